use super::dice::Dice;
use super::{Addressee, Fault};
use crate::command::{Code, Command, Request, Run, with_command};
use crate::element::{Element, MemoryArea};
use crate::sim::bus::BROADCAST;
use crate::sim::memory::covered;

/// A [`Fault`], and which requests it befalls: all of them, until something narrows it down.
///
/// ```
/// use fatek::command::Code;
/// use fatek::element;
/// use fatek::sim::{Fault, Rule};
///
/// // Station 3 answers one in ten reads that touch R100 to R199 with a bad checksum, but not the first five of them.
/// let rule = Rule::new(Fault::BadChecksum)
///     .station(3)
///     .command(Code::ReadRegisters)
///     .elements(element!("R100"), 100)
///     .skip(5)
///     .one_in(10);
/// assert_eq!(rule.struck(), 0);
/// ```
///
/// Order does not matter: a request must be in the scope (station, command, elements), then it is counted, then come
/// [`skip`](Self::skip), [`times`](Self::times) and chance.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rule {
    fault: Fault,
    station: Option<u8>,
    command: Option<Code>,
    elements: Option<Span>,
    skip: u64,
    times: Option<u64>,
    odds: Odds,
    in_scope: u64,
    struck: u64,
}

impl Rule {
    /// This fault befalls every request.
    #[must_use]
    pub fn new(fault: Fault) -> Self {
        Self {
            fault,
            station: None,
            command: None,
            elements: None,
            skip: 0,
            times: None,
            odds: Odds { strikes: 1, of: 1 },
            in_scope: 0,
            struck: 0,
        }
    }

    /// Only requests to this station. 0 is the broadcast.
    ///
    /// For [`Fault::AnswerBroadcast`] it is the station that answers, and with 0, as without this, each of them.
    #[must_use]
    pub fn station(mut self, station: u8) -> Self {
        self.station = Some(station);
        self
    }

    /// Only this command.
    #[must_use]
    pub fn command(mut self, code: Code) -> Self {
        self.command = Some(code);
        self
    }

    /// Only requests that touch this element, by any name: `R101` is touched by a read of `DR100`, and `M9` by one of
    /// `WM8`.
    #[must_use]
    pub fn element(self, element: impl Into<Element>) -> Self {
        self.elements(element, 1)
    }

    /// Only requests that touch one of `count` consecutive elements from `first` on.
    #[must_use]
    pub fn elements(mut self, first: impl Into<Element>, count: usize) -> Self {
        self.elements = Some(Span::new(first.into(), count));
        self
    }

    /// Not the first `requests` of those in the scope.
    #[must_use]
    pub fn skip(mut self, requests: u64) -> Self {
        self.skip = requests;
        self
    }

    /// At most this many times.
    #[must_use]
    pub fn times(mut self, times: u64) -> Self {
        self.times = Some(times);
        self
    }

    /// With a chance of this many in a thousand.
    #[must_use]
    pub fn per_mille(mut self, per_mille: u16) -> Self {
        self.odds = Odds { strikes: per_mille.into(), of: 1000 };
        self
    }

    /// With a chance of one in `requests`; never with one in 0.
    #[must_use]
    pub fn one_in(mut self, requests: u32) -> Self {
        self.odds = Odds { strikes: requests.min(1).into(), of: requests.into() };
        self
    }

    /// The fault.
    #[must_use]
    pub fn fault(&self) -> &Fault {
        &self.fault
    }

    /// How often it has struck, for a rule that [`Faults::rules`](super::Faults::rules) gives.
    #[must_use]
    pub fn struck(&self) -> u64 {
        self.struck
    }

    /// The same rule, as if it had never been asked.
    pub(super) fn afresh(mut self) -> Self {
        (self.in_scope, self.struck) = (0, 0);
        self
    }

    /// Whether it is meant for this station alone.
    pub(super) fn is_for(&self, station: u8) -> bool {
        self.station == Some(station)
    }

    /// Whether it befalls this request, and counts it.
    pub(super) fn strikes(&mut self, subject: &Subject<'_>, dice: &mut Dice) -> bool {
        if !self.covers(subject) {
            return false;
        }
        let earlier = self.in_scope;
        self.in_scope = earlier.saturating_add(1);
        let strikes =
            earlier >= self.skip && self.times.is_none_or(|times| self.struck < times) && self.odds.strike(dice);
        self.struck = self.struck.saturating_add(strikes.into());
        strikes
    }

    fn covers(&self, subject: &Subject<'_>) -> bool {
        self.fault.befalls(subject.addressee)
            && self.station.is_none_or(|station| subject.concerns(station))
            && self.command.is_none_or(|code| subject.command == Some(code))
            && self.elements.is_none_or(|span| subject.request.is_some_and(|request| span.is_touched_by(request)))
    }
}

/// What a rule is asked about.
#[derive(Clone, Copy, Debug)]
pub(super) struct Subject<'a> {
    pub(super) addressee: Addressee,
    pub(super) station: Option<u8>,
    pub(super) command: Option<Code>,
    pub(super) request: Option<&'a Request>,
}

impl Subject<'_> {
    fn concerns(&self, station: u8) -> bool {
        self.station == Some(station) || self.addressee == Addressee::Listener && station == BROADCAST
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Odds {
    strikes: u64,
    of: u64,
}

impl Odds {
    fn strike(self, dice: &mut Dice) -> bool {
        match self.strikes {
            0 => false,
            strikes => strikes >= self.of || dice.below(self.of) < strikes,
        }
    }
}

/// Addresses of one area, from the first to the last; none if the last comes before the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Span {
    area: MemoryArea,
    first: u16,
    last: u16,
}

impl Span {
    fn new(first: Element, count: usize) -> Self {
        let area = first.symbol().area();
        // Past the last element is nothing that could be touched.
        let last = count.checked_sub(1).map(|n| first.nth(n).map_or(u16::MAX, |last| covered(last).1));
        match last {
            Some(last) => Self { area, first: first.address(), last },
            None => Self { area, first: 1, last: 0 },
        }
    }

    fn is_touched_by(self, request: &Request) -> bool {
        let mut is_touched = false;
        let mut look = |run: Run| is_touched |= self.overlaps(Self::new(run.first, run.count));
        with_command!(request, command => command.for_each_run(&mut look));
        is_touched
    }

    fn overlaps(self, other: Self) -> bool {
        let empty = self.first > self.last || other.first > other.last;
        !empty && self.area == other.area && self.first <= other.last && other.first <= self.last
    }
}

#[cfg(test)]
mod tests;
