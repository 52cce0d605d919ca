//! Changes of the bytes of a reply by faults.

use bytes::{BufMut, Bytes, BytesMut};
use tokio_util::codec::Decoder;

use super::rng::FaultRng;
use super::{DisconnectAt, Fault};
use crate::command::Code;
use crate::wire::{Codec, FieldWriter, Frame, Framing, MAX_FRAME_LEN, Received, Side, ascii, binary};

/// The bytes to send for a reply.
#[derive(Debug, Default)]
pub(super) struct CorruptedReply {
    /// Empty if no reply is sent.
    pub(super) reply: Bytes,
    /// The bytes of a duplicate: the same without the garbage before it.
    pub(super) duplicate: Bytes,
}

/// Changes a reply from the frame outwards; the order of the faults has no effect.
pub(super) fn corrupt(mut reply: BytesMut, framing: Framing, faults: &[Fault], rng: &mut FaultRng) -> CorruptedReply {
    if faults.contains(&Fault::DropReply) || faults.contains(&Fault::Disconnect(DisconnectAt::BeforeReply)) {
        return CorruptedReply::default();
    }
    if let Some(frame) = reframed(&reply, framing, faults) {
        reply.clear();
        match framing {
            Framing::Ascii => ascii::emit(&mut reply, frame.station, frame.command, |data| data.raw(&frame.data)),
            Framing::Binary => {
                binary::emit(&mut reply, Side::Plc, frame.station, frame.command, |data| data.raw(&frame.data));
            }
        }
    }
    if faults.contains(&Fault::BadChecksum) {
        invalidate_checksum(&mut reply, framing);
    }
    if let Some(max_len) = faults.iter().find_map(|fault| fault.garbage_inside()) {
        reply = with_garbage_inside(&reply, framing, max_len, rng);
    }
    let duplicate = reply.freeze();
    let mut reply = duplicate.clone();
    if let Some(max_len) = faults.iter().find_map(|fault| fault.garbage_before()) {
        reply = with_garbage_before(&reply, framing, max_len, rng).freeze();
    }
    if faults.contains(&Fault::Disconnect(DisconnectAt::WithinReply)) {
        reply.truncate(reply.len() / 2);
    }
    CorruptedReply { reply, duplicate }
}

/// The frame with other content, if a fault changes it.
fn reframed(reply: &BytesMut, framing: Framing, faults: &[Fault]) -> Option<Frame> {
    let changes_content = |fault: &Fault| {
        matches!(fault, Fault::WrongStation | Fault::WrongCommand | Fault::Truncated { .. } | Fault::Extended { .. })
    };
    if !faults.iter().any(changes_content) {
        return None;
    }
    let mut frame = frames(reply, framing).pop()?;
    for fault in faults {
        match *fault {
            Fault::WrongStation => frame.station = if frame.station < 254 { frame.station + 1 } else { 1 },
            Fault::WrongCommand => frame.command = next_command(frame.command),
            Fault::Truncated { by } => frame.data.truncate(frame.data.len().saturating_sub(by)),
            Fault::Extended { by } => {
                let zero = if framing == Framing::Ascii { b'0' } else { 0 };
                let mut data = BytesMut::from(frame.data);
                data.put_bytes(zero, by.min(MAX_FRAME_LEN));
                frame.data = data.freeze();
            }
            Fault::Ignore
            | Fault::DropReply
            | Fault::Delay { .. }
            | Fault::Split { .. }
            | Fault::GarbageBefore { .. }
            | Fault::GarbageInside { .. }
            | Fault::BadChecksum
            | Fault::Duplicate(_)
            | Fault::RoamingDuplicate(_)
            | Fault::SecondAnswer { .. }
            | Fault::LeftOver { .. }
            | Fault::AnswerBroadcast { .. }
            | Fault::Echo
            | Fault::Disconnect(_)
            | Fault::Refuse
            | Fault::Error(_) => {}
        }
    }
    Some(frame)
}

