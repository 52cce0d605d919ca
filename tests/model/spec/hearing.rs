//! What follows from what the line brings.

use fatek::wire::Framing;

use super::super::ear::Heard;
use super::super::fit::{Fit, fit};
use super::super::state::{Echo, End, Goal, Micros};
use super::Spec;

impl Spec {
    pub(super) fn read(&mut self, bytes: &[u8], at: Micros) {
        self.ear.hear(bytes);
        while let Some(heard) = self.ear.next(false) {
            self.heard(heard, at);
        }
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
            Heard::Frame { station, command, data, bytes } => self.frame(station, command, &data, &bytes, at),
        }
    }

    fn frame(&mut self, station: u8, command: u8, data: &[u8], bytes: &[u8], at: Micros) {
        let Some(wire) = &mut self.wire else { return self.stray(station, at) };
        let copy = self.rules.framing == Framing::Ascii && !wire.echoed && bytes.eq_ignore_ascii_case(&wire.request);
        let fit = if (station, command) == (wire.station, wire.command) {
            fit(self.rules.framing, command, &wire.data, data)
        } else {
            Fit::None
        };
        if copy && (self.echo == Echo::Present || wire.goal == Goal::Learn || matches!(fit, Fit::None)) {
            wire.echoed = true;
            self.echo = Echo::Present;
            return;
        }
        match fit {
            Fit::None if station == wire.station => {
                wire.fault = true;
                wire.doubtful = true;
            }
            Fit::None => self.stray(station, at),
            Fit::Reply(words) => self.answered(Ok(words), at),
            Fit::Refusal(code) => self.answered(Err(code), at),
        }
    }

    /// A frame that nobody asked for.
    fn stray(&mut self, station: u8, at: Micros) {
        if self.stations.contains_key(&station) {
            self.doubt(station, at);
        }
    }

    fn answered(&mut self, answer: Result<Vec<u16>, u8>, at: Micros) {
        let Some(wire) = self.wire.take() else { return };
        let known = self.stations.entry(wire.station).or_default();
        known.timeouts = 0;
        if known.offline.take().is_some() {
            self.hurry(at);
        }
        let passed = wire.goal == Goal::Barrier && answer.is_ok();
        let known = self.stations.entry(wire.station).or_default();
        match (wire.goal, &answer) {
            (Goal::Barrier, Ok(_)) => (known.dirty, known.refused) = (false, None),
            (Goal::Barrier, Err(_)) => known.refused = Some(at),
            (Goal::Learn, _) => {
                if self.echo == Echo::Unknown && wire.noise * 2 < wire.request.len() {
                    self.echo = Echo::Absent;
                }
            }
            (Goal::Call, _) => {}
        }
        if wire.doubtful && wire.goal != Goal::Barrier {
            self.doubt(wire.station, at);
        }
        match (wire.goal, wire.call) {
            (Goal::Call, Some(id)) => {
                let repeated = self.calls[&id].sends > 1;
                self.end(id, |_| match answer {
                    Ok(words) => End::Done(words),
                    Err(code) => End::Refused { code, repeated },
                });
            }
            (_, Some(id)) if passed => self.cleared = Some(id),
            (_, Some(id)) => self.put_back(id),
            (_, None) => self.no_probe_before = at + (at - wire.sent) * self.rules.probe_pause,
        }
    }
}
