//! Pools of links: sharing, idle connections, limits, and a bounded connection rate.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::pool::{PoolBuilder, PoolError};
use fatek::sim::{self, Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{CallOptions, Endpoint, Error, Link, LinkState, Pool, Station, register};
use futures::future::{join, join_all};
use tokio::io::DuplexStream;
use tokio::time::{Instant, sleep};

/// Simulated PLCs that record connection attempts.
#[derive(Clone)]
struct Plant {
    bus: Bus,
    /// Time until a connection is opened or refused.
    connect_time: Duration,
    off: Arc<AtomicBool>,
    opening: Arc<AtomicUsize>,
    most_opening: Arc<AtomicUsize>,
    begun: Arc<Mutex<Vec<(Instant, String)>>>,
}

impl Plant {
    fn new(connect_time: Duration) -> Self {
        let bus = [1, 2, 3].into_iter().fold(Bus::new(), |bus, n| bus.with_station(n, Plc::new()).unwrap());
        Self {
            bus,
            connect_time,
            off: Arc::default(),
            opening: Arc::default(),
            most_opening: Arc::default(),
            begun: Arc::default(),
        }
    }

    fn pool(&self) -> PoolBuilder {
        let plant = self.clone();
        Pool::builder().seed(1).connector(move |endpoint| plant.clone().connect(endpoint))
    }

    async fn connect(self, endpoint: Endpoint) -> io::Result<DuplexStream> {
        self.begun.lock().unwrap().push((Instant::now(), endpoint.to_string()));
        let opening = self.opening.fetch_add(1, Ordering::SeqCst) + 1;
        self.most_opening.fetch_max(opening, Ordering::SeqCst);
        sleep(self.connect_time).await;
        self.opening.fetch_sub(1, Ordering::SeqCst);
        if self.off.load(Ordering::SeqCst) {
            return Err(io::ErrorKind::ConnectionRefused.into());
        }
        sim::connector(self.bus, endpoint.framing())().await
    }

    fn connects(&self) -> usize {
        self.begun.lock().unwrap().len()
    }

    fn begun_at(&self) -> Vec<Instant> {
        self.begun.lock().unwrap().iter().map(|&(at, _)| at).collect()
    }
}

async fn works(station: &Station) -> bool {
    station.read_registers(register!("R0"), 1).await.is_ok()
}

fn host(n: usize) -> String {
    format!("tcp://plc{n}")
}

#[tokio::test(start_paused = true)]
async fn stations_of_one_endpoint_share_a_link() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().build();
    let second: Endpoint = "tcp://plc2".parse().unwrap();
    let stations = [
        pool.station("tcp://plc1", 1).unwrap(),
        pool.station(String::from("tcp://PLC1:500"), 2).unwrap(),
        pool.clone().station(Endpoint::tcp("plc1", 500), 3).unwrap(),
        pool.station(&second, 1).unwrap(),
    ];
    assert_eq!((plant.connects(), pool.stats().idle), (0, 2), "creating a station does no I/O");
    for station in &stations {
        assert!(works(station).await);
    }
    assert_eq!(plant.connects(), 2);
    let stats = pool.stats();
    assert_eq!((stats.endpoints, stats.links, stats.up), (2, 2, 2));
    assert_eq!((stats.traffic.connects, stats.traffic.stations.replies), (2, 4));
    let mut endpoints = pool.endpoints();
    endpoints.sort_by_key(|endpoint| endpoint.endpoint.to_string());
    assert_eq!(endpoints[0].endpoint, "tcp://plc1".parse().unwrap());
    assert_eq!((endpoints[0].traffic.stations.replies, endpoints[1].traffic.stations.replies), (3, 1));
    assert!(matches!(endpoints[0].links[..], [LinkState::Up]));
}

