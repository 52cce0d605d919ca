//! The state machine of commands: order, ids, results and pulses. No I/O, and no clock.
//!
//! The driver hands in events with the time and the configuration, and performs the [`Output`]s: writes to the
//! disk and to PLCs, whose results come back as events with the same token.
//!
//! ```text
//!  arrived ─▶ rules, rate ─▶ queue of the PLC ─▶ Beginning ─▶ Writing ─▶ Reading ─▶ Finishing ─▶ reply
//!                                        id on disk ┘   to the PLC ┘    read back ┘   result on disk ┘
//! ```
//!
//! Invariants:
//! - An id is on disk before its write is sent, and is sent once.
//! - The reply `ok` is given only after the PLC has confirmed the write, and its result is on disk.
//! - A PLC has one command from `Beginning` to `Finishing`; a pulse leaves it when its set is confirmed.
//! - Each token is handed in once.

mod pulses;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use fatek::tag::{Tag, TagValue};
use serde_json::Value;

use super::journal::{IsOther, Journal, Key, Record, State};
use super::pulse::{Place, Pulse, PulseRecord, PulseState};
use super::rate::RateLimit;
use super::reply::{Outcome, Refusal, Reply};
use super::rules::{Catalog, Plan};
use super::stats::Figures;
use super::{CommandLimits, Now};

/// A command whose payload was parsed and checked.
#[derive(Debug)]
pub(super) struct Received {
    pub(super) key: Key,
    pub(super) digest: u64,
    pub(super) plan: Result<Plan, Refusal>,
}

/// A change on disk. All of it is stored, or nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Changes {
    pub(super) put: Vec<(Key, Record)>,
    pub(super) forget: Vec<Key>,
    pub(super) begin: Option<(Place, PulseRecord)>,
    pub(super) end: Option<Place>,
}

/// The content of the disk.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Stored {
    pub(super) commands: Vec<(Key, Record)>,
    pub(super) pulses: Vec<(Place, PulseRecord)>,
}

/// A write to a PLC.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Write {
    pub(super) tag: Tag,
    pub(super) values: Vec<TagValue>,
    /// `true`: the end of a pulse, which may be sent again.
    pub(super) is_end: bool,
    /// The time after which it must not be sent any more.
    pub(super) valid_for: Duration,
}

/// The PLC of a call.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Target {
    /// The PLC that has this name now.
    Plc(Arc<str>),
    /// The PLC of a pulse, which may have another name by now, or have left the configuration.
    Place(Place),
}

/// A write that was not confirmed.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct WriteFailure {
    pub(super) may_have_executed: bool,
    pub(super) error: String,
}

/// An action for the driver.
#[derive(Debug)]
pub(super) enum Output {
    Store { token: u64, changes: Changes },
    Write { token: u64, target: Target, write: Write },
    Read { token: u64, target: Target, tag: Tag },
    Reply { call: u64, reply: Reply },
}

/// All commands.
#[derive(Debug)]
pub(super) struct Core {
    limits: CommandLimits,
    journal: Journal,
    lanes: BTreeMap<Arc<str>, Lane>,
    pulses: BTreeMap<Place, Pulse>,
    /// Who gets the result of an output.
    owners: HashMap<u64, Owner>,
    next_token: u64,
    outputs: VecDeque<Output>,
    /// Once it is closed: the time that pulses may still last.
    grace: Option<Duration>,
    figures: Figures,
}

/// The commands of one PLC.
#[derive(Debug)]
struct Lane {
    queue: VecDeque<(Key, Plan)>,
    active: Option<Active>,
    rate: RateLimit,
}

#[derive(Debug)]
struct Active {
    key: Key,
    plan: Plan,
    /// Where its pulse is, if it is one.
    place: Option<Place>,
    step: Step,
}

#[derive(Clone, Debug)]
enum Step {
    /// The id is on the way to the disk.
    Beginning,
    /// The write is on the way to the PLC.
    Writing,
    /// The value is being read.
    Reading,
    /// The reply is on the way to the disk.
    Finishing(Reply),
}

