//! One scan class of a station: its tags, its plans and its schedule.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::class::ScanClass;
use super::compiled_plan::CompiledPlan;
use super::cycle::{Cycle, CycleStart};
use super::schedule::Schedule;
use super::stats::Counters;
use super::tag_map::TagMap;
use super::{Sample, Stamp, TagId};

/// The time from the begin of a cycle to one ahead of the due time.
const EARLY_INTERVAL: Duration = Duration::from_secs(1);

#[derive(Debug)]
pub(super) struct ClassState {
    pub(super) scan: ScanClass,
    /// In the order in which they were added; those of a group are consecutive.
    pub(super) members: Vec<TagId>,
    pub(super) plan: Option<ClassPlan>,
    /// The start of the next cycle.
    pub(super) start: CycleStart,
    /// The next due time by period and phase.
    due: Instant,
    /// The time of a cycle ahead of the due time, for tags without a reading.
    early: Option<Instant>,
    /// `true` if the last cycle began ahead of its due time.
    began_early: bool,
    /// The time at which the last cycle began.
    began_at: Option<Instant>,
    pub(super) cycle: Option<Box<Cycle>>,
    /// A lower bound of the next time at which age changes the quality of a tag.
    pub(super) next_aging: Option<Instant>,
    /// The time of the last check of the ages.
    aged_at: Option<Instant>,
    pub(super) stats: Counters,
}

/// The plans of a class.
#[derive(Debug)]
pub(super) struct ClassPlan {
    pub(super) plans: Vec<Arc<CompiledPlan>>,
    /// The response time that it was made with.
    pub(super) response_time: Duration,
    pub(super) made_at: Instant,
}

impl ClassState {
    pub(super) fn new(scan: ScanClass, due: Instant) -> Self {
        Self {
            scan,
            members: Vec::new(),
            plan: None,
            start: CycleStart::default(),
            due,
            early: None,
            began_early: false,
            began_at: None,
            cycle: None,
            next_aging: None,
            aged_at: None,
            stats: Counters::default(),
        }
    }

    /// Schedules a cycle for tags that were added, if the next one is not due soon. A class with a phase is read at
    /// no other times.
    pub(super) fn read_early(&mut self, schedule: &Schedule, now: Instant) {
        if self.scan.phase.is_some() || self.early.is_some() {
            return;
        }
        let at = match self.began_at {
            None => schedule.next_first_reading(now),
            // Tags that are added one by one cause one more cycle a second at most.
            Some(began_at) => began_at.checked_add(EARLY_INTERVAL).unwrap_or(now).max(Schedule::gathered(now)),
        };
        self.early = Some(at).filter(|at| *at < self.due);
    }

    /// Returns when the next cycle begins, unless one is running then.
    pub(super) fn next_due(&self) -> Instant {
        self.early.map_or(self.due, |early| early.min(self.due))
    }

    /// Returns the due time of the cycle that begins now; `None` if it is not due, or one is running.
    pub(super) fn begin(&mut self, now: Instant) -> Option<Instant> {
        if self.cycle.is_some() || self.next_due() > now {
            return None;
        }
        let early = self.early.take().filter(|_| self.due > now);
        (self.began_early, self.began_at) = (early.is_some(), Some(now));
        // More than one due time has passed only if the task was not woken in time.
        Some(early.unwrap_or_else(|| self.skip_to(now)))
    }

    /// Returns the last due time that has come, counts the skipped ones, and sets the next one.
    fn skip_to(&mut self, now: Instant) -> Instant {
        let late = now.saturating_duration_since(self.due);
        let missed = late.as_nanos().checked_div(self.scan.period.as_nanos()).unwrap_or(0);
        self.stats.overruns = self.stats.overruns.saturating_add(u64::try_from(missed).unwrap_or(u64::MAX));
        let due = self.due_after(missed);
        self.due = due.checked_add(self.scan.period).unwrap_or(due);
        due
    }

    /// Skips and counts the due times that have passed while a cycle was running. The first one behind the begin of an
    /// early cycle is no overrun.
    pub(super) fn skip_overruns(&mut self, now: Instant) {
        if self.due <= now {
            self.skip_to(now);
            self.stats.overruns = self.stats.overruns.saturating_add(u64::from(!self.began_early));
        }
    }

    fn due_after(&self, periods: u128) -> Instant {
        let nanoseconds = self.scan.period.as_nanos().saturating_mul(periods);
        let by = Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX));
        self.due.checked_add(by).unwrap_or(self.due)
    }

    /// Updates the quality of the tags by their age.
    pub(super) fn age(&mut self, now: Stamp, tag_map: &mut TagMap, samples: &mut Vec<Sample>) {
        let (stale, bad) = (self.scan.stale_age(), self.scan.bad_age());
        for id in &self.members {
            if let Some(state) = tag_map.get_mut(*id) {
                state.age(now, stale, bad, samples);
            }
        }
        self.aged_at = Some(now.instant);
        self.schedule_aging(tag_map);
    }

    /// Returns when to call [`age`](Self::age): with a pause after the last call, so that a
    /// thousand tags that age one after the other are checked together.
    pub(super) fn next_age_check(&self) -> Option<Instant> {
        let next_aging = self.next_aging?;
        let pause = self.scan.stale_age().checked_div(16).unwrap_or(Duration::ZERO).max(Duration::from_millis(10));
        let pause_ends = self.aged_at.and_then(|at| at.checked_add(pause));
        Some(pause_ends.map_or(next_aging, |end| next_aging.max(end)))
    }

    pub(super) fn schedule_aging(&mut self, tag_map: &TagMap) {
        let (stale, bad) = (self.scan.stale_age(), self.scan.bad_age());
        let times = self.members.iter().filter_map(|id| tag_map.get(*id)?.next_aging(stale, bad));
        self.next_aging = times.min();
    }
}
