//! What is said over one connection, and when. No I/O, and no clock: bytes and instants in, bytes and instants out.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio::time::Instant;

use super::faults::Verdict;
use super::spoil::spoil;
use super::{Addressee, Fault, Faults, Heard, Line, Moment};
use crate::command::{Class, Code, Request, encode_refusal};
use crate::sim::Bus;
use crate::sim::bus::{BROADCAST, respond};
use crate::wire::{FieldError, Frame, Framing, Received};

/// What a bus that is not as it should be has besides its PLCs. Clones are the same.
#[derive(Clone, Debug)]
pub(crate) struct Conditions {
    faults: Faults,
    occupancy: Arc<Mutex<Occupancy>>,
}

impl Conditions {
    pub(crate) fn new(faults: Faults) -> Self {
        Self { faults, occupancy: Arc::default() }
    }

    pub(crate) fn faults(&self) -> &Faults {
        &self.faults
    }

    fn occupancy(&self) -> MutexGuard<'_, Occupancy> {
        // Nothing panics under the lock.
        self.occupancy.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Until when the parts of a bus are taken.
#[derive(Debug, Default)]
struct Occupancy {
    incoming: Option<Instant>,
    outgoing: Option<Instant>,
    stations: BTreeMap<u8, Instant>,
}

impl Occupancy {
    /// When something that begins to come now has come.
    fn receive(&mut self, now: Instant, takes: Duration) -> Instant {
        let end = later(free(self.incoming, now), takes);
        self.incoming = Some(end);
        end
    }

    /// When a station executes a request, and when it is ready with its reply.
    fn serve(&mut self, station: u8, arrived: Instant, turnaround: Duration, delay: Duration) -> (Instant, Instant) {
        let execute_at = later(free(self.stations.get(&station).copied(), arrived), turnaround);
        let ready_at = later(execute_at, delay);
        self.stations.insert(station, ready_at);
        (execute_at, ready_at)
    }

    /// When something that is ready begins to go out.
    fn send(&mut self, ready: Instant, takes: Duration) -> Instant {
        let start = free(self.outgoing, ready);
        self.outgoing = Some(later(start, takes));
        start
    }
}

fn free(taken_until: Option<Instant>, now: Instant) -> Instant {
    taken_until.map_or(now, |until| until.max(now))
}

/// A day is longer than any test waits, and still within what a clock can hold.
fn later(at: Instant, by: Duration) -> Instant {
    at.checked_add(by.min(Duration::from_secs(86_400))).unwrap_or(at)
}

/// What is to be done to the connection.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// Write this.
    Bytes(Bytes),
    /// Close it, then say [`Conversation::hang_up`].
    Close,
}

/// One connection to a bus with faults.
///
/// What must always hold:
/// - a station executes its requests in the order of their arrival, and its replies become ready in that order;
/// - what has arrived is executed, unless a fault says otherwise;
/// - nothing is due before its time, and nothing due is left while there is a timer to wait for.
#[derive(Debug)]
pub(crate) struct Conversation {
    bus: Bus,
    conditions: Conditions,
    framing: Framing,
    /// By their time, and of equal times in the order in which they came up.
    events: BTreeMap<(Instant, u64), Event>,
    /// The number of the next event.
    next: u64,
    /// Whether there is nobody left who could hear a reply.
    unheard: bool,
}

impl Conversation {
    pub(crate) fn new(bus: Bus, conditions: Conditions, framing: Framing) -> Self {
        Self { bus, conditions, framing, events: BTreeMap::new(), next: 0, unheard: false }
    }

    /// Takes what has come, with its bytes.
    pub(crate) fn hear(&mut self, item: Received, bytes: Bytes, now: Instant) {
        match item {
            Received::Frame(frame) => self.hear_frame(frame, bytes, now),
            Received::Discarded { reason, .. } => {
                let takes = self.conditions.faults.line_now().transmission(bytes.len());
                let arrived = self.conditions.occupancy().receive(now, takes);
                self.conditions.faults.log().arrived(arrived, &[], || Heard::Noise { reason, bytes });
            }
        }
    }

