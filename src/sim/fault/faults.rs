use std::collections::{BTreeMap, VecDeque};
use std::mem;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::conversation::MAX_LEFT_OVER;
use super::dice::Dice;
use super::rule::Subject;
use super::timing::DrawnTiming;
use super::{Addressee, Fault, LeftOver, Line, Log, Moment, Rule};
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
        let state = State {
            seed,
            rules: Vec::new(),
            line: Line::default(),
            requests: BTreeMap::new(),
            connections: 0,
            left_over: VecDeque::new(),
        };
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

    /// Adds a reply that an earlier client has left over: the next connection that opens gets it.
    ///
    /// Left-over replies are sent in the order in which they were added, and before the reply to any request of the
    /// connection unless they have a [delay](LeftOver::delay). At most 64 wait; further ones are lost.
    ///
    /// ```
    /// use fatek::command::{ReadRegisters, Request};
    /// use fatek::register;
    /// use fatek::sim::{self, Bus, Faults, LeftOver, Plc};
    /// use fatek::wire::Framing;
    /// use tokio::io::AsyncReadExt;
    ///
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let earlier = Request::ReadRegisters(ReadRegisters::new(register!("R200"), 1)?);
    /// let faults = Faults::new(1)
    ///     .left_over(LeftOver::reply(1, earlier))
    ///     .left_over(LeftOver::bytes(&b"\x0201410F8\x03"[..])); // STOP is done
    /// let bus = Bus::new().with_station(1, Plc::new())?.with_faults(faults);
    ///
    /// let mut client = sim::connector(bus, Framing::Ascii)().await?;
    /// let mut received = [0; 22];
    /// client.read_exact(&mut received).await?; // without a request
    /// assert_eq!(&received, b"\x02014600000BD\x03\x0201410F8\x03");
    /// # Ok(())
    /// # }
    /// ```
    #[must_use]
    pub fn left_over(self, reply: LeftOver) -> Self {
        self.add_left_over(reply);
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

    /// Adds a reply that an earlier client has left over, as [`left_over`](Self::left_over) does.
    pub fn add_left_over(&self, reply: LeftOver) {
        let mut state = self.lock();
        if state.left_over.len() < MAX_LEFT_OVER {
            state.left_over.push_back(reply);
        }
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

    /// Decides what a station, of which there is a PLC, does with a broadcast that has not been ignored by all.
    pub(super) fn judge_broadcast(&self, station: u8, frame: &Frame, request: Option<&Request>) -> BroadcastVerdict {
        let mut state = self.lock();
        let mut dice = state.dice(station);
        let subject = Subject { station: Some(station), ..Subject::new(Addressee::Everybody, frame, request) };
        let mut rules = state.rules.iter_mut().filter(|rule| *rule.fault() == Fault::Ignore && rule.is_for(station));
        if rules.any(|rule| rule.strikes(&subject, &mut dice)) {
            return BroadcastVerdict::Ignored;
        }
        let subject = Subject { addressee: Addressee::Listener, ..subject };
        let answer = state.rules.iter_mut().find_map(|rule| {
            let fault = rule.fault().clone();
            let Fault::AnswerBroadcast { station: number, min, max, .. } = fault else { return None };
            rule.strikes(&subject, &mut dice).then_some((number, min, max, fault))
        });
        let Some((number, min, max, fault)) = answer else { return BroadcastVerdict::Obeyed };
        let delay = dice.between(min, max);
        let verdict = Verdict { faults: vec![fault], dice, line: state.line, turnaround: Duration::ZERO };
        BroadcastVerdict::Answered { station: number.unwrap_or(station), delay, verdict: Box::new(verdict) }
    }

    /// The replies of earlier clients, which are those of this connection from now on.
    pub(super) fn take_left_over(&self) -> VecDeque<LeftOver> {
        mem::take(&mut self.lock().left_over)
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

/// What a station does with a broadcast.
#[derive(Debug)]
pub(super) enum BroadcastVerdict {
    Ignored,
    Obeyed,
    /// It replies under this number, this long after the execution.
    Answered {
        station: u8,
        delay: Duration,
        verdict: Box<Verdict>,
    },
}

/// What comes after a reply, and when.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Again {
    Copy(DrawnTiming),
    RoamingCopy(DrawnTiming),
    SecondAnswer(DrawnTiming, Option<ErrorCode>),
}

impl Verdict {
    pub(super) fn has(&self, fault: &Fault) -> bool {
        self.faults.contains(fault)
    }

    pub(super) fn disconnect(&self) -> Option<Moment> {
        self.find(|fault| if let Fault::Disconnect(moment) = *fault { Some(moment) } else { None })
    }

    pub(super) fn error(&self) -> Option<ErrorCode> {
        self.find(|fault| {
            if let Fault::Error(error) = *fault {
                Some(error)
            } else if let Fault::AnswerBroadcast { error, .. } = *fault {
                error
            } else {
                None
            }
        })
    }

    /// How many pieces the reply comes in, and the pause between them.
    pub(super) fn split(&self) -> (usize, Duration) {
        let split =
            self.find(|fault| if let Fault::Split { pieces, pause } = *fault { Some((pieces, pause)) } else { None });
        split.unwrap_or((1, Duration::ZERO))
    }

    /// Draws how late the reply is.
    pub(super) fn delay(&mut self) -> Duration {
        let delay = self.find(|fault| if let Fault::Delay { min, max } = *fault { Some((min, max)) } else { None });
        let left_over =
            self.find(|fault| if let Fault::LeftOver { min, max } = *fault { Some((min, max)) } else { None });
        let mut draw = |times: Option<(Duration, Duration)>| {
            times.map_or(Duration::ZERO, |(min, max)| self.dice.between(min, max))
        };
        draw(delay).saturating_add(draw(left_over))
    }

    /// Whether the reply waits for the next connection when its own has ended.
    pub(super) fn outlives_connection(&self) -> bool {
        self.faults.iter().any(|fault| matches!(fault, Fault::LeftOver { .. }))
    }

    /// Draws what comes after the reply. It is empty where there is no whole reply.
    pub(super) fn again(&mut self) -> Vec<Again> {
        let faults = &self.faults;
        let is_cut = self.disconnect().is_some_and(|moment| moment != Moment::AfterReply);
        if is_cut || self.has(&Fault::DropReply) {
            return Vec::new();
        }
        let dice = &mut self.dice;
        let again = faults.iter().filter_map(|fault| {
            if let Fault::Duplicate(timing) = *fault {
                Some(Again::Copy(timing.draw(dice)))
            } else if let Fault::RoamingDuplicate(timing) = *fault {
                Some(Again::RoamingCopy(timing.draw(dice)))
            } else if let Fault::SecondAnswer { timing, error } = *fault {
                Some(Again::SecondAnswer(timing.draw(dice), error))
            } else {
                None
            }
        });
        again.collect()
    }

    fn find<T>(&self, property: impl Fn(&Fault) -> Option<T>) -> Option<T> {
        self.faults.iter().find_map(property)
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
    left_over: VecDeque<LeftOver>,
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
