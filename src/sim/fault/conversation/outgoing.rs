//! Replies from their execution to the line, what follows them, and what is left over of them.

use std::collections::VecDeque;
use std::mem;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;
use tracing::debug;

use super::answers::{Answer, Content, Delivery, Event, FollowUp, Job, Piece, Speech};
use super::conditions::{Remainder, later};
use super::{BROADCAST, Client, Conversation, MAX_FOLLOW_UPS};
use crate::ErrorCode;
use crate::command::{Request, RequestError, encode_refusal};
use crate::sim::fault::faults::Again;
use crate::sim::fault::left_over;
use crate::sim::fault::spoil::{Spoilt, spoil};
use crate::sim::fault::{Fault, Heard, LeftOver};
use crate::wire::Frame;

/// More than there are events.
const AFTER_ALL_EVENTS: u64 = 1 << 63;

impl Conversation {
    pub(super) fn execute(&mut self, mut job: Job, at: Instant) {
        let error = job.answer.as_ref().and_then(|answer| answer.verdict.error());
        let reply = if let Some(error) = error {
            self.refusal(&job.frame, error)
        } else {
            let (reply, is_done) = self.respond(job.station, &job.frame, &job.request);
            if is_done {
                self.conditions.faults.log().executed(job.number, job.station, job.write());
            }
            reply
        };
        let Some(answer) = job.answer.take().filter(|answer| !self.unheard || answer.delivery.outlives) else { return };
        let Answer { mut verdict, ready_at, again, delivery } = answer;
        let Spoilt { reply, copy } = spoil(reply, self.framing, &verdict.faults, &mut verdict.dice);
        let then_close = verdict.disconnect().is_some();
        if !then_close && reply.is_empty() {
            return;
        }
        let refused = verdict.error().is_some();
        let follow_up = |again| self.follow_up((&job, refused), again, &copy, delivery, at);
        let follow_ups = again.into_iter().map(follow_up).collect();
        let speech = Box::new(Speech { bytes: reply, split: verdict.split(), then_close, delivery, follow_ups });
        let ready_at = ready_at.max(at);
        if self.client == Client::Gone && delivery.outlives {
            self.conditions.left_overs().put(self.connection, ready_at, Remainder::Reply(speech));
        } else {
            self.schedule(ready_at, Event::Speak(speech));
        }
    }

    fn refusal(&self, frame: &Frame, error: ErrorCode) -> BytesMut {
        let mut reply = BytesMut::new();
        encode_refusal(frame.command, error, self.framing, frame.station, &mut reply);
        reply
    }

    /// What follows the answer to a request, which may have been refused by [`Fault::Error`].
    fn follow_up(
        &self,
        (job, refused): (&Job, bool),
        again: Again,
        copy: &Bytes,
        delivery: Delivery,
        at: Instant,
    ) -> FollowUp {
        let (timing, is_roaming, content) = match again {
            // A request that is not to be executed is not executed later either.
            Again::SecondAnswer(timing, None) if refused => (timing, false, Content::Bytes(copy.clone())),
            Again::Copy(timing) => (timing, false, Content::Bytes(copy.clone())),
            Again::RoamingCopy(timing) => (timing, true, Content::Bytes(copy.clone())),
            Again::SecondAnswer(timing, None) => (timing, false, job.again(copy)),
            Again::SecondAnswer(timing, Some(error)) => {
                (timing, false, Content::Bytes(self.refusal(&job.frame, error).freeze()))
            }
        };
        FollowUp { content, is_roaming, timing, delivery, waits: false, not_before: at }
    }

