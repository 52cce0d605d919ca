//! What may be sent, and when.

use fatek::wire::Side;

use super::super::fit::shape;
use super::super::state::{Echo, End, Goal, Id, Micros, Sort, Wire};
use super::station::{Shape, Threat};
use super::{ONLY_READ_ELEMENTS_ARE_KNOWN, Spec, Verdict};
use crate::book::{carried, framed};

/// A frame that the link writes.
struct Sent<'a> {
    request: &'a [u8],
    station: u8,
    command: u8,
    data: &'a [u8],
}

/// What a request is for: its goal, the call, and which spelling of that call it is.
type Purpose = (Goal, Option<Id>, usize);

impl Spec {
    pub(super) fn wrote(&mut self, request: Vec<u8>, whole: bool, at: Micros) -> Verdict {
        if let Some(wire) = &self.wire {
            return Err(format!("two requests on the wire: {request:02X?} beside {:02X?}", wire.request));
        }
        if !self.up || self.spent {
            return Err("there is no connection".to_owned());
        }
        let frame = carried(self.rules.framing, &request);
        let (station, command, data) = (frame.station, frame.command, frame.data.to_vec());
        if framed(self.rules.framing, Side::Client, station, command, &data) != request {
            return Err(format!("{request:02X?} is no request"));
        }
        let sent = Sent { request: &request, station, command, data: &data };
        let (goal, call, spelling) = self.purpose(&sent, at)?;
        let own = call.filter(|_| goal == Goal::Call);
        self.witness.asked(station, own, goal == Goal::Check && command == 0x4E && !data.is_empty(), at);
        self.ear.forget();
        if station == 0 {
            // A broadcast has no reply that is waited for, but stations may answer it.
            let end = |sent| if whole { End::Done(Vec::new()) } else { End::Disconnected { sent } };
            call.into_iter().for_each(|id| self.end(id, end));
            if whole {
                self.stations.values_mut().for_each(|known| known.broadcast(command, at));
            }
            return Ok(());
        }
        let allowed = self.stations.get(&station).map_or(0, |known| known.allowed);
        // A check is a part of its call's attempt; a probe waits as long as the longest request of the station.
        let timeout = call.map_or(self.rules.timeout.max(allowed), |id| self.calls[&id].call.timeout);
        if goal != Goal::Learn {
            let known = self.stations.entry(station).or_default();
            known.allowed = if goal == Goal::Call { allowed.max(timeout) } else { allowed };
        }
        let limit = call.map_or(at + timeout, |id| self.calls[&id].call.deadline.min(at + timeout));
        self.wire = Some(Wire {
            goal,
            station,
            call,
            spelling,
            command,
            data,
            request,
            sent: at,
            give_up: limit,
            limit,
            whole: limit == at + timeout,
            fault: false,
            echoed: false,
            noise: 0,
            held: None,
            followed: false,
        });
        Ok(())
    }

    /// What a request is for, if it is allowed at all.
    fn purpose(&mut self, sent: &Sent<'_>, at: Micros) -> Result<Purpose, String> {
        let station = sent.station;
        if let Some(known) = self.stations.get_mut(&station) {
            known.lapse(at);
        }
        let mut cleared = self.cleared.take().filter(|id| self.is_wanted(*id, at));
        if let Some(id) = cleared.take_if(|id| self.needs_silence(self.calls[id].call.station)) {
            self.put_back(id);
        }
        if let Some(id) = cleared.filter(|id| self.calls[id].call.station != station) {
            return Err(format!("call {id} has passed its check, and another station is asked"));
        }
        let is_check = matches!(sent.command, 0x4E | 0x40 | 0x53);
        let probe = self.stations.get(&station).and_then(|known| known.offline);
        if let (Some(probe), true) = (probe, is_check) {
            let others = self.stations.values().any(|known| known.offline.is_none());
            let due = if others { probe.at.max(self.no_probe_before) } else { probe.at };
            if at < due {
                return Err(format!("station {station} is probed before {due}"));
            }
            let goal = if self.echo == Echo::Unknown { Goal::Learn } else { Goal::Check };
            self.is_good_check(goal, sent, None, at)?;
            return Ok((goal, None, 0));
        }
        let id = match cleared {
            Some(id) => id,
            None => {
                let id = self.front(station, at).ok_or_else(|| format!("station {station} is asked for nobody"))?;
                self.first_of_all(id, at)?;
                self.take(id);
                id
            }
        };
        if !is_check {
            return Ok((Goal::Call, Some(id), self.spelling_of(id, sent, at)?));
        }
        let goal = if self.echo == Echo::Unknown { Goal::Learn } else { Goal::Check };
        self.is_good_check(goal, sent, Some(id), at)?;
        Ok((goal, Some(id), 0))
    }

