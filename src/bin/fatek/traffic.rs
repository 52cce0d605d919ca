//! Sources of recorded traffic: captures (pcap, pcapng), recordings of `fatek record`, and logs of
//! `fatek -vv`. Each is read as a stream, in bounded memory.

mod capture;
mod escape;
mod failure;
mod flows;
mod lines;
mod log;
mod packet;
mod reassembly;
pub(crate) mod recording;

use std::fmt;
use std::fs::{self, File};
use std::io::{self, BufReader, IsTerminal, Read};
use std::path::Path;

use fatek::wire::Framing;

pub(crate) use self::escape::unescape;
pub(crate) use self::failure::TrafficFailure;
use crate::conversation::{Analysis, Entry, Event};
use crate::failure::Failure;
use crate::transfer::shown;

/// Takes the events of a source; an error ends the reading.
pub(crate) type Sink<'s> = dyn FnMut(Event) -> Result<(), Failure> + 's;

/// A source of traffic, and the name of it for messages.
pub(crate) struct Source {
    pub(crate) name: String,
    reader: BufReader<Box<dyn Read>>,
}

impl fmt::Debug for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Source").field("name", &self.name).finish_non_exhaustive()
    }
}

/// Kind of a source, told by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SourceKind {
    Capture(capture::Form),
    /// With the framing that its first line names.
    Recording(Option<Framing>),
    /// Log lines, the first of which has a time.
    Log,
    /// Text or bytes of another kind.
    Other,
}

/// The error of a source.
#[derive(Debug)]
pub(crate) enum SourceError {
    Io(io::Error),
    /// The content breaks a rule: a damaged or foreign file.
    Content(String),
}

impl From<io::Error> for SourceError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Either the error of a source, or that of the sink.
#[derive(Debug)]
pub(crate) enum ReadError {
    Source(SourceError),
    Sink(Failure),
}

impl<E: Into<SourceError>> From<E> for ReadError {
    fn from(error: E) -> Self {
        Self::Source(error.into())
    }
}

/// A part of a source that was not read, as a text for people.
pub(crate) type Remarks = Vec<String>;

/// Longest text or run of bytes that is no stream.
const MAX_TEXT_LEN: u64 = 16 * 1024 * 1024;

/// Name of the standard input.
const STDIN: &str = "the standard input";

/// Bytes that [`SourceKind`] is told from.
const HEAD_LEN: usize = 4096;

impl Source {
    /// A regular file, or the standard input for `-`.
    pub(crate) fn open(path: &Path) -> Result<Self, Failure> {
        if path.as_os_str() == "-" {
            return Ok(Self::stdin());
        }
        let name = shown(path);
        let failed = |error: io::Error| TrafficFailure::NotRead { name: name.clone(), error };
        // Checked before it is opened: that blocks for a pipe without a writer.
        if !fs::metadata(path).map_err(failed)?.is_file() {
            return Err(failed(io::Error::other("not a regular file; `-` is the standard input")).into());
        }
        let file = File::open(path).map_err(failed)?;
        Ok(Self { name, reader: BufReader::new(Box::new(file)) })
    }

    pub(crate) fn is_stdin(&self) -> bool {
        self.name == STDIN
    }

    pub(crate) fn stdin() -> Self {
        Self { name: STDIN.to_owned(), reader: BufReader::new(Box::new(io::stdin())) }
    }

    /// Any bytes as a source, for tests and arguments.
    pub(crate) fn of_bytes(name: &str, bytes: Vec<u8>) -> Self {
        Self { name: name.to_owned(), reader: BufReader::new(Box::new(io::Cursor::new(bytes))) }
    }

    /// Tells the kind by the first bytes, as far as they have come.
    pub(crate) fn kind(&mut self) -> Result<SourceKind, Failure> {
        let kind = self.sniff();
        kind.map_err(|error| self.failure(SourceError::Io(error)))
    }

    fn sniff(&mut self) -> io::Result<SourceKind> {
        let mut head = Vec::new();
        // Enough for a magic number; a line may come in parts.
        while head.len() < 4 || (is_text(&head) && !head.contains(&b'\n') && head.len() < HEAD_LEN) {
            let mut part = [0];
            if self.reader.read(&mut part)? == 0 {
                break;
            }
            head.extend_from_slice(&part);
        }
        let kind = SourceKind::of(&head);
        let rest = std::mem::replace(&mut self.reader, BufReader::new(Box::new(io::empty())));
        self.reader = BufReader::new(Box::new(io::Cursor::new(head).chain(rest)));
        Ok(kind)
    }

