//! What goes wrong in a run.

use std::time::Duration;

use fatek::command::{Code, ReadRegisters, Request, WriteRegisters};
use fatek::sim::{DisconnectAt, Fault, LeftOver, Rule, Timing};
use fatek::{Element, Register};

use crate::plant::{Dice, INJECTED, REFUSED, SECOND, UNKNOWN_COMMAND, UNREADABLE, UNWRITABLE, d, r};
use crate::wire::Times;

/// Something that goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Trouble {
    /// A copy of a reply without a pause.
    CopyAtOnce,
    /// A copy some time after the reply.
    CopyAfter,
    /// A copy between the next request and its reply.
    CopyWithNext,
    /// A copy directly before the next reply.
    CopyBeforeNext,
    /// A second answer, with the same values or newer ones.
    SecondAnswer,
    /// A second answer that is a refusal.
    SecondRefusal,
    /// A reply that is later than the response timeout.
    Late,
    /// A request or a reply that is lost.
    Lost,
    /// A broadcast that is answered, under the station's number or 00.
    AnsweredBroadcast,
    /// Replies to an earlier client at the beginning, from a PLC that is idle or busy.
    LeftAtStart,
    /// Late replies that outlive their connection, and connections that end.
    LeftOver,
    /// A device that refuses 4E.
    NoLoopBack,
    /// A device that refuses 48 and 49.
    NoMixed,
    /// A device that closes the connection after each reply.
    Closes,
    /// A refusal at random.
    Injected,
    /// One copy that keeps no order.
    Roaming,
    /// Copies that come behind the next reply, as over UDP. A port is used again after four requests, and a copy that lives
    /// longer than that is beyond what is promised.
    Roams,
}

use Trouble::*;

/// The troubles of a run: run `n` has number `n` modulo their number. The last one stands for any of them.
pub(crate) const TROUBLES: [&[Trouble]; 17] = [
    &[],
    &[CopyAfter],
    &[CopyWithNext],
    &[CopyBeforeNext],
    &[CopyAtOnce, CopyAfter],
    &[SecondAnswer],
    &[SecondRefusal],
    &[Late],
    &[Lost],
    &[AnsweredBroadcast],
    &[LeftAtStart, CopyWithNext],
    &[LeftOver],
    &[NoLoopBack, CopyWithNext],
    &[NoMixed, CopyWithNext],
    &[Closes],
    &[CopyWithNext, CopyAfter, SecondAnswer, Late, Lost, Injected],
    ANY,
];

/// Each of them with a chance of one in three.
const ANY: &[Trouble] = &[
    CopyAtOnce,
    CopyAfter,
    CopyWithNext,
    CopyBeforeNext,
    SecondAnswer,
    SecondRefusal,
    Late,
    Lost,
    AnsweredBroadcast,
    LeftAtStart,
    LeftOver,
    NoLoopBack,
    NoMixed,
    Closes,
    Injected,
];

pub(crate) fn troubles(seed: u64, dice: &mut Dice) -> Vec<Trouble> {
    let troubles = TROUBLES[(seed % TROUBLES.len() as u64) as usize];
    if troubles != ANY {
        return troubles.to_vec();
    }
    ANY.iter().copied().filter(|_| dice.in_hundred(33)).collect()
}

