//! Passing of bytes between clients over TCP or a serial port, and the PLC.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fatek::Endpoint;
use fatek::endpoint::EndpointStream;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, split};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{AcquireError, OwnedSemaphorePermit, Semaphore};
use tokio::task::JoinSet;
use tokio::time;

use super::MAX_CONNECTIONS;
use super::writer::RecordingWriter;
use crate::connect;
use crate::conversation::{Change, Direction};
use crate::failure::Failure;
use crate::listen::accept;
use crate::output::{Output, complain};

/// Longest time for the other direction after one has ended. A serial port does not end, and the next
/// client waits for it.
const LINGER: Duration = Duration::from_secs(2);
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
                    connection(stream, ends, &endpoint, timeout, &writer).await
                });
                accepting.set(next_client(&listener, &places));
            }
        }
    }
}

/// Passes bytes between a serial port and the PLC, until one of them ends.
pub(super) async fn pass_port(
    port: EndpointStream,
    url: &str,
    endpoint: &Endpoint,
    timeout: Option<Duration>,
    writer: &RecordingWriter,
    output: &Output,
) -> Result<(), Failure> {
    report(connection(port, format!("{url} > {endpoint}"), endpoint, timeout, writer).await, output);
    Ok(())
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
type Ended = (String, Result<(), ConnectionError>);

#[derive(Debug)]
enum ConnectionError {
    NotOpened(io::Error),
    Lost(io::Error),
}

fn report((ends, result): Ended, output: &Output) {
    match result {
        Ok(()) => output.remark(format_args!("{ends}: closed")),
        Err(ConnectionError::NotOpened(error)) => complain(format_args!("{ends}: cannot connect: {error}")),
        Err(ConnectionError::Lost(error)) => output.remark(format_args!("{ends}: lost: {error}")),
    }
}

async fn connection<S>(
    client: S,
    ends: String,
    endpoint: &Endpoint,
    timeout: Option<Duration>,
    writer: &RecordingWriter,
) -> Ended
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let number = writer.open(ends.clone());
    let is_serial = endpoint.transport().serial_settings().is_some();
    let linger = if is_serial { SERIAL_LINGER } else { LINGER };
    let result = match connect::open(endpoint, timeout).await {
        Ok(plc) => pass(client, plc, number, linger, writer).await.map_err(ConnectionError::Lost),
        Err(error) => Err(ConnectionError::NotOpened(error)),
    };
    writer.record(number, &Change::Close);
    (ends, result)
}

/// Passes bytes in both directions. The end of one is passed on; the other may go on for a while.
async fn pass<C, P>(client: C, plc: P, number: u64, linger: Duration, writer: &RecordingWriter) -> io::Result<()>
where
    C: AsyncRead + AsyncWrite + Unpin,
    P: AsyncRead + AsyncWrite + Unpin,
{
    let (from_client, to_client) = split(client);
    let (from_plc, to_plc) = split(plc);
    let requests = copy(from_client, to_plc, Direction::ToPlc, number, writer);
    let replies = copy(from_plc, to_client, Direction::FromPlc, number, writer);
    tokio::pin!(requests, replies);
    tokio::select! {
        ended = &mut requests => {
            ended?;
            time::timeout(linger, replies).await.unwrap_or(Ok(()))
        }
        ended = &mut replies => {
            ended?;
            time::timeout(linger, requests).await.unwrap_or(Ok(()))
        }
    }
}

async fn copy(
    mut from: impl AsyncRead + Unpin,
    mut to: impl AsyncWrite + Unpin,
    direction: Direction,
    number: u64,
    writer: &RecordingWriter,
) -> io::Result<()> {
    let mut buffer = vec![0; READ_LEN];
    loop {
        let len = from.read(&mut buffer).await?;
        let bytes = buffer.get(..len).unwrap_or_default();
        if bytes.is_empty() {
            return to.shutdown().await;
        }
        let change = Change::Bytes { direction, bytes: Bytes::copy_from_slice(bytes), is_datagram: false };
        writer.record(number, &change);
        to.write_all(bytes).await?;
    }
}
