use super::slot::Slot;
use crate::endpoint::Endpoint;
use crate::link::{LinkState, LinkStats};

/// A pool as a whole. A snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PoolStats {
    /// The endpoints that the pool has.
    pub endpoints: usize,
    /// Their links: the sum of the following six.
    pub links: usize,
    /// Links without a connection, because nobody has asked for one yet or for long.
    pub idle: usize,
    /// Links that wait for their turn to connect, and were idle before.
    pub waiting: usize,
    /// Links that are connecting.
    pub connecting: usize,
    /// Links with a connection.
    pub up: usize,
    /// Links that have lost their connection or could not open one; they may be waiting to try again.
    pub down: usize,
    /// Links that have been closed.
    pub closed: usize,
    /// Endpoints that were forgotten to make room for others, since the pool was made.
    pub evicted: u64,
    /// What has gone over all links together since the pool was made, those that are gone included. Of
    /// [round trips](crate::StationStats::round_trip) the mean is a rough one.
    pub traffic: LinkStats,
}

/// An endpoint of a pool. A snapshot.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct PoolEndpoint {
    /// Where it is.
    pub endpoint: Endpoint,
    /// What each of its links is doing.
    pub links: Vec<LinkState>,
    /// What has gone over its links.
    pub traffic: LinkStats,
}

impl PoolStats {
    pub(super) fn count(&mut self, slot: &Slot) {
        let add = |counter: &mut usize| *counter = counter.saturating_add(1);
        add(&mut self.endpoints);
        for link in &slot.links {
            add(&mut self.links);
            add(match link.state() {
                LinkState::Idle => &mut self.idle,
                LinkState::Waiting => &mut self.waiting,
                LinkState::Connecting => &mut self.connecting,
                LinkState::Up => &mut self.up,
                LinkState::Down { .. } => &mut self.down,
                LinkState::Closed => &mut self.closed,
            });
        }
        self.traffic = self.traffic.plus(&slot.traffic());
    }
}

impl PoolEndpoint {
    pub(super) fn of(slot: &Slot) -> Self {
        Self {
            endpoint: slot.endpoint.clone(),
            links: slot.links.iter().map(|link| link.state()).collect(),
            traffic: slot.traffic(),
        }
    }
}
