//! Life cycle of a link: lost connections, offline stations, closing, runtimes that end.

use std::io;
use std::pin::pin;
use std::task::{Context, Waker};
use std::time::Duration;

use fatek::wire::Framing;
use fatek::{CallOptions, Error, Link, LinkBuilder, LinkState, StationState, register};
use futures::future::join3;
use tokio::io::{AsyncReadExt, DuplexStream, duplex};
use tokio::runtime::Builder;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::time::{Instant, sleep, timeout};

mod peer;

use peer::{Peer, line, once, station};

/// Creates a link whose connections come out of the channel. Attempts that `accepts` rejects fail.
fn reconnecting(
    mut accepts: impl FnMut(u32) -> bool + Send + 'static,
) -> (LinkBuilder, UnboundedReceiver<DuplexStream>) {
    let (ends, peers) = unbounded_channel();
    let mut attempts = 0;
    let builder = Link::connector_builder("a test", Framing::Ascii, move || {
        attempts += 1;
        let opened = if accepts(attempts) {
            let (client, plc) = duplex(4096);
            ends.send(plc).unwrap();
            Ok(client)
        } else {
            Err(io::Error::from(io::ErrorKind::ConnectionRefused))
        };
        async move { opened }
    });
    (builder, peers)
}

/// Before, with a channel made by its first watcher: the present state was no change, and a closed link
/// never showed that it is.
#[tokio::test(start_paused = true)]
async fn a_new_watcher_has_not_seen_the_present_state() {
    let (link, mut peer) = line();
    let station = station(&link);
    let call = tokio::spawn(async move { station.write_registers(register!("R0"), &[1]).await });
    peer.request().await;
    let mut watcher = link.watch_state();
    timeout(Duration::from_secs(60), watcher.changed()).await.expect("at once").expect("it is up");
    assert!(matches!(*watcher.borrow_and_update(), LinkState::Up), "{:?}", link.state());
    call.abort();
    link.close().await;
    let mut late = link.watch_state();
    late.changed().await.expect("it is closed");
    assert!(matches!(*late.borrow_and_update(), LinkState::Closed));
    assert!(late.changed().await.is_err(), "it does not change again");
}

#[tokio::test(start_paused = true)]
async fn a_lost_connection_fails_waiting_calls_at_once() {
    let (link, mut peer) = line();
    let station = station(&link);
    let began = Instant::now();
    let calls: Vec<_> = (0..3)
        .map(|_| {
            let station = station.clone();
            tokio::spawn(async move { station.write_registers(register!("R0"), &[1]).await })
        })
        .collect();
    peer.request().await;
    drop(peer);
    let mut sent = 0;
    for call in calls {
        let error = call.await.unwrap().unwrap_err();
        assert!(matches!(error, Error::Disconnected { .. }), "{error:?}");
        sent += u32::from(error.may_have_executed());
    }
    assert_eq!(sent, 1, "only the first had been sent");
    assert!(began.elapsed() < Duration::from_millis(1));
    assert!(matches!(station.read_status().await.unwrap_err(), Error::Closed { .. }));
}

#[tokio::test(start_paused = true)]
async fn closing_fails_queued_calls_and_finishes_the_one_in_flight() {
    let (link, mut peer) = line();
    let calls: Vec<_> = (0..2)
        .map(|_| {
            let station = station(&link);
            tokio::spawn(async move { station.read_registers(register!("R0"), 1).await })
        })
        .collect();
    peer.request().await;
    let closing = {
        let link = link.clone();
        tokio::spawn(async move { link.close().await })
    };
    sleep(Duration::from_millis(10)).await;
    peer.reply(1, 0x46, "00001").await;
    closing.await.unwrap();
    let mut results = Vec::new();
    for call in calls {
        results.push(call.await.unwrap());
    }
    assert_eq!(results[0].as_ref().unwrap(), &[1]);
    assert!(matches!(results[1], Err(Error::Closed { .. })));
    assert!(matches!(station(&link).read_status().await, Err(Error::Closed { .. })));
    assert_eq!(peer.stream.read(&mut [0; 1]).await.unwrap(), 0, "the connection is closed");
}

