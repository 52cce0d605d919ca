//! The link over UDP: one frame per datagram, a local port for each request, and unexpected
//! datagrams.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Duration;

use bytes::BytesMut;
use fatek::endpoint::InStepSettings;
use fatek::wire::{Codec, Frame, Framing, Side};
use fatek::{Endpoint, Error, Link, LinkBuilder, Station, register};
use tokio::net::UdpSocket;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_util::codec::{Decoder, Encoder};

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// Longer than any step takes, even on a busy machine.
const LONG: Duration = Duration::from_secs(10);

/// A scripted PLC: the test decides every datagram.
struct Peer {
    socket: UdpSocket,
    framing: Framing,
}

/// A request and its sender.
struct ReceivedRequest {
    frame: Frame,
    from: SocketAddr,
}

impl Peer {
    async fn bind(framing: Framing) -> Self {
        Self { socket: UdpSocket::bind("127.0.0.1:0").await.unwrap(), framing }
    }

    fn builder(&self) -> LinkBuilder {
        let address = self.socket.local_addr().unwrap();
        let endpoint = Endpoint::udp(address.ip().to_string(), address.port()).with_framing(self.framing);
        Link::builder(endpoint).response_timeout(LONG).retries(0)
    }

    /// Receives the next request, which must be the only frame of its datagram.
    async fn request(&self) -> ReceivedRequest {
        let mut datagram = [0; 2048];
        let received = timeout(LONG, self.socket.recv_from(&mut datagram)).await.expect("the client sends no request");
        let (len, from) = received.unwrap();
        let mut bytes = BytesMut::from(&datagram[..len]);
        let mut codec = Codec::new(self.framing, Side::Plc);
        let frame = codec.decode(&mut bytes).unwrap().unwrap().frame().unwrap();
        assert!(bytes.is_empty() && codec.decode(&mut bytes).unwrap().is_none(), "one frame per datagram");
        ReceivedRequest { frame, from }
    }

    async fn send(&self, to: &ReceivedRequest, datagram: &[u8]) {
        self.socket.send_to(datagram, to.from).await.unwrap();
    }

    /// Answers a read of one register, in any spelling.
    async fn reply(&self, to: &ReceivedRequest, value: u16) {
        self.send(to, &self.reply_bytes(to, value)).await;
    }

    fn reply_bytes(&self, to: &ReceivedRequest, value: u16) -> BytesMut {
        self.frame(to.frame.command, &self.register(value))
    }

    /// Data of a reply with one register.
    fn register(&self, value: u16) -> Vec<u8> {
        match self.framing {
            Framing::Ascii => format!("0{value:04X}").into_bytes(),
            _ => [&[0][..], &value.to_be_bytes()].concat(),
        }
    }

    fn frame(&self, command: u8, data: &[u8]) -> BytesMut {
        let mut bytes = BytesMut::new();
        let frame = Frame { station: 1, command, data: data.to_vec().into() };
        Codec::new(self.framing, Side::Plc).encode(frame, &mut bytes).unwrap();
        bytes
    }

    /// Answers the next request, which must be a check, with its echo.
    async fn echo(&self) -> ReceivedRequest {
        let request = self.request().await;
        assert_eq!(request.frame.command, 0x4E, "a new connection and a suspect station get a check");
        self.send(&request, &self.frame(0x4E, &request.frame.data)).await;
        request
    }
}

fn read(station: &Station) -> JoinHandle<Result<Vec<u16>, Error>> {
    let station = station.clone();
    tokio::spawn(async move { station.read_registers(register!("R1"), 1).await })
}

