//! A state that can be watched.

use tokio::sync::watch;

/// A state whose channel is made by its first watcher. Most states are not watched, and a channel takes
/// more memory than all other fields of a record.
///
/// Invariant: after [`end`](Self::end) no channel has a sender, so watchers see that the state is final.
#[derive(Debug)]
pub(super) struct Watchable<T> {
    state: T,
    channel: Option<watch::Sender<T>>,
    /// It is not the first state any more.
    was_set: bool,
    ended: bool,
}

impl<T: Clone> Watchable<T> {
    pub(super) fn new(state: T) -> Self {
        Self { state, channel: None, was_set: false, ended: false }
    }

    pub(super) fn get(&self) -> &T {
        &self.state
    }

    pub(super) fn watch(&mut self) -> watch::Receiver<T> {
        if self.ended {
            return watch::Sender::new(self.state.clone()).subscribe();
        }
        self.channel.get_or_insert_with(|| watch::Sender::new(self.state.clone())).subscribe()
    }

    /// A watcher that has not seen the present state, unless that is the first one.
    pub(super) fn watch_unseen(&mut self) -> watch::Receiver<T> {
        let mut watcher = self.watch();
        if self.was_set {
            watcher.mark_changed();
        }
        watcher
    }

    /// Sets the state, and notifies its watchers.
    pub(super) fn set(&mut self, state: T) {
        if let Some(channel) = self.store(state.clone()) {
            channel.send_replace(state);
        }
    }

    /// Sets the state, and returns its channel for the notification of the watchers.
    #[must_use]
    pub(super) fn store(&mut self, state: T) -> Option<watch::Sender<T>> {
        self.state = state;
        self.was_set = true;
        self.channel.clone()
    }

    /// Sets the final state, and returns its channel for the last notification of the watchers.
    #[must_use]
    pub(super) fn end(&mut self, state: T) -> Option<watch::Sender<T>> {
        self.state = state;
        self.was_set = true;
        self.ended = true;
        self.channel.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_watcher_sees_the_state_each_change_and_the_end() {
        let mut state = Watchable::new(1);
        state.set(2);
        assert!(state.channel.is_none(), "no channel without a watcher");
        let mut watcher = state.watch();
        assert_eq!(*watcher.borrow_and_update(), 2);
        state.set(3);
        assert_eq!((watcher.changed().await.is_ok(), *watcher.borrow()), (true, 3));
        state.end(4).unwrap().send_replace(4);
        assert_eq!((watcher.wait_for(|&state| state == 4).await.is_ok(), *state.get()), (true, 4));
        assert!(watcher.changed().await.is_err(), "it does not change again");
        let mut unseen = state.watch_unseen();
        assert_eq!((unseen.changed().await.is_ok(), *unseen.borrow()), (true, 4));
        assert!(unseen.changed().await.is_err());
        let mut late = state.watch();
        assert_eq!(*late.borrow_and_update(), 4);
        assert!(late.changed().await.is_err());
    }
}
