//! Rules for progress: what must have happened by now.

use super::super::state::{Micros, Station};
use super::{RuleResult, Spec, whole_ms};

impl Spec {
    /// Checks that everything due by now has happened.
    pub(crate) fn check_progress(&mut self, at: Micros) -> RuleResult {
        self.advance_to(at);
        for (id, state) in &self.calls {
            match &state.due {
                _ if state.ended => {}
                Some(due) => return Err(format!("call {id} has not ended, expected {due:?}")),
                None if at >= whole_ms(state.call.deadline) => return Err(format!("call {id} is past its deadline")),
                None => {}
            }
        }
        let askable = self.queues.keys().filter(|&&station| self.is_sendable(station, at));
        let waits =
            askable.filter_map(|station| self.next_call(*station, at)).find(|id| !self.may_be_too_late(*id, at));
        let resynced = self.resynced.filter(|id| {
            let station = self.calls[id].call.station;
            self.is_pending(*id, at) && self.is_sendable(station, at)
        });
        let usable = self.up && !self.spent;
        if let (Some(id), true, None) = (waits.or(resynced), usable, &self.in_flight) {
            return Err(format!("call {id} waits while no request is on the wire"));
        }
        for (station, since) in &self.silent_since {
            let entry = self.stations.get(station);
            let quiet = entry.map_or(self.settings.quiet, |entry| entry.quiet_time(&self.settings));
            // A frame within the silence is noticed at its end.
            let next = self.next_call(*station, at);
            let is_too_late = next.is_some_and(|id| self.may_be_too_late(id, at));
            if usable && !is_too_late && self.in_flight.is_none() && at > whole_ms(since + 2 * quiet) + 1000 {
                return Err(format!(
                    "station {station} was silent from {since} for {quiet}, but a call still waits at {at}"
                ));
            }
        }
        if waits.is_none() || usable || self.connecting {
            self.unconnected_since = None;
        } else if at > *self.unconnected_since.get_or_insert(at) + self.settings.backoff + 1000 {
            return Err("a call waits while no connection is attempted".to_owned());
        }
        Ok(())
    }

    /// Returns whether a call of a station, or a check before it, can be sent.
    pub(super) fn is_sendable(&self, station: u8, at: Micros) -> bool {
        !self.needs_silence(station) && self.silences.get(&station).is_none_or(|&until| at >= whole_ms(until))
    }

    /// Returns whether a station must be silent before its next request.
    pub(super) fn needs_silence(&self, station: u8) -> bool {
        let entry = self.stations.get(&station);
        let (suspect, refused) = entry.map_or((true, false), |entry| (entry.suspect, entry.refused));
        station != 0 && suspect && (refused || self.one_request)
    }

    /// Updates the silences that calls wait for.
    pub(super) fn wait_for_silence(&mut self, at: Micros) {
        self.silent_since.retain(|station, _| self.queues.contains_key(station));
        for station in self.queues.keys().copied().collect::<Vec<_>>() {
            let Some(_) = self.next_call(station, at).filter(|_| self.needs_silence(station)) else {
                self.silent_since.remove(&station);
                continue;
            };
            let (new, settings) = (Station::default(), self.settings);
            let entry = self.stations.get(&station).unwrap_or(&new);
            self.silences.insert(station, at + entry.quiet_time(&settings));
            if self.up && !self.spent {
                // During another station's exchange the silence may not have begun.
                let since = self.silent_since.entry(station).or_insert(at);
                *since = if self.in_flight.is_some() { at } else { entry.silence_from.max(*since) };
            } else {
                self.silent_since.remove(&station);
            }
            let waiting = self.queues.get(&station).into_iter().flatten().flatten();
            for id in waiting {
                if let Some(state) = self.calls.get_mut(id) {
                    state.waited_for_silence = true;
                }
            }
        }
    }
}
