//! Checks as data: an assumption, its source, its requests and its judgement. No I/O.

use std::fmt;
use std::time::Duration;

use super::exchange::{Answer, Ask, Exchange};
use super::facts::Facts;
use super::line::Medium;
use super::request::Request;

/// The examination of one assumption.
pub(crate) struct Check {
    pub(crate) name: String,
    pub(crate) group: Group,
    /// Section of docs/PROTOCOL.md or of the facts in docs/HARDWARE.md.
    pub(crate) source: &'static str,
    pub(crate) assumes: String,
    pub(crate) kind: Kind,
    /// The commands that its requests need.
    pub(crate) needs: &'static [u8],
    /// The largest number of requests, repetitions not counted.
    pub(crate) requests: usize,
    /// The number of requests to a PLC as documented.
    pub(crate) usual: usize,
    /// The number of them that a PLC as documented does not answer.
    pub(crate) silences: usize,
    /// The next action after the exchanges so far; `None` if there is enough to judge.
    pub(crate) next: By<Option<Ask>>,
    pub(crate) judge: By<Finding>,
    /// Restores what the exchanges so far have changed.
    pub(crate) undo: By<Option<Undo>>,
}

/// A write that restores an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Undo {
    pub(crate) request: Request,
    /// A read of the element.
    pub(crate) read: Request,
    /// The value to restore.
    pub(crate) value: u16,
    /// The same as an argument of `fatek write`.
    pub(crate) assignment: String,
}

/// A function of the facts and of the exchanges of the check.
type By<T> = Box<dyn Fn(&Facts, &[Exchange]) -> T>;

/// The part of the report that a check belongs to, in its order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Group {
    Framing,
    Commands,
    Limits,
    Errors,
    Values,
    Counters,
    Status,
    Memory,
    Clock,
    Order,
    Timing,
    Connections,
    Writing,
}

/// When a check is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Always.
    Basic,
    /// Unless `--quick` was given.
    Full,
    /// From the traffic of all others.
    Passive,
    /// Unless `--quick` or `--no-load` was given.
    Load,
    /// With `--idle`.
    Idle,
    /// With `--unknown-commands`.
    UnknownCommands,
    /// With `--write`.
    Write,
}

/// The choice of checks.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Choice {
    pub(crate) quick: bool,
    pub(crate) load: bool,
    pub(crate) idle: Option<Duration>,
    pub(crate) unknown_commands: bool,
    pub(crate) write: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The PLC behaves as assumed.
    Holds,
    /// The PLC behaves otherwise.
    Contradicts,
    /// Not examined, or without a result.
    Open,
}

/// The result of a check.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Finding {
    pub(crate) verdict: Verdict,
    /// The observation, without values, addresses and names.
    pub(crate) text: String,
}

impl Finding {
    pub(crate) fn holds(text: impl Into<String>) -> Self {
        Self { verdict: Verdict::Holds, text: text.into() }
    }

    pub(crate) fn contradicts(text: impl Into<String>) -> Self {
        Self { verdict: Verdict::Contradicts, text: text.into() }
    }

    pub(crate) fn open(reason: impl Into<String>) -> Self {
        Self { verdict: Verdict::Open, text: reason.into() }
    }

    /// Holds if none of these things, such as `replies`, has the fault.
    pub(crate) fn unless(faults: usize, of: usize, things: &str, fault: &str) -> Self {
        match (faults, of) {
            (_, 0) => Self::open(format!("no {things} to judge by")),
            (0, _) => Self::holds(format!("{of} {things}")),
            (faults, _) => Self::contradicts(format!("{faults} of {of} {things} {fault}")),
        }
    }
}

