//! Counters and findings of a line.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use fatek::Error;

/// Number of findings after which the test ends.
pub(crate) const MAX_FINDINGS: u64 = 10;

#[derive(Debug, Default)]
pub(crate) struct Counters {
    pub(crate) calls: AtomicU64,
    pub(crate) confirmed: AtomicU64,
    pub(crate) cancelled: AtomicU64,
    /// Checked values, including those of samples.
    pub(crate) values: AtomicU64,
    pub(crate) samples: AtomicU64,
    pub(crate) not_good: AtomicU64,
    /// Writes executed by the PLCs.
    pub(crate) writes: AtomicU64,
    pub(crate) audits: AtomicU64,
    pub(crate) wrong: AtomicU64,
    failed: Mutex<BTreeMap<&'static str, u64>>,
    findings: Mutex<Vec<String>>,
}

impl Counters {
    pub(crate) fn failed(&self, error: &Error) {
        *lock(&self.failed).entry(kind(error)).or_default() += 1;
    }

    pub(crate) fn wrong(&self, finding: String) {
        if self.wrong.fetch_add(1, Ordering::Relaxed) < MAX_FINDINGS {
            lock(&self.findings).push(finding);
        }
    }

    /// Returns the findings since the last call.
    pub(crate) fn take_findings(&self) -> Vec<String> {
        std::mem::take(&mut lock(&self.findings))
    }

    pub(crate) fn failures(&self) -> BTreeMap<&'static str, u64> {
        lock(&self.failed).clone()
    }
}

pub(crate) fn count(counter: &AtomicU64, by: usize) {
    counter.fetch_add(by as u64, Ordering::Relaxed);
}

pub(crate) fn load(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn kind(error: &Error) -> &'static str {
    match error {
        Error::Invalid(_) => "invalid",
        Error::Plc { .. } | Error::RefusedTags { .. } => "refused",
        Error::Timeout { .. } => "timeout",
        Error::BadReply { .. } => "bad reply",
        Error::Connect { .. } => "connect",
        Error::Disconnected { .. } => "disconnected",
        Error::Offline { .. } => "offline",
        Error::QueueFull { .. } => "queue full",
        Error::GateClosed { .. } => "gate closed",
        Error::Closed { .. } => "closed",
        Error::OutOfStep { .. } | Error::Duplicates { .. } | Error::PartlyWritten { .. } | _ => "other",
    }
}
