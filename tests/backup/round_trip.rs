//! Round trips: a restore writes the elements of the backup and no others, without faults and under
//! seeded faults of every kind.
//!
//! `FATEK_BACKUP_SEEDS=200` sets the number of seeds, `FATEK_BACKUP_SEED=n` runs one.

use std::collections::HashSet;
use std::time::Duration;

use fatek::backup::{Backup, BackupError, Missing, Restore, RestoreOptions, TakeBackup};
use fatek::command::Code;
use fatek::sim::{DisconnectAt, Fault, Faults, Line, Rule};
use fatek::tag::Tag;
use fatek::wire::Framing;
use fatek::{Element, Error, Value};

use crate::bench::{Bench, FRAMINGS, Rng, base_elements, memory, random, tags};

/// Every width, adjacent and separate ranges, pairs from an odd address on, inputs and contacts.
const RANGES: [&str; 16] = [
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
    "DRC196-DRC198",
    "DRC200-DRC203",
    "X0-X19",
];
/// Inputs, which are not restored.
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

/// Takes a backup, resuming it until it is complete.
async fn take_backup(bench: &Bench, ranges: impl IntoIterator<Item = Tag>) -> Backup {
    let (mut taking, station) = (TakeBackup::new(ranges).unwrap(), bench.station());
    for _ in 0..1000 {
        let before = taking.partial().value_count();
        match taking.run(&station).await {
            Ok(backup) => return backup,
            Err(BackupError::Call { source: Error::Plc { .. } | Error::Invalid(_), .. }) => panic!("no such fault"),
            Err(error) => assert!(matches!(error, BackupError::Call { .. }), "{error}"),
        }
        assert!(taking.partial().value_count() >= before, "values are kept");
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    panic!("the backup does not complete");
}

/// Overwrites about one in `one_in` elements with random values.
fn overwrite_some(bench: &Bench, one_in: u64, rng: &mut Rng) {
    for element in memory() {
        if rng.below(one_in) == 0 {
            bench.plc.write(element, random(element, rng)).unwrap();
        }
    }
}

/// Checks that the restored elements are as `saved`, and all others as `before`.
fn check(
    bench: &Bench,
    saved: &[(Element, Value)],
    before: &[(Element, Value)],
    restored: &HashSet<Element>,
    note: &str,
) {
    for ((now, saved), before) in bench.snapshot().iter().zip(saved).zip(before) {
        let expected = if restored.contains(&now.0) { saved } else { before };
        assert_eq!(now, expected, "{note}");
    }
}

/// Runs one round trip; returns the number of injections of each fault.
async fn round_trip(seed: u64, framing: Framing, faulty: bool) -> Vec<u64> {
    let note = format!("FATEK_BACKUP_SEED={seed}, {framing}");
    let mut rng = Rng(seed);
    let bench = Bench::new(framing, if faulty { faults(seed) } else { Faults::new(seed) });
    bench.fill(&mut rng);
    let saved = bench.snapshot();
    let backup = take_backup(&bench, tags(RANGES)).await;
    assert!(backup.is_complete(), "{note}");
    for (element, value) in backup.elements() {
        assert_eq!(value, Ok(bench.plc.read(element)), "{element}, {note}");
    }
    let backup = Backup::from_file(backup.to_file().as_bytes()).unwrap();

    let one_in = 1 + rng.below(50);
    overwrite_some(&bench, one_in, &mut rng);
    let before = bench.snapshot();
    bench.clear_log();
    let options = RestoreOptions::new().bridge(if rng.below(2) == 0 { 0 } else { 5 });
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
        // A station that is offline needs a while.
        tokio::time::sleep(Duration::from_secs(1)).await;
    };
    let left_out: HashSet<_> = base_elements(&tags(LEFT_OUT)).into_iter().collect();
    let mut restored: HashSet<_> = base_elements(&tags(RANGES)).into_iter().collect();
    restored.retain(|element| !left_out.contains(element));
    check(&bench, &saved, &before, &restored, &note);
    assert_eq!(report.left_out, tags(LEFT_OUT), "{note}");
    assert!(report.remaining.is_empty() && report.unwritten.is_empty() && report.in_doubt.is_empty(), "{note}");
    // No element outside the backup was written, nor an equal one, unless to bridge a gap.
    let differed: HashSet<_> =
        before.iter().zip(&saved).filter(|(now, saved)| now != saved).map(|(now, _)| now.0).collect();
    for (first, count) in bench.writes() {
        let range: Tag = Tag::spanning(first, fatek::tag::TagType::default_for(first.width()), count).unwrap();
        let elements: Vec<_> = range.elements().map(|element| base_elements(&[element.into()])).collect();
        // One half of a 32-bit value may be equal.
        let is_pairs =
            tags(RANGES).iter().any(|of| of.elements_per_value() == 2 && of.elements().any(|has| has == first));
        let values: Vec<_> = elements.chunks(if is_pairs { 2 } else { 1 }).map(<[_]>::concat).collect();
        let differs = |base_elements: &Vec<Element>| base_elements.iter().any(|atom| differed.contains(atom));
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
async fn a_restore_changes_only_the_elements_of_the_backup() {
    for framing in FRAMINGS {
        round_trip(1, framing, false).await;
    }
}

#[tokio::test(start_paused = true)]
async fn a_restore_under_faults_changes_only_its_elements() {
    let mut fault_counts: Vec<u64> = Vec::new();
    for seed in seeds() {
        for framing in FRAMINGS {
            let more = round_trip(seed, framing, true).await;
            fault_counts.resize(more.len(), 0);
            fault_counts.iter_mut().zip(more).for_each(|(fault_counts, more)| *fault_counts += more);
        }
    }
    // A single seed may lack a fault.
    assert!(seeds().count() < 5 || fault_counts.iter().all(|&fault_counts| fault_counts > 0), "{fault_counts:?}");
}

#[tokio::test(start_paused = true)]
async fn nothing_is_written_when_nothing_differs() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        bench.fill(&mut Rng(1));
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
async fn runs_are_one_request_and_32_bit_values_stay_whole() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let station = bench.station();
        let backup = station.back_up(tags(["R1-R200:i32", "DR300-DR500", "M0-M599"])).await.unwrap();
        let requests = bench.faults.log().entries();
        // 64, 64, 64 and 8 registers; 32, 31, 32 and 6 pairs; 256, 255 and 89 discretes; the status
        // twice; the check of the new connection, and the one at the end.
        assert_eq!(requests.len(), 1 + 2 + 4 + 4 + 3 + 1);
        for address in (2..=200).chain(300..502) {
            bench.plc.write(fatek::Register::r(address), 7_u16).unwrap();
        }
        for address in [0, 1, 5, 598, 599] {
            bench.plc.write(fatek::Discrete::new(fatek::Symbol::M, address).unwrap(), true).unwrap();
        }
        bench.clear_log();
        station.restore(&backup, RestoreOptions::new()).await.unwrap();
        let written: Vec<_> = bench.writes().iter().map(|(first, count)| format!("{first} {count}")).collect();
        // Of the first value only the high word differs. It is written whole.
        let registers = ["R1 64", "R65 64", "R129 64", "R193 8", "DR300 32", "DR364 32", "DR428 32", "DR492 5"];
        assert_eq!(written, [&registers[..], &["M0 2", "M5 1", "M598 2"]].concat());
    }
}

