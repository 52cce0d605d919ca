//! Splitting of input bytes into frames, including bad ones.
//!
//! A receiver discards bad frames. Here they are explained, so the end of a bad frame is estimated.

use fatek::wire::Framing;
use fatek::wire::ascii::{ETX, STX};
use fatek::wire::binary::{ID, QUERY, REPLY, TERMINATOR};

/// Part of the input: a frame, good or bad, or bytes outside frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Piece<'a> {
    Noise(&'a [u8]),
    Ascii(&'a [u8]),
    Binary(&'a [u8]),
}

/// Splits the input into pieces, which together are the whole input. The default framing is that of
/// the first frame.
pub(super) fn pieces(input: &[u8], mut framing: Option<Framing>) -> Vec<Piece<'_>> {
    let mut pieces = Vec::new();
    let mut rest = input;
    while !rest.is_empty() {
        let at_the_start = rest.len() == input.len();
        let begin = (0..rest.len()).find_map(|i| Some((i, begins(&rest[i..], framing, i == 0 && at_the_start)?)));
        let Some((noise, found)) = begin else {
            pieces.push(Piece::Noise(rest));
            break;
        };
        if noise > 0 {
            pieces.push(Piece::Noise(&rest[..noise]));
        }
        rest = &rest[noise..];
        framing = Some(found);
        let (frame, behind) = match found {
            Framing::Binary => rest.split_at(binary_len(rest)),
            Framing::Ascii | _ => rest.split_at(ascii_len(rest)),
        };
        pieces.push(if found == Framing::Binary { Piece::Binary(frame) } else { Piece::Ascii(frame) });
        rest = behind;
    }
    pieces
}

/// Framing of the frame that begins here, if any. At the start of the input the first byte alone is
/// sufficient.
fn begins(bytes: &[u8], framing: Option<Framing>, at_the_start: bool) -> Option<Framing> {
    let found = match bytes {
        [STX, ..] => Framing::Ascii,
        [QUERY | REPLY] | [QUERY | REPLY, ID, ..] => Framing::Binary,
        [QUERY | REPLY, ..] if at_the_start => Framing::Binary,
        _ => return None,
    };
    framing.is_none_or(|framing| framing == found).then_some(found)
}

/// Length up to ETX, else up to the next STX.
fn ascii_len(bytes: &[u8]) -> usize {
    match (1..bytes.len()).find(|&i| matches!(bytes[i], STX | ETX)) {
        Some(i) if bytes[i] == ETX => i + 1,
        Some(i) => i,
        None => bytes.len(),
    }
}

/// Length by the length field if a terminator is there. Else up to the first terminator followed by
/// a frame or by the end of the input. Else by the length field.
fn binary_len(bytes: &[u8]) -> usize {
    let Some(&[high, low]) = bytes.get(2..4) else { return bytes.len() };
    let stated = usize::from(u16::from_be_bytes([high, low])) + 8;
    if bytes.get(..stated).is_some_and(|frame| frame.ends_with(&TERMINATOR)) {
        return stated;
    }
    let is_end = |end: usize| {
        let behind = &bytes[end..];
        bytes[..end].ends_with(&TERMINATOR)
            && (behind.is_empty() || begins(behind, Some(Framing::Binary), false).is_some())
    };
    (6..=bytes.len()).find(|&end| is_end(end)).unwrap_or(stated.min(bytes.len()))
}
