//! Slow, silent and hostile clients: they are disconnected, without effect on the others.

use std::time::Duration;

use fatek::command::{ReadRegisters, Request};
use fatek::register;
use fatek::sim::{Faults, Line};
use fatek::wire::{Framing, Side};
use tokio::time::{Instant, sleep, timeout};

use crate::bench::{Bench, CALL_TIMEOUT, LIMITS, UNRESTRICTED, word};
use crate::common::{FRAMINGS, Rng, framed};
use crate::server::{DisconnectReason, MAX_NOISE};

/// Time that a good client takes for a hundred reads.
async fn a_hundred_reads(bench: &Bench) -> Duration {
    let mut client = bench.client(Framing::Ascii);
    let began = Instant::now();
    for n in 0..100 {
        let station = 1 + n % 8;
        let values = client.call(station, &ReadRegisters::new(register!("D0"), 4).unwrap()).await.unwrap();
        assert_eq!(values, [0, 1, 2, 3].map(|n| word(station, n)));
    }
    began.elapsed()
}

fn slow_bus() -> Bench {
    let line = Line::new(19_200).response_time(Duration::from_millis(2), Duration::from_millis(2));
    Bench::with_faults(Framing::Ascii, UNRESTRICTED, Faults::new(0).line(line), CALL_TIMEOUT)
}

#[tokio::test(start_paused = true)]
async fn clients_without_requests_do_not_delay_others() {
    let alone = a_hundred_reads(&slow_bus()).await;
    assert!(alone > Duration::from_secs(1), "the line takes its time: {alone:?}");

    let bench = slow_bus();
    let mut others = Vec::new();
    for n in 0..60_u64 {
        let (mut client, serving) = bench.client_with(FRAMINGS[n as usize % 2], 256);
        others.push(serving);
        tokio::spawn(async move {
            let mut rng = Rng(n);
            match n % 3 {
                // Sends nothing.
                0 => sleep(Duration::MAX).await,
                // Sends half a request.
                1 => {
                    client.send(&framed(FRAMINGS[n as usize % 2], Side::Client, 1, 0x46, b"04D00000")[..7]).await;
                    sleep(Duration::MAX).await;
                }
                // Sends slow garbage, in which a frame may begin.
                _ => loop {
                    client.send(&[rng.next() as u8]).await;
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
async fn a_client_that_sends_endless_garbage_is_disconnected() {
    for (seed, begin) in [(1, &b"\x02"[..]), (2, b"\x51"), (3, b"\x51\x10\x02\x00"), (4, b"")] {
        let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
        let (mut client, serving) = bench.client_with(Framing::Ascii, 4096);
        client.send(begin).await;
        let flood = tokio::spawn(async move {
            let mut rng = Rng(seed);
            let mut sent = 0;
            while !serving.is_finished() {
                let noise: Vec<u8> = (0..512).map(|_| rng.next() as u8).collect();
                // The gateway may disconnect during the write.
                let _ = timeout(Duration::from_secs(1), client.try_send(&noise)).await;
                sent += noise.len();
                assert!(sent < 4 * MAX_NOISE, "seed {seed}: the client is not disconnected");
            }
            assert_eq!(serving.await.unwrap().unwrap(), DisconnectReason::Noise, "seed {seed}");
            sent
        });
        assert!(flood.await.unwrap() > MAX_NOISE);
        assert_eq!(bench.faults.log().arrivals(), 0, "garbage is no request");
    }
}

#[tokio::test(start_paused = true)]
async fn only_an_idle_client_is_disconnected() {
    let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
    let (mut silent, silence) = bench.client_with(Framing::Ascii, 4096);
    let (mut occasional, occasional_served) = bench.client_with(Framing::Binary, 4096);
    let began = Instant::now();
    let read = ReadRegisters::new(register!("D0"), 1).unwrap();
    for _ in 0..10 {
        sleep(LIMITS.idle * 9 / 10).await;
        assert_eq!(occasional.call(1, &read).await.unwrap(), [word(1, 0)]);
    }
    assert!(silent.is_closed().await);
    assert_eq!(silence.await.unwrap().unwrap(), DisconnectReason::Idle);
    assert!(began.elapsed() > LIMITS.idle && !occasional_served.is_finished());
    // Single bytes are no requests.
    let (mut slow, served) = bench.client_with(Framing::Ascii, 4096);
    while !served.is_finished() {
        let _ = slow.try_send(b"\x02").await;
        sleep(LIMITS.idle / 7).await;
    }
    assert_eq!(served.await.unwrap().unwrap(), DisconnectReason::Idle);
}

#[tokio::test(start_paused = true)]
async fn a_client_that_does_not_read_replies_is_disconnected() {
    let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
    // The reply of 64 registers is longer than the connection's buffer.
    let (mut client, served) = bench.client_with(Framing::Ascii, 200);
    let flood = tokio::spawn(async move {
        let request = framed(Framing::Ascii, Side::Client, 1, 0x46, b"40D00000");
        while client.try_send(&request).await {}
    });
    sleep(LIMITS.idle / 2).await;
    // The check of the new connection, and the read.
    assert_eq!(bench.faults.log().arrivals(), 2, "no more requests for a client that does not read");
    assert_eq!(a_hundred_reads(&bench).await, Duration::ZERO);
    assert_eq!(served.await.unwrap().unwrap(), DisconnectReason::NotReading);
    flood.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_client_that_hangs_up_does_not_disturb_others() {
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
async fn a_partial_frame_is_dropped_after_a_pause() {
    let bench = Bench::new(Framing::Binary, UNRESTRICTED);
    let mut client = bench.client(Framing::Binary);
    // The header promises 512 bytes.
    client.send(b"\x51\x10\x02\x00").await;
    sleep(Duration::from_secs(2)).await;
    let values = client.call(1, &ReadRegisters::new(register!("D7"), 1).unwrap()).await.unwrap();
    assert_eq!(values, [word(1, 7)]);
}

#[tokio::test(start_paused = true)]
async fn stopping_the_gateway_disconnects_every_client() {
    let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
    let (_first, first_served) = bench.client_with(Framing::Ascii, 4096);
    let (mut second, second_served) = bench.client_with(Framing::Binary, 4096);
    second.call(1, &ReadRegisters::new(register!("D7"), 1).unwrap()).await.unwrap();
    let proxy = bench.stop();
    assert_eq!(first_served.await.unwrap().unwrap(), DisconnectReason::Stopped);
    assert_eq!(second_served.await.unwrap().unwrap(), DisconnectReason::Stopped);
    assert_eq!(proxy.counts().done, 1);
}
