//! What is said over one connection, and when. No I/O, and no clock: bytes and instants in, bytes and instants out.

mod answers;
mod conditions;
mod outgoing;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;

use self::answers::{Answer, Delivery, Event, FollowUp, Job};
pub(super) use self::conditions::MAX_LEFT_OVER;
pub(crate) use self::conditions::{Conditions, LeftOvers};
use super::faults::BroadcastVerdict;
use super::{Addressee, Fault, Heard, Moment};
use crate::command::{Request, RequestError};
use crate::sim::Bus;
use crate::sim::bus::{BROADCAST, respond};
use crate::wire::{Frame, Framing, Received};

/// What is to be done to the connection.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// Write this.
    Bytes(Bytes),
    /// Close it, then say [`Conversation::hang_up`].
    Close,
}

/// One connection to a bus with faults, or a socket for datagrams.
///
/// Invariants:
/// - a station executes its requests in the order of their arrival, and its replies become ready in that order;
/// - what follows a reply is sent before the next reply of its station, unless it roams;
/// - what has arrived is executed, unless a fault says otherwise;
/// - nothing is due before its time, and nothing due is left while there is a timer to wait for.
#[derive(Debug)]
pub(crate) struct Conversation {
    bus: Bus,
    conditions: Conditions,
    framing: Framing,
    /// Its number among the connections of the bus.
    connection: u64,
    is_stream: bool,
    /// By their time, and of equal times in the order in which they came up.
    events: BTreeMap<(Instant, u64), Event>,
    /// What follows replies that have gone out, in the same order.
    follow_ups: BTreeMap<(Instant, u64), FollowUp>,
    /// The number of the next event.
    next: u64,
    /// Whether there is a client that left-over replies can be sent to.
    client: Client,
    /// Whether there is nobody left who could hear a reply.
    unheard: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Client {
    /// No datagram has come yet.
    Unknown,
    /// It has opened the connection, and has not been sent what was left over before.
    New,
    Known,
    /// It has ended the connection, or its half of it.
    Gone,
}

impl Conversation {
    /// A connection that a client has opened.
    pub(crate) fn new(bus: Bus, conditions: Conditions, framing: Framing) -> Self {
        let connection = conditions.left_overs().connect();
        Self {
            bus,
            conditions,
            framing,
            connection,
            is_stream: true,
            events: BTreeMap::new(),
            follow_ups: BTreeMap::new(),
            next: 0,
            client: Client::New,
            unheard: false,
        }
    }

    /// A socket for datagrams of any clients.
    pub(crate) fn of_datagrams(bus: Bus, conditions: Conditions, framing: Framing) -> Self {
        Self { is_stream: false, client: Client::Unknown, ..Self::new(bus, conditions, framing) }
    }

    /// Takes what has come, with its bytes.
    pub(crate) fn hear(&mut self, item: Received, bytes: Bytes, now: Instant) {
        self.hear_from(item, bytes, None, now);
    }

    /// Takes what has come from an address, where its reply goes.
    pub(crate) fn hear_from(&mut self, item: Received, bytes: Bytes, from: Option<SocketAddr>, now: Instant) {
        match item {
            Received::Frame(frame) => self.hear_frame(frame, bytes, from, now),
            Received::Discarded { reason, .. } => {
                let takes = self.conditions.faults.line_now().transmission(bytes.len());
                let arrived = self.conditions.occupancy().receive(now, takes);
                self.conditions.faults.log().arrived(arrived, &[], || Heard::Noise { reason, bytes });
            }
        }
    }

    /// The next thing to be done by now.
    pub(crate) fn next(&mut self, now: Instant) -> Option<Output> {
        self.next_to(now).map(|(_, output)| output)
    }

    /// The next thing to be done by now, and for which address; `None` is the latest one.
    pub(crate) fn next_to(&mut self, now: Instant) -> Option<(Option<SocketAddr>, Output)> {
        self.adopt_left_overs(now);
        loop {
            let event = self.events.first_key_value().map(|(&key, _)| key);
            if let Some(first) = self.follow_ups.first_entry().filter(|first| event.is_none_or(|e| *first.key() < e)) {
                let (at, _) = *first.key();
                if at > now {
                    return None;
                }
                let follow_up = first.remove();
                self.follow(follow_up, at);
                continue;
            }
            let first = self.events.first_entry().filter(|first| first.key().0 <= now)?;
            let ((at, number), event) = first.remove_entry();
            match event {
                Event::Execute(job) => self.execute(*job, at),
                Event::Speak(speech) => self.speak(*speech, at),
                Event::Echo(bytes, to) => return Some((to, Output::Bytes(bytes))),
                Event::Close => return Some((None, Output::Close)),
                Event::HandOver { mut pieces, then_close } => {
                    let piece = pieces.pop_front();
                    if let Some(next_at) = pieces.front().map(|next| next.at) {
                        // By its old number: nothing that went out later may come in between.
                        self.events.insert((next_at, number), Event::HandOver { pieces, then_close });
                    } else if then_close {
                        self.schedule(at, Event::Close);
                    }
                    if let Some(piece) = piece {
                        return Some((piece.to, Output::Bytes(piece.bytes)));
                    }
                }
            }
        }
    }

    /// When there is something to be done.
    pub(crate) fn due(&self) -> Option<Instant> {
        let event = self.events.first_key_value().map(|(&(at, _), _)| at);
        let follow_up = self.follow_ups.first_key_value().map(|(&(at, _), _)| at);
        event.into_iter().chain(follow_up).min()
    }

    /// Whether more may be taken.
    pub(crate) fn has_room(&self) -> bool {
        self.events.len() < MAX_EVENTS
    }

    /// The client has ended its half of the connection: left-over replies go to the next one.
    pub(crate) fn end_input(&mut self) {
        self.client = Client::Gone;
        self.leave_over();
    }

