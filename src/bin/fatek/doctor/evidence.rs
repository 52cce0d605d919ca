//! Evidence of a finding: requests and replies as hexadecimal digits, without values unless they are asked for.

use fatek::wire::Framing;

use super::exchange::{Arrival, Exchange, Item};
use crate::output::hex;

/// Commands whose replies have values or a part of the program.
const READS: [u8; 5] = [0x43, 0x44, 0x46, 0x48, 0x4F];
/// Commands whose requests have values.
const WRITES: [u8; 4] = [0x42, 0x45, 0x47, 0x49];

/// The lines of an exchange: `> ` requests, `< ` replies with their times.
pub(crate) fn lines(exchange: &Exchange, framing: Framing, with_values: bool) -> Vec<String> {
    let mut lines = Vec::new();
    for attempt in &exchange.attempts {
        if !attempt.sent.is_empty() {
            let is_write = exchange.ask.request().is_some_and(|request| WRITES.contains(&request.frame.command));
            lines.push(format!("> {}", masked(&attempt.sent, is_write && !with_values, framing)));
        }
        lines.extend(attempt.arrivals.iter().map(|arrival| line(arrival, framing, with_values)));
        if attempt.closed {
            lines.push("< (connection closed)".to_owned());
        }
    }
    lines
}

fn line(arrival: &Arrival, framing: Framing, with_values: bool) -> String {
    let (bytes, note, has_values) = match &arrival.item {
        Item::Frame(frame, bytes) => (bytes, String::new(), READS.contains(&frame.command)),
        // The next value is that of a request.
        Item::Echo(bytes) => (bytes, " (echo)".to_owned(), true),
        Item::Noise(reason, bytes) => (bytes, format!(" ({reason})"), true),
    };
    let time = format!("{:.1} ms", arrival.after.as_secs_f64() * 1e3);
    let late = if arrival.unawaited { ", not awaited" } else { "" };
    format!("< {} [{time}{late}]{note}", masked(bytes, has_values && !with_values, framing))
}

/// The bytes; in place of those behind the error code their number. An error code alone is shown.
fn masked(bytes: &[u8], hides_values: bool, framing: Framing) -> String {
    // STX, station, command, error code; of binary header, length, station, command, error code.
    let (begin, frame) = match framing {
        Framing::Ascii => (6, 9),
        Framing::Binary | _ => (7, 11),
    };
    if !hides_values || bytes.len() <= frame {
        return hex(bytes);
    }
    let (shown, hidden) = bytes.split_at(begin);
    format!("{}.. ({} bytes not shown)", hex(shown), hidden.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_hidden_with_the_checksum_that_tells_them() {
        let reply = b"\x02014601234C9\x03";
        assert_eq!(masked(reply, true, Framing::Ascii), "023031343630.. (7 bytes not shown)");
        assert_eq!(masked(reply, false, Framing::Ascii), hex(reply));
        let refusal = b"\x020146A0C\x03";
        assert_eq!(masked(refusal, true, Framing::Ascii), hex(refusal));
    }
}
