//! The links: configured, placed, seen in the store, and lost.

mod transfer;

use std::sync::Arc;
use std::time::Duration;

use super::members::Peer;
use super::{Action, Core, Member, Nanos, StoreFault, Timer};
use crate::fleet::keys::Key;
use crate::fleet::placement;
use crate::fleet::{LinkSpec, LinkStatus, LinkToken, Reach};

/// A link.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) id: Arc<str>,
    /// The members that can reach it; `None`: the configuration does not have it.
    reach: Option<Reach>,
    owner: Owner,
    revision: u64,
    /// The time at which this view first had this revision, or had no entry.
    since: Nanos,
    /// The time at which this member first saw this revision.
    owned_since: Nanos,
    /// `true` if the entry came after the view began: then it is true at once (rule 5).
    is_news: bool,
    /// `true` if the present view has its entry.
    is_confirmed: bool,
    /// `true` if its release was sent in an earlier view, with an unknown result.
    is_doubtful: bool,
    mine: Mine,
    /// The session that is to own it.
    target: Option<Arc<str>>,
    /// It is not taken before this time: the last attempt failed.
    retry_at: Nanos,
    /// The time of the first timer that is set.
    timer: Option<Nanos>,
}

/// The owner of a link by its entry.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Owner {
    /// There is no entry.
    Missing,
    Free,
    Session(Arc<str>),
}

/// The part of this member in a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mine {
    No,
    /// The request to take it is in flight.
    Taking(u64),
    Owned {
        token: u64,
    },
    /// The driver closes it. `release`: then it is released; else it was lost.
    Closing {
        token: u64,
        release: bool,
    },
    /// It is closed; the request to release it is in flight, or must be sent again.
    Releasing {
        token: u64,
        request: Option<u64>,
    },
}

impl Link {
    fn new(id: Arc<str>, since: Nanos) -> Self {
        Self {
            id,
            reach: None,
            owner: Owner::Missing,
            revision: 0,
            since,
            owned_since: since,
            is_news: false,
            is_confirmed: false,
            is_doubtful: false,
            mine: Mine::No,
            target: None,
            retry_at: 0,
            timer: None,
        }
    }

    /// A new view begins.
    pub(super) fn connected(&mut self, now: Nanos) {
        self.since = now;
        self.is_news = false;
        self.is_confirmed = false;
        self.is_doubtful = matches!(self.mine, Mine::Releasing { .. });
    }

    /// Returns whether the view lacks the entry, although there was one: the protocol deletes none.
    pub(super) fn has_vanished(&self) -> bool {
        self.revision > 0 && !self.is_confirmed
    }

    pub(super) fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns whether a session owns it.
    pub(super) fn is_of(&self, session: &str) -> bool {
        matches!(&self.owner, Owner::Session(owner) if **owner == *session)
    }

    /// Returns whether the configuration has it, or the driver is still to close it.
    pub(super) fn is_needed(&self) -> bool {
        self.reach.is_some() || self.mine != Mine::No
    }

    fn is_leased(&self) -> bool {
        matches!(&self.reach, Some(Reach::All | Reach::Only(_)))
    }

    fn is_pinned_to(&self, member: &str) -> bool {
        matches!(&self.reach, Some(Reach::Pinned(pinned)) if **pinned == *member)
    }
}

impl Core {
    pub(super) fn configure(&mut self, now: Nanos, member: Member, links: Vec<LinkSpec>) {
        self.member = member;
        let since = self.view.as_ref().map_or(now, |view| view.since);
        self.links.values_mut().for_each(|link| link.reach = None);
        for LinkSpec { id, reach } in links {
            let link = self.links.entry(id.clone()).or_insert_with(|| Link::new(id, since));
            link.reach = Some(reach);
        }
        self.links.retain(|_, link| link.reach.is_some() || link.revision > 0 || link.mine != Mine::No);
        self.is_placement_old = true;
        self.renew_if_changed();
        self.review_all();
    }

    /// Computes the targets of all links.
    pub(super) fn place(&mut self) {
        self.is_placement_old = false;
        self.longest_lease = self.find_longest_lease();
        let peers = self.peers();
        for link in self.links.values_mut() {
            let Some(reach) = link.reach.as_ref().filter(|_| link.is_leased()) else {
                link.target = None;
                continue;
            };
            let by_hand = self.overrides.get(&*link.id);
            let reaching = || peers.iter().filter(|peer| peer.weight > 0 && peer.reaches(reach));
            let chosen = reaching().filter(|peer| by_hand.is_some_and(|member| **member == *peer.member));
            let chosen = placement::target(&link.id, chosen.map(Peer::candidate));
            let target = chosen.or_else(|| placement::target(&link.id, reaching().map(Peer::candidate)));
            link.target = target.map(|target| target.session.into());
        }
        self.review_all();
    }

    pub(super) fn review_all(&mut self) {
        self.review.extend(self.links.keys().cloned());
    }

    /// Sets a timer.
    pub(super) fn set_timer(&mut self, at: Nanos, timer: Timer) {
        self.timers.push(std::cmp::Reverse((at, timer)));
    }

