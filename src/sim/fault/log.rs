use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::time::Instant;

use super::Fault;
use crate::command::{Request, RequestError};
use crate::wire::{Discard, Frame};

/// What has arrived at a [`Bus`](crate::sim::Bus) with [`Faults`](super::Faults), and what came of it.
///
/// This is a handle: its clones show the same log. It keeps the latest arrivals, up to a number that
/// [`Faults::log_capacity`](super::Faults::log_capacity) sets, and counts the others. Besides it counts how often each
/// write was applied, which [`Faults::journal_capacity`](super::Faults::journal_capacity) bounds.
#[derive(Clone)]
pub struct Log {
    record: Arc<Mutex<Record>>,
}

impl Log {
    /// The arrivals it still has, in the order in which they came.
    #[must_use]
    pub fn entries(&self) -> Vec<LogEntry> {
        self.lock().entries.iter().cloned().collect()
    }

    /// How many arrivals there were.
    #[must_use]
    pub fn arrivals(&self) -> u64 {
        self.lock().arrivals
    }

    /// How many arrivals, the oldest ones, had no place any more.
    #[must_use]
    pub fn forgotten(&self) -> u64 {
        let record = self.lock();
        record.arrivals.saturating_sub(u64::try_from(record.entries.len()).unwrap_or(u64::MAX))
    }

    /// How often a PLC has done what exactly this write or control request asks: a broadcast counts for every station
    /// that has obeyed it, a request that the PLC refused does not count, and reads do not either.
    ///
    /// ```
    /// use fatek::command::{Request, WriteRegisters};
    /// use fatek::register;
    /// use fatek::sim::Faults;
    ///
    /// let log = Faults::new(0).log();
    /// let write = Request::WriteRegisters(WriteRegisters::new(register!("R0"), [7])?);
    /// assert_eq!(log.applied(1, &write), 0);
    /// # Ok::<(), fatek::command::InvalidRequest>(())
    /// ```
    #[must_use]
    pub fn applied(&self, station: u8, request: &Request) -> u64 {
        let record = self.lock();
        record.journal.get(&station).and_then(|writes| writes.get(request)).map_or(0, |count| count.times)
    }

    /// The writes that were applied more than once, in the order in which they were first applied.
    #[must_use]
    pub fn repeated(&self) -> Vec<Applied> {
        let record = self.lock();
        let mut repeated = Vec::new();
        for (&station, writes) in &record.journal {
            let writes = writes.iter().filter(|(_, count)| count.times > 1);
            repeated.extend(writes.map(|(request, count)| {
                (count.first, Applied { station, request: request.clone(), times: count.times })
            }));
        }
        repeated.sort_by_key(|&(first, _)| first);
        repeated.into_iter().map(|(_, write)| write).collect()
    }

    /// How many writes were applied, those that had no place in the journal included.
    #[must_use]
    pub fn writes(&self) -> u64 {
        self.lock().writes
    }

    /// How many writes were applied that are not in the journal, because it was full.
    #[must_use]
    pub fn unjournaled(&self) -> u64 {
        self.lock().unjournaled
    }

    /// Forgets all there is, counts included.
    pub fn clear(&self) {
        let mut record = self.lock();
        let Record { capacity, journal_capacity, next, .. } = *record;
        *record = Record { capacity, journal_capacity, next, ..Record::default() };
    }

    pub(super) fn new() -> Self {
        let record = Record { capacity: 1000, journal_capacity: 10_000, ..Record::default() };
        Self { record: Arc::new(Mutex::new(record)) }
    }

    pub(super) fn set_capacity(&self, entries: usize) {
        let mut record = self.lock();
        record.capacity = entries;
        let excess = record.entries.len().saturating_sub(entries);
        record.entries.drain(..excess);
    }

    pub(super) fn set_journal_capacity(&self, writes: usize) {
        self.lock().journal_capacity = writes;
    }

    /// Something has arrived. The number it gets is how the rest of it is told later.
    pub(super) fn arrived(&self, at: Instant, faults: &[Fault], heard: impl FnOnce() -> Heard) -> u64 {
        let mut record = self.lock();
        let number = record.next;
        record.next += 1;
        record.arrivals += 1;
        if record.capacity > 0 {
            if record.entries.len() >= record.capacity {
                record.entries.pop_front();
            }
            let faults = faults.to_vec();
            record.entries.push_back(LogEntry { at, heard: heard(), executed: false, answer: None, faults });
        }
        number
    }