#[tokio::test(start_paused = true)]
async fn equal_elements_are_bridged_only_on_request() {
    let bench = Bench::new(Framing::Ascii, Faults::new(1));
    let station = bench.station();
    let backup = station.back_up(tags(["R0-R9", "R11-R199"])).await.unwrap();
    let overwrite_some = || [3, 5, 9, 11, 30, 93, 95].map(|n| bench.plc.write(fatek::Register::r(n), 1_u16).unwrap());
    for (bridge, expected) in [
        (0, vec!["R3 1", "R5 1", "R9 1", "R11 1", "R30 1", "R93 1", "R95 1"]),
        (1, vec!["R3 3", "R9 1", "R11 1", "R30 1", "R93 3"]),
        // R10 is not in the backup, and R30 to R95 would exceed a request.
        (100, vec!["R3 7", "R11 20", "R93 3"]),
    ] {
        overwrite_some();
        bench.plc.write(fatek::Register::r(10), 99_u16).unwrap();
        bench.clear_log();
        let report = station.restore(&backup, RestoreOptions::new().bridge(bridge)).await.unwrap();
        let written: Vec<_> = bench.writes().iter().map(|(first, count)| format!("{first} {count}")).collect();
        assert_eq!(written, expected);
        assert_eq!((report.differences.len(), bench.plc.read(fatek::Register::r(10))), (7, 99_u16.into()));
    }
}

#[tokio::test(start_paused = true)]
async fn an_interrupted_backup_is_resumed() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        bench.fill(&mut Rng(3));
        // The PLC answers three reads, and then only the checks that confirm them.
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
        // Resume, perhaps in another process.
        let partial = Backup::from_file(partial.to_file().as_bytes()).unwrap();
        bench.faults.set_rules([]);
        bench.clear_log();
        let reports = std::sync::Arc::new(std::sync::Mutex::new(Vec::new()));
        let report_sink = reports.clone();
        let mut taking =
            TakeBackup::resume(partial).on_progress(move |progress| report_sink.lock().unwrap().push(*progress));
        let backup = taking.run(&bench.station()).await.unwrap();
        // The check of the new connection, the status, three requests and their check.
        assert_eq!(bench.faults.log().arrivals(), 2 + 3 + 1);
        assert_eq!((backup.is_complete(), backup.station()), (true, Some(1)));
        let reports: Vec<_> = reports
            .lock()
            .unwrap()
            .iter()
            .map(|reports| (reports.done, reports.total, reports.kept, reports.bytes))
            .collect();
        assert_eq!(reports, [(255, 310, 191, 128), (300, 310, 191, 218), (310, 310, 191, 220)]);
        for (element, value) in backup.elements() {
            assert_eq!(value, Ok(bench.plc.read(element)));
        }
    }
}
