//! The simulated bus of a run, and what was written to it.

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

use crate::plant::{self, Dice, INJECTED, REFUSED, UNKNOWN_COMMAND, WRITABLE};
use crate::tally::Tally;
use crate::troubles::{self, Trouble, label, left_over, refused_addresses};
use crate::wire::{Times, Wire};

/// Any call must have ended by its deadline, or this much later.
const GRACE: Duration = Duration::from_millis(10);
/// Arrivals in the log of a run.
const LOG_CAPACITY: usize = 100_000;

pub(crate) struct World {
    pub(crate) framing: Framing,
    pub(crate) wire: Wire,
    pub(crate) times: Times,
    pub(crate) troubles: Vec<Trouble>,
    pub(crate) stations: u8,
    pub(crate) bus: Bus,
    pub(crate) plcs: Vec<Plc>,
    pub(crate) faults: Faults,
    /// More than [`GRACE`] in real time.
    pub(crate) grace: Duration,
    in_step: InStepSettings,
    serial: AtomicU32,
    writes: Mutex<Vec<Write>>,
    /// RUN and STOP, by station: called for, and confirmed.
    controls: Mutex<BTreeMap<(u8, bool), (u64, u64)>>,
    broadcasts: Mutex<Vec<u16>>,
}

/// A write, and what was said of it.
#[derive(Debug)]
struct Write {
    station: u8,
    first: u16,
    count: u16,
    /// All the registers' value: no two writes have the same.
    serial: u16,
    said: Said,
}

#[derive(Debug)]
enum Said {
    Done,
    NotDone,
    /// So many for certain.
    Written(usize),
}

impl World {
    pub(crate) fn new(
        seed: u64,
        framing: Framing,
        wire: Wire,
        troubles: Vec<Trouble>,
        in_step: InStepSettings,
        dice: &mut Dice,
    ) -> Self {
        let stations = dice.of(&[1, 1, 2, 3]);
        let times = wire.times();
        let mut faults = Faults::new(seed).log_capacity(LOG_CAPACITY).journal_capacity(0).line(wire.line(dice));
        for rule in refused_addresses() {
            faults = faults.rule(rule);
        }
        // First what happens once, as only one fault of each kind strikes.
        for &trouble in &troubles {
            let rules = troubles::rules(trouble, &times, troubles.len() == 1);
            for rule in rules {
                if trouble == Trouble::LeftAtStart {
                    faults = (1..=stations).fold(faults, |faults, station| faults.rule(rule.clone().station(station)));
                } else {
                    faults = faults.rule(rule);
                }
            }
        }
        if troubles.contains(&Trouble::LeftAtStart) {
            left_over(stations, &times, dice).into_iter().for_each(|reply| faults.add_left_over(reply));
        }
        if wire.echoes() {
            faults = faults.rule(Rule::new(Fault::Echo));
        }
        let plcs: Vec<Plc> = (1..=stations).map(plant::plc).collect();
        let bus = (1..).zip(&plcs).fold(Bus::new(), |bus, (n, plc)| bus.with_station(n, plc.clone()).unwrap());
        // A device that knows no loop-back and closes each connection cannot be learned.
        let closes = troubles.contains(&Trouble::Closes);
        let told = closes && (troubles.contains(&Trouble::NoLoopBack) || dice.in_hundred(50));
        Self {
            framing,
            wire,
            times,
            stations,
            bus: bus.with_faults(faults.clone()),
            plcs,
            faults,
            grace: GRACE,
            in_step: in_step.with_one_request(told),
            serial: AtomicU32::new(1),
            writes: Mutex::default(),
            controls: Mutex::default(),
            broadcasts: Mutex::default(),
            troubles,
        }
    }

    pub(crate) fn has(&self, trouble: Trouble) -> bool {
        self.troubles.contains(&trouble)
    }

    pub(crate) fn builder(&self) -> LinkBuilder {
        self.wire.builder(self.bus.clone(), self.framing, self.in_step)
    }

    pub(crate) fn link(&self) -> Link {
        self.builder().build()
    }

    pub(crate) fn in_step(&self) -> InStepSettings {
        self.in_step
    }

    /// The settings of a link to the line.
    pub(crate) fn settings(&self, builder: LinkBuilder) -> LinkBuilder {
        self.wire.settings(builder, self.framing, self.in_step)
    }

    pub(crate) fn plc(&self, station: u8) -> &Plc {
        &self.plcs[usize::from(station) - 1]
    }

    pub(crate) fn any_station(&self, dice: &mut Dice) -> u8 {
        1 + dice.below(self.stations.into()) as u8
    }

