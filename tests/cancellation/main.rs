//! Cancel safety: a call may be dropped at any point.
//!
//! A request that was not sent is never sent, a request that was sent is executed once, and the
//! next caller gets its own reply.
//!
//! Each test cancels every method after every number of polls, until the method completes. Between
//! two polls one other task runs once, or a millisecond passes.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

mod bench;
mod elements;
mod methods;

use std::collections::BTreeSet;
use std::time::Duration;

use fatek::command::{ReadRegisters, Request};
use fatek::wire::Framing;
use fatek::{Error, LinkState};
use tokio::task::JoinHandle;
use tokio::time::sleep;

use self::bench::{Bench, Counters, Obstacle, Stage, cancel_after, close_call, in_two_pieces, paused, poll_once, tick};
use self::elements::{d, word, words};
use self::methods::{Method, MethodKind, broadcasts, reads, writes};

/// Time until the first request is in flight: the connection is open, and the check answered in two
/// pieces.
const ON_THE_WIRE: Duration = Duration::from_millis(6);

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

#[test]
fn every_async_method_is_covered() {
    let async_methods = |source: &str| -> BTreeSet<String> {
        let names = source.lines().filter_map(|line| line.trim_start().strip_prefix("pub async fn "));
        names.map(|line| line.split(['(', '<']).next().unwrap().to_owned()).collect()
    };
    let names = |methods: Vec<Method>| methods.iter().map(|method| method.name.to_owned()).collect::<BTreeSet<_>>();
    let of_station = [include_str!("../../src/station.rs"), include_str!("../../src/station/handle.rs")].concat();
    assert_eq!(async_methods(&of_station), names(reads().into_iter().chain(writes()).collect()));
    assert_eq!(async_methods(include_str!("../../src/station/broadcast.rs")), names(broadcasts()));
    assert_eq!(async_methods(include_str!("../../src/link/mod.rs")), ["close".to_owned()].into());
}

#[test]
fn calls_are_cancel_safe_while_the_connection_opens() {
    cancel_at_every_point(Obstacle::Opening, &[Stage::Queued, Stage::Connecting]);
}

#[test]
fn calls_are_cancel_safe_behind_another_call() {
    cancel_at_every_point(Obstacle::Busy, &[Stage::Queued]);
}

#[test]
fn calls_are_cancel_safe_in_a_long_queue() {
    cancel_at_every_point(Obstacle::Crowded, &[Stage::Queued]);
}

#[test]
fn calls_are_cancel_safe_around_a_check() {
    cancel_at_every_point(Obstacle::SuspectStation, &[Stage::Checked]);
}

#[test]
fn calls_are_cancel_safe_between_retries() {
    cancel_at_every_point(Obstacle::Unanswered, &[]);
}

#[test]
fn a_cancelled_close_still_closes_the_link() {
    paused(async {
        for framing in FRAMINGS {
            for polls in 0.. {
                let bench = Bench::new(framing);
                let in_flight = bench.read(1, 100);
                sleep(ON_THE_WIRE).await;
                let queued = bench.read(1, 200);
                tick().await;
                let ended = cancel_after(close_call(&bench.link), polls).await.is_some();
                let next = bench.station().read_registers(d(500), 3).await;
                assert_eq!(in_flight.await.unwrap().unwrap(), words(100));
                if polls == 0 {
                    assert_eq!(queued.await.unwrap().unwrap(), words(200));
                    assert_eq!(next.unwrap(), words(500));
                    continue;
                }
                for result in [queued.await.unwrap(), next] {
                    assert!(matches!(result, Err(Error::Closed { sent: false, .. })), "cut {polls}: {result:?}");
                }
                bench.link.close().await;
                assert!(matches!(bench.link.state(), LinkState::Closed));
                assert_eq!(bench.log_of(&Request::ReadRegisters(ReadRegisters::new(d(200), 3).unwrap())).len(), 0);
                if ended {
                    assert!(polls > 10, "{polls}");
                    break;
                }
            }
        }
    });
}

#[test]
fn a_second_close_is_cancel_safe() {
    paused(async {
        for polls in 0.. {
            let bench = Bench::new(Framing::Ascii);
            let in_flight = bench.read(1, 100);
            sleep(ON_THE_WIRE).await;
            let mut first = close_call(&bench.link);
            assert!(poll_once(&mut first).await.is_pending());
            let ended = cancel_after(close_call(&bench.link), polls).await.is_some();
            first.await.unwrap();
            assert_eq!(in_flight.await.unwrap().unwrap(), words(100));
            assert!(matches!(bench.link.state(), LinkState::Closed));
            if ended {
                assert!(polls > 10, "{polls}");
                break;
            }
        }
    });
}

