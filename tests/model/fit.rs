//! What a reply must look like, by the protocol reference, for the requests that the model's callers and the link make.

use fatek::wire::Framing;

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
    let (Some(code), Some((_, rest))) = (code(framing, data), data.split_first()) else { return Fit::None };
    match code {
        0 => bytes(framing, rest)
            .and_then(|bytes| values(framing, command, request, &bytes))
            .map_or(Fit::None, Fit::Reply),
        code if rest.is_empty() => Fit::Refusal(code),
        _ => Fit::None,
    }
}

/// The registers that a reply must hold.
fn values(framing: Framing, command: u8, request: &[u8], reply: &[u8]) -> Option<Vec<u16>> {
    let expected = match command {
        0x40 => 3,
        0x46 if framing == Framing::Ascii => 2 * usize::from(bytes(framing, request.get(..2)?)?[0]),
        0x46 => 2 * usize::from(request[0]),
        _ => 0,
    };
    let words = reply.chunks(2).filter_map(|pair| Some(u16::from_be_bytes(pair.try_into().ok()?)));
    (reply.len() == expected).then(|| if command == 0x46 { words.collect() } else { Vec::new() })
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
