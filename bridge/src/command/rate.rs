//! The rate limit: a token bucket. No clock.

use std::time::Duration;

/// A token bucket, as the time at which it will be full again.
#[derive(Clone, Copy, Debug)]
pub(super) struct RateLimit {
    /// The time in which one token comes back.
    interval: Duration,
    /// The time in which an empty bucket becomes full.
    capacity: Duration,
    full_at: Duration,
}

impl RateLimit {
    /// A full bucket of `burst` tokens, of which `per_second` come back each second; both at least 1.
    pub(super) fn new(per_second: u32, burst: u32) -> Self {
        let interval = Duration::from_secs(1) / per_second.max(1);
        Self { interval, capacity: interval.saturating_mul(burst.max(1)), full_at: Duration::ZERO }
    }

    /// Takes a token if there is one. `now`: the time since some start, which never goes back.
    pub(super) fn take(&mut self, now: Duration) -> bool {
        let full_at = self.full_at.max(now).saturating_add(self.interval);
        let is_taken = full_at.saturating_sub(now) <= self.capacity;
        if is_taken {
            self.full_at = full_at;
        }
        is_taken
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_is_taken_and_then_the_rate() {
        let mut limit = RateLimit::new(10, 20);
        let mut taken =
            |from: u64, millis: u64| (from..from + millis).filter(|ms| limit.take(Duration::from_millis(*ms))).count();
        assert_eq!(taken(0, 10), 10);
        assert_eq!(taken(10, 90), 10);
        assert_eq!(taken(100, 1000), 10);
        // After a pause of two seconds the bucket is full, and not more than full.
        assert_eq!(taken(60_000, 50), 20);
        assert_eq!(taken(60_050, 10_000), 100);
    }

    #[test]
    fn a_rate_of_zero_is_one() {
        let mut limit = RateLimit::new(0, 0);
        assert!(limit.take(Duration::ZERO) && !limit.take(Duration::from_millis(999)));
        assert!(limit.take(Duration::from_secs(1)));
    }
}
