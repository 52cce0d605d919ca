use std::fmt;
use std::future::Future;
use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead, AsyncWrite};

use super::{Pool, PoolShared, PoolState};
use crate::endpoint::Endpoint;
use crate::link::{ConnectLimiter, Connector, Link, LinkBuilder, SendGate, SharedConfigs};
use crate::random::Random;
use crate::transport::BoxIo;

/// The maximum of connections of a FATEK Ethernet module.
const MAX_LINKS_PER_ENDPOINT: usize = 8;

const DEFAULT_MAX_ENDPOINTS: usize = 16_384;
const DEFAULT_IDLE_TIMEOUT: Duration = Duration::from_secs(60);
const DEFAULT_CONNECTS_AT_ONCE: usize = 128;
const DEFAULT_CONNECTS_PER_SECOND: u32 = 200;

/// Settings of a [`Pool`], with defaults for thousands of PLCs on a plant network.
#[must_use]
pub struct PoolBuilder {
    max_endpoints: usize,
    links_per_endpoint: usize,
    idle_timeout: Option<Duration>,
    connects_at_once: usize,
    connects_per_second: u32,
    configure: Option<Configure>,
    connect: Option<Connect>,
    send_gates: Option<SendGates>,
    seed: Option<u64>,
}

type Configure = Box<dyn Fn(LinkBuilder) -> LinkBuilder + Send + Sync>;
type SendGates = Box<dyn Fn(&Endpoint) -> Option<SendGate> + Send + Sync>;
type Connect = Arc<dyn Fn(Endpoint) -> BoxFuture<'static, io::Result<BoxIo>> + Send + Sync>;

impl PoolBuilder {
    pub(super) fn new() -> Self {
        Self {
            max_endpoints: DEFAULT_MAX_ENDPOINTS,
            links_per_endpoint: 1,
            idle_timeout: Some(DEFAULT_IDLE_TIMEOUT),
            connects_at_once: DEFAULT_CONNECTS_AT_ONCE,
            connects_per_second: DEFAULT_CONNECTS_PER_SECOND,
            configure: None,
            connect: None,
            send_gates: None,
            seed: None,
        }
    }

    /// Sets the maximum of endpoints, at least 1. Default: 16,384.
    ///
    /// When it is reached, the least recently requested endpoint without handles is evicted and its
    /// connection closed. If all have handles, [`Pool::station`] fails with
    /// [`PoolError::Full`](super::PoolError::Full).
    pub fn max_endpoints(mut self, endpoints: usize) -> Self {
        self.max_endpoints = endpoints.max(1);
        self
    }

    /// Sets the maximum of links per endpoint, 1 to 8. Default: 1.
    ///
    /// FATEK's Ethernet modules accept up to 8 connections. A serial port always has one link.
    /// Priorities, fairness and offline stations are separate for each link.
    pub fn links_per_endpoint(mut self, links: usize) -> Self {
        self.links_per_endpoint = links.clamp(1, MAX_LINKS_PER_ENDPOINT);
        self
    }

    /// Sets the time without a call until a connection is closed; `None`: never. Default: 60 s.
    ///
    /// See [`LinkBuilder::idle_timeout`].
    pub fn idle_timeout(mut self, timeout: impl Into<Option<Duration>>) -> Self {
        self.idle_timeout = timeout.into();
        self
    }

    /// Sets the maximum of TCP connections being opened at once, at least 1. Default: 128.
    ///
    /// Other links wait in the order of their requests; the deadlines of their calls run meanwhile.
    /// An endpoint that is switched off occupies a permit for the [connect
    /// timeout](LinkBuilder::connect_timeout).
    pub fn connects_at_once(mut self, connects: usize) -> Self {
        self.connects_at_once = connects.max(1);
        self
    }

    /// Sets the average number of TCP connection attempts per second, at least 1. Default: 200.
    ///
    /// The attempts are spread over the second, so that they do not hit a plant all at once after a
    /// power cut. All links are up within the maximum of the longest
    /// [back-off](LinkBuilder::connect_backoff) and the time of all attempts at this rate: 10,000
    /// links take 50 s at 200 per second.
    pub fn connects_per_second(mut self, connects: u32) -> Self {
        self.connects_per_second = connects.max(1);
        self
    }

