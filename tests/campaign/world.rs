//! The simulated bus of a run, with its faults and a record of the writes.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use fatek::LinkBuilder;
use fatek::command::{ControlPlc, Request, Value};
use fatek::endpoint::InStepSettings;
use fatek::sim::{Bus, Fault, Faults, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Element, Error, Link, Symbol};
use tokio::time::Instant;

use crate::faults::{self, FaultKind, label, left_over, refused_addresses};
use crate::layout::{self, INJECTED, REFUSED, UNKNOWN_COMMAND, WRITABLE};
use crate::line::{LineKind, Times};
use crate::rng::Rng;
use crate::tally::Tally;

/// Allowance for calls that end after their deadline.
const GRACE: Duration = Duration::from_millis(10);
/// Capacity of the log of arrivals.
const LOG_CAPACITY: usize = 100_000;

pub(crate) struct World {
    pub(crate) framing: Framing,
    pub(crate) line: LineKind,
    pub(crate) times: Times,
    pub(crate) fault_kinds: Vec<FaultKind>,
    pub(crate) stations: u8,
    pub(crate) bus: Bus,
    pub(crate) plcs: Vec<Plc>,
    pub(crate) faults: Faults,
    /// Longer than [`GRACE`] in real time.
    pub(crate) grace: Duration,
    in_step: InStepSettings,
    serial: AtomicU32,
    writes: Mutex<Vec<Write>>,
    /// RUN and STOP commands by station: number of calls, and number of confirmed calls.
    controls: Mutex<BTreeMap<(u8, bool), (u64, u64)>>,
    broadcasts: Mutex<Vec<u16>>,
}

/// A write and its reported outcome.
#[derive(Debug)]
struct Write {
    station: u8,
    first: u16,
    count: u16,
    /// Value of all registers; no two writes have the same.
    serial: u16,
    outcome: Outcome,
}

#[derive(Debug)]
enum Outcome {
    Done,
    NotDone,
    /// At least this many registers were written.
    Written(usize),
}

impl World {
    pub(crate) fn new(
        seed: u64,
        framing: Framing,
        line: LineKind,
        fault_kinds: Vec<FaultKind>,
        in_step: InStepSettings,
        rng: &mut Rng,
    ) -> Self {
        let stations = rng.pick(&[1, 1, 2, 3]);
        let times = line.times();
        let mut faults = Faults::new(seed).log_capacity(LOG_CAPACITY).journal_capacity(0).line(line.sim_line(rng));
        for rule in refused_addresses() {
            faults = faults.rule(rule);
        }
        // Only one fault of each kind applies to a request, so rules that apply once come first.
        for &kind in &fault_kinds {
            let rules = faults::rules(kind, &times, fault_kinds.len() == 1);
            for rule in rules {
                if kind == FaultKind::LeftAtStart {
                    faults = (1..=stations).fold(faults, |faults, station| faults.rule(rule.clone().station(station)));
                } else {
                    faults = faults.rule(rule);
                }
            }
        }
        if fault_kinds.contains(&FaultKind::LeftAtStart) {
            left_over(stations, &times, rng).into_iter().for_each(|reply| faults.add_left_over(reply));
        }
        if line.echoes() {
            faults = faults.rule(Rule::new(Fault::Echo));
        }
        let plcs: Vec<Plc> = (1..=stations).map(layout::plc).collect();
        let bus = (1..).zip(&plcs).fold(Bus::new(), |bus, (n, plc)| bus.with_station(n, plc.clone()).unwrap());
        // A link cannot learn that a PLC closes each connection if 4E is refused, too.
        let closes = fault_kinds.contains(&FaultKind::Closes);
        let one_request = closes && (fault_kinds.contains(&FaultKind::NoLoopBack) || rng.percent(50));
        Self {
            framing,
            line,
            times,
            stations,
            bus: bus.with_faults(faults.clone()),
            plcs,
            faults,
            grace: GRACE,
            in_step: in_step.with_one_request(one_request),
            serial: AtomicU32::new(1),
            writes: Mutex::default(),
            controls: Mutex::default(),
            broadcasts: Mutex::default(),
            fault_kinds,
        }
    }

