//! Seeded simulation: commands, faults of PLCs and of the disk, reloads, clock steps and crashes at each
//! boundary, with a model of the disk and of the PLCs.
//!
//! `FATEK_BRIDGE_SEEDS` sets the number of seeds. A failure names its seed.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use fastrand::Rng;
use fatek::plant::Plant;
use fatek::tag::TagValue;
use serde_json::json;

use super::*;
use crate::command::reply::Outcome;
use crate::command::rules::Gate;
use crate::command::{request, rules};

const PLANT: &str = r#"
[template.machine]
counter = { at = "DR300:u32", write = { max = 1e9 } }
level = { at = "R200:f32", write = { min = 0.0, max = 80.0 } }
start = { at = "M100", write = { pulse = "500ms" } }
flush = { at = "M101", write = { pulse = "20s" } }
state = "M7"
[plc.mixer]
link = "tcp://10.0.0.3"
station = 1
use = ["machine"]
[plc.boiler]
link = "tcp://10.0.0.4"
station = 7
use = ["machine"]
"#;

/// The plants that reloads switch between: the second lacks a tag and has another limit, the third lacks a PLC.
fn plants() -> Vec<Plant> {
    let other = PLANT.replace("max = 1e9", "max = 1000").replace("level", "depth");
    let fewer = PLANT.split("[plc.boiler]").next().unwrap();
    [PLANT, &other, fewer].iter().map(|text| Plant::from_toml(text).unwrap()).collect()
}

/// A command that was sent, with all that happened to it.
#[derive(Debug, Default)]
struct Sent {
    payload: String,
    /// Its place in the order of arrivals, from which it was accepted.
    accepted: u64,
    /// Writes that the core has sent for it.
    writes: u32,
    /// `true` if a PLC has executed its write.
    is_executed: bool,
    replies: Vec<Reply>,
}

struct World {
    seed: u64,
    rng: Rng,
    plants: Vec<Plant>,
    plant: usize,
    gate: Gate,
    core: Core,
    now: Now,
    /// Outputs that were taken, and whose results were not handed in.
    pending: Vec<Output>,
    disk: Stored,
    /// Discretes that are on, by PLC and tag.
    on: BTreeSet<(Arc<str>, String)>,
    sent: BTreeMap<Key, Sent>,
    /// The command of a call.
    calls: BTreeMap<u64, Key>,
    next: u64,
    /// The command that each PLC has executed last since the last crash.
    order: BTreeMap<Arc<str>, u64>,
    /// When a set was confirmed, by PLC and tag.
    set_at: BTreeMap<(Arc<str>, String), Duration>,
    faults_of_disk: bool,
    crashes: u32,
}

fn limits() -> CommandLimits {
    CommandLimits { per_second: 10, burst: 20, max_waiting: 4, ..CommandLimits::default() }
}

impl World {
    fn new(seed: u64) -> Self {
        fastrand::seed(seed);
        let mut rng = Rng::with_seed(seed);
        let now = Now { run: Duration::ZERO, wall: 1_764_457_200_000 };
        let core = Core::new(limits(), Stored::default(), Figures::default(), now);
        let faults_of_disk = rng.bool();
        Self {
            seed,
            rng,
            plants: plants(),
            plant: 0,
            gate: Gate::new(true),
            core,
            now,
            pending: Vec::new(),
            disk: Stored::default(),
            on: BTreeSet::new(),
            sent: BTreeMap::new(),
            calls: BTreeMap::new(),
            next: 0,
            order: BTreeMap::new(),
            set_at: BTreeMap::new(),
            faults_of_disk,
            crashes: 0,
        }
    }

    fn step(&mut self) {
        match self.rng.u32(0..100) {
            0..25 => self.send_new(),
            25..35 => self.repeat(),
            35..75 => self.complete_one(true),
            75..90 => self.pass(),
            90..92 => self.plant = self.rng.usize(0..self.plants.len()),
            92..93 => self.gate.set_open(self.rng.bool()),
            93..95 => self.step_clock(),
            95..98 => self.crash(),
            _ => self.tick(),
        }
        self.take_outputs();
    }

