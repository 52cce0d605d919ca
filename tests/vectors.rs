//! All examples of the manuals, from `vectors.tsv`, in both directions and cut at every position.

mod common;

use std::collections::BTreeSet;

use bytes::BytesMut;
use common::{AnyExchange, Vector, decode, exchange, frame_content, framed, frames, vectors};
use fatek::command::*;
use fatek::wire::{Codec, Framing, Received, Side};
use fatek::{Register, discrete, element, register, register32};
use tokio_util::codec::{Decoder, Encoder};

/// Number of rows in the file.
const ROWS: usize = 45;

/// Typed request and reply of the manuals' example of a command.
fn meaning(framing: Framing, command: u8) -> Option<AnyExchange> {
    use DiscreteControl::{Disable, Set};
    use Value::{Bit, DWord, Word};

    let off_on = |states: &str| states.bytes().map(|b| b == b'1').collect::<Vec<_>>();
    Some(match (framing, command) {
        (Framing::Ascii, 0x40) => exchange(ReadStatus, BriefStatus::from_raw([0x29, 0, 0]), Request::ReadStatus),
        (Framing::Ascii, 0x41) => exchange(ControlPlc::Run, (), Request::ControlPlc),
        (Framing::Ascii, 0x42) => {
            exchange(ControlDiscrete::new(Disable, discrete!("X16")), (), Request::ControlDiscrete)
        }
        (Framing::Ascii, 0x43) => {
            let request = ReadDisabled::new(discrete!("Y10"), 7).unwrap();
            exchange(request, off_on("1010001"), Request::ReadDisabled)
        }
        (Framing::Ascii, 0x44) => {
            let request = ReadDiscretes::new(discrete!("X50"), 6).unwrap();
            exchange(request, off_on("010110"), Request::ReadDiscretes)
        }
        (Framing::Ascii, 0x45) => {
            let request = WriteDiscretes::new(discrete!("Y0"), off_on("1001")).unwrap();
            exchange(request, (), Request::WriteDiscretes)
        }
        (Framing::Ascii, 0x46) => {
            let request = ReadRegisters::new(Register::r(12), 3).unwrap();
            exchange(request, vec![0x10A5, 0x7FC4, 0x0001], Request::ReadRegisters)
        }
        (Framing::Ascii, 0x47) => {
            let request = WriteRegisters::new(register!("WY8"), [0xAAAA, 0x5555]).unwrap();
            exchange(request, (), Request::WriteRegisters)
        }
        (Framing::Ascii, 0x48) => {
            let request = ReadMixed::new([element!("R1"), element!("Y9"), element!("DWM0")]).unwrap();
            exchange(request, vec![Word(0x5C34), Bit(true), DWord(0x0035_47BA)], Request::ReadMixed)
        }
        (Framing::Ascii, 0x49) => {
            let request = WriteMixed::new([
                (element!("Y0"), Bit(true)),
                (element!("Y1"), Bit(false)),
                (element!("WM8"), Word(0x5555)),
                (element!("DR2"), DWord(0xFF)),
            ]);
            exchange(request.unwrap(), (), Request::WriteMixed)
        }
        (Framing::Ascii, 0x4E) => exchange(LoopBack::new("ABCDEFG").unwrap(), (), Request::LoopBack),
        (Framing::Ascii, 0x53) => {
            let reply = DetailedStatus::from_raw([0x21; 64].to_vec()).unwrap();
            exchange(ReadDetailedStatus, reply, Request::ReadDetailedStatus)
        }
        (Framing::Binary, 0x40) => exchange(ReadStatus, BriefStatus::from_raw([1, 0, 0]), Request::ReadStatus),
        (Framing::Binary, 0x41) => exchange(ControlPlc::Stop, (), Request::ControlPlc),
        (Framing::Binary, 0x42) => exchange(ControlDiscrete::new(Set, discrete!("Y100")), (), Request::ControlDiscrete),
        (Framing::Binary, 0x43) => {
            let request = ReadDisabled::new(discrete!("X0"), 4).unwrap();
            exchange(request, vec![true; 4], Request::ReadDisabled)
        }
        (Framing::Binary, 0x44) => {
            let request = ReadDiscretes::new(discrete!("Y0"), 15).unwrap();
            exchange(request, vec![false; 15], Request::ReadDiscretes)
        }
        (Framing::Binary, 0x45) => {
            let request = WriteDiscretes::new(discrete!("Y0"), off_on("010")).unwrap();
            exchange(request, (), Request::WriteDiscretes)
        }
        (Framing::Binary, 0x46) => {
            let request = ReadRegisters::new(Register::r(0), 2).unwrap();
            exchange(request, vec![0xFF55, 0xFF4B], Request::ReadRegisters)
        }
        (Framing::Binary, 0x47) => {
            let request = WriteRegisters::new(Register::r(0), [0xFF55, 0xFF4B, 0xFF41]).unwrap();
            exchange(request, (), Request::WriteRegisters)
        }
        (Framing::Binary, 0x48) => {
            let request = ReadMixed::new([element!("DR15"), element!("D1")]).unwrap();
            exchange(request, vec![DWord(0x9999_0000), Word(0)], Request::ReadMixed)
        }
        (Framing::Binary, 0x49) => {
            let items = [(register32!("DR0").into(), DWord(0)), (Register::r(15).into(), Word(0xFF))];
            exchange(WriteMixed::new(items).unwrap(), (), Request::WriteMixed)
        }
        (Framing::Binary, 0x4E) => exchange(LoopBack::new(&[0xFF, 0xFF][..]).unwrap(), (), Request::LoopBack),
        _ => return None,
    })
}

