//! Logs of `fatek -vv`, as a conversation.
//!
//! Lines with a frame, where `link{name=URL}` may be missing:
//!
//! ```text
//! TIME TRACE link{name=URL}: fatek::…: sending station=1 bytes=\x02…\x03
//! TIME TRACE link{name=URL}: fatek::…: received station=1 command=70 data=0…
//! TIME TRACE link{name=URL}: fatek::…: discarded reason=… bytes=…
//! ```
//!
//! A received frame has no bytes in the log: they are made of its fields. All other lines are ignored.

use std::collections::BTreeMap;
use std::io::BufRead;
use std::time::UNIX_EPOCH;

use bytes::Bytes;
use fatek::wire::ascii::{ETX, STX, lrc};
use fatek::wire::binary::{ID, QUERY, REPLY, TERMINATOR, crc};

use super::escape::unescape;
use super::lines::Lines;
use super::{ReadError, Remarks, Sink, SourceError};
use crate::conversation::{Change, Direction, Event, Timestamp};

/// Links of a log that are kept apart; frames of further ones are in the conversation of the last.
const MAX_LINKS: usize = 1000;

/// The message of a line with a frame.
const SENDING: &str = ": sending station=";
const RECEIVED: &str = ": received station=";
const DISCARDED: &str = ": discarded reason=";

/// Returns whether the line begins with a time and a level.
pub(super) fn has_time(line: &str) -> bool {
    let line = without_colours(line);
    let mut words = line.split_ascii_whitespace();
    let time = words.next().is_some_and(|word| humantime::parse_rfc3339(word).is_ok());
    time && words.next().is_some_and(|word| matches!(word, "TRACE" | "DEBUG" | "INFO" | "WARN" | "ERROR"))
}

/// Returns whether a text has lines with frames.
pub(super) fn has_frames(text: &str) -> bool {
    [SENDING, RECEIVED, DISCARDED].iter().any(|message| text.contains(message))
}

/// The conversation of one link.
#[derive(Debug, Default)]
struct LoggedLink {
    /// Number of its connection; 0 before the first.
    connection: u64,
    is_binary: bool,
}

pub(super) fn read(reader: impl BufRead, sink: &mut Sink<'_>) -> Result<Remarks, ReadError> {
    let mut lines = Lines::new(reader);
    let mut links: BTreeMap<String, LoggedLink> = BTreeMap::new();
    let (mut connections, mut at) = (0, Timestamp::ZERO);
    let mut frames = 0_u64;
    // Line of the first frame that cannot be read, and number of the others.
    let mut unreadable: Option<(u64, u64)> = None;
    while let Some(line) = lines.next()? {
        let text = without_colours(&line.text);
        let name = link_name(&text).to_owned();
        if text.ends_with(": connected") || text.contains(": connection lost") || text.ends_with(": idle") {
            // The next frame is one of a new connection.
            if let Some(link) = links.get_mut(&name)
                && let connection @ 1.. = std::mem::take(&mut link.connection)
            {
                sink(Event { connection, at, change: Change::Close }).map_err(ReadError::Sink)?;
            }
            continue;
        }
        let Some(logged) = Logged::parse(&text) else { continue };
        let Ok(logged) = logged else {
            unreadable = Some(unreadable.map_or((line.number, 0), |(first, others)| (first, others + 1)));
            continue;
        };
        frames += 1;
        let time = text.split_ascii_whitespace().next().and_then(|word| humantime::parse_rfc3339(word).ok());
        at = time.and_then(|time| time.duration_since(UNIX_EPOCH).ok()).unwrap_or(at);
        let name = if links.len() < MAX_LINKS { name } else { String::new() };
        let link = links.entry(name.clone()).or_default();
        if link.connection == 0 {
            connections += 1;
            link.connection = connections;
            link.is_binary |= name.contains("framing=binary");
            let name = if name.is_empty() { "a link".to_owned() } else { name };
            let open = Event { connection: connections, at, change: Change::Open(name) };
            sink(open).map_err(ReadError::Sink)?;
        }
        if let Logged::Sent(bytes) = &logged {
            link.is_binary = bytes.starts_with(&[QUERY, ID]);
        }
        let (direction, bytes) = logged.bytes(link.is_binary);
        let change = Change::Bytes { direction, bytes, is_datagram: true };
        sink(Event { connection: link.connection, at, change }).map_err(ReadError::Sink)?;
    }
    if frames == 0 && unreadable.is_none() {
        return Err(SourceError::Content("no line has a frame: frames are logged with -vv".to_owned()).into());
    }
    Ok(match unreadable {
        None => Remarks::new(),
        Some((first, others)) => {
            let others = if others == 0 { String::new() } else { format!(", and {others} more") };
            vec![format!("line {first} has a frame that cannot be read{others}")]
        }
    })
}

