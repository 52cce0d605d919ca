//! Rules for sent frames: which may be sent, and when.

use fatek::wire::Side;

use super::super::replies::shape;
use super::super::state::{CallClass, CallResult, CallState, Id, InFlight, LineEcho, Micros, Purpose};
use super::station::{Ambiguity, Shape, Station, Strays};
use super::{ONLY_READ_ELEMENTS_ARE_KNOWN, RuleResult, Spec};
use crate::reference::{frame_content, framed};

/// A frame written by the link.
struct SentFrame<'a> {
    request: &'a [u8],
    station: u8,
    command: u8,
    data: &'a [u8],
}

/// Purpose of a request, its call, and the index of the spelling.
type Classified = (Purpose, Option<Id>, usize);

impl Spec {
    pub(super) fn wrote(&mut self, request: Vec<u8>, is_written: bool, at: Micros) -> RuleResult {
        if let Some(in_flight) = &self.in_flight {
            return Err(format!("two requests on the wire: {request:02X?} beside {:02X?}", in_flight.request));
        }
        if !self.up || self.spent {
            return Err("there is no connection".to_owned());
        }
        if self.is_mute(at) {
            return Err("a request over a mute connection".to_owned());
        }
        let frame = frame_content(self.settings.framing, &request);
        let (station, command, data) = (frame.station, frame.command, frame.data.to_vec());
        if framed(self.settings.framing, Side::Client, station, command, &data) != request {
            return Err(format!("{request:02X?} is no request"));
        }
        let sent = SentFrame { request: &request, station, command, data: &data };
        let (purpose, call, spelling) = self.classify(&sent, at)?;
        let own = call.filter(|_| purpose == Purpose::Call);
        self.oracle.request_sent(station, own, purpose == Purpose::Check && command == 0x4E && !data.is_empty(), at);
        self.decoder.clear();
        if station == 0 {
            // No reply to a broadcast is awaited, but stations may answer it.
            let end = |sent| if is_written { CallResult::Done(Vec::new()) } else { CallResult::Disconnected { sent } };
            call.into_iter().for_each(|id| self.end_with(id, end));
            if is_written {
                self.stations.values_mut().for_each(|entry| entry.broadcast(command, at));
                self.silent_since.values_mut().for_each(|since| *since = at);
            }
            return Ok(());
        }
        let longest_timeout = self.stations.get(&station).map_or(0, |entry| entry.longest_timeout);
        // A check is a part of its call's attempt. A probe waits as long as the longest request of
        // its station.
        let timeout = call.map_or(self.settings.timeout.max(longest_timeout), |id| self.calls[&id].call.timeout);
        self.stations.entry(station).or_default().sent_at = Some(at);
        if purpose != Purpose::LearnEcho {
            let entry = self.stations.entry(station).or_default();
            entry.longest_timeout =
                if purpose == Purpose::Call { longest_timeout.max(timeout) } else { longest_timeout };
        }
        self.in_flight = Some(InFlight {
            purpose,
            station,
            call,
            spelling,
            command,
            data,
            request,
            sent: at,
            give_up: at + timeout,
            limit: at + timeout + self.settings.slow_frame,
            bad_reply: false,
            echoed: false,
            noise: 0,
            held: None,
            followed_by_other: false,
        });
        Ok(())
    }

    /// Finds the purpose of a request, and checks that it may be sent.
    fn classify(&mut self, sent: &SentFrame<'_>, at: Micros) -> Result<Classified, String> {
        let station = sent.station;
        if let Some(entry) = self.stations.get_mut(&station) {
            entry.expire_owed(at);
        }
        let mut resynced = self.resynced.take().filter(|id| self.is_pending(*id, at));
        if let Some(id) = resynced.take_if(|id| self.needs_silence(self.calls[id].call.station)) {
            self.requeue(id);
        }
        let is_check = matches!(sent.command, 0x4E | 0x40 | 0x53);
        // A refused write is not sent again if the refusal may have been another request's.
        let is_skipped = |id: Id| {
            let elsewhere = self.calls[&id].call.station != station;
            self.may_be_skipped(id, at) && (elsewhere || !is_check && !self.has_spelling(id, sent))
        };
        if let Some(id) = resynced.take_if(|id| is_skipped(*id)) {
            self.skip(id);
        }
        if let Some(id) = resynced.filter(|id| self.calls[id].call.station != station) {
            return Err(format!("call {id} has passed its check, but another station gets a request"));
        }
        let probe = self.stations.get(&station).and_then(|entry| entry.offline);
        if let (Some(probe), true) = (probe, is_check) {
            let others = self.stations.values().any(|entry| entry.offline.is_none());
            let due = if others { probe.at.max(self.no_probe_before) } else { probe.at };
            if at < due {
                return Err(format!("station {station} is probed before {due}"));
            }
            let purpose = if self.echo == LineEcho::Unknown { Purpose::LearnEcho } else { Purpose::Check };
            self.check_link_request(purpose, sent, None, at)?;
            return Ok((purpose, None, 0));
        }
        let id = match resynced {
            Some(id) => id,
            None => loop {
                let id = self.next_call(station, at).ok_or_else(|| format!("station {station} has no call to send"))?;
                let skipped = !is_check && self.may_be_skipped(id, at) && !self.has_spelling(id, sent);
                if !skipped {
                    self.check_lane_order(id, at)?;
                }
                self.dequeue(id);
                if !skipped {
                    break id;
                }
                self.skip(id);
            },
        };
        if !is_check {
            return Ok((Purpose::Call, Some(id), self.spelling_of(id, sent, at)?));
        }
        let purpose = if self.echo == LineEcho::Unknown { Purpose::LearnEcho } else { Purpose::Check };
        self.check_link_request(purpose, sent, Some(id), at)?;
        Ok((purpose, Some(id), 0))
    }