    /// A PLC has done what a request asks.
    pub(super) fn executed(&self, number: u64, station: u8, write: Option<&Request>) {
        let mut record = self.lock();
        if let Some(entry) = record.entry(number) {
            entry.executed = true;
        }
        if let Some(request) = write {
            record.apply(station, request);
        }
    }

    /// A fault has befallen a request after its arrival.
    pub(super) fn befell(&self, number: u64, fault: &Fault) {
        if let Some(entry) = self.lock().entry(number).filter(|entry| !entry.faults.contains(fault)) {
            entry.faults.push(fault.clone());
        }
    }

    /// An answer has been sent, behind those that were sent before.
    pub(super) fn answered(&self, number: u64, answer: &Bytes) {
        if let Some(entry) = self.lock().entry(number) {
            entry.answer = Some(match entry.answer.take() {
                None => answer.clone(),
                Some(earlier) => Bytes::from([earlier, answer.clone()].concat()),
            });
        }
    }

    fn lock(&self) -> MutexGuard<'_, Record> {
        // Nothing panics under the lock.
        self.record.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let record = self.lock();
        f.debug_struct("Log")
            .field("arrivals", &record.arrivals)
            .field("writes", &record.writes)
            .finish_non_exhaustive()
    }
}

/// One arrival.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct LogEntry {
    /// When its last byte had come over the line.
    pub at: Instant,
    /// What came.
    pub heard: Heard,
    /// Whether a PLC has done what it asks. `false` while it waits for its turn, and for ever when it was lost, or when
    /// the PLC refused it.
    pub executed: bool,
    /// What was sent for an answer, all faults included: the reply, and behind it copies and second answers that have
    /// been sent by now. An echo is none.
    pub answer: Option<Bytes>,
    /// The faults that befell it, in the order of their rules; behind them those that had stations answer a broadcast.
    pub faults: Vec<Fault>,
}

impl LogEntry {
    /// Which station it was for: 0 is the broadcast. `None` for noise.
    #[must_use]
    pub fn station(&self) -> Option<u8> {
        match &self.heard {
            Heard::Request { station, .. } => Some(*station),
            Heard::Unreadable { frame, .. } => Some(frame.station),
            Heard::Noise { .. } => None,
        }
    }

    /// The request, if it is one.
    #[must_use]
    pub fn request(&self) -> Option<&Request> {
        match &self.heard {
            Heard::Request { request, .. } => Some(request),
            Heard::Unreadable { .. } | Heard::Noise { .. } => None,
        }
    }
}

/// What arrives at a bus.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Heard {
    /// A request, perhaps to a station that is not there.
    #[non_exhaustive]
    Request {
        /// To which station; 0 is the broadcast.
        station: u8,
        /// What it asks.
        request: Request,
    },
    /// A good frame that is no request.
    #[non_exhaustive]
    Unreadable {
        /// The frame.
        frame: Frame,
        /// What is wrong with it.
        reason: RequestError,
    },
    /// Bytes that are no frame.
    #[non_exhaustive]
    Noise {
        /// Why not.
        reason: Discard,
        /// The bytes.
        bytes: Bytes,
    },
}

/// A write or control request that was applied.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Applied {
    /// By which station.
    pub station: u8,
    /// What it asks.
    pub request: Request,
    /// How often.
    pub times: u64,
}

#[derive(Debug, Default)]
struct Record {
    capacity: usize,
    entries: VecDeque<LogEntry>,
    /// The number of the next entry.
    next: u64,
    arrivals: u64,
    journal_capacity: usize,
    journal: BTreeMap<u8, HashMap<Request, Count>>,
    /// How many different writes the journal holds.
    journaled: usize,
    writes: u64,
    unjournaled: u64,
}

/// How often a write was applied.
#[derive(Debug)]
struct Count {
    times: u64,
    /// The number of the first time, among all writes.
    first: u64,
}

impl Record {
    /// The entry with this number, if it has not been forgotten.
    fn entry(&mut self, number: u64) -> Option<&mut LogEntry> {
        let back = usize::try_from(self.next.checked_sub(number)?).ok()?;
        let index = self.entries.len().checked_sub(back)?;
        self.entries.get_mut(index)
    }

    fn apply(&mut self, station: u8, request: &Request) {
        let first = self.writes;
        self.writes += 1;
        if let Some(count) = self.journal.get_mut(&station).and_then(|writes| writes.get_mut(request)) {
            count.times += 1;
        } else if self.journaled < self.journal_capacity {
            self.journal.entry(station).or_default().insert(request.clone(), Count { times: 1, first });
            self.journaled += 1;
        } else {
            self.unjournaled += 1;
        }
    }
}

#[cfg(test)]
mod tests;
