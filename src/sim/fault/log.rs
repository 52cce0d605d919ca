use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::time::Instant;

use super::{Change, Fault};
use crate::command::{Class, Data, Request, RequestError, with_command};
use crate::sim::bus::BROADCAST;
use crate::sim::execute::Execute as _;
use crate::wire::{Discard, Frame};

/// Log of the arrivals at a [`Bus`](crate::sim::Bus) with [`Faults`](super::Faults).
///
/// A handle: clones show the same log. It keeps the latest arrivals with their replies and faults,
/// up to [`Faults::log_capacity`](super::Faults::log_capacity), and counts the others. A journal
/// counts how often each write was executed, up to
/// [`Faults::journal_capacity`](super::Faults::journal_capacity) different writes.
#[derive(Clone)]
pub struct Log {
    inner: Arc<Mutex<LogInner>>,
}

impl Log {
    /// The arrivals in the log, oldest first.
    #[must_use]
    pub fn entries(&self) -> Vec<LogEntry> {
        self.lock().entries.iter().cloned().collect()
    }

    /// Number of arrivals, including those no longer in the log.
    #[must_use]
    pub fn arrivals(&self) -> u64 {
        self.lock().arrivals
    }

    /// Number of arrivals, the oldest ones, that are no longer in the log for lack of capacity.
    #[must_use]
    pub fn forgotten(&self) -> u64 {
        let inner = self.lock();
        // Each entry is an arrival.
        inner.arrivals - inner.entries.len() as u64
    }