    fn send_new(&mut self) {
        self.next += 1;
        let id = format!("c{}", self.next);
        let plc: Arc<str> = ["mixer", "boiler", "nothing"][self.rng.usize(0..3)].into();
        let (tag, value) = match self.rng.u32(0..8) {
            0..3 => ("counter", json!(self.next)),
            3 => ("counter", json!(2_000_000_000_u64)),
            4 => ("level", json!(self.rng.u32(0..100))),
            5 => ("start", json!(true)),
            6 => ("flush", json!(true)),
            _ => ("state", json!(true)),
        };
        let ts = self.now.wall - self.rng.u64(0..11_000);
        let payload = json!({"id": id, "tag": tag, "value": value, "ts": ts}).to_string();
        let key = Key { plc, id: id.as_str().into() };
        self.sent.insert(key.clone(), Sent { payload, ..Sent::default() });
        self.deliver(key);
    }

    fn repeat(&mut self) {
        let nth = self.rng.usize(0..self.sent.len().max(1));
        // Mostly one of the last.
        let key = if self.rng.bool() { self.sent.keys().nth(nth) } else { self.sent.keys().next_back() };
        if let Some(key) = key.cloned() {
            self.deliver(key);
        }
    }

    fn deliver(&mut self, key: Key) {
        let request = request::parse(self.sent[&key].payload.as_bytes()).unwrap();
        let catalog = &self.plants[self.plant];
        let plan = rules::check(&request, &key.plc, &self.gate, catalog, self.now.wall);
        let received = Received { key: key.clone(), digest: request.digest(), plan };
        let before = self.core.journal.record(&key, None);
        self.next += 1;
        self.calls.insert(self.next, key.clone());
        self.core.arrived(self.now, catalog, self.next, received);
        if before.is_none() {
            self.sent.get_mut(&key).unwrap().accepted = self.next;
        }
    }

    fn pass(&mut self) {
        let most = if self.rng.bool() { 100 } else { 3000 };
        let by = self.rng.u64(1..most);
        self.now.run += Duration::from_millis(by);
        self.now.wall += by;
    }

    fn step_clock(&mut self) {
        let by = self.rng.i64(-3_600_000..3_600_000);
        self.now.wall = self.now.wall.checked_add_signed(by).unwrap();
    }

    fn tick(&mut self) {
        self.core.tick(self.now);
    }

    fn take_outputs(&mut self) {
        while let Some(output) = self.core.poll_output() {
            match output {
                Output::Reply { call, reply } => self.check_reply(call, reply),
                Output::Write { token, target, write } => {
                    self.check_write(&self.name_of(&target), &write);
                    self.pending.push(Output::Write { token, target, write });
                }
                other @ (Output::Store { .. } | Output::Read { .. }) => self.pending.push(other),
            }
        }
    }

    /// The name of the PLC in the first plant. The second and the third have it at the same place, or not at all.
    fn name_of(&self, target: &Target) -> Arc<str> {
        match target {
            Target::Plc(name) => name.clone(),
            Target::Place(place) => {
                let is_there = |plc: &&fatek::plant::PlantPlc| {
                    plc.station() == place.station && plc.endpoint().to_string() == place.endpoint
                };
                self.plants[0].plcs().find(is_there).unwrap().name().into()
            }
        }
    }

    /// Completes an action: stores in their order, others in any.
    fn complete_one(&mut self, with_faults: bool) {
        if self.pending.is_empty() {
            return;
        }
        let chosen = self.rng.usize(0..self.pending.len());
        let is_store = matches!(self.pending[chosen], Output::Store { .. });
        let first = self.pending.iter().position(|output| matches!(output, Output::Store { .. }));
        let output = self.pending.remove(if is_store { first.unwrap() } else { chosen });
        self.complete(output, with_faults);
    }

