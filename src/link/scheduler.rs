//! Chooses the next call.
//!
//! Every station has a bounded queue for each [`Lane`]. Within a lane the station with the least
//! used bus time is next, so a slow or dead station costs the others no more than its share. Among
//! the lanes the best one is next. A call rises by one lane for each [`Scheduler::ageing`] that it
//! has waited while nothing of its lane was served at its station, so no lane starves another.
//!
//! A call that comes while no other waits is the *only* one: it stays out of the queues unless
//! another comes before it is taken. Mostly it is taken at once, and a service with thousands of
//! links saves the cache misses.
//!
//! Invariants:
//! - A station's queues never exceed the capacity.
//! - Calls of one station and lane keep their order.
//! - A station that was idle gains no credit for it.
//! - While there is an only call, the queues are empty.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use super::by_station::ByStation;
use super::call::PendingCall;
use super::options::Lane;

#[derive(Debug)]
pub(crate) struct Scheduler {
    only: Option<PendingCall>,
    /// Number of calls in the queues.
    queued: usize,
    stations: ByStation<Queues>,
    /// Maximum number of waiting calls of a station.
    capacity: usize,
    /// A call rises by one lane per this time.
    ageing: Duration,
    /// Used bus time of the station that was served last: an idle station starts from there.
    served: Duration,
}

#[derive(Debug, Default)]
struct Queues {
    service: Service,
    lanes: [VecDeque<PendingCall>; Lane::COUNT],
}

/// How a station has been served.
#[derive(Debug, Default)]
struct Service {
    /// Used bus time, as far as it matters for fairness.
    used: Duration,
    /// When each lane was served last.
    served_at: [Option<Instant>; Lane::COUNT],
    /// Not served before this time.
    blocked_until: Option<Instant>,
}

impl Service {
    fn is_blocked(&self, now: Instant) -> bool {
        self.blocked_until.is_some_and(|until| now < until)
    }
}

impl Queues {
    fn len(&self) -> usize {
        self.lanes.iter().map(VecDeque::len).sum()
    }
}

impl Scheduler {
    pub(crate) fn new(capacity: usize, ageing: Duration) -> Self {
        Self { only: None, queued: 0, stations: ByStation::new(), capacity, ageing, served: Duration::ZERO }
    }

    /// Appends a call to its queue. Returns it if the station's queues are full.
    #[must_use]
    pub(crate) fn push(&mut self, call: PendingCall, now: Instant) -> Option<PendingCall> {
        let capacity = self.capacity;
        if self.queued == 0 && self.only.is_none() {
            let blocked = self.queues(call.station, |queues| queues.service.is_blocked(now));
            if !blocked {
                self.only = Some(call);
                return None;
            }
        }
        self.queue_only();
        let (refused, left) = self.queues(call.station, |queues| {
            let before = queues.len();
            if before >= capacity {
                queues.lanes.iter_mut().for_each(|lane| lane.retain(|waiting| keep(waiting, now)));
            }
            let left = before.saturating_sub(queues.len());
            if queues.len() >= capacity {
                return (Some(call), left);
            }
            if let Some(lane) = queues.lanes.get_mut(index(call.lane)) {
                lane.push_back(call);
            }
            (None, left)
        });
        self.count_removed(left);
        self.queued = self.queued.saturating_add(usize::from(refused.is_none()));
        refused
    }

    /// Puts a call that was taken back to the head of its queue. It had its place, so no bound
    /// applies.
    pub(crate) fn push_front(&mut self, call: PendingCall) {
        self.queue_only();
        self.queues(call.station, |queues| {
            if let Some(lane) = queues.lanes.get_mut(index(call.lane)) {
                lane.push_front(call);
            }
        });
        self.queued = self.queued.saturating_add(1);
    }

    /// Moves the only call into its queue.
    fn queue_only(&mut self) {
        if let Some(call) = self.only.take() {
            self.push_front(call);
        }
    }

    /// Takes the next call that is still wanted and whose station may be served.
    pub(crate) fn pop(&mut self, now: Instant) -> Option<PendingCall> {
        loop {
            let call = match self.only.take() {
                Some(call) => call,
                None => {
                    let (station, lane) = self.next(now)?;
                    let call = self.stations.get_mut(station)?.lanes.get_mut(lane)?.pop_front()?;
                    self.count_removed(1);
                    call
                }
            };
            let service = &mut self.stations.get_mut(call.station)?.service;
            self.served = service.used;
            if let Some(served_at) = service.served_at.get_mut(index(call.lane)) {
                *served_at = Some(now);
            }
            if keep(&call, now) {
                return Some(call);
            }
        }
    }

    /// Whether a call waits whose station may be served now.
    pub(crate) fn has_work(&mut self, now: Instant) -> bool {
        self.only.take_if(|call| !keep(call, now));
        if self.only.is_some() {
            return true;
        }
        while let Some((station, lane)) = self.next(now) {
            let queue = self.stations.get_mut(station).and_then(|queues| queues.lanes.get_mut(lane));
            match queue {
                Some(queue) if queue.front().is_some_and(|call| keep(call, now)) => return true,
                Some(queue) => {
                    drop(queue.pop_front());
                    self.count_removed(1);
                }
                None => return false,
            }
        }
        false
    }

    /// Whether a wanted call waits, for any station.
    pub(crate) fn is_waiting(&mut self, now: Instant) -> bool {
        self.only.take_if(|call| !keep(call, now));
        if self.queued > 0 {
            let queues = self.stations.values_mut().flat_map(|queues| queues.lanes.iter_mut());
            self.queued = queues.fold(0_usize, |queued, queue| {
                queue.retain(|call| keep(call, now));
                queued.saturating_add(queue.len())
            });
        }
        self.only.is_some() || self.queued > 0
    }