impl Check {
    /// A check by a fixed list of requests that are all made.
    pub(crate) fn fixed(
        (group, name, source): (Group, &str, &'static str),
        assumes: impl Into<String>,
        asks: Vec<Ask>,
        judge: impl Fn(&Facts, &[Exchange]) -> Finding + 'static,
    ) -> Self {
        let requests = asks.iter().map(Ask::requests).sum();
        let next = move |_: &Facts, done: &[Exchange]| asks.get(done.len()).cloned();
        Self::adaptive((group, name, source), assumes, requests, next, judge)
    }

    /// A check whose next request depends on the replies.
    pub(crate) fn adaptive(
        (group, name, source): (Group, &str, &'static str),
        assumes: impl Into<String>,
        requests: usize,
        next: impl Fn(&Facts, &[Exchange]) -> Option<Ask> + 'static,
        judge: impl Fn(&Facts, &[Exchange]) -> Finding + 'static,
    ) -> Self {
        Self {
            name: name.to_owned(),
            group,
            source,
            assumes: assumes.into(),
            kind: Kind::Full,
            needs: &[],
            requests,
            usual: requests,
            silences: 0,
            next: Box::new(next),
            judge: Box::new(judge),
            undo: Box::new(|_, _| None),
        }
    }

    /// A check of values that can change meanwhile: the requests are repeated while they contradict.
    ///
    /// A contradiction counts if it shows in [`ROUNDS`] rounds in succession.
    pub(crate) fn rounds<const N: usize>(
        id: (Group, &str, &'static str),
        assumes: impl Into<String>,
        requests: [Request; N],
        judge: impl Fn(&Facts, &[Exchange]) -> Finding + Clone + 'static,
    ) -> Self {
        let judge_rounds = move |facts: &Facts, done: &[Exchange]| {
            let findings = done.chunks_exact(N).map(|round| judge(facts, round)).collect::<Vec<_>>();
            by_rounds(findings)
        };
        let next_by = judge_rounds.clone();
        let next = move |facts: &Facts, done: &[Exchange]| {
            let complete = done.len() / N;
            let is_repeated = complete < ROUNDS && next_by(facts, done).verdict == Verdict::Contradicts;
            let is_next = complete == 0 || !done.len().is_multiple_of(N) || is_repeated;
            requests.get(done.len() % N).filter(|_| is_next).cloned().map(Ask::Reply)
        };
        Self::adaptive(id, assumes, ROUNDS * N, next, judge_rounds).usually(N)
    }

    /// A check of the traffic of all others.
    pub(crate) fn passive(
        (group, name, source): (Group, &str, &'static str),
        assumes: impl Into<String>,
        judge: impl Fn(&Facts) -> Finding + 'static,
    ) -> Self {
        let check = Self::adaptive((group, name, source), assumes, 0, |_, _| None, move |facts, _| judge(facts));
        Self { kind: Kind::Passive, ..check }
    }

    /// The number of requests to a PLC as documented, if it is not the largest one.
    pub(crate) fn usually(self, usual: usize) -> Self {
        Self { usual, ..self }
    }

    pub(crate) fn kind(self, kind: Kind) -> Self {
        Self { kind, ..self }
    }

    pub(crate) fn needs(self, needs: &'static [u8]) -> Self {
        Self { needs, ..self }
    }

    pub(crate) fn silences(self, silences: usize) -> Self {
        Self { silences, ..self }
    }

    pub(crate) fn undo(self, undo: impl Fn(&Facts, &[Exchange]) -> Option<Undo> + 'static) -> Self {
        Self { undo: Box::new(undo), ..self }
    }

    /// The reason why a choice leaves it out.
    pub(crate) fn left_out(&self, choice: Choice) -> Option<&'static str> {
        match self.kind {
            Kind::Full | Kind::Load if choice.quick => Some("not examined: --quick"),
            Kind::Load if !choice.load => Some("not examined: --no-load"),
            Kind::Idle if choice.idle.is_none() => Some("not examined: give --idle TIME"),
            Kind::UnknownCommands if !choice.unknown_commands => Some("not examined: give --unknown-commands"),
            Kind::Write if !choice.write => Some("not examined: give --write ELEMENT"),
            Kind::Basic
            | Kind::Full
            | Kind::Passive
            | Kind::Load
            | Kind::Idle
            | Kind::UnknownCommands
            | Kind::Write => None,
        }
    }

    /// The reason why the facts leave it out.
    pub(crate) fn lacking(&self, facts: &Facts) -> Option<String> {
        let lacks = |code: &&u8| facts.has_command(**code) == Some(false);
        self.needs.iter().find(lacks).map(|code| format!("not examined: the PLC does not execute {code:02X}"))
    }
}

/// Rounds in which a contradiction of values must show: they can change between two requests.
pub(crate) const ROUNDS: usize = 3;

/// The finding by those of the rounds, of which all but the last contradict.
pub(crate) fn by_rounds(mut findings: Vec<Finding>) -> Finding {
    let rounds = findings.len();
    match findings.pop() {
        None => Finding::open("nothing was asked"),
        Some(last) if last.verdict != Verdict::Contradicts && rounds > 1 => {
            Finding::open("a difference was not repeated: the values change")
        }
        Some(last) => last,
    }
}

impl Group {
    pub(crate) fn title(self) -> &'static str {
        match self {
            Self::Framing => "Framing",
            Self::Commands => "Commands",
            Self::Limits => "Longest requests",
            Self::Errors => "Error codes",
            Self::Values => "Values and words of discretes",
            Self::Counters => "Counters of 32 bits",
            Self::Status => "Status and model",
            Self::Memory => "Memory",
            Self::Clock => "Clock",
            Self::Order => "Order of replies",
            Self::Timing => "Timing",
            Self::Connections => "Connections",
            Self::Writing => "Writing",
        }
    }
}

impl Verdict {
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Holds => "holds",
            Self::Contradicts => "contradicts",
            Self::Open => "open",
        }
    }
}

impl fmt::Debug for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Check").field("name", &self.name).finish_non_exhaustive()
    }
}

impl fmt::Display for Answer<'_> {
    /// Without the values.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Data(_) => f.write_str("answered"),
            Self::Refused(code) => write!(f, "refused with error {code:X}"),
            Self::None => f.write_str("not answered"),
        }
    }
}

/// The reason why a check is not for this transport.
pub(crate) fn only_over(medium: Medium, wanted: &[Medium], text: &str) -> Option<Finding> {
    (!wanted.contains(&medium)).then(|| Finding::open(format!("not examined: only over {text}")))
}
