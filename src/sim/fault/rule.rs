use super::rng::FaultRng;
use super::{Fault, FaultTarget};
use crate::command::{Code, Command, Request, Run, with_command};
use crate::element::{Element, Width};
use crate::sim::bus::BROADCAST;
use crate::sim::span::Span;

/// A [`Fault`] with the requests it applies to. Default: all requests.
///
/// ```
/// use fatek::command::Code;
/// use fatek::element;
/// use fatek::sim::{Fault, Rule};
///
/// // A bad checksum for one in ten reads of R100 to R199 of station 3, after the first five.
/// let rule = Rule::new(Fault::BadChecksum)
///     .station(3)
///     .command(Code::ReadRegisters)
///     .elements(element!("R100"), 100)
///     .skip(5)
///     .one_in(10);
/// assert_eq!(rule.times_applied(), 0);
/// ```
///
/// The order of the methods has no effect. A request in the scope of the rule (station, command,
/// elements, length) is counted; then [`skip`](Self::skip), [`times`](Self::times) and the chance apply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rule {
    fault: Fault,
    station: Option<u8>,
    command: Option<Code>,
    elements: Option<Span>,
    words_of_discretes: bool,
    longer_than: Option<usize>,
    skip: u64,
    times: Option<u64>,
    odds: Odds,
    /// Number of requests in the scope so far.
    in_scope: u64,
    applied: u64,
}

impl Rule {
    /// A rule that applies this fault to all requests.
    #[must_use]
    pub fn new(fault: Fault) -> Self {
        Self {
            fault,
            station: None,
            command: None,
            elements: None,
            words_of_discretes: false,
            longer_than: None,
            skip: 0,
            times: None,
            odds: Odds { hits: 1, of: 1 },
            in_scope: 0,
            applied: 0,
        }
    }

    /// Limits the rule to requests to this station; 0 is a broadcast.
    ///
    /// For [`Fault::AnswerBroadcast`]: the station that answers. 0 is all stations, the default.
    #[must_use]
    pub fn station(mut self, station: u8) -> Self {
        self.station = Some(station);
        self
    }

    /// Limits the rule to requests of this command.
    #[must_use]
    pub fn command(mut self, code: Code) -> Self {
        self.command = Some(code);
        self
    }

    /// Limits the rule to requests that read or write this element.
    ///
    /// By any symbol of the same memory: a read of `DR100` includes `R101`, one of `WM8` includes
    /// `M9`.
    #[must_use]
    pub fn element(self, element: impl Into<Element>) -> Self {
        self.elements(element, 1)
    }

    /// Limits the rule to requests that read or write any of `count` elements from `first` on.
    #[must_use]
    pub fn elements(mut self, first: impl Into<Element>, count: usize) -> Self {
        self.elements = Some(Span::new(first.into(), count));
        self
    }

    /// Limits the rule to requests for words of discretes: `WX`, `WY`, `WM`, `WS`, `WT`, `WC`, and
    /// double words of them.
    ///
    /// With [`Fault::Error`]: a PLC that has discretes, but not as words.
    #[must_use]
    pub fn words_of_discretes(self) -> Self {
        Self { words_of_discretes: true, ..self }
    }

    /// Limits the rule to requests that read or write more than this number of elements.
    ///
    /// With [`Fault::Error`]: a PLC whose requests are shorter than those of the protocol.
    #[must_use]
    pub fn longer_than(self, elements: usize) -> Self {
        Self { longer_than: Some(elements), ..self }
    }

    /// Excludes the first `requests` requests in the scope. Default: 0.
    #[must_use]
    pub fn skip(mut self, requests: u64) -> Self {
        self.skip = requests;
        self
    }

    /// Limits how often the fault applies. Default: no limit.
    #[must_use]
    pub fn times(mut self, times: u64) -> Self {
        self.times = Some(times);
        self
    }

    /// Sets the chance of each request, in thousandths. Default: 1000.
    #[must_use]
    pub fn per_mille(mut self, per_mille: u16) -> Self {
        self.odds = Odds { hits: per_mille.into(), of: 1000 };
        self
    }

