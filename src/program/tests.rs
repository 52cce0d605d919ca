use std::time::{Duration, SystemTime};

use proptest::prelude::*;

use super::*;
use crate::command::{BriefStatus, DetailedStatus};

fn program(ladder_words: u16, seed: u16, known: bool) -> Program {
    let mut header = [0xFF; PAGE_BYTES];
    header[..4].copy_from_slice(b"FB07");
    header[4..6].copy_from_slice(&ladder_words.to_be_bytes());
    let ladder =
        (1..header::page_count(ladder_words)).map(|page| ProgramPage::new([page.wrapping_mul(seed); PAGE_WORDS]));
    let pages = [ProgramPage::from_bytes(&header)].into_iter().chain(ladder).collect();
    let program = Program::from_pages(pages).unwrap();
    if !known {
        return program;
    }
    let origin = Origin {
        brief: Some(BriefStatus::from_raw([1, 0x54, 0])),
        detailed: DetailedStatus::from_raw(vec![0x31; 64]),
        read_at: Some(SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000)),
    };
    Program { origin, ..program }
}

#[test]
fn a_program_can_be_read_again_from_its_file() {
    for program in [program(8192, 3, true), program(13_184, 5, false), program(0, 0, true), program(65, 1, false)] {
        let read = Program::from_file(program.to_file().as_bytes()).unwrap();
        assert_eq!(read.pages, program.pages);
        assert_eq!(read.origin, program.origin);
        assert_eq!(read.to_file(), program.to_file());
    }
    let file = program(64, 0x0101, true).to_file();
    let head = "fatek file 1: program\nlength 779\nread 2001-09-09T01:46:40Z\n\
                about FB07, 64 words, from FBE 13K, main unit unknown (31h), OS 3.1\nbrief 015400\nstatus 3131";
    assert!(file.starts_with(head), "{file}");
    assert!(file.contains("\npages 2\npage 0 464230370040FFFF"), "{file}");
}

#[test]
fn a_bit_flip_and_a_truncation_of_a_file_are_refused() {
    for known in [false, true] {
        let file = program(64, 7, known).to_file().into_bytes();
        for bit in 0..file.len() * 8 {
            let mut flipped = file.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(Program::from_file(&flipped).is_err(), "bit {bit}");
        }
        for len in 0..file.len() {
            assert!(Program::from_file(&file[..len]).is_err(), "{len} bytes");
        }
    }
}

#[test]
fn bad_content_with_a_good_checksum_is_refused_by_line() {
    let good = program(64, 7, true).to_file();
    let content = file::unframe(file::Kind("program"), good.as_bytes()).unwrap().text;
    for (from, to, message) in [
        ("read 2001-", "read 20x1-", "line 3: `read`: a time such as 2026-11-22T07:09:13Z, or `-`, was expected"),
        ("pages 2", "pages +2", "line 7: `pages 2` was expected"),
        ("pages 2", "pages 02", "line 7: `pages 2` was expected"),
        ("about ", "model ", "line 4: `about` was expected"),
        ("brief 015400", "brief 0154", "line 5: `brief`: three bytes in hexadecimal digits, or `-`, was expected"),
        ("brief 015400", "brief -", "line 6: `read`, `brief` and `status` must be known together"),
        ("status 31", "status 3g", "line 6: `status`: 28 to 249 bytes in hexadecimal digits, or `-`, was expected"),
        ("pages 2", "pages two", "line 7: a number of pages was expected"),
        ("pages 2", "pages 3", "line 10: `page` was expected, and the content ends"),
        ("pages 2", "pages 1", "line 9: the content should end before this line"),
        ("pages 2", "pages 99999999999999999", "line 10: `page` was expected, and the content ends"),
        ("page 1 0007", "page 2 0007", "line 9: page 1 was expected"),
        ("page 1 0007", "page 1 07", "line 9: 256 hexadecimal digits were expected"),
        ("page 0 4642", "page 0 4643", "page 0: it begins with 46 43, where `FB` or `FM` was expected"),
        (
            "page 0 464230370040",
            "page 0 464230370041",
            "2 pages, where 3 were expected: page 0 states a ladder of 65 words",
        ),
    ] {
        assert!(content.contains(from), "{from}");
        let bad = file::frame(file::Kind("program"), &content.replacen(from, to, 1));
        let error = Program::from_file(bad.as_bytes()).unwrap_err().to_string();
        assert!(error.starts_with(message), "{from} → {to}: {error}");
    }
}

