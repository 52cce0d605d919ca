mod session;
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

use self::session::run_session;
pub use self::udp::UdpServer;
use super::Bus;
use super::fault::{Faults, Session};
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Side};

/// Maximum number of connections of a [`Server`]. Further ones wait until one of them ends.
pub const MAX_CONNECTIONS: usize = 64;

/// Serves a bus over a stream, until the stream ends.
///
/// Requests are handled one at a time, as by a PLC. An incomplete frame is discarded after a pause
/// of 100 ms, so that the next frame is not taken for its rest. For a bus with [`Faults`], see
/// [`fault`](super::fault).
///
/// ```
/// use fatek::sim::{self, Bus, Plc};
/// use fatek::wire::Framing;
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let (client, line) = tokio::io::duplex(1024);
/// let bus = Bus::new().with_station(1, Plc::new())?;
/// let serving = tokio::spawn(sim::serve(line, bus, Framing::Binary));
/// drop(client);
/// serving.await??;
/// # Ok(())
/// # }
/// ```
///
/// Requires the timer of the Tokio runtime.
///
/// # Errors
/// Errors of the stream.
pub async fn serve<S>(stream: S, bus: Bus, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    match bus.conditions().cloned() {
        None => serve_at_once(stream, bus, framing).await,
        // Boxed, since this future is large: without faults it costs no memory.
        Some(conditions) => Box::pin(run_session(stream, Session::new(bus, conditions, framing), framing)).await,
    }
}

/// Without a queue and without delays: each reply is written before the next request is decoded.
async fn serve_at_once<S>(mut stream: S, bus: Bus, framing: Framing) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut codec = Codec::new(framing, Side::Plc);
    let mut received = BytesMut::with_capacity(MAX_FRAME_LEN);
    let mut reply = BytesMut::with_capacity(MAX_FRAME_LEN);
    loop {
        let event = read_event(&mut stream, &mut received).await?;
        loop {
            let item = match event {
                ReadEvent::Bytes => codec.decode(&mut received)?,
                ReadEvent::Silence => codec.decode_eof(&mut received)?,
                ReadEvent::End => return Ok(()),
            };
            let Some(item) = item else { break };
            bus.answer(&item, framing, &mut reply);
            stream.write_all(&reply).await?;
            reply.clear();
        }
    }
}

/// Longest pause within a frame.
const FRAME_TIMEOUT: Duration = Duration::from_millis(100);

enum ReadEvent {
    Bytes,
    /// An incomplete frame was received, and no byte after it for [`FRAME_TIMEOUT`].
    Silence,
    End,
}

async fn read_event(stream: &mut (impl AsyncRead + Unpin), received: &mut BytesMut) -> io::Result<ReadEvent> {
    let begun = !received.is_empty();
    let read = stream.read_buf(received);
    let len = if begun {
        match time::timeout(FRAME_TIMEOUT, read).await {
            Ok(len) => len?,
            Err(_) => return Ok(ReadEvent::Silence),
        }
    } else {
        read.await?
    };
    Ok(if len == 0 { ReadEvent::End } else { ReadEvent::Bytes })
}

/// Opens connections to a bus in memory, for
/// [`Link::connector_builder`](crate::Link::connector_builder).
///
/// Without ports and sockets, a test is reproducible under a paused clock. Each connection is
/// served by a task of the runtime. [`Fault::Refuse`](super::Fault::Refuse) refuses connections.
///
/// ```
/// use fatek::sim::{self, Bus, Plc};
/// use fatek::{Link, register, wire::Framing};
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let bus = Bus::new().with_station(1, Plc::new())?;
/// let connector = sim::connector(bus, Framing::Ascii);
/// let link = Link::connector_builder("in memory", Framing::Ascii, connector).build();
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

/// A TCP server for a [`Bus`], as an Ethernet module.
///
/// Dropping it closes the port and all connections; [`shutdown`](Self::shutdown) also waits for
/// that. The [module](super) has an example.
#[derive(Debug)]
pub struct Server {
    local_addr: SocketAddr,
    /// Stops the task when dropped.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl Server {
    /// Listens on an address, such as `127.0.0.1:0` for any free local port.
    ///
    /// Each connection is served as by [`serve`], at most [`MAX_CONNECTIONS`] at a time.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn bind(address: impl ToSocketAddrs, bus: Bus, framing: Framing) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let local_addr = listener.local_addr()?;
        let (stop, stopped) = oneshot::channel();
        let task = tokio::spawn(serve_until(stopped, listener, bus, framing));
        Ok(Self { local_addr, stop, task })
    }

    /// The address it listens on.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Closes the port and all connections, and returns when that is done.
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
    // The port is closed first: a client can reconnect as soon as its connection ends.
    drop(listener);
    connections.shutdown().await;
}

/// Accepts connections. Never returns.
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
                    // A reply is one small segment: without this, Nagle's algorithm delays it.
                    let _ = stream.set_nodelay(true);
                    let result = serve(stream, bus, framing).await;
                    debug!(%peer, ?result, "closed");
                });
            }
            Err(error) => {
                // For instance too many open files. The pause prevents a busy loop.
                debug!(%error, "cannot accept");
                time::sleep(FRAME_TIMEOUT).await;
            }
        }
    }
}

#[cfg(test)]
mod tests;
