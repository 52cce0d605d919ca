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
    /// Bus time of timeouts that need not be charged.
    allowance: Duration,
}

/// The allowance grows by the bus time divided by this.
const ALLOWANCE_SHARE: u32 = 50;

/// Distance to the last station of a round.
const BEHIND: Duration = Duration::from_micros(1);

/// The most that the allowance can be.
const MAX_ALLOWANCE: Duration = Duration::from_secs(2);

#[derive(Debug, Default)]
struct Queues {
    service: Service,
    /// Made by the first call that waits in them: on most links none does.
    lanes: Option<Box<Lanes>>,
}

type Lanes = [VecDeque<PendingCall>; Lane::COUNT];

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
    fn lane(&mut self, lane: Lane) -> &mut VecDeque<PendingCall> {
        of_lane(self.lanes.get_or_insert_default(), lane)
    }

    fn len(&self) -> usize {
        self.lanes().iter().map(VecDeque::len).sum()
    }

    /// All lanes, from the best one; none if no call ever waited in them.
    fn lanes(&self) -> &[VecDeque<PendingCall>] {
        self.lanes.as_deref().map_or(&[], <[_; Lane::COUNT]>::as_slice)
    }

    fn lanes_mut(&mut self) -> &mut [VecDeque<PendingCall>] {
        self.lanes.as_deref_mut().map_or(&mut [], <[_; Lane::COUNT]>::as_mut_slice)
    }
}

impl Scheduler {
    pub(crate) fn new(capacity: usize, ageing: Duration) -> Self {
        Self {
            only: None,
            queued: 0,
            stations: ByStation::new(),
            capacity,
            ageing,
            served: Duration::ZERO,
            allowance: MAX_ALLOWANCE,
        }
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
                queues.lanes_mut().iter_mut().for_each(|lane| lane.retain(|waiting| keep(waiting, now)));
            }
            let left = before.saturating_sub(queues.len());
            if queues.len() >= capacity {
                return (Some(call), left);
            }
            queues.lane(call.lane).push_back(call);
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
        self.queues(call.station, |queues| queues.lane(call.lane).push_front(call));
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
                    let call = self.stations.get_mut(station)?.lanes_mut().get_mut(lane)?.pop_front()?;
                    self.count_removed(1);
                    call
                }
            };
            self.served = self.stations.with(call.station, Queues::default, |queues| {
                *of_lane(&mut queues.service.served_at, call.lane) = Some(now);
                queues.service.used
            });
            if keep(&call, now) {
                return Some(call);
            }
        }
    }

    /// Returns whether a write or a control command waits.
    pub(crate) fn has_write(&self) -> bool {
        let writes = |queues: &Queues| {
            queues
                .lanes
                .as_deref()
                .is_some_and(|[control, write, _read, _background]| !control.is_empty() || !write.is_empty())
        };
        self.only.as_ref().is_some_and(PendingCall::is_write) || self.queued > 0 && self.stations.values().any(writes)
    }

    /// Returns whether a call waits, wanted or not.
    #[inline]
    pub(crate) fn has_calls(&self) -> bool {
        self.only.is_some() || self.queued > 0
    }

    /// Returns whether a call waits whose station may be served now.
    pub(crate) fn has_work(&mut self, now: Instant) -> bool {
        self.only.take_if(|call| !keep(call, now));
        if self.only.is_some() {
            return true;
        }
        while let Some((station, lane)) = self.next(now) {
            let queue = self.stations.get_mut(station).and_then(|queues| queues.lanes_mut().get_mut(lane));
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

    /// Returns whether a wanted call waits, for any station.
    pub(crate) fn is_waiting(&mut self, now: Instant) -> bool {
        self.only.take_if(|call| !keep(call, now));
        if self.queued > 0 {
            let queues = self.stations.values_mut().flat_map(|queues| queues.lanes_mut());
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
            Some(queues) => queues.lanes_mut().iter_mut().flat_map(std::mem::take).collect(),
            None => VecDeque::new(),
        };
        self.count_removed(calls.len());
        calls
    }

    /// Takes all calls.
    pub(crate) fn drain_all(&mut self) -> VecDeque<PendingCall> {
        self.queue_only();
        self.queued = 0;
        let queues = self.stations.values_mut().flat_map(|queues| queues.lanes_mut());
        queues.flat_map(std::mem::take).collect()
    }

    /// Adds a timeout to the used bus time of a station, but no more than a place at the end of the
    /// present round if the allowance covers the rest. So a station that has lost one reply is
    /// served again in the next round, and one that loses many pays for them.
    pub(crate) fn charge_timeout(&mut self, station: u8, time: Duration) {
        let used = |queues: &Queues| queues.service.used;
        let others = self.stations.iter().filter(|&(other, queues)| other != station && queues.len() > 0);
        let end_of_round = others.map(|(_, queues)| used(queues)).max().unwrap_or(self.served);
        let before = self.stations.get(station).map(used).unwrap_or_default();
        let behind = end_of_round.max(before).saturating_add(BEHIND);
        let debt = before.saturating_add(time).saturating_sub(behind);
        let Some(rest) = self.allowance.checked_sub(debt) else { return self.charge(station, time) };
        self.allowance = rest;
        self.charge(station, time.saturating_sub(debt));
    }

    /// Forgets what a station has used more than others: it is back after it was offline.
    pub(crate) fn forgive(&mut self, station: u8) {
        let served = self.served;
        self.queues(station, |queues| queues.service.used = queues.service.used.min(served));
    }

    /// Adds to the used bus time of a station.
    pub(crate) fn charge(&mut self, station: u8, time: Duration) {
        if self.allowance < MAX_ALLOWANCE {
            let grown = time.checked_div(ALLOWANCE_SHARE).unwrap_or_default();
            self.allowance = self.allowance.saturating_add(grown).min(MAX_ALLOWANCE);
        }
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
            let lanes = queues.lanes().iter().enumerate();
            lanes.filter_map(move |(lane, queue)| Some((station, queues, lane, queue.front()?)))
        })
    }

    /// The lane, less one for each ageing period since then.
    fn rank(&self, lane: usize, since: Instant, now: Instant) -> u128 {
        let waited = now.saturating_duration_since(since).as_nanos();
        // Without ageing no call rises.
        let risen = waited.checked_div(self.ageing.as_nanos()).unwrap_or_default();
        u128::try_from(lane).unwrap_or(u128::MAX).saturating_sub(risen)
    }
}

/// Returns whether a call is still wanted; ends it if not.
fn keep(call: &PendingCall, now: Instant) -> bool {
    let wanted = call.is_wanted(now);
    if !wanted {
        call.expire();
    }
    wanted
}

/// The entry of a lane. Lanes are numbered from the best one.
fn of_lane<T>(lanes: &mut [T; Lane::COUNT], lane: Lane) -> &mut T {
    let [control, write, read, background] = lanes;
    match lane {
        Lane::Control => control,
        Lane::Write => write,
        Lane::Read => read,
        Lane::Background => background,
    }
}

#[cfg(test)]
mod tests;