/// All rows with their meaning. Panics on a row without one.
fn rows() -> Vec<(Vector, AnyExchange)> {
    let with_meaning = |vector: Vector| {
        let meaning = meaning(vector.framing, vector.command).unwrap_or_else(|| panic!("no meaning: {}", vector.row));
        assert_eq!(u8::from(meaning.code()), vector.command, "{}", vector.row);
        (vector, meaning)
    };
    vectors().into_iter().map(with_meaning).collect()
}

#[test]
fn each_row_has_a_meaning_and_each_meaning_a_row() {
    let rows = rows();
    assert_eq!(rows.len(), ROWS);
    let key = |v: &Vector| (v.framing, v.command, v.sender == Side::Client);
    let distinct: BTreeSet<_> = rows.iter().map(|(vector, _)| key(vector)).collect();
    assert_eq!(distinct.len(), ROWS, "duplicate row");
    for framing in common::FRAMINGS {
        for command in (0..=u8::MAX).filter(|&command| meaning(framing, command).is_some()) {
            assert!(distinct.contains(&(framing, command, true)), "{framing} {command:02X}: a meaning without a row");
        }
    }
}

#[test]
fn every_typed_request_and_reply_encodes_to_the_manuals_bytes() {
    for (vector, meaning) in rows() {
        let bytes = match vector.sender {
            Side::Client => meaning.encode_request(vector.framing, 1).expect(vector.row),
            Side::Plc => meaning.encode_reply(vector.framing, 1, None),
        };
        assert_eq!(bytes, vector.bytes, "{}", vector.row);
    }
}

#[test]
fn the_manuals_bytes_decode_to_every_typed_request_and_reply() {
    for (vector, meaning) in rows() {
        let [frame] = frames(decode(&mut vector.codec(), [&vector.bytes[..]])).try_into().expect(vector.row);
        assert_eq!(frame, vector.frame(), "{}", vector.row);
        assert_eq!((frame.station, frame.command), (1, vector.command), "{}", vector.row);
        match vector.sender {
            Side::Client => {
                assert_eq!(Request::decode(&frame, vector.framing), Ok(meaning.request()), "{}", vector.row);
            }
            Side::Plc => assert_eq!(meaning.decode_reply(vector.framing, &frame.data), Ok(true), "{}", vector.row),
        }
    }
}

#[test]
fn requests_survive_a_round_trip_through_either_framing() {
    let requests = vectors().into_iter().filter(|vector| vector.sender == Side::Client);
    for (vector, other) in requests.flat_map(|vector| common::FRAMINGS.map(|other| (vector.clone(), other))) {
        let request = Request::decode(&vector.frame(), vector.framing).expect(vector.row);
        let mut bytes = BytesMut::new();
        match request.encode(other, 1, &mut bytes) {
            Ok(()) => {}
            // The manual's example holds FF FF.
            Err(InvalidRequest::NotPrintable { .. }) if (vector.command, other) == (0x4E, Framing::Ascii) => continue,
            Err(error) => panic!("{}: {error}", vector.row),
        }
        let back = Request::decode(&frame_content(other, &bytes), other).expect(vector.row);
        bytes.clear();
        back.encode(vector.framing, 1, &mut bytes).expect(vector.row);
        assert_eq!(bytes, vector.bytes, "{}: by way of {other}", vector.row);
    }
}

