//! The own session: created, renewed, read after doubt, and ended.

use std::sync::Arc;

use super::requests::Purpose;
use super::{Action, Core, Nanos, Operation, Outcome, StoreFault};
use crate::fleet::keys::{DEAD, Key, SessionValue};

/// The own session.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) name: Arc<str>,
    /// `true` once it is known to be in the store.
    pub(super) is_created: bool,
    /// Its last revision that is known; 0 before it is created.
    revision: u64,
    /// The attempt that was stored as this revision.
    stored_beat: u64,
    /// The last attempt that was sent.
    beat: u64,
    /// The last value that was sent.
    value: Option<SessionValue>,
    /// The gates are open until then.
    deadline: Nanos,
    /// The last renewal that was stored was sent then.
    renewed: Nanos,
    /// The end of the gates as the driver has it.
    announced: Nanos,
    /// The next renewal is due then.
    next: Nanos,
    /// The time of the last request.
    last_sent: Nanos,
    /// `true` while a request is in flight.
    is_busy: bool,
    /// `true` if the last result is unknown: the entry must be read.
    is_in_doubt: bool,
    /// `true` if the present view has its entry.
    is_confirmed: bool,
}

impl Session {
    fn new(name: Arc<str>, now: Nanos) -> Self {
        Self {
            name,
            is_created: false,
            revision: 0,
            stored_beat: 0,
            beat: 0,
            value: None,
            deadline: 0,
            renewed: now,
            announced: 0,
            next: now,
            last_sent: 0,
            is_busy: false,
            is_in_doubt: false,
            is_confirmed: false,
        }
    }

    /// Its last value and the time of its last renewal, once it is created.
    pub(super) fn renewed_value(&self) -> Option<(&SessionValue, Nanos)> {
        self.value.as_ref().filter(|_| self.is_created).map(|value| (value, self.renewed))
    }
}

impl Core {
    /// The time at which the gates close; 0: they are closed.
    pub(super) fn open_until(&self, now: Nanos) -> Nanos {
        let open = self.session.as_ref().filter(|session| session.deadline > now);
        open.map_or(0, |session| session.deadline)
    }

    /// A new view begins. A session whose gates have closed by then ends (rule 5). It has no links before it is
    /// created.
    pub(super) fn session_connected(&mut self, now: Nanos) {
        let Some(session) = &mut self.session else { return };
        session.is_confirmed = false;
        if session.is_created && session.deadline <= now {
            self.end_session();
        }
    }

    /// Tells the driver the end of the gates.
    ///
    /// A session whose gates have closed ends, even if a late renewal could open them again: what was polled with it
    /// pauses, and each pause has a token of its own.
    pub(super) fn update_gate(&mut self, now: Nanos) {
        if self.session.as_ref().is_some_and(|session| session.announced > 0 && session.deadline <= now) {
            self.fenced(now, None);
        }
        let Some(session) = &mut self.session else { return };
        let until = session.deadline;
        if until != session.announced && until > now {
            session.announced = until;
            self.actions.push_back(Action::Gate { session: session.name.clone(), until });
        }
        let is_open = self.may_act(now);
        if is_open && !self.was_open {
            self.review_all();
            self.check_sessions(now);
        }
        self.was_open = is_open;
    }

    /// The time at which something is due for the session.
    pub(super) fn session_due(&self) -> Option<Nanos> {
        let is_connected = self.is_complete();
        let Some(session) = &self.session else {
            return (is_connected && !self.is_leaving).then_some(self.join_after);
        };
        let is_urgent = session.is_in_doubt || (self.is_leaving && self.has_closed_all());
        let next = if is_urgent { 0 } else { session.next };
        let next = (is_connected && !session.is_busy).then(|| next.max(self.not_before(session)));
        // Its passing must be noticed, and its end must not be missed between two renewals.
        let closes = (session.announced > 0).then_some(session.deadline);
        [next, closes].into_iter().flatten().min()
    }

    /// The first time of the next request: errors that come at once must not become a storm.
    fn not_before(&self, session: &Session) -> Nanos {
        session.last_sent.saturating_add(if session.last_sent == 0 { 0 } else { self.settings.lease / 24 })
    }