    fn has_spelling(&self, id: Id, sent: &SentFrame<'_>) -> bool {
        self.calls[&id].call.spellings.iter().any(|spelling| spelling.request == sent.request)
    }

    /// Notes that the link has ended a call, and that its caller has not seen it yet.
    fn skip(&mut self, id: Id) {
        match self.may_have_failed(id) {
            true => self.end_with(id, |sent| CallResult::OutOfStep { sent }),
            false => self.end_with(id, |sent| CallResult::Timeout { sent }),
        }
    }

    /// Returns whether the reply to a call that has waited cannot come before its deadline, as the
    /// round trips of its station show: then the call ends and is not sent.
    pub(super) fn is_too_late(&self, id: Id, at: Micros, tolerance: Micros) -> bool {
        let CallState { call, called_at, .. } = &self.calls[&id];
        let expected = self.stations.get(&call.station).map_or(0, Station::expected_round_trip);
        let sent_at = self.stations.get(&call.station).and_then(|entry| entry.sent_at);
        let is_busy = sent_at.is_some_and(|sent| at < sent + expected + 2 * tolerance);
        let is_late = at + tolerance >= called_at + 1000 && expected > 0 && at + expected > call.deadline;
        call.class != CallClass::Write && is_busy && is_late
    }

    /// As [`is_too_late`](Self::is_too_late), also if it is so just not, or has been so just
    /// before.
    pub(super) fn may_be_too_late(&self, id: Id, at: Micros) -> bool {
        self.is_too_late(id, at + 1000, 1000)
    }

    /// Returns whether the link may have ended a call without its caller having seen it: a write
    /// whose other spelling was refused. A stray since then shows that the refusal may be
    /// another's.
    pub(super) fn may_have_failed(&self, id: Id) -> bool {
        let state = &self.calls[&id];
        let strays = self.strays_at(state.call.station);
        state.refused_at.is_some_and(|before| before.all != strays.all)
    }

    fn strays_at(&self, station: u8) -> Strays {
        self.stations.get(&station).map(|entry| entry.strays).unwrap_or_default()
    }

    /// Returns whether the link may have ended a waiting call instead of sending it.
    fn may_be_skipped(&self, id: Id, at: Micros) -> bool {
        self.may_have_failed(id) || self.may_be_too_late(id, at)
    }

    /// Checks a request of the link itself: a check, a probe, or a status request that learns the
    /// echo.
    fn check_link_request(
        &mut self,
        purpose: Purpose,
        sent: &SentFrame<'_>,
        call: Option<Id>,
        at: Micros,
    ) -> RuleResult {
        let SentFrame { station, command, data, .. } = *sent;
        let request_shape = shape(self.settings.framing, command, data);
        if purpose == Purpose::LearnEcho {
            let is_status = command == 0x40 && data.is_empty();
            return if is_status { Ok(()) } else { Err("the line's echo is still unknown".to_owned()) };
        }
        let nonce = command == 0x4E && !data.is_empty();
        if nonce && data.len() != 8 {
            return Err(format!("{data:02X?} is no nonce of 8 characters"));
        }
        if nonce && !self.nonces.insert(data.to_vec()) {
            return Err(format!("repeated nonce {data:02X?}"));
        }
        let Some(id) = call else {
            return if nonce { Ok(()) } else { Err(format!("station {station} is probed with {command:02X}")) };
        };
        if self.needs_silence(station) {
            return Err(format!("station {station} is checked during its silence"));
        }
        let (class, plain) = (self.calls[&id].call.class, self.plain_shape(id));
        let entry = self.stations.entry(station).or_default();
        if entry.suspect {
            return if nonce { Ok(()) } else { Err(format!("request {command:02X} to suspect station {station}")) };
        }
        entry.expire_owed(at);
        // A page that probably equals the one before it may be read after a check at once.
        let needed =
            !entry.allows(class, plain) || class == CallClass::Page && entry.ambiguity(plain) == Ambiguity::Reply;
        if !needed {
            return Err(format!("check before call {id}, though no owed reply could match"));
        }
        match (command, entry.refused) {
            (0x4E, false) if nonce || entry.ambiguity(request_shape) == Ambiguity::None => Ok(()),
            (0x40 | 0x53, true) if data.is_empty() && entry.ambiguity(request_shape) == Ambiguity::None => Ok(()),
            _ => Err(format!("{command:02X} is no check for station {station} now: {entry:?}")),
        }
    }