#[tokio::test(start_paused = true)]
async fn a_dropped_handle_leaves_the_link_to_the_next() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().links_per_endpoint(8).build();
    for number in [1, 2, 3, 1] {
        assert!(works(&pool.station("tcp://plc", number).unwrap()).await);
    }
    assert_eq!((plant.connects(), pool.stats().links), (1, 1));
}

#[tokio::test(start_paused = true)]
async fn links_per_endpoint_are_configurable_but_one_for_serial() {
    let plant = Plant::new(Duration::ZERO);
    for (requested, links) in [(0, 1), (1, 1), (3, 3), (8, 8), (100, 8)] {
        let pool = plant.pool().links_per_endpoint(requested).build();
        let stations: Vec<_> = (0..20).map(|_| pool.station("tcp://plc", 1).unwrap()).collect();
        assert_eq!(pool.stats().links, links);
        let port: Vec<_> = (1..=3).map(|n| pool.station("serial:/dev/ttyUSB0", n).unwrap()).collect();
        assert_eq!(pool.stats().links, links + 1);
        assert!(join_all(stations.iter().chain(&port).map(works)).await.into_iter().all(|works| works));
    }
}

#[tokio::test(start_paused = true)]
async fn one_serial_port_has_one_setting_at_a_time() {
    let pool = Plant::new(Duration::ZERO).pool().build();
    let slow = pool.station("serial:/dev/ttyUSB0", 1).unwrap();
    let error = pool.station("serial:/dev/ttyUSB0?baud=19200", 2).unwrap_err();
    assert_eq!(error.to_string(), "serial:/dev/ttyUSB0?baud=19200: the port is in use as serial:/dev/ttyUSB0");
    assert!(pool.station("serial:/dev/ttyUSB0?framing=binary", 2).is_err());
    drop(slow);
    let fast = pool.station("serial:/dev/ttyUSB0?baud=19200", 2).unwrap();
    assert_eq!((pool.stats().endpoints, pool.stats().links), (1, 1));
    assert!(works(&fast).await);
}

#[tokio::test(start_paused = true)]
async fn an_idle_connection_is_closed_and_reopened_on_demand() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().idle_timeout(Duration::from_secs(5)).build();
    let station = pool.station("tcp://plc", 1).unwrap();
    for n in 1..=3 {
        assert!(works(&station).await);
        assert_eq!((plant.connects(), pool.stats().up), (n, 1));
        sleep(Duration::from_secs(6)).await;
        assert_eq!((pool.stats().idle, pool.stats().traffic.idle_closes), (1, n as u64));
    }

    let pool = plant.pool().idle_timeout(None).build();
    let station = pool.station("tcp://plc", 1).unwrap();
    assert!(works(&station).await);
    sleep(Duration::from_secs(100_000)).await;
    assert_eq!(pool.stats().up, 1);
}

#[tokio::test(start_paused = true)]
async fn failed_requests_for_a_station_evict_no_endpoint() {
    let pool = Plant::new(Duration::ZERO).pool().max_endpoints(1).build();
    drop(pool.station("tcp://first", 1).unwrap());
    let error = pool.station("http://plc", 1).unwrap_err();
    assert!(matches!(&error, PoolError::Endpoint(_)), "{error:?}");
    assert_eq!(
        error.to_string(),
        "`http://plc` is not an endpoint: unknown transport `http`: it must be `tcp`, `udp` or `serial`"
    );
    let error = pool.station("tcp://second", 0).unwrap_err();
    assert!(error.to_string().starts_with("0 is not a station"), "{error}");
    assert_eq!(pool.endpoints()[0].endpoint, Endpoint::tcp("first", 500));
    assert_eq!(pool.stats().evicted, 0);
}

