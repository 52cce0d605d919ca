use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::ops::Range;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytes::BytesMut;
use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead, AsyncWrite, Interest, ReadBuf};
use tokio::net::{UdpSocket, lookup_host};
use tokio::task::consume_budget;
use tokio_util::codec::Decoder;

use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Side};

/// Makes a socket that hears the host and nobody else.
///
/// Nothing is sent, so this says nothing about whether anybody is there.
pub(super) async fn connect(host: &str, port: u16, framing: Framing) -> io::Result<Datagrams> {
    let mut addresses: Vec<SocketAddr> = lookup_host((host, port)).await?.collect();
    // As no attempt fails, the first address is the one that is used; and the modules have IPv4.
    addresses.sort_by_key(SocketAddr::is_ipv6);
    let mut failure = io::Error::new(io::ErrorKind::NotFound, "the host has no address");
    for address in addresses {
        match connect_to(address).await {
            Ok(socket) => return Ok(Datagrams::new(socket, framing)),
            Err(error) => failure = error,
        }
    }
    Err(failure)
}

async fn connect_to(address: SocketAddr) -> io::Result<UdpSocket> {
    // Any free port. It is a new one for every socket, so what comes late for the one before reaches nobody.
    let any: SocketAddr = match address {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(any).await?;
    socket.connect(address).await?;
    Ok(socket)
}

/// A connected socket as a stream: each write is a datagram of its own, and no read goes beyond the end of a datagram.
///
/// Datagrams that are empty or longer than a frame can be are dropped, and so is the beginning of a frame that a datagram
/// does not end: the next datagram shall not end it either. A refusal, which the host sends when nobody listens on the
/// port, is an error of the next read or write.
pub(super) struct Datagrams {
    socket: Arc<UdpSocket>,
    framing: Framing,
    /// Waits until there is something to be received.
    ready: Option<BoxFuture<'static, io::Result<()>>>,
    /// The datagram that is being read, and one more byte, to see which are too long.
    buffer: Box<[u8; MAX_FRAME_LEN + 1]>,
    /// Which part of it has not been read yet.
    unread: Range<usize>,
}

impl Datagrams {
    fn new(socket: UdpSocket, framing: Framing) -> Self {
        let buffer = Box::new([0; MAX_FRAME_LEN + 1]);
        Self { socket: Arc::new(socket), framing, ready: None, buffer, unread: 0..0 }
    }

    /// Receives one datagram that can be a frame.
    fn poll_receive(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            let ready = self.ready.get_or_insert_with(|| wait(self.socket.clone()).boxed());
            let waited = ready!(ready.poll_unpin(cx));
            self.ready = None;
            let len = match waited.and_then(|()| receive(&self.socket, &mut self.buffer[..])) {
                Ok(len) => len,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => continue,
                Err(error) => return Poll::Ready(Err(error)),
            };
            let datagram =
                self.buffer.get(..len).filter(|datagram| datagram.len() <= MAX_FRAME_LEN).unwrap_or_default();
            let ended = ended(datagram, self.framing);
            if ended < len {
                tracing::debug!(len, dropped = len.saturating_sub(ended), "not the whole of a datagram is frames");
            }
            // To a reader of a stream, nothing would be its end.
            if ended > 0 {
                self.unread = 0..ended;
                return Poll::Ready(Ok(()));
            }
        }
    }
}

/// How much of a datagram there is before a frame that it begins and does not end.
fn ended(datagram: &[u8], framing: Framing) -> usize {
    let mut codec = Codec::new(framing, Side::Client);
    let mut rest = BytesMut::from(datagram);
    while let Ok(Some(_)) = codec.decode(&mut rest) {}
    let begun = rest.len();
    while let Ok(Some(received)) = codec.decode_eof(&mut rest) {
        if received.frame().is_some() {
            // What seemed to begin is noise, and there is more behind it.
            return datagram.len();
        }
    }
    datagram.len().saturating_sub(begun)
}

/// Waits for a datagram or an error. Linux reports a refusal as an error alone, for which `poll_recv` does not wait.
async fn wait(socket: Arc<UdpSocket>) -> io::Result<()> {
    // Whoever sends without a pause must not keep the other tasks from running.
    consume_budget().await;
    socket.ready(Interest::READABLE | Interest::ERROR).await.map(drop)
}

/// Receives one datagram; if it is longer than the buffer, as much of it as fits.
fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<usize> {
    let nothing = || io::Error::from(io::ErrorKind::WouldBlock);
    let failed = socket.try_io(Interest::ERROR, || Err::<(), _>(socket.take_error()?.unwrap_or_else(nothing)));
    match failed {
        Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
        _ => {}
    }
    match socket.try_recv(buffer) {
        // Windows says so, the others do not.
        Err(error) if cfg!(windows) && error.raw_os_error() == Some(WSAEMSGSIZE) => Ok(buffer.len()),
        result => result,
    }
}

const WSAEMSGSIZE: i32 = 10_040;

