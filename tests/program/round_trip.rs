//! Round trips of programs of real sizes over a faulty line.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::command::Code;
use fatek::program::{Program, ProgramError, ReadProgram, WriteOptions, WriteProgram};
use fatek::progress::{Phase, Progress};
use fatek::sim::{DisconnectAt, Fault, PageReply, Rule};
use fatek::wire::Framing;
use fatek::{Error, Link};

use crate::bench::{Bench, program, seeds};

/// Adds faults of every kind that a single line can have.
fn add_faults(bench: &Bench) {
    let rare = |fault| Rule::new(fault).per_mille(10);
    let late = Fault::Delay { min: Duration::from_millis(40), max: Duration::from_millis(80) };
    for fault in [
        Fault::Ignore,
        Fault::DropReply,
        late,
        Fault::Split { pieces: 5, pause: Duration::from_millis(2) },
        Fault::GarbageBefore { max_len: 40 },
        Fault::GarbageInside { max_len: 40 },
        Fault::WrongCommand,
        // Both at once must not give the length of a page: that could not be detected.
        Fault::Truncated { by: 2 },
        Fault::Extended { by: 5 },
        Fault::BadChecksum,
        Fault::Disconnect(DisconnectAt::BeforeExecution),
        Fault::Disconnect(DisconnectAt::BeforeReply),
        Fault::Disconnect(DisconnectAt::WithinReply),
    ] {
        bench.faults.add_rule(rare(fault));
    }
}

async fn read_until_complete(bench: &Bench) -> (Program, u32) {
    let station = bench.station();
    let mut read = ReadProgram::new();
    for failures in 0..1000 {
        match read.run(&station).await {
            Ok(program) => return (program, failures),
            Err(ProgramError::Call { .. }) => {}
            Err(error) => panic!("{error}"),
        }
    }
    panic!("the read does not complete");
}

#[tokio::test(start_paused = true)]
async fn programs_survive_a_round_trip_under_faults() {
    let mut interrupted = (0, 0);
    for seed in seeds(6) {
        for ladder_words in [8192, 13_184] {
            let form = if seed.is_multiple_of(2) { PageReply::WithErrorDigit } else { PageReply::Bare };
            let bench = Bench::new(ladder_words, form, seed);
            let (old, new) = (program(ladder_words, seed), program(ladder_words, seed + 1000));
            bench.load(&old);
            bench.plc.run();
            add_faults(&bench);

            let (read, failures) = read_until_complete(&bench).await;
            assert!(read.to_bytes() == old.to_bytes(), "seed {seed}: pages {:?}", read.differing_pages(&old));
            interrupted.0 += failures;

            let station = bench.station();
            let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first(true).run_again(true));
            let report = loop {
                match write.run(&station).await {
                    Ok(report) => break report,
                    Err(error) => {
                        interrupted.1 += 1;
                        assert!(matches!(*error.source, ProgramError::Call { .. }), "seed {seed}: {error}");
                        let half = bench.pages_held() != new.pages() && bench.pages_held() != old.pages();
                        assert!(!(half && bench.plc.is_running()), "seed {seed}: {error}");
                    }
                }
            };
            assert!(report.was_stopped && report.running && bench.plc.is_running(), "seed {seed}: {report:?}");
            bench.assert_never_ran_a_half(&old, &new);

            let (read, failures) = read_until_complete(&bench).await;
            assert!(read.to_bytes() == new.to_bytes(), "seed {seed}: pages {:?}", read.differing_pages(&new));
            assert_eq!(read, new);
            interrupted.0 += failures;
            let struck = bench.entries().iter().filter(|entry| !entry.faults.is_empty()).count();
            assert!(struck > 20, "seed {seed}: {struck} faults");
        }
    }
    println!("interrupted and resumed reads and writes: {interrupted:?}");
}

#[tokio::test(start_paused = true)]
async fn a_read_interrupted_at_every_page_is_resumed() {
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    let program = program(640, 7);
    bench.load(&program);
    let station = bench.station().with_options(fatek::CallOptions::new().with_retries(0));
    let mut read = ReadProgram::new();
    for page in 0..11 {
        bench.faults.set_rules([]);
        // Answered are 40, 53, the header, one page more, and the checks that confirm them.
        bench.faults.add_rule(Rule::new(Fault::Ignore).command(Code::ReadProgramPage).skip(if page == 0 {
            1
        } else {
            2
        }));
        let error = read.run(&station).await.unwrap_err();
        assert!(matches!(error.call_error(), Some(Error::Timeout { .. })), "{error}");
        assert_eq!(read.pages_done(), page + 1, "{error}");
    }
    bench.faults.set_rules([]);
    assert_eq!(read.run(&station).await.unwrap(), program);
}

