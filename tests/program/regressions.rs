//! Regressions: second failures, single failed requests, and other users who start or stop the PLC
//! meanwhile.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::command::{Code, Request};
use fatek::program::{PlcState, Program, ProgramError, WriteOptions, WriteProgram};
use fatek::sim::{Fault, Line, PageReply, Rule};
use fatek::wire::Framing;
use fatek::{CallOptions, ErrorCode, Link, Station};
use tokio::time::sleep;

use crate::bench::{Bench, program};

const REQUEST: Duration = Duration::from_millis(10);

/// A PLC with a program and a response time.
fn bench() -> Bench {
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    bench.load(&program(640, 1));
    bench.faults.set_line(Line::default().response_time(REQUEST, REQUEST));
    bench
}

fn once() -> CallOptions {
    CallOptions::new().with_retries(0)
}

#[tokio::test(start_paused = true)]
async fn a_started_half_is_stopped_even_if_a_request_fails() {
    for fault in [Fault::Error(ErrorCode::IllegalFormat), Fault::Ignore] {
        let bench = bench();
        let new = program(640, 2);
        let station = bench.station().with_options(once());
        let writing = station.write_program(&new, WriteOptions::new());
        // Page 0 and ten pages of the comparison, and two that are read back.
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
        assert!(
            error.state.is_half_written() && error.state.plc == PlcState::Stopped && !bench.plc.is_running(),
            "{error:?}"
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_second_failure_still_reports_the_half_written_program() {
    let bench = bench();
    bench.plc.run();
    let station = bench.station().with_options(once());
    let new = program(640, 2);
    let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first(true).run_again(true));
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(3));
    let first = write.run(&station).await.unwrap_err();
    assert!(first.state.is_half_written() && first.state.plc == PlcState::Stopped, "{first}");
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    let second = write.run(&station).await.unwrap_err();
    assert!(second.state.is_half_written() && second.state.written_before == [1, 2, 3], "{second:?}");
    assert!(
        second.to_string().ends_with(
            "; this run has written no page, and earlier ones 1-3: the PLC may hold a part of the program, \
             and the PLC ran before, and whether it runs now is not known: write the rest before it runs"
        ),
        "{second}"
    );
    bench.faults.set_rules([]);
    let report = write.run(&station).await.unwrap();
    assert_eq!(report.written, (4..=10).collect::<Vec<_>>());
    assert!(report.was_stopped && report.running && bench.plc.is_running());
    // A completed write has no state left.
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    let error = write.run(&station).await.unwrap_err();
    assert!(!error.state.is_half_written() && error.to_string().contains("nothing was written"), "{error}");
}

#[tokio::test(start_paused = true)]
async fn a_half_started_between_two_attempts_is_stopped_again() {
    for options in [WriteOptions::new(), WriteOptions::new().stop_first(true)] {
        let bench = bench();
        let station = bench.station().with_options(once());
        let new = program(640, 2);
        let mut write = WriteProgram::new(&new, options);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(3));
        assert!(write.run(&station).await.unwrap_err().state.is_half_written());
        bench.faults.set_rules([]);
        bench.plc.run();
        let second = write.run(&station).await.unwrap_err();
        assert!(matches!(*second.source, ProgramError::SetRunning), "{second}");
        assert!(
            second.state.is_half_written() && second.state.plc == PlcState::Stopped && !bench.plc.is_running(),
            "{second:?}"
        );
        assert_eq!(write.run(&station).await.unwrap().written, (4..=10).collect::<Vec<_>>());
    }
}

#[tokio::test(start_paused = true)]
async fn a_program_completed_by_another_process_is_not_touched() {
    let stop = WriteOptions::new().stop_first(true);
    for options in [WriteOptions::new(), stop, stop.run_again(true), stop.all_pages(true), stop.verify_all(true)] {
        let bench = bench();
        bench.plc.run();
        let (station, new) = (bench.station().with_options(once()), program(640, 2));
        if options == WriteOptions::new() {
            bench.plc.stop();
        }
        let mut write = WriteProgram::new(&new, options);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(3));
        assert!(write.run(&station).await.unwrap_err().state.is_half_written());
        bench.faults.set_rules([]);
        // Another process completes the write.
        bench.station().write_program(&new, WriteOptions::new()).await.unwrap();
        bench.plc.run();
        let before = bench.faults.log().entries().len();
        let report = write.run(&station).await.unwrap();
        assert!(report.written.is_empty() && report.running && bench.plc.is_running(), "{report:?}");
        let changes = |entry: &fatek::sim::LogEntry| {
            matches!(entry.request(), Some(Request::WriteProgramPage(_) | Request::ControlPlc(_)))
        };
        assert!(!bench.entries()[before..].iter().any(changes), "{options:?}");
        // A completed write has no state left.
        assert!(!write.state().is_half_written());
    }
}

