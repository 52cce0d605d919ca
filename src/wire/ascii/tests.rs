use bytes::Bytes;

use super::*;

/// The status query of the manuals.
const QUERY: &[u8] = b"\x020140C7\x03";
/// The read of R12 to R14 of the manuals.
const READ: &[u8] = b"\x02014603R0001275\x03";

#[test]
fn bytes_one_at_a_time_make_a_frame() {
    let mut codec = AsciiCodec::new();
    let mut buffer = BytesMut::new();
    for &byte in &READ[..READ.len() - 1] {
        buffer.extend_from_slice(&[byte]);
        assert_eq!(codec.decode(&mut buffer).unwrap(), None);
    }
    buffer.extend_from_slice(&[ETX]);
    assert_eq!(codec.decode(&mut buffer).unwrap(), Some(read()));
    assert_eq!(codec.decode_eof(&mut buffer).unwrap(), None);
}

#[test]
fn one_read_can_bring_several_frames_and_a_part_of_the_next() {
    let mut codec = AsciiCodec::new();
    let mut buffer = BytesMut::from(&[QUERY, READ, QUERY, &READ[..6]].concat()[..]);
    assert_eq!(all(&mut codec, &mut buffer), [query(), read(), query()]);
    buffer.extend_from_slice(&READ[6..]);
    assert_eq!(all(&mut codec, &mut buffer), [read()]);
}

#[test]
fn garbage_around_frames_is_an_item_of_its_own() {
    let input = [b"\x06\x15\xFF", QUERY, b"noise", READ, b"\x00"].concat();
    let garbage = |bytes| discarded(Discard::Garbage, bytes);
    assert_eq!(decode(&input), [garbage(b"\x06\x15\xFF"), query(), garbage(b"noise"), read(), garbage(b"\x00")]);
}

#[test]
fn garbage_inside_a_frame_affects_that_frame_only() {
    let spoilt = b"\x020146\xFF03R0001275\x03";
    assert_eq!(decode(&[spoilt, QUERY].concat()), [discarded(Discard::BadChecksum, spoilt), query()]);
}

#[test]
fn an_etx_in_noise_hides_no_frame() {
    let garbage = |bytes| discarded(Discard::Garbage, bytes);
    assert_eq!(decode(&[b"\x03\x03ab\x03", QUERY].concat()), [garbage(b"\x03\x03ab\x03"), query()]);
    // Inside a frame it ends the frame; the rest is noise.
    let cut = discarded(Discard::BadChecksum, b"\x02014603R\x03");
    assert_eq!(decode(&[b"\x02014603R\x030001275\x03", QUERY].concat()), [cut, garbage(b"0001275\x03"), query()]);
}

#[test]
fn a_frame_inside_garbage_or_another_frame_is_found() {
    let truncated = |bytes| discarded(Discard::Truncated, bytes);
    assert_eq!(decode(&[b"\x02", QUERY].concat()), [truncated(b"\x02"), query()]);
    assert_eq!(
        decode(&[b"\x02\x02\x02014603R", QUERY].concat()),
        [truncated(b"\x02"), truncated(b"\x02"), truncated(b"\x02014603R"), query()]
    );
}

#[test]
fn a_wrong_lrc_is_a_bad_checksum() {
    // Manual 000 draws FF where the sum is FE. Then no hex digits, no characters, and other sums.
    for bad in [
        &b"\x0201470FF\x03"[..],
        b"\x0201470FG\x03",
        b"\x0201470\x00\x00\x03",
        b"\x020140C8\x03",
        b"\x020140\xC7\xC7\x03",
    ] {
        assert_eq!(decode(&[bad, READ].concat()), [discarded(Discard::BadChecksum, bad), read()], "{bad:?}");
    }
    assert_eq!(decode(b"\x0201470FE\x03"), [frame(1, 0x47, b"0")]);
}

#[test]
fn a_short_frame_or_a_header_without_digits_is_malformed() {
    for bad in
        [&b"\x02\x03"[..], b"\x02C7\x03", b"\x0201C7\x03", b"\x02014C7\x03", b"\x02G140DD\x03", b"\x0201 0B7\x03"]
    {
        assert_eq!(decode(&[bad, QUERY].concat()), [discarded(Discard::Malformed, bad), query()], "{bad:?}");
    }
}