#[tokio::test(start_paused = true)]
async fn the_least_recently_used_endpoint_without_handles_is_evicted() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().max_endpoints(3).build();
    let held = pool.station(host(0), 1).unwrap();
    for n in [1, 2, 1, 3] {
        assert!(works(&pool.station(host(n), 1).unwrap()).await);
    }
    let is_pooled = |n| pool.endpoints().iter().any(|is_pooled| is_pooled.endpoint == host(n).parse().unwrap());
    assert_eq!([is_pooled(0), is_pooled(1), is_pooled(2), is_pooled(3)], [true, true, false, true]);
    let stats = pool.stats();
    assert_eq!(
        (stats.endpoints, stats.evicted, stats.traffic.stations.replies),
        (3, 1, 4),
        "counters keep evicted endpoints"
    );

    let _one = (pool.station(host(1), 1).unwrap(), pool.station(host(3), 1).unwrap());
    let error = pool.station(host(4), 1).unwrap_err();
    assert_eq!(
        error.to_string(),
        "no room for tcp://plc4:500: all 3 endpoints of the pool are in use (see `PoolBuilder::max_endpoints`)"
    );
    assert!(works(&held).await);
    assert!(pool.station(host(0), 2).is_ok(), "endpoints of the pool stay available");
}

#[tokio::test(start_paused = true)]
async fn connections_are_opened_at_a_bounded_rate() {
    const AT_ONCE: usize = 5;
    const PER_SECOND: u32 = 20;
    let plant = Plant::new(Duration::from_millis(150));
    let pool = plant.pool().connects_at_once(AT_ONCE).connects_per_second(PER_SECOND).build();
    let stations: Vec<_> = (0..100).map(|n| pool.station(host(n), 1).unwrap()).collect();
    let began = Instant::now();
    assert!(join_all(stations.iter().map(works)).await.into_iter().all(|works| works));
    let took = began.elapsed();
    assert!(Duration::from_millis(4950) <= took && took < Duration::from_millis(5300), "{took:?}");
    assert!((4..=AT_ONCE).contains(&plant.most_opening.load(Ordering::SeqCst)), "20 per second, each 150 ms long");
    let begun = plant.begun_at();
    assert_eq!(begun.len(), 100);
    for (n, first) in begun.iter().enumerate() {
        let within_a_second = begun[n..].iter().take_while(|at| at.duration_since(*first) < Duration::from_secs(1));
        assert!(within_a_second.count() <= 21, "the jitter can add one");
    }
}

#[tokio::test(start_paused = true)]
async fn concurrent_connection_attempts_are_bounded() {
    let plant = Plant::new(Duration::from_millis(100));
    let pool = plant.pool().connects_at_once(7).connects_per_second(100_000).build();
    let stations: Vec<_> = (0..100).map(|n| pool.station(host(n), 1).unwrap()).collect();
    let began = Instant::now();
    let (all, ()) = tokio::join!(join_all(stations.iter().map(works)), async {
        sleep(Duration::from_millis(50)).await;
        let stats = pool.stats();
        assert_eq!((stats.connecting, stats.waiting, stats.up), (7, 93, 0));
    });
    assert!(all.into_iter().all(|works| works));
    assert_eq!(plant.most_opening.load(Ordering::SeqCst), 7);
    assert!(began.elapsed() >= Duration::from_millis(1500), "100 connections, seven at a time, take 15 rounds");
}

#[tokio::test(start_paused = true)]
async fn endpoints_that_are_off_are_retried_at_a_bounded_rate() {
    let plant = Plant::new(Duration::from_millis(20));
    let pool = plant.pool().connects_at_once(10).connects_per_second(50).build();
    let stations: Vec<_> = (0..100).map(|n| pool.station(host(n), 1).unwrap()).collect();
    plant.off.store(true, Ordering::SeqCst);
    let results = join_all(stations.iter().map(|station| station.read_status())).await;
    for result in results {
        match result.unwrap_err() {
            // The deadline of some has passed during an attempt.
            Error::Connect { source, sent: false, .. } => {
                assert!(
                    matches!(source.kind(), io::ErrorKind::ConnectionRefused | io::ErrorKind::TimedOut),
                    "{source}"
                );
            }
            error => panic!("{error:?}"),
        }
    }
    assert!(plant.connects() <= 501, "{}", plant.connects());
    let under_way = plant.connects() as u64 - pool.stats().traffic.connect_failures;
    assert!(under_way <= 10, "{under_way}");

    plant.off.store(false, Ordering::SeqCst);
    let began = Instant::now();
    let long_deadline = CallOptions::new().with_call_timeout(Duration::from_secs(60));
    let long_deadline = stations.iter().map(|station| station.with_options(long_deadline));
    let results = join_all(long_deadline.map(|station| async move { works(&station).await })).await;
    assert!(results.into_iter().all(|works| works));
    assert!(began.elapsed() < Duration::from_secs(31), "within one back-off cap");
    assert!(plant.most_opening.load(Ordering::SeqCst) <= 10);
}

