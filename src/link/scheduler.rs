//! Which call is next.
//!
//! Every station has a bounded queue for each [`Lane`]. Within a lane it is the turn of the station that has used the
//! least bus time, so that a slow or dead station costs the others no more than its share. Among the lanes the best one
//! comes first; but a call rises by one lane for each [`Scheduler::ageing`] that it has waited while nothing of its lane
//! was served at its station, so that no lane starves another.
//!
//! A call that comes when no other waits is not put into a queue unless another one comes before it is taken: it is the
//! *only* one. Mostly it is taken at once, and a service with thousands of links has other things to keep in its caches.
//!
//! What must always hold: a queue is never longer than its bound; calls of one station and lane keep their order; a
//! station that was idle gains no credit for it; while there is an only call, the queues are empty.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use super::by_station::ByStation;
use super::call::Ticket;
use super::options::Lane;

#[derive(Debug)]
pub(crate) struct Scheduler {
    only: Option<Ticket>,
    /// How many calls are in queues.
    queued: usize,
    stations: ByStation<Queues>,
    /// How many calls a station can have waiting.
    capacity: usize,
    /// A call that has waited this long rises by one lane.
    ageing: Duration,
    /// The bus time of the station that was served last: where a station that was idle begins.
    served: Duration,
}

#[derive(Debug, Default)]
struct Queues {
    service: Service,
    lanes: [VecDeque<Ticket>; Lane::COUNT],
}

/// How a station has been served so far.
#[derive(Debug, Default)]
struct Service {
    /// How much bus time it has used, as far as that matters for fairness.
    used: Duration,
    /// When each of its lanes was served last.
    served_at: [Option<Instant>; Lane::COUNT],
    /// Not served before then.
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

    /// Puts a call at the end of its queue; gives it back when the station's queues are full.
    #[must_use]
    pub(crate) fn push(&mut self, ticket: Ticket, now: Instant) -> Option<Ticket> {
        let capacity = self.capacity;
        if self.queued == 0 && self.only.is_none() {
            let blocked = self.queues(ticket.station, |queues| queues.service.is_blocked(now));
            if !blocked {
                self.only = Some(ticket);
                return None;
            }
        }
        self.queue_only();
        let (refused, left) = self.queues(ticket.station, |queues| {
            let before = queues.len();
            if before >= capacity {
                queues.lanes.iter_mut().for_each(|lane| lane.retain(|waiting| keep(waiting, now)));
            }
            let left = before.saturating_sub(queues.len());
            if queues.len() >= capacity {
                return (Some(ticket), left);
            }
            if let Some(lane) = queues.lanes.get_mut(index(ticket.lane)) {
                lane.push_back(ticket);
            }
            (None, left)
        });
        self.queued = self.queued.saturating_sub(left).saturating_add(usize::from(refused.is_none()));
        refused
    }

    /// Puts a call that was taken back before all others of its queue. It had its place, so no bound applies.
    pub(crate) fn push_front(&mut self, ticket: Ticket) {
        self.queue_only();
        self.queues(ticket.station, |queues| {
            if let Some(lane) = queues.lanes.get_mut(index(ticket.lane)) {
                lane.push_front(ticket);
            }
        });
        self.queued = self.queued.saturating_add(1);
    }

    /// The only call is that no more, or its station is to be blocked.
    fn queue_only(&mut self) {
        if let Some(ticket) = self.only.take() {
            self.push_front(ticket);
        }
    }

    /// Takes the next call that is still wanted, if there is one whose station may be served.
    pub(crate) fn pop(&mut self, now: Instant) -> Option<Ticket> {
        loop {
            let ticket = match self.only.take() {
                Some(ticket) => ticket,
                None => {
                    let (station, lane) = self.next(now)?;
                    let ticket = self.stations.get_mut(station)?.lanes.get_mut(lane)?.pop_front()?;
                    self.queued = self.queued.saturating_sub(1);
                    ticket
                }
            };
            let service = &mut self.stations.get_mut(ticket.station)?.service;
            self.served = service.used;
            if let Some(served_at) = service.served_at.get_mut(index(ticket.lane)) {
                *served_at = Some(now);
            }
            if keep(&ticket, now) {
                return Some(ticket);
            }
        }
    }

