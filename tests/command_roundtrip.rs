//! Round trips of every command through both framings, and rejected replies.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

mod common;

use bytes::BytesMut;
use common::{AnyExchange, FRAMINGS, Rng, decode, exchange, for_every_command, frame_content, framed, frames, value};
use fatek::command::*;
use fatek::wire::{Codec, FieldError, Frame, Framing, Side};
use fatek::{Element, ErrorCode, Register, Symbol, discrete, element};
use proptest::collection::vec;
use proptest::prelude::*;

/// Number of exchanges of each command, framing and property.
const CASES: u32 = 128;

#[test]
fn every_request_decodes_as_it_was_encoded() {
    for_every_command(CASES, |framing, exchange| {
        let request = exchange.request();
        prop_assert_eq!(request.code(), exchange.code());
        let mut untyped = BytesMut::new();
        let encoded = request.encode(framing, 7, &mut untyped).map(|()| untyped);
        prop_assert_eq!(&encoded, &exchange.encode_request(framing, 7), "equals the encoding of the typed request");
        let frame = match encoded {
            Ok(frame) => received(framing, Side::Plc, &frame),
            Err(InvalidRequest::Ambiguous { code, .. }) => {
                prop_assert_eq!((code, framing), (exchange.code(), Framing::Binary));
                prop_assert!(decodings_of(&exchange.request()) > 1, "{exchange:?} is not ambiguous");
                return Ok(());
            }
            Err(error) => return Err(TestCaseError::fail(format!("{error}: {exchange:?}"))),
        };
        prop_assert_eq!((frame.station, frame.command), (7, exchange.code().into()));
        prop_assert_eq!(Request::decode(&frame, framing), Ok(exchange.request()));
        Ok(())
    });
}

#[test]
fn every_reply_decodes_as_it_was_encoded() {
    for_every_command(CASES, |framing, exchange| {
        let frame = received(framing, Side::Client, &exchange.encode_reply(framing, 254, None));
        prop_assert_eq!((frame.station, frame.command), (254, exchange.code().into()));
        prop_assert_eq!(exchange.decode_reply(framing, &frame.data), Ok(true));
        Ok(())
    });
}

#[test]
fn every_refusal_decodes_with_its_code() {
    for_every_command(4, |framing, exchange| {
        let last = if framing == Framing::Ascii { 0xF } else { 0xFF };
        for code in 1..=last {
            let error = ErrorCode::from_u8(code).expect("only 0 is none");
            prop_assert_eq!(u8::from(error), code);
            let frame = received(framing, Side::Client, &exchange.encode_reply(framing, 1, Some(error)));
            prop_assert_eq!(frame.data.len(), 1);
            let mut refusal = BytesMut::new();
            encode_refusal(frame.command, error, framing, 1, &mut refusal);
            prop_assert_eq!(refusal, exchange.encode_reply(framing, 1, Some(error)), "as for an undecodable request");
            // The echo of a loop-back may have the shape of a refusal. It counts as the echo.
            if exchange.request() != Request::LoopBack(LoopBack::new(frame.data.clone()).unwrap()) {
                prop_assert_eq!(exchange.decode_reply(framing, &frame.data), Err(ReplyError::Plc(error)));
            }
        }
        Ok(())
    });
}

#[test]
fn no_refusal_can_be_encoded_as_a_success() {
    for code in 0..=u8::MAX {
        for framing in FRAMINGS {
            let exchange = exchange(ControlPlc::Run, (), Request::ControlPlc);
            let data = exchange.reply_data(framing, Some(ErrorCode::Unknown(code)));
            let result = exchange.decode_reply(framing, &data);
            assert!(result.is_err(), "{framing}: the refusal with code {code:02X}h decodes as a success");
        }
    }
}

#[test]
fn a_reply_of_wrong_length_is_never_accepted() {
    for_every_command(CASES / 4, |framing, exchange| {
        let data = exchange.reply_data(framing, None);
        for len in 0..data.len() {
            expect_rejected(framing, &exchange, &data[..len])?;
        }
        for (more, filler) in (1..=20).flat_map(|n| [(n, b'0'), (n, b'F'), (n, 0x00), (n, 0x01), (n, b' ')]) {
            expect_rejected(framing, &exchange, &[&data[..], &vec![filler; more]].concat())?;
        }
        Ok(())
    });
}

