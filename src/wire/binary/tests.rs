use bytes::Bytes;

use super::*;
use crate::element::{ElementError, Symbol};

/// The reply to a stop, from the manual.
const OK: &[u8] = b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";
/// The reply with R0 and R1, from the manual: FF55 FF4B.
const VALUES: &[u8] = b"\x52\x10\x00\x07\x01\x46\x00\xFF\x55\xFF\x4B\x74\xB3\x55\xAA";
/// The status query of the manual.
const STATUS: &[u8] = b"\x51\x10\x00\x02\x01\x40\xA1\x84\x55\xAA";

#[test]
fn bytes_one_at_a_time_make_a_frame() {
    let mut codec = BinaryCodec::client();
    let mut buffer = BytesMut::new();
    for &byte in &VALUES[..VALUES.len() - 1] {
        buffer.extend_from_slice(&[byte]);
        assert_eq!(codec.decode(&mut buffer).unwrap(), None);
    }
    buffer.extend_from_slice(&[0xAA]);
    assert_eq!(codec.decode(&mut buffer).unwrap(), Some(values()));
    assert_eq!(codec.decode_eof(&mut buffer).unwrap(), None);
}

#[test]
fn one_read_can_bring_several_frames_and_a_part_of_the_next() {
    let mut codec = BinaryCodec::client();
    let mut buffer = BytesMut::from(&[OK, VALUES, OK, &VALUES[..5]].concat()[..]);
    assert_eq!(all(&mut codec, &mut buffer), [ok(), values(), ok()]);
    buffer.extend_from_slice(&VALUES[5..]);
    assert_eq!(all(&mut codec, &mut buffer), [values()]);
}

#[test]
fn garbage_around_frames_is_an_item_of_its_own() {
    let garbage = |bytes| discarded(Discard::Garbage, bytes);
    let input = [b"\x06\x10\x55\xAA", OK, b"\x52\x51\x53", VALUES, b"\x00"].concat();
    assert_eq!(
        to_eof(&input),
        [garbage(b"\x06\x10\x55\xAA"), ok(), garbage(b"\x52\x51\x53"), values(), garbage(b"\x00")]
    );
}

#[test]
fn the_first_byte_of_a_header_waits_for_the_second() {
    let mut codec = BinaryCodec::client();
    let mut buffer = BytesMut::from(&b"\x52"[..]);
    assert_eq!(all(&mut codec, &mut buffer), []);
    buffer.extend_from_slice(OK);
    assert_eq!(all(&mut codec, &mut buffer), [discarded(Discard::Garbage, b"\x52"), ok()]);
}

#[test]
fn garbage_inside_a_frame_affects_that_frame_only() {
    let spoilt = [&VALUES[..9], b"\x00", &VALUES[9..]].concat();
    let items = to_eof(&[&spoilt[..], OK].concat());
    assert_eq!(items[0], discarded(Discard::BadChecksum, &spoilt));
    assert_eq!(items[1..], [ok()]);
}

#[test]
fn a_wrong_crc_is_a_bad_checksum() {
    // One bit wrong, the high byte first, and the misprint of the manual: shifted by one column.
    for crc in [b"\x44\xD4", b"\xD4\x45", b"\xD4\x55"] {
        let bad = [&OK[..7], &crc[..], b"\x55\xAA"].concat();
        assert_eq!(to_eof(&[&bad[..], VALUES].concat()), [discarded(Discard::BadChecksum, &bad), values()], "{crc:?}");
    }
}

#[test]
fn a_wrong_terminator_is_a_bad_frame() {
    for end in [b"\x55\xAB", b"\xAA\x55", b"\x00\x00"] {
        let bad = [&OK[..9], &end[..]].concat();
        assert_eq!(to_eof(&[&bad[..], VALUES].concat()), [discarded(Discard::BadChecksum, &bad), values()], "{end:?}");
    }
}

#[test]
fn a_length_of_65535_does_not_delay_the_next_frame() {
    let header = b"\x52\x10\xFF\xFF";
    let mut codec = BinaryCodec::client();
    let mut buffer = BytesMut::from(&[header, OK].concat()[..]);
    assert_eq!(all(&mut codec, &mut buffer), [discarded(Discard::TooLong, header), ok()]);
    assert!(buffer.is_empty());
}

#[test]
fn the_longest_frame_passes_if_the_limit_allows_it() {
    let data = Bytes::from(b"\x55\xAA\x52\x10".repeat(17_000)).split_to(65_533);
    let mut bytes = BytesMut::new();
    BinaryCodec::plc()
        .max_frame_len(LONGEST)
        .encode(&Frame { station: 9, command: 0x4E, data: data.clone() }, &mut bytes)
        .unwrap();
    let mut codec = BinaryCodec::client().max_frame_len(LONGEST);
    assert_eq!(all(&mut codec, &mut bytes), [Received::Frame(Frame { station: 9, command: 0x4E, data })]);
}