    /// Makes the renewal due, if others would see something else by it.
    pub(super) fn renew_if_changed(&mut self) {
        let value = self.session_value();
        let Some(session) = &mut self.session else { return };
        if session.value.as_ref().is_some_and(|sent| sent.differs_from(&value)) {
            session.next = 0;
        }
    }

    fn session_value(&self) -> SessionValue {
        SessionValue {
            member: self.member.id.to_string(),
            version: self.member.version.clone(),
            config: self.member.config.clone(),
            weight: self.member.weight,
            draining: self.is_draining(),
            lease_ms: self.settings.lease / 1_000_000,
            beat: self.session.as_ref().map_or(0, |session| session.beat),
        }
    }

    /// Creates, renews, reads or ends the session, if that is due.
    pub(super) fn drive_session(&mut self, now: Nanos) {
        let is_done = self.is_leaving && self.has_closed_all();
        if !self.is_complete() {
            if is_done {
                self.left();
            }
            return;
        }
        let Some(session) = &self.session else {
            if is_done {
                self.left();
            } else if !self.is_leaving && now >= self.join_after {
                self.join(now);
            }
            return;
        };
        if session.is_busy || now < self.not_before(session) {
            return;
        }
        let (name, revision, is_in_doubt) = (session.name.clone(), session.revision, session.is_in_doubt);
        let key = Key::Session(&name).text();
        if is_in_doubt {
            self.send(now, Purpose::Read { session: name, known: revision }, Operation::Get { key });
        } else if is_done {
            if revision == 0 {
                return self.left();
            }
            let operation = Operation::Put { key, value: DEAD.to_owned(), expected: revision };
            self.send(now, Purpose::End { session: name }, operation);
        } else if now >= session.next {
            self.renew(now);
        }
    }

    fn join(&mut self, now: Nanos) {
        self.joins += 1;
        let name = format!("{}-{}", self.settings.process, self.joins);
        self.session = Some(Session::new(name.into(), now));
        self.join_after = now.saturating_add(self.settings.lease / 3);
        self.renew(now);
    }

    fn renew(&mut self, now: Nanos) {
        let mut value = self.session_value();
        let next = now.saturating_add(self.settings.lease / 3);
        let Some(session) = &mut self.session else { return };
        session.beat += 1;
        value.beat = session.beat;
        session.next = next;
        session.value = Some(value.clone());
        let (name, expected) = (session.name.clone(), session.revision);
        let purpose = Purpose::Renew { session: name.clone(), beat: value.beat };
        let key = Key::Session(&name).text();
        self.send(now, purpose, Operation::Put { key, value: value.to_json(), expected });
    }

    fn send(&mut self, now: Nanos, purpose: Purpose, operation: Operation) {
        if let Some(session) = &mut self.session {
            session.is_busy = true;
            session.last_sent = now;
        }
        self.request(now, purpose, operation);
    }

    /// The session, if it is still this one.
    fn session_of(&mut self, name: &str) -> Option<&mut Session> {
        self.session.as_mut().filter(|session| *session.name == *name)
    }

    pub(super) fn renewed(&mut self, now: Nanos, name: &str, beat: u64, sent: Nanos, outcome: &Outcome) {
        let lease = self.settings.lease;
        #[cfg(test)]
        let sent = if self.counts_from_reply { now } else { sent };
        let Some(session) = self.session_of(name) else { return };
        session.is_busy = false;
        let Outcome::Stored(revision) = *outcome else {
            session.is_in_doubt = true;
            return;
        };
        let is_new = !session.is_created;
        session.is_created = true;
        session.revision = session.revision.max(revision);
        session.stored_beat = session.stored_beat.max(beat);
        // Others count from when they see it, which is after it was sent.
        session.deadline = session.deadline.max(sent.saturating_add(lease - lease / 10));
        session.renewed = sent;
        self.is_placement_old |= is_new;
        self.update_gate(now);
    }

    pub(super) fn ended(&mut self, now: Nanos, name: &str, outcome: &Outcome) {
        let Some(session) = self.session_of(name) else { return };
        session.is_busy = false;
        session.is_in_doubt = true;
        if let Outcome::Stored(revision) = *outcome {
            self.fenced(now, Some(revision));
        }
    }

