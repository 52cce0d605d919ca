//! What may be sent, and when.

use fatek::wire::Side;

use super::super::state::{Echo, End, Goal, Id, Micros, Wire};
use super::{Spec, Verdict};
use crate::book::{carried, framed};

impl Spec {
    pub(super) fn wrote(&mut self, request: Vec<u8>, whole: bool, at: Micros) -> Verdict {
        if let Some(wire) = &self.wire {
            return Err(format!("two requests on the wire: {request:02X?} beside {:02X?}", wire.request));
        }
        if !self.up {
            return Err("there is no connection".to_owned());
        }
        let frame = carried(self.rules.framing, &request);
        let (station, again) =
            (frame.station, framed(self.rules.framing, Side::Client, frame.station, frame.command, &frame.data));
        if again != request {
            return Err(format!("{request:02X?} is no request"));
        }
        let (goal, call) = self.purpose(&request, station, frame.command, &frame.data, at)?;
        self.ear.forget();
        if station == 0 {
            // Nobody answers a broadcast.
            let end = |sent| if whole { End::Done(Vec::new()) } else { End::Disconnected { sent } };
            call.into_iter().for_each(|id| self.end(id, end));
            return Ok(());
        }
        let known = self.stations.entry(station).or_default();
        let own = call.map(|id| &self.calls[&id].call);
        // A barrier is a part of its call's attempt; a probe waits as long as anybody has.
        let timeout = own.map_or(self.rules.timeout.max(known.allowed), |call| call.timeout);
        if goal == Goal::Call {
            known.allowed = known.allowed.max(timeout);
        }
        let limit = own.map_or(at + timeout, |call| call.deadline.min(at + timeout));
        self.wire = Some(Wire {
            goal,
            station,
            call,
            command: frame.command,
            data: frame.data.to_vec(),
            request,
            sent: at,
            give_up: limit,
            limit,
            whole: limit == at + timeout,
            fault: false,
            doubtful: false,
            echoed: false,
            noise: 0,
        });
        Ok(())
    }

    /// What a request is for, if it is allowed at all.
    fn purpose(
        &mut self,
        request: &[u8],
        station: u8,
        command: u8,
        data: &[u8],
        at: Micros,
    ) -> Result<(Goal, Option<Id>), String> {
        let cleared = self.cleared.take().filter(|id| self.is_wanted(*id, at));
        let probe = self.stations.get(&station).and_then(|known| known.offline);
        if command != 0x4E && command != 0x40 {
            return self.call_for(request, station, cleared, at).map(|id| (Goal::Call, Some(id)));
        }
        if let Some(id) = cleared {
            return Err(format!("call {id} has passed its barrier, and another request is sent"));
        }
        if (command == 0x40) != (self.echo == Echo::Unknown) {
            return Err(format!("command {command:02X}, and of the line's echo it is known: {:?}", self.echo));
        }
        let call = match probe {
            Some(probe) => {
                let others = self.stations.values().any(|known| known.offline.is_none());
                let due = if others { probe.at.max(self.no_probe_before) } else { probe.at };
                if at < due {
                    return Err(format!("station {station} is probed before {due}"));
                }
                None
            }
            None => Some(self.front(station, at).ok_or("a station is asked for nobody")?),
        };
        if let Some(id) = call {
            self.first_of_all(id, at)?;
            self.take(id);
        }
        if command == 0x40 {
            return Ok((Goal::Learn, call));
        }
        if call.is_some() && !self.stations.get(&station).is_some_and(|known| known.dirty) {
            return Err(format!("station {station} is not in doubt, and must pass a barrier"));
        }
        if !self.nonces.insert(data.to_vec()) {
            return Err(format!("the nonce {data:02X?} was used before"));
        }
        Ok((Goal::Barrier, call))
    }

    fn call_for(&mut self, request: &[u8], station: u8, cleared: Option<Id>, at: Micros) -> Result<Id, String> {
        let id = match cleared {
            Some(id) => id,
            None => {
                let id = self.front(station, at).ok_or_else(|| format!("station {station} is asked for nobody"))?;
                self.first_of_all(id, at)?;
                self.take(id);
                id
            }
        };
        let wanted = &self.calls[&id].call;
        if wanted.request != request {
            return Err(format!("call {id} is next at station {station}, and {request:02X?} is sent"));
        }
        if station != 0 {
            if self.echo == Echo::Unknown {
                return Err("it is not known whether the line echoes".to_owned());
            }
            let known = self.stations.entry(station).or_default();
            let quiet = self.rules.timeout.max(known.allowed);
            match known.refused {
                // The next best thing to an echo.
                Some(since) if at >= since + quiet => (known.dirty, known.refused) = (false, None),
                _ if known.dirty => return Err(format!("station {station} is in doubt, and has passed no barrier")),
                _ => {}
            }
        }
        let state = self.calls.get_mut(&id).ok_or("no such call")?;
        state.sends += 1;
        if state.sends > 1 + state.call.retries {
            return Err(format!("call {id} is sent for the {}. time", state.sends));
        }
        Ok(id)
    }

    /// No call of a better lane waits, at a station that can be asked.
    fn first_of_all(&self, id: Id, at: Micros) -> Verdict {
        let lane = self.calls[&id].call.lane;
        let askable = |station: &u8| self.stations.get(station).is_none_or(|known| known.refused.is_none());
        let better = |station: &u8| self.front(*station, at).filter(|other| self.calls[other].call.lane < lane);
        match self.waiting.keys().filter(|station| askable(station)).find_map(better) {
            Some(other) => Err(format!("call {other} is of a better lane than call {id}")),
            None => Ok(()),
        }
    }
}
