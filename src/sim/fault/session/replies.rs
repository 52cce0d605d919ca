//! Events of a session: requests to execute, replies to send, duplicates and second answers.

use std::collections::VecDeque;
use std::mem;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::Instant;

use crate::command::{Class, Code, Request, RequestError};
use crate::sim::fault::Line;
use crate::sim::fault::faults::{Decision, DrawnFollowUp};
use crate::sim::fault::timing::{DrawnTiming, later};
use crate::wire::Frame;

#[derive(Debug)]
pub(super) enum SessionEvent {
    /// The station executes the request.
    Execute(Box<PendingRequest>),
    /// The reply is ready; its transmission begins when the line is free.
    SendReply(Box<OutgoingReply>),
    /// The next piece of a reply is complete; the others follow, each at its time.
    Deliver { pieces: VecDeque<ReplyPiece>, then_close: bool },
    /// The request is sent back to its sender.
    Echo(Bytes, Option<SocketAddr>),
    /// The connection is closed.
    Close,
}

/// A request to a station, to be executed.
#[derive(Debug)]
pub(super) struct PendingRequest {
    /// The station that executes it.
    pub(super) station: u8,
    /// The request, with the station number of its reply.
    pub(super) frame: Frame,
    pub(super) request: Arc<Result<Request, RequestError>>,
    /// Number of its entry in the log.
    pub(super) log_number: u64,
    /// `None` for a broadcast without a reply.
    pub(super) reply: Option<PendingReply>,
}

impl PendingRequest {
    /// The request, if it is a write or control request.
    pub(super) fn write(&self) -> Option<&Request> {
        self.request.as_ref().as_ref().ok().filter(|_| !self.is_read())
    }

    fn is_read(&self) -> bool {
        Code::from_u8(self.frame.command).is_some_and(|code| code.class() == Class::Read)
    }

    /// The content of a second answer without an error: reads are executed again, for all others
    /// it is a duplicate of the first reply.
    pub(super) fn second_answer(&self, duplicate: &Bytes) -> FollowUpContent {
        if self.is_read() && self.request.is_ok() {
            FollowUpContent::Read { frame: self.frame.clone(), request: self.request.clone() }
        } else {
            FollowUpContent::Bytes(duplicate.clone())
        }
    }
}

/// Decisions about the reply to a request, made on its arrival.
#[derive(Debug)]
pub(super) struct PendingReply {
    pub(super) decision: Decision,
    pub(super) ready_at: Instant,
    pub(super) follow_ups: Vec<DrawnFollowUp>,
    pub(super) delivery: Delivery,
}

/// Destination and order of a reply.
#[derive(Clone, Copy, Debug)]
pub(super) struct Delivery {
    /// The station among whose replies it stays in order.
    pub(super) station: u8,
    /// Number of the request's entry in the log; `None` for bytes without a request.
    pub(super) log_number: Option<u64>,
    pub(super) line: Line,
    /// Address for datagrams; `None` is the latest client.
    pub(super) to: Option<SocketAddr>,
    /// `true` if it is kept for the next connection when its own has ended.
    pub(super) outlives: bool,
}

/// A reply that is ready to be sent.
#[derive(Debug)]
pub(super) struct OutgoingReply {
    pub(super) bytes: Bytes,
    /// Number of pieces, and the pause between them.
    pub(super) split: (usize, Duration),
    pub(super) then_close: bool,
    pub(super) delivery: Delivery,
    pub(super) follow_ups: Vec<FollowUp>,
}

impl OutgoingReply {
    /// Bytes in one piece, without follow-ups.
    pub(super) fn whole(bytes: Bytes, delivery: Delivery) -> Self {
        Self { bytes, split: (1, Duration::ZERO), then_close: false, delivery, follow_ups: Vec::new() }
    }

    /// The pieces to deliver, with their times from the beginning of the transmission.
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

/// Bytes that are delivered at once.
#[derive(Debug)]
pub(super) struct ReplyPiece {
    pub(super) at: Instant,
    pub(super) bytes: Bytes,
    pub(super) to: Option<SocketAddr>,
    pub(super) outlives: bool,
}

/// A duplicate of a reply, or a second answer.
///
/// Sent at its time, but before the next reply of its station unless it roams.
#[derive(Debug)]
pub(super) struct FollowUp {
    pub(super) content: FollowUpContent,
    pub(super) is_roaming: bool,
    pub(super) timing: DrawnTiming,
    pub(super) delivery: Delivery,
    /// `true` if its time depends on the next request or reply, which has not come yet.
    pub(super) waits: bool,
    /// Time of the reply that it follows.
    pub(super) not_before: Instant,
}

#[derive(Debug)]
pub(super) enum FollowUpContent {
    Bytes(Bytes),
    /// A read to execute at the time of sending.
    Read {
        frame: Frame,
        request: Arc<Result<Request, RequestError>>,
    },
}

impl FollowUp {
    /// Returns whether it follows the reply without a pause.
    pub(super) fn is_at_once(&self) -> bool {
        self.timing == DrawnTiming::After(Duration::ZERO)
    }

    /// Returns whether the next reply, if due at the same time, is handled first and sends both
    /// together.
    pub(super) fn yields_to_reply(&self) -> bool {
        !self.is_roaming && matches!(self.timing, DrawnTiming::WithNextRequest { per_mille: 1000, .. })
    }

    /// Sets its time after its reply was sent, and returns it.
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

    /// Handles the arrival of the next request, whose reply will be ready at `ready_at`. Returns
    /// the new time, if it changes.
    pub(super) fn next_request(&mut self, arrived: Instant, ready_at: Instant) -> Option<Instant> {
        let DrawnTiming::WithNextRequest { per_mille, .. } = self.timing else { return None };
        if !mem::replace(&mut self.waits, false) {
            return None;
        }
        let arrived = arrived.max(self.not_before);
        let wait = ready_at.saturating_duration_since(arrived);
        // Does not overflow: a wait is at most a few days.
        Some(later(arrived, wait.saturating_mul(per_mille.into()) / 1000))
    }

    /// Handles the sending of the next reply. Returns the new time, if it changes.
    pub(super) fn next_reply(&mut self, sent_at: Instant) -> Option<Instant> {
        let DrawnTiming::AfterNextReply { after, .. } = self.timing else { return None };
        mem::replace(&mut self.waits, false).then(|| later(sent_at, after))
    }
}
