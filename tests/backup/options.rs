//! Options of a restore: running PLCs, programs that overwrite values, and forced discretes.

use std::time::Duration;

use fatek::backup::{Backup, Restore, RestoreFailure, RestoreOptions, SpecialElements};
use fatek::command::Code;
use fatek::program::PlcState;
use fatek::sim::{Fault, Faults, Rule};
use fatek::tag::Tag;
use fatek::{CallOptions, ErrorCode, Value, discrete, element, register};

use crate::bench::{Bench, FRAMINGS, Rng, model, tags};

/// Creates a backup of these ranges, and a running PLC with other values.
async fn prepare<const N: usize>(bench: &Bench, ranges: [&str; N]) -> Backup {
    let backup = bench.station().back_up(tags(ranges)).await.unwrap();
    bench.fill(&mut Rng(4));
    bench.plc.run();
    bench.clear_log();
    backup
}

#[tokio::test(start_paused = true)]
async fn a_plc_is_stopped_and_run_again_only_on_request() {
    for framing in FRAMINGS {
        for (options, runs, was_stopped) in [
            (RestoreOptions::new(), true, false),
            (RestoreOptions::new().run_again(true), true, false),
            (RestoreOptions::new().stop_first(true), false, true),
            (RestoreOptions::new().stop_first(true).run_again(true), true, true),
        ] {
            let bench = Bench::new(framing, Faults::new(1));
            let backup = prepare(&bench, ["R0-R9"]).await;
            let report = bench.station().restore(&backup, options).await.unwrap();
            assert_eq!((bench.plc.is_running(), report.was_stopped), (runs, was_stopped), "{options:?}");
            assert_eq!(report.plc, if runs { PlcState::Running } else { PlcState::Stopped });
            // A stopped PLC stays stopped and gets no command.
            bench.plc.stop();
            bench.plc.write(element!("R0"), 7_u16).unwrap();
            let report = bench.station().restore(&backup, options).await.unwrap();
            assert_eq!((bench.plc.is_running(), report.was_stopped), (false, false), "{options:?}");
        }
        let bench = Bench::new(framing, Faults::new(1));
        let backup = prepare(&bench, ["R0-R9"]).await;
        let error = bench.station().restore(&backup, RestoreOptions::new().require_stopped(true)).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::Running), "{error}");
        assert_eq!((bench.plc.is_running(), bench.faults.log().writes()), (true, 0));
        bench.plc.stop();
        bench.station().restore(&backup, RestoreOptions::new().require_stopped(true)).await.unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_stopped_by_another_user_is_not_run_again() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let (backup, station) = (prepare(&bench, ["R0-R9"]).await, bench.station());
        let mut restore = Restore::new(&backup, RestoreOptions::new().stop_first(true).run_again(true));
        restore.run(&station).await.unwrap();
        assert!(bench.plc.is_running());
        bench.plc.stop();
        bench.plc.write(element!("R0"), 7_u16).unwrap();
        assert!(!restore.compare(&station).await.unwrap().was_stopped);
        let report = restore.run(&station).await.unwrap();
        assert_eq!((bench.plc.is_running(), report.was_stopped), (false, false), "{report}");

        // This restore fails while the PLC is stopped. A comparison meanwhile does not lose that.
        bench.plc.run();
        bench.plc.write(element!("R0"), 7_u16).unwrap();
        let ignore = Rule::new(Fault::Ignore);
        bench.faults.set_rules([ignore.clone().command(Code::WriteRegisters)]);
        assert!(restore.run(&station).await.unwrap_err().report.was_stopped && !bench.plc.is_running());
        bench.faults.set_rules([]);
        restore.compare(&station).await.unwrap();
        restore.run(&station).await.unwrap();
        assert!(bench.plc.is_running());

        // Another user runs the PLC after such a failure, and stops it after the next one.
        bench.plc.write(element!("R0"), 7_u16).unwrap();
        bench.faults.set_rules([ignore.clone().command(Code::WriteRegisters)]);
        restore.run(&station).await.unwrap_err();
        bench.plc.run();
        bench.faults.set_rules([ignore.command(Code::ReadRegisters)]);
        restore.run(&station).await.unwrap_err();
        bench.plc.stop();
        bench.faults.set_rules([]);
        restore.run(&station).await.unwrap();
        assert!(!bench.plc.is_running());
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_is_not_stopped_without_need() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let station = bench.station();
        let options = RestoreOptions::new().stop_first(true).run_again(true);
        let stops = || {
            let log = bench.faults.log().entries();
            log.iter().filter(|entry| entry.request().is_some_and(|request| request.code() == Code::ControlPlc)).count()
        };
        // All elements are equal or forced.
        let backup = station.back_up(tags(["R0-R9", "M0-M9"])).await.unwrap();
        bench.plc.run();
        let report = station.restore(&backup, options).await.unwrap();
        assert_eq!((stops(), report.was_stopped, report.plc), (0, false, PlcState::Running));
        station.disable(discrete!("M3")).await.unwrap();
        station.set(discrete!("M3")).await.unwrap();
        let report = station.restore(&backup, options).await.unwrap();
        assert_eq!((stops(), report.was_stopped, report.forced), (0, false, tags(["M3"]).to_vec()));
        // The PLC lacks some elements.
        let larger = Bench::with_model(framing, Faults::new(1), fatek::sim::Model::largest());
        let more = larger.station().back_up(tags(["F90-F150"])).await.unwrap();
        let error = station.restore(&more, options).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::NotThere { .. }), "{error}");
        assert_eq!((stops(), bench.plc.is_running()), (0, true), "{error}");
    }
}

