//! The send gate: nothing is sent after it has closed, at any moment and on any transport.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![allow(clippy::print_stdout, reason = "prints figures")]
#![cfg(feature = "sim")]

mod campaign;
#[path = "../common/rng.rs"]
mod rng;
mod wire;

use std::io::Read as _;
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::poll::{PollTag, Poller, Quality, Reason, ScanClass};
use fatek::sim::{self, Bus, Fault, Faults, Plc, Rule};
use fatek::wire::Framing;
use fatek::{CallOptions, Endpoint, Error, Link, Pool, SendGate, StationState, Value, register};
use futures::future::join;
use tokio::time::{Instant, sleep, timeout};

use self::wire::{Closing, Count, Wire};

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

/// A link to a PLC, station 1, over this wire.
fn link(wire: &Wire, plc: &Plc, faults: Faults) -> Link {
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults);
    let (mut connect, recorder) = (sim::connector(bus, Framing::Ascii), wire.clone());
    Link::connector_builder("a wire", Framing::Ascii, move || recorder.connect(connect()))
        .send_gate(wire.gate())
        .seed(1)
        .build()
}

fn quick(closing: Closing) -> Wire {
    Wire::new(1, Framing::Ascii, closing).quick()
}

fn is_refused<T: std::fmt::Debug>(result: Result<T, Error>) -> bool {
    matches!(result, Err(Error::GateClosed { station: 1, sent: false, .. }))
}

#[tokio::test(start_paused = true)]
async fn calls_fail_at_once_while_the_gate_is_closed() {
    let (wire, plc) = (quick(Closing::Never), Plc::new());
    let link = link(&wire, &plc, Faults::new(1));
    let station = link.station(1).unwrap();
    wire.close();
    let began = Instant::now();
    let error = station.write_registers(register!("R0"), &[1]).await.unwrap_err();
    assert_eq!(error.to_string(), "write registers (47h) to station 1 was not sent: the send gate is closed");
    assert!(!error.may_have_executed() && error.is_transient() && !error.is_timeout() && !error.is_connect());
    assert!(is_refused(station.read_registers(register!("R0"), 200).await), "without retries");
    assert!(matches!(
        link.broadcast().write_registers(register!("R0"), &[1]).await,
        Err(Error::GateClosed { station: 0, sent: false, .. })
    ));
    assert_eq!((began.elapsed(), wire.after().connects), (Duration::ZERO, 0), "no connection is opened");
    assert_eq!((link.stats().withheld, link.stats().stations.requests), (3, 0));

    wire.open();
    station.write_registers(register!("R0"), &[2]).await.unwrap();
    assert_eq!((plc.read(register!("R0")), link.stats().connects), (Value::Word(2), 1));

    wire.close();
    assert!(is_refused(station.read_status().await), "over an open connection");
    wire.open();
    station.read_status().await.unwrap();
    assert_eq!((link.stats().connects, link.stats().disconnects), (1, 0), "it stays open");
}

#[tokio::test(start_paused = true)]
async fn the_reply_to_a_request_sent_before_is_taken() {
    let (wire, plc) = (quick(Closing::Never), Plc::new());
    let delay = Fault::Delay { min: ms(100), max: ms(100) };
    let link = link(&wire, &plc, Faults::new(1).rule(Rule::new(delay)));
    let station = link.station(1).unwrap();
    station.read_status().await.unwrap();
    let close = async {
        sleep(ms(50)).await;
        wire.close();
        // Waits for the end of the exchange on the wire.
        assert!(is_refused(station.read_status().await));
    };
    let (written, ()) = join(station.write_registers(register!("R0"), &[7]), close).await;
    written.unwrap();
    assert_eq!((plc.read(register!("R0")), wire.after().bytes), (Value::Word(7), 0));
}

/// Without the question in `Driver::poll_write`: the other 15 bytes of the check were sent.
#[tokio::test(start_paused = true)]
async fn the_rest_of_a_request_is_not_sent() {
    // Closed after each byte of the check of the new connection, and of the write.
    let counted = quick(Closing::Never);
    let link_to = |wire: &Wire, plc: &Plc| link(wire, plc, Faults::new(1));
    let write = [1];
    link_to(&counted, &Plc::new()).station(1).unwrap().write_registers(register!("R0"), &write).await.unwrap();
    let all = counted.all().bytes;
    for last in 1..=all {
        let (wire, plc) = (quick(Closing::AfterByte(last)), Plc::new());
        let link = link_to(&wire, &plc);
        let station = link.station(1).unwrap();
        let error = station.write_registers(register!("R0"), &write).await.unwrap_err();
        let is_within_write = last > CHECK_LEN as u64;
        assert!(matches!(error, Error::GateClosed { sent, .. } if sent == is_within_write), "{last}: {error:?}");
        assert_eq!((wire.after().bytes, wire.all().bytes), (0, last));
        // As after a broken write; also behind the last byte, since the stream may send when it is flushed.
        assert_eq!((link.stats().connects, link.stats().disconnects), (1, 1), "{last}");
        sleep(ms(1)).await;
        assert_eq!(plc.read(register!("R0")), Value::Word(u16::from(last == all)), "{last}");
        wire.open();
        station.write_registers(register!("R0"), &write).await.unwrap();
        assert_eq!(plc.read(register!("R0")), Value::Word(1));
    }
}