#[test]
fn a_refusal_with_data_is_never_accepted() {
    for_every_command(CASES / 4, |framing, exchange| {
        let data = exchange.reply_data(framing, None);
        // An acknowledgement has no data, and loop-backs and pages need no error code.
        if data.len() > 1 && !matches!(exchange.code(), Code::LoopBack | Code::ReadProgramPage) {
            for code in 1..=15_u8 {
                let refusal = exchange.reply_data(framing, ErrorCode::from_u8(code));
                let result = exchange.decode_reply(framing, &[&refusal[..], &data[1..]].concat());
                prop_assert_eq!(result, Err(ReplyError::Mismatch(FieldError::Trailing)));
            }
        }
        Ok(())
    });
}

#[test]
fn an_ascii_reply_with_a_non_digit_is_never_accepted() {
    for_every_command(CASES / 32, |framing, exchange| {
        if framing == Framing::Binary {
            return Ok(());
        }
        let data = exchange.reply_data(framing, None);
        for at in 0..data.len() {
            for wrong in [b'G', b'g', b' ', b'/', b':', b'@', b'`', 0x00, 0x80, 0xFF] {
                let mut data = data.clone();
                if std::mem::replace(&mut data[at], wrong) != wrong {
                    expect_rejected(framing, &exchange, &data)?;
                }
            }
        }
        Ok(())
    });
}

#[test]
fn a_state_other_than_on_and_off_is_never_accepted() {
    let read = exchange(ReadDiscretes::new(discrete!("Y0"), 3).unwrap(), vec![true; 3], Request::ReadDiscretes);
    let disabled = exchange(ReadDisabled::new(discrete!("Y0"), 3).unwrap(), vec![true; 3], Request::ReadDisabled);
    let bits = ["X0", "X1", "X2"].map(|text| text.parse::<Element>().unwrap());
    let mixed = exchange(ReadMixed::new(bits).unwrap(), vec![Value::Bit(true); 3], Request::ReadMixed);
    for (exchange, framing, at) in [&read, &disabled, &mixed]
        .into_iter()
        .flat_map(|e| FRAMINGS.into_iter().flat_map(move |f| (1..=3).map(move |at| (e, f, at))))
    {
        let mut data = exchange.reply_data(framing, None);
        for state in 2..=15_u8 {
            data[at] = if framing == Framing::Ascii { format!("{state:x}").as_bytes()[0] } else { state };
            let expected = Err(ReplyError::Mismatch(FieldError::NotABit(state)));
            assert_eq!(exchange.decode_reply(framing, &data), expected, "{exchange:?}");
        }
    }
}

#[test]
fn a_reply_with_another_count_is_never_accepted() {
    for framing in FRAMINGS {
        for requested in 1..=64_usize {
            for replied in (1..=64_usize).filter(|&n| n != requested) {
                let request = ReadRegisters::new(Register::r(0), requested).unwrap();
                let reply = exchange(request, vec![0; replied], Request::ReadRegisters).reply_data(framing, None);
                assert!(matches!(decode_reply(&request, framing, &reply), Err(ReplyError::Mismatch(_))));
                let request = ReadDiscretes::new(discrete!("M0"), requested).unwrap();
                let reply = exchange(request, vec![false; replied], Request::ReadDiscretes).reply_data(framing, None);
                assert!(matches!(decode_reply(&request, framing, &reply), Err(ReplyError::Mismatch(_))));
            }
        }
    }
}