#[tokio::test(start_paused = true)]
async fn a_call_waiting_for_a_connect_slot_ends_by_its_deadline() {
    let plant = Plant::new(Duration::from_secs(2));
    let pool = plant.pool().connects_at_once(1).build();
    let (first, second) = (pool.station(host(1), 1).unwrap(), pool.station(host(2), 1).unwrap());
    let short_deadline = second.with_options(CallOptions::new().with_call_timeout(Duration::from_millis(500)));
    let mut states = second.link().watch_state();
    let waiting = async {
        let began = Instant::now();
        let error = short_deadline.read_status().await.unwrap_err();
        assert!(began.elapsed() < Duration::from_millis(510));
        assert!(states.has_changed().unwrap(), "watchers are notified");
        assert!(matches!(*states.borrow_and_update(), LinkState::Waiting));
        error
    };
    let (_, error) = join(first.read_status(), waiting).await;
    assert!(matches!(error, Error::Connect { .. }) && !error.may_have_executed(), "{error:?}");
    assert!(error.to_string().contains("still waiting for other connections to be opened"), "{error}");
    sleep(Duration::from_secs(10)).await;
    assert_eq!(plant.connects(), 1, "the second link has no call left");
    assert!(matches!(second.link().state(), LinkState::Idle));
    assert!(works(&second).await);
}

#[tokio::test(start_paused = true)]
async fn close_closes_all_links_for_good() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().build();
    let stations: Vec<_> = (0..50).map(|n| pool.station(host(n), 1).unwrap()).collect();
    let (used, unused) = stations.split_at(25);
    assert!(join_all(used.iter().map(works)).await.into_iter().all(|works| works));
    tokio::join!(pool.close(), pool.close());
    let stats = pool.stats();
    assert_eq!((stats.links, stats.closed, stats.traffic.stations.replies), (50, 50, 25));
    for station in used.iter().chain(unused) {
        assert!(matches!(station.read_status().await, Err(Error::Closed { .. })));
    }
    assert_eq!(pool.station(host(0), 1).unwrap_err(), PoolError::Closed);
    assert_eq!(pool.station(host(99), 1).unwrap_err(), PoolError::Closed);
}

#[tokio::test(start_paused = true)]
async fn a_closed_link_is_replaced() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().build();
    let station = pool.station("tcp://plc", 1).unwrap();
    assert!(works(&station).await);
    station.link().close().await;
    let again = pool.station("tcp://plc", 1).unwrap();
    assert!(works(&again).await && !works(&station).await);
    assert_eq!((pool.stats().links, pool.stats().traffic.stations.replies), (1, 2));
}

#[tokio::test(start_paused = true)]
async fn one_endpoint_is_closed_and_opened_again() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().links_per_endpoint(2).build();
    let endpoint: Endpoint = "tcp://plc".parse().unwrap();
    pool.close_endpoint(&endpoint).await;
    let closed = [1, 2].map(|n| pool.station(endpoint.clone(), n).unwrap());
    let other = pool.station("tcp://other", 1).unwrap();
    assert!(works(&closed[0]).await && works(&closed[1]).await && works(&other).await);
    // In another spelling.
    pool.close_endpoint(&"tcp://PLC:500".parse().unwrap()).await;
    assert_eq!((pool.stats().closed, pool.stats().up), (2, 1));
    for station in &closed {
        assert!(matches!(station.read_status().await, Err(Error::Closed { .. })));
    }
    assert!(works(&pool.station(endpoint, 1).unwrap()).await && works(&other).await);
    assert_eq!((pool.stats().links, pool.stats().traffic.stations.replies), (2, 5));
}