#[derive(Clone, Debug)]
enum Owner {
    Lane(Arc<str>),
    Pulse(Place),
    /// The result of a command that no longer is in its lane.
    Answer(Key, Reply),
    Nothing,
}

impl Core {
    /// Takes up the content of the disk: commands without a result become `unknown`, pulses are ended.
    pub(super) fn new(limits: CommandLimits, stored: Stored, figures: Figures, now: Now) -> Self {
        let lost: Vec<Key> =
            stored.commands.iter().filter(|(_, record)| record.reply.is_none()).map(|(key, _)| key.clone()).collect();
        let mut core = Self {
            limits,
            journal: Journal::new(limits.journal, stored.commands, now),
            lanes: BTreeMap::new(),
            pulses: BTreeMap::new(),
            owners: HashMap::new(),
            next_token: 0,
            outputs: VecDeque::new(),
            grace: None,
            figures,
        };
        core.store_lost(lost);
        for (place, record) in stored.pulses {
            core.recover_pulse(place, record, now);
        }
        core
    }

    /// Stores the replies of commands whose result was lost.
    fn store_lost(&mut self, lost: Vec<Key>) {
        let put: Vec<(Key, Record)> =
            lost.into_iter().filter_map(|key| self.journal.done(&key).map(|record| (key, record))).collect();
        let forget = self.journal.take_forgotten();
        if !put.is_empty() || !forget.is_empty() {
            self.store(Owner::Nothing, Changes { put, forget, ..Changes::default() });
        }
    }

    /// The next action.
    pub(super) fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// The time of the next [`tick`](Self::tick).
    pub(super) fn next_deadline(&self) -> Option<Duration> {
        self.pulses.values().filter_map(Pulse::due).min()
    }

    /// Returns whether nothing is under way, except ends of pulses that wait for their PLC.
    pub(super) fn is_idle(&self) -> bool {
        self.owners.is_empty() && self.pulses.values().all(Pulse::is_waiting)
    }

    /// Takes a command. Its reply is an output for this call.
    pub(super) fn arrived(&mut self, now: Now, catalog: &dyn Catalog, call: u64, received: Received) {
        let Received { key, digest, plan } = received;
        match self.journal.find(&key, digest) {
            Ok(Some(state)) => {
                match state {
                    State::Running(calls) => calls.push(call),
                    State::Done(reply) => self.outputs.push_back(Output::Reply { call, reply: reply.clone() }),
                }
                self.figures.of(&key.plc, |stats| stats.repeated = stats.repeated.saturating_add(1));
                return;
            }
            Ok(None) => {}
            Err(IsOther) => return self.reply_refused(&key, vec![call], &Refusal::IdReused),
        }
        let plan = match plan.and_then(|plan| self.accept(now, catalog, &key, plan)) {
            Ok(plan) => plan,
            Err(refusal) => return self.reply_refused(&key, vec![call], &refusal),
        };
        if !self.journal.insert(key.clone(), digest, call, now) {
            let waiting = self.limits.journal.count;
            return self.reply_refused(&key, vec![call], &Refusal::Busy { waiting });
        }
        let plc = key.plc.clone();
        self.figures.of(&plc, |stats| stats.waiting = stats.waiting.saturating_add(1));
        if let Some(lane) = self.lanes.get_mut(&plc) {
            lane.queue.push_back((key, plan));
        }
        self.advance(now, catalog, &plc);
    }

    /// Checks a command against the others.
    fn accept(&mut self, now: Now, catalog: &dyn Catalog, key: &Key, plan: Plan) -> Result<Plan, Refusal> {
        if self.grace.is_some() {
            return Err(Refusal::Closed);
        }
        let place = place_of(&plan, catalog);
        if place.is_some_and(|place| self.pulses.contains_key(&place)) {
            return Err(Refusal::PulseOpen);
        }
        let CommandLimits { per_second, burst, max_waiting, .. } = self.limits;
        let lane = self.lanes.entry(key.plc.clone()).or_insert_with(|| Lane {
            queue: VecDeque::new(),
            active: None,
            rate: RateLimit::new(per_second, burst),
        });
        if lane.queue.len() >= max_waiting {
            return Err(Refusal::Busy { waiting: lane.queue.len() });
        }
        if !lane.rate.take(now.run) {
            return Err(Refusal::Rate { per_second });
        }
        Ok(plan)
    }

