use super::*;
use crate::command::{Command, ReadStatus};
use crate::link::call::{self, CallFuture, CallMeta, Sending};
use crate::link::options::CallOptions;
use crate::random::Random;

const SECOND: Duration = Duration::from_secs(1);

fn call(station: u8, lane: Lane, now: Instant) -> (PendingCall, CallFuture<ReadStatus>) {
    let meta = CallMeta {
        station,
        code: ReadStatus::CODE,
        lane,
        deadline: now + 1000 * SECOND,
        queued_at: now,
        confirms: false,
        plain: ReadStatus.plain(),
    };
    let sending = Sending { response_timeout: SECOND, adaptive: None, part: false };
    call::new(ReadStatus, meta, sending, &CallOptions::new())
}

/// A scheduler with these calls waiting, and the futures that keep them wanted.
fn with(capacity: usize, calls: &[(u8, Lane)], now: Instant) -> (Scheduler, Vec<CallFuture<ReadStatus>>) {
    let mut scheduler = Scheduler::new(capacity, SECOND);
    let mut callers = Vec::new();
    for &(station, lane) in calls {
        let (call, caller) = call(station, lane, now);
        assert!(scheduler.push(call, now).is_none(), "the queue has room");
        callers.push(caller);
    }
    (scheduler, callers)
}

fn order(scheduler: &mut Scheduler, now: Instant) -> Vec<(u8, Lane)> {
    std::iter::from_fn(|| scheduler.pop(now).map(|call| (call.station, call.lane))).collect()
}

#[test]
fn a_full_stations_abandoned_calls_make_room() {
    let now = Instant::now();
    let (mut scheduler, mut callers) = with(3, &[(1, Lane::Read), (1, Lane::Write), (1, Lane::Read)], now);
    let (fourth, _caller) = call(1, Lane::Control, now);
    let fourth = scheduler.push(fourth, now).expect("the queue is full");
    let (elsewhere, _waits) = call(2, Lane::Read, now);
    assert!(scheduler.push(elsewhere, now).is_none(), "another station has a queue of its own");
    callers.pop();
    assert!(scheduler.push(fourth, now).is_none(), "one call was abandoned");
    assert_eq!(scheduler.drain(1).len(), 3);
    assert_eq!(scheduler.drain_all().len(), 1);
    assert!(scheduler.pop(now).is_none());
}

#[test]
fn a_call_put_back_comes_first_even_beyond_the_capacity() {
    let now = Instant::now();
    let (mut scheduler, _callers) = with(1, &[(1, Lane::Read)], now);
    let (mut back, _caller) = call(1, Lane::Read, now);
    back.retries_left = 9;
    scheduler.push_front(back);
    assert_eq!(scheduler.pop(now).map(|call| call.retries_left), Some(9));
}

#[test]
fn better_lanes_come_first_and_ageing_prevents_starvation() {
    let now = Instant::now();
    let lanes = [Lane::Background, Lane::Read, Lane::Write, Lane::Control];
    let (mut scheduler, _callers) = with(9, &lanes.map(|lane| (1, lane)), now);
    assert_eq!(
        order(&mut scheduler, now).iter().map(|(_, lane)| *lane).collect::<Vec<_>>(),
        [Lane::Control, Lane::Write, Lane::Read, Lane::Background]
    );
    // Two lanes apart: equal after two periods, when the better lane comes first; ahead after
    // the third.
    for (waited, first) in
        [(2 * SECOND, Lane::Write), (3 * SECOND - SECOND / 100, Lane::Write), (3 * SECOND, Lane::Background)]
    {
        let (mut scheduler, mut callers) = with(9, &[(1, Lane::Background)], now);
        let (write, caller) = call(1, Lane::Write, now + waited);
        assert!(scheduler.push(write, now + waited).is_none());
        callers.push(caller);
        assert_eq!(scheduler.pop(now + waited).map(|call| call.lane), Some(first), "after {waited:?}");
    }
}

