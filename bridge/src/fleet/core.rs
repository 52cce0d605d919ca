//! The protocol of one member of a fleet. No I/O, and no clock.
//!
//! The driver hands in [`Input`]s with the time, performs the [`Action`]s, and calls again at [`Core::wake_at`].
//! The time is that of `CLOCK_BOOTTIME` of this machine in nanoseconds; clocks of different machines are never
//! compared.
//!
//! ```text
//!                    Connected, entries, Complete            created
//!   no view ──────────────────────────────────────▶ joining ─────────▶ active ──Leave──▶ leaving ──▶ left
//!      ▲                                               ▲                 │
//!      └────────────── Disconnected ───────────────────┼─────────────────┤ (the session goes on)
//!                                                      └──── fenced ─────┘ (a new session)
//!   any ── the store was deleted or set back ──▶ failed, for good
//!
//!   link:  free ──▶ taking ──▶ owned ──▶ closing ──▶ releasing ──▶ free
//!                                │          ▲
//!                                └── lost ──┘ (then not released)
//! ```
//!
//! Rules, with `L` for the lease:
//! 1. A session is created, then renewed each `L/3` by compare-and-set. Its gates are open until the time **before
//!    the sending** of the last renewal that was stored, plus 0.9 `L`.
//! 2. A session that this member has seen unchanged for `L` is fenced: compare-and-set to `dead`. Its links are
//!    taken only after that.
//! 3. A link is taken by compare-and-set; the new revision is the token. It is released by closing it, and then by
//!    compare-and-set to empty. A link or session without an entry must be seen to have none for `L`.
//! 4. After a renewal with an unknown result the entry is read. Its revision is adopted if this member wrote it. That
//!    alone moves no deadline: the next renewal does.
//! 5. **A view that is younger than `L` proves nothing about the past**: the store may have been set back before
//!    the connection was made, to a time at which a link had no owner, or another one. So an entry that the
//!    view began with counts only after `L`, and only an entry that comes later counts at once. A session whose gates
//!    have closed when a connection is made ends: its links may have had another owner. A release with an
//!    unknown result that was sent over an earlier connection is not sent again before `L`.
//! 6. A store with another creation time, or with revisions below those seen before, is not the store of this fleet
//!    any more: the member stops for good. It never makes a store.
//!
//! Invariants:
//! - Two sessions never own a link at overlapping times of open gates. If `p` is the largest relative error of the
//!   clocks' rates, this needs `0.9 (1 + p) <= 1 - p`, so `p` of at most 5.2 %. The rest of the tenth of the lease is
//!   for the way of a request from the gate to the PLC.
//! - A link has one [`Action::Own`], then one [`Action::Close`], then one [`Input::Closed`], and so on.
//! - Each request has one reply that counts; there are at most `max_requests` for links, one for the own session,
//!   and one for each other session at a time.
//! - No key is polled: all decisions follow from the watch, replies and timers.

mod interface;
mod links;
mod members;
mod requests;
mod session;
#[cfg(test)]
mod tests;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

pub(super) use self::interface::{Action, Input, Nanos, Operation, Outcome, Settings};
pub use self::interface::{Member, StoreFault};
use self::links::Link;
use self::members::Seen;
use self::requests::Pending;
use self::session::Session;
use super::keys::{DRAIN, Key};
use super::{FleetStatus, MemberState};

/// The links that are given to other members at once, and not taken by them yet. Each of them is without a
/// master meanwhile.
const MAX_HANDED: usize = 64;

/// The protocol of one member.
#[derive(Debug)]
pub(super) struct Core {
    settings: Settings,
    member: Member,
    /// The creation time of the store, once it was seen.
    store: Option<u64>,
    /// The present view of the store.
    view: Option<View>,
    /// The highest revision that was seen.
    max_revision: u64,
    session: Option<Session>,
    /// The sessions that this process has had.
    joins: u64,
    /// The next session is made after this time.
    join_after: Nanos,
    /// Other sessions.
    sessions: BTreeMap<Arc<str>, Seen>,
    /// All links of the configuration, and all that have an entry.
    links: BTreeMap<Arc<str>, Link>,
    overrides: BTreeMap<String, String>,
    drains: BTreeSet<String>,
    /// The longest lease of all sessions that are alive.
    longest_lease: Nanos,
    /// `true`: the targets of links must be computed again.
    is_placement_old: bool,
    /// Links to decide about.
    review: BTreeSet<Arc<str>>,
    /// Links that wait until fewer are being released.
    waiting: BTreeSet<Arc<str>>,
    /// Links that are being closed in order to release them, or released.
    releasing: BTreeSet<Arc<str>>,
    /// Links that were given to another member, which has not taken them yet, and since when.
    handed: BTreeMap<Arc<str>, Nanos>,
    timers: BinaryHeap<Reverse<(Nanos, Timer)>>,
    pending: HashMap<u64, Pending>,
    /// The pending requests for links.
    link_requests: usize,
    next_request: u64,
    actions: VecDeque<Action>,
    /// `true` if the gate was open at the last call.
    was_open: bool,
    /// The naive variant of rule 1: the gates are open from the reply on.
    #[cfg(test)]
    counts_from_reply: bool,
    is_missing: bool,
    is_leaving: bool,
    has_left: bool,
    failure: Option<StoreFault>,
}

