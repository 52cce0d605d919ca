//! The rules of a link: those of docs/DESIGN.md ("The link"), docs/GUARANTEES.md and the protocol reference, and nothing of
//! how the link keeps them. `station` has the rule of "in step", `sending` and `hearing` apply it, `waiting` has what must
//! happen in time.
//!
//! The model is told all events in order: calls, bytes on the wire, results. Each event is allowed or an error that names the
//! rule. Times are in microseconds; the link's timers fire at whole milliseconds.
//!
//! Where the link has a choice, the model allows every legal one: any distinct spelling, and a nonce or an empty loop-back
//! where a check is due in step.

mod hearing;
mod sending;
pub(crate) mod station;
mod waiting;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::ear::Ear;
use super::state::{Call, Echo, End, Event, Goal, Id, Micros, Probe, Rules, State, Station, Wire};
use super::witness::Witness;

/// A stray behind the echo of a check makes the station suspect. The link forgets it if both come in one read, which costs no
/// result: set this to `true` when it does not any more.
const STRAY_BEHIND_ECHO_COUNTS: bool = true;

/// A read takes one element more only if that element has been answered. The link takes a list of scattered elements for one
/// of consecutive elements, which costs an exchange that is refused: set this to `true` when it does not any more.
const ONLY_READ_ELEMENTS_ARE_KNOWN: bool = true;

#[derive(Debug)]
pub(crate) struct Spec {
    rules: Rules,
    calls: BTreeMap<Id, State>,
    waiting: BTreeMap<u8, [VecDeque<Id>; 3]>,
    /// The call whose check has just been answered: it goes before all others.
    cleared: Option<Id>,
    wire: Option<Wire>,
    stations: BTreeMap<u8, Station>,
    nonces: BTreeSet<Vec<u8>>,
    ear: Ear,
    echo: Echo,
    /// The station whose status reply has shown that the line does not echo.
    learned_from: Option<u8>,
    up: bool,
    connecting: bool,
    /// Over this connection nothing was taken since the echo of a check.
    echo_was_last: bool,
    /// Connections in a row that were closed then.
    closed_behind_echo: u32,
    /// Each connection carries one request.
    one_request: bool,
    /// That request has been answered.
    spent: bool,
    /// Stations that may be waited for in silence until then.
    silences: BTreeMap<u8, Micros>,
    /// Since when a call has been waiting for silence that nothing has broken.
    silent_since: BTreeMap<u8, Micros>,
    witness: Witness,
    /// Since when a call has been waiting for an attempt to connect.
    unconnected_since: Option<Micros>,
    no_probe_before: Micros,
}

type Verdict = Result<(), String>;

impl Spec {
    pub(crate) fn new(rules: Rules) -> Self {
        Self {
            rules,
            calls: BTreeMap::new(),
            waiting: BTreeMap::new(),
            cleared: None,
            wire: None,
            stations: BTreeMap::new(),
            nonces: BTreeSet::new(),
            ear: Ear::new(rules.framing),
            echo: Echo::Absent,
            learned_from: None,
            up: false,
            connecting: false,
            echo_was_last: false,
            closed_behind_echo: 0,
            one_request: false,
            spent: false,
            silences: BTreeMap::new(),
            silent_since: BTreeMap::new(),
            witness: Witness::new(rules.window),
            unconnected_since: None,
            no_probe_before: 0,
        }
    }

    /// Something has happened.
    pub(crate) fn observe(&mut self, at: Micros, event: Event) -> Verdict {
        self.pass(at);
        match event {
            Event::Called(id, call) => self.called(id, call, at),
            Event::Cancelled(id) => self.calls.get_mut(&id).into_iter().for_each(|state| state.over = true),
            Event::Ended(id, end) => return self.ended(id, end, at),
            Event::Connecting => return self.connecting(at),
            Event::Connected => self.connected(at),
            Event::NotConnected => self.connecting = false,
            Event::Lost => self.lost(at),
            Event::Wrote(bytes) => return self.wrote(bytes, true, at),
            Event::WroteInVain(bytes) => {
                self.wrote(bytes, false, at)?;
                self.lost(at);
            }
            Event::Read(bytes, marks) => self.read(&bytes, &marks, at),
        }
        Ok(())
    }