#[tokio::test(start_paused = true)]
async fn an_unused_link_can_be_closed() {
    let (link, _peer) = line();
    link.close().await;
    assert!(matches!(station(&link).read_status().await, Err(Error::Closed { .. })));
}

#[tokio::test(start_paused = true)]
async fn a_lost_connection_fails_only_the_write_in_flight() {
    let (builder, mut peers) = reconnecting(|_| true);
    let link = builder.build();
    let began = Instant::now();
    let calls: Vec<_> = (0..3)
        .map(|_| {
            let station = station(&link);
            tokio::spawn(async move { station.write_registers(register!("R0"), &[1]).await })
        })
        .collect();
    let mut first = Peer::new(peers.recv().await.unwrap());
    first.request().await;
    drop(first);
    let mut second = Peer::new(peers.recv().await.unwrap());
    let check = second.any_request().await.unwrap();
    assert_eq!((check.command, check.data.len()), (0x4E, 8), "the outcome of the first write is unknown");
    second.reply(1, 0x4E, std::str::from_utf8(&check.data).unwrap()).await;
    tokio::spawn(second.serve());
    let mut results = Vec::new();
    for call in calls {
        results.push(call.await.unwrap());
    }
    assert!(matches!(&results[0], Err(error @ Error::Disconnected { .. }) if error.may_have_executed()), "{results:?}");
    assert!(results[1..].iter().all(Result::is_ok), "{results:?}");
    assert!(began.elapsed() < Duration::from_millis(1), "no back-off after an answered check");
}

#[tokio::test(start_paused = true)]
async fn an_offline_station_recovers_after_a_lost_connection() {
    let (builder, mut peers) = reconnecting(|_| true);
    let link = builder.build();
    let plc = station(&link);
    let mut state = plc.watch_state();
    assert!(plc.read_status().await.is_err()); // three timeouts
    assert!(matches!(*state.borrow_and_update(), StationState::Offline { .. }));
    drop(peers.recv().await); // the PLC's power is cycled
    tokio::spawn(async move {
        while let Some(end) = peers.recv().await {
            tokio::spawn(Peer::new(end).serve());
        }
    });
    state.wait_for(|state| *state == StationState::Online).await.unwrap();
    assert!(plc.read_status().await.unwrap().flags().running());
    assert_eq!(link.stats().connects, 2);
}

#[tokio::test(start_paused = true)]
async fn connection_attempts_are_shared_and_back_off() {
    let (builder, mut peers) = reconnecting(|attempt| attempt > 6);
    let link = builder.build();
    let began = Instant::now();
    let calls: Vec<_> = (0..10)
        .map(|_| {
            let station = station(&link);
            tokio::spawn(async move { station.read_status().await })
        })
        .collect();
    tokio::spawn(Peer::new(peers.recv().await.unwrap()).serve());
    // 0.1 + 0.2 + 0.4 + 0.8 + 1.6 + 3.2 s, each reduced by a jitter of up to a half.
    let waited = began.elapsed();
    assert!(Duration::from_millis(3150) <= waited && waited <= Duration::from_millis(6310), "{waited:?}");
    for call in calls {
        call.await.unwrap().unwrap();
    }
    assert_eq!((link.stats().connect_failures, link.stats().connects), (6, 1));
}

#[tokio::test(start_paused = true)]
async fn with_fail_fast_a_failed_attempt_fails_all_waiting_calls() {
    let (builder, _peers) = reconnecting(|_| false);
    let link = builder.fail_fast(true).build();
    let began = Instant::now();
    let (first, second) = (station(&link), station(&link));
    let (first, second) = tokio::join!(first.read_status(), second.read_status());
    for error in [first.unwrap_err(), second.unwrap_err()] {
        assert!(matches!(error, Error::Connect { .. }), "{error:?}");
        assert!(!error.may_have_executed());
    }
    assert!(began.elapsed() < Duration::from_millis(1));
}

