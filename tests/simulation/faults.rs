//! Faults of the simulated bus, and the refusals that are right.

use std::time::Duration;

use fatek::command::{Code, ReadRegisters, Request, WriteRegisters};
use fatek::sim::{Bus, DisconnectAt, Fault, Faults, LeftOver, Line, Rule, Timing};
use fatek::wire::Framing;
use fatek::{ErrorCode, Register, element, register};

use super::{SLOW, STATIONS, plc};

/// Station that refuses the loop-back.
pub(crate) const NO_LOOP_BACK: u8 = 5;
/// Station that refuses mixed reads and writes.
pub(crate) const NO_MIXED: u8 = 6;
/// Station that refuses RUN.
pub(crate) const NO_RUN: u8 = 7;
/// First register that cannot be read, and the number of them.
pub(crate) const UNREADABLE: (u16, u16) = (1000, 100);
/// First register that cannot be written, and the number of them.
pub(crate) const UNWRITABLE: (u16, u16) = (2000, 200);

/// Error code of addresses that are always refused.
pub(crate) const REFUSED: ErrorCode = ErrorCode::IllegalAddress;
/// Error code of unsupported commands and of refused loop-backs.
pub(crate) const UNKNOWN_COMMAND: ErrorCode = ErrorCode::IllegalFormat;
/// Error code of refused RUN commands.
pub(crate) const RUN_REFUSED: ErrorCode = ErrorCode::Syntax;
/// Error code of injected refusals of reads and writes.
pub(crate) const INJECTED: ErrorCode = ErrorCode::IllegalValue;
/// Error code of second answers and answers to broadcasts. It is right for no request.
const SECOND: ErrorCode = ErrorCode::NotSupported;

/// Longest delay of a copy, within the copy window of 100 ms.
const COPY_TIME: Duration = Duration::from_millis(60);

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

fn some(fault: Fault, per_mille: u16) -> Rule {
    Rule::new(fault).per_mille(per_mille)
}

/// All timings that keep the order of replies.
fn timings() -> [Timing; 4] {
    let with_next =
        |min_per_mille| Timing::WithNextRequest { min_per_mille, max_per_mille: 1000, at_latest: COPY_TIME };
    [Timing::AT_ONCE, Timing::After { min: Duration::ZERO, max: COPY_TIME }, with_next(0), with_next(1000)]
}

/// Faults of every kind, in four groups of stations.
///
/// Some combinations cannot be detected by any client: a late reply with another station's number,
/// and a second answer that is a refusal after a corrupt first one.
pub(crate) fn faults(seed: u64, framing: Framing, echo: bool) -> Faults {
    let mut faults = Faults::new(seed)
        .journal_capacity(1_000_000)
        .rule(some(Fault::Ignore, 8))
        .rule(some(Fault::DropReply, 8))
        .rule(some(Fault::Split { pieces: 3, pause: ms(4) }, 20))
        .rule(some(Fault::Disconnect(DisconnectAt::BeforeExecution), 1))
        .rule(some(Fault::Disconnect(DisconnectAt::BeforeReply), 1))
        .rule(some(Fault::Disconnect(DisconnectAt::WithinReply), 1))
        .rule(some(Fault::Disconnect(DisconnectAt::AfterReply), 1))
        .rule(some(Fault::Refuse, 200))
        .line(Line::new(115_200).response_time(ms(1), ms(5)));
    for rule in refusals().into_iter().chain(answers_to_broadcasts()) {
        faults = faults.rule(rule);
    }
    for station in 1..=STATIONS {
        for rule in of_station(station) {
            faults = faults.rule(rule.station(station));
        }
    }
    if echo && framing == Framing::Ascii {
        faults = faults.rule(Rule::new(Fault::Echo));
    }
    left_over(faults, seed)
}

/// Refusals: permanent ones and random ones.
fn refusals() -> Vec<Rule> {
    let always = |error| Rule::new(Fault::Error(error));
    vec![
        always(REFUSED).elements(element!("R1000"), UNREADABLE.1.into()),
        always(REFUSED).elements(element!("D2000"), UNWRITABLE.1.into()),
        always(UNKNOWN_COMMAND).station(NO_LOOP_BACK).command(Code::LoopBack),
        always(UNKNOWN_COMMAND).station(NO_MIXED).command(Code::ReadMixed),
        always(UNKNOWN_COMMAND).station(NO_MIXED).command(Code::WriteMixed),
        some(Fault::Error(UNKNOWN_COMMAND), 20).command(Code::LoopBack),
        some(Fault::Error(INJECTED), 5).command(Code::ReadRegisters),
        some(Fault::Error(INJECTED), 5).command(Code::WriteRegisters),
    ]
}

