//! The pool: links to many PLCs, made when they are first asked for and shared by all that ask for the same endpoint.
//!
//! ```text
//! endpoint   unknown ──station()──▶ known ──room needed, no handle left──▶ unknown
//! link       idle ──a call──▶ waiting ──its turn──▶ connecting ──▶ up ──no call for long──▶ idle
//!                               ▲                       └──fails──▶ down ◀──lost──┘
//!                               └──back-off, and a call that waits───┘
//! ```
//!
//! The pool is a map and a gate; it has no task and does no I/O. All that a link can do by itself it does by itself: it
//! opens its connection with the first call, opens it again after a loss, and closes it when it has not been used for the
//! [idle timeout](PoolBuilder::idle_timeout). What falls idle is the *connection*: the link stays, so a [`Station`] goes
//! on working for as long as it is kept, and its next call opens the connection again. An idle link has no socket and no
//! buffers.
//!
//! What must always hold:
//! - an endpoint has no more links than [`PoolBuilder::links_per_endpoint`] says, and a serial port has one, whatever
//!   settings it is asked for with;
//! - there are no more endpoints than [`PoolBuilder::max_endpoints`] says;
//! - no more connections are being opened at once, and on average no more a second, than the pool's limits say: links
//!   wait for their turn at a gate that they share, and the callers' deadlines go on meanwhile;
//! - a link with handles outside the pool is never taken from them: to make room, the pool forgets the endpoint that was
//!   asked for longest ago among those without handles;
//! - after [`Pool::close`] there is no link that is not closed.

mod builder;
mod error;
mod slot;
mod stats;

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use futures::future::join_all;

use self::builder::Settings;
use self::slot::{Key, Slot};
use crate::endpoint::Endpoint;
use crate::link::{Link, LinkStats};
use crate::station::Station;

pub use self::builder::PoolBuilder;
pub use self::error::PoolError;
pub use self::stats::{PoolEndpoint, PoolStats};

/// Links to many PLCs, one an endpoint, each shared by all that ask for it. Cheap to clone; all clones are the same pool.
///
/// Asking for a station does no I/O: a connection is opened by the first call, closed after it has not been used for a
/// while, and opened again by the next call. Dropping the pool leaves the stations that are still held as they are.
///
/// ```
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// use fatek::sim::{Bus, Plc, Server};
/// use fatek::{Pool, register, wire::Framing};
///
/// // Yours are at addresses such as "tcp://10.0.0.7:500".
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
    shared: Arc<Shared>,
}

struct Shared {
    settings: Settings,
    slots: Mutex<Slots>,
}

#[derive(Default)]
struct Slots {
    /// In boxes, because a map has more places than it has entries, up to twice as many and more.
    by_key: HashMap<Key, Box<Slot>>,
    /// How often a station was asked for: the pool's idea of time.
    asked: u64,
    /// How many endpoints were forgotten to make room, and what their links had counted.
    evicted: u64,
    evicted_traffic: LinkStats,
    closed: bool,
}

impl Pool {
    /// A pool with the default settings.
    #[must_use]
    pub fn new() -> Self {
        Self::builder().build()
    }

    /// A pool with settings.
    pub fn builder() -> PoolBuilder {
        PoolBuilder::new()
    }

    /// The PLC with this station number, 1 to 254, at an endpoint: an [`Endpoint`], a text that is one, or a socket
    /// address.
    ///
    /// All stations of an endpoint share its link. Where it may have several, a new one is made as long as those there
    /// are have handles, and then it is the one with the fewest. Keep the handle if you use it often; if not, asking again
    /// gives the same link.
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
    /// - [`PoolError::Endpoint`] for a text that is no endpoint;
    /// - [`PoolError::Invalid`] for a number that is no station's;
    /// - [`PoolError::Full`] when there are as many endpoints as there may be, and all of them have handles;
    /// - [`PoolError::OtherSettings`] for a serial port that the pool has with other settings;
    /// - [`PoolError::Closed`] after [`close`](Self::close).
    pub fn station<E>(&self, endpoint: E, station: u8) -> Result<Station, PoolError>
    where
        E: TryInto<Endpoint>,
        PoolError: From<E::Error>,
    {
        let endpoint = endpoint.try_into()?;
        // A number that is wrong must not cost another endpoint its place.
        Station::check_number(station)?;
        Ok(self.link(&endpoint)?.station(station)?)
    }

    /// The sum of all there is now. It asks every link, so call it every second rather than for every reading.
    #[must_use]
    pub fn stats(&self) -> PoolStats {
        let slots = self.lock();
        let mut stats = PoolStats { evicted: slots.evicted, traffic: slots.evicted_traffic, ..PoolStats::default() };
        slots.by_key.values().for_each(|slot| stats.count(slot));
        stats
    }

    /// The endpoints that the pool has, in no order, each with what its links are doing and have done.
    ///
    /// ```
    /// # let pool = fatek::Pool::new();
    /// for endpoint in pool.endpoints() {
    ///     println!("{}: {:?}, {} replies", endpoint.endpoint, endpoint.links, endpoint.traffic.stations.replies);
    /// }
    /// ```
    #[must_use]
    pub fn endpoints(&self) -> Vec<PoolEndpoint> {
        self.lock().by_key.values().map(|slot| PoolEndpoint::of(slot)).collect()
    }

    /// Closes all links at the same time, as [`Link::close`] does, for all their handles; returns when that is done.
    /// Stations are not to be had any more.
    ///
    /// Dropping the future leaves links that have not been told yet open; call it again for these.
    pub async fn close(&self) {
        let links: Vec<Link> = {
            let mut slots = self.lock();
            slots.closed = true;
            slots.by_key.values().flat_map(|slot| slot.links.iter().cloned()).collect()
        };
        join_all(links.iter().map(Link::close)).await;
    }

    fn link(&self, endpoint: &Endpoint) -> Result<Link, PoolError> {
        let settings = &self.shared.settings;
        let mut slots = self.lock();
        if slots.closed {
            return Err(PoolError::Closed);
        }
        slots.asked = slots.asked.saturating_add(1);
        let asked_at = slots.asked;
        let key = Key::of(endpoint);
        if !slots.by_key.contains_key(&key) && slots.by_key.len() >= settings.max_endpoints {
            slots.make_room(endpoint, settings.max_endpoints)?;
        }
        let slot = slots.by_key.entry(key).or_insert_with(|| Box::new(Slot::new(endpoint.clone())));
        slot.link(endpoint, asked_at, settings)
    }

    fn lock(&self) -> MutexGuard<'_, Slots> {
        // What is done under this lock leaves the map whole at every step.
        self.shared.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Slots {
    /// Forgets the endpoint that was asked for longest ago among those that nobody has a handle of.
    fn make_room(&mut self, endpoint: &Endpoint, limit: usize) -> Result<(), PoolError> {
        let unused = self.by_key.iter().filter(|(_, slot)| slot.is_unused());
        let oldest = unused.min_by_key(|(_, slot)| slot.asked_at).map(|(key, _)| key.clone());
        let slot = oldest.and_then(|key| self.by_key.remove(&key));
        let slot = slot.ok_or_else(|| PoolError::Full { endpoint: endpoint.to_string(), limit })?;
        self.evicted = self.evicted.saturating_add(1);
        self.evicted_traffic = self.evicted_traffic.plus(&slot.traffic());
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
        write!(f, "Pool({} endpoints)", self.lock().by_key.len())
    }
}
