use super::*;
use crate::transport::BoxIo;
use futures::future::FutureExt as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Wake;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt, split};
use tokio::time::timeout;

fn sum(late: LateDatagrams) -> u64 {
    late.duplicates + late.others
}

/// Longer than any step takes, even on a busy machine.
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

    /// Receives the next request, which must be this one. Returns its sender.
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
    let stream = connect(host, device.address().port(), Framing::Ascii, 0).await.unwrap();
    (device, stream)
}

/// Sends a request without letting the runtime poll any socket. Returns its sender.
fn request(stream: &mut Datagrams, device: &Device, request: &[u8]) -> SocketAddr {
    assert_eq!(stream.write(request).now_or_never().expect("the send buffer has room").unwrap(), request.len());
    device.expect(request)
}

/// Reads the next datagram, which must come now.
async fn next(stream: &mut Datagrams) -> Vec<u8> {
    let mut buffer = [0; 4096];
    let len = timeout(LONG, stream.read(&mut buffer)).await.expect("a datagram has come").unwrap();
    buffer[..len].to_vec()
}

/// Waits until this number of datagrams were dropped.
async fn late(stream: &mut Datagrams, expected: u64) {
    let mut late = 0;
    let all = async {
        while late < expected {
            tokio::task::yield_now().await;
            late += sum(stream.take_late());
        }
    };
    timeout(LONG, all).await.expect("all are counted");
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
    assert_eq!(stream.read(&mut buffer[..2]).await.unwrap(), 2, "a short buffer takes the beginning of the datagram");
    assert_eq!(stream.read(&mut buffer[2..]).await.unwrap(), 1, "the next read takes the rest");
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
    assert_eq!(ports[SOCKETS - 1], idle, "before the first write the last socket is read");
}

/// Before each request had a port of its own, the reply to the second request was `late`.
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
    assert_eq!(timeout(LONG, read).await.expect("the read is woken").unwrap(), b"answer");
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
async fn a_pending_read_is_woken_if_the_next_socket_is_ready() {
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

/// The readiness of a datagram that was drained wakes the read, which finds no data and waits on.
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
    // Now the runtime sees the datagram that was drained.
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
fn an_incomplete_frame_at_the_end_of_a_datagram_is_cut_off() {
    let binary = |bytes: &[u8]| complete_len(bytes, Framing::Binary);
    let ascii = |bytes: &[u8]| complete_len(bytes, Framing::Ascii);
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
async fn datagrams_of_other_hosts_are_not_read() {
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
            timeout(LONG, stream.read(&mut [0; 16])).await.expect("the read is woken").unwrap_err()
        } else {
            stream.write(b"another").await.unwrap_err()
        };
        assert_eq!(error.kind(), io::ErrorKind::ConnectionRefused);
    }
}

#[tokio::test]
async fn a_pending_read_fails_when_the_port_is_closed() {
    let (device, mut stream) = pair("127.0.0.1").await;
    drop(device);
    assert!(stream.read(&mut [0; 16]).now_or_never().is_none());
    let (mut reader, mut writer) = split(stream);
    let read = tokio::spawn(async move { reader.read(&mut [0; 16]).await });
    tokio::task::yield_now().await;
    writer.write_all(b"request").await.unwrap();
    let error = timeout(LONG, read).await.expect("the read is woken").unwrap().unwrap_err();
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
async fn sockets_have_distinct_ports_and_names_resolve_to_ipv4() {
    let (device, first) = pair("localhost").await;
    let second = connect("localhost", device.address().port(), Framing::Ascii, 0).await.unwrap();
    let mut ports = std::collections::HashSet::new();
    for socket in first.sockets.iter().chain(&second.sockets) {
        assert!(socket.peer_addr().unwrap().is_ipv4());
        assert!(ports.insert(socket.local_addr().unwrap().port()));
    }
    assert_eq!(ports.len(), 2 * SOCKETS);
}

/// Before: the first address was used each time, though nothing answered there.
#[tokio::test]
async fn the_number_of_an_address_chooses_among_those_of_the_host() {
    let [one, two, three] = ["127.0.0.1:7", "127.0.0.2:7", "[::1]:7"].map(|text| text.parse::<SocketAddr>().unwrap());
    for (number, expected) in [(0, one), (1, two), (2, one), (3, two), (usize::MAX, two)] {
        // Resolvers give addresses in any order, and twice.
        for addresses in [vec![one, two, one], vec![two, one]] {
            let stream = connect_any(addresses, Framing::Ascii, number).await.unwrap();
            assert_eq!(stream.sockets[0].peer_addr().unwrap(), expected, "number {number}");
            assert!(stream.has_other_addresses());
        }
    }
    let single = connect_any(vec![one, one], Framing::Ascii, 3).await.unwrap();
    assert!(!single.has_other_addresses());
    let stream = connect_any(vec![three, one], Framing::Ascii, 0).await.unwrap();
    assert_eq!(stream.sockets[0].peer_addr().unwrap(), one, "IPv4 first");
    let none = connect_any(Vec::new(), Framing::Ascii, 0).await.map(|_| ()).unwrap_err();
    assert_eq!(none.kind(), io::ErrorKind::NotFound);
}

#[tokio::test]
async fn late_duplicates_are_counted_apart_from_other_datagrams() {
    for answer in [&b"answer"[..], &[4; MAX_FRAME_LEN]] {
        let (device, mut stream) = pair("127.0.0.1").await;
        let first = request(&mut stream, &device, b"first");
        device.send(answer, first);
        assert_eq!(next(&mut stream).await, answer);
        for _ in 1..SOCKETS {
            request(&mut stream, &device, b"another");
        }
        // The longest begins as the answer does.
        for datagram in [answer, b"other", &[4; MAX_FRAME_LEN + 1]] {
            device.send(datagram, first);
        }
        assert_eq!(request(&mut stream, &device, b"fifth"), first);
        assert_eq!(stream.take_late(), LateDatagrams { duplicates: 1, others: 2 }, "{} bytes", answer.len());
    }
}

#[tokio::test]
async fn datagrams_behind_the_error_of_an_earlier_request_are_not_read() {
    let (device, mut stream) = pair("127.0.0.1").await;
    let address = device.address();
    let first = request(&mut stream, &device, b"first");
    for _ in 1..SOCKETS {
        request(&mut stream, &device, b"another");
    }
    drop(device);
    stream.sockets[1].send(b"refused").await.unwrap();
    let device = Device::bind(address);
    device.send(b"late", first);
    assert_eq!(request(&mut stream, &device, b"fifth"), first);
    device.send(b"answer", first);
    assert_eq!(next(&mut stream).await, b"answer");
    assert_eq!(sum(stream.take_late()), 1);
}

#[test]
fn only_windows_reports_a_datagram_longer_than_the_buffer_as_an_error() {
    let buffer = [0; 8];
    let too_long = truncated(Err(io::Error::from_raw_os_error(WSAEMSGSIZE)), &buffer);
    assert_eq!(too_long.ok(), cfg!(windows).then_some(buffer.len()));
    assert!(truncated(Err(io::ErrorKind::ConnectionReset.into()), &buffer).is_err());
    assert_eq!(truncated(Ok(3), &buffer).ok(), Some(3));
}
