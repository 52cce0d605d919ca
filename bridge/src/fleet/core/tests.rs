//! Each rule of the protocol, with one member and a store that the test plays.

mod links;
mod members;
mod session;
mod store;

use super::*;
use crate::fleet::keys::{DEAD, SessionValue};
use crate::fleet::{LinkSpec, LinkToken, Reach};

const L: Nanos = 3_000_000_000;

/// A member, and what it has asked for.
struct Bench {
    core: Core,
    now: Nanos,
    requests: Vec<(u64, Operation)>,
    actions: Vec<Action>,
    revision: u64,
}

impl Bench {
    fn new(links: &[&str]) -> Self {
        Self::with(links.iter().map(|id| LinkSpec { id: (*id).into(), reach: Reach::All }).collect())
    }

    fn with(links: Vec<LinkSpec>) -> Self {
        let settings = Settings { lease: L, process: "me".to_owned(), max_requests: 4 };
        let core = Core::new(settings, member());
        let mut bench = Self { core, now: L, requests: Vec::new(), actions: Vec::new(), revision: 100 };
        bench.feed(Input::Configure { member: member(), links });
        bench
    }

    /// With a view that has these entries, and a session that was just created.
    fn active(links: &[&str], entries: &[(&str, &str)]) -> Self {
        let mut bench = Self::new(links);
        bench.connect(entries);
        bench.create();
        bench
    }

    fn feed(&mut self, input: Input) {
        self.core.handle(self.now, input);
        while let Some(action) = self.core.next_action() {
            match action {
                Action::Request { request, operation, timeout } => {
                    assert_eq!(timeout, L / 4);
                    self.requests.push((request, operation));
                }
                Action::Gate { .. }
                | Action::Own { .. }
                | Action::Close { .. }
                | Action::Reconnect
                | Action::Warn(_)
                | Action::Fail(_)
                | Action::Left => self.actions.push(action),
            }
        }
    }

    fn connect(&mut self, entries: &[(&str, &str)]) {
        let last_revision = self.revision + u64::try_from(entries.len()).unwrap();
        self.feed(Input::Connected { created: 7, last_revision });
        for (key, value) in entries {
            self.see(key, value);
        }
        self.feed(Input::Complete);
    }

    /// Connects again, with the entries at the revisions that they have.
    fn reconnect(&mut self, last_revision: u64, entries: &[(&str, &str, u64)]) {
        self.feed(Input::Connected { created: 7, last_revision });
        for (key, value, revision) in entries {
            self.feed(Input::Entry { key: (*key).to_owned(), value: Some((*value).to_owned()), revision: *revision });
        }
        self.feed(Input::Complete);
    }

    /// The watch shows a new entry. Returns its revision.
    fn see(&mut self, key: &str, value: &str) -> u64 {
        self.revision += 1;
        let (key, value, revision) = (key.to_owned(), Some(value.to_owned()), self.revision);
        self.feed(Input::Entry { key, value, revision });
        revision
    }

    /// Creates or renews the session. Returns its revision.
    fn create(&mut self) -> u64 {
        let (request, _) = self.put("w.me-");
        self.store(request)
    }

    /// The next request, which stores a key that begins so.
    fn put(&mut self, start: &str) -> (u64, Operation) {
        let is_it = |(_, operation): &(u64, Operation)| match operation {
            Operation::Put { key, .. } => key.starts_with(start),
            Operation::Get { .. } | Operation::Purge { .. } => false,
        };
        let index = self.requests.iter().position(is_it);
        self.requests.remove(index.unwrap_or_else(|| panic!("no {start} in {:?}", self.requests)))
    }

    fn store(&mut self, request: u64) -> u64 {
        self.revision += 1;
        let revision = self.revision;
        self.reply(request, Outcome::Stored(revision));
        revision
    }

    fn reply(&mut self, request: u64, outcome: Outcome) {
        self.feed(Input::Reply { request, outcome });
    }

    /// Lets time pass, with the timers of the core, while its renewals are stored.
    fn pass(&mut self, time: Nanos) {
        let end = self.now + time;
        loop {
            let next = self.core.wake_at().filter(|at| *at <= end);
            self.now = next.unwrap_or(end).max(self.now + u64::from(next.is_some()));
            self.feed(Input::Tick);
            while self.requests.iter().any(|(_, operation)| is_renewal(operation)) {
                self.create();
            }
            if next.is_none() {
                break;
            }
        }
    }

    /// Lets time pass, and leaves all requests.
    fn wait(&mut self, time: Nanos) {
        self.now += time;
        self.feed(Input::Tick);
    }

    fn take_actions(&mut self) -> Vec<Action> {
        std::mem::take(&mut self.actions)
    }

    /// Owns a link of a free entry that comes now. Returns the token.
    fn own(&mut self, link: &str) -> LinkToken {
        self.see(&format!("l.{link}"), "");
        let (request, _) = self.put(&format!("l.{link}"));
        let token = LinkToken { store: 7, revision: self.store(request) };
        let session = self.core.session_name().cloned();
        let owns = Action::Own { link: link.into(), token, session };
        assert!(self.take_actions().contains(&owns), "{link}");
        token
    }

    fn open_until(&self) -> Nanos {
        self.core.open_until(self.now)
    }
}

fn member() -> Member {
    Member { id: "hall-1".into(), version: "1".to_owned(), config: "c".to_owned(), weight: 1 }
}

fn is_renewal(operation: &Operation) -> bool {
    matches!(operation, Operation::Put { key, value, .. } if key.starts_with("w.me-") && value != DEAD)
}

fn session(member: &str, change: impl FnOnce(&mut SessionValue)) -> String {
    let mut value = SessionValue {
        member: member.into(),
        version: "1".to_owned(),
        config: "c".to_owned(),
        weight: 1,
        draining: false,
        lease_ms: 3000,
        beat: 1,
    };
    change(&mut value);
    value.to_json()
}

fn other() -> String {
    session("hall-2", |_| {})
}

fn put(key: &str, value: &str, expected: u64) -> Operation {
    Operation::Put { key: key.to_owned(), value: value.to_owned(), expected }
}

/// Links whose targets are these, among both members.
fn links_of(member: &str, count: usize) -> Vec<String> {
    let candidate = |member| crate::fleet::placement::Candidate { member, weight: 1, session: member };
    let all = (0..).map(|n| format!("plc{n}"));
    let is_its = |link: &String| {
        let candidates = [candidate("hall-1"), candidate("hall-2")];
        crate::fleet::placement::target(link, candidates).is_some_and(|target| target.member == member)
    };
    all.filter(is_its).take(count).collect()
}
