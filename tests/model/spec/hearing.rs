//! What follows from the bytes that the line brings.

use fatek::wire::Framing;

use super::super::ear::Heard;
use super::super::fit::{Fit, fit, shape};
use super::super::state::{Echo, End, Goal, Held, Id, Micros, Sort, Wire};
use super::super::witness::Mark;
use super::{STRAY_BEHIND_ECHO_COUNTS, Spec};

impl Spec {
    pub(super) fn read(&mut self, bytes: &[u8], marks: &[Option<Mark>], at: Micros) {
        self.ear.hear(bytes, marks);
        while let Some(heard) = self.ear.next(false) {
            self.heard(heard, at);
        }
        self.conclude(at);
        // A frame that is coming in is given the time that it takes.
        if let (Some(wire), true) = (&mut self.wire, self.ear.is_amid_a_frame()) {
            wire.give_up = wire.give_up.max(wire.limit.min(at + self.rules.settle));
        }
    }

    pub(super) fn heard(&mut self, heard: Heard, at: Micros) {
        match heard {
            Heard::Noise { spoils, len } => {
                let Some(wire) = &mut self.wire else { return };
                wire.noise += len;
                wire.fault |= spoils;
                // The reply may have been in it; a call that can be repeated need not wait for it.
                if spoils && wire.call.is_some_and(|id| self.calls[&id].retries_left > 0) {
                    wire.give_up = wire.give_up.min(at + self.rules.settle);
                }
            }
            Heard::Frame { station, command, data, bytes, mark } => {
                if !self.is_echo(station, command, &data, &bytes) {
                    self.witness.heard(station, mark, at);
                    self.frame(station, command, &data, at);
                }
            }
        }
    }

    /// Whether a frame is a request that the line sends back.
    fn is_echo(&mut self, station: u8, command: u8, data: &[u8], bytes: &[u8]) -> bool {
        if self.rules.framing != Framing::Ascii {
            return false;
        }
        if command == 0x40 && data.is_empty() && self.learned_from == Some(station) {
            (self.echo, self.learned_from) = (Echo::Present, None);
            return true;
        }
        let Some(wire) = self.wire.as_mut().filter(|wire| wire.held.is_none()) else { return false };
        let is_copy = !wire.echoed && bytes.eq_ignore_ascii_case(&wire.request);
        let is_no_reply = matches!(fit(self.rules.framing, command, &wire.data, data), Fit::None);
        let echo = is_copy && (self.echo == Echo::Present || wire.goal == Goal::Learn || is_no_reply);
        if echo {
            wire.echoed = true;
            self.echo = Echo::Present;
        }
        echo
    }

    fn frame(&mut self, station: u8, command: u8, data: &[u8], at: Micros) {
        let Some(wire) = &mut self.wire else { return self.stray(station, command, data, at) };
        let own = station == wire.station;
        let answer = match fit(self.rules.framing, command, &wire.data, data) {
            Fit::Reply(words) if own && command == wire.command => Some(Ok(words)),
            Fit::Refusal(code) if own && command == wire.command => Some(Err(code)),
            _ => None,
        };
        match (&wire.held, answer) {
            (Some(held), _) if own && command == wire.command && held.data == data => return,
            (Some(_), _) => wire.followed |= own,
            (None, Some(answer)) => {
                wire.held = Some(Held { data: data.to_vec(), answer });
                if wire.goal == Goal::Learn && self.echo == Echo::Unknown && wire.noise * 2 < wire.request.len() {
                    (self.echo, self.learned_from) = (Echo::Absent, Some(station));
                }
                return;
            }
            (None, None) => wire.fault |= own,
        }
        self.stray(station, command, data, at);
    }

    /// A frame that no request takes.
    fn stray(&mut self, station: u8, command: u8, data: &[u8], at: Micros) {
        if let Some(known) = self.stations.get_mut(&station) {
            known.stray(command, data, at);
        }
    }

