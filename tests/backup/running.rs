//! A PLC that is to stand still while it is restored: what becomes of the restoring when somebody sets it running, and what is
//! said of a PLC that refuses to stop or to run.

use fatek::backup::{Backup, Restore, RestoreFailure, RestoreOptions};
use fatek::command::Code;
use fatek::program::PlcState;
use fatek::progress::Phase;
use fatek::sim::{Fault, Faults, Rule};
use fatek::wire::Framing;
use fatek::{ErrorCode, element};

use crate::bench::{Bench, FRAMINGS, tags};

/// A backup, and a stopped PLC that holds something else in R3, and in R70.
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

/// The restoring of it, in which somebody sets the PLC running when so many requests of this phase are done.
fn disturbed(bench: &Bench, backup: &Backup, options: RestoreOptions, phase: Phase, requests: usize) -> Restore {
    let (plc, mut done) = (bench.plc.clone(), 0);
    Restore::new(backup, options).on_progress(move |progress| {
        done += usize::from(progress.phase == phase);
        if done == requests && progress.phase == phase {
            plc.run();
        }
    })
}

fn wants_it_stopped() -> [RestoreOptions; 3] {
    let options = RestoreOptions::new();
    [options.require_stopped(), options.stop_first(), options.stop_first().run_again()]
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_is_set_running_between_two_writes_or_while_it_is_verified_is_told() {
    for framing in FRAMINGS {
        for options in wants_it_stopped() {
            for (phase, requests) in [(Phase::Writing, 1), (Phase::Writing, 2), (Phase::Verifying, 2)] {
                let note = format!("{framing}, {options:?}, {phase} {requests}");
                let (bench, backup) = prepare(framing).await;
                let mut restore = disturbed(&bench, &backup, options, phase, requests);
                let error = restore.run(&bench.station()).await.expect_err(&note);
                let text = error.to_string();
                assert!(text.starts_with("another client started the PLC while it was restored"), "{text}, {note}");
                assert_eq!(error.report.plc, PlcState::Running, "{note}");
                assert_eq!(error.report.written, tags(["R3", "R70"]), "{note}");
                // What is done about that is up to whoever asked for it.
                assert!(bench.plc.is_running(), "{note}");
            }
        }
        // Where it was not to stand still, that is no matter.
        let (bench, backup) = prepare(framing).await;
        let mut restore = disturbed(&bench, &backup, RestoreOptions::new(), Phase::Writing, 1);
        restore.run(&bench.station()).await.unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn what_a_program_has_changed_after_the_plc_was_set_running_is_told_with_that() {
    let (bench, backup) = prepare(FRAMINGS[0]).await;
    let plc = bench.plc.clone();
    let mut restore = Restore::new(&backup, RestoreOptions::new().require_stopped()).on_progress(move |progress| {
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
async fn nothing_is_written_to_a_plc_that_is_set_running_while_it_is_compared() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        let mut restore = disturbed(&bench, &backup, RestoreOptions::new().require_stopped(), Phase::Comparing, 2);
        let error = restore.run(&bench.station()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::Running), "{error}");
        assert_eq!((bench.writes(), error.report.plc), (vec![], PlcState::Running));

        // One that may be stopped is stopped now; and run again, because it ran before that.
        let (bench, backup) = prepare(framing).await;
        let options = RestoreOptions::new().stop_first().run_again();
        let mut restore = disturbed(&bench, &backup, options, Phase::Comparing, 2);
        let report = restore.run(&bench.station()).await.unwrap();
        assert_eq!((report.was_stopped, report.plc, bench.plc.is_running()), (true, PlcState::Running, true));

        // Somebody runs it again as soon as it has been stopped: they want it to run.
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        let mut restore = disturbed(&bench, &backup, options, Phase::Comparing, 4);
        let error = restore.run(&bench.station()).await.unwrap_err();
        assert!(error.to_string().starts_with("another client started the PLC"), "{error}");
        assert!(error.to_string().ends_with("; it was stopped, and the PLC runs"), "{error}");
        assert_eq!((bench.writes(), bench.plc.is_running()), (vec![], true));
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_somebody_has_set_running_and_stopped_since_is_not_run() {
    let (bench, backup) = prepare(FRAMINGS[0]).await;
    bench.plc.run();
    let options = RestoreOptions::new().stop_first().run_again();
    let mut restore = disturbed(&bench, &backup, options, Phase::Writing, 1);
    restore.run(&bench.station()).await.unwrap_err();
    bench.plc.stop();
    bench.plc.write(element!("R3"), 1_u16).unwrap();
    restore.run(&bench.station()).await.unwrap();
    assert!(!bench.plc.is_running());
}

#[tokio::test(start_paused = true)]
async fn a_last_look_without_an_answer_leaves_the_state_unknown() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        // It is looked at first, before the first write, and in the end.
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::ReadStatus).skip(2)]);
        let restored = bench.station().restore(&backup, RestoreOptions::new().require_stopped()).await;
        let error = restored.unwrap_err();
        assert!(error.to_string().starts_with("reading the status: station 1 did not answer"), "{error}");
        assert_eq!((error.report.plc, error.report.written), (PlcState::Unknown, tags(["R3", "R70"]).to_vec()));
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_to_stop_is_known_to_run() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(Code::ControlPlc)]);
        let error = bench.station().restore(&backup, RestoreOptions::new().stop_first()).await.unwrap_err();
        assert!(error.to_string().starts_with("stopping the PLC, which still runs: station 1 refused"), "{error}");
        assert_eq!((error.report.plc, error.report.was_stopped), (PlcState::Running, false));
        assert_eq!(bench.writes(), []);
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_to_run_again_is_known_to_be_stopped() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        bench.plc.refuse_run(Some(ErrorCode::LadderChecksum));
        let options = RestoreOptions::new().stop_first().run_again();
        let error = bench.station().restore(&backup, options).await.unwrap_err();
        assert!(error.to_string().starts_with("running the PLC, which is still stopped: station 1 refused"), "{error}");
        assert!(error.to_string().ends_with(" 2 written; it was stopped, and the PLC is stopped"), "{error}");
        assert_eq!(error.report.plc, PlcState::Stopped);
    }
}

#[tokio::test(start_paused = true)]
async fn what_is_known_of_one_plc_is_not_used_on_another() {
    for framing in FRAMINGS {
        let (bench, backup) = prepare(framing).await;
        bench.plc.run();
        let mut restore = Restore::new(&backup, RestoreOptions::new().stop_first().run_again());
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::WriteRegisters)]);
        let error = restore.run(&bench.station()).await.unwrap_err();
        assert!(error.report.was_stopped && !bench.plc.is_running(), "{error}");
        bench.faults.set_rules([]);
        // It stands still, and nothing here has stopped it.
        let (other, _) = prepare(framing).await;
        let result = restore.run(&other.station_named("in another memory")).await;
        assert!(!other.plc.is_running() && other.faults.log().arrivals() == 0, "{framing}: {result:?}");
        // What is known of the first one is not lost by that.
        let report = restore.run(&bench.station()).await.unwrap();
        assert!(report.was_stopped && bench.plc.is_running(), "{framing}: {report}");
        // When all is done, it may be used for others.
        let report = restore.run(&other.station_named("in another memory")).await.unwrap();
        assert!(!report.was_stopped && !other.plc.is_running(), "{framing}: {report}");
    }
}
