//! Files of every version of the format: `tests/fixtures` has one of each, and artificial ones of a
//! newer minor version (1.9) and a newer major one (2). A fixture is never changed: files of users
//! look like it.

use std::fs;
use std::path::PathBuf;

use fatek::backup::Missing;
use fatek::file::{FileError, FormatError};
use fatek::{Backup, ErrorCode, Program, Value, element};

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn text(name: &str) -> String {
    fs::read_to_string(fixture(name)).unwrap()
}

fn check_program(program: &Program) {
    assert_eq!((program.ladder_words(), program.pages().len()), (64, 2));
    assert!(program.words().eq((0..64).map(|word| word * 257)));
    assert_eq!(program.status().map(|status| status.raw().to_vec()), program.read_at().map(|_| vec![0x31; 64]));
}

fn check_backup(backup: &Backup) {
    assert_eq!((backup.station(), backup.element_count(), backup.value_count()), (Some(7), 34, 27));
    assert_eq!(backup.value(element!("R4")), Some(Ok(Value::Word(0xEF37))));
    assert_eq!(backup.value(element!("R7")), Some(Err(Missing::Refused(ErrorCode::IllegalAddress))));
    assert_eq!(backup.value(element!("M61")), Some(Ok(Value::Bit(true))));
    assert_eq!(backup.value(element!("DR102")), Some(Err(Missing::NotRead)));
}

#[test]
fn files_of_version_1_are_read_and_written_alike() {
    for name in ["program-1.program", "program-1-bare.program"] {
        let program = Program::load(fixture(name)).unwrap();
        check_program(&program);
        assert_eq!((program.to_file(), program.unknown_fields().len()), (text(name), 0), "{name}");
    }
    let backup = Backup::load(fixture("backup-1.backup")).unwrap();
    check_backup(&backup);
    assert_eq!((backup.to_file(), backup.unknown_fields().len()), (text("backup-1.backup"), 0));
}

#[test]
fn unknown_fields_of_a_newer_minor_version_are_named() {
    let program = Program::load(fixture("program-1.9.program")).unwrap();
    check_program(&program);
    assert_eq!(program.unknown_fields(), ["name", "tool", "comment"]);
    assert_eq!(program.to_file(), text("program-1.program"));
    let backup = Backup::load(fixture("backup-1.9.backup")).unwrap();
    check_backup(&backup);
    assert_eq!(backup.unknown_fields(), ["plant", "label"]);
    assert_eq!(backup.to_file(), text("backup-1.backup"));
    // A part of it was read from the same file.
    let part = backup.select(["D5".parse().unwrap()]).unwrap();
    assert_eq!(part.unknown_fields(), backup.unknown_fields());
}

#[test]
fn another_major_version_is_refused_by_name() {
    for error in [
        Program::load(fixture("program-2.program")).unwrap_err(),
        Backup::load(fixture("backup-2.backup")).unwrap_err(),
    ] {
        let text = error.to_string();
        assert!(
            text.ends_with("format version 2 needs a newer version of this library, which reads version 1"),
            "{text}"
        );
        let FileError::Format { source: FormatError::Version { found, known, .. }, .. } = error else {
            panic!("{error}")
        };
        assert_eq!((&*found, known), ("2", 1));
    }
}

#[test]
fn an_error_in_a_newer_minor_version_names_its_line() {
    for (name, from, to, message) in [
        ("program-1.9.program", "pages 2", "pages 3", "line 14: `page` was expected, and the content ends"),
        ("program-1.9.program", "page 1 0000", "page 1 000g", "line 12: 256 hexadecimal digits were expected"),
        ("backup-1.9.backup", "M60 0101", "M60 0121", "line 17: values as wide as the element"),
        // A name in lower case is an unknown field, so the elements are missing.
        ("backup-1.9.backup", "R13 5827", "r13 5827", "line 14: `R13` was expected, or `missing R13`"),
    ] {
        let file = sealed(&text(name).replacen(from, to, 1));
        let error = match name.starts_with("program") {
            true => Program::from_file(file.as_bytes()).unwrap_err(),
            false => Backup::from_file(file.as_bytes()).unwrap_err(),
        };
        assert!(error.to_string().starts_with(message), "{name}, {to}: {error}");
    }
}