#[test]
fn a_length_below_two_is_malformed() {
    for header in [b"\x52\x10\x00\x00", b"\x52\x10\x00\x01"] {
        assert_eq!(to_eof(&[&header[..], OK].concat()), [discarded(Discard::Malformed, header), ok()]);
    }
}

#[test]
fn a_frame_ends_by_its_length_not_by_its_content() {
    for data in [&b"\x55\xAA"[..], b"\x55\xAA\x55\xAA\x00", b"\x52\x10\x00\x03", b"\x52\x10\xFF\xFF", OK, STATUS] {
        let outer = from_plc(0x4E, data);
        let expected = Received::Frame(Frame { station: 1, command: 0x4E, data: Bytes::copy_from_slice(data) });
        assert_eq!(to_eof(&[&outer[..], OK].concat()), [expected.clone(), ok()], "{data:?}");
        // Byte by byte as well: a complete frame inside the payload is not decoded early.
        let (mut codec, mut buffer, mut items) = (BinaryCodec::client(), BytesMut::new(), Vec::new());
        for byte in outer {
            buffer.extend_from_slice(&[byte]);
            items.extend(all(&mut codec, &mut buffer));
        }
        assert_eq!(items, [expected], "{data:?}");
    }
}

#[test]
fn a_frame_inside_a_bad_one_is_found() {
    let mut outer = from_plc(0x4E, OK);
    *outer.last_mut().unwrap() = 0;
    let items = to_eof(&outer);
    assert_eq!(items, [discarded(Discard::BadChecksum, &outer[..6]), ok(), discarded(Discard::Garbage, &outer[17..])]);
}

#[test]
fn a_frame_inside_an_incomplete_one_is_found_at_the_end() {
    let outer = from_plc(0x4E, &[OK, VALUES].concat());
    let cut = &outer[..outer.len() - 5];
    let mut codec = BinaryCodec::client();
    let mut buffer = BytesMut::from(cut);
    assert_eq!(all(&mut codec, &mut buffer), [], "it may still become complete");
    assert_eq!(
        to_eof(cut),
        [discarded(Discard::Truncated, &outer[..6]), ok(), discarded(Discard::Truncated, &cut[17..])]
    );
}

#[test]
fn a_frame_of_the_other_direction_is_discarded_whole() {
    assert_eq!(to_eof(&[STATUS, OK].concat()), [discarded(Discard::WrongSide, STATUS), ok()]);
    let mut buffer = BytesMut::from(&[OK, STATUS].concat()[..]);
    let status = Received::Frame(Frame { station: 1, command: 0x40, data: Bytes::new() });
    assert_eq!(all(&mut BinaryCodec::plc(), &mut buffer), [discarded(Discard::WrongSide, OK), status]);
}

#[test]
fn a_frame_longer_than_the_limit_is_too_long() {
    let mut codec = BinaryCodec::client().max_frame_len(OK.len());
    assert_eq!(all(&mut codec, &mut BytesMut::from(OK)), [ok()]);
    let items = all(&mut codec, &mut BytesMut::from(&[VALUES, OK].concat()[..]));
    assert_eq!(items, [discarded(Discard::TooLong, VALUES), ok()]);
}

#[test]
fn skip_partial_continues_after_the_first_byte() {
    let mut codec = BinaryCodec::client();
    let mut buffer = BytesMut::from(&[b"\x52\x10\x03\x00", OK].concat()[..]);
    assert_eq!(all(&mut codec, &mut buffer), []);
    codec.skip_partial();
    assert_eq!(all(&mut codec, &mut buffer), [discarded(Discard::Truncated, b"\x52\x10\x03\x00"), ok()]);
    buffer.extend_from_slice(OK);
    assert_eq!(all(&mut codec, &mut buffer), [ok()], "it skips once");
}

#[test]
fn reset_cancels_skip_partial() {
    let mut codec = BinaryCodec::client();
    assert_eq!(all(&mut codec, &mut BytesMut::from(&OK[..5])), []);
    codec.skip_partial();
    codec.reset();
    let mut buffer = BytesMut::from(&OK[..5]);
    assert_eq!(all(&mut codec, &mut buffer), [], "an incomplete frame after the reset stays");
    buffer.extend_from_slice(&OK[5..]);
    assert_eq!(all(&mut codec, &mut buffer), [ok()]);
}