    fn complete(&mut self, output: Output, with_faults: bool) {
        let fails = with_faults && self.rng.u32(0..4) == 0;
        let catalog = &self.plants[self.plant].clone();
        match output {
            Output::Store { token, changes } => {
                let fails = fails && self.faults_of_disk;
                if !fails {
                    self.disk.apply(&changes);
                }
                let result = if fails { Err("no space left".to_owned()) } else { Ok(()) };
                self.core.stored(self.now, catalog, token, result);
            }
            Output::Write { token, target, write } => {
                let plc = self.name_of(&target);
                let is_executed = !fails || self.rng.bool();
                if is_executed {
                    self.execute(&plc, &write, token);
                }
                let failure =
                    WriteFailure { may_have_executed: is_executed || self.rng.bool(), error: "no reply".to_owned() };
                if !fails && write.values == [TagValue::Bool(true)] {
                    self.set_at.insert((plc, write.tag.to_string()), self.now.run);
                }
                self.core.written(self.now, catalog, token, if fails { Err(failure) } else { Ok(()) });
            }
            Output::Read { token, target: _, tag } => {
                let values = vec![if tag.tag_type().is_number() { TagValue::U32(0) } else { TagValue::Bool(false) }];
                self.core.read(token, if fails { Err("no reply".to_owned()) } else { Ok(values) });
            }
            Output::Reply { .. } => unreachable!(),
        }
        self.take_outputs();
    }

    /// The PLC executes a write.
    fn execute(&mut self, plc: &Arc<str>, write: &Write, token: u64) {
        let place = (plc.clone(), write.tag.to_string());
        if write.is_end {
            self.on.remove(&place);
            return;
        }
        let Some(Owner::Lane(lane)) = self.core.owners.get(&token) else { panic!("{} no lane", self.seed) };
        let key = self.core.lanes[lane].active.as_ref().unwrap().key.clone();
        let sent = self.sent.get_mut(&key).unwrap();
        sent.is_executed = true;
        let last = self.order.insert(plc.clone(), sent.accepted).unwrap_or(0);
        assert!(last < sent.accepted, "seed {}: {key:?} out of order at {plc}", self.seed);
        if write.values == [TagValue::Bool(true)] {
            self.on.insert(place);
        }
    }

    /// Asserts the rules of a write that is being sent.
    fn check_write(&mut self, plc: &Arc<str>, write: &Write) {
        let seed = self.seed;
        let place = self.core.pulses.iter().find(|(place, pulse)| {
            pulse.tag == write.tag && self.plants[0].plc(plc).unwrap().station() == place.station
        });
        if write.is_end {
            let (place, pulse) = place.unwrap();
            assert!(self.disk.pulses.iter().any(|(stored, _)| stored == place), "seed {seed}: an end without a record");
            let time = if write.tag.to_string() == "M100" { 500 } else { 20_000 };
            if pulse.command.is_some() && !pulse.is_cut {
                let set_at = self.set_at[&(plc.clone(), write.tag.to_string())];
                assert!(self.now.run - set_at >= Duration::from_millis(time), "seed {seed}: the pulse was too short");
            }
            return;
        }
        let key = self.core.lanes[plc].active.as_ref().unwrap().key.clone();
        let ts = request::parse(self.sent[&key].payload.as_bytes()).unwrap().ts;
        let last = Duration::from_millis(self.now.wall).saturating_add(write.valid_for);
        assert!(last <= Duration::from_millis(ts + 10_000), "seed {seed}: {key:?} may be sent when it is too old");
        assert!(
            self.disk.commands.iter().any(|(stored, _)| *stored == key),
            "seed {seed}: {key:?} was sent before its id was on disk"
        );
        if write.values == [TagValue::Bool(true)] {
            let is_stored = place.is_some_and(|(place, _)| self.disk.pulses.iter().any(|(stored, _)| stored == place));
            assert!(is_stored, "seed {seed}: a pulse was set that is not on disk");
        }
        assert_eq!(self.gate.check(), Ok(()), "seed {seed}: {plc} {write:?}: its output takes no commands");
        let allowed = self.plants[self.plant].plc(plc).is_some_and(|plc| {
            plc.tags().any(|tag| {
                let rule = tag.write();
                let is_within = |max: f64| write.values[0].as_f64().is_none_or(|value| value <= max);
                tag.tag() == write.tag && rule.is_some_and(|rule| rule.max.is_none_or(is_within))
            })
        });
        assert!(allowed, "seed {seed}: {plc} {write:?}: the configuration does not allow it");
        let sent = self.sent.get_mut(&key).unwrap();
        sent.writes += 1;
        assert_eq!(sent.writes, 1, "seed {seed}: {key:?} was sent twice");
    }

