//! What was backed up is restored, and nothing else is changed: without faults, and under seeded faults of every kind.
//!
//! `FATEK_BACKUP_SEEDS=200` runs so many seeds, `FATEK_BACKUP_SEED=n` one.

use std::collections::HashSet;
use std::time::Duration;

use fatek::backup::{Backup, BackupError, Missing, Restore, RestoreOptions, TakeBackup};
use fatek::command::Code;
use fatek::sim::{DisconnectAt, Fault, Faults, Line, Rule};
use fatek::tag::Tag;
use fatek::wire::Framing;
use fatek::{Element, Error, Value};

use crate::bench::{Bench, Dice, FRAMINGS, atoms, memory, random, tags};

/// Every width, with and without neighbours, pairs from an odd address on, inputs and contacts too.
const RANGES: [&str; 14] = [
    "R0-R199",
    "R301-R500:f32",
    "DR1000-DR1198",
    "R3839",
    "D7-D9",
    "DD100-DD140",
    "F0-F100",
    "M0-M299",
    "WM320-WM640",
    "DWM1000-DWM1064",
    "Y8-Y40",
    "RT0-RT99",
    "DRC10-DRC20",
    "X0-X19",
];
/// The inputs among them are not restored.
const LEFT_OUT: [&str; 1] = ["X0-X19"];

fn faults(seed: u64) -> Faults {
    let ms = Duration::from_millis;
    let some = |fault: Fault, per_mille: u16| Rule::new(fault).per_mille(per_mille);
    Faults::new(seed)
        .rule(some(Fault::Ignore, 30))
        .rule(some(Fault::DropReply, 30))
        .rule(some(Fault::Delay { min: ms(65), max: ms(200) }, 30))
        .rule(some(Fault::Split { pieces: 3, pause: ms(4) }, 20))
        .rule(some(Fault::GarbageBefore { max_len: 40 }, 20))
        .rule(some(Fault::GarbageInside { max_len: 10 }, 20))
        .rule(some(Fault::WrongCommand, 10))
        .rule(some(Fault::Truncated { by: 1 }, 10))
        .rule(some(Fault::Extended { by: 4 }, 10))
        .rule(some(Fault::BadChecksum, 20))
        .rule(some(Fault::duplicate(), 20))
        .rule(some(Fault::Disconnect(DisconnectAt::BeforeExecution), 10))
        .rule(some(Fault::Disconnect(DisconnectAt::BeforeReply), 10))
        .rule(some(Fault::Disconnect(DisconnectAt::WithinReply), 10))
        .rule(some(Fault::Refuse, 200))
        .line(Line::new(115_200).response_time(ms(1), ms(5)))
}

