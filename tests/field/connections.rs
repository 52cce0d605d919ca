//! Connections that fall mute, close, or are deaf at first; hosts that are switched off.

use std::future::pending;
use std::io;
use std::time::Duration;

use fatek::wire::Framing;
use fatek::{Error, Link, LinkState, register};
use tokio::io::DuplexStream;
use tokio::time::{Instant, sleep};

use crate::device::{Behaviour, Device};

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);

/// Reads once a second until a read succeeds.
async fn recovers_within(station: &fatek::Station, limit: Duration) -> Option<Duration> {
    let began = Instant::now();
    while began.elapsed() < limit {
        if station.read_registers(register!("R0"), 1).await.is_ok() {
            return Some(began.elapsed());
        }
        sleep(SECOND).await;
    }
    None
}

/// Before: the link stayed `Up` for 240 s, with one connection.
#[tokio::test(start_paused = true)]
async fn a_mute_connection_is_replaced() {
    let device = Device::new(Behaviour { mute: Some((1, 3)), ..Behaviour::default() });
    let link = device.link().build();
    let station = link.station(1).unwrap();
    station.read_registers(register!("R0"), 1).await.unwrap();
    station.read_registers(register!("R10"), 1).await.unwrap();
    let after = recovers_within(&station, 240 * SECOND).await;
    println!("mute: recovered after {after:?}, {} connections", device.accepted());
    assert!(after.is_some_and(|after| after < 15 * SECOND), "{after:?}");
    assert_eq!(device.accepted(), 2);
}

/// A device that stays mute is asked again at the pace of the back-off.
#[tokio::test(start_paused = true)]
async fn mute_connections_are_replaced_with_a_back_off() {
    let device = Device::new(Behaviour { deaf: 10_000 * SECOND, ..Behaviour::default() });
    let link = device.link().build();
    let station = link.station(1).unwrap();
    recovers_within(&station, 600 * SECOND).await;
    println!("always mute: {} connections in 600 s", device.accepted());
    assert!((5..60).contains(&device.accepted()), "{}", device.accepted());
}

#[tokio::test(start_paused = true)]
async fn one_dead_station_does_not_cost_the_connection() {
    let device = Device::new(Behaviour { plc_time: 5 * MS, ..Behaviour::default() });
    let link = device.link().build();
    let began = Instant::now();
    let live = [1, 3].map(|station| link.station(station).unwrap());
    let dead = link.station(2).unwrap();
    let asks = tokio::spawn(async move {
        loop {
            dead.read_registers(register!("R0"), 1).await.unwrap_err();
            sleep(100 * MS).await;
        }
    });
    while began.elapsed() < 300 * SECOND {
        for station in &live {
            station.read_registers(register!("R0"), 1).await.unwrap();
        }
        sleep(2 * SECOND).await;
    }
    asks.abort();
    assert_eq!(device.accepted(), 1);
}

/// Before: see the assertions' messages.
#[tokio::test(start_paused = true)]
async fn devices_that_close_after_each_reply_are_read_and_written() {
    for closes_after in [Duration::ZERO, 2 * MS, 50 * MS] {
        let device =
            Device::new(Behaviour { plc_time: 5 * MS, closes_after: Some(closes_after), ..Behaviour::default() });
        let link = device.link().build();
        let station = link.station(1).unwrap();
        let mut failed = Vec::new();
        for n in 0..20 {
            if let Err(error) = station.read_registers(register!("R0"), 1).await {
                failed.push(format!("read {n}: {error}"));
            }
            if let Err(error) = station.write_registers(register!("R0"), &[n]).await {
                failed.push(format!("write {n}: {error}, executed: {}", error.may_have_executed()));
            }
            sleep(100 * MS).await;
        }
        println!("closes after {closes_after:?}: {failed:?}");
        assert!(failed.is_empty(), "closes after {closes_after:?}: {failed:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn devices_that_are_deaf_at_first_are_read_and_written() {
    for deaf in [200 * MS, 500 * MS, 1000 * MS] {
        let device = Device::new(Behaviour { plc_time: 5 * MS, deaf, ..Behaviour::default() });
        for n in 0..10 {
            let link = device.link().build();
            let station = link.station(1).unwrap();
            let began = Instant::now();
            let written = station.write_registers(register!("R0"), &[n]).await;
            println!("deaf for {deaf:?}: write after {:?}: {written:?}", began.elapsed());
            assert!(written.is_ok(), "deaf for {deaf:?}: {written:?}");
            let link = device.link().build();
            assert_eq!(link.station(1).unwrap().read_registers(register!("R0"), 1).await.unwrap(), [n]);
        }
    }
}

/// Before: 3 of 4 calls reported that the station did not answer.
#[tokio::test(start_paused = true)]
async fn a_switched_off_host_is_a_connect_error() {
    for call_timeout in [500 * MS, SECOND, 2500 * MS, 3500 * MS, 10 * SECOND] {
        let never = || async { pending::<io::Result<DuplexStream>>().await };
        let link =
            Link::connector_builder("a switched-off PLC", Framing::Ascii, never).call_timeout(call_timeout).build();
        let station = link.station(1).unwrap();
        for n in 0..4 {
            let error = station.read_registers(register!("R0"), 1).await.unwrap_err();
            println!("{call_timeout:?}, call {n}: {error}");
            assert!(matches!(error, Error::Connect { .. }), "{call_timeout:?}, call {n}: {error:?}");
            assert!(!error.may_have_executed());
        }
        assert!(!matches!(link.state(), LinkState::Up));
    }
}
