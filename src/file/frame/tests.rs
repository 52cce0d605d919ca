use proptest::prelude::*;

use super::*;

const NOTES: Kind = Kind("notes");
const CONTENT: &str = "about a pump\nwords 0001 00FF\n";

fn same(text: &str) -> Content<'_> {
    Content { text, minor: super::MINOR }
}

/// The file with another version, and a good checksum.
fn of_version(version: &str) -> String {
    let file = frame(NOTES, CONTENT).replacen("file 1:", &format!("file {version}:"), 1);
    let sealed = &file[..file.len() - LAST_LINE];
    format!("{sealed}crc32 {:08X}\n", crc32(sealed.as_bytes()))
}

#[test]
fn newer_minor_versions_are_read_and_other_major_ones_not() {
    for (version, minor) in [("1", 0), ("1.1", 1), ("1.987654321", 987_654_321)] {
        assert_eq!(unframe(NOTES, of_version(version).as_bytes()), Ok(Content { text: CONTENT, minor }), "{version}");
    }
    for version in ["0", "2", "2.1", "11", "999999999"] {
        let error = unframe(NOTES, of_version(version).as_bytes()).unwrap_err();
        assert_eq!(error, FormatError::Version { found: version.to_owned(), known: 1 });
    }
    for version in ["", "x", "01", "1.", "1.0", "1.01", "1.1.1", "-1", "+1", " 1", "1 ", "1.9876543210"] {
        let error = unframe(NOTES, of_version(version).as_bytes()).unwrap_err();
        assert!(error.to_string().starts_with("line 1: `fatek file VERSION: KIND`"), "{version}: {error}");
    }
}

#[test]
fn framed_content_can_be_read_again() {
    for content in ["", "\n", CONTENT] {
        assert_eq!(unframe(NOTES, frame(NOTES, content).as_bytes()), Ok(same(content)));
    }
    let file = frame(NOTES, CONTENT);
    assert!(file.starts_with("fatek file 1: notes\nlength 29\nabout a pump\n"), "{file}");
}

#[test]
fn the_checksum_is_that_of_other_tools() {
    // The check value of CRC-32/ISO-HDLC, which is that of `gzip`, PNG and `crc32`.
    assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
}

#[test]
fn a_flip_of_any_single_bit_is_refused() {
    let file = frame(NOTES, CONTENT).into_bytes();
    for bit in 0..file.len() * 8 {
        let mut flipped = file.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(unframe(NOTES, &flipped).is_err(), "bit {bit}: {}", String::from_utf8_lossy(&flipped));
    }
}

#[test]
fn every_truncation_and_addition_is_refused() {
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
fn the_error_names_the_fault() {
    let file = frame(NOTES, CONTENT);
    let error = |file: &str| unframe(NOTES, file.as_bytes()).unwrap_err().to_string();
    assert!(error("PK\x03\x04").contains("does not begin with `fatek file`"));
    assert!(
        error(&file.replace("file 1:", "file 2:")).contains("format version 2 needs a newer version of this library")
    );
    assert!(error(&file.replace("notes", "songs")).contains("it holds `songs`, where `notes` was expected"));
    assert!(error(&file[..file.len() - 20]).contains("it is cut off: 74 bytes were expected, and there are 54"));
    assert!(error(&format!("{file}more")).contains("it is too long"));
    assert!(error(&file.replace("pump", "pomp")).contains("it is damaged: its checksum is"));
    assert!(error(&file.replace('\n', "\r\n")).starts_with("line 1: lines end with CR LF"));
    assert!(error(&file.replace("length ", "length +")).starts_with("line 2: `length` and a number"));
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(unframe(NOTES, &bytes).is_err());
        let behind = [b"fatek file 1: notes\n", &bytes[..]].concat();
        prop_assert!(unframe(NOTES, &behind).is_err());
    }

    #[test]
    fn any_lines_can_be_read_again(content in "[ -~\n]{0,200}") {
        let file = frame(NOTES, &content);
        prop_assert_eq!(unframe(NOTES, file.as_bytes()), Ok(same(&content)));
    }
}
