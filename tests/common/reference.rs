//! Reference implementation of the framings, independent of the codec, for tests and fuzz targets.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![allow(dead_code, reason = "each user needs a part of it")]

use std::ops::Range;

use bytes::{Bytes, BytesMut};
use fatek::wire::{Codec, Frame, Framing, MAX_FRAME_LEN, Received, Side};
use tokio_util::codec::Decoder;

/// One row of `vectors.tsv`.
#[derive(Clone)]
pub(crate) struct Vector {
    pub(crate) framing: Framing,
    pub(crate) sender: Side,
    pub(crate) command: u8,
    pub(crate) bytes: Vec<u8>,
    pub(crate) row: &'static str,
}

impl Vector {
    /// Codec of the receiving side.
    pub(crate) fn codec(&self) -> Codec {
        Codec::new(self.framing, other_side(self.sender))
    }

    /// Content of the frame, decoded without the codec.
    pub(crate) fn frame(&self) -> Frame {
        frame_content(self.framing, &self.bytes)
    }
}

pub(crate) fn vectors() -> Vec<Vector> {
    let rows = include_str!("../vectors.tsv").lines().filter(|line| !line.starts_with('#') && !line.is_empty());
    rows.map(|row| {
        let [framing, direction, command, bytes, _meaning, _source] =
            row.split('\t').collect::<Vec<_>>().try_into().unwrap_or_else(|_| panic!("six columns: {row}"));
        let sender = match direction {
            "request" => Side::Client,
            "reply" => Side::Plc,
            _ => panic!("neither request nor reply: {row}"),
        };
        let hex = |text| u8::from_str_radix(text, 16).expect(row);
        let bytes = bytes.split(' ').map(hex).collect();
        Vector { framing: framing.parse().expect(row), sender, command: hex(command), bytes, row }
    })
    .collect()
}

pub(crate) fn other_side(side: Side) -> Side {
    match side {
        Side::Client => Side::Plc,
        Side::Plc => Side::Client,
    }
}

/// Decodes the pieces of an input until nothing is left.
pub(crate) fn decode<'a>(codec: &mut Codec, pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<Received> {
    decode_within(MAX_FRAME_LEN, codec, pieces)
}

/// Like [`decode`], for a codec with another frame limit. Panics if the buffer outgrows the limit.
pub(crate) fn decode_within<'a>(
    max_frame_len: usize,
    codec: &mut Codec,
    pieces: impl IntoIterator<Item = &'a [u8]>,
) -> Vec<Received> {
    let mut buffer = BytesMut::new();
    let mut items = Vec::new();
    for piece in pieces {
        buffer.extend_from_slice(piece);
        drain(codec, &mut buffer, &mut items);
        assert!(buffer.len() <= max_frame_len, "{} bytes wait, the limit is {max_frame_len}", buffer.len());
    }
    while let Some(item) = codec.decode_eof(&mut buffer).unwrap() {
        items.push(item);
    }
    assert!(buffer.is_empty(), "{} bytes are left at the end of the input", buffer.len());
    items
}

/// Decodes all items that are complete in the buffer.
pub(crate) fn drain(codec: &mut Codec, buffer: &mut BytesMut, items: &mut Vec<Received>) {
    while let Some(item) = codec.decode(buffer).unwrap() {
        items.push(item);
    }
}

pub(crate) fn frames(items: Vec<Received>) -> Vec<Frame> {
    items.into_iter().filter_map(Received::frame).collect()
}

/// Ranges of the input that the decoded frames cover.
///
/// Fails unless the items are the input: every byte once, in order.
pub(crate) fn frame_ranges(framing: Framing, input: &[u8], items: &[Received]) -> Result<Vec<Range<usize>>, String> {
    let mut at = 0;
    let mut frame_ranges = Vec::new();
    for item in items {
        let len = match item {
            Received::Discarded { bytes, .. } => bytes.len(),
            Received::Frame(frame) => frame.data.len() + overhead(framing),
            other => return Err(format!("unknown item {other:?}")),
        };
        let part = input.get(at..at + len).ok_or_else(|| format!("{item:?} at {at} is past the end of the input"))?;
        match item {
            Received::Frame(frame) if *frame == frame_content(framing, part) => frame_ranges.push(at..at + len),
            Received::Discarded { bytes, .. } if !bytes.is_empty() && bytes == part => {}
            _ => return Err(format!("{item:?} at {at} is not what the input holds there")),
        }
        at += len;
    }
    if at == input.len() { Ok(frame_ranges) } else { Err(format!("{} bytes of {} came out", at, input.len())) }
}

