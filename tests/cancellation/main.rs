//! A call that is dropped at any point of its life harms nobody: what was not sent is never sent, what was sent is done
//! once, and whoever asks next gets their own answer.
//!
//! Every method is cut off after every number of polls until it ends by itself, and between two polls the rest of the
//! runtime does as little as can be: one task runs once, or a millisecond passes.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

mod bench;
mod memory;
mod methods;

use std::collections::BTreeSet;
use std::time::Duration;

use fatek::command::{ReadRegisters, Request};
use fatek::wire::Framing;
use fatek::{Error, LinkState};
use tokio::task::JoinHandle;
use tokio::time::sleep;

use self::bench::{Bench, Progress, Scene, Stage, closing, cut_off, in_two_pieces, paused, poll_once, tick};
use self::memory::{d, word, words};
use self::methods::{Kind, Method, broadcasts, reads, writes};

/// When the first request is on the wire: behind the opening of the connection, and the check, whose reply is in two pieces.
const ON_THE_WIRE: Duration = Duration::from_millis(6);

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

#[test]
fn every_async_method_is_tested_here() {
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
fn a_call_that_is_dropped_while_the_connection_is_opened_harms_nobody() {
    drop_everywhere(Scene::Opening, &[Stage::Queued, Stage::Connecting]);
}

#[test]
fn a_call_that_is_dropped_behind_another_one_harms_nobody() {
    drop_everywhere(Scene::Busy, &[Stage::Queued]);
}

#[test]
fn a_call_that_is_dropped_behind_many_others_harms_nobody() {
    drop_everywhere(Scene::Crowded, &[Stage::Queued]);
}

#[test]
fn a_call_to_a_dirty_station_that_is_dropped_before_behind_or_with_the_barrier_harms_nobody() {
    drop_everywhere(Scene::Dirty, &[Stage::Checked]);
}

#[test]
fn a_call_that_is_dropped_before_or_between_its_retries_harms_nobody() {
    drop_everywhere(Scene::Unanswered, &[]);
}

#[test]
fn closing_that_is_dropped_at_any_point_closes_all_the_same_once_it_has_begun() {
    paused(async {
        for framing in FRAMINGS {
            for polls in 0.. {
                let bench = Bench::new(framing);
                let in_flight = bench.read(1, 100);
                sleep(ON_THE_WIRE).await;
                let queued = bench.read(1, 200);
                tick().await;
                let ended = cut_off(closing(&bench.link), polls).await.is_some();
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
fn closing_twice_is_closing_once_whoever_gives_up_waiting() {
    paused(async {
        for polls in 0.. {
            let bench = Bench::new(Framing::Ascii);
            let in_flight = bench.read(1, 100);
            sleep(ON_THE_WIRE).await;
            let mut first = closing(&bench.link);
            assert!(poll_once(&mut first).await.is_pending());
            let ended = cut_off(closing(&bench.link), polls).await.is_some();
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

/// Cuts every method off at every point; each must come at least through these stages, and those behind them.
fn drop_everywhere(scene: Scene, stages: &[Stage]) {
    paused(async {
        let mut cuts = 0;
        for framing in FRAMINGS {
            let methods = reads().into_iter().chain(writes()).chain(broadcasts());
            for method in methods.filter(|method| framing == Framing::Ascii || !method.name.contains("program_page")) {
                let mut seen = BTreeSet::new();
                let mut polls = 0;
                while let Some(stage) = cut_and_go_on(scene, framing, &method, polls).await {
                    seen.insert(stage);
                    polls += 1;
                }
                cuts += polls;
                let mut expected = BTreeSet::from_iter(stages.iter().copied());
                match (method.kind, scene) {
                    // It ends when it is sent, and no barrier comes before it.
                    (Kind::Broadcast, _) => expected.retain(|&stage| stage < Stage::Checked),
                    (Kind::Write, Scene::Unanswered) => expected.extend([Stage::Sent, Stage::Executed]),
                    (Kind::Read, Scene::Unanswered) => {
                        expected.extend([Stage::Sent, Stage::Executed, Stage::Checked, Stage::Replied]);
                    }
                    _ => expected.extend([Stage::Sent, Stage::Executed, Stage::Replied]),
                }
                assert!(expected.is_subset(&seen), "{scene:?}, {framing}, {}: only {seen:?}", method.name);
                let at_least = match (method.kind, scene) {
                    // Nothing is on the wire, so it is sent as soon as it is polled, and that is all.
                    (Kind::Broadcast, Scene::Dirty | Scene::Unanswered) => 0,
                    (Kind::Broadcast, _) => 2,
                    _ => 10,
                };
                assert!(polls > at_least, "{scene:?}, {framing}, {}: {polls}", method.name);
            }
        }
        println!("{scene:?}: {cuts} cuts");
    });
}

/// Drops a call after so many polls, and does what must work then. Says how far the call had come; `None` when it had
/// ended by itself.
async fn cut_and_go_on(scene: Scene, framing: Framing, method: &Method, polls: u32) -> Option<Stage> {
    let at = format!("{scene:?}, {framing}, {} after {polls}", method.name);
    let bench = Bench::new(framing);
    let earlier = bench.set(scene).await;
    let before = bench.progress();
    let ended = cut_off((method.call)(&bench.link, 1), polls).await;
    let after = bench.progress();
    let stage = if polls == 0 { Stage::Unpolled } else { bench.stage(&(method.request)(1), before, after) };
    match &ended {
        None => {}
        // Sent, and never answered.
        Some(Err(error)) if scene == Scene::Unanswered && method.kind == Kind::Write => {
            assert!(matches!(error, Error::Timeout { .. }) && error.may_have_executed(), "{at}: {error:?}");
        }
        Some(result) => assert_eq!(result.as_deref().unwrap(), (method.reply)(1), "{at}"),
    }

    // Whatever the dropped call may still bring, the next ones are answered right.
    bench.faults.set_rules([in_two_pieces()]);
    bench.plcs[0].set_battery_low(true);
    if scene == Scene::Crowded {
        earlier.iter().for_each(JoinHandle::abort);
    }
    assert_eq!((method.call)(&bench.link, 2).await.unwrap(), (method.reply)(2), "{at}");
    assert_eq!(bench.station().read_registers(d(500), 3).await.unwrap(), words(500), "{at}");
    for call in earlier {
        if let Ok(result) = call.await {
            assert_eq!(result.unwrap()[1], result_of(scene), "{at}");
        }
    }

    sleep(Duration::from_secs(1)).await;
    assert_done_once(&bench, method, before, after, &at);
    let (station, link) = (bench.station().stats(), bench.link.stats());
    let made_dirty = u64::from(scene == Scene::Dirty);
    if scene != Scene::Unanswered {
        let checks = 1 + made_dirty; // one for the new connection
        assert_eq!((station.checks, station.timeouts), (checks, made_dirty), "{at}: giving up is no doubt");
    }
    assert_eq!((station.bad_replies, link.connects, link.disconnects, link.garbage_bytes), (0, 1, 0, 0), "{at}");
    ended.is_none().then_some(stage)
}

/// What had been sent by then has arrived, what had not has not, and all of it has been done once.
fn assert_done_once(bench: &Bench, method: &Method, before: Progress, after: Progress, at: &str) {
    let (first, second) = ((method.request)(1), (method.request)(2));
    let (sent, stations): (_, &[u8]) = match method.kind {
        Kind::Broadcast => (after.broadcasts - before.broadcasts, &[1, 2]),
        Kind::Read | Kind::Write => (after.requests - before.requests, &[1]),
    };
    let second_is_first = u64::from(first == second);
    assert_eq!(bench.log_of(&first).len() as u64, sent + second_is_first, "{at}");
    assert_eq!(bench.log_of(&second).len() as u64, 1 + second_is_first * sent, "{at}");
    for &station in stations {
        let applied = |request| bench.faults.log().applied(station, request);
        let expected = if method.kind == Kind::Read { 0 } else { sent + second_is_first };
        assert_eq!(applied(&first), expected, "{at}");
    }
    if method.kind != Kind::Read {
        assert!(sent <= 1, "{at}: sent {sent} times");
    }
}

/// What the second register of an earlier call holds.
fn result_of(scene: Scene) -> u16 {
    word(if scene == Scene::Crowded { 2 } else { 1 }, 301)
}
