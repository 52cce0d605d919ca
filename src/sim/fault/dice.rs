//! The chance in faults.

use std::time::Duration;

use crate::random::Random;

/// The random numbers of one request.
#[derive(Debug)]
pub(super) struct Dice {
    random: Random,
}

impl Dice {
    /// Those of the `nth` event of a kind: they do not depend on what happened to the events of other kinds meanwhile.
    pub(super) fn new(seed: u64, kind: u64, nth: u64) -> Self {
        let of_kind = Random::new(seed ^ Random::new(kind).next()).next();
        Self { random: Random::new(Random::new(of_kind.wrapping_add(nth)).next()) }
    }

    /// A number below this one, and 0 below 0.
    pub(super) fn below(&mut self, end: u64) -> u64 {
        self.random.next().checked_rem(end).unwrap_or_default()
    }

    /// As [`below`](Self::below), for lengths and positions.
    pub(super) fn index(&mut self, end: usize) -> usize {
        let end = u64::try_from(end).unwrap_or(u64::MAX);
        usize::try_from(self.below(end)).unwrap_or_default()
    }

    pub(super) fn byte(&mut self) -> u8 {
        let [byte, ..] = self.random.next().to_le_bytes();
        byte
    }

    /// A time between the two, both included; the shorter one if that is the second.
    pub(super) fn between(&mut self, min: Duration, max: Duration) -> Duration {
        let span = u64::try_from(max.saturating_sub(min).as_nanos()).unwrap_or(u64::MAX - 1);
        let extra = if span == 0 { 0 } else { self.below(span.saturating_add(1)) };
        min.min(max).saturating_add(Duration::from_nanos(extra))
    }
}
