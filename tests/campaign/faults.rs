//! Faults of the runs: their kinds, the rules that inject them, and the sets that runs use.

use std::time::Duration;

use fatek::command::{Code, ReadRegisters, Request, WriteRegisters};
use fatek::sim::{DisconnectAt, Fault, LeftOver, Rule, Timing};
use fatek::{Element, Register};

use crate::layout::{INJECTED, READABLE, REFUSED, SECOND, UNKNOWN_COMMAND, UNREADABLE, UNWRITABLE, WRITABLE, d, r};
use crate::line::Times;
use crate::rng::Rng;

/// The parameters of the rules.
struct Parameters<'a> {
    times: &'a Times,
    /// The run has no other kind of fault.
    alone: bool,
}

impl Parameters<'_> {
    /// Applies to this part of the requests, or twice as many if the kind is alone.
    fn some(&self, fault: Fault, per_mille: u16) -> Rule {
        Rule::new(fault).per_mille(if self.alone { 2 * per_mille } else { per_mille })
    }

    fn after(&self) -> Timing {
        Timing::After { min: Duration::ZERO, max: self.times.copies }
    }

    fn with_next(&self, min_per_mille: u16) -> Timing {
        Timing::WithNextRequest { min_per_mille, max_per_mille: 1000, at_latest: self.times.copies }
    }

    /// A second answer at any time.
    fn second_answer(&self, error: Option<fatek::ErrorCode>) -> Vec<Rule> {
        let timings = [Timing::AT_ONCE, self.after(), self.with_next(0), self.with_next(1000)];
        timings.map(|timing| self.some(Fault::SecondAnswer { timing, error }, 30)).to_vec()
    }

    fn answer_broadcast(&self, station: Option<u8>, error: Option<fatek::ErrorCode>, per_mille: u16) -> Rule {
        self.some(Fault::AnswerBroadcast { station, min: Duration::ZERO, max: self.times.busy, error }, per_mille)
    }
}

/// Refuses a command that the PLC does not support.
fn unsupported(code: Code) -> Rule {
    Rule::new(Fault::Error(UNKNOWN_COMMAND)).command(code)
}

