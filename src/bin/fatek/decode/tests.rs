use bytes::BytesMut;
use fatek::command::Request;
use fatek::wire::{Codec, Framing, Received, Side};
use proptest::prelude::*;
use tokio_util::codec::Decoder;

use super::explain::{Explanation, explain};
use super::field::Part;
use super::split::{Piece, pieces};

#[test]
fn examples_of_the_manuals_are_good_frames() {
    for (hex, shown) in MANUALS {
        let [explanation] = &all(hex)[..] else { panic!("{hex}: one frame") };
        assert_eq!(explanation.faults, [""; 0], "{hex}");
        for shown in *shown {
            assert!(lines(explanation).contains(&(*shown).to_owned()), "{shown} in {:#?}", lines(explanation));
        }
    }
}

const MANUALS: &[(&str, &[&str])] = &[
    ("02 30 31 34 30 43 37 03", &["frame STX begin", "frame station 1", "frame LRC C7, as computed", "frame ETX end"]),
    (
        "02 30 31 34 30 30 32 39 30 30 30 30 32 32 03",
        &["reply error code ok (0)", "reply STATUS1 RUN, memory card in use, id set"],
    ),
    // In the reading as a reply, 1 is an error code that no manual names.
    ("02 30 31 34 31 31 46 39 03", &["request control run (1)", "reply error code unknown error code (1)"]),
    ("02 30 31 34 31 30 46 38 03", &["request control stop (0)", "reply error code ok (0)"]),
    ("02 30 31 34 32 31 58 30 30 31 36 31 39 03", &["request control disable (1)", "request element X16, a discrete"]),
    ("02 30 31 34 33 30 37 59 30 30 31 30 34 42 03", &["request N 7", "request element Y10, a discrete"]),
    ("02 30 31 34 33 30 31 30 31 30 30 30 31 34 44 03", &["reply value 1 disabled (1)", "reply value 2 enabled (0)"]),
    ("02 30 31 34 34 30 30 31 30 31 31 30 31 45 03", &["reply value 1 off (0)", "reply value 2 on (1)"]),
    ("02 30 31 34 35 30 34 59 30 30 30 30 31 30 30 31 30 42 03", &["request Y0 on (1)", "request Y3 on (1)"]),
    ("02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03", &["request N 3", "request element R12, a 16-bit register"]),
    (
        "02 30 31 34 36 30 31 30 41 35 37 46 43 34 30 30 30 31 38 39 03",
        &["reply value 1 10A5h: 4261", "reply value 3 0001h: 1"],
    ),
    (
        "02 30 31 34 37 30 32 57 59 30 30 30 38 41 41 41 41 35 35 35 35 38 30 03",
        &["request WY8 AAAAh: 43690, or -21846", "request WY24 5555h: 21845"],
    ),
    (
        "02 30 31 34 38 30 33 52 30 30 30 30 31 59 30 30 30 39 44 57 4D 30 30 30 30 33 46 03",
        &["request element R1, a 16-bit register", "request element DWM0, a 32-bit register"],
    ),
    (
        "02 30 31 34 38 30 35 43 33 34 31 30 30 33 35 34 37 42 41 43 35 03",
        &["reply values in the order of the request, each as wide as its element"],
    ),
    (
        "02 30 31 34 39 30 34 59 30 30 30 30 31 59 30 30 30 31 30 57 4D 30 30 30 38 35 35 35 35 44 52 30 30 30 30 32 \
         30 30 30 30 30 30 46 46 33 43 03",
        &["request Y0 on (1)", "request WM8 5555h: 21845", "request DR2 000000FFh: 255"],
    ),
    ("02 30 31 34 45 41 42 43 44 45 46 47 42 38 03", &["request data \"ABCDEFG\"", "reply data \"ABCDEFG\""]),
    ("02 30 31 35 33 43 42 03", &["frame command read detailed status (53h)"]),
    ("51 10 00 02 01 40 A1 84 55 AA", &["frame header request", "frame CRC A1 84, as computed"]),
    ("52 10 00 06 01 40 00 01 00 00 77 D5 55 AA", &["frame header reply", "reply STATUS1 RUN"]),
    ("51 10 00 06 01 42 03 59 00 64 8E 69 55 AA", &["request control set (3)", "request element Y100, a discrete"]),
    ("52 10 00 07 01 43 00 01 01 01 01 C5 49 55 AA", &["reply value 4 disabled (1)"]),
    ("51 10 00 09 01 45 03 59 00 00 00 01 00 21 0D 55 AA", &["request Y1 on (1)"]),
    (
        "52 10 00 07 01 46 00 FF 55 FF 4B 74 B3 55 AA",
        &["reply value 2 FF4Bh: 65355, or -181", "reply as 32 bits FF55FF4Bh: 4283825995, or -11141301"],
    ),
    ("51 10 00 0A 01 48 02 44 52 00 0F 44 00 01 48 B2 55 AA", &["request element DR15, a 32-bit register"]),
    ("51 10 00 10 01 49 02 44 52 00 00 00 00 00 00 52 00 0F 00 FF 37 89 55 AA", &["request R15 00FFh: 255"]),
    ("52 10 00 04 01 4E FF FF 91 80 55 AA", &["reply data 2 bytes"]),
];

