//! Restoring against a model of a PLC: the report of each element must be true.
//!
//! `FATEK_RESTORING_SEEDS=100000` runs 100000 seeds, `FATEK_RESTORING_SEED=n` one.

use super::*;
use crate::backup::Block;
use crate::command::BriefStatus;
use crate::element::Element;
use crate::file::Origin;
use crate::random::Random;
use crate::tag::Tag;
use crate::transfer::PlcState;

/// A backup of these ranges with the value 0 everywhere.
fn backup(ranges: &[&str]) -> Backup {
    let block = |range: &&str| {
        let range: Tag = range.parse().unwrap();
        Block { range, cells: vec![Ok(Value::Word(0)); range.element_count()] }
    };
    Backup {
        station: None,
        origin: Origin::default(),
        blocks: ranges.iter().map(block).collect(),
        unknown_fields: Vec::new(),
    }
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

/// The reply to 40.
fn status(running: bool) -> Reply {
    Reply::Status(BriefStatus::from_raw([running.into(), 0, 0]))
}

fn names(ranges: &[Tag]) -> Vec<String> {
    ranges.iter().map(ToString::to_string).collect()
}

/// Restores 0 to elements that hold these values, up to the first write.
fn until_write(range: &str, held: &[u16]) -> Restoring {
    let mut restoring = Restoring::new(&backup(&[range]), RestoreOptions::new());
    restoring.begin(RestoreGoal::Restore, RequestLengths::PROTOCOL);
    assert_eq!(next(&mut restoring), Request::Status);
    restoring.handle(Ok(status(false))).unwrap();
    assert!(matches!(next(&mut restoring), Request::Read { .. }));
    restoring.handle(words(held)).unwrap();
    restoring
}

/// The next request, after all checks.
fn next(restoring: &mut Restoring) -> Request {
    loop {
        match restoring.next().unwrap() {
            Step::Confirm => restoring.confirmed(Ok(())).unwrap(),
            Step::Send(request) => return request,
            Step::Done => panic!("there is no further request"),
        }
    }
}

/// The range of the next request, a write.
fn write(restoring: &mut Restoring) -> String {
    match next(restoring) {
        Request::Write(range, _) => range.to_string(),
        request => panic!("{request:?}"),
    }
}

/// The last write is lost, and a read then finds these values.
fn lose(restoring: &mut Restoring, found: &[u16]) {
    restoring.handle(Err(lost())).unwrap();
    assert!(matches!(next(restoring), Request::Read { .. }));
    restoring.handle(words(found)).unwrap();
}

#[test]
fn half_a_value_of_a_lost_write_is_not_unwritten() {
    let mut restoring = until_write("R0-R1:u32", &[7, 7]);
    assert_eq!(write(&mut restoring), "R0-R1");
    // Another client has changed the second half since.
    lose(&mut restoring, &[0, 9]);
    // The whole value is written again, and that is not sent.
    assert_eq!(write(&mut restoring), "R0-R1");
    assert_eq!(names(&restoring.report().in_doubt), ["R0-R1"]);
    restoring.handle(Err(unsent())).unwrap_err();
    let report = restoring.report();
    assert_eq!((names(&report.written), names(&report.in_doubt)), (vec!["R0".to_owned()], vec!["R1".to_owned()]));
    assert_eq!(report.unwritten, []);
}

#[test]
fn elements_of_a_lost_write_differ_from_those_never_sent() {
    let held = [[7_u16; 64], [7; 64]].concat();
    let mut restoring = Restoring::new(&backup(&["R0-R127"]), RestoreOptions::new());
    restoring.begin(RestoreGoal::Restore, RequestLengths::PROTOCOL);
    restoring.handle(Ok(status(false))).unwrap();
    for half in held.chunks(64) {
        assert!(matches!(next(&mut restoring), Request::Read { .. }));
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
fn an_equal_half_that_was_not_sent_stays_equal() {
    let mut restoring = until_write("R0-R3:u32", &[0, 7, 7, 7]);
    assert_eq!(write(&mut restoring), "R0-R3");
    restoring.handle(Err(refused())).unwrap();
    assert_eq!(write(&mut restoring), "R0-R1");
    restoring.handle(Err(unsent())).unwrap_err();
    let report = restoring.report();
    assert_eq!((report.written, report.in_doubt), (vec![], vec![]));
    assert_eq!(names(&report.unwritten), ["R1-R3"]);
}

/// Random choices.
struct Choices(Random);

impl Choices {
    fn below(&mut self, limit: u64) -> u64 {
        self.0.next() % limit
    }
}

/// The fate of an element, as far as the client can know it.
#[derive(Clone, Copy, Debug, Default)]
struct Fate {
    /// A write of it was sent, in this run.
    sent: bool,
    /// The last write that was sent was confirmed, or a later read has found its value.
    shown: bool,
}

const RANGES: [&str; 3] = ["R0-R9", "R20-R29:u32", "R100-R230"];

/// A PLC whose program runs now and then, and whose line loses requests and replies. Returns the
/// number of elements that were in doubt at the ends of runs.
fn model(seed: u64) -> usize {
    let dice = &mut Choices(Random::new(seed));
    let mut options = RestoreOptions::new().bridge(dice.below(4) as usize).attempts(1 + dice.below(4) as u32);
    options = match dice.below(3) {
        0 => options.stop_first(true).run_again(true),
        1 => options.require_stopped(true),
        _ => options,
    };
    let mut memory: Vec<u16> = (0..300).map(|_| dice.below(4).saturating_sub(2) as u16).collect();
    let (mut restoring, mut doubts, mut running) = (Restoring::new(&backup(&RANGES), options), 0, dice.below(2) == 0);
    let place = |element: Element| usize::from(element.address());
    for _ in 0..4 {
        let mut fates = vec![Fate::default(); memory.len()];
        restoring.begin(RestoreGoal::Restore, RequestLengths::PROTOCOL);
        // The last status since STOP or RUN was sent.
        let mut seen: Option<bool> = None;
        // Elements that unconfirmed reads have shown, and the mark of the first of these reads.
        let (mut read, mut held) = (Vec::new(), None);
        let ended = loop {
            let request = match restoring.next() {
                Ok(Step::Done) => break Ok(()),
                Ok(Step::Send(request)) => Some(request),
                Ok(Step::Confirm) => None,
                Err(failure) => break Err(failure),
            };
            let mark = restoring.mark();
            // A check finds an out-of-order duplicate.
            let shows = matches!(request, Some(Request::Read { .. }) | None);
            if let Some(mark) = held.filter(|_| shows && dice.below(40) == 0) {
                if mark == RestoreStage::Elements(Write)
                    || matches!(restoring.stage, RestoreStage::Elements(Verify) | RestoreStage::Control(LastLook))
                {
                    fates.iter_mut().for_each(|fate| fate.shown = false);
                }
                (read, held) = (Vec::new(), None);
                restoring.rewind(mark);
                continue;
            }
            let Some(request) = request else {
                let good = dice.below(20) > 0;
                if good {
                    read.drain(..).for_each(|at: usize| fates[at].shown = true);
                    held = None;
                }
                if let Err(failure) = restoring.confirmed(if good { Ok(()) } else { Err(lost()) }) {
                    break Err(failure);
                }
                continue;
            };
            // The future is dropped: the request may have been sent.
            if dice.below(400) == 0 {
                if let Request::Write(range, _) = &request {
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
            let reply = match &request {
                Request::Status => {
                    seen = if is_lost.is_none() { Some(running) } else { seen };
                    status(running)
                }
                Request::Stop | Request::Run => {
                    running = if is_done { request == Request::Run } else { running };
                    seen = if sent { None } else { seen };
                    Reply::Done
                }
                Request::Read { range, .. } => {
                    let elements: Vec<_> = range.elements().map(place).collect();
                    if is_lost.is_none() {
                        held.get_or_insert(mark);
                        read.extend(elements.iter().filter(|&&at| fates[at].sent && memory[at] == 0));
                    }
                    Reply::Values(elements.iter().map(|&at| Value::Word(memory[at])).collect())
                }
                Request::Write(range, values) => {
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
                Request::Pause => Reply::Done,
                request => unreachable!("{request:?}"),
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
fn the_report_of_each_element_is_true() {
    let number = |name| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    let seeds = match number("FATEK_RESTORING_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_RESTORING_SEEDS").unwrap_or(2000),
    };
    let many = seeds.end - seeds.start > 100;
    let doubts: usize = seeds.map(model).sum();
    assert!(!many || doubts > 100, "{doubts}");
}

#[test]
fn elements_are_in_doubt_after_too_many_duplicates() {
    let mut restoring = until_write("R0-R3", &[7, 7, 0, 7]);
    assert_eq!(write(&mut restoring), "R0-R1");
    restoring.handle(Ok(Reply::Done)).unwrap();
    assert_eq!(write(&mut restoring), "R3");
    let mark = restoring.mark();
    assert_eq!(names(&restoring.report().written), ["R0-R1"]);
    restoring.distrust(mark);
    let duplicates = Error::Duplicates { station: 1, sent: true };
    restoring.handle(Err(duplicates)).unwrap();
    let report = restoring.report();
    assert_eq!((report.written, names(&report.in_doubt)), (vec![], vec!["R0-R1".to_owned(), "R3".to_owned()]));
}

#[cfg(feature = "sim")]
#[test]
fn restoring_keeps_the_contract_of_a_transfer() {
    use crate::sim::Plc;
    use crate::transfer::contract::{self, End};

    for seed in 0..300 {
        let mut random = Random::new(seed);
        let (plc, backup) = (Plc::new(), backup(&RANGES));
        for element in backup.ranges().flat_map(|range| range.elements().collect::<Vec<_>>()) {
            plc.write(element, Value::Word(u16::from(random.next().is_multiple_of(3)))).unwrap();
        }
        let ran = random.next().is_multiple_of(2);
        if ran {
            plc.run();
        }
        let mut options = RestoreOptions::new().bridge(random.next() as usize % 4);
        if random.next().is_multiple_of(2) {
            options = options.stop_first(true).run_again(true);
        }
        let mut restoring = Restoring::new(&backup, options);
        for run in 0.. {
            assert!(run < 300, "seed {seed}: it does not end");
            restoring.begin(RestoreGoal::Restore, RequestLengths::PROTOCOL);
            if let End::Done = contract::run(&mut restoring, &plc, &mut random, 10) {
                break;
            }
        }
        for element in backup.ranges().flat_map(|range| range.elements().collect::<Vec<_>>()) {
            assert_eq!(plc.read(element), Value::Word(0), "seed {seed}: {element}");
        }
        assert_eq!(plc.is_running(), ran, "seed {seed}: {}", restoring.report());
    }
}