#[tokio::test(start_paused = true)]
async fn elements_are_compared_again_after_the_stop() {
    let bench = Bench::new(FRAMINGS[0], Faults::new(1));
    let backup = bench.station().back_up(tags(["R0-R99"])).await.unwrap();
    bench.plc.write(element!("R3"), 1_u16).unwrap();
    bench.plc.run();
    let (plc, reports) = (bench.plc.clone(), std::sync::Arc::new(std::sync::Mutex::new(Vec::new())));
    let report_sink = reports.clone();
    let mut restore = Restore::new(&backup, RestoreOptions::new().stop_first(true)).on_progress(move |progress| {
        let mut reports = report_sink.lock().unwrap();
        reports.push((progress.phase.to_string(), progress.done, progress.bytes));
        if reports.len() == 2 {
            plc.write(element!("R3"), 0_u16).unwrap();
            plc.write(element!("R70"), 1_u16).unwrap();
        }
    });
    let report = restore.run(&bench.station()).await.unwrap();
    assert_eq!((report.written, report.plc), (tags(["R70"]).to_vec(), PlcState::Stopped));
    let reports = reports.lock().unwrap();
    let compared: Vec<_> =
        reports.iter().filter(|reports| reports.0 == "comparing").map(|reports| (reports.1, reports.2)).collect();
    assert_eq!(compared, [(64, 128), (100, 200), (64, 128), (100, 200)]);
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_stop_is_confirmed_by_the_status() {
    for framing in FRAMINGS {
        for fault in [Fault::DropReply, Fault::Ignore] {
            let bench = Bench::new(framing, Faults::new(1));
            let backup = prepare(&bench, ["R0-R9"]).await;
            bench.faults.set_rules([Rule::new(fault.clone()).command(Code::ControlPlc).times(1)]);
            let report = bench.station().restore(&backup, RestoreOptions::new().stop_first(true)).await.unwrap();
            assert_eq!((bench.plc.is_running(), report.plc), (false, PlcState::Stopped), "{fault:?}");
        }
        // A PLC that never stops: the command does not arrive.
        let bench = Bench::new(framing, Faults::new(1));
        let backup = prepare(&bench, ["R0-R9"]).await;
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::ControlPlc)]);
        let error = bench.station().restore(&backup, RestoreOptions::new().stop_first(true)).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::StillRunning), "{error}");
        assert_eq!((bench.faults.log().writes(), error.report.plc), (0, PlcState::Running));
        assert!(!error.report.was_stopped, "{error}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_to_run_is_restored_completely() {
    let bench = Bench::new(FRAMINGS[0], Faults::new(1));
    let backup = prepare(&bench, ["R0-R9"]).await;
    bench.plc.refuse_run(Some(ErrorCode::LadderChecksum));
    let mut restore = Restore::new(&backup, RestoreOptions::new().stop_first(true).run_again(true));
    let error = restore.run(&bench.station()).await.unwrap_err();
    assert!(matches!(error.source, RestoreFailure::Call { .. }), "{error}");
    assert!(error.to_string().ends_with("10 written; it was stopped, and the PLC is stopped"), "{error}");
    bench.plc.refuse_run(None);
    let report = restore.run(&bench.station()).await.unwrap();
    assert!(bench.plc.is_running() && report.written.is_empty());
}

