use std::collections::{BTreeMap, VecDeque};
use std::mem;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::left_over::MAX_LEFT_OVER;
use super::rng::FaultRng;
use super::rule::Subject;
use super::timing::DrawnTiming;
use super::{DisconnectAt, Fault, FaultTarget, LeftOver, Line, Log, Rule};
use crate::ErrorCode;
use crate::command::{Code, Request};
use crate::wire::Frame;

/// The fault rules of one [`Bus`](crate::sim::Bus), with its line and its log.
///
/// A handle: clones share the same rules. Changes apply to requests that arrive from then on.
/// Without a rule and a line, there are no faults and no delays, and arrivals are only logged.
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
/// faults.set_rules([Rule::new(Fault::Ignore).station(3)]); // station 3 is offline
/// faults.set_rules([]); // online again, no faults
/// # Ok::<(), fatek::sim::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Faults {
    inner: Arc<Mutex<FaultsInner>>,
    log: Log,
}

impl Faults {
    /// No rules. All random numbers come from the seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let inner = FaultsInner {
            seed,
            rules: Vec::new(),
            line: Line::default(),
            requests: BTreeMap::new(),
            connections: 0,
            left_over: VecDeque::new(),
        };
        Self { inner: Arc::new(Mutex::new(inner)), log: Log::new() }
    }

    /// Adds a rule behind the others.
    #[must_use]
    pub fn rule(self, rule: Rule) -> Self {
        self.add_rule(rule);
        self
    }

    /// Sets the speed and the response time of the line.
    #[must_use]
    pub fn line(self, line: Line) -> Self {
        self.set_line(line);
        self
    }

    /// Adds a reply to an earlier client: it is sent on the next connection that opens.
    ///
    /// Left-over replies are sent in the order in which they were added. Without a
    /// [delay](LeftOver::delay) they precede all replies to requests of the connection. At most 64
    /// can wait; further ones are discarded.
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
    ///     .left_over(LeftOver::bytes(&b"\x0201410F8\x03"[..])); // success of STOP
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

    /// Sets the number of arrivals that the log keeps. Default: 1000, each of a few hundred bytes.
    #[must_use]
    pub fn log_capacity(self, arrivals: usize) -> Self {
        self.log.set_capacity(arrivals);
        self
    }

    /// Sets the number of different writes that the journal of the log can count.
    ///
    /// Default: 10,000. Each takes a hundred bytes and its values.
    #[must_use]
    pub fn journal_capacity(self, writes: usize) -> Self {
        self.log.set_journal_capacity(writes);
        self
    }

    /// Adds a rule behind the others.
    pub fn add_rule(&self, rule: Rule) {
        self.lock().rules.push(rule.with_counts_reset());
    }

    /// Adds a reply to an earlier client, as [`left_over`](Self::left_over).
    pub fn add_left_over(&self, reply: LeftOver) {
        let mut inner = self.lock();
        if inner.left_over.len() < MAX_LEFT_OVER {
            inner.left_over.push_back(reply);
        }
    }

    /// Replaces all rules. The counts of the new rules start at 0.
    pub fn set_rules(&self, rules: impl IntoIterator<Item = Rule>) {
        let rules = rules.into_iter().map(Rule::with_counts_reset).collect();
        self.lock().rules = rules;
    }

    /// The current rules, with their counts.
    #[must_use]
    pub fn rules(&self) -> Vec<Rule> {
        self.lock().rules.clone()
    }

    /// Replaces the line.
    pub fn set_line(&self, line: Line) {
        self.lock().line = line;
    }

    /// The log of arrivals.
    #[must_use]
    pub fn log(&self) -> Log {
        self.log.clone()
    }

    pub(super) fn line_now(&self) -> Line {
        self.lock().line
    }

    /// Evaluates the rules for a request that has arrived.
    pub(super) fn decide(&self, frame: &Frame, request: Option<&Request>, target: FaultTarget) -> Decision {
        let mut inner = self.lock();
        let mut rng = inner.rng(frame.station);
        let subject = Subject::new(target, frame, request);
        let mut faults: Vec<Fault> = Vec::new();
        for rule in &mut inner.rules {
            let kind = mem::discriminant(rule.fault());
            let has_kind = faults.iter().any(|fault| mem::discriminant(fault) == kind);
            if !has_kind && rule.matches(&subject, &mut rng) {
                faults.push(rule.fault().clone());
            }
        }
        let line = inner.line;
        let (min, max) = line.response_times();
        let response_time = rng.between(min, max);
        Decision { faults, rng, line, response_time }
    }

    /// Evaluates the rules for one station of the bus and a broadcast that the bus has received.
    pub(super) fn decide_broadcast(&self, station: u8, frame: &Frame, request: Option<&Request>) -> BroadcastDecision {
        let mut inner = self.lock();
        let mut rng = inner.rng(station);
        let subject = Subject { station: Some(station), ..Subject::new(FaultTarget::Broadcast, frame, request) };
        let mut rules = inner.rules.iter_mut().filter(|rule| *rule.fault() == Fault::Ignore && rule.is_for(station));
        if rules.any(|rule| rule.matches(&subject, &mut rng)) {
            return BroadcastDecision::Ignored;
        }
        let subject = Subject { target: FaultTarget::BroadcastListener, ..subject };
        let answer = inner.rules.iter_mut().find_map(|rule| {
            let fault = rule.fault().clone();
            let Fault::AnswerBroadcast { station: number, min, max, .. } = fault else { return None };
            rule.matches(&subject, &mut rng).then_some((number, min, max, fault))
        });
        let Some((number, min, max, fault)) = answer else { return BroadcastDecision::Obeyed };
        let delay = rng.between(min, max);
        let decision = Decision { faults: vec![fault], rng, line: inner.line, response_time: Duration::ZERO };
        BroadcastDecision::Answered { station: number.unwrap_or(station), delay, decision: Box::new(decision) }
    }

    /// Takes the replies to earlier clients, for the connection that calls this.
    pub(super) fn take_left_over(&self) -> VecDeque<LeftOver> {
        mem::take(&mut self.lock().left_over)
    }

    /// Evaluates the rules for a new connection: whether it is refused.
    pub(in crate::sim) fn refuse_connection(&self) -> bool {
        let mut inner = self.lock();
        let nth = inner.connections;
        inner.connections += 1;
        let mut rng = FaultRng::new(inner.seed, CONNECTIONS, nth);
        let subject = Subject { target: FaultTarget::Connection, station: None, command: None, request: None };
        inner.rules.iter_mut().any(|rule| rule.matches(&subject, &mut rng))
    }

    fn lock(&self) -> MutexGuard<'_, FaultsInner> {
        // Nothing panics under the lock.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Faults and times of one request.