#[tokio::test(start_paused = true)]
async fn a_timeout_is_not_reported_as_a_later_disconnect() {
    let (builder, mut peers) = reconnecting(|attempt| attempt == 1);
    let plc = once(&station(&builder.build()));
    let (read, end) = tokio::join!(plc.read_registers(register!("R0"), 1), async {
        let mut end = Peer::new(peers.recv().await.unwrap());
        end.request().await;
        end
    });
    assert!(matches!(read, Err(Error::Timeout { sent: true, .. })), "{read:?}");
    // The station is suspect, so a check is sent. It is not answered, and the caller is polled only
    // later.
    let mut write = pin!(plc.write_registers(register!("R0"), &[1]));
    assert!(tokio::time::timeout(Duration::from_millis(1), &mut write).await.is_err());
    sleep(Duration::from_secs(2)).await;
    drop(end);
    sleep(Duration::from_millis(10)).await;
    assert!(matches!(plc.link().state(), LinkState::Down { .. }));
    let error = write.await.unwrap_err();
    assert!(matches!(error, Error::Timeout { sent: false, .. }), "{error:?}");
}

#[tokio::test(start_paused = true)]
async fn errors_of_a_sent_write_say_that_it_may_have_executed() {
    let options = CallOptions::new().with_retry_writes(true);

    // Sent, then the connection is lost and cannot be opened again.
    let (builder, mut peers) = reconnecting(|attempt| attempt == 1);
    let plc = station(&builder.fail_fast(true).options(options).build());
    let call = tokio::spawn(async move { plc.write_registers(register!("R0"), &[1]).await });
    let mut end = Peer::new(peers.recv().await.unwrap());
    end.request().await;
    drop(end);
    let error = call.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::Connect { .. }) && error.may_have_executed(), "{error:?}");

    // Sent, not answered, and the link is closed before it is sent again.
    let (link, mut end) = line();
    let plc = station(&link).with_options(options);
    let call = tokio::spawn(async move { plc.write_registers(register!("R0"), &[1]).await });
    end.request().await;
    assert_eq!(end.request().await.command, 0x4E);
    end.reply(1, 0x4E, "4").await; // refused, so a quiet time follows
    sleep(Duration::from_millis(10)).await;
    link.close().await;
    let error = call.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::Closed { .. }) && error.may_have_executed(), "{error:?}");

    // Sent, not answered, sent again, and refused.
    let (link, mut end) = line();
    let plc = station(&link).with_options(options);
    let call = tokio::spawn(async move { plc.write_registers(register!("R0"), &[1]).await });
    end.request().await;
    end.echo().await;
    end.request().await;
    end.reply(1, 0x47, "A").await;
    let error = call.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::Plc { .. }) && error.may_have_executed(), "{error:?}");
}

#[test]
fn a_write_in_flight_when_its_runtime_ends_is_in_doubt() {
    let runtime = || Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let (link_runtime, caller_runtime) = (runtime(), runtime());
    let (link, mut end) = line();
    let plc = station(&link);
    link_runtime.block_on(async {
        let call = {
            let plc = plc.clone();
            tokio::spawn(async move { plc.read_status().await })
        };
        end.request().await;
        end.reply(1, 0x40, "0000000").await;
        call.await.unwrap().unwrap();
    });
    let call = caller_runtime.spawn(async move { plc.write_registers(register!("R0"), &[1]).await });
    caller_runtime.block_on(end.request());
    link_runtime.shutdown_background();
    let error = caller_runtime.block_on(call).unwrap().unwrap_err();
    assert!(matches!(error, Error::Closed { .. }) && error.may_have_executed(), "{error:?}");
}