    /// A value that no other write of the run has.
    pub(crate) fn serial(&self) -> u16 {
        let serial = self.serial.fetch_add(1, Ordering::Relaxed);
        u16::try_from(serial).expect("a run has fewer writes")
    }

    /// The refusals that any request for registers may get.
    pub(crate) fn injected(&self) -> &'static [fatek::ErrorCode] {
        if self.has(Trouble::Injected) { &[INJECTED] } else { &[] }
    }

    /// The refusals that mixed reads and writes may get.
    pub(crate) fn mixed(&self) -> &'static [fatek::ErrorCode] {
        if self.has(Trouble::NoMixed) { &[UNKNOWN_COMMAND] } else { &[] }
    }

    /// The refusals that loop-backs may get.
    pub(crate) fn loop_back(&self) -> &'static [fatek::ErrorCode] {
        if self.has(Trouble::NoLoopBack) { &[UNKNOWN_COMMAND] } else { &[] }
    }

    /// Notes a write to D and what was said of it.
    pub(crate) fn wrote(&self, station: u8, first: u16, count: u16, serial: u16, result: &Result<(), Error>) {
        self.wrote_many(station, (first, count), serial, 1, result);
    }

    /// The same of values that have so many words.
    pub(crate) fn wrote_many(
        &self,
        station: u8,
        (first, count): (u16, u16),
        serial: u16,
        words: usize,
        result: &Result<(), Error>,
    ) {
        let said = match result {
            // This, too, is counted where it was returned.
            Ok(()) if first + count > WRITABLE => Said::Written(0),
            Ok(()) => Said::Done,
            Err(Error::PartlyWritten { written, .. }) => Said::Written(words * written),
            // A refusal that was never given to a write of these addresses is counted where it was returned.
            Err(Error::Plc { error, .. }) if !matches!(*error, REFUSED | INJECTED | UNKNOWN_COMMAND) => {
                Said::Written(0)
            }
            Err(Error::Plc { error: REFUSED, .. }) if first + count <= WRITABLE => Said::Written(0),
            // It was not sent, or the PLC has refused it.
            Err(error) if !error.may_have_executed() => Said::NotDone,
            Err(_) => Said::Written(0),
        };
        self.writes.lock().unwrap().push(Write { station, first, count, serial, said });
    }

    pub(crate) fn controlled(&self, station: u8, run: bool, confirmed: bool) {
        let mut controls = self.controls.lock().unwrap();
        let control = controls.entry((station, run)).or_default();
        *control = (control.0 + 1, control.1 + u64::from(confirmed));
    }

    pub(crate) fn broadcast(&self, serial: u16) {
        self.broadcasts.lock().unwrap().push(serial);
    }

    /// Counts a call that began then if it has not ended by its deadline.
    pub(crate) fn in_time(&self, began: Instant, requests: usize, tally: &mut Tally) {
        // Each of several requests, and each check, is a call with a deadline of its own.
        let calls = if requests > 1 { 8 * requests } else { 1 };
        let deadline = self.times.call_timeout * u32::try_from(calls).unwrap() + self.grace;
        tally.late += u64::from(began.elapsed() > deadline);
    }

    /// Compares the log with what was said.
    pub(crate) fn audit(&self, tally: &mut Tally) {
        let log = self.faults.log();
        assert_eq!(log.forgotten(), 0, "the log holds the run");
        let mut executed: BTreeMap<(u8, Element, u16), u64> = BTreeMap::new();
        let mut controls: BTreeMap<(u8, bool), u64> = BTreeMap::new();
        for entry in log.entries().iter().filter(|entry| entry.executed) {
            let (Some(station), Some(request)) = (entry.station(), entry.request()) else { continue };
            if let Request::ControlPlc(control) = request {
                // Left-over ones were not called for here.
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
                let right = match write.said {
                    Said::Done => times == 1,
                    Said::NotDone => times == 0,
                    Said::Written(written) => times == 1 || times == 0 && usize::from(n) >= written,
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
            *tally.struck.entry(label(rule.fault())).or_default() += rule.times_applied();
        }
        if self.has(Trouble::LeftAtStart) {
            let is_left_over = |fault: &Fault| matches!(fault, Fault::LeftOver { min, max } if min == max);
            let entries = log.entries();
            let count = entries.iter().filter(|entry| entry.faults.iter().any(is_left_over)).count();
            *tally.struck.entry("LeftOver at the start".to_owned()).or_default() += count as u64;
        }
    }
}

/// The words that a request writes, each element once.
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