    /// Begins the next command of a PLC, if none is under way.
    fn advance(&mut self, now: Now, catalog: &dyn Catalog, plc: &Arc<str>) {
        loop {
            let Some(lane) = self.lanes.get_mut(plc).filter(|lane| lane.active.is_none()) else { return };
            let Some((key, plan)) = lane.queue.pop_front() else { return };
            let place = place_of(&plan, catalog);
            let is_open = place.as_ref().is_some_and(|place| self.pulses.contains_key(place));
            let allowed = if is_open { Err(Refusal::PulseOpen) } else { plan.check_again(catalog, now.wall) };
            match allowed {
                Ok(()) => return self.begin(now, key, plan, place),
                Err(refusal) => self.refuse(&key, &refusal),
            }
        }
    }

    /// Stores an id, and its pulse.
    fn begin(&mut self, now: Now, key: Key, plan: Plan, place: Option<Place>) {
        let put = self.journal.record(&key, None).map(|record| (key.clone(), record)).into_iter().collect();
        let forget = self.journal.take_forgotten();
        let begin = place.clone().map(|place| {
            let record = PulseRecord {
                plc: key.plc.to_string(),
                name: plan.name.to_string(),
                id: key.id.to_string(),
                at: now.wall,
            };
            self.add_pulse(place.clone(), Pulse::new(record.clone(), plan.tag, PulseState::Beginning));
            (place, record)
        });
        let plc = key.plc.clone();
        if let Some(lane) = self.lanes.get_mut(&plc) {
            lane.active = Some(Active { key, plan, place, step: Step::Beginning });
        }
        self.store(Owner::Lane(plc), Changes { put, forget, begin, end: None });
    }

    /// Takes the result of [`Output::Store`].
    pub(super) fn stored(&mut self, now: Now, catalog: &dyn Catalog, token: u64, result: Result<(), String>) {
        match self.owners.remove(&token) {
            Some(Owner::Lane(plc)) => self.lane_stored(now, catalog, &plc, result),
            Some(Owner::Pulse(place)) => self.pulse_stored(now, &place, &result),
            Some(Owner::Answer(key, reply)) => {
                warn_of(&result, &key);
                self.complete(&key, reply);
            }
            Some(Owner::Nothing) | None => {}
        }
    }

    fn lane_stored(&mut self, now: Now, catalog: &dyn Catalog, plc: &Arc<str>, result: Result<(), String>) {
        let Some(Active { key, plan, place, step }) = self.take_active(plc) else { return };
        match (step, result) {
            (Step::Beginning, Err(error)) => {
                // It may be on disk all the same.
                if let Some(place) = place {
                    self.pulse_stored(now, &place, &Err(String::new()));
                }
                self.refuse(&key, &Refusal::Storage(error));
                self.journal.forget(key);
            }
            (Step::Beginning, Ok(())) => {
                let active = Active { key, plan, place, step: Step::Writing };
                // The disk may have been slow, and a reload may have come between.
                if let Err(refusal) =
                    active.plan.check_again(catalog, now.wall).and_then(|()| active.check_place(catalog))
                {
                    let reply = Reply::refused(Some(&active.key.id), &refusal);
                    return self.finish(active, reply, true);
                }
                let valid_for = active.plan.valid_for(now.wall);
                let write =
                    Write { tag: active.plan.tag, values: active.plan.values.clone(), is_end: false, valid_for };
                self.put_active(active);
                let token = self.token(Owner::Lane(plc.clone()));
                self.outputs.push_back(Output::Write { token, target: Target::Plc(plc.clone()), write });
                return;
            }
            (Step::Finishing(reply), result) => {
                // The result is true even if it is not on disk: then a repetition after a restart is unknown.
                warn_of(&result, &key);
                if let Some(place) = place {
                    self.pulse_stored(now, &place, &result);
                }
                self.complete(&key, reply);
            }
            (Step::Writing | Step::Reading, _) => debug_assert!(false, "nothing is stored in this step"),
        }
        self.advance(now, catalog, plc);
    }

