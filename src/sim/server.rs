mod converse;
mod udp;

use std::future::{Ready, ready};
use std::io;
use std::net::SocketAddr;
use std::pin::pin;
use std::time::Duration;

use bytes::BytesMut;
use futures::future;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, DuplexStream, duplex};
use tokio::net::{TcpListener, ToSocketAddrs};
use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time;
use tokio_util::codec::Decoder;
use tracing::debug;

use self::converse::converse;
pub use self::udp::UdpServer;
use super::Bus;
use super::fault::{Conversation, Faults};
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Side};

/// How many connections a [`Server`] has at a time; further ones wait until one of them ends.
pub const MAX_CONNECTIONS: usize = 64;

/// Answers what comes from a stream, until it ends.
///
/// One request after the other, as a PLC does. A frame whose rest does not come within 100 ms is given up, so that what
/// follows is not taken for its rest. With [`Faults`] it is as their [documentation](super::fault) says.
///
/// ```
/// use fatek::sim::{self, Bus, Plc};
/// use fatek::wire::Framing;
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let (client, line) = tokio::io::duplex(1024);
/// let serving = tokio::spawn(sim::serve(line, Bus::new().with_station(1, Plc::new())?, Framing::Binary));
/// drop(client);
/// serving.await??;
/// # Ok(())
/// # }
/// ```
///
/// It needs the timer of the Tokio runtime.
///
/// # Errors
/// Those of the stream.
pub async fn serve<S>(stream: S, bus: Bus, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    match bus.conditions().cloned() {
        None => serve_at_once(stream, bus, framing).await,
        // In a box, so that those who have no faults do not pay for them with memory.
        Some(conditions) => Box::pin(converse(stream, Conversation::new(bus, conditions, framing), framing)).await,
    }
}

/// Without a queue and without time: a reply is out before the next request is looked at.
async fn serve_at_once<S>(mut stream: S, bus: Bus, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut codec = Codec::new(framing, Side::Plc);
    let mut received = BytesMut::with_capacity(MAX_FRAME_LEN);
    let mut reply = BytesMut::with_capacity(MAX_FRAME_LEN);
    loop {
        let heard = listen(&mut stream, &mut received).await?;
        loop {
            let item = match heard {
                Heard::Bytes => codec.decode(&mut received)?,
                Heard::Silence => codec.decode_eof(&mut received)?,
                Heard::End => return Ok(()),
            };
            let Some(item) = item else { break };
            bus.answer(&item, framing, &mut reply);
            stream.write_all(&reply).await?;
            reply.clear();
        }
    }
}

/// How long a frame may pause in its middle.
const SILENCE: Duration = Duration::from_millis(100);

enum Heard {
    Bytes,
    /// A frame has begun, and nothing more has come of it.
    Silence,
    End,
}

async fn listen(stream: &mut (impl AsyncRead + Unpin), received: &mut BytesMut) -> io::Result<Heard> {
    let begun = !received.is_empty();
    let read = stream.read_buf(received);
    let len = if begun {
        match time::timeout(SILENCE, read).await {
            Ok(len) => len?,
            Err(_) => return Ok(Heard::Silence),
        }
    } else {
        read.await?
    };
    Ok(if len == 0 { Heard::End } else { Heard::Bytes })
}

/// Opens connections to a bus in memory, for [`Link::connector_builder`](crate::Link::connector_builder): no port, no
/// sockets, and so the same run every time under a paused clock. Each connection is served by a task of the runtime, and
/// [`Fault::Refuse`](super::Fault::Refuse) refuses it.
///
/// ```
/// use fatek::sim::{self, Bus, Plc};
/// use fatek::{Link, register, wire::Framing};
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let bus = Bus::new().with_station(1, Plc::new())?;
/// let link = Link::connector_builder("in memory", Framing::Ascii, sim::connector(bus, Framing::Ascii)).build();
/// assert_eq!(link.station(1)?.read_registers(register!("R0"), 2).await?, [0, 0]);
/// # Ok(())
/// # }
/// ```
pub fn connector(bus: Bus, framing: Framing) -> impl FnMut() -> Ready<io::Result<DuplexStream>> + Send + 'static {
    move || ready(connect(&bus, framing))
}

fn connect(bus: &Bus, framing: Framing) -> io::Result<DuplexStream> {
    let runtime = Handle::try_current().map_err(io::Error::other)?;
    if bus.faults().is_some_and(Faults::refuse_connection) {
        return Err(io::ErrorKind::ConnectionRefused.into());
    }
    let (client, line) = duplex(4 * MAX_FRAME_LEN);
    runtime.spawn(serve(line, bus.clone(), framing));
    Ok(client)
}

/// A [`Bus`] behind a TCP port, as behind an Ethernet module.
///
/// Dropping it stops accepting and closes its connections, soon; [`shutdown`](Self::shutdown) waits until that is done.
///
/// The [module's documentation](super) has an example.
#[derive(Debug)]
pub struct Server {
    local_addr: SocketAddr,
    /// Closes when this server is dropped, and that stops the task.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl Server {
    /// Listens on an address, such as `127.0.0.1:0` for any free port of this machine, and answers every connection as
    /// [`serve`] does, at most [`MAX_CONNECTIONS`] at a time.
    ///
    /// # Errors
    /// Those of binding the address.
    pub async fn bind(address: impl ToSocketAddrs, bus: Bus, framing: Framing) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let local_addr = listener.local_addr()?;
        let (stop, stopped) = oneshot::channel();
        let task = tokio::spawn(serve_until(stopped, listener, bus, framing));
        Ok(Self { local_addr, stop, task })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Stops accepting, closes the connections, and returns when both are done.
    pub async fn shutdown(self) {
        drop(self.stop);
        if let Err(error) = self.task.await {
            debug!(%error, "the task of the simulated PLC failed");
        }
    }
}

async fn serve_until(stopped: oneshot::Receiver<()>, listener: TcpListener, bus: Bus, framing: Framing) {
    let mut connections = JoinSet::new();
    {
        let accepting = pin!(accept(&listener, &mut connections, &bus, framing));
        future::select(accepting, stopped).await;
    }
    // The port first: a client that loses its connection may be quick to open the next.
    drop(listener);
    connections.shutdown().await;
}

/// Never ends.
async fn accept(listener: &TcpListener, connections: &mut JoinSet<()>, bus: &Bus, framing: Framing) {
    loop {
        while connections.try_join_next().is_some() {}
        if connections.len() >= MAX_CONNECTIONS {
            connections.join_next().await;
        }
        match listener.accept().await {
            Ok((_, peer)) if bus.faults().is_some_and(Faults::refuse_connection) => debug!(%peer, "refused"),
            Ok((stream, peer)) => {
                debug!(%peer, "accepted");
                let bus = bus.clone();
                connections.spawn(async move {
                    // A reply is one small segment, and the client waits for it.
                    let _ = stream.set_nodelay(true);
                    let result = serve(stream, bus, framing).await;
                    debug!(%peer, ?result, "closed");
                });
            }
            Err(error) => {
                // Such as too many open files: it takes a moment to pass, and must not be asked for in a tight loop.
                debug!(%error, "cannot accept");
                time::sleep(SILENCE).await;
            }
        }
    }
}

#[cfg(test)]
mod tests;
