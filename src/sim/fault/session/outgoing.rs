//! Replies from their execution to the line, their follow-ups, and left-over replies.

use std::collections::VecDeque;
use std::mem;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;
use tracing::debug;

use super::conditions::LeftOverPart;
use super::replies::{
    Delivery, FollowUp, FollowUpContent, OutgoingReply, PendingReply, PendingRequest, ReplyPiece, SessionEvent,
};
use super::{BROADCAST, Client, MAX_FOLLOW_UPS, Session};
use crate::ErrorCode;
use crate::command::{Request, RequestError, encode_refusal};
use crate::sim::fault::corrupt::{CorruptedReply, corrupt};
use crate::sim::fault::faults::DrawnFollowUp;
use crate::sim::fault::left_over::LeftOverContent;
use crate::sim::fault::timing::later;
use crate::sim::fault::{Arrival, Fault, LeftOver};
use crate::wire::Frame;

/// Above all numbers of events.
const AFTER_ALL_EVENTS: u64 = 1 << 63;

impl Session {
    pub(super) fn execute(&mut self, mut request: PendingRequest, at: Instant) {
        let error = request.reply.as_ref().and_then(|reply| reply.decision.error());
        let bytes = self.execute_or_refuse(&request, error);
        let reply = request.reply.take().filter(|reply| !self.disconnected || reply.delivery.outlives);
        let Some(PendingReply { mut decision, ready_at, follow_ups, delivery }) = reply else { return };
        let CorruptedReply { reply, duplicate } = corrupt(bytes, self.framing, &decision.faults, &mut decision.rng);
        let then_close = decision.disconnect().is_some();
        if !then_close && reply.is_empty() {
            return;
        }
        let refused = error.is_some();
        let follow_up = |drawn| self.follow_up((&request, refused), drawn, &duplicate, delivery, at);
        let follow_ups = follow_ups.into_iter().map(follow_up).collect();
        let outgoing =
            Box::new(OutgoingReply { bytes: reply, split: decision.split(), then_close, delivery, follow_ups });
        let ready_at = ready_at.max(at);
        if self.client == Client::Gone && delivery.outlives {
            self.conditions.left_overs().put(self.connection, ready_at, LeftOverPart::Reply(outgoing));
        } else {
            self.schedule(ready_at, SessionEvent::SendReply(outgoing));
        }
    }

    /// Executes a request and logs it; with an error, only encodes the refusal. Returns the reply.
    fn execute_or_refuse(&self, request: &PendingRequest, error: Option<ErrorCode>) -> BytesMut {
        if let Some(error) = error {
            return self.refusal(&request.frame, error);
        }
        let (reply, executed) = self.respond(request.station, &request.frame, &request.request);
        if executed {
            self.conditions.faults.log().executed(request.log_number, request.station, request.write());
        }
        reply
    }

    fn refusal(&self, frame: &Frame, error: ErrorCode) -> BytesMut {
        let mut reply = BytesMut::new();
        encode_refusal(frame.command, error, self.framing, frame.station, &mut reply);
        reply
    }

    /// A follow-up of the reply to a request, which [`Fault::Error`] may have refused.
    fn follow_up(
        &self,
        (request, refused): (&PendingRequest, bool),
        drawn: DrawnFollowUp,
        duplicate: &Bytes,
        delivery: Delivery,
        at: Instant,
    ) -> FollowUp {
        let (timing, is_roaming, content) = match drawn {
            // A refused request must not be executed for its second answer.
            DrawnFollowUp::SecondAnswer(timing, None) if refused => {
                (timing, false, FollowUpContent::Bytes(duplicate.clone()))
            }
            DrawnFollowUp::Duplicate(timing) => (timing, false, FollowUpContent::Bytes(duplicate.clone())),
            DrawnFollowUp::RoamingDuplicate(timing) => (timing, true, FollowUpContent::Bytes(duplicate.clone())),
            DrawnFollowUp::SecondAnswer(timing, None) => (timing, false, request.second_answer(duplicate)),
            DrawnFollowUp::SecondAnswer(timing, Some(error)) => {
                (timing, false, FollowUpContent::Bytes(self.refusal(&request.frame, error).freeze()))
            }
        };
        FollowUp { content, is_roaming, timing, delivery, waits: false, not_before: at }
    }

