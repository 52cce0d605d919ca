//! The end of a session.
//!
//! ```text
//! stopped ──last states queued──▶ closing ──broker has all states and replies──▶ DISCONNECT ──▶ end
//!                                    └──no acknowledgement for a second, or 4 s in all──▶ end
//! ```
//!
//! Invariant: the bridge sends DISCONNECT only when the broker has the last state of the bridge. Otherwise the broker
//! publishes the will, which has the same content.
//!
//! Why the acknowledgements of all states are awaited: the process ends after the DISCONNECT, and its socket is closed.
//! A broker that then cannot write an acknowledgement drops the messages behind it unread.

use std::time::Duration;

use bytes::Bytes;
use tokio::time::{Instant, timeout};

use super::{End, Item, LostError, Message, OFFLINE, Session};
use crate::output::mqtt::delivery::Loss;
use crate::output::mqtt::retained::Priority;

/// The time without an acknowledgement after which the session ends.
const SILENCE: Duration = Duration::from_secs(1);
/// The time after which the session ends, also if the broker acknowledges one message after the other.
const LIMIT: Duration = Duration::from_secs(4);

/// A session that is being ended.
#[derive(Debug)]
pub(super) struct Closing {
    began: Instant,
    ends: Instant,
    /// `true` if the broker has the last state of the bridge.
    pub(super) is_last_state_known: bool,
}

impl Closing {
    fn new(now: Instant) -> Self {
        Self { began: now, ends: now + SILENCE, is_last_state_known: false }
    }

    /// When the session ends at the latest.
    pub(super) fn ends(&self) -> Instant {
        self.ends
    }

    /// Notes that the broker has acknowledged a message.
    pub(super) fn acknowledged(&mut self, now: Instant) {
        self.ends = (now + SILENCE).min(self.began + LIMIT);
    }
}

impl Session<'_> {
    /// Queues the last states.
    pub(super) fn begin_close(&mut self) {
        self.closing = Some(Closing::new(Instant::now()));
        // PLCs that the last member of a fleet has given up are offline.
        self.refresh(false);
        let topic = self.shared.topics.bridge_state();
        self.carried.retained.set(topic, Bytes::from_static(OFFLINE), Priority::First, None);
    }

    /// Returns whether the broker has all states and replies, or the time is up.
    pub(super) fn is_closed(&self, closing: &Closing) -> bool {
        let is_replying = self.window.iter().any(|item| matches!(item, Item::Reply(_)))
            || !self.carried.replies.is_empty()
            || !self.carried.commands.is_empty();
        let is_told = closing.is_last_state_known && self.states_under_way() == 0;
        is_told && !is_replying || closing.ends <= Instant::now()
    }

    /// The states that the broker has not acknowledged, but for that of the bridge.
    fn states_under_way(&self) -> usize {
        let in_flight = self.window.iter().filter(|item| matches!(item, Item::Retained(_))).count();
        self.carried.retained.states() + in_flight
    }

    /// Ends the connection. Unless the broker has the last state, it publishes the will instead.
    pub(super) async fn close(&mut self, is_last_state_known: bool) -> End {
        let states = self.states_under_way();
        if states > 0 {
            tracing::warn!(states, "mqtt: the broker did not take all states before the end");
        }
        if is_last_state_known {
            self.connection.writer.disconnect();
            let written = async {
                while !self.connection.writer.is_idle() {
                    self.connection.writer.write_some().await?;
                }
                Ok::<_, LostError>(())
            };
            // It ends anyway.
            let _ = timeout(SILENCE, written).await;
        }
        End::Stopped
    }

    /// Keeps what was not acknowledged for the next connection.
    pub(super) fn carry(&mut self, ended: &End) {
        let items: Vec<Item> = self.window.drain().collect();
        let positions: Vec<u64> = items.iter().filter_map(Item::position).collect();
        let is_alone = positions.len() == items.len();
        let loss = match (ended, positions.as_slice()) {
            (End::Lost(error), [position]) if error.blames_a_message() && is_alone => Loss::Guilty(*position),
            (End::Lost(error), [_, ..]) if error.blames_a_message() => Loss::Suspect,
            (End::Lost(_) | End::Stopped, _) => Loss::Other,
        };
        self.carried.delivery.lost(loss, Instant::now());
        let replies: Vec<Message> = items.into_iter().filter_map(Item::into_reply).collect();
        replies.into_iter().for_each(|reply| self.carried.push_reply(reply));
    }
}
