//! Interference: other users of the same PLC, and PLCs that refuse or ignore commands.

use std::time::Duration;

use fatek::ErrorCode;
use fatek::command::{Code, ProgramPage};
use fatek::program::{PlcState, ProgramError, WriteOptions, WriteProgram};
use fatek::sim::{Fault, Line, Model, PageReply, Rule};
use tokio::time::sleep;

use crate::bench::{Bench, program};

const REQUEST: Duration = Duration::from_millis(10);

/// A PLC with a program and a response time.
fn bench(ladder_words: u16) -> Bench {
    let bench = Bench::new(ladder_words, PageReply::WithErrorDigit, 1);
    bench.load(&program(ladder_words, 1));
    bench.faults.set_line(Line::default().response_time(REQUEST, REQUEST));
    bench
}

#[tokio::test(start_paused = true)]
async fn a_header_changed_during_a_read_is_an_error() {
    let bench = bench(640);
    let station = bench.station();
    let reading = station.read_program();
    let changing = async {
        sleep(6 * REQUEST).await;
        let mut header = bench.plc.page(0).unwrap().to_bytes();
        header[3] = b'5';
        bench.plc.set_page(0, ProgramPage::from_bytes(&header)).unwrap();
    };
    let (result, ()) = tokio::join!(reading, changing);
    let error = result.unwrap_err();
    assert!(matches!(error, ProgramError::Changed { page: Some(0), .. }), "{error}");
}

#[tokio::test(start_paused = true)]
async fn a_running_plc_is_not_written_unless_it_may_be_stopped() {
    let bench = bench(640);
    let (old, new) = (program(640, 1), program(640, 2));
    bench.plc.run();
    let station = bench.station();
    let error = station.write_program(&new, WriteOptions::new()).await.unwrap_err();
    assert!(matches!(*error.source, ProgramError::Running), "{error}");
    assert_eq!((bench.faults.log().writes(), bench.pages_held()), (0, old.pages().to_vec()));
    assert!(bench.plc.is_running());

    // Without a difference the PLC is not stopped.
    let report = station.write_program(&old, WriteOptions::new().stop_first(true)).await.unwrap();
    assert!(report.written.is_empty() && !report.was_stopped && report.running && bench.plc.is_running());
    assert_eq!(bench.faults.log().writes(), 0);

    let compared = WriteProgram::new(&new, WriteOptions::new()).compare(&station).await.unwrap();
    assert_eq!(compared, (1..=10).collect::<Vec<_>>());
    assert_eq!(bench.faults.log().writes(), 0);

    let report = station.write_program(&new, WriteOptions::new().stop_first(true)).await.unwrap();
    assert!(report.was_stopped && !report.running && !bench.plc.is_running());
    assert_eq!(bench.pages_held(), new.pages());
}

#[tokio::test(start_paused = true)]
async fn a_plc_started_during_a_write_is_stopped_again() {
    let new = program(2560, 2);
    // Before the first page: the check of the new connection, 53, 41 compared pages, a check that
    // confirms them, and 40. Then each page is written and read back.
    for at in [48, 63, 80, 103] {
        let bench = bench(2560);
        let station = bench.station();
        let writing = station.write_program(&new, WriteOptions::new().run_again(true));
        let starting = async {
            sleep(at * REQUEST).await;
            bench.plc.run();
        };
        let (result, ()) = tokio::join!(writing, starting);
        let error = result.unwrap_err();
        assert!(matches!(*error.source, ProgramError::SetRunning), "{error}");
        assert!(
            error.state.is_half_written() && error.state.plc == PlcState::Stopped && !bench.plc.is_running(),
            "{error:?}"
        );
        // The next attempt completes the write.
        let report = station.write_program(&new, WriteOptions::new()).await.unwrap();
        assert_eq!(report.written, error.state.unwritten);
        assert_eq!(bench.pages_held(), new.pages());
    }
}

