//! Recordings of `fatek record`: JSON lines, one event each.
//!
//! ```text
//! {"fatek":"recording","version":1,"started":"2026-11-29T18:00:00.123456Z","link":"tcp://h:500","framing":"ascii"}
//! {"us":1043,"connection":1,"open":"tcp 127.0.0.1:41234 > tcp://192.168.2.3:500"}
//! {"us":1210,"connection":1,"to":"plc","bytes":"0230313430433703"}
//! {"us":9466,"connection":1,"to":"client","bytes":"0230313430…"}
//! {"us":9999,"connection":1,"close":true}
//! ```
//!
//! `us` is the time since `started` in microseconds, by a clock that never steps. `bytes` are those of
//! one read, and may be a part of a frame, or several. `"datagram":true`: they are a datagram. Unknown
//! members are ignored, and so are lines with none of `open`, `bytes`, `missing` and `close`. Docs: docs/CLI.md.

use std::fmt::Write;
use std::io::BufRead;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use fatek::wire::Framing;
use serde_json::{Map, Value, json};

use super::lines::Lines;
use super::{ReadError, Remarks, Sink, SourceError};
use crate::conversation::{Change, Direction, Event};
use crate::printable::excerpt;

/// Version of the format.
const VERSION: u64 = 1;

/// The first line.
pub(crate) fn header(started: SystemTime, link: &str, framing: Framing) -> String {
    let started = humantime::format_rfc3339_micros(started.max(UNIX_EPOCH)).to_string();
    let framing = framing.to_string();
    line(&json!({"fatek": "recording", "version": VERSION, "started": started, "link": link, "framing": framing}))
}

/// The line of an event at this time since the start.
pub(crate) fn event(since: Duration, connection: u64, change: &Change) -> String {
    let mut members = Map::new();
    members.insert("us".to_owned(), u64::try_from(since.as_micros()).unwrap_or(u64::MAX).into());
    members.insert("connection".to_owned(), connection.into());
    match change {
        Change::Open(ends) => members.insert("open".to_owned(), ends.as_str().into()),
        Change::Bytes { direction, bytes, is_datagram } => {
            members.insert("to".to_owned(), side(*direction).into());
            if *is_datagram {
                members.insert("datagram".to_owned(), true.into());
            }
            let digits = bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut digits, byte| {
                // Writing to a string does not fail.
                let _ = write!(digits, "{byte:02x}");
                digits
            });
            members.insert("bytes".to_owned(), digits.into())
        }
        Change::Missing { direction, count } => {
            members.insert("to".to_owned(), side(*direction).into());
            members.insert("missing".to_owned(), (*count).into())
        }
        Change::Close => members.insert("close".to_owned(), true.into()),
    };
    line(&Value::Object(members))
}

fn line(value: &Value) -> String {
    format!("{value}\n")
}

fn side(direction: Direction) -> &'static str {
    match direction {
        Direction::ToPlc => "plc",
        Direction::FromPlc => "client",
    }
}

