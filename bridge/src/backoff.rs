//! Delays between attempts to connect.

use std::time::Duration;

/// The first delay, at most.
const FIRST: Duration = Duration::from_millis(250);
/// The longest delay.
const LONGEST: Duration = Duration::from_secs(10);

/// Delays that double with each failure, with jitter, so that the clients of a server that restarts do not
/// all connect at once.
#[derive(Debug, Default)]
pub struct Backoff {
    failures: u32,
}

impl Backoff {
    /// Notes a failure. Returns the delay before the next attempt: from half of the limit up to the limit,
    /// which is 250 ms at first and 10 s at most.
    pub fn next_delay(&mut self) -> Duration {
        let limit = FIRST.saturating_mul(2u32.saturating_pow(self.failures)).min(LONGEST);
        self.failures = self.failures.saturating_add(1);
        limit.mul_f64(0.5 + fastrand::f64() / 2.0)
    }

    /// Notes a success: the next delay is short again.
    pub fn reset(&mut self) {
        self.failures = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_double_up_to_a_limit_and_differ() {
        let mut backoff = Backoff::default();
        for limit in [250, 500, 1000, 2000, 4000, 8000, 10_000, 10_000] {
            let delay = backoff.next_delay();
            let limit = Duration::from_millis(limit);
            assert!(delay >= limit / 2 && delay <= limit, "{delay:?} of {limit:?}");
        }
        (0..100).for_each(|_| assert!(backoff.next_delay() <= LONGEST));
        backoff.reset();
        assert!(backoff.next_delay() <= FIRST);
        let delays: std::collections::HashSet<_> = (0..20).map(|_| Backoff::default().next_delay()).collect();
        assert!(delays.len() > 1, "without jitter");
    }
}
