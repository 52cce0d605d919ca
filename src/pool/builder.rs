use std::fmt;
use std::future::Future;
use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead, AsyncWrite};

use super::{Pool, Shared, Slots};
use crate::endpoint::{Endpoint, Transport};
use crate::link::{BoxIo, ConnectLimiter, Connector, Link, LinkBuilder};
use crate::random::Random;

/// The most connections that a FATEK Ethernet module takes.
const MAX_LINKS_PER_ENDPOINT: usize = 8;

/// Settings of a pool. Each has a default that suits thousands of PLCs on a plant's network.
#[must_use]
pub struct PoolBuilder {
    max_endpoints: usize,
    links_per_endpoint: usize,
    idle_timeout: Option<Duration>,
    connects_at_once: usize,
    connects_per_second: u32,
    configure: Option<Configure>,
    connect: Option<Connect>,
    seed: Option<u64>,
}

type Configure = Box<dyn Fn(LinkBuilder) -> LinkBuilder + Send + Sync>;
type Connect = Arc<dyn Fn(Endpoint) -> BoxFuture<'static, io::Result<BoxIo>> + Send + Sync>;

impl PoolBuilder {
    pub(super) fn new() -> Self {
        Self {
            max_endpoints: 16_384,
            links_per_endpoint: 1,
            idle_timeout: Some(Duration::from_secs(60)),
            connects_at_once: 128,
            connects_per_second: 200,
            configure: None,
            connect: None,
            seed: None,
        }
    }

    /// How many endpoints there may be, at least 1. Default: 16,384.
    ///
    /// For one more, the endpoint that was asked for longest ago among those without handles is forgotten, and its
    /// connection closed; if all have handles, there is an error.
    pub fn max_endpoints(mut self, endpoints: usize) -> Self {
        self.max_endpoints = endpoints.max(1);
        self
    }

    /// How many links an endpoint may have, 1 to 8, which is what FATEK's Ethernet modules take; a serial port always has
    /// one. Default: 1.
    ///
    /// What a link does for its callers it does for its own: priorities, fairness and offline stations are its alone.
    pub fn links_per_endpoint(mut self, links: usize) -> Self {
        self.links_per_endpoint = links.clamp(1, MAX_LINKS_PER_ENDPOINT);
        self
    }

    /// After how long without a call a connection is closed; `None` for never. Default: 60 s. See
    /// [`LinkBuilder::idle_timeout`].
    pub fn idle_timeout(mut self, timeout: impl Into<Option<Duration>>) -> Self {
        self.idle_timeout = timeout.into();
        self
    }

    /// How many TCP connections are being opened at once, at least 1. Default: 128.
    ///
    /// The others wait for their turn, which comes in the order in which they asked, and their calls wait with them
    /// within their deadlines. An endpoint that is switched off holds its turn for the
    /// [connect timeout](LinkBuilder::connect_timeout).
    pub fn connects_at_once(mut self, connects: usize) -> Self {
        self.connects_at_once = connects.max(1);
        self
    }

    /// How many TCP connections are begun a second on average, at least 1. Default: 200.
    ///
    /// They are spread over the second, so that a plant that comes back after a power cut is not hit by all of them
    /// together. All are back within the longest [back-off](LinkBuilder::connect_backoff), or within the time that this
    /// pace takes for all links, whichever is longer: 10,000 links take 50 s at 200 a second.
    pub fn connects_per_second(mut self, connects: u32) -> Self {
        self.connects_per_second = connects.max(1);
        self
    }

    /// What all links are set to. The function gets the builder of each new link; it must not use the pool. The idle
    /// timeout is the pool's.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::Pool;
    ///
    /// let pool = Pool::builder()
    ///     .links(|link| link.response_timeout(Duration::from_millis(500)).retries(1))
    ///     .build();
    /// ```
    pub fn links(mut self, configure: impl Fn(LinkBuilder) -> LinkBuilder + Send + Sync + 'static) -> Self {
        self.configure = Some(Box::new(configure));
        self
    }

    /// What opens the connections instead: through a tunnel, or, in a test, in memory. The limits on connecting then hold
    /// for every transport.
    ///
    /// ```
    /// use fatek::sim::{self, Bus, Plc};
    /// use fatek::{Pool, register, wire::Framing};
    ///
    /// # #[tokio::main(flavor = "current_thread")]
    /// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
    /// let bus = Bus::new().with_station(1, Plc::new())?;
    /// let pool = Pool::builder().connector(move |endpoint| sim::connector(bus.clone(), endpoint.framing())()).build();
    /// let station = pool.station("tcp://bench", 1)?;
    /// assert_eq!(station.read_registers(register!("R0"), 2).await?, [0, 0]);
    /// # Ok(())
    /// # }
    /// ```
    pub fn connector<F, Fut, T>(mut self, open: F) -> Self
    where
        F: Fn(Endpoint) -> Fut + Send + Sync + 'static,
        Fut: Future<Output = io::Result<T>> + Send + 'static,
        T: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        self.connect = Some(Arc::new(move |endpoint| {
            let opening = open(endpoint);
            async move { Ok(Box::new(opening.await?) as BoxIo) }.boxed()
        }));
        self
    }

    /// The seed of the jitter between connections, so that a test can be repeated; see also [`LinkBuilder::seed`].
    /// Default: a new one for each pool.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = Some(seed);
        self
    }

    /// Makes the pool, which is empty.
    #[must_use]
    pub fn build(self) -> Pool {
        let seed = self.seed.unwrap_or_else(Random::seed);
        let settings = Settings {
            max_endpoints: self.max_endpoints,
            links_per_endpoint: self.links_per_endpoint,
            idle_timeout: self.idle_timeout,
            connect_limiter: ConnectLimiter::new(self.connects_at_once, self.connects_per_second, seed),
            configure: self.configure,
            connect: self.connect,
        };
        Pool { shared: Arc::new(Shared { settings, slots: Mutex::new(Slots::default()) }) }
    }
}

impl fmt::Debug for PoolBuilder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PoolBuilder")
            .field("max_endpoints", &self.max_endpoints)
            .field("links_per_endpoint", &self.links_per_endpoint)
            .field("idle_timeout", &self.idle_timeout)
            .field("connects_at_once", &self.connects_at_once)
            .field("connects_per_second", &self.connects_per_second)
            .finish_non_exhaustive()
    }
}

/// What the pool knows of all its endpoints.
pub(super) struct Settings {
    pub(super) max_endpoints: usize,
    pub(super) links_per_endpoint: usize,
    idle_timeout: Option<Duration>,
    connect_limiter: Arc<ConnectLimiter>,
    configure: Option<Configure>,
    connect: Option<Connect>,
}

impl Settings {
    /// A new link.
    pub(super) fn link(&self, endpoint: &Endpoint) -> Link {
        let mut builder = Link::builder(endpoint.clone());
        // Opening a socket for UDP or a port of this machine hits nobody, and a doubt on UDP must get a fresh one soon.
        let remote = matches!(endpoint.transport(), Transport::Tcp { .. });
        if remote || self.connect.is_some() {
            builder = builder.connect_limiter(self.connect_limiter.clone());
        }
        if let Some(configure) = &self.configure {
            builder = configure(builder);
        }
        if let Some(connect) = self.connect.clone() {
            let endpoint = endpoint.clone();
            builder = builder.connector(Connector::Custom {
                open: Box::new(move || connect(endpoint.clone())),
                wakes_reader: false,
            });
        }
        builder.idle_timeout(self.idle_timeout).build()
    }
}
