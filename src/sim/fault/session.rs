//! One connection to a bus with faults, without I/O and without a clock: bytes and times in, bytes
//! and times out.

mod conditions;
mod outgoing;
mod replies;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;

pub(crate) use self::conditions::{Conditions, LeftOvers};
use self::replies::{Delivery, FollowUp, PendingReply, PendingRequest, SessionEvent};
use super::faults::BroadcastDecision;
use super::{Arrival, DisconnectAt, Fault, FaultTarget};
use crate::command::{Request, RequestError};
use crate::sim::Bus;
use crate::sim::bus::{BROADCAST, respond};
use crate::wire::{Frame, Framing, Received};

/// The next action on the connection.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// Write these bytes.
    Bytes(Bytes),
    /// Close the connection, then call [`Session::disconnect`].
    Close,
}

/// One connection to a bus with faults, or a socket for datagrams.
///
/// Invariants:
/// - A station executes its requests in order of arrival. Its replies become ready in that order.
/// - A follow-up is sent before the next reply of its station, unless it roams.
/// - A request that has arrived is executed, unless a fault prevents it.
/// - No output precedes its time, and no output that is due waits for a later one.
#[derive(Debug)]
pub(crate) struct Session {
    bus: Bus,
    conditions: Conditions,
    framing: Framing,
    /// Number of the connection among those of the bus.
    connection: u64,
    is_stream: bool,
    /// By time; at equal times in order of creation.
    events: BTreeMap<(Instant, u64), SessionEvent>,
    /// Follow-ups of replies that were sent, in the same order.
    follow_ups: BTreeMap<(Instant, u64), FollowUp>,
    /// Number of the next event or follow-up.
    next_number: u64,
    client: Client,
    /// `true` if the connection is closed, so that no reply can be sent.
    disconnected: bool,
}

/// Client to which left-over replies can be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Client {
    /// No datagram has come yet.
    Unknown,
    /// The connection is open, and left-over replies from before it have not been sent.
    New,
    Known,
    /// The client has closed the connection, or its half of it.
    Gone,
}

