//! Limits of every command at both ends, and the messages when one is broken.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

mod common;

use std::fmt::Debug;

use bytes::{Bytes, BytesMut};
use common::{FRAMINGS, frame_content, framed};
use fatek::command::*;
use fatek::wire::{AsciiCodec, BinaryCodec, Codec, EncodeError, Frame, Framing, MAX_FRAME_LEN, Side};
use fatek::{
    Discrete, Element, ErrorCode, Register, Register32, Symbol, Width, discrete, element, register, register32,
};
use tokio_util::codec::Encoder;

#[test]
fn counts_are_limited_by_command_and_last_address() {
    for &symbol in Symbol::ALL {
        for behind in [0, 1, 2, 31, 32, 63, 64, 255, 256, 300] {
            let Some(back) = u16::checked_mul(behind, symbol.step()) else { continue };
            let Some(address) = symbol.last_address().checked_sub(back) else { continue };
            let first = Element::new(symbol, address).unwrap();
            for count in 0..=300_usize {
                let (code, max) = match symbol.width() {
                    Width::Bit => (Code::ReadDiscretes, 256),
                    Width::Word => (Code::ReadRegisters, 64),
                    Width::DWord => (Code::ReadRegisters, 32),
                };
                let expected = match count {
                    _ if !(1..=max).contains(&count) => Err(InvalidRequest::Count { code, count, min: 1, max }),
                    _ if count > usize::from(behind) + 1 => Err(InvalidRequest::PastTheEnd { first, count }),
                    _ => Ok(()),
                };
                for (code, result) in every_consecutive_command(first, count) {
                    assert_eq!(result, with_code(expected.clone(), code), "{first} {count}");
                }
            }
        }
    }
}

/// Results of all commands that take this element, with this count.
fn every_consecutive_command(first: Element, count: usize) -> Vec<(Code, Result<(), InvalidRequest>)> {
    match first {
        Element::Discrete(first) => vec![
            (Code::ReadDisabled, ReadDisabled::new(first, count).map(drop)),
            (Code::ReadDiscretes, ReadDiscretes::new(first, count).map(drop)),
            (Code::WriteDiscretes, WriteDiscretes::new(first, vec![true; count]).map(drop)),
        ],
        Element::Register(first) => vec![
            (Code::ReadRegisters, ReadRegisters::new(first, count).map(drop)),
            (Code::WriteRegisters, WriteRegisters::new(first, vec![0; count]).map(drop)),
        ],
        Element::Register32(first) => vec![
            (Code::ReadRegisters, ReadRegisters::new(first, count).map(drop)),
            (Code::WriteRegisters, WriteRegisters::new(first, vec![0; count]).map(drop)),
        ],
    }
}

fn with_code(result: Result<(), InvalidRequest>, code: Code) -> Result<(), InvalidRequest> {
    match result {
        Err(InvalidRequest::Count { count, min, max, .. }) => Err(InvalidRequest::Count { code, count, min, max }),
        other => other,
    }
}

#[test]
fn mixed_lists_are_limited_in_units() {
    for singles in 0..=70_usize {
        for doubles in 0..=35_usize {
            let units = singles + 2 * doubles;
            let single = |i: usize| if i.is_multiple_of(2) { element!("X0") } else { element!("R0") };
            let elements = (0..singles).map(single).chain((0..doubles).map(|_| element!("DR0")));
            let items = elements.clone().map(|e| (e, common::value(e, 0))).collect::<Vec<_>>();
            let ok = |max| (1..=max).contains(&units);
            assert_eq!(ReadMixed::new(elements.collect::<Vec<_>>()).is_ok(), ok(64), "{singles} + 2 * {doubles}");
            assert_eq!(WriteMixed::new(items).is_ok(), ok(32), "{singles} + 2 * {doubles}");
        }
    }
}