    /// Takes the result of [`Output::Write`].
    pub(super) fn written(&mut self, now: Now, catalog: &dyn Catalog, token: u64, result: Result<(), WriteFailure>) {
        match self.owners.remove(&token) {
            Some(Owner::Lane(plc)) => {
                self.lane_written(now, &plc, result);
                self.cut_pulses(now);
                self.advance(now, catalog, &plc);
            }
            Some(Owner::Pulse(place)) => self.pulse_written(now, &place, result),
            Some(Owner::Answer(..) | Owner::Nothing) | None => {}
        }
    }

    fn lane_written(&mut self, now: Now, plc: &Arc<str>, result: Result<(), WriteFailure>) {
        let Some(mut active) = self.take_active(plc) else { return };
        let id = active.key.id.clone();
        match (result, active.plan.pulse, active.place.clone()) {
            (Ok(()), Some(time), Some(place)) => {
                let until = now.run.saturating_add(time);
                self.pulse_is_on(&place, until, Some(active.key));
            }
            (Ok(()), _, _) => {
                active.step = Step::Reading;
                let tag = active.plan.tag;
                self.put_active(active);
                let token = self.token(Owner::Lane(plc.clone()));
                self.outputs.push_back(Output::Read { token, target: Target::Plc(plc.clone()), tag });
            }
            (Err(WriteFailure { may_have_executed: false, error }), _, _) => {
                let reply = Reply::refused(Some(&id), &Refusal::Call(error));
                self.finish(active, reply, true);
            }
            (Err(WriteFailure { may_have_executed: true, error }), time, place) => {
                let reply = Reply::unknown(Some(&id), format!("plc: {error}"));
                // It may have begun, so it is ended.
                if let (Some(time), Some(place)) = (time, place) {
                    self.pulse_is_on(&place, now.run.saturating_add(time), None);
                }
                self.finish(active, reply, false);
            }
        }
    }

    /// Takes the result of [`Output::Read`].
    pub(super) fn read(&mut self, token: u64, result: Result<Vec<TagValue>, String>) {
        match self.owners.remove(&token) {
            Some(Owner::Lane(plc)) => {
                let Some(active) = self.take_active(&plc) else { return };
                let reply = confirmed(&active.key, active.plan.tag, &active.plan.values, result);
                self.finish(active, reply, false);
            }
            Some(Owner::Pulse(place)) => self.pulse_read(&place, result),
            Some(Owner::Answer(..) | Owner::Nothing) | None => {}
        }
    }

    /// Stores the reply of a command. `without_pulse`: its pulse has not begun.
    fn finish(&mut self, mut active: Active, reply: Reply, without_pulse: bool) {
        let (key, plc) = (active.key.clone(), active.key.plc.clone());
        active.place = active.place.filter(|_| without_pulse);
        let end = active.place.clone();
        if let Some(pulse) = end.as_ref().and_then(|place| self.pulses.get_mut(place)) {
            pulse.state = PulseState::Clearing(None);
        }
        let put = self.journal.record(&key, Some(reply.clone())).map(|record| (key, record)).into_iter().collect();
        active.step = Step::Finishing(reply);
        self.put_active(active);
        self.store(Owner::Lane(plc), Changes { put, end, ..Changes::default() });
    }

    /// Refuses everything that has not begun, and ends pulses that would last for longer than `grace`.
    pub(super) fn close(&mut self, now: Now, grace: Duration) {
        self.grace = Some(grace);
        let waiting: Vec<Key> =
            self.lanes.values_mut().flat_map(|lane| lane.queue.drain(..)).map(|(key, _)| key).collect();
        for key in waiting {
            self.refuse(&key, &Refusal::Closed);
        }
        self.cut_pulses(now);
    }

