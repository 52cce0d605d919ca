//! Replies that outlive their connection, in memory and over TCP.

use super::faults::{bind_tcp_with, bus_with};
use super::*;
use crate::sim::{Fault, Faults, LeftOver, Rule, Timing};

#[tokio::test(start_paused = true)]
async fn in_memory_a_left_over_reply_comes_at_its_time() {
    // The second connection opens after the end of the first one, and before it.
    for overlap in [false, true] {
        let mut open = connector(bus_with(&left_over(500)), Framing::Ascii);
        let began = Instant::now();
        let mut first = open().await.unwrap();
        send(&mut first, RUN).await;
        time::sleep(Duration::from_millis(100)).await;
        let early = if overlap { Some(open().await.unwrap()) } else { None };
        time::sleep(Duration::from_millis(100)).await;
        drop(first);
        time::sleep(Duration::from_millis(100)).await;
        let mut second = if let Some(early) = early { early } else { open().await.unwrap() };
        expect(&mut second, DONE).await;
        assert_eq!(began.elapsed().as_millis(), 500, "overlap: {overlap}");
        assert_silent(&mut second).await;
    }
}

#[tokio::test(start_paused = true)]
async fn in_memory_a_left_over_reply_comes_on_connection() {
    let mut open = connector(bus_with(&left_over(500)), Framing::Ascii);
    let mut first = open().await.unwrap();
    send(&mut first, RUN).await;
    time::sleep(Duration::from_millis(100)).await;
    drop(first);
    time::sleep(Duration::from_secs(10)).await;
    let began = Instant::now();
    let mut second = open().await.unwrap();
    expect(&mut second, DONE).await;
    assert_eq!(began.elapsed(), Duration::ZERO);
    assert_silent(&mut second).await;
}

#[tokio::test(start_paused = true)]
async fn a_connection_closed_by_a_fault_keeps_left_over_replies() {
    let faults = left_over(500).rule(Rule::new(Fault::Disconnect(crate::sim::DisconnectAt::AfterReply)).station(2));
    let mut open = connector(bus_with(&faults), Framing::Ascii);
    let mut first = open().await.unwrap();
    send(&mut first, &[RUN, super::faults::RUN_2].concat()).await;
    expect(&mut first, super::faults::DONE_2).await;
    assert_eq!(first.read(&mut [0]).await.unwrap(), 0);
    let mut second = open().await.unwrap();
    expect(&mut second, DONE).await;
}

#[tokio::test(start_paused = true)]
async fn the_first_connection_gets_replies_of_an_earlier_run() {
    let late = LeftOver::bytes(DONE).delay(Duration::from_millis(50));
    let faults = Faults::new(1).left_over(LeftOver::bytes(&b"noise"[..])).left_over(late);
    let mut open = connector(bus_with(&faults), Framing::Ascii);
    let began = Instant::now();
    let mut first = open().await.unwrap();
    expect(&mut first, b"noise").await;
    assert_eq!(began.elapsed(), Duration::ZERO);
    expect(&mut first, DONE).await;
    assert_eq!(began.elapsed().as_millis(), 50);
    assert_silent(&mut open().await.unwrap()).await;
}

#[tokio::test(start_paused = true)]
async fn a_duplicate_comes_between_a_request_and_its_reply() {
    let timing = Timing::WithNextRequest { min_per_mille: 500, max_per_mille: 500, at_latest: Duration::from_secs(9) };
    let response_time = Duration::from_millis(10);
    let faults = Faults::new(1)
        .rule(Rule::new(Fault::Duplicate(timing)).times(1))
        .line(crate::sim::Line::new(0).response_time(response_time, response_time));
    let mut client = connector(bus_with(&faults), Framing::Ascii)().await.unwrap();
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    time::sleep(Duration::from_millis(70)).await;
    let began = Instant::now();
    send(&mut client, RUN).await;
    expect(&mut client, DONE).await;
    assert_eq!(began.elapsed().as_millis(), 5);
    expect(&mut client, DONE).await;
    assert_eq!(began.elapsed().as_millis(), 10);
    assert_silent(&mut client).await;
}

#[tokio::test]
async fn over_tcp_a_left_over_reply_comes_on_reconnection() {
    for wait_ms in [0, 300] {
        let faults = left_over(200);
        let server = bind_tcp_with(&faults).await;
        let mut first = TcpStream::connect(server.local_addr()).await.unwrap();
        send(&mut first, RUN).await;
        while faults.log().arrivals() == 0 {
            time::sleep(Duration::from_millis(1)).await;
        }
        drop(first);
        time::sleep(Duration::from_millis(wait_ms)).await;
        let mut second = TcpStream::connect(server.local_addr()).await.unwrap();
        expect(&mut second, DONE).await;
        server.shutdown().await;
    }
}

#[tokio::test]
async fn over_tcp_the_first_connection_gets_left_over_replies() {
    let server = bind_tcp_with(&Faults::new(1).left_over(LeftOver::bytes(DONE))).await;
    let mut first = TcpStream::connect(server.local_addr()).await.unwrap();
    expect(&mut first, DONE).await;
    server.shutdown().await;
}

/// The first reply of station 1 has this delay and outlives its connection.
fn left_over(ms: u64) -> Faults {
    let late = Duration::from_millis(ms);
    Faults::new(1).rule(Rule::new(Fault::LeftOver { min: late, max: late }).station(1).times(1))
}

async fn assert_silent(client: &mut DuplexStream) {
    let read = time::timeout(Duration::from_secs(3600), client.read_u8()).await;
    assert!(read.is_err(), "{read:?}");
}