#[test]
fn errors_of_broken_limits_name_input_and_rule() {
    fn assert_message<T: Debug>(result: Result<T, InvalidRequest>, message: &str) {
        assert_eq!(result.unwrap_err().to_string(), message);
    }
    let mixed = |n: usize, e: Element| vec![e; n];
    let writes = |n: usize, e: Element| vec![(e, common::value(e, 0)); n];
    assert_message(
        ReadDisabled::new(discrete!("X0"), 0),
        "read enable/disable (43h): 0 items were asked for, and it takes 1 to 256",
    );
    assert_message(
        ReadDiscretes::new(discrete!("X0"), 257),
        "read discretes (44h): 257 items were asked for, and it takes 1 to 256",
    );
    assert_message(
        WriteDiscretes::new(discrete!("X65534"), [true; 3]),
        "3 elements from X65534 on reach past the last address, X65535",
    );
    assert_message(
        ReadRegisters::new(register!("R0"), 65),
        "read registers (46h): 65 items were asked for, and it takes 1 to 64",
    );
    assert_message(
        ReadRegisters::new(register32!("DR0"), 33),
        "read registers (46h): 33 items were asked for, and it takes 1 to 32",
    );
    assert_message(
        ReadRegisters::new(register!("WX65520"), 2),
        "2 elements from WX65520 on reach past the last address, WX65520",
    );
    assert_message(
        WriteRegisters::new(register!("R0"), []),
        "write registers (47h): 0 items were asked for, and it takes 1 to 64",
    );
    assert_message(
        WriteRegisters::new(register32!("DR65534"), [1, 2]),
        "2 elements from DR65534 on reach past the last address, DR65534",
    );
    assert_message(ReadMixed::new([]), "mixed read (48h): 0 items were asked for, and it takes 1 to 64");
    assert_message(
        ReadMixed::new(mixed(65, element!("X0"))),
        "mixed read (48h): 65 items were asked for, and it takes 1 to 64",
    );
    assert_message(
        ReadMixed::new(mixed(33, element!("DR0"))),
        "mixed read (48h): the elements count 66 units (a 32-bit register counts 2), and it takes at most 64",
    );
    assert_message(WriteMixed::new([]), "mixed write (49h): 0 items were asked for, and it takes 1 to 32");
    assert_message(
        WriteMixed::new(writes(17, element!("DR0"))),
        "mixed write (49h): the elements count 34 units (a 32-bit register counts 2), and it takes at most 32",
    );
    assert_message(
        WriteMixed::new([(element!("R5"), Value::DWord(70_000))]),
        "R5 is a 16-bit register, not a 32-bit register",
    );
    assert_message(WriteMixed::new([(element!("Y5"), Value::Word(2))]), "Y5 is a discrete, not a 16-bit register");
    assert_message(LoopBack::new(vec![0; 257]), "loop back (4Eh): 257 items were asked for, and it takes 0 to 256");
    assert_message(
        send(&LoopBack::new("AB\x03").unwrap(), Framing::Ascii),
        "loop back (4Eh): the byte 03h at position 2 cannot be sent in the ASCII framing (20h to 7Eh can)",
    );
    assert_message(
        send(&ReadProgramPage::new(1), Framing::Binary),
        "read program page (4Fh) does not exist in the binary framing",
    );
    assert_message(
        send(&WriteProgramPage::new(1, ProgramPage::new([0; PAGE_WORDS])), Framing::Binary),
        "write program page (50h) does not exist in the binary framing",
    );
}

#[test]
fn errors_of_invalid_addresses_quote_the_address() {
    let assert_message = |error: InvalidRequest, message: &str| assert_eq!(error.to_string(), message);
    let new = |symbol, address| InvalidRequest::from(Element::new(symbol, address).unwrap_err());
    assert_message(new(Symbol::WX, 65_528), "WX65528 is past the last address, WX65520");
    assert_message(new(Symbol::DR, 65_535), "DR65535 is past the last address, DR65534");
    assert_message(new(Symbol::WM, 12), "WM12: the address of WM must be a multiple of 8");
    assert_message(Discrete::new(Symbol::R, 1).unwrap_err().into(), "R1 is a 16-bit register, not a discrete");
    assert_message(Register::new(Symbol::DR, 1).unwrap_err().into(), "DR1 is a 32-bit register, not a 16-bit register");
    assert_message(Register32::new(Symbol::M, 1).unwrap_err().into(), "M1 is a discrete, not a 32-bit register");
}

#[test]
fn the_error_of_an_ambiguous_list_names_its_elements() {
    let list = ReadMixed::new([element!("RT87"), element!("X0")]).unwrap();
    let message = send(&list, Framing::Binary).unwrap_err().to_string();
    assert!(message.contains(" RT87 X0 can also be read "), "the list is missing: {message}");
    assert!(!message.contains("  "), "the list stands between single spaces: {message}");
}

