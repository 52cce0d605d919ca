//! The buffer between the poller and the outputs.
//!
//! It is a log of batches. Each output has a cursor: what it reads next, and up to where its server has
//! acknowledged. A batch leaves the buffer when all outputs have acknowledged it, or when the buffer is
//! full: then the oldest is dropped and counted for each output that lacks it. `push` never waits.
//!
//! ```text
//! push ──▶ [acknowledged by all … | unacknowledged …            | not yet read …]
//!           └ removed              └ cursor of a slow output      └ cursor of a fast one
//! ```
//!
//! Batches are in memory first. One without an acknowledgement for half a second is written to disk, so that
//! a crash loses at most one second; with `sync` an output gets only what is on disk. Batches that do not fit into
//! memory are read back from disk when an output needs them.
//!
//! Invariants:
//! - positions grow by one with each batch, by more at a start, and are never used again;
//! - a cursor yields positions in order; after a rewind it begins behind the last acknowledged one;
//! - a batch that an output may have sent before is a replay;
//! - a batch is in the buffer while an output has not acknowledged it, unless it was dropped and counted.
//!
//! Parts: the state machine without I/O and clocks (`log`, `jobs`, `chunk`), the format (`record`), the file
//! (`disk`) and the thread that writes it (`storage`).

mod chunk;
mod disk;
#[cfg(test)]
mod faults;
mod jobs;
mod log;
#[cfg(test)]
mod model;
mod record;
mod restore;
mod settings;
mod storage;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use self::log::{Limits, Log, Slot};
pub use self::settings::{BufferError, BufferSettings};
use self::storage::Shared;
use crate::batch::Batch;

/// A batch in the buffer.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Its place in the order of all batches, from 1.
    pub position: u64,
    /// The batch.
    pub batch: Arc<Batch>,
    /// `true` if it is not news: the output may have sent it before, it is of an earlier run, or it was pushed
    /// more than 5 s before it is sent.
    pub replay: bool,
}

/// A batch that an output has fetched, and not sent yet.
#[derive(Clone, Debug)]
pub struct Fetched(Slot);

/// Figures of the buffer, for an output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CursorStats {
    /// Batches that are not acknowledged.
    pub lag: u64,
    /// Batches that were dropped before they were acknowledged.
    pub dropped: u64,
}

/// Figures of the buffer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BufferStats {
    /// The batches that an output lacks.
    pub batches: u64,
    /// The age of the oldest of them.
    pub oldest_age: Option<Duration>,
    /// The bytes of batches in memory.
    pub memory_bytes: u64,
    /// The bytes of batches on disk, in whole pages.
    pub disk_bytes: u64,
    /// The length of the file.
    pub file_bytes: u64,
    /// The share of the disk's limit that is used, or of the memory's without a disk: 0 to 1. While the disk
    /// fails, the larger one of both.
    pub fill: f64,
    /// `true` if there is no room, or if batches were dropped within the last 10 s because there was none.
    pub is_full: bool,
    /// Batches that were written to disk.
    pub spilled_batches: u64,
    /// Reads and writes that failed.
    pub disk_errors: u64,
    /// Files that were damaged and moved aside.
    pub corrupt_files: u64,
    /// Batches that could not be read back.
    pub corrupt_batches: u64,
    /// Why the disk does not take batches, if it does not.
    pub failure: Option<String>,
}

/// The buffer; cheap to clone. The storage thread ends with the last clone.
#[derive(Clone, Debug)]
pub struct Buffer {
    shared: Arc<Shared>,
    /// Of a buffer with a disk.
    closer: Option<Arc<Closer>>,
}

/// Ends the storage thread.
#[derive(Debug)]
struct Closer {
    shared: Arc<Shared>,
    ended: watch::Receiver<bool>,
}

impl Drop for Closer {
    fn drop(&mut self) {
        self.shared.start_closing();
    }
}

/// The cursor of an output.
#[derive(Debug)]
pub struct Cursor {
    shared: Arc<Shared>,
    output: usize,
}

impl Buffer {
    /// Opens a buffer for these outputs, with what an earlier run has left there. Blocks: it reads the whole
    /// file and verifies it.
    ///
    /// An output goes on where the output of the same name stopped; a new one begins with the oldest batch.
    /// A damaged file is moved aside, and the buffer begins empty.
    ///
    /// # Errors
    /// [`BufferError`] if another process has it open, or if the folder or the file cannot be used.
    pub fn open(settings: &BufferSettings, outputs: &[&str]) -> Result<Self, BufferError> {
        restore::open(settings, outputs, disk::Disk::opener())
    }

    /// Makes a buffer in memory for these outputs. `memory`: the limit in bytes.
    #[must_use]
    pub fn in_memory(outputs: usize, memory: usize) -> Self {
        let log = Log::in_memory(outputs, Limits { memory, max_age: None });
        Self { shared: Arc::new(Shared::new(log, 0)), closer: None }
    }

    /// Appends a batch and returns its position. Never waits for the disk.
    pub fn push(&self, batch: Batch) -> u64 {
        let now = self.shared.now();
        let mut state = self.shared.lock();
        let position = state.log.push(batch, now);
        self.shared.wake_storage(&mut state);
        drop(state);
        self.shared.changed.notify_waiters();
        position
    }

    /// The cursor of an output, by its number. Each output has one.
    #[must_use]
    pub fn cursor(&self, output: usize) -> Cursor {
        Cursor { shared: self.shared.clone(), output }
    }

    /// The figures of each output.
    #[must_use]
    pub fn stats(&self) -> Vec<CursorStats> {
        self.shared.lock().log.stats()
    }

