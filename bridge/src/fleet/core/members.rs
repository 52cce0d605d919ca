//! The other sessions: seen, fenced and purged; and the members that can own links.

use std::sync::Arc;

use super::requests::Purpose;
use super::{Core, Nanos, Operation, Outcome, StoreFault, Timer};
use crate::fleet::keys::{DEAD, Key, SessionValue};
use crate::fleet::placement::{self, Candidate};
use crate::fleet::{Reach, status::MemberStatus};

/// A dead session is purged after this number of leases, if no link names it any more.
const PURGE_AFTER: u64 = 4;
/// A session that was not purged by then is forgotten, and shows up again with the next view.
const FORGET_AFTER: u64 = 8;

/// A session of another process, or an earlier one of this.
#[derive(Debug)]
pub(super) struct Seen {
    pub(super) state: SeenState,
    revision: u64,
    /// The time at which this view first had this revision.
    pub(super) since: Nanos,
    /// The value of a living session, if this version understands it.
    value: Option<SessionValue>,
    /// `true` if the present view has it.
    pub(super) is_confirmed: bool,
    /// `true` while it is being fenced.
    is_fencing: bool,
    is_timer_set: bool,
    is_purged: bool,
}

/// The state of another session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SeenState {
    Alive,
    /// It has ended, and cannot come back.
    Dead,
    /// Its entry was deleted.
    Gone,
}

/// A member that can own links.
#[derive(Clone, Debug)]
pub(super) struct Peer {
    pub(super) member: Arc<str>,
    pub(super) weight: u32,
    pub(super) session: Arc<str>,
}

impl Core {
    pub(super) fn session_entry(&mut self, now: Nanos, name: &str, value: Option<&str>, revision: u64, is_news: bool) {
        if self.session.as_ref().is_some_and(|session| *session.name == *name) {
            return self.own_entry(now, value, revision, is_news);
        }
        let name: Arc<str> = name.into();
        let known = self.sessions.get(&name).map_or(0, |seen| seen.revision);
        if revision < known {
            if is_news {
                // The result of a request of this member was faster.
                return;
            }
            let seen = self.sessions.get_mut(&name).filter(|seen| seen.state != SeenState::Alive);
            let Some(seen) = seen else {
                let what = Key::Session(&name).text();
                return self.fail(StoreFault::SetBack { what, before: known, now: revision });
            };
            // A session that has ended was removed, and nats-server 2.15 was killed: then the entry before the last one
            // is back. It is fenced and removed again: other members may not know that it has ended.
            // The timer of its removal comes too late for that.
            (seen.is_purged, seen.is_timer_set) = (false, false);
        }
        let state = match value {
            None => SeenState::Gone,
            Some(DEAD) => SeenState::Dead,
            Some(_) => SeenState::Alive,
        };
        let value = value.and_then(SessionValue::parse);
        let seen = self.sessions.entry(name.clone()).or_insert_with(|| Seen::new(now));
        if revision == known && seen.is_confirmed {
            // The result of a request of this member was faster.
            return;
        }
        let is_changed = match (&seen.value, &value) {
            (Some(before), Some(after)) => before.differs_from(after),
            (None, None) => false,
            (None, Some(_)) | (Some(_), None) => true,
        };
        self.is_placement_old |= is_changed || seen.state != state || known == 0;
        (seen.state, seen.value, seen.revision, seen.since) = (state, value, revision, now);
        seen.is_confirmed = true;
        self.set_session_timer(&name);
    }

    /// Notes that a session has ended.
    pub(super) fn note_dead(&mut self, now: Nanos, name: Arc<str>, revision: u64) {
        let seen = self.sessions.entry(name.clone()).or_insert_with(|| Seen::new(now));
        (seen.state, seen.value, seen.revision, seen.since) = (SeenState::Dead, None, revision, now);
        seen.is_confirmed = true;
        self.is_placement_old = true;
        self.set_session_timer(&name);
    }

    /// Sets the timer of a session, unless there is one: it fires early if the session was renewed meanwhile.
    fn set_session_timer(&mut self, name: &Arc<str>) {
        let own_lease = self.settings.lease;
        let Some(seen) = self.sessions.get_mut(name).filter(|seen| !seen.is_timer_set) else { return };
        seen.is_timer_set = true;
        let due = match seen.state {
            SeenState::Alive => seen.since.saturating_add(seen.lease(own_lease)),
            SeenState::Dead | SeenState::Gone => seen.since.saturating_add(own_lease * PURGE_AFTER),
        };
        self.set_timer(due, Timer::Session(name.clone()));
    }

