//! Streams and ports for a bus with faults.

use super::*;
use crate::sim::{DisconnectAt, Fault, Faults, Line, Rule};

pub(super) const RUN_2: &[u8] = b"\x0202411FA\x03";
pub(super) const DONE_2: &[u8] = b"\x0202410F9\x03";

#[tokio::test(start_paused = true)]
async fn without_rules_and_line_no_time_passes() {
    let (mut client, serving) = start_with(&Faults::new(1), Framing::Ascii);
    let began = Instant::now();
    for _ in 0..1000 {
        send(&mut client, &[RUN, RUN_2].concat()).await;
        expect(&mut client, &[DONE, DONE_2].concat()).await;
    }
    assert_eq!(began.elapsed(), Duration::ZERO);
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn a_late_station_delays_no_other_station() {
    let (mut client, serving) = start_with(&late(1000), Framing::Ascii);
    let began = Instant::now();
    send(&mut client, &[RUN, RUN].concat()).await;
    time::sleep(Duration::from_millis(100)).await;
    send(&mut client, RUN_2).await;
    expect(&mut client, DONE_2).await;
    assert_eq!(began.elapsed().as_millis(), 100);
    expect(&mut client, DONE).await;
    assert_eq!(began.elapsed().as_millis(), 1000);
    expect(&mut client, DONE).await;
    assert_eq!(began.elapsed().as_millis(), 2000);
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn a_line_speed_gives_real_transmission_times() {
    let (mut client, serving) = start_with(&Faults::new(1).line(Line::new(9600)), Framing::Ascii);
    for _ in 0..10 {
        let began = Instant::now();
        send(&mut client, RUN).await;
        expect(&mut client, DONE).await;
        // 18 characters of 10 bits are 18.75 ms, and Tokio's timer counts in whole milliseconds.
        assert_eq!(began.elapsed().as_millis(), 19);
    }
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn a_frame_can_pause_while_a_station_is_busy() {
    let (mut client, serving) = start_with(&late(60), Framing::Ascii);
    send(&mut client, RUN).await;
    for part in [&RUN_2[..4], &RUN_2[4..6], &RUN_2[6..]] {
        send(&mut client, part).await;
        time::sleep(FRAME_TIMEOUT / 2).await;
    }
    expect(&mut client, &[DONE, DONE_2].concat()).await;
    // A pause above the timeout discards it.
    send(&mut client, &RUN_2[..4]).await;
    time::sleep(2 * FRAME_TIMEOUT).await;
    send(&mut client, &RUN_2[4..]).await;
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn an_incomplete_binary_frame_does_not_hide_the_next() {
    let (mut client, serving) = start_with(&Faults::new(1), Framing::Binary);
    send(&mut client, b"\x51\x10\x01\x00\x01\x47\x02").await;
    send(&mut client, STOP_BINARY).await;
    expect(&mut client, DONE_BINARY).await;
    assert_ends(client, serving).await;
}

#[tokio::test(start_paused = true)]
async fn requests_above_the_limit_wait_in_the_stream() {
    let (client, serving) = start_with(&late(10), Framing::Ascii);
    let (mut replies, mut requests) = tokio::io::split(client);
    let asking = tokio::spawn(async move {
        for _ in 0..500 {
            send(&mut requests, RUN).await;
        }
        requests
    });
    for _ in 0..500 {
        expect(&mut replies, DONE).await;
    }
    assert_ends(replies.unsplit(asking.await.unwrap()), serving).await;
}

#[tokio::test(start_paused = true)]
async fn a_half_closed_connection_still_gets_its_replies() {
    let (mut client, serving) = start_with(&late(500), Framing::Ascii);
    send(&mut client, &[RUN, RUN].concat()).await;
    client.shutdown().await.unwrap();
    let mut replies = Vec::new();
    client.read_to_end(&mut replies).await.unwrap();
    assert_eq!(replies, [DONE, DONE].concat());
    serving.await.unwrap().unwrap();
}

#[tokio::test(start_paused = true)]
async fn requests_are_executed_after_their_client_has_gone() {
    let faults = late(500);
    let (mut client, serving) = start_with(&faults, Framing::Ascii);
    send(&mut client, &[RUN, RUN, RUN].concat()).await;
    tokio::task::yield_now().await;
    drop(client);
    let _ = serving.await.unwrap();
    assert!(faults.log().entries().iter().all(|entry| entry.executed));
    assert_eq!(faults.log().arrivals(), 3);
}

#[tokio::test]
async fn over_tcp_disconnect_closes_at_the_given_point() {
    for (point, received) in [
        (DisconnectAt::BeforeExecution, &b""[..]),
        (DisconnectAt::BeforeReply, b""),
        (DisconnectAt::WithinReply, &DONE[..DONE.len() / 2]),
        (DisconnectAt::AfterReply, DONE),
    ] {
        let faults = Faults::new(1).rule(Rule::new(Fault::Disconnect(point)).times(1));
        let server = bind_tcp_with(&faults).await;
        let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
        send(&mut client, RUN).await;
        let mut replies = Vec::new();
        client.read_to_end(&mut replies).await.unwrap();
        assert_eq!(replies, received, "{point:?}");
        assert_eq!(faults.log().entries()[0].executed, point != DisconnectAt::BeforeExecution);
        // The next connection is served.
        let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
        send(&mut client, RUN).await;
        expect(&mut client, DONE).await;
        server.shutdown().await;
    }
}

#[tokio::test]
async fn over_tcp_a_refused_connection_is_closed_at_once() {
    let faults = Faults::new(1).rule(Rule::new(Fault::Refuse).times(2));
    let server = bind_tcp_with(&faults).await;
    for _ in 0..2 {
        let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
        assert_eq!(client.read(&mut [0]).await.unwrap(), 0);
    }
    let mut client = TcpStream::connect(server.local_addr()).await.unwrap();
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    server.shutdown().await;
}

#[tokio::test]
async fn a_connector_fails_when_a_rule_refuses() {
    let faults = Faults::new(1).rule(Rule::new(Fault::Refuse).skip(1).times(1));
    let mut open = connector(bus_with(&faults), Framing::Ascii);
    let mut first = open().await.unwrap();
    assert_eq!(open().await.unwrap_err().kind(), io::ErrorKind::ConnectionRefused);
    let mut second = open().await.unwrap();
    for client in [&mut first, &mut second] {
        send(client, RUN).await;
        expect(client, DONE).await;
    }
}

#[test]
fn a_connector_needs_a_runtime() {
    let mut open = connector(Bus::new(), Framing::Ascii);
    assert!(open().into_inner().is_err());
}

/// All replies of station 1 have this delay.
fn late(ms: u64) -> Faults {
    let delay = Duration::from_millis(ms);
    Faults::new(1).rule(Rule::new(Fault::Delay { min: delay, max: delay }).station(1))
}

fn start_with(faults: &Faults, framing: Framing) -> (DuplexStream, JoinHandle<io::Result<()>>) {
    let (client, line) = duplex(64);
    (client, tokio::spawn(serve(line, bus_with(faults), framing)))
}

pub(super) async fn bind_tcp_with(faults: &Faults) -> Server {
    Server::bind("127.0.0.1:0", bus_with(faults), Framing::Ascii).await.unwrap()
}

pub(super) fn bus_with(faults: &Faults) -> Bus {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_station(2, Plc::new()).unwrap();
    bus.with_faults(faults.clone())
}
