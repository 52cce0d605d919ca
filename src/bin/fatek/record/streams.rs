//! Passing of bytes between clients over TCP or a serial port, and the PLC.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use fatek::Endpoint;
use fatek::endpoint::{DataBits, EndpointStream, Parity, SerialSettings, StopBits};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, split};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{AcquireError, OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinSet;
use tokio::time::{self, Instant};

use super::MAX_CONNECTIONS;
use super::writer::RecordingWriter;
use crate::connect;
use crate::conversation::{Change, Direction};
use crate::failure::Failure;
use crate::listen::accept;
use crate::output::{Output, complain};
use crate::traffic::TrafficFailure;

/// Longest time for the other direction after one has ended.
const LINGER: Duration = Duration::from_secs(30);

/// The same for a PLC at a serial port, which does not end, and the next client waits for it: with a
/// request that has no reply so far, and without one.
const SERIAL_REPLY_LINGER: Duration = Duration::from_secs(2);
const SERIAL_LINGER: Duration = Duration::from_millis(300);

/// Bytes that are read at a time: some frames.
const READ_LEN: usize = 4096;

/// Accepts connections, and opens one to the PLC for each; over a serial port one at a time.
pub(super) async fn pass_connections(
    listener: TcpListener,
    endpoint: &Endpoint,
    timeout: Option<Duration>,
    writer: &RecordingWriter,
    output: &Output,
) -> Result<(), Failure> {
    let is_one_line = endpoint.transport().serial_settings().is_some();
    let places = Arc::new(Semaphore::new(if is_one_line { 1 } else { MAX_CONNECTIONS }));
    let mut passing = JoinSet::new();
    // Not made anew for each event: a place must not be given up between two of them.
    let mut accepting = Box::pin(next_client(&listener, &places));
    loop {
        tokio::select! {
            biased;
            Some(ended) = passing.join_next() => {
                if let Ok(ended) = ended {
                    report(ended, output);
                }
            }
            (permit, (stream, client)) = &mut accepting => {
                let (endpoint, writer) = (endpoint.clone(), writer.clone());
                let ends = format!("tcp {client} > {endpoint}");
                output.remark(format_args!("{ends}: open"));
                passing.spawn(async move {
                    let _permit = permit;
                    let client = Side { stream, byte_time: Duration::ZERO };
                    connection(client, ends, &endpoint, timeout, &writer).await
                });
                accepting.set(next_client(&listener, &places));
            }
        }
    }
}

/// A serial port with a client at its other end.
pub(super) struct SerialClient<'u> {
    pub(super) port: EndpointStream,
    pub(super) settings: SerialSettings,
    pub(super) url: &'u str,
}

/// Passes bytes between a serial port and the PLC, until one of them ends, which is a failure: a serial
/// port has no end.
pub(super) async fn pass_port(
    client: SerialClient<'_>,
    endpoint: &Endpoint,
    timeout: Option<Duration>,
    writer: &RecordingWriter,
) -> Failure {
    let SerialClient { port, settings, url } = client;
    let ends = format!("{url} > {endpoint}");
    let client = Side { stream: port, byte_time: byte_time(settings) };
    let (ends, result) = connection(client, ends, endpoint, timeout, writer).await;
    let failure = match result {
        Err(ConnectionError::NotOpened(error)) => TrafficFailure::NotConnected { url: endpoint.to_string(), error },
        Err(ConnectionError::Lost(error)) => TrafficFailure::Lost { ends, error },
        Ok(_) => TrafficFailure::Lost { ends, error: io::ErrorKind::UnexpectedEof.into() },
    };
    failure.into()
}

/// Waits for a place, and for a client. The error is that of a closed semaphore, which this one never is.
async fn next_client(
    listener: &TcpListener,
    places: &Arc<Semaphore>,
) -> (Result<OwnedSemaphorePermit, AcquireError>, (TcpStream, String)) {
    let permit = places.clone().acquire_owned().await;
    (permit, accept(listener).await)
}

/// Result of a connection: its ends, and the way it ended.
type Ended = (String, Result<End, ConnectionError>);

/// End of a connection without an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// Both directions have ended.
    Both,
    /// The other direction was still open after this time.
    CutAfter(Duration),
}

#[derive(Debug)]
enum ConnectionError {
    NotOpened(io::Error),
    Lost(io::Error),
}

fn report((ends, result): Ended, output: &Output) {
    match result {
        Ok(End::Both) => output.remark(format_args!("{ends}: closed")),
        Ok(End::CutAfter(linger)) => output.remark(format_args!(
            "{ends}: closed by one end; the other was still open {linger:?} later, and is cut off"
        )),
        Err(ConnectionError::NotOpened(error)) => complain(format_args!("{ends}: cannot connect: {error}")),
        Err(ConnectionError::Lost(error)) => output.remark(format_args!("{ends}: lost: {error}")),
    }
}

