//! The pulses of the state machine; see [`pulse`](crate::command::pulse) for their states.

use std::time::Duration;

use fatek::tag::{Tag, TagValue};

use super::{Changes, Core, Output, Owner, Reply, Target, Write, WriteFailure, confirmed, warn_of};
use crate::command::Now;
use crate::command::journal::Key;
use crate::command::pulse::{Place, Pulse, PulseRecord, PulseState, off};

impl Core {
    /// Takes up a pulse of an earlier run: it is ended at once.
    pub(super) fn recover_pulse(&mut self, place: Place, record: PulseRecord, now: Now) {
        let Ok(tag) = place.tag.parse::<Tag>() else {
            tracing::error!(plc = %record.plc, tag = ?place.tag, "a stored pulse has no tag: it cannot be ended");
            return;
        };
        tracing::warn!(plc = %record.plc, tag = %record.name, "a pulse has not ended before the restart");
        self.add_pulse(place, Pulse::new(record, tag, PulseState::Waiting(now.run)));
    }

    pub(super) fn add_pulse(&mut self, place: Place, pulse: Pulse) {
        self.figures.of(&pulse.record.plc, |stats| stats.pulses_open = stats.pulses_open.saturating_add(1));
        self.pulses.insert(place, pulse);
    }

    fn remove_pulse(&mut self, place: &Place) {
        if let Some(pulse) = self.pulses.remove(place) {
            self.figures.of(&pulse.record.plc, |stats| stats.pulses_open = stats.pulses_open.saturating_sub(1));
        }
    }

    /// The set was confirmed, or may have been executed: then no command waits for the end.
    pub(super) fn pulse_is_on(&mut self, place: &Place, until: Duration, command: Option<Key>) {
        if let Some(pulse) = self.pulses.get_mut(place) {
            pulse.state = PulseState::On(until);
            pulse.command = command;
        }
    }

    /// Performs the steps of pulses whose time has come.
    pub(in crate::command) fn tick(&mut self, now: Now) {
        let is_due = |pulse: &Pulse| pulse.due().is_some_and(|at| at <= now.run);
        let due: Vec<Place> =
            self.pulses.iter().filter(|(_, pulse)| is_due(pulse)).map(|(place, _)| place.clone()).collect();
        for place in due {
            let Some(pulse) = self.pulses.get(&place) else { continue };
            match pulse.state {
                PulseState::On(_) | PulseState::Waiting(_) => self.end_pulse(&place),
                PulseState::Stored(_) => self.clear_pulse(&place, None),
                PulseState::Beginning | PulseState::Ending | PulseState::Reading | PulseState::Clearing(_) => {}
            }
        }
    }

    /// Sends the reset to the PLC at the place of the pulse. Its name and its tags may have changed.
    fn end_pulse(&mut self, place: &Place) {
        let Some(pulse) = self.pulses.get_mut(place) else { return };
        pulse.state = PulseState::Ending;
        let write = Write { tag: pulse.tag, values: off(), is_end: true, valid_for: Duration::MAX };
        let token = self.token(Owner::Pulse(place.clone()));
        self.outputs.push_back(Output::Write { token, target: Target::Place(place.clone()), write });
    }

    pub(super) fn pulse_written(&mut self, now: Now, place: &Place, result: Result<(), WriteFailure>) {
        let Some(pulse) = self.pulses.get_mut(place) else { return };
        match result {
            Ok(()) if pulse.command.is_some() => {
                pulse.state = PulseState::Reading;
                let (target, tag) = (Target::Place(place.clone()), pulse.tag);
                let token = self.token(Owner::Pulse(place.clone()));
                self.outputs.push_back(Output::Read { token, target, tag });
            }
            Ok(()) => self.clear_pulse(place, None),
            Err(failure) => {
                let at = now.run.saturating_add(pulse.backoff.next_delay());
                self.end_failed(place, at, &failure.error);
            }
        }
    }

    /// Notes that a reset was not confirmed, and that the next one is due at this time.
    fn end_failed(&mut self, place: &Place, at: Duration, error: &str) {
        let Some(pulse) = self.pulses.get_mut(place) else { return };
        if !std::mem::replace(&mut pulse.is_reported, true) {
            let PulseRecord { plc, name, .. } = &pulse.record;
            tracing::warn!(%plc, tag = %name, %error, "the end of a pulse is not confirmed: it is sent again");
        }
        pulse.state = PulseState::Waiting(at);
        let Some(key) = pulse.command.take() else { return };
        let why = format!("pulse: it has begun, and its end is not confirmed yet: {error}");
        let reply = Reply::unknown(Some(&key.id), why);
        let put = self.journal.record(&key, Some(reply.clone())).map(|record| (key.clone(), record));
        let changes = Changes { put: put.into_iter().collect(), ..Changes::default() };
        self.store(Owner::Answer(key, reply), changes);
    }

    pub(super) fn pulse_read(&mut self, place: &Place, result: Result<Vec<TagValue>, String>) {
        let Some(pulse) = self.pulses.get(place) else { return };
        let reply = pulse.command.as_ref().map(|key| {
            if pulse.is_cut {
                Reply::unknown(Some(&key.id), "closed: the pulse was ended early, since the bridge is stopping")
            } else {
                confirmed(key, pulse.tag, &off(), result)
            }
        });
        self.clear_pulse(place, reply);
    }

    /// Removes the record of a pulse that has ended, and stores the reply of its command.
    fn clear_pulse(&mut self, place: &Place, reply: Option<Reply>) {
        let Some(pulse) = self.pulses.get_mut(place) else { return };
        let record = pulse.command.as_ref().and_then(|key| {
            let record = self.journal.record(key, Some(reply.clone()?))?;
            Some((key.clone(), record))
        });
        pulse.state = PulseState::Clearing(reply);
        let end = Some(place.clone());
        let changes = Changes { put: record.into_iter().collect(), end, ..Changes::default() };
        self.store(Owner::Pulse(place.clone()), changes);
    }

    /// The removal of a record is on disk, or has failed and is tried again.
    pub(super) fn pulse_stored(&mut self, now: Now, place: &Place, result: &Result<(), String>) {
        let Some(pulse) = self.pulses.get_mut(place) else { return };
        let at = now.run.saturating_add(pulse.backoff.next_delay());
        let state = std::mem::replace(&mut pulse.state, PulseState::Stored(at));
        let done = if let PulseState::Clearing(Some(reply)) = state {
            pulse.command.take().map(|key| (key, reply))
        } else {
            None
        };
        if result.is_ok() {
            self.remove_pulse(place);
        }
        if let Some((key, reply)) = done {
            warn_of(result, &key);
            self.complete(&key, reply);
        }
    }

    /// Once it is closed: ends the pulses early that would last for too long.
    pub(super) fn cut_pulses(&mut self, now: Now) {
        let Some(grace) = self.grace else { return };
        for pulse in self.pulses.values_mut() {
            if let PulseState::On(until) = pulse.state
                && until > now.run.saturating_add(grace)
            {
                pulse.state = PulseState::On(now.run);
                pulse.is_cut = true;
            }
        }
    }
}