/// The file with a good checksum. Its length is that of the fixture.
fn sealed(file: &str) -> String {
    let (content, _) = file.rsplit_once("crc32 ").unwrap();
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
    let crc = content.bytes().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(byte), |crc, _| step(crc)));
    format!("{content}crc32 {:08X}\n", !crc)
}

/// Reads a file. Returns the file of its content.
type Read = fn(&[u8]) -> Result<String, FormatError>;

/// All fixtures of version 1.
fn files() -> Vec<(String, Read)> {
    let program = |bytes: &[u8]| Program::from_file(bytes).map(|program| program.to_file());
    let backup = |bytes: &[u8]| Backup::from_file(bytes).map(|backup| backup.to_file());
    vec![
        (text("program-1.program"), program),
        (text("program-1-bare.program"), program),
        (text("backup-1.backup"), backup),
    ]
}

#[test]
fn no_truncated_file_is_read() {
    let mut count = 0;
    for (file, read) in files() {
        assert_eq!(read(file.as_bytes()).unwrap(), file);
        for len in 0..file.len() {
            read(&file.as_bytes()[..len]).unwrap_err();
            count += 1;
        }
    }
    println!("{count} truncated files refused");
    assert!(count >= 942);
}

#[test]
fn no_file_with_one_changed_bit_or_byte_is_read() {
    let mut count = 0;
    for (file, read) in files() {
        for at in 0..file.len() {
            let mut changed = file.clone().into_bytes();
            // Each bit, and the digits of another value: those pass all rules but the checksum.
            let others = (0..8).map(|bit| changed[at] ^ (1 << bit)).chain(*b"07AF \n");
            for other in others.collect::<Vec<_>>() {
                let before = std::mem::replace(&mut changed[at], other);
                if other != before {
                    read(&changed).unwrap_err();
                    count += 1;
                }
                changed[at] = before;
            }
        }
    }
    println!("{count} changed files refused");
    assert!(count >= 800);
}

/// The process that [`a_process_killed_while_it_saves_leaves_a_whole_file`] kills: it saves two
/// contents in turn, without end.
#[test]
fn saves_without_end() {
    let Some(path) = std::env::var_os("FATEK_SAVES_WITHOUT_END") else { return };
    let contents = ["program-1.program", "program-1-bare.program"].map(|name| Program::load(fixture(name)).unwrap());
    for program in contents.iter().cycle() {
        program.save(&path).unwrap();
    }
}

/// Unix only: elsewhere left-over files are removed by their age.
///
/// Before: 149 of 150 killed processes left a file beside it, for ever. The file itself was whole.
#[cfg(unix)]
#[test]
fn a_process_killed_while_it_saves_leaves_a_whole_file() {
    const KILLS: u64 = 150;
    let folder = std::env::temp_dir().join(format!("fatek-killed-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    let path = folder.join("file");
    let contents = ["program-1.program", "program-1-bare.program"].map(text);
    fs::write(&path, &contents[0]).unwrap();
    let files = || fs::read_dir(&folder).unwrap().count();
    let mut in_the_middle = 0;
    for n in 0..KILLS {
        let mut child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "saves_without_end", "--nocapture"])
            .env("FATEK_SAVES_WITHOUT_END", &path)
            .stdout(std::process::Stdio::null())
            .spawn()
            .unwrap();
        // It has begun when the file is another one; then at any time within some saves.
        let begun = |file: &str| fs::read_to_string(&path).is_ok_and(|now| now != file);
        let before = fs::read_to_string(&path).unwrap();
        while !begun(&before) {
            assert_eq!(child.try_wait().unwrap(), None);
            std::thread::sleep(std::time::Duration::from_micros(50));
        }
        std::thread::sleep(std::time::Duration::from_micros(n * 37 % 3000));
        child.kill().unwrap();
        child.wait().unwrap();
        let now = fs::read_to_string(&path).unwrap();
        assert!(contents.contains(&now), "kill {n}: {now}");
        in_the_middle += u32::from(files() > 1);
        assert!(files() <= 2, "kill {n}: the left-over file of the kill before was not removed");
    }
    println!("{in_the_middle} of {KILLS} processes were killed in the middle of a save");
    assert!(in_the_middle > 0);
    Program::load(&path).unwrap().save(&path).unwrap();
    assert_eq!(files(), 1, "the next save removes left-over files");
    fs::remove_dir_all(&folder).unwrap();
}
