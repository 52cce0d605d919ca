//! Who is served when: many stations and many callers on one line.

use std::time::Duration;

use fatek::wire::Framing;
use fatek::{CallOptions, EchoMode, Error, Link, Station, register};
use tokio::io::duplex;
use tokio::time::{Instant, sleep};

mod peer;

use peer::{Peer, line, station};

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
    assert_eq!(order, [0x46, 0x41, 0x47, 0x46], "the first was on its way before the others came");
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
            assert!(after <= Duration::from_millis(1001), "it waited {after:?}, more than one timeout");
        }
    }
    plc.abort();
}

#[tokio::test(start_paused = true)]
async fn every_call_ends_by_its_deadline() {
    let (link, peer) = line();
    let options = CallOptions::new().call_timeout(Duration::from_millis(2500)).retries(100);
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
    while let Some(request) = peer.request_if_any().await {
        if request.station == station {
            peer.reply(station, request.command, "0000000").await;
        }
    }
}

#[tokio::test(start_paused = true)]
async fn background_reads_give_way_and_are_not_starved() {
    let (link, mut peer) = line();
    let plc = station(&link);
    let polling = plc.with_options(CallOptions::new().background(true));
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
    assert!(waited >= Duration::from_millis(500), "it gave way: {waited:?}");
    assert!(waited <= Duration::from_secs(5), "but not for ever: {waited:?}");
    busy.iter().for_each(tokio::task::JoinHandle::abort);
}

#[tokio::test(start_paused = true)]
async fn a_full_queue_is_an_error_that_names_its_length() {
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
    assert_eq!(full, 7, "all came before the first could be sent, so three wait");
}

/// A line that echoes, or not, with a PLC behind it; counts the requests that it hears.
async fn echoing(mut peer: Peer, echo: bool, stopped: tokio::sync::mpsc::UnboundedSender<String>) {
    while let Some(request) = peer.request_if_any().await {
        let data = String::from_utf8(request.data.to_vec()).unwrap();
        let _ = stopped.send(format!("{:02X}{data}", request.command));
        if echo {
            peer.reply(request.station, request.command, &data).await;
        }
        match request.command {
            0x40 => peer.reply(1, 0x40, "0000000").await,
            0x41 => peer.reply(1, 0x41, "0").await,
            0x46 => peer.reply(1, 0x46, "00007").await,
            _ => peer.reply(1, request.command, &data).await,
        }
    }
}

async fn with_echo(mode: EchoMode, echo: bool) -> (Station, tokio::sync::mpsc::UnboundedReceiver<String>) {
    let (client, plc) = duplex(4096);
    let (requests, heard) = tokio::sync::mpsc::unbounded_channel();
    tokio::spawn(echoing(Peer::new(plc), echo, requests));
    (station(&Link::stream_builder(client, Framing::Ascii).echo(mode).build()), heard)
}

#[tokio::test(start_paused = true)]
async fn an_echo_is_never_taken_for_the_reply() {
    for (mode, echo) in [(EchoMode::Auto, true), (EchoMode::Auto, false), (EchoMode::On, true), (EchoMode::Off, false)]
    {
        let (plc, mut heard) = with_echo(mode, echo).await;
        plc.stop().await.unwrap();
        plc.loop_back("ABC").await.unwrap();
        assert_eq!(plc.read_registers(register!("R0"), 1).await.unwrap(), [7]);
        let mut requests = Vec::new();
        while let Ok(request) = heard.try_recv() {
            requests.push(request);
        }
        let expected = ["40", "410", "4EABC", "4601R00000"];
        let expected = if mode == EchoMode::Auto { &expected[..] } else { &expected[1..] };
        assert_eq!(requests, expected, "{mode:?} {echo}: learned once, with a status request");
        assert_eq!(plc.link().stats().echoes, if echo { requests.len() as u64 } else { 0 });
    }
}

#[tokio::test(start_paused = true)]
async fn on_a_line_that_echoes_a_dead_plc_is_dead() {
    for mode in [EchoMode::Auto, EchoMode::On] {
        let (link, mut peer) = {
            let (client, plc) = duplex(4096);
            (Link::stream_builder(client, Framing::Ascii).echo(mode).build(), Peer::new(plc))
        };
        tokio::spawn(async move {
            while let Some(request) = peer.request_if_any().await {
                let data = String::from_utf8(request.data.to_vec()).unwrap();
                peer.reply(request.station, request.command, &data).await;
            }
        });
        let plc = station(&link);
        for result in [plc.stop().await, plc.loop_back("ABC").await] {
            assert!(matches!(result, Err(Error::Timeout { .. } | Error::Offline { .. })), "{mode:?}: {result:?}");
        }
        assert!(plc.stats().replies == 0, "{mode:?}");
    }
}