    /// Sends a reply that is ready, behind the follow-ups of earlier replies of its station.
    pub(super) fn send_reply(&mut self, mut reply: OutgoingReply, at: Instant) {
        let Delivery { station, .. } = reply.delivery;
        let then_close = reply.then_close;
        let mut pieces = VecDeque::new();
        if !reply.bytes.is_empty() {
            let is_earlier = |follow_up: &FollowUp| follow_up.delivery.station == station && !follow_up.is_roaming;
            let earlier: Vec<_> =
                self.follow_ups.iter().filter(|(_, it)| is_earlier(it)).map(|(&key, _)| key).collect();
            for key in earlier {
                if let Some(follow_up) = self.follow_ups.remove(&key) {
                    let earlier = self.outgoing_follow_up(follow_up);
                    self.transmit(&earlier, at, &mut pieces);
                }
            }
        }
        let follow_ups = mem::take(&mut reply.follow_ups);
        let (at_once, later_on): (Vec<_>, Vec<_>) = follow_ups.into_iter().partition(FollowUp::is_at_once);
        let at_once: Vec<_> = at_once.into_iter().map(|follow_up| self.outgoing_follow_up(follow_up)).collect();
        if self.is_stream && !at_once.is_empty() {
            let duplicates = at_once.iter().flat_map(|duplicate| &duplicate.bytes[..]);
            reply.bytes = reply.bytes.iter().chain(duplicates).copied().collect();
        }
        self.transmit(&reply, at, &mut pieces);
        if !self.is_stream {
            at_once.iter().for_each(|duplicate| self.transmit(duplicate, at, &mut pieces));
        }
        let sent_at = pieces.back().map_or(at, |last: &ReplyPiece| last.at);
        self.retime_for_reply(station, sent_at);
        for follow_up in later_on {
            self.add_follow_up(follow_up, sent_at);
        }
        self.deliver(pieces, at, then_close);
    }

    /// Sends a duplicate or second answer at its time.
    pub(super) fn send_follow_up(&mut self, follow_up: FollowUp, at: Instant) {
        let reply = self.outgoing_follow_up(follow_up);
        let mut pieces = VecDeque::new();
        self.transmit(&reply, at, &mut pieces);
        self.deliver(pieces, at, false);
    }

    fn deliver(&mut self, pieces: VecDeque<ReplyPiece>, at: Instant, then_close: bool) {
        let first_at = pieces.front().map_or(at, |first| first.at);
        self.schedule(first_at, SessionEvent::Deliver { pieces, then_close });
    }

    /// Appends the pieces of a reply. On a stream, pieces that are due at the same time are joined.
    fn transmit(&mut self, reply: &OutgoingReply, at: Instant, burst: &mut VecDeque<ReplyPiece>) {
        let mut pieces = reply.pieces();
        let Delivery { log_number, line, to, outlives, .. } = reply.delivery;
        if let Some(number) = log_number.filter(|_| !reply.bytes.is_empty()) {
            self.conditions.faults.log().answered(number, &reply.bytes);
        }
        let transmission = pieces.last().map_or(Duration::ZERO, |&(after, _)| after);
        let start = self.conditions.occupancy().send(at, &line, transmission);
        let mut is_first = true;
        for (after, bytes) in pieces.drain(..) {
            let piece = ReplyPiece { at: later(start, after), bytes, to, outlives };
            let joins = mem::take(&mut is_first) && self.is_stream;
            match burst.back_mut().filter(|last| joins && last.at == piece.at) {
                Some(last) => {
                    last.bytes = [&last.bytes[..], &piece.bytes].concat().into();
                    last.outlives |= outlives;
                }
                None => burst.push_back(piece),
            }
        }
    }

    fn outgoing_follow_up(&self, follow_up: FollowUp) -> OutgoingReply {
        let FollowUp { content, delivery, .. } = follow_up;
        let bytes = match content {
            FollowUpContent::Bytes(bytes) => bytes,
            FollowUpContent::Read { frame, request } => {
                let (reply, executed) = self.respond(delivery.station, &frame, &request);
                if let Some(number) = delivery.log_number.filter(|_| executed) {
                    self.conditions.faults.log().executed(number, delivery.station, None);
                }
                reply.freeze()
            }
        };
        OutgoingReply::whole(bytes, delivery)
    }

    fn add_follow_up(&mut self, mut follow_up: FollowUp, sent_at: Instant) {
        let station = follow_up.delivery.station;
        let mut due = follow_up.begin(sent_at);
        // The next request may have arrived before this reply was sent.
        if let Some(ready_at) = self.next_ready_at(station) {
            due = follow_up.next_request(sent_at, ready_at).unwrap_or(due);
        }
        self.insert_follow_up(due, follow_up);
    }

    fn insert_follow_up(&mut self, due: Instant, follow_up: FollowUp) {
        if self.follow_ups.len() < MAX_FOLLOW_UPS {
            // At equal times, one that yields to the reply comes after all events.
            let offset = if follow_up.yields_to_reply() { AFTER_ALL_EVENTS } else { 0 };
            self.follow_ups.insert((due, self.next_number + offset), follow_up);
            self.next_number += 1;
        } else {
            debug!("a duplicate is discarded: too many are in progress");
        }
    }

    /// The time at which the next reply of a station is ready, of the requests that have arrived.
    fn next_ready_at(&self, station: u8) -> Option<Instant> {
        self.events.iter().find_map(|(&(at, _), event)| match event {
            SessionEvent::Execute(request) => {
                request.reply.as_ref().filter(|_| request.station == station).map(|reply| reply.ready_at)
            }
            SessionEvent::SendReply(reply) => (reply.delivery.station == station).then_some(at),
            SessionEvent::Deliver { .. } | SessionEvent::Echo(..) | SessionEvent::Close => None,
        })
    }

