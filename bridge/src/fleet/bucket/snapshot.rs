//! The entries that a watch must deliver before its view is complete.
//!
//! The server counts the pending entries of a watch, too. But nats-server 2.9 counts an entry for ever that was
//! replaced before it was delivered: a member that waited for zero joined nothing, until its connection was lost.
//! So the keys are listed when the watch begins, and crossed off.

use std::collections::HashSet;

use crate::fleet::keys::Key;

/// The keys that a watch has not delivered yet.
#[derive(Debug, Default)]
pub(super) struct Snapshot {
    keys: HashSet<String>,
    /// Sessions may be removed before they are delivered.
    sessions: HashSet<String>,
    /// The last revision when the keys were listed.
    end: u64,
    is_past_end: bool,
}

impl Snapshot {
    /// A snapshot of all keys, which were listed after the watch began.
    pub(super) fn new(keys: impl IntoIterator<Item = String>, end: u64) -> Self {
        let is_session = |key: &String| matches!(Key::parse(key), Some(Key::Session(_)));
        let (sessions, keys) = keys.into_iter().partition(is_session);
        Self { keys, sessions, end, is_past_end: false }
    }

    /// Crosses a key off.
    pub(super) fn delivered(&mut self, key: &str, revision: u64) {
        self.keys.remove(key);
        self.sessions.remove(key);
        // Entries come in the order of their revisions, so all sessions up to this one have come, or are gone.
        self.is_past_end |= revision >= self.end;
    }

    /// Returns whether all keys were delivered that were there when they were listed.
    pub(super) fn is_complete(&self) -> bool {
        self.keys.is_empty() && (self.sessions.is_empty() || self.is_past_end)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn snapshot(keys: &[&str], end: u64) -> Snapshot {
        Snapshot::new(keys.iter().map(|key| (*key).to_owned()), end)
    }

    #[test]
    fn a_view_is_complete_when_all_keys_have_come() {
        assert!(snapshot(&[], 7).is_complete());
        let mut snapshot = snapshot(&["w.a", "l.mixer", "o.mixer"], 9);
        for (key, revision) in [("l.mixer", 2), ("w.a", 5), ("o.mixer", 9)] {
            assert!(!snapshot.is_complete());
            snapshot.delivered(key, revision);
        }
        assert!(snapshot.is_complete());
    }

    #[test]
    fn an_entry_that_was_replaced_may_come_after_the_end() {
        let mut snapshot = snapshot(&["w.a", "l.mixer"], 9);
        snapshot.delivered("w.a", 12);
        assert!(!snapshot.is_complete());
        snapshot.delivered("l.mixer", 13);
        assert!(snapshot.is_complete());
    }

    #[test]
    fn a_session_that_was_removed_is_not_waited_for() {
        let mut snapshot = snapshot(&["w.a", "w.b", "l.mixer"], 9);
        snapshot.delivered("l.mixer", 3);
        snapshot.delivered("w.b", 8);
        assert!(!snapshot.is_complete());
        snapshot.delivered("w.b", 10);
        assert!(snapshot.is_complete());
    }
}