#[tokio::test(start_paused = true)]
async fn elements_overwritten_by_the_program_are_reported() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let backup = prepare(&bench, ["R0-R199", "M0-M9"]).await;
        let plc = bench.plc.clone();
        let program = tokio::spawn(async move {
            for cycle in 1_u16.. {
                plc.write(register!("R70"), 1000 + cycle).unwrap();
                plc.write(discrete!("M3"), true).unwrap();
                tokio::task::yield_now().await;
            }
        });
        let station = bench.station();
        let error = station.restore(&backup, RestoreOptions::new()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::Differs { count: 2, .. }), "{error}");
        let remaining = error.report.remaining;
        assert_eq!([remaining[0].element, remaining[1].element], [element!("R70"), element!("M3")]);
        assert_eq!((remaining[0].expected, remaining[1].found), (Value::Word(0), Some(Value::Bit(true))));
        assert!(matches!(remaining[0].found, Some(Value::Word(1000..))), "{remaining:?}");
        assert!(remaining[1].to_string() == "M3: 1, where 0 was expected", "{}", remaining[1]);
        program.abort();
        let report = station.restore(&backup, RestoreOptions::new()).await.unwrap();
        assert_eq!(report.written, tags(["R70", "M3"]));
    }
}

#[tokio::test(start_paused = true)]
async fn a_changing_32_bit_value_is_written_whole() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        bench.plc.write(element!("DR0"), 0x0001_0005_u32).unwrap();
        let backup = bench.station().back_up(tags(["R0-R1:u32"])).await.unwrap();
        bench.plc.write(element!("DR0"), 0x0001_FFFF_u32).unwrap();
        bench.plc.run();
        let (plc, mut compared) = (bench.plc.clone(), false);
        // The low word differs in the comparison; the high word changes right after it.
        let mut restore = Restore::new(&backup, RestoreOptions::new()).on_progress(move |_| {
            if !std::mem::replace(&mut compared, true) {
                plc.write(element!("DR0"), 0x0002_0000_u32).unwrap();
            }
        });
        let report = restore.run(&bench.station()).await.unwrap();
        assert_eq!(bench.plc.read(element!("DR0")), 0x0001_0005_u32.into());
        assert_eq!((report.differences.len(), report.written), (1, tags(["R0-R1"]).to_vec()));
    }
}

#[tokio::test(start_paused = true)]
async fn a_32_bit_value_with_a_forced_bit_is_left_alone() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let station = bench.station();
        let backup = station.back_up(tags(["WM0-WM80:u32"])).await.unwrap();
        // In the word that is equal, in one that differs, and in none.
        for forced in [discrete!("M20"), discrete!("M40")] {
            station.disable(forced).await.unwrap();
        }
        for differs in [element!("WM0"), element!("WM32"), element!("WM80")] {
            bench.plc.write(differs, 1_u16).unwrap();
        }
        let report = station.restore(&backup, RestoreOptions::new()).await.unwrap();
        assert_eq!((report.forced, report.written), (tags(["WM0-WM48"]).to_vec(), tags(["WM64-WM80"]).to_vec()));
        assert_eq!((bench.plc.read(element!("WM0")), bench.plc.read(element!("WM80"))), (1_u16.into(), 0_u16.into()));
    }
}