#[test]
fn the_least_served_station_is_next_and_idling_gives_no_credit() {
    let now = Instant::now();
    let (mut scheduler, _callers) = with(9, &[(1, Lane::Read), (1, Lane::Read), (2, Lane::Read)], now);
    scheduler.charge(1, 5 * SECOND);
    assert_eq!(order(&mut scheduler, now).iter().map(|(station, _)| *station).collect::<Vec<_>>(), [2, 1, 1]);
    // Station 3 comes late, and has no credit for the time before.
    let mut scheduler = Scheduler::new(9, SECOND);
    let mut callers = Vec::new();
    let mut push = |scheduler: &mut Scheduler, station| {
        let (call, caller) = call(station, Lane::Read, now);
        callers.push(caller);
        assert!(scheduler.push(call, now).is_none());
    };
    push(&mut scheduler, 1);
    scheduler.charge(1, 10 * SECOND);
    push(&mut scheduler, 1);
    assert_eq!(scheduler.pop(now).map(|call| call.station), Some(1));
    push(&mut scheduler, 3);
    assert_eq!(scheduler.pop(now).map(|call| call.station), Some(1), "3 starts at the bus time of 1, and came later");
    assert_eq!(scheduler.pop(now).map(|call| call.station), Some(3));
}

#[test]
fn a_blocked_station_is_skipped_until_its_time() {
    let now = Instant::now();
    let (mut scheduler, _callers) = with(9, &[(1, Lane::Control), (2, Lane::Read)], now);
    scheduler.block(1, now + SECOND);
    scheduler.block(7, now + SECOND / 2);
    assert_eq!(scheduler.next_unblocked(), Some(now + SECOND), "7 has no calls");
    assert_eq!(order(&mut scheduler, now), [(2, Lane::Read)]);
    assert!(!scheduler.has_work(now) && scheduler.is_waiting(now));
    assert!(scheduler.has_work(now + SECOND));
    assert_eq!(order(&mut scheduler, now + SECOND), [(1, Lane::Control)]);
    assert_eq!(scheduler.next_unblocked(), None);
}

/// A call outside the queues is treated as if it were in one.
#[test]
fn the_only_call_is_like_any_other() {
    let start = Instant::now();
    for seed in 0..500 {
        let mut random = Random::new(seed);
        let mut any = |n: u64| random.next() % n;
        let (mut one, mut other) = (Scheduler::new(3, SECOND), Scheduler::new(3, SECOND));
        let (mut now, mut calls, mut number) = (start, Vec::new(), 0);
        let shown = |call: Option<PendingCall>| call.map(|call| (call.station, call.lane, call.retries_left));
        let all = |calls: VecDeque<PendingCall>| calls.into_iter().map(|call| shown(Some(call))).collect::<Vec<_>>();
        for step in 0..200 {
            let (station, at) = (any(3) as u8, format!("seed {seed}, step {step}"));
            match any(12) {
                0..=4 => {
                    let lane = [Lane::Control, Lane::Write, Lane::Read, Lane::Background][any(4) as usize];
                    let front = any(6) == 0;
                    number += 1;
                    let [first, second] = [&mut one, &mut other].map(|scheduler| {
                        let (mut call, caller) = call(station, lane, now);
                        call.retries_left = number;
                        let refused = if front {
                            scheduler.push_front(call);
                            None
                        } else {
                            scheduler.push(call, now)
                        };
                        (shown(refused), caller)
                    });
                    other.queue_only();
                    assert_eq!(first.0, second.0, "{at}");
                    calls.push((first.1, second.1));
                }
                5..=7 => assert_eq!(shown(one.pop(now)), shown(other.pop(now)), "{at}"),
                8 => {
                    let time = Duration::from_millis(any(50));
                    one.charge(station, time);
                    other.charge(station, time);
                }
                9 => {
                    let until = now + Duration::from_millis(any(40));
                    one.block(station, until);
                    other.block(station, until);
                }
                10 if any(4) == 0 => assert_eq!(all(one.drain(station)), all(other.drain(station)), "{at}"),
                10 if !calls.is_empty() => drop(calls.swap_remove(any(calls.len() as u64) as usize)),
                _ => now += Duration::from_millis(any(400)),
            }
            match any(4) {
                0 => assert_eq!(one.has_work(now), other.has_work(now), "{at}"),
                1 => assert_eq!(one.is_waiting(now), other.is_waiting(now), "{at}"),
                _ => {}
            }
            for scheduler in [&one, &other] {
                let queued: usize = scheduler.stations.values().map(Queues::len).sum();
                assert_eq!(scheduler.queued, queued, "{at}");
                assert!(scheduler.only.is_none() || queued == 0, "{at}");
            }
            let used = |scheduler: &Scheduler| -> Vec<_> {
                scheduler.stations.iter().map(|(station, queues)| (station, queues.service.used)).collect()
            };
            assert_eq!((used(&one), one.served), (used(&other), other.served), "{at}");
        }
        assert_eq!(all(one.drain_all()), all(other.drain_all()), "seed {seed}");
    }
}