    /// Updates follow-ups for a request to their station, whose reply will be ready at `ready_at`.
    pub(super) fn retime_for_request(&mut self, station: u8, arrived: Instant, ready_at: Instant) {
        self.retime(station, |follow_up| follow_up.next_request(arrived, ready_at));
    }

    /// Updates follow-ups for a reply of their station.
    fn retime_for_reply(&mut self, station: u8, sent_at: Instant) {
        self.retime(station, |follow_up| follow_up.next_reply(sent_at));
    }

    fn retime(&mut self, station: u8, mut new_time: impl FnMut(&mut FollowUp) -> Option<Instant>) {
        let of_station = self.follow_ups.iter_mut().filter(|(_, follow_up)| follow_up.delivery.station == station);
        let retimed: Vec<_> = of_station.filter_map(|(&key, follow_up)| Some((key, new_time(follow_up)?))).collect();
        for (key, due) in retimed {
            if let Some(follow_up) = self.follow_ups.remove(&key) {
                self.insert_follow_up(due, follow_up);
            }
        }
    }

    /// Moves replies that outlive their client to the queue for the next connection.
    pub(super) fn keep_left_over(&mut self) {
        let mut left: Vec<((Instant, u64), LeftOverPart)> = Vec::new();
        for (key, event) in mem::take(&mut self.events) {
            match event {
                SessionEvent::SendReply(reply) if reply.delivery.outlives => {
                    left.push((key, LeftOverPart::Reply(reply)));
                }
                SessionEvent::Deliver { pieces, then_close } => {
                    let (outliving, others): (VecDeque<_>, VecDeque<_>) =
                        pieces.into_iter().partition(|piece| piece.outlives);
                    if !outliving.is_empty() {
                        left.push((key, LeftOverPart::Pieces(outliving)));
                    }
                    if !others.is_empty() || then_close {
                        self.events.insert(key, SessionEvent::Deliver { pieces: others, then_close });
                    }
                }
                event @ (SessionEvent::Execute(_)
                | SessionEvent::SendReply(_)
                | SessionEvent::Echo(..)
                | SessionEvent::Close) => {
                    self.events.insert(key, event);
                }
            }
        }
        for (key, follow_up) in mem::take(&mut self.follow_ups) {
            if follow_up.delivery.outlives {
                left.push((key, LeftOverPart::FollowUp(Box::new(follow_up))));
            } else {
                self.follow_ups.insert(key, follow_up);
            }
        }
        left.sort_by_key(|&(key, _)| key);
        for ((at, _), part) in left {
            self.conditions.left_overs().put(self.connection, at, part);
        }
    }

    /// Takes left-over replies for this connection from the queue, in their order.
    pub(super) fn take_left_over(&mut self, now: Instant) {
        match self.client {
            Client::Unknown | Client::Gone => return,
            Client::New => {
                self.client = Client::Known;
                let mut at = now;
                for reply in self.conditions.faults.take_left_over() {
                    at = at.max(later(now, reply.delay));
                    self.send_left_over(reply, now, at);
                }
            }
            Client::Known => {}
        }
        for (at, part) in self.conditions.left_overs().take(self.connection) {
            let at = at.max(now);
            match part {
                LeftOverPart::Reply(reply) => self.schedule(at, SessionEvent::SendReply(reply)),
                LeftOverPart::FollowUp(follow_up) => self.insert_follow_up(at, *follow_up),
                LeftOverPart::Pieces(mut pieces) => {
                    pieces.iter_mut().for_each(|piece| piece.at = piece.at.max(now));
                    self.deliver(pieces, at, false);
                }
            }
        }
    }

    /// Schedules a reply to an earlier client, which [`Faults::left_over`] has added.
    ///
    /// [`Faults::left_over`]: crate::sim::Faults::left_over
    fn send_left_over(&mut self, reply: LeftOver, now: Instant, at: Instant) {
        let faults = self.conditions.faults.clone();
        let line = faults.line_now();
        let (bytes, station, log_number) = match reply.content {
            LeftOverContent::Bytes(bytes) => (bytes, BROADCAST, None),
            LeftOverContent::Reply { station, request, error } => {
                if self.bus.plc(station).is_none() {
                    return;
                }
                let fault = Fault::LeftOver { min: reply.delay, max: reply.delay };
                let log_number =
                    faults.log().arrived(now, &[fault], || Arrival::Request { station, request: request.clone() });
                let frame = Frame { station, command: request.code().into(), data: Bytes::new() };
                let request: Arc<Result<Request, RequestError>> = Arc::new(Ok(request));
                let request = PendingRequest { station, frame, request, log_number, reply: None };
                (self.execute_or_refuse(&request, error).freeze(), station, Some(log_number))
            }
        };
        let delivery = Delivery { station, log_number, line, to: None, outlives: true };
        self.schedule(at, SessionEvent::SendReply(Box::new(OutgoingReply::whole(bytes, delivery))));
    }
}
