//! Requests to the store that wait for their replies.

use std::sync::Arc;

use super::{Action, Core, Nanos, Operation, Outcome, StoreFault};

/// The purpose of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// Creates or renews the own session; the attempt with this number.
    Renew { session: Arc<str>, beat: u64 },
    /// Ends the own session.
    End { session: Arc<str> },
    /// Reads the own session. Its revision was at least this one before.
    Read { session: Arc<str>, known: u64 },
    /// Fences another session.
    Fence { session: Arc<str> },
    /// Removes a session that has ended.
    Purge,
    /// Takes a link for a session.
    Take { link: Arc<str>, session: Arc<str> },
    /// Releases a link.
    Release { link: Arc<str> },
}

/// A request without a reply.
#[derive(Clone, Debug)]
pub(super) struct Pending {
    pub(super) purpose: Purpose,
    key: String,
    /// The time before it was sent.
    pub(super) sent: Nanos,
    /// The highest revision that was seen before it was sent.
    max_revision: u64,
}

impl Core {
    /// Sends a request. Returns its number.
    pub(super) fn request(&mut self, now: Nanos, purpose: Purpose, operation: Operation) -> u64 {
        self.next_request += 1;
        let request = self.next_request;
        let key = match &operation {
            Operation::Put { key, .. } | Operation::Get { key } | Operation::Purge { key, .. } => key.clone(),
        };
        self.link_requests += usize::from(purpose.is_of_link());
        self.pending.insert(request, Pending { purpose, key, sent: now, max_revision: self.max_revision });
        self.actions.push_back(Action::Request { request, operation, timeout: self.settings.lease / 4 });
        request
    }

    pub(super) fn replied(&mut self, now: Nanos, request: u64, outcome: Outcome) {
        // A second reply, or one of a connection that was lost.
        let Some(pending) = self.pending.remove(&request) else { return };
        self.link_requests -= usize::from(pending.purpose.is_of_link());
        if let Outcome::Stored(revision) = outcome {
            // Revisions of a store only rise.
            if revision <= pending.max_revision {
                let before = pending.max_revision;
                return self.fail(StoreFault::SetBack { what: pending.key, before, now: revision });
            }
            self.max_revision = self.max_revision.max(revision);
        }
        let sent = pending.sent;
        match pending.purpose {
            Purpose::Renew { session, beat } => self.renewed(now, &session, beat, sent, &outcome),
            Purpose::End { session } => self.ended(now, &session, &outcome),
            Purpose::Read { session, known } => self.session_read(now, &session, known, outcome),
            Purpose::Fence { session } => self.fenced_other(now, &session, &outcome),
            Purpose::Purge => {}
            Purpose::Take { link, session } => self.taken(now, request, &link, &session, &outcome),
            Purpose::Release { link } => self.released(now, request, &link, &outcome),
        }
    }

    /// Treats a request as one whose result is unknown, since its connection was lost.
    pub(super) fn forget(&mut self, pending: &Pending) {
        match &pending.purpose {
            Purpose::Renew { .. } | Purpose::End { .. } | Purpose::Read { .. } => self.session_forgotten(),
            Purpose::Fence { session } => self.fence_forgotten(session),
            Purpose::Purge => {}
            Purpose::Take { link, .. } | Purpose::Release { link } => self.link_forgotten(link),
        }
    }
}

impl Purpose {
    fn is_of_link(&self) -> bool {
        match self {
            Self::Take { .. } | Self::Release { .. } => true,
            Self::Renew { .. } | Self::End { .. } | Self::Read { .. } | Self::Fence { .. } | Self::Purge => false,
        }
    }
}
