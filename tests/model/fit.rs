//! What a reply must look like, by the protocol reference, for the requests that the model's callers and the link make.

use fatek::command::PAGE_WORDS;
use fatek::wire::Framing;

use super::spec::station::Shape;

/// What the data of a frame is to a request.
pub(crate) enum Fit {
    Reply(Vec<u16>),
    Refusal(u8),
    None,
}

/// Station and command have been compared already.
pub(crate) fn fit(framing: Framing, command: u8, request: &[u8], data: &[u8]) -> Fit {
    if command == 0x4E {
        if data == request {
            return Fit::Reply(Vec::new());
        }
        return match (data, code(framing, data)) {
            ([_], Some(code)) if code > 0 => Fit::Refusal(code),
            _ => Fit::None,
        };
    }
    if command == 0x4F && data.len() == 4 * PAGE_WORDS {
        // The manual has both: with an error code before the words, and without.
        return bytes(framing, data).map_or(Fit::None, |bytes| Fit::Reply(words(&bytes)));
    }
    let (Some(code), Some((_, rest))) = (code(framing, data), data.split_first()) else { return Fit::None };
    match code {
        0 => bytes(framing, rest)
            .and_then(|bytes| values(framing, command, request, &bytes))
            .map_or(Fit::None, Fit::Reply),
        code if rest.is_empty() => Fit::Refusal(code),
        _ => Fit::None,
    }
}

/// The size of the positive reply to a request.
pub(crate) fn shape(framing: Framing, command: u8, request: &[u8]) -> Shape {
    let size = match command {
        0x46 | 0x48 => count(framing, request).unwrap_or_default(),
        0x4E => request.len(),
        _ => 0,
    };
    Shape { command, size }
}

/// The number of elements that a request names, which stands at its beginning.
fn count(framing: Framing, request: &[u8]) -> Option<usize> {
    match framing {
        Framing::Binary => request.first().copied().map(usize::from),
        _ => Some(usize::from(*bytes(framing, request.get(..2)?)?.first()?)),
    }
}

/// The registers that a reply must hold.
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
