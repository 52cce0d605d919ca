//! UDP as a stream: the local port is the transaction id.
//!
//! Each request (a write, a datagram) is sent from the next of [`SOCKETS`] connected sockets. So a
//! reply to an earlier request, late or a duplicate, comes to a port that is not read.
//!
//! Invariants:
//! - A read returns only datagrams that came to the socket of the last write after its queue was
//!   emptied.
//! - All sockets are opened in [`connect`]: a write may run on a runtime other than the link's.
//! - If a read is pending, its waker is registered with the socket of the last write.

use std::io::{self, Read as _};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::ops::Range;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker, ready};

use bytes::BytesMut;
use socket2::SockRef;
use tokio::io::{AsyncRead, AsyncWrite, Interest, ReadBuf};
use tokio::net::UdpSocket;
use tokio::task::consume_budget;
use tokio_util::codec::Decoder;
use tokio_util::sync::ReusableBoxFuture;

use super::lookup::lookup;
use super::{Address, Kind, Transport, authority};
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Side, fingerprint};

// Opening a socket sends nothing to the PLC.
pub(super) static KIND: Kind =
    Kind { prefix: "udp://", own_options: None, is_remote: false, is_one_line: false, parse };

fn parse(address: &Address<'_>) -> Result<Transport, String> {
    let (host, port) = authority::parse(address.scheme, address.text, address.framing)?;
    Ok(Transport::Udp { host, port })
}

/// Numbers of datagrams that came to the ports of earlier requests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct LateDatagrams {
    /// Duplicates of the datagram that was read last from that port.
    pub(crate) duplicates: u64,
    /// All others.
    pub(crate) others: u64,
}

/// Number of sockets of a connection: a local port is used again after as many requests.
const SOCKETS: usize = 4;

/// Maximum number of datagrams taken from one socket before other tasks run.
const MAX_DISCARDED: usize = 64;

/// Opens the sockets; each receives from the host only.
///
/// Nothing is sent, so success does not mean that the host is there. `number` chooses among several
/// addresses of the host: IPv4 first, the lowest first.
pub(super) async fn connect(host: &str, port: u16, framing: Framing, number: usize) -> io::Result<Datagrams> {
    connect_any(lookup(host, port).await?, framing, number).await
}