/// A loop-back with a nonce of 8 characters.
const CHECK_LEN: usize = 16;

/// Without any question: the retry was sent, and its reply did not come either.
#[tokio::test(start_paused = true)]
async fn a_retry_is_not_sent_after_the_gate_has_closed() {
    let (wire, plc) = (quick(Closing::Never), Plc::new());
    let link = link(&wire, &plc, Faults::new(1).rule(Rule::new(Fault::DropReply).skip(1)));
    let options = CallOptions::new().with_response_timeout(ms(200)).with_retries(5).with_retry_writes(true);
    let station = link.station(1).unwrap().with_options(options);
    let close = async {
        sleep(ms(100)).await;
        wire.close();
    };
    let (written, ()) = join(station.write_registers(register!("R0"), &[7]), close).await;
    let error = written.unwrap_err();
    assert!(matches!(error, Error::GateClosed { sent: true, .. }), "it was sent once: {error:?}");
    assert_eq!((wire.after().bytes, link.stats().stations.requests), (0, 1));
}

/// With stations that stay offline: the driver began the probe again without end.
#[tokio::test(start_paused = true)]
async fn an_offline_station_is_not_probed_and_nothing_spins() {
    let (wire, plc) = (quick(Closing::Never), Plc::new());
    let faults = Faults::new(1).rule(Rule::new(Fault::Ignore));
    let link = link(&wire, &plc, faults.clone());
    let station = link.station(1).unwrap();
    while !matches!(*station.watch_state().borrow(), StationState::Offline { .. }) {
        station.read_status().await.unwrap_err();
    }
    wire.close();
    sleep(Duration::from_secs(600)).await;
    assert!(matches!(*station.watch_state().borrow(), StationState::Unknown));
    let Count { questions, connects, bytes, .. } = wire.after();
    assert!(questions <= 2, "{questions} questions in ten minutes");
    assert_eq!((connects, bytes), (0, 0));
    wire.open();
    faults.set_rules([]);
    station.read_status().await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_poller_has_the_closed_gate_as_reason() {
    let (wire, plc) = (quick(Closing::Never), Plc::new());
    let link = link(&wire, &plc, Faults::new(1));
    let poller = Poller::builder().seed(1).build();
    let polled = poller.station(&link.station(1).unwrap()).unwrap();
    let class = ScanClass::every(ms(100)).bad_after(ms(2000));
    let id = polled.add(class, [PollTag::from("R0".parse::<fatek::Tag>().unwrap())]).unwrap()[0];
    let quality = || polled.latest(id).unwrap().quality;
    sleep(ms(1000)).await;
    assert!(matches!(quality(), Quality::Good));
    wire.close();
    sleep(ms(1000)).await;
    let is_withheld =
        |reason: &Reason| matches!(reason, Reason::Failed(error) if matches!(**error, Error::GateClosed { .. }));
    assert!(matches!(quality(), Quality::Stale(reason) if is_withheld(&reason)), "{:?}", quality());
    sleep(ms(3000)).await;
    assert!(matches!(quality(), Quality::Bad(reason) if is_withheld(&reason)), "{:?}", quality());
    let Count { questions, bytes, .. } = wire.after();
    // One call a cycle.
    assert!((38..=42).contains(&questions) && bytes == 0, "{questions} questions in 40 cycles, {bytes} bytes");
    wire.open();
    sleep(ms(200)).await;
    assert!(matches!(quality(), Quality::Good), "{:?}", quality());
}

#[tokio::test(start_paused = true)]
async fn a_pool_has_a_gate_for_each_endpoint() {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap();
    let mine = Arc::new(AtomicBool::new(true));
    let gate_of = {
        let mine = mine.clone();
        move |endpoint: &Endpoint| {
            let mine = mine.clone();
            (endpoint.to_string() != "tcp://free:500").then(|| SendGate::new(move || mine.load(Ordering::SeqCst)))
        }
    };
    let pool = Pool::builder()
        .connector(move |endpoint| sim::connector(bus.clone(), endpoint.framing())())
        .send_gates(gate_of)
        .build();
    let [leased, free] = ["tcp://leased", "tcp://free"].map(|endpoint| pool.station(endpoint, 1).unwrap());
    leased.read_status().await.unwrap();
    mine.store(false, Ordering::SeqCst);
    assert!(is_refused(leased.read_status().await));
    free.read_status().await.unwrap();
    // Another link of the same endpoint.
    pool.close_endpoint(&"tcp://leased".parse().unwrap()).await;
    let leased = pool.station("tcp://leased", 1).unwrap();
    assert!(is_refused(leased.read_status().await));
    mine.store(true, Ordering::SeqCst);
    leased.read_status().await.unwrap();
}

/// Over sockets, with a PLC that does not answer: the check of the connection and its repetitions. After
/// the first one the gate is open for some questions more; each check has two. Over UDP a datagram is one
/// write.
///
/// Without the question in `Driver::poll_write`: two checks instead of one, over both.
#[tokio::test]
async fn nothing_leaves_a_socket_after_the_gate_has_closed() {
    for more in 0..=3_usize {
        for plc in [SilentPlc::udp(), SilentPlc::tcp()] {
            let endpoint = plc.endpoint();
            let shown = endpoint.to_string();
            let plc = Arc::new(Mutex::new(plc));
            let gate = {
                let (plc, left) = (plc.clone(), Mutex::new(more));
                move || {
                    if plc.lock().unwrap().receive() == 0 {
                        return true;
                    }
                    let mut left = left.lock().unwrap();
                    let yes = *left > 0;
                    *left = left.saturating_sub(1);
                    yes
                }
            };
            let link = Link::builder(endpoint).send_gate(gate).offline_after(0).build();
            let options = CallOptions::new().with_response_timeout(ms(100)).with_retries(20);
            let error = link.station(1).unwrap().with_options(options).read_status().await.unwrap_err();
            assert!(matches!(error, Error::GateClosed { sent: false, .. }), "only checks were sent: {error:?}");
            link.close().await;
            assert_eq!(plc.lock().unwrap().receive(), CHECK_LEN * (1 + more / 2), "{shown}, {more} times more");
        }
    }
}

/// The socket of a PLC that receives, and does not answer.
enum SilentPlc {
    Udp(UdpSocket, usize),
    Tcp(TcpListener, Option<TcpStream>, usize),
}

impl SilentPlc {
    fn udp() -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_nonblocking(true).unwrap();
        Self::Udp(socket, 0)
    }

    fn tcp() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        Self::Tcp(listener, None, 0)
    }

    fn endpoint(&self) -> Endpoint {
        match self {
            Self::Udp(socket, _) => Endpoint::udp("127.0.0.1", socket.local_addr().unwrap().port()),
            Self::Tcp(listener, ..) => Endpoint::tcp("127.0.0.1", listener.local_addr().unwrap().port()),
        }
    }

    /// Receives all that has come. Returns the number of bytes so far.
    fn receive(&mut self) -> usize {
        let mut bytes = [0; 256];
        match self {
            Self::Udp(socket, received) => {
                *received += std::iter::from_fn(|| socket.recv(&mut bytes).ok()).sum::<usize>();
                *received
            }
            Self::Tcp(listener, connection, received) => {
                if let (None, Ok((accepted, _))) = (&connection, listener.accept()) {
                    accepted.set_nonblocking(true).unwrap();
                    *connection = Some(accepted);
                }
                if let Some(connection) = connection {
                    *received += connection.read(&mut bytes).unwrap_or(0);
                }
                *received
            }
        }
    }
}

