//! What all connections of a bus share: the line, its stations, and replies whose connection has ended.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::debug;

use super::answers::{FollowUp, Piece, Speech};
use crate::sim::fault::Faults;

/// What a bus that is not as it should be has besides its PLCs. Clones are the same.
#[derive(Clone, Debug)]
pub(crate) struct Conditions {
    pub(super) faults: Faults,
    occupancy: Arc<Mutex<Occupancy>>,
    left_overs: Arc<LeftOvers>,
}

impl Conditions {
    pub(crate) fn new(faults: Faults) -> Self {
        Self { faults, occupancy: Arc::default(), left_overs: Arc::default() }
    }

    pub(crate) fn faults(&self) -> &Faults {
        &self.faults
    }

    pub(super) fn occupancy(&self) -> MutexGuard<'_, Occupancy> {
        // Nothing panics under the lock.
        self.occupancy.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn left_overs(&self) -> &Arc<LeftOvers> {
        &self.left_overs
    }
}

/// Until when the parts of a bus are taken.
#[derive(Debug, Default)]
pub(super) struct Occupancy {
    incoming: Option<Instant>,
    outgoing: Option<Instant>,
    stations: BTreeMap<u8, Instant>,
}

impl Occupancy {
    /// When something that begins to come now has come.
    pub(super) fn receive(&mut self, now: Instant, takes: Duration) -> Instant {
        let end = later(free(self.incoming, now), takes);
        self.incoming = Some(end);
        end
    }

    /// When a station executes a request, and when it is ready with its reply.
    pub(super) fn serve(
        &mut self,
        station: u8,
        arrived: Instant,
        turnaround: Duration,
        delay: Duration,
    ) -> (Instant, Instant) {
        let execute_at = later(free(self.stations.get(&station).copied(), arrived), turnaround);
        let ready_at = later(execute_at, delay);
        self.stations.insert(station, ready_at);
        (execute_at, ready_at)
    }

    /// When something that is ready begins to go out.
    pub(super) fn send(&mut self, ready: Instant, takes: Duration) -> Instant {
        let start = free(self.outgoing, ready);
        self.outgoing = Some(later(start, takes));
        start
    }
}

fn free(taken_until: Option<Instant>, now: Instant) -> Instant {
    taken_until.map_or(now, |until| until.max(now))
}

/// A day is longer than any test waits, and still within what a clock can hold.
pub(super) fn later(at: Instant, by: Duration) -> Instant {
    at.checked_add(by.min(Duration::from_secs(86_400))).unwrap_or(at)
}

/// The replies whose connection has ended, for the next one.
#[derive(Debug, Default)]
pub(crate) struct LeftOvers {
    queue: Mutex<Queue>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct Queue {
    /// How many connections there were. The number of a connection is its place among them, from 1 on.
    connections: u64,
    /// Each with the number of the connection that it comes from.
    waiting: VecDeque<(u64, Instant, Remainder)>,
}

/// What is left of a reply.
#[derive(Debug)]
pub(super) enum Remainder {
    Reply(Box<Speech>),
    FollowUp(Box<FollowUp>),
    Pieces(VecDeque<Piece>),
}

/// How many replies wait for the next connection; further ones are lost.
pub(in crate::sim::fault) const MAX_LEFT_OVER: usize = 64;

impl LeftOvers {
    /// Counts a connection, and returns its number.
    pub(super) fn connect(&self) -> u64 {
        let mut queue = self.lock();
        queue.connections += 1;
        queue.connections
    }

    /// Keeps what the connection with this number has not sent.
    pub(super) fn put(&self, from: u64, at: Instant, remainder: Remainder) {
        let mut queue = self.lock();
        if queue.waiting.len() < MAX_LEFT_OVER {
            queue.waiting.push_back((from, at, remainder));
        } else {
            debug!("too many replies wait for the next connection");
        }
        drop(queue);
        self.changed.notify_waiters();
    }

    /// What the connection with this number sends for earlier ones, and when at the earliest: nothing, if it is not the
    /// latest connection.
    pub(super) fn take(&self, connection: u64) -> Vec<(Instant, Remainder)> {
        let mut queue = self.lock();
        if queue.connections != connection || queue.waiting.is_empty() {
            return Vec::new();
        }
        let (own, others): (VecDeque<_>, VecDeque<_>) =
            queue.waiting.drain(..).partition(|&(from, ..)| from == connection);
        queue.waiting = own;
        others.into_iter().map(|(_, at, remainder)| (at, remainder)).collect()
    }

    /// Signals that something has been put.
    pub(crate) fn changed(&self) -> &Notify {
        &self.changed
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        // Nothing panics under the lock.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