/// The rules of a trouble, of which a station's number makes no difference.
pub(crate) fn rules(trouble: Trouble, times: &Times, alone: bool) -> Vec<Rule> {
    let some = |fault: Fault, per_mille: u16| Rule::new(fault).per_mille(if alone { 2 * per_mille } else { per_mille });
    let always = |error, code| Rule::new(Fault::Error(error)).command(code);
    let after = Timing::After { min: Duration::ZERO, max: times.copies };
    let with_next =
        |min_per_mille| Timing::WithNextRequest { min_per_mille, max_per_mille: 1000, at_latest: times.copies };
    let any_time = [Timing::AT_ONCE, after, with_next(0), with_next(1000)];
    let roaming = Timing::AfterNextReply { min: Duration::ZERO, max: times.copies / 4, at_latest: times.copies };
    let (min, max) = times.late;
    match trouble {
        CopyAtOnce => vec![some(Fault::duplicate(), 100)],
        CopyAfter => vec![some(Fault::Duplicate(after), 100)],
        CopyWithNext => vec![some(Fault::Duplicate(with_next(0)), 100)],
        CopyBeforeNext => vec![some(Fault::Duplicate(with_next(1000)), 100)],
        SecondAnswer => any_time.map(|timing| some(Fault::SecondAnswer { timing, error: None }, 30)).to_vec(),
        SecondRefusal => any_time.map(|timing| some(Fault::SecondAnswer { timing, error: Some(SECOND) }, 30)).to_vec(),
        Late => vec![some(Fault::Delay { min, max }, 25)],
        Lost => vec![some(Fault::Ignore, 15), some(Fault::DropReply, 15)],
        AnsweredBroadcast => {
            let answer =
                |station, error| Fault::AnswerBroadcast { station, min: Duration::ZERO, max: times.busy, error };
            vec![some(answer(None, None), 250), some(answer(Some(0), None), 100), some(answer(None, Some(SECOND)), 100)]
        }
        LeftAtStart => vec![Rule::new(Fault::Delay { min: times.busy, max: times.busy }).times(1)],
        LeftOver => vec![
            some(Fault::LeftOver { min, max }, 25),
            some(Fault::Disconnect(DisconnectAt::BeforeExecution), 4),
            some(Fault::Disconnect(DisconnectAt::BeforeReply), 4),
            some(Fault::Disconnect(DisconnectAt::WithinReply), 4),
            some(Fault::Disconnect(DisconnectAt::AfterReply), 4),
        ],
        NoLoopBack => vec![always(UNKNOWN_COMMAND, Code::LoopBack)],
        NoMixed => vec![always(UNKNOWN_COMMAND, Code::ReadMixed), always(UNKNOWN_COMMAND, Code::WriteMixed)],
        Closes => vec![Rule::new(Fault::Disconnect(DisconnectAt::AfterReply))],
        Injected => vec![
            some(Fault::Error(INJECTED), 20).command(Code::ReadRegisters),
            some(Fault::Error(INJECTED), 20).command(Code::WriteRegisters),
        ],
        Roaming => vec![Rule::new(Fault::RoamingDuplicate(roaming)).one_in(30).times(1)],
        Roams => {
            let (min, max) = (Duration::ZERO, Duration::ZERO);
            let timing = Timing::AfterNextReply { min, max, at_latest: times.copies };
            vec![some(Fault::RoamingDuplicate(timing), 100)]
        }
    }
}

/// The addresses that are always refused.
pub(crate) fn refused_addresses() -> [Rule; 2] {
    let refused =
        |first: Register, count: u16| Rule::new(Fault::Error(REFUSED)).elements(Element::from(first), count.into());
    [refused(r(crate::plant::READABLE), UNREADABLE), refused(d(crate::plant::WRITABLE), UNWRITABLE)]
}

/// Replies to an earlier client.
pub(crate) fn left_over(stations: u8, times: &Times, dice: &mut Dice) -> Vec<LeftOver> {
    // Just before the reply of a station that is busy.
    let delay = if dice.in_hundred(50) { Duration::ZERO } else { times.busy };
    let mut replies = Vec::new();
    for station in 1..=stations {
        for _ in 0..=dice.below(4) {
            let count = if dice.in_hundred(60) { 1 } else { dice.between(1, 64).into() };
            let request = match dice.below(3) {
                0 => Request::ControlPlc(fatek::command::ControlPlc::Stop),
                1 => Request::WriteRegisters(WriteRegisters::new(d(3500), [0]).unwrap()),
                _ => Request::ReadRegisters(ReadRegisters::new(r(dice.between(0, 2900)), count).unwrap()),
            };
            let reply = LeftOver::reply(station, request).delay(delay);
            replies.push(if dice.in_hundred(30) { reply.error(SECOND) } else { reply });
        }
    }
    replies
}

/// A fault's kind, and what is drawn of it: each is counted by itself.
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