#[test]
fn a_count_of_256_is_sent_as_00() {
    let first = discrete!("M0");
    let requests = [
        (
            framed(Framing::Ascii, Side::Client, 1, 0x43, b"00M0000"),
            Request::ReadDisabled(ReadDisabled::new(first, 256).unwrap()),
        ),
        (
            framed(Framing::Ascii, Side::Client, 1, 0x44, b"00M0000"),
            Request::ReadDiscretes(ReadDiscretes::new(first, 256).unwrap()),
        ),
    ];
    for (bytes, request) in requests {
        let expected = match &request {
            Request::ReadDisabled(request) => send(request, Framing::Ascii),
            Request::ReadDiscretes(request) => send(request, Framing::Ascii),
            other => panic!("{other:?}"),
        };
        assert_eq!(expected.unwrap(), bytes);
        assert_eq!(Request::decode(&frame_content(Framing::Ascii, &bytes), Framing::Ascii), Ok(request));
    }
    let write = WriteDiscretes::new(first, vec![true; 256]).unwrap();
    let binary = framed(Framing::Binary, Side::Client, 1, 0x45, &[b"\0M\0\0", &[1; 256][..]].concat());
    assert_eq!(send(&write, Framing::Binary).unwrap(), binary);
    assert_eq!(
        Request::decode(&frame_content(Framing::Binary, &binary), Framing::Binary),
        Ok(Request::WriteDiscretes(write))
    );
    // 255 is FF. The commands for registers do not take 256.
    assert_eq!(&send(&ReadDiscretes::new(first, 255).unwrap(), Framing::Ascii).unwrap()[5..7], b"FF");
    for (code, data) in [(0x46, &b"00R00000"[..]), (0x46, b"00DR00000"), (0x48, b"00"), (0x49, b"00")] {
        let error = read(Framing::Ascii, code, data).unwrap_err();
        assert!(matches!(error, RequestError::Invalid(InvalidRequest::Count { count: 256, .. })), "{error}");
    }
}

#[test]
fn faulty_requests_have_a_message_and_an_error_code() {
    let ascii: [(u8, &[u8], &str, u8); 16] = [
        (0x44, b"0GX0000", "47h is not a hexadecimal digit", 2),
        (0x44, b"06X00G0", "47h is not a decimal digit", 2),
        (0x44, b"06Q0000", "no element has these letters", 4),
        (0x44, b"06X000", "the data is too short", 4),
        (0x44, b"06X00000", "the data is too long", 4),
        (0x44, b"06X9999", "X10004 is past the last address of the ascii framing, X9999", 0xA),
        (0x44, b"06R00000", "R0 is a 16-bit register, not a discrete", 4),
        (0x45, b"01X00002", "2 is not the state of a discrete (0 or 1)", 2),
        (0x46, b"01R65536", "R65536 is past the last address, R65535", 0xA),
        (0x46, b"41R00000", "read registers (46h): 65 items were asked for, and it takes 1 to 64", 2),
        (0x46, b"01WX0004", "WX4: the address of WX must be a multiple of 8", 0xA),
        (0x46, b"01X0000", "X0 is a discrete, not a 16-bit register", 4),
        (0x41, b"2", "2 is not a code of this command", 2),
        (0x42, b"5X0000", "5 is not a code of this command", 2),
        (0x42, b"1WX0000", "WX0 is a 16-bit register, not a discrete", 4),
        (0x51, b"", "there is no command 51", 4),
    ];
    let binary: [(u8, &[u8], &str, u8); 8] = [
        (0x44, b"\x06X\xFF\xFF", "6 elements from X65535 on reach past the last address, X65535", 0xA),
        (0x44, b"\x06Q\0\0", "the data is no list of elements that fills it", 4),
        (0x44, b"\x06x\0\0", "the data is no list of elements that fills it", 4),
        (0x45, b"\x01X\0\0\x02", "2 is not the state of a discrete (0 or 1)", 2),
        (0x46, b"\x01WX\0\x04", "WX4: the address of WX must be a multiple of 8", 0xA),
        (0x48, b"\x02RT\0WX\0\0", "the list of elements can be read in more than one way", 4),
        (0x4F, b"\0\0", "there is no command 4F", 4),
        (0x50, b"\0\0", "there is no command 50", 4),
    ];
    let all = ascii.map(|case| (Framing::Ascii, case)).into_iter().chain(binary.map(|case| (Framing::Binary, case)));
    for (framing, (code, data, message, answer)) in all {
        let case = format!("{framing} {code:02X} {}", data.escape_ascii());
        let error = read(framing, code, data).expect_err(&case);
        assert!(error.to_string().starts_with(message), "{case}: {error}");
        assert_eq!(Some(error.error_code()), ErrorCode::from_u8(answer), "{case}: {error}");
    }
}

#[test]
fn a_loop_back_carries_256_printable_characters_or_bytes() {
    for byte in 0..=u8::MAX {
        for len in [1, 7, 256] {
            let mut data = vec![b'.'; len];
            data[len - 1] = byte;
            let request = LoopBack::new(data).unwrap();
            assert!(send(&request, Framing::Binary).is_ok());
            let expected = InvalidRequest::NotPrintable { code: Code::LoopBack, byte, position: len - 1 };
            let printable = (0x20..=0x7E).contains(&byte);
            assert_eq!(send(&request, Framing::Ascii).err(), (!printable).then_some(expected));
        }
    }
    for framing in FRAMINGS {
        assert!(send(&LoopBack::new("").unwrap(), framing).is_ok(), "no data is legal");
    }
}

