use super::endpoint_links::EndpointLinks;
use crate::endpoint::Endpoint;
use crate::link::{LinkState, LinkStats};

/// Statistics of a [`Pool`](super::Pool). A snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct PoolStats {
    /// Endpoints in the pool.
    pub endpoints: usize,
    /// Links of the endpoints: the sum of the following six.
    pub links: usize,
    /// Links without a connection: not called yet, or idle for long.
    pub idle: usize,
    /// Links that were idle and wait for a permit to connect.
    pub waiting: usize,
    /// Links that are connecting.
    pub connecting: usize,
    /// Links with a connection.
    pub up: usize,
    /// Links that lost their connection or failed to open it; they may be waiting to retry.
    pub down: usize,
    /// Links that have been closed.
    pub closed: usize,
    /// Endpoints evicted since the pool was made.
    pub evicted: u64,
    /// Traffic of all links since the pool was made, including closed and evicted ones.
    ///
    /// The mean of [round trips](crate::StationStats::round_trip) is approximate.
    pub traffic: LinkStats,
}

/// Statistics of an endpoint of a pool. A snapshot.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct PoolEndpoint {
    /// The endpoint.
    pub endpoint: Endpoint,
    /// The state of each link.
    pub links: Vec<LinkState>,
    /// The traffic of its links.
    pub traffic: LinkStats,
}

impl PoolStats {
    pub(super) fn count(&mut self, endpoint: &EndpointLinks) {
        let add = |counter: &mut usize| *counter = counter.saturating_add(1);
        add(&mut self.endpoints);
        for link in &endpoint.links {
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
        self.traffic = self.traffic.plus(&endpoint.traffic());
    }
}

impl PoolEndpoint {
    pub(super) fn of(links: &EndpointLinks) -> Self {
        Self {
            endpoint: Endpoint::clone(&links.endpoint),
            links: links.links.iter().map(|link| link.state()).collect(),
            traffic: links.traffic(),
        }
    }
}