async fn connect_any(mut addresses: Vec<SocketAddr>, framing: Framing, number: usize) -> io::Result<Datagrams> {
    // The modules have IPv4. A resolver may give the addresses in another order each time.
    addresses.sort_by_key(|address| (address.is_ipv6(), *address));
    addresses.dedup();
    if let Some(first) = number.checked_rem(addresses.len()) {
        addresses.rotate_left(first);
    }
    let mut failure = io::Error::new(io::ErrorKind::NotFound, "the host has no address");
    let mut addresses = addresses.into_iter();
    while let Some(address) = addresses.next() {
        match sockets(address).await {
            Ok(sockets) => {
                // Without a route, such as of IPv6, an address is none.
                let mut has_others = false;
                for other in addresses {
                    has_others |= socket(other).await.is_ok();
                }
                return Ok(Datagrams::new(sockets, framing, has_others));
            }
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

async fn sockets(address: SocketAddr) -> io::Result<[Arc<UdpSocket>; SOCKETS]> {
    let (one, two, three, four) = tokio::try_join!(socket(address), socket(address), socket(address), socket(address))?;
    Ok([one, two, three, four])
}

async fn socket(address: SocketAddr) -> io::Result<Arc<UdpSocket>> {
    // Any free port: it differs from those of all open sockets.
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any).await?;
    socket.connect(address).await?;
    // Until the runtime has seen that there is room, a write would be pending until its next turn.
    socket.writable().await?;
    Ok(Arc::new(socket))
}

/// Connected sockets as a stream: each write is a datagram from the next socket, and no read goes
/// beyond the end of a datagram.
///
/// Dropped datagrams:
/// - empty ones, and those longer than a frame can be;
/// - the beginning of a frame that a datagram does not end, since the next datagram must not end it
///   either;
/// - those that came to a socket before its last write, or after a later write from another one;
///   these are counted, see [`take_late`](Self::take_late).
///
/// If the port is closed, the host sends a refusal. It is an error of the next read or write if it
/// concerns the last request, and ignored otherwise.
pub(super) struct Datagrams {
    /// In the order of use: the first is the socket of the last write, the second that of the next.
    sockets: [Arc<UdpSocket>; SOCKETS],
    /// Fingerprint of the datagram that was read last from each socket.
    last_read: [Option<u64>; SOCKETS],
    framing: Framing,
    /// Completes when the current socket has a datagram or an error.
    readiness: ReusableBoxFuture<'static, io::Result<()>>,
    /// `true` if `readiness` is pending, and with it a read.
    waiting: bool,
    /// Waker of the pending read.
    reader: Waker,
    /// The datagram being read, and one more byte to detect oversized ones.
    buffer: Box<[u8; MAX_FRAME_LEN + 1]>,
    /// The part of the buffer that has not been read.
    unread: Range<usize>,
    /// Dropped datagrams of earlier requests.
    late: LateDatagrams,
    /// The host has further addresses.
    has_other_addresses: bool,
}

impl Datagrams {
    fn new(sockets: [Arc<UdpSocket>; SOCKETS], framing: Framing, has_other_addresses: bool) -> Self {
        let [current, ..] = &sockets;
        let readiness = ReusableBoxFuture::new(wait(current.clone()));
        let buffer = Box::new([0; MAX_FRAME_LEN + 1]);
        Self {
            sockets,
            last_read: [None; SOCKETS],
            framing,
            readiness,
            waiting: false,
            reader: Waker::noop().clone(),
            buffer,
            unread: 0..0,
            late: LateDatagrams::default(),
            has_other_addresses,
        }
    }

    /// Returns whether the host has further addresses.
    pub(super) fn has_other_addresses(&self) -> bool {
        self.has_other_addresses
    }

    /// Returns the datagrams of earlier requests dropped since the last call.
    ///
    /// Counts those that the runtime has seen on the other sockets; the rest is counted when these
    /// are used again. Costs no system call unless a datagram is dropped.
    pub(super) fn take_late(&mut self) -> LateDatagrams {
        for (socket, last_read) in self.sockets.iter().zip(self.last_read).skip(1) {
            discard(socket, last_read, receive, &mut self.late);
        }
        std::mem::take(&mut self.late)
    }

    /// Receives one datagram that can be a frame.
    fn poll_receive(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            let [current, ..] = &self.sockets;
            if !self.waiting {
                self.readiness.set(wait(current.clone()));
                self.waiting = true;
            }
            let waited = ready!(self.readiness.poll(cx));
            self.waiting = false;
            let len = match waited.and_then(|()| receive(current, &mut self.buffer[..])) {
                Ok(len) => len,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => continue,
                Err(error) => return Poll::Ready(Err(error)),
            };
            let datagram =
                self.buffer.get(..len).filter(|datagram| datagram.len() <= MAX_FRAME_LEN).unwrap_or_default();
            let complete = complete_len(datagram, self.framing);
            if complete < len {
                tracing::debug!(len, dropped = len.saturating_sub(complete), "incomplete frame in a datagram dropped");
            }
            // Zero bytes would end the stream.
            if complete > 0 {
                let [last_read, ..] = &mut self.last_read;
                *last_read = Some(fingerprint(0, datagram));
                self.unread = 0..complete;
                return Poll::Ready(Ok(()));
            }
        }
    }

    /// Makes the next socket the current one; a pending read waits for it from now on.
    fn rotate(&mut self) {
        if !self.unread.is_empty() {
            self.unread = 0..0;
            self.late.others = self.late.others.saturating_add(1);
        }
        self.sockets.rotate_left(1);
        self.last_read.rotate_left(1);
        let [last_read, ..] = &mut self.last_read;
        *last_read = None;
        if self.waiting {
            let [current, ..] = &self.sockets;
            self.readiness.set(wait(current.clone()));
            // The writer may be another task, with another waker.
            if self.readiness.poll(&mut Context::from_waker(&self.reader)).is_ready() {
                self.waiting = false;
                self.reader.wake_by_ref();
            }
        }
    }
}

/// The length of a datagram without the incomplete frame at its end.
fn complete_len(datagram: &[u8], framing: Framing) -> usize {
    let mut codec = Codec::new(framing, Side::Client);
    let mut rest = BytesMut::from(datagram);
    while let Ok(Some(_)) = codec.decode(&mut rest) {}
    let incomplete = rest.len();
    while let Ok(Some(received)) = codec.decode_eof(&mut rest) {
        if received.frame().is_some() {
            // The incomplete frame is noise, and a whole frame follows behind its beginning.
            return datagram.len();
        }
    }
    datagram.len().saturating_sub(incomplete)
}

/// Waits for a datagram or an error. Linux reports a refusal only as an error, for which
/// `poll_recv` does not wait.
async fn wait(socket: Arc<UdpSocket>) -> io::Result<()> {
    // A peer that sends without pause must not keep other tasks from running.
    consume_budget().await;
    socket.ready(Interest::READABLE | Interest::ERROR).await.map(drop)
}

/// Receives one datagram that the runtime has seen, cut to the length of the buffer.
fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<usize> {
    let nothing = || io::Error::from(io::ErrorKind::WouldBlock);
    let failed = socket.try_io(Interest::ERROR, || Err::<(), _>(socket.take_error()?.unwrap_or_else(nothing)));
    match failed {
        Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
        _ => {}
    }
    truncated(socket.try_recv(buffer), buffer)
}

/// As [`receive`], but also reads from the operating system if the runtime has seen nothing.
fn receive_unseen(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<usize> {
    match receive(socket, buffer) {
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
            let received = (&*SockRef::from(socket)).read(buffer);
            truncated(received, buffer)
        }
        result => result,
    }
}

/// Turns the error of Windows for a datagram longer than the buffer into a full buffer, as
/// elsewhere.
fn truncated(received: io::Result<usize>, buffer: &[u8]) -> io::Result<usize> {
    match received {
        Err(error) if cfg!(windows) && error.raw_os_error() == Some(WSAEMSGSIZE) => Ok(buffer.len()),
        result => result,
    }
}

const WSAEMSGSIZE: i32 = 10_040;

/// Drops and counts all datagrams of a socket, and ignores its errors. Returns `false` if there may
/// be more.
///
/// `last_read` is the fingerprint of the datagram that was read last from this socket.
fn discard(
    socket: &UdpSocket,
    last_read: Option<u64>,
    receive: fn(&UdpSocket, &mut [u8]) -> io::Result<usize>,
    late: &mut LateDatagrams,
) -> bool {
    let mut buffer = [0; MAX_FRAME_LEN + 1];
    for _ in 0..MAX_DISCARDED {
        match receive(socket, &mut buffer) {
            Ok(len) => {
                tracing::debug!("datagram of an earlier request dropped");
                let print = buffer.get(..len).map(|datagram| fingerprint(0, datagram));
                let counter =
                    if last_read.is_some() && print == last_read { &mut late.duplicates } else { &mut late.others };
                *counter = counter.saturating_add(1);
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return true,
            Err(_) => {}
        }
    }
    false
}

impl AsyncRead for Datagrams {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if self.unread.is_empty() {
            match self.poll_receive(cx) {
                Poll::Ready(result) => result?,
                Poll::Pending => {
                    self.reader.clone_from(cx.waker());
                    return Poll::Pending;
                }
            }
        }
        let unread = self.buffer.get(self.unread.clone()).unwrap_or_default();
        let read = unread.get(..buf.remaining()).unwrap_or(unread);
        buf.put_slice(read);
        self.unread.start = self.unread.start.saturating_add(read.len());
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Datagrams {
    /// Sends a datagram from the next socket, after emptying its queue. The unread rest of earlier
    /// ones is dropped.
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let this = &mut *self;
        let ([current, next, ..], [_, last_read, ..]) = (&this.sockets, this.last_read);
        if let Some(error) = current.take_error()? {
            return Poll::Ready(Err(error));
        }
        if !discard(next, last_read, receive_unseen, &mut this.late) {
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        let sent = ready!(next.poll_send(cx, buf))?;
        this.rotate();
        Poll::Ready(Ok(sent))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
mod tests;