/// Returns whether a line, or its beginning, is the first of a recording.
pub(super) fn is_header(line: &str) -> bool {
    let compact: String = line.chars().filter(|character| !character.is_ascii_whitespace()).take(64).collect();
    compact.starts_with(r#"{"fatek":"recording""#)
}

/// Framing in the first line.
pub(super) fn framing_of(line: &str) -> Option<Framing> {
    let header: Value = serde_json::from_str(line).ok()?;
    header.get("framing")?.as_str()?.parse().ok()
}

/// Reads a recording. A last line that is cut off is a remark: the computer may have lost its power.
pub(super) fn read(reader: impl BufRead, sink: &mut Sink<'_>) -> Result<Remarks, ReadError> {
    let mut lines = Lines::new(reader);
    let content = |number: u64, rule: String| SourceError::Content(format!("line {number}: {rule}"));
    let first = lines.next()?.map(|line| line.text).unwrap_or_default();
    let started = started(&first).map_err(|rule| content(1, rule))?;
    while let Some(line) = lines.next()? {
        if line.text.trim().is_empty() {
            continue;
        }
        match parse(&line.text, started) {
            Ok(Some(event)) => sink(event).map_err(ReadError::Sink)?,
            Ok(None) => {}
            Err(_) if !line.is_whole => return Ok(vec![format!("line {}, the last, is cut off", line.number)]),
            Err(rule) => return Err(content(line.number, rule).into()),
        }
    }
    Ok(Remarks::new())
}

/// Checks the first line. Returns the time of its start.
fn started(line: &str) -> Result<Duration, String> {
    let header: Value = serde_json::from_str(line).map_err(|_| "not the first line of a recording".to_owned())?;
    let version = header.get("version").and_then(Value::as_u64).ok_or("`version` is not a number")?;
    if version > VERSION {
        return Err(format!("version {version} needs a newer `fatek`, this one reads version {VERSION}"));
    }
    let started = header.get("started").and_then(Value::as_str).ok_or("`started` is not a text")?;
    let time = humantime::parse_rfc3339(started).map_err(|_| {
        format!("`started` is `{}`: expected a time such as 2026-11-29T18:00:00.123456Z", excerpt(started))
    })?;
    Ok(time.duration_since(UNIX_EPOCH).unwrap_or_default())
}

/// Parses the line of an event; `None` for one of an unknown kind.
fn parse(line: &str, started: Duration) -> Result<Option<Event>, String> {
    let value: Value =
        serde_json::from_str(line).map_err(|error| format!("no JSON: {}", excerpt(&error.to_string())))?;
    let number =
        |name: &str| value.get(name).and_then(Value::as_u64).ok_or_else(|| format!("`{name}` is not a number from 0"));
    let direction = || match value.get("to").and_then(Value::as_str) {
        Some("plc") => Ok(Direction::ToPlc),
        Some("client") => Ok(Direction::FromPlc),
        Some(_) | None => Err("`to` is neither `plc` nor `client`".to_owned()),
    };
    let change = if let Some(ends) = value.get("open") {
        Change::Open(ends.as_str().unwrap_or_default().to_owned())
    } else if let Some(digits) = value.get("bytes") {
        let bytes = digits.as_str().and_then(bytes_of).ok_or("`bytes` are not pairs of hexadecimal digits")?;
        let is_datagram = value.get("datagram").and_then(Value::as_bool).unwrap_or_default();
        Change::Bytes { direction: direction()?, bytes, is_datagram }
    } else if value.get("missing").is_some() {
        Change::Missing { direction: direction()?, count: number("missing")? }
    } else if value.get("close").is_some() {
        Change::Close
    } else {
        return Ok(None);
    };
    let at = started.saturating_add(Duration::from_micros(number("us")?));
    Ok(Some(Event { connection: number("connection")?, at, change }))
}

fn bytes_of(digits: &str) -> Option<Bytes> {
    let nibble = |digit: u8| char::from(digit).to_digit(16).and_then(|nibble| u8::try_from(nibble).ok());
    let (pairs, rest) = digits.as_bytes().as_chunks::<2>();
    let bytes =
        pairs.iter().map(|&[high, low]| Some(nibble(high)? << 4 | nibble(low)?)).collect::<Option<Vec<u8>>>()?;
    rest.is_empty().then(|| bytes.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(text: &str) -> Result<(Vec<Event>, Remarks), String> {
        let mut events = Vec::new();
        let read = read(text.as_bytes(), &mut |event| {
            events.push(event);
            Ok(())
        });
        match read {
            Ok(remarks) => Ok((events, remarks)),
            Err(ReadError::Source(SourceError::Content(rule))) => Err(rule),
            Err(error) => panic!("{error:?}"),
        }
    }

    fn changes() -> Vec<Change> {
        let bytes = Bytes::from_static(b"\x02\xFF");
        vec![
            Change::Open("tcp a:1 > \u{1b}".to_owned()),
            Change::Bytes { direction: Direction::ToPlc, bytes: bytes.clone(), is_datagram: false },
            Change::Bytes { direction: Direction::FromPlc, bytes, is_datagram: true },
            Change::Missing { direction: Direction::FromPlc, count: 7 },
            Change::Close,
        ]
    }

    fn recording() -> String {
        let started = UNIX_EPOCH + Duration::from_micros(1_700_000_000_000_001);
        let lines = changes().into_iter().zip(1..).map(|(change, n)| event(Duration::from_micros(n), n, &change));
        header(started, "tcp://h:500", Framing::Binary) + &lines.collect::<String>()
    }

    #[test]
    fn events_are_read_as_they_were_written() {
        let (events, remarks) = all(&recording()).unwrap();
        let expected = changes().into_iter().zip(1..).map(|(change, n)| Event {
            connection: n,
            at: Duration::from_micros(1_700_000_000_000_001 + n),
            change,
        });
        assert_eq!((events, remarks), (expected.collect(), Remarks::new()));
        assert!(is_header(&recording()) && is_header("{ \"fatek\": \"recording\" }") && !is_header("{}"));
        assert_eq!(framing_of(recording().lines().next().unwrap()), Some(Framing::Binary));
        assert_eq!(framing_of("{\"fatek\":\"recording\"}"), None);
    }

    #[test]
    fn a_cut_off_recording_is_read_up_to_its_end() {
        let whole = recording();
        let first = whole.find('\n').unwrap() + 1;
        for end in first..whole.len() {
            let (events, remarks) = all(&whole[..end]).unwrap_or_else(|rule| panic!("{end}: {rule}"));
            assert!(events.len() <= 5 && remarks.len() <= 1, "{end}: {remarks:?}");
        }
        // Events of later versions, and members.
        let extended =
            whole + "\n{\"us\":1,\"connection\":1,\"note\":\"x\"}\n{\"us\":1,\"connection\":9,\"close\":1,\"x\":2}\n";
        assert_eq!(all(&extended).unwrap().0.len(), 6);
    }

    #[test]
    fn wrong_lines_are_named_with_their_rule() {
        let header = header(UNIX_EPOCH, "tcp://h", Framing::Ascii);
        for (line, rule) in [
            ("{", "line 2: no JSON"),
            (r#"{"us":1,"connection":1,"to":"plc","bytes":"0"}"#, "line 2: `bytes` are not pairs"),
            (r#"{"us":1,"connection":1,"to":"plc","bytes":"0é"}"#, "line 2: `bytes` are not pairs"),
            (r#"{"us":1,"connection":1,"to":"x","bytes":"00"}"#, "line 2: `to` is neither"),
            (r#"{"us":-1,"connection":1,"close":1}"#, "line 2: `us` is not a number"),
            (r#"{"us":1,"close":1}"#, "line 2: `connection` is not a number"),
        ] {
            let error = all(&format!("{header}{line}\n")).unwrap_err();
            assert!(error.starts_with(rule), "{error} should begin: {rule}");
        }
        for (header, rule) in [
            ("", "line 1: not the first line"),
            (r#"{"fatek":"recording","version":2}"#, "line 1: version 2 needs a newer"),
            (r#"{"fatek":"recording","version":1,"started":"x"}"#, "line 1: `started` is `x`"),
        ] {
            let error = all(header).unwrap_err();
            assert!(error.starts_with(rule), "{error} should begin: {rule}");
        }
    }

    proptest::proptest! {
        /// Hostile recordings and logs: no panic.
        #[test]
        fn any_lines_are_read_or_refused(
            lines in proptest::collection::vec(
                "\\PC{0,40}|\\{\"us\":[0-9]{1,20},\"connection\":[0-9]{1,20},\
                 \"(to|bytes|open|missing)\":[\"a-f0-9]{1,9}\\}",
                0..6,
            ),
            cut in 0_usize..400,
        ) {
            let text = header(UNIX_EPOCH, "tcp://h", Framing::Ascii) + &lines.join("\n");
            let mut bytes = text.into_bytes();
            bytes.truncate(cut);
            let _ = read(&bytes[..], &mut |_| Ok(()));
            let _ = crate::traffic::log::read(&bytes[..], &mut |_| Ok(()));
        }
    }
}
