//! Restores that need a stopped PLC: other users who start it meanwhile, and PLCs that refuse STOP
//! or RUN.

use fatek::backup::{Backup, Restore, RestoreFailure, RestoreOptions};
use fatek::command::Code;
use fatek::program::PlcState;
use fatek::progress::Phase;
use fatek::sim::{Fault, Faults, Rule};
use fatek::wire::Framing;
use fatek::{ErrorCode, element};

use crate::bench::{Bench, FRAMINGS, tags};

/// Creates a backup, and a stopped PLC with other values in R3 and R70.
async fn prepare(framing: Framing) -> (Bench, Backup) {
    let bench = Bench::new(framing, Faults::new(1));
    bench.plc.stop();
    let backup = bench.station().back_up(tags(["R0-R99"])).await.unwrap();
    for differs in [element!("R3"), element!("R70")] {
        bench.plc.write(differs, 1_u16).unwrap();
    }
    bench.clear_log();
    (bench, backup)
}

/// Creates a restore during which another user starts the PLC, after this number of requests of a
/// phase.
fn started_meanwhile(
    bench: &Bench,
    backup: &Backup,
    options: RestoreOptions,
    phase: Phase,
    requests: usize,
) -> Restore {
    let (plc, mut done) = (bench.plc.clone(), 0);
    Restore::new(backup, options).on_progress(move |progress| {
        done += usize::from(progress.phase == phase);
        if done == requests && progress.phase == phase {
            plc.run();
        }
    })
}

fn options_that_need_a_stopped_plc() -> [RestoreOptions; 3] {
    let options = RestoreOptions::new();
    [options.require_stopped(true), options.stop_first(true), options.stop_first(true).run_again(true)]
}

