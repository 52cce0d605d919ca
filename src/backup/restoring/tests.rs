//! The states of restoring against a PLC of a few lines: what is said of each element is what has become of it.
//!
//! `FATEK_RESTORING_SEEDS=100000` runs so many seeds, `FATEK_RESTORING_SEED=n` one.

use super::*;
use crate::backup::{Block, Origin};
use crate::element::Element;
use crate::tag::Tag;

/// A backup of these, in which all is 0.
fn backup(ranges: &[&str]) -> Backup {
    let block = |range: &&str| {
        let range: Tag = range.parse().unwrap();
        Block { range, cells: vec![Ok(Value::Word(0)); range.element_count()] }
    };
    Backup { origin: Origin::default(), blocks: ranges.iter().map(block).collect() }
}

fn lost() -> Error {
    Error::Closed { sent: true }
}

fn unsent() -> Error {
    Error::Closed { sent: false }
}

fn refused() -> Error {
    Error::Plc {
        station: 1,
        code: crate::command::Code::WriteRegisters,
        error: ErrorCode::IllegalValue,
        repeated: false,
    }
}

fn words(values: &[u16]) -> Result<Reply, Error> {
    Ok(Reply::Values(values.iter().copied().map(Value::Word).collect()))
}

fn names(ranges: &[Tag]) -> Vec<String> {
    ranges.iter().map(ToString::to_string).collect()
}

/// Restores 0 to such elements, which hold this, and goes as far as the first write.
fn until_write(range: &str, held: &[u16]) -> Restoring {
    let mut restoring = Restoring::new(&backup(&[range]), RestoreOptions::new());
    restoring.begin(Goal::Restore);
    assert_eq!(restoring.next().unwrap(), Step::Status);
    restoring.handle(Ok(Reply::Running(false))).unwrap();
    assert!(matches!(restoring.next().unwrap(), Step::Read(_)));
    restoring.handle(words(held)).unwrap();
    restoring
}

/// What is asked for next. What was read is confirmed.
fn next(restoring: &mut Restoring) -> Step {
    loop {
        match restoring.next().unwrap() {
            Step::Confirm => restoring.confirmed(Ok(None)).unwrap(),
            step => return step,
        }
    }
}

/// What is to be written next.
fn write(restoring: &mut Restoring) -> String {
    match next(restoring) {
        Step::Write(range, _) => range.to_string(),
        step => panic!("{step:?}"),
    }
}

/// The write just asked for is lost, and a read then finds this.
fn lose(restoring: &mut Restoring, found: &[u16]) {
    restoring.handle(Err(lost())).unwrap();
    assert!(matches!(restoring.next().unwrap(), Step::Read(_)));
    restoring.handle(words(found)).unwrap();
}

#[test]
fn half_a_value_that_a_lost_write_has_changed_is_not_said_to_be_unwritten() {
    let mut restoring = until_write("R0-R1:u32", &[7, 7]);
    assert_eq!(write(&mut restoring), "R0-R1");
    // Somebody has changed the second half since.
    lose(&mut restoring, &[0, 9]);
    // The value is written again, as a whole, and that is not even sent.
    assert_eq!(write(&mut restoring), "R0-R1");
    assert_eq!(names(&restoring.report().in_doubt), ["R0-R1"]);
    restoring.handle(Err(unsent())).unwrap_err();
    let report = restoring.report();
    assert_eq!((names(&report.written), names(&report.in_doubt)), (vec!["R0".to_owned()], vec!["R1".to_owned()]));
    assert_eq!(report.unwritten, []);
}

#[test]
fn of_several_elements_those_of_a_lost_write_are_told_from_those_never_sent() {
    let held = [[7_u16; 64], [7; 64]].concat();
    let mut restoring = Restoring::new(&backup(&["R0-R127"]), RestoreOptions::new());
    restoring.begin(Goal::Restore);
    restoring.handle(Ok(Reply::Running(false))).unwrap();
    for half in held.chunks(64) {
        assert!(matches!(restoring.next().unwrap(), Step::Read(_)));
        restoring.handle(words(half)).unwrap();
    }
    assert_eq!(write(&mut restoring), "R0-R63");
    let mut found = [0; 64];
    found[10..20].fill(7);
    lose(&mut restoring, &found);
    assert_eq!(write(&mut restoring), "R10-R19");
    restoring.handle(Err(unsent())).unwrap_err();
    let report = restoring.report();
    assert_eq!(names(&report.written), ["R0-R9", "R20-R63"]);
    assert_eq!((names(&report.in_doubt), names(&report.unwritten)), (vec!["R10-R19".into()], vec!["R64-R127".into()]));
    assert!(report.to_string().ends_with("128 differed, 54 written, 10 perhaps written, 64 not written"), "{report}");
}

#[test]
fn an_equal_half_that_was_not_sent_stays_what_it_was() {
    let mut restoring = until_write("R0-R3:u32", &[0, 7, 7, 7]);
    assert_eq!(write(&mut restoring), "R0-R3");
    restoring.handle(Err(refused())).unwrap();
    assert_eq!(write(&mut restoring), "R0-R1");
    restoring.handle(Err(unsent())).unwrap_err();
    let report = restoring.report();
    assert_eq!((report.written, report.in_doubt), (vec![], vec![]));
    assert_eq!(names(&report.unwritten), ["R1-R3"]);
}

/// `SplitMix64`.
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ self.0 >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ mixed >> 31) % limit
    }
}

/// What has become of an element, as whoever sends the requests knows it.
#[derive(Clone, Copy, Debug, Default)]
struct Fate {
    /// A write of it was sent, in this run.
    sent: bool,
    /// The last write of it that was sent was confirmed, or a read behind it has found what was to be written.
    shown: bool,
}