#[test]
fn a_first_call_without_a_runtime_fails_harmlessly() {
    let (link, end) = line();
    let plc = station(&link);
    {
        let mut call = pin!(plc.read_status());
        let poll = call.as_mut().poll(&mut Context::from_waker(Waker::noop()));
        assert!(poll.is_ready());
    }
    Builder::new_current_thread().enable_all().build().unwrap().block_on(async move {
        tokio::spawn(end.serve());
        plc.read_status().await.unwrap();
    });
}

#[tokio::test(start_paused = true)]
async fn no_request_is_sent_after_close() {
    let (link, mut end) = line();
    let plc = station(&link);
    let call = {
        let plc = plc.clone();
        tokio::spawn(async move { plc.read_status().await })
    };
    end.request().await;
    end.reply(1, 0x40, "0000000").await;
    call.await.unwrap().unwrap();
    let ((), written, request) =
        join3(link.close(), plc.write_registers(register!("R0"), &[1]), end.request_if_any()).await;
    assert!(matches!(written, Err(Error::Closed { sent: false, .. })), "{written:?}");
    assert_eq!(request, None);
}

#[tokio::test(start_paused = true)]
async fn closing_stops_retries() {
    let (link, mut end) = line();
    let plc = station(&link);
    let call = tokio::spawn(async move { plc.read_status().await });
    end.request().await;
    let began = Instant::now();
    let ((), after) = tokio::join!(link.close(), end.request_if_any());
    assert_eq!(after, None);
    assert!(began.elapsed() <= Duration::from_secs(1), "one response timeout, not three");
    assert!(call.await.unwrap().is_err());
}

#[tokio::test(start_paused = true)]
async fn close_returns_when_the_link_is_closed() {
    let (link, mut end) = line();
    let plc = once(&station(&link));
    tokio::spawn(async move { plc.read_status().await });
    end.request().await;
    let close = |after| {
        let link = link.clone();
        async move {
            sleep(Duration::from_millis(after)).await;
            link.close().await;
            assert!(matches!(link.state(), LinkState::Closed));
        }
    };
    tokio::join!(close(0), close(0), close(10), close(5000));

    let (unused, _end) = line();
    unused.close().await;
    assert!(matches!(unused.state(), LinkState::Closed));
}

/// Answers every connection as a healthy PLC.
fn serve_all(mut peers: UnboundedReceiver<DuplexStream>) {
    tokio::spawn(async move {
        while let Some(end) = peers.recv().await {
            tokio::spawn(Peer::new(end).serve());
        }
    });
}

const MINUTE: Duration = Duration::from_secs(60);

#[tokio::test(start_paused = true)]
async fn an_unused_link_becomes_idle_and_the_next_call_reopens_it() {
    let (builder, mut peers) = reconnecting(|_| true);
    let link = builder.idle_timeout(MINUTE).build();
    let plc = station(&link);
    let (first, end) = tokio::join!(plc.read_status(), async {
        let mut end = Peer::new(peers.recv().await.unwrap());
        end.request().await;
        end.reply(1, 0x40, "0010000").await;
        end
    });
    first.unwrap();
    let (mut end, used_at) = (end, Instant::now());
    assert_eq!(end.request_if_any().await, None, "the connection is closed");
    let idle = used_at.elapsed();
    assert!(MINUTE <= idle && idle <= MINUTE + Duration::from_millis(2), "{idle:?}");
    assert!(matches!(link.state(), LinkState::Idle));

    serve_all(peers);
    let began = Instant::now();
    plc.read_status().await.unwrap();
    assert!(began.elapsed() < Duration::from_millis(1), "no back-off");
    assert!(matches!(link.state(), LinkState::Up));
    let stats = link.stats();
    assert_eq!(
        (stats.connects, stats.idle_closes, stats.disconnects, stats.stations.checks),
        (2, 1, 0, 2),
        "one check per connection"
    );
}

#[tokio::test(start_paused = true)]
async fn a_link_in_use_does_not_become_idle() {
    let (builder, peers) = reconnecting(|_| true);
    serve_all(peers);
    let link = builder.idle_timeout(MINUTE).build();
    for _ in 0..5 {
        station(&link).read_status().await.unwrap();
        sleep(MINUTE - Duration::from_millis(10)).await;
    }
    assert_eq!(link.stats().connects, 1);
    sleep(MINUTE).await;
    assert_eq!(link.stats().idle_closes, 1);
}

