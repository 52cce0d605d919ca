//! Random numbers for nonces, jitter and simulated faults. Seeded, so that runs are reproducible;
//! not for secrets.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// The `SplitMix64` generator.
#[derive(Debug)]
pub(crate) struct Random {
    state: u64,
}

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// A seed that differs between processes and between links.
    pub(crate) fn seed() -> u64 {
        RandomState::new().hash_one(0)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.state ^ self.state >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ mixed >> 31
    }

    /// Draws from half of a duration to all of it, so that links do not reconnect at the same time.
    pub(crate) fn jitter(&mut self, duration: Duration) -> Duration {
        // 500 to 1000, so it fits a u32.
        let thousandths = (self.next() % 501) as u32;
        duration.saturating_mul(thousandths.saturating_add(500)).checked_div(1000).unwrap_or(duration)
    }
}