/// Without the question in `Driver::poll_write`: the write was executed.
#[tokio::test(start_paused = true)]
async fn a_link_over_one_stream_ends_when_the_gate_cuts_a_request() {
    let (client, plc) = tokio::io::duplex(1024);
    tokio::spawn(sim::serve(plc, Bus::new().with_station(1, Plc::new()).unwrap(), Framing::Ascii));
    let wire = quick(Closing::AfterByte(25));
    let link = Link::stream_builder(wire.record(client), Framing::Ascii).send_gate(wire.gate()).build();
    let station = link.station(1).unwrap();
    let (first, second) = join(station.write_registers(register!("R0"), &[1]), station.read_status()).await;
    assert!(matches!(first, Err(Error::GateClosed { sent: true, .. })), "{first:?}");
    assert!(second.is_err_and(|error| !error.may_have_executed()));
    assert_eq!(wire.after().bytes, 0);
    assert!(matches!(station.read_status().await, Err(Error::Closed { .. })), "it has no other connection");
}

/// A flapping gate: each second question has another answer.
#[tokio::test(start_paused = true)]
async fn a_gate_that_alternates_ends_every_call() {
    for first in [false, true] {
        let plc = Plc::new();
        let bus = Bus::new().with_station(1, plc).unwrap();
        let answer = AtomicBool::new(first);
        let link = Link::connector_builder("a wire", Framing::Ascii, sim::connector(bus, Framing::Ascii))
            .send_gate(move || answer.fetch_xor(true, Ordering::SeqCst))
            .build();
        let (one, absent) = (link.station(1).unwrap(), link.station(9).unwrap());
        for _ in 0..50 {
            let calls = join(one.read_status(), absent.read_status());
            let (_, gone) = timeout(Duration::from_secs(60), calls).await.expect("both end");
            gone.expect_err("it does not answer");
        }
    }
}