    pub(crate) fn is_over(&self) -> bool {
        self.calls.values().all(|state| state.over)
    }

    fn called(&mut self, id: Id, call: Call, at: Micros) {
        let (station, lane, retries_left) = (call.station, call.lane, call.retries);
        let full = self.waiting.get(&station).is_some_and(|lanes| {
            lanes.iter().flatten().filter(|id| self.is_wanted(**id, at)).count() >= self.rules.queue
        });
        let due = match self.stations.get(&station) {
            Some(Station { offline: Some(_), .. }) => Some(End::Offline { sent: false }),
            _ if full => Some(End::QueueFull),
            _ => None,
        };
        if due.is_none() {
            self.waiting.entry(station).or_default()[lane].push_back(id);
        }
        let state = State {
            call,
            retries_left,
            sends: 0,
            was_sent: false,
            asked_again: false,
            plain: false,
            doubted: false,
            due,
            over: false,
        };
        self.calls.insert(id, state);
    }

    fn ended(&mut self, id: Id, end: End, at: Micros) -> Verdict {
        let (up, state) = (self.up, self.calls.get_mut(&id).ok_or("a call that nobody made has ended")?);
        if state.over {
            return Err(format!("call {id} has ended twice, or after it was cancelled"));
        }
        state.over = true;
        self.witness.ended(id, &end)?;
        let sent = state.was_sent;
        let late = at >= whole_ms(state.call.deadline);
        let allowed = match &end {
            End::Timeout { sent: said } if late && *said == sent => true,
            End::OutOfStep { sent: said } if late && *said == sent && state.doubted => true,
            // The refusal of another spelling may have been another request's.
            End::OutOfStep { sent: true } if state.plain && state.call.sort == super::state::Sort::Once => true,
            End::NotConnected if late && !sent && !up => true,
            end => state.due.as_ref() == Some(end),
        };
        match allowed {
            true => Ok(()),
            false => Err(format!("call {id} has ended with {end:?}, and may with {:?} (sent: {sent})", state.due)),
        }
    }

    fn connecting(&mut self, at: Micros) -> Verdict {
        if self.connecting || self.up && !self.spent {
            return Err("there is a connection already".to_owned());
        }
        (self.up, self.connecting, self.unconnected_since) = (false, true, None);
        let waits = self.waiting.keys().any(|&station| self.front(station, at).is_some());
        let probes = self.stations.values().any(|station| station.offline.is_some());
        if waits || probes { Ok(()) } else { Err("nobody wants a connection".to_owned()) }
    }

    fn connected(&mut self, at: Micros) {
        (self.up, self.connecting) = (true, false);
        self.ear.forget();
        if self.echo != Echo::Absent {
            self.echo = Echo::Unknown;
        }
        self.learned_from = None;
        self.echo_was_last = false;
        // Replies to what was asked over earlier connections, or by others, may still be on their way.
        self.stations.values_mut().for_each(|known| known.reconnected(at));
        if !std::mem::take(&mut self.spent) {
            self.hurry(at);
        }
    }

    fn lost(&mut self, at: Micros) {
        self.up = false;
        self.ear.forget();
        if self.echo_was_last && !self.one_request {
            self.closed_behind_echo += 1;
            self.one_request = self.closed_behind_echo >= 2;
        }
        if let Some(id) = self.cleared.take() {
            self.put_back(id);
        }
        if let Some(wire) = self.wire.take() {
            match wire.call {
                Some(id) => self.again_or(id, at, |sent| End::Disconnected { sent }),
                None => self.probe_failed(wire.station, at),
            }
        }
        self.hurry(at);
    }

