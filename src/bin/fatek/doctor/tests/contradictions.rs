//! Each assumption has a PLC that contradicts it.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;
use fatek::command::Code;
use fatek::memory_map::PlcModel;
use fatek::sim::{DisconnectAt, Fault, Model, Plc, Quirk, Rule, Timing};
use fatek::wire::Framing;
use fatek::{ErrorCode, discrete, register};

use super::rig::{Rig, contradicted, data_of};
use crate::doctor::request::Requests;

const ASCII: Requests = Requests { framing: Framing::Ascii, station: 1 };

/// Checks that need a socket: they are in `udp.rs`.
pub(super) const OF_UDP: [&str; 3] = ["one-datagram", "own-port", "asking-port"];

/// Makes a PLC, a line, or a choice that contradicts one assumption.
type Contradiction = Box<dyn Fn(&mut Rig)>;

fn fault(rule: Rule) -> Contradiction {
    Box::new(move |rig| rig.faults.add_rule(rule.clone()))
}

fn quirk(quirk: Quirk) -> Contradiction {
    Box::new(move |rig| rig.plc.add_quirk(quirk.clone()))
}

/// A reply of its own to one request.
fn reply(code: Code, data: impl Into<Bytes>, reply: &str) -> Contradiction {
    quirk(Quirk::reply(code.into(), data, Some(reply)))
}

fn model(change: impl Fn(Model) -> Model + 'static) -> Contradiction {
    Box::new(move |rig| {
        let plc = Plc::with_model(change(Model::of(PlcModel::Fbe28Mc)));
        *rig = Rig::with_plc(rig.framing, plc);
    })
}

/// A PLC without faults on its line, with this quirk.
fn without_queue(quirk: Quirk) -> Contradiction {
    Box::new(move |rig| {
        rig.has_faults = false;
        rig.plc.add_quirk(quirk.clone());
    })
}

fn write(change: impl Fn(&mut Rig) + 'static) -> Contradiction {
    Box::new(move |rig| {
        rig.choice.write = true;
        change(rig);
    })
}

fn once(fault: Fault) -> Rule {
    // Behind the first requests, which find the commands.
    Rule::new(fault).command(Code::ReadRegisters).skip(1).times(1)
}

fn refused(code: Code) -> Contradiction {
    fault(Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(code))
}

fn longer(code: Code, than: usize, error: ErrorCode) -> Rule {
    Rule::new(Fault::Error(error)).command(code).longer_than(than)
}