    /// The figures of the buffer.
    #[must_use]
    pub fn figures(&self) -> BufferStats {
        let now = self.shared.now();
        self.shared.lock().log.figures(now)
    }

    /// The bytes in memory.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.shared.lock().log.bytes()
    }

    /// The sequence numbers behind the last batch of each PLC.
    #[must_use]
    pub fn next_seqs(&self) -> HashMap<Arc<str>, u64> {
        self.shared.lock().log.next_seqs()
    }

    /// Waits until the users of an output need the present values of all tags: it has delivered its last replay
    /// and has no late batch left, but for those that its server refuses, or it has asked for them. Several such
    /// events count as one. Cancel-safe.
    pub async fn present_values_wanted(&self) {
        self.shared.present.notified().await;
    }

    /// Waits until the thread that writes to disk has ended: after [`close`](Self::close), or after a panic, with
    /// which nothing reaches the disk any more. Cancel-safe. Without a disk it never returns.
    pub async fn ended(&self) {
        let Some(closer) = &self.closer else { return std::future::pending().await };
        let mut ended = closer.ended.clone();
        // After a panic the sender is gone.
        let _ = ended.wait_for(|ended| *ended).await;
    }

    /// Writes all that is not acknowledged to disk, within a limited time, and closes the file. Returns
    /// whether all of it is there; `true` for a buffer in memory. Later batches stay in memory only.
    pub async fn close(&self) -> bool {
        let Some(closer) = &self.closer else { return true };
        self.shared.start_closing();
        let mut ended = closer.ended.clone();
        // A disk that does not answer at all is given up.
        let limit = storage::CLOSE_WITHIN.saturating_add(Duration::from_secs(5));
        let waited = tokio::time::timeout(limit, ended.wait_for(|ended| *ended)).await;
        matches!(waited, Ok(Ok(_))) && self.shared.lock().log.is_written()
    }
}

impl Cursor {
    /// Waits for batches and returns those that come next, at most `max`. They count as sent.
    ///
    /// Cancel-safe: batches that were not returned are returned by the next call.
    pub async fn next(&mut self, max: usize) -> Vec<Entry> {
        let fetched = self.fetch(max).await;
        fetched.into_iter().map(|fetched| self.send(fetched)).collect()
    }

    /// As [`next`](Self::next), for an output that keeps batches before it sends them: [`send`](Self::send)
    /// tells of each.
    ///
    /// Cancel-safe: batches that were not returned are returned by the next call.
    pub async fn fetch(&mut self, max: usize) -> Vec<Fetched> {
        loop {
            // Created before the look, so that a push in between wakes it.
            let changed = self.shared.changed.notified();
            let slots = {
                let mut state = self.shared.lock();
                let slots = state.log.read(self.output, max);
                self.shared.wake_storage(&mut state);
                slots
            };
            if !slots.is_empty() {
                return slots.into_iter().map(Fetched).collect();
            }
            changed.await;
        }
    }

    /// Notes that a batch is sent now, and returns it as it is to be sent.
    pub fn send(&mut self, fetched: Fetched) -> Entry {
        let now = self.shared.now();
        self.shared.lock().log.send(self.output, fetched.0, now)
    }

    /// Marks all batches up to this position as delivered.
    pub fn acknowledge(&mut self, position: u64) {
        let now = self.shared.now();
        let mut state = self.shared.lock();
        state.log.acknowledge(self.output, position);
        let has_caught_up = state.log.has_caught_up(self.output, 0, now);
        drop(state);
        if has_caught_up {
            self.want_present_values();
        }
    }

    /// Notes that all batches before this position are acknowledged, or kept by the output because its server
    /// refuses them. An output that has caught up but for these ones needs the present values of all tags:
    /// [`acknowledge`](Self::acknowledge) does not notice that, since the kept ones are not acknowledged.
    pub fn settled_before(&self, position: u64) {
        let now = self.shared.now();
        let has_caught_up = self.shared.lock().log.has_caught_up(self.output, position, now);
        if has_caught_up {
            self.want_present_values();
        }
    }

    /// Asks for the present values of all tags: see [`Buffer::present_values_wanted`].
    pub fn want_present_values(&self) {
        self.shared.present.notify_one();
    }

    /// Begins again behind the last acknowledged batch, after a connection was lost.
    pub fn rewind(&mut self) {
        self.shared.lock().log.rewind(self.output);
    }

    /// Returns whether all batches are acknowledged.
    #[must_use]
    pub fn is_drained(&self) -> bool {
        self.shared.lock().log.stats().get(self.output).is_none_or(|stats| stats.lag == 0)
    }
}

#[cfg(test)]
mod tests {
    use futures::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn a_panic_of_the_storage_thread_is_noticed() {
        let Buffer { shared, .. } = Buffer::in_memory(1, 1 << 20);
        let (end, wait) = std::sync::mpsc::channel::<()>();
        let work = move || {
            let _ = wait.recv();
            panic!("injected");
        };
        let ended = storage::spawn(work).unwrap();
        let buffer = Buffer { closer: Some(Arc::new(Closer { shared: shared.clone(), ended })), shared };
        assert_eq!(buffer.ended().now_or_never(), None, "it runs");
        end.send(()).unwrap();
        tokio::time::timeout(Duration::from_secs(60), buffer.ended()).await.expect("the end is noticed");
        assert!(!buffer.close().await, "nothing was written");
        assert_eq!(Buffer::in_memory(1, 1 << 20).ended().now_or_never(), None, "there is no thread");
    }
}
