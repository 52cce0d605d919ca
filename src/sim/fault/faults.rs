use std::collections::BTreeMap;
use std::mem;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::dice::Dice;
use super::rule::Subject;
use super::{Addressee, Fault, Line, Log, Moment, Rule};
use crate::ErrorCode;
use crate::command::{Code, Request};
use crate::wire::Frame;

/// The faults of one [`Bus`](crate::sim::Bus), its line and its log.
///
/// This is a handle: its clones are the same, and what is changed takes effect for the requests that arrive from then on.
/// Without any rule or line it makes nothing go wrong, takes no time, and only logs.
///
/// ```
/// use std::time::Duration;
/// use fatek::command::Code;
/// use fatek::sim::{Bus, Fault, Faults, Line, Plc, Rule};
///
/// let late = Fault::Delay { min: Duration::from_millis(500), max: Duration::from_millis(1500) };
/// let faults = Faults::new(42)
///     .rule(Rule::new(Fault::BadChecksum).station(3).command(Code::ReadRegisters).one_in(10))
///     .rule(Rule::new(late).per_mille(5))
///     .line(Line::new(9600));
/// let bus = Bus::new().with_station(3, Plc::new())?.with_faults(faults.clone());
///
/// faults.set_rules([Rule::new(Fault::Ignore).station(3)]); // station 3 is dead
/// faults.set_rules([]); // and well again
/// # Ok::<(), fatek::sim::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Faults {
    state: Arc<Mutex<State>>,
    log: Log,
}

impl Faults {
    /// No faults yet. All chance comes from the seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let state = State { seed, rules: Vec::new(), line: Line::default(), requests: BTreeMap::new(), connections: 0 };
        Self { state: Arc::new(Mutex::new(state)), log: Log::new() }
    }

    /// Adds a rule behind those there are.
    #[must_use]
    pub fn rule(self, rule: Rule) -> Self {
        self.add_rule(rule);
        self
    }

    /// Sets the line.
    #[must_use]
    pub fn line(self, line: Line) -> Self {
        self.set_line(line);
        self
    }

    /// Sets how many arrivals the log keeps: 1000 by default, each of a few hundred bytes.
    #[must_use]
    pub fn log_capacity(self, arrivals: usize) -> Self {
        self.log.set_capacity(arrivals);
        self
    }

    /// Sets how many different writes the log can count: 10,000 by default, each of a hundred bytes and its values.
    #[must_use]
    pub fn journal_capacity(self, writes: usize) -> Self {
        self.log.set_journal_capacity(writes);
        self
    }

    /// Adds a rule behind those there are.
    pub fn add_rule(&self, rule: Rule) {
        self.lock().rules.push(rule.afresh());
    }

    /// Puts rules in the place of those there are. They start afresh: nothing is in their counts.
    pub fn set_rules(&self, rules: impl IntoIterator<Item = Rule>) {
        let rules = rules.into_iter().map(Rule::afresh).collect();
        self.lock().rules = rules;
    }

    /// The rules as they are now, counts included.
    #[must_use]
    pub fn rules(&self) -> Vec<Rule> {
        self.lock().rules.clone()
    }

    /// Changes the line.
    pub fn set_line(&self, line: Line) {
        self.lock().line = line;
    }

    /// The log.
    #[must_use]
    pub fn log(&self) -> Log {
        self.log.clone()
    }

    pub(super) fn line_now(&self) -> Line {
        self.lock().line
    }

    /// Decides what befalls a request.
    pub(super) fn judge(&self, frame: &Frame, request: Option<&Request>, addressee: Addressee) -> Verdict {
        let mut state = self.lock();
        let mut dice = state.dice(frame.station);
        let subject = Subject::new(addressee, frame, request);
        let mut faults: Vec<Fault> = Vec::new();
        for rule in &mut state.rules {
            let kind = mem::discriminant(rule.fault());
            let is_befallen = faults.iter().any(|fault| mem::discriminant(fault) == kind);
            if !is_befallen && rule.strikes(&subject, &mut dice) {
                faults.push(rule.fault().clone());
            }
        }
        let line = state.line;
        let (min, max) = line.turnarounds();
        let turnaround = dice.between(min, max);
        Verdict { faults, dice, line, turnaround }
    }

    /// Decides whether a station, of which there is a PLC, ignores a broadcast that has not been ignored by all.
    pub(super) fn ignores_broadcast(&self, station: u8, frame: &Frame, request: Option<&Request>) -> bool {
        let mut state = self.lock();
        let mut dice = state.dice(station);
        let subject = Subject { station: Some(station), ..Subject::new(Addressee::Everybody, frame, request) };
        let mut rules = state.rules.iter_mut().filter(|rule| *rule.fault() == Fault::Ignore && rule.is_for(station));
        rules.any(|rule| rule.strikes(&subject, &mut dice))
    }

    /// Decides whether a connection is refused.
    pub(in crate::sim) fn refuse_connection(&self) -> bool {
        let mut state = self.lock();
        let nth = state.connections;
        state.connections += 1;
        let mut dice = Dice::new(state.seed, CONNECTIONS, nth);
        let subject = Subject { addressee: Addressee::Server, station: None, command: None, request: None };
        state.rules.iter_mut().any(|rule| rule.strikes(&subject, &mut dice))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing panics under the lock.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What befalls a request.
#[derive(Debug)]
pub(super) struct Verdict {
    /// At most one of each kind.
    pub(super) faults: Vec<Fault>,
    pub(super) dice: Dice,
    pub(super) line: Line,
    pub(super) turnaround: Duration,
}

impl Verdict {
    pub(super) fn has(&self, fault: &Fault) -> bool {
        self.faults.contains(fault)
    }

    pub(super) fn disconnect(&self) -> Option<Moment> {
        self.faults.iter().find_map(|fault| match *fault {
            Fault::Disconnect(moment) => Some(moment),
            _ => None,
        })
    }

    pub(super) fn error(&self) -> Option<ErrorCode> {
        self.faults.iter().find_map(|fault| match *fault {
            Fault::Error(error) => Some(error),
            _ => None,
        })
    }

    /// How many pieces the reply comes in, and the pause between them.
    pub(super) fn split(&self) -> (usize, Duration) {
        let split = self.faults.iter().find_map(|fault| match *fault {
            Fault::Split { pieces, pause } => Some((pieces, pause)),
            _ => None,
        });
        split.unwrap_or((1, Duration::ZERO))
    }

    /// Draws how late the reply is.
    pub(super) fn delay(&mut self) -> Duration {
        let delay = self.faults.iter().find_map(|fault| match *fault {
            Fault::Delay { min, max } => Some((min, max)),
            _ => None,
        });
        delay.map_or(Duration::ZERO, |(min, max)| self.dice.between(min, max))
    }
}

#[derive(Debug)]
struct State {
    seed: u64,
    rules: Vec<Rule>,
    line: Line,
    /// How many requests there were to each station.
    requests: BTreeMap<u8, u64>,
    connections: u64,
}

impl State {
    /// The dice of the next request to this station.
    fn dice(&mut self, station: u8) -> Dice {
        let requests = self.requests.entry(station).or_default();
        let nth = *requests;
        *requests += 1;
        Dice::new(self.seed, station.into(), nth)
    }
}

/// The kind of dice that connections have; those of requests are the stations' numbers.
const CONNECTIONS: u64 = 256;

impl<'a> Subject<'a> {
    fn new(addressee: Addressee, frame: &Frame, request: Option<&'a Request>) -> Self {
        Self { addressee, station: Some(frame.station), command: Code::from_u8(frame.command), request }
    }
}
