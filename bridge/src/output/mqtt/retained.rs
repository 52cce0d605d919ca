//! Retained messages: the ones that the broker should have, and those of them that must be sent. No I/O.
//!
//! A broker that restarts may have lost them all, so all are sent at each CONNACK, and then those that change.
//! A removed one is cleared with an empty payload.
//!
//! Invariants:
//! - a message that is wanted and was not acknowledged on this connection is queued or in flight;
//! - `owned` has the topics of the messages that have an owner, and no others;
//! - a message that is not wanted any more is cleared, and is forgotten when the broker has acknowledged that.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use bytes::Bytes;

/// When a message is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Priority {
    /// Before batches: states.
    First,
    /// Between batches: discovery, of which there is one a tag.
    Between,
}

/// The retained messages.
#[derive(Debug, Default)]
pub(super) struct Retained {
    /// By topic.
    messages: BTreeMap<String, Wanted>,
    /// The topics of each PLC: thousands of them come and go at once in a fleet.
    owned: HashMap<Arc<str>, BTreeSet<String>>,
    first: BTreeSet<String>,
    between: BTreeSet<String>,
    /// States that are cleared: after the discovery messages that name them.
    last: BTreeSet<String>,
}

#[derive(Debug)]
struct Wanted {
    /// The PLC; `None`: the bridge.
    owner: Option<Arc<str>>,
    priority: Priority,
    /// Empty: to be cleared.
    payload: Bytes,
    /// `true`: it is sent on this connection alone, and is then no concern of this bridge.
    is_announcement: bool,
}

impl Retained {
    /// Wants a message. Returns whether that is news.
    pub(super) fn set(&mut self, topic: String, payload: Bytes, priority: Priority, owner: Option<&Arc<str>>) -> bool {
        if self.messages.get(&topic).is_some_and(|known| known.payload == payload) {
            return false;
        }
        let queue = match priority {
            Priority::First => &mut self.first,
            Priority::Between => &mut self.between,
        };
        queue.insert(topic.clone());
        self.last.remove(&topic);
        self.disown(&topic);
        if let Some(owner) = owner {
            self.owned.entry(owner.clone()).or_default().insert(topic.clone());
        }
        self.messages.insert(topic, Wanted { owner: owner.cloned(), priority, payload, is_announcement: false });
        true
    }

    /// Sends a state once, if this connection lasts: in a fleet, the next one may be of another member.
    pub(super) fn announce(&mut self, topic: String, payload: Bytes) {
        self.set(topic.clone(), payload, Priority::First, None);
        if let Some(message) = self.messages.get_mut(&topic) {
            message.is_announcement = true;
        }
    }

    /// Leaves all messages of a PLC as they are at the broker: another member of the fleet has them now.
    pub(super) fn forget_owner(&mut self, owner: &Arc<str>) {
        for topic in self.owned.remove(owner).unwrap_or_default() {
            self.messages.remove(&topic);
            for queue in [&mut self.first, &mut self.between, &mut self.last] {
                queue.remove(&topic);
            }
        }
    }

    /// Removes a topic from those of its PLC.
    fn disown(&mut self, topic: &str) {
        let Some(owner) = self.messages.get(topic).and_then(|known| known.owner.as_ref()) else { return };
        if let Some(topics) = self.owned.get_mut(owner) {
            topics.remove(topic);
            if topics.is_empty() {
                let owner = owner.clone();
                self.owned.remove(&owner);
            }
        }
    }

    /// Wants exactly these messages of a priority of a PLC: others of it are cleared.
    pub(super) fn replace(&mut self, owner: &Arc<str>, priority: Priority, messages: Vec<(String, Bytes)>) {
        let topics: BTreeSet<&String> = messages.iter().map(|(topic, _)| topic).collect();
        let is_old = |topic: &&String| {
            !topics.contains(*topic) && self.messages.get(*topic).is_some_and(|known| known.priority == priority)
        };
        let old: Vec<String> = self.owned.get(owner).into_iter().flatten().filter(is_old).cloned().collect();
        old.into_iter().for_each(|topic| self.clear(topic));
        for (topic, payload) in messages {
            self.set(topic, payload, priority, Some(owner));
        }
    }