/// Declares the kinds of faults: for each kind whether random sets contain it, and its rules.
macro_rules! fault_kinds {
    ($p:ident; $($(#[$doc:meta])* $kind:ident, in_random_sets: $random:literal => $rules:expr;)*) => {
        /// A kind of fault.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum FaultKind {
            $($(#[$doc])* $kind,)*
        }

        /// All kinds, each with whether random sets contain it.
        const ALL: &[(FaultKind, bool)] = &[$((FaultKind::$kind, $random),)*];

        /// Rules that inject a kind of fault. They do not depend on the station.
        pub(crate) fn rules(kind: FaultKind, times: &Times, alone: bool) -> Vec<Rule> {
            let $p = Parameters { times, alone };
            match kind {
                $(FaultKind::$kind => $rules,)*
            }
        }
    };
}

fault_kinds! { p;
    /// A copy of a reply, without a pause.
    CopyAtOnce, in_random_sets: true => vec![p.some(Fault::duplicate(), 100)];

    /// A copy some time after the reply.
    CopyAfter, in_random_sets: true => vec![p.some(Fault::Duplicate(p.after()), 100)];

    /// A copy between the next request and its reply.
    CopyWithNext, in_random_sets: true => vec![p.some(Fault::Duplicate(p.with_next(0)), 100)];

    /// A copy just before the next reply.
    CopyBeforeNext, in_random_sets: true => vec![p.some(Fault::Duplicate(p.with_next(1000)), 100)];

    /// A second answer, with the same values or newer ones.
    SecondAnswer, in_random_sets: true => p.second_answer(None);

    /// A second answer that is a refusal.
    SecondRefusal, in_random_sets: true => p.second_answer(Some(SECOND));

    /// A reply after the response timeout.
    Late, in_random_sets: true => vec![p.some(Fault::Delay { min: p.times.late.0, max: p.times.late.1 }, 25)];

    /// A lost request or reply.
    Lost, in_random_sets: true => vec![p.some(Fault::Ignore, 15), p.some(Fault::DropReply, 15)];

    /// An answer to a broadcast, under the station's number or 00.
    AnsweredBroadcast, in_random_sets: true => vec![
        p.answer_broadcast(None, None, 250),
        p.answer_broadcast(Some(0), None, 100),
        p.answer_broadcast(None, Some(SECOND), 100),
    ];

    /// Replies to an earlier client at the start, from an idle or busy PLC.
    LeftAtStart, in_random_sets: true => vec![
        Rule::new(Fault::Delay { min: p.times.busy, max: p.times.busy }).times(1),
    ];

    /// Late replies that outlive their connection, and connections that end.
    LeftOver, in_random_sets: true => vec![
        p.some(Fault::LeftOver { min: p.times.late.0, max: p.times.late.1 }, 25),
        p.some(Fault::Disconnect(DisconnectAt::BeforeExecution), 4),
        p.some(Fault::Disconnect(DisconnectAt::BeforeReply), 4),
        p.some(Fault::Disconnect(DisconnectAt::WithinReply), 4),
        p.some(Fault::Disconnect(DisconnectAt::AfterReply), 4),
    ];

    /// A PLC that refuses 4E.
    NoLoopBack, in_random_sets: true => vec![unsupported(Code::LoopBack)];

    /// A PLC that refuses 48 and 49.
    NoMixed, in_random_sets: true => vec![unsupported(Code::ReadMixed), unsupported(Code::WriteMixed)];

    /// A PLC that closes the connection after each reply.
    Closes, in_random_sets: true => vec![Rule::new(Fault::Disconnect(DisconnectAt::AfterReply))];

    /// A random refusal.
    Injected, in_random_sets: true => vec![
        p.some(Fault::Error(INJECTED), 20).command(Code::ReadRegisters),
        p.some(Fault::Error(INJECTED), 20).command(Code::WriteRegisters),
    ];

    /// One roaming duplicate.
    RoamingOnce, in_random_sets: false => {
        let (max, at_latest) = (p.times.copies / 4, p.times.copies);
        let timing = Timing::AfterNextReply { min: Duration::ZERO, max, at_latest };
        vec![Rule::new(Fault::RoamingDuplicate(timing)).one_in(30).times(1)]
    };

    /// Copies just after the next reply, as over UDP. A link uses a port again after four requests,
    /// and tolerates no copy that lives longer.
    RoamingUdp, in_random_sets: false => {
        let (min, max) = (Duration::ZERO, Duration::ZERO);
        let timing = Timing::AfterNextReply { min, max, at_latest: p.times.copies };
        vec![p.some(Fault::RoamingDuplicate(timing), 100)]
    };
}

use FaultKind::*;

/// Faults of a run.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FaultSet {
    Exactly(&'static [FaultKind]),
    /// Each kind with a chance of one in three.
    Random,
}

use FaultSet::{Exactly, Random};

/// Sets of the campaign: run `n` has set `n` modulo 17.
pub(crate) const FAULT_SETS: [FaultSet; 17] = [
    Exactly(&[]),
    Exactly(&[CopyAfter]),
    Exactly(&[CopyWithNext]),
    Exactly(&[CopyBeforeNext]),
    Exactly(&[CopyAtOnce, CopyAfter]),
    Exactly(&[SecondAnswer]),
    Exactly(&[SecondRefusal]),
    Exactly(&[Late]),
    Exactly(&[Lost]),
    Exactly(&[AnsweredBroadcast]),
    Exactly(&[LeftAtStart, CopyWithNext]),
    Exactly(&[LeftOver]),
    Exactly(&[NoLoopBack, CopyWithNext]),
    Exactly(&[NoMixed, CopyWithNext]),
    Exactly(&[Closes]),
    Exactly(&[CopyWithNext, CopyAfter, SecondAnswer, Late, Lost, Injected]),
    Random,
];

/// Draws the faults of a run.
pub(crate) fn draw(seed: u64, rng: &mut Rng) -> Vec<FaultKind> {
    match FAULT_SETS[(seed % FAULT_SETS.len() as u64) as usize] {
        Exactly(kinds) => kinds.to_vec(),
        Random => {
            let kinds = ALL.iter().filter(|(_, in_random_sets)| *in_random_sets).map(|&(kind, _)| kind);
            kinds.filter(|_| rng.percent(33)).collect()
        }
    }
}

/// Rules for addresses that are always refused.
pub(crate) fn refused_addresses() -> [Rule; 2] {
    let refused =
        |first: Register, count: u16| Rule::new(Fault::Error(REFUSED)).elements(Element::from(first), count.into());
    [refused(r(READABLE), UNREADABLE), refused(d(WRITABLE), UNWRITABLE)]
}

/// Replies to an earlier client.
pub(crate) fn left_over(stations: u8, times: &Times, rng: &mut Rng) -> Vec<LeftOver> {
    // From an idle PLC, or just before the first reply of a busy one.
    let delay = if rng.percent(50) { Duration::ZERO } else { times.busy };
    let mut replies = Vec::new();
    for station in 1..=stations {
        for _ in 0..=rng.below(4) {
            let count = if rng.percent(60) { 1 } else { rng.between(1, 64).into() };
            let request = match rng.below(3) {
                0 => Request::ControlPlc(fatek::command::ControlPlc::Stop),
                1 => Request::WriteRegisters(WriteRegisters::new(d(3500), [0]).unwrap()),
                _ => Request::ReadRegisters(ReadRegisters::new(r(rng.between(0, 2900)), count).unwrap()),
            };
            let reply = LeftOver::reply(station, request).delay(delay);
            replies.push(if rng.percent(30) { reply.error(SECOND) } else { reply });
        }
    }
    replies
}

/// Name under which injections of a fault are counted.
pub(crate) fn label(fault: &Fault) -> String {
    let text = format!("{fault:?}");
    let kind = text.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
    let timing_label = |timing: &Timing| match *timing {
        Timing::AT_ONCE => "at once",
        Timing::After { .. } => "after",
        Timing::WithNextRequest { min_per_mille: 1000, .. } => "before the next reply",
        Timing::WithNextRequest { .. } => "with the next request",
        _ => "after the next reply",
    };
    match fault {
        Fault::Duplicate(timing) => format!("{kind} {}", timing_label(timing)),
        Fault::SecondAnswer { timing, error: None } => format!("{kind} {}", timing_label(timing)),
        Fault::SecondAnswer { timing, error: Some(_) } => format!("{kind} refused {}", timing_label(timing)),
        Fault::AnswerBroadcast { station, error, .. } => {
            format!("{kind} under {}{}", station.map_or("own", |_| "00"), if error.is_some() { " refused" } else { "" })
        }
        Fault::Error(code) => format!("{kind} {code:?}"),
        Fault::Disconnect(moment) => format!("{kind} {moment:?}"),
        _ => kind.to_owned(),
    }
}
