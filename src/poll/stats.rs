use std::time::Duration;

use super::ScanClass;

/// What a scan class does on one station: a snapshot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ClassStats {
    /// The class.
    pub class: ScanClass,
    /// How many tags it has now.
    pub tags: usize,
    /// How many of them the PLC refuses.
    pub refused_tags: usize,
    /// How many requests read the others; 0 before the first cycle, and after a change until the next.
    pub requests_per_cycle: usize,
    /// Cycles begun.
    pub cycles: u64,
    /// Cycles that were skipped, because the one before was not over, or nothing ran here.
    pub overruns: u64,
    /// Cycles that were given up, because an answer did not come.
    pub abandoned: u64,
    /// Requests sent.
    pub requests: u64,
    /// Requests that the PLC refused.
    pub refusals: u64,
    /// Requests without an answer.
    pub failures: u64,
    /// How long the last cycle took.
    pub last_cycle: Duration,
}

impl ClassStats {
    pub(super) fn new(class: ScanClass) -> Self {
        Self {
            class,
            tags: 0,
            refused_tags: 0,
            requests_per_cycle: 0,
            cycles: 0,
            overruns: 0,
            abandoned: 0,
            requests: 0,
            refusals: 0,
            failures: 0,
            last_cycle: Duration::ZERO,
        }
    }
}

/// What a [`Poller`](super::Poller) does: all its stations together. A snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PollerStats {
    /// Stations with tags.
    pub stations: usize,
    /// Tags.
    pub tags: usize,
    /// Tags that their PLC refuses.
    pub refused_tags: usize,
    /// Cycles begun.
    pub cycles: u64,
    /// Cycles that were skipped.
    pub overruns: u64,
    /// Cycles that were given up.
    pub abandoned: u64,
    /// Requests sent.
    pub requests: u64,
    /// Requests that a PLC refused.
    pub refusals: u64,
    /// Requests without an answer.
    pub failures: u64,
    /// Samples given.
    pub samples: u64,
    /// Samples that were dropped, because they were not taken in time.
    pub missed: u64,
}

impl PollerStats {
    /// What a class has, and has done.
    pub(super) fn count(&mut self, class: &ClassStats) {
        self.tags = self.tags.saturating_add(class.tags);
        self.refused_tags = self.refused_tags.saturating_add(class.refused_tags);
        self.count_done(class);
    }

    /// What a class has done: it is no more.
    pub(super) fn count_done(&mut self, class: &ClassStats) {
        self.add(&Self {
            cycles: class.cycles,
            overruns: class.overruns,
            abandoned: class.abandoned,
            requests: class.requests,
            refusals: class.refusals,
            failures: class.failures,
            ..Self::default()
        });
    }

    /// Adds what others have done.
    pub(super) fn add(&mut self, other: &Self) {
        let sums = [
            (&mut self.cycles, other.cycles),
            (&mut self.overruns, other.overruns),
            (&mut self.abandoned, other.abandoned),
            (&mut self.requests, other.requests),
            (&mut self.refusals, other.refusals),
            (&mut self.failures, other.failures),
        ];
        sums.into_iter().for_each(|(sum, count)| *sum = sum.saturating_add(count));
    }
}
