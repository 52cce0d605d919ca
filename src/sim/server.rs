//! Servers of a bus: over streams, TCP, UDP and serial ports.

mod connection;
mod serial;
mod session;
mod tcp;
mod udp;

use std::future::{Ready, ready};
use std::io;
use std::time::Duration;

use bytes::BytesMut;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, DuplexStream, duplex};
use tokio::runtime::Handle;
use tokio::time;
use tokio_util::codec::Decoder;

pub use self::serial::SerialServer;
use self::session::run_session;
pub use self::tcp::{MAX_CONNECTIONS, Server};
pub use self::udp::UdpServer;
use super::Bus;
use super::fault::{Faults, Session};
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Side};

/// Time for the replies to requests that have arrived when a server is shut down.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

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
        let event = read_event(&mut stream, &mut received, bus.idle_limit()).await?;
        let mut next = || match event {
            ReadEvent::Bytes => codec.decode(&mut received),
            ReadEvent::Silence => codec.decode_eof(&mut received),
            ReadEvent::End => Ok(None),
        };
        if let ReadEvent::End = event {
            return Ok(());
        }
        let mut reordered = Vec::new().into_iter();
        if bus.reorders() {
            let mut items = Vec::new();
            while let Some(item) = next()? {
                items.push(item);
            }
            bus.reorder(&mut items);
            reordered = items.into_iter();
        }
        while let Some(item) = reordered.next().map_or_else(&mut next, |item| Ok(Some(item)))? {
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

async fn read_event(
    stream: &mut (impl AsyncRead + Unpin),
    received: &mut BytesMut,
    idle_limit: Option<Duration>,
) -> io::Result<ReadEvent> {
    let begun = !received.is_empty();
    let read = stream.read_buf(received);
    let len = if begun {
        match time::timeout(FRAME_TIMEOUT, read).await {
            Ok(len) => len?,
            Err(_) => return Ok(ReadEvent::Silence),
        }
    } else if let Some(limit) = idle_limit {
        match time::timeout(limit, read).await {
            Ok(len) => len?,
            Err(_) => return Ok(ReadEvent::End),
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

#[cfg(test)]
mod tests;
