//! The connection as the core sees it: its state, and when the next one may be opened.
//!
//! ```text
//! down ──begin──▶ connecting ──opened──▶ up ──lost, or closed──▶ down
//!  ▲ ▲───closed───────┘ │
//!  └───────failed───────┘
//! ```
//!
//! Invariant: after a failed attempt, or a connection that ended without a reply, none is begun
//! before a pause has passed. The pause doubles each time, up to a maximum, and starts anew after a
//! reply.

use std::time::Duration;

use tokio::time::Instant;

use super::later;
use crate::random::Random;

#[derive(Debug)]
pub(crate) struct Connection {
    state: ConnectionState,
    /// Failed attempts, and connections that ended without a reply, since the last reply.
    failures: u32,
    /// How often the shortest pause is doubled for the next one.
    doublings: u32,
    /// The number of the host's address to be used next, of those that a transport chooses among.
    address: usize,
    /// A reply has come from this address.
    is_address_proven: bool,
    /// The connection carries one request only, and that has been answered.
    spent: bool,
    /// The shortest and the longest pause.
    backoff: (Duration, Duration),
    random: Random,
}

/// Connections in a row without a reply, after which another address is tried.
const LOST: u32 = 3;

/// Connections in a row without a reply, during which no address is skipped: a single call makes
/// three or four, and each address is to get one of them.
const IN_ORDER: u32 = 5;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ConnectionState {
    Down { retry_at: Option<Instant> },
    Connecting,
    Up { replied: bool },
}

impl Connection {
    pub(crate) fn new(backoff: (Duration, Duration), random: Random) -> Self {
        Self {
            state: ConnectionState::Down { retry_at: None },
            failures: 0,
            doublings: 0,
            address: 0,
            is_address_proven: false,
            spent: false,
            backoff,
            random,
        }
    }

    pub(crate) fn state(&self) -> ConnectionState {
        self.state
    }

    /// Returns whether the next request needs a new connection.
    pub(crate) fn is_spent(&self) -> bool {
        self.spent
    }

    /// Notes that a connection for one request has carried it.
    pub(crate) fn spend(&mut self) {
        self.spent = true;
    }

    /// The number of the host's address to be used next.
    ///
    /// It stays the same once a reply has come, until [`LOST`] connections in a row had none. Without
    /// a reply it changes with each connection, to the next address for the first [`IN_ORDER`] times.
    /// Later one is sometimes skipped: else a link whose stations take turns could ask each of them at
    /// one address only.
    pub(crate) fn address(&self) -> usize {
        self.address
    }

    /// Returns whether a reply has come from this address.
    pub(crate) fn is_address_proven(&self) -> bool {
        self.is_address_proven
    }

    /// An attempt to connect begins.
    pub(crate) fn begin(&mut self) {
        self.state = ConnectionState::Connecting;
    }

    pub(crate) fn opened(&mut self) {
        self.state = ConnectionState::Up { replied: false };
        self.spent = false;
    }

    /// A request or check was answered over the connection.
    pub(crate) fn replied(&mut self) {
        self.state = ConnectionState::Up { replied: true };
        self.failures = 0;
        self.doublings = 0;
        self.is_address_proven = true;
    }

    /// The connection was closed because it is not needed.
    pub(crate) fn closed(&mut self) {
        self.state = ConnectionState::Down { retry_at: None };
    }

    /// The connection was lost.
    pub(crate) fn lost(&mut self, now: Instant) {
        if self.state == (ConnectionState::Up { replied: true }) {
            self.closed();
        } else {
            self.failed(now);
        }
    }

    /// Limits the pause before the next attempt, and the one after another failure.
    pub(crate) fn retry_within(&mut self, longest: Duration, now: Instant) {
        if let ConnectionState::Down { retry_at: Some(at) } = &mut self.state {
            *at = later(now, longest).min(*at);
        }
        while self.doublings > 0 && self.next_pause() > longest {
            self.doublings = self.doublings.saturating_sub(1);
        }
    }

    /// The next pause, without jitter.
    fn next_pause(&self) -> Duration {
        let (shortest, longest) = self.backoff;
        shortest.saturating_mul(1_u32.checked_shl(self.doublings).unwrap_or(u32::MAX)).min(longest)
    }