    /// Sets the timers of sessions that could not be fenced while the gate was closed.
    pub(super) fn check_sessions(&mut self, now: Nanos) {
        let names: Vec<_> = self.sessions.keys().cloned().collect();
        for name in names {
            self.fence_if_silent(now, &name);
        }
    }

    pub(super) fn session_timer(&mut self, now: Nanos, name: &Arc<str>) {
        let lease = self.settings.lease;
        let Some(seen) = self.sessions.get_mut(name) else { return };
        seen.is_timer_set = false;
        match seen.state {
            SeenState::Alive => {
                let due = seen.since.saturating_add(seen.lease(lease));
                if due > now {
                    self.set_session_timer(name);
                } else {
                    self.fence_if_silent(now, name);
                }
            }
            SeenState::Dead | SeenState::Gone => {
                let age = now.saturating_sub(seen.since);
                if age < lease * PURGE_AFTER {
                    self.set_session_timer(name);
                } else {
                    self.purge_if_unused(now, name, age >= lease * FORGET_AFTER);
                }
            }
        }
    }

    /// Fences a session that has not been renewed for a lease. Only a member that renews its own one does.
    fn fence_if_silent(&mut self, now: Nanos, name: &Arc<str>) {
        let (may_act, lease) = (self.may_act(now), self.settings.lease);
        let Some(seen) = self.sessions.get_mut(name) else { return };
        let is_silent = now >= seen.since.saturating_add(seen.lease(lease));
        if !may_act || !is_silent || seen.state != SeenState::Alive || seen.is_fencing {
            return;
        }
        seen.is_fencing = true;
        let (key, expected) = (Key::Session(name).text(), seen.revision);
        let operation = Operation::Put { key, value: DEAD.to_owned(), expected };
        self.request(now, Purpose::Fence { session: name.clone() }, operation);
    }

    pub(super) fn fenced_other(&mut self, now: Nanos, name: &Arc<str>, outcome: &Outcome) {
        let retry = self.settings.lease / 8;
        let Some(seen) = self.sessions.get_mut(name) else { return };
        seen.is_fencing = false;
        match outcome {
            Outcome::Stored(revision) if *revision > seen.revision => {
                self.note_dead(now, name.clone(), *revision);
            }
            Outcome::Stored(_) => {}
            // The watch will tell why, unless the request was delayed.
            Outcome::WrongRevision | Outcome::Unknown => {
                if !seen.is_timer_set {
                    seen.is_timer_set = true;
                    self.set_timer(now.saturating_add(retry), Timer::Session(name.clone()));
                }
            }
            Outcome::Found { .. } | Outcome::Missing | Outcome::Purged => {}
        }
    }

    pub(super) fn fence_forgotten(&mut self, name: &Arc<str>) {
        if let Some(seen) = self.sessions.get_mut(name) {
            seen.is_fencing = false;
        }
    }

    /// Removes a dead session that no link names. One member does that in the store.
    fn purge_if_unused(&mut self, now: Nanos, name: &Arc<str>, is_old: bool) {
        let is_used = self.links.values().any(|link| link.is_of(name));
        let is_mine = {
            let peers = self.peers();
            let target = placement::target(name, peers.iter().map(Peer::candidate));
            target.is_some_and(|target| self.session_name().is_some_and(|own| **own == *target.session))
        };
        let may_act = self.may_act(now);
        let Some(seen) = self.sessions.get_mut(name) else { return };
        let (is_dead, revision) = (seen.state == SeenState::Dead, seen.revision);
        let is_due = is_dead && !is_used && is_mine && may_act && !seen.is_purged;
        if is_old && !is_used && !is_due {
            self.sessions.remove(name);
            return;
        }
        seen.is_purged |= is_due;
        seen.is_timer_set = true;
        self.set_timer(now.saturating_add(self.settings.lease * PURGE_AFTER), Timer::Session(name.clone()));
        if is_due {
            let operation = Operation::Purge { key: Key::Session(name).text(), revision };
            self.request(now, Purpose::Purge, operation);
        }
    }

    /// The name of the own session.
    pub(in crate::fleet) fn session_name(&self) -> Option<&Arc<str>> {
        self.session.as_ref().map(|session| &session.name)
    }

