//! A second failure, a request that fails alone, and others who start or stop the PLC in between.

use std::time::Duration;

use fatek::command::Code;
use fatek::program::{PlcState, ProgramError, WriteOptions, WriteProgram};
use fatek::sim::{Fault, Line, PageReply, Rule};
use fatek::{CallOptions, ErrorCode};
use tokio::time::sleep;

use crate::bench::{Bench, program};

const REQUEST: Duration = Duration::from_millis(10);

/// With a program, and with requests that take a while.
fn bench() -> Bench {
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    bench.load(&program(640, 1));
    bench.faults.set_line(Line::default().turnaround(REQUEST, REQUEST));
    bench
}

fn once() -> CallOptions {
    CallOptions::new().retries(0)
}

#[tokio::test(start_paused = true)]
async fn a_half_that_somebody_runs_is_stopped_again_though_the_request_fails_that_would_show_it() {
    for fault in [Fault::Error(ErrorCode::IllegalFormat), Fault::Ignore] {
        let bench = bench();
        let new = program(640, 2);
        let station = bench.station().with_options(once());
        let writing = station.write_program(&new, WriteOptions::new());
        // Page 0 and the ten of the comparison, and two that are read back.
        bench.faults.add_rule(Rule::new(fault).command(Code::ReadProgramPage).skip(13).times(1));
        let other = async {
            while bench.plc.page(3).as_ref() != new.page(3) {
                sleep(Duration::from_millis(1)).await;
            }
            bench.plc.run();
        };
        let (result, ()) = tokio::join!(writing, other);
        let error = result.unwrap_err();
        assert!(error.to_string().starts_with("cannot read page 3: "), "{error}");
        assert!(error.is_half_written() && error.plc == PlcState::Stopped && !bench.plc.is_running(), "{error:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_second_failure_does_not_forget_that_the_plc_holds_a_half() {
    let bench = bench();
    bench.plc.run();
    let station = bench.station().with_options(once());
    let new = program(640, 2);
    let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first().run_again());
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(3));
    let first = write.run(&station).await.unwrap_err();
    assert!(first.is_half_written() && first.plc == PlcState::Stopped, "{first}");
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    let second = write.run(&station).await.unwrap_err();
    assert!(second.is_half_written() && second.written_before == [1, 2, 3], "{second:?}");
    assert!(
        second.to_string().ends_with(
            "; this run has written no page, and earlier ones 3: the PLC may hold a half of the program, \
             and whether the PLC runs is not known: write the rest before it runs"
        ),
        "{second}"
    );
    bench.faults.set_rules([]);
    let report = write.run(&station).await.unwrap();
    assert_eq!(report.written, (4..=10).collect::<Vec<_>>());
    assert!(report.was_stopped && report.running && bench.plc.is_running());
    // From here on it is one like any other.
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    let error = write.run(&station).await.unwrap_err();
    assert!(!error.is_half_written() && error.to_string().contains("nothing was written"), "{error}");
}

#[tokio::test(start_paused = true)]
async fn a_half_that_somebody_runs_between_two_runs_is_stopped_again() {
    for options in [WriteOptions::new(), WriteOptions::new().stop_first()] {
        let bench = bench();
        let station = bench.station().with_options(once());
        let new = program(640, 2);
        let mut write = WriteProgram::new(&new, options);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(3));
        assert!(write.run(&station).await.unwrap_err().is_half_written());
        bench.faults.set_rules([]);
        bench.plc.run();
        let second = write.run(&station).await.unwrap_err();
        assert!(matches!(*second.source, ProgramError::SetRunning), "{second}");
        assert!(second.is_half_written() && second.plc == PlcState::Stopped && !bench.plc.is_running(), "{second:?}");
        assert_eq!(write.run(&station).await.unwrap().written, (4..=10).collect::<Vec<_>>());
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_did_not_obey_and_that_somebody_else_has_stopped_is_not_run() {
    for fault in [Fault::Error(ErrorCode::IllegalFormat), Fault::Ignore] {
        let bench = bench();
        bench.plc.run();
        let (station, new) = (bench.station().with_options(once()), program(640, 2));
        let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first().run_again());
        bench.faults.add_rule(Rule::new(fault).command(Code::ControlPlc));
        assert_eq!(write.run(&station).await.unwrap_err().plc, PlcState::Running);
        bench.faults.set_rules([]);
        // A person, at the machine.
        bench.plc.stop();
        let report = write.run(&station).await.unwrap();
        assert!(!report.was_stopped && !report.running && !bench.plc.is_running(), "{report:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_whole_old_program_that_somebody_runs_before_the_first_page_is_not_stopped() {
    let bench = bench();
    let (old, new) = (program(640, 1), program(640, 2));
    let station = bench.station();
    let writing = station.write_program(&new, WriteOptions::new());
    // 53, page 0, ten pages and 40 have been answered, and the first page is on its way.
    let starting = async {
        while bench.faults.log().entries().len() < 14 {
            sleep(Duration::from_millis(1)).await;
        }
        bench.plc.run();
    };
    let (result, ()) = tokio::join!(writing, starting);
    let error = result.unwrap_err();
    assert!(matches!(*error.source, ProgramError::SetRunning) && !error.is_half_written(), "{error}");
    assert!(error.to_string().ends_with("; nothing was written, and the PLC runs"), "{error}");
    assert!(bench.holds() == old.pages() && bench.plc.is_running());
}

#[tokio::test(start_paused = true)]
async fn the_reason_of_a_refusal_is_told_though_the_next_request_fails_too() {
    let bench = bench();
    let new = program(640, 2);
    let station = bench.station().with_options(once());
    bench.faults.set_rules([
        Rule::new(Fault::Error(ErrorCode::WriteProhibited)).command(Code::WriteProgramPage).skip(3),
        Rule::new(Fault::Ignore).command(Code::ReadStatus).skip(1),
    ]);
    let error = station.write_program(&new, WriteOptions::new()).await.unwrap_err();
    assert!(error.to_string().contains("ROM pack") && error.plc == PlcState::Unknown, "{error}");
}

#[tokio::test(start_paused = true)]
async fn the_writing_of_all_pages_goes_on_where_it_was() {
    let bench = bench();
    let new = program(640, 2);
    let mut write = WriteProgram::new(&new, WriteOptions::new().all_pages());
    let station = bench.station().with_options(once());
    for (skip, written) in [(5, 1..=5), (3, 6..=8)] {
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(skip)]);
        let error = write.run(&station).await.unwrap_err();
        assert_eq!(error.written, written.collect::<Vec<_>>());
    }
    // One that is another since is written again; and the header is the last.
    bench.plc.set_page(3, program(640, 1).pages()[3].clone()).unwrap();
    bench.faults.set_rules([]);
    assert_eq!(write.run(&station).await.unwrap().written, [3, 9, 10, 0]);
    assert_eq!(bench.holds(), new.pages());
}