#[tokio::test(start_paused = true)]
async fn forced_discretes_are_kept_unless_requested() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let backup = bench
            .station()
            .back_up(tags(["M0-M9", "Y0-Y9", "DWM32-DWM64", "WM96-WM128", "X0-X9", "T0"]))
            .await
            .unwrap();
        let station = bench.station();
        for forced in [discrete!("M3"), discrete!("Y9"), discrete!("M70"), discrete!("M96")] {
            station.disable(forced).await.unwrap();
            station.set(forced).await.unwrap();
        }
        // This one is forced to the value of the backup.
        station.disable(discrete!("Y4")).await.unwrap();
        let others =
            [element!("M2"), element!("Y0"), element!("M40"), element!("M66"), element!("M127"), element!("X3")];
        others.into_iter().for_each(|element| bench.plc.write(element, true).unwrap());
        bench.clear_log();
        let compared = Restore::new(&backup, RestoreOptions::new()).compare(&station).await.unwrap();
        assert_eq!(bench.faults.log().writes(), 0);
        assert_eq!(
            (compared.forced, compared.unwritten),
            (tags(["M3", "Y9", "DWM64", "WM96"]).to_vec(), tags(["M2", "Y0", "DWM32", "WM112"]).to_vec())
        );

        let report = station.restore(&backup, RestoreOptions::new().bridge(9)).await.unwrap();
        assert_eq!(report.forced, tags(["M3", "Y9", "DWM64", "WM96"]));
        assert_eq!(report.left_out, tags(["X0-X9", "T0"]));
        assert_eq!(report.written, tags(["M2", "Y0", "DWM32", "WM112"]));
        for on in [element!("M3"), element!("Y9"), element!("M70"), element!("M96"), element!("X3"), element!("M66")] {
            assert_eq!(bench.plc.read(on), Value::Bit(true), "{on}");
        }
        let report = station.restore(&backup, RestoreOptions::new().write_forced(true)).await.unwrap();
        assert_eq!((report.written, report.forced), (tags(["M3", "Y9", "DWM64", "WM96"]).to_vec(), vec![]));
        assert_eq!((bench.plc.read(element!("M3")), bench.plc.is_disabled(discrete!("M3"))), (Value::Bit(false), true));
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_43_is_not_written() {
    let bench = Bench::new(FRAMINGS[0], Faults::new(1));
    let backup = prepare(&bench, ["R0-R9", "M0-M9"]).await;
    bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(Code::ReadDisabled)]);
    let error = bench.station().restore(&backup, RestoreOptions::new()).await.unwrap_err();
    assert!(error.to_string().starts_with("reading which of M"), "{error}");
    assert_eq!(bench.faults.log().writes(), 0);
    bench.station().restore(&backup, RestoreOptions::new().write_forced(true)).await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn progress_reports_every_phase_completely() {
    let bench = Bench::new(FRAMINGS[0], Faults::new(1));
    let backup = prepare(&bench, ["R0-R99", "M0-M9"]).await;
    let reports = std::sync::Arc::new(std::sync::Mutex::new(Vec::new()));
    let report_sink = reports.clone();
    let options = CallOptions::new().with_response_timeout(Duration::from_secs(1));
    let restore = Restore::new(&backup, RestoreOptions::new().bridge(10));
    let mut restore = restore.on_progress(move |progress| report_sink.lock().unwrap().push(*progress));
    let report = restore.run(&bench.station().with_options(options)).await.unwrap();
    let reports: Vec<_> = reports
        .lock()
        .unwrap()
        .iter()
        .map(|reports| (reports.phase.to_string(), reports.done, reports.total, reports.bytes))
        .collect();
    let written: usize = report.written.iter().map(Tag::element_count).sum();
    let of = |phase: &str| {
        reports
            .iter()
            .filter(|reports| reports.0 == phase)
            .map(|reports| (reports.1, reports.2, reports.3))
            .collect::<Vec<_>>()
    };
    assert_eq!(of("comparing"), [(64, 110, 128), (100, 110, 200), (110, 110, 202)]);
    assert_eq!(of("verifying"), of("comparing"));
    let writing = of("writing");
    let &(done, total, _) = writing.last().unwrap();
    assert_eq!((done, total, writing[0].0), (written, written, 64));
    assert!(reports.is_sorted_by_key(|reports| {
        ["comparing", "writing", "verifying"].iter().position(|phase| *phase == reports.0)
    }));
}

