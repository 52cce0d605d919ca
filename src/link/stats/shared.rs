//! The counters and states of a link while it works.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::watch;

use super::{LinkCounters, LinkStats, StationState, StationStats, add};
use crate::link::by_station::ByStation;
use crate::link::nanoseconds;
use crate::link::watchable::Watchable;
use crate::wire::Discard;

/// The counters and states of a link, shared by its task and its handles.
#[derive(Debug, Default)]
pub(crate) struct SharedStats {
    records: Mutex<Records>,
    /// In nanoseconds: it lasts for more than 500 years. Not under the lock, which is taken once for a
    /// reply already.
    bus_time: AtomicU64,
}

#[derive(Debug, Default)]
struct Records {
    link: LinkCounters,
    stations: ByStation<StationRecord>,
}

#[derive(Debug)]
struct StationRecord {
    stats: StationStats,
    state: Watchable<StationState>,
}

impl StationRecord {
    fn new() -> Self {
        Self { stats: StationStats::default(), state: Watchable::new(StationState::default()) }
    }

    fn set_state(&mut self, state: StationState) {
        if *self.state.get() != state {
            self.state.set(state);
        }
    }
}

impl SharedStats {
    pub(crate) fn link_stats(&self) -> LinkStats {
        let records = self.lock();
        let stations = records.stations.values().fold(StationStats::default(), |sum, record| sum.plus(&record.stats));
        records.link.with(stations, Duration::from_nanos(self.bus_time.load(Ordering::Relaxed)))
    }

    pub(crate) fn station_stats(&self, station: u8) -> StationStats {
        self.lock().stations.get(station).map(|record| record.stats).unwrap_or_default()
    }

    pub(crate) fn watch_state(&self, station: u8) -> watch::Receiver<StationState> {
        self.lock().stations.with(station, StationRecord::new, |record| record.state.watch())
    }

    pub(crate) fn count_link(&self, count: impl FnOnce(&mut LinkCounters)) {
        count(&mut self.lock().link);
    }

    /// Adds to the time in which the line was in use. Only the core adds, one thread at a time.
    pub(crate) fn add_bus_time(&self, time: Duration) {
        let before = self.bus_time.load(Ordering::Relaxed);
        self.bus_time.store(before.saturating_add(nanoseconds(time)), Ordering::Relaxed);
    }

    pub(crate) fn count_station(&self, station: u8, count: impl FnOnce(&mut StationStats)) {
        self.lock().stations.with(station, StationRecord::new, |record| count(&mut record.stats));
    }

    /// Notes that a station has answered.
    pub(crate) fn mark_online(&self, station: u8, count: impl FnOnce(&mut StationStats)) {
        self.lock().stations.with(station, StationRecord::new, |record| {
            record.set_state(StationState::Online);
            count(&mut record.stats);
        });
    }

    /// Notes that a job was rewound.
    pub(crate) fn count_repeated_job(&self, station: u8) {
        self.count_station(station, |stats| add(&mut stats.repeated_jobs, 1));
    }

    pub(crate) fn count_discarded(&self, reason: Discard, bytes: usize) {
        self.count_link(|link| match reason {
            Discard::WrongSide => add(&mut link.rare().echoes, 1),
            Discard::Garbage | Discard::Truncated | Discard::BadChecksum | Discard::Malformed | Discard::TooLong => {
                add(&mut link.garbage_bytes, u64::try_from(bytes).unwrap_or(u64::MAX));
                add(&mut link.checksum_errors, u64::from(reason == Discard::BadChecksum));
            }
        });
    }

    pub(crate) fn set_state(&self, station: u8, state: StationState) {
        self.lock().stations.with(station, StationRecord::new, |record| record.set_state(state));
    }

    fn lock(&self) -> MutexGuard<'_, Records> {
        // No code panics while it holds this lock.
        self.records.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::link::stats::RoundTripStats;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn link_stats_are_the_sum_of_all_stations() {
        let stats = SharedStats::default();
        stats.count_station(1, |stats| stats.replied(20 * MS, false));
        stats.count_station(2, |stats| stats.replied(40 * MS, true));
        stats.count_station(9, |stats| add(&mut stats.requests, 3));
        let sum = stats.link_stats().stations;
        let round_trip = RoundTripStats { last: 40 * MS, shortest: 20 * MS, longest: 40 * MS, smoothed: 30 * MS };
        assert_eq!((sum.requests, sum.replies, sum.refusals, sum.round_trip), (3, 2, 1, Some(round_trip)));
        assert_eq!((stats.station_stats(2).refusals, stats.station_stats(3)), (1, StationStats::default()));
    }

    #[test]
    fn discarded_bytes_are_counted_by_reason() {
        let stats = SharedStats::default();
        stats.count_discarded(Discard::Garbage, 3);
        stats.count_discarded(Discard::BadChecksum, 10);
        stats.count_discarded(Discard::Truncated, 4);
        stats.count_discarded(Discard::WrongSide, 100);
        let stats = stats.link_stats();
        assert_eq!((stats.garbage_bytes, stats.checksum_errors, stats.echoes), (17, 1, 1));
    }

    #[test]
    fn a_watcher_sees_a_state_only_when_it_changes() {
        let stats = SharedStats::default();
        stats.set_state(1, StationState::Online);
        let mut watcher = stats.watch_state(1);
        assert_eq!(*watcher.borrow_and_update(), StationState::Online);
        stats.set_state(1, StationState::Online);
        assert!(!watcher.has_changed().expect("the sender exists"));
        stats.set_state(1, StationState::Unknown);
        assert!(watcher.has_changed().expect("the sender exists"));
        assert_eq!(*watcher.borrow(), StationState::Unknown);
        assert_eq!(*stats.watch_state(2).borrow(), StationState::Unknown);
    }
}
