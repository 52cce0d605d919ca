//! State that all sessions of a bus share: rules, the use of the line, and left-over replies.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::debug;

use super::replies::{FollowUp, OutgoingReply, ReplyPiece};
use crate::sim::fault::left_over::MAX_LEFT_OVER;
use crate::sim::fault::timing::later;
use crate::sim::fault::{Faults, Line};

/// Conditions of a bus with faults. A handle: clones share the same state.
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

/// Ends of the current use of the two directions of the line, and of each station.
#[derive(Debug, Default)]
pub(super) struct Occupancy {
    incoming: Option<Instant>,
    outgoing: Option<Instant>,
    stations: BTreeMap<u8, Instant>,
}

impl Occupancy {
    /// Occupies the line for a request of these bytes, and returns its time of arrival.
    pub(super) fn receive(&mut self, now: Instant, line: &Line, bytes: usize) -> Instant {
        let outgoing = self.outgoing.filter(|_| line.is_half_duplex());
        let end = later(free_at(self.incoming.max(outgoing), now), line.transmission(bytes));
        self.incoming = Some(end);
        end
    }

    /// Returns whether a request begins while the driver of the last reply still holds the line.
    pub(super) fn is_held(&self, now: Instant, turnaround: Duration) -> bool {
        let begins = free_at(self.incoming, now);
        !turnaround.is_zero() && self.outgoing.is_some_and(|end| begins < later(end, turnaround))
    }

    /// Occupies a station for a request, and returns the times of its execution and of its reply.
    pub(super) fn serve(
        &mut self,
        station: u8,
        arrived: Instant,
        response_time: Duration,
        delay: Duration,
    ) -> (Instant, Instant) {
        let execute_at = later(free_at(self.stations.get(&station).copied(), arrived), response_time);
        let ready_at = later(execute_at, delay);
        self.stations.insert(station, ready_at);
        (execute_at, ready_at)
    }

    /// Occupies the line for a reply that takes this time, and returns the beginning of its transmission.
    pub(super) fn send(&mut self, ready_at: Instant, line: &Line, transmission: Duration) -> Instant {
        let incoming = self.incoming.filter(|_| line.is_half_duplex());
        let start = free_at(self.outgoing.max(incoming), ready_at);
        self.outgoing = Some(later(start, transmission));
        start
    }
}

fn free_at(occupied_until: Option<Instant>, now: Instant) -> Instant {
    occupied_until.map_or(now, |until| until.max(now))
}

/// Replies whose connection has ended, for the next connection.
#[derive(Debug, Default)]
pub(crate) struct LeftOvers {
    queue: Mutex<LeftOverQueue>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct LeftOverQueue {
    /// Number of connections so far. The number of a connection is its place among them, from 1.
    connections: u64,
    /// Each with the number of its connection, and its time.
    waiting: VecDeque<(u64, Instant, LeftOverPart)>,
}

/// A reply, or the part of it that was not sent when its connection ended.
#[derive(Debug)]
pub(super) enum LeftOverPart {
    Reply(Box<OutgoingReply>),
    FollowUp(Box<FollowUp>),
    Pieces(VecDeque<ReplyPiece>),
}

impl LeftOvers {
    /// Counts a new connection, and returns its number.
    pub(super) fn connect(&self) -> u64 {
        let mut queue = self.lock();
        queue.connections += 1;
        queue.connections
    }

    /// Keeps a reply of a connection that has ended. Discards it if the queue is full.
    pub(super) fn put(&self, connection: u64, at: Instant, part: LeftOverPart) {
        let mut queue = self.lock();
        if queue.waiting.len() < MAX_LEFT_OVER {
            queue.waiting.push_back((connection, at, part));
        } else {
            debug!("the queue of replies for the next connection is full");
        }
        drop(queue);
        self.changed.notify_waiters();
    }

    /// Takes the replies of other connections, with their times. Empty unless `connection` is the
    /// latest one.
    pub(super) fn take(&self, connection: u64) -> Vec<(Instant, LeftOverPart)> {
        let mut queue = self.lock();
        if queue.connections != connection || queue.waiting.is_empty() {
            return Vec::new();
        }
        let (own, others): (VecDeque<_>, VecDeque<_>) =
            queue.waiting.drain(..).partition(|&(from, ..)| from == connection);
        queue.waiting = own;
        others.into_iter().map(|(_, at, part)| (at, part)).collect()
    }

    /// Notifies of each [`put`](Self::put).
    pub(crate) fn changed(&self) -> &Notify {
        &self.changed
    }

    fn lock(&self) -> MutexGuard<'_, LeftOverQueue> {
        // Nothing panics under the lock.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
