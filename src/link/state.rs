//! The state of a link's connection, shared by its task and its handles.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;

use super::watchable::Watchable;

/// State of a link's connection.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum LinkState {
    /// Not open: no call has been made yet, or none for the [idle
    /// timeout](crate::LinkBuilder::idle_timeout).
    Idle,
    /// Waiting to be opened: a [`Pool`](crate::Pool) limits connection attempts. A link that was
    /// down stays `Down` while it waits.
    Waiting,
    /// Being opened.
    Connecting,
    /// Open.
    Up,
    /// Lost, or could not be opened. The next call, or one that waits, opens it again.
    #[non_exhaustive]
    Down {
        /// Why the connection was lost or not opened.
        error: Arc<io::Error>,
    },
    /// Closed for good.
    Closed,
}

#[derive(Debug)]
pub(super) struct SharedLinkState(Mutex<Watchable<LinkState>>);

impl SharedLinkState {
    pub(super) fn new() -> Self {
        Self(Mutex::new(Watchable::new(LinkState::Idle)))
    }

    pub(super) fn get(&self) -> LinkState {
        self.lock().get().clone()
    }

    pub(super) fn watch(&self) -> watch::Receiver<LinkState> {
        self.lock().watch_unseen()
    }

    // Watchers are notified after the lock was released: a waker may come here.
    pub(super) fn set(&self, state: LinkState) {
        let channel = self.lock().store(state.clone());
        notify(channel, state);
    }

    /// Replaces the state if this is one of those to be replaced.
    pub(super) fn set_if(&self, replaces: impl FnOnce(&LinkState) -> bool, state: LinkState) {
        let mut present = self.lock();
        if replaces(present.get()) {
            let channel = present.store(state.clone());
            drop(present);
            notify(channel, state);
        }
    }

    /// Sets the final state: [`LinkState::Closed`].
    pub(super) fn end(&self) {
        let channel = self.lock().end(LinkState::Closed);
        notify(channel, LinkState::Closed);
    }

    fn lock(&self) -> MutexGuard<'_, Watchable<LinkState>> {
        // No code panics while it holds this lock.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn notify(channel: Option<watch::Sender<LinkState>>, state: LinkState) {
    if let Some(channel) = channel {
        channel.send_replace(state);
    }
}