#[test]
fn encoding_appends_the_manuals_bytes_to_the_buffer() {
    for vector in vectors() {
        let mut buffer = BytesMut::from(&b"before"[..]);
        Codec::new(vector.framing, vector.sender).encode(vector.frame(), &mut buffer).expect(vector.row);
        assert_eq!(buffer, [b"before", &vector.bytes[..]].concat(), "{}", vector.row);
    }
}

#[test]
fn every_vector_cut_in_two_at_every_place_is_one_frame() {
    let mut cuts = 0;
    for vector in vectors() {
        for cut in 0..=vector.bytes.len() {
            let (mut codec, mut buffer, mut items) = (vector.codec(), BytesMut::new(), Vec::new());
            for piece in [&vector.bytes[..cut], &vector.bytes[cut..]] {
                assert!(items.is_empty() || piece.is_empty(), "{}: decoded too early, cut at {cut}", vector.row);
                buffer.extend_from_slice(piece);
                common::drain(&mut codec, &mut buffer, &mut items);
            }
            assert_eq!(items, [Received::Frame(vector.frame())], "{}: cut at {cut}", vector.row);
            assert_eq!(codec.decode_eof(&mut buffer).unwrap(), None, "{}: cut at {cut}", vector.row);
            cuts += 1;
        }
    }
    assert_eq!(cuts, 734);
}

#[test]
fn every_vector_byte_by_byte_is_one_frame() {
    for vector in vectors() {
        let items = decode(&mut vector.codec(), vector.bytes.chunks(1));
        assert_eq!(items, [Received::Frame(vector.frame())], "{}", vector.row);
    }
}

#[test]
fn a_truncated_vector_is_no_frame() {
    for vector in vectors() {
        for len in 0..vector.bytes.len() {
            assert!(frames(decode(&mut vector.codec(), [&vector.bytes[..len]])).is_empty(), "{}: {len}", vector.row);
        }
    }
}

#[test]
fn a_flipped_bit_loses_one_frame_and_not_the_next() {
    for vector in vectors() {
        for bit in 0..8 * vector.bytes.len() {
            let mut flipped = vector.bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let found = frames(decode(&mut vector.codec(), [&flipped[..], &vector.bytes]));
            // One bit may differ: the case of a letter in the checksum.
            let same = vector.framing == Framing::Ascii && flipped.eq_ignore_ascii_case(&vector.bytes);
            let same = same && bit / 8 + 3 >= vector.bytes.len();
            assert_eq!(found, vec![vector.frame(); 1 + usize::from(same)], "{}: bit {bit}", vector.row);
        }
    }
}

#[test]
fn a_binary_vector_is_ignored_by_its_own_side() {
    for vector in vectors() {
        let found = frames(decode(&mut Codec::new(vector.framing, vector.sender), [&vector.bytes[..]]));
        assert_eq!(found.len(), usize::from(vector.framing == Framing::Ascii), "{}", vector.row);
    }
}

#[test]
fn every_ascii_vector_in_lower_case_means_the_same() {
    // Not loop-backs: their data are characters, not numbers.
    for (vector, meaning) in rows().into_iter().filter(|(v, _)| v.framing == Framing::Ascii && v.command != 0x4E) {
        let data = vector.frame().data.to_ascii_lowercase();
        let lower = framed(Framing::Ascii, vector.sender, 1, vector.command, &data).to_ascii_lowercase();
        let [frame] = frames(decode(&mut vector.codec(), [&lower[..]])).try_into().expect(vector.row);
        assert_eq!(frame, frame_content(Framing::Ascii, &lower));
        match vector.sender {
            Side::Client => {
                assert_eq!(Request::decode(&frame, Framing::Ascii), Ok(meaning.request()), "{}", vector.row);
            }
            Side::Plc => assert_eq!(meaning.decode_reply(Framing::Ascii, &frame.data), Ok(true), "{}", vector.row),
        }
    }
}
