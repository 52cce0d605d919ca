//! Devices that close their connection after each reply: set, or learned. No I/O, and no clock.
//!
//! Such a device also closes behind the echo of a check, which so never leads to a request. Two connections in a row
//! that end like this teach it. Connections that were lost by chance can teach it, too, and then each request takes
//! the quiet time. So it is forgotten after a while, and learned again at the price of two connections.

use std::io;

/// The number of such connections in a row that teach it.
const CLOSES_TO_LEARN: u8 = 2;

/// The number of connections after which it is forgotten. Each of them takes the quiet time at least, a second unless
/// set.
const CONNECTIONS_TO_FORGET: u8 = 60;

/// The knowledge of a link that its device closes the connection after each reply.
#[derive(Debug)]
pub(super) struct OneRequest {
    state: State,
    /// The last reply over the connection was the echo of a check. Strays do not count.
    echo_was_last: bool,
    /// Number of connections in a row that were closed right after the echo of a check.
    closed_behind_echo: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Unknown,
    /// By the settings of the link.
    Set,
    /// For this number of further connections.
    Learned(u8),
    /// It was learned before.
    Forgotten,
}

/// A change of what is learned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    LearnedFirst,
    LearnedAgain,
    Forgotten,
}

impl OneRequest {
    pub(super) fn new(is_set: bool) -> Self {
        let state = if is_set { State::Set } else { State::Unknown };
        Self { state, echo_was_last: false, closed_behind_echo: 0 }
    }

    /// Returns whether a connection carries one request only.
    #[inline]
    pub(super) fn is_in_force(&self) -> bool {
        match self.state {
            State::Set | State::Learned(_) => true,
            State::Unknown | State::Forgotten => false,
        }
    }

    /// A connection is open.
    pub(super) fn connected(&mut self) -> Option<Change> {
        self.echo_was_last = false;
        let State::Learned(connections) = self.state else { return None };
        if let Some(further) = connections.checked_sub(1) {
            self.state = State::Learned(further);
            return None;
        }
        (self.state, self.closed_behind_echo) = (State::Forgotten, 0);
        Some(Change::Forgotten)
    }

    /// A check was answered: by its echo, or by a refusal.
    pub(super) fn check_answered(&mut self, is_echo: bool) {
        self.echo_was_last = is_echo;
    }

    /// A call was answered.
    #[inline]
    pub(super) fn call_answered(&mut self) {
        (self.echo_was_last, self.closed_behind_echo) = (false, 0);
    }

    /// A request was not answered.
    pub(super) fn timed_out(&mut self) {
        self.echo_was_last = false;
    }

    /// The connection was lost.
    pub(super) fn lost(&mut self, error: &io::Error) -> Option<Change> {
        use io::ErrorKind::{BrokenPipe, ConnectionAborted, ConnectionReset, UnexpectedEof};
        let is_closed = matches!(error.kind(), UnexpectedEof | ConnectionReset | ConnectionAborted | BrokenPipe);
        if !is_closed || !self.echo_was_last || self.is_in_force() {
            return None;
        }
        self.closed_behind_echo = self.closed_behind_echo.saturating_add(1);
        if self.closed_behind_echo < CLOSES_TO_LEARN {
            return None;
        }
        let change = if self.state == State::Forgotten { Change::LearnedAgain } else { Change::LearnedFirst };
        self.state = State::Learned(CONNECTIONS_TO_FORGET);
        Some(change)
    }
}
