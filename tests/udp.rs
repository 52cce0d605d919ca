//! The link over UDP: one frame a datagram, a local port for each request, and traffic that is no reply.
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

/// Longer than anything here takes, even on a busy machine.
const LONG: Duration = Duration::from_secs(10);

/// A PLC whose every datagram the test decides.
struct Peer {
    socket: UdpSocket,
    framing: Framing,
}

/// A request, and where it came from.
struct Asked {
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

    /// The next request, which must be the only frame of its datagram.
    async fn request(&self) -> Asked {
        let mut datagram = [0; 2048];
        let received = timeout(LONG, self.socket.recv_from(&mut datagram)).await.expect("the client asks nothing");
        let (len, from) = received.unwrap();
        let mut bytes = BytesMut::from(&datagram[..len]);
        let mut codec = Codec::new(self.framing, Side::Plc);
        let frame = codec.decode(&mut bytes).unwrap().unwrap().frame().unwrap();
        assert!(bytes.is_empty() && codec.decode(&mut bytes).unwrap().is_none(), "one frame a datagram");
        Asked { frame, from }
    }

    async fn send(&self, to: &Asked, datagram: &[u8]) {
        self.socket.send_to(datagram, to.from).await.unwrap();
    }

    /// Answers a read of one register, however it is spelt.
    async fn reply(&self, to: &Asked, value: u16) {
        self.send(to, &self.reply_bytes(to, value)).await;
    }

    fn reply_bytes(&self, to: &Asked, value: u16) -> BytesMut {
        self.frame(to.frame.command, &self.register(value))
    }

    /// The data of a reply with one register.
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

    /// The check that must come now, echoed. Each connection begins with one.
    async fn echo(&self) -> Asked {
        let asked = self.request().await;
        assert_eq!(asked.frame.command, 0x4E, "a new connection and a doubt ask for a check");
        self.send(&asked, &self.frame(0x4E, &asked.frame.data)).await;
        asked
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
                let asked = peer.request().await;
                let mut reply = BytesMut::new();
                bus.answer(&fatek::wire::Received::Frame(asked.frame.clone()), framing, &mut reply);
                peer.send(&asked, &reply).await;
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
async fn a_read_after_a_lost_datagram_is_repeated_behind_a_check() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().response_timeout(Duration::from_millis(100)).retries(2).build();
        let call = read(&link.station(1).unwrap());
        let first = peer.echo().await;
        let lost = peer.request().await;
        let barrier = peer.echo().await;
        let repeated = peer.request().await;
        assert_eq!(repeated.frame, lost.frame);
        let ports = BTreeSet::from([&first, &lost, &barrier, &repeated].map(|asked| asked.from.port()));
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
        let barrier = peer.request().await;
        peer.reply(&first, 1).await; // to where it was asked from
        peer.reply(&barrier, 1).await; // and from a module that knows only the last to ask
        peer.send(&barrier, &peer.frame(0x4E, &barrier.frame.data)).await;
        let second = peer.request().await;
        peer.reply(&first, 1).await;
        peer.reply(&second, 2).await;
        assert_eq!(call.await.unwrap().unwrap(), [2]);
    }
}

