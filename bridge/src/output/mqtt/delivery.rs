//! Delivery of batches: which ones may be sent, and which ones are acknowledged in the buffer. No I/O besides
//! the buffer, and no clock.
//!
//! ```text
//!              a connection was lost, perhaps because of a batch
//! Open ────────────────────────────────────────────────────────────▶ Probing
//!  ▲                                                                    │
//!  └────────────────── enough batches are taken ────────────────────────┘
//! ```
//!
//! Batches that the broker refuses, without an end of the connection, are in [`super::refusals`].
//!
//! Invariants:
//! - a batch is acknowledged in the buffer only when it and all before it were taken by the broker, or given up and
//!   counted;
//! - the batches of a PLC are sent in the order of the buffer, and again in that order after a loss or a refusal;
//! - a PLC whose batches are refused holds up no other;
//! - a batch that ends the connections is found, and one that the broker names as the reason is given up;
//! - a batch that was taken or given up is not sent again, also behind one of another PLC that waits.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use tokio::time::Instant;

use super::refusals::{Passed, Refusal, Refusals};
use super::window::{Prefix, Settled};
use crate::buffer::{Cursor, Entry, Fetched};
use crate::output::Health;

/// The batches that are read from the buffer at once.
const MAX_BATCHES: usize = 64;
/// The batches in flight with which all is well again.
const ENOUGH: usize = 64;
/// The batches that wait for the acknowledgement of the first one in the buffer.
const MAX_BEHIND: usize = 1 << 19;
/// The refused PLCs up to which the log names each.
const MAX_NAMED: usize = 3;

/// The batches of a cursor, on all connections of an output.
#[derive(Debug)]
pub(super) struct Delivery {
    cursor: Cursor,
    health: Arc<Health>,
    /// Read, and not sent yet.
    queue: VecDeque<Fetched>,
    prefix: Prefix,
    /// By position.
    in_flight: BTreeMap<u64, InFlight>,
    refusals: Refusals,
    /// `true` if a batch was taken since the last loss of a connection.
    has_progress: bool,
    state: State,
}

#[derive(Debug)]
struct InFlight {
    entry: Entry,
    sent: Instant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Batches are sent.
    Open,
    /// As many batches as this are in flight at once: one at first, and twice as many with each that is taken.
    Probing(usize),
}

/// Why a connection was lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Loss {
    /// Because of one of the batches in flight: the next ones are sent one at a time.
    Suspect,
    /// Because of the batch at this position, which was alone in flight: it is given up.
    Guilty(u64),
    /// For another reason.
    Other,
}

impl Delivery {
    pub(super) fn new(cursor: Cursor, health: Arc<Health>) -> Self {
        Self {
            cursor,
            health,
            queue: VecDeque::new(),
            prefix: Prefix::default(),
            in_flight: BTreeMap::new(),
            refusals: Refusals::default(),
            has_progress: true,
            state: State::Open,
        }
    }

    /// Returns whether [`fetch`](Self::fetch) has something to do.
    pub(super) fn needs_batches(&self) -> bool {
        self.queue.is_empty() && self.has_room_behind() && !self.refusals.is_full()
    }

    fn has_room_behind(&self) -> bool {
        self.prefix.len() < MAX_BEHIND
    }

    /// Waits for batches of the buffer. Cancel-safe.
    pub(super) async fn fetch(&mut self) {
        let fetched = self.cursor.fetch(MAX_BATCHES).await;
        self.queue.extend(fetched);
    }

    /// The batch that is sent now.
    pub(super) fn take(&mut self, now: Instant) -> Option<Entry> {
        match self.state {
            State::Open => {}
            State::Probing(limit) if self.in_flight.len() < limit => {}
            State::Probing(_) => return None,
        }
        // The next ones may have been parked, and one of them be an attempt that is due.
        let Some(entry) = self.refusals.take().or_else(|| self.take_next()).or_else(|| self.refusals.take()) else {
            // Perhaps the last ones were parked.
            self.note_settled();
            return None;
        };
        self.in_flight.insert(entry.position, InFlight { entry: entry.clone(), sent: now });
        Some(entry)
    }

    /// The next batch of the buffer that may be sent.
    fn take_next(&mut self) -> Option<Entry> {
        loop {
            let entry = self.cursor.send(self.queue.pop_front()?);
            if let Some(how) = self.prefix.push(entry.position, &entry.batch.plc) {
                self.settle(entry.position, how);
                continue;
            }
            match self.refusals.pass(entry) {
                Passed::Send(entry) => return Some(entry),
                Passed::Parked => {}
                Passed::Dropped(entry) => self.drop_batch(&entry),
            }
        }
    }

    /// When the next attempt after a refusal is due.
    pub(super) fn due(&self) -> Option<Instant> {
        self.refusals.due()
    }

    /// Begins the attempts that are due.
    pub(super) fn resume(&mut self, now: Instant) {
        self.refusals.resume(now);
    }

    /// Notes that the broker has taken a batch.
    pub(super) fn taken(&mut self, position: u64, now: Instant) {
        let Some(InFlight { entry, .. }) = self.in_flight.remove(&position) else { return };
        self.health.count(entry.batch.samples);
        self.has_progress = true;
        self.settle(position, Settled::Taken);
        if let State::Probing(limit) = self.state {
            self.state = if limit < ENOUGH { State::Probing(limit.saturating_mul(2)) } else { State::Open };
        }
        if self.refusals.taken(&entry.batch.plc, now) {
            let plc = &*entry.batch.plc;
            self.health.set_plc_refused(plc, false);
            self.health.set_refusal(self.refusals.summary());
            tracing::info!(plc, "mqtt: the broker takes the batches of this PLC again");
            // Some were dropped, and others come as replays.
            self.want_present_values();
        }
        self.note_settled();
    }