    /// Number of executions of exactly this write or control request by a station.
    ///
    /// A broadcast counts for each station that obeyed it. Refused requests and reads do not count.
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
        let inner = self.lock();
        inner.journal.get(&station).and_then(|writes| writes.get(request)).map_or(0, |count| count.times)
    }

    /// Writes and control requests that were executed more than once, in the order of their first
    /// execution.
    #[must_use]
    pub fn repeated(&self) -> Vec<Applied> {
        let inner = self.lock();
        let mut repeated = Vec::new();
        for (&station, writes) in &inner.journal {
            let writes = writes.iter().filter(|(_, count)| count.times > 1);
            repeated.extend(writes.map(|(request, count)| {
                (count.first, Applied { station, request: request.clone(), times: count.times })
            }));
        }
        repeated.sort_by_key(|&(first, _)| first);
        repeated.into_iter().map(|(_, write)| write).collect()
    }

    /// The changes of a PLC by executed writes and control requests, in the order of their arrival.
    ///
    /// One [`Change`] for each element, independent of the command: a [`Link`](crate::Link) sends
    /// equal writes by 47 and 49 in turn. Broadcasts that the station has obeyed are included; refused
    /// requests and reads have no changes. For the requests themselves see
    /// [`entries`](Self::entries).
    ///
    /// If executed writes are not in the log, of any station, the first item is
    /// [`Change::NotInLog`]: an empty list proves that nothing was written.
    ///
    /// ```
    /// use fatek::sim::{self, Change};
    /// use fatek::{discrete, register};
    ///
    /// # #[tokio::main(flavor = "current_thread", start_paused = true)]
    /// # async fn main() -> Result<(), fatek::Error> {
    /// let bench = sim::station().await;
    /// bench.station.read_registers(register!("R0"), 2).await?;
    /// assert_eq!(bench.log().changes(1), []);
    ///
    /// bench.station.run().await?;
    /// bench.station.write_registers(register!("R0"), &[7, 8]).await?;
    /// bench.station.set(discrete!("Y3")).await?;
    /// assert_eq!(
    ///     bench.log().changes(1),
    ///     [
    ///         Change::Run,
    ///         Change::value(register!("R0"), 7_u16),
    ///         Change::value(register!("R1"), 8_u16),
    ///         Change::value(discrete!("Y3"), true),
    ///     ]
    /// );
    /// # Ok(())
    /// # }
    /// ```
    #[must_use]
    pub fn changes(&self, station: u8) -> Vec<Change> {
        let inner = self.lock();
        let logged: u64 = inner.entries.iter().map(LogEntry::executed_writes).sum();
        let missing = inner.writes.saturating_sub(logged);
        let mut changes = if missing > 0 { vec![Change::NotInLog(missing)] } else { Vec::new() };
        for entry in inner.entries.iter().filter(|entry| entry.was_executed_by(station)) {
            if let Some(request) = entry.request() {
                changes.extend(with_command!(request, request => request.changes()));
            }
        }
        changes
    }

    /// Number of executed writes and control requests, including those not in the journal.
    #[must_use]
    pub fn writes(&self) -> u64 {
        self.lock().writes
    }

    /// Number of executed writes and control requests that the full journal did not take.
    ///
    /// Check that it is 0 before you rely on [`applied`](Self::applied) and
    /// [`repeated`](Self::repeated).
    #[must_use]
    pub fn unjournaled(&self) -> u64 {
        self.lock().unjournaled
    }

    /// Removes all entries and resets all counts.
    pub fn clear(&self) {
        let mut inner = self.lock();
        let LogInner { capacity, journal_capacity, next, .. } = *inner;
        *inner = LogInner { capacity, journal_capacity, next, ..LogInner::default() };
    }

    pub(super) fn new() -> Self {
        let inner = LogInner { capacity: 1000, journal_capacity: 10_000, ..LogInner::default() };
        Self { inner: Arc::new(Mutex::new(inner)) }
    }

    pub(super) fn set_capacity(&self, entries: usize) {
        let mut inner = self.lock();
        inner.capacity = entries;
        let excess = inner.entries.len().saturating_sub(entries);
        inner.entries.drain(..excess);
    }

    pub(super) fn set_journal_capacity(&self, writes: usize) {
        self.lock().journal_capacity = writes;
    }

    /// Adds an arrival, and returns its number for later additions to its entry.
    pub(super) fn arrived(&self, at: Instant, faults: &[Fault], arrival: impl FnOnce() -> Arrival) -> u64 {
        let mut inner = self.lock();
        let number = inner.next;
        inner.next += 1;
        inner.arrivals += 1;
        if inner.capacity > 0 {
            if inner.entries.len() >= inner.capacity {
                inner.entries.pop_front();
            }
            let faults = faults.to_vec();
            inner.entries.push_back(LogEntry {
                at,
                arrival: arrival(),
                executed: false,
                answer: None,
                faults,
                obeyed_by: Vec::new(),
            });
        }
        number
    }

    /// A PLC has executed a request.
    pub(super) fn executed(&self, number: u64, station: u8, write: Option<&Request>) {
        let mut inner = self.lock();
        if let Some(entry) = inner.entry(number) {
            entry.executed = true;
            if write.is_some() && entry.station() == Some(BROADCAST) {
                entry.obeyed_by.push(station);
            }
        }
        if let Some(request) = write {
            inner.apply(station, request);
        }
    }

    /// Adds a fault that was decided after the arrival.
    pub(super) fn add_fault(&self, number: u64, fault: &Fault) {
        if let Some(entry) = self.lock().entry(number).filter(|entry| !entry.faults.contains(fault)) {
            entry.faults.push(fault.clone());
        }
    }

    /// Adds a reply that was sent, behind earlier ones to the same request.
    pub(super) fn answered(&self, number: u64, answer: &Bytes) {
        if let Some(entry) = self.lock().entry(number) {
            entry.answer = Some(match entry.answer.take() {
                None => answer.clone(),
                Some(earlier) => Bytes::from([earlier, answer.clone()].concat()),
            });
        }
    }

    fn lock(&self) -> MutexGuard<'_, LogInner> {
        // Nothing panics under the lock.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let inner = self.lock();
        f.debug_struct("Log").field("arrivals", &inner.arrivals).field("writes", &inner.writes).finish_non_exhaustive()
    }
}

impl fmt::Display for Log {
    /// A line for each arrival in the log, oldest first, with its time since the first of them. A
    /// line before them has the number of arrivals that are not in the log, if there are any.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (forgotten, entries) = (self.forgotten(), self.entries());
        if forgotten > 0 {
            writeln!(f, "earlier arrivals: {forgotten}")?;
        }
        let began = entries.first().map(|entry| entry.at);
        entries.iter().try_for_each(|entry| {
            let at = began.map_or_else(Default::default, |began| entry.at.duration_since(began));
            writeln!(f, "{:9.3} s  {entry}", at.as_secs_f64())
        })
    }
}

/// One arrival at a bus, with its replies and faults.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct LogEntry {
    /// Time at which its last byte had arrived.
    pub at: Instant,
    /// The request, or the bytes that are none.
    pub arrival: Arrival,
    /// `true` if a PLC has executed it.
    ///
    /// `false` while it waits for earlier requests to its station, and if it was lost or refused.
    pub executed: bool,
    /// Bytes that were sent in reply, with all faults.
    ///
    /// The reply, and behind it the duplicates and second answers that have been sent so far. An
    /// echo does not belong to them.
    pub answer: Option<Bytes>,
    /// The faults that applied to it, in the order of their rules.
    ///
    /// Behind them: the faults by which stations answered a broadcast.
    pub faults: Vec<Fault>,
    /// The stations that have executed a write or control request that was broadcast.
    obeyed_by: Vec<u8>,
}