/// The next command in the manuals' table. The code after an unknown one is the next number.
fn next_command(command: u8) -> u8 {
    let mut codes = Code::ALL.iter().copied().map(u8::from).cycle().skip_while(|&code| code != command).skip(1);
    match Code::from_u8(command) {
        Some(_) => codes.next().unwrap_or(command),
        None => command.wrapping_add(1),
    }
}

/// Replaces the last character or byte of the data by another valid one; without data, one of the
/// checksum.
fn invalidate_checksum(reply: &mut BytesMut, framing: Framing) {
    // Positions from the end of the frame: the last of the data, and one of the checksum.
    let (empty, data, checksum) = match framing {
        Framing::Ascii => (EMPTY_ASCII, 4, 2),
        Framing::Binary => (EMPTY_BINARY, 5, 4),
    };
    let from_end = if reply.len() > empty { data } else { checksum };
    if let Some(byte) = reply.len().checked_sub(from_end).and_then(|at| reply.get_mut(at)) {
        *byte = match (framing, *byte) {
            // For these two, `^ 1` gives no hexadecimal digit.
            (Framing::Ascii, b'A') => b'F',
            (Framing::Ascii, b'F') => b'A',
            (_, byte) => byte ^ 1,
        };
    }
}

/// Length of a frame without data: `STX station command LRC ETX`.
const EMPTY_ASCII: usize = 8;
/// Length of a frame without data: header, id, length, station, command, CRC, terminator.
const EMPTY_BINARY: usize = 10;

/// The frame with garbage between its first and its last byte. Never a good frame.
fn with_garbage_inside(reply: &[u8], framing: Framing, max_len: usize, rng: &mut FaultRng) -> BytesMut {
    for _ in 0..GARBAGE_TRIES {
        let garbage = garbage(max_len, rng);
        let (head, tail) = reply.split_at((1 + rng.index(reply.len().saturating_sub(1))).min(reply.len()));
        let corrupted = BytesMut::from(&[head, &garbage, tail].concat()[..]);
        if frames(&corrupted, framing).is_empty() {
            return corrupted;
        }
    }
    // All tries gave a good frame; half of a frame is not one.
    BytesMut::from(reply.split_at(reply.len() / 2).0)
}

/// The reply behind garbage. The garbage can hide the reply, but never adds a frame.
fn with_garbage_before(reply: &[u8], framing: Framing, max_len: usize, rng: &mut FaultRng) -> BytesMut {
    let sent = frames(reply, framing);
    for _ in 0..GARBAGE_TRIES {
        let garbage = garbage(max_len, rng);
        let corrupted = BytesMut::from(&[&garbage, reply].concat()[..]);
        if sent.ends_with(&frames(&corrupted, framing)) {
            return corrupted;
        }
    }
    reply.into()
}

/// How often garbage is drawn. Up to one draw in 256 forms a good frame.
const GARBAGE_TRIES: usize = 16;

/// One to `max_len` random bytes. Half of them have a meaning in a frame.
fn garbage(max_len: usize, rng: &mut FaultRng) -> Vec<u8> {
    let len = 1 + rng.index(max_len.min(MAX_FRAME_LEN));
    let byte = |_| {
        if rng.below(2) == 0 { rng.byte() } else { FRAME_BYTES[rng.index(FRAME_BYTES.len())] }
    };
    (0..len).map(byte).collect()
}

const FRAME_BYTES: [u8; 13] = [
    ascii::STX,
    ascii::ETX,
    b'0',
    b'1',
    b'4',
    b'F',
    binary::QUERY,
    binary::REPLY,
    binary::ID,
    binary::TERMINATOR[0],
    binary::TERMINATOR[1],
    0x06,
    0x15,
];

/// All good frames that a client decodes from these bytes.
fn frames(bytes: &[u8], framing: Framing) -> Vec<Frame> {
    let mut codec = Codec::new(framing, Side::Client);
    let mut bytes = BytesMut::from(bytes);
    let items = std::iter::from_fn(|| codec.decode_eof(&mut bytes).ok().flatten());
    items.filter_map(Received::frame).collect()
}

#[cfg(test)]
mod tests;