#[test]
fn a_program_page_reply_is_recognised_by_its_length() {
    let page = ProgramPage::new(std::array::from_fn(|i| 0xFB00 + i as u16));
    let words = page.words().map(|word| format!("{word:04X}")).concat();
    let read = |data: &str| decode_reply(&ReadProgramPage::new(0), Framing::Ascii, data.as_bytes());
    assert_eq!(read(&words), Ok(page.clone()), "256: the page alone, as in the manual's figure");
    assert_eq!(read(&format!("0{words}")), Ok(page), "257: with the error digit, as in its text");
    assert_eq!(read(&"0".repeat(256)), Ok(ProgramPage::new([0; PAGE_WORDS])));
    for code in 1..=15 {
        assert_eq!(read(&format!("{code:X}")), Err(ErrorCode::from_u8(code).unwrap().into()), "1: the error digit");
        let refusal_and_page = read(&format!("{code:X}{words}"));
        assert!(matches!(refusal_and_page, Err(ReplyError::Mismatch(_))), "{refusal_and_page:?}");
    }
    for len in (0..=300).filter(|len| ![256, 257].contains(len)) {
        assert!(matches!(read(&"0".repeat(len)), Err(ReplyError::Mismatch(_))), "{len}");
        assert!(len == 1 || matches!(read(&"4".repeat(len)), Err(ReplyError::Mismatch(_))), "{len}");
    }
}

#[test]
fn a_detailed_status_has_at_least_28_bytes() {
    for framing in FRAMINGS {
        for len in 0..=100_usize {
            let raw: Vec<u8> = (1..).take(len).collect();
            let data = match framing {
                Framing::Ascii => {
                    format!("0{}", raw.iter().map(|b| format!("{b:02X}")).collect::<String>()).into_bytes()
                }
                _ => [&[0], &raw[..]].concat(),
            };
            let status = decode_reply(&ReadDetailedStatus, framing, &data);
            match (len, status) {
                (28.., Ok(status)) => assert_eq!(status.raw(), raw, "the raw bytes are kept"),
                (..28, Err(ReplyError::Mismatch(_))) => {}
                (_, other) => panic!("{framing} {len}: {other:?}"),
            }
            if framing == Framing::Ascii {
                let odd = decode_reply(&ReadDetailedStatus, framing, &[&data[..], b"0"].concat());
                assert!(matches!(odd, Err(ReplyError::Mismatch(_))), "{len} and a half: {odd:?}");
            }
        }
    }
}

#[test]
fn one_digit_is_the_echo_of_a_loop_back_or_a_refusal() {
    let sent = LoopBack::new("5").unwrap();
    let read = |data: &[u8]| decode_reply(&sent, Framing::Ascii, data);
    assert_eq!(read(b"5"), Ok(()));
    assert_eq!(read(b"4"), Err(ErrorCode::IllegalFormat.into()));
    for data in [&b""[..], b"0", b"55", b"05", b"G"] {
        assert_eq!(read(data), Err(ReplyError::Mismatch(FieldError::NotTheEcho)), "{data:?}");
    }
    let upper = LoopBack::new("ABC").unwrap();
    let lower = decode_reply(&upper, Framing::Ascii, b"abc");
    assert_eq!(lower, Err(ReplyError::Mismatch(FieldError::NotTheEcho)), "case matters in a loop-back");
}

