//! Sends an [`Enquiry`] over a line and waits for its reply.

use std::io;
use std::time::Duration;

use fatek::command::{Command, ReadStatus};
use fatek::wire::Framing;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::UdpSocket;
use tokio::time::{Instant, timeout, timeout_at};

use super::{Enquiry, Reply, Traffic};

/// A line to stations.
pub(crate) trait Line {
    async fn send(&mut self, request: &[u8]) -> io::Result<()>;

    /// Waits for bytes; at least one is returned.
    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize>;
}

/// A stream of bytes: TCP, or a serial port.
pub(crate) struct Stream<T>(pub(crate) T);

/// A connected UDP socket: each request is a datagram.
pub(crate) struct Datagrams(pub(crate) UdpSocket);

impl<T: AsyncRead + AsyncWrite + Unpin> Line for Stream<T> {
    async fn send(&mut self, request: &[u8]) -> io::Result<()> {
        // Never flushed: of a serial port that blocks.
        self.0.write_all(request).await
    }

    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self.0.read(buffer).await? {
            0 => Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the other end closed the connection")),
            len => Ok(len),
        }
    }
}

impl Line for Datagrams {
    async fn send(&mut self, request: &[u8]) -> io::Result<()> {
        self.0.send(request).await.map(drop)
    }

    async fn receive(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            match self.0.recv(buffer).await? {
                0 => {}
                len => return Ok(len),
            }
        }
    }
}

/// The end of an exchange.
#[derive(Debug)]
pub(crate) struct Outcome<T> {
    /// The reply, with its round trip.
    pub(crate) reply: Option<(Reply<T>, Duration)>,
    pub(crate) traffic: Traffic,
    /// The line has ended.
    pub(crate) lost: Option<io::Error>,
}

/// Sends a request and waits for its reply, at most for this time from the beginning of the request.
///
/// Cancel-safe for the line: a request that was not written whole is no frame.
pub(crate) async fn ask<C: Command>(
    line: &mut impl Line,
    command: C,
    framing: Framing,
    station: u8,
    within: Duration,
) -> Outcome<C::Reply> {
    let sent_at = Instant::now();
    let mut enquiry = match Enquiry::new(command, framing, station) {
        Ok(enquiry) => enquiry,
        Err(invalid) => {
            return Outcome {
                reply: None,
                traffic: Traffic::default(),
                lost: Some(io::Error::other(invalid.to_string())),
            };
        }
    };
    let exchange = async {
        let request = enquiry.request();
        tracing::trace!(station, bytes = %request.escape_ascii(), "sending");
        line.send(&request).await?;
        receive(line, &mut enquiry).await
    };
    let (reply, lost) = match timeout_at(sent_at + within, exchange).await {
        Ok(Ok(reply)) => (Some((reply, sent_at.elapsed())), None),
        Ok(Err(error)) => (None, Some(error)),
        Err(_) => (None, None),
    };
    Outcome { reply, traffic: enquiry.end(), lost }
}

/// Listens without a request: the traffic of a framing in this time, or until the line ends, with the
/// reason of its end.
pub(crate) async fn listen(line: &mut impl Line, framing: Framing, time: Duration) -> (Traffic, Option<io::Error>) {
    // No station answers as station 0, so no frame is taken for a reply.
    let Ok(mut enquiry) = Enquiry::new(ReadStatus, framing, 0) else { return (Traffic::default(), None) };
    let lost = timeout(time, receive(line, &mut enquiry)).await.ok().and_then(Result::err);
    (enquiry.end(), lost)
}

/// Receives until the reply comes.
async fn receive<C: Command>(line: &mut impl Line, enquiry: &mut Enquiry<C>) -> io::Result<Reply<C::Reply>> {
    // A datagram is at most as long as this.
    let mut buffer = [0; 2048];
    loop {
        let len = line.receive(&mut buffer).await?;
        let bytes = buffer.get(..len).unwrap_or_default();
        tracing::trace!(bytes = %bytes.escape_ascii(), "received");
        if let Some(reply) = enquiry.receive(bytes) {
            return Ok(reply);
        }
    }
}