/// The whole list: the name of the check, and what contradicts it.
fn contradictions() -> Vec<(&'static str, Contradiction)> {
    let ms = Duration::from_millis;
    let read = |n, first: &str| data_of(Framing::Ascii, Code::ReadRegisters, n, first);
    let registers = |n: usize| format!("0{}", "0000".repeat(n));
    let no_words = |area: &str| {
        let read = data_of(Framing::Ascii, Code::ReadRegisters, 1, &format!("W{area}8"));
        reply(Code::ReadRegisters, read, "A")
    };
    let last = |element: &'static str| model(move |model| model.last(element.parse::<fatek::Element>().unwrap()));
    let mixed = |elements: &[&str]| ASCII.mixed(elements).frame.data;
    let slow = Fault::Delay { min: ms(400), max: ms(400) };
    let at_once = Timing::After { min: ms(5), max: ms(5) };
    vec![
        // Framing.
        ("frames", fault(once(Fault::BadChecksum))),
        ("no-noise", quirk_of_noise()),
        ("no-echo", fault(Rule::new(Fault::Echo))),
        ("own-station", fault(once(Fault::WrongStation))),
        ("own-command", fault(once(Fault::WrongCommand))),
        ("own-length", fault(once(Fault::Extended { by: 4 }))),
        ("digits", reply(Code::ReadRegisters, read(1, "R4167"), "0XYZ0")),
        ("error-alone", quirk(Quirk::DataWithErrors)),
        ("upper-case", quirk(Quirk::LowerCase)),
        // Commands.
        ("status-40", refused(Code::ReadStatus)),
        ("loop-back-4e", refused(Code::LoopBack)),
        ("registers-46", refused(Code::ReadRegisters)),
        ("discretes-44", refused(Code::ReadDiscretes)),
        ("disabled-43", fault(Rule::new(Fault::Ignore).command(Code::ReadDisabled))),
        ("mixed-48", refused(Code::ReadMixed)),
        ("detailed-53", refused(Code::ReadDetailedStatus)),
        ("page-4f", fault(Rule::new(Fault::Truncated { by: 2 }).command(Code::ReadProgramPage))),
        // Longest requests.
        ("longest-43", fault(longer(Code::ReadDisabled, 255, ErrorCode::IllegalValue))),
        ("longest-44", fault(Rule::new(Fault::Ignore).command(Code::ReadDiscretes).longer_than(128))),
        ("longest-46", reply(Code::ReadRegisters, read(64, "R0"), "2")),
        ("longest-46-dw", reply(Code::ReadRegisters, read(32, "DR0"), "2")),
        ("longest-48", reply(Code::ReadMixed, mixed_run("R", 64, 1), "4")),
        ("longest-48-dw", reply(Code::ReadMixed, mixed_run("DR", 32, 2), "4")),
        ("longest-48-m", reply(Code::ReadMixed, mixed_run("M", 64, 1), "4")),
        ("beyond-46", reply(Code::ReadRegisters, read(65, "R0"), &registers(65))),
        ("beyond-46-dw", reply(Code::ReadRegisters, read(33, "DR0"), "9")),
        ("beyond-48", quirk(Quirk::reply(0x48, mixed_run("R", 65, 1), None))),
        ("count-0", reply(Code::ReadRegisters, read(0, "R0"), "0")),
        ("loop-back-sizes", quirk(Quirk::reply(0x4E, loop_back_of(256), None))),
        // Wrong requests.
        ("bad-address", reply(Code::ReadRegisters, read(1, "R65535"), "2")),
        ("bad-symbol", reply(Code::ReadRegisters, read(1, "QQ0"), "A")),
        ("no-element", reply(Code::ReadRegisters, "01", "2")),
        ("bad-word", reply(Code::ReadRegisters, read(1, "WM4"), "00000")),
        ("unknown-command", quirk(Quirk::reply(0xFF, "", Some("9")))),
        ("bad-checksum", quirk(Quirk::AnswersBadChecksum)),
        ("other-station", quirk(Quirk::AnswersAnyStation)),
        ("broadcast", fault(Rule::new(answer_broadcast()))),
        // Values.
        ("words-x", no_words("X")),
        ("words-y", no_words("Y")),
        ("words-m", no_words("M")),
        ("words-s", no_words("S")),
        ("words-t", no_words("T")),
        ("words-c", no_words("C")),
        // Y9 is on: as the highest bit but one instead of the second one.
        ("bits-of-words", reply(Code::ReadRegisters, read(2, "WY8"), "040000000")),
        ("mixed-order", reply(Code::ReadMixed, mixed(&["M0", "R0", "DR2", "WM0"]), &format!("0{}", "1".repeat(17)))),
        // The words of DR0 = 24681234h exchanged.
        ("dword-order", reply(Code::ReadRegisters, read(1, "DR0"), "012342468")),
        ("rc-single", reply(Code::ReadRegisters, read(1, "RC199"), "A")),
        ("drc-single", reply(Code::ReadRegisters, read(1, "DRC255"), "A")),
        // As DRC200 and DRC202.
        ("drc-run", reply(Code::ReadRegisters, read(2, "DRC200"), "00001117000011172")),
        ("drc-mixed", reply(Code::ReadMixed, mixed(&["DRC200", "DRC201"]), "00001117000011172")),
        // Status.
        ("reserved-bit", reply(Code::ReadStatus, "", "0805400")),
        ("capacity-code", model(|model| model.program_capacity(0x77))),
        ("statuses-agree", reply(Code::ReadStatus, "", "0205400")),
        ("main-unit", model(|model| model.main_unit(7))),
        ("os-version", model(|model| model.os_version(3, 12))),
        ("detailed-length", fault(Rule::new(Fault::Truncated { by: 20 }).command(Code::ReadDetailedStatus))),
        ("model-counts", model(|model| model.m_relays(4000))),
        // Memory.
        ("end-x", last("X127")),
        ("end-y", last("Y271")),
        ("end-m", last("M1999")),
        ("end-s", last("S1023")),
        ("end-t", last("T199")),
        ("end-c", last("C127")),
        ("end-rt", last("RT511")),
        ("end-r", last("R8999")),
        ("end-d", last("D3999")),
        ("gap-r", reply(Code::ReadRegisters, read(1, "R4999"), "00000")),
        ("end-words", reply(Code::ReadRegisters, read(1, "WM1992"), "00000")),
        (
            "clock",
            Box::new(|rig| {
                *rig = Rig::with_plc(rig.framing, Plc::new());
                rig.plc.write(discrete!("M1954"), true).unwrap();
            }),
        ),
        ("clock-r4135", Box::new(|rig| rig.plc.write(register!("R4135"), 0x061F_u16).unwrap())),
        // Order and time.
        ("once", fault(once(Fault::Duplicate(at_once)))),
        ("answered", fault(once(Fault::DropReply))),
        ("in-time", fault(once(Fault::Delay { min: ms(1500), max: ms(1500) }))),
        (
            "without-pause",
            fault(
                Rule::new(Fault::Duplicate(at_once))
                    .command(Code::ReadRegisters)
                    .element(register!("R24"))
                    .skip(8)
                    .times(1),
            ),
        ),
        ("in-order", without_queue(Quirk::ReadsReversed)),
        ("echo-is-last", without_queue(Quirk::LoopBackFirst)),
        ("module-timeout", fault(Rule::new(slow).command(Code::ReadStatus).skip(2).times(1))),
        ("pause-in-frame", fault(once(Fault::Split { pieces: 2, pause: ms(150) }))),
        // Connections.
        ("stays-open", fault(once(Fault::Disconnect(DisconnectAt::AfterReply)))),
        ("several", fault(Rule::new(Fault::Refuse).skip(1))),
        ("idle", without_queue(Quirk::ClosesIdle(Duration::from_secs(45)))),
        // Writing.
        ("write-47", write(|rig| rig.faults.add_rule(protected(Code::WriteRegisters)))),
        ("write-49", write(|rig| rig.faults.add_rule(protected(Code::WriteMixed)))),
        (
            "write-45",
            write(|rig| {
                rig.element = "M100";
                rig.faults.add_rule(protected(Code::WriteDiscretes));
            }),
        ),
        (
            "control-42",
            write(|rig| {
                rig.element = "M100";
                rig.faults.add_rule(protected(Code::ControlDiscrete));
            }),
        ),
    ]
}

