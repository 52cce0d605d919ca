//! The oracle: judges each request that a PLC has had by the token of its sender.
//!
//! A connection belongs to the newest ownership of its link that a session of its process had when it was made. A
//! request is *stale* if it came after one of a newer ownership, and *late* if it came after the store had an entry
//! that ends its ownership. Both must not be. Times that overlap are no order: then the request counts as good.

mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::plcs::{Connection, Record};
use super::recorder::{Entry, Token};

/// The longest list of faults.
const SHOWN: usize = 20;

/// The ownerships and the requests of one link.
#[derive(Debug, Default)]
struct Link {
    entries: BTreeMap<Token, Entry>,
    /// The end of the time in which the first request of an ownership came.
    first: BTreeMap<Token, Instant>,
    last_arrival: Option<Instant>,
}

/// Figures of the requests.
#[derive(Clone, Debug, Default)]
pub(crate) struct Judged {
    pub(crate) requests: u64,
    pub(crate) connections: u64,
    /// Ownerships in the store.
    pub(crate) ownerships: u64,
    /// Ownerships under which a request was sent.
    pub(crate) used: u64,
    pub(crate) stale: u64,
    pub(crate) late: u64,
    /// Requests of a process that had no ownership of the link at any time before.
    pub(crate) unowned: u64,
    /// Connections whose process was not found: it closed them at once.
    pub(crate) unknown: u64,
    /// Connections whose process was found by its end.
    pub(crate) by_end: u64,
    pub(crate) faults: Vec<String>,
}

/// The oracle.
#[derive(Debug)]
pub(crate) struct Oracle {
    names: Vec<String>,
    links: Vec<Link>,
    tokens: BTreeMap<usize, Option<Token>>,
    known: BTreeSet<usize>,
    /// The longest time without a request to a link.
    pub(crate) gap: Duration,
    pub(crate) judged: Judged,
}

impl Oracle {
    pub(crate) fn new(names: Vec<String>) -> Self {
        let links = names.iter().map(|_| Link::default()).collect();
        Self {
            names,
            links,
            tokens: BTreeMap::new(),
            known: BTreeSet::new(),
            gap: Duration::ZERO,
            judged: Judged::default(),
        }
    }

    /// Adds entries of the store. Those before the connections of the next [`judge`](Self::judge) must be there.
    pub(crate) fn add(&mut self, entries: Vec<Entry>) {
        for entry in entries {
            let Some(link) = self.names.iter().position(|name| *name == entry.link) else { continue };
            let known = self.links[link].entries.get(&entry.token);
            self.judged.ownerships += u64::from(known.is_none() && !entry.session.is_empty());
            // Of two with different times, the one with the exact time.
            if known.is_none_or(|known| known.after < known.stored) {
                self.links[link].entries.insert(entry.token, entry);
            }
        }
    }

    /// Judges arrivals. `sessions`: the processes of all sessions; `ended_at`: the process that ended at a time.
    pub(crate) fn judge(
        &mut self,
        record: &Record,
        sessions: &BTreeMap<String, usize>,
        ended_at: impl Fn(Instant) -> Option<usize>,
    ) {
        for arrival in &record.arrivals {
            let Some(mut connection) = record.connections.get(&arrival.connection).copied() else { continue };
            self.judged.requests += 1;
            if self.known.insert(arrival.connection) {
                self.judged.connections += 1;
                if connection.process.is_none() {
                    connection.process = ended_at(connection.accepted);
                    self.judged.by_end += u64::from(connection.process.is_some());
                }
                let token = self.links[connection.link].token(&connection, sessions);
                self.tokens.insert(arrival.connection, token);
                self.judged.unknown += u64::from(connection.process.is_none());
            }
            let token = self.tokens.get(&arrival.connection).copied().flatten();
            let link = &mut self.links[connection.link];
            let gap = link.last_arrival.replace(arrival.before).map(|last| arrival.before - last);
            self.gap = self.gap.max(gap.unwrap_or_default());
            let Some(token) = token else {
                self.judged.unowned += 1;
                let entries = self.links[connection.link].history(connection.accepted, sessions);
                let name = &self.names[connection.link];
                let process = connection.process;
                self.tell(format!("{name}: a request of {process:?} without an ownership; the link has {entries}"));
                continue;
            };
            let used = &mut self.judged.used;
            link.first.entry(token).or_insert_with(|| {
                *used += 1;
                arrival.before
            });
            let newer = (std::ops::Bound::Excluded(token), std::ops::Bound::Unbounded);
            let stale = link.first.range(newer).find(|(_, first)| **first < arrival.after);
            let late = link.entries.range(newer).find(|(_, entry)| entry.stored < arrival.after);
            let text = match (stale, late) {
                (Some((newer, first)), _) => {
                    self.judged.stale += 1;
                    format!("stale: {:?} after the first request of {newer:?}", arrival.after - *first)
                }
                (None, Some((newer, Entry { session, stored, .. }))) => {
                    self.judged.late += 1;
                    format!("late: {:?} after {newer:?} ({session:?}) was stored", arrival.after - *stored)
                }
                (None, None) => continue,
            };
            let entries = self.links[connection.link].history(arrival.before, sessions);
            let name = &self.names[connection.link];
            let process = connection.process;
            self.tell(format!("{name}: request of {token:?}, process {process:?}, {text}; the link has {entries}"));
        }
    }

    /// The processes that own the links by the newest entries.
    pub(crate) fn owners(&self, sessions: &BTreeMap<String, usize>) -> Vec<Option<usize>> {
        let owner = |link: &Link| sessions.get(&link.entries.last_key_value()?.1.session).copied();
        self.links.iter().map(owner).collect()
    }

    fn tell(&mut self, fault: String) {
        if self.judged.faults.len() < SHOWN {
            self.judged.faults.push(fault);
        }
    }
}

impl Link {
    /// The newest ownership of the process of a connection when it was made. One of an unknown process counts as one
    /// of the newest owner.
    fn token(&self, connection: &Connection, sessions: &BTreeMap<String, usize>) -> Option<Token> {
        let is_of = |session: &String| match connection.process {
            Some(process) => sessions.get(session) == Some(&process),
            None => !session.is_empty(),
        };
        let is_own = |entry: &Entry| entry.after <= connection.accepted && is_of(&entry.session);
        let mut own = self.entries.iter().rev().filter(|(_, entry)| is_own(entry));
        own.next().map(|(token, _)| *token)
    }
}

impl Link {
    /// The last entries with their processes, and their times after another time.
    fn history(&self, time: Instant, sessions: &BTreeMap<String, usize>) -> String {
        let entry = |(token, Entry { session, stored, .. }): (&Token, &Entry)| {
            let process = sessions.get(session);
            let after = stored.saturating_duration_since(time).as_secs_f64() - (time - *stored).as_secs_f64();
            format!("{}.{} of {process:?} at {:+.1} ms", token.epoch, token.revision, after * 1e3)
        };
        self.entries.iter().rev().take(4).map(entry).collect::<Vec<_>>().join(", ")
    }
}

impl Judged {
    /// Requests that must not have been.
    pub(crate) fn wrong(&self) -> u64 {
        self.stale + self.late + self.unowned
    }
}