/// Cancels every method at every point. Each must pass at least these stages, and the later ones.
fn cancel_at_every_point(obstacle: Obstacle, stages: &[Stage]) {
    paused(async {
        let mut cuts = 0;
        for framing in FRAMINGS {
            let methods = reads().into_iter().chain(writes()).chain(broadcasts());
            for method in methods.filter(|method| framing == Framing::Ascii || !method.name.contains("program_page")) {
                let mut seen = BTreeSet::new();
                let mut polls = 0;
                while let Some(stage) = cancel_and_continue(obstacle, framing, &method, polls).await {
                    seen.insert(stage);
                    polls += 1;
                }
                cuts += polls;
                let mut expected = BTreeSet::from_iter(stages.iter().copied());
                match (method.kind, obstacle) {
                    // It ends when it is sent, and without a check.
                    (MethodKind::Broadcast, _) => expected.retain(|&stage| stage < Stage::Checked),
                    (MethodKind::Write, Obstacle::Unanswered) => expected.extend([Stage::Sent, Stage::Executed]),
                    (MethodKind::Read, Obstacle::Unanswered) => {
                        expected.extend([Stage::Sent, Stage::Executed, Stage::Checked, Stage::Replied]);
                    }
                    _ => expected.extend([Stage::Sent, Stage::Executed, Stage::Replied]),
                }
                assert!(expected.is_subset(&seen), "{obstacle:?}, {framing}, {}: only {seen:?}", method.name);
                let at_least = match (method.kind, obstacle) {
                    // Nothing is in flight, so the first poll sends it.
                    (MethodKind::Broadcast, Obstacle::SuspectStation | Obstacle::Unanswered) => 0,
                    (MethodKind::Broadcast, _) => 2,
                    _ => 10,
                };
                assert!(polls > at_least, "{obstacle:?}, {framing}, {}: {polls}", method.name);
            }
        }
        println!("{obstacle:?}: {cuts} cuts");
    });
}

/// Cancels a call after this number of polls, and checks later calls. Returns the stage of the
/// call; `None` if it had completed.
async fn cancel_and_continue(obstacle: Obstacle, framing: Framing, method: &Method, polls: u32) -> Option<Stage> {
    let at = format!("{obstacle:?}, {framing}, {} after {polls}", method.name);
    let bench = Bench::new(framing);
    let earlier = bench.set_up(obstacle).await;
    let before = bench.counters();
    let ended = cancel_after((method.call)(&bench.link, 1), polls).await;
    let after = bench.counters();
    let stage = if polls == 0 { Stage::Unpolled } else { bench.stage(&(method.request)(1), before, after) };
    match &ended {
        None => {}
        // Sent, but never answered.
        Some(Err(error)) if obstacle == Obstacle::Unanswered && method.kind == MethodKind::Write => {
            assert!(matches!(error, Error::Timeout { .. }) && error.may_have_executed(), "{at}: {error:?}");
        }
        Some(result) => assert_eq!(result.as_deref().unwrap(), (method.reply)(1), "{at}"),
    }

    // A late reply to the dropped call must not disturb the next calls.
    bench.faults.set_rules([in_two_pieces()]);
    bench.plcs[0].set_battery_low(true);
    if obstacle == Obstacle::Crowded {
        earlier.iter().for_each(JoinHandle::abort);
    }
    assert_eq!((method.call)(&bench.link, 2).await.unwrap(), (method.reply)(2), "{at}");
    assert_eq!(bench.station().read_registers(d(500), 3).await.unwrap(), words(500), "{at}");
    for call in earlier {
        if let Ok(result) = call.await {
            assert_eq!(result.unwrap()[1], second_register(obstacle), "{at}");
        }
    }

    sleep(Duration::from_secs(1)).await;
    assert_done_once(&bench, method, before, after, &at);
    let (station, link) = (bench.station().stats(), bench.link.stats());
    let made_suspect = u64::from(obstacle == Obstacle::SuspectStation);
    if obstacle != Obstacle::Unanswered {
        let checks = 1 + made_suspect; // one for the new connection
        assert_eq!((station.checks, station.timeouts), (checks, made_suspect), "{at}: cancelling causes no check");
    }
    assert_eq!((station.bad_replies, link.connects, link.disconnects, link.garbage_bytes), (0, 1, 0, 0), "{at}");
    ended.is_none().then_some(stage)
}

/// Checks that sent requests have arrived, unsent ones have not, and each was executed once.
fn assert_done_once(bench: &Bench, method: &Method, before: Counters, after: Counters, at: &str) {
    let (first, second) = ((method.request)(1), (method.request)(2));
    let (sent, stations): (_, &[u8]) = match method.kind {
        MethodKind::Broadcast => (after.broadcasts - before.broadcasts, &[1, 2]),
        MethodKind::Read | MethodKind::Write => (after.requests - before.requests, &[1]),
    };
    let second_is_first = u64::from(first == second);
    assert_eq!(bench.log_of(&first).len() as u64, sent + second_is_first, "{at}");
    assert_eq!(bench.log_of(&second).len() as u64, 1 + second_is_first * sent, "{at}");
    for &station in stations {
        let applied = |request| bench.faults.log().applied(station, request);
        let expected = if method.kind == MethodKind::Read { 0 } else { sent + second_is_first };
        assert_eq!(applied(&first), expected, "{at}");
    }
    if method.kind != MethodKind::Read {
        assert!(sent <= 1, "{at}: sent {sent} times");
    }
}

/// Content of the second register of an earlier call.
fn second_register(obstacle: Obstacle) -> u16 {
    word(if obstacle == Obstacle::Crowded { 2 } else { 1 }, 301)
}