/// A view of the store: that of one watch of one connection.
#[derive(Debug)]
struct View {
    /// The time at which it began.
    since: Nanos,
    /// The last revision when it began. Later ones are news.
    last_revision: u64,
    is_complete: bool,
}

/// A time at which something is due.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Timer {
    Link(Arc<str>),
    Session(Arc<str>),
}

impl Core {
    pub(super) fn new(settings: Settings, member: Member) -> Self {
        let longest_lease = settings.lease;
        Self {
            settings,
            member,
            store: None,
            view: None,
            max_revision: 0,
            session: None,
            joins: 0,
            join_after: 0,
            sessions: BTreeMap::new(),
            links: BTreeMap::new(),
            overrides: BTreeMap::new(),
            drains: BTreeSet::new(),
            longest_lease,
            is_placement_old: false,
            review: BTreeSet::new(),
            waiting: BTreeSet::new(),
            releasing: BTreeSet::new(),
            handed: BTreeMap::new(),
            timers: BinaryHeap::new(),
            pending: HashMap::new(),
            link_requests: 0,
            next_request: 0,
            actions: VecDeque::new(),
            was_open: false,
            #[cfg(test)]
            counts_from_reply: false,
            is_missing: false,
            is_leaving: false,
            has_left: false,
            failure: None,
        }
    }

    /// Breaks rule 1: the simulation must find that.
    #[cfg(test)]
    pub(super) fn count_from_reply(&mut self) {
        self.counts_from_reply = true;
    }

    /// Handles an input at a time, which never goes back.
    pub(super) fn handle(&mut self, now: Nanos, input: Input) {
        let is_over = self.failure.is_some() || self.has_left;
        if is_over && !matches!(input, Input::Closed { .. }) {
            return;
        }
        match input {
            Input::Closed { link, token } => self.link_closed(&link, token),
            Input::Configure { member, links } => self.configure(now, member, links),
            Input::Leave => self.leave(),
            Input::Connected { created, last_revision } => self.connected(now, created, last_revision),
            Input::Entry { key, value, revision } => self.entry(now, &key, value.as_deref(), revision),
            Input::Complete => self.complete(now),
            Input::Disconnected => self.disconnected(),
            Input::StoreMissing => self.store_missing(),
            Input::Reply { request, outcome } => self.replied(now, request, outcome),
            Input::Tick => {}
        }
        self.advance(now);
    }

    /// The next action, in their order.
    pub(super) fn next_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// The time at which the core is to be called without an input.
    pub(super) fn wake_at(&self) -> Option<Nanos> {
        if self.failure.is_some() || self.has_left {
            return None;
        }
        let timer = self.timers.peek().map(|Reverse((at, _))| *at);
        [timer, self.session_due()].into_iter().flatten().min()
    }

    /// The state of this member.
    pub(super) fn state(&self) -> MemberState {
        if let Some(failure) = &self.failure {
            return MemberState::Failed(failure.to_string());
        }
        let is_created = self.session.as_ref().is_some_and(|session| session.is_created);
        match &self.view {
            _ if self.has_left => MemberState::Left,
            None => MemberState::Connecting,
            Some(view) if !view.is_complete => MemberState::Connecting,
            Some(_) if !is_created => MemberState::Joining,
            Some(_) if self.is_draining() => MemberState::Draining,
            Some(_) => MemberState::Active,
        }
    }

    /// All that follows from the time and from changes of state.
    fn advance(&mut self, now: Nanos) {
        if self.failure.is_some() || self.has_left {
            return;
        }
        self.update_gate(now);
        while self.timers.peek().is_some_and(|Reverse((at, _))| *at <= now) {
            match self.timers.pop() {
                Some(Reverse((at, Timer::Link(link)))) => self.link_due(link, at),
                Some(Reverse((_, Timer::Session(session)))) => self.session_timer(now, &session),
                None => break,
            }
        }
        if self.is_placement_old && self.is_complete() {
            self.place();
        }
        self.review_links(now);
        self.drive_session(now);
    }

