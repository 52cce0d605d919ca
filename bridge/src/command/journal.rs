//! The ids of commands that were accepted, with their replies. No I/O, and no clock.
//!
//! Invariants:
//! - An id is here from its acceptance on. It leaves if the command is refused before anything was sent, or
//!   when it is forgotten.
//! - An id is forgotten after [`Limits::age`], or when there are too many. Never within
//!   [`Limits::protected`], which is longer than a command is valid: then new commands are refused.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::Now;
use super::reply::Reply;

/// The id of a command with the name of its PLC.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Key {
    pub(super) plc: Arc<str>,
    pub(super) id: Arc<str>,
}

/// A command on disk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    /// The time when it began, in milliseconds since 1970.
    pub(super) at: u64,
    /// The digest of its content.
    pub(super) digest: u64,
    /// Its reply; `None` while it runs.
    pub(super) reply: Option<Reply>,
}

/// The limits of the journal.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    pub(super) age: Duration,
    pub(super) protected: Duration,
    pub(super) count: usize,
    pub(super) bytes: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            age: Duration::from_secs(24 * 3600),
            protected: Duration::from_secs(60),
            count: 1 << 16,
            bytes: 16 << 20,
        }
    }
}

/// A command in memory.
#[derive(Debug)]
pub(super) struct Entry {
    digest: u64,
    state: State,
    /// When it began, in milliseconds since 1970.
    at: u64,
    /// The same since the start of the bridge; `None`: before.
    begun: Option<Duration>,
    /// Separates it from an earlier entry of the same id.
    number: u64,
    size: usize,
}

#[derive(Debug)]
pub(super) enum State {
    /// It waits or runs: the calls that wait for its reply.
    Running(Vec<u64>),
    Done(Reply),
}

/// All ids.
#[derive(Debug)]
pub(super) struct Journal {
    limits: Limits,
    entries: HashMap<Key, Entry>,
    /// The entries by age, and others that have left.
    order: VecDeque<(u64, Key)>,
    next: u64,
    bytes: usize,
    /// The keys that are to be removed from the disk.
    forgotten: Vec<Key>,
}

/// The places of entries that have left which are kept at least.
const MAX_LEFT: usize = 1024;
/// The memory of an entry besides its id and its reply.
const OVERHEAD: usize = 200;

impl Journal {
    /// With the commands of an earlier run, of which those without a reply get this one.
    pub(super) fn new(limits: Limits, mut records: Vec<(Key, Record)>, now: Now) -> Self {
        let (entries, order) = (HashMap::new(), VecDeque::new());
        let mut journal = Self { limits, entries, order, next: 0, bytes: 0, forgotten: Vec::new() };
        records.sort_by_key(|(_, record)| record.at);
        for (key, record) in records {
            let reply = record.reply.unwrap_or_else(|| interrupted(&key));
            journal.put(key, record.digest, State::Done(reply), (record.at, None));
        }
        journal.shrink(now);
        journal
    }

    /// The command of this id. An error: the id belongs to a command of other content.
    pub(super) fn find(&mut self, key: &Key, digest: u64) -> Result<Option<&mut State>, IsOther> {
        match self.entries.get_mut(key) {
            Some(entry) if entry.digest == digest => Ok(Some(&mut entry.state)),
            Some(_) => Err(IsOther),
            None => Ok(None),
        }
    }

    /// Adds a command, for which a call waits. Returns whether there was room for it.
    pub(super) fn insert(&mut self, key: Key, digest: u64, call: u64, now: Now) -> bool {
        self.shrink(now);
        let is_full = self.entries.len() >= self.limits.count || self.bytes >= self.limits.bytes;
        if !is_full {
            self.put(key, digest, State::Running(vec![call]), (now.wall, Some(now.run)));
        }
        !is_full
    }

    /// Sets the reply of a command. Returns the calls that wait for it.
    pub(super) fn finish(&mut self, key: &Key, reply: Reply) -> Vec<u64> {
        let Some(entry) = self.entries.get_mut(key) else { return Vec::new() };
        let size = reply.size();
        entry.size = entry.size.saturating_add(size);
        self.bytes = self.bytes.saturating_add(size);
        match std::mem::replace(&mut entry.state, State::Done(reply)) {
            State::Running(calls) => calls,
            State::Done(_) => Vec::new(),
        }
    }