#[test]
fn an_ambiguous_binary_list_is_never_sent() {
    let read = |list: &[&str]| ReadMixed::new(list.iter().map(|e| e.parse().unwrap()).collect::<Vec<_>>()).unwrap();
    // 52 54 00 57 58 00 00: `R` at 5400h and `WX` at 0, or `RT` at 57h and `X` at 0.
    let pairs: [[&[&str]; 2]; 5] = [
        [&["R21543", "WX0"], &["RT10071", "X0"]],
        [&["R21504", "WX0"], &["RT87", "X0"]],
        [&["DR21504", "WX0"], &["DRT87", "X0"]],
        [&["DR21504", "DD0"], &["DRT68", "D0"]],
        [&["D17408", "D17152", "DWX0"], &["DD68", "C68", "WX0"]],
    ];
    for list in pairs.as_flattened() {
        let elements = list.iter().map(|text| text.parse().unwrap()).collect();
        let ambiguous = InvalidRequest::Ambiguous { code: Code::ReadMixed, elements };
        assert_eq!(frame_of(&read(list), Framing::Binary), Err(ambiguous), "{list:?}");
        let is_in_ascii = list[0] != "RT10071";
        assert_eq!(frame_of(&read(list), Framing::Ascii).is_ok(), is_in_ascii, "{list:?}: not ambiguous in ASCII");
    }
    // Values matter, too: `DWX` at 0 and `X` at 0, or `D` at 5758h and `DR` at 0.
    let write = |value| WriteMixed::new([(element!("DWX0"), Value::DWord(value)), (element!("X0"), Value::Bit(false))]);
    let elements = vec![element!("DWX0"), element!("X0")];
    let ambiguous = InvalidRequest::Ambiguous { code: Code::WriteMixed, elements };
    assert_eq!(frame_of(&write(0x4452_0000).unwrap(), Framing::Binary), Err(ambiguous));
    assert!(frame_of(&write(0x4452_0000).unwrap(), Framing::Ascii).is_ok());
    assert!(frame_of(&write(0x4453_0000).unwrap(), Framing::Binary).is_ok());
}

#[test]
fn a_list_with_an_ambiguous_prefix_is_sent() {
    for list in [
        &["R21504"][..],
        &["RT87"],
        &["R21504", "X0"],
        &["RT87", "WX0"],
        &["R21504", "R21504", "R21504"],
        &["RT0", "RT1", "RT2", "RC0"],
        &["DWX0", "WX0", "X0"],
        &["D22360", "DWX0"],
        &["R21504", "R0", "DR0"],
    ] {
        let request = ReadMixed::new(list.iter().map(|e| e.parse().unwrap()).collect::<Vec<_>>()).unwrap();
        let frame = frame_of(&request, Framing::Binary).unwrap_or_else(|error| panic!("{list:?}: {error}"));
        assert_eq!(
            Request::decode(&frame_content(Framing::Binary, &frame), Framing::Binary),
            Ok(Request::ReadMixed(request))
        );
    }
}

#[test]
fn exactly_the_ambiguous_lists_are_rejected() {
    let mut rng = Rng(1);
    let (mut sent, mut refused) = ([0; 2], [0; 2]);
    for _ in 0..10_000 {
        // The worst case: addresses and values consist of letters of symbols.
        let items: Vec<(Element, Value)> = (0..2 + rng.index(4)).map(|_| lettered(&mut rng)).collect();
        let elements: Vec<Element> = items.iter().map(|(element, _)| *element).collect();
        let (read, write) = (ReadMixed::new(elements).unwrap(), WriteMixed::new(items).unwrap());
        for (i, request) in
            [Request::ReadMixed(read.clone()), Request::WriteMixed(write.clone())].into_iter().enumerate()
        {
            let result = if i == 0 { frame_of(&read, Framing::Binary) } else { frame_of(&write, Framing::Binary) };
            match (decodings_of(&request), result) {
                (1, Ok(frame)) => {
                    assert_eq!(Request::decode(&frame_content(Framing::Binary, &frame), Framing::Binary), Ok(request));
                    sent[i] += 1;
                }
                (2.., Err(InvalidRequest::Ambiguous { .. })) => refused[i] += 1,
                (decodings, result) => panic!("{decodings} decodings, and {result:?}: {request:?}"),
            }
        }
    }
    assert!(sent.into_iter().chain(refused).all(|n| n > 500), "sent {sent:?}, refused {refused:?}");
}

/// Encoding a decoded request gives its own bytes: nothing is ignored or invented.
#[test]
fn a_decoded_request_encodes_to_the_same_bytes() {
    for_every_command(CASES / 2, |framing, exchange| {
        let Ok(frame) = exchange.encode_request(framing, 1) else { return Ok(()) };
        let right = frame_content(framing, &frame);
        for data in mutations(&right.data) {
            let frame = Frame { data: data.clone().into(), ..right.clone() };
            let Ok(request) = Request::decode(&frame, framing) else { continue };
            match frame_of_any(&request, framing) {
                Ok(bytes) => expect_same_fields(framing, exchange.code(), &frame_content(framing, &bytes).data, &data)?,
                // A line of 8 data bits may carry bytes that this crate does not send.
                Err(error) => prop_assert!(matches!(error, InvalidRequest::NotPrintable { .. }), "{error}"),
            }
        }
        Ok(())
    });
}

