//! Backups in memory and in files, without a PLC.

use std::time::{Duration, SystemTime};

use proptest::prelude::*;

use super::*;
use crate::command::{BriefStatus, DetailedStatus};
use crate::element;
use crate::element::{Symbol, Width};
use crate::file;
use crate::file::Kind;
use crate::tag::TagType;

fn tags<const N: usize>(texts: [&str; N]) -> [Tag; N] {
    texts.map(|text| text.parse().unwrap())
}

fn of<const N: usize>(texts: [&str; N]) -> Result<Backup, InvalidBackup> {
    Backup::of(tags(texts))
}

fn value(element: Element, bits: u32) -> Value {
    match element.width() {
        Width::Bit => Value::Bit(bits & 1 == 1),
        Width::Word => Value::Word(bits as u16),
        Width::DWord => Value::DWord(bits),
    }
}

/// All elements are read, with different values as far as possible.
fn read(mut backup: Backup) -> Backup {
    for block in &mut backup.blocks {
        for (cell, (place, element)) in block.cells.iter_mut().zip((0_u32..).zip(block.range.elements())) {
            *cell = Ok(value(element, place.wrapping_mul(0x9E37_79B9) >> 3));
        }
    }
    backup
}

fn small() -> Backup {
    let mut backup = read(of(["R3-R22:f32", "M60-M70", "DR100-DR102", "D5"]).unwrap());
    backup.station = Some(7);
    backup.origin = Origin {
        read_at: Some(SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000)),
        brief: Some(BriefStatus::from_raw([1, 0x54, 0])),
        detailed: DetailedStatus::from_raw((0..28).collect::<Vec<u8>>()),
    };
    backup.blocks[0].cells[4..8].fill(Err(Missing::Refused(ErrorCode::IllegalAddress)));
    backup.blocks[0].cells[8..10].fill(Err(Missing::Refused(ErrorCode::Unknown(0x1F))));
    backup.blocks[2].cells[1] = Err(Missing::NotRead);
    backup
}

/// The content of the file of `small`.
const CONTENT: &str = "\
station 7
read 2001-09-09T01:46:40Z
about main unit MC, OS 0.3, RUN
brief 015400
status 000102030405060708090A0B0C0D0E0F101112131415161718191A1B
range R3-R22:u32
R3 0000 EF37 DE6E CDA5
missing R7-R10 refused A
missing R11-R12 refused 1F
R13 5827 475E 3695 25CC 1503 043A
R19 F372 E2A9 D1E0 C117
range M60-M70
M60 01010101 101
range DR100-DR102
DR100 00000000
missing DR102 not-read
range D5
D5 0000
";

#[test]
fn a_backup_can_be_read_again_from_its_file() {
    let file = small().to_file();
    let content = file::unframe(Kind("backup"), file.as_bytes()).unwrap();
    assert_eq!(content.text, CONTENT);
    assert!(file.starts_with("fatek file 1: backup\nlength "), "{file}");
    for backup in [small(), of(["R0-R9"]).unwrap(), read(of(["R0-R65535", "M0-M9999", "DD1-DD65533"]).unwrap())] {
        let again = Backup::from_file(backup.to_file().as_bytes()).unwrap();
        assert_eq!(again, backup);
        assert_eq!(again.to_file(), backup.to_file());
    }
}

#[test]
fn a_changed_byte_and_a_truncation_are_refused() {
    let file = small().to_file().into_bytes();
    for place in 0..file.len() {
        for byte in 0..=u8::MAX {
            let mut changed = file.clone();
            changed[place] = byte;
            assert!(byte == file[place] || Backup::from_file(&changed).is_err(), "byte {place} as {byte:02X}");
        }
        assert!(Backup::from_file(&file[..place]).is_err(), "{place} bytes");
    }
}