fn protected(code: Code) -> Rule {
    Rule::new(Fault::Error(ErrorCode::WriteProhibited)).command(code)
}

fn answer_broadcast() -> Fault {
    Fault::AnswerBroadcast { station: None, error: None, min: Duration::ZERO, max: Duration::ZERO }
}

/// Bytes before a reply that are no part of a frame.
fn quirk_of_noise() -> Contradiction {
    fault(once(Fault::GarbageBefore { max_len: 3 }))
}

/// A mixed read of elements in a row.
fn mixed_run(symbol: &str, n: usize, step: usize) -> Bytes {
    ASCII.mixed(&(0..n).map(|n| format!("{symbol}{}", n * step)).collect::<Vec<_>>()).frame.data
}

fn loop_back_of(len: usize) -> Bytes {
    (b' '..=b'~').cycle().take(len).collect()
}

#[tokio::test(start_paused = true)]
async fn each_contradiction_is_found_by_its_check_alone() {
    let mut wrong = Vec::new();
    for (name, contradict) in contradictions() {
        let mut rig = Rig::new(Framing::Ascii);
        contradict(&mut rig);
        let (findings, ended) = rig.run().await;
        if contradicted(&findings) != [name] || ended.is_err() {
            let finding = findings.iter().find(|(check, _)| check == name);
            wrong.push(format!("{name}: found {:?}, {ended:?}; {finding:?}", contradicted(&findings)));
        }
    }
    assert!(wrong.is_empty(), "{}:\n{}", wrong.len(), wrong.join("\n"));
}

/// The same checks find contradictions of the binary framing.
#[tokio::test(start_paused = true)]
async fn contradictions_are_found_in_the_binary_framing() {
    let no_register = data_of(Framing::Binary, Code::ReadRegisters, 1, "R65535");
    let beyond = Quirk::reply(Code::ReadRegisters.into(), no_register, Some("\u{2}"));
    let cases: Vec<(&str, Contradiction)> = vec![
        ("frames", fault(once(Fault::BadChecksum))),
        ("own-command", fault(once(Fault::WrongCommand))),
        ("longest-43", fault(longer(Code::ReadDisabled, 255, ErrorCode::IllegalValue))),
        ("bad-address", quirk(beyond)),
        ("bad-checksum", quirk(Quirk::AnswersBadChecksum)),
        ("capacity-code", model(|model| model.program_capacity(0x77))),
        ("write-47", write(|rig| rig.faults.add_rule(protected(Code::WriteRegisters)))),
    ];
    for (name, contradict) in cases {
        let mut rig = Rig::new(Framing::Binary);
        contradict(&mut rig);
        let findings = rig.examine().await;
        assert_eq!(contradicted(&findings), [name], "{findings:#?}");
    }
}

/// A check that nothing can contradict would examine nothing.
#[test]
fn each_check_has_a_contradiction() {
    let mut rig = Rig::new(Framing::Ascii);
    let mut all: BTreeSet<String> = rig.checks().into_iter().map(|check| check.name).collect();
    rig.element = "M0";
    all.extend(rig.checks().into_iter().map(|check| check.name));
    let played = contradictions().into_iter().map(|(name, _)| name).chain(OF_UDP);
    let played: BTreeSet<String> = played.map(str::to_owned).collect();
    assert_eq!(all.symmetric_difference(&played).collect::<Vec<_>>(), [""; 0]);
}
