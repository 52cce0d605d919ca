//! Crashes at every page of a write, and a second process that has only the program and the PLC.
//!
//! Programs of real sizes are tested at every eighth page, with one kind of crash after the other.
//! `FATEK_CRASH_STEP=1` tests every kind at every page.

use std::time::Duration;

use fatek::CallOptions;
use fatek::command::Code;
use fatek::program::{PlcState, Program, ProgramError, WriteOptions, WriteProgram, WriteProgramError};
use fatek::sim::{DisconnectAt, Fault, Line, PageReply, Rule};

use crate::bench::{Bench, program, program_with_header, seeds};

/// Failures from the n-th page write on.
#[derive(Clone, Copy, Debug)]
enum Crash {
    /// The PLC receives nothing any more.
    Silence,
    /// The page is written, and the connection is lost for good.
    Disconnect,
    /// The page is written, and no reply comes any more.
    NoAnswer,
    /// The process ends after it has sent the write.
    Process,
}

const OPTIONS: fn() -> WriteOptions = || WriteOptions::new().stop_first(true).run_again(true);

#[tokio::test(start_paused = true)]
async fn a_new_process_completes_a_write_after_any_crash() {
    let step = std::env::var("FATEK_CRASH_STEP").ok().and_then(|step| step.parse().ok()).unwrap_or(32_usize);
    let mut crashes = 0;
    for (ladder_words, step) in [(1280, 1), (8192, step), (13_184, step)] {
        // The headers differ, too, so that every page is written.
        let (old, new) = (program(ladder_words, 1), program_with_header(ladder_words, 2, b"FB01"));
        let last = new.header().page_count();
        for (place, crash) in
            [Crash::Silence, Crash::Disconnect, Crash::NoAnswer, Crash::Process].into_iter().enumerate()
        {
            let first = 1 + (place * step / 4) as u16;
            for nth in (first..last).step_by(step).chain([last]) {
                crash_at(crash, nth, ladder_words, &old, &new).await;
                crashes += 1;
            }
        }
    }
    println!("crashes: {crashes}");
}

async fn crash_at(crash: Crash, nth: u16, ladder_words: u16, old: &Program, new: &Program) {
    let context = format!("{crash:?} at the {nth}. page of {ladder_words} words");
    let bench = Bench::new(ladder_words, PageReply::WithErrorDigit, nth.into());
    bench.load(old);
    bench.plc.run();
    let skip = u64::from(nth - 1);
    // From the n-th write on. Earlier reads are not affected.
    let from_here = |fault| Rule::new(fault).command(Code::WriteProgramPage).skip(skip);
    match crash {
        Crash::Silence => bench.faults.add_rule(from_here(Fault::Ignore)),
        Crash::Disconnect => {
            bench.faults.add_rule(from_here(Fault::Disconnect(DisconnectAt::BeforeReply)));
            // No second connection is accepted.
            bench.faults.add_rule(Rule::new(Fault::Refuse).skip(1));
        }
        Crash::NoAnswer | Crash::Process => bench.faults.add_rule(from_here(Fault::DropReply)),
    };
    let station = bench.station().with_options(CallOptions::new().with_retries(0));
    let mut write = WriteProgram::new(new, OPTIONS());
    {
        let mut run = Box::pin(write.run(&station));
        let ended = tokio::select! {
            ended = &mut run => Some(ended),
            // Once the write has arrived, the whole line fails.
            () = first_fault_struck(&bench) => None,
        };
        assert!(ended.is_none(), "{context}: {ended:?}");
        match crash {
            Crash::Process => drop(run),
            Crash::Silence | Crash::NoAnswer | Crash::Disconnect => {
                bench.faults.add_rule(Rule::new(Fault::Ignore));
                let error = run.await.unwrap_err();
                check(&error, nth, new, &context);
            }
        }
    }
    assert!(!bench.plc.is_running(), "{context}: the PLC runs a half-written program");
    let before = bench.pages_held();
    assert!(before != old.pages() || nth == 1, "{context}");
    assert!(before != new.pages() || nth == new.header().page_count(), "{context}");

    // Another process has another link, and only the program.
    bench.faults.set_rules([]);
    let missing: Vec<u16> =
        write_order(new).into_iter().filter(|&page| before.get(usize::from(page)) != new.page(page)).collect();
    let report = bench.station().write_program(new, OPTIONS()).await.unwrap();
    assert_eq!(report.written, missing, "{context}: only missing pages are written");
    // This process has not seen the PLC run.
    assert!(!report.running && !bench.plc.is_running(), "{context}");
    assert_eq!(bench.pages_held(), new.pages(), "{context}");

    // The first process, if it still exists, has seen it run.
    let report = write.run(&bench.station()).await.unwrap();
    assert!(report.written.is_empty() && report.running && bench.plc.is_running(), "{context}: {report:?}");
    bench.assert_never_ran_a_half(old, new);
}

