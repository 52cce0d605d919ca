//! Rules for received bytes.

use fatek::wire::Framing;

use super::super::decoder::Decoded;
use super::super::oracle::Mark;
use super::super::replies::{ReplyMatch, match_reply, shape};
use super::super::state::{CallClass, CallResult, HeldReply, Id, InFlight, LineEcho, Micros, Purpose};
use super::{STRAY_BEHIND_ECHO_COUNTS, Spec};

impl Spec {
    pub(super) fn read(&mut self, bytes: &[u8], marks: &[Option<Mark>], at: Micros) {
        self.decoder.feed(bytes, marks);
        while let Some(decoded) = self.decoder.next(false) {
            self.handle_decoded(decoded, at);
        }
        self.finish_read(at);
        // A frame in progress extends the timeout by its transmission time.
        if let (Some(in_flight), true) = (&mut self.in_flight, self.decoder.has_partial_frame()) {
            in_flight.give_up = in_flight.give_up.max(in_flight.limit.min(at + self.settings.byte_timeout));
        }
    }

    pub(super) fn handle_decoded(&mut self, decoded: Decoded, at: Micros) {
        match decoded {
            Decoded::Noise { may_hide_frame, len } => {
                let Some(in_flight) = &mut self.in_flight else { return };
                in_flight.noise += len;
                in_flight.bad_reply |= may_hide_frame;
                // The reply may be lost in the noise. A call with retries left does not wait for
                // it.
                if may_hide_frame && in_flight.call.is_some_and(|id| self.calls[&id].retries_left > 0) {
                    in_flight.give_up = in_flight.give_up.min(at + self.settings.settle);
                }
            }
            Decoded::Frame { station, command, data, bytes, mark } => {
                self.stations.values_mut().for_each(|station| station.add_busy(bytes.len()));
                if !self.is_echo(station, command, &data, &bytes) {
                    self.unanswered = None;
                    self.oracle.frame_received(station, mark, at);
                    self.frame(station, command, &data, at);
                }
            }
        }
    }

    /// Returns whether the line has echoed a request.
    fn is_echo(&mut self, station: u8, command: u8, data: &[u8], bytes: &[u8]) -> bool {
        if self.settings.framing != Framing::Ascii {
            return false;
        }
        if command == 0x40 && data.is_empty() && self.learned_from == Some(station) {
            (self.echo, self.learned_from) = (LineEcho::Present, None);
            return true;
        }
        let Some(in_flight) = self.in_flight.as_mut().filter(|in_flight| in_flight.held.is_none()) else {
            return false;
        };
        let is_copy = !in_flight.echoed && bytes.eq_ignore_ascii_case(&in_flight.request);
        let is_no_reply =
            matches!(match_reply(self.settings.framing, command, &in_flight.data, data), ReplyMatch::None);
        let echo =
            is_copy && (self.echo == LineEcho::Present || in_flight.purpose == Purpose::LearnEcho || is_no_reply);
        if echo {
            in_flight.echoed = true;
            self.echo = LineEcho::Present;
        }
        echo
    }

    fn frame(&mut self, station: u8, command: u8, data: &[u8], at: Micros) {
        let Some(in_flight) = &mut self.in_flight else { return self.stray(station, command, data, at) };
        let own = station == in_flight.station;
        let answer = match match_reply(self.settings.framing, command, &in_flight.data, data) {
            ReplyMatch::Reply(words) if own && command == in_flight.command => Some(Ok(words)),
            ReplyMatch::Refusal(code) if own && command == in_flight.command => Some(Err(code)),
            _ => None,
        };
        match (&in_flight.held, answer) {
            (Some(held), _) if own && command == in_flight.command && held.data == data => return,
            (Some(_), _) => {
                in_flight.followed_by_other |= own;
                if let Some(entry) = self.stations.get_mut(&station).filter(|_| own) {
                    entry.strays.all += 1;
                }
            }
            (None, Some(answer)) => {
                in_flight.held = Some(HeldReply { data: data.to_vec(), answer });
                if in_flight.purpose == Purpose::LearnEcho
                    && self.echo == LineEcho::Unknown
                    && in_flight.noise * 2 < in_flight.request.len()
                {
                    (self.echo, self.learned_from) = (LineEcho::Absent, Some(station));
                }
                return;
            }
            (None, None) => in_flight.bad_reply |= own,
        }
        self.stray(station, command, data, at);
    }

    /// Handles a frame that matches no request.
    fn stray(&mut self, station: u8, command: u8, data: &[u8], at: Micros) {
        if let Some(entry) = self.stations.get_mut(&station) {
            entry.stray(command, data, at);
        }
    }