    /// Clears all messages of a PLC.
    pub(super) fn remove_owner(&mut self, owner: &Arc<str>) {
        self.replace(owner, Priority::First, Vec::new());
        self.replace(owner, Priority::Between, Vec::new());
    }

    /// Clears a message: one that was wanted, or one of an earlier run that the broker still has.
    pub(super) fn clear(&mut self, topic: String) {
        let known = self.messages.entry(topic.clone()).or_insert_with(|| Wanted {
            owner: None,
            priority: Priority::Between,
            payload: Bytes::new(),
            is_announcement: false,
        });
        known.payload = Bytes::new();
        self.first.remove(&topic);
        let queue = match known.priority {
            Priority::First => &mut self.last,
            Priority::Between => &mut self.between,
        };
        queue.insert(topic);
    }

    /// Returns whether a message of this topic is wanted.
    pub(super) fn is_wanted(&self, topic: &str) -> bool {
        self.messages.get(topic).is_some_and(|known| !known.payload.is_empty())
    }

    /// Queues all messages: the connection is new.
    pub(super) fn queue_all(&mut self) {
        let Self { messages, first, .. } = self;
        messages.retain(|topic, known| {
            if known.is_announcement {
                first.remove(topic);
            }
            !known.is_announcement
        });
        for (topic, known) in &self.messages {
            match known.priority {
                Priority::First if known.payload.is_empty() => self.last.insert(topic.clone()),
                Priority::First => self.first.insert(topic.clone()),
                Priority::Between => self.between.insert(topic.clone()),
            };
        }
    }

    /// Queues the messages of a priority that are wanted.
    pub(super) fn queue_wanted(&mut self, priority: Priority) {
        let is_one = |(_, known): &(&String, &Wanted)| known.priority == priority && !known.payload.is_empty();
        let topics: Vec<String> = self.messages.iter().filter(is_one).map(|(topic, _)| topic.clone()).collect();
        match priority {
            Priority::First => self.first.extend(topics),
            Priority::Between => self.between.extend(topics),
        }
    }

    /// The number of states that wait to be sent.
    pub(super) fn states(&self) -> usize {
        self.first.len()
    }

    /// Takes a message to be sent; an empty payload clears it.
    pub(super) fn take(&mut self, priority: Priority) -> Option<(String, Bytes)> {
        let topic = match priority {
            Priority::First => self.first.pop_first()?,
            Priority::Between => self.between.pop_first().or_else(|| self.last.pop_first())?,
        };
        let payload = self.messages.get(&topic).map(|known| known.payload.clone()).unwrap_or_default();
        Some((topic, payload))
    }