    fn connected(&mut self, now: Nanos, created: u64, last_revision: u64) {
        self.disconnected();
        let before = *self.store.get_or_insert(created);
        if before != created {
            return self.fail(StoreFault::Recreated { before, now: created });
        }
        if last_revision < self.max_revision {
            let before = self.max_revision;
            return self.fail(StoreFault::SetBack { what: "it".to_owned(), before, now: last_revision });
        }
        self.is_missing = false;
        self.max_revision = last_revision;
        self.view = Some(View { since: now, last_revision, is_complete: false });
        self.session_connected(now);
        self.sessions.values_mut().for_each(|seen| seen.is_confirmed = false);
        for link in self.links.values_mut() {
            link.connected(now);
        }
        self.overrides.clear();
        self.drains.clear();
    }

    fn entry(&mut self, now: Nanos, key: &str, value: Option<&str>, revision: u64) {
        // An entry of a view that has ended.
        let Some(view) = &self.view else { return };
        let is_news = revision > view.last_revision;
        self.max_revision = self.max_revision.max(revision);
        match Key::parse(key) {
            Some(Key::Session(name)) => self.session_entry(now, name, value, revision, is_news),
            Some(Key::Link(name)) => self.link_entry(now, name, value, revision, is_news),
            Some(Key::Override(link)) => {
                match value.filter(|member| !member.is_empty()) {
                    Some(member) => self.overrides.insert(link.to_owned(), member.to_owned()),
                    None => self.overrides.remove(link),
                };
                self.is_placement_old = true;
            }
            Some(Key::Drain(member)) => {
                if value == Some(DRAIN) {
                    self.drains.insert(member.to_owned());
                } else {
                    self.drains.remove(member);
                }
                self.is_placement_old = true;
                self.renew_if_changed();
            }
            None => {}
        }
    }

    fn complete(&mut self, now: Nanos) {
        let Some(view) = &mut self.view else { return };
        view.is_complete = true;
        // Entries of links that left the configuration may be removed by hand.
        self.links.retain(|_, link| link.is_needed() || !link.has_vanished());
        if let Some(vanished) = self.links.values().find(|link| link.has_vanished()) {
            let what = Key::Link(&vanished.id).text();
            let before = vanished.revision();
            return self.fail(StoreFault::SetBack { what, before, now: 0 });
        }
        // They were purged after their end.
        self.sessions.retain(|_, seen| seen.is_confirmed);
        self.session_complete(now);
        self.is_placement_old = true;
        self.renew_if_changed();
    }

    fn disconnected(&mut self) {
        self.view = None;
        let pending = std::mem::take(&mut self.pending);
        for pending in pending.into_values() {
            self.forget(&pending);
        }
        self.link_requests = 0;
        if self.is_leaving {
            self.review_all();
        }
    }

    fn store_missing(&mut self) {
        self.disconnected();
        if !self.is_missing {
            self.is_missing = true;
            self.actions.push_back(Action::Warn(
                "the store does not exist: this bridge sends nothing until it is back".to_owned(),
            ));
        }
        self.end_session();
    }

    /// Stops for good.
    fn fail(&mut self, fault: StoreFault) {
        self.disconnected();
        self.end_session();
        self.failure = Some(fault.clone());
        self.actions.push_back(Action::Fail(fault));
    }

    fn leave(&mut self) {
        self.is_leaving = true;
        self.is_placement_old = true;
        self.renew_if_changed();
        self.review_all();
    }

    /// The state of the fleet, as this member sees it.
    pub(super) fn status(&self, now: Nanos) -> FleetStatus {
        let open_until = self.open_until(now);
        FleetStatus {
            id: self.member.id.clone(),
            state: self.state(),
            open_for: (open_until > now).then(|| Duration::from_nanos(open_until - now)),
            members: self.member_statuses(now),
            links: self.link_statuses(now),
            warnings: self.warnings(),
        }
    }

    /// The state of the fleet for an observer: one that has a view which is not complete, and so joins nothing.
    pub(super) fn observe(&mut self, now: Nanos) -> FleetStatus {
        self.place();
        self.status(now)
    }

    fn is_complete(&self) -> bool {
        self.view.as_ref().is_some_and(|view| view.is_complete)
    }

    /// Returns whether the gate is open, and the view is that of a connection.
    fn may_act(&self, now: Nanos) -> bool {
        self.is_complete() && self.open_until(now) > now
    }

    fn is_draining(&self) -> bool {
        self.is_leaving || self.drains.contains(&*self.member.id)
    }
}
