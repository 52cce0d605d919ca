//! One scan class of a station: its tags, its plans and its schedule.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::class::ScanClass;
use super::compiled_plan::CompiledPlan;
use super::cycle::{Cycle, CycleStart};
use super::schedule::ClassSchedule;
use super::stats::Counters;
use super::tag_map::TagMap;
use super::{Sample, Stamp, TagId};

#[derive(Debug)]
pub(super) struct ClassState {
    pub(super) scan: ScanClass,
    /// In the order in which they were added; those of a group are consecutive.
    pub(super) members: Vec<TagId>,
    pub(super) plan: Option<ClassPlan>,
    /// The start of the next cycle.
    pub(super) start: CycleStart,
    pub(super) schedule: ClassSchedule,
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
            schedule: ClassSchedule::new(due),
            cycle: None,
            next_aging: None,
            aged_at: None,
            stats: Counters::default(),
        }
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