#[tokio::test(start_paused = true)]
async fn a_read_dropped_at_any_time_is_resumed() {
    let bench = Bench::new(640, PageReply::Bare, 1);
    let program = program(640, 7);
    bench.load(&program);
    // Each request takes 10 ms.
    bench
        .faults
        .set_line(fatek::sim::Line::default().response_time(Duration::from_millis(10), Duration::from_millis(10)));
    let station = bench.station();
    let mut read = ReadProgram::new();
    let mut drops = 0;
    let whole = loop {
        // Enough for six requests: a check after the dropped request, 40, 53, the header, a page,
        // and the check that confirms them. The last run repeats 53 and the header, with a check
        // between.
        match tokio::time::timeout(Duration::from_millis(95), read.run(&station)).await {
            Ok(program) => break program.unwrap(),
            Err(_) => drops += 1,
        }
    };
    assert_eq!(whole, program);
    assert!(drops > 5, "{drops}");
}

#[tokio::test(start_paused = true)]
async fn progress_reports_pages_bytes_and_time_left() {
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    let (old, new) = (program(640, 7), program(640, 8));
    bench.load(&old);
    bench
        .faults
        .set_line(fatek::sim::Line::default().response_time(Duration::from_millis(10), Duration::from_millis(10)));
    let reports = Arc::<Mutex<Vec<Progress>>>::default();
    let report = |reports: &Arc<Mutex<Vec<Progress>>>| {
        let reports = reports.clone();
        move |progress: &Progress| reports.lock().unwrap().push(*progress)
    };
    let station = bench.station();
    ReadProgram::new().twice(true).on_progress(report(&reports)).run(&station).await.unwrap();
    let seen = std::mem::take(&mut *reports.lock().unwrap());
    let steps: Vec<_> = seen.iter().map(|progress| (progress.phase, progress.done)).collect();
    let reading = (1..=11).map(|done| (Phase::Reading, done));
    let verifying = (1..=11).map(|done| (Phase::Verifying, done));
    assert_eq!(steps, reading.chain(verifying).collect::<Vec<_>>());
    assert!(seen.iter().all(|progress| progress.total == 11 && progress.bytes == 128 * progress.done as u64));
    let third = seen[2];
    // 10 ms a page, and up to a millisecond for each timer.
    assert!((30..=36).contains(&third.elapsed.as_millis()), "{third:?}");
    assert!((80..=96).contains(&third.time_left().unwrap().as_millis()), "{third:?}");
    assert!((10_000.0..13_000.0).contains(&third.bytes_per_second().unwrap()), "{third:?}");

    WriteProgram::new(&new, WriteOptions::new()).on_progress(report(&reports)).run(&station).await.unwrap();
    let seen = std::mem::take(&mut *reports.lock().unwrap());
    let comparing = seen.iter().filter(|progress| progress.phase == Phase::Comparing);
    assert!(comparing.map(|progress| progress.done).eq(1..=11));
    let last = seen.last().unwrap();
    // The header is the same; ten pages are written and read back.
    assert_eq!((last.phase, last.done, last.total, last.bytes), (Phase::Writing, 10, 10, 2 * 10 * 128));
}

#[tokio::test(start_paused = true)]
async fn in_the_binary_framing_no_program_request_is_sent() {
    let open = || -> std::future::Ready<std::io::Result<tokio::io::DuplexStream>> { panic!("must not connect") };
    let link = Link::connector_builder("nothing", Framing::Binary, open).build();
    let station = link.station(1).unwrap();
    let error = station.read_program().await.unwrap_err().to_string();
    assert_eq!(
        error,
        "cannot read page 0: invalid request: read program page (4Fh) does not exist in the binary framing"
    );
    let new = program(640, 1);
    let error = station.write_program(&new, WriteOptions::new().stop_first(true)).await.unwrap_err();
    assert!(error.state.written.is_empty() && error.state.in_doubt.is_empty());
    assert!(error.to_string().contains("does not exist in the binary framing; nothing was written"), "{error}");
    let error = WriteProgram::new(&new, WriteOptions::new()).compare(&station).await.unwrap_err();
    assert!(matches!(error.source.call_error(), Some(Error::Invalid(_))), "{error}");
}