/// Frame or bytes of a line.
#[derive(Debug, PartialEq, Eq)]
enum Logged {
    Sent(Vec<u8>),
    Received { station: u8, command: u8, data: Vec<u8> },
    Discarded(Vec<u8>),
}

impl Logged {
    /// `None` for a line of another kind, `Err` for one with wrong fields.
    fn parse(line: &str) -> Option<Result<Self, ()>> {
        let fields = |message: &str| line.split_once(message).map(|(_, fields)| fields);
        if let Some(fields) = fields(SENDING) {
            let bytes = fields.split_once(" bytes=").and_then(|(_, bytes)| unescape(bytes).ok());
            return Some(bytes.map(Self::Sent).ok_or(()));
        }
        if let Some(fields) = fields(DISCARDED) {
            let bytes = fields.split_once(" bytes=").and_then(|(_, bytes)| unescape(bytes).ok());
            return Some(bytes.map(Self::Discarded).ok_or(()));
        }
        let fields = fields(RECEIVED)?;
        let received = || {
            let (station, fields) = fields.split_once(" command=")?;
            let (command, data) = fields.split_once(" data=")?;
            let (station, command) = (station.parse().ok()?, command.parse().ok()?);
            Some(Self::Received { station, command, data: unescape(data).ok()? })
        };
        Some(received().ok_or(()))
    }

    /// Its bytes on the wire.
    fn bytes(self, is_binary: bool) -> (Direction, Bytes) {
        match self {
            Self::Sent(bytes) => (Direction::ToPlc, bytes.into()),
            Self::Discarded(bytes) => (Direction::FromPlc, bytes.into()),
            Self::Received { station, command, data } => {
                let frame = if is_binary { binary(station, command, &data) } else { ascii(station, command, &data) };
                (Direction::FromPlc, frame.into())
            }
        }
    }
}

/// A frame of the ASCII framing, whose data may have any bytes.
fn ascii(station: u8, command: u8, data: &[u8]) -> Vec<u8> {
    let mut frame = vec![STX];
    frame.extend_from_slice(format!("{station:02X}{command:02X}").as_bytes());
    frame.extend_from_slice(data);
    let sum = lrc(&frame);
    frame.extend_from_slice(format!("{sum:02X}").as_bytes());
    frame.push(ETX);
    frame
}

/// A reply of the binary framing.
fn binary(station: u8, command: u8, data: &[u8]) -> Vec<u8> {
    // Longer data is in no frame.
    let length = u16::try_from(data.len() + 2).unwrap_or(u16::MAX);
    let mut frame = vec![REPLY, ID];
    frame.extend_from_slice(&length.to_be_bytes());
    frame.extend_from_slice(&[station, command]);
    frame.extend_from_slice(data);
    let sum = crc(frame.get(2..).unwrap_or_default());
    frame.extend_from_slice(&sum.to_le_bytes());
    frame.extend_from_slice(&TERMINATOR);
    frame
}

/// The URL in `link{name=URL}`, or an empty text.
fn link_name(line: &str) -> &str {
    let name = line.split_once("link{name=").and_then(|(_, rest)| rest.split_once('}'));
    name.map_or("", |(name, _)| name)
}