    /// The members that can own links: those that live, are not drained, and have the configuration of this one.
    pub(super) fn peers(&self) -> Vec<Peer> {
        let others = self.sessions.iter().filter_map(|(session, seen)| {
            let value = seen.value.as_ref()?;
            let can_own = !value.draining && !self.drains.contains(&value.member) && value.config == self.member.config;
            let peer = || Peer { member: value.member.as_str().into(), weight: value.weight, session: session.clone() };
            (seen.state == SeenState::Alive && can_own).then(peer)
        });
        let own = self.session.as_ref().filter(|session| session.is_created && !self.is_draining());
        let own = own.map(|session| Peer {
            member: self.member.id.clone(),
            weight: self.member.weight,
            session: session.name.clone(),
        });
        others.chain(own).collect()
    }

    /// Returns whether a session was renewed lately, so that links may be given to it.
    pub(super) fn is_punctual(&self, now: Nanos, session: &str) -> bool {
        let lease = self.settings.lease;
        let seen = self.sessions.get(session).filter(|seen| seen.state == SeenState::Alive);
        seen.is_some_and(|seen| now < seen.since.saturating_add(seen.lease(lease) / 3 * 2))
    }

    /// The longest lease of all that live.
    pub(super) fn find_longest_lease(&self) -> Nanos {
        let others = self.sessions.values().filter_map(|seen| seen.value.as_ref()).map(SessionValue::lease);
        others.fold(self.settings.lease, Nanos::max)
    }

    /// The id of the member of a session.
    pub(super) fn member_of(&self, session: &str) -> Option<Arc<str>> {
        if self.session_name().is_some_and(|own| **own == *session) {
            return Some(self.member.id.clone());
        }
        Some(self.sessions.get(session)?.value.as_ref()?.member.as_str().into())
    }

    /// The state of all members.
    pub(super) fn member_statuses(&self, now: Nanos) -> Vec<MemberStatus> {
        let status = |session: &Arc<str>, value: &SessionValue, since: Nanos| MemberStatus {
            id: value.member.as_str().into(),
            session: session.clone(),
            version: value.version.clone(),
            config: value.config.clone(),
            weight: value.weight,
            is_draining: value.draining,
            lease: std::time::Duration::from_nanos(value.lease()),
            silent_for: std::time::Duration::from_nanos(now.saturating_sub(since)),
            links: self.links.values().filter(|link| link.is_of(session)).count(),
        };
        let others = self.sessions.iter().filter(|(_, seen)| seen.state == SeenState::Alive);
        let others = others.filter_map(|(name, seen)| Some(status(name, seen.value.as_ref()?, seen.since)));
        let own = self.session.as_ref().and_then(|session| {
            let (value, renewed) = session.renewed_value()?;
            Some(status(&session.name, value, renewed))
        });
        let mut all: Vec<_> = others.chain(own).collect();
        all.sort_by(|a, b| (&a.id, &a.session).cmp(&(&b.id, &b.session)));
        all
    }

    /// The faults that an operator should know.
    pub(super) fn warnings(&self) -> Vec<String> {
        let alive = self.sessions.values().filter(|seen| seen.state == SeenState::Alive);
        let mut warnings = Vec::new();
        for value in alive.filter_map(|seen| seen.value.as_ref()) {
            if *value.member == *self.member.id {
                warnings.push(format!("another process runs, or has just ended, under the id {}", value.member));
            } else if value.config != self.member.config {
                warnings
                    .push(format!("{} has another configuration: it shares no links with this bridge", value.member));
            }
        }
        warnings
    }
}

impl Seen {
    fn new(now: Nanos) -> Self {
        Self {
            state: SeenState::Gone,
            revision: 0,
            since: now,
            value: None,
            is_confirmed: false,
            is_fencing: false,
            is_timer_set: false,
            is_purged: false,
        }
    }

    /// The time for which it must be silent before it is fenced: the longer one of both leases.
    fn lease(&self, own: Nanos) -> Nanos {
        self.value.as_ref().map_or(own, |value| value.lease().max(own))
    }
}

impl Peer {
    pub(super) fn candidate(&self) -> Candidate<'_> {
        Candidate { member: &self.member, weight: self.weight, session: &self.session }
    }

    pub(super) fn reaches(&self, reach: &Reach) -> bool {
        match reach {
            Reach::All => true,
            Reach::Only(members) => members.contains(&self.member),
            Reach::Pinned(member) => *member == self.member,
        }
    }
}
