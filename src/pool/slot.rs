use super::builder::Settings;
use super::error::PoolError;
use crate::endpoint::{Endpoint, Transport};
use crate::link::{Link, LinkStats};
use crate::wire::Framing;

/// What makes two endpoints the same: of a serial port its path alone, for there is one line behind it.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) enum Key {
    Tcp(String, u16, Framing),
    Udp(String, u16, Framing),
    Serial(String),
}

impl Key {
    pub(super) fn of(endpoint: &Endpoint) -> Self {
        let framing = endpoint.framing();
        // Names of hosts are the same in either case.
        match endpoint.transport() {
            Transport::Tcp { host, port } => Self::Tcp(host.to_ascii_lowercase(), *port, framing),
            Transport::Udp { host, port } => Self::Udp(host.to_ascii_lowercase(), *port, framing),
            Transport::Serial { path, .. } => Self::Serial(path.clone()),
        }
    }
}

/// An endpoint and its links.
#[derive(Debug)]
pub(super) struct Slot {
    pub(super) endpoint: Endpoint,
    pub(super) links: Vec<Link>,
    /// When it was asked for last, counted in such questions.
    pub(super) asked_at: u64,
    /// What the links counted that are closed.
    closed_traffic: LinkStats,
}

impl Slot {
    pub(super) fn new(endpoint: Endpoint) -> Self {
        Self { endpoint, links: Vec::new(), asked_at: 0, closed_traffic: LinkStats::default() }
    }

    /// The link for one more handle.
    pub(super) fn link(&mut self, endpoint: &Endpoint, asked_at: u64, settings: &Settings) -> Result<Link, PoolError> {
        self.forget_closed();
        let serial = matches!(endpoint.transport(), Transport::Serial { .. });
        if serial && self.endpoint != *endpoint {
            if !self.is_unused() {
                let (asked, known) = (endpoint.to_string(), self.endpoint.to_string());
                return Err(PoolError::OtherSettings { asked, known });
            }
            // Nobody uses the line as it was.
            self.closed_traffic = self.traffic();
            self.links.clear();
            self.endpoint = endpoint.clone();
        }
        self.asked_at = asked_at;
        let limit = if serial { 1 } else { settings.links_per_endpoint };
        let idlest = self.links.iter().min_by_key(|link| link.handles());
        match idlest {
            Some(link) if self.links.len() >= limit || link.handles() == 1 => Ok(link.clone()),
            _ => {
                let link = settings.link(endpoint);
                self.links.push(link.clone());
                Ok(link)
            }
        }
    }

    /// Whether only the pool itself holds its links.
    pub(super) fn is_unused(&self) -> bool {
        self.links.iter().all(|link| link.handles() == 1)
    }

    pub(super) fn traffic(&self) -> LinkStats {
        self.links.iter().fold(self.closed_traffic, |sum, link| sum.plus(&link.stats()))
    }

    /// A link can be closed through any of its handles, and ends with the runtime of its task.
    fn forget_closed(&mut self) {
        let traffic = &mut self.closed_traffic;
        self.links.retain(|link| {
            let closed = link.is_closed();
            if closed {
                *traffic = traffic.plus(&link.stats());
            }
            !closed
        });
    }
}
