//! Transfers of links: taken when they are free, given to other members, and released when they are closed.

use std::sync::Arc;

use super::{Mine, Owner};
use crate::fleet::LinkToken;
use crate::fleet::core::members::SeenState;
use crate::fleet::core::requests::Purpose;
use crate::fleet::core::{Action, Core, MAX_HANDED, Nanos, Operation, Outcome};
use crate::fleet::keys::Key;

impl Core {
    /// Decides about the links that something has happened to.
    pub(in crate::fleet::core) fn review_links(&mut self, now: Nanos) {
        let expired = now.saturating_sub(self.settings.lease);
        self.handed.retain(|_, since| *since > expired);
        let room = self.room_for_releases();
        for _ in 0..room {
            let Some(id) = self.waiting.pop_first() else { break };
            self.review.insert(id);
        }
        while let Some(id) = self.review.pop_first() {
            if self.decide(now, &id).is_none() {
                self.review.insert(id);
                break;
            }
        }
    }

    fn room_for_releases(&self) -> usize {
        let room = self.settings.max_requests.saturating_sub(self.releasing.len());
        if self.is_leaving { room } else { room.min(MAX_HANDED.saturating_sub(self.handed.len())) }
    }

    /// Decides about a link. `None`: it needs a request, and too many are in flight.
    fn decide(&mut self, now: Nanos, id: &Arc<str>) -> Option<()> {
        let may_act = self.may_act(now);
        let (is_leaving, own) = (self.is_leaving, self.session_name().cloned());
        let Some(link) = self.links.get_mut(id) else { return Some(()) };
        match link.mine {
            Mine::Taking(_) | Mine::Closing { .. } | Mine::Releasing { request: Some(_), .. } => {}
            Mine::Releasing { request: None, .. } if is_leaving && !may_act => {
                // Others take it when the session has ended.
                link.mine = Mine::No;
                self.releasing.remove(id);
            }
            Mine::Releasing { token, request: None } => {
                // Rule 5: the store may have been set back to before a release that was sent in an earlier view.
                let certain = if link.is_doubtful { link.since.saturating_add(self.longest_lease) } else { 0 };
                let at = link.retry_at.max(certain);
                if may_act && now >= at {
                    return self.send_release(now, id, token);
                } else if may_act {
                    self.set_link_timer(id, at);
                }
            }
            Mine::Owned { token: 0 } => {
                if is_leaving || !link.is_pinned_to(&self.member.id) {
                    link.mine = Mine::Closing { token: 0, release: false };
                    self.actions.push_back(Action::Close { link: id.clone(), token: LinkToken::PINNED });
                }
            }
            Mine::Owned { token } => {
                let is_target = link.is_leased() && link.target == own;
                let must_go = is_leaving || !link.is_leased();
                if is_leaving && !may_act {
                    self.lose(id);
                } else if may_act && (must_go || !is_target) {
                    self.give(now, id, token, must_go);
                }
            }
            Mine::No if link.is_pinned_to(&self.member.id) => {
                if !is_leaving {
                    link.mine = Mine::Owned { token: 0 };
                    let (link, token) = (id.clone(), LinkToken::PINNED);
                    self.actions.push_back(Action::Own { link, token, session: None });
                }
            }
            Mine::No => {
                let Some(own) = own.filter(|_| self.session.as_ref().is_some_and(|session| session.is_created)) else {
                    return Some(());
                };
                if is_leaving {
                    // Others take it when the session has ended.
                } else if link.is_of(&own) && !link.is_leased() {
                    link.mine = Mine::Releasing { token: link.revision, request: None };
                    self.releasing.insert(id.clone());
                    self.review.insert(id.clone());
                } else if link.is_of(&own) {
                    self.own(id, own);
                    self.review.insert(id.clone());
                } else if may_act && link.is_leased() && link.target.as_ref() == Some(&own) {
                    return self.take_if_free(now, id, own);
                }
            }
        }
        Some(())
    }

    /// The entry of the link has the own session.
    fn own(&mut self, id: &Arc<str>, session: Arc<str>) {
        let store = self.store.unwrap_or(0);
        let Some(link) = self.links.get_mut(id) else { return };
        link.mine = Mine::Owned { token: link.revision };
        let token = LinkToken { store, revision: link.revision };
        self.actions.push_back(Action::Own { link: id.clone(), token, session: Some(session) });
    }

    /// Begins to give a link away, if there is a member that takes it, or if it must go.
    fn give(&mut self, now: Nanos, id: &Arc<str>, token: u64, must_go: bool) {
        let Some(link) = self.links.get(id) else { return };
        if !must_go {
            let Some(target) = link.target.clone() else { return };
            if !self.is_punctual(now, &target) {
                let at = now.saturating_add(self.settings.lease / 4);
                return self.set_link_timer(id, at);
            }
        }
        if self.room_for_releases() == 0 {
            self.waiting.insert(id.clone());
            return;
        }
        self.releasing.insert(id.clone());
        if !must_go {
            self.handed.insert(id.clone(), now);
        }
        let store = self.store.unwrap_or(0);
        if let Some(link) = self.links.get_mut(id) {
            link.mine = Mine::Closing { token, release: true };
        }
        let token = LinkToken { store, revision: token };
        self.actions.push_back(Action::Close { link: id.clone(), token });
    }