/// The line without the colours of a terminal: `ESC [ … m`.
fn without_colours(line: &str) -> String {
    let mut parts = line.split("\x1b[");
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |text, part| {
        text + part
            .split_once('m')
            .filter(|(codes, _)| codes.bytes().all(|b| b.is_ascii_digit() || b == b';'))
            .map_or(part, |(_, rest)| rest)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOG: &str = r"2026-11-29T18:43:27.386149Z DEBUG link{name=tcp://h:500}: f::driver: connected
2026-11-29T18:43:27.386387Z TRACE link{name=tcp://h:500}: f::outgoing: sending station=1 bytes=\x0201411F9\x03
2026-11-29T18:43:27.386974Z TRACE link{name=tcp://h:500}: f::exchange: received station=1 command=65 data=0
2026-11-29T18:43:27.7Z TRACE link{name=h?framing=binary}: f: sending station=1 bytes=Q\x10\x00\x02\x01@\xa1\x84U\xaa
2026-11-29T18:43:27.7Z TRACE link{name=h?framing=binary}: f::exchange: received station=1 command=65 data=\x00
2026-11-29T18:43:27.8Z TRACE link{name=tcp://h:500}: f::exchange: discarded reason=garbage between frames bytes=\x06
2026-11-29T18:43:28Z DEBUG link{name=tcp://h:500}: f::driver: connection lost error=x
2026-11-29T18:43:29.5Z TRACE link{name=tcp://h:500}: f::outgoing: sending station=1 bytes=\x0201411F9\x03
";

    fn events(log: &str) -> Vec<Event> {
        let mut events = Vec::new();
        let remarks = read(log.as_bytes(), &mut |event| {
            events.push(event);
            Ok(())
        });
        assert_eq!(remarks.unwrap(), Remarks::new());
        events
    }

    #[test]
    fn frames_of_a_log_are_events_of_their_links() {
        let events = events(LOG);
        let passed: Vec<_> = events
            .iter()
            .filter_map(|event| {
                let Change::Bytes { direction, bytes, .. } = &event.change else { return None };
                Some((event.connection, *direction, bytes.escape_ascii().to_string()))
            })
            .collect();
        let text = |bytes: &[u8]| bytes.escape_ascii().to_string();
        assert_eq!(
            passed,
            [
                (1, Direction::ToPlc, text(b"\x0201411F9\x03")),
                (1, Direction::FromPlc, text(b"\x0201410F8\x03")),
                (2, Direction::ToPlc, text(b"\x51\x10\x00\x02\x01\x40\xA1\x84\x55\xAA")),
                (2, Direction::FromPlc, text(b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA")),
                (1, Direction::FromPlc, text(b"\x06")),
                (3, Direction::ToPlc, text(b"\x0201411F9\x03")),
            ]
        );
        assert_eq!(events[2].at - events[1].at, std::time::Duration::from_micros(587));
        assert!(events.iter().any(|event| event.connection == 1 && event.change == Change::Close));
    }

    #[test]
    fn colours_of_a_terminal_are_ignored() {
        let coloured =
            LOG.replace("TRACE", "\x1b[35mTRACE\x1b[0m").replace("bytes=", "\x1b[3mbytes\x1b[0m\x1b[2m=\x1b[0m");
        assert_eq!(events(&coloured), events(LOG));
        assert!(has_time(coloured.lines().nth(1).unwrap()) && has_time(LOG));
    }

    #[test]
    fn a_log_without_frames_is_refused_and_wrong_frames_are_named() {
        assert!(matches!(read(&b"2026\nx"[..], &mut |_| Ok(())), Err(ReadError::Source(SourceError::Content(_)))));
        let log = "T: sending station=1 bytes=\\q\nT: received station=999 command=1 data=\n";
        let remarks = read(log.as_bytes(), &mut |_| Ok(())).unwrap();
        assert_eq!(remarks, ["line 1 has a frame that cannot be read, and 1 more"]);
    }

    proptest::proptest! {
        #[test]
        fn any_log_is_read_or_refused(
            lines in proptest::collection::vec(
                "(2026-11-29T18:43:27Z |\\PC{0,9})TRACE (link\\{name=\\PC{0,9}\\}?)?: (sending|received|discarded)( \\PC{0,9}|\
                 station=[0-9]{0,4}|command=[0-9]{0,4}|reason=x| bytes=| data=|\\\\x[0-9a-f]{0,2}){0,6}",
                0..6,
            ),
        ) {
            let _ = read(lines.join("\n").as_bytes(), &mut |_| Ok(()));
        }
    }
}
