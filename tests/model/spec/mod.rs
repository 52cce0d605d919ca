//! The rules of a link, from docs/DESIGN.md ("The link"), docs/GUARANTEES.md and the protocol
//! reference.
//!
//! The rules are independent of the link's implementation. `station` has the rule of "in step";
//! `sending` and `receiving` apply it; `progress` has what must happen in time.
//!
//! The model gets all events in order: calls, bytes on the wire, results. An event that breaks a
//! rule is an error that names the rule. Times are in microseconds; the link's timers fire at whole
//! milliseconds.
//!
//! Where the link has a choice, the model accepts every legal one: any distinct spelling, and a
//! nonce or an empty loop-back where a check is due in step.

mod progress;
mod receiving;
mod sending;
pub(crate) mod station;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::decoder::LineDecoder;
use super::oracle::Oracle;
use super::state::{
    Call, CallResult, CallState, Event, Id, InFlight, LineEcho, LinkSettings, Micros, ProbeTimer, Purpose, Station,
};

/// `true` if a stray after the echo of a check makes the station suspect.
///
/// With `false` the model accepts a link that forgets the stray if both arrive in one read. That
/// costs no result.
const STRAY_BEHIND_ECHO_COUNTS: bool = true;

/// `true` if a read may take an extra element only if that element has been answered before.
///
/// With `false` the model accepts a link that takes a list of scattered elements for consecutive
/// ones. That costs an exchange that is refused.
const ONLY_READ_ELEMENTS_ARE_KNOWN: bool = true;

#[derive(Debug)]
pub(crate) struct Spec {
    settings: LinkSettings,
    calls: BTreeMap<Id, CallState>,
    queues: BTreeMap<u8, [VecDeque<Id>; 3]>,
    /// The call whose check has just been answered. It precedes all others.
    resynced: Option<Id>,
    in_flight: Option<InFlight>,
    stations: BTreeMap<u8, Station>,
    nonces: BTreeSet<Vec<u8>>,
    decoder: LineDecoder,
    echo: LineEcho,
    /// Station whose status reply has shown that the line does not echo.
    learned_from: Option<u8>,
    up: bool,
    connecting: bool,
    /// No reply was taken over this connection since the echo of a check.
    echo_was_last: bool,
    /// Consecutive connections that were closed in that state.
    closed_behind_echo: u32,
    /// When the first and the last of consecutive requests without a reply were sent, and their
    /// number: no frame has come since. A longer time between two of them than the mute timeout is
    /// no silence.
    unanswered: Option<(Micros, Micros, u32)>,
    /// Each connection carries one request only.
    one_request: bool,
    /// That was learned, for this number of further connections.
    learned_for: Option<u8>,
    /// The request of this connection has been answered.
    spent: bool,
    /// Times until which the link may wait for silence of a station.
    silences: BTreeMap<u8, Micros>,
    /// Times since which a call has waited for silence without traffic of its station.
    silent_since: BTreeMap<u8, Micros>,
    oracle: Oracle,
    /// Time since which a call has waited for a connection attempt.
    unconnected_since: Option<Micros>,
    no_probe_before: Micros,
}

type RuleResult = Result<(), String>;

impl Spec {
    pub(crate) fn new(settings: LinkSettings) -> Self {
        Self {
            settings,
            calls: BTreeMap::new(),
            queues: BTreeMap::new(),
            resynced: None,
            in_flight: None,
            stations: BTreeMap::new(),
            nonces: BTreeSet::new(),
            decoder: LineDecoder::new(settings.framing),
            echo: LineEcho::Absent,
            learned_from: None,
            up: false,
            connecting: false,
            echo_was_last: false,
            closed_behind_echo: 0,
            unanswered: None,
            one_request: false,
            learned_for: None,
            spent: false,
            silences: BTreeMap::new(),
            silent_since: BTreeMap::new(),
            oracle: Oracle::new(settings.window),
            unconnected_since: None,
            no_probe_before: 0,
        }
    }

