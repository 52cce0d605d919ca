//! Scheduling: the order in which calls of many stations and callers are sent.

use std::time::Duration;

use fatek::wire::Framing;
use fatek::{CallOptions, Error, Link, register};
use tokio::io::duplex;
use tokio::time::{Instant, sleep};

mod peer;

use peer::{Peer, line, once, station};

#[tokio::test(start_paused = true)]
async fn control_goes_before_writes_and_writes_before_reads() {
    let (link, mut peer) = line();
    let station = station(&link);
    let mut calls = Vec::new();
    for code in [0x46, 0x46, 0x47, 0x41] {
        let station = station.clone();
        calls.push(tokio::spawn(async move {
            match code {
                0x46 => station.read_registers(register!("R0"), 1).await.map(drop),
                0x47 => station.write_registers(register!("R0"), &[1]).await,
                _ => station.run().await,
            }
        }));
        tokio::task::yield_now().await;
    }
    let mut order = Vec::new();
    for _ in 0..4 {
        let request = peer.request().await;
        order.push(request.command);
        peer.reply(1, request.command, if request.command == 0x46 { "00000" } else { "0" }).await;
    }
    assert_eq!(order, [0x46, 0x41, 0x47, 0x46], "the first read was in flight before the others came");
    for call in calls {
        call.await.unwrap().unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn other_stations_go_on_while_one_is_silent() {
    let (link, mut peer) = line();
    let began = Instant::now();
    let mut calls = Vec::new();
    for (number, reads) in [(1, 5), (2, 1)] {
        for _ in 0..reads {
            let station = link.station(number).unwrap();
            calls.push(tokio::spawn(async move {
                let result = station.read_registers(register!("R0"), 1).await;
                (number, result.is_ok(), began.elapsed())
            }));
            tokio::task::yield_now().await;
        }
    }
    let plc = tokio::spawn(async move {
        loop {
            let request = peer.request().await;
            if request.station == 2 {
                peer.reply(2, 0x46, "00002").await;
            }
        }
    });
    for call in calls {
        let (number, ok, after) = call.await.unwrap();
        if number == 2 {
            assert!(ok);
            assert!(after <= Duration::from_millis(1001), "waited {after:?}, more than one timeout");
        }
    }
    plc.abort();
}

#[tokio::test(start_paused = true)]
async fn every_call_ends_by_its_deadline() {
    let (link, peer) = line();
    let options = CallOptions::new().with_call_timeout(Duration::from_millis(2500)).with_retries(100);
    let began = Instant::now();
    let calls: Vec<_> = (0..20)
        .map(|number| {
            let station = link.station(number % 5 + 1).unwrap().with_options(options);
            tokio::spawn(async move {
                let error = station.read_status().await.unwrap_err();
                assert!(matches!(error, Error::Timeout { .. } | Error::Offline { .. }), "{error:?}");
            })
        })
        .collect();
    for call in calls {
        call.await.unwrap();
    }
    assert!(began.elapsed() <= Duration::from_millis(2510), "{:?}", began.elapsed());
    drop(peer);
}

#[tokio::test(start_paused = true)]
async fn a_dead_station_costs_the_others_one_timeout_at_a_time() {
    for offline_after in [3, 0] {
        let (client, plc) = duplex(4096);
        let link = Link::stream_builder(client, Framing::Ascii).offline_after(offline_after).build();
        tokio::spawn(answer_only(Peer::new(plc), 2));
        for _ in 0..3 {
            let dead = station(&link);
            tokio::spawn(async move {
                loop {
                    let _ = dead.read_status().await;
                    sleep(Duration::from_millis(10)).await;
                }
            });
        }
        let alive = link.station(2).unwrap();
        let end = Instant::now() + Duration::from_secs(60);
        let mut worst = Duration::ZERO;
        while Instant::now() < end {
            let began = Instant::now();
            alive.read_status().await.unwrap();
            worst = worst.max(began.elapsed());
            sleep(Duration::from_millis(10)).await;
        }
        assert!(worst <= Duration::from_millis(1001), "offline after {offline_after}: {worst:?}");
    }
}

async fn answer_only(mut peer: Peer, station: u8) {
    while let Some(request) = peer.any_request().await {
        if request.station == station {
            let data = String::from_utf8(request.data.to_vec()).unwrap();
            peer.reply(station, request.command, if request.command == 0x4E { &data } else { "0000000" }).await;
        }
    }
}

#[tokio::test(start_paused = true)]
async fn background_reads_give_way_and_are_not_starved() {
    let (link, mut peer) = line();
    let plc = station(&link);
    let polling = plc.with_options(CallOptions::new().with_background(true));
    let busy: Vec<_> = (0..4)
        .map(|_| {
            let plc = plc.clone();
            tokio::spawn(async move {
                loop {
                    plc.read_registers(register!("R0"), 1).await.unwrap();
                }
            })
        })
        .collect();
    tokio::spawn(async move {
        while let Some(request) = peer.request_if_any().await {
            sleep(Duration::from_millis(20)).await;
            peer.reply(1, request.command, if request.command == 0x46 { "00000" } else { "0000000" }).await;
        }
    });
    sleep(Duration::from_millis(100)).await;
    let began = Instant::now();
    polling.read_status().await.unwrap();
    let waited = began.elapsed();
    assert!(waited >= Duration::from_millis(500), "it did not give way: {waited:?}");
    assert!(waited <= Duration::from_secs(5), "it starved: {waited:?}");
    busy.iter().for_each(tokio::task::JoinHandle::abort);
}

#[tokio::test(start_paused = true)]
async fn a_full_queue_is_an_error_with_its_length() {
    let (client, plc) = duplex(4096);
    let link = Link::stream_builder(client, Framing::Ascii).queue_capacity(3).build();
    let calls: Vec<_> = (0..10)
        .map(|_| {
            let plc = station(&link);
            tokio::spawn(async move { plc.read_status().await })
        })
        .collect();
    sleep(Duration::from_millis(1)).await;
    tokio::spawn(Peer::new(plc).serve());
    let mut full = 0;
    for call in calls {
        if let Err(error) = call.await.unwrap() {
            assert_eq!(error.to_string(), "3 calls are waiting for station 1 already");
            assert!(!error.may_have_executed());
            full += 1;
        }
    }
    assert_eq!(full, 7, "all came before the first could be sent, so three are queued");
}

/// Answers after `takes`, as a healthy PLC, while `alive` holds for the station and the time since
/// the start.
fn serve_when(mut peer: Peer, takes: Duration, alive: impl Fn(u8, Duration) -> bool + Send + 'static) {
    let began = Instant::now();
    tokio::spawn(async move {
        while let Some(request) = peer.any_request().await {
            if !alive(request.station, began.elapsed()) {
                continue;
            }
            sleep(takes).await;
            let data = String::from_utf8(request.data.to_vec()).unwrap();
            peer.reply(request.station, request.command, if request.command == 0x4E { &data } else { "0000000" }).await;
        }
    });
}

#[tokio::test(start_paused = true)]
async fn a_station_with_a_longer_timeout_recovers_from_an_outage() {
    let (link, peer) = line();
    let outage = Duration::from_secs(10)..Duration::from_secs(40);
    serve_when(peer, Duration::from_secs(2), move |_, time| !outage.contains(&time));
    let options =
        CallOptions::new().with_response_timeout(Duration::from_secs(5)).with_call_timeout(Duration::from_secs(60));
    let slow = station(&link).with_options(options);
    slow.read_status().await.unwrap();
    sleep(Duration::from_secs(9)).await;
    assert!(slow.read_status().await.is_err());
    let back = Instant::now();
    while slow.read_status().await.is_err() {
        sleep(Duration::from_secs(1)).await;
        assert!(back.elapsed() < Duration::from_secs(120), "the station stays offline");
    }
}

#[tokio::test(start_paused = true)]
async fn a_lone_station_is_probed_at_the_configured_interval() {
    let (client, plc) = duplex(4096);
    let second = Duration::from_secs(1);
    let plc_side = Peer::new(plc);
    serve_when(plc_side, Duration::ZERO, |_, time| time > Duration::from_secs(60));
    let link = Link::stream_builder(client, Framing::Ascii).probe_interval(second, second).build();
    let plc = station(&link);
    let began = Instant::now();
    while let Err(error) = plc.read_status().await {
        if let Error::Offline { probe_in, .. } = error {
            assert!(probe_in <= 2 * second, "{probe_in:?}");
        }
        sleep(Duration::from_millis(100)).await;
    }
    assert!(began.elapsed() < Duration::from_secs(63), "{:?}", began.elapsed());
}

#[tokio::test(start_paused = true)]
async fn one_recovery_hastens_the_probes_of_other_stations() {
    let (link, peer) = line();
    let outage = Duration::from_secs(10)..Duration::from_secs(150);
    // Stations 1 to 10 stay dead, the others are dead for a while.
    serve_when(peer, Duration::from_millis(20), move |station, time| station > 10 && !outage.contains(&time));
    let calls: Vec<_> = (1..=31)
        .map(|number| {
            let plc = once(&link.station(number).unwrap());
            tokio::spawn(async move {
                let began = Instant::now();
                sleep(Duration::from_secs(150)).await;
                while plc.read_status().await.is_err() && began.elapsed() < Duration::from_secs(900) {
                    sleep(Duration::from_secs(1)).await;
                }
                (number, began.elapsed() - Duration::from_secs(150))
            })
        })
        .collect();
    // Calls keep the stations in use, so that their outage is noticed.
    for _ in 0..30 {
        for number in 1..=31 {
            let plc = once(&link.station(number).unwrap());
            tokio::spawn(async move { plc.read_status().await });
        }
        sleep(Duration::from_secs(5)).await;
    }
    for call in calls {
        let (number, after) = call.await.unwrap();
        // Ten timeouts of dead stations, a second each, and 19 times that for the other traffic.
        assert!(number <= 10 || after < Duration::from_secs(210), "station {number} is back after {after:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_short_deadline_does_not_close_the_connection() {
    // The deadline passes while the check, or the request, is being written.
    for checked in [false, true] {
        let (client, plc) = duplex(8); // less than a frame
        let link = Link::from_stream(client, Framing::Ascii);
        let mut plc_side = Peer::new(plc);
        if checked {
            let (plc, first) = (station(&link), async {
                assert_eq!(plc_side.request().await.command, 0x40);
                plc_side.reply(1, 0x40, "0000000").await;
            });
            tokio::join!(plc.read_status(), first).0.unwrap();
        }
        let short_deadline =
            station(&link).with_options(CallOptions::new().with_call_timeout(Duration::from_millis(5)));
        let error = short_deadline.read_registers(register!("R1"), 1).await.unwrap_err();
        assert!(matches!(error, Error::Timeout { sent, .. } if sent == checked), "{error:?}");
        let cut = plc_side.any_request().await.unwrap();
        assert_eq!(cut.command, if checked { 0x46 } else { 0x4E }, "the frame is written to its end");
        serve_when(plc_side, Duration::ZERO, |_, _| true);
        station(&link).read_status().await.unwrap();
        assert_eq!(link.stats().disconnects, 0);
    }
}