/// Reads a backup, again and again until it is there.
async fn take(bench: &Bench, ranges: impl IntoIterator<Item = Tag>) -> Backup {
    let (mut taking, station) = (TakeBackup::new(ranges).unwrap(), bench.station());
    for _ in 0..1000 {
        let before = taking.partial().value_count();
        match taking.run(&station).await {
            Ok(backup) => return backup,
            Err(BackupError::Call { source: Error::Plc { .. } | Error::Invalid(_), .. }) => panic!("no such fault"),
            Err(error) => assert!(matches!(error, BackupError::Call { .. }), "{error}"),
        }
        assert!(taking.partial().value_count() >= before, "what was read is kept");
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    panic!("it does not come to an end");
}

/// Puts other values into memory: into about one element of `one_in`.
fn disturb(bench: &Bench, one_in: u64, dice: &mut Dice) {
    for element in memory() {
        if dice.below(one_in) == 0 {
            bench.plc.write(element, random(element, dice)).unwrap();
        }
    }
}

/// That memory is as before, and those elements as then.
fn check(
    bench: &Bench,
    then: &[(Element, Value)],
    before: &[(Element, Value)],
    restored: &HashSet<Element>,
    note: &str,
) {
    for ((now, then), before) in bench.snapshot().iter().zip(then).zip(before) {
        let expected = if restored.contains(&now.0) { then } else { before };
        assert_eq!(now, expected, "{note}");
    }
}

/// Gives how often each fault has struck.
async fn round_trip(seed: u64, framing: Framing, faulty: bool) -> Vec<u64> {
    let note = format!("FATEK_BACKUP_SEED={seed}, {framing}");
    let mut dice = Dice(seed);
    let bench = Bench::new(framing, if faulty { faults(seed) } else { Faults::new(seed) });
    bench.fill(&mut dice);
    let then = bench.snapshot();
    let backup = take(&bench, tags(RANGES)).await;
    assert!(backup.is_complete(), "{note}");
    for (element, value) in backup.elements() {
        assert_eq!(value, Ok(bench.plc.read(element)), "{element}, {note}");
    }
    let backup = Backup::from_file(backup.to_file().as_bytes()).unwrap();

    let one_in = 1 + dice.below(50);
    disturb(&bench, one_in, &mut dice);
    let before = bench.snapshot();
    bench.clear_log();
    let options = RestoreOptions::new().bridge(if dice.below(2) == 0 { 0 } else { 5 });
    let (mut restore, station) = (Restore::new(&backup, options), bench.station());
    let mut runs = 0;
    let report = loop {
        match restore.run(&station).await {
            Ok(report) => break report,
            Err(error) => {
                assert!(error.source.to_string().contains(": "), "{error}, {note}");
                for range in &error.report.written {
                    for element in range.elements() {
                        assert_eq!(Some(Ok(bench.plc.read(element))), backup.value(element), "{element}, {note}");
                    }
                }
            }
        }
        runs += 1;
        assert!(runs < 1000, "{note}");
        // A station that was given up is not asked again at once.
        tokio::time::sleep(Duration::from_secs(1)).await;
    };
    let left_out: HashSet<_> = atoms(&tags(LEFT_OUT)).into_iter().collect();
    let mut restored: HashSet<_> = atoms(&tags(RANGES)).into_iter().collect();
    restored.retain(|element| !left_out.contains(element));
    check(&bench, &then, &before, &restored, &note);
    assert_eq!(report.left_out, tags(LEFT_OUT), "{note}");
    assert!(report.remaining.is_empty() && report.unwritten.is_empty() && report.in_doubt.is_empty(), "{note}");
    // Nothing that is not part of the backup was ever written, nor an element that was right, unless to bridge a gap.
    let differed: HashSet<_> =
        before.iter().zip(&then).filter(|(now, then)| now != then).map(|(now, _)| now.0).collect();
    for (first, count) in bench.writes() {
        let range: Tag = Tag::spanning(first, fatek::tag::TagType::default_for(first.width()), count).unwrap();
        let elements: Vec<_> = range.elements().map(|element| atoms(&[element.into()])).collect();
        // Of the values of two registers, one may be right.
        let is_pairs =
            tags(RANGES).iter().any(|of| of.elements_per_value() == 2 && of.elements().any(|has| has == first));
        let values: Vec<_> = elements.chunks(if is_pairs { 2 } else { 1 }).map(<[_]>::concat).collect();
        let differs = |atoms: &Vec<Element>| atoms.iter().any(|atom| differed.contains(atom));
        assert!(elements.iter().flatten().all(|atom| restored.contains(atom)), "{range}, {note}");
        assert!(differs(&values[0]) && differs(&values[values.len() - 1]), "{range}, {note}");
        assert!(options != RestoreOptions::new() || values.iter().all(differs), "{range}, {note}");
    }
    bench.faults.rules().iter().map(Rule::times_applied).collect()
}

fn seeds() -> std::ops::Range<u64> {
    let number = |name| std::env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    match number("FATEK_BACKUP_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_BACKUP_SEEDS").unwrap_or(5),
    }
}

#[tokio::test(start_paused = true)]
async fn all_is_restored_and_nothing_else_is_changed() {
    for framing in FRAMINGS {
        round_trip(1, framing, false).await;
    }
}

#[tokio::test(start_paused = true)]
async fn all_is_restored_and_nothing_else_is_changed_under_faults_of_every_kind() {
    let mut struck: Vec<u64> = Vec::new();
    for seed in seeds() {
        for framing in FRAMINGS {
            let more = round_trip(seed, framing, true).await;
            struck.resize(more.len(), 0);
            struck.iter_mut().zip(more).for_each(|(struck, more)| *struck += more);
        }
    }
    // One seed alone may lack one.
    assert!(seeds().count() < 5 || struck.iter().all(|&struck| struck > 0), "{struck:?}");
}

#[tokio::test(start_paused = true)]
async fn nothing_is_written_when_nothing_differs() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        bench.fill(&mut Dice(1));
        let station = bench.station();
        let backup = station.back_up(tags(RANGES)).await.unwrap();
        bench.plc.run();
        bench.clear_log();
        let report = station.restore(&backup, RestoreOptions::new()).await.unwrap();
        assert_eq!((bench.faults.log().writes(), bench.writes()), (0, vec![]));
        assert_eq!(report.compared, backup.element_count() - 20);
        // Each element was read once: there was nothing to verify.
        let arrivals = bench.faults.log().arrivals();
        bench.clear_log();
        assert_eq!(Restore::new(&backup, RestoreOptions::new()).compare(&station).await.unwrap().differences, []);
        assert_eq!(bench.faults.log().arrivals(), arrivals, "the inputs are read, and not the status");
    }
}

