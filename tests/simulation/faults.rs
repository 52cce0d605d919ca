//! The faults of the simulated bus, and which refusals are right.

use std::time::Duration;

use fatek::command::{Code, ReadRegisters, Request, WriteRegisters};
use fatek::sim::{Bus, DisconnectAt, Fault, Faults, LeftOver, Line, Rule, Timing};
use fatek::wire::Framing;
use fatek::{ErrorCode, Register, element, register};

use super::{SLOW, STATIONS, plc};

/// Refuses the loop-back.
pub(crate) const NO_LOOP_BACK: u8 = 5;
/// Refuses mixed reads and writes.
pub(crate) const NO_MIXED: u8 = 6;
/// Refuses RUN.
pub(crate) const NO_RUN: u8 = 7;
/// The first register that every station refuses to read, and the number of them.
pub(crate) const UNREADABLE: (u16, u16) = (1000, 100);
/// The first register that every station refuses to write, and the number of them.
pub(crate) const UNWRITABLE: (u16, u16) = (2000, 200);

/// The refusal of an address that is always refused.
pub(crate) const REFUSED: ErrorCode = ErrorCode::IllegalAddress;
/// The refusal of a command that a station does not know, and of loop-backs.
pub(crate) const UNKNOWN_COMMAND: ErrorCode = ErrorCode::IllegalFormat;
/// The refusal of RUN.
pub(crate) const RUN_REFUSED: ErrorCode = ErrorCode::Syntax;
/// The refusal of a read or write of registers at random.
pub(crate) const INJECTED: ErrorCode = ErrorCode::IllegalValue;
/// The second answer to a request, and the answer to a broadcast: right for no request.
const SECOND: ErrorCode = ErrorCode::NotSupported;

/// A copy comes within this time, so that it is over within the copy window of 100 ms.
const COPY_TIME: Duration = Duration::from_millis(60);

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

fn some(fault: Fault, per_mille: u16) -> Rule {
    Rule::new(fault).per_mille(per_mille)
}

/// Every timing that keeps the order.
fn timings() -> [Timing; 4] {
    let with_next =
        |min_per_mille| Timing::WithNextRequest { min_per_mille, max_per_mille: 1000, at_latest: COPY_TIME };
    [Timing::AT_ONCE, Timing::After { min: Duration::ZERO, max: COPY_TIME }, with_next(0), with_next(1000)]
}

/// Faults of every kind, in four groups of stations. Some combinations are beyond what any client of this protocol can
/// tell: a reply that comes late *and* under another station's number, and a second answer that is a refusal when the
/// first one was garbled.
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

/// What is refused: always, and at random.
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

/// Under the number of the station, under 00, and as a refusal.
fn answers_to_broadcasts() -> [Rule; 3] {
    let answer = |station, error| Fault::AnswerBroadcast { station, min: Duration::ZERO, max: ms(30), error };
    [some(answer(None, None), 150), some(answer(Some(0), None), 50), some(answer(None, Some(SECOND)), 20)]
}

fn of_station(station: u8) -> Vec<Rule> {
    let late = if SLOW.contains(&station) { 80 } else { 10 };
    let mut rules = Vec::new();
    match station % 4 {
        // Wrong numbers, and nothing that is late.
        0 => rules.extend([some(Fault::WrongStation, 10), some(Fault::duplicate(), 10)]),
        // Late: some by a little, some by more than the client waits, some beyond the end of the connection.
        _ => rules.extend([
            some(Fault::Delay { min: ms(65), max: ms(200) }, late),
            some(Fault::Delay { min: ms(1), max: ms(30) }, 50),
            some(Fault::LeftOver { min: ms(65), max: ms(200) }, 10),
        ]),
    }
    if !station.is_multiple_of(4) {
        rules.extend(timings().map(|timing| some(Fault::Duplicate(timing), 10)));
    }
    // A second answer that is a refusal comes only where the first one is not garbled.
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

/// Half of the runs begin with replies to an earlier client.
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

/// A fault's kind, and what is drawn of it: each is counted by itself.
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

/// The labels there must be: 16 kinds have one each, duplicates 4, second answers 8, answers to broadcasts 3.
pub(crate) const LABELS: usize = 31;

pub(crate) fn bus(faults: &Faults) -> Bus {
    let mut bus = Bus::new();
    for station in 1..=STATIONS {
        bus = bus.with_station(station, plc(station)).unwrap();
    }
    bus.with_faults(faults.clone())
}
