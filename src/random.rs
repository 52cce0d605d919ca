//! Randomness for nonces, jitter and simulated faults: seeded, so that a run can be repeated. Not for secrets.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// `SplitMix64`.
#[derive(Debug)]
pub(crate) struct Random {
    state: u64,
}

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// A seed that differs from process to process and from link to link.
    pub(crate) fn seed() -> u64 {
        RandomState::new().hash_one(0)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.state ^ self.state >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ mixed >> 31
    }

    /// Between half of it and all of it, so that links that failed together do not come back together.
    pub(crate) fn jitter(&mut self, duration: Duration) -> Duration {
        let thousandths = 500_u64.saturating_add(self.next().checked_rem(501).unwrap_or_default());
        duration.saturating_mul(u32::try_from(thousandths).unwrap_or(1000)).checked_div(1000).unwrap_or(duration)
    }
}
