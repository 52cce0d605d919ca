//! The end of a session that was stopped.
//!
//! ```text
//! stopped ──last states queued──▶ closing ──all acknowledged, or the time is up──▶ DISCONNECT ──▶ end
//!                                    └──connection lost──▶ end; a member of a fleet may connect again
//! ```
//!
//! The time is up a second after the last acknowledgement, and 4 s after the stop.
//!
//! Invariant: the bridge sends DISCONNECT only when the broker has its offline state. Otherwise the broker publishes
//! the will, which has the same content.
//!
//! Why the acknowledgements of all states are awaited: the process ends after the DISCONNECT, and its socket is closed.
//! A broker that then cannot write an acknowledgement drops the messages behind it unread.

use std::time::Duration;

use bytes::Bytes;
use tokio::time::{Instant, timeout};

use super::{End, Item, LostError, OFFLINE, Session};
use crate::output::mqtt::retained::Priority;

/// The time without an acknowledgement after which the session ends.
const SILENCE: Duration = Duration::from_secs(1);
/// The time to write DISCONNECT.
const FLUSH: Duration = Duration::from_millis(500);

/// A session that is being ended.
#[derive(Debug)]
pub(super) struct Closing {
    ends: Instant,
    /// The end of the time for the last messages of the output.
    limit: Instant,
    pub(super) offline_state: OfflineState,
}

/// The offline state of the bridge at the broker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OfflineState {
    NotAcknowledged,
    Known,
    Refused,
}

impl Closing {
    fn new(now: Instant, limit: Instant) -> Self {
        Self { ends: limit.min(now + SILENCE), limit, offline_state: OfflineState::NotAcknowledged }
    }

    /// When the session ends unless there is progress before.
    pub(super) fn ends(&self) -> Instant {
        self.ends
    }

    /// Notes an acknowledgement, or a reply that is to be sent.
    pub(super) fn progressed(&mut self, now: Instant) {
        self.ends = self.limit.min(now + SILENCE);
    }
}

impl Session<'_> {
    /// Queues the last states.
    pub(super) fn begin_close(&mut self) {
        let now = Instant::now();
        self.closing = Some(Closing::new(now, self.shared.limit_of_the_end(now)));
        // PLCs that the last member of a fleet has given up are offline.
        self.refresh(false);
        let topic = self.shared.topics.bridge_state();
        self.carried.retained.set(topic, Bytes::from_static(OFFLINE), Priority::First, None);
    }

    /// Returns whether the broker has all states and replies, or the time is up.
    pub(super) fn is_over(&self, closing: &Closing) -> bool {
        let is_replying = self.window.iter().any(|item| matches!(item, Item::Reply(_)))
            || !self.carried.replies.is_empty()
            || !self.carried.commands.is_empty();
        let is_told = closing.offline_state != OfflineState::NotAcknowledged && self.retained_under_way() == 0;
        is_told && !is_replying || closing.ends <= Instant::now()
    }

    /// The states that are queued, and the retained messages in flight.
    pub(super) fn retained_under_way(&self) -> usize {
        let in_flight = self.window.iter().filter(|item| matches!(item, Item::Retained(_))).count();
        self.carried.retained.states() + in_flight
    }

    /// Ends the connection. Unless the broker has the offline state, it publishes the will instead.
    pub(super) async fn close(&mut self, offline_state: OfflineState) -> End {
        let messages = self.retained_under_way();
        if messages > 0 {
            tracing::warn!(messages, "mqtt: the broker did not take all retained messages before the end");
        }
        if offline_state == OfflineState::Known {
            self.connection.writer.disconnect();
            let written = async {
                while !self.connection.writer.is_idle() {
                    self.connection.writer.write_some().await?;
                }
                Ok::<_, LostError>(())
            };
            // It ends anyway.
            let _ = timeout(FLUSH, written).await;
        }
        End::Stopped
    }
}