    pub(super) fn session_read(&mut self, now: Nanos, name: &str, known: u64, outcome: Outcome) {
        let Some(session) = self.session_of(name) else { return };
        session.is_busy = false;
        match outcome {
            Outcome::Found { value: Some(value), revision } => {
                if revision < known {
                    let what = Key::Session(name).text();
                    return self.fail(StoreFault::SetBack { what, before: known, now: revision });
                }
                session.is_in_doubt = false;
                session.next = now;
                self.adopt(now, &value, revision);
            }
            // It was not stored, and may still be: then the next attempt finds it.
            Outcome::Missing if !session.is_created => {
                session.is_in_doubt = false;
                session.next = now;
            }
            // Purged after its end, or the store is not the same: a new connection tells.
            Outcome::Missing | Outcome::Found { value: None, .. } => self.actions.push_back(Action::Reconnect),
            Outcome::Unknown | Outcome::Stored(_) | Outcome::WrongRevision | Outcome::Purged => {}
        }
    }

    /// Takes over a revision of the own session, if this process wrote it.
    fn adopt(&mut self, now: Nanos, value: &str, revision: u64) {
        let Some(session) = &mut self.session else { return };
        let parsed = SessionValue::parse(value);
        let beat = parsed.as_ref().map(|value| value.beat);
        if revision == session.revision && session.is_created && beat != Some(session.stored_beat) {
            // The store was set back, and has given the revision again.
            let (what, before) = (Key::Session(&session.name).text(), revision);
            return self.fail(StoreFault::SetBack { what, before, now: revision });
        }
        if revision <= session.revision {
            return;
        }
        let unresolved = session.stored_beat + 1..=session.beat;
        match parsed.filter(|value| *value.member == *self.member.id && unresolved.contains(&value.beat)) {
            Some(value) => {
                session.revision = revision;
                session.stored_beat = value.beat;
                self.is_placement_old |= !session.is_created;
                session.is_created = true;
            }
            None => {
                if value == DEAD {
                    return self.fenced(now, Some(revision));
                }
                let text = format!("session {} was written by another process: it ends", session.name);
                self.actions.push_back(Action::Warn(text));
                self.fenced(now, None);
            }
        }
    }

    /// An entry of the own session in the watch.
    pub(super) fn own_entry(&mut self, now: Nanos, value: Option<&str>, revision: u64, is_news: bool) {
        let Some(session) = &mut self.session else { return };
        session.is_confirmed = value.is_some();
        if !is_news && revision < session.revision {
            let (what, before) = (Key::Session(&session.name).text(), session.revision);
            return self.fail(StoreFault::SetBack { what, before, now: revision });
        }
        // A deletion is found by the next renewal.
        if let Some(value) = value {
            self.adopt(now, value, revision);
        }
    }

    /// The view is complete: the session goes on if it has the entry.
    pub(super) fn session_complete(&mut self, now: Nanos) {
        let Some(session) = &mut self.session else { return };
        session.is_in_doubt = false;
        session.next = now;
        if session.is_created && !session.is_confirmed {
            // Purged after its end.
            self.fenced(now, None);
        }
    }

    pub(super) fn session_forgotten(&mut self) {
        if let Some(session) = &mut self.session {
            session.is_busy = false;
            session.is_in_doubt = true;
        }
    }

    /// The session has ended: another member has fenced it, or this one has ended it. `dead`: the revision of that.
    fn fenced(&mut self, now: Nanos, dead: Option<u64>) {
        if let (Some(revision), Some(name)) = (dead, self.session_name().cloned()) {
            self.note_dead(now, name, revision);
        }
        self.end_session();
        self.is_placement_old = true;
        if self.is_leaving && self.has_closed_all() {
            self.left();
        }
        self.review_all();
        self.join_after = self.join_after.max(now);
    }

    /// Ends the session: its gates are closed for good, and its links are lost.
    pub(super) fn end_session(&mut self) {
        let Some(session) = self.session.take() else { return };
        self.was_open = false;
        self.actions.push_back(Action::Gate { session: session.name, until: 0 });
        self.lose_all();
    }

    fn left(&mut self) {
        if !self.has_left {
            self.end_session();
            self.has_left = true;
            self.actions.push_back(Action::Left);
        }
    }
}