    /// Refuses a command that waits or begins.
    fn refuse(&mut self, key: &Key, refusal: &Refusal) {
        let calls = self.journal.remove(key);
        self.figures.of(&key.plc, |stats| stats.waiting = stats.waiting.saturating_sub(1));
        self.reply_refused(key, calls, refusal);
    }

    fn reply_refused(&mut self, key: &Key, calls: Vec<u64>, refusal: &Refusal) {
        let reply = Reply::refused(Some(&key.id), refusal);
        tracing::debug!(plc = %key.plc, id = %key.id, why = reply.why(), "command refused");
        if *refusal == Refusal::NoPlc {
            self.figures.count_no_plc();
        } else {
            self.figures.count(&key.plc, &reply);
        }
        self.reply_all(calls, &reply);
    }

    /// Gives the reply of a command that was stored.
    fn complete(&mut self, key: &Key, reply: Reply) {
        tracing::info!(plc = %key.plc, id = %key.id, result = ?reply.result(), why = reply.why(), "command");
        self.figures.count(&key.plc, &reply);
        self.figures.of(&key.plc, |stats| stats.waiting = stats.waiting.saturating_sub(1));
        let calls = self.journal.finish(key, reply.clone());
        self.reply_all(calls, &reply);
    }

    fn reply_all(&mut self, calls: Vec<u64>, reply: &Reply) {
        self.outputs.extend(calls.into_iter().map(|call| Output::Reply { call, reply: reply.clone() }));
    }

    fn take_active(&mut self, plc: &Arc<str>) -> Option<Active> {
        self.lanes.get_mut(plc)?.active.take()
    }

    fn put_active(&mut self, active: Active) {
        if let Some(lane) = self.lanes.get_mut(&active.key.plc) {
            lane.active = Some(active);
        }
    }

    fn store(&mut self, owner: Owner, changes: Changes) {
        let token = self.token(owner);
        self.outputs.push_back(Output::Store { token, changes });
    }

    fn token(&mut self, owner: Owner) -> u64 {
        let token = self.next_token;
        self.next_token = self.next_token.saturating_add(1);
        self.owners.insert(token, owner);
        token
    }
}

impl Active {
    /// Refuses a pulse whose PLC has moved since it was stored.
    fn check_place(&self, catalog: &dyn Catalog) -> Result<(), Refusal> {
        if place_of(&self.plan, catalog) == self.place { Ok(()) } else { Err(Refusal::Changed) }
    }
}

/// Where the pulse of a plan is; `None`: it is no pulse.
fn place_of(plan: &Plan, catalog: &dyn Catalog) -> Option<Place> {
    plan.pulse?;
    let plc = catalog.plc(&plan.plc)?;
    Some(Place { endpoint: plc.endpoint().to_string(), station: plc.station(), tag: plan.tag.to_string() })
}

/// The reply to a write that was confirmed, with the value that was read then.
fn confirmed(key: &Key, tag: Tag, written: &[TagValue], read: Result<Vec<TagValue>, String>) -> Reply {
    let (why, value) = match read {
        Ok(values) => {
            let is_same = values == written
                || tag.encode(&values).ok().zip(tag.encode(written).ok()).is_some_and(|(a, b)| a == b);
            let why = (!is_same).then(|| "read back: the value differs from the one that was written".to_owned());
            (why, Some(natural(&values)))
        }
        Err(error) => (Some(format!("read back: {error}")), None),
    };
    Reply::new(Some(&key.id), Outcome::Ok, why, value)
}

/// The values of a tag as in the batches: a list if there are several.
fn natural(values: &[TagValue]) -> Value {
    let value = |value: &TagValue| serde_json::to_value(value).unwrap_or(Value::Null);
    match values {
        [single] => value(single),
        several => several.iter().map(value).collect(),
    }
}

fn warn_of(result: &Result<(), String>, key: &Key) {
    if let Err(error) = result {
        tracing::warn!(plc = %key.plc, id = %key.id, %error, "the result of a command is not on disk");
    }
}