    /// Whether a request of the link itself is one that may be sent now.
    fn is_good_check(&mut self, goal: Goal, sent: &Sent<'_>, call: Option<Id>, at: Micros) -> Verdict {
        let Sent { station, command, data, .. } = *sent;
        let asked = shape(self.rules.framing, command, data);
        if goal == Goal::Learn {
            let is_status = command == 0x40 && data.is_empty();
            return if is_status { Ok(()) } else { Err("it is not known whether the line echoes".to_owned()) };
        }
        let nonce = command == 0x4E && !data.is_empty();
        if nonce && data.len() != 8 {
            return Err(format!("{data:02X?} is no nonce of 8 characters"));
        }
        if nonce && !self.nonces.insert(data.to_vec()) {
            return Err(format!("the nonce {data:02X?} was used before"));
        }
        let Some(id) = call else {
            return if nonce { Ok(()) } else { Err(format!("station {station} is probed with {command:02X}")) };
        };
        if self.needs_silence(station) {
            return Err(format!("station {station} must be silent, and is checked"));
        }
        let (sort, plain) = (self.calls[&id].call.sort, self.plain_shape(id));
        let known = self.stations.entry(station).or_default();
        if known.suspect {
            return if nonce {
                Ok(())
            } else {
                Err(format!("station {station} is suspect, and is asked {command:02X}"))
            };
        }
        known.lapse(at);
        // A page that is probably equal to the one before it may be asked for behind a check at once.
        let needed = !known.allows(sort, plain) || sort == Sort::Page && known.threat(plain) == Threat::Reply;
        if !needed {
            return Err(format!("nothing owed could answer call {id}, and a check goes before it"));
        }
        match (command, known.refused) {
            (0x4E, false) if nonce || known.threat(asked) == Threat::None => Ok(()),
            (0x40 | 0x53, true) if data.is_empty() && known.threat(asked) == Threat::None => Ok(()),
            _ => Err(format!("{command:02X} is no check for station {station} now: {known:?}")),
        }
    }

    /// Which spelling of a call a request is, if it may be sent now.
    fn spelling_of(&mut self, id: Id, sent: &Sent<'_>, at: Micros) -> Result<usize, String> {
        let station = sent.station;
        let spellings = &self.calls[&id].call.spellings;
        let spelling = spellings
            .iter()
            .position(|spelling| spelling.request == sent.request)
            .ok_or_else(|| format!("call {id} is next at station {station}, and {:02X?} is sent", sent.request))?;
        if station != 0 {
            self.may_be_asked(id, spelling, sent, at)?;
        }
        let state = self.calls.get_mut(&id).ok_or("no such call")?;
        if spelling > 0 && state.plain {
            return Err(format!("a spelling of call {id} was refused, and it is not sent as itself"));
        }
        state.sends += 1;
        (state.was_sent, state.doubted) = (true, false);
        if state.sends > 1 + state.call.retries + u32::from(state.asked_again) {
            return Err(format!("call {id} is sent for the {}. time", state.sends));
        }
        Ok(spelling)
    }

    /// Whether a station is in step, and nothing owed could answer a request.
    fn may_be_asked(&mut self, id: Id, spelling: usize, sent: &Sent<'_>, at: Micros) -> Verdict {
        let Sent { station, command, data, .. } = *sent;
        if self.echo == Echo::Unknown {
            return Err("it is not known whether the line echoes".to_owned());
        }
        let silence = self.needs_silence(station);
        let known = self.stations.entry(station).or_default();
        if silence && at >= known.heard + known.quiet(&self.rules) {
            known.was_silent();
            self.witness.was_silent(station);
        }
        if known.suspect {
            return Err(format!("station {station} is suspect, and call {id} is sent: {known:?}"));
        }
        let call = &self.calls[&id].call;
        if !known.allows(call.sort, shape(self.rules.framing, command, data)) {
            return Err(format!("what is owed could answer call {id}: {known:?}"));
        }
        match call.spellings[spelling].extra {
            Some(extra) if ONLY_READ_ELEMENTS_ARE_KNOWN && !known.answered.contains(&extra) => {
                Err(format!("call {id} is sent with R{extra}, which station {station} has not answered"))
            }
            _ => Ok(()),
        }
    }

    fn plain_shape(&self, id: Id) -> Shape {
        let frame = carried(self.rules.framing, &self.calls[&id].call.spellings[0].request);
        shape(self.rules.framing, frame.command, &frame.data)
    }

    /// No call of a better lane waits, at a station that can be asked.
    fn first_of_all(&self, id: Id, at: Micros) -> Verdict {
        let lane = self.calls[&id].call.lane;
        let better = |station: u8| self.front(station, at).filter(|other| self.calls[other].call.lane < lane);
        match self.waiting.keys().copied().filter(|&station| self.is_askable(station, at)).find_map(better) {
            Some(other) => Err(format!("call {other} is of a better lane than call {id}")),
            None => Ok(()),
        }
    }
}