#[test]
fn abandoned_and_expired_calls_are_no_work() {
    let now = Instant::now();
    let (mut scheduler, callers) = with(9, &[(1, Lane::Read), (1, Lane::Write)], now);
    assert!(scheduler.has_work(now) && scheduler.is_waiting(now));
    drop(callers);
    assert!(!scheduler.has_work(now));
    let (mut scheduler, _callers) = with(9, &[(1, Lane::Read)], now);
    assert!(!scheduler.is_waiting(now + 1000 * SECOND), "its deadline has passed");
}

#[test]
fn a_waiting_write_or_control_command_is_known() {
    let now = Instant::now();
    for (calls, expected) in [
        (&[][..], false),
        (&[(1, Lane::Read)], false),
        (&[(1, Lane::Read), (2, Lane::Background)], false),
        (&[(1, Lane::Read), (2, Lane::Write)], true),
        (&[(1, Lane::Control), (2, Lane::Read)], true),
        (&[(1, Lane::Read), (1, Lane::Write)], true),
    ] {
        let (mut scheduler, _futures) = with(9, calls, now);
        assert_eq!(scheduler.has_write(), expected, "{calls:?}");
        while scheduler.pop(now).is_some() {}
        assert!(!scheduler.has_write(), "nothing waits");
    }
}

/// Stations without calls have no place in the round.
#[test]
fn a_timeout_costs_a_place_at_the_end_of_the_round_of_waiting_stations() {
    let now = Instant::now();
    let ms = Duration::from_millis;
    let (mut scheduler, _futures) =
        with(9, &[(1, Lane::Read), (1, Lane::Read), (2, Lane::Read), (3, Lane::Read), (2, Lane::Read)], now);
    scheduler.charge(4, ms(10_000));
    scheduler.charge(2, ms(10));
    scheduler.charge(3, ms(20));
    assert!(scheduler.pop(now).is_some_and(|call| call.station == 1));
    scheduler.charge_timeout(1, ms(100));
    let mut next = || scheduler.pop(now).unwrap().station;
    assert_eq!([next(), next()], [2, 2], "of these nothing was charged");
    assert_eq!(next(), 3);
    assert_eq!(next(), 1);
}

#[test]
fn a_station_that_joins_waiting_ones_has_no_credit() {
    let now = Instant::now();
    let ms = Duration::from_millis;
    let (mut scheduler, mut futures) = with(9, &[(1, Lane::Read), (1, Lane::Read), (2, Lane::Read)], now);
    scheduler.charge(1, ms(100));
    scheduler.charge(2, ms(110));
    assert_eq!(scheduler.pop(now).unwrap().station, 1);
    scheduler.charge(1, ms(5));
    for _ in 0..3 {
        let (call, future) = call(3, Lane::Read, now);
        assert!(scheduler.push(call, now).is_none());
        futures.push(future);
    }
    // It begins at the 100 ms of the station that was served last.
    let order: Vec<u8> = std::iter::from_fn(|| {
        let station = scheduler.pop(now)?.station;
        scheduler.charge(station, ms(10));
        Some(station)
    })
    .collect();
    assert_eq!(order, [3, 1, 2, 3, 3]);
}