    /// The connection is closed: what waits for its execution is all that is left to be done.
    pub(crate) fn hang_up(&mut self) {
        self.end_input();
        self.unheard = true;
        self.events.retain(|_, event| matches!(event, Event::Execute(_)));
        self.follow_ups.clear();
    }

    /// A datagram comes from another address than the last: that is as if a connection opened.
    pub(crate) fn change_client(&mut self, now: Instant) {
        self.client = Client::New;
        self.adopt_left_overs(now);
    }

    /// Signals that [`next`](Self::next) may have more to be done than [`due`](Self::due) says.
    pub(crate) fn left_overs(&self) -> Arc<LeftOvers> {
        self.conditions.left_overs().clone()
    }

    fn hear_frame(&mut self, frame: Frame, bytes: Bytes, from: Option<SocketAddr>, now: Instant) {
        let faults = self.conditions.faults.clone();
        let request = Request::decode(&frame, self.framing);
        let addressee = match frame.station {
            BROADCAST => Addressee::Everybody,
            station if self.bus.plc(station).is_some() => Addressee::Plc,
            _ => Addressee::Nobody,
        };
        let mut verdict = faults.judge(&frame, request.as_ref().ok(), addressee);
        let takes = verdict.line.transmission(bytes.len());
        let arrived = self.conditions.occupancy().receive(now, takes);
        let number = faults.log().arrived(arrived, &verdict.faults, || heard(&frame, &request));
        if verdict.has(&Fault::Echo) {
            self.schedule(arrived, Event::Echo(bytes, from));
        }
        let is_lost = verdict.has(&Fault::Ignore) || verdict.disconnect() == Some(Moment::BeforeExecution);
        if is_lost && addressee == Addressee::Plc {
            self.time_follow_ups(frame.station, arrived, arrived);
        }
        if verdict.disconnect() == Some(Moment::BeforeExecution) {
            return self.schedule(arrived, Event::Close);
        }
        let over_at = match addressee {
            _ if is_lost => arrived,
            Addressee::Plc => {
                let delay = verdict.delay();
                let again = verdict.again();
                let station = frame.station;
                let (execute_at, ready_at) =
                    self.conditions.occupancy().serve(station, arrived, verdict.turnaround, delay);
                self.time_follow_ups(station, arrived, ready_at);
                let outlives = verdict.outlives_connection();
                // With datagrams, what outlives its client is for the latest one.
                let to = from.filter(|_| !outlives);
                let delivery = Delivery { station, number: Some(number), line: verdict.line, to, outlives };
                let answer = Some(Answer { verdict, ready_at, again, delivery });
                let job = Job { station, frame, request: Arc::new(request), number, answer };
                return self.schedule(execute_at, Event::Execute(Box::new(job)));
            }
            Addressee::Everybody => {
                let turnaround = verdict.turnaround;
                self.broadcast(&frame, request, number, from, (arrived, turnaround))
            }
            Addressee::Nobody | Addressee::Listener | Addressee::Server => arrived,
        };
        if verdict.disconnect().is_some() {
            self.schedule(over_at, Event::Close);
        }
    }

    /// Has all stations obey, and says when the last one does.
    fn broadcast(
        &mut self,
        frame: &Frame,
        request: Result<Request, RequestError>,
        number: u64,
        from: Option<SocketAddr>,
        (arrived, turnaround): (Instant, Duration),
    ) -> Instant {
        let request = Arc::new(request);
        let faults = self.conditions.faults.clone();
        let mut last = arrived;
        let stations: Vec<_> = self.bus.stations().collect();
        for station in stations {
            let mut frame = frame.clone();
            let (delay, verdict) = match faults.judge_broadcast(station, &frame, request.as_ref().as_ref().ok()) {
                BroadcastVerdict::Ignored => continue,
                BroadcastVerdict::Obeyed => (Duration::ZERO, None),
                BroadcastVerdict::Answered { station, delay, verdict } => {
                    frame.station = station;
                    verdict.faults.iter().for_each(|fault| faults.log().befell(number, fault));
                    (delay, Some(*verdict))
                }
            };
            let (execute_at, ready_at) = self.conditions.occupancy().serve(station, arrived, turnaround, delay);
            last = last.max(execute_at);
            let answer = verdict.map(|verdict| {
                let line = verdict.line;
                let delivery = Delivery { station, number: Some(number), line, to: from, outlives: false };
                Answer { verdict, ready_at, again: Vec::new(), delivery }
            });
            let job = Job { station, frame, request: request.clone(), number, answer };
            self.schedule(execute_at, Event::Execute(Box::new(job)));
        }
        last
    }

    /// Executes a request on a PLC under the station number of the frame, and returns its reply.
    fn respond(&self, station: u8, frame: &Frame, request: &Result<Request, RequestError>) -> (BytesMut, bool) {
        let mut reply = BytesMut::new();
        let is_done = self.bus.plc(station).is_some_and(|plc| respond(plc, frame, request, self.framing, &mut reply));
        (reply, is_done)
    }

    fn schedule(&mut self, at: Instant, event: Event) {
        self.events.insert((at, self.next), event);
        self.next += 1;
    }
}

/// How many requests and replies a connection may have under way before no more is read from it.
const MAX_EVENTS: usize = 64;

/// How many copies and second answers a connection may have under way; further ones are not sent.
const MAX_FOLLOW_UPS: usize = 64;

fn heard(frame: &Frame, request: &Result<Request, RequestError>) -> Heard {
    match request {
        Ok(request) => Heard::Request { station: frame.station, request: request.clone() },
        Err(reason) => Heard::Unreadable { frame: frame.clone(), reason: reason.clone() },
    }
}

#[cfg(test)]
mod tests;