#[test]
fn digits_are_read_in_either_case_and_sent_in_upper_case() {
    assert_eq!(decode(b"\x020140c7\x03"), [query()]);
    assert_eq!(decode(b"\x02014eABCDEFGd8\x03"), [frame(1, 0x4E, b"ABCDEFG")]);
    assert_eq!(decode(b"\x02fe4031\x03\x02Fe4011\x03\x02FE40f1\x03"), [const { 0xFE }; 3].map(|s| frame(s, 0x40, b"")));
    let mut sent = BytesMut::new();
    let frame = Frame { station: 0xFE, command: 0x4E, data: Bytes::from_static(b"abc") };
    AsciiCodec::new().encode(frame, &mut sent).unwrap();
    assert_eq!(&sent[..], b"\x02FE4Eabc2C\x03");
}

#[test]
fn a_frame_longer_than_the_limit_is_too_long() {
    let frame_of = |data: usize| {
        let mut bytes = BytesMut::new();
        emit(&mut bytes, 1, 0x4E, |fields| fields.raw(&vec![b'x'; data]));
        bytes
    };
    let mut codec = AsciiCodec::new().max_frame_len(508);
    assert!(matches!(&all(&mut codec, &mut frame_of(500))[..], [Received::Frame(frame)] if frame.data.len() == 500));
    let long = frame_of(501);
    let mut buffer = BytesMut::from(&[&long, QUERY].concat()[..]);
    let [over, rest, good] = all(&mut codec, &mut buffer).try_into().unwrap();
    assert_eq!(over, discarded(Discard::TooLong, &long[..508]));
    assert_eq!((rest, good), (discarded(Discard::Garbage, &long[508..]), query()));
}

#[test]
fn an_endless_frame_is_discarded_at_the_limit() {
    let mut codec = AsciiCodec::new().max_frame_len(100);
    let mut buffer = BytesMut::from(&[STX][..]);
    let mut dropped = 0;
    for _ in 0..1000 {
        buffer.extend_from_slice(b"0123456");
        for item in all(&mut codec, &mut buffer) {
            let Received::Discarded { bytes, .. } = item else { panic!("{item:?}") };
            dropped += bytes.len();
        }
        assert!(buffer.len() < 100);
    }
    assert_eq!(dropped + buffer.len(), 7001);
    buffer.extend_from_slice(QUERY);
    assert_eq!(all(&mut codec, &mut buffer).last(), Some(&query()));
}

#[test]
fn an_incomplete_frame_at_the_end_of_input_is_truncated() {
    let mut codec = AsciiCodec::new();
    let mut buffer = BytesMut::from(&[QUERY, b"\x02014603R"].concat()[..]);
    assert_eq!(codec.decode_eof(&mut buffer).unwrap(), Some(query()));
    assert_eq!(codec.decode_eof(&mut buffer).unwrap(), Some(discarded(Discard::Truncated, b"\x02014603R")));
    assert_eq!(codec.decode_eof(&mut buffer).unwrap(), None);
    buffer.extend_from_slice(QUERY);
    assert_eq!(all(&mut codec, &mut buffer), [query()], "the codec is still usable");
}

#[test]
fn reset_forgets_how_much_was_scanned() {
    let mut codec = AsciiCodec::new();
    assert_eq!(all(&mut codec, &mut BytesMut::from(&READ[..15])), []);
    codec.reset();
    assert_eq!(all(&mut codec, &mut BytesMut::from(QUERY)), [query()]);
}