    pub(crate) fn has(&self, kind: FaultKind) -> bool {
        self.fault_kinds.contains(&kind)
    }

    pub(crate) fn builder(&self) -> LinkBuilder {
        self.line.builder(self.bus.clone(), self.framing, self.in_step)
    }

    pub(crate) fn link(&self) -> Link {
        self.builder().build()
    }

    pub(crate) fn in_step(&self) -> InStepSettings {
        self.in_step
    }

    /// Applies the settings for a link over the line.
    pub(crate) fn settings(&self, builder: LinkBuilder) -> LinkBuilder {
        self.line.settings(builder, self.framing, self.in_step)
    }

    pub(crate) fn plc(&self, station: u8) -> &Plc {
        &self.plcs[usize::from(station) - 1]
    }

    pub(crate) fn any_station(&self, rng: &mut Rng) -> u8 {
        1 + rng.below(self.stations.into()) as u8
    }

    /// A value that no other write of the run has.
    pub(crate) fn serial(&self) -> u16 {
        let serial = self.serial.fetch_add(1, Ordering::Relaxed);
        u16::try_from(serial).expect("a run has fewer writes")
    }

    /// Refusals that any request for registers may get.
    pub(crate) fn injected(&self) -> &'static [fatek::ErrorCode] {
        if self.has(FaultKind::Injected) { &[INJECTED] } else { &[] }
    }

    /// Refusals that mixed reads and writes may get.
    pub(crate) fn mixed(&self) -> &'static [fatek::ErrorCode] {
        if self.has(FaultKind::NoMixed) { &[UNKNOWN_COMMAND] } else { &[] }
    }

    /// Refusals that loop-backs may get.
    pub(crate) fn loop_back(&self) -> &'static [fatek::ErrorCode] {
        if self.has(FaultKind::NoLoopBack) { &[UNKNOWN_COMMAND] } else { &[] }
    }

    /// Records a write to D and its result.
    pub(crate) fn record_write(&self, station: u8, first: u16, count: u16, serial: u16, result: &Result<(), Error>) {
        self.record_write_of(station, (first, count), serial, 1, result);
    }

    /// Records a write of values of `words` words each.
    pub(crate) fn record_write_of(
        &self,
        station: u8,
        (first, count): (u16, u16),
        serial: u16,
        words: usize,
        result: &Result<(), Error>,
    ) {
        let outcome = match result {
            // Counted by the caller: a refused write was reported as done.
            Ok(()) if first + count > WRITABLE => Outcome::Written(0),
            Ok(()) => Outcome::Done,
            Err(Error::PartlyWritten { written, .. }) => Outcome::Written(words * written),
            // Counted by the caller: this error code is right for no write to these addresses.
            Err(Error::Plc { error, .. }) if !matches!(*error, REFUSED | INJECTED | UNKNOWN_COMMAND) => {
                Outcome::Written(0)
            }
            Err(Error::Plc { error: REFUSED, .. }) if first + count <= WRITABLE => Outcome::Written(0),
            // Not sent, or refused by the PLC.
            Err(error) if !error.may_have_executed() => Outcome::NotDone,
            Err(_) => Outcome::Written(0),
        };
        self.writes.lock().unwrap().push(Write { station, first, count, serial, outcome });
    }

    pub(crate) fn record_control(&self, station: u8, run: bool, confirmed: bool) {
        let mut controls = self.controls.lock().unwrap();
        let control = controls.entry((station, run)).or_default();
        *control = (control.0 + 1, control.1 + u64::from(confirmed));
    }

    pub(crate) fn record_broadcast(&self, serial: u16) {
        self.broadcasts.lock().unwrap().push(serial);
    }

    /// Counts a call as late unless it has ended by its deadline.
    pub(crate) fn check_deadline(&self, began: Instant, requests: usize, tally: &mut Tally) {
        // Each request of a job, and each check, has a deadline of its own.
        let calls = if requests > 1 { 8 * requests } else { 1 };
        let deadline = self.times.call_timeout * u32::try_from(calls).unwrap() + self.grace;
        tally.late += u64::from(began.elapsed() > deadline);
    }

    /// Compares the simulator's log with the reported outcomes.
    pub(crate) fn audit(&self, tally: &mut Tally) {
        let log = self.faults.log();
        assert_eq!(log.forgotten(), 0, "the log is complete");
        let mut executed: BTreeMap<(u8, Element, u16), u64> = BTreeMap::new();
        let mut controls: BTreeMap<(u8, bool), u64> = BTreeMap::new();
        for entry in log.entries().iter().filter(|entry| entry.executed) {
            let (Some(station), Some(request)) = (entry.station(), entry.request()) else { continue };
            if let Request::ControlPlc(control) = request {
                // Left-over requests come from an earlier client.
                let is_ours =
                    !entry.faults.iter().any(|fault| matches!(fault, Fault::LeftOver { min, max } if min == max));
                let run = matches!(control, ControlPlc::Run);
                *controls.entry((station, run)).or_default() += u64::from(is_ours);
            }
            for (element, value) in words(request) {
                *executed.entry((station, element, value)).or_default() += 1;
            }
        }
        let times = |station, symbol, address, serial| {
            let element = Element::new(symbol, address).unwrap();
            executed.get(&(station, element, serial)).copied().unwrap_or(0)
        };
        for write in &*self.writes.lock().unwrap() {
            for n in 0..write.count {
                let times = times(write.station, Symbol::D, write.first + n, write.serial);
                let right = match write.outcome {
                    Outcome::Done => times == 1,
                    Outcome::NotDone => times == 0,
                    Outcome::Written(written) => times == 1 || times == 0 && usize::from(n) >= written,
                };
                if !right {
                    tally.wrong.push(format!("register {n} of {write:?} was written {times} times"));
                    break;
                }
            }
        }
        for (&(station, run), &(called, confirmed)) in &*self.controls.lock().unwrap() {
            let executed = controls.get(&(station, run)).copied().unwrap_or(0);
            if !(confirmed..=called).contains(&executed) {
                let name = if run { "RUN" } else { "STOP" };
                tally.wrong.push(format!("{name} of {station}: {called} calls, {confirmed} done, {executed} executed"));
            }
        }
        for &serial in &*self.broadcasts.lock().unwrap() {
            tally.broadcasts.0 += 1;
            match times(0, Symbol::F, 0, serial) {
                0 => {}
                1 => tally.broadcasts.1 += 1,
                times => tally.wrong.push(format!("broadcast {serial} was executed {times} times")),
            }
        }
        for rule in self.faults.rules() {
            *tally.fault_counts.entry(label(rule.fault())).or_default() += rule.times_applied();
        }
        if self.has(FaultKind::LeftAtStart) {
            let is_left_over = |fault: &Fault| matches!(fault, Fault::LeftOver { min, max } if min == max);
            let entries = log.entries();
            let count = entries.iter().filter(|entry| entry.faults.iter().any(is_left_over)).count();
            *tally.fault_counts.entry("LeftOver at the start".to_owned()).or_default() += count as u64;
        }
    }
}

/// Words that a request writes, each element once.
fn words(request: &Request) -> BTreeSet<(Element, u16)> {
    let run = |first: Element, values: &[u16]| {
        values.iter().enumerate().map(move |(n, &value)| (first.nth(n).unwrap(), value)).collect::<Vec<_>>()
    };
    let pairs = |first: Element, values: &[u32]| {
        let symbol = if first.symbol() == Symbol::DD { Symbol::D } else { Symbol::F };
        let words: Vec<u16> = values.iter().flat_map(|&value| [value as u16, (value >> 16) as u16]).collect();
        run(Element::new(symbol, first.address()).unwrap(), &words)
    };
    match request {
        Request::WriteRegisters(write) => run(write.first().into(), write.values()).into_iter().collect(),
        Request::WriteRegisters32(write) => pairs(write.first().into(), write.values()).into_iter().collect(),
        Request::WriteMixed(write) => {
            let words = write.items().iter().flat_map(|&(element, value)| match value {
                Value::Word(value) => run(element, &[value]),
                Value::DWord(value) => pairs(element, &[value]),
                Value::Bit(_) => Vec::new(),
            });
            words.collect()
        }
        _ => BTreeSet::new(),
    }
}
