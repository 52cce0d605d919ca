//! Reading from a PLC in memory, without a link.

use super::*;
use crate::command::{ReadDetailedStatus, ReadProgramPage, ReadStatus};
use crate::random::Random;
use crate::sim::{Model, Plc};
use crate::transfer::contract::{self, End};

fn plc(ladder_words: u16, random: &mut Random) -> Plc {
    let plc = Plc::with_model(Model::default().ladder_words(ladder_words));
    for page in 1..plc.pages() {
        plc.set_page(page, ProgramPage::new([0; 64].map(|_: u16| random.next() as u16))).unwrap();
    }
    plc
}

fn pages(plc: &Plc) -> Vec<ProgramPage> {
    (0..plc.pages()).map(|page| plc.page(page).unwrap()).collect()
}

/// Continues for this number of requests; `None` if the program is not complete then.
fn run(reading: &mut Reading, plc: &Plc, requests: usize) -> Result<Option<Program>, ProgramError> {
    for _ in 0..requests {
        let reply = match reading.next()? {
            Step::Send(Request::Status) => Some(Reply::Status(plc.execute(&ReadStatus).unwrap())),
            Step::Send(Request::DetailedStatus) => {
                Some(Reply::DetailedStatus(plc.execute(&ReadDetailedStatus).unwrap()))
            }
            Step::Send(Request::ReadPage(page)) => Some(Reply::Page(plc.execute(&ReadProgramPage::new(page)).unwrap())),
            Step::Send(request) => panic!("{request:?}"),
            Step::Confirm => None,
            Step::Done => return reading.finish(SystemTime::UNIX_EPOCH).map(Some),
        };
        if let Some(reply) = reply {
            reading.handle(Ok(reply))?;
        }
        // Every reply is confirmed at once.
        reading.confirmed(Ok(()))?;
    }
    Ok(None)
}

#[test]
fn every_page_of_a_program_of_any_size_is_read_once() {
    for (words, count) in [(0, 1), (1, 2), (64, 2), (65, 3), (8192, 129), (13_184, 207), (u16::MAX, 1025)] {
        let plc = plc(words, &mut Random::new(words.into()));
        let mut reading = Reading::default();
        reading.begin();
        // 40, 53, the pages, and header and 53 again. Each is confirmed at once, without a request.
        assert_eq!(run(&mut reading, &plc, count + 4).unwrap(), None);
        let program = run(&mut reading, &plc, 1).unwrap().unwrap();
        assert_eq!((program.pages(), program.ladder_words()), (&pages(&plc)[..], words));
        assert_eq!(program.words().count(), usize::from(words));
    }
}

#[test]
fn a_reading_interrupted_anywhere_continues_there() {
    let plc = plc(320, &mut Random::new(1));
    for twice in [false, true] {
        for interrupted_after in 0..20 {
            let mut reading = Reading { twice, ..Reading::default() };
            reading.begin();
            let done = match run(&mut reading, &plc, interrupted_after).unwrap() {
                Some(program) => program,
                None => {
                    let kept = reading.pages_done();
                    assert_eq!(kept, interrupted_after.saturating_sub(2).min(6));
                    reading.begin();
                    assert!(run(&mut reading, &plc, 2 + usize::from(kept > 0)).unwrap().is_none());
                    assert_eq!(reading.pages_done(), kept);
                    run(&mut reading, &plc, 100).unwrap().unwrap()
                }
            };
            assert_eq!(done.pages(), pages(&plc));
        }
    }
}