impl LogEntry {
    /// Station number of the frame; 0 is a broadcast, `None` is noise.
    #[must_use]
    pub fn station(&self) -> Option<u8> {
        match &self.arrival {
            Arrival::Request { station, .. } => Some(*station),
            Arrival::Unreadable { frame, .. } => Some(frame.station),
            Arrival::Noise { .. } => None,
        }
    }

    /// The request, if the arrival is one.
    #[must_use]
    pub fn request(&self) -> Option<&Request> {
        match &self.arrival {
            Arrival::Request { request, .. } => Some(request),
            Arrival::Unreadable { .. } | Arrival::Noise { .. } => None,
        }
    }
}

impl LogEntry {
    fn was_executed_by(&self, station: u8) -> bool {
        self.executed && (self.station() == Some(station) || self.obeyed_by.contains(&station))
    }

    /// Number of executions, if it is a write or control request.
    fn executed_writes(&self) -> u64 {
        let is_write = self.request().is_some_and(|request| request.code().class() != Class::Read);
        match self.station() {
            Some(BROADCAST) => self.obeyed_by.len() as u64,
            Some(_) | None => u64::from(self.executed && is_write),
        }
    }
}

impl fmt::Display for LogEntry {
    /// Arrival, result and faults on one line, without the time: `station 1: write registers (47h)
    /// R0 = 7; executed; no reply; DropReply`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.arrival)?;
        if self.executed {
            f.write_str("; executed")?;
        }
        match &self.answer {
            Some(bytes) => write!(f, "; {} bytes in reply", bytes.len())?,
            None => f.write_str("; no reply")?,
        }
        self.faults.iter().try_for_each(|fault| write!(f, "; {fault:?}"))
    }
}

/// A request as the bus received it, or bytes that are none.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Arrival {
    /// A request, possibly to a station that is not on the bus.
    #[non_exhaustive]
    Request {
        /// Station number; 0 is a broadcast.
        station: u8,
        /// The request.
        request: Request,
    },
    /// A good frame that is not a request.
    #[non_exhaustive]
    Unreadable {
        /// The frame.
        frame: Frame,
        /// The rule that its content breaks.
        reason: RequestError,
    },
    /// Bytes that are not a frame.
    #[non_exhaustive]
    Noise {
        /// Why they are not.
        reason: Discard,
        /// The bytes.
        bytes: Bytes,
    },
}

impl fmt::Display for Arrival {
    /// One line: `station 1: read registers (46h) R0`, `broadcast: control RUN/STOP (41h) stop`,
    /// `station 1: command 99h: there is no command 99`, or `noise: garbage between frames: 06`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Request { station: BROADCAST, request } => write!(f, "broadcast: {request}"),
            Self::Request { station, request } => write!(f, "station {station}: {request}"),
            Self::Unreadable { frame, reason } => write!(f, "{frame}: {reason}"),
            Self::Noise { reason, bytes } => write!(f, "noise: {reason}: {}", Data(bytes)),
        }
    }
}

/// A write or control request that a station has executed.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Applied {
    /// The station that executed it.
    pub station: u8,
    /// The request.
    pub request: Request,
    /// Number of executions.
    pub times: u64,
}

impl fmt::Display for Applied {
    /// One line: `station 1: write registers (47h) R0 = 7; executed 2 times`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { station, request, times } = self;
        write!(f, "station {station}: {request}; executed {times} times")
    }
}

#[derive(Debug, Default)]
struct LogInner {
    capacity: usize,
    entries: VecDeque<LogEntry>,
    /// Number of the next entry.
    next: u64,
    arrivals: u64,
    journal_capacity: usize,
    journal: BTreeMap<u8, HashMap<Request, WriteCount>>,
    /// Number of different writes in the journal.
    journaled: usize,
    writes: u64,
    unjournaled: u64,
}

/// Executions of one write.
#[derive(Debug)]
struct WriteCount {
    times: u64,
    /// Number of the first execution among all writes.
    first: u64,
}

impl LogInner {
    /// The entry with this number, if it is still in the log.
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
            self.journal.entry(station).or_default().insert(request.clone(), WriteCount { times: 1, first });
            self.journaled += 1;
        } else {
            self.unjournaled += 1;
        }
    }
}

#[cfg(test)]
mod tests;
