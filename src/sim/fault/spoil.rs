//! What faults do to the bytes of a reply.

use bytes::{BufMut, Bytes, BytesMut};
use tokio_util::codec::Decoder;

use super::dice::Dice;
use super::{Fault, Moment};
use crate::command::Code;
use crate::wire::{Codec, FieldWriter, Frame, Framing, MAX_FRAME_LEN, Received, Side, ascii, binary};

/// What goes out in the place of a reply.
#[derive(Debug, Default)]
pub(super) struct Spoilt {
    /// The bytes of the reply. Empty, if there is nothing to be heard.
    pub(super) reply: Bytes,
    /// What a copy of it has: all but the garbage before it.
    pub(super) copy: Bytes,
}

/// Changes a reply from the frame outwards, whatever the order of the faults.
pub(super) fn spoil(mut reply: BytesMut, framing: Framing, faults: &[Fault], dice: &mut Dice) -> Spoilt {
    if faults.contains(&Fault::DropReply) || faults.contains(&Fault::Disconnect(Moment::BeforeReply)) {
        return Spoilt::default();
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
        falsify(&mut reply, framing);
    }
    if let Some(max_len) = faults.iter().find_map(|fault| fault.garbage_inside()) {
        reply = garbled(&reply, framing, max_len, dice);
    }
    let copy = reply.freeze();
    let mut reply = copy.clone();
    if let Some(max_len) = faults.iter().find_map(|fault| fault.garbage_before()) {
        reply = after_garbage(&reply, framing, max_len, dice).freeze();
    }
    if faults.contains(&Fault::Disconnect(Moment::WithinReply)) {
        reply.truncate(reply.len() / 2);
    }
    Spoilt { reply, copy }
}

/// The frame with another content, if a fault asks for it.
fn reframed(reply: &BytesMut, framing: Framing, faults: &[Fault]) -> Option<Frame> {
    let changed = |fault: &Fault| {
        matches!(fault, Fault::WrongStation | Fault::WrongCommand | Fault::Truncated { .. } | Fault::Extended { .. })
    };
    if !faults.iter().any(changed) {
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

/// The next one in the manuals' table.
fn next_command(command: u8) -> u8 {
    let mut codes = Code::ALL.iter().copied().map(u8::from).cycle().skip_while(|&code| code != command).skip(1);
    match Code::from_u8(command) {
        Some(_) => codes.next().unwrap_or(command),
        None => command.wrapping_add(1),
    }
}

/// Changes the last character or byte of the data to another that could stand there, and leaves the checksum as it is;
/// or, if there is no data, the checksum.
fn falsify(reply: &mut BytesMut, framing: Framing) {
    // From the end of the frame: the last of the data, and the last of the checksum that can be changed.
    let (empty, data, checksum) = match framing {
        Framing::Ascii => (EMPTY_ASCII, 4, 2),
        Framing::Binary => (EMPTY_BINARY, 5, 4),
    };
    let from_end = if reply.len() > empty { data } else { checksum };
    if let Some(byte) = reply.len().checked_sub(from_end).and_then(|at| reply.get_mut(at)) {
        *byte = match (framing, *byte) {
            // The neighbours of these two are no digits.
            (Framing::Ascii, b'A') => b'F',
            (Framing::Ascii, b'F') => b'A',
            (_, byte) => byte ^ 1,
        };
    }
}

/// A frame without data: `STX station command LRC ETX`.
const EMPTY_ASCII: usize = 8;
/// A frame without data: header, id, length, station, command, CRC, terminator.
const EMPTY_BINARY: usize = 10;

/// The frame with garbage somewhere between its first and its last byte.
fn garbled(reply: &[u8], framing: Framing, max_len: usize, dice: &mut Dice) -> BytesMut {
    for _ in 0..TRIES {
        let garbage = garbage(max_len, dice);
        let (head, tail) = reply.split_at((1 + dice.index(reply.len().saturating_sub(1))).min(reply.len()));
        let garbled = BytesMut::from(&[head, &garbage, tail].concat()[..]);
        if frames(&garbled, framing).is_empty() {
            return garbled;
        }
    }
    // So much bad luck: what is no frame either is half of one.
    BytesMut::from(reply.split_at(reply.len() / 2).0)
}

/// The reply behind garbage.
fn after_garbage(reply: &[u8], framing: Framing, max_len: usize, dice: &mut Dice) -> BytesMut {
    let said = frames(reply, framing);
    for _ in 0..TRIES {
        let garbage = garbage(max_len, dice);
        let heard = BytesMut::from(&[&garbage, reply].concat()[..]);
        // It may swallow the reply, but not become one.
        if said.ends_with(&frames(&heard, framing)) {
            return heard;
        }
    }
    reply.into()
}

/// How often garbage is drawn anew that adds up to a frame, which one in some 256 may do.
const TRIES: usize = 16;

/// One to `max_len` bytes. Half of them are those that mean something in a frame.
fn garbage(max_len: usize, dice: &mut Dice) -> Vec<u8> {
    let len = 1 + dice.index(max_len.min(MAX_FRAME_LEN));
    let byte = |_| {
        if dice.below(2) == 0 { dice.byte() } else { MEANINGFUL[dice.index(MEANINGFUL.len())] }
    };
    (0..len).map(byte).collect()
}

const MEANINGFUL: [u8; 13] = [
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

/// All good frames that a client finds in these bytes.
fn frames(bytes: &[u8], framing: Framing) -> Vec<Frame> {
    let mut codec = Codec::new(framing, Side::Client);
    let mut bytes = BytesMut::from(bytes);
    let items = std::iter::from_fn(|| codec.decode_eof(&mut bytes).ok().flatten());
    items.filter_map(Received::frame).collect()
}

#[cfg(test)]
mod tests;
