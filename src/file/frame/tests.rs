use proptest::prelude::*;

use super::*;

const NOTES: Kind = Kind("notes");
const CONTENT: &str = "about a pump\nwords 0001 00FF\n";

#[test]
fn what_is_framed_comes_back() {
    for content in ["", "\n", CONTENT] {
        assert_eq!(unframe(NOTES, frame(NOTES, content).as_bytes()), Ok(content));
    }
    let file = frame(NOTES, CONTENT);
    assert!(file.starts_with("fatek file 1: notes\nlength 29\nabout a pump\n"), "{file}");
}

#[test]
fn the_checksum_is_the_one_that_other_tools_compute() {
    // The check value of CRC-32/ISO-HDLC, which is that of `gzip`, PNG and `crc32`.
    assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
}

#[test]
fn every_single_bit_flip_is_refused() {
    let file = frame(NOTES, CONTENT).into_bytes();
    for bit in 0..file.len() * 8 {
        let mut flipped = file.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(unframe(NOTES, &flipped).is_err(), "bit {bit}: {}", String::from_utf8_lossy(&flipped));
    }
}

#[test]
fn every_truncation_and_every_addition_is_refused() {
    let file = frame(NOTES, CONTENT).into_bytes();
    for len in 0..file.len() {
        assert!(unframe(NOTES, &file[..len]).is_err(), "{len} bytes");
    }
    for more in [&b"\n"[..], b"\0", &file] {
        let longer = [&file[..], more].concat();
        assert!(matches!(unframe(NOTES, &longer), Err(FormatError::TooLong { .. })));
    }
}

#[test]
fn the_error_names_what_is_wrong() {
    let file = frame(NOTES, CONTENT);
    let error = |file: &str| unframe(NOTES, file.as_bytes()).unwrap_err().to_string();
    assert!(error("PK\x03\x04").contains("does not begin with `fatek file`"));
    assert!(error(&file.replace("file 1:", "file 2:")).contains("version is 2, and only version 1"));
    assert!(error(&file.replace("notes", "songs")).contains("it holds `songs`, where `notes` was expected"));
    assert!(error(&file[..file.len() - 20]).contains("it is cut off: 74 bytes were expected, and there are 54"));
    assert!(error(&format!("{file}more")).contains("it is too long"));
    assert!(error(&file.replace("pump", "pomp")).contains("it is damaged: its checksum is"));
    assert!(error(&file.replace('\n', "\r\n")).starts_with("line 1: lines end with a line feed alone"));
    assert!(error(&file.replace("length ", "length +")).starts_with("line 2: `length` and a number"));
}

proptest! {
    #[test]
    fn any_bytes_are_taken_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(unframe(NOTES, &bytes).is_err());
        let behind = [b"fatek file 1: notes\n", &bytes[..]].concat();
        prop_assert!(unframe(NOTES, &behind).is_err());
    }

    #[test]
    fn any_lines_come_back(content in "[ -~\n]{0,200}") {
        let file = frame(NOTES, &content);
        prop_assert_eq!(unframe(NOTES, file.as_bytes()), Ok(&*content));
    }
}