/// Ranges of the frames for `receiver` by the reference decoder: left to right, not nested.
pub(crate) fn reference_ranges(framing: Framing, receiver: Side, input: &[u8], max: usize) -> Vec<Range<usize>> {
    let mut frame_ranges = Vec::new();
    let mut at = 0;
    while at < input.len() {
        let found = match framing {
            Framing::Binary => binary_frame(&input[at..], max),
            _ => ascii_frame(&input[at..], max),
        };
        if let Some(len) = found
            && (framing == Framing::Ascii || (input[at] == 0x52) == (receiver == Side::Client))
        {
            frame_ranges.push(at..at + len);
        }
        at += found.unwrap_or(1);
    }
    frame_ranges
}

fn ascii_frame(input: &[u8], max: usize) -> Option<usize> {
    if input.first() != Some(&2) {
        return None;
    }
    let etx = 1 + input.get(1..)?.iter().position(|b| matches!(b, 2 | 3))?;
    let hex = |range: Range<usize>| std::str::from_utf8(input.get(range)?).ok().filter(|t| !t.contains('+'));
    let number = |range| u8::from_str_radix(hex(range)?, 16).ok();
    let good = input[etx] == 3 && (8..=max).contains(&(etx + 1));
    let good = good && number(1..3).is_some() && number(3..5).is_some();
    (good && number(etx - 2..etx)? == lrc(&input[..etx - 2])).then_some(etx + 1)
}

fn binary_frame(input: &[u8], max: usize) -> Option<usize> {
    let &[0x51 | 0x52, 0x10, high, low, ..] = input else { return None };
    let len = usize::from(u16::from_be_bytes([high, low])) + 8;
    let frame = input.get(..len).filter(|_| (10..=max).contains(&len))?;
    (frame[len - 4..] == trailer(&frame[2..len - 4])).then_some(len)
}

/// Encodes a frame without the codec. The sender matters in the binary framing only.
pub(crate) fn framed(framing: Framing, sender: Side, station: u8, command: u8, data: &[u8]) -> Vec<u8> {
    if framing == Framing::Ascii {
        let mut frame = format!("\x02{station:02X}{command:02X}").into_bytes();
        frame.extend(data);
        let tail = format!("{:02X}\x03", lrc(&frame));
        return [&frame, tail.as_bytes()].concat();
    }
    let header = if sender == Side::Client { 0x51 } else { 0x52 };
    let length = u16::try_from(data.len() + 2).unwrap().to_be_bytes();
    let covered = [&length[..], &[station, command], data].concat();
    [&[header, 0x10][..], &covered, &trailer(&covered)].concat()
}

/// Content of a well-formed frame.
pub(crate) fn frame_content(framing: Framing, bytes: &[u8]) -> Frame {
    if framing == Framing::Binary {
        let data = Bytes::copy_from_slice(&bytes[6..bytes.len() - 4]);
        return Frame { station: bytes[4], command: bytes[5], data };
    }
    let byte = |at: usize| u8::from_str_radix(std::str::from_utf8(&bytes[at..at + 2]).unwrap(), 16).unwrap();
    let data = Bytes::copy_from_slice(&bytes[5..bytes.len() - 3]);
    Frame { station: byte(1), command: byte(3), data }
}

/// Bytes of a frame that are not data.
pub(crate) fn overhead(framing: Framing) -> usize {
    if framing == Framing::Ascii { 8 } else { 10 }
}

fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |sum, byte| sum.wrapping_add(*byte))
}

/// CRC-16/MODBUS, bit by bit, low byte first, and the terminator.
fn trailer(covered: &[u8]) -> [u8; 4] {
    let crc = covered.iter().fold(0xFFFF_u16, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    });
    let [low, high] = crc.to_le_bytes();
    [low, high, 0x55, 0xAA]
}