#[test]
fn bad_content_with_a_good_checksum_is_refused_by_line() {
    let error =
        |content: &str| Backup::from_file(file::frame(Kind("backup"), content).as_bytes()).unwrap_err().to_string();
    for (from, to, message) in [
        ("station 7", "station 255", "line 3: `station`: a number from 1 to 254, or `-`, was expected"),
        ("station 7", "station 07", "line 3: `station 7` was expected"),
        ("read 2001-", "read 20x1-", "line 4: `read`: a time such as"),
        ("about ", "model ", "line 5: `about` was expected"),
        ("brief 0154", "brief 54", "line 6: `brief`: three bytes in hexadecimal digits, or `-`, was expected"),
        ("status 00", "status ", "line 7: `status`: 28 to 249 bytes"),
        ("range R3-R22:u32", "range R3-R22:f32", "line 8: `range R3-R22:u32` was expected"),
        ("range R3-R22:u32", "range R3-R2", "`R3-R2` is not a tag"),
        (
            "range R3-R22:u32",
            "range R3-R22:u32\nrange R23",
            "line 9: the range R3-R22:u32 is not whole: R3 was expected",
        ),
        ("R3 0000", "R3 0000 0000", "line 9: a value of several registers would be cut in two here"),
        ("R3 0000", "R3 000", "line 9: values as wide as the element"),
        ("R3 0000", "R3 00000000", "line 9: values as wide as the element"),
        ("R3 0000", "R3 +000", "line 9: values as wide as the element"),
        ("R3 0000 EF37", "R3 0000 EF37\nR5", "line 9: `R3 0000 EF37 DE6E CDA5` was expected"),
        ("R3 0000", "r3 0000", "line 9: `R3` was expected"),
        ("R7-R10 refused A", "R7-R10 refused 0", "line 10: elements from R7 on, and why they are missing"),
        ("R7-R10 refused A", "R7-R10 refused 0A", "line 10: `missing R7-R10 refused A` was expected"),
        ("R7-R10 refused A", "R7-R10", "line 10: elements from R7 on"),
        ("R7-R10 refused A", "R7-R99 refused A", "line 10: elements from R7 on"),
        ("R7-R10 refused A", "M7-M10 refused A", "line 10: elements from R7 on"),
        ("R7-R10 refused A", "R7-R22 refused A", "line 11: `range` was expected"),
        ("01010101", "01010201", "line 15: values as wide"),
        ("01010101", "0101010 1", "line 15: `M60 01010101 101` was expected"),
        ("01010101 101", "01010101 1011", "line 15: these are more elements than the range M60-M70 has"),
        ("range D5\nD5 0000\n", "range D5\n", "the range D5 is not whole: D5 was expected"),
        ("range D5\n", "range R10\n", "share memory"),
        ("D5 0000\n", "D5 0000\nD6 0000\n", "line 21: the content should end before this line"),
        ("D5 0000\n", "D5 0000", "the last line should end with a line feed"),
    ] {
        assert_eq!(CONTENT.matches(from).count(), 1, "{from}");
        let error = error(&CONTENT.replace(from, to));
        assert!(error.contains(message), "{to}: {error}");
    }
    assert_eq!(error(""), "line 3: `station` was expected, and the content ends");
    let no_ranges = &CONTENT[..CONTENT.find("range").unwrap()];
    assert_eq!(error(no_ranges), "line 8: there are no ranges: at least one was expected");
    // No number of ranges allocates memory for more elements than there are.
    assert!(error(&CONTENT.replace("range D5\n", &"range F0-F65535\n".repeat(10_000))).contains("share memory"));
    let program = CONTENT.replace("range", "page");
    let foreign = file::frame(Kind("program"), &program);
    let foreign = Backup::from_file(foreign.as_bytes()).unwrap_err().to_string();
    assert!(foreign.contains("it holds `program`, where `backup` was expected"), "{foreign}");
}