#[tokio::test(start_paused = true)]
async fn stations_outlive_the_pool() {
    let plant = Plant::new(Duration::ZERO);
    let pool = plant.pool().idle_timeout(Duration::from_secs(1)).build();
    let station = pool.station("tcp://plc", 1).unwrap();
    drop(pool);
    assert!(works(&station).await);
    sleep(Duration::from_secs(5)).await;
    assert!(works(&station).await);
    assert_eq!(plant.connects(), 2);
}

#[tokio::test(start_paused = true)]
async fn every_link_has_the_settings_of_the_pool() {
    let plant = Plant::new(Duration::ZERO);
    plant.off.store(true, Ordering::SeqCst);
    let pool = plant.pool().links(|link| link.fail_fast(true).call_timeout(Duration::from_secs(1))).build();
    let began = Instant::now();
    assert!(matches!(pool.station("tcp://plc", 1).unwrap().read_status().await, Err(Error::Connect { .. })));
    assert!(began.elapsed() < Duration::from_millis(100));
}

async fn serve(address: SocketAddr, plc: &Plc, framing: Framing) -> Server {
    Server::bind(address, Bus::new().with_station(1, plc.clone()).unwrap(), framing).await.unwrap()
}

#[tokio::test]
async fn restarted_tcp_servers_are_reconnected() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let plcs: Vec<_> = (0..20).map(|_| Plc::new()).collect();
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        let servers = join_all(plcs.iter().map(|plc| serve(any, plc, framing))).await;
        let addresses: Vec<_> = servers.iter().map(Server::local_addr).collect();
        let backoff = Duration::from_millis(10);
        let pool =
            Pool::builder().connects_at_once(4).links(move |link| link.connect_backoff(backoff, 10 * backoff)).build();
        let endpoint = |&address| Endpoint::from(address).with_framing(framing);
        let stations: Vec<_> = addresses.iter().map(|a| pool.station(endpoint(a), 1).unwrap()).collect();
        let values: Vec<u16> = (0..100).collect();
        for station in &stations {
            station.write_registers(register!("R0"), &values).await.unwrap();
        }
        join_all(servers.into_iter().map(Server::shutdown)).await;
        let servers = join_all(addresses.iter().zip(&plcs).map(|(&a, plc)| serve(a, plc, framing))).await;
        let reads = stations.iter().map(|station| station.read_registers(register!("R0"), 100));
        for read in join_all(reads).await {
            assert_eq!(read.unwrap(), values);
        }
        assert_eq!((pool.stats().up, pool.stats().traffic.connects >= 40), (20, true));
        pool.close().await;
        join_all(servers.into_iter().map(Server::shutdown)).await;
    }
}

#[tokio::test]
async fn an_idle_tcp_connection_is_closed_and_reopened() {
    let server = serve(SocketAddr::from(([127, 0, 0, 1], 0)), &Plc::new(), Framing::Ascii).await;
    let pool = Pool::builder().idle_timeout(Duration::from_millis(20)).build();
    let station = pool.station(server.local_addr(), 1).unwrap();
    let mut state = station.link().watch_state();
    for _ in 0..3 {
        assert!(works(&station).await);
        state.wait_for(|state| matches!(state, LinkState::Idle)).await.unwrap();
    }
    let stats: fatek::LinkStats = Link::stats(station.link());
    assert_eq!((stats.connects, stats.idle_closes, stats.disconnects), (3, 3, 0));
}
