use std::ops::Deref;
use std::time::Duration;

use super::ScanClass;

/// What has been done, since it began. A snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Counters {
    /// Cycles begun.
    pub cycles: u64,
    /// Cycles that were skipped, because the one before was not over, or nothing ran here.
    pub overruns: u64,
    /// Cycles that were given up, because an answer did not come.
    pub abandoned: u64,
    /// Requests sent.
    pub requests: u64,
    /// Requests that a PLC refused.
    pub refusals: u64,
    /// Requests without an answer.
    pub failures: u64,
    /// How long the last cycle took; of several classes, the longest of the last ones.
    pub last_cycle: Duration,
}

/// What a scan class does on one station: a snapshot. The [`Counters`] can be read as if they were its own.
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
    /// What it has done.
    pub counters: Counters,
}

/// What a [`Poller`](super::Poller) does: all its stations together. A snapshot. The [`Counters`] can be read as if they were
/// its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PollerStats {
    /// Stations with tags.
    pub stations: usize,
    /// Tags.
    pub tags: usize,
    /// Tags that their PLC refuses.
    pub refused_tags: usize,
    /// Samples given.
    pub samples: u64,
    /// Samples that were dropped, because they were not taken in time.
    pub missed: u64,
    /// What all of them have done, those included that are not polled any more.
    pub counters: Counters,
}

impl Counters {
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
        self.last_cycle = self.last_cycle.max(other.last_cycle);
    }
}

impl PollerStats {
    /// A station with these classes, which has done this.
    pub(super) fn count(&mut self, classes: impl Iterator<Item = ClassStats>, counters: &Counters) {
        let tags = self.tags;
        for class in classes {
            self.tags = self.tags.saturating_add(class.tags);
            self.refused_tags = self.refused_tags.saturating_add(class.refused_tags);
        }
        self.stations = self.stations.saturating_add(usize::from(self.tags > tags));
        self.counters.add(counters);
    }
}

impl Deref for ClassStats {
    type Target = Counters;

    fn deref(&self) -> &Counters {
        &self.counters
    }
}

impl Deref for PollerStats {
    type Target = Counters;

    fn deref(&self) -> &Counters {
        &self.counters
    }
}