/// Before each request had a local port of its own, the copy was read as the answer: 32 wrong values of 64 as `Ok`, with
/// both framings. Only the surplus reply after each of them led to another socket.
#[tokio::test]
async fn a_copy_of_a_reply_is_not_read_by_later_requests() {
    const READS: u16 = 64;
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let station = link.station(1).unwrap();
        let plc = tokio::spawn(async move {
            let mut before: Option<(Asked, BytesMut)> = None;
            for value in 0..READS {
                let asked = loop {
                    let asked = peer.request().await;
                    if asked.frame.command != 0x4E {
                        break asked;
                    }
                    peer.send(&asked, &peer.frame(0x4E, &asked.frame.data)).await;
                };
                if let Some((earlier, copy)) = &before {
                    peer.send(earlier, copy).await;
                }
                let reply = peer.frame(asked.frame.command, &peer.register(value));
                peer.send(&asked, &reply).await;
                before = Some((asked, reply));
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

/// Before each request had a port and a shape of its own, a duplicate made the station suspect and led to a fresh socket. Now it
/// can be taken for no later reply, so it is counted and no check is sent.
#[tokio::test]
async fn after_a_doubled_reply_the_next_request_has_another_port() {
    let peer = Peer::bind(Framing::Ascii).await;
    // Duplicates are expected for longer than the test takes on a busy machine.
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
    assert_eq!((stats.duplicates, stats.stray_frames, stats.checks), (1, 0, 1), "the check of a new connection");
}

/// Waits until the condition is true.
async fn until(condition: impl Fn() -> bool) {
    let wait = async {
        while !condition() {
            tokio::task::yield_now().await;
        }
    };
    timeout(LONG, wait).await.expect("the condition stays false");
}

/// An unexpected frame makes the station suspect: the reply behind it has no proof, and the read is sent again behind a check.
#[tokio::test]
async fn a_reply_behind_a_stray_is_not_taken() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let asked = peer.request().await;
        let stray = [peer.register(1), peer.register(1)[1..].to_vec()].concat();
        peer.send(&asked, &peer.frame(0x46, &stray)).await;
        peer.reply(&asked, 0xBAD).await;
        peer.echo().await;
        let again = peer.request().await;
        peer.reply(&again, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn a_datagram_from_a_stranger_is_ignored() {
    for framing in FRAMINGS {
        let (peer, stranger) = (Peer::bind(framing).await, Peer::bind(framing).await);
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let asked = peer.request().await;
        stranger.reply(&asked, 0xBAD).await;
        peer.reply(&asked, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn empty_oversized_and_noisy_datagrams_harm_nobody() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let asked = peer.request().await;
        let good = peer.reply_bytes(&asked, 0xBAD);
        let swollen = [&good[..], &[0x20; 1024][..]].concat();
        for datagram in [&b""[..], &swollen, &[0x51; 60_000], b"\x06", b""] {
            peer.send(&asked, datagram).await;
        }
        peer.reply(&asked, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn a_frame_that_a_datagram_has_begun_is_not_ended_by_the_next() {
    for framing in FRAMINGS {
        let peer = Peer::bind(framing).await;
        let link = peer.builder().build();
        let call = read(&link.station(1).unwrap());
        peer.echo().await;
        let asked = peer.request().await;
        let wrong = peer.reply_bytes(&asked, 0xBAD);
        for cut in 1..wrong.len() {
            peer.send(&asked, &wrong[..cut]).await;
            peer.send(&asked, &wrong[cut..]).await;
        }
        peer.reply(&asked, 7).await;
        assert_eq!(call.await.unwrap().unwrap(), [7]);
    }
}

#[tokio::test]
async fn the_longest_datagram_is_taken_whole() {
    let peer = Peer::bind(Framing::Ascii).await;
    let link = peer.builder().build();
    let call = read(&link.station(1).unwrap());
    peer.echo().await;
    let asked = peer.request().await;
    let reply = peer.reply_bytes(&asked, 7);
    let noise = vec![0x06; 1024 - reply.len()];
    peer.send(&asked, &[&noise, &reply[..]].concat()).await;
    assert_eq!(call.await.unwrap().unwrap(), [7]);
}

#[tokio::test]
async fn a_port_where_nobody_listens_is_a_lost_connection_and_not_a_timeout() {
    // Without a first read only the check is sent.
    for once_heard in [false, true] {
        let peer = Peer::bind(Framing::Ascii).await;
        let link = peer.builder().build();
        let station = link.station(1).unwrap();
        if once_heard {
            let call = read(&station);
            peer.echo().await;
            peer.reply(&peer.request().await, 7).await;
            assert_eq!(call.await.unwrap().unwrap(), [7]);
        }
        drop(peer);
        let error = timeout(LONG / 2, read(&station)).await.unwrap().unwrap().unwrap_err();
        assert!(matches!(error, Error::Disconnected { sent, .. } if sent == once_heard), "{error:?}");
        assert!(error.to_string().contains("refused"), "{error}");
    }
}