#[test]
fn fields_are_written_as_in_the_manual() {
    let written = |write: &dyn Fn(&mut AsciiWriter<'_>)| {
        let mut dst = BytesMut::new();
        write(&mut AsciiWriter::new(&mut dst));
        String::from_utf8(dst.to_vec()).unwrap()
    };
    assert_eq!([1, 15, 255, 256].map(|n| written(&|w| w.count(n))), ["01", "0F", "FF", "00"]);
    assert_eq!([0, 4, 0xA, 0xF].map(|n| written(&|w| w.code(n))), ["0", "4", "A", "F"]);
    assert_eq!(written(&|w| w.byte(0x0A)), "0A");
    assert_eq!(written(&|w| w.word(0x10A5)), "10A5");
    assert_eq!(written(&|w| w.dword(10_000_000)), "00989680");
    assert_eq!(written(&|w| [true, false].into_iter().for_each(|b| w.bit(b))), "10");
    for &symbol in Symbol::ALL {
        for address in [0, 8, 1000, symbol.last_address_in(Framing::Ascii)] {
            let element = Element::new(symbol, address).unwrap();
            assert_eq!(written(&|w| w.element(element)), format!("{element:#}"));
        }
    }
    // Not `M0000`, which would be another relay.
    assert_eq!(written(&|w| w.element(Element::new(Symbol::M, 10_000).unwrap())), "M????");
    assert_eq!(AsciiReader::new(b"M????").element(), Err(FieldError::NotDecimal(b'?')));
}

#[test]
fn fields_are_read_in_either_case_and_in_one_form() {
    let reader = |data: &'static str| AsciiReader::new(data.as_bytes());
    assert_eq!((reader("00").count(), reader("fF").count()), (Ok(256), Ok(255)));
    assert_eq!((reader("a").code(), reader("7fC4").word()), (Ok(10), Ok(0x7FC4)));
    assert_eq!(reader("c3FA1000").dword(), Ok(0xC3FA_1000));
    assert_eq!(reader("dwm0008").element(), Ok(Element::new(Symbol::DWM, 8).unwrap()));
    assert_eq!(reader("1").bit().and(reader("2").bit()), Err(FieldError::NotABit(2)));
    for (data, error) in [("", FieldError::Truncated), ("0", FieldError::Truncated), ("0 ", FieldError::NotHex(b' '))] {
        assert_eq!(reader(data).byte(), Err(error));
    }
    assert_eq!(reader("123").word(), Err(FieldError::Truncated));
    assert_eq!(reader("+123").word(), Err(FieldError::NotHex(b'+')));
    for (data, error) in [
        ("", ElementError::UnknownSymbol.into()),
        ("0012", ElementError::UnknownSymbol.into()),
        ("L0000", ElementError::UnknownSymbol.into()),
        ("RA0012", FieldError::NotDecimal(b'A')),
        ("X000", FieldError::Truncated),
        ("R0000", FieldError::Truncated),
        ("X00A0", FieldError::NotDecimal(b'A')),
        ("R65536", ElementError::OutOfRange { symbol: Symbol::R, address: 65_536 }.into()),
        ("R99999", ElementError::OutOfRange { symbol: Symbol::R, address: 99_999 }.into()),
        ("DRT9999", Element::parse("DRT9999").unwrap().check_in(Framing::Ascii).unwrap_err().into()),
        ("WX0004", ElementError::Misaligned { symbol: Symbol::WX, address: 4 }.into()),
    ] {
        assert_eq!(reader(data).element(), Err(error), "{data}");
    }
}

#[test]
fn the_lrc_is_the_low_byte_of_the_sum() {
    assert_eq!((lrc(b""), lrc(b"\x020140"), lrc(&[0xFF; 3])), (0, 0xC7, 0xFD));
}

fn frame(station: u8, command: u8, data: &'static [u8]) -> Received {
    Received::Frame(Frame { station, command, data: Bytes::from_static(data) })
}

fn query() -> Received {
    frame(1, 0x40, b"")
}

fn read() -> Received {
    frame(1, 0x46, b"03R00012")
}

fn discarded(reason: Discard, bytes: &[u8]) -> Received {
    Received::Discarded { reason, bytes: Bytes::copy_from_slice(bytes) }
}

/// All items of an input.
fn decode(input: &[u8]) -> Vec<Received> {
    let mut buffer = BytesMut::from(input);
    let items = all(&mut AsciiCodec::new(), &mut buffer);
    assert!(buffer.is_empty(), "{buffer:?} is left");
    items
}

fn all(codec: &mut AsciiCodec, buffer: &mut BytesMut) -> Vec<Received> {
    std::iter::from_fn(|| codec.decode(buffer).unwrap()).collect()
}