    /// Checks an event against the rules.
    pub(crate) fn observe(&mut self, at: Micros, event: Event) -> RuleResult {
        self.advance_to(at);
        match event {
            Event::Called(id, call) => self.called(id, call, at),
            Event::Cancelled(id) => self.calls.get_mut(&id).into_iter().for_each(|state| state.ended = true),
            Event::Ended(id, end) => return self.ended(id, end, at),
            Event::Connecting => return self.connecting(at),
            Event::Connected => self.connected(at),
            Event::NotConnected => self.connecting = false,
            Event::Lost => self.lost(at),
            Event::Dropped => return self.dropped(at),
            Event::Wrote(bytes) => {
                let count = bytes.len();
                self.wrote(bytes, true, at)?;
                self.stations.values_mut().for_each(|station| station.add_busy(count));
            }
            Event::WroteInVain(bytes) => {
                self.wrote(bytes, false, at)?;
                self.lost(at);
            }
            Event::Read(bytes, marks) => self.read(&bytes, &marks, at),
        }
        Ok(())
    }

    pub(crate) fn all_ended(&self) -> bool {
        self.calls.values().all(|state| state.ended)
    }

    fn called(&mut self, id: Id, call: Call, at: Micros) {
        let (station, lane, retries_left) = (call.station, call.lane, call.retries);
        let check_retries_left = call.check_retries;
        let full = self.queues.get(&station).is_some_and(|lanes| {
            lanes.iter().flatten().filter(|id| self.is_pending(**id, at)).count() >= self.settings.queue
        });
        let due = match self.stations.get(&station) {
            Some(Station { offline: Some(_), .. }) => Some(CallResult::Offline { sent: false }),
            _ if full => Some(CallResult::QueueFull),
            _ => None,
        };
        if due.is_none() {
            self.queues.entry(station).or_default()[lane].push_back(id);
        }
        let state = CallState {
            call,
            retries_left,
            check_retries_left,
            called_at: at,
            cause: None,
            sends: 0,
            was_sent: false,
            extra_attempt: false,
            plain_only: false,
            refused_at: None,
            waited_for_silence: false,
            due,
            ended: false,
        };
        self.calls.insert(id, state);
    }

    fn ended(&mut self, id: Id, end: CallResult, at: Micros) -> RuleResult {
        let (up, state) = (self.up, self.calls.get_mut(&id).ok_or("an unknown call has ended")?);
        if state.ended {
            return Err(format!("call {id} has ended twice, or after it was cancelled"));
        }
        state.ended = true;
        self.oracle.ended(id, &end)?;
        let too_late = self.may_be_too_late(id, at);
        let state = self.calls.get(&id).ok_or("an unknown call has ended")?;
        let sent = state.was_sent;
        let late = at >= whole_ms(state.call.deadline);
        let allowed = match &end {
            CallResult::Timeout { sent: reported } if (late || too_late) && *reported == sent => true,
            CallResult::BadReply { sent: reported }
                if (late || too_late) && *reported == sent && state.cause == Some(true) =>
            {
                true
            }
            CallResult::OutOfStep { sent: reported }
                if (late || too_late) && *reported == sent && state.waited_for_silence =>
            {
                true
            }
            // The refused spelling's refusal may have belonged to another request.
            CallResult::OutOfStep { sent: true } if self.may_have_failed(id) => true,
            CallResult::NotConnected { sent: reported } if late && *reported == sent && !up => true,
            end => state.due.as_ref() == Some(end),
        };
        if !allowed {
            return Err(format!("call {id} has ended with {end:?}, allowed: {:?} (sent: {sent})", state.due));
        }
        if end == (CallResult::OutOfStep { sent: true }) && self.may_have_failed(id) && !late && !too_late {
            // The link would have sent it: the station was in step, perhaps by its silence.
            let station = self.calls[&id].call.station;
            self.note_silence(station, at);
        }
        // The link ended the call before it chose a request, so the check on the wire is for the
        // next one.
        let own = self.in_flight.as_ref().filter(|in_flight| in_flight.call == Some(id));
        let skipped = !late && (too_late || self.may_have_failed(id));
        if let Some(station) = own.filter(|it| it.purpose != Purpose::Call && skipped).map(|it| it.station) {
            let next = self.next_call(station, at).ok_or("the check on the wire is for no call")?;
            self.check_lane_order(next, at)?;
            self.dequeue(next);
            let timeout = self.calls[&next].call.timeout;
            if let Some(in_flight) = &mut self.in_flight {
                in_flight.call = Some(next);
                in_flight.give_up = in_flight.sent + timeout;
                in_flight.limit = in_flight.give_up + self.settings.slow_frame;
            }
        }
        Ok(())
    }