#[tokio::test(start_paused = true)]
async fn the_backup_of_another_plc_is_restored_only_by_option() {
    for framing in FRAMINGS {
        let (own, other) = (
            Bench::new(framing, Faults::new(1)),
            Bench::with_model(framing, Faults::new(2), model().os_version(4, 0).main_unit(0)),
        );
        let backup = prepare(&own, ["R0-R9"]).await;
        other.plc.write(register!("R5"), 7_u16).unwrap();
        // Before: it was written, and the report did not say that the PLC is another one.
        let error = other.station().restore(&backup, RestoreOptions::new()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::OtherPlc), "{error}");
        assert_eq!(other.writes(), []);
        let differences = "main unit MA/MU instead of MC, OS version 4.0 instead of 3.1";
        let shown = format!("; another PLC than that of the backup: {differences}");
        assert!(error.to_string().ends_with(&shown), "{error}");
        // A comparison only tells it.
        let compared = Restore::new(&backup, RestoreOptions::new()).compare(&other.station()).await.unwrap();
        assert_eq!((compared.other_plc.len(), compared.differences.len()), (2, 1), "{compared}");
        let options = RestoreOptions::new().accept_other_plc(true);
        let report = other.station().restore(&backup, options).await.unwrap();
        assert_eq!(report.other_plc, compared.other_plc);
        assert_eq!(report.written, tags(["R5"]));
        let report = own.station().restore(&backup, RestoreOptions::new()).await.unwrap();
        assert_eq!(report.other_plc, []);
    }
}

#[tokio::test(start_paused = true)]
async fn special_elements_are_restored_only_by_choice() {
    for framing in FRAMINGS {
        // DR3838 is R3838 and R3839; the value at R3839 and R3840 is special as a whole.
        let ranges = tags(["R3830-R3838", "R3839-R3842:u32", "M1910-M1913", "R5000-R5004"]);
        let new = || Bench::with_model(framing, Faults::new(1), fatek::sim::Model::default());
        let source = new();
        for (element, value) in [("R3838", 1), ("R3839", 2), ("R3842", 3), ("R5004", 4)] {
            source.plc.write(element.parse::<fatek::Element>().unwrap(), value as u16).unwrap();
        }
        for relay in [discrete!("M1911"), discrete!("M1912")] {
            source.plc.write(relay, true).unwrap();
        }
        let backup = source.station().back_up(ranges).await.unwrap();

        let bench = new();
        let station = bench.station();
        bench.clear_log();
        let error = station.restore(&backup, RestoreOptions::new()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::Special { .. }), "{error}");
        assert_eq!(bench.faults.log().entries().len(), 0, "{error}");

        let skip = RestoreOptions::new().special(SpecialElements::Skip).bridge(64);
        let report = station.restore(&backup, skip).await.unwrap();
        assert_eq!(report.special, tags(["R3839-R3842", "M1912-M1913"]));
        assert_eq!(report.written, tags(["R3838", "M1911", "R5004"]));
        let values = |elements: [&str; 6]| elements.map(|e| bench.plc.read(e.parse::<fatek::Element>().unwrap()));
        let elements = ["R3838", "R3839", "R3842", "R5004", "M1911", "M1912"];
        let (word, bit) = (Value::Word, Value::Bit);
        assert_eq!(values(elements), [word(1), word(0), word(0), word(4), bit(true), bit(false)]);
        assert!(report.to_string().contains(", 6 special not to be written"), "{report}");

        let write = RestoreOptions::new().special(SpecialElements::Write);
        let report = station.restore(&backup, write).await.unwrap();
        assert_eq!(report.special, []);
        assert_eq!(values(elements), [word(1), word(2), word(3), word(4), bit(true), bit(true)]);
    }
}

#[tokio::test(start_paused = true)]
async fn special_elements_are_compared_in_any_case() {
    let bench = Bench::with_model(FRAMINGS[0], Faults::new(1), fatek::sim::Model::default());
    let station = bench.station();
    let backup = station.back_up(tags(["R3839-R3841"])).await.unwrap();
    bench.plc.write(register!("R3841"), 1_u16).unwrap();
    let report = Restore::new(&backup, RestoreOptions::new()).compare(&station).await.unwrap();
    assert_eq!((report.compared, report.differences.len()), (3, 1));
    assert_eq!(report.special, tags(["R3840-R3841"]));
}