    /// Sets the chance of each request, in millionths: 10,000 is one percent. Default: 1,000,000.
    #[must_use]
    pub fn per_million(mut self, per_million: u32) -> Self {
        self.odds = Odds { hits: per_million.into(), of: 1_000_000 };
        self
    }

    /// Sets the chance of each request to one in `requests`. 0 is never.
    #[must_use]
    pub fn one_in(mut self, requests: u32) -> Self {
        self.odds = Odds { hits: requests.min(1).into(), of: requests.into() };
        self
    }

    /// The fault of this rule.
    #[must_use]
    pub fn fault(&self) -> &Fault {
        &self.fault
    }

    /// How often the fault has applied so far, for a rule from [`Faults::rules`].
    ///
    /// [`Faults::rules`]: super::Faults::rules
    #[must_use]
    pub fn times_applied(&self) -> u64 {
        self.applied
    }

    /// The same rule with its counts at 0.
    pub(super) fn with_counts_reset(mut self) -> Self {
        (self.in_scope, self.applied) = (0, 0);
        self
    }

    /// Returns whether it is limited to this station.
    pub(super) fn is_for(&self, station: u8) -> bool {
        self.station == Some(station)
    }

    /// Returns whether the fault applies to this request. Updates the counts.
    pub(super) fn matches(&mut self, subject: &Subject<'_>, rng: &mut FaultRng) -> bool {
        if !self.has_in_scope(subject) {
            return false;
        }
        let earlier = self.in_scope;
        self.in_scope += 1;
        let is_due = earlier >= self.skip && self.times.is_none_or(|times| self.applied < times);
        let applies = is_due && self.odds.draw(rng);
        self.applied += u64::from(applies);
        applies
    }

    fn has_in_scope(&self, subject: &Subject<'_>) -> bool {
        self.fault.applies_to(subject.target)
            && self.station.is_none_or(|station| subject.is_for(station))
            && self.command.is_none_or(|code| subject.command == Some(code))
            && (!self.words_of_discretes || subject.request.is_some_and(has_words_of_discretes))
            && self.longer_than.is_none_or(|most| subject.request.is_some_and(|request| element_count(request) > most))
            && self.elements.is_none_or(|span| subject.request.is_some_and(|request| is_accessed(span, request)))
    }
}

fn is_accessed(span: Span, request: &Request) -> bool {
    let mut is_accessed = false;
    let mut check = |run: Run| is_accessed |= span.overlaps(Span::new(run.first, run.count));
    with_command!(request, command => command.for_each_run(&mut check));
    is_accessed
}

fn element_count(request: &Request) -> usize {
    let mut count = 0;
    with_command!(request, command => command.for_each_run(&mut |run: Run| count += run.count));
    count
}

fn has_words_of_discretes(request: &Request) -> bool {
    let mut has_words = false;
    let mut check = |run: Run| {
        let symbol = run.first.symbol();
        let smallest = symbol.area().smallest();
        has_words |= smallest.width() == Width::Bit && symbol != smallest;
    };
    with_command!(request, command => command.for_each_run(&mut check));
    has_words
}

/// A request, broadcast or connection for which a rule is evaluated.
#[derive(Clone, Copy, Debug)]
pub(super) struct Subject<'a> {
    pub(super) target: FaultTarget,
    pub(super) station: Option<u8>,
    pub(super) command: Option<Code>,
    pub(super) request: Option<&'a Request>,
}

impl Subject<'_> {
    fn is_for(&self, station: u8) -> bool {
        self.station == Some(station) || self.target == FaultTarget::BroadcastListener && station == BROADCAST
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Odds {
    hits: u64,
    of: u64,
}

impl Odds {
    /// Draws a random number only if the result is open.
    fn draw(self, rng: &mut FaultRng) -> bool {
        match self.hits {
            0 => false,
            hits => hits >= self.of || rng.below(self.of) < hits,
        }
    }
}

#[cfg(test)]
mod tests;