    /// Time passes: an answer that has not come is given up.
    fn pass(&mut self, at: Micros) {
        self.wait_for_silence(at);
        while let Some(when) = self.wire.as_ref().map(|wire| whole_ms(wire.give_up)).filter(|&when| when <= at) {
            self.give_up(when);
            self.wait_for_silence(when);
        }
    }

    fn give_up(&mut self, at: Micros) {
        while let Some(heard) = self.ear.next(true) {
            self.heard(heard, at);
        }
        self.conclude(at);
        let Some(mut wire) = self.wire.take() else { return };
        wire.fault |= self.ear.is_amid_a_frame();
        if wire.goal == Goal::Check && wire.echoed {
            self.echo = Echo::Unknown;
        }
        self.echo_was_last = false;
        self.stations.entry(wire.station).or_default().doubt(at);
        match wire.call {
            Some(id) if wire.fault => self.again_or(id, at, |sent| End::BadReply { sent }),
            Some(id) => self.again_or(id, at, |sent| End::Timeout { sent }),
            None => {
                self.no_probe_before = at + (at - wire.sent) * self.rules.probe_pause;
                self.probe_failed(wire.station, at);
            }
        }
        if !wire.fault && wire.whole {
            self.silent(wire.station, at);
        }
    }

    /// A station has not answered within the whole response timeout.
    fn silent(&mut self, station: u8, at: Micros) {
        let rules = self.rules;
        let known = self.stations.entry(station).or_default();
        known.timeouts += 1;
        if known.timeouts >= rules.offline_after && known.offline.is_none() {
            known.offline = Some(Probe { at: at + rules.probe_interval.0, interval: rules.probe_interval.0 });
            for id in self.waiting.remove(&station).into_iter().flatten().flatten() {
                self.end(id, |sent| End::Offline { sent });
            }
        }
    }

    fn again_or(&mut self, id: Id, at: Micros, otherwise: impl FnOnce(bool) -> End) {
        let wanted = self.is_wanted(id, at);
        let state = self.calls.get_mut(&id).filter(|state| state.retries_left > 0 && wanted);
        match state {
            Some(state) => {
                state.retries_left -= 1;
                self.put_back(id);
            }
            None => self.end(id, otherwise),
        }
    }

    fn end(&mut self, id: Id, with: impl FnOnce(bool) -> End) {
        if let Some(state) = self.calls.get_mut(&id)
            && state.due.is_none()
        {
            state.due = Some(with(state.was_sent));
        }
    }

    fn hurry(&mut self, at: Micros) {
        self.no_probe_before = 0;
        self.stations.values_mut().filter_map(|known| known.offline.as_mut()).for_each(|probe| probe.at = at);
    }

    fn probe_failed(&mut self, station: u8, at: Micros) {
        let longest = self.rules.probe_interval.1;
        if let Some(probe) = self.stations.get_mut(&station).and_then(|known| known.offline.as_mut()) {
            probe.interval = (2 * probe.interval).min(longest);
            probe.at = at + probe.interval;
        }
    }

    pub(super) fn is_wanted(&self, id: Id, at: Micros) -> bool {
        self.calls.get(&id).is_some_and(|state| !state.over && state.due.is_none() && at < state.call.deadline)
    }

    /// The call of a station that is next.
    fn front(&self, station: u8, at: Micros) -> Option<Id> {
        self.waiting.get(&station)?.iter().flatten().copied().find(|id| self.is_wanted(*id, at))
    }

    fn take(&mut self, id: Id) {
        let call = &self.calls[&id].call;
        if let Some(lanes) = self.waiting.get_mut(&call.station) {
            lanes[call.lane].retain(|other| *other != id);
        }
    }

    fn put_back(&mut self, id: Id) {
        let call = &self.calls[&id].call;
        self.waiting.entry(call.station).or_default()[call.lane].push_front(id);
    }
}

/// When a timer for this time fires.
fn whole_ms(at: Micros) -> Micros {
    at.div_ceil(1000) * 1000
}