    /// Removes a command that was refused before anything was sent. Returns the calls that wait for it.
    pub(super) fn remove(&mut self, key: &Key) -> Vec<u64> {
        let Some(entry) = self.entries.remove(key) else { return Vec::new() };
        self.bytes = self.bytes.saturating_sub(entry.size);
        match entry.state {
            State::Running(calls) => calls,
            State::Done(_) => Vec::new(),
        }
    }

    /// Removes a key from the disk with the next change.
    pub(super) fn forget(&mut self, key: Key) {
        self.forgotten.push(key);
    }

    /// The form on disk of a command, with this reply.
    pub(super) fn record(&self, key: &Key, reply: Option<Reply>) -> Option<Record> {
        let entry = self.entries.get(key)?;
        Some(Record { at: entry.at, digest: entry.digest, reply })
    }

    /// The form on disk of a command that has a reply.
    pub(super) fn done(&self, key: &Key) -> Option<Record> {
        match &self.entries.get(key)?.state {
            State::Done(reply) => self.record(key, Some(reply.clone())),
            State::Running(_) => None,
        }
    }

    /// Takes the keys that are to be removed from the disk.
    pub(super) fn take_forgotten(&mut self) -> Vec<Key> {
        std::mem::take(&mut self.forgotten)
    }

    fn put(&mut self, key: Key, digest: u64, state: State, (at, begun): (u64, Option<Duration>)) {
        let reply = match &state {
            State::Running(_) => 0,
            State::Done(reply) => reply.size(),
        };
        let size = OVERHEAD.saturating_add(key.id.len()).saturating_add(reply);
        let number = self.next;
        self.next = self.next.saturating_add(1);
        self.bytes = self.bytes.saturating_add(size);
        self.forgotten.retain(|forgotten| *forgotten != key);
        self.order.push_back((number, key.clone()));
        self.entries.insert(key, Entry { digest, state, at, begun, number, size });
    }

    /// Forgets the oldest commands, of which one that runs keeps the younger ones.
    fn shrink(&mut self, now: Now) {
        while let Some((number, key)) = self.order.front() {
            match self.entries.get(key) {
                Some(entry) if entry.number == *number => {
                    if !self.may_forget(entry, now) {
                        break;
                    }
                    let key = key.clone();
                    self.remove(&key);
                    self.forgotten.push(key);
                }
                Some(_) | None => {}
            }
            self.order.pop_front();
        }
        // Behind one that stays there may be many that have left.
        if self.order.len() > self.entries.len().saturating_mul(2).saturating_add(MAX_LEFT) {
            let entries = &self.entries;
            self.order.retain(|(number, key)| entries.get(key).is_some_and(|entry| entry.number == *number));
        }
    }

    fn may_forget(&self, entry: &Entry, now: Now) -> bool {
        // The clock of the day may be set at any time, so it counts only where there is no other.
        let age = entry.begun.map_or_else(
            || Duration::from_millis(now.wall.saturating_sub(entry.at)).max(now.run),
            |begun| now.run.saturating_sub(begun),
        );
        let is_full = self.entries.len() >= self.limits.count || self.bytes >= self.limits.bytes;
        let is_old = age >= self.limits.age || is_full && age >= self.limits.protected;
        matches!(entry.state, State::Done(_)) && is_old
    }
}

/// The id belongs to a command of other content.
#[derive(Debug)]
pub(super) struct IsOther;

/// The reply to a command whose result was lost.
fn interrupted(key: &Key) -> Reply {
    Reply::unknown(Some(&key.id), "restart: the bridge ended before the result was stored")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Without the cure it had 10,001 places.
    #[test]
    fn commands_that_are_refused_after_their_acceptance_take_no_memory() {
        let now = Now { run: Duration::ZERO, wall: 0 };
        let mut journal = Journal::new(Limits::default(), Vec::new(), now);
        let key = |id: u32| Key { plc: "mixer".into(), id: id.to_string().into() };
        assert!(journal.insert(key(0), 0, 0, now));
        for id in 1..=10_000 {
            assert!(journal.insert(key(id), 0, 0, now));
            journal.remove(&key(id));
        }
        assert!(journal.order.len() <= MAX_LEFT + 4, "{}", journal.order.len());
        assert!(journal.find(&key(0), 0).is_ok_and(|found| found.is_some()));
    }
}