    /// The driver has closed a link.
    pub(in crate::fleet::core) fn link_closed(&mut self, id: &Arc<str>, token: LinkToken) {
        let Some(link) = self.links.get_mut(id) else { return };
        match link.mine {
            Mine::Closing { token: closed, release } if closed == token.revision => {
                link.mine = if release { Mine::Releasing { token: closed, request: None } } else { Mine::No };
                link.retry_at = 0;
            }
            Mine::No | Mine::Taking(_) | Mine::Owned { .. } | Mine::Closing { .. } | Mine::Releasing { .. } => return,
        }
        self.review.insert(id.clone());
    }

    fn send_release(&mut self, now: Nanos, id: &Arc<str>, token: u64) -> Option<()> {
        if self.link_requests >= self.settings.max_requests {
            return None;
        }
        let operation = Operation::Put { key: Key::Link(id).text(), value: String::new(), expected: token };
        let request = self.request(now, Purpose::Release { link: id.clone() }, operation);
        if let Some(link) = self.links.get_mut(id) {
            link.mine = Mine::Releasing { token, request: Some(request) };
        }
        Some(())
    }

    pub(in crate::fleet::core) fn released(&mut self, now: Nanos, request: u64, id: &Arc<str>, outcome: &Outcome) {
        let retry = self.settings.lease / 12;
        let Some(link) = self.links.get_mut(id) else { return };
        let Mine::Releasing { token, request: Some(sent) } = link.mine else { return };
        if sent != request {
            return;
        }
        match outcome {
            Outcome::Stored(revision) if *revision > link.revision => {
                self.set_owner(now, id, Owner::Free, *revision, true);
            }
            Outcome::Stored(_)
            | Outcome::WrongRevision
            | Outcome::Unknown
            | Outcome::Found { .. }
            | Outcome::Missing
            | Outcome::Purged => {
                // The watch tells if it was released, or lost.
                link.mine = Mine::Releasing { token, request: None };
                link.retry_at = now.saturating_add(retry);
            }
        }
        self.review.insert(id.clone());
    }

    fn take_if_free(&mut self, now: Nanos, id: &Arc<str>, own: Arc<str>) -> Option<()> {
        let Some(free_at) = self.free_at(id) else { return Some(()) };
        let Some(link) = self.links.get(id) else { return Some(()) };
        let at = free_at.max(link.retry_at);
        if at > now {
            self.set_link_timer(id, at);
            return Some(());
        }
        if self.link_requests >= self.settings.max_requests {
            return None;
        }
        let expected = link.revision;
        let operation = Operation::Put { key: Key::Link(id).text(), value: own.to_string(), expected };
        let request = self.request(now, Purpose::Take { link: id.clone(), session: own }, operation);
        if let Some(link) = self.links.get_mut(id) {
            link.mine = Mine::Taking(request);
        }
        Some(())
    }

    /// The time from which a link may be taken; `None` while its owner lives.
    fn free_at(&self, id: &Arc<str>) -> Option<Nanos> {
        let link = self.links.get(id)?;
        let aged = link.since.saturating_add(self.longest_lease);
        // Rules 3 and 5.
        let known = if link.is_news { 0 } else { aged };
        match &link.owner {
            Owner::Missing => Some(aged),
            Owner::Free => Some(known),
            Owner::Session(owner) => match self.sessions.get(owner) {
                None => Some(aged),
                Some(seen) => match seen.state {
                    SeenState::Alive => None,
                    SeenState::Dead => Some(known),
                    SeenState::Gone => Some(aged.max(seen.since.saturating_add(self.longest_lease))),
                },
            },
        }
    }

    pub(in crate::fleet::core) fn taken(
        &mut self,
        now: Nanos,
        request: u64,
        id: &Arc<str>,
        session: &Arc<str>,
        outcome: &Outcome,
    ) {
        let (retry, own) = (self.settings.lease / 12, self.session_name().cloned());
        let Some(link) = self.links.get_mut(id) else { return };
        if link.mine == Mine::Taking(request) {
            link.mine = Mine::No;
        }
        match outcome {
            // Not if the watch is further: then it says who owns it now.
            Outcome::Stored(revision) if *revision > link.revision && own.as_ref() == Some(session) => {
                self.set_owner(now, id, Owner::Session(session.clone()), *revision, true);
            }
            Outcome::Stored(_)
            | Outcome::WrongRevision
            | Outcome::Unknown
            | Outcome::Found { .. }
            | Outcome::Missing
            | Outcome::Purged => link.retry_at = now.saturating_add(retry),
        }
        self.review.insert(id.clone());
    }

    pub(in crate::fleet::core) fn link_forgotten(&mut self, id: &Arc<str>) {
        let Some(link) = self.links.get_mut(id) else { return };
        link.mine = match link.mine {
            Mine::Taking(_) => Mine::No,
            Mine::Releasing { token, .. } => Mine::Releasing { token, request: None },
            mine @ (Mine::No | Mine::Owned { .. } | Mine::Closing { .. }) => mine,
        };
    }
}
