//! Clients that are slow, silent or hostile: they are sent away, and the others do not notice.

use std::time::Duration;

use fatek::command::{ReadRegisters, Request};
use fatek::register;
use fatek::sim::{Faults, Line};
use fatek::wire::{Framing, Side};
use tokio::time::{Instant, sleep, timeout};

use crate::bench::{Bench, LIMITS, OPEN, PATIENCE, word};
use crate::common::{FRAMINGS, Rng, framed};
use crate::server::{DisconnectReason, MAX_NOISE};

/// How long a good client takes for a hundred reads.
async fn a_hundred_reads(bench: &Bench) -> Duration {
    let mut client = bench.client(Framing::Ascii);
    let began = Instant::now();
    for n in 0..100 {
        let station = 1 + n % 8;
        let values = client.ask(station, &ReadRegisters::new(register!("D0"), 4).unwrap()).await.unwrap();
        assert_eq!(values, [0, 1, 2, 3].map(|n| word(station, n)));
    }
    began.elapsed()
}

fn slow_bus() -> Bench {
    let line = Line::new(19_200).response_time(Duration::from_millis(2), Duration::from_millis(2));
    Bench::with_faults(Framing::Ascii, OPEN, Faults::new(0).line(line), PATIENCE)
}

#[tokio::test(start_paused = true)]
async fn clients_that_ask_nothing_cost_the_others_nothing() {
    let alone = a_hundred_reads(&slow_bus()).await;
    assert!(alone > Duration::from_secs(1), "the line takes its time: {alone:?}");

    let bench = slow_bus();
    let mut others = Vec::new();
    for n in 0..60_u64 {
        let (mut client, serving) = bench.client_with(FRAMINGS[n as usize % 2], 256);
        others.push(serving);
        tokio::spawn(async move {
            let mut dice = Rng::new(n);
            match n % 3 {
                // Nothing at all.
                0 => sleep(Duration::MAX).await,
                // Half a request, and then nothing.
                1 => {
                    client.send(&framed(FRAMINGS[n as usize % 2], Side::Client, 1, 0x46, b"04D00000")[..7]).await;
                    sleep(Duration::MAX).await;
                }
                // Garbage, as slow as can be; a frame may even begin in it.
                _ => loop {
                    client.send(&[dice.next() as u8]).await;
                    sleep(Duration::from_millis(1)).await;
                },
            }
        });
    }
    let among_others = a_hundred_reads(&bench).await;
    assert!(among_others.abs_diff(alone) <= Duration::from_millis(100), "{among_others:?}, alone {alone:?}");
    drop(others);
}

#[tokio::test(start_paused = true)]
async fn a_client_that_sends_garbage_for_ever_is_sent_away_in_both_framings() {
    for (seed, begin) in [(1, &b"\x02"[..]), (2, b"\x51"), (3, b"\x51\x10\x02\x00"), (4, b"")] {
        let bench = Bench::new(Framing::Ascii, OPEN);
        let (mut client, serving) = bench.client_with(Framing::Ascii, 4096);
        client.send(begin).await;
        let flood = tokio::spawn(async move {
            let mut dice = Rng::new(seed);
            let mut sent = 0;
            while !serving.is_finished() {
                let noise: Vec<u8> = (0..512).map(|_| dice.next() as u8).collect();
                // The other end goes in the middle of it.
                let _ = timeout(Duration::from_secs(1), client.try_send(&noise)).await;
                sent += noise.len();
                assert!(sent < 4 * MAX_NOISE, "seed {seed}: it goes on and on");
            }
            assert_eq!(serving.await.unwrap().unwrap(), DisconnectReason::Noise, "seed {seed}");
            sent
        });
        assert!(flood.await.unwrap() > MAX_NOISE);
        assert_eq!(bench.faults.log().arrivals(), 0, "none of it was a request");
    }
}