    /// The attempt to connect has failed.
    pub(crate) fn failed(&mut self, now: Instant) {
        let pause = self.next_pause();
        self.doublings = self.doublings.saturating_add(1).min(31);
        self.failures = self.failures.saturating_add(1);
        self.is_address_proven &= self.failures < LOST;
        if !self.is_address_proven {
            let skip = usize::from(self.failures > IN_ORDER && self.random.next().is_multiple_of(4));
            self.address = self.address.wrapping_add(1).wrapping_add(skip);
        }
        let delay = self.random.jitter(pause);
        self.state = ConnectionState::Down { retry_at: Some(later(now, delay)) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_with_a_reply_is_kept_until_three_connections_had_none() {
        for seed in 0..100 {
            let mut connection = Connection::new((Duration::ZERO, Duration::ZERO), Random::new(seed));
            let now = Instant::now();
            connection.failed(now);
            let good = connection.address();
            assert!(good > 0 && !connection.is_address_proven());
            for _ in 0..10 {
                connection.opened();
                connection.replied();
                connection.lost(now);
                for _ in 0..LOST - 1 {
                    connection.failed(now);
                }
                assert_eq!((connection.address(), connection.is_address_proven()), (good, true), "seed {seed}");
            }
            connection.failed(now);
            assert!(connection.address() > good && !connection.is_address_proven());
        }
    }

    /// An address that was skipped at random kept 1 of 16 calls from the second of two addresses.
    #[test]
    fn the_first_attempts_skip_no_address() {
        for seed in 0..100 {
            let mut connection = Connection::new((Duration::ZERO, Duration::ZERO), Random::new(seed));
            for number in 0..5 {
                assert_eq!(connection.address(), number, "seed {seed}");
                connection.failed(Instant::now());
            }
            connection.opened();
            connection.replied();
            let proven = connection.address();
            (0..LOST - 1).for_each(|_| connection.failed(Instant::now()));
            assert_eq!(connection.address(), proven, "seed {seed}");
            connection.failed(Instant::now());
            assert_eq!(connection.address(), proven + 1, "seed {seed}");
        }
    }

    /// Two stations in turn, one of them off, and two addresses, one of them wrong.
    #[test]
    fn each_station_is_asked_at_each_address() {
        for seed in 0..1000 {
            let mut connection = Connection::new((Duration::ZERO, Duration::ZERO), Random::new(seed));
            let reached = |connection: &mut Connection, wanted: (usize, usize)| {
                (0..60).any(|n| {
                    let now = (n % 2, connection.address() % 2);
                    connection.failed(Instant::now());
                    now == wanted
                })
            };
            for wanted in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                assert!(reached(&mut connection, wanted), "seed {seed}: {wanted:?}");
            }
        }
    }

    /// A host that was mute for minutes and then closed the connection was left alone for half a minute.
    #[test]
    fn the_pause_after_a_replaced_connection_is_short_and_so_is_the_next() {
        let (backoff, limit) = ((Duration::from_millis(100), Duration::from_secs(30)), Duration::from_secs(5));
        for seed in 0..100 {
            let mut connection = Connection::new(backoff, Random::new(seed));
            let now = Instant::now();
            let pause = |connection: &Connection| match connection.state() {
                ConnectionState::Down { retry_at } => retry_at.unwrap().duration_since(now),
                state => panic!("{state:?}"),
            };
            for _ in 0..20 {
                connection.opened();
                connection.lost(now);
                connection.retry_within(limit, now);
                assert!(pause(&connection) <= limit, "seed {seed}");
            }
            connection.opened();
            connection.lost(now);
            assert!(pause(&connection) <= limit, "seed {seed}: {:?}", pause(&connection));
            // Then it grows again.
            (0..5).for_each(|_| connection.failed(now));
            assert!(pause(&connection) >= backoff.1 / 2, "seed {seed}: {:?}", pause(&connection));
        }
    }

    #[test]
    fn the_pause_doubles_up_to_its_maximum_until_a_reply() {
        let (shortest, longest) = (Duration::from_millis(100), Duration::from_secs(30));
        for seed in 0..100 {
            let mut connection = Connection::new((shortest, longest), Random::new(seed));
            let now = Instant::now();
            let pause = |connection: &Connection| match connection.state() {
                ConnectionState::Down { retry_at } => retry_at.map_or(Duration::ZERO, |at| at.duration_since(now)),
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
