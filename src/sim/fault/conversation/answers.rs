//! Requests that are executed, the replies to them, and what follows a reply.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::Instant;

use super::conditions::later;
use crate::command::{Class, Code, Request, RequestError};
use crate::sim::fault::Line;
use crate::sim::fault::faults::{Again, Verdict};
use crate::sim::fault::timing::DrawnTiming;
use crate::wire::Frame;

#[derive(Debug)]
pub(super) enum Event {
    /// The station's turn has come.
    Execute(Box<Job>),
    /// A reply is ready to go out.
    Speak(Box<Speech>),
    /// Pieces of a reply have come, each at its time.
    HandOver { pieces: VecDeque<Piece>, then_close: bool },
    /// A request comes back, to where it came from.
    Echo(Bytes, Option<SocketAddr>),
    /// The connection ends.
    Close,
}

/// A request that a station is to execute.
#[derive(Debug)]
pub(super) struct Job {
    /// The station that executes it.
    pub(super) station: u8,
    /// The request, with the station number that its reply has.
    pub(super) frame: Frame,
    pub(super) request: Arc<Result<Request, RequestError>>,
    /// Which entry of the log it is.
    pub(super) number: u64,
    /// `None` for a broadcast that is not answered.
    pub(super) answer: Option<Answer>,
}

impl Job {
    /// The write or control request that it is, if it is one.
    pub(super) fn write(&self) -> Option<&Request> {
        self.request.as_ref().as_ref().ok().filter(|_| !self.is_read())
    }

    fn is_read(&self) -> bool {
        Code::from_u8(self.frame.command).is_some_and(|code| code.class() == Class::Read)
    }

    /// The content of a second answer that is not an error: a read is executed again, all else repeats the `first`.
    pub(super) fn again(&self, first: &Bytes) -> Content {
        if self.is_read() && self.request.is_ok() {
            Content::Read { frame: self.frame.clone(), request: self.request.clone() }
        } else {
            Content::Bytes(first.clone())
        }
    }
}

/// What was decided about the answer to a request when it arrived.
#[derive(Debug)]
pub(super) struct Answer {
    /// What befalls it.
    pub(super) verdict: Verdict,
    pub(super) ready_at: Instant,
    /// What comes after the reply.
    pub(super) again: Vec<Again>,
    pub(super) delivery: Delivery,
}

/// How an answer is delivered.
#[derive(Clone, Copy, Debug)]
pub(super) struct Delivery {
    /// The station whose order it keeps.
    pub(super) station: u8,
    /// Which entry of the log it answers; `None` for bytes from elsewhere.
    pub(super) number: Option<u64>,
    pub(super) line: Line,
    /// The address for datagrams; `None` for the latest client.
    pub(super) to: Option<SocketAddr>,
    /// Whether it waits for the next connection when its own has ended.
    pub(super) outlives: bool,
}

/// A reply that goes out.
#[derive(Debug)]
pub(super) struct Speech {
    pub(super) bytes: Bytes,
    /// How many pieces, and the pause between them.
    pub(super) split: (usize, Duration),
    pub(super) then_close: bool,
    pub(super) delivery: Delivery,
    /// What comes after it.
    pub(super) follow_ups: Vec<FollowUp>,
}

impl Speech {
    /// Bytes in one piece, with nothing after them.
    pub(super) fn whole(bytes: Bytes, delivery: Delivery) -> Self {
        Self { bytes, split: (1, Duration::ZERO), then_close: false, delivery, follow_ups: Vec::new() }
    }

    /// What is handed over at once, and how long after the beginning.
    pub(super) fn pieces(&self) -> Vec<(Duration, Bytes)> {
        let (count, pause) = self.split;
        let line = self.delivery.line;
        let len = self.bytes.len();
        let count = count.clamp(1, len.max(1));
        let mut pieces = Vec::new();
        let mut paused = Duration::ZERO;
        let mut from = 0;
        for nth in 1..=count {
            let end = len * nth / count;
            while from < end {
                let to = if line.is_byte_by_byte() { from + 1 } else { end };
                pieces.push((line.transmission(to).saturating_add(paused), self.bytes.slice(from..to)));
                from = to;
            }
            paused = paused.saturating_add(pause);
        }
        pieces
    }
}

/// Bytes that are handed over at once.
#[derive(Debug)]
pub(super) struct Piece {
    pub(super) at: Instant,
    pub(super) bytes: Bytes,
    pub(super) to: Option<SocketAddr>,
    pub(super) outlives: bool,
}

/// A copy of a reply, or a second answer. It is sent at its time; one that keeps the order is sent before the next reply
/// of its station.
#[derive(Debug)]
pub(super) struct FollowUp {
    pub(super) content: Content,
    pub(super) is_roaming: bool,
    pub(super) timing: DrawnTiming,
    pub(super) delivery: Delivery,
    /// Whether its time depends on something that has not happened yet.
    pub(super) waits: bool,
    /// When the reply before it has gone out.
    pub(super) not_before: Instant,
}

#[derive(Debug)]
pub(super) enum Content {
    Bytes(Bytes),
    /// A read that is executed when the answer is sent.
    Read {
        frame: Frame,
        request: Arc<Result<Request, RequestError>>,
    },
}

impl FollowUp {
    /// Whether it comes without a pause.
    pub(super) fn is_at_once(&self) -> bool {
        self.timing == DrawnTiming::After(Duration::ZERO)
    }

    /// Whether it is sent together with the next reply, where both are due at the same time.
    pub(super) fn yields_to_reply(&self) -> bool {
        !self.is_roaming && matches!(self.timing, DrawnTiming::WithNextRequest { per_mille: 1000, .. })
    }

    /// The reply has gone out. Returns when this is sent, if nothing changes that.
    pub(super) fn begin(&mut self, sent_at: Instant) -> Instant {
        self.not_before = sent_at;
        let (waits, after) = match self.timing {
            DrawnTiming::After(after) => (false, after),
            DrawnTiming::WithNextRequest { at_latest, .. } | DrawnTiming::AfterNextReply { at_latest, .. } => {
                (true, at_latest)
            }
        };
        self.waits = waits;
        later(sent_at, after)
    }

    /// The next request has arrived, and its reply will be ready then. Returns when this is sent, if that changes it.
    pub(super) fn next_request(&mut self, arrived: Instant, ready_at: Instant) -> Option<Instant> {
        let DrawnTiming::WithNextRequest { per_mille, .. } = self.timing else { return None };
        if !std::mem::replace(&mut self.waits, false) {
            return None;
        }
        let arrived = arrived.max(self.not_before);
        let wait = ready_at.saturating_duration_since(arrived);
        // A wait is at most a few days.
        Some(later(arrived, wait.saturating_mul(per_mille.into()) / 1000))
    }

    /// The next reply has gone out. Returns when this is sent, if that changes it.
    pub(super) fn next_reply(&mut self, sent_at: Instant) -> Option<Instant> {
        let DrawnTiming::AfterNextReply { after, .. } = self.timing else { return None };
        std::mem::replace(&mut self.waits, false).then(|| later(sent_at, after))
    }
}