#[tokio::test(start_paused = true)]
async fn a_client_that_is_silent_is_sent_away_and_one_that_asks_now_and_then_is_not() {
    let bench = Bench::new(Framing::Ascii, OPEN);
    let (mut silent, silence) = bench.client_with(Framing::Ascii, 4096);
    let (mut seldom, seldom_served) = bench.client_with(Framing::Binary, 4096);
    let began = Instant::now();
    let read = ReadRegisters::new(register!("D0"), 1).unwrap();
    for _ in 0..10 {
        sleep(LIMITS.idle * 9 / 10).await;
        assert_eq!(seldom.ask(1, &read).await.unwrap(), [word(1, 0)]);
    }
    assert!(silent.is_closed().await);
    assert_eq!(silence.await.unwrap().unwrap(), DisconnectReason::Idle);
    assert!(began.elapsed() > LIMITS.idle && !seldom_served.is_finished());
    // A byte now and then is no request.
    let (mut dribbling, served) = bench.client_with(Framing::Ascii, 4096);
    while !served.is_finished() {
        let _ = dribbling.try_send(b"\x02").await;
        sleep(LIMITS.idle / 7).await;
    }
    assert_eq!(served.await.unwrap().unwrap(), DisconnectReason::Idle);
}

#[tokio::test(start_paused = true)]
async fn a_client_that_does_not_take_its_replies_is_sent_away_and_stops_asking_until_then() {
    let bench = Bench::new(Framing::Ascii, OPEN);
    // A reply of 64 registers is more than the connection holds.
    let (mut client, served) = bench.client_with(Framing::Ascii, 200);
    let flood = tokio::spawn(async move {
        let request = framed(Framing::Ascii, Side::Client, 1, 0x46, b"40D00000");
        while client.try_send(&request).await {}
    });
    sleep(LIMITS.idle / 2).await;
    // The check of the new connection, and the read.
    assert_eq!(bench.faults.log().arrivals(), 2, "nothing more is asked for one who does not listen");
    assert_eq!(a_hundred_reads(&bench).await, Duration::ZERO);
    assert_eq!(served.await.unwrap().unwrap(), DisconnectReason::NotReading);
    flood.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_client_that_hangs_up_in_the_middle_of_it_all_harms_nobody() {
    let bench = slow_bus();
    for _ in 0..20 {
        let (mut client, served) = bench.client_with(Framing::Ascii, 4096);
        client.send(&framed(Framing::Ascii, Side::Client, 1, 0x46, b"02D00000")).await;
        tokio::task::yield_now().await;
        drop(client);
        drop(served);
    }
    a_hundred_reads(&bench).await;
    let read = Request::ReadRegisters(ReadRegisters::new(register!("D0"), 2).unwrap());
    assert!(bench.faults.log().entries().iter().filter(|entry| entry.request() == Some(&read)).count() <= 20);
}

#[tokio::test(start_paused = true)]
async fn a_client_with_half_a_frame_is_understood_again_after_a_pause() {
    let bench = Bench::new(Framing::Binary, OPEN);
    let mut client = bench.client(Framing::Binary);
    // It says that 512 bytes follow.
    client.send(b"\x51\x10\x02\x00").await;
    sleep(Duration::from_secs(2)).await;
    let values = client.ask(1, &ReadRegisters::new(register!("D7"), 1).unwrap()).await.unwrap();
    assert_eq!(values, [word(1, 7)]);
}

#[tokio::test(start_paused = true)]
async fn every_client_is_told_when_the_gateway_stops() {
    let bench = Bench::new(Framing::Ascii, OPEN);
    let (_first, first_served) = bench.client_with(Framing::Ascii, 4096);
    let (mut second, second_served) = bench.client_with(Framing::Binary, 4096);
    second.ask(1, &ReadRegisters::new(register!("D7"), 1).unwrap()).await.unwrap();
    let proxy = bench.stop();
    assert_eq!(first_served.await.unwrap().unwrap(), DisconnectReason::Stopped);
    assert_eq!(second_served.await.unwrap().unwrap(), DisconnectReason::Stopped);
    assert_eq!(proxy.counts().done, 1);
}