    fn set_link_timer(&mut self, id: &Arc<str>, at: Nanos) {
        let Some(link) = self.links.get_mut(id) else { return };
        if link.timer.is_none_or(|timer| at < timer) {
            link.timer = Some(at);
            self.set_timer(at, Timer::Link(id.clone()));
        }
    }

    pub(super) fn link_due(&mut self, id: Arc<str>, at: Nanos) {
        if let Some(link) = self.links.get_mut(&id) {
            if link.timer == Some(at) {
                link.timer = None;
            }
            self.review.insert(id);
        }
    }

    pub(super) fn link_entry(&mut self, now: Nanos, id: &str, value: Option<&str>, revision: u64, is_news: bool) {
        let id: Arc<str> = id.into();
        let since = self.view.as_ref().map_or(now, |view| view.since);
        let link = self.links.entry(id.clone()).or_insert_with(|| Link::new(id.clone(), since));
        let owner = match value {
            None => Owner::Missing,
            Some("") => Owner::Free,
            Some(session) => Owner::Session(session.into()),
        };
        let is_other = revision == link.revision && owner != link.owner;
        if revision < link.revision || is_other {
            if is_news && !is_other {
                // The result of a request of this member was faster.
                return;
            }
            let (what, before) = (Key::Link(&id).text(), link.revision);
            return self.fail(StoreFault::SetBack { what, before, now: revision });
        }
        link.is_confirmed = true;
        if revision > link.revision {
            self.set_owner(now, &id, owner, revision, is_news);
        }
        self.review.insert(id);
    }

    /// The entry of a link has changed.
    fn set_owner(&mut self, now: Nanos, id: &Arc<str>, owner: Owner, revision: u64, is_news: bool) {
        let own = self.session_name().cloned();
        let Some(link) = self.links.get_mut(id) else { return };
        let is_own = matches!((&owner, &own), (Owner::Session(owner), Some(own)) if owner == own);
        if matches!(owner, Owner::Session(_)) && !is_own {
            self.handed.remove(id);
        }
        (link.owner, link.revision, link.is_news) = (owner, revision, is_news);
        (link.since, link.owned_since) = (now, now);
        (link.is_confirmed, link.is_doubtful, link.retry_at) = (true, false, 0);
        match link.mine {
            Mine::Owned { token } if token > 0 => self.lose(id),
            Mine::Closing { token, release: true } => {
                link.mine = Mine::Closing { token, release: false };
                self.releasing.remove(id);
            }
            Mine::Releasing { .. } => {
                link.mine = Mine::No;
                self.releasing.remove(id);
            }
            // An entry of this session is adopted by the review, even if the reply is still on its way.
            Mine::Taking(_) if is_own => link.mine = Mine::No,
            Mine::No | Mine::Taking(_) | Mine::Owned { .. } | Mine::Closing { .. } => {}
        }
    }

    /// A link is not owned any more: its gate is closed, and then the link.
    fn lose(&mut self, id: &Arc<str>) {
        let store = self.store.unwrap_or(0);
        let Some(link) = self.links.get_mut(id) else { return };
        if let Mine::Owned { token } = link.mine {
            link.mine = Mine::Closing { token, release: false };
            let token = LinkToken { store, revision: token };
            self.actions.push_back(Action::Close { link: id.clone(), token });
        }
    }

    /// The session has ended: all its links are lost.
    pub(super) fn lose_all(&mut self) {
        let ids: Vec<_> = self.links.keys().cloned().collect();
        for id in ids {
            let Some(link) = self.links.get_mut(&id) else { continue };
            match link.mine {
                Mine::Owned { token } if token > 0 => self.lose(&id),
                Mine::Closing { token, .. } => link.mine = Mine::Closing { token, release: false },
                Mine::Taking(_) | Mine::Releasing { .. } => link.mine = Mine::No,
                Mine::No | Mine::Owned { .. } => {}
            }
        }
        self.releasing.clear();
        self.handed.clear();
    }

    /// Returns whether this member has nothing to close or release any more.
    pub(super) fn has_closed_all(&self) -> bool {
        let is_done = |link: &Link| match link.mine {
            Mine::No => true,
            // The session ends, and others may take it then.
            Mine::Taking(_) => true,
            Mine::Owned { .. } | Mine::Closing { .. } | Mine::Releasing { .. } => false,
        };
        // Links are released in the order of their ids: one that is not done is found among the last ones.
        self.links.values().rev().all(is_done)
    }

    /// The state of all links of the configuration.
    pub(super) fn link_statuses(&self, now: Nanos) -> Vec<LinkStatus> {
        let configured = self.links.values().filter(|link| link.reach.is_some());
        let status = |link: &Link| {
            let pinned = match &link.reach {
                Some(Reach::Pinned(member)) => Some(member.clone()),
                Some(Reach::All | Reach::Only(_)) | None => None,
            };
            let owner = match &link.owner {
                Owner::Session(session) => self.member_of(session),
                Owner::Missing | Owner::Free => None,
            };
            LinkStatus {
                link: link.id.clone(),
                owner: pinned.clone().or(owner),
                token: LinkToken { store: self.store.unwrap_or(0), revision: link.revision },
                owned_for: Duration::from_nanos(now.saturating_sub(link.owned_since)),
                target: pinned.or_else(|| self.member_of(link.target.as_ref()?)),
            }
        };
        configured.map(status).collect()
    }
}
