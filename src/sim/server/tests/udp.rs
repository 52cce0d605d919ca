//! A bus behind a UDP port.

use tokio::net::UdpSocket;

use super::faults::{DONE_2, RUN_2, bus_with};
use super::*;
use crate::sim::{DisconnectAt, Fault, Faults, LeftOver, Line, Rule, Timing, UdpServer};

#[tokio::test]
async fn a_reply_is_a_datagram_to_the_sender_of_its_request() {
    let plc = Plc::new();
    let server = UdpServer::bind("127.0.0.1:0", bus(&plc), Framing::Ascii).await.unwrap();
    let [first, second] = [client(&server).await, client(&server).await];
    first.send(b"\x02014701R0000012343B\x03\x02014601R0000070\x03").await.unwrap();
    assert_next(&first, b"\x0201470FE\x03").await;
    assert_next(&first, b"\x02014601234C7\x03").await;
    second.send(b"noise").await.unwrap();
    second.send(RUN).await.unwrap();
    assert_next(&second, DONE).await;
    // A frame does not continue in the next datagram.
    second.send(&RUN[..4]).await.unwrap();
    second.send(&RUN[4..]).await.unwrap();
    second.send(RUN).await.unwrap();
    assert_next(&second, DONE).await;
    assert_silent(&first).await;
    assert_silent(&second).await;
    let address = server.local_addr();
    server.shutdown().await;
    UdpServer::bind(address, Bus::new(), Framing::Ascii).await.unwrap().shutdown().await;
}

#[tokio::test]
async fn duplicates_are_separate_datagrams() {
    let after = Duration::from_millis(50);
    for timing in [Timing::AT_ONCE, Timing::After { min: after, max: after }] {
        let (server, [first, second]) = start(&Faults::new(1).rule(Rule::new(Fault::Duplicate(timing)).times(1))).await;
        first.send(RUN).await.unwrap();
        assert_next(&first, DONE).await;
        // The duplicate precedes the reply, and goes to the sender of its request.
        second.send(RUN).await.unwrap();
        assert_next(&second, DONE).await;
        assert_now(&first, DONE);
        assert_silent(&second).await;
        server.shutdown().await;
    }
}

#[tokio::test]
async fn a_duplicate_can_come_with_a_request_of_any_address() {
    let timing = Timing::WithNextRequest { min_per_mille: 0, max_per_mille: 0, at_latest: Duration::from_secs(3600) };
    let response_time = Duration::from_millis(100);
    let faults = Faults::new(1)
        .rule(Rule::new(Fault::Duplicate(timing)).times(1))
        .line(Line::new(0).response_time(response_time, response_time));
    for to_last_sender in [false, true] {
        faults.set_rules(faults.rules());
        let (server, [first, second]) = start(&faults).await;
        server.answer_last_sender(to_last_sender);
        first.send(RUN).await.unwrap();
        assert_next(&first, DONE).await;
        second.send(RUN).await.unwrap();
        let asked = Instant::now();
        assert_next(if to_last_sender { &second } else { &first }, DONE).await;
        assert!(asked.elapsed() < response_time, "{:?}", asked.elapsed());
        assert_next(&second, DONE).await;
        assert!(asked.elapsed() >= response_time - Duration::from_millis(5), "{:?}", asked.elapsed());
        server.shutdown().await;
    }
}

#[tokio::test]
async fn a_reply_that_outlives_its_client_goes_to_the_latest_address() {
    let late = Duration::from_millis(200);
    let faults = Faults::new(1).rule(Rule::new(Fault::LeftOver { min: late, max: late }).station(1).times(1));
    let (server, [first, second]) = start(&faults).await;
    first.send(RUN).await.unwrap();
    while faults.log().arrivals() == 0 {
        time::sleep(Duration::from_millis(1)).await;
    }
    second.send(RUN_2).await.unwrap();
    assert_next(&second, DONE_2).await;
    assert_next(&second, DONE).await;
    assert_silent(&first).await;
    server.shutdown().await;
}

#[tokio::test]
async fn the_first_request_brings_left_over_replies() {
    let faults = Faults::new(1).left_over(LeftOver::bytes(DONE_2));
    let (server, [first, second]) = start(&faults).await;
    first.send(RUN).await.unwrap();
    assert_next(&first, DONE_2).await;
    assert_next(&first, DONE).await;
    // Another address counts as another client.
    faults.add_left_over(LeftOver::bytes(DONE_2));
    first.send(RUN).await.unwrap();
    assert_next(&first, DONE).await;
    second.send(RUN).await.unwrap();
    assert_next(&second, DONE_2).await;
    assert_next(&second, DONE).await;
    server.shutdown().await;
}

#[tokio::test]
async fn disconnect_loses_the_request() {
    let faults = Faults::new(1).rule(Rule::new(Fault::Disconnect(DisconnectAt::BeforeExecution)).times(1));
    let (server, [first, _]) = start(&faults).await;
    first.send(RUN).await.unwrap();
    assert_silent(&first).await;
    first.send(RUN).await.unwrap();
    assert_next(&first, DONE).await;
    let executed: Vec<_> = faults.log().entries().iter().map(|entry| entry.executed).collect();
    assert_eq!(executed, [false, true]);
    server.shutdown().await;
}

#[tokio::test]
async fn broadcast_answers_go_to_the_sender() {
    let time = Duration::ZERO;
    let answer = Fault::AnswerBroadcast { station: None, min: time, max: time, error: None };
    let (server, [first, second]) = start(&Faults::new(1).rule(Rule::new(answer))).await;
    first.send(b"\x0200411F8\x03").await.unwrap();
    assert_next(&first, DONE).await;
    assert_next(&first, DONE_2).await;
    assert_silent(&second).await;
    server.shutdown().await;
}

async fn start(faults: &Faults) -> (UdpServer, [UdpSocket; 2]) {
    let server = UdpServer::bind("127.0.0.1:0", bus_with(faults), Framing::Ascii).await.unwrap();
    let clients = [client(&server).await, client(&server).await];
    (server, clients)
}

async fn client(server: &UdpServer) -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    socket.connect(server.local_addr()).await.unwrap();
    socket
}

async fn assert_next(client: &UdpSocket, bytes: &[u8]) {
    let mut datagram = [0; 2048];
    let received = time::timeout(Duration::from_secs(10), client.recv(&mut datagram)).await;
    let len = received.expect("no datagram comes").unwrap();
    assert_eq!(datagram[..len].escape_ascii().to_string(), bytes.escape_ascii().to_string());
}

/// Expects a datagram that was received before.
fn assert_now(client: &UdpSocket, bytes: &[u8]) {
    let mut datagram = [0; 2048];
    let len = client.try_recv(&mut datagram).unwrap();
    assert_eq!(datagram[..len].escape_ascii().to_string(), bytes.escape_ascii().to_string());
}

async fn assert_silent(client: &UdpSocket) {
    let received = time::timeout(Duration::from_millis(100), client.recv(&mut [0])).await;
    assert!(received.is_err(), "{received:?}");
}