    /// The next thing to be done by now.
    pub(crate) fn next(&mut self, now: Instant) -> Option<Output> {
        loop {
            let first = self.events.first_entry().filter(|first| first.key().0 <= now)?;
            let ((at, number), event) = first.remove_entry();
            match event {
                Event::Execute(job) => self.execute(*job, at),
                Event::Speak(speech) => self.speak(*speech, at),
                Event::Echo(bytes) => return Some(Output::Bytes(bytes)),
                Event::Close => return Some(Output::Close),
                Event::HandOver { mut pieces, then_close } => {
                    let piece = pieces.pop_front();
                    if let Some(&(next_at, _)) = pieces.front() {
                        // By its old number: nothing that went out later may come in between.
                        self.events.insert((next_at, number), Event::HandOver { pieces, then_close });
                    } else if then_close {
                        self.schedule(at, Event::Close);
                    }
                    if let Some((_, piece)) = piece {
                        return Some(Output::Bytes(piece));
                    }
                }
            }
        }
    }

    /// When there is something to be done.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.events.first_key_value().map(|(&(at, _), _)| at)
    }

    /// Whether more may be taken.
    pub(crate) fn has_room(&self) -> bool {
        self.events.len() < MAX_EVENTS
    }

    /// The connection is closed: what waits for its execution is all that is left to be done.
    pub(crate) fn hang_up(&mut self) {
        self.unheard = true;
        self.events.retain(|_, event| matches!(event, Event::Execute(_)));
    }

    fn hear_frame(&mut self, frame: Frame, bytes: Bytes, now: Instant) {
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
            self.schedule(arrived, Event::Echo(bytes));
        }
        if verdict.disconnect() == Some(Moment::BeforeExecution) {
            return self.schedule(arrived, Event::Close);
        }
        let over_at = match addressee {
            _ if verdict.has(&Fault::Ignore) => arrived,
            Addressee::Plc => {
                let delay = verdict.delay();
                let station = frame.station;
                let times = self.conditions.occupancy().serve(station, arrived, verdict.turnaround, delay);
                let job = Job { station, frame, request: Arc::new(request), number, answer: Some((verdict, times.1)) };
                return self.schedule(times.0, Event::Execute(Box::new(job)));
            }
            Addressee::Everybody => self.broadcast(&frame, request, number, arrived, verdict.turnaround),
            Addressee::Nobody | Addressee::Server => arrived,
        };
        if verdict.disconnect().is_some() {
            self.schedule(over_at, Event::Close);
        }
    }

    /// Has all stations obey, and says when the last one does.
    fn broadcast(
        &mut self,
        frame: &Frame,
        request: Result<Request, FieldError>,
        number: u64,
        arrived: Instant,
        turnaround: Duration,
    ) -> Instant {
        let request = Arc::new(request);
        let faults = self.conditions.faults.clone();
        let mut last = arrived;
        let stations: Vec<_> = self.bus.stations().collect();
        for station in stations {
            if faults.ignores_broadcast(station, frame, request.as_ref().as_ref().ok()) {
                continue;
            }
            let (execute_at, _) = self.conditions.occupancy().serve(station, arrived, turnaround, Duration::ZERO);
            last = last.max(execute_at);
            let job = Job { station, frame: frame.clone(), request: request.clone(), number, answer: None };
            self.schedule(execute_at, Event::Execute(Box::new(job)));
        }
        last
    }

    fn execute(&mut self, job: Job, at: Instant) {
        let Some(plc) = self.bus.plc(job.station) else { return };
        let mut reply = BytesMut::new();
        let error = job.answer.as_ref().and_then(|(verdict, _)| verdict.error());
        if let Some(error) = error {
            encode_refusal(job.frame.command, error, self.framing, job.station, &mut reply);
        } else if respond(plc, &job.frame, &job.request, self.framing, &mut reply) {
            let is_write = Code::from_u8(job.frame.command).is_some_and(|code| code.class() != Class::Read);
            let write = job.request.as_ref().as_ref().ok().filter(|_| is_write);
            self.conditions.faults.log().executed(job.number, job.station, write);
        }
        if let Some((mut verdict, ready_at)) = job.answer.filter(|_| !self.unheard) {
            let bytes = spoil(reply, self.framing, &verdict.faults, &mut verdict.dice);
            let then_close = verdict.disconnect().is_some();
            if then_close || !bytes.is_empty() {
                let speech =
                    Speech { bytes, split: verdict.split(), line: verdict.line, then_close, number: job.number };
                self.schedule(ready_at.max(at), Event::Speak(Box::new(speech)));
            }
        }
    }

    fn speak(&mut self, speech: Speech, at: Instant) {
        let mut pieces = speech.pieces();
        if !speech.bytes.is_empty() {
            self.conditions.faults.log().answered(speech.number, &speech.bytes);
        }
        let takes = pieces.last().map_or(Duration::ZERO, |&(after, _)| after);
        let start = self.conditions.occupancy().send(at, takes);
        let pieces: VecDeque<_> = pieces.drain(..).map(|(after, piece)| (later(start, after), piece)).collect();
        let first_at = pieces.front().map_or(at, |&(at, _)| at);
        self.schedule(first_at, Event::HandOver { pieces, then_close: speech.then_close });
    }

    fn schedule(&mut self, at: Instant, event: Event) {
        self.events.insert((at, self.next), event);
        self.next += 1;
    }
}