impl AsyncRead for Datagrams {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if self.unread.is_empty() {
            ready!(self.poll_receive(cx))?;
        }
        let unread = self.buffer.get(self.unread.clone()).unwrap_or_default();
        let read = unread.get(..buf.remaining()).unwrap_or(unread);
        buf.put_slice(read);
        self.unread.start = self.unread.start.saturating_add(read.len());
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Datagrams {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.socket.poll_send(cx, buf)
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    /// A socket that the test speaks through, and the stream that hears it.
    async fn pair(host: &str) -> (UdpSocket, Datagrams) {
        let peer = UdpSocket::bind((host, 0)).await.unwrap();
        let stream = connect(host, peer.local_addr().unwrap().port(), Framing::Ascii).await.unwrap();
        peer.connect(("127.0.0.1", stream.socket.local_addr().unwrap().port())).await.unwrap();
        (peer, stream)
    }

    #[tokio::test]
    async fn a_write_is_a_datagram_and_a_read_goes_no_further_than_one() {
        let (peer, mut stream) = pair("127.0.0.1").await;
        stream.write_all(b"first").await.unwrap();
        stream.write_all(&[7; MAX_FRAME_LEN]).await.unwrap();
        let mut buffer = [0; 2048];
        assert_eq!(peer.recv(&mut buffer).await.unwrap(), 5);
        assert_eq!(peer.recv(&mut buffer).await.unwrap(), MAX_FRAME_LEN);

        peer.send(b"one").await.unwrap();
        peer.send(b"two").await.unwrap();
        assert_eq!(stream.read(&mut buffer).await.unwrap(), 3);
        assert_eq!(stream.read(&mut buffer[..2]).await.unwrap(), 2, "a short buffer takes a part of the datagram");
        assert_eq!(stream.read(&mut buffer[2..]).await.unwrap(), 1, "and then the rest of it");
        assert_eq!(&buffer[..3], b"two");
    }

    #[tokio::test]
    async fn empty_and_oversized_datagrams_are_dropped_whole() {
        let (peer, mut stream) = pair("127.0.0.1").await;
        for datagram in [&b""[..], &[1; MAX_FRAME_LEN + 1], &[1; 60_000], &[4; MAX_FRAME_LEN], b"end"] {
            peer.send(datagram).await.unwrap();
        }
        let mut buffer = [0; 4096];
        assert_eq!(stream.read(&mut buffer).await.unwrap(), MAX_FRAME_LEN);
        assert_eq!(buffer[..MAX_FRAME_LEN], [4; MAX_FRAME_LEN]);
        assert_eq!(stream.read(&mut buffer).await.unwrap(), 3);
    }

    #[test]
    fn what_a_datagram_begins_and_does_not_end_is_cut_off() {
        let binary = |bytes: &[u8]| ended(bytes, Framing::Binary);
        let ascii = |bytes: &[u8]| ended(bytes, Framing::Ascii);
        assert_eq!(ascii(b""), 0);
        assert_eq!(ascii(b"\x020141045\x03"), 9);
        assert_eq!(ascii(b"\x06\x0201410F8\x03\x06"), 11, "noise is for the codec to count");
        assert_eq!(ascii(b"\x0201410F8"), 0);
        assert_eq!(ascii(b"\x0201410F8\x03\x020141"), 9);

        let frame = b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";
        for len in 0..frame.len() {
            assert_eq!(binary(&frame[..len]), 0);
            assert_eq!(binary(&[&frame[..], &frame[..len]].concat()), frame.len());
        }
        let claim = [b"\x52\x10\x00\x40", &frame[..]].concat();
        assert_eq!(binary(&claim), claim.len(), "a frame behind noise is not lost");
    }

    #[tokio::test]
    async fn strangers_are_not_heard() {
        let (peer, mut stream) = pair("127.0.0.1").await;
        let stranger = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        stranger.send_to(b"stranger", stream.socket.local_addr().unwrap()).await.unwrap();
        peer.send(b"peer").await.unwrap();
        let mut buffer = [0; 16];
        assert_eq!(stream.read(&mut buffer).await.unwrap(), 4);
    }

    #[tokio::test]
    async fn a_port_where_nobody_listens_is_an_error_of_the_read() {
        let (peer, mut stream) = pair("127.0.0.1").await;
        drop(peer);
        stream.write_all(b"anybody?").await.unwrap();
        let error = stream.read(&mut [0; 16]).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::ConnectionRefused);
    }

    #[tokio::test]
    async fn every_socket_has_a_port_of_its_own_and_a_name_means_its_ipv4_address() {
        let (peer, first) = pair("localhost").await;
        let second = connect("localhost", peer.local_addr().unwrap().port(), Framing::Ascii).await.unwrap();
        assert_ne!(first.socket.local_addr().unwrap(), second.socket.local_addr().unwrap());
        assert!(second.socket.peer_addr().unwrap().is_ipv4());
    }
}
