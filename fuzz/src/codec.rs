//! Decoders are total: every byte comes out once and in order, however the input is cut into
//! pieces. The frames are those of the reference decoder, and encoding a decoded frame gives its
//! bytes. The buffer never exceeds the longest frame.

use bytes::BytesMut;
use fatek::wire::{AsciiCodec, BinaryCodec, Codec, EncodeError, Framing, MAX_FRAME_LEN, Received, Side};
use tokio_util::codec::{Decoder, Encoder};

use crate::input::{Flags, Input};
use crate::reference::{decode_within, drain, frame_content, frame_ranges, reference_ranges};
use crate::repair::repair;

/// Bits of the first byte.
const REPAIR: u8 = 0;
const PLC: u8 = 1;
const SHORT: u8 = 2;
const SINGLE_BYTES: u8 = 3;

/// Frame limit that short inputs exceed.
const SHORT_LIMIT: usize = 24;

pub(crate) fn run(framing: Framing, input: &[u8]) {
    let mut input = Input::new(input);
    let flags = Flags(input.byte());
    let cuts = input.byte();
    let mut bytes = input.rest().to_vec();
    if flags.has(REPAIR) {
        repair(framing, &mut bytes);
    }
    let receiver = if flags.has(PLC) { Side::Plc } else { Side::Client };
    let limit = if flags.has(SHORT) { SHORT_LIMIT } else { MAX_FRAME_LEN };

    let whole = decode_within(limit, &mut codec(framing, receiver, limit), bytes.chunks(limit.max(1)));
    let found = frame_ranges(framing, &bytes, &whole).unwrap();
    assert_eq!(found, reference_ranges(framing, receiver, &bytes, limit), "frames of the reference decoder");

    let pieces = if flags.has(SINGLE_BYTES) { 1 } else { usize::from(cuts % 61) + 2 };
    let cut = decode_within(limit, &mut codec(framing, receiver, limit), bytes.chunks(pieces.min(limit)));
    assert_eq!(frame_ranges(framing, &bytes, &cut).unwrap(), found, "pieces of {pieces} bytes");
    assert_eq!(frames(&cut), frames(&whole));

    silences(framing, receiver, limit, &bytes, usize::from(cuts) + 1);
    for place in found {
        encodes_to_itself(framing, receiver, &bytes[place]);
    }
}

fn codec(framing: Framing, receiver: Side, limit: usize) -> Codec {
    match (framing, receiver) {
        (Framing::Ascii, _) => Codec::Ascii(AsciiCodec::new().max_frame_len(limit)),
        (_, Side::Client) => Codec::Binary(BinaryCodec::client().max_frame_len(limit)),
        (_, Side::Plc) => Codec::Binary(BinaryCodec::plc().max_frame_len(limit)),
    }
}

fn frames(items: &[Received]) -> Vec<&fatek::wire::Frame> {
    items.iter().filter_map(|item| if let Received::Frame(frame) = item { Some(frame) } else { None }).collect()
}

/// A line that falls silent now and then: other frames may be found, but no byte is lost or comes
/// twice.
fn silences(framing: Framing, receiver: Side, limit: usize, bytes: &[u8], pieces: usize) {
    let mut codec = codec(framing, receiver, limit);
    let (mut buffer, mut items) = (BytesMut::new(), Vec::new());
    for piece in bytes.chunks(pieces.min(limit)) {
        buffer.extend_from_slice(piece);
        drain(&mut codec, &mut buffer, &mut items);
        codec.skip_partial();
        drain(&mut codec, &mut buffer, &mut items);
        assert!(buffer.len() <= limit);
    }
    while let Some(item) = codec.decode_eof(&mut buffer).unwrap() {
        items.push(item);
    }
    frame_ranges(framing, bytes, &items).unwrap();
}

fn encodes_to_itself(framing: Framing, receiver: Side, bytes: &[u8]) {
    let frame = frame_content(framing, bytes);
    let sender = if receiver == Side::Client { Side::Plc } else { Side::Client };
    let mut encoded = BytesMut::new();
    match Codec::new(framing, sender).encode(&frame, &mut encoded) {
        // Digits of either case are accepted, upper case is sent.
        Ok(()) if framing == Framing::Ascii => {
            assert!(encoded.eq_ignore_ascii_case(bytes) || lower_case_checksum(bytes), "{frame:?}");
        }
        Ok(()) => assert_eq!(encoded, bytes),
        Err(EncodeError::NotPrintable { byte, position }) => {
            assert_eq!(frame.data.get(position), Some(&byte));
            assert!(framing == Framing::Ascii && !(0x20..=0x7E).contains(&byte));
        }
        Err(error) => panic!("{frame:?}: {error}"),
    }
    if !encoded.is_empty() {
        let decoded = Codec::new(framing, receiver).decode(&mut encoded).unwrap();
        assert_eq!(decoded, Some(Received::Frame(frame)));
    }
}

/// Returns whether station or command have lower case digits, so that the checksum of the encoded
/// frame differs.
fn lower_case_checksum(bytes: &[u8]) -> bool {
    bytes.iter().skip(1).take(4).any(u8::is_ascii_lowercase)
}