/// How many requests and replies a connection may have under way before no more is read from it.
const MAX_EVENTS: usize = 64;

#[derive(Debug)]
enum Event {
    /// The station's turn has come.
    Execute(Box<Job>),
    /// A reply is ready to go out.
    Speak(Box<Speech>),
    /// Pieces of a reply have come, each at its time.
    HandOver { pieces: VecDeque<(Instant, Bytes)>, then_close: bool },
    /// A request comes back.
    Echo(Bytes),
    /// The connection ends.
    Close,
}

/// A request that a station is to execute.
#[derive(Debug)]
struct Job {
    station: u8,
    frame: Frame,
    request: Arc<Result<Request, FieldError>>,
    /// Which entry of the log it is.
    number: u64,
    /// What befalls it, and when the reply is ready. Broadcasts have no reply.
    answer: Option<(Verdict, Instant)>,
}

/// A reply that goes out.
#[derive(Debug)]
struct Speech {
    bytes: Bytes,
    /// How many pieces, and the pause between them.
    split: (usize, Duration),
    line: Line,
    then_close: bool,
    /// Which entry of the log it answers.
    number: u64,
}

impl Speech {
    /// What is handed over at once, and how long after the beginning.
    fn pieces(&self) -> Vec<(Duration, Bytes)> {
        let (count, pause) = self.split;
        let len = self.bytes.len();
        let count = count.clamp(1, len.max(1));
        let mut pieces = Vec::new();
        let mut paused = Duration::ZERO;
        let mut from = 0;
        for nth in 1..=count {
            let end = len * nth / count;
            while from < end {
                let to = if self.line.is_byte_by_byte() { from + 1 } else { end };
                pieces.push((self.line.transmission(to).saturating_add(paused), self.bytes.slice(from..to)));
                from = to;
            }
            paused = paused.saturating_add(pause);
        }
        pieces
    }
}

fn heard(frame: &Frame, request: &Result<Request, FieldError>) -> Heard {
    match request {
        Ok(request) => Heard::Request { station: frame.station, request: request.clone() },
        Err(reason) => Heard::Unreadable { frame: frame.clone(), reason: reason.clone() },
    }
}

#[cfg(test)]
mod tests;