    /// Asserts the rules of a reply.
    fn check_reply(&mut self, call: u64, reply: Reply) {
        let (seed, key) = (self.seed, self.calls.remove(&call).expect("one reply for a call"));
        let sent = self.sent.get_mut(&key).unwrap();
        let is_pulse = sent.payload.contains("\"start\"") || sent.payload.contains("\"flush\"");
        match reply.result() {
            Outcome::Ok => {
                assert!(sent.is_executed, "seed {seed}: {key:?} is ok, and was not executed");
                let record = self.disk.commands.iter().find(|(stored, _)| *stored == key).map(|(_, record)| record);
                let is_stored = record.is_some_and(|record| record.reply.as_ref() == Some(&reply));
                assert!(is_stored || self.faults_of_disk, "seed {seed}: {key:?} is ok, and the disk has {record:?}");
                if is_pulse && !self.faults_of_disk {
                    let open = self.disk.pulses.iter().any(|(_, pulse)| *pulse.id == *key.id);
                    assert!(!open, "seed {seed}: {key:?} is ok before its end");
                }
            }
            Outcome::Refused => assert!(!sent.is_executed, "seed {seed}: {key:?} is refused, and was executed"),
            Outcome::Unknown => assert!(sent.writes == 1 || self.crashes > 0, "seed {seed}: {key:?} is unknown"),
        }
        let final_reply = sent.replies.iter().find(|reply| reply.result() != Outcome::Refused);
        if let (Some(earlier), false) = (final_reply, self.faults_of_disk) {
            assert_eq!(*earlier, reply, "seed {seed}: {key:?} got another reply");
        }
        sent.replies.push(reply);
    }

    /// The bridge is killed, and started again. Some of its last actions have had an effect.
    fn crash(&mut self) {
        self.crashes += 1;
        let mut is_disk_alive = true;
        for output in std::mem::take(&mut self.pending) {
            match output {
                Output::Store { changes, .. } => {
                    is_disk_alive &= self.rng.bool();
                    if is_disk_alive {
                        self.disk.apply(&changes);
                    }
                }
                Output::Write { token, target, write } if self.rng.bool() => {
                    self.execute(&self.name_of(&target), &write, token);
                }
                Output::Write { .. } | Output::Read { .. } | Output::Reply { .. } => {}
            }
        }
        self.calls.clear();
        self.order.clear();
        let down = self.rng.u64(0..5000);
        self.now = Now { run: Duration::ZERO, wall: self.now.wall + down };
        self.core = Core::new(limits(), self.disk.clone(), Figures::default(), self.now);
        self.take_outputs();
    }