#[test]
fn fields_are_written_as_in_the_manual() {
    let written = |write: &dyn Fn(&mut BinaryWriter<'_>)| {
        let mut dst = BytesMut::new();
        write(&mut BinaryWriter::new(&mut dst));
        dst.to_vec()
    };
    assert_eq!([1, 15, 255, 256].map(|n| written(&|w| w.count(n))), [[1], [15], [255], [0]]);
    assert_eq!(written(&|w| w.word(0xFF55)), b"\xFF\x55");
    assert_eq!(written(&|w| w.dword(0x9999_0001)), b"\x99\x99\x00\x01");
    assert_eq!(written(&|w| [true, false].into_iter().for_each(|b| w.bit(b))), b"\x01\x00");
    for (symbol, address, bytes) in [
        (Symbol::Y, 100, &b"Y\x00\x64"[..]),
        (Symbol::R, 65_535, b"R\xFF\xFF"),
        (Symbol::WX, 9984, b"WX\x27\x00"),
        (Symbol::DRT, 1, b"DRT\x00\x01"),
    ] {
        assert_eq!(written(&|w| w.element(Element::new(symbol, address).unwrap())), bytes);
    }
}

#[test]
fn fields_are_read_in_one_form() {
    assert_eq!(BinaryReader::new(b"\x00").count(), Ok(256));
    assert_eq!(BinaryReader::new(b"").byte(), Err(FieldError::Truncated));
    assert_eq!(BinaryReader::new(b"\x00").word(), Err(FieldError::Truncated));
    assert_eq!(BinaryReader::new(b"\x00\x00\x00").dword(), Err(FieldError::Truncated));
    assert_eq!(BinaryReader::new(b"\x02").bit(), Err(FieldError::NotABit(2)));
    assert_eq!(BinaryReader::new(b"X\x00\x00").element(), Err(FieldError::Unreadable), "no layout was announced");
    let one = |data: &'static [u8]| {
        let mut reader = BinaryReader::new(data);
        reader.layout(1, 0).and_then(|()| reader.element())
    };
    assert_eq!(one(b"DRT\x00\x01"), Ok(Element::new(Symbol::DRT, 1).unwrap()));
    // Before: an error, with the limit of the ASCII framing.
    assert_eq!(one(b"X\x27\x10"), Ok(Element::new(Symbol::X, 10_000).unwrap()));
    for (data, error) in [
        (&b""[..], FieldError::Unreadable),
        (b"X\x00", FieldError::Unreadable),
        (b"X\x00\x00\x00", FieldError::Unreadable),
        (b"x\x00\x00", FieldError::Unreadable),
        (b"wx\x00\x00", FieldError::Unreadable),
        (b"WX\xFF\xF8", ElementError::OutOfRange { symbol: Symbol::WX, address: 65_528 }.into()),
        (b"WX\x00\x04", ElementError::Misaligned { symbol: Symbol::WX, address: 4 }.into()),
    ] {
        assert_eq!(one(data), Err(error), "{data:?}");
    }
}

#[test]
fn a_layout_longer_than_the_data_is_refused() {
    for elements in [2, 256, usize::MAX] {
        for values in [0, 1, usize::MAX] {
            assert_eq!(BinaryReader::new(b"X\x00\x00").layout(elements, values), Err(FieldError::Unreadable));
        }
    }
}

#[test]
fn the_crc_is_crc_16_modbus() {
    assert_eq!((crc(b"123456789"), crc(b"")), (0x4B37, 0xFFFF));
    assert_eq!(crc(b"\x00\x02\x01\x40"), 0x84A1);
}

fn ok() -> Received {
    Received::Frame(Frame { station: 1, command: 0x41, data: Bytes::from_static(b"\x00") })
}

fn values() -> Received {
    Received::Frame(Frame { station: 1, command: 0x46, data: Bytes::from_static(b"\x00\xFF\x55\xFF\x4B") })
}

fn discarded(reason: Discard, bytes: &[u8]) -> Received {
    Received::Discarded { reason, bytes: Bytes::copy_from_slice(bytes) }
}

/// A frame from a PLC.
fn from_plc(command: u8, data: &[u8]) -> BytesMut {
    let mut bytes = BytesMut::new();
    emit(&mut bytes, Side::Plc, 1, command, |fields| fields.raw(data));
    bytes
}

/// All items that a client decodes of an input.
fn to_eof(input: &[u8]) -> Vec<Received> {
    let (mut codec, mut buffer) = (BinaryCodec::client(), BytesMut::from(input));
    std::iter::from_fn(|| codec.decode_eof(&mut buffer).unwrap()).collect()
}

fn all(codec: &mut BinaryCodec, buffer: &mut BytesMut) -> Vec<Received> {
    std::iter::from_fn(|| codec.decode(buffer).unwrap()).collect()
}
