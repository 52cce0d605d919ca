//! Evidence of a finding: requests and replies as hexadecimal digits.
//!
//! Without `--values` only frames are shown whose content is known to be no value: statuses, loop-backs of this
//! examination, and refusals. Without `--with-address` station numbers are hidden, with the checksums that tell them.

use fatek::wire::{Frame, Framing};

use super::exchange::{Answer, Arrival, Ask, Exchange, Item, fit};
use super::report::Contents;
use super::request::{Request, Requests};
use crate::output::hex;

/// Commands whose requests have values.
const WRITES: [u8; 4] = [0x42, 0x45, 0x47, 0x49];

/// In place of a hidden byte.
const HIDDEN: &str = "..";

/// The lines of an exchange: `> ` requests, `< ` replies with their times.
pub(crate) fn lines(exchange: &Exchange, requests: Requests, contents: Contents) -> Vec<String> {
    let framing = requests.framing;
    let mut lines = Vec::new();
    for attempt in &exchange.attempts {
        if !attempt.sent.is_empty() {
            let is_shown = contents.values || !is_write(&exchange.ask);
            let frames = frames(&attempt.sent, framing);
            let frames = frames.iter().map(|frame| shown(frame, is_shown, framing, contents));
            lines.push(format!("> {}", frames.collect::<String>()));
        }
        lines.extend(attempt.arrivals.iter().map(|arrival| line(arrival, &exchange.ask, requests, contents)));
        if attempt.closed {
            lines.push("< (connection closed)".to_owned());
        }
    }
    lines
}

fn is_write(ask: &Ask) -> bool {
    ask.request().is_some_and(|request| WRITES.contains(&request.frame.command))
}

fn line(arrival: &Arrival, ask: &Ask, requests: Requests, contents: Contents) -> String {
    let framing = requests.framing;
    let (bytes, note) = match &arrival.item {
        Item::Frame(frame, bytes) => {
            let is_shown = contents.values || is_without_values(frame, ask, requests);
            (shown(bytes, is_shown, framing, contents), String::new())
        }
        Item::Echo(bytes) => {
            let is_shown = contents.values || !is_write(ask);
            (shown(bytes, is_shown, framing, contents), " (echo)".to_owned())
        }
        // The station can be anywhere in it.
        Item::Noise(reason, bytes) if contents.values && contents.address => (hex(bytes), format!(" ({reason})")),
        Item::Noise(reason, bytes) => (format!("({} bytes not shown)", bytes.len()), format!(" ({reason})")),
    };
    let time = format!("{:.1} ms", arrival.after.as_secs_f64() * 1e3);
    let late = if arrival.unawaited { ", not awaited" } else { "" };
    format!("< {bytes} [{time}{late}]{note}")
}

/// Returns whether a reply is a status, a loop-back of the examination, or a refusal.
fn is_without_values(frame: &Frame, ask: &Ask, requests: Requests) -> bool {
    let framing = requests.framing;
    // A reply can have the command of another one: it must be a status, and have been asked for.
    let is_asked = |status: &Request| match ask {
        Ask::Connections(_) | Ask::Idle(_) => *status == requests.status(),
        Ask::Reply(request) | Ask::Once(request) | Ask::Silence(request, _) | Ask::Sync(request) => request == status,
        Ask::Burst(_) | Ask::Load(_) | Ask::TwoPorts(..) => false,
    };
    let is_status = |status: Request| is_asked(&status) && matches!(fit(&status, frame, framing), Answer::Data(_));
    let is_own_loop_back = || {
        let is_it = |request: &Request| request.frame.command == 0x4E && request.frame.data == frame.data;
        frame.command == 0x4E
            && match ask {
                Ask::Burst(requests) | Ask::Load(requests) => requests.iter().any(is_it),
                Ask::TwoPorts(first, second) => is_it(first) || is_it(second),
                Ask::Reply(_) | Ask::Once(_) | Ask::Silence(..) | Ask::Sync(_) | Ask::Connections(_) | Ask::Idle(_) => {
                    ask.request().is_some_and(is_it)
                }
            }
    };
    frame.data.len() <= 1 || is_status(requests.status()) || is_status(requests.detailed()) || is_own_loop_back()
}

/// The bytes of a frame, and how many of them are not shown.
fn shown(bytes: &[u8], is_shown: bool, framing: Framing, contents: Contents) -> String {
    // Of ASCII STX, station, command; checksum, ETX. Of binary header, length, station, command; CRC, terminator.
    let (station, checksum, behind, begin) = match framing {
        Framing::Ascii => (1..3, 2, 1, 5),
        Framing::Binary | _ => (4..5, 2, 2, 6),
    };
    let checksum = bytes.len().saturating_sub(checksum + behind)..bytes.len().saturating_sub(behind);
    let is_hidden = |at: usize| !contents.address && (station.contains(&at) || checksum.contains(&at));
    let byte = |(at, byte): (usize, &u8)| if is_hidden(at) { HIDDEN.to_owned() } else { hex(&[*byte]) };
    let frame: Vec<String> = bytes.iter().enumerate().map(byte).collect();
    match bytes.len().checked_sub(begin) {
        Some(hidden) if !is_shown => format!("{}.. ({hidden} bytes not shown)", frame[..begin].concat()),
        Some(_) | None => frame.concat(),
    }
}