#[test]
fn a_decoded_reply_encodes_to_the_same_bytes() {
    for_every_command(CASES / 2, |framing, exchange| {
        for data in mutations(&exchange.reply_data(framing, None)) {
            let Ok(frame) = exchange.reencode_reply(framing, &data) else { continue };
            let without_digit = exchange.code() == Code::ReadProgramPage && data.len() == 256;
            let data = if without_digit { [b"0", &data[..]].concat() } else { data };
            expect_same_fields(framing, exchange.code(), &frame_content(framing, &frame).data, &data)?;
        }
        Ok(())
    });
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_input_makes_a_decoder_panic(
        station: u8,
        command in prop_oneof![any::<u8>(), 0x40_u8..=0x53],
        data in prop_oneof![vec(any::<u8>(), 0..600), vec(prop::sample::select(LETTERS.to_vec()), 0..600)],
    ) {
        let frame = Frame { station, command, data: data.into() };
        let list = ReadMixed::new(["DR0", "WX8", "Y1"].map(|e| e.parse::<Element>().unwrap())).unwrap();
        for framing in FRAMINGS {
            let _ = Request::decode(&frame, framing);
            let _ = decode_reply(&list, framing, &frame.data);
            let _ = decode_reply(&ReadDetailedStatus, framing, &frame.data);
            let _ = decode_reply(&ReadProgramPage::new(1), framing, &frame.data);
        }
    }
}

/// Decodes the single frame in these bytes, as this side receives it.
fn received(framing: Framing, receiver: Side, bytes: &[u8]) -> Frame {
    let [frame] = frames(decode(&mut Codec::new(framing, receiver), [bytes])).try_into().expect("one frame");
    let sender = common::other_side(receiver);
    assert_eq!(framed(framing, sender, frame.station, frame.command, &frame.data), bytes, "reference encoding");
    frame
}

/// Checks that the data is rejected as a reply. A single error code must be reported as that error.
fn expect_rejected(framing: Framing, exchange: &AnyExchange, data: &[u8]) -> Result<(), TestCaseError> {
    let code = match (data, framing) {
        ([digit], Framing::Ascii) => char::from(*digit).to_digit(16).and_then(|d| u8::try_from(d).ok()),
        ([byte], _) => Some(*byte),
        _ => None,
    };
    // For these commands another length can be another valid reply. They have their own tests.
    let other_reply = match exchange.code() {
        Code::ReadDetailedStatus => data.len() >= 29,
        Code::ReadProgramPage => data.len() == 256,
        _ => false,
    };
    match (exchange.decode_reply(framing, data), code.and_then(ErrorCode::from_u8)) {
        (Err(ReplyError::Plc(error)), Some(code)) if error == code => Ok(()),
        (Err(ReplyError::Mismatch(_)), None) => Ok(()),
        (Ok(false), _) if other_reply => Ok(()),
        (result, _) => Err(TestCaseError::fail(format!("{result:?} for {data:02X?}: {exchange:?}"))),
    }
}

fn frame_of<C: Command>(request: &C, framing: Framing) -> Result<BytesMut, InvalidRequest> {
    let mut frame = BytesMut::new();
    encode_request(request, framing, 1, &mut frame).map(|()| frame)
}

fn frame_of_any(request: &Request, framing: Framing) -> Result<BytesMut, InvalidRequest> {
    macro_rules! frame_of_each {
        ($($name:ident)*) => {
            match request {
                $(Request::$name(request) => frame_of(request, framing),)*
                other => panic!("no command of ours: {other:?}"),
            }
        };
    }
    frame_of_each! {
        ReadStatus ControlPlc ControlDiscrete ReadDisabled ReadDiscretes WriteDiscretes ReadRegisters ReadRegisters32
        WriteRegisters WriteRegisters32 ReadMixed WriteMixed LoopBack ReadProgramPage WriteProgramPage
        ReadDetailedStatus
    }
}