    fn connecting(&mut self, at: Micros) -> RuleResult {
        if self.connecting || self.up && !self.spent {
            return Err("there is a connection already".to_owned());
        }
        (self.up, self.connecting, self.unconnected_since) = (false, true, None);
        let mut queued = self.queues.values().flatten().flatten();
        let waits = queued.any(|id| self.is_pending(*id, at));
        let probes = self.stations.values().any(|station| station.offline.is_some());
        if waits || probes { Ok(()) } else { Err("connects without a waiting call".to_owned()) }
    }

    fn connected(&mut self, at: Micros) {
        (self.up, self.connecting) = (true, false);
        self.decoder.clear();
        if self.echo != LineEcho::Absent {
            self.echo = LineEcho::Unknown;
        }
        self.learned_from = None;
        self.unanswered = None;
        self.echo_was_last = false;
        match &mut self.learned_for {
            Some(0) => (self.one_request, self.learned_for, self.closed_behind_echo) = (false, None, 0),
            Some(connections) => *connections -= 1,
            None => {}
        }
        // Replies to requests over earlier connections, or of other clients, may still arrive.
        self.stations.values_mut().for_each(|entry| entry.reconnected(at));
        if !std::mem::take(&mut self.spent) {
            self.probe_now(at);
        }
    }

    /// The link drops a stream that is lost or spent, and one that is mute.
    fn dropped(&mut self, at: Micros) -> RuleResult {
        if self.up && !self.spent {
            if !self.is_mute(at) {
                return Err(format!("a connection that is not mute is closed: {:?}", self.unanswered));
            }
            let shortest = self.settings.probe_interval.0;
            let probes = self.stations.values_mut().filter_map(|entry| entry.offline.as_mut());
            probes.for_each(|probe| probe.interval = shortest);
            self.lost(at);
        }
        Ok(())
    }

    /// Returns whether nothing is answered over the connection any more.
    fn is_mute(&self, at: Micros) -> bool {
        self.in_flight.is_none()
            && self.unanswered.is_some_and(|(since, _, count)| count >= 3 && at >= since + self.settings.mute)
    }

    fn lost(&mut self, at: Micros) {
        self.up = false;
        self.decoder.clear();
        if self.echo_was_last && !self.one_request {
            self.closed_behind_echo += 1;
            self.one_request = self.closed_behind_echo >= 2;
            self.learned_for = self.one_request.then_some(60);
        }
        if let Some(id) = self.resynced.take() {
            self.requeue(id);
        }
        if let Some(in_flight) = self.in_flight.take() {
            let check_fails = in_flight.purpose != Purpose::Call;
            match in_flight.call {
                Some(id) if check_fails && self.repeats_check(id, at) => self.requeue(id),
                Some(id) => self.retry_or(id, at, |sent| CallResult::Disconnected { sent }),
                None => self.probe_failed(in_flight.station, at),
            }
        }
        self.probe_now(at);
    }

    /// Advances time, and gives up on replies whose timeout has passed.
    fn advance_to(&mut self, at: Micros) {
        self.wait_for_silence(at);
        while let Some(when) =
            self.in_flight.as_ref().map(|in_flight| whole_ms(in_flight.give_up)).filter(|&when| when <= at)
        {
            self.give_up(when);
            self.wait_for_silence(when);
        }
    }

