use std::time::Duration;

use crate::random::Random;

/// The random numbers of one request or connection.
#[derive(Debug)]
pub(super) struct FaultRng {
    random: Random,
}

impl FaultRng {
    /// The numbers of the `nth` event of a stream, independent of the events of other streams.
    pub(super) fn new(seed: u64, stream: u64, nth: u64) -> Self {
        let of_stream = Random::new(seed ^ Random::new(stream).next()).next();
        Self { random: Random::new(Random::new(of_stream.wrapping_add(nth)).next()) }
    }

    /// Draws a number below `end`; 0 if `end` is 0.
    pub(super) fn below(&mut self, end: u64) -> u64 {
        self.random.next().checked_rem(end).unwrap_or(0)
    }

    /// Draws a length or position below `end`; 0 if `end` is 0.
    pub(super) fn index(&mut self, end: usize) -> usize {
        // The result is below `end`, so both conversions succeed.
        let end = u64::try_from(end).unwrap_or(u64::MAX);
        usize::try_from(self.below(end)).unwrap_or(0)
    }

    pub(super) fn byte(&mut self) -> u8 {
        let [byte, ..] = self.random.next().to_le_bytes();
        byte
    }

    /// Draws a time from `min` to `max`, both included; `max` if it is below `min`.
    pub(super) fn between(&mut self, min: Duration, max: Duration) -> Duration {
        let span = u64::try_from(max.saturating_sub(min).as_nanos()).unwrap_or(u64::MAX - 1);
        let extra = if span == 0 { 0 } else { self.below(span.saturating_add(1)) };
        min.min(max).saturating_add(Duration::from_nanos(extra))
    }
}