#[tokio::test(start_paused = true)]
async fn runs_of_differences_are_one_request_and_values_of_32_bits_are_never_split() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let station = bench.station();
        let backup = station.back_up(tags(["R1-R200:i32", "DR300-DR500", "M0-M599"])).await.unwrap();
        let asked = bench.faults.log().entries();
        // 64, 64, 64 and 8 registers; 32, 31, 32 and 6 pairs; 256, 255 and 89 discretes; the status twice; the check of the new
        // connection, and the one at the end.
        assert_eq!(asked.len(), 1 + 2 + 4 + 4 + 3 + 1);
        for address in (2..=200).chain(300..502) {
            bench.plc.write(fatek::Register::r(address), 7_u16).unwrap();
        }
        for address in [0, 1, 5, 598, 599] {
            bench.plc.write(fatek::Discrete::new(fatek::Symbol::M, address).unwrap(), true).unwrap();
        }
        bench.clear_log();
        station.restore(&backup, RestoreOptions::new()).await.unwrap();
        let written: Vec<_> = bench.writes().iter().map(|(first, count)| format!("{first} {count}")).collect();
        // Of the first value only the high word differs; it is written as a whole.
        let registers = ["R1 64", "R65 64", "R129 64", "R193 8", "DR300 32", "DR364 32", "DR428 32", "DR492 5"];
        assert_eq!(written, [&registers[..], &["M0 2", "M5 1", "M598 2"]].concat());
    }
}

#[tokio::test(start_paused = true)]
async fn equal_elements_between_are_written_only_by_choice() {
    let bench = Bench::new(Framing::Ascii, Faults::new(1));
    let station = bench.station();
    let backup = station.back_up(tags(["R0-R9", "R11-R199"])).await.unwrap();
    let disturb = || [3, 5, 9, 11, 30, 93, 95].map(|n| bench.plc.write(fatek::Register::r(n), 1_u16).unwrap());
    for (bridge, expected) in [
        (0, vec!["R3 1", "R5 1", "R9 1", "R11 1", "R30 1", "R93 1", "R95 1"]),
        (1, vec!["R3 3", "R9 1", "R11 1", "R30 1", "R93 3"]),
        // R10 is not in the backup, and R30 to R95 would be more than a request takes.
        (100, vec!["R3 7", "R11 20", "R93 3"]),
    ] {
        disturb();
        bench.plc.write(fatek::Register::r(10), 99_u16).unwrap();
        bench.clear_log();
        let report = station.restore(&backup, RestoreOptions::new().bridge(bridge)).await.unwrap();
        let written: Vec<_> = bench.writes().iter().map(|(first, count)| format!("{first} {count}")).collect();
        assert_eq!(written, expected);
        assert_eq!((report.differences.len(), bench.plc.read(fatek::Register::r(10))), (7, 99_u16.into()));
    }
}

#[tokio::test(start_paused = true)]
async fn a_backup_that_was_broken_off_goes_on_where_it_was() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        bench.fill(&mut Dice(3));
        // The PLC answers three requests, and from then on nothing but checks, which confirm what it has answered.
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::ReadRegisters).skip(3)]);
        let error = bench.station().back_up(tags(["R0-R299", "M0-M9"])).await.unwrap_err();
        let BackupError::Call { partial, source, .. } = error else { panic!("{error}") };
        assert!(matches!(source, Error::Timeout { .. }), "{source}");
        assert_eq!(
            (partial.value_count(), partial.element_count()),
            (191, 310),
            "64, 63 and 64: replies to equal requests would be of one shape"
        );
        let missing: Vec<_> = partial.missing().iter().map(|missing| (missing.range, missing.reason)).collect();
        assert_eq!(missing, tags(["R191-R299", "M0-M9"]).map(|range| (range, Missing::NotRead)));
        // In another process, perhaps.
        let partial = Backup::from_file(partial.to_file().as_bytes()).unwrap();
        bench.faults.set_rules([]);
        bench.clear_log();
        let told = std::sync::Arc::new(std::sync::Mutex::new(Vec::new()));
        let tell = told.clone();
        let mut taking = TakeBackup::resume(partial).on_progress(move |progress| tell.lock().unwrap().push(*progress));
        let backup = taking.run(&bench.station()).await.unwrap();
        // The check of the new connection, the status, three requests and their check.
        assert_eq!(bench.faults.log().arrivals(), 2 + 3 + 1);
        assert_eq!((backup.is_complete(), backup.station()), (true, Some(1)));
        let told: Vec<_> =
            told.lock().unwrap().iter().map(|told| (told.done, told.total, told.kept, told.bytes)).collect();
        assert_eq!(told, [(255, 310, 191, 128), (300, 310, 191, 218), (310, 310, 191, 220)]);
        for (element, value) in backup.elements() {
            assert_eq!(value, Ok(bench.plc.read(element)));
        }
    }
}