#[tokio::test(start_paused = true)]
async fn a_started_half_is_detected_by_its_first_unwritten_page() {
    let bench = bench();
    let (station, new) = (bench.station().with_options(once()), program(640, 2));
    let mut write = WriteProgram::new(&new, WriteOptions::new());
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(8));
    assert_eq!(write.run(&station).await.unwrap_err().state.unwritten, [10]);
    bench.faults.set_rules([]);
    bench.plc.run();
    let before = bench.faults.log().entries().len();
    let error = write.run(&station).await.unwrap_err();
    assert!(matches!(*error.source, ProgramError::SetRunning) && !bench.plc.is_running(), "{error}");
    let pages: Vec<u16> = bench.entries()[before..]
        .iter()
        .filter_map(|entry| match entry.request() {
            Some(Request::ReadProgramPage(read)) => Some(read.page),
            _ => None,
        })
        .collect();
    // The header is the same in both programs.
    assert_eq!(pages, [0, 10]);
}

#[tokio::test(start_paused = true)]
async fn a_dropped_write_reports_its_progress() {
    let bench = bench();
    bench.plc.run();
    let (station, new) = (bench.station(), program(640, 2));
    let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first(true).run_again(true));
    assert_eq!(write.state().to_string(), "nothing was written, and whether the PLC runs is not known");
    type When = fn(&Request) -> bool;
    let dropped_at: [(When, &str); 3] = [
        (
            |request| matches!(request, Request::ReadProgramPage(read) if read.page == 3),
            "nothing was written, and the PLC runs",
        ),
        (
            |request| matches!(request, Request::ControlPlc(_)),
            "nothing was written, and the PLC ran before, and whether it runs now is not known",
        ),
        (
            |request| matches!(request, Request::WriteProgramPage(write) if write.page == 4),
            "3 of the 10 pages that differ are written (1-3), page 4 perhaps, and the PLC ran before and is stopped now: \
             write the rest before it runs",
        ),
    ];
    for (last, reports) in dropped_at {
        let mut run = Box::pin(write.run(&station));
        while !bench.entries().last().and_then(|entry| entry.request()).is_some_and(last) {
            tokio::select! {
                ended = &mut run => panic!("{ended:?}"),
                () = sleep(Duration::from_millis(1)) => {}
            }
        }
        drop(run);
        assert_eq!(write.state().to_string(), reports);
        bench.plc.run();
    }
}

#[tokio::test(start_paused = true)]
async fn a_write_of_all_pages_reports_no_comparison() {
    let bench = bench();
    let (reports, new) = (Arc::<Mutex<Vec<String>>>::default(), program(640, 2));
    let shared = reports.clone();
    let mut write = WriteProgram::new(&new, WriteOptions::new().all_pages(true))
        .on_progress(move |progress| shared.lock().unwrap().push(progress.to_string()));
    write.run(&bench.station()).await.unwrap();
    let reports = reports.lock().unwrap();
    assert_eq!(reports.len(), 22);
    assert!(reports.iter().all(|line| line.starts_with("writing: ") && line.contains(" of 11, ")), "{reports:?}");
}

#[tokio::test(start_paused = true)]
async fn a_plc_stopped_by_another_user_is_not_run_again() {
    for fault in [Fault::Error(ErrorCode::IllegalFormat), Fault::Ignore] {
        let bench = bench();
        bench.plc.run();
        let (station, new) = (bench.station().with_options(once()), program(640, 2));
        let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first(true).run_again(true));
        bench.faults.add_rule(Rule::new(fault).command(Code::ControlPlc));
        assert_eq!(write.run(&station).await.unwrap_err().state.plc, PlcState::Running);
        bench.faults.set_rules([]);
        // Another user stops the PLC.
        bench.plc.stop();
        let report = write.run(&station).await.unwrap();
        assert!(!report.was_stopped && !report.running && !bench.plc.is_running(), "{report:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn an_old_program_started_before_the_first_page_keeps_running() {
    let bench = bench();
    let (old, new) = (program(640, 1), program(640, 2));
    let station = bench.station();
    let writing = station.write_program(&new, WriteOptions::new());
    // Answered so far: 53, page 0, ten pages, 40, and two checks: of the new connection and of the
    // comparison. The first page is in flight.
    let starting = async {
        while bench.faults.log().entries().len() < 16 {
            sleep(Duration::from_millis(1)).await;
        }
        bench.plc.run();
    };
    let (result, ()) = tokio::join!(writing, starting);
    let error = result.unwrap_err();
    assert!(matches!(*error.source, ProgramError::SetRunning) && !error.state.is_half_written(), "{error}");
    assert!(error.to_string().ends_with("; nothing was written, and the PLC runs"), "{error}");
    assert!(bench.pages_held() == old.pages() && bench.plc.is_running());
}

#[tokio::test(start_paused = true)]
async fn a_refusal_is_reported_even_if_the_next_request_fails() {
    let bench = bench();
    let new = program(640, 2);
    let station = bench.station().with_options(once());
    bench.faults.set_rules([
        Rule::new(Fault::Error(ErrorCode::WriteProhibited)).command(Code::WriteProgramPage).skip(3),
        Rule::new(Fault::Ignore).command(Code::ReadStatus).skip(1),
    ]);
    let error = station.write_program(&new, WriteOptions::new()).await.unwrap_err();
    assert!(error.to_string().contains("ROM pack") && error.state.plc == PlcState::Unknown, "{error}");
}

#[tokio::test(start_paused = true)]
async fn a_write_of_all_pages_resumes_where_it_stopped() {
    let bench = bench();
    let new = program(640, 2);
    let mut write = WriteProgram::new(&new, WriteOptions::new().all_pages(true));
    let station = bench.station().with_options(once());
    for (skip, written) in [(5, 1..=5), (3, 6..=8)] {
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(skip)]);
        let error = write.run(&station).await.unwrap_err();
        assert_eq!(error.state.written, written.collect::<Vec<_>>());
    }
    // A page that was changed meanwhile is written again. The header is last.
    bench.plc.set_page(3, program(640, 1).pages()[3].clone()).unwrap();
    bench.faults.set_rules([]);
    assert_eq!(write.run(&station).await.unwrap().written, [3, 9, 10, 0]);
    assert_eq!(bench.pages_held(), new.pages());
}

