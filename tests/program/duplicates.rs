//! Programs with one roaming duplicate, at each request in turn.

use fatek::command::{PAGE_WORDS, ProgramPage};
use fatek::program::{Program, WriteOptions};

use crate::bench::{Bench, program};
use crate::roaming::RoamingLine;

const WORDS: u16 = 640;

fn line(bench: &Bench, from: usize) -> RoamingLine {
    RoamingLine::new(bench.bus.clone(), from)
}

fn bench(holds: &Program) -> Bench {
    let bench = Bench::new(WORDS, fatek::sim::PageReply::WithErrorDigit, 1);
    bench.load(holds);
    bench
}

/// Without the checks (`Job::must_confirm`) 10 of the 16 reads failed: page 0 seemed to have
/// changed.
#[tokio::test(start_paused = true)]
async fn no_page_of_a_program_is_a_roaming_duplicate() {
    let holds = program(WORDS, 1);
    let (mut copies, mut wrong) = (0, 0);
    for from in 1..=16 {
        let line = line(&bench(&holds), from);
        match line.station.read_program().await {
            Ok(program) => wrong += usize::from(program != holds),
            Err(error) => {
                println!("from request {from}: {error}");
                wrong += 1;
            }
        }
        copies += line.copies();
    }
    assert_eq!(wrong, 0, "with {copies} copies");
    assert!(copies >= 12, "{copies}");
}

/// Without the checks (`Job::must_confirm`) 10 of the 100 writes failed, without jobs 12: pages
/// seemed to have changed.
#[tokio::test(start_paused = true)]
async fn a_roaming_duplicate_does_not_spoil_a_program_write() {
    let old = program(WORDS, 1);
    // Blank pages are equal: a copy of one may be taken for another.
    let mut pages = program(WORDS, 2).pages().to_vec();
    for page in [3, 4, 6, 7] {
        pages[page] = ProgramPage::new([0xFFFF; PAGE_WORDS]);
    }
    let new = Program::from_pages(pages).unwrap();
    let (mut copies, mut wrong) = (0, 0);
    for (verify, from) in [false, true].into_iter().flat_map(|verify| (1..=50).map(move |from| (verify, from))) {
        let bench = bench(&old);
        bench.plc.run();
        let line = line(&bench, from);
        let options = WriteOptions::new().stop_first(true).run_again(true);
        let options = if verify { options.verify_all(true) } else { options };
        let report = line.station.write_program(&new, options).await;
        let good = report.is_ok() && bench.pages_held() == new.pages() && bench.plc.is_running();
        if let (false, Err(error)) = (good, report) {
            println!("from request {from}: {error}");
        }
        wrong += usize::from(!good);
        copies += line.copies();
        bench.assert_never_ran_a_half(&old, &new);
    }
    assert_eq!(wrong, 0, "with {copies} copies");
    assert!(copies >= 60, "{copies}");
}