    /// Sets a function that configures the builder of each new link.
    ///
    /// The function must not use the pool. The idle timeout is always that of the pool.
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

    /// Sets a function that opens the connections, for example through a tunnel or in memory.
    ///
    /// The limits on connecting then apply to every transport.
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

    /// Sets a function that returns the [send gate](SendGate) of each new link, by its endpoint; `None`:
    /// the link needs no permission to send. Default: none of them does.
    ///
    /// The function must not use the pool. It is called again if an endpoint that was closed or evicted
    /// is requested again.
    ///
    /// ```
    /// use std::collections::HashSet;
    /// use std::sync::{Arc, Mutex};
    /// use fatek::{Endpoint, Pool, SendGate};
    ///
    /// // The PLCs of which this master is the active one.
    /// let owned: Arc<Mutex<HashSet<Endpoint>>> = Arc::default();
    /// let gate_of = {
    ///     let owned = owned.clone();
    ///     move |endpoint: &Endpoint| {
    ///         let (owned, endpoint) = (owned.clone(), endpoint.clone());
    ///         Some(SendGate::new(move || owned.lock().is_ok_and(|owned| owned.contains(&endpoint))))
    ///     }
    /// };
    /// let pool = Pool::builder().send_gates(gate_of).build();
    /// ```
    pub fn send_gates(mut self, gate_of: impl Fn(&Endpoint) -> Option<SendGate> + Send + Sync + 'static) -> Self {
        self.send_gates = Some(Box::new(gate_of));
        self
    }

    /// Sets the seed of the jitter between connection attempts, for repeatable tests.
    ///
    /// See also [`LinkBuilder::seed`]. Default: a new one for each pool.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = Some(seed);
        self
    }

    /// Makes an empty pool.
    #[must_use]
    pub fn build(self) -> Pool {
        let seed = self.seed.unwrap_or_else(Random::seed);
        let settings = PoolSettings {
            max_endpoints: self.max_endpoints,
            links_per_endpoint: self.links_per_endpoint,
            idle_timeout: self.idle_timeout,
            connect_limiter: ConnectLimiter::new(self.connects_at_once, self.connects_per_second, seed),
            configs: Arc::default(),
            configure: self.configure,
            connect: self.connect,
            send_gates: self.send_gates,
        };
        Pool { shared: Arc::new(PoolShared { settings, state: Mutex::new(PoolState::default()) }) }
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

/// The settings of a pool, applied to all its endpoints.
pub(super) struct PoolSettings {
    pub(super) max_endpoints: usize,
    pub(super) links_per_endpoint: usize,
    idle_timeout: Option<Duration>,
    connect_limiter: Arc<ConnectLimiter>,
    configs: Arc<SharedConfigs>,
    configure: Option<Configure>,
    connect: Option<Connect>,
    send_gates: Option<SendGates>,
}

impl PoolSettings {
    /// Makes a new link.
    pub(super) fn link(&self, endpoint: &Arc<Endpoint>) -> Link {
        let mut builder = LinkBuilder::of_endpoint(endpoint.clone()).share_config(&self.configs);
        // Opening a UDP socket or a local port puts no load on a PLC, and must not be delayed.
        if endpoint.transport().is_remote() || self.connect.is_some() {
            builder = builder.connect_limiter(self.connect_limiter.clone());
        }
        if let Some(configure) = &self.configure {
            builder = configure(builder);
        }
        if let Some(connect) = self.connect.clone() {
            let endpoint = endpoint.clone();
            builder = builder.connector(Connector::Custom {
                open: Box::new(move || connect(Endpoint::clone(&endpoint))),
                wakes_reader: false,
            });
        }
        if let Some(gate) = self.send_gates.as_ref().and_then(|gate_of| gate_of(endpoint)) {
            builder = builder.send_gate(gate);
        }
        builder.idle_timeout(self.idle_timeout).build()
    }
}