#[test]
fn ranges_that_share_memory_are_refused() {
    for [one, other] in [
        ["R0-R9", "R9-R12"],
        ["R0-R9", "DR8"],
        ["DR0-DR8", "R9"],
        ["M0-M15", "WM8"],
        ["DWM0", "M31"],
        ["WY0-WY16", "DWY0"],
        ["RC198", "DRC197"],
        ["R0", "R0"],
        ["D0-D99", "DD98:i32"],
    ] {
        for ranges in [["X0", one, "R5000", other], [other, "X0", one, "R5000"]] {
            let error = of(ranges).unwrap_err();
            let InvalidBackup::Overlap { first, second } = error else { panic!("{error}") };
            let named = [first, second].map(|range| range.first());
            assert!(tags([one, other]).iter().all(|range| named.contains(&range.first())), "{ranges:?}: {error}");
        }
    }
    assert_eq!(Backup::of([]), Err(InvalidBackup::Empty));
    // It was taken for the whole register, whose other bits a restore would have written.
    let error = Backup::of(tags(["R0-R3", "R5.3"])).unwrap_err();
    assert_eq!(error.to_string(), "R5.3 is a part of R5, and a backup has whole registers");
    of(["R0-R9", "R10", "DR11", "RT0-RT9", "T0-T9", "WM0", "M16", "DWM24", "D0-D9", "F0-F9", "RC0", "DRC1"]).unwrap();
}

#[test]
fn of_a_type_only_the_size_of_a_value_is_kept() {
    for (range, plain) in [
        ("R0-R9:i16*0.1-40", "R0-R9"),
        ("R0-R9:f32", "R0-R9:u32"),
        ("R0:i32*0.5", "R0:u32"),
        ("R0-R1:text", "R0-R1"),
        ("DR0-DR4:f32", "DR0-DR4"),
        ("WM0:hex", "WM0"),
        ("M0-M9", "M0-M9"),
    ] {
        assert_eq!(of([range]).unwrap().ranges().map(|range| range.to_string()).collect::<Vec<_>>(), [plain]);
    }
}

#[test]
fn a_part_of_a_backup_is_a_backup() {
    let backup = small();
    let part = backup.select(tags(["M62-M63", "R5-R8", "DR102"])).unwrap();
    assert_eq!(part.ranges().map(|range| range.to_string()).collect::<Vec<_>>(), ["M62-M63", "R5-R8:u32", "DR102"]);
    assert!(part.elements().all(|(element, cell)| backup.value(element) == Some(cell)));
    assert_eq!((part.station(), part.read_at()), (backup.station(), backup.read_at()));
    assert_eq!(part.missing().len(), 2);
    for (range, message) in [
        ("R4-R7", "R4-R7 would split a value of several registers: the backup has R3-R22:u32"),
        ("R3-R5", "R3-R5 would split"),
        ("R21-R23", "R21-R23 is not wholly in one range of the backup"),
        ("DR4", "DR4 is not wholly in one range"),
        ("DR101", "DR101 is not wholly in one range"),
        ("M0", "M0 is not wholly in one range"),
    ] {
        let error = backup.select(tags([range])).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }
    assert_eq!(backup.select([]), Err(InvalidBackup::Empty));
    assert!(matches!(backup.select(tags(["R0.3"])), Err(InvalidBackup::BitsOfRegister { .. })));
    assert!(matches!(backup.select(tags(["M60-M62", "M62"])), Err(InvalidBackup::Overlap { .. })));
}

#[test]
fn differences_are_values_that_the_other_has_not() {
    let (backup, mut other) = (small(), small());
    assert_eq!(backup.differences(&other), []);
    other.blocks[0].cells[0] = Ok(Value::Word(9));
    other.blocks[0].cells[6] = Ok(Value::Word(9)); // missing in the first
    other.blocks[1].cells[2] = Err(Missing::NotRead);
    let found: Vec<_> = backup.differences(&other).iter().map(ToString::to_string).collect();
    assert_eq!(found, ["R3: 9, where 0 was expected", "M62: not known, where 0 was expected"]);
    let other = other.select(tags(["R3-R22"])).unwrap();
    assert_eq!(backup.differences(&other).len(), 1 + 11 + 1 + 1);
    let missing: Vec<_> =
        backup.missing().iter().map(|missing| format!("{} {}", missing.range, missing.reason)).collect();
    assert_eq!(
        missing,
        ["R7-R10 refused: illegal address (A)", "R11-R12 refused: unknown error code (1F)", "DR102 not read"]
    );
    assert_eq!((backup.value(element!("R13")), backup.value(element!("DR13"))), (Some(Ok(Value::Word(0x5827))), None));
}