#[tokio::test(start_paused = true)]
async fn a_call_longer_than_the_idle_timeout_is_completed() {
    let (builder, mut peers) = reconnecting(|_| true);
    let short = Duration::from_millis(10);
    let link = builder.idle_timeout(short).retries(0).build();
    let plc = station(&link);
    let call = tokio::spawn(async move {
        let failed = plc.read_status().await;
        (failed, plc.read_status().await)
    });
    let mut end = Peer::new(peers.recv().await.unwrap());
    end.request().await;
    sleep(Duration::from_millis(900)).await;
    end.reply(1, 0x40, "0010000").await;
    assert_eq!(end.request().await.command, 0x40, "the next call is over the same connection");
    // A response time just below the quiet time.
    sleep(Duration::from_millis(990)).await;
    end.reply(1, 0x40, "0010000").await;
    let (first, second) = call.await.unwrap();
    assert!(first.is_ok() && second.is_ok());
    assert_eq!(end.request_if_any().await, None);
}

#[tokio::test(start_paused = true)]
async fn a_quiet_time_does_not_count_as_idle() {
    let (builder, mut peers) = reconnecting(|_| true);
    let link = builder.idle_timeout(Duration::from_millis(10)).retries(1).build();
    let plc = station(&link);
    let call = tokio::spawn(async move { plc.read_status().await });
    let mut end = Peer::new(peers.recv().await.unwrap());
    end.request().await; // not answered
    assert_eq!(end.request().await.command, 0x4E);
    end.reply(1, 0x4E, "4").await; // refused, so a quiet time follows
    assert_eq!(end.request().await.command, 0x40, "over the same connection");
    end.reply(1, 0x40, "0010000").await;
    call.await.unwrap().unwrap();
}

#[tokio::test(start_paused = true)]
async fn an_idle_link_sends_no_probes_and_forgets_offline_stations() {
    let (builder, mut peers) = reconnecting(|_| true);
    let link = builder.idle_timeout(MINUTE).mute_timeout(None).build();
    let plc = station(&link);
    assert!(plc.read_status().await.is_err()); // three timeouts
    assert!(matches!(*plc.watch_state().borrow(), StationState::Offline { .. }));
    let _silent = peers.recv().await.unwrap();
    sleep(MINUTE + Duration::from_secs(1)).await;
    assert!(matches!(link.state(), LinkState::Idle));
    assert_eq!(*plc.watch_state().borrow(), StationState::Unknown);
    let checks = link.stats().stations.checks;
    sleep(100 * MINUTE).await;
    assert_eq!((link.stats().connects, link.stats().stations.checks), (1, checks));

    serve_all(peers);
    plc.read_status().await.unwrap();
    assert_eq!(link.stats().stations.checks, checks + 1, "the station is still suspect");
}

#[tokio::test(start_paused = true)]
async fn a_link_without_calls_stops_connecting() {
    let (builder, _peers) = reconnecting(|_| false);
    let link = builder.idle_timeout(MINUTE).build();
    assert!(matches!(station(&link).read_status().await, Err(Error::Connect { .. })));
    sleep(100 * MINUTE).await;
    let failures = link.stats().connect_failures;
    sleep(100 * MINUTE).await;
    assert_eq!(link.stats().connect_failures, failures);
}

#[tokio::test(start_paused = true)]
async fn a_stream_without_connector_is_not_closed_when_idle() {
    let (client, end) = duplex(4096);
    tokio::spawn(Peer::new(end).serve());
    let link = Link::stream_builder(client, Framing::Ascii).idle_timeout(Duration::from_secs(1)).build();
    station(&link).read_status().await.unwrap();
    sleep(MINUTE).await;
    station(&link).read_status().await.unwrap();
}
