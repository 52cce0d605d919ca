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
//! Invariants:
//! - positions grow by one with each batch, and are never used again, also after a restart;
//! - a cursor yields positions in order; after a rewind it begins behind the last acknowledged one;
//! - a batch is in the buffer while an output has not acknowledged it, unless it was dropped and counted.

mod log;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

use self::log::Log;
use crate::batch::Batch;

/// A batch in the buffer.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Its place in the order of all batches, from 1.
    pub position: u64,
    /// The batch.
    pub batch: Arc<Batch>,
    /// `true` if it was delivered before without an acknowledgement, or is of an earlier run.
    pub replay: bool,
}

/// Figures of the buffer, for an output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CursorStats {
    /// Batches that are not acknowledged.
    pub lag: u64,
    /// Batches that were dropped before they were acknowledged.
    pub dropped: u64,
}

/// The buffer; cheap to clone.
#[derive(Clone, Debug)]
pub struct Buffer {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    log: Mutex<Log>,
    /// Wakes the outputs.
    pushed: Notify,
}

/// The cursor of an output.
#[derive(Debug)]
pub struct Cursor {
    shared: Arc<Shared>,
    output: usize,
}

impl Buffer {
    /// Makes a buffer in memory for these outputs. `memory`: the limit in bytes.
    #[must_use]
    pub fn in_memory(outputs: usize, memory: usize) -> Self {
        Self { shared: Arc::new(Shared { log: Mutex::new(Log::new(outputs, memory)), pushed: Notify::new() }) }
    }

    /// Appends a batch and returns its position.
    pub fn push(&self, batch: Batch) -> u64 {
        let position = lock(&self.shared.log).push(batch);
        self.shared.pushed.notify_waiters();
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
        lock(&self.shared.log).stats()
    }

    /// The bytes in memory.
    #[must_use]
    pub fn bytes(&self) -> usize {
        lock(&self.shared.log).bytes()
    }

    /// The sequence numbers behind the last batch of each PLC.
    #[must_use]
    pub fn next_seqs(&self) -> HashMap<Arc<str>, u64> {
        lock(&self.shared.log).next_seqs()
    }
}

impl Cursor {
    /// Waits for batches and returns those that come next, at most `max`.
    ///
    /// Cancel-safe: batches that were not returned are returned by the next call.
    pub async fn next(&mut self, max: usize) -> Vec<Entry> {
        loop {
            // Created before the look, so that a push in between wakes it.
            let pushed = self.shared.pushed.notified();
            let entries = lock(&self.shared.log).read(self.output, max);
            if !entries.is_empty() {
                return entries;
            }
            pushed.await;
        }
    }

    /// Marks all batches up to this position as delivered.
    pub fn acknowledge(&mut self, position: u64) {
        lock(&self.shared.log).acknowledge(self.output, position);
    }

    /// Begins again behind the last acknowledged batch, after a connection was lost.
    pub fn rewind(&mut self) {
        lock(&self.shared.log).rewind(self.output);
    }

    /// Returns whether all batches are acknowledged.
    #[must_use]
    pub fn is_drained(&self) -> bool {
        lock(&self.shared.log).stats().get(self.output).is_none_or(|stats| stats.lag == 0)
    }
}

/// Locks a mutex, poisoned or not: no code under this lock leaves its data inconsistent.
fn lock(log: &Mutex<Log>) -> MutexGuard<'_, Log> {
    log.lock().unwrap_or_else(PoisonError::into_inner)
}
