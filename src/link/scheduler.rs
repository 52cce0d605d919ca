//! Which call is next.
//!
//! Every station has a bounded queue for each [`Lane`]. Within a lane it is the turn of the station that has used the
//! least bus time, so that a slow or dead station costs the others no more than its share. Among the lanes the best one
//! comes first; but a call rises by one lane for each [`Scheduler::ageing`] that it has waited while nothing of its lane
//! was served at its station, so that no lane starves another.
//!
//! What must always hold: a queue is never longer than its bound; calls of one station and lane keep their order; a
//! station that was idle gains no credit for it.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

use super::by_station::ByStation;
use super::call::Ticket;
use super::options::Lane;

#[derive(Debug)]
pub(crate) struct Scheduler {
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
    lanes: [VecDeque<Ticket>; Lane::COUNT],
    /// How much bus time it has used, as far as that matters for fairness.
    used: Duration,
    /// When each of its lanes was served last.
    served_at: [Option<Instant>; Lane::COUNT],
    /// Not served before then.
    blocked_until: Option<Instant>,
}

impl Queues {
    fn len(&self) -> usize {
        self.lanes.iter().map(VecDeque::len).sum()
    }
}

impl Scheduler {
    pub(crate) fn new(capacity: usize, ageing: Duration) -> Self {
        Self { stations: ByStation::new(), capacity, ageing, served: Duration::ZERO }
    }

    /// Puts a call at the end of its queue; gives it back when the station's queues are full.
    #[must_use]
    pub(crate) fn push(&mut self, ticket: Ticket, now: Instant) -> Option<Ticket> {
        let capacity = self.capacity;
        self.queues(ticket.station, |queues| {
            if queues.len() >= capacity {
                queues.lanes.iter_mut().for_each(|lane| lane.retain(|waiting| keep(waiting, now)));
            }
            if queues.len() >= capacity {
                return Some(ticket);
            }
            if let Some(lane) = queues.lanes.get_mut(index(ticket.lane)) {
                lane.push_back(ticket);
            }
            None
        })
    }

    /// Puts a call that was taken back before all others of its queue. It had its place, so no bound applies.
    pub(crate) fn push_front(&mut self, ticket: Ticket) {
        self.queues(ticket.station, |queues| {
            if let Some(lane) = queues.lanes.get_mut(index(ticket.lane)) {
                lane.push_front(ticket);
            }
        });
    }

    /// Takes the next call that is still wanted, if there is one whose station may be served.
    pub(crate) fn pop(&mut self, now: Instant) -> Option<Ticket> {
        loop {
            let (station, lane) = self.next(now)?;
            let queues = self.stations.get_mut(station)?;
            let ticket = queues.lanes.get_mut(lane)?.pop_front()?;
            self.served = queues.used;
            if let Some(served_at) = queues.served_at.get_mut(lane) {
                *served_at = Some(now);
            }
            if keep(&ticket, now) {
                return Some(ticket);
            }
        }
    }

    /// Whether a call is waiting whose station may be served now.
    pub(crate) fn has_work(&mut self, now: Instant) -> bool {
        while let Some((station, lane)) = self.next(now) {
            let queue = self.stations.get_mut(station).and_then(|queues| queues.lanes.get_mut(lane));
            match queue {
                Some(queue) if queue.front().is_some_and(|ticket| keep(ticket, now)) => return true,
                Some(queue) => drop(queue.pop_front()),
                None => return false,
            }
        }
        false
    }

    /// Whether a call is waiting that is still wanted, may its station be served or not.
    pub(crate) fn is_waiting(&mut self, now: Instant) -> bool {
        let queues = self.stations.values_mut().flat_map(|queues| queues.lanes.iter_mut());
        queues.fold(false, |waiting, queue| {
            queue.retain(|ticket| keep(ticket, now));
            waiting || !queue.is_empty()
        })
    }

    /// Takes every call of a station.
    pub(crate) fn drain(&mut self, station: u8) -> VecDeque<Ticket> {
        match self.stations.get_mut(station) {
            Some(queues) => queues.lanes.iter_mut().flat_map(std::mem::take).collect(),
            None => VecDeque::new(),
        }
    }

    /// Takes every call.
    pub(crate) fn drain_all(&mut self) -> VecDeque<Ticket> {
        let queues = self.stations.values_mut().flat_map(|queues| queues.lanes.iter_mut());
        queues.flat_map(std::mem::take).collect()
    }

    /// Counts bus time that a station has used.
    pub(crate) fn charge(&mut self, station: u8, time: Duration) {
        self.queues(station, |queues| queues.used = queues.used.saturating_add(time));
    }

    /// Does not serve a station before then.
    pub(crate) fn block(&mut self, station: u8, until: Instant) {
        self.queues(station, |queues| queues.blocked_until = Some(until));
    }

    /// When the next station that is blocked and has calls may be served.
    pub(crate) fn next_unblocked(&self) -> Option<Instant> {
        self.stations.values().filter(|queues| queues.len() > 0).filter_map(|queues| queues.blocked_until).min()
    }

    fn queues<R>(&mut self, station: u8, work: impl FnOnce(&mut Queues) -> R) -> R {
        let served = self.served;
        self.stations.with(station, Queues::default, |queues| {
            if queues.len() == 0 {
                queues.used = queues.used.max(served);
            }
            work(queues)
        })
    }

    /// The station and lane whose turn it is.
    fn next(&self, now: Instant) -> Option<(u8, usize)> {
        // Of each lane, the station whose turn it is.
        let mut turns: [Option<(Duration, Instant, u8)>; Lane::COUNT] = [None; Lane::COUNT];
        for (station, queues) in self.stations.iter() {
            if queues.blocked_until.is_some_and(|until| now < until) {
                continue;
            }
            for (turn, lane) in turns.iter_mut().zip(&queues.lanes) {
                let Some(ticket) = lane.front() else { continue };
                let waits = (queues.used, ticket.queued_at, station);
                if turn.is_none_or(|turn| waits < turn) {
                    *turn = Some(waits);
                }
            }
        }
        let turns = turns.into_iter().enumerate();
        let mut lanes = turns.filter_map(|(lane, turn)| turn.map(|(_, queued_at, station)| (lane, queued_at, station)));
        let (lane, queued_at, station) = lanes.next()?;
        let Some(second) = lanes.next() else {
            // Mostly there is one: nothing is to be weighed.
            return Some((station, lane));
        };
        let ranked = [(lane, queued_at, station), second].into_iter().chain(lanes).map(|(lane, queued_at, station)| {
            let served_at = self.stations.get(station).and_then(|queues| *queues.served_at.get(lane)?);
            (self.rank(lane, served_at.map_or(queued_at, |at| at.max(queued_at)), now), lane, station)
        });
        ranked.min().map(|(_, lane, station)| (station, lane))
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