#[test]
fn reading_twice_notices_any_change_of_two_pages() {
    for seed in 0..2000 {
        let mut random = Random::new(seed);
        let plc = plc(320, &mut random);
        let before = pages(&plc);
        let mut reading = Reading { twice: true, ..Reading::default() };
        reading.begin();
        let at = random.next() as usize % 17;
        let done = run(&mut reading, &plc, at).unwrap();
        // Two at once: with one, either program is read whole in any case.
        let changed = [random.next() as u16 % 3, 3 + random.next() as u16 % 3];
        for page in changed {
            let mut bytes = plc.page(page).unwrap().to_bytes();
            // In the header a digit changes, so that it stays one.
            bytes[3] = if page == 0 { b'7' } else { !bytes[3] };
            plc.set_page(page, ProgramPage::from_bytes(&bytes)).unwrap();
        }
        let result = done.map_or_else(|| run(&mut reading, &plc, 100).map(Option::unwrap), Ok);
        match result {
            Ok(program) => {
                let whole = program.pages() == pages(&plc) || program.pages() == before;
                assert!(whole, "seed {seed}: a mixture");
            }
            Err(ProgramError::Changed { page: Some(found) }) => {
                assert!(changed.contains(&found), "seed {seed}: {found}");
                // No page is kept, and the next run reads the new program.
                assert_eq!(reading.pages_done(), 0);
                reading.begin();
                assert_eq!(run(&mut reading, &plc, 100).unwrap().unwrap().pages(), pages(&plc), "seed {seed}");
            }
            Err(error) => panic!("seed {seed}: {error}"),
        }
    }
}

#[test]
fn another_plc_or_size_in_the_middle_is_noticed() {
    let small = plc(320, &mut Random::new(1));
    for other in [
        Plc::with_model(Model::default().ladder_words(640)),
        Plc::with_model(Model::default().ladder_words(320).os_version(4, 0)),
        Plc::with_model(Model::default().ladder_words(320).main_unit(0)),
    ] {
        // There must be a status to compare with.
        for at in 2..10 {
            let mut reading = Reading::default();
            reading.begin();
            assert!(run(&mut reading, &small, at).unwrap().is_none());
            reading.begin();
            let error = run(&mut reading, &other, 100).unwrap_err();
            assert!(matches!(error, ProgramError::Changed { page: None }), "{error}");
            assert_eq!(reading.pages_done(), 0);
        }
    }
    let other_program = plc(320, &mut Random::new(2));
    let mut header = other_program.page(0).unwrap().to_bytes();
    header[3] = b'9';
    other_program.set_page(0, ProgramPage::from_bytes(&header)).unwrap();
    let mut reading = Reading::default();
    reading.begin();
    assert!(run(&mut reading, &small, 5).unwrap().is_none());
    let error = run(&mut reading, &other_program, 100).unwrap_err();
    assert_eq!(error.to_string(), "the program changed while it was read: page 0 is different now");
}

#[test]
fn a_bad_header_is_refused_with_its_fault() {
    for (at, bytes, message) in [
        (0, *b"XB", "page 0: it begins with 58 42, where `FB` or `FM` was expected"),
        (1, *b"X0", "page 0: it begins with 46 58, where `FB` or `FM` was expected"),
        (2, *b"1x", "page 0: bytes 2 and 3 are 31 78, where two digits were expected"),
        (4, [1, 0], "page 0: the header states a ladder of 256 words, and the status (53) one of 320"),
    ] {
        let plc = plc(320, &mut Random::new(1));
        let good = plc.page(0).unwrap();
        let mut header = good.to_bytes();
        header[at..at + 2].copy_from_slice(&bytes);
        plc.set_page(0, ProgramPage::from_bytes(&header)).unwrap();
        let mut reading = Reading::default();
        reading.begin();
        let error = run(&mut reading, &plc, 100).unwrap_err();
        assert!(error.to_string().ends_with(message), "{error}");
        plc.set_page(0, good).unwrap();
        reading.begin();
        assert!(run(&mut reading, &plc, 100).unwrap().is_some());
    }
}

#[test]
fn reading_keeps_the_contract_of_a_transfer() {
    for seed in 0..100 {
        let mut random = Random::new(seed);
        // A second reading begins again in each run.
        let twice = random.next().is_multiple_of(2);
        let plc = plc(if twice { 320 } else { 6400 }, &mut random);
        let mut reading = Reading { twice, ..Reading::default() };
        let mut done = 0;
        loop {
            reading.begin();
            if let End::Done = contract::run(&mut reading, &plc, &mut random, 10) {
                break;
            }
            assert!(reading.pages_done() >= done, "seed {seed}: confirmed pages are lost");
            done = reading.pages_done();
        }
        assert_eq!(reading.finish(SystemTime::UNIX_EPOCH).unwrap().pages(), pages(&plc), "seed {seed}");
    }
}