/// Up to five ranges of different symbols, with any cells.
fn any_backup() -> impl Strategy<Value = Backup> {
    let symbols = [Symbol::R, Symbol::DD, Symbol::M, Symbol::WY, Symbol::DWS];
    let cell = prop_oneof![
        6 => any::<u32>().prop_map(Ok),
        1 => Just(Err(Missing::NotRead)),
        1 => (1..=u8::MAX).prop_map(|code| Err(Missing::Refused(ErrorCode::from_u8(code).unwrap()))),
    ];
    let range = (0_u16..50, prop::collection::vec(cell, 1..150), any::<bool>());
    let origin =
        (prop::option::of(1_u8..=254), prop::option::of(0_u64..4_000_000_000), any::<bool>(), any::<[u8; 3]>());
    (prop::collection::vec(range, 1..=symbols.len()), origin).prop_map(
        move |(ranges, (station, seconds, known, raw))| {
            let blocks = symbols.into_iter().zip(ranges).map(|(symbol, (first, mut cells, pairs))| {
                let pairs = pairs && symbol == Symbol::R && cells.len() > 1;
                cells.truncate(if pairs { cells.len() / 2 * 2 } else { cells.len() });
                let first = Element::new(symbol, first * symbol.alignment()).unwrap();
                let tag_type = if pairs { TagType::U32 } else { TagType::default_for(first.width()) };
                let mut cells: Vec<_> = cells.into_iter().map(|cell| cell.map(|bits| value(first, bits))).collect();
                for pair in cells.chunks_mut(2).filter(|_| pairs) {
                    if let Some(&missing) = pair.iter().find(|cell| cell.is_err()) {
                        pair.fill(missing);
                    }
                }
                Block { range: Tag::spanning(first, tag_type, cells.len()).unwrap(), cells }
            });
            let origin = Origin {
                read_at: seconds.map(|seconds| SystemTime::UNIX_EPOCH + Duration::from_secs(seconds)),
                brief: known.then(|| BriefStatus::from_raw(raw)),
                detailed: (!known).then(|| DetailedStatus::from_raw(raw.repeat(10)).unwrap()),
            };
            Backup { station, origin, blocks: blocks.collect(), unknown_fields: Vec::new() }
        },
    )
}

proptest! {
    #[test]
    fn any_backup_can_be_read_again_from_its_file(backup in any_backup()) {
        let file = backup.to_file();
        prop_assert_eq!(Backup::from_file(file.as_bytes()), Ok(backup.clone()));
        let ranges: Vec<_> = backup.ranges().collect();
        prop_assert_eq!(backup.select(ranges), Ok(backup));
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = Backup::from_file(&bytes);
        if let Ok(text) = String::from_utf8(bytes) {
            let _ = Backup::from_file(file::frame(Kind("backup"), &text).as_bytes());
        }
    }

    /// With a good checksum, only the content can be wrong.
    #[test]
    fn changed_content_is_refused_or_has_its_own_form(
        backup in any_backup(),
        place: prop::sample::Index,
        byte in prop::sample::select(b"\n -:0AMRu1g".to_vec()),
        remove: bool,
    ) {
        let file = backup.to_file();
        let mut content = file::unframe(Kind("backup"), file.as_bytes()).unwrap().text.as_bytes().to_vec();
        let place = place.index(content.len());
        if remove { content.remove(place); } else { content[place] = byte; }
        let changed = file::frame(Kind("backup"), std::str::from_utf8(&content).unwrap());
        if let Ok(read) = Backup::from_file(changed.as_bytes()) {
            // Without length, the field for people, and checksum.
            let fields = |file: &str| -> Vec<String> {
                let is_field = |line: &&str| !["length ", "about ", "crc32 "].iter().any(|name| line.starts_with(name));
                file.lines().filter(is_field).map(str::to_owned).collect()
            };
            prop_assert_eq!(fields(&read.to_file()), fields(&changed));
        }
    }
}
