//! What the pollers count.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use fatek::poll::{Missed, Quality};
use fatek::tag::TagValue;

/// Counters of all pollers together.
#[derive(Debug)]
pub(crate) struct Tally {
    /// Which PLCs have answered, since the start or since they were last forgotten.
    answered: Vec<AtomicBool>,
    answering: AtomicU32,
    /// Whether the PLCs are away, so that calls are bound to fail.
    away: AtomicBool,
    replies: AtomicU64,
    errors: AtomicU64,
    failed_while_away: AtomicU64,
    late: AtomicU64,
    round_trips: RoundTrips,
    first_errors: Mutex<Vec<String>>,
}

/// A snapshot.
#[derive(Clone, Debug, Default)]
pub(crate) struct Counts {
    pub(crate) replies: u64,
    pub(crate) errors: u64,
    pub(crate) failed_while_away: u64,
    /// Readings more than a tenth of the interval later than one interval after the one before.
    pub(crate) late: u64,
    round_trips: Vec<u64>,
}

impl Tally {
    pub(crate) fn new(plcs: u32) -> Self {
        Self {
            answered: (0..plcs).map(|_| AtomicBool::new(false)).collect(),
            answering: AtomicU32::new(0),
            away: AtomicBool::new(false),
            replies: AtomicU64::new(0),
            errors: AtomicU64::new(0),
            failed_while_away: AtomicU64::new(0),
            late: AtomicU64::new(0),
            round_trips: RoundTrips::default(),
            first_errors: Mutex::new(Vec::new()),
        }
    }

    /// PLC `n` has answered what it should.
    pub(crate) fn answered(&self, n: u32, within: Duration) {
        count(&self.replies);
        if !self.is_away() {
            self.round_trips.count(within);
        }
        if !self.answered[n as usize].swap(true, Ordering::Relaxed) {
            self.answering.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// PLC `n` has answered something else.
    pub(crate) fn wrong(&self, n: u32, values: &[TagValue]) {
        self.error(format!("PLC {n} answers {values:?}"));
    }

    /// PLC `n` could not be read.
    pub(crate) fn failed(&self, n: u32, error: &Quality) {
        if self.is_away() {
            count(&self.failed_while_away);
        } else {
            self.error(format!("PLC {n}: {error}"));
        }
    }

    pub(crate) fn late(&self) {
        if !self.is_away() {
            count(&self.late);
        }
    }

    /// Samples were not taken in time.
    pub(crate) fn missed(&self, missed: &Missed) {
        self.error(missed.to_string());
    }

    /// From now on calls are, or are not, bound to fail.
    pub(crate) fn away(&self, away: bool) {
        self.away.store(away, Ordering::Relaxed);
    }

    fn is_away(&self) -> bool {
        self.away.load(Ordering::Relaxed)
    }

    pub(crate) fn all_answered(&self) -> bool {
        self.answering.load(Ordering::Relaxed) as usize == self.answered.len()
    }

    /// Asks anew which PLCs answer.
    pub(crate) fn forget_answers(&self) {
        for answered in &self.answered {
            if answered.swap(false, Ordering::Relaxed) {
                self.answering.fetch_sub(1, Ordering::Relaxed);
            }
        }
    }

    pub(crate) fn errors(&self) -> u64 {
        self.errors.load(Ordering::Relaxed)
    }

    /// The first few errors, in words.
    pub(crate) fn first_errors(&self) -> Vec<String> {
        self.first_errors.lock().map(|errors| errors.clone()).unwrap_or_default()
    }

    pub(crate) fn counts(&self) -> Counts {
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Counts {
            replies: load(&self.replies),
            errors: load(&self.errors),
            failed_while_away: load(&self.failed_while_away),
            late: load(&self.late),
            round_trips: self.round_trips.counts(),
        }
    }

    fn error(&self, what: String) {
        count(&self.errors);
        if let Ok(mut errors) = self.first_errors.lock()
            && errors.len() < 10
        {
            errors.push(what);
        }
    }
}

impl Counts {
    pub(crate) fn since(&self, before: &Self) -> Self {
        Self {
            replies: self.replies - before.replies,
            errors: self.errors - before.errors,
            failed_while_away: self.failed_while_away - before.failed_while_away,
            late: self.late - before.late,
            round_trips: (self.round_trips.iter().enumerate())
                .map(|(i, count)| count - before.round_trips.get(i).unwrap_or(&0))
                .collect(),
        }
    }

    /// How long a round trip takes that so many of a hundred do not exceed, to an eighth.
    pub(crate) fn percentile(&self, percent: u64) -> Duration {
        let rank = (self.round_trips.iter().sum::<u64>() * percent).div_ceil(100);
        let mut sum = 0;
        let at = self.round_trips.iter().position(|count| {
            sum += count;
            sum >= rank
        });
        RoundTrips::longest(at.unwrap_or_default())
    }
}

/// Round trips by length: eight classes to each doubling, in microseconds.
#[derive(Debug)]
struct RoundTrips {
    classes: [AtomicU64; CLASSES],
}

/// As far as an hour.
const CLASSES: usize = 8 * 32;

impl RoundTrips {
    fn count(&self, time: Duration) {
        let micros = u64::try_from(time.as_micros()).unwrap_or(u64::MAX).max(8);
        let doublings = micros.ilog2() - 3;
        // The three bits behind the first one.
        let class = 8 * doublings as usize + (micros >> doublings) as usize - 8;
        count(&self.classes[class.min(CLASSES - 1)]);
    }

    fn counts(&self) -> Vec<u64> {
        self.classes.iter().map(|class| class.load(Ordering::Relaxed)).collect()
    }

    /// The longest one of a class.
    fn longest(class: usize) -> Duration {
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