/// Answers to broadcasts under the station's number, under 00, and as a refusal.
fn answers_to_broadcasts() -> [Rule; 3] {
    let answer = |station, error| Fault::AnswerBroadcast { station, min: Duration::ZERO, max: ms(30), error };
    [some(answer(None, None), 150), some(answer(Some(0), None), 50), some(answer(None, Some(SECOND)), 20)]
}

fn of_station(station: u8) -> Vec<Rule> {
    let late = if SLOW.contains(&station) { 80 } else { 10 };
    let mut rules = Vec::new();
    match station % 4 {
        // Wrong station numbers, and no late replies.
        0 => rules.extend([some(Fault::WrongStation, 10), some(Fault::duplicate(), 10)]),
        // Slightly late replies, replies after the timeout, and replies after the end of the
        // connection.
        _ => rules.extend([
            some(Fault::Delay { min: ms(65), max: ms(200) }, late),
            some(Fault::Delay { min: ms(1), max: ms(30) }, 50),
            some(Fault::LeftOver { min: ms(65), max: ms(200) }, 10),
        ]),
    }
    if !station.is_multiple_of(4) {
        rules.extend(timings().map(|timing| some(Fault::Duplicate(timing), 10)));
    }
    // A second answer that is a refusal comes only if the first one is never corrupt.
    let error = (station % 4 == 3).then_some(SECOND);
    if station % 4 >= 2 {
        rules.extend(timings().map(|timing| some(Fault::SecondAnswer { timing, error }, 10)));
    }
    if error.is_none() {
        rules.extend([
            some(Fault::GarbageBefore { max_len: 40 }, 10),
            some(Fault::GarbageInside { max_len: 10 }, 10),
            some(Fault::WrongCommand, 5),
            some(Fault::Truncated { by: 1 }, 5),
            some(Fault::Extended { by: 4 }, 5),
            some(Fault::BadChecksum, 10),
        ]);
    }
    rules
}

/// Adds replies to an earlier client, in half of the runs.
fn left_over(mut faults: Faults, seed: u64) -> Faults {
    if seed % 4 > 1 {
        return faults;
    }
    for station in SLOW.chain([NO_LOOP_BACK]) {
        let read = Request::ReadRegisters(ReadRegisters::new(Register::r(200 + u16::from(station)), 1).unwrap());
        let write = Request::WriteRegisters(WriteRegisters::new(register!("D3000"), [0]).unwrap());
        faults = faults.left_over(LeftOver::reply(station, read.clone()));
        faults = faults.left_over(LeftOver::reply(station, write));
        faults = faults.left_over(LeftOver::reply(station, read).error(SECOND));
    }
    faults
}

/// Name under which injections of a fault are counted.
pub(crate) fn label(fault: &Fault) -> String {
    let text = format!("{fault:?}");
    let kind = text.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
    match fault {
        Fault::Duplicate(timing) => format!("{kind} {}", timing_label(timing)),
        Fault::SecondAnswer { timing, error: None } => format!("{kind} {}", timing_label(timing)),
        Fault::SecondAnswer { timing, error: Some(_) } => format!("{kind} refused {}", timing_label(timing)),
        Fault::AnswerBroadcast { station, error, .. } => {
            format!("{kind} under {}{}", station.map_or("own", |_| "00"), if error.is_some() { " refused" } else { "" })
        }
        _ => kind.to_owned(),
    }
}

fn timing_label(timing: &Timing) -> &'static str {
    match *timing {
        Timing::AT_ONCE => "at once",
        Timing::After { .. } => "after",
        Timing::WithNextRequest { min_per_mille: 1000, .. } => "before the next reply",
        Timing::WithNextRequest { .. } => "with the next request",
        _ => "roaming",
    }
}

/// Number of labels: 16 kinds have one each, duplicates 4, second answers 8, answers to broadcasts
/// 3.
pub(crate) const LABELS: usize = 31;

pub(crate) fn bus(faults: &Faults) -> Bus {
    let mut bus = Bus::new();
    for station in 1..=STATIONS {
        bus = bus.with_station(station, plc(station)).unwrap();
    }
    bus.with_faults(faults.clone())
}
