use std::ops::Deref;
use std::time::Duration;

use super::ScanClass;

/// Counters since the start of polling. A snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Counters {
    /// Cycles started.
    pub cycles: u64,
    /// Cycles that have ended, with those that were abandoned. Their samples are queued.
    pub completed: u64,
    /// Cycles that were skipped: the previous one was running, or the task was not scheduled.
    pub overruns: u64,
    /// Cycles that were abandoned because a reply did not come.
    pub abandoned: u64,
    /// Requests sent.
    pub requests: u64,
    /// Requests that the PLC refused.
    pub refusals: u64,
    /// Requests without a reply.
    pub failures: u64,
    /// Duration of the last cycle; of several classes, the longest of their last cycles.
    pub last_cycle: Duration,
}

/// Statistics of a scan class on one station. A snapshot. Dereferences to its [`Counters`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ClassStats {
    /// The class.
    pub class: ScanClass,
    /// Tags in the class.
    pub tags: usize,
    /// Tags that the PLC refuses.
    pub refused_tags: usize,
    /// Requests that read the other tags; 0 until the first cycle after a change.
    pub requests_per_cycle: usize,
    /// Counters of the class.
    pub counters: Counters,
}

/// Statistics of a [`Poller`](super::Poller): the sum over its stations. A snapshot.
///
/// Dereferences to its [`Counters`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PollerStats {
    /// Stations with tags.
    pub stations: usize,
    /// Tags.
    pub tags: usize,
    /// Tags that their PLC refuses.
    pub refused_tags: usize,
    /// Samples queued.
    pub samples: u64,
    /// Samples dropped because the consumer was too slow.
    pub missed: u64,
    /// Counters of all stations, including those that are not polled any more.
    pub counters: Counters,
}

impl Counters {
    /// Adds the counters of another class or station.
    pub(super) fn add(&mut self, other: &Self) {
        let sums = [
            (&mut self.cycles, other.cycles),
            (&mut self.completed, other.completed),
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
    /// Adds a station with these classes and counters.
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
