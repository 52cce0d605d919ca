//! Lower limit of the work with the bytes of a frame: copy, checksum, and decoding of the values of
//! a reply.
//!
//! No search for frames, no comparison of fields, no counters, no allocation.

use fatek::command::{MAX_POINTS, MAX_UNITS};
use fatek::wire::{Framing, binary};

/// Copies a frame. Returns whether its checksum is correct.
pub(crate) fn copy_and_check(framing: Framing, frame: &[u8], copy: &mut [u8]) -> bool {
    copy.copy_from_slice(frame);
    match framing {
        // STX … LRC ETX
        Framing::Ascii => {
            let (body, tail) = copy.split_at(copy.len() - 3);
            let sum = body.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte));
            tail[..2] == [DIGITS[usize::from(sum >> 4)], DIGITS[usize::from(sum & 0x0F)]]
        }
        // header, id, length … CRC, terminator
        _ => {
            let (body, tail) = copy.split_at(copy.len() - 4);
            tail[..2] == binary::crc(&body[2..]).to_le_bytes()
        }
    }
}

/// Decodes the registers of a reply. Returns whether all digits are valid.
pub(crate) fn registers(framing: Framing, frame: &[u8], words: &mut [u16; MAX_UNITS]) -> bool {
    let data = values(framing, frame);
    if framing == Framing::Binary {
        for (word, bytes) in words.iter_mut().zip(data.as_chunks().0) {
            *word = u16::from_be_bytes(*bytes);
        }
        return true;
    }
    for (word, digits) in words.iter_mut().zip(data.as_chunks().0) {
        let digits = u32::from_le_bytes(*digits);
        let nibbles = (digits & 0x0F0F_0F0F) + (digits >> 6 & 0x0101_0101) * 9;
        *word = (nibbles << 12 | nibbles & 0x0F00 | nibbles >> 12 & 0x00F0 | nibbles >> 24) as u16;
    }
    data.iter().fold(true, |good, digit| good & digit.is_ascii_hexdigit())
}

/// Decodes the discretes of a reply. Returns whether all states are valid.
pub(crate) fn discretes(framing: Framing, frame: &[u8], states: &mut [bool; MAX_POINTS]) -> bool {
    let data = values(framing, frame);
    let off = if framing == Framing::Binary { 0 } else { b'0' };
    for (state, character) in states.iter_mut().zip(data) {
        *state = character & 1 == 1;
    }
    data.iter().fold(true, |good, character| good & (character & !1 == off))
}

/// Data of a reply after its error code.
fn values(framing: Framing, frame: &[u8]) -> &[u8] {
    match framing {
        Framing::Ascii => &frame[6..frame.len() - 3],
        _ => &frame[7..frame.len() - 4],
    }
}

const DIGITS: [u8; 16] = *b"0123456789ABCDEF";