    /// Notes the acknowledgement of a message. One that was cleared is forgotten, unless it is wanted again.
    pub(super) fn acknowledged(&mut self, topic: &str) {
        let is_queued = self.between.contains(topic) || self.last.contains(topic);
        let is_announced = self.messages.get(topic).is_some_and(|known| known.is_announcement);
        if is_announced && !self.first.contains(topic) || !is_queued && !self.is_wanted(topic) {
            self.disown(topic);
            self.messages.remove(topic);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plc(name: &str) -> Arc<str> {
        name.into()
    }

    fn all(retained: &mut Retained) -> Vec<String> {
        let mut taken = Vec::new();
        for priority in [Priority::First, Priority::Between] {
            while let Some((topic, payload)) = retained.take(priority) {
                taken.push(format!("{topic}={}", std::str::from_utf8(&payload).unwrap()));
            }
        }
        taken
    }

    #[test]
    fn messages_are_sent_when_they_change_and_at_each_connection() {
        let mut retained = Retained::default();
        let set = |retained: &mut Retained, payload: &'static str| {
            retained.set("b/state".to_owned(), payload.into(), Priority::First, None)
        };
        assert!(set(&mut retained, "1"));
        assert_eq!(all(&mut retained), ["b/state=1"]);
        assert!(!set(&mut retained, "1") && set(&mut retained, "2"));
        assert_eq!(all(&mut retained), ["b/state=2"]);
        retained.queue_all();
        assert_eq!(all(&mut retained), ["b/state=2"]);
    }

    #[test]
    fn the_messages_of_a_removed_plc_are_cleared_until_that_is_acknowledged() {
        let mut retained = Retained::default();
        for name in ["a", "b"] {
            retained.set(format!("{name}/state"), "s".into(), Priority::First, Some(&plc(name)));
            let tags = vec![(format!("ha/{name}/1"), "1".into()), (format!("ha/{name}/2"), "2".into())];
            retained.replace(&plc(name), Priority::Between, tags);
        }
        assert_eq!(all(&mut retained).len(), 6);
        retained.remove_owner(&plc("a"));
        // Discovery first: it names the state.
        assert_eq!(all(&mut retained), ["ha/a/1=", "ha/a/2=", "a/state="]);
        retained.acknowledged("ha/a/1");
        // The connection is lost before the others are acknowledged.
        retained.queue_all();
        assert_eq!(all(&mut retained), ["b/state=s", "ha/a/2=", "ha/b/1=1", "ha/b/2=2", "a/state="]);
        ["ha/a/2", "a/state"].into_iter().for_each(|topic| retained.acknowledged(topic));
        retained.queue_all();
        assert_eq!(all(&mut retained), ["b/state=s", "ha/b/1=1", "ha/b/2=2"]);
    }

    #[test]
    fn a_tag_that_goes_is_cleared_and_one_that_comes_back_is_not() {
        let mut retained = Retained::default();
        let one = |n: u32| (format!("ha/{n}"), Bytes::from(n.to_string()));
        retained.replace(&plc("a"), Priority::Between, vec![one(1), one(2)]);
        all(&mut retained);
        retained.replace(&plc("a"), Priority::Between, vec![one(2), one(3)]);
        assert_eq!(all(&mut retained), ["ha/1=", "ha/3=3"]);
        // Back before the broker has acknowledged the clearing.
        retained.replace(&plc("a"), Priority::Between, vec![one(1), one(2), one(3)]);
        retained.acknowledged("ha/1");
        assert!(retained.is_wanted("ha/1"));
        assert_eq!(all(&mut retained), ["ha/1=1"]);
    }

    #[test]
    fn a_plc_that_goes_to_another_member_keeps_its_messages() {
        let mut retained = Retained::default();
        let state = |retained: &mut Retained, text: &'static str| {
            retained.set("a/state".to_owned(), text.into(), Priority::First, Some(&plc("a")))
        };
        state(&mut retained, "on");
        retained.replace(&plc("a"), Priority::Between, vec![("ha/a/1".to_owned(), "1".into())]);
        retained.forget_owner(&plc("a"));
        assert_eq!(all(&mut retained), [""; 0]);
        retained.queue_all();
        assert_eq!(all(&mut retained), [""; 0]);

        // One that was lost is announced as offline, once.
        state(&mut retained, "on");
        retained.forget_owner(&plc("a"));
        retained.announce("a/state".to_owned(), "off".into());
        assert_eq!(all(&mut retained), ["a/state=off"]);
        retained.queue_wanted(Priority::First);
        assert_eq!(all(&mut retained), ["a/state=off"]);
        retained.acknowledged("a/state");
        retained.queue_wanted(Priority::First);
        assert_eq!(all(&mut retained), [""; 0]);

        // Not on the next connection: another member may have published its state by then.
        retained.announce("a/state".to_owned(), "off".into());
        retained.queue_all();
        assert_eq!(all(&mut retained), [""; 0]);
        // It comes back.
        retained.announce("a/state".to_owned(), "off".into());
        assert!(state(&mut retained, "on"));
        retained.queue_all();
        assert_eq!(all(&mut retained), ["a/state=on"]);
    }

    #[test]
    fn messages_of_an_earlier_run_are_cleared() {
        let mut retained = Retained::default();
        assert!(!retained.is_wanted("old/state"));
        retained.clear("old/state".to_owned());
        assert_eq!(all(&mut retained), ["old/state="]);
        retained.acknowledged("old/state");
        retained.queue_all();
        assert_eq!(all(&mut retained), [""; 0]);
    }
}