#[test]
fn bad_frames_are_explained_with_their_faults() {
    for (hex, faults, shown) in [
        (
            "02 30 31 34 36 30 33 52 30 30 30 31 32 37 36 03",
            &["LRC: found 76, computed 75"][..],
            "request element R12, a 16-bit register",
        ),
        ("51 10 00 02 01 40 A1 85 55 AA", &["CRC: found A1 85, computed A1 84"], "frame station 1"),
        (
            "02 30 31 34 36 30 33 52 30 30",
            &[
                "data: not a request: the data is too short",
                "data: not a reply: 52h is not a hexadecimal digit",
                "end: the frame is cut off: LRC and ETX (03) are missing",
            ],
            "request N 3",
        ),
        ("02 30 31 39 39 44 35 03", &["command: unknown command 99"], "frame LRC D5, as computed"),
        ("02 46 46 34 30 46 32 03", &["station: 255 is not a station"], "frame LRC F2, as computed"),
        (
            "02 33 03",
            &["station: expected two hexadecimal digits", "command: expected two hexadecimal digits"],
            "frame ETX end",
        ),
        (
            "51 10 00 03 01 40 A1 84 55 AA",
            &["length: 3 bytes stated, 2 found, minimum 2", "CRC: found A1 84, computed F0 44"],
            "frame terminator end",
        ),
        ("51 11 00 02 01 40 A1 84 55 AA", &["id: expected 10"], "frame CRC A1 84, as computed"),
        (
            "51 10 00 04 01 4F 00 00 80 0A 55 AA",
            &["command: read program page (4Fh) does not exist in the binary framing"],
            "frame station 1",
        ),
        ("51 10 00 02 01 40 A1 84 55 AB", &["terminator: expected 55 AA"], "frame CRC A1 84, as computed"),
    ] {
        let [explanation] = &all(hex)[..] else { panic!("{hex}: one frame") };
        for fault in faults {
            assert!(explanation.faults.iter().any(|f| f == fault), "{hex}: {fault} in {:?}", explanation.faults);
        }
        assert!(lines(explanation).iter().any(|line| line == shown), "{hex}: {shown} in {:#?}", lines(explanation));
    }
}

