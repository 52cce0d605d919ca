//! The file of a recording.
//!
//! Each event is one write of whole lines, without a buffer: a killed process has lost none, and a full
//! disk cuts off the last line only. When the file has its largest size, the rest is passed on, but not
//! recorded.

use std::fs::OpenOptions;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Instant, SystemTime};

use fatek::Endpoint;
use tokio::sync::Notify;

use crate::conversation::{Change, Direction};
use crate::failure::Failure;
use crate::output::complain;
use crate::traffic::{TrafficFailure, recording};
use crate::transfer::shown;

/// Handle to the file, for all connections.
#[derive(Clone, Debug)]
pub(super) struct RecordingWriter(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    name: String,
    is_stdout: bool,
    file: Mutex<RecordingFile>,
    failed: Notify,
}

struct RecordingFile {
    out: Box<dyn Write + Send>,
    started: Instant,
    len: u64,
    max_len: u64,
    is_full: bool,
    failure: Option<io::Error>,
    connections: u64,
    to_plc: u64,
    from_plc: u64,
}

impl std::fmt::Debug for RecordingFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RecordingFile").field("len", &self.len).finish_non_exhaustive()
    }
}

impl RecordingWriter {
    /// Makes the file, which must not exist, and writes its first line. `-` is stdout.
    pub(super) fn create(path: &Path, endpoint: &Endpoint, max_len: u64) -> Result<Self, Failure> {
        let is_stdout = path.as_os_str() == "-";
        let name = if is_stdout { "stdout".to_owned() } else { shown(path) };
        let out: Box<dyn Write + Send> = if is_stdout {
            Box::new(io::stdout())
        } else {
            let file = OpenOptions::new().write(true).create_new(true).open(path);
            let exists = |error: &io::Error| error.kind() == io::ErrorKind::AlreadyExists;
            Box::new(file.map_err(|error| match exists(&error) {
                true => TrafficFailure::Exists { name: name.clone() },
                false => TrafficFailure::NotWritten { name: name.clone(), error },
            })?)
        };
        let writer = Self::new(name, is_stdout, out, max_len);
        writer.write(&recording::header(SystemTime::now(), &endpoint.to_string(), endpoint.framing()));
        let failure = writer.file().failure.take();
        failure.map_or(Ok(writer.clone()), |error| Err(writer.failure(error)))
    }

    fn new(name: String, is_stdout: bool, out: Box<dyn Write + Send>, max_len: u64) -> Self {
        let file = RecordingFile {
            out,
            started: Instant::now(),
            len: 0,
            max_len,
            is_full: false,
            failure: None,
            connections: 0,
            to_plc: 0,
            from_plc: 0,
        };
        Self(Arc::new(Shared { name, is_stdout, file: Mutex::new(file), failed: Notify::new() }))
    }

    pub(super) fn is_stdout(&self) -> bool {
        self.0.is_stdout
    }

    /// Begins a connection between these ends. Returns its number.
    pub(super) fn open(&self, ends: String) -> u64 {
        let mut file = self.file();
        file.connections += 1;
        let number = file.connections;
        drop(file);
        self.record(number, &Change::Open(ends));
        number
    }

    /// Records an event, before its bytes are passed on: a reply is recorded behind its request.
    pub(super) fn record(&self, connection: u64, change: &Change) {
        let mut file = self.file();
        if let Change::Bytes { direction, bytes, .. } = change {
            let len = u64::try_from(bytes.len()).unwrap_or(u64::MAX);
            match direction {
                Direction::ToPlc => file.to_plc += len,
                Direction::FromPlc => file.from_plc += len,
            }
        }
        let line = recording::event(file.started.elapsed(), connection, change);
        drop(file);
        self.write(&line);
    }

    fn write(&self, line: &str) {
        let mut file = self.file();
        let len = file.len.saturating_add(u64::try_from(line.len()).unwrap_or(u64::MAX));
        if file.is_full || file.failure.is_some() {
            return;
        }
        if len > file.max_len {
            file.is_full = true;
            let (name, max_len) = (&self.0.name, file.max_len);
            complain(format_args!("{name}: it has {max_len} bytes (--max-size); the rest is not recorded"));
            return;
        }
        file.len = len;
        if let Err(error) = file.out.write_all(line.as_bytes()).and_then(|()| file.out.flush()) {
            file.failure = Some(error);
            self.0.failed.notify_one();
        }
    }

    /// Waits until the file cannot be written.
    pub(super) async fn failed(&self) -> Failure {
        loop {
            self.0.failed.notified().await;
            let failure = self.file().failure.take();
            if let Some(error) = failure {
                return self.failure(error);
            }
        }
    }

    /// Contents of the file, for people.
    pub(super) fn summary(&self) -> String {
        let file = self.file();
        format!(
            "{}: {} bytes; {} connections, {} bytes to the PLC, {} from it",
            self.0.name, file.len, file.connections, file.to_plc, file.from_plc
        )
    }

    fn failure(&self, error: io::Error) -> Failure {
        if self.0.is_stdout {
            return Failure::Output(error);
        }
        TrafficFailure::NotWritten { name: self.0.name.clone(), error }.into()
    }

    fn file(&self) -> MutexGuard<'_, RecordingFile> {
        self.0.file.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    /// A file that has room for some bytes.
    #[derive(Clone, Debug)]
    struct Disk(Arc<Mutex<(Vec<u8>, usize)>>);

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let (content, room) = &mut *self.0.lock().unwrap();
            if content.len() + bytes.len() > *room {
                return Err(io::ErrorKind::StorageFull.into());
            }
            content.extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn writer(room: usize, max_len: u64) -> (RecordingWriter, Disk) {
        let disk = Disk(Arc::new(Mutex::new((Vec::new(), room))));
        (RecordingWriter::new("f".to_owned(), false, Box::new(disk.clone()), max_len), disk)
    }

    fn bytes() -> Change {
        Change::Bytes { direction: Direction::ToPlc, bytes: Bytes::from_static(b"\x02"), is_datagram: false }
    }

    #[test]
    fn the_largest_size_is_not_exceeded_and_lines_are_whole() {
        let (writer, disk) = writer(usize::MAX, 200);
        let number = writer.open("a > b".to_owned());
        for _ in 0..10 {
            writer.record(number, &bytes());
        }
        let content = String::from_utf8(disk.0.lock().unwrap().0.clone()).unwrap();
        assert!((150..=200).contains(&content.len()) && content.ends_with('\n'), "{content}");
        assert!(content.lines().all(|line| line.starts_with('{') && line.ends_with('}')), "{content}");
        // The rest is counted.
        assert!(writer.summary().ends_with("1 connections, 10 bytes to the PLC, 0 from it"), "{}", writer.summary());
    }

    #[tokio::test]
    async fn a_full_disk_ends_the_recording() {
        let (writer, _) = writer(100, u64::MAX);
        let number = writer.open("a > b".to_owned());
        for _ in 0..10 {
            writer.record(number, &bytes());
        }
        let failure = writer.failed().await;
        assert_eq!(failure.exit_status(), 1);
        assert!(failure.to_string().starts_with("f: cannot write it: "), "{failure}");
    }
}