    /// Reads all of it, up to 16 MiB.
    pub(crate) fn read_all(&mut self) -> Result<Vec<u8>, Failure> {
        let mut content = Vec::new();
        let read = (&mut self.reader).take(MAX_TEXT_LEN + 1).read_to_end(&mut content);
        read.map_err(|error| self.failure(SourceError::Io(error)))?;
        if u64::try_from(content.len()).is_ok_and(|len| len <= MAX_TEXT_LEN) {
            Ok(content)
        } else {
            Err(self.failure(SourceError::Content(format!("it has more than {MAX_TEXT_LEN} bytes"))))
        }
    }

    /// Reads the events of a source of this kind. Returns remarks about the parts that were skipped.
    pub(crate) fn read(&mut self, kind: SourceKind, ports: &[u16], sink: &mut Sink<'_>) -> Result<Remarks, Failure> {
        let reader = &mut self.reader;
        let read = match kind {
            SourceKind::Capture(form) => capture::read(reader, form, ports, sink),
            SourceKind::Recording(_) => recording::read(reader, sink),
            SourceKind::Log | SourceKind::Other => log::read(reader, sink),
        };
        read.map_err(|error| match error {
            ReadError::Source(error) => self.failure(error),
            ReadError::Sink(failure) => failure,
        })
    }

    fn failure(&self, error: SourceError) -> Failure {
        let name = self.name.clone();
        match error {
            SourceError::Io(error) => TrafficFailure::NotRead { name, error }.into(),
            SourceError::Content(rule) => TrafficFailure::Damaged { name, rule }.into(),
        }
    }
}

impl SourceKind {
    /// Framing that the source names.
    pub(crate) fn framing(self) -> Option<Framing> {
        match self {
            Self::Recording(framing) => framing,
            Self::Capture(_) | Self::Log | Self::Other => None,
        }
    }

    fn of(head: &[u8]) -> Self {
        if let Some(form) = capture::Form::of(head) {
            return Self::Capture(form);
        }
        let first = head.split(|&byte| byte == b'\n').next().unwrap_or_default();
        let first = String::from_utf8_lossy(first);
        if recording::is_header(&first) {
            Self::Recording(recording::framing_of(&first))
        } else if log::has_time(&first) {
            Self::Log
        } else {
            Self::Other
        }
    }
}

/// Returns whether the bytes are a text, and not frames.
pub(crate) fn is_text(bytes: &[u8]) -> bool {
    let is_of_text = |&byte: &u8| byte >= b' ' && byte != 0x7F || matches!(byte, b'\t' | b'\n' | b'\r' | 0x1B | 0x0C);
    // A character may be cut off at the end.
    bytes.iter().all(is_of_text)
        && std::str::from_utf8(bytes).map_or_else(|error| error.error_len().is_none(), |_| true)
}

/// Returns whether a text has lines of `fatek -vv`.
pub(crate) fn is_log(text: &str) -> bool {
    log::has_frames(text)
}

/// The payload of a whole packet of TCP or UDP, from Ethernet or IP on, as programs that show packets copy
/// it; `None` for other bytes.
pub(crate) fn payload(bytes: &[u8]) -> Option<&[u8]> {
    packet::payload(bytes)
}

/// Returns whether the standard input is a pipe or a file.
pub(crate) fn stdin_is_piped() -> bool {
    !io::stdin().is_terminal()
}

/// Reads a whole source, and returns its entries. Its framing is this one, else that of a recording.
pub(crate) fn entries(
    source: &mut Source,
    ports: &[u16],
    framing: Option<Framing>,
    max: usize,
) -> Result<Vec<Entry>, Failure> {
    let mut kind = source.kind()?;
    if kind == SourceKind::Other {
        // A log may begin with other lines.
        let content = source.read_all()?;
        if !is_text(&content) || !is_log(&String::from_utf8_lossy(&content)) {
            let rule = "neither a recording, nor a capture, nor a log of -vv".to_owned();
            return Err(source.failure(SourceError::Content(rule)));
        }
        *source = Source::of_bytes(&source.name, content);
        kind = SourceKind::Log;
    }
    let (mut analysis, mut entries) = (Analysis::new(framing.or(kind.framing())), Vec::new());
    let name = source.name.clone();
    source.read(kind, ports, &mut |event| {
        analysis.push(event, &mut entries);
        let rule = || format!("it has more than {max} exchanges");
        if entries.len() > max {
            Err(TrafficFailure::Damaged { name: name.clone(), rule: rule() }.into())
        } else {
            Ok(())
        }
    })?;
    analysis.finish(&mut entries);
    Ok(entries)
}