    /// Ends the exchange if the read contained the reply.
    pub(super) fn finish_read(&mut self, at: Micros) {
        if let Some(mut in_flight) = self.in_flight.take_if(|in_flight| in_flight.held.is_some())
            && let Some(held) = in_flight.held.take()
        {
            match (in_flight.purpose, in_flight.call) {
                (Purpose::Call, Some(id)) => self.call_replied(id, &in_flight, &held, at),
                _ => self.check_replied(&in_flight, &held, at),
            }
        }
    }

    fn call_replied(&mut self, id: Id, in_flight: &InFlight, held: &HeldReply, at: Micros) {
        (self.echo_was_last, self.closed_behind_echo) = (false, 0);
        self.spent |= self.one_request;
        let (class, shape) =
            (self.calls[&id].call.class, shape(self.settings.framing, in_flight.command, &in_flight.data));
        let entry = self.stations.entry(in_flight.station).or_default();
        // Of two answers to a write, the first is its own.
        let contradicted = class != CallClass::Write && in_flight.followed_by_other;
        if contradicted || !entry.proves(class, shape, held) {
            entry.make_suspect(at);
            return self.reply_unproven(id, class, at);
        }
        self.station_answered(in_flight, at);
        let entry = self.stations.entry(in_flight.station).or_default();
        entry.reply_taken(in_flight, shape, held, &self.settings, at);
        let Some(state) = self.calls.get_mut(&id) else { return };
        let repeated = state.sends > 1;
        if held.answer.is_err() && in_flight.spelling > 0 {
            // The PLC may have refused only the spelling. A write may use the plain spelling only
            // if a check proves that the refusal was its own.
            state.plain_only = true;
            state.sends -= 1;
            if class == CallClass::Write {
                state.refused_at = Some(entry.strays);
                entry.make_suspect(at);
            }
            return self.requeue(id);
        }
        if held.answer.is_ok() {
            entry.answered.extend(&state.call.spellings[in_flight.spelling].shows);
        }
        let (words, before) = (state.call.words, state.call.spellings[in_flight.spelling].before);
        self.end_with(id, |_| match held.answer.clone() {
            Ok(mut values) => {
                if class == CallClass::Read {
                    if before && !values.is_empty() {
                        values.remove(0);
                    }
                    values.truncate(words);
                }
                CallResult::Done(values)
            }
            Err(code) => CallResult::Refused { code, repeated },
        });
    }

    /// Handles a reply that may answer an earlier request: no caller gets it.
    fn reply_unproven(&mut self, id: Id, class: CallClass, at: Micros) {
        let is_pending = self.is_pending(id, at);
        match self.calls.get_mut(&id).filter(|state| class != CallClass::Write && !state.extra_attempt && is_pending) {
            Some(state) => {
                state.extra_attempt = true;
                self.requeue(id);
            }
            None => self.retry_or(id, at, |sent| CallResult::OutOfStep { sent }),
        }
    }

    fn check_replied(&mut self, in_flight: &InFlight, held: &HeldReply, at: Micros) {
        self.station_answered(in_flight, at);
        let (settings, shape) = (self.settings, shape(self.settings.framing, in_flight.command, &in_flight.data));
        let entry = self.stations.entry(in_flight.station).or_default();
        let passed = match in_flight.purpose {
            // The reply may be a late one, so it proves nothing about the station.
            Purpose::LearnEcho => {
                entry.make_suspect(at);
                false
            }
            _ => {
                self.echo_was_last = held.answer.is_ok();
                let passed = entry.checked(in_flight, shape, held, &settings, at);
                // A stray after the echo is none of those that the echo has outlived.
                let has_stray = STRAY_BEHIND_ECHO_COUNTS && in_flight.followed_by_other;
                entry.suspect |= passed && has_stray;
                passed && !has_stray
            }
        };
        match in_flight.call {
            Some(id) if passed => self.resynced = Some(id),
            Some(id) => self.requeue(id),
            None => self.no_probe_before = at + (at - in_flight.sent) * self.settings.probe_pause,
        }
    }

    /// Records that a station has answered.
    fn station_answered(&mut self, in_flight: &InFlight, at: Micros) {
        let entry = self.stations.entry(in_flight.station).or_default();
        entry.timeouts = 0;
        // A frame that was cut short extends the wait beyond the response timeout, and may have held
        // up the reply: such a time is no round trip.
        let timeout = in_flight.limit - self.settings.slow_frame - in_flight.sent;
        entry.measured((at - in_flight.sent).min(timeout));
        if entry.offline.take().is_some() {
            self.probe_now(at);
        }
    }
}
