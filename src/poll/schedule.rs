//! Due times of classes: by period and phase, and early ones of tags without a reading.
//!
//! ```text
//! tags added ──▶ early time ──reached──▶ cycle ──completed──▶ due by period and phase
//!                    ▲                     │
//!                    └──── abandoned ──────┘ (after a pause that doubles, up to the period)
//! ```
//!
//! Invariants:
//! - A class has a reading once a period, at its phase, besides the early ones.
//! - Early cycles of a class begin at least [`EARLY_INTERVAL`] after its last cycle, so tags that are added one by one
//!   cause one a second at most.
//! - Early cycles of the stations of one line leave half of its time to other requests.
//! - A due time that passes while a cycle is running is an overrun, unless that cycle is an early one: its values are
//!   as good. An early cycle without values replaces no due time.
//! - A class with a phase has no early cycles.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::time::Instant;

use super::class::ScanClass;
use super::shared::lock;

/// Tags that are added within this time are in the same early cycle.
const GATHERING_TIME: Duration = Duration::from_millis(10);

/// The time between early cycles of different lines: connections to thousands of PLCs are not opened at once.
const LINE_INTERVAL: Duration = Duration::from_micros(200);

/// The time from the begin of a cycle to the next early one, and the first pause after one without values.
const EARLY_INTERVAL: Duration = Duration::from_secs(1);

/// The due times of new classes and tags, shared by the stations of a poller.
#[derive(Debug)]
pub(super) struct PollerSchedule {
    /// The phase of a [`ScanClass`] counts from here.
    epoch: Instant,
    /// No early cycle begins before.
    next_early: Mutex<Instant>,
}

/// The early cycles of the stations of one line.
#[derive(Debug)]
pub(super) struct LineSchedule {
    poller: Arc<PollerSchedule>,
    /// No early cycle begins before.
    next_early: Mutex<Instant>,
}

/// The due times of one class of a station.
#[derive(Debug)]
pub(super) struct ClassSchedule {
    /// The next due time by period and phase.
    due: Instant,
    /// The time of the next early cycle.
    early: Option<Instant>,
    /// The begin of the last cycle.
    began_at: Option<Instant>,
    /// `true` if the last cycle was an early one.
    is_early: bool,
    /// `true` if there are tags without a reading.
    is_unread: bool,
    /// The cycles without values since tags were added.
    failures: u32,
}

/// A due time, and the number of due times that were skipped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Due {
    pub(super) at: Instant,
    pub(super) overruns: u64,
}

impl PollerSchedule {
    pub(super) fn new(epoch: Instant) -> Self {
        Self { epoch, next_early: Mutex::new(epoch) }
    }

    /// Returns the next time for an early cycle of any line.
    fn reserve(&self, now: Instant) -> Instant {
        let mut next = lock(&self.next_early);
        let at = after(now, GATHERING_TIME).max(*next);
        *next = after(at, LINE_INTERVAL);
        at
    }
}

impl LineSchedule {
    pub(super) fn new(poller: Arc<PollerSchedule>) -> Self {
        let next_early = Mutex::new(poller.epoch);
        Self { poller, next_early }
    }

    /// Returns the next time for an early cycle that takes `time`.
    pub(super) fn reserve(&self, now: Instant, time: Duration) -> Instant {
        let mut next = lock(&self.next_early);
        let at = self.poller.reserve(now).max(*next);
        *next = after(at, time.saturating_mul(2));
        at
    }

    /// Returns when a class that is added now is due by its phase, or by `random` if it has none.
    pub(super) fn first_due(&self, scan: &ScanClass, now: Instant, random: u64) -> Instant {
        let period = scan.period.as_nanos().max(1);
        let nanoseconds = |n: u128| Duration::from_nanos(u64::try_from(n).unwrap_or(u64::MAX));
        match scan.phase {
            None => after(now, nanoseconds(u128::from(random).checked_rem(period).unwrap_or(0))),
            Some(phase) => {
                // The first due time that has not passed.
                let phase = phase.as_nanos().checked_rem(period).unwrap_or(0);
                let epoch = self.poller.epoch;
                let since = now.saturating_duration_since(epoch).as_nanos();
                let cycles = since.saturating_sub(phase).div_ceil(period);
                after(epoch, nanoseconds(cycles.saturating_mul(period).saturating_add(phase)))
            }
        }
    }
}

impl ClassSchedule {
    pub(super) fn new(due: Instant) -> Self {
        Self { due, early: None, began_at: None, is_early: false, is_unread: false, failures: 0 }
    }

    /// Tags were added, whose reading takes `time`. `is_running`: a cycle without them is running.
    pub(super) fn tags_added(
        &mut self,
        scan: &ScanClass,
        is_running: bool,
        line: &LineSchedule,
        now: Instant,
        time: Duration,
    ) {
        if scan.phase.is_some() {
            return;
        }
        (self.is_unread, self.failures) = (true, 0);
        let gathered = after(now, GATHERING_TIME);
        let is_due_soon = self.due <= gathered && !is_running;
        if self.early.is_some() || is_due_soon {
            return;
        }
        let paused = self.began_at.map(|at| after(at, EARLY_INTERVAL)).filter(|at| *at > gathered);
        self.early = Some(paused.unwrap_or_else(|| line.reserve(now, time)));
    }

    /// Returns when the next cycle begins, unless one is running then.
    pub(super) fn next_due(&self) -> Instant {
        self.early.map_or(self.due, |early| early.min(self.due))
    }

    /// Begins a cycle, while none is running. `None`: none is due.
    pub(super) fn begin(&mut self, scan: &ScanClass, now: Instant) -> Option<Due> {
        if self.next_due() > now {
            return None;
        }
        let early = self.early.take().filter(|_| self.due > now);
        (self.is_early, self.began_at) = (early.is_some(), Some(now));
        Some(match early {
            Some(at) => Due { at, overruns: 0 },
            // More than one due time has passed only if the task was not woken in time.
            None => self.skip_to(scan, now),
        })
    }

    /// Ends a cycle. Returns the number of due times that it has overrun. `is_complete`: it has read all tags that it
    /// began with, or found them to be refused.
    pub(super) fn end(&mut self, scan: &ScanClass, now: Instant, is_complete: bool) -> u64 {
        if is_complete {
            // Tags that were added meanwhile have an early time.
            (self.is_unread, self.failures) = (self.early.is_some(), 0);
        } else if self.is_unread && self.early.is_none() {
            let pause = EARLY_INTERVAL.saturating_mul(1_u32.checked_shl(self.failures).unwrap_or(u32::MAX));
            self.failures = self.failures.saturating_add(1);
            self.early = Some(after(now, pause.min(scan.period)));
        }
        if self.due > now || self.is_early && !is_complete {
            return 0;
        }
        self.skip_to(scan, now).overruns.saturating_add(u64::from(!self.is_early))
    }

    /// Returns the last due time that has come, with the number of those before it, and sets the next one.
    fn skip_to(&mut self, scan: &ScanClass, now: Instant) -> Due {
        let period = scan.period;
        let late = now.saturating_duration_since(self.due);
        let missed = late.as_nanos().checked_div(period.as_nanos()).unwrap_or(0);
        let by = Duration::from_nanos(u64::try_from(period.as_nanos().saturating_mul(missed)).unwrap_or(u64::MAX));
        let at = after(self.due, by);
        self.due = after(at, period);
        Due { at, overruns: u64::try_from(missed).unwrap_or(u64::MAX) }
    }
}

/// The instant `by` behind `at`, within the range of a clock.
fn after(at: Instant, by: Duration) -> Instant {
    at.checked_add(by).unwrap_or(at)
}