    /// Finds the spelling of a call, and checks that it may be sent.
    fn spelling_of(&mut self, id: Id, sent: &SentFrame<'_>, at: Micros) -> Result<usize, String> {
        let station = sent.station;
        let spellings = &self.calls[&id].call.spellings;
        let spelling = spellings
            .iter()
            .position(|spelling| spelling.request == sent.request)
            .ok_or_else(|| format!("call {id} is next at station {station}, but {:02X?} is sent", sent.request))?;
        if station != 0 {
            self.check_may_send(id, spelling, sent, at)?;
        }
        let strays = self.strays_at(station);
        let state = self.calls.get_mut(&id).ok_or("no such call")?;
        if state.refused_at.is_some_and(|before| before.unexpected != strays.unexpected) {
            return Err(format!("call {id} is sent again, though its refusal may be another request's"));
        }
        if spelling > 0 && state.plain_only {
            return Err(format!("call {id} must use its plain spelling after a refusal"));
        }
        state.sends += 1;
        (state.was_sent, state.waited_for_silence, state.refused_at) = (true, false, None);
        if state.sends > 1 + state.call.retries + u32::from(state.extra_attempt) {
            return Err(format!("call {id} is sent {} times", state.sends));
        }
        Ok(spelling)
    }

    /// Notes that a station is in step if it has been silent for its quiet time.
    pub(super) fn note_silence(&mut self, station: u8, at: Micros) {
        let silence = self.needs_silence(station);
        let entry = self.stations.entry(station).or_default();
        if silence && at >= entry.silence_from + entry.quiet_time(&self.settings) {
            entry.was_silent();
            self.oracle.was_silent(station);
        }
    }

    /// Checks that a station is in step, and that no owed reply could match the request.
    fn check_may_send(&mut self, id: Id, spelling: usize, sent: &SentFrame<'_>, at: Micros) -> RuleResult {
        let SentFrame { station, command, data, .. } = *sent;
        if self.echo == LineEcho::Unknown {
            return Err("the line's echo is still unknown".to_owned());
        }
        self.note_silence(station, at);
        let entry = self.stations.entry(station).or_default();
        if entry.suspect {
            return Err(format!("call {id} is sent to suspect station {station}: {entry:?}"));
        }
        let call = &self.calls[&id].call;
        if !entry.allows(call.class, shape(self.settings.framing, command, data)) {
            return Err(format!("owed reply could match call {id}: {entry:?}"));
        }
        match call.spellings[spelling].extra {
            Some(extra) if ONLY_READ_ELEMENTS_ARE_KNOWN && !entry.answered.contains(&extra) => {
                Err(format!("call {id} reads extra R{extra}, which station {station} has not answered yet"))
            }
            _ => Ok(()),
        }
    }

    fn plain_shape(&self, id: Id) -> Shape {
        let frame = frame_content(self.settings.framing, &self.calls[&id].call.spellings[0].request);
        shape(self.settings.framing, frame.command, &frame.data)
    }

    /// Checks that no call of a higher lane can be sent. One that the link may have ended instead
    /// has ended.
    pub(super) fn check_lane_order(&mut self, id: Id, at: Micros) -> RuleResult {
        let lane = self.calls[&id].call.lane;
        let sendable: Vec<u8> = self.queues.keys().copied().filter(|&station| self.is_sendable(station, at)).collect();
        for station in sendable {
            while let Some(other) = self.next_call(station, at).filter(|other| self.calls[other].call.lane < lane) {
                if !self.may_be_skipped(other, at) {
                    return Err(format!("call {other} has a higher lane than call {id}"));
                }
                self.dequeue(other);
                self.skip(other);
            }
        }
        Ok(())
    }
}