    /// Everything works again: all commands and all pulses end.
    fn heal(&mut self) {
        self.plant = 0;
        self.gate.set_open(true);
        self.faults_of_disk = false;
        for _ in 0..10_000 {
            self.take_outputs();
            if !self.pending.is_empty() {
                self.complete_one(false);
            } else if let Some(at) = self.core.next_deadline() {
                self.now.run = self.now.run.max(at);
                self.tick();
            } else {
                break;
            }
        }
        let seed = self.seed;
        assert!(self.core.is_idle() && self.core.pulses.is_empty(), "seed {seed}: not idle");
        assert!(self.calls.is_empty(), "seed {seed}: {:?} got no reply", self.calls);
        assert!(self.on.is_empty(), "seed {seed}: a discrete stays on: {:?}", self.on);
        assert_eq!(self.disk.pulses, [], "seed {seed}: a pulse stays on disk");
        let stats = self.core.figures.snapshot();
        assert!(stats.plcs.values().all(|plc| plc.waiting == 0 && plc.pulses_open == 0), "seed {seed}: {stats:?}");
    }
}

impl Stored {
    fn apply(&mut self, changes: &Changes) {
        let Changes { put, forget, begin, end } = changes;
        self.commands.retain(|(key, _)| !forget.contains(key) && !put.iter().any(|(other, _)| other == key));
        self.commands.extend(put.iter().cloned());
        if let Some((place, record)) = begin {
            self.pulses.retain(|(other, _)| other != place);
            self.pulses.push((place.clone(), record.clone()));
        }
        self.pulses.retain(|(place, _)| end.as_ref() != Some(place));
    }
}

#[test]
fn ids_run_once_and_pulses_end_with_crashes_at_each_step() {
    let seeds: u64 = std::env::var("FATEK_BRIDGE_SEEDS").ok().and_then(|text| text.parse().ok()).unwrap_or(400);
    let (mut commands, mut crashes, mut results) = (0, 0, [0_u32; 3]);
    for seed in 0..seeds {
        let mut world = World::new(seed);
        (0..400).for_each(|_| world.step());
        world.heal();
        commands += world.sent.len();
        crashes += world.crashes;
        for reply in world.sent.values().flat_map(|sent| &sent.replies) {
            results[reply.result() as usize] += 1;
        }
    }
    println!("{seeds} seeds: {commands} commands, {crashes} crashes, ok/refused/unknown {results:?}");
    assert!(results.iter().all(|count| u64::from(*count) >= seeds), "{results:?}");
}

#[test]
fn a_close_refuses_the_queue_and_ends_long_pulses() {
    let mut world = World::new(1);
    world.faults_of_disk = false;
    let send = |world: &mut World, id: &str, tag: &str, value: Value| {
        let payload = json!({"id": id, "tag": tag, "value": value, "ts": world.now.wall}).to_string();
        let key = Key { plc: "mixer".into(), id: id.into() };
        world.sent.insert(key.clone(), Sent { payload, ..Sent::default() });
        world.deliver(key.clone());
        key
    };
    let flush = send(&mut world, "1", "flush", json!(true));
    world.take_outputs();
    while !world.pending.is_empty() {
        world.complete_one(false);
    }
    let active = send(&mut world, "2", "counter", json!(2));
    let queued = send(&mut world, "3", "counter", json!(3));
    world.take_outputs();
    world.core.close(world.now, Duration::from_secs(2));
    world.take_outputs();
    assert!(!world.core.is_idle());
    world.heal();
    let late = send(&mut world, "4", "counter", json!(4));
    world.take_outputs();
    let results = [flush, active, queued, late].map(|key| world.sent[&key].replies[0].clone());
    let why = |n: usize| results[n].why().unwrap_or_default().split(':').next().unwrap().to_owned();
    assert_eq!(
        results.each_ref().map(Reply::result),
        [Outcome::Unknown, Outcome::Ok, Outcome::Refused, Outcome::Refused]
    );
    assert_eq!((why(0), why(2), why(3)), ("closed".into(), "closed".into(), "closed".into()));
    assert!(world.now.run < Duration::from_secs(1), "{:?}", world.now);
}
