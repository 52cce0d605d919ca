//! Programs of real sizes there and back over a bad line.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::command::Code;
use fatek::program::{Program, ProgramError, ReadProgram, WriteOptions, WriteProgram};
use fatek::progress::{Phase, Progress};
use fatek::sim::{DisconnectAt, Fault, PageReply, Rule};
use fatek::wire::Framing;
use fatek::{Error, Link};

use crate::bench::{Bench, program, seeds};

/// Faults of every kind that one line can have.
fn spoil(bench: &Bench) {
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
        // Both at once must not come to the length of a page: nobody could tell that from one.
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

async fn read_on(bench: &Bench) -> (Program, u32) {
    let station = bench.station();
    let mut read = ReadProgram::new();
    for failures in 0..1000 {
        match read.run(&station).await {
            Ok(program) => return (program, failures),
            Err(ProgramError::Call { .. }) => {}
            Err(error) => panic!("{error}"),
        }
    }
    panic!("it does not come to an end");
}

#[tokio::test(start_paused = true)]
async fn programs_of_both_sizes_come_back_byte_for_byte_under_faults() {
    let mut interrupted = (0, 0);
    for seed in seeds(6) {
        for ladder_words in [8192, 13_184] {
            let form = if seed.is_multiple_of(2) { PageReply::WithErrorDigit } else { PageReply::Bare };
            let bench = Bench::new(ladder_words, form, seed);
            let (old, new) = (program(ladder_words, seed), program(ladder_words, seed + 1000));
            bench.load(&old);
            bench.plc.run();
            spoil(&bench);

            let (read, failures) = read_on(&bench).await;
            assert!(read.to_bytes() == old.to_bytes(), "seed {seed}: pages {:?}", read.differing_pages(&old));
            interrupted.0 += failures;

            let station = bench.station();
            let mut write = WriteProgram::new(&new, WriteOptions::new().stop_first().run_again());
            let report = loop {
                match write.run(&station).await {
                    Ok(report) => break report,
                    Err(error) => {
                        interrupted.1 += 1;
                        assert!(matches!(*error.source, ProgramError::Call { .. }), "seed {seed}: {error}");
                        let half = bench.holds() != new.pages() && bench.holds() != old.pages();
                        assert!(!(half && bench.plc.is_running()), "seed {seed}: {error}");
                    }
                }
            };
            assert!(report.was_stopped && report.running && bench.plc.is_running(), "seed {seed}: {report:?}");
            bench.never_ran_a_half(&old, &new);

            let (read, failures) = read_on(&bench).await;
            assert!(read.to_bytes() == new.to_bytes(), "seed {seed}: pages {:?}", read.differing_pages(&new));
            assert_eq!(read, new);
            interrupted.0 += failures;
            let struck = bench.entries().iter().filter(|entry| !entry.faults.is_empty()).count();
            assert!(struck > 20, "seed {seed}: {struck} faults");
        }
    }
    println!("readings and writings that were interrupted and went on: {interrupted:?}");
}

#[tokio::test(start_paused = true)]
async fn a_reading_that_loses_its_connection_at_every_page_goes_on_there() {
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    let program = program(640, 7);
    bench.load(&program);
    let station = bench.station().with_options(fatek::CallOptions::new().retries(0));
    let mut read = ReadProgram::new();
    for page in 0..11 {
        bench.faults.set_rules([]);
        // What has an answer is 40, 53, the header and one page more; and the checks, which confirm these.
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
async fn a_reading_that_is_dropped_at_any_time_goes_on_there() {
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
        // Long enough for six requests: a check that settles the one that was dropped, 40, 53, the header, a page, and the check that
        // confirms them. In the end it is 53 and the header once more, behind a check that tells it from the first.
        match tokio::time::timeout(Duration::from_millis(95), read.run(&station)).await {
            Ok(program) => break program.unwrap(),
            Err(_) => drops += 1,
        }
    };
    assert_eq!(whole, program);
    assert!(drops > 5, "{drops}");
}

#[tokio::test(start_paused = true)]
async fn progress_tells_each_page_its_bytes_and_how_long_the_rest_takes() {
    let bench = Bench::new(640, PageReply::WithErrorDigit, 1);
    let (old, new) = (program(640, 7), program(640, 8));
    bench.load(&old);
    bench
        .faults
        .set_line(fatek::sim::Line::default().response_time(Duration::from_millis(10), Duration::from_millis(10)));
    let told = Arc::<Mutex<Vec<Progress>>>::default();
    let tell = |told: &Arc<Mutex<Vec<Progress>>>| {
        let told = told.clone();
        move |progress: &Progress| told.lock().unwrap().push(*progress)
    };
    let station = bench.station();
    ReadProgram::new().twice().on_progress(tell(&told)).run(&station).await.unwrap();
    let seen = std::mem::take(&mut *told.lock().unwrap());
    let steps: Vec<_> = seen.iter().map(|progress| (progress.phase, progress.done)).collect();
    let reading = (1..=11).map(|done| (Phase::Reading, done));
    let verifying = (1..=11).map(|done| (Phase::Verifying, done));
    assert_eq!(steps, reading.chain(verifying).collect::<Vec<_>>());
    assert!(seen.iter().all(|progress| progress.total == 11 && progress.bytes == 128 * progress.done as u64));
    let third = seen[2];
    // 10 ms a page, and up to a millisecond for the timer each.
    assert!((30..=36).contains(&third.elapsed.as_millis()), "{third:?}");
    assert!((80..=96).contains(&third.time_left().unwrap().as_millis()), "{third:?}");
    assert!((10_000.0..13_000.0).contains(&third.bytes_per_second().unwrap()), "{third:?}");

    WriteProgram::new(&new, WriteOptions::new()).on_progress(tell(&told)).run(&station).await.unwrap();
    let seen = std::mem::take(&mut *told.lock().unwrap());
    let comparing = seen.iter().filter(|progress| progress.phase == Phase::Comparing);
    assert!(comparing.map(|progress| progress.done).eq(1..=11));
    let last = seen.last().unwrap();
    // The header is the same; ten pages are written and read back.
    assert_eq!((last.phase, last.done, last.total, last.bytes), (Phase::Writing, 10, 10, 2 * 10 * 128));
}

#[tokio::test(start_paused = true)]
async fn in_the_binary_framing_nothing_is_sent_and_the_error_says_why() {
    let open = || -> std::future::Ready<std::io::Result<tokio::io::DuplexStream>> { panic!("it must not connect") };
    let link = Link::connector_builder("nothing", Framing::Binary, open).build();
    let station = link.station(1).unwrap();
    let error = station.read_program().await.unwrap_err().to_string();
    assert_eq!(
        error,
        "cannot read page 0: invalid request: read program page (4F) does not exist in the binary framing"
    );
    let new = program(640, 1);
    let error = station.write_program(&new, WriteOptions::new().stop_first()).await.unwrap_err();
    assert!(error.state.written.is_empty() && error.state.in_doubt.is_empty());
    assert!(error.to_string().contains("does not exist in the binary framing; nothing was written"), "{error}");
    let error = WriteProgram::new(&new, WriteOptions::new()).compare(&station).await.unwrap_err();
    assert!(matches!(error.source.call_error(), Some(Error::Invalid(_))), "{error}");
}