impl Session {
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
            next_number: 0,
            client: Client::New,
            disconnected: false,
        }
    }

    /// A socket for datagrams from any client.
    pub(crate) fn of_datagrams(bus: Bus, conditions: Conditions, framing: Framing) -> Self {
        Self { is_stream: false, client: Client::Unknown, ..Self::new(bus, conditions, framing) }
    }

    /// Takes what was decoded from these bytes.
    pub(crate) fn receive(&mut self, item: Received, bytes: Bytes, now: Instant) {
        self.receive_from(item, bytes, None, now);
    }

    /// Takes what was decoded from these bytes, with the address for its reply.
    pub(crate) fn receive_from(&mut self, item: Received, bytes: Bytes, from: Option<SocketAddr>, now: Instant) {
        match self.bus.taken_for(item, self.framing) {
            Received::Frame(frame) => self.receive_frame(frame, bytes, from, now),
            Received::Discarded { reason, .. } => {
                let line = self.conditions.faults.line_now();
                let arrived = self.conditions.occupancy().receive(now, &line, bytes.len());
                self.conditions.faults.log().arrived(arrived, &[], || Arrival::Noise { reason, bytes });
            }
        }
    }

    /// Takes the next output that is due.
    pub(crate) fn next_output(&mut self, now: Instant) -> Option<Output> {
        self.next_addressed_output(now).map(|(_, output)| output)
    }

    /// Takes the next output that is due, with its address; `None` is that of the latest client.
    pub(crate) fn next_addressed_output(&mut self, now: Instant) -> Option<(Option<SocketAddr>, Output)> {
        self.take_left_over(now);
        loop {
            let event = self.events.first_key_value().map(|(&key, _)| key);
            if let Some(first) = self.follow_ups.first_entry().filter(|first| event.is_none_or(|e| *first.key() < e)) {
                let (at, _) = *first.key();
                if at > now {
                    return None;
                }
                let follow_up = first.remove();
                self.send_follow_up(follow_up, at);
                continue;
            }
            let first = self.events.first_entry().filter(|first| first.key().0 <= now)?;
            let ((at, number), event) = first.remove_entry();
            match event {
                SessionEvent::Execute(request) => self.execute(*request, at),
                SessionEvent::SendReply(reply) => self.send_reply(*reply, at),
                SessionEvent::Echo(bytes, to) => return Some((to, Output::Bytes(bytes))),
                SessionEvent::Close => return Some((None, Output::Close)),
                SessionEvent::Deliver { mut pieces, then_close } => {
                    let piece = pieces.pop_front();
                    if let Some(next_at) = pieces.front().map(|next| next.at) {
                        // Keeps its number, so that no later reply comes between its pieces.
                        self.events.insert((next_at, number), SessionEvent::Deliver { pieces, then_close });
                    } else if then_close {
                        self.schedule(at, SessionEvent::Close);
                    }
                    if let Some(piece) = piece {
                        return Some((piece.to, Output::Bytes(piece.bytes)));
                    }
                }
            }
        }
    }

    /// Time of the next event.
    pub(crate) fn due(&self) -> Option<Instant> {
        let event = self.events.first_key_value().map(|(&(at, _), _)| at);
        let follow_up = self.follow_ups.first_key_value().map(|(&(at, _), _)| at);
        event.into_iter().chain(follow_up).min()
    }

    /// Returns whether more bytes can be read; `false` is backpressure.
    pub(crate) fn has_room(&self) -> bool {
        self.events.len() < MAX_EVENTS
    }

    /// Handles the end of the client's half of the connection: left-over replies go to the next
    /// connection.
    pub(crate) fn end_input(&mut self) {
        self.client = Client::Gone;
        self.keep_left_over();
    }

    /// Handles the end of the connection: only requests that have arrived are still executed.
    pub(crate) fn disconnect(&mut self) {
        self.end_input();
        self.disconnected = true;
        self.events.retain(|_, event| matches!(event, SessionEvent::Execute(_)));
        self.follow_ups.clear();
    }

    /// Handles a datagram from another address than the last: the client counts as new.
    pub(crate) fn change_client(&mut self, now: Instant) {
        self.client = Client::New;
        self.take_left_over(now);
    }

    /// The queue of left-over replies: on a change, [`next_output`](Self::next_output) can have
    /// more to send before [`due`](Self::due).
    pub(crate) fn left_overs(&self) -> Arc<LeftOvers> {
        self.conditions.left_overs().clone()
    }

    fn receive_frame(&mut self, frame: Frame, bytes: Bytes, from: Option<SocketAddr>, now: Instant) {
        let faults = self.conditions.faults.clone();
        let request = Request::decode(&frame, self.framing);
        let target = match frame.station {
            BROADCAST => FaultTarget::Broadcast,
            station if self.bus.plc(station).is_some() => FaultTarget::Station,
            _ => FaultTarget::AbsentStation,
        };
        let mut decision = faults.decide(&frame, request.as_ref().ok(), target);
        let is_line_held = self.conditions.occupancy().is_held(now, decision.line.turnaround_time());
        let arrived = self.conditions.occupancy().receive(now, &decision.line, bytes.len());
        let log_number = faults.log().arrived(arrived, &decision.faults, || arrival(&frame, &request));
        if decision.has(&Fault::Echo) {
            self.schedule(arrived, SessionEvent::Echo(bytes, from));
        }
        let is_lost = is_line_held
            || decision.has(&Fault::Ignore)
            || decision.disconnect() == Some(DisconnectAt::BeforeExecution);
        if is_lost && target == FaultTarget::Station {
            self.retime_for_request(frame.station, arrived, arrived);
        }
        if decision.disconnect() == Some(DisconnectAt::BeforeExecution) {
            return self.schedule(arrived, SessionEvent::Close);
        }
        let executed_at = match target {
            _ if is_lost => arrived,
            FaultTarget::Station => {
                let delay = decision.delay();
                let follow_ups = decision.draw_follow_ups();
                let station = frame.station;
                let (execute_at, ready_at) =
                    self.conditions.occupancy().serve(station, arrived, decision.response_time, delay);
                self.retime_for_request(station, arrived, ready_at);
                let outlives = decision.outlives_connection();
                // Over UDP, a reply that outlives its client goes to the latest address.
                let to = from.filter(|_| !outlives);
                let delivery = Delivery { station, log_number: Some(log_number), line: decision.line, to, outlives };
                let reply = Some(PendingReply { decision, ready_at, follow_ups, delivery });
                let request = PendingRequest { station, frame, request: Arc::new(request), log_number, reply };
                return self.schedule(execute_at, SessionEvent::Execute(Box::new(request)));
            }
            FaultTarget::Broadcast => {
                let response_time = decision.response_time;
                self.broadcast(&frame, request, log_number, from, (arrived, response_time))
            }
            FaultTarget::AbsentStation | FaultTarget::BroadcastListener | FaultTarget::Connection => arrived,
        };
        if decision.disconnect().is_some() {
            self.schedule(executed_at, SessionEvent::Close);
        }
    }

    /// Schedules a broadcast at all stations, and returns the time of the last execution.
    fn broadcast(
        &mut self,
        frame: &Frame,
        request: Result<Request, RequestError>,
        log_number: u64,
        from: Option<SocketAddr>,
        (arrived, response_time): (Instant, Duration),
    ) -> Instant {
        let request = Arc::new(request);
        let faults = self.conditions.faults.clone();
        let mut last = arrived;
        let stations: Vec<_> = self.bus.stations().collect();
        for station in stations {
            let mut frame = frame.clone();
            let (delay, decision) = match faults.decide_broadcast(station, &frame, request.as_ref().as_ref().ok()) {
                BroadcastDecision::Ignored => continue,
                BroadcastDecision::Obeyed => (Duration::ZERO, None),
                BroadcastDecision::Answered { station, delay, decision } => {
                    frame.station = station;
                    decision.faults.iter().for_each(|fault| faults.log().add_fault(log_number, fault));
                    (delay, Some(*decision))
                }
            };
            let (execute_at, ready_at) = self.conditions.occupancy().serve(station, arrived, response_time, delay);
            last = last.max(execute_at);
            let reply = decision.map(|decision| {
                let line = decision.line;
                let delivery = Delivery { station, log_number: Some(log_number), line, to: from, outlives: false };
                PendingReply { decision, ready_at, follow_ups: Vec::new(), delivery }
            });
            let request = PendingRequest { station, frame, request: request.clone(), log_number, reply };
            self.schedule(execute_at, SessionEvent::Execute(Box::new(request)));
        }
        last
    }

    /// Executes a request on a PLC. Returns its reply, with the station number of the frame, and
    /// whether it was executed rather than refused.
    fn respond(&self, station: u8, frame: &Frame, request: &Result<Request, RequestError>) -> (BytesMut, bool) {
        let mut reply = BytesMut::new();
        let executed = self.bus.plc(station).is_some_and(|plc| respond(plc, frame, request, self.framing, &mut reply));
        (reply, executed)
    }

    fn schedule(&mut self, at: Instant, event: SessionEvent) {
        self.events.insert((at, self.next_number), event);
        self.next_number += 1;
    }
}

/// Maximum number of requests and replies in progress. Above it, the connection is not read.
const MAX_EVENTS: usize = 64;

/// Maximum number of duplicates and second answers in progress; further ones are discarded.
const MAX_FOLLOW_UPS: usize = 64;

fn arrival(frame: &Frame, request: &Result<Request, RequestError>) -> Arrival {
    match request {
        Ok(request) => Arrival::Request { station: frame.station, request: request.clone() },
        Err(reason) => Arrival::Unreadable { frame: frame.clone(), reason: reason.clone() },
    }
}

#[cfg(test)]
mod tests;