    /// Counts calls that have left the queues.
    fn count_removed(&mut self, calls: usize) {
        debug_assert!(calls <= self.queued, "a call in the queues was not counted");
        self.queued = self.queued.saturating_sub(calls);
    }

    /// Takes all calls of a station.
    pub(crate) fn drain(&mut self, station: u8) -> VecDeque<PendingCall> {
        self.queue_only();
        let calls: VecDeque<PendingCall> = match self.stations.get_mut(station) {
            Some(queues) => queues.lanes.iter_mut().flat_map(std::mem::take).collect(),
            None => VecDeque::new(),
        };
        self.count_removed(calls.len());
        calls
    }

    /// Takes all calls.
    pub(crate) fn drain_all(&mut self) -> VecDeque<PendingCall> {
        self.queue_only();
        self.queued = 0;
        let queues = self.stations.values_mut().flat_map(|queues| queues.lanes.iter_mut());
        queues.flat_map(std::mem::take).collect()
    }

    /// Adds to the used bus time of a station.
    pub(crate) fn charge(&mut self, station: u8, time: Duration) {
        self.queues(station, |queues| queues.service.used = queues.service.used.saturating_add(time));
    }

    /// Blocks a station until this time.
    pub(crate) fn block(&mut self, station: u8, until: Instant) {
        self.queue_only();
        self.queues(station, |queues| queues.service.blocked_until = Some(until));
    }

    /// When the next blocked station that has calls may be served.
    pub(crate) fn next_unblocked(&self) -> Option<Instant> {
        if self.queued == 0 {
            return None;
        }
        self.stations.values().filter(|queues| queues.len() > 0).filter_map(|queues| queues.service.blocked_until).min()
    }

    fn queues<R>(&mut self, station: u8, work: impl FnOnce(&mut Queues) -> R) -> R {
        let (served, idle) = (self.served, self.queued == 0);
        self.stations.with(station, Queues::default, |queues| {
            // If the only call is this station's, this was done when it came, and no station was
            // served since.
            if queues.service.used < served && (idle || queues.len() == 0) {
                queues.service.used = served;
            }
            work(queues)
        })
    }

    /// The station and lane that are next.
    fn next(&self, now: Instant) -> Option<(u8, usize)> {
        if self.queued == 0 {
            return None;
        }
        // Mostly there is at most one, and no comparison is needed.
        let mut waiting = self.waiting(now).map(|(station, _, lane, _)| (station, lane));
        let first = waiting.next()?;
        if waiting.next().is_none() {
            return Some(first);
        }
        // The next station of each lane.
        let mut turns: [Option<(Duration, Instant, u8)>; Lane::COUNT] = [None; Lane::COUNT];
        for (station, queues, lane, call) in self.waiting(now) {
            let Some(turn) = turns.get_mut(lane) else { continue };
            let waits = (queues.service.used, call.queued_at, station);
            if turn.is_none_or(|turn| waits < turn) {
                *turn = Some(waits);
            }
        }
        let turns = turns.into_iter().enumerate();
        let lanes = turns.filter_map(|(lane, turn)| turn.map(|(_, queued_at, station)| (lane, queued_at, station)));
        let ranked = lanes.map(|(lane, queued_at, station)| {
            let served_at = self.stations.get(station).and_then(|queues| *queues.service.served_at.get(lane)?);
            (self.rank(lane, served_at.map_or(queued_at, |at| at.max(queued_at)), now), lane, station)
        });
        ranked.min().map(|(_, lane, station)| (station, lane))
    }

    /// The first call of each lane of each station that may be served.
    fn waiting(&self, now: Instant) -> impl Iterator<Item = (u8, &Queues, usize, &PendingCall)> {
        let served = self.stations.iter().filter(move |(_, queues)| !queues.service.is_blocked(now));
        served.flat_map(|(station, queues)| {
            let lanes = queues.lanes.iter().enumerate();
            lanes.filter_map(move |(lane, queue)| Some((station, queues, lane, queue.front()?)))
        })
    }

    /// The lane, less one for each ageing period since then.
    fn rank(&self, lane: usize, since: Instant, now: Instant) -> u128 {
        let waited = now.saturating_duration_since(since).as_nanos();
        let risen = waited.checked_div(self.ageing.as_nanos()).unwrap_or_default();
        u128::try_from(lane).unwrap_or_default().saturating_sub(risen)
    }
}

/// Whether a call is still wanted; ends it if not.
fn keep(call: &PendingCall, now: Instant) -> bool {
    let wanted = call.is_wanted(now);
    if !wanted {
        call.expire();
    }
    wanted
}

fn index(lane: Lane) -> usize {
    match lane {
        Lane::Control => 0,
        Lane::Write => 1,
        Lane::Read => 2,
        Lane::Background => 3,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::{Command, ReadStatus};
    use crate::link::call::{self, CallFuture, CallMeta, SpareSlots};
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
            response_timeout: SECOND,
            options: CallOptions::new(),
            part: false,
            confirms: false,
        };
        call::new(ReadStatus, None, meta, &SpareSlots::default())
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
        assert_eq!(
            scheduler.pop(now).map(|call| call.station),
            Some(1),
            "3 starts at the bus time of 1, and came later"
        );
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
            let all =
                |calls: VecDeque<PendingCall>| calls.into_iter().map(|call| shown(Some(call))).collect::<Vec<_>>();
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
}