#[test]
fn the_field_for_people_may_differ() {
    let good = program(64, 7, true);
    let file = good.to_file();
    let content = file::unframe(file::Kind("program"), file.as_bytes()).unwrap().text;
    for (from, to) in [("about FB07", "about FB08"), ("OS 3.1", "OS 3.1, with words of another version")] {
        assert!(content.contains(from), "{from}");
        let other = file::frame(file::Kind("program"), &content.replacen(from, to, 1));
        let read = Program::from_file(other.as_bytes()).unwrap();
        assert_eq!((&read, read.to_file()), (&good, file.clone()));
    }
}

#[test]
fn raw_bytes_are_read_again_or_refused() {
    let program = program(13_184, 3, true);
    let bytes = program.to_bytes();
    assert_eq!(bytes.len(), 207 * 128);
    let read = Program::from_bytes(&bytes).unwrap();
    assert_eq!((&read, read.status()), (&program, None));
    let error = |bytes: &[u8]| Program::from_bytes(bytes).unwrap_err().to_string();
    assert_eq!(error(&[]), "there is no page 0");
    assert_eq!(error(&bytes[1..]), "26495 bytes are no whole pages: a page has 128");
    assert!(error(&bytes[128..]).starts_with("page 0: it begins with 00 03"));
    assert_eq!(
        error(&bytes[..206 * 128]),
        "206 pages, where 207 were expected: page 0 states a ladder of 13184 words, 64 a page"
    );
}

#[test]
fn files_of_both_forms_are_saved_and_loaded() {
    let folder = std::env::temp_dir().join(format!("fatek-program-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let (path, raw) = (folder.join("a.program"), folder.join("a.bin"));
    let program = program(8192, 3, true);
    program.save(&path).unwrap();
    program.save_raw(&raw).unwrap();
    let loaded = Program::load(&path).unwrap();
    assert_eq!((&loaded, loaded.read_at()), (&program, program.read_at()));
    assert_eq!(Program::load_raw(&raw).unwrap(), program);
    let error = Program::load(&raw).unwrap_err().to_string();
    assert!(error.ends_with("a.bin: not a file of this kind: it does not begin with `fatek file`"), "{error}");
    let error = Program::load_raw(&path).unwrap_err().to_string();
    assert!(error.contains("a.program: ") && error.ends_with("bytes are no whole pages: a page has 128"), "{error}");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn programs_are_compared_page_by_page() {
    let one = program(13_184, 3, true);
    assert!(one.differing_pages(&one).is_empty());
    let mut pages = one.pages().to_vec();
    pages[206] = ProgramPage::new([1; PAGE_WORDS]);
    pages[17] = ProgramPage::new([2; PAGE_WORDS]);
    let other = Program::from_pages(pages).unwrap();
    assert_eq!(one.differing_pages(&other), [17, 206]);
    assert!(one != other);
    let shorter = program(13_120, 3, false);
    assert_eq!(one.differing_pages(&shorter), [0, 206]);
    assert_eq!(shorter.differing_pages(&one), [0, 206]);
    assert_eq!(one.words().nth(64), Some(6));
}

proptest! {
    #[test]
    fn no_content_of_a_file_causes_a_panic(
        content in "([ -~]{0,20}\n){0,8}",
        bytes in prop::collection::vec(any::<u8>(), 0..400),
    ) {
        let _ = Program::from_file(file::frame(file::Kind("program"), &content).as_bytes());
        let _ = Program::from_file(&bytes);
        let _ = Program::from_bytes(&bytes);
    }

    #[test]
    fn any_program_can_be_read_again_from_its_file(words in 0..2000_u16, seed: u16, known: bool) {
        let program = program(words, seed, known);
        let read = Program::from_file(program.to_file().as_bytes()).unwrap();
        prop_assert_eq!(&read.pages, &program.pages);
        prop_assert_eq!(read.origin, program.origin);
    }
}
