use std::sync::Arc;

use super::builder::PoolSettings;
use super::error::PoolError;
use crate::endpoint::{Endpoint, Transport};
use crate::link::{Link, LinkStats};
use crate::wire::Framing;

/// The identity of an endpoint. The framing is no part of it where all links would share one line.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct EndpointKey {
    transport: Transport,
    framing: Option<Framing>,
}

impl EndpointKey {
    pub(super) fn of(endpoint: &Endpoint) -> Self {
        let transport = endpoint.transport();
        let framing = (!transport.is_one_line()).then(|| endpoint.framing());
        Self { transport: transport.identity(), framing }
    }
}

/// An endpoint and its links.
#[derive(Debug)]
pub(super) struct EndpointLinks {
    /// Shared with the links.
    pub(super) endpoint: Arc<Endpoint>,
    pub(super) links: Vec<Link>,
    /// The time of the last request for it, by the pool's logical clock.
    pub(super) requested_at: u64,
    /// The statistics of closed links; boxed, since most endpoints have none.
    closed_traffic: Option<Box<LinkStats>>,
}

impl EndpointLinks {
    pub(super) fn new(endpoint: Endpoint, requested_at: u64) -> Self {
        Self { endpoint: Arc::new(endpoint), links: Vec::new(), requested_at, closed_traffic: None }
    }

    /// Returns the link for one more handle.
    pub(super) fn link(
        &mut self,
        endpoint: &Endpoint,
        requested_at: u64,
        settings: &PoolSettings,
    ) -> Result<Link, PoolError> {
        self.remove_closed();
        let one_line = endpoint.transport().is_one_line();
        if one_line && *self.endpoint != *endpoint {
            if !self.is_unused() {
                let (asked, known) = (endpoint.to_string(), self.endpoint.to_string());
                return Err(PoolError::OtherSettings { asked, known });
            }
            // No handle uses the old settings.
            self.closed_traffic = Some(Box::new(self.traffic()));
            self.links.clear();
            self.endpoint = Arc::new(endpoint.clone());
        }
        self.requested_at = requested_at;
        let limit = if one_line { 1 } else { settings.links_per_endpoint };
        let idlest = self.links.iter().min_by_key(|link| link.handles());
        match idlest {
            Some(link) if self.links.len() >= limit || link.handles() == 1 => Ok(link.clone()),
            Some(_) | None => {
                let same = *self.endpoint == *endpoint;
                let endpoint = if same { self.endpoint.clone() } else { Arc::new(endpoint.clone()) };
                let link = settings.link(&endpoint);
                // Mostly it is the only one.
                self.links.reserve_exact(1);
                self.links.push(link.clone());
                Ok(link)
            }
        }
    }

    /// Returns whether its links have no handles outside of the pool.
    pub(super) fn is_unused(&self) -> bool {
        self.links.iter().all(|link| link.handles() == 1)
    }

    /// Returns the sum of the statistics of its links, including closed ones.
    pub(super) fn traffic(&self) -> LinkStats {
        let closed = self.closed_traffic.as_deref().copied().unwrap_or_default();
        self.links.iter().fold(closed, |sum, link| sum.plus(&link.stats()))
    }

    /// Removes links that were closed through a handle or ended with their runtime.
    fn remove_closed(&mut self) {
        let traffic = &mut self.closed_traffic;
        self.links.retain(|link| {
            let closed = link.is_closed();
            if closed {
                let traffic = traffic.get_or_insert_default();
                **traffic = traffic.plus(&link.stats());
            }
            !closed
        });
    }
}