/// The frames of a request, or of several that were sent together.
fn frames(sent: &[u8], framing: Framing) -> Vec<&[u8]> {
    let len = |bytes: &[u8]| match framing {
        Framing::Ascii => bytes.iter().position(|&byte| byte == ETX).map(|at| at + 1),
        Framing::Binary | _ => {
            let payload = bytes.get(2..4)?.iter().fold(0, |len, &byte| len << 8 | usize::from(byte));
            Some(payload + AROUND_PAYLOAD)
        }
    };
    let (mut frames, mut rest) = (Vec::new(), sent);
    while !rest.is_empty() {
        let (frame, behind) = rest.split_at(len(rest).unwrap_or(rest.len()).min(rest.len()));
        frames.push(frame);
        rest = behind;
    }
    frames
}

/// The last byte of a frame in the ASCII framing.
const ETX: u8 = 0x03;
/// Header, id, length, CRC and terminator of a frame in the binary framing.
const AROUND_PAYLOAD: usize = 8;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bytes::Bytes;
    use fatek::command::Code;
    use fatek::wire::Discard;

    use super::*;
    use crate::doctor::exchange::Attempt;

    const ASCII: Requests = Requests { framing: Framing::Ascii, station: 1 };
    const PRIVATE: Contents = Contents { evidence: true, values: false, address: false };
    const OPEN: Contents = Contents { evidence: true, values: true, address: true };

    fn line_of(ask: &Ask, item: Item, contents: Contents) -> String {
        let after = Duration::from_millis(5);
        let arrival = Arrival { after, unawaited: false, item, pieces: 1, pause: Duration::ZERO, other_port: false };
        line(&arrival, ask, ASCII, contents)
    }

    fn reply(command: u8, data: &str) -> Item {
        let frame = Frame { station: 1, command, data: data.to_owned().into() };
        let bytes = ASCII.encode(&frame);
        Item::Frame(frame, bytes)
    }

    #[test]
    fn only_frames_without_values_are_shown() {
        let read = Ask::Reply(ASCII.read(Code::ReadRegisters, 1, "R0"));
        let shown = |ask: &Ask, item| line_of(ask, item, PRIVATE);
        assert_eq!(shown(&read, reply(0x46, "0D431")), "< 02....3436.. (8 bytes not shown) [5.0 ms]");
        // A reply under the code of another command.
        for code in [0x47, 0x40, 0x53, 0x4E] {
            let line = shown(&read, reply(code, "0D431"));
            assert!(!line.contains("44343331"), "{line}");
        }
        let many = format!("0{}", "D431".repeat(15));
        assert!(!shown(&read, reply(0x53, &many)).contains("44343331"));
        assert_eq!(shown(&read, reply(0x46, "A")), "< 02....343641....03 [5.0 ms]");
        let noise = Item::Noise(Discard::Garbage, Bytes::from_static(b"D431C9\x03"));
        assert_eq!(shown(&read, noise.clone()), "< (7 bytes not shown) [5.0 ms] (garbage between frames)");
        assert!(line_of(&read, noise, OPEN).starts_with("< 44343331433903 "));
        assert!(shown(&read, reply(0x40, "0014000")).contains("not shown"));
        let status = shown(&Ask::Idle(Duration::ZERO), reply(0x40, "0014000"));
        assert_eq!(status, "< 02....343030303134303030....03 [5.0 ms]");
        let (own, other) = (Ask::Reply(ASCII.loop_back("AB")), reply(0x4E, "D431"));
        assert_eq!(shown(&own, reply(0x4E, "AB")), "< 02....34454142....03 [5.0 ms]");
        assert!(shown(&own, other).contains("not shown"));
        let (Item::Frame(_, all), open) = (reply(0x46, "0D431"), line_of(&read, reply(0x46, "0D431"), OPEN)) else {
            unreachable!()
        };
        assert_eq!(open, format!("< {} [5.0 ms]", hex(&all)));
    }

    #[test]
    fn each_frame_of_a_burst_hides_its_station() {
        for framing in [Framing::Ascii, Framing::Binary] {
            let requests = Requests { framing, station: 0x77 };
            let burst = vec![requests.read(Code::ReadRegisters, 1, "R0"), requests.loop_back("AB")];
            let parts: Vec<Bytes> = burst.iter().map(|request| requests.encode(&request.frame)).collect();
            let sent = crate::doctor::request::joined(&parts);
            let attempt = Attempt { sent: sent.clone(), ..Attempt::default() };
            let exchange = Exchange { ask: Ask::Burst(burst), attempts: vec![attempt] };
            let private = lines(&exchange, requests, PRIVATE);
            assert_eq!(
                private[0].matches(HIDDEN).count(),
                if framing == Framing::Ascii { 8 } else { 6 },
                "{private:?}"
            );
            assert!(!private[0].contains("3737") && !private[0].contains("77"), "{private:?}");
            assert_eq!(lines(&exchange, requests, OPEN), [format!("> {}", hex(&sent))]);
        }
    }

    #[test]
    fn values_of_writes_are_hidden() {
        let write = ASCII.write(Code::WriteRegisters, "R5", 0xD431);
        let attempt = Attempt { sent: ASCII.encode(&write.frame), ..Attempt::default() };
        let exchange = Exchange { ask: Ask::Once(write), attempts: vec![attempt] };
        assert_eq!(lines(&exchange, ASCII, PRIVATE), ["> 02....3437.. (15 bytes not shown)"]);
    }
}