    /// Whether a call is waiting whose station may be served now.
    pub(crate) fn has_work(&mut self, now: Instant) -> bool {
        self.only.take_if(|ticket| !keep(ticket, now));
        if self.only.is_some() {
            return true;
        }
        while let Some((station, lane)) = self.next(now) {
            let queue = self.stations.get_mut(station).and_then(|queues| queues.lanes.get_mut(lane));
            match queue {
                Some(queue) if queue.front().is_some_and(|ticket| keep(ticket, now)) => return true,
                Some(queue) => {
                    drop(queue.pop_front());
                    self.queued = self.queued.saturating_sub(1);
                }
                None => return false,
            }
        }
        false
    }

    /// Whether a call is waiting that is still wanted, may its station be served or not.
    pub(crate) fn is_waiting(&mut self, now: Instant) -> bool {
        self.only.take_if(|ticket| !keep(ticket, now));
        if self.queued > 0 {
            let queues = self.stations.values_mut().flat_map(|queues| queues.lanes.iter_mut());
            self.queued = queues.fold(0_usize, |queued, queue| {
                queue.retain(|ticket| keep(ticket, now));
                queued.saturating_add(queue.len())
            });
        }
        self.only.is_some() || self.queued > 0
    }

    /// Takes every call of a station.
    pub(crate) fn drain(&mut self, station: u8) -> VecDeque<Ticket> {
        self.queue_only();
        let calls: VecDeque<Ticket> = match self.stations.get_mut(station) {
            Some(queues) => queues.lanes.iter_mut().flat_map(std::mem::take).collect(),
            None => VecDeque::new(),
        };
        self.queued = self.queued.saturating_sub(calls.len());
        calls
    }

    /// Takes every call.
    pub(crate) fn drain_all(&mut self) -> VecDeque<Ticket> {
        self.queue_only();
        self.queued = 0;
        let queues = self.stations.values_mut().flat_map(|queues| queues.lanes.iter_mut());
        queues.flat_map(std::mem::take).collect()
    }

    /// Counts bus time that a station has used.
    pub(crate) fn charge(&mut self, station: u8, time: Duration) {
        self.queues(station, |queues| queues.service.used = queues.service.used.saturating_add(time));
    }

    /// Does not serve a station before then.
    pub(crate) fn block(&mut self, station: u8, until: Instant) {
        self.queue_only();
        self.queues(station, |queues| queues.service.blocked_until = Some(until));
    }

    /// When the next station that is blocked and has calls may be served.
    pub(crate) fn next_unblocked(&self) -> Option<Instant> {
        if self.queued == 0 {
            return None;
        }
        self.stations.values().filter(|queues| queues.len() > 0).filter_map(|queues| queues.service.blocked_until).min()
    }

    fn queues<R>(&mut self, station: u8, work: impl FnOnce(&mut Queues) -> R) -> R {
        let (served, idle) = (self.served, self.queued == 0);
        self.stations.with(station, Queues::default, |queues| {
            // If the only call is this station's, this was done when it came, and nothing has been served since.
            if queues.service.used < served && (idle || queues.len() == 0) {
                queues.service.used = served;
            }
            work(queues)
        })
    }

