//! The line of an examination: bytes and datagrams as they come, without the checks of a link.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use fatek::Endpoint;
use fatek::endpoint::Transport;
use fatek::link::defaults;
use fatek::wire::{Codec, Framing, MAX_FRAME_LEN, Received, Side};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{UdpSocket, lookup_host};
use tokio::time::{Instant, timeout};
use tokio_util::codec::Decoder;

use super::exchange::{Arrival, Item};
use crate::connect;

/// The kind of line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Medium {
    Tcp,
    Udp,
    Serial,
}

impl Medium {
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Tcp => "tcp",
            Self::Udp => "udp",
            Self::Serial => "serial",
        }
    }
}

/// Opens connections to the PLC.
pub(crate) trait Connect {
    fn medium(&self) -> Medium;

    async fn open(&mut self) -> io::Result<Wire>;

    /// The time that this many bytes take on the line.
    fn transmission(&self, _bytes: usize) -> Duration {
        Duration::ZERO
    }
}

impl Connect for Endpoint {
    fn medium(&self) -> Medium {
        match self.transport() {
            Transport::Udp { .. } => Medium::Udp,
            Transport::Serial { .. } => Medium::Serial,
            Transport::Tcp { .. } | _ => Medium::Tcp,
        }
    }

    async fn open(&mut self) -> io::Result<Wire> {
        match self.transport() {
            Transport::Udp { host, port, .. } => {
                let opened = timeout(defaults::CONNECT_TIMEOUT, Wire::udp(host, *port)).await;
                opened.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
            }
            Transport::Tcp { .. } | Transport::Serial { .. } | _ => {
                Ok(Wire::Stream(Box::new(connect::open(self, None).await?)))
            }
        }
    }

    fn transmission(&self, bytes: usize) -> Duration {
        // At most 12 bits for each byte: start, data, parity and stop bits.
        let baud = self.transport().serial_settings().map_or(f64::INFINITY, |settings| settings.baud().into());
        Duration::from_secs_f64(12.0 * bytes as f64 / baud)
    }
}

pub(crate) trait Stream: AsyncRead + AsyncWrite + Unpin {}
impl<T: AsyncRead + AsyncWrite + Unpin> Stream for T {}

/// One connection, or one UDP socket.
pub(crate) enum Wire {
    Stream(Box<dyn Stream>),
    Datagrams { socket: UdpSocket, peer: SocketAddr },
}

/// Bytes of one read, or one datagram.
#[derive(Debug)]
pub(crate) struct Chunk {
    bytes: Bytes,
    other_port: bool,
}

impl Wire {
    /// A socket that is not connected: replies from other ports of the host are of interest.
    async fn udp(host: &str, port: u16) -> io::Result<Self> {
        let none = || io::Error::new(io::ErrorKind::NotFound, "the host has no address");
        let mut addresses: Vec<SocketAddr> = lookup_host((host, port)).await?.collect();
        // The modules have IPv4.
        addresses.sort_by_key(SocketAddr::is_ipv6);
        let peer = *addresses.first().ok_or_else(none)?;
        let any: IpAddr = match peer {
            SocketAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
            SocketAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
        };
        Ok(Self::Datagrams { socket: UdpSocket::bind((any, 0)).await?, peer })
    }

    pub(crate) async fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Self::Stream(stream) => stream.write_all(bytes).await,
            Self::Datagrams { socket, peer } => socket.send_to(bytes, *peer).await.map(drop),
        }
    }

    /// Returns the next bytes; `None` at the end of the stream. Cancel-safe.
    async fn read(&mut self) -> io::Result<Option<Chunk>> {
        let mut buffer = BytesMut::with_capacity(2 * MAX_FRAME_LEN);
        match self {
            Self::Stream(stream) => {
                let len = stream.read_buf(&mut buffer).await?;
                Ok((len > 0).then(|| Chunk { bytes: buffer.freeze(), other_port: false }))
            }
            Self::Datagrams { socket, peer } => loop {
                buffer.clear();
                let (_, from) = socket.recv_buf_from(&mut buffer).await?;
                if from.ip() == peer.ip() && !buffer.is_empty() {
                    return Ok(Some(Chunk { bytes: buffer.freeze(), other_port: from.port() != peer.port() }));
                }
            },
        }
    }
}

/// A connection with its decoder.
pub(crate) struct Receiver {
    pub(crate) wire: Wire,
    codec: Codec,
    buffer: BytesMut,
    pieces: usize,
    pause: Duration,
    last_read: Option<Instant>,
}

impl Receiver {
    pub(crate) fn new(wire: Wire, framing: Framing) -> Self {
        let codec = Codec::new(framing, Side::Client);
        Self { wire, codec, buffer: BytesMut::new(), pieces: 0, pause: Duration::ZERO, last_read: None }
    }

    /// Waits for bytes, and returns the items that are complete then; `None` at the end of the stream.
    ///
    /// `sent`: bytes whose return is an echo. Cancel-safe.
    pub(crate) async fn receive(&mut self, sent_at: Instant, sent: &[u8]) -> io::Result<Option<Vec<Arrival>>> {
        let Some(chunk) = self.wire.read().await? else { return Ok(None) };
        let now = Instant::now();
        if let Some(last) = self.last_read.filter(|_| !self.buffer.is_empty()) {
            self.pause = self.pause.max(now - last);
        }
        self.last_read = Some(now);
        self.pieces += 1;
        self.buffer.extend_from_slice(&chunk.bytes);
        let mut arrivals = Vec::new();
        while let Some((item, bytes)) = self.decode(false)? {
            arrivals.push(self.arrival(item, bytes, sent, now.saturating_duration_since(sent_at), chunk.other_port));
        }
        Ok(Some(arrivals))
    }

    /// Gives up an incomplete frame.
    pub(crate) fn give_up(&mut self, sent_at: Instant, sent: &[u8]) -> io::Result<Vec<Arrival>> {
        let after = Instant::now().saturating_duration_since(sent_at);
        let mut arrivals = Vec::new();
        while let Some((item, bytes)) = self.decode(true)? {
            arrivals.push(self.arrival(item, bytes, sent, after, false));
        }
        Ok(arrivals)
    }

    fn decode(&mut self, at_end: bool) -> io::Result<Option<(Received, Bytes)>> {
        if self.buffer.is_empty() {
            return Ok(None);
        }
        let before = Bytes::copy_from_slice(&self.buffer);
        let item =
            if at_end { self.codec.decode_eof(&mut self.buffer)? } else { self.codec.decode(&mut self.buffer)? };
        Ok(item.map(|item| (item, before.slice(..before.len() - self.buffer.len()))))
    }

    fn arrival(&mut self, item: Received, bytes: Bytes, sent: &[u8], after: Duration, other_port: bool) -> Arrival {
        let item = match item {
            _ if !sent.is_empty() && bytes == sent => Item::Echo(bytes),
            Received::Frame(frame) => Item::Frame(frame, bytes),
            Received::Discarded { reason, .. } => Item::Noise(reason, bytes),
            // A codec has no other items.
            _ => Item::Noise(fatek::wire::Discard::Garbage, bytes),
        };
        let (pieces, pause) = (self.pieces, self.pause);
        (self.pieces, self.pause) = (usize::from(!self.buffer.is_empty()), Duration::ZERO);
        Arrival { after, unawaited: false, item, pieces, pause, other_port }
    }
}
