//! UDP as a stream: the local port is the transaction id.
//!
//! Each request (a write, a datagram) goes out from the next of [`SOCKETS`] connected sockets, so a reply to an earlier
//! request, late or a copy, comes to a port that is not read.
//!
//! Invariants:
//! - A read returns only datagrams that came to the socket of the last write, after its queue was emptied.
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
use tokio::net::{UdpSocket, lookup_host};
use tokio::task::consume_budget;
use tokio_util::codec::Decoder;
use tokio_util::sync::ReusableBoxFuture;

use super::Late;
use crate::link::in_step::fingerprint;
use crate::wire::{Codec, Framing, MAX_FRAME_LEN, Side};

/// Number of sockets of a connection: a local port is used again after as many requests.
const SOCKETS: usize = 4;

/// Maximum number of datagrams taken from one socket before other tasks run.
const MAX_DISCARDED: usize = 64;

/// Opens the sockets; each receives from the host only.
///
/// Nothing is sent, so success does not mean that the host is there.
pub(super) async fn connect(host: &str, port: u16, framing: Framing) -> io::Result<Datagrams> {
    let mut addresses: Vec<SocketAddr> = lookup_host((host, port)).await?.collect();
    // As no attempt fails, the first address is the one that is used; and the modules have IPv4.
    addresses.sort_by_key(SocketAddr::is_ipv6);
    let mut failure = io::Error::new(io::ErrorKind::NotFound, "the host has no address");
    for address in addresses {
        match sockets(address).await {
            Ok(sockets) => return Ok(Datagrams::new(sockets, framing)),
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
    // Until the runtime has seen that there is room, a write would wait for its next turn.
    socket.writable().await?;
    Ok(Arc::new(socket))
}

/// Connected sockets as a stream: each write is a datagram of its own from the next socket, and no read goes beyond the
/// end of a datagram.
///
/// Dropped datagrams:
/// - empty ones, and those longer than a frame can be;
/// - the beginning of a frame that a datagram does not end, since the next datagram must not end it either;
/// - whatever came to a socket before its last write, or after a later write from another one; these are counted, see
///   [`take_late`](Self::take_late).
///
/// A refusal, which the host sends if the port is closed, is an error of the next read or write if it concerns the last
/// request; for earlier requests it is ignored.
pub(super) struct Datagrams {
    /// In the order of use: the first is the socket of the last write, the second is used by the next one.
    sockets: [Arc<UdpSocket>; SOCKETS],
    /// The fingerprints of the datagrams that were read from them last.
    read: [Option<u64>; SOCKETS],
    framing: Framing,
    /// Completes when the current socket has a datagram or an error.
    readiness: ReusableBoxFuture<'static, io::Result<()>>,
    /// Whether `readiness` is pending, and with it a read.
    waiting: bool,
    /// Waker of the pending read.
    reader: Waker,
    /// The datagram that is being read, and one more byte to detect oversized ones.
    buffer: Box<[u8; MAX_FRAME_LEN + 1]>,
    /// The part of the buffer that has not been read yet.
    unread: Range<usize>,
    /// Dropped datagrams of earlier requests.
    late: Late,
}

impl Datagrams {
    fn new(sockets: [Arc<UdpSocket>; SOCKETS], framing: Framing) -> Self {
        let [current, ..] = &sockets;
        let readiness = ReusableBoxFuture::new(wait(current.clone()));
        let buffer = Box::new([0; MAX_FRAME_LEN + 1]);
        Self {
            sockets,
            read: [None; SOCKETS],
            framing,
            readiness,
            waiting: false,
            reader: Waker::noop().clone(),
            buffer,
            unread: 0..0,
            late: Late::default(),
        }
    }

    /// Returns the datagrams of earlier requests dropped since the last call.
    ///
    /// Counts what the runtime has seen on the other sockets; the rest is counted when their turn comes. Costs no system
    /// call unless there is something to drop.
    pub(super) fn take_late(&mut self) -> Late {
        for (socket, read) in self.sockets.iter().zip(self.read).skip(1) {
            discard(socket, read, receive, &mut self.late);
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
            let ended = ended(datagram, self.framing);
            if ended < len {
                tracing::debug!(len, dropped = len.saturating_sub(ended), "not the whole of a datagram is frames");
            }
            // To a reader of a stream, nothing would be its end.
            if ended > 0 {
                let [read, ..] = &mut self.read;
                *read = Some(fingerprint(0, datagram));
                self.unread = 0..ended;
                return Poll::Ready(Ok(()));
            }
        }
    }

    /// Makes the next socket the current one. A pending read waits for it from now on.
    fn rotate(&mut self) {
        if !self.unread.is_empty() {
            self.unread = 0..0;
            self.late.others = self.late.others.saturating_add(1);
        }
        self.sockets.rotate_left(1);
        self.read.rotate_left(1);
        let [read, ..] = &mut self.read;
        *read = None;
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
    // A peer that sends without a pause must not keep the other tasks from running.
    consume_budget().await;
    socket.ready(Interest::READABLE | Interest::ERROR).await.map(drop)
}

/// Receives one datagram that the runtime has seen; if it is longer than the buffer, as much of it as fits.
fn receive(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<usize> {
    let nothing = || io::Error::from(io::ErrorKind::WouldBlock);
    let failed = socket.try_io(Interest::ERROR, || Err::<(), _>(socket.take_error()?.unwrap_or_else(nothing)));
    match failed {
        Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(error),
        _ => {}
    }
    cut(socket.try_recv(buffer), buffer)
}

/// As [`receive`], and asks the operating system if the runtime has seen nothing.
fn receive_unseen(socket: &UdpSocket, buffer: &mut [u8]) -> io::Result<usize> {
    match receive(socket, buffer) {
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
            let received = (&*SockRef::from(socket)).read(buffer);
            cut(received, buffer)
        }
        result => result,
    }
}

/// A datagram longer than the buffer: Windows calls that an error, other systems do not.
fn cut(received: io::Result<usize>, buffer: &[u8]) -> io::Result<usize> {
    match received {
        Err(error) if cfg!(windows) && error.raw_os_error() == Some(WSAEMSGSIZE) => Ok(buffer.len()),
        result => result,
    }
}

const WSAEMSGSIZE: i32 = 10_040;

/// Drops and counts all datagrams of a socket, from which this one was read last, and ignores its errors. Returns `false` if
/// there may be more.
fn discard(
    socket: &UdpSocket,
    read: Option<u64>,
    receive: fn(&UdpSocket, &mut [u8]) -> io::Result<usize>,
    late: &mut Late,
) -> bool {
    let mut buffer = [0; MAX_FRAME_LEN + 1];
    for _ in 0..MAX_DISCARDED {
        match receive(socket, &mut buffer) {
            Ok(len) => {
                tracing::debug!("datagram of an earlier request dropped");
                let print = buffer.get(..len).map(|datagram| fingerprint(0, datagram));
                let counter = if read.is_some() && print == read { &mut late.copies } else { &mut late.others };
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
    /// Sends a datagram from the next socket, whose queue is emptied first. What was not read of earlier ones is dropped.
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let this = &mut *self;
        let ([current, next, ..], [_, read, ..]) = (&this.sockets, this.read);
        if let Some(error) = current.take_error()? {
            return Poll::Ready(Err(error));
        }
        if !discard(next, read, receive_unseen, &mut this.late) {
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
mod tests {
    use super::*;
    use crate::link::transport::BoxIo;
    use futures::future::FutureExt as _;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::task::Wake;
    use std::time::Duration;
    use tokio::io::{AsyncReadExt, AsyncWriteExt, split};
    use tokio::time::timeout;

    fn sum(late: Late) -> u64 {
        late.copies + late.others
    }

    /// Longer than anything here takes, even on a busy machine.
    const LONG: Duration = Duration::from_secs(10);

    /// The socket of a device. It blocks, so that a test decides when the runtime sees what was sent.
    struct Device(std::net::UdpSocket);

    impl Device {
        fn bind(address: impl std::net::ToSocketAddrs) -> Self {
            let socket = std::net::UdpSocket::bind(address).unwrap();
            socket.set_read_timeout(Some(LONG)).unwrap();
            Self(socket)
        }

        fn address(&self) -> SocketAddr {
            self.0.local_addr().unwrap()
        }

        /// The next request, which must be this, and where it came from.
        fn expect(&self, request: &[u8]) -> SocketAddr {
            let mut buffer = [0; 2048];
            let (len, from) = self.0.recv_from(&mut buffer).unwrap();
            assert_eq!(&buffer[..len], request);
            from
        }

        fn send(&self, datagram: &[u8], to: SocketAddr) {
            assert_eq!(self.0.send_to(datagram, to).unwrap(), datagram.len());
        }
    }

    async fn pair(host: &str) -> (Device, Datagrams) {
        let device = Device::bind((host, 0));
        let stream = connect(host, device.address().port(), Framing::Ascii).await.unwrap();
        (device, stream)
    }

    /// Sends a request without letting the runtime look at any socket. Returns where it came from.
    fn request(stream: &mut Datagrams, device: &Device, request: &[u8]) -> SocketAddr {
        assert_eq!(stream.write(request).now_or_never().expect("there is room").unwrap(), request.len());
        device.expect(request)
    }

    /// The datagram that must come now.
    async fn next(stream: &mut Datagrams) -> Vec<u8> {
        let mut buffer = [0; 4096];
        let len = timeout(LONG, stream.read(&mut buffer)).await.expect("a datagram").unwrap();
        buffer[..len].to_vec()
    }

    /// Waits until so many datagrams were dropped.
    async fn late(stream: &mut Datagrams, expected: u64) {
        let mut late = 0;
        let all = async {
            while late < expected {
                tokio::task::yield_now().await;
                late += sum(stream.take_late());
            }
        };
        timeout(LONG, all).await.expect("they are counted");
        assert_eq!(late, expected);
        assert_eq!(sum(stream.take_late()), 0, "each is counted once");
    }

    #[tokio::test]
    async fn a_write_is_a_datagram_and_a_read_ends_with_one() {
        let (device, mut stream) = pair("127.0.0.1").await;
        request(&mut stream, &device, b"first");
        let from = request(&mut stream, &device, &[7; MAX_FRAME_LEN]);

        device.send(b"one", from);
        device.send(b"two", from);
        let mut buffer = [0; 2048];
        assert_eq!(next(&mut stream).await, b"one");
        assert_eq!(stream.read(&mut buffer[..2]).await.unwrap(), 2, "a short buffer takes a part of the datagram");
        assert_eq!(stream.read(&mut buffer[2..]).await.unwrap(), 1, "and then the rest of it");
        assert_eq!(&buffer[..3], b"two");
    }

    #[tokio::test]
    async fn each_write_uses_the_next_port_and_the_fifth_the_first() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let idle = stream.sockets[0].local_addr().unwrap().port();
        let ports: Vec<u16> = (0..13).map(|_| request(&mut stream, &device, b"request").port()).collect();
        for (position, four) in ports.windows(SOCKETS).enumerate() {
            let distinct: std::collections::HashSet<_> = four.iter().collect();
            assert_eq!(distinct.len(), SOCKETS, "{four:?}");
            assert_eq!(four[0], ports[position % SOCKETS]);
        }
        assert_eq!(ports[SOCKETS - 1], idle, "before the first write it is the last of the ring that is read");
    }

    /// Before each request had a port of its own, the answer to the second request was `late`.
    #[tokio::test]
    async fn replies_to_earlier_ports_are_counted_and_not_read() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let mut earlier = Vec::new();
        for _ in 1..SOCKETS {
            earlier.push(request(&mut stream, &device, b"earlier"));
        }
        let last = request(&mut stream, &device, b"last");
        for &port in &earlier {
            device.send(b"late", port);
            device.send(b"late", port);
        }
        device.send(b"answer", last);
        assert_eq!(next(&mut stream).await, b"answer");
        late(&mut stream, 6).await;
        assert!(stream.read(&mut [0; 16]).now_or_never().is_none(), "nothing else is read");
    }

    #[tokio::test]
    async fn a_socket_is_emptied_before_it_is_used_again() {
        for seen in [false, true] {
            let (device, mut stream) = pair("127.0.0.1").await;
            let first = request(&mut stream, &device, b"first");
            for _ in 1..SOCKETS {
                request(&mut stream, &device, b"another");
            }
            for datagram in [&b"late"[..], b"", &[4; MAX_FRAME_LEN], &[5; 60_000]] {
                device.send(datagram, first);
            }
            if seen {
                stream.sockets[1].readable().await.unwrap();
            }
            assert_eq!(request(&mut stream, &device, b"fifth"), first);
            device.send(b"answer", first);
            assert_eq!(next(&mut stream).await, b"answer", "seen by the runtime: {seen}");
            assert_eq!(sum(stream.take_late()), 4);
        }
    }

    #[tokio::test]
    async fn a_long_queue_is_emptied_in_turns_with_other_tasks() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let first = request(&mut stream, &device, b"first");
        for _ in 1..SOCKETS {
            request(&mut stream, &device, b"another");
        }
        let many = 2 * MAX_DISCARDED + MAX_DISCARDED / 2;
        for _ in 0..many {
            device.send(b"late", first);
        }
        let woken = Arc::new(Woken::default());
        let waker = Waker::from(woken.clone());
        assert!(Pin::new(&mut stream).poll_write(&mut Context::from_waker(&waker), b"fifth").is_pending());
        assert!(woken.0.load(Ordering::Relaxed));
        stream.write_all(b"fifth").await.unwrap();
        assert_eq!(device.expect(b"fifth"), first);
        device.send(b"answer", first);
        assert_eq!(next(&mut stream).await, b"answer");
        assert_eq!(sum(stream.take_late()), u64::try_from(many).unwrap());
    }

    #[tokio::test]
    async fn the_rest_of_a_datagram_is_dropped_by_a_write() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let first = request(&mut stream, &device, b"first");
        device.send(b"late", first);
        assert_eq!(stream.read(&mut [0; 2]).await.unwrap(), 2);
        let second = request(&mut stream, &device, b"second");
        device.send(b"answer", second);
        assert_eq!(next(&mut stream).await, b"answer");
        assert_eq!(sum(stream.take_late()), 1);
    }

    #[tokio::test]
    async fn a_pending_read_is_woken_by_the_socket_of_a_later_write() {
        let (device, stream) = pair("127.0.0.1").await;
        let (mut reader, mut writer) = split(stream);
        let read = tokio::spawn(async move {
            let mut buffer = [0; 16];
            let len = reader.read(&mut buffer).await.unwrap();
            buffer[..len].to_vec()
        });
        for _ in 0..=SOCKETS {
            tokio::task::yield_now().await;
            writer.write_all(b"request").await.unwrap();
            let from = device.expect(b"request");
            tokio::task::yield_now().await;
            assert!(!read.is_finished());
            writer.write_all(b"another").await.unwrap();
            device.expect(b"another");
            device.send(b"late", from);
        }
        writer.write_all(b"last").await.unwrap();
        let last = device.expect(b"last");
        device.send(b"answer", last);
        assert_eq!(timeout(LONG, read).await.expect("it is woken").unwrap(), b"answer");
    }

    #[derive(Default)]
    struct Woken(AtomicBool);

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.store(true, Ordering::Relaxed);
        }
    }

    /// On another thread, the runtime can see the reply before the write has returned.
    #[tokio::test]
    async fn a_pending_read_is_woken_if_the_next_socket_is_ready_already() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let woken = Arc::new(Woken::default());
        let waker = Waker::from(woken.clone());
        let mut buffer = [0; 16];
        let mut buffer = ReadBuf::new(&mut buffer);
        assert!(Pin::new(&mut stream).poll_read(&mut Context::from_waker(&waker), &mut buffer).is_pending());
        let port = stream.sockets[1].local_addr().unwrap().port();
        device.send(b"answer", (Ipv4Addr::LOCALHOST, port).into());
        stream.sockets[1].readable().await.unwrap();
        assert!(!woken.0.load(Ordering::Relaxed));
        stream.rotate();
        assert!(woken.0.load(Ordering::Relaxed));
        assert_eq!(next(&mut stream).await, b"answer");
    }

    /// A readiness left over from a datagram that was drained wakes the read, which finds nothing and waits on.
    #[tokio::test]
    async fn a_read_goes_on_waiting_after_a_false_wake_up() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let first = request(&mut stream, &device, b"first");
        for _ in 1..SOCKETS {
            request(&mut stream, &device, b"another");
        }
        device.send(b"late", first);
        assert!(stream.read(&mut [0; 16]).now_or_never().is_none());
        request(&mut stream, &device, b"fifth");
        // Now the runtime sees what was drained.
        tokio::task::yield_now().await;
        tokio::task::yield_now().await;
        assert!(stream.read(&mut [0; 16]).now_or_never().is_none());
        device.send(b"answer", first);
        assert_eq!(next(&mut stream).await, b"answer");
    }

    #[tokio::test]
    async fn only_datagrams_are_counted_through_a_box() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let first = request(&mut stream, &device, b"first");
        device.send(b"late", first);
        stream.sockets[0].readable().await.unwrap();
        request(&mut stream, &device, b"second");
        let mut boxed: BoxIo = Box::new(stream);
        assert_eq!((sum(boxed.take_late()), sum(boxed.take_late())), (1, 0));
        let mut other: BoxIo = Box::new(tokio::io::empty());
        assert_eq!(sum(other.take_late()), 0);
    }

    #[tokio::test]
    async fn empty_and_oversized_datagrams_are_dropped_whole() {
        let (device, mut stream) = pair("127.0.0.1").await;
        let from = request(&mut stream, &device, b"request");
        for datagram in [&b""[..], &[1; MAX_FRAME_LEN + 1], &[1; 60_000], &[4; MAX_FRAME_LEN], b"end"] {
            device.send(datagram, from);
        }
        assert_eq!(next(&mut stream).await, [4; MAX_FRAME_LEN]);
        assert_eq!(next(&mut stream).await, b"end");
        assert_eq!(sum(stream.take_late()), 0);
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
        let (device, mut stream) = pair("127.0.0.1").await;
        let from = request(&mut stream, &device, b"request");
        Device::bind("127.0.0.1:0").send(b"stranger", from);
        device.send(b"device", from);
        assert_eq!(next(&mut stream).await, b"device");
    }

    #[tokio::test]
    async fn a_closed_port_is_an_error_of_the_next_read_or_write() {
        for reads in [true, false] {
            let (device, mut stream) = pair("127.0.0.1").await;
            drop(device);
            stream.write_all(b"request").await.unwrap();
            let error = if reads {
                timeout(LONG, stream.read(&mut [0; 16])).await.expect("it is woken").unwrap_err()
            } else {
                stream.write(b"another").await.unwrap_err()
            };
            assert_eq!(error.kind(), io::ErrorKind::ConnectionRefused);
        }
    }

    #[tokio::test]
    async fn a_pending_read_is_told_that_the_port_is_closed() {
        let (device, mut stream) = pair("127.0.0.1").await;
        drop(device);
        assert!(stream.read(&mut [0; 16]).now_or_never().is_none());
        let (mut reader, mut writer) = split(stream);
        let read = tokio::spawn(async move { reader.read(&mut [0; 16]).await });
        tokio::task::yield_now().await;
        writer.write_all(b"request").await.unwrap();
        let error = timeout(LONG, read).await.expect("it is woken").unwrap().unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::ConnectionRefused);
    }

    #[tokio::test]
    async fn errors_of_earlier_requests_are_ignored() {
        for seen in [false, true] {
            let (device, mut stream) = pair("127.0.0.1").await;
            let address = device.address();
            drop(device);
            for socket in &stream.sockets[1..] {
                socket.send(b"refused").await.unwrap();
                if seen {
                    socket.ready(Interest::ERROR).await.unwrap();
                }
            }
            let device = Device::bind(address);
            for _ in 0..=SOCKETS {
                let from = request(&mut stream, &device, b"request");
                device.send(b"answer", from);
                assert_eq!(next(&mut stream).await, b"answer", "seen by the runtime: {seen}");
            }
            assert_eq!(sum(stream.take_late()), 0);
        }
    }

    #[tokio::test]
    async fn every_socket_has_its_own_port_and_a_name_is_its_ipv4_address() {
        let (device, first) = pair("localhost").await;
        let second = connect("localhost", device.address().port(), Framing::Ascii).await.unwrap();
        let mut ports = std::collections::HashSet::new();
        for socket in first.sockets.iter().chain(&second.sockets) {
            assert!(socket.peer_addr().unwrap().is_ipv4());
            assert!(ports.insert(socket.local_addr().unwrap().port()));
        }
        assert_eq!(ports.len(), 2 * SOCKETS);
    }
}