    /// The station and lane whose turn it is.
    fn next(&self, now: Instant) -> Option<(u8, usize)> {
        if self.queued == 0 {
            return None;
        }
        // Mostly there is one, or none: nothing is to be weighed.
        let mut waiting = self.waiting(now).map(|(station, _, lane, _)| (station, lane));
        let first = waiting.next()?;
        if waiting.next().is_none() {
            return Some(first);
        }
        // Of each lane, the station whose turn it is.
        let mut turns: [Option<(Duration, Instant, u8)>; Lane::COUNT] = [None; Lane::COUNT];
        for (station, queues, lane, ticket) in self.waiting(now) {
            let Some(turn) = turns.get_mut(lane) else { continue };
            let waits = (queues.service.used, ticket.queued_at, station);
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

    /// The stations that may be served and have calls, with those of their lanes that have any, and the first call in each.
    fn waiting(&self, now: Instant) -> impl Iterator<Item = (u8, &Queues, usize, &Ticket)> {
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

/// Whether the call is still wanted; ends it if not.
fn keep(ticket: &Ticket, now: Instant) -> bool {
    let wanted = ticket.is_wanted(now);
    if !wanted {
        ticket.expire();
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
    use crate::link::call::{self, Completion, Spares, Terms};
    use crate::link::options::CallOptions;
    use crate::random::Random;

    const SECOND: Duration = Duration::from_secs(1);

    fn ticket(station: u8, lane: Lane, now: Instant) -> (Ticket, Completion<ReadStatus>) {
        let terms = Terms {
            station,
            code: ReadStatus::CODE,
            lane,
            deadline: now + 1000 * SECOND,
            queued_at: now,
            response_timeout: SECOND,
            options: CallOptions::new(),
            longer: false,
            confirms: false,
        };
        call::new(ReadStatus, None, terms, &Spares::default())
    }

    /// A scheduler with these calls waiting, and what keeps them wanted.
    fn with(capacity: usize, calls: &[(u8, Lane)], now: Instant) -> (Scheduler, Vec<Completion<ReadStatus>>) {
        let mut scheduler = Scheduler::new(capacity, SECOND);
        let mut callers = Vec::new();
        for &(station, lane) in calls {
            let (ticket, caller) = ticket(station, lane, now);
            assert!(scheduler.push(ticket, now).is_none(), "there is room");
            callers.push(caller);
        }
        (scheduler, callers)
    }

    fn order(scheduler: &mut Scheduler, now: Instant) -> Vec<(u8, Lane)> {
        std::iter::from_fn(|| scheduler.pop(now).map(|ticket| (ticket.station, ticket.lane))).collect()
    }

    #[test]
    fn a_stations_queues_hold_so_many_calls_together_and_those_that_nobody_wants_give_way() {
        let now = Instant::now();
        let (mut scheduler, mut callers) = with(3, &[(1, Lane::Read), (1, Lane::Write), (1, Lane::Read)], now);
        let (fourth, _caller) = ticket(1, Lane::Control, now);
        let fourth = scheduler.push(fourth, now).expect("it is full");
        let (elsewhere, _waits) = ticket(2, Lane::Read, now);
        assert!(scheduler.push(elsewhere, now).is_none(), "another station has its own room");
        callers.pop();
        assert!(scheduler.push(fourth, now).is_none(), "one has gone");
        assert_eq!(scheduler.drain(1).len(), 3);
        assert_eq!(scheduler.drain_all().len(), 1);
        assert!(scheduler.pop(now).is_none());
    }

    #[test]
    fn a_call_that_was_taken_back_comes_first_again_whatever_the_bound() {
        let now = Instant::now();
        let (mut scheduler, _callers) = with(1, &[(1, Lane::Read)], now);
        let (mut back, _caller) = ticket(1, Lane::Read, now);
        back.retries_left = 9;
        scheduler.push_front(back);
        assert_eq!(scheduler.pop(now).map(|ticket| ticket.retries_left), Some(9));
    }

    #[test]
    fn better_lanes_come_first_and_none_waits_for_ever() {
        let now = Instant::now();
        let lanes = [Lane::Background, Lane::Read, Lane::Write, Lane::Control];
        let (mut scheduler, _callers) = with(9, &lanes.map(|lane| (1, lane)), now);
        assert_eq!(
            order(&mut scheduler, now).iter().map(|(_, lane)| *lane).collect::<Vec<_>>(),
            [Lane::Control, Lane::Write, Lane::Read, Lane::Background]
        );
        // Behind by two lanes: level after two periods, when the better lane comes first; ahead after the third.
        for (waited, first) in
            [(2 * SECOND, Lane::Write), (3 * SECOND - SECOND / 100, Lane::Write), (3 * SECOND, Lane::Background)]
        {
            let (mut scheduler, mut callers) = with(9, &[(1, Lane::Background)], now);
            let (write, caller) = ticket(1, Lane::Write, now + waited);
            assert!(scheduler.push(write, now + waited).is_none());
            callers.push(caller);
            assert_eq!(scheduler.pop(now + waited).map(|ticket| ticket.lane), Some(first), "after {waited:?}");
        }
    }

    #[test]
    fn the_station_that_has_used_the_least_is_next_and_an_idle_one_gains_nothing() {
        let now = Instant::now();
        let (mut scheduler, _callers) = with(9, &[(1, Lane::Read), (1, Lane::Read), (2, Lane::Read)], now);
        scheduler.charge(1, 5 * SECOND);
        assert_eq!(order(&mut scheduler, now).iter().map(|(station, _)| *station).collect::<Vec<_>>(), [2, 1, 1]);
        // Station 3 comes late. It has not saved up what the others have used before it came.
        let mut scheduler = Scheduler::new(9, SECOND);
        let mut callers = Vec::new();
        let mut push = |scheduler: &mut Scheduler, station| {
            let (ticket, caller) = ticket(station, Lane::Read, now);
            callers.push(caller);
            assert!(scheduler.push(ticket, now).is_none());
        };
        push(&mut scheduler, 1);
        scheduler.charge(1, 10 * SECOND);
        push(&mut scheduler, 1);
        assert_eq!(scheduler.pop(now).map(|ticket| ticket.station), Some(1));
        push(&mut scheduler, 3);
        assert_eq!(scheduler.pop(now).map(|ticket| ticket.station), Some(1), "3 has begun where 1 is, and came later");
        assert_eq!(scheduler.pop(now).map(|ticket| ticket.station), Some(3));
    }

    #[test]
    fn a_station_that_is_blocked_is_passed_over_until_its_time_and_wakes_nobody_when_it_has_no_calls() {
        let now = Instant::now();
        let (mut scheduler, _callers) = with(9, &[(1, Lane::Control), (2, Lane::Read)], now);
        scheduler.block(1, now + SECOND);
        scheduler.block(7, now + SECOND / 2);
        assert_eq!(scheduler.next_unblocked(), Some(now + SECOND), "7 has nothing to be done");
        assert_eq!(order(&mut scheduler, now), [(2, Lane::Read)]);
        assert!(!scheduler.has_work(now) && scheduler.is_waiting(now));
        assert!(scheduler.has_work(now + SECOND));
        assert_eq!(order(&mut scheduler, now + SECOND), [(1, Lane::Control)]);
        assert_eq!(scheduler.next_unblocked(), None);
    }

    /// A call that is not put into a queue is treated as if it were in one.
    #[test]
    fn the_only_call_is_like_any_other() {
        let start = Instant::now();
        for seed in 0..500 {
            let mut random = Random::new(seed);
            let mut any = |n: u64| random.next() % n;
            let (mut one, mut other) = (Scheduler::new(3, SECOND), Scheduler::new(3, SECOND));
            let (mut now, mut calls, mut number) = (start, Vec::new(), 0);
            let shown =
                |ticket: Option<Ticket>| ticket.map(|ticket| (ticket.station, ticket.lane, ticket.retries_left));
            let all = |calls: VecDeque<Ticket>| calls.into_iter().map(|ticket| shown(Some(ticket))).collect::<Vec<_>>();
            for step in 0..200 {
                let (station, at) = (any(3) as u8, format!("seed {seed}, step {step}"));
                match any(12) {
                    0..=4 => {
                        let lane = [Lane::Control, Lane::Write, Lane::Read, Lane::Background][any(4) as usize];
                        let front = any(6) == 0;
                        number += 1;
                        let [first, second] = [&mut one, &mut other].map(|scheduler| {
                            let (mut ticket, caller) = ticket(station, lane, now);
                            ticket.retries_left = number;
                            let refused = if front {
                                scheduler.push_front(ticket);
                                None
                            } else {
                                scheduler.push(ticket, now)
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
    fn what_nobody_wants_any_more_is_no_work() {
        let now = Instant::now();
        let (mut scheduler, callers) = with(9, &[(1, Lane::Read), (1, Lane::Write)], now);
        assert!(scheduler.has_work(now) && scheduler.is_waiting(now));
        drop(callers);
        assert!(!scheduler.has_work(now));
        let (mut scheduler, _callers) = with(9, &[(1, Lane::Read)], now);
        assert!(!scheduler.is_waiting(now + 1000 * SECOND), "its time is up");
    }
}