#[test]
fn input_is_split_into_frames_and_bytes_between_them() {
    let lengths = |hex: &str| -> Vec<(usize, bool)> {
        all(hex).iter().map(|explanation| (explanation.length, explanation.faults.is_empty())).collect()
    };
    assert_eq!(lengths("06 02 30 31 34 30 43 37 03 15 15"), [(1, false), (8, true), (2, false)]);
    assert_eq!(lengths("02 30 31 02 30 31 34 30 43 37 03"), [(3, false), (8, true)]);
    let query = "51 10 00 02 01 40 A1 84 55 AA";
    let reply = "52 10 00 06 01 40 00 01 00 00 77 D5 55 AA";
    assert_eq!(lengths(&format!("{query} {reply}")), [(10, true), (14, true)]);
    assert_eq!(lengths(&format!("{query} 02 {reply}")), [(10, true), (1, false), (14, true)]);
    // The frame after one with a wrong length is still found.
    assert_eq!(lengths(&format!("51 10 00 01 01 40 A1 84 55 AA {reply}")), [(10, false), (14, true)]);
    assert_eq!(lengths("48 45 4C 4C 4F"), [(5, false)]);
}

#[test]
fn only_the_given_framing_is_searched() {
    let query = super::hex::parse("51 10 00 02 01 40 A1 84 55 AA").unwrap();
    assert_eq!(pieces(&query, Some(Framing::Binary)), [Piece::Binary(&query)]);
    assert_eq!(pieces(&query, None), [Piece::Binary(&query)]);
    // The length field contains an STX.
    assert_eq!(pieces(&query, Some(Framing::Ascii)), [Piece::Noise(&query[..3]), Piece::Ascii(&query[3..])]);
    let query = b"\x020140C7\x03";
    assert_eq!(pieces(query, Some(Framing::Binary)), [Piece::Noise(query)]);
}

fn all(hex: &str) -> Vec<Explanation> {
    let bytes = super::hex::parse(hex).unwrap();
    pieces(&bytes, None).iter().map(explain).collect()
}

fn lines(explanation: &Explanation) -> Vec<String> {
    let line = |field: &super::Field| format!("{} {} {}", field.part.as_str(), field.name, field.meaning);
    explanation.fields.iter().map(line).collect()
}

/// Invariants of the explanation of any input.
fn check(bytes: &[u8], framing: Option<Framing>) {
    let pieces = pieces(bytes, framing);
    let raw = |piece: &Piece<'_>| match *piece {
        Piece::Noise(bytes) | Piece::Ascii(bytes) | Piece::Binary(bytes) => bytes.to_vec(),
    };
    assert_eq!(pieces.iter().flat_map(raw).collect::<Vec<_>>(), bytes, "the pieces are the whole input");
    for piece in &pieces {
        let explanation = explain(piece);
        let _ = (explanation.title(), super::json(&explanation));
        for reading in [Part::Request, Part::Reply] {
            let is_shown = explanation.fields.iter().any(|field| field.part == reading && !field.bytes.is_empty());
            let fields = explanation.fields.iter().filter(|field| field.part == Part::Frame || field.part == reading);
            let shown: Vec<u8> = fields.flat_map(|field| field.bytes.clone()).collect();
            assert!(!is_shown || shown == raw(piece), "every byte is shown once: {explanation:#?}");
        }
        check_verdict(piece, &explanation);
    }
}

/// A frame is explained as good exactly if the library decodes it.
fn check_verdict(piece: &Piece<'_>, explanation: &Explanation) {
    let (bytes, framing, side) = match *piece {
        Piece::Noise(_) => return assert!(!explanation.faults.is_empty()),
        Piece::Ascii(bytes) => (bytes, Framing::Ascii, Side::Plc),
        Piece::Binary(bytes) if bytes[0] == 0x52 => (bytes, Framing::Binary, Side::Client),
        Piece::Binary(bytes) => (bytes, Framing::Binary, Side::Plc),
    };
    let mut buffer = BytesMut::from(bytes);
    match Codec::new(framing, side).decode(&mut buffer) {
        Ok(Some(Received::Frame(frame))) if buffer.is_empty() => {
            let is_request = Request::decode(&frame, framing).is_ok() && side == Side::Plc;
            assert!(!is_request || frame.station == 255 || explanation.faults.is_empty(), "{explanation:#?}");
            let shown = explanation.fields.iter().any(|field| field.part == Part::Request);
            assert!(!shown || is_request || !explanation.faults.is_empty(), "{explanation:#?}");
        }
        _ => assert!(!explanation.faults.is_empty(), "{explanation:#?}"),
    }
}