#[cfg(feature = "sim")]
#[tokio::test]
async fn a_value_written_is_read_back_in_both_framings() {
    use fatek::sim::{Bus, Plc};

    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let plc = tokio::spawn(async move {
            let bus = Bus::new().with_station(1, Plc::new()).unwrap();
            loop {
                let request = peer.request().await;
                let mut reply = BytesMut::new();
                bus.answer(&fatek::wire::Received::Frame(request.frame.clone()), framing, &mut reply);
                peer.send(&request, &reply).await;
            }
        });
        let station = link.station(1).unwrap();
        let values: Vec<u16> = (0..64).collect();
        station.write_registers(register!("R0"), &values).await.unwrap();
        assert_eq!(station.read_registers(register!("R0"), 64).await.unwrap(), values);
        plc.abort();
    }
}

#[tokio::test]
async fn a_lost_datagram_is_retried_after_a_check() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().response_timeout(Duration::from_millis(100)).retries(2).build();
        let call = read(&link.station(1).unwrap());
        let first = peer.echo().await;
        let lost = peer.request().await;
        let check = peer.echo().await;
        let repeated = peer.request().await;
        assert_eq!(repeated.frame, lost.frame);
        let ports = BTreeSet::from([&first, &lost, &check, &repeated].map(|request| request.from.port()));
        assert_eq!(ports.len(), 4, "each request has its own port");
        peer.reply(&repeated, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn a_late_datagram_is_not_given_to_the_next_read() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().response_timeout(Duration::from_millis(100)).build();
        let station = link.station(1).unwrap();
        let call = read(&station);
        peer.echo().await;
        let first = peer.request().await;
        assert!(matches!(call.await.unwrap(), Err(Error::Timeout { sent: true, .. })));

        let call = read(&station);
        let check = peer.request().await;
        peer.reply(&first, 1).await; // to the port of its request
        peer.reply(&check, 1).await; // to the newest port, as some modules do
        peer.send(&check, &peer.frame(0x4E, &check.frame.data)).await;
        let second = peer.request().await;
        peer.reply(&first, 1).await;
        peer.reply(&second, 2).await;
        assert_eq!(call.await.unwrap().unwrap(), [2]);
    }
}

/// Before each request had a local port of its own, the copy was taken for the reply: 32 wrong
/// values of 64 as `Ok`, in both framings. Only the surplus reply after each of them led to another
/// socket.
#[tokio::test]
async fn a_copy_of_a_reply_does_not_answer_later_requests() {
    const READS: u16 = 64;
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let station = link.station(1).unwrap();
        let plc = tokio::spawn(async move {
            let mut before: Option<(ReceivedRequest, BytesMut)> = None;
            for value in 0..READS {
                let request = loop {
                    let request = peer.request().await;
                    if request.frame.command != 0x4E {
                        break request;
                    }
                    peer.send(&request, &peer.frame(0x4E, &request.frame.data)).await;
                };
                if let Some((earlier, copy)) = &before {
                    peer.send(earlier, copy).await;
                }
                let reply = peer.frame(request.frame.command, &peer.register(value));
                peer.send(&request, &reply).await;
                before = Some((request, reply));
            }
        });
        let mut wrong = Vec::new();
        for value in 0..READS {
            let read = station.read_registers(register!("R1"), 1).await.unwrap();
            if read != [value] {
                wrong.push((value, read));
            }
        }
        assert_eq!(wrong, [], "{} of {READS}, {framing}", wrong.len());
        plc.await.unwrap();
    }
}