#[tokio::test(start_paused = true)]
async fn a_plc_started_during_a_restore_is_reported() {
    for framing in FRAMINGS {
        for options in options_that_need_a_stopped_plc() {
            for (phase, requests) in [(Phase::Writing, 1), (Phase::Writing, 2), (Phase::Verifying, 2)] {
                let note = format!("{framing}, {options:?}, {phase} {requests}");
                let (bench, backup) = prepare(framing).await;
                let mut restore = started_meanwhile(&bench, &backup, options, phase, requests);
                let error = restore.run(&bench.station()).await.expect_err(&note);
                let text = error.to_string();
                assert!(text.starts_with("another client started the PLC while it was restored"), "{text}, {note}");
                assert_eq!(error.report.plc, PlcState::Running, "{note}");
                assert_eq!(error.report.written, tags(["R3", "R70"]), "{note}");
                // The PLC is left running: the caller decides.
                assert!(bench.plc.is_running(), "{note}");
            }
        }
        // Without the requirement, a running PLC is no error.
        let (bench, backup) = prepare(framing).await;
        let mut restore = started_meanwhile(&bench, &backup, RestoreOptions::new(), Phase::Writing, 1);
        restore.run(&bench.station()).await.unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn changes_by_a_started_program_are_reported_too() {
    let (bench, backup) = prepare(FRAMINGS[0]).await;
    let plc = bench.plc.clone();
    let mut restore = Restore::new(&backup, RestoreOptions::new().require_stopped(true)).on_progress(move |progress| {
        if progress.phase == Phase::Writing {
            plc.run();
            plc.write(element!("R5"), 9_u16).unwrap();
        }
    });
    let error = restore.run(&bench.station()).await.unwrap_err();
    let text = error.to_string();
    assert!(text.starts_with("another client started the PLC while it was restored; 1 of the elements do"), "{text}");
    assert_eq!((error.report.remaining.len(), error.report.remaining[0].element), (1, element!("R5")));
}

#[tokio::test(start_paused = true)]
async fn a_plc_started_during_the_comparison_is_not_written() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        let mut restore =
            started_meanwhile(&bench, &backup, RestoreOptions::new().require_stopped(true), Phase::Comparing, 2);
        let error = restore.run(&bench.station()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::Running), "{error}");
        assert_eq!((bench.writes(), error.report.plc), (vec![], PlcState::Running));

        // A PLC that may be stopped is stopped, and run again, because it ran before the stop.
        let (bench, backup) = prepare(framing).await;
        let options = RestoreOptions::new().stop_first(true).run_again(true);
        let mut restore = started_meanwhile(&bench, &backup, options, Phase::Comparing, 2);
        let report = restore.run(&bench.station()).await.unwrap();
        assert_eq!((report.was_stopped, report.plc, bench.plc.is_running()), (true, PlcState::Running, true));

        // Another user starts the PLC right after the stop: it is left running.
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        let mut restore = started_meanwhile(&bench, &backup, options, Phase::Comparing, 4);
        let error = restore.run(&bench.station()).await.unwrap_err();
        assert!(error.to_string().starts_with("another client started the PLC"), "{error}");
        assert!(error.to_string().ends_with("; it was stopped, and the PLC runs"), "{error}");
        assert_eq!((bench.writes(), bench.plc.is_running()), (vec![], true));
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_started_and_stopped_by_others_is_not_run_again() {
    let (bench, backup) = prepare(FRAMINGS[0]).await;
    bench.plc.run();
    let options = RestoreOptions::new().stop_first(true).run_again(true);
    let mut restore = started_meanwhile(&bench, &backup, options, Phase::Writing, 1);
    restore.run(&bench.station()).await.unwrap_err();
    bench.plc.stop();
    bench.plc.write(element!("R3"), 1_u16).unwrap();
    restore.run(&bench.station()).await.unwrap();
    assert!(!bench.plc.is_running());
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_last_status_leaves_the_state_unknown() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        // The status is read twice at the start, before the first write, and at the end.
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::ReadStatus).skip(3)]);
        let restored = bench.station().restore(&backup, RestoreOptions::new().require_stopped(true)).await;
        let error = restored.unwrap_err();
        assert!(error.to_string().starts_with("reading the status: station 1 did not answer"), "{error}");
        assert_eq!((error.report.plc, error.report.written), (PlcState::Unknown, tags(["R3", "R70"]).to_vec()));
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_to_stop_is_reported_running() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(Code::ControlPlc)]);
        let error = bench.station().restore(&backup, RestoreOptions::new().stop_first(true)).await.unwrap_err();
        assert!(error.to_string().starts_with("stopping the PLC, which still runs: station 1 refused"), "{error}");
        assert_eq!((error.report.plc, error.report.was_stopped), (PlcState::Running, false));
        assert_eq!(bench.writes(), []);
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_to_run_is_reported_stopped() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        bench.plc.refuse_run(Some(ErrorCode::LadderChecksum));
        let options = RestoreOptions::new().stop_first(true).run_again(true);
        let error = bench.station().restore(&backup, options).await.unwrap_err();
        assert!(error.to_string().starts_with("running the PLC, which is still stopped: station 1 refused"), "{error}");
        assert!(error.to_string().ends_with(" 2 written; it was stopped, and the PLC is stopped"), "{error}");
        assert_eq!(error.report.plc, PlcState::Stopped);
    }
}

#[tokio::test(start_paused = true)]
async fn state_of_one_plc_is_not_used_on_another() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        let mut restore = Restore::new(&backup, RestoreOptions::new().stop_first(true).run_again(true));
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::WriteRegisters)]);
        let error = restore.run(&bench.station()).await.unwrap_err();
        assert!(error.report.was_stopped && !bench.plc.is_running(), "{error}");
        bench.faults.set_rules([]);
        // The other PLC is stopped, but not by this restore.
        let (other, _) = prepare(framing).await;
        let result = restore.run(&other.station_named("in another memory")).await;
        assert!(!other.plc.is_running() && other.faults.log().arrivals() == 0, "{framing}: {result:?}");
        // State of the first PLC is kept.
        let report = restore.run(&bench.station()).await.unwrap();
        assert!(report.was_stopped && bench.plc.is_running(), "{framing}: {report}");
        // After completion the restore may be used for other PLCs.
        let report = restore.run(&other.station_named("in another memory")).await.unwrap();
        assert!(!report.was_stopped && !other.plc.is_running(), "{framing}: {report}");
    }
}