fn framings() -> impl Strategy<Value = Option<Framing>> {
    prop::sample::select(vec![None, Some(Framing::Ascii), Some(Framing::Binary)])
}

/// Frame with this content and a good checksum.
fn wrapped(framing: Framing, header: u8, station: u8, command: u8, data: &[u8]) -> Vec<u8> {
    if framing == Framing::Ascii {
        let mut frame = format!("\x02{station:02X}{command:02X}").into_bytes();
        frame.extend_from_slice(data);
        let lrc = fatek::wire::ascii::lrc(&frame);
        frame.extend_from_slice(format!("{lrc:02X}\x03").as_bytes());
        return frame;
    }
    let mut frame = vec![header, 0x10];
    frame.extend_from_slice(&u16::try_from(data.len() + 2).unwrap().to_be_bytes());
    frame.extend_from_slice(&[station, command]);
    frame.extend_from_slice(data);
    let crc = fatek::wire::binary::crc(&frame[2..]);
    frame.extend_from_slice(&crc.to_le_bytes());
    frame.extend_from_slice(&[0x55, 0xAA]);
    frame
}

fn commands() -> impl Strategy<Value = u8> {
    prop_oneof![9 => prop::sample::select((0x40..=0x53).collect::<Vec<u8>>()), 1 => any::<u8>()]
}

/// Bytes that occur in frames of both framings.
const FRAME_BYTES: &[u8] = b"\x02\x03\x51\x52\x10\x00\x01\x06\x55\xAA0144689AFERXWMD";
/// Data of ASCII frames, as a regular expression.
const ASCII_DATA: &str = "[0-9A-F]{0,20}|[0-9A-FRXYMD]{0,30}|0[0-9A-F]{0,300}";

fn frame_bytes() -> impl Strategy<Value = Vec<u8>> {
    prop::collection::vec(prop::sample::select(FRAME_BYTES), 0..60)
}

fn binary_data() -> impl Strategy<Value = Vec<u8>> {
    prop::collection::vec(prop_oneof![any::<u8>(), 0..4_u8, prop::sample::select(b"RDWXYM".to_vec())], 0..40)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn any_bytes_are_explained(bytes in prop::collection::vec(any::<u8>(), 0..200), framing in framings()) {
        check(&bytes, framing);
    }

    #[test]
    fn any_bytes_that_occur_in_frames_are_explained(bytes in frame_bytes(), framing in framings()) {
        check(&bytes, framing);
    }

    #[test]
    fn any_content_of_an_ascii_frame_is_explained(station: u8, command in commands(), data in ASCII_DATA) {
        check(&wrapped(Framing::Ascii, 0, station, command, data.as_bytes()), None);
    }

    #[test]
    fn any_content_of_a_binary_frame_is_explained(
        reply: bool,
        station: u8,
        command in commands(),
        data in binary_data(),
    ) {
        check(&wrapped(Framing::Binary, if reply { 0x52 } else { 0x51 }, station, command, &data), None);
    }

    #[test]
    fn any_damaged_frame_is_explained(
        frame in prop::sample::select(MANUALS),
        at: prop::sample::Index,
        byte: u8,
        end: prop::sample::Index,
    ) {
        let mut bytes = super::hex::parse(frame.0).unwrap();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        check(&bytes, None);
        bytes.truncate(end.index(bytes.len()));
        check(&bytes, None);
    }

    #[test]
    fn any_text_is_parsed_without_panic(text in "\\PC{0,40}|[0-9a-fx:, ]{0,40}") {
        let _ = super::hex::parse(&text);
    }
}