/// Before each request had its own port and shape, a duplicate made the station suspect and led to
/// a new socket. Now it cannot match a later request, so it is counted and no check is sent.
#[tokio::test]
async fn after_a_duplicate_reply_the_next_request_uses_another_port() {
    let peer = Peer::bind(Framing::Ascii).await;
    // A copy window longer than the test takes on a busy machine.
    let link = peer.builder().in_step(InStepSettings::new().with_window(LONG)).build();
    let station = link.station(1).unwrap();
    let call = read(&station);
    peer.echo().await;
    let first = peer.request().await;
    peer.reply(&first, 1).await;
    peer.reply(&first, 1).await;
    assert_eq!(call.await.unwrap().unwrap(), [1]);
    until(|| link.stats().stations.duplicates == 1).await;

    let call = read(&station);
    let second = peer.request().await;
    assert_ne!(first.from.port(), second.from.port());
    assert_eq!((first.frame.command, second.frame.command), (0x46, 0x48));
    // A duplicate to the port of the earlier request is counted and dropped.
    peer.reply(&first, 1).await;
    peer.reply(&second, 2).await;
    assert_eq!(call.await.unwrap().unwrap(), [2]);
    let call = read(&station);
    let third = peer.request().await;
    peer.reply(&third, 3).await;
    assert_eq!(call.await.unwrap().unwrap(), [3]);
    until(|| link.stats().late_datagrams == 1).await;
    let stats = link.stats().stations;
    assert_eq!((stats.duplicates, stats.stray_frames, stats.checks), (1, 0, 1), "only the check of the new connection");
}

/// Waits until the condition is true.
async fn until(condition: impl Fn() -> bool) {
    let wait = async {
        while !condition() {
            tokio::task::yield_now().await;
        }
    };
    timeout(LONG, wait).await.expect("the condition never becomes true");
}

/// An unexpected frame makes the station suspect. The reply after it has no proof, so the read is
/// sent again after a check.
#[tokio::test]
async fn a_reply_after_a_stray_is_not_taken() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let request = peer.request().await;
        let stray = [peer.register(1), peer.register(1)[1..].to_vec()].concat();
        peer.send(&request, &peer.frame(0x46, &stray)).await;
        peer.reply(&request, 0xBAD).await;
        peer.echo().await;
        let again = peer.request().await;
        peer.reply(&again, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn a_datagram_from_another_sender_is_ignored() {
    for framing in FRAMINGS {
        let (peer, stranger) = (Peer::bind(framing).await, Peer::bind(framing).await);
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let request = peer.request().await;
        stranger.reply(&request, 0xBAD).await;
        peer.reply(&request, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn empty_oversized_and_noisy_datagrams_are_ignored() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let request = peer.request().await;
        let good = peer.reply_bytes(&request, 0xBAD);
        let oversized = [&good[..], &[0x20; 1024][..]].concat();
        for datagram in [&b""[..], &oversized, &[0x51; 60_000], b"\x06", b""] {
            peer.send(&request, datagram).await;
        }
        peer.reply(&request, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn frames_do_not_span_datagrams() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let request = peer.request().await;
        let wrong = peer.reply_bytes(&request, 0xBAD);
        for cut in 1..wrong.len() {
            peer.send(&request, &wrong[..cut]).await;
            peer.send(&request, &wrong[cut..]).await;
        }
        peer.reply(&request, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn the_longest_datagram_is_taken_whole() {
    let peer = Peer::bind(Framing::Ascii).await;
    let link = peer.builder().build();
    let call = read(&link.station(1).unwrap());
    peer.echo().await;
    let request = peer.request().await;
    let reply = peer.reply_bytes(&request, 7);
    let noise = vec![0x06; 1024 - reply.len()];
    peer.send(&request, &[&noise, &reply[..]].concat()).await;
    assert_eq!(call.await.unwrap().unwrap(), [7]);
}

#[tokio::test]
async fn a_closed_port_is_a_lost_connection_and_no_timeout() {
    // Without a first read only the check is sent.
    for once_answered in [false, true] {
        let peer = Peer::bind(Framing::Ascii).await;
        let link = peer.builder().build();
        let station = link.station(1).unwrap();
        if once_answered {
            let call = read(&station);
            peer.echo().await;
            peer.reply(&peer.request().await, 7).await;
            assert_eq!(call.await.unwrap().unwrap(), [7]);
        }
        drop(peer);
        let error = timeout(LONG / 2, read(&station)).await.unwrap().unwrap().unwrap_err();
        assert!(matches!(error, Error::Disconnected { sent, .. } if sent == once_answered), "{error:?}");
        assert!(error.to_string().contains("refused"), "{error}");
    }
}