    /// A reply is ready: what follows earlier ones of its station goes before it.
    pub(super) fn speak(&mut self, mut speech: Speech, at: Instant) {
        let Delivery { station, .. } = speech.delivery;
        let then_close = speech.then_close;
        let mut pieces = VecDeque::new();
        if !speech.bytes.is_empty() {
            let is_earlier = |follow_up: &FollowUp| follow_up.delivery.station == station && !follow_up.is_roaming;
            let earlier: Vec<_> =
                self.follow_ups.iter().filter(|(_, it)| is_earlier(it)).map(|(&key, _)| key).collect();
            for key in earlier {
                if let Some(follow_up) = self.follow_ups.remove(&key) {
                    let earlier = self.speech_of(follow_up);
                    self.transmit(&earlier, at, &mut pieces);
                }
            }
        }
        let follow_ups = mem::take(&mut speech.follow_ups);
        let (at_once, later_on): (Vec<_>, Vec<_>) = follow_ups.into_iter().partition(FollowUp::is_at_once);
        let at_once: Vec<_> = at_once.into_iter().map(|follow_up| self.speech_of(follow_up)).collect();
        if self.is_stream && !at_once.is_empty() {
            let copies = at_once.iter().flat_map(|copy| &copy.bytes[..]);
            speech.bytes = speech.bytes.iter().chain(copies).copied().collect();
        }
        self.transmit(&speech, at, &mut pieces);
        if !self.is_stream {
            at_once.iter().for_each(|copy| self.transmit(copy, at, &mut pieces));
        }
        let sent_at = pieces.back().map_or(at, |last: &Piece| last.at);
        self.time_roaming(station, sent_at);
        for follow_up in later_on {
            self.add_follow_up(follow_up, sent_at);
        }
        self.hand_over(pieces, at, then_close);
    }

    /// The time of a copy or a second answer has come.
    pub(super) fn follow(&mut self, follow_up: FollowUp, at: Instant) {
        let speech = self.speech_of(follow_up);
        let mut pieces = VecDeque::new();
        self.transmit(&speech, at, &mut pieces);
        self.hand_over(pieces, at, false);
    }

    fn hand_over(&mut self, pieces: VecDeque<Piece>, at: Instant, then_close: bool) {
        let first_at = pieces.front().map_or(at, |first| first.at);
        self.schedule(first_at, Event::HandOver { pieces, then_close });
    }