#[derive(Debug)]
pub(super) struct Decision {
    /// At most one fault of each kind.
    pub(super) faults: Vec<Fault>,
    pub(super) rng: FaultRng,
    pub(super) line: Line,
    pub(super) response_time: Duration,
}

/// The reaction of one station to a broadcast.
#[derive(Debug)]
pub(super) enum BroadcastDecision {
    Ignored,
    Obeyed,
    /// Replies with this station number, this long after the execution.
    Answered {
        station: u8,
        delay: Duration,
        decision: Box<Decision>,
    },
}

/// A duplicate or second answer behind a reply, with its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DrawnFollowUp {
    Duplicate(DrawnTiming),
    RoamingDuplicate(DrawnTiming),
    SecondAnswer(DrawnTiming, Option<ErrorCode>),
}

impl Decision {
    pub(super) fn has(&self, fault: &Fault) -> bool {
        self.faults.contains(fault)
    }

    pub(super) fn disconnect(&self) -> Option<DisconnectAt> {
        self.find(|fault| if let Fault::Disconnect(at) = *fault { Some(at) } else { None })
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

    /// The number of pieces of the reply, and the pause between them.
    pub(super) fn split(&self) -> (usize, Duration) {
        let split =
            self.find(|fault| if let Fault::Split { pieces, pause } = *fault { Some((pieces, pause)) } else { None });
        split.unwrap_or((1, Duration::ZERO))
    }

    /// Draws the delay of the reply.
    pub(super) fn delay(&mut self) -> Duration {
        let delay = self.find(|fault| if let Fault::Delay { min, max } = *fault { Some((min, max)) } else { None });
        let left_over =
            self.find(|fault| if let Fault::LeftOver { min, max } = *fault { Some((min, max)) } else { None });
        let mut draw =
            |times: Option<(Duration, Duration)>| times.map_or(Duration::ZERO, |(min, max)| self.rng.between(min, max));
        draw(delay).saturating_add(draw(left_over))
    }

    /// Returns whether the reply is kept for the next connection when its own has ended.
    pub(super) fn outlives_connection(&self) -> bool {
        self.faults.iter().any(|fault| matches!(fault, Fault::LeftOver { .. }))
    }

    /// Draws duplicates and second answers. None without a whole reply.
    pub(super) fn draw_follow_ups(&mut self) -> Vec<DrawnFollowUp> {
        let faults = &self.faults;
        let is_cut = self.disconnect().is_some_and(|at| at != DisconnectAt::AfterReply);
        if is_cut || self.has(&Fault::DropReply) {
            return Vec::new();
        }
        let rng = &mut self.rng;
        let follow_ups = faults.iter().filter_map(|fault| {
            if let Fault::Duplicate(timing) = *fault {
                Some(DrawnFollowUp::Duplicate(timing.draw(rng)))
            } else if let Fault::RoamingDuplicate(timing) = *fault {
                Some(DrawnFollowUp::RoamingDuplicate(timing.draw(rng)))
            } else if let Fault::SecondAnswer { timing, error } = *fault {
                Some(DrawnFollowUp::SecondAnswer(timing.draw(rng), error))
            } else {
                None
            }
        });
        follow_ups.collect()
    }

    fn find<T>(&self, property: impl Fn(&Fault) -> Option<T>) -> Option<T> {
        self.faults.iter().find_map(property)
    }
}

#[derive(Debug)]
struct FaultsInner {
    seed: u64,
    rules: Vec<Rule>,
    line: Line,
    /// The number of requests so far, by station.
    requests: BTreeMap<u8, u64>,
    connections: u64,
    left_over: VecDeque<LeftOver>,
}

impl FaultsInner {
    /// The random numbers of the next request to a station.
    fn rng(&mut self, station: u8) -> FaultRng {
        let requests = self.requests.entry(station).or_default();
        let nth = *requests;
        *requests += 1;
        FaultRng::new(self.seed, station.into(), nth)
    }
}

/// The stream of random numbers for connections; requests have the station number as theirs.
const CONNECTIONS: u64 = 256;

impl<'a> Subject<'a> {
    fn new(target: FaultTarget, frame: &Frame, request: Option<&'a Request>) -> Self {
        Self { target, station: Some(frame.station), command: Code::from_u8(frame.command), request }
    }
}