/// Another PLC with this program, as another station and over another link.
fn another(holds: &Program) -> (Bench, [Station; 2]) {
    let other = bench();
    other.load(holds);
    let bus = other.bus.clone().with_station(2, other.plc.clone()).unwrap();
    let link = |name| {
        let open = fatek::sim::connector(bus.clone(), Framing::Ascii);
        Link::connector_builder(name, Framing::Ascii, open).response_timeout(Duration::from_millis(50)).build()
    };
    let stations = [link("in memory").station(2).unwrap(), link("in another memory").station(1).unwrap()];
    (other, stations)
}

#[tokio::test(start_paused = true)]
async fn state_of_one_plc_is_not_used_on_another() {
    let (old, new) = (program(640, 1), program(640, 2));
    // The other PLC is stopped on purpose, with the whole program; or it runs, and may not be
    // stopped.
    let stop = WriteOptions::new().stop_first(true).run_again(true);
    for (options, holds, runs) in [(stop, &new, false), (WriteOptions::new(), &old, true)] {
        let bench = bench();
        if !runs {
            bench.plc.run();
        }
        let mut write = WriteProgram::new(&new, options);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(3));
        let station = bench.station().with_options(once());
        let first = write.run(&station).await.unwrap_err();
        assert!(first.state.is_half_written(), "{first}");
        let (other, stations) = another(holds);
        if runs {
            other.plc.run();
        }
        for another in stations {
            let result = write.run(&another).await;
            assert_eq!((other.plc.is_running(), other.faults.log().arrivals()), (runs, 0), "{result:?}");
        }
        // State of the first PLC is kept.
        bench.faults.set_rules([]);
        let report = write.run(&bench.station()).await.unwrap();
        assert_eq!((report.was_stopped, report.running), (!runs, !runs));
        // After completion the write may be used for other PLCs.
        for another in another(&new).1 {
            assert!(write.run(&another).await.unwrap().written.is_empty());
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_read_does_not_resume_with_another_plc() {
    let bench = bench();
    let (mut read, station) = (fatek::program::ReadProgram::new(), bench.station().with_options(once()));
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ReadProgramPage).skip(5));
    read.run(&station).await.unwrap_err();
    // Another PLC of the same model, with the same header.
    let (other, stations) = another(&program(640, 2));
    for another in stations {
        let error = read.run(&another).await.expect_err("one program of two PLCs");
        assert!(matches!(error, ProgramError::OtherStation { .. }) && other.faults.log().arrivals() == 0, "{error}");
        assert!(error.to_string().starts_with("this was begun with station 1 on in memory, and cannot continue with "));
    }
    assert_eq!(read.pages_done(), 5);
    bench.faults.set_rules([]);
    assert_eq!(read.run(&bench.station()).await.unwrap(), program(640, 1));
    assert_eq!(read.run(&another(&program(640, 2)).1[0]).await.unwrap(), program(640, 2));
}

#[tokio::test(start_paused = true)]
async fn a_started_half_is_detected_by_its_page_in_doubt() {
    let bench = bench();
    let (station, new) = (bench.station().with_options(once()), program(640, 2));
    let mut write = WriteProgram::new(&new, WriteOptions::new());
    bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage).skip(9));
    let state = write.run(&station).await.unwrap_err().state;
    assert_eq!((state.unwritten, state.in_doubt), (vec![], vec![10]));
    bench.faults.set_rules([]);
    bench.plc.run();
    let before = bench.faults.log().entries().len();
    let error = write.run(&station).await.unwrap_err();
    assert!(matches!(*error.source, ProgramError::SetRunning) && !bench.plc.is_running(), "{error}");
    let is_read = |entry: &&fatek::sim::LogEntry| matches!(entry.request(), Some(Request::ReadProgramPage(_)));
    assert_eq!(bench.entries()[before..].iter().filter(is_read).count(), 2, "the header, and page 10");
}
