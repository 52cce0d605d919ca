//! The pool: links to many PLCs by endpoint, made on demand and shared by all users of an endpoint.
//!
//! ```text
//! endpoint   absent ──station()──▶ present ──room needed, no handle left──▶ absent
//! link       idle ──a call──▶ waiting ──permit──▶ connecting ──▶ up ──idle timeout──▶ idle
//!                               ▲                       └──fails──▶ down ◀──lost──┘
//!                               └──back-off, and a call is waiting───┘
//! ```
//!
//! The pool is a map and a connect limiter; it has no task and does no I/O. Each link manages its
//! own connection: it opens it with the first call, reopens it after a loss, and closes it after
//! the [idle timeout](PoolBuilder::idle_timeout). The link itself stays, without socket and
//! buffers, so a [`Station`] works as long as it is kept: its next call opens the connection again.
//!
//! Invariants:
//! - an endpoint has at most [`PoolBuilder::links_per_endpoint`] links; a serial port has one,
//!   regardless of the requested settings;
//! - there are at most [`PoolBuilder::max_endpoints`] endpoints;
//! - the connections opened at once, and on average per second, are bounded. Links wait at a shared
//!   connect limiter while the deadlines of their callers run;
//! - a link with handles outside of the pool is never evicted: to make room, the pool evicts the
//!   least recently requested endpoint without handles;
//! - after [`Pool::close`] all links are closed.

mod builder;
mod endpoint_links;
mod error;
mod eviction;
mod stats;

use std::cell::RefCell;
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use futures::future::join_all;

use self::builder::PoolSettings;
use self::endpoint_links::{EndpointKey, EndpointLinks};
use self::eviction::{EvictionOrder, Use};
use crate::endpoint::Endpoint;
use crate::link::{Link, LinkStats};
use crate::station::Station;

pub use self::builder::PoolBuilder;
pub use self::error::PoolError;
pub use self::stats::{PoolEndpoint, PoolStats};

/// A pool of links to many PLCs, one per endpoint, shared by all users of the endpoint.
///
/// Cheap to clone; all clones are the same pool. [`station`](Self::station) does no I/O: the first
/// call opens the connection, the idle timeout closes it, and the next call opens it again.
/// Stations stay usable after the pool is dropped.
///
/// ```
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// use fatek::sim::{Bus, Plc, Server};
/// use fatek::{Pool, register, wire::Framing};
///
/// // Simulated PLCs; real ones have endpoints such as "tcp://10.0.0.7:500".
/// let mut servers = Vec::new();
/// for _ in 0..3 {
///     let bus = Bus::new().with_station(1, Plc::new())?;
///     servers.push(Server::bind("127.0.0.1:0", bus, Framing::Ascii).await?);
/// }
///
/// let pool = Pool::new();
/// for server in &servers {
///     let station = pool.station(server.local_addr(), 1)?;
///     assert_eq!(station.read_registers(register!("R0"), 2).await?, [0, 0]);
/// }
/// assert_eq!(pool.stats().up, 3);
/// pool.close().await;
/// # Ok(())
/// # }
/// ```
#[derive(Clone)]
pub struct Pool {
    shared: Arc<PoolShared>,
}

struct PoolShared {
    settings: PoolSettings,
    state: Mutex<PoolState>,
}

#[derive(Default)]
struct PoolState {
    /// Boxed, because a hash map allocates up to twice as many places as it has entries.
    endpoints: HashMap<Arc<EndpointKey>, Box<EndpointLinks>>,
    eviction: EvictionOrder<Arc<EndpointKey>>,
    /// The number of stations requested: a logical clock for eviction.
    requests: u64,
    /// The number of evicted endpoints.
    evicted: u64,
    /// The statistics of their links.
    evicted_traffic: LinkStats,
    closed: bool,
}

impl Pool {
    /// Makes a pool with the default settings.
    #[must_use]
    pub fn new() -> Self {
        Self::builder().build()
    }

    /// Returns a builder with the default settings.
    pub fn builder() -> PoolBuilder {
        PoolBuilder::new()
    }

    /// Returns the station with this number, 1 to 254, at an endpoint.
    ///
    /// The endpoint is an [`Endpoint`], its text, or a socket address. All stations of an endpoint
    /// share its link. If several links per endpoint are allowed, a new one is made while all
    /// existing ones have handles; then the one with the fewest handles is used. Handles may be
    /// kept or requested each time.
    ///
    /// ```
    /// use fatek::Pool;
    ///
    /// let pool = Pool::new();
    /// let station = pool.station("tcp://10.0.0.7:500", 1)?;
    /// assert!(pool.station("tcp://10.0.0.7:fivehundred", 1).is_err());
    /// # Ok::<(), fatek::PoolError>(())
    /// ```
    ///
    /// # Errors
    /// - [`PoolError::Endpoint`] if the text is not an endpoint;
    /// - [`PoolError::Invalid`] if the number is not that of a station;
    /// - [`PoolError::Full`] if the maximum of endpoints is reached and all of them have handles;
    /// - [`PoolError::OtherSettings`] if the serial port is in use with other settings;
    /// - [`PoolError::Closed`] after [`close`](Self::close).
    pub fn station<E>(&self, endpoint: E, station: u8) -> Result<Station, PoolError>
    where
        E: TryInto<Endpoint>,
        PoolError: From<E::Error>,
    {
        let endpoint = endpoint.try_into()?;
        // Checked first: an invalid number must not evict another endpoint.
        Station::check_number(station)?;
        Ok(self.link(&endpoint)?.station(station)?)
    }

