//! Counters of replies, errors and round trips.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use fatek::poll::{Missed, Quality};
use fatek::tag::TagValue;

/// Counters of all PLCs.
#[derive(Debug)]
pub(crate) struct Counters {
    /// Per PLC, whether it has answered since the start or since
    /// [`forget_answers`](Self::forget_answers).
    answered: Vec<AtomicBool>,
    answered_count: AtomicU32,
    /// `true` if the simulator is down, so that calls must fail.
    down: AtomicBool,
    replies: AtomicU64,
    errors: AtomicU64,
    failed_while_down: AtomicU64,
    late: AtomicU64,
    round_trips: RoundTrips,
    first_errors: Mutex<Vec<String>>,
}

/// Snapshot of the counters.
#[derive(Clone, Debug, Default)]
pub(crate) struct Snapshot {
    pub(crate) replies: u64,
    pub(crate) errors: u64,
    pub(crate) failed_while_down: u64,
    /// Samples more than 1.1 intervals after the previous one.
    pub(crate) late: u64,
    round_trips: Vec<u64>,
}

impl Counters {
    pub(crate) fn new(plcs: u32) -> Self {
        Self {
            answered: (0..plcs).map(|_| AtomicBool::new(false)).collect(),
            answered_count: AtomicU32::new(0),
            down: AtomicBool::new(false),
            replies: AtomicU64::new(0),
            errors: AtomicU64::new(0),
            failed_while_down: AtomicU64::new(0),
            late: AtomicU64::new(0),
            round_trips: RoundTrips::default(),
            first_errors: Mutex::new(Vec::new()),
        }
    }

    /// Counts a reply with the right values.
    pub(crate) fn answered(&self, n: u32, round_trip: Duration) {
        count(&self.replies);
        if !self.is_down() {
            self.round_trips.count(round_trip);
        }
        if !self.answered[n as usize].swap(true, Ordering::Relaxed) {
            self.answered_count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counts a reply with wrong values.
    pub(crate) fn wrong(&self, n: u32, values: &[TagValue]) {
        self.error(format!("PLC {n}: wrong values {values:?}"));
    }

    /// Counts a failed read.
    pub(crate) fn failed(&self, n: u32, error: &Quality) {
        if self.is_down() {
            count(&self.failed_while_down);
        } else {
            self.error(format!("PLC {n}: {error}"));
        }
    }

    pub(crate) fn late(&self) {
        if !self.is_down() {
            count(&self.late);
        }
    }

    /// Counts samples dropped because the consumer was too slow.
    pub(crate) fn missed(&self, missed: &Missed) {
        self.error(missed.to_string());
    }

    /// Sets whether the simulator is down.
    pub(crate) fn set_down(&self, down: bool) {
        self.down.store(down, Ordering::Relaxed);
    }

    fn is_down(&self) -> bool {
        self.down.load(Ordering::Relaxed)
    }

    pub(crate) fn all_answered(&self) -> bool {
        self.answered_count.load(Ordering::Relaxed) as usize == self.answered.len()
    }

    /// Marks all PLCs as not answered.
    pub(crate) fn forget_answers(&self) {
        for answered in &self.answered {
            if answered.swap(false, Ordering::Relaxed) {
                self.answered_count.fetch_sub(1, Ordering::Relaxed);
            }
        }
    }

    pub(crate) fn errors(&self) -> u64 {
        self.errors.load(Ordering::Relaxed)
    }

    /// Messages of the first ten errors.
    pub(crate) fn first_errors(&self) -> Vec<String> {
        self.first_errors.lock().map(|errors| errors.clone()).unwrap_or_default()
    }

    pub(crate) fn snapshot(&self) -> Snapshot {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Snapshot {
            replies: load(&self.replies),
            errors: load(&self.errors),
            failed_while_down: load(&self.failed_while_down),
            late: load(&self.late),
            round_trips: self.round_trips.counts(),
        }
    }

    fn error(&self, message: String) {
        count(&self.errors);
        if let Ok(mut errors) = self.first_errors.lock()
            && errors.len() < 10
        {
            errors.push(message);
        }
    }
}

impl Snapshot {
    pub(crate) fn since(&self, before: &Self) -> Self {
        Self {
            replies: self.replies - before.replies,
            errors: self.errors - before.errors,
            failed_while_down: self.failed_while_down - before.failed_while_down,
            late: self.late - before.late,
            round_trips: (self.round_trips.iter().enumerate())
                .map(|(i, count)| count - before.round_trips.get(i).unwrap_or(&0))
                .collect(),
        }
    }

    /// Percentile of the round trips, with a resolution of one eighth.
    pub(crate) fn percentile(&self, percent: u64) -> Duration {
        let rank = (self.round_trips.iter().sum::<u64>() * percent).div_ceil(100);
        let mut sum = 0;
        let at = self.round_trips.iter().position(|count| {
            sum += count;
            sum >= rank
        });
        RoundTrips::upper_bound(at.unwrap_or_default())
    }
}

/// Histogram of round trips in microseconds: eight classes per doubling.
#[derive(Debug)]
struct RoundTrips {
    classes: [AtomicU64; CLASSES],
}

/// Up to one hour.
const CLASSES: usize = 8 * 32;

impl RoundTrips {
    fn count(&self, time: Duration) {
        let micros = u64::try_from(time.as_micros()).unwrap_or(u64::MAX).max(8);
        let doublings = micros.ilog2() - 3;
        // The class is given by the three bits after the highest one.
        let class = 8 * doublings as usize + (micros >> doublings) as usize - 8;
        count(&self.classes[class.min(CLASSES - 1)]);
    }

    fn counts(&self) -> Vec<u64> {
        self.classes.iter().map(|class| class.load(Ordering::Relaxed)).collect()
    }

    /// Upper bound of a class.
    fn upper_bound(class: usize) -> Duration {
        Duration::from_micros(((class as u64 % 8 + 9) << (class / 8)) - 1)
    }
}

impl Default for RoundTrips {
    fn default() -> Self {
        Self { classes: [const { AtomicU64::new(0) }; CLASSES] }
    }
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}