const RANGES: [&str; 3] = ["R0-R9", "R20-R29:u32", "R100-R230"];

/// A PLC whose program runs now and then, and whose line loses much. Gives how many elements were in doubt at the end of a run.
fn model(seed: u64) -> usize {
    let dice = &mut Dice(seed);
    let mut options = RestoreOptions::new().bridge(dice.below(4) as usize).attempts(1 + dice.below(4) as u32);
    options = match dice.below(3) {
        0 => options.stop_first().run_again(),
        1 => options.require_stopped(),
        _ => options,
    };
    let mut memory: Vec<u16> = (0..300).map(|_| dice.below(4).saturating_sub(2) as u16).collect();
    let (mut restoring, mut doubts, mut running) = (Restoring::new(&backup(&RANGES), options), 0, dice.below(2) == 0);
    let place = |element: Element| usize::from(element.address());
    for _ in 0..4 {
        let mut fates = vec![Fate::default(); memory.len()];
        restoring.begin(Goal::Restore);
        // What the PLC was last seen to be, since it was last told something.
        let mut seen: Option<bool> = None;
        // What reads have shown that are not confirmed yet, and the first of these.
        let (mut read, mut held) = (Vec::new(), None);
        let ended = loop {
            let step = match restoring.next() {
                Ok(Step::Done) => break Ok(()),
                Ok(step) => step,
                Err(failure) => break Err(failure),
            };
            let mark = restoring.mark();
            // A check finds that a duplicate came out of order.
            if let Some(mark) = held.filter(|_| matches!(step, Step::Read(_) | Step::Confirm) && dice.below(40) == 0) {
                if mark == State::Write || matches!(restoring.state, State::Verify | State::LastLook) {
                    fates.iter_mut().for_each(|fate| fate.shown = false);
                }
                (read, held) = (Vec::new(), None);
                restoring.rewind(mark);
                continue;
            }
            if step == Step::Confirm {
                let good = dice.below(20) > 0;
                if good {
                    read.drain(..).for_each(|at: usize| fates[at].shown = true);
                    held = None;
                }
                if let Err(failure) = restoring.confirmed(if good { Ok(None) } else { Err(lost()) }) {
                    break Err(failure);
                }
                continue;
            }
            // The future is dropped, and nobody knows whether that was sent.
            if dice.below(400) == 0 {
                if let Step::Write(range, _) = &step {
                    range.elements().for_each(|element| fates[place(element)] = Fate { sent: true, shown: false });
                }
                break Err(RestoreFailure::NotRunning);
            }
            if dice.below(30) == 0 {
                running = !running;
            }
            if running && dice.below(10) == 0 {
                memory[dice.below(300) as usize] = dice.below(3) as u16;
            }
            let (is_lost, is_done) = match dice.below(20) {
                0 => (Some(unsent()), false),
                1 => (Some(refused()), false),
                2 | 3 => (Some(lost()), true),
                4 => (Some(lost()), false),
                _ => (None, true),
            };
            let sent = is_lost.as_ref().is_none_or(Error::may_have_executed);
            let reply = match &step {
                Step::Status => {
                    seen = if is_lost.is_none() { Some(running) } else { seen };
                    Reply::Running(running)
                }
                Step::Stop | Step::Run => {
                    running = if is_done { step == Step::Run } else { running };
                    seen = if sent { None } else { seen };
                    Reply::Done
                }
                Step::Read(chunk) => {
                    let elements: Vec<_> = chunk.names().elements().map(place).collect();
                    if is_lost.is_none() {
                        held.get_or_insert(mark);
                        read.extend(elements.iter().filter(|&&at| fates[at].sent && memory[at] == 0));
                    }
                    Reply::Values(elements.iter().map(|&at| Value::Word(memory[at])).collect())
                }
                Step::Write(range, values) => {
                    assert!(values.iter().all(|&value| value == Value::Word(0)), "seed {seed}");
                    for at in range.elements().map(place) {
                        held.get_or_insert(mark);
                        if sent {
                            fates[at] = Fate { sent, shown: is_lost.is_none() };
                        }
                        if is_done {
                            memory[at] = 0;
                        }
                    }
                    Reply::Done
                }
                _ => Reply::Done,
            };
            if let Err(failure) = restoring.handle(is_lost.map_or(Ok(reply), Err)) {
                break Err(failure);
            }
        };
        let report = restoring.report();
        let each = |ranges: &[Tag], rule: &dyn Fn(Fate) -> bool, what: &str| {
            for element in ranges.iter().flat_map(Tag::elements) {
                assert!(rule(fates[place(element)]), "{element} is {what}, seed {seed}: {report}");
            }
        };
        each(&report.unwritten, &|fate| !fate.sent, "unwritten");
        each(&report.in_doubt, &|fate| fate.sent && !fate.shown, "in doubt");
        each(&report.written, &|fate| fate.shown, "written");
        match report.plc {
            PlcState::Running => assert_eq!(seen, Some(true), "seed {seed}: {report}"),
            PlcState::Stopped => assert_eq!(seen, Some(false), "seed {seed}: {report}"),
            PlcState::Unknown => {}
        }
        doubts += report.in_doubt.len();
        if ended.is_ok() {
            assert!(report.in_doubt.is_empty() && report.unwritten.is_empty(), "seed {seed}: {report}");
        }
    }
    doubts
}

#[test]
fn what_is_said_of_each_element_is_what_has_become_of_it() {
    let number = |name| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let seeds = match number("FATEK_RESTORING_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_RESTORING_SEEDS").unwrap_or(2000),
    };
    let many = seeds.end - seeds.start > 100;
    let doubts: usize = seeds.map(model).sum();
    assert!(!many || doubts > 100, "{doubts}");
}
