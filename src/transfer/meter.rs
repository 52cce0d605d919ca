//! Progress of one phase.

use tokio::time::Instant;

use super::step::Position;
use crate::progress::Progress;

/// Counts steps and bytes of one phase. The caller supplies the time.
#[derive(Clone, Debug)]
pub(crate) struct Meter {
    position: Position,
    since: Instant,
    kept: usize,
    bytes: u64,
}

impl Meter {
    /// A phase begins at this position.
    pub(crate) fn new(start: Position, now: Instant) -> Self {
        Self { position: start, since: now, kept: start.done, bytes: 0 }
    }

    /// Returns whether this position belongs to the same phase. A phase that went back begins anew.
    pub(crate) fn continues_at(&self, position: Position) -> bool {
        self.position.phase == position.phase && self.position.done <= position.done
    }

    pub(crate) fn advance(&mut self, position: Position, bytes: usize) {
        self.position = position;
        // Limit: a transfer of 2^64 bytes does not exist.
        self.bytes = self.bytes.saturating_add(u64::try_from(bytes).unwrap_or(u64::MAX));
    }

    pub(crate) fn progress(&self, now: Instant) -> Progress {
        let Position { phase, done, total } = self.position;
        let elapsed = now.saturating_duration_since(self.since);
        Progress { phase, done, total, bytes: self.bytes, elapsed, kept: self.kept }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::progress::Phase;

    #[test]
    fn rate_and_time_left_count_this_run_only() {
        let (start, at) = (Instant::now(), |done| Position { phase: Phase::Reading, done, total: 10 });
        let mut meter = Meter::new(at(4), start);
        assert_eq!(meter.progress(start).time_left(), None);
        assert_eq!(meter.progress(start).bytes_per_second(), None);
        meter.advance(at(6), 256);
        let progress = meter.progress(start + Duration::from_secs(2));
        assert_eq!(progress.time_left(), Some(Duration::from_secs(4)));
        assert_eq!(progress.bytes_per_second(), Some(128.0));
        assert_eq!(progress.to_string(), "reading: 6 of 10, 256 bytes, 128 bytes/s, 4 s left");
        meter.advance(at(10), 512);
        let progress = meter.progress(start + Duration::from_secs(6));
        assert!(progress.is_complete());
        assert_eq!(progress.to_string(), "reading: 10 of 10, 768 bytes, 128 bytes/s");
    }

    #[test]
    fn a_phase_that_goes_back_or_changes_begins_anew() {
        let at = |phase, done| Position { phase, done, total: 10 };
        let meter = Meter::new(at(Phase::Comparing, 4), Instant::now());
        assert!(meter.continues_at(at(Phase::Comparing, 4)) && meter.continues_at(at(Phase::Comparing, 5)));
        assert!(!meter.continues_at(at(Phase::Comparing, 3)) && !meter.continues_at(at(Phase::Writing, 5)));
    }
}
