//! The time for opening the store.
//!
//! An attempt that hangs, such as to a server that was stopped, must not last for many leases; a store with many
//! entries, or a slow path, takes longer to open. So attempts without an answer have 2, 4, 8, 10, and again 2 s. After
//! a success they begin with twice the time that it took.

use std::time::Duration;

use super::bucket::OPEN;

const SHORTEST: Duration = Duration::from_secs(2);

/// The time for the next attempt to open the store.
#[derive(Clone, Copy, Debug)]
pub(super) struct OpenLimit {
    /// That of the first attempt.
    first: Duration,
    next: Duration,
}

impl Default for OpenLimit {
    fn default() -> Self {
        Self { first: SHORTEST, next: SHORTEST }
    }
}

impl OpenLimit {
    /// The time for the next attempt.
    pub(super) fn next(&self) -> Duration {
        self.next
    }

    /// An attempt has succeeded after this time.
    pub(super) fn opened(&mut self, after: Duration) {
        self.first = after.saturating_mul(2).clamp(SHORTEST, OPEN);
        self.next = self.first;
    }

    /// An attempt has failed after this time. One that fails soon had an answer.
    pub(super) fn failed(&mut self, after: Duration) {
        if after >= self.next / 2 {
            self.next = if self.next < OPEN { self.next.saturating_mul(2).min(OPEN) } else { self.first };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Duration = Duration::from_secs(1);

    #[test]
    fn attempts_without_an_answer_get_longer_and_then_short_again() {
        let mut limit = OpenLimit::default();
        let mut limits = Vec::new();
        for _ in 0..6 {
            limits.push(limit.next().as_secs());
            limit.failed(limit.next());
        }
        assert_eq!(limits, [2, 4, 8, 10, 2, 4]);
        // The client gives a connection up after 5 s.
        limit.failed(5 * S);
        limit.failed(5 * S);
        assert_eq!(limit.next(), 2 * S);
    }

    #[test]
    fn a_refusal_is_an_answer_and_a_success_sets_the_first_limit() {
        let mut limit = OpenLimit::default();
        limit.failed(S / 100);
        assert_eq!(limit.next(), 2 * S);
        limit.opened(3 * S);
        assert_eq!(limit.next(), 6 * S);
        limit.failed(6 * S);
        limit.failed(10 * S);
        assert_eq!(limit.next(), 6 * S);
        limit.opened(S / 10);
        assert_eq!(limit.next(), 2 * S);
    }
}