#[test]
fn the_longest_requests_are_far_below_the_limit_of_a_frame() {
    let words = ReadMixed::new(vec![element!("WX8"); 64]).unwrap();
    let write = WriteDiscretes::new(discrete!("X0"), vec![true; 256]).unwrap();
    let len = |result: Result<BytesMut, _>| result.unwrap().len();
    assert_eq!(len(send(&words, Framing::Ascii)), 394);
    assert_eq!(len(send(&write, Framing::Ascii)), 271);
    assert_eq!(len(send(&write, Framing::Binary)), 270);
    assert_eq!(len(send(&LoopBack::new(vec![b'A'; 256]).unwrap(), Framing::Binary)), 266);
    common::for_every_command(100, |framing, exchange| {
        let longest = if framing == Framing::Ascii { 394 } else { 270 };
        let len = exchange.encode_request(framing, 1).map_or(0, |frame| frame.len());
        proptest::prop_assert!(len <= longest && exchange.encode_reply(framing, 1, None).len() <= 394);
        Ok(())
    });
}

#[test]
fn an_oversized_frame_is_not_encoded() {
    for (framing, side) in
        [(Framing::Ascii, Side::Client), (Framing::Binary, Side::Client), (Framing::Binary, Side::Plc)]
    {
        for max in [20, 508, MAX_FRAME_LEN] {
            let mut codec = match Codec::new(framing, side) {
                Codec::Binary(codec) => Codec::Binary(codec.max_frame_len(max)),
                _ => Codec::Ascii(AsciiCodec::new().max_frame_len(max)),
            };
            let longest = max - common::overhead(framing);
            let mut buffer = BytesMut::new();
            codec.encode(frame_of(longest), &mut buffer).unwrap();
            assert_eq!(buffer.len(), max);
            let error = codec.encode(frame_of(longest + 1), &mut buffer).unwrap_err();
            assert_eq!(error.to_string(), format!("a frame of {} bytes is over the limit of {max}", max + 1));
            assert_eq!(buffer.len(), max, "no partial frame is left");
        }
    }
}

#[test]
fn a_binary_frame_never_exceeds_its_length_field() {
    let mut codec = BinaryCodec::client().max_frame_len(usize::MAX);
    let mut buffer = BytesMut::new();
    codec.encode(frame_of(65_533), &mut buffer).unwrap();
    assert_eq!((buffer.len(), &buffer[..4]), (65_543, &b"\x51\x10\xFF\xFF"[..]));
    let error = codec.encode(frame_of(65_534), &mut buffer).unwrap_err();
    assert!(matches!(error, EncodeError::TooLong { len: 65_544, max: 65_543 }), "{error}");
    assert_eq!(buffer.len(), 65_543);
}

#[test]
fn an_unprintable_byte_is_reported_with_its_position() {
    for byte in (0..=u8::MAX).filter(|byte| !(0x20..=0x7E).contains(byte)) {
        for position in [0, 3] {
            let mut data = *b"R000";
            data[position] = byte;
            let frame = Frame { station: 1, command: 0x46, data: Bytes::copy_from_slice(&data) };
            let mut buffer = BytesMut::new();
            let error = AsciiCodec::new().encode(&frame, &mut buffer).unwrap_err().to_string();
            assert!(error.contains(&format!("{byte:02X}h at position {position}")), "{error}");
            assert!(buffer.is_empty(), "no partial frame is left");
            assert!(BinaryCodec::client().encode(&frame, &mut buffer).is_ok());
        }
    }
}

fn send<C: Command>(request: &C, framing: Framing) -> Result<BytesMut, InvalidRequest> {
    let mut frame = BytesMut::from(&b"before"[..]);
    let result = encode_request(request, framing, 1, &mut frame);
    assert_eq!(frame.split_to(6), b"before"[..]);
    assert!(result.is_ok() || frame.is_empty(), "no partial frame is left");
    result.map(|()| frame)
}

fn read(framing: Framing, command: u8, data: &[u8]) -> Result<Request, RequestError> {
    Request::decode(&Frame { station: 1, command, data: Bytes::copy_from_slice(data) }, framing)
}

fn frame_of(data_len: usize) -> Frame {
    Frame { station: 1, command: 0x4E, data: vec![b'A'; data_len].into() }
}
