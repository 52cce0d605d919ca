//! Heap memory of a link in bytes: its slot in the pool, its handle, task and buffers, and the
//! future of a caller. A service that polls ten thousand PLCs has ten thousand of them.
//!
//! Sockets are not included: these connections answer by themselves. `examples/poll_many` measures
//! the whole.
#![allow(clippy::print_stdout, reason = "prints its figures")]

#[path = "../../tests/plant/mod.rs"]
mod plant;

use std::time::Duration;

use fatek::wire::Framing;
use fatek::{Station, register};
use tokio::task::JoinSet;
use tokio::time::sleep;

use self::plant::{Mode, Plant};

#[global_allocator]
static HEAP: dhat::Alloc = dhat::Alloc;

const LINKS: usize = 512;
const KIB: usize = 1024;

/// A single test, because all tests would share the heap.
#[tokio::test(start_paused = true)]
async fn a_link_keeps_little_memory_and_no_buffers() {
    let _profiler = dhat::Profiler::builder().testing().build();
    for framing in [Framing::Ascii, Framing::Binary] {
        let plant = Plant::new(LINKS, framing, Duration::ZERO);
        let all_are = |mode| (0..LINKS).for_each(|n| plant.set(n, mode));
        let before = heap();
        let pool = plant.pool().connects_per_second(1_000_000).idle_timeout(IDLE / 2).build();
        let stations: Vec<Station> = (0..LINKS).map(|n| pool.station(plant.endpoint(n), 1).unwrap()).collect();
        let per_link = |what: &str, limit: usize| {
            let bytes = (heap() - before) / LINKS;
            println!("{framing}: {bytes} bytes per link {what}");
            assert!(bytes <= limit, "{framing}: {bytes} bytes per link {what}, more than {limit}");
            bytes
        };
        per_link("when unused", 22 * KIB / 10);

        read_all(&stations, 10).await;
        let connected = per_link("when connected", 33 * KIB / 10);

        read_all(&stations, 64).await;
        all_are(Mode::Noisy);
        read_all(&stations, 10).await;
        all_are(Mode::Answers);
        read_all(&stations, 10).await;
        let after = per_link("after much traffic", 4 * KIB);
        assert!(after <= connected + 64, "{framing}: no buffer is kept");

        all_are(Mode::Delayed);
        let mut calls = JoinSet::new();
        for station in &stations {
            let station = station.clone();
            calls.spawn(async move { station.read_registers(register!("R0"), 10).await.unwrap() });
        }
        sleep(Duration::from_millis(100)).await;
        per_link("with a call in flight", 6 * KIB);
        all_are(Mode::Answers);
        assert_eq!(calls.join_all().await.len(), LINKS);
        let after = per_link("after the call", 5 * KIB);
        assert!(after <= connected + 64 + KEPT_CALLS, "{framing}: nothing else of the call is kept");

        sleep(IDLE).await;
        assert_eq!(pool.stats().idle, LINKS);
        assert!(per_link("when idle", 5 * KIB) <= connected + KEPT_CALLS);

        pool.close().await;
        drop((pool, stations));
        sleep(Duration::from_millis(1)).await;
        // The rest is the queue of the runtime, which has grown.
        per_link("after dropping", 64 + KEPT_CALLS);
    }
}

/// A thread keeps the slots and timers of 256 calls, here after calls of all links at once.
const KEPT_CALLS: usize = 256 * 544 / LINKS;

const IDLE: Duration = Duration::from_secs(60);

fn heap() -> usize {
    dhat::HeapStats::get().curr_bytes
}

async fn read_all(stations: &[Station], count: usize) {
    for station in stations {
        assert_eq!(station.read_registers(register!("R0"), count).await.unwrap().len(), count);
    }
}
