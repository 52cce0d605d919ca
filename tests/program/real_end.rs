//! PLCs whose program memory ends before the size that they state.

use fatek::command::Code;
use fatek::program::{Program, ProgramError, ReadProgram, WriteOptions, WriteProgram};
use fatek::sim::{Fault, Model, PageReply, Rule};
use fatek::{Error, ErrorCode};

use crate::bench::{Bench, program, seeds};

/// An FBs states 32768 words, 513 pages, and has 20 K.
const STATED: u16 = 32_768;
const REAL: u16 = 320;

fn bench(seed: u64) -> (Bench, Program) {
    let form = if seed.is_multiple_of(2) { PageReply::WithErrorDigit } else { PageReply::Bare };
    let model = Model::default().ladder_words(STATED).page_reply(form).real_last_page(REAL);
    let (bench, whole) = (Bench::with_model(model, seed), program(STATED, seed));
    for (page, content) in (0..=REAL).zip(whole.pages()) {
        bench.plc.set_page(page, content.clone()).unwrap();
    }
    (bench, whole)
}

/// Before, the reading failed at page 321, and nothing could be saved.
#[tokio::test(start_paused = true)]
async fn a_reading_ends_at_the_real_end_and_says_so() {
    for (seed, twice) in seeds(4).zip([false, true].into_iter().cycle()) {
        let (bench, whole) = bench(seed);
        let read = ReadProgram::new().twice(twice).run(&bench.station()).await.unwrap();
        assert_eq!(read.refused_page(), Some(REAL + 1));
        assert_eq!((read.pages(), read.ladder_words()), (&whole.pages()[..=usize::from(REAL)], STATED));
        assert_eq!(read.words().count(), 64 * usize::from(REAL));
        assert_eq!(read.differing_pages(&whole), (REAL + 1..513).collect::<Vec<_>>());
        // The file has the same pages, and says where they end.
        let saved = read.to_file();
        assert!(saved.contains("\npages 321 of 513\n"));
        let loaded = Program::from_file(saved.as_bytes()).unwrap();
        assert_eq!((&loaded, loaded.refused_page()), (&read, read.refused_page()));
        assert_eq!(whole.refused_page(), None);
    }
}

/// A run that fails behind the end asks for it again.
#[tokio::test(start_paused = true)]
async fn a_reading_interrupted_at_the_end_continues_there() {
    let (bench, whole) = bench(1);
    for lost in 300..340 {
        let station = bench.station();
        let rule = Rule::new(Fault::Disconnect(fatek::sim::DisconnectAt::BeforeReply));
        bench.faults.set_rules([rule.command(Code::ReadProgramPage).skip(lost).times(1)]);
        let mut read = ReadProgram::new();
        let program = loop {
            match read.run(&station).await {
                Ok(program) => break program,
                Err(ProgramError::Call { .. }) => {}
                Err(error) => panic!("{error}"),
            }
        };
        assert_eq!(program.pages(), &whole.pages()[..=usize::from(REAL)], "{lost}");
    }
}

/// A single refusal is no end: the last page is read.
#[tokio::test(start_paused = true)]
async fn a_refused_page_among_others_is_an_error() {
    let bench = Bench::new(640, PageReply::Bare, 1);
    bench.load(&program(640, 1));
    let rule = Rule::new(Fault::Error(ErrorCode::IllegalAddress)).command(Code::ReadProgramPage);
    // The first refusal is not proven, since a page is owed: the page is asked for again.
    bench.faults.add_rule(rule.skip(5).times(2));
    let error = ReadProgram::new().run(&bench.station()).await.unwrap_err();
    assert!(
        matches!(&error, ProgramError::Call { source: Error::Plc { error: ErrorCode::IllegalAddress, .. }, .. }),
        "{error}"
    );
    assert!(error.to_string().starts_with("cannot read page 5: "), "{error}");
    // Nor are two refusals in a row: the page is asked for again when all others are read.
    for refused in 3..12 {
        let rule = Rule::new(Fault::Error(ErrorCode::IllegalAddress)).command(Code::ReadProgramPage);
        bench.faults.set_rules([rule.skip(5).times(refused)]);
        match ReadProgram::new().run(&bench.station()).await {
            Ok(whole) => assert_eq!((whole.refused_page(), whole.pages().len()), (None, 11), "{refused}"),
            Err(ProgramError::Call { .. }) => {}
            Err(error) => panic!("{refused}: {error}"),
        }
    }
    // Nor is another refusal, such as one of a PLC that runs.
    bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::NotSupported)).command(Code::ReadProgramPage).skip(3)]);
    assert!(ReadProgram::new().run(&bench.station()).await.is_err());
    // A PLC that refuses all of the ladder has no program.
    bench.faults.set_rules([Rule::new(Fault::Error(ErrorCode::IllegalAddress)).command(Code::ReadProgramPage).skip(1)]);
    assert!(ReadProgram::new().run(&bench.station()).await.is_err());
}

#[tokio::test(start_paused = true)]
async fn a_program_that_ends_early_is_written_only_to_such_a_plc() {
    let (bench, _) = bench(2);
    let read = ReadProgram::new().run(&bench.station()).await.unwrap();
    let (same, _) = self::bench(3);
    let mut write = WriteProgram::new(&read, WriteOptions::new());
    let report = write.run(&same.station()).await.unwrap();
    assert_eq!(report.pages, REAL + 1);
    assert_eq!(same.pages_held(), read.pages());
    // One with fewer pages is not written at all, also without a comparison.
    let shorter = Bench::with_model(Model::default().ladder_words(STATED).real_last_page(200), 5);
    let before = shorter.pages_held();
    let options = WriteOptions::new().all_pages(true).stop_first(true);
    assert!(WriteProgram::new(&read, options).run(&shorter.station()).await.is_err());
    assert_eq!(shorter.pages_held(), before);
    // A PLC with more pages would keep those of another program behind it.
    let larger = Bench::with_model(Model::default().ladder_words(STATED), 4);
    let before = larger.pages_held();
    let error = WriteProgram::new(&read, WriteOptions::new()).run(&larger.station()).await.unwrap_err();
    assert!(matches!(*error.source, ProgramError::HasRefusedPage { page: 321, .. }), "{error}");
    assert_eq!(larger.pages_held(), before);
}