/// Compares fields: in ASCII, numbers and symbols may have either case.
fn expect_same_fields(framing: Framing, code: Code, written: &[u8], read: &[u8]) -> Result<(), TestCaseError> {
    let either_case = framing == Framing::Ascii && code != Code::LoopBack;
    prop_assert!(written == read || either_case && written.eq_ignore_ascii_case(read), "{written:02X?} {read:02X?}");
    Ok(())
}

/// Bytes of symbols, digits and counts.
const LETTERS: &[u8] = b"XYMSTCWRDF0123456789ABEabf\x00\x01\x02\x40";

/// The data itself, and variants with one random error.
fn mutations(data: &[u8]) -> Vec<Vec<u8>> {
    let seed = data.iter().fold(data.len() as u64, |seed, byte| seed.wrapping_mul(31).wrapping_add(u64::from(*byte)));
    let mut rng = Rng(seed);
    let mut all = vec![data.to_vec(), data.to_ascii_lowercase()];
    for _ in 0..10 {
        let mut mutation = data.to_vec();
        match rng.index(4) {
            0 => mutation.truncate(rng.index(data.len() + 1)),
            1 => mutation.extend((0..=rng.index(8)).map(|_| rng.pick(LETTERS))),
            _ if data.is_empty() => {}
            2 => mutation[rng.index(data.len())] = rng.pick(LETTERS),
            _ => mutation[rng.index(data.len().min(8))] = rng.next().to_le_bytes()[0],
        }
        all.push(mutation);
    }
    all
}

/// Number of ways to decode a mixed request in the binary framing, found by exhaustive search.
/// Other requests have one.
fn decodings_of(request: &Request) -> u64 {
    match request {
        Request::ReadMixed(request) => {
            let data = request.elements().iter().flat_map(|e| element_bytes(*e)).collect::<Vec<_>>();
            count_decodings(&data, request.elements().len(), false)
        }
        Request::WriteMixed(request) => {
            let item = |(e, v): &(Element, Value)| [element_bytes(*e), value_bytes(*v)].concat();
            count_decodings(&request.items().iter().flat_map(item).collect::<Vec<_>>(), request.items().len(), true)
        }
        _ => 1,
    }
}

fn count_decodings(data: &[u8], elements: usize, values: bool) -> u64 {
    if elements == 0 {
        return u64::from(data.is_empty());
    }
    let behind = |symbol: &Symbol| {
        let rest = data.strip_prefix(symbol.as_str().as_bytes())?;
        let (address, rest) = rest.split_first_chunk()?;
        Element::new(*symbol, u16::from_be_bytes(*address)).ok()?;
        let value_len = if values { (symbol.width().bits() as usize).div_ceil(8) } else { 0 };
        Some(count_decodings(rest.get(value_len..)?, elements - 1, values))
    };
    Symbol::ALL.iter().filter_map(behind).sum()
}

fn element_bytes(element: Element) -> Vec<u8> {
    [element.symbol().as_str().as_bytes(), &element.address().to_be_bytes()].concat()
}

fn value_bytes(value: Value) -> Vec<u8> {
    match value {
        Value::Bit(on) => vec![u8::from(on)],
        Value::Word(word) => word.to_be_bytes().to_vec(),
        Value::DWord(double) => double.to_be_bytes().to_vec(),
    }
}

/// A random element and value whose bytes are letters of symbols where possible.
fn lettered(rng: &mut Rng) -> (Element, Value) {
    loop {
        let symbol = rng.pick(Symbol::ALL);
        let mut byte = || rng.pick(b"\x00\x00\x00XTCRDDWRF");
        let (address, bits) =
            (u16::from_be_bytes([byte(), byte()]), u32::from_be_bytes([byte(), byte(), byte(), byte()]));
        if let Ok(element) = Element::new(symbol, address) {
            return (element, value(element, bits));
        }
    }
}