    fn give_up(&mut self, at: Micros) {
        while let Some(decoded) = self.decoder.next(true) {
            self.handle_decoded(decoded, at);
        }
        self.finish_read(at);
        let Some(mut in_flight) = self.in_flight.take() else { return };
        in_flight.bad_reply |= self.decoder.has_partial_frame();
        if in_flight.purpose == Purpose::Check && in_flight.echoed {
            self.echo = LineEcho::Unknown;
        }
        self.echo_was_last = false;
        self.stations.entry(in_flight.station).or_default().timed_out(in_flight.command, at);
        let check_fails = in_flight.purpose != Purpose::Call;
        let state = in_flight.call.and_then(|id| self.calls.get_mut(&id));
        let bad_reply = state.map_or(in_flight.bad_reply, |state| match check_fails {
            true => state.cause.unwrap_or(in_flight.bad_reply),
            false => *state.cause.get_or_insert(in_flight.bad_reply),
        });
        match in_flight.call {
            Some(id) if check_fails && self.repeats_check(id, at) => self.requeue(id),
            Some(id) if bad_reply => self.retry_or(id, at, |sent| CallResult::BadReply { sent }),
            Some(id) => self.retry_or(id, at, |sent| CallResult::Timeout { sent }),
            None => {
                self.no_probe_before = at + (at - in_flight.sent) * self.settings.probe_pause;
                self.probe_failed(in_flight.station, at);
            }
        }
        if !in_flight.bad_reply {
            let (sent, limit) = (in_flight.sent, self.settings.mute);
            let before = self.unanswered.filter(|&(_, last, _)| sent <= last + limit);
            let (since, _, count) = before.unwrap_or((sent, sent, 0));
            self.unanswered = Some((since, sent, count + 1));
            self.timed_out(in_flight.station, at);
        }
    }

    /// Counts a response timeout of full length; may take the station offline.
    fn timed_out(&mut self, station: u8, at: Micros) {
        let settings = self.settings;
        let entry = self.stations.entry(station).or_default();
        entry.timeouts += 1;
        if entry.timeouts >= settings.offline_after && entry.offline.is_none() {
            entry.offline =
                Some(ProbeTimer { at: at + settings.probe_interval.0, interval: settings.probe_interval.0 });
            for id in self.queues.remove(&station).into_iter().flatten().flatten() {
                self.end_with(id, |sent| CallResult::Offline { sent });
            }
        }
    }

    /// Takes a retry of the check before a request that must not be repeated itself.
    fn repeats_check(&mut self, id: Id, at: Micros) -> bool {
        let is_pending = self.is_pending(id, at);
        match self.calls.get_mut(&id).filter(|state| state.check_retries_left > 0 && is_pending) {
            Some(state) => {
                state.check_retries_left -= 1;
                true
            }
            None => false,
        }
    }

    fn retry_or(&mut self, id: Id, at: Micros, otherwise: impl FnOnce(bool) -> CallResult) {
        let is_pending = self.is_pending(id, at);
        let state = self.calls.get_mut(&id).filter(|state| state.retries_left > 0 && is_pending);
        match state {
            Some(state) => {
                state.retries_left -= 1;
                self.requeue(id);
            }
            None => self.end_with(id, otherwise),
        }
    }

    fn end_with(&mut self, id: Id, with: impl FnOnce(bool) -> CallResult) {
        if let Some(state) = self.calls.get_mut(&id)
            && state.due.is_none()
        {
            state.due = Some(with(state.was_sent));
        }
    }

    fn probe_now(&mut self, at: Micros) {
        self.no_probe_before = 0;
        self.stations.values_mut().filter_map(|entry| entry.offline.as_mut()).for_each(|probe| probe.at = at);
    }

    fn probe_failed(&mut self, station: u8, at: Micros) {
        let longest = self.settings.probe_interval.1;
        if let Some(probe) = self.stations.get_mut(&station).and_then(|entry| entry.offline.as_mut()) {
            probe.interval = (2 * probe.interval).min(longest);
            probe.at = at + probe.interval;
        }
    }

    pub(super) fn is_pending(&self, id: Id, at: Micros) -> bool {
        self.calls.get(&id).is_some_and(|state| !state.ended && state.due.is_none() && at < state.call.deadline)
    }

    /// Next call of a station, without those that the link finds too late.
    fn next_call(&self, station: u8, at: Micros) -> Option<Id> {
        let calls = self.queues.get(&station)?.iter().flatten().copied();
        calls.into_iter().find(|id| self.is_pending(*id, at) && !self.is_too_late(*id, at, 0))
    }

    fn dequeue(&mut self, id: Id) {
        let call = &self.calls[&id].call;
        if let Some(lanes) = self.queues.get_mut(&call.station) {
            lanes[call.lane].retain(|other| *other != id);
        }
    }

    fn requeue(&mut self, id: Id) {
        let call = &self.calls[&id].call;
        self.queues.entry(call.station).or_default()[call.lane].push_front(id);
    }
}

/// Time at which a timer for `at` fires.
fn whole_ms(at: Micros) -> Micros {
    at.div_ceil(1000) * 1000
}
