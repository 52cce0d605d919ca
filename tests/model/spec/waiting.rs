//! What must have happened by now.

use super::super::state::{Micros, Station};
use super::{Spec, Verdict, whole_ms};

impl Spec {
    /// All that had to happen by now has.
    pub(crate) fn settled(&mut self, at: Micros) -> Verdict {
        self.pass(at);
        for (id, state) in &self.calls {
            match &state.due {
                _ if state.over => {}
                Some(due) => return Err(format!("call {id} has not ended, and must with {due:?}")),
                None if at >= whole_ms(state.call.deadline) => return Err(format!("call {id} is past its deadline")),
                None => {}
            }
        }
        let askable = self.waiting.keys().filter(|&&station| self.is_askable(station, at));
        let waits = askable.copied().find_map(|station| self.front(station, at));
        let cleared = self.cleared.filter(|id| {
            let station = self.calls[id].call.station;
            self.is_wanted(*id, at) && self.is_askable(station, at)
        });
        let usable = self.up && !self.spent;
        if let (Some(id), true, None) = (waits.or(cleared), usable, &self.wire) {
            return Err(format!("call {id} waits, and nothing is on the wire"));
        }
        for (station, since) in &self.silent_since {
            let known = self.stations.get(station);
            let quiet = known.map_or(self.rules.quiet, |known| known.quiet(&self.rules));
            // A frame that comes within the silence is noticed at its end.
            if usable && self.wire.is_none() && at > whole_ms(since + 2 * quiet) + 1000 {
                return Err(format!("station {station} was silent for long, and a call still waits"));
            }
        }
        if waits.is_none() || usable || self.connecting {
            self.unconnected_since = None;
        } else if at > *self.unconnected_since.get_or_insert(at) + self.rules.backoff + 1000 {
            return Err("a call waits, and no connection is opened".to_owned());
        }
        Ok(())
    }

    /// Whether a call of a station can be sent, or a check before it.
    pub(super) fn is_askable(&self, station: u8, at: Micros) -> bool {
        !self.needs_silence(station) && self.silences.get(&station).is_none_or(|&until| at >= whole_ms(until))
    }

    /// Whether a station must be silent before it is asked anything.
    pub(super) fn needs_silence(&self, station: u8) -> bool {
        let known = self.stations.get(&station);
        let (suspect, refused) = known.map_or((true, false), |known| (known.suspect, known.refused));
        station != 0 && suspect && (refused || self.one_request)
    }

    /// Time has passed while calls wait for silence.
    pub(super) fn wait_for_silence(&mut self, at: Micros) {
        self.silent_since.retain(|station, _| self.waiting.contains_key(station));
        for station in self.waiting.keys().copied().collect::<Vec<_>>() {
            let Some(_) = self.front(station, at).filter(|_| self.needs_silence(station)) else {
                self.silent_since.remove(&station);
                continue;
            };
            let (new, rules) = (Station::default(), self.rules);
            let known = self.stations.get(&station).unwrap_or(&new);
            self.silences.insert(station, at + known.quiet(&rules));
            if self.up && !self.spent {
                // While another station is asked, the silence has perhaps not begun.
                let since = self.silent_since.entry(station).or_insert(at);
                *since = if self.wire.is_some() { at } else { known.heard.max(*since) };
            } else {
                self.silent_since.remove(&station);
            }
            let waiting = self.waiting.get(&station).into_iter().flatten().flatten();
            for id in waiting {
                if let Some(state) = self.calls.get_mut(id) {
                    state.doubted = true;
                }
            }
        }
    }
}
