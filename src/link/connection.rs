//! The connection as the core sees it: whether there is one, and when the next one may be opened.
//!
//! ```text
//! down ──begin──▶ connecting ──opened──▶ up ──lost, or closed──▶ down
//!  ▲ ▲───closed───────┘ │
//!  └───────failed───────┘
//! ```
//!
//! What must always hold: after an attempt that failed, or a connection that ended without a single reply, none is begun
//! before a pause has passed; it doubles with each of them up to a cap, and begins anew after a reply.

use std::time::Duration;

use tokio::time::Instant;

use super::later;
use crate::random::Random;

#[derive(Debug)]
pub(crate) struct Connection {
    state: State,
    /// Attempts to connect, and connections that ended without a single reply, since the last reply.
    failures: u32,
    /// It is for one request alone, which has been answered.
    spent: bool,
    /// The shortest and the longest pause.
    backoff: (Duration, Duration),
    random: Random,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum State {
    Down { retry_at: Option<Instant> },
    Connecting,
    Up { replied: bool },
}

impl Connection {
    pub(crate) fn new(backoff: (Duration, Duration), random: Random) -> Self {
        Self { state: State::Down { retry_at: None }, failures: 0, spent: false, backoff, random }
    }

    pub(crate) fn state(&self) -> State {
        self.state
    }

    /// Whether another one must be opened for the next request.
    pub(crate) fn is_spent(&self) -> bool {
        self.spent
    }

    /// It was for the one request that has been answered.
    pub(crate) fn spend(&mut self) {
        self.spent = true;
    }

    /// One is being opened.
    pub(crate) fn begin(&mut self) {
        self.state = State::Connecting;
    }

    pub(crate) fn opened(&mut self) {
        self.state = State::Up { replied: false };
        self.spent = false;
    }

    /// Something that was asked over it has been answered.
    pub(crate) fn replied(&mut self) {
        self.state = State::Up { replied: true };
        self.failures = 0;
    }

    /// There is none, because nobody wants one.
    pub(crate) fn closed(&mut self) {
        self.state = State::Down { retry_at: None };
    }

    /// It has ended by itself.
    pub(crate) fn lost(&mut self, now: Instant) {
        if self.state == (State::Up { replied: true }) {
            self.closed();
        } else {
            self.failed(now);
        }
    }

    /// It could not be opened.
    pub(crate) fn failed(&mut self, now: Instant) {
        let (shortest, longest) = self.backoff;
        let doubled = shortest.saturating_mul(1_u32.checked_shl(self.failures).unwrap_or(u32::MAX));
        self.failures = self.failures.saturating_add(1).min(31);
        let delay = self.random.jitter(doubled.min(longest));
        self.state = State::Down { retry_at: Some(later(now, delay)) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pause_doubles_up_to_the_cap_and_begins_anew_after_a_reply() {
        let (shortest, longest) = (Duration::from_millis(100), Duration::from_secs(30));
        for seed in 0..100 {
            let mut connection = Connection::new((shortest, longest), Random::new(seed));
            let now = Instant::now();
            let pause = |connection: &Connection| match connection.state() {
                State::Down { retry_at } => retry_at.map_or(Duration::ZERO, |at| at.duration_since(now)),
                state => panic!("{state:?}"),
            };
            for _ in 0..2 {
                for failures in 0..40_u32 {
                    let whole = longest.min(shortest * 2_u32.saturating_pow(failures.min(20)));
                    connection.begin();
                    if failures % 3 == 0 {
                        connection.opened();
                        connection.lost(now);
                    } else {
                        connection.failed(now);
                    }
                    let pause = pause(&connection);
                    assert!(whole / 2 <= pause && pause <= whole, "seed {seed}: {pause:?} after {failures} failures");
                }
                connection.begin();
                connection.opened();
                connection.replied();
                connection.lost(now);
                assert_eq!(pause(&connection), Duration::ZERO, "seed {seed}");
            }
        }
    }
}
