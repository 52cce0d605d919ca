//! A model of the store: a server with one bucket, which restarts, and is deleted or set back.

use std::collections::BTreeMap;

use super::super::core::{Operation, Outcome};
use super::super::keys::{DEAD, Key, SessionValue};

/// The states to which the store can be set back.
const SNAPSHOTS: usize = 12;

/// An entry that has changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Change {
    pub(super) key: String,
    pub(super) value: Option<String>,
    pub(super) revision: u64,
}

/// The content of the bucket.
#[derive(Clone, Debug, Default)]
struct Bucket {
    last_revision: u64,
    /// Value, revision and the wall clock of the server when it was stored.
    entries: BTreeMap<String, (Option<String>, u64, u64)>,
}

/// The server.
#[derive(Debug)]
pub(super) struct Store {
    pub(super) is_up: bool,
    /// Counts the starts of the server: connections end with it.
    pub(super) life: u64,
    /// The creation time of the bucket, if there is one.
    pub(super) created: Option<u64>,
    /// `true` once revisions have gone back: tokens no longer rise.
    pub(super) was_set_back: bool,
    bucket: Bucket,
    snapshots: Vec<Bucket>,
    /// All revisions with which links were taken, for the oracle.
    takes: BTreeMap<String, Vec<u64>>,
}

impl Store {
    pub(super) fn new() -> Self {
        Self {
            is_up: true,
            life: 1,
            created: Some(1),
            was_set_back: false,
            bucket: Bucket::default(),
            snapshots: Vec::new(),
            takes: BTreeMap::new(),
        }
    }

    pub(super) fn last_revision(&self) -> u64 {
        self.bucket.last_revision
    }

    /// All entries in the order of their revisions.
    pub(super) fn entries(&self) -> Vec<Change> {
        let entries = self.bucket.entries.iter();
        let change = |(key, (value, revision, _)): (&String, &(Option<String>, u64, u64))| Change {
            key: key.clone(),
            value: value.clone(),
            revision: *revision,
        };
        let mut entries: Vec<_> = entries.map(change).collect();
        entries.sort_by_key(|change| change.revision);
        entries
    }

    /// Performs a request. Returns its outcome, and the change that watchers see.
    pub(super) fn perform(&mut self, operation: &Operation, wall: u64) -> (Outcome, Option<Change>) {
        if self.created.is_none() {
            return (Outcome::Unknown, None);
        }
        match operation {
            Operation::Put { key, value, expected } => {
                let revision = self.bucket.entries.get(key).map_or(0, |(_, revision, _)| *revision);
                if revision != *expected {
                    return (Outcome::WrongRevision, None);
                }
                let change = self.put(key, Some(value.clone()), wall);
                (Outcome::Stored(change.revision), Some(change))
            }
            Operation::Get { key } => match self.bucket.entries.get(key) {
                Some((value, revision, _)) => (Outcome::Found { value: value.clone(), revision: *revision }, None),
                None => (Outcome::Missing, None),
            },
            Operation::Purge { key, revision } => {
                if self.bucket.entries.get(key).is_some_and(|(_, stored, _)| stored <= revision) {
                    self.bucket.entries.remove(key);
                }
                (Outcome::Purged, None)
            }
        }
    }

    /// Stores a value without a condition.
    pub(super) fn put(&mut self, key: &str, value: Option<String>, wall: u64) -> Change {
        self.bucket.last_revision += 1;
        let revision = self.bucket.last_revision;
        if let (Some(Key::Link(link)), Some(value)) = (Key::parse(key), &value)
            && !value.is_empty()
        {
            self.takes.entry(link.to_owned()).or_default().push(revision);
        }
        self.bucket.entries.insert(key.to_owned(), (value.clone(), revision, wall));
        Change { key: key.to_owned(), value, revision }
    }

    /// The last revision with which a link was taken.
    pub(super) fn last_take(&self, link: &str) -> Option<u64> {
        self.takes.get(link)?.last().copied()
    }

    /// Keeps the present state as one to which the store can be set back.
    pub(super) fn keep(&mut self) {
        if self.snapshots.len() == SNAPSHOTS {
            self.snapshots.remove(0);
        }
        self.snapshots.push(self.bucket.clone());
    }

    /// Sets the store back to a state that was kept. Later ones are more likely.
    pub(super) fn set_back(&mut self, rng: &mut fastrand::Rng) {
        let length = self.snapshots.len();
        if length > 0 {
            let index = rng.usize(..length).max(rng.usize(..length));
            self.bucket = self.snapshots[index].clone();
            self.snapshots.truncate(index + 1);
            self.was_set_back = true;
        }
    }

    /// Deletes the bucket.
    pub(super) fn delete(&mut self) {
        self.created = None;
        self.bucket = Bucket::default();
        self.snapshots.clear();
        self.was_set_back = true;
    }

    /// Expires sessions by the wall clock of the server, and frees their links: the variant of the server's TTL.
    pub(super) fn expire(&mut self, wall: u64, lease: u64) -> Vec<Change> {
        let is_old = |value: &Option<String>, stored: u64| {
            value.as_deref().and_then(SessionValue::parse).is_some() && wall.saturating_sub(stored) >= lease
        };
        let sessions = self.bucket.entries.iter().filter(|(_, (value, _, stored))| is_old(value, *stored));
        let old: Vec<String> = sessions.filter_map(|(key, _)| key.strip_prefix("w.")).map(str::to_owned).collect();
        let mut changes = Vec::new();
        for session in old {
            changes.push(self.put(&Key::Session(&session).text(), Some(DEAD.to_owned()), wall));
            let links = self.bucket.entries.iter().filter(|(key, (value, ..))| {
                matches!(Key::parse(key), Some(Key::Link(_))) && value.as_ref() == Some(&session)
            });
            let links: Vec<String> = links.map(|(key, _)| key.clone()).collect();
            changes.extend(links.into_iter().map(|key| self.put(&key, Some(String::new()), wall)));
        }
        changes
    }
}
