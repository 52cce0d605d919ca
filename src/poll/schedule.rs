//! When the classes of the stations of a poller are due for the first time.

use std::sync::Mutex;
use std::time::Duration;

use tokio::time::Instant;

use super::class::ScanClass;
use super::shared::lock;

/// The time in which tags are added that the first reading of a class has together.
const GATHERING_TIME: Duration = Duration::from_millis(10);

/// The time between first readings of two classes of any stations: connections to thousands of PLCs are not opened at
/// once.
const FIRST_READING_INTERVAL: Duration = Duration::from_micros(200);

/// The due times of new classes, shared by the stations of a poller.
#[derive(Debug)]
pub(super) struct Schedule {
    /// The phase of a [`ScanClass`] counts from here.
    epoch: Instant,
    /// No first reading is due before.
    next_first_reading: Mutex<Instant>,
}

impl Schedule {
    pub(super) fn new(epoch: Instant) -> Self {
        Self { epoch, next_first_reading: Mutex::new(epoch) }
    }

    /// Returns when a class that is added now is due by its phase, or by `random` if it has none.
    pub(super) fn first_due(&self, scan: &ScanClass, now: Instant, random: u64) -> Instant {
        let period = scan.period.as_nanos().max(1);
        let nanoseconds = |n: u128| Duration::from_nanos(u64::try_from(n).unwrap_or(u64::MAX));
        match scan.phase {
            None => {
                let phase = u128::from(random).checked_rem(period).unwrap_or(0);
                now.checked_add(nanoseconds(phase)).unwrap_or(now)
            }
            Some(phase) => {
                // The first due time that has not passed.
                let phase = phase.as_nanos().checked_rem(period).unwrap_or(0);
                let since = now.saturating_duration_since(self.epoch).as_nanos();
                let cycles = since.saturating_sub(phase).div_ceil(period);
                let due = self.epoch.checked_add(nanoseconds(cycles.saturating_mul(period).saturating_add(phase)));
                due.unwrap_or(now)
            }
        }
    }

    /// Returns when the tags that are added from now on are together.
    pub(super) fn gathered(now: Instant) -> Instant {
        now.checked_add(GATHERING_TIME).unwrap_or(now)
    }

    /// Returns when a class that is added now may be read ahead of its due time.
    pub(super) fn next_first_reading(&self, now: Instant) -> Instant {
        let mut next = lock(&self.next_first_reading);
        let at = Self::gathered(now).max(*next);
        *next = at.checked_add(FIRST_READING_INTERVAL).unwrap_or(at);
        at
    }
}