    /// Notes that a batch is given up: the broker can never take it.
    pub(super) fn skip(&mut self, position: u64, now: Instant) {
        self.health.count_skipped();
        self.settle(position, Settled::GivenUp);
        if let Some(InFlight { entry, .. }) = self.in_flight.remove(&position) {
            self.refusals.skipped(&entry.batch.plc, now);
        }
        self.note_settled();
    }

    /// Notes that a batch was refused. It is sent again, unless its PLC is given up.
    pub(super) fn refused(&mut self, position: u64, why: &str, now: Instant) {
        let Some(InFlight { entry, .. }) = self.in_flight.remove(&position) else { return };
        let plc = entry.batch.plc.clone();
        let (refusal, dropped) = self.refusals.refused(entry, why, now);
        match refusal {
            Refusal::New(count) => {
                self.health.set_plc_refused(&plc, true);
                if count <= MAX_NAMED {
                    tracing::warn!(plc = &*plc, why, "mqtt: the batches of this PLC are kept, and sent again");
                } else if count.is_power_of_two() {
                    tracing::warn!(why, "mqtt: the batches of {count} PLCs are kept, and sent again");
                }
            }
            Refusal::Again | Refusal::Dropped => {}
        }
        dropped.iter().for_each(|entry| self.drop_batch(entry));
        self.health.set_refusal(self.refusals.summary());
        self.note_settled();
    }

    /// Gives up PLCs that were refused for long, or that take too much room, while others are taken.
    pub(super) fn give_up(&mut self, now: Instant) {
        for (number, (plc, parked)) in self.refusals.give_up(!self.has_room_behind(), now).into_iter().enumerate() {
            if number < MAX_NAMED {
                let batches = parked.len();
                tracing::warn!(
                    plc = &*plc,
                    batches,
                    "mqtt: the batches of this PLC are dropped until the broker takes one: it takes those of others"
                );
            }
            parked.iter().for_each(|entry| self.drop_batch(entry));
        }
    }

    /// Returns whether the batches of a PLC are refused.
    pub(super) fn has_refused(&self) -> bool {
        !self.refusals.is_empty()
    }

    /// Notes which PLCs are configured: a removed one is no failure of the output any more. Its batches are kept as
    /// before.
    pub(super) fn configured(&mut self, is_configured: impl Fn(&str) -> bool) {
        let changed = self.refusals.configured(&is_configured);
        changed.iter().for_each(|plc| self.health.set_plc_refused(plc, is_configured(plc)));
        if !changed.is_empty() {
            self.health.set_refusal(self.refusals.summary());
        }
    }

    /// Drops a batch of a PLC that is given up.
    fn drop_batch(&mut self, entry: &Entry) {
        self.health.count_plc_dropped(&entry.batch.plc);
        self.settle(entry.position, Settled::GivenUp);
    }

    /// Asks for the present values of all tags.
    pub(super) fn want_present_values(&self) {
        self.cursor.want_present_values();
    }

    /// When the first batch was sent that has no answer.
    pub(super) fn oldest(&self) -> Option<Instant> {
        self.in_flight.values().map(|batch| batch.sent).min()
    }

    /// Returns whether batches are sent one at a time.
    pub(super) fn is_probing(&self) -> bool {
        self.state == State::Probing(1)
    }

    /// Returns whether such a batch is in flight: nothing else is sent then, so that it alone is the reason if
    /// the broker ends the connection.
    pub(super) fn is_probing_in_flight(&self) -> bool {
        self.is_probing() && !self.in_flight.is_empty()
    }

    /// Notes that the connection was lost: all that was neither taken nor given up is sent again.
    pub(super) fn lost(&mut self, loss: Loss, now: Instant) {
        if let Loss::Guilty(position) = loss {
            self.health.count_skipped();
            self.settle(position, Settled::GivenUp);
        }
        // Twice without progress, although batches were sent: perhaps because of one of them.
        let is_fruitless = !self.in_flight.is_empty() && !std::mem::replace(&mut self.has_progress, false);
        if loss != Loss::Other || self.state != State::Open || is_fruitless {
            self.state = State::Probing(1);
        }
        self.prefix.rewind();
        self.queue.clear();
        self.in_flight.clear();
        self.refusals.rewind(now);
        self.cursor.rewind();
    }

    /// Tells the buffer which batches wait for nothing, or for an end of the refusal of their PLC alone. They are
    /// behind one that is not acknowledged.
    fn note_settled(&self) {
        if self.refusals.is_empty() || self.refusals.has_ready() {
            return;
        }
        let is_awaited = |batch: &&InFlight| !self.refusals.is_refused(&batch.entry.batch.plc);
        let first = self.in_flight.values().find(is_awaited).map(|batch| batch.entry.position);
        self.cursor.settled_before(first.unwrap_or(u64::MAX));
    }

    /// Settles a batch, and acknowledges those at the front in the buffer.
    fn settle(&mut self, position: u64, how: Settled) {
        if let Some(last) = self.prefix.settle(position, how) {
            self.cursor.acknowledge(last);
        }
    }
}

#[cfg(test)]
mod tests;