#[tokio::test(start_paused = true)]
async fn a_running_plc_is_detected_within_16_pages() {
    let (old, new) = (program(2560, 1), program(2560, 2));
    // As above.
    for at in [49, 63, 80, 103, 125] {
        let bench = Bench::with_model(Model::default().ladder_words(2560).pages_while_running(true), 1);
        bench.load(&old);
        bench.faults.set_line(Line::default().response_time(REQUEST, REQUEST));
        let station = bench.station();
        let writing = station.write_program(&new, WriteOptions::new());
        let starting = async {
            sleep(at * REQUEST).await;
            bench.plc.run();
            bench.faults.log().writes()
        };
        let (result, before) = tokio::join!(writing, starting);
        let error = result.unwrap_err();
        assert!(matches!(*error.source, ProgramError::SetRunning), "{error}");
        let written_since = error.state.written.len() as u64 - before;
        assert!((1..=16).contains(&written_since), "at {at}: {written_since}");
        assert!(error.state.plc == PlcState::Stopped && !bench.plc.is_running(), "{error:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_does_not_stop_is_not_written() {
    let bench = bench(640);
    bench.plc.run();
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ControlPlc));
    let new = program(640, 2);
    let error = bench.station().write_program(&new, WriteOptions::new().stop_first(true)).await.unwrap_err();
    assert!(error.to_string().starts_with("cannot stop the PLC: station 1 did not answer"), "{error}");
    assert_eq!((error.state.plc, bench.faults.log().writes()), (PlcState::Running, 0));
    bench.faults.set_rules([]);
    bench.faults.add_rule(Rule::new(Fault::Error(ErrorCode::IllegalFormat)).command(Code::ControlPlc));
    let error = bench.station().write_program(&new, WriteOptions::new().stop_first(true)).await.unwrap_err();
    assert!(error.to_string().contains("illegal format, or the command cannot be executed (4)"), "{error}");
    // A STOP that needs two attempts is no error.
    bench.faults.set_rules([]);
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ControlPlc).times(1));
    bench.station().write_program(&new, WriteOptions::new().stop_first(true)).await.unwrap();
    assert_eq!(bench.pages_held(), program(640, 2).pages());
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_to_run_keeps_the_whole_program() {
    let bench = bench(640);
    bench.plc.run();
    bench.plc.refuse_run(Some(ErrorCode::Syntax));
    let new = program(640, 2);
    let error =
        bench.station().write_program(&new, WriteOptions::new().stop_first(true).run_again(true)).await.unwrap_err();
    assert_eq!(
        error.to_string(),
        "the PLC refuses to run the program: cannot run: syntax error (7); the program is written, and the PLC ran before and is stopped \
         now"
    );
    assert_eq!(bench.pages_held(), new.pages());
    assert!(!bench.plc.is_running());
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_run_is_confirmed_by_the_status() {
    for fault in [Fault::DropReply, Fault::Ignore] {
        let bench = bench(640);
        bench.plc.run();
        // The first 41 is STOP.
        bench.faults.add_rule(Rule::new(fault).command(Code::ControlPlc).skip(1).times(1));
        let new = program(640, 2);
        let options = WriteOptions::new().stop_first(true).run_again(true).verify_all(true);
        let report = bench.station().write_program(&new, options).await.unwrap();
        assert!(report.was_stopped && report.running && bench.plc.is_running());
        bench.assert_never_ran_a_half(&program(640, 1), &new);
    }
}

#[tokio::test(start_paused = true)]
async fn a_refused_page_leaves_the_plc_stopped() {
    let bench = bench(640);
    bench.plc.run();
    let refused = Rule::new(Fault::Error(ErrorCode::WriteProhibited)).command(Code::WriteProgramPage).skip(3);
    bench.faults.add_rule(refused);
    let new = program(640, 2);
    let error =
        bench.station().write_program(&new, WriteOptions::new().stop_first(true).run_again(true)).await.unwrap_err();
    assert_eq!(
        error.to_string(),
        "cannot write page 4: station 1 refused write program page (50h): write prohibited, the PLC has a ROM pack (3); \
         3 of the 10 pages that differ are written (1-3), and the PLC ran before and is stopped now: \
         write the rest before it runs"
    );
    assert!(!bench.plc.is_running());
}