async fn connection<S>(
    client: Side<S>,
    ends: String,
    endpoint: &Endpoint,
    timeout: Option<Duration>,
    writer: &RecordingWriter,
) -> Ended
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let number = writer.open(ends.clone());
    let settings = endpoint.transport().serial_settings();
    let result = match connect::open(endpoint, timeout).await {
        Ok(stream) => {
            let plc = Side { stream, byte_time: settings.map_or(Duration::ZERO, byte_time) };
            pass(client, plc, settings.is_some(), number, writer).await.map_err(ConnectionError::Lost)
        }
        Err(error) => Err(ConnectionError::NotOpened(error)),
    };
    writer.record(number, &Change::Close);
    (ends, result)
}

/// One side of a connection.
struct Side<S> {
    stream: S,
    /// Transmission time of a byte on a serial line, zero on others.
    byte_time: Duration,
}

/// Transmission time of a byte with its start, parity and stop bits.
fn byte_time(settings: SerialSettings) -> Duration {
    let data = if settings.data_bits() == DataBits::Seven { 7 } else { 8 };
    let parity = u32::from(settings.parity() != Parity::None);
    let stop = if settings.stop_bits() == StopBits::Two { 2 } else { 1 };
    Duration::from_secs(u64::from(1 + data + parity + stop)) / settings.baud().max(1)
}

/// Passes bytes in both directions. The end of one is passed on; the other may go on for a while.
async fn pass<C, P>(
    client: Side<C>,
    plc: Side<P>,
    plc_is_serial: bool,
    number: u64,
    writer: &RecordingWriter,
) -> io::Result<End>
where
    C: AsyncRead + AsyncWrite + Unpin,
    P: AsyncRead + AsyncWrite + Unpin,
{
    let awaits_reply = AtomicBool::new(false);
    let (from_client, to_client) = split(client.stream);
    let (from_plc, to_plc) = split(plc.stream);
    let connection = Passing { number, writer, awaits_reply: &awaits_reply };
    let requests = connection.copy(from_client, to_plc, plc.byte_time, Direction::ToPlc);
    let replies = connection.copy(from_plc, to_client, client.byte_time, Direction::FromPlc);
    tokio::pin!(requests, replies);
    let linger = || match (plc_is_serial, awaits_reply.load(Ordering::Relaxed)) {
        (false, _) => LINGER,
        (true, true) => SERIAL_REPLY_LINGER,
        (true, false) => SERIAL_LINGER,
    };
    let (linger, ended) = tokio::select! {
        ended = &mut requests => {
            ended?;
            let linger = linger();
            (linger, time::timeout(linger, replies).await)
        }
        ended = &mut replies => {
            ended?;
            let linger = linger();
            (linger, time::timeout(linger, requests).await)
        }
    };
    match ended {
        Ok(ended) => ended.map(|()| End::Both),
        // The next client waits for a serial port, which has no end.
        Err(_) if plc_is_serial && !awaits_reply.load(Ordering::Relaxed) => Ok(End::Both),
        Err(_) => Ok(End::CutAfter(linger)),
    }
}

/// A connection whose bytes are passed.
struct Passing<'p> {
    number: u64,
    writer: &'p RecordingWriter,
    /// The last bytes are those of the client.
    awaits_reply: &'p AtomicBool,
}

impl Passing<'_> {
    /// Passes the bytes of one direction up to its end.
    async fn copy(
        &self,
        mut from: impl AsyncRead + Unpin,
        mut to: impl AsyncWrite + Unpin,
        byte_time: Duration,
        direction: Direction,
    ) -> io::Result<()> {
        let mut buffer = vec![0; READ_LEN];
        let mut transmitted = Instant::now();
        loop {
            let len = from.read(&mut buffer).await?;
            let bytes = buffer.get(..len).unwrap_or_default();
            if bytes.is_empty() {
                // A serial port that is closed discards the bytes that are not on the line yet.
                time::sleep_until(transmitted).await;
                return to.shutdown().await;
            }
            self.awaits_reply.store(direction == Direction::ToPlc, Ordering::Relaxed);
            let change = Change::Bytes { direction, bytes: Bytes::copy_from_slice(bytes), is_datagram: false };
            self.writer.record(self.number, &change);
            to.write_all(bytes).await?;
            let count = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
            transmitted = transmitted.max(Instant::now()) + byte_time.saturating_mul(count);
        }
    }
}