    /// Returns the sum over all links. Locks each of them: call it every second, not per call.
    #[must_use]
    pub fn stats(&self) -> PoolStats {
        let state = self.lock();
        let mut stats = PoolStats { evicted: state.evicted, traffic: state.evicted_traffic, ..PoolStats::default() };
        state.endpoints.values().for_each(|links| stats.count(links));
        stats
    }

    /// Returns each endpoint of the pool with the state and traffic of its links, in no order.
    ///
    /// ```
    /// # let pool = fatek::Pool::new();
    /// for endpoint in pool.endpoints() {
    ///     println!("{}: {:?}, {} replies", endpoint.endpoint, endpoint.links, endpoint.traffic.stations.replies);
    /// }
    /// ```
    #[must_use]
    pub fn endpoints(&self) -> Vec<PoolEndpoint> {
        self.lock().endpoints.values().map(|links| PoolEndpoint::of(links)).collect()
    }

    /// Closes all links concurrently, for all their handles, and waits until they are closed.
    ///
    /// [`station`](Self::station) fails afterwards. See [`Link::close`]. If the future is dropped,
    /// some links may stay open; call it again to close them.
    pub async fn close(&self) {
        let links: Vec<Link> = {
            let mut state = self.lock();
            state.closed = true;
            state.endpoints.values().flat_map(|links| links.links.iter().cloned()).collect()
        };
        join_all(links.iter().map(Link::close)).await;
    }

    /// Closes the links of one endpoint, for all their handles, and waits until they are closed: the
    /// request on the wire is finished, and the connection is closed. See [`Link::close`].
    ///
    /// For a PLC that another master is to take over. Without links of the endpoint, nothing happens.
    /// The endpoint can be requested again: [`station`](Self::station) then makes a new link. Request it after
    /// this has returned, or the new link may connect while the request of the closed one ends.
    /// Handles of the closed one stay closed. If the future is dropped, some links may stay open; call it
    /// again to close them.
    ///
    /// ```
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// use fatek::sim::{self, Bus, Plc};
    /// use fatek::{Endpoint, Pool};
    ///
    /// let bus = Bus::new().with_station(1, Plc::new())?;
    /// let pool = Pool::builder().connector(move |endpoint| sim::connector(bus.clone(), endpoint.framing())()).build();
    /// let endpoint: Endpoint = "tcp://bench".parse()?;
    /// let station = pool.station(endpoint.clone(), 1)?;
    /// station.read_status().await?;
    ///
    /// pool.close_endpoint(&endpoint).await;
    /// assert!(station.read_status().await.is_err());
    /// pool.station(endpoint, 1)?.read_status().await?;
    /// # Ok(())
    /// # }
    /// ```
    pub async fn close_endpoint(&self, endpoint: &Endpoint) {
        let links = self.lock().endpoints.get(&EndpointKey::of(endpoint)).map(|links| links.links.clone());
        join_all(links.iter().flatten().map(Link::close)).await;
    }

    fn link(&self, endpoint: &Endpoint) -> Result<Link, PoolError> {
        let settings = &self.shared.settings;
        let mut state = self.lock();
        if state.closed {
            return Err(PoolError::Closed);
        }
        state.requests = state.requests.saturating_add(1);
        let requested_at = state.requests;
        let key = EndpointKey::of(endpoint);
        let state = &mut *state;
        let links = match state.endpoints.get_mut(&key) {
            Some(links) => links,
            None => {
                if state.endpoints.len() >= settings.max_endpoints {
                    state.make_room(endpoint, settings.max_endpoints)?;
                }
                let key = Arc::new(key);
                state.eviction.insert(requested_at, key.clone());
                let links = EndpointLinks::new(endpoint.clone(), requested_at);
                state.endpoints.entry(key).or_insert(Box::new(links))
            }
        };
        links.link(endpoint, requested_at, settings)
    }

    fn lock(&self) -> MutexGuard<'_, PoolState> {
        // No code under this lock leaves the map inconsistent, so a poisoned lock is usable.
        self.shared.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PoolState {
    /// Evicts the least recently requested endpoint without handles.
    fn make_room(&mut self, endpoint: &Endpoint, limit: usize) -> Result<(), PoolError> {
        let endpoints = RefCell::new(&mut self.endpoints);
        let in_use = |key: &Arc<EndpointKey>| {
            let endpoints = endpoints.borrow();
            let links = endpoints.get(key);
            debug_assert!(links.is_some(), "each endpoint of the order is in the pool");
            let has_handles = links.is_some_and(|links| !links.is_unused());
            Use { requested_at: links.map_or(0, |links| links.requested_at), has_handles }
        };
        let requested = |key: &Arc<EndpointKey>| {
            self.requests = self.requests.saturating_add(1);
            if let Some(links) = endpoints.borrow_mut().get_mut(key) {
                links.requested_at = self.requests;
            }
            self.requests
        };
        let oldest = self.eviction.evict(in_use, requested);
        let links = oldest.and_then(|key| self.endpoints.remove(&key));
        let links = links.ok_or_else(|| PoolError::Full { endpoint: endpoint.to_string(), limit })?;
        self.evicted = self.evicted.saturating_add(1);
        self.evicted_traffic = self.evicted_traffic.plus(&links.traffic());
        Ok(())
    }
}

impl Default for Pool {
    fn default() -> Self {
        Self::new()
    }
}

impl fmt::Debug for Pool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Pool({} endpoints)", self.lock().endpoints.len())
    }
}