fn check(error: &WriteProgramError, nth: u16, new: &Program, context: &str) {
    assert!(matches!(*error.source, ProgramError::Call { .. }), "{context}: {error}");
    let mut written = write_order(new);
    let mut rest = written.split_off(usize::from(nth - 1));
    let in_doubt = rest.remove(0);
    assert_eq!((&error.state.written, &error.state.in_doubt), (&written, &vec![in_doubt]), "{context}");
    rest.sort_unstable();
    assert_eq!(error.state.unwritten, rest, "{context}");
    assert!(error.state.is_half_written() && error.state.plc == PlcState::Unknown, "{context}: {error:?}");
    let text = error.to_string();
    assert!(
        text.contains(&format!("{} of the ", nth - 1)) && text.contains("whether it runs now is not known"),
        "{context}: {text}"
    );
}

/// Waits until the first fault has been injected.
async fn first_fault_struck(bench: &Bench) {
    while bench.faults.rules().first().is_some_and(|rule| rule.times_applied() == 0) {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// Order in which pages are written: the header last.
fn write_order(program: &Program) -> Vec<u16> {
    (1..program.header().page_count()).chain([0]).collect()
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_page_write_is_repeated_only_if_needed() {
    let (old, new) = (program(640, 1), program(640, 2));
    for (fault, writes) in [(Fault::DropReply, 1), (Fault::Ignore, 2)] {
        let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
        bench.load(&old);
        bench.faults.add_rule(Rule::new(fault).command(Code::WriteProgramPage).skip(4).times(1));
        let report = bench.station().write_program(&new, WriteOptions::new()).await.unwrap();
        assert_eq!(report.written, (1..=10).collect::<Vec<_>>());
        assert_eq!(bench.pages_held(), new.pages());
        let sent = bench.entries().into_iter().filter(|entry| {
            matches!(entry.request(), Some(fatek::command::Request::WriteProgramPage(write)) if write.page == 5)
        });
        assert_eq!(sent.count(), writes);
    }
}

#[tokio::test(start_paused = true)]
async fn a_page_write_fails_after_the_configured_attempts() {
    let (old, new) = (program(640, 1), program(640, 2));
    for attempts in [0, 1, 4] {
        let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
        bench.load(&old);
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteProgramPage));
        let error = bench.station().write_program(&new, WriteOptions::new().attempts(attempts)).await.unwrap_err();
        assert!(error.to_string().starts_with("cannot write page 1: station 1 did not answer"), "{error}");
        let sent = bench
            .entries()
            .into_iter()
            .filter(|entry| matches!(entry.request(), Some(fatek::command::Request::WriteProgramPage(_))));
        assert_eq!(sent.count(), attempts.max(1) as usize);
    }
}

#[tokio::test(start_paused = true)]
async fn the_page_timeout_applies_to_page_writes_only() {
    let (old, new) = (program(640, 1), program(640, 2));
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    bench.load(&old);
    let slow = Fault::Delay { min: Duration::from_secs(7), max: Duration::from_secs(7) };
    bench.faults.add_rule(Rule::new(slow).command(Code::WriteProgramPage));
    let options = WriteOptions::new().page_timeout(Duration::from_secs(8));
    bench.station().write_program(&new, options).await.unwrap();
    let sent = bench.faults.log().writes();
    assert_eq!((sent, bench.pages_held()), (10, new.pages().to_vec()));
}

#[tokio::test(start_paused = true)]
async fn a_write_dropped_at_any_time_can_be_resumed() {
    let (old, new) = (program(640, 1), program(640, 2));
    let mut drops = 0;
    for seed in seeds(100) {
        let bench = Bench::new(640, PageReply::WithErrorDigit, seed);
        bench.load(&old);
        bench.plc.run();
        let request = Duration::from_millis(10);
        bench.faults.set_line(Line::default().response_time(request, request));
        let station = bench.station();
        let mut write = WriteProgram::new(&new, OPTIONS());
        // The whole write takes about 400 ms, the comparison before the first page 130 ms.
        let mut after = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let report = loop {
            after = after.rotate_left(17).wrapping_mul(0x0100_0000_01B3).wrapping_add(1);
            match tokio::time::timeout(Duration::from_millis(after % 450), write.run(&station)).await {
                Ok(report) => break report.unwrap(),
                Err(_) => drops += 1,
            }
            let half = bench.pages_held() != old.pages() && bench.pages_held() != new.pages();
            assert!(!(half && bench.plc.is_running()), "seed {seed}");
        };
        assert!(report.was_stopped && report.running && bench.plc.is_running(), "seed {seed}: {report:?}");
        assert_eq!(bench.pages_held(), new.pages(), "seed {seed}");
        bench.assert_never_ran_a_half(&old, &new);
    }
    assert!(drops > 100 || seeds(100).count() < 100, "{drops}");
}