    /// A read is understood to its end: if the reply was in it, the exchange is over.
    pub(super) fn conclude(&mut self, at: Micros) {
        if let Some(mut wire) = self.wire.take_if(|wire| wire.held.is_some())
            && let Some(held) = wire.held.take()
        {
            match (wire.goal, wire.call) {
                (Goal::Call, Some(id)) => self.replied(id, &wire, &held, at),
                _ => self.check_replied(&wire, &held, at),
            }
        }
    }

    fn replied(&mut self, id: Id, wire: &Wire, held: &Held, at: Micros) {
        (self.echo_was_last, self.closed_behind_echo) = (false, 0);
        self.spent |= self.one_request;
        let (sort, shape) = (self.calls[&id].call.sort, shape(self.rules.framing, wire.command, &wire.data));
        let known = self.stations.entry(wire.station).or_default();
        // Of two answers to a write the first is its own.
        let contradicted = sort != Sort::Once && wire.followed;
        if contradicted || !known.proves(sort, shape, held) {
            known.doubt(at);
            return self.without_proof(id, sort, at);
        }
        self.is_there(wire.station, at);
        let known = self.stations.entry(wire.station).or_default();
        known.taken(wire, shape, held, &self.rules, at);
        let Some(state) = self.calls.get_mut(&id) else { return };
        let repeated = state.sends > 1;
        if held.answer.is_err() && wire.spelling > 0 {
            // It may be the spelling that is refused. A write is sent as itself only if a check shows the refusal to be its own.
            state.plain = true;
            state.sends -= 1;
            if sort == Sort::Once {
                known.doubt(at);
            }
            return self.put_back(id);
        }
        if held.answer.is_ok() {
            known.answered.extend(&state.call.spellings[wire.spelling].shows);
        }
        let (words, before) = (state.call.words, state.call.spellings[wire.spelling].before);
        self.end(id, |_| match held.answer.clone() {
            Ok(mut values) => {
                if sort == Sort::Read {
                    if before && !values.is_empty() {
                        values.remove(0);
                    }
                    values.truncate(words);
                }
                End::Done(values)
            }
            Err(code) => End::Refused { code, repeated },
        });
    }

    /// The reply may be one to an earlier request, so it is given to no caller.
    fn without_proof(&mut self, id: Id, sort: Sort, at: Micros) {
        let wanted = self.is_wanted(id, at);
        match self.calls.get_mut(&id).filter(|state| sort != Sort::Once && !state.asked_again && wanted) {
            Some(state) => {
                state.asked_again = true;
                self.put_back(id);
            }
            None => self.again_or(id, at, |sent| End::OutOfStep { sent }),
        }
    }

    fn check_replied(&mut self, wire: &Wire, held: &Held, at: Micros) {
        self.is_there(wire.station, at);
        let (rules, shape) = (self.rules, shape(self.rules.framing, wire.command, &wire.data));
        let known = self.stations.entry(wire.station).or_default();
        let passed = match wire.goal {
            // The reply may be a late one: it proves nothing of the station.
            Goal::Learn => {
                known.doubt(at);
                false
            }
            _ => {
                self.echo_was_last = held.answer.is_ok();
                let passed = known.checked(wire, shape, held, &rules, at);
                // A stray behind the echo is none of those that the echo has outlived.
                let followed = STRAY_BEHIND_ECHO_COUNTS && wire.followed;
                known.suspect |= passed && followed;
                passed && !followed
            }
        };
        match wire.call {
            Some(id) if passed => self.cleared = Some(id),
            Some(id) => self.put_back(id),
            None => self.no_probe_before = at + (at - wire.sent) * self.rules.probe_pause,
        }
    }

    /// A station has answered.
    fn is_there(&mut self, station: u8, at: Micros) {
        let known = self.stations.entry(station).or_default();
        known.timeouts = 0;
        if known.offline.take().is_some() {
            self.hurry(at);
        }
    }
}
