//! Reference matching of replies to requests, for the commands that the model's calls and the link
//! send.

use fatek::command::PAGE_WORDS;
use fatek::wire::Framing;

use super::spec::station::Shape;

/// How the data of a frame matches a request.
pub(crate) enum ReplyMatch {
    Reply(Vec<u16>),
    Refusal(u8),
    None,
}

/// Matches data to a request. The caller has compared station and command.
pub(crate) fn match_reply(framing: Framing, command: u8, request: &[u8], data: &[u8]) -> ReplyMatch {
    if command == 0x4E {
        if data == request {
            return ReplyMatch::Reply(Vec::new());
        }
        return match (data, code(framing, data)) {
            ([_], Some(code)) if code > 0 => ReplyMatch::Refusal(code),
            _ => ReplyMatch::None,
        };
    }
    if command == 0x4F && data.len() == 4 * PAGE_WORDS {
        // The manual shows both: the words with and without an error code before them.
        return bytes(framing, data).map_or(ReplyMatch::None, |bytes| ReplyMatch::Reply(words(&bytes)));
    }
    let (Some(code), Some((_, rest))) = (code(framing, data), data.split_first()) else { return ReplyMatch::None };
    match code {
        0 => bytes(framing, rest)
            .and_then(|bytes| values(framing, command, request, &bytes))
            .map_or(ReplyMatch::None, ReplyMatch::Reply),
        code if rest.is_empty() => ReplyMatch::Refusal(code),
        _ => ReplyMatch::None,
    }
}

/// Shape of the positive reply to a request.
pub(crate) fn shape(framing: Framing, command: u8, request: &[u8]) -> Shape {
    let size = match command {
        0x46 | 0x48 => count(framing, request).unwrap_or_default(),
        0x4E => request.len(),
        _ => 0,
    };
    Shape { command, size }
}

/// Number of elements, from the first field of a request.
fn count(framing: Framing, request: &[u8]) -> Option<usize> {
    match framing {
        Framing::Binary => request.first().copied().map(usize::from),
        _ => Some(usize::from(*bytes(framing, request.get(..2)?)?.first()?)),
    }
}

/// Registers of a positive reply; `None` if its length does not match the request.
fn values(framing: Framing, command: u8, request: &[u8], reply: &[u8]) -> Option<Vec<u16>> {
    let fits = match command {
        0x40 => reply.len() == 3,
        0x46 | 0x48 => reply.len() == 2 * count(framing, request)?,
        0x4F => reply.len() == 2 * PAGE_WORDS,
        0x53 => (28..=249).contains(&reply.len()),
        _ => reply.is_empty(),
    };
    let holds_values = matches!(command, 0x46 | 0x48 | 0x4F);
    fits.then(|| if holds_values { words(reply) } else { Vec::new() })
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

fn code(framing: Framing, data: &[u8]) -> Option<u8> {
    let first = *data.first()?;
    if framing == Framing::Binary { Some(first) } else { digit(first) }
}

fn bytes(framing: Framing, data: &[u8]) -> Option<Vec<u8>> {
    if framing == Framing::Binary {
        return Some(data.to_vec());
    }
    let pairs = data.chunks(2).map(|pair| match pair {
        [high, low] => Some(digit(*high)? << 4 | digit(*low)?),
        _ => None,
    });
    pairs.collect()
}

fn digit(character: u8) -> Option<u8> {
    char::from(character).to_digit(16).and_then(|digit| u8::try_from(digit).ok())
}