    /// Adds the pieces of a reply that is ready. What comes at the same time is handed over as one, but for datagrams.
    fn transmit(&mut self, speech: &Speech, at: Instant, burst: &mut VecDeque<Piece>) {
        let mut pieces = speech.pieces();
        let Delivery { number, to, outlives, .. } = speech.delivery;
        if let Some(number) = number.filter(|_| !speech.bytes.is_empty()) {
            self.conditions.faults.log().answered(number, &speech.bytes);
        }
        let takes = pieces.last().map_or(Duration::ZERO, |&(after, _)| after);
        let start = self.conditions.occupancy().send(at, takes);
        let mut is_first = true;
        for (after, bytes) in pieces.drain(..) {
            let piece = Piece { at: later(start, after), bytes, to, outlives };
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

    fn speech_of(&self, follow_up: FollowUp) -> Speech {
        let FollowUp { content, delivery, .. } = follow_up;
        let bytes = match content {
            Content::Bytes(bytes) => bytes,
            Content::Read { frame, request } => {
                let (reply, is_done) = self.respond(delivery.station, &frame, &request);
                if let Some(number) = delivery.number.filter(|_| is_done) {
                    self.conditions.faults.log().executed(number, delivery.station, None);
                }
                reply.freeze()
            }
        };
        Speech::whole(bytes, delivery)
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
            // At equal times those that yield are after all events.
            let number =
                if follow_up.yields_to_reply() { self.next.saturating_add(AFTER_ALL_EVENTS) } else { self.next };
            self.follow_ups.insert((due, number), follow_up);
            self.next += 1;
        } else {
            debug!("too many copies are under way");
        }
    }

    /// When the next reply of a station is ready, of those that were asked for.
    fn next_ready_at(&self, station: u8) -> Option<Instant> {
        self.events.iter().find_map(|(&(at, _), event)| match event {
            Event::Execute(job) => job.answer.as_ref().filter(|_| job.station == station).map(|answer| answer.ready_at),
            Event::Speak(speech) => (speech.delivery.station == station).then_some(at),
            Event::HandOver { .. } | Event::Echo(..) | Event::Close => None,
        })
    }

    /// A request to this station has arrived, and its reply will be ready then.
    pub(super) fn time_follow_ups(&mut self, station: u8, arrived: Instant, ready_at: Instant) {
        self.time_anew(station, |follow_up| follow_up.next_request(arrived, ready_at));
    }

    /// A reply of this station goes out then.
    fn time_roaming(&mut self, station: u8, sent_at: Instant) {
        self.time_anew(station, |follow_up| follow_up.next_reply(sent_at));
    }

    fn time_anew(&mut self, station: u8, mut due: impl FnMut(&mut FollowUp) -> Option<Instant>) {
        let of_station = self.follow_ups.iter_mut().filter(|(_, follow_up)| follow_up.delivery.station == station);
        let timed: Vec<_> = of_station.filter_map(|(&key, follow_up)| Some((key, due(follow_up)?))).collect();
        for (key, due) in timed {
            if let Some(follow_up) = self.follow_ups.remove(&key) {
                self.insert_follow_up(due, follow_up);
            }
        }
    }

    /// The client has gone: what outlives the connection is for the next one.
    pub(super) fn leave_over(&mut self) {
        let mut left: Vec<((Instant, u64), Remainder)> = Vec::new();
        for (key, event) in mem::take(&mut self.events) {
            match event {
                Event::Speak(speech) if speech.delivery.outlives => left.push((key, Remainder::Reply(speech))),
                Event::HandOver { pieces, then_close } => {
                    let (outliving, others): (VecDeque<_>, VecDeque<_>) =
                        pieces.into_iter().partition(|piece| piece.outlives);
                    if !outliving.is_empty() {
                        left.push((key, Remainder::Pieces(outliving)));
                    }
                    if !others.is_empty() || then_close {
                        self.events.insert(key, Event::HandOver { pieces: others, then_close });
                    }
                }
                event @ (Event::Execute(_) | Event::Speak(_) | Event::Echo(..) | Event::Close) => {
                    self.events.insert(key, event);
                }
            }
        }
        for (key, follow_up) in mem::take(&mut self.follow_ups) {
            if follow_up.delivery.outlives {
                left.push((key, Remainder::FollowUp(Box::new(follow_up))));
            } else {
                self.follow_ups.insert(key, follow_up);
            }
        }
        left.sort_by_key(|&(key, _)| key);
        for ((at, _), remainder) in left {
            self.conditions.left_overs().put(self.connection, at, remainder);
        }
    }

    /// Takes what is left over for this connection, in its order.
    pub(super) fn adopt_left_overs(&mut self, now: Instant) {
        match self.client {
            Client::Unknown | Client::Gone => return,
            Client::New => {
                self.client = Client::Known;
                let mut at = now;
                for reply in self.conditions.faults.take_left_over() {
                    at = at.max(later(now, reply.delay));
                    self.begin_with(reply, now, at);
                }
            }
            Client::Known => {}
        }
        for (at, remainder) in self.conditions.left_overs().take(self.connection) {
            let at = at.max(now);
            match remainder {
                Remainder::Reply(speech) => self.schedule(at, Event::Speak(speech)),
                Remainder::FollowUp(follow_up) => self.insert_follow_up(at, *follow_up),
                Remainder::Pieces(mut pieces) => {
                    pieces.iter_mut().for_each(|piece| piece.at = piece.at.max(now));
                    self.hand_over(pieces, at, false);
                }
            }
        }
    }

    /// Sends what a run begins with.
    fn begin_with(&mut self, reply: LeftOver, now: Instant, at: Instant) {
        let faults = self.conditions.faults.clone();
        let line = faults.line_now();
        let (bytes, station, number) = match reply.content {
            left_over::Content::Bytes(bytes) => (bytes, BROADCAST, None),
            left_over::Content::Reply { station, request, error } => {
                if self.bus.plc(station).is_none() {
                    return;
                }
                let fault = Fault::LeftOver { min: reply.delay, max: reply.delay };
                let number =
                    faults.log().arrived(now, &[fault], || Heard::Request { station, request: request.clone() });
                let frame = Frame { station, command: request.code().into(), data: Bytes::new() };
                let request: Arc<Result<Request, RequestError>> = Arc::new(Ok(request));
                let job = Job { station, frame, request, number, answer: None };
                let bytes = if let Some(error) = error {
                    self.refusal(&job.frame, error)
                } else {
                    let (reply, is_done) = self.respond(station, &job.frame, &job.request);
                    if is_done {
                        faults.log().executed(number, station, job.write());
                    }
                    reply
                };
                (bytes.freeze(), station, Some(number))
            }
        };
        let delivery = Delivery { station, number, line, to: None, outlives: true };
        self.schedule(at, Event::Speak(Box::new(Speech::whole(bytes, delivery))));
    }
}
