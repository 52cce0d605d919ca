use fatek::Pool;
use fatek::plant::Plant;
use fatek::poll::PollerHandle;
use fatek::sim::{Plc, Server};

use super::*;
use crate::fleet::Gate;
use crate::registry::{PlcOwnership, Share};

struct Bench {
    server: Server,
    registry: Registry,
    pool: Pool,
    poller: PollerHandle,
    buffer: Buffer,
}

impl Bench {
    async fn start() -> Self {
        let server = Plc::new().serve("127.0.0.1:0").await.unwrap();
        let (registry, pool, poller) = (Registry::default(), Pool::new(), Poller::new());
        let buffer = Buffer::in_memory(1, 1 << 20);
        let handle = poller.handle();
        tokio::spawn(Collector::new(registry.clone(), buffer.clone(), Liveness::new()).run(poller));
        Self { server, registry, pool, poller: handle, buffer }
    }

    fn apply(&self, tags: &str) {
        let address = self.server.local_addr();
        let plant =
            format!("[class]\nall = {{ every = '50ms' }}\n[plc.mixer]\nlink = 'tcp://{address}'\nstation = 1\n{tags}");
        self.registry.apply(&Plant::from_toml(&plant).unwrap(), &self.pool, &self.poller).unwrap();
    }
}

/// Without the samples that are kept, the alarm was never delivered: its only sample came before its place.
#[tokio::test(flavor = "multi_thread")]
async fn samples_before_the_end_of_a_reload_are_delivered() {
    let bench = Bench::start().await;
    // As during a reload of many PLCs: the tags are polled, and have no place yet.
    bench.registry.set_applying(true);
    let hidden = Registry::default();
    let address = bench.server.local_addr();
    let plant = format!(
        "[class]\nall = {{ every = '50ms' }}\n[plc.mixer]\nlink = 'tcp://{address}'\nstation = 1\n\
         tag.alarm = {{ at = 'M7', class = 'all', on_change = true }}\n"
    );
    hidden.apply(&Plant::from_toml(&plant).unwrap(), &bench.pool, &bench.poller).unwrap();
    let id = hidden.read().get("mixer").unwrap().ids[0];
    while !bench.poller.snapshot().iter().any(|sample| sample.id == id && sample.is_good()) {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    tokio::time::sleep(Duration::from_millis(200)).await;
    bench.registry.take_from(&hidden);
    bench.registry.set_applying(false);
    let mut cursor = bench.buffer.cursor(0);
    let entries = timeout(Duration::from_secs(20), cursor.next(10)).await.expect("the alarm is delivered");
    assert_eq!(&entries[0].batch.data[..], br#"{"alarm":false}"#);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_collector_without_samples_gives_signs_of_life() {
    let liveness = Liveness::new();
    let poller = Poller::new();
    let collector = Collector::new(Registry::default(), Buffer::in_memory(0, 1 << 20), liveness.clone());
    let task = tokio::spawn(collector.run(poller));
    tokio::time::sleep(Duration::from_millis(2500)).await;
    assert!(liveness.age() < Duration::from_secs(2), "{:?}", liveness.age());
    task.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn batches_of_the_registry_reach_the_buffer() {
    let bench = Bench::start().await;
    bench.apply("tag.level = { at = 'R5:i16', class = 'all' }\n");
    let mut cursor = bench.buffer.cursor(0);
    let first = timeout(Duration::from_secs(20), cursor.next(1)).await.unwrap();
    assert_eq!(&first[0].batch.data[..], br#"{"level":0}"#);
    let second = timeout(Duration::from_secs(20), cursor.next(1)).await.unwrap();
    assert_eq!(second[0].batch.seq, first[0].batch.seq + 1);
}

/// Without the question to the gate, the batch of a reply that had waited in the socket was delivered: its time was
/// later than that of values of the next owner.
#[tokio::test(flavor = "multi_thread")]
async fn samples_behind_a_closed_gate_are_dropped() {
    let bench = Bench::start().await;
    let address = bench.server.local_addr();
    let plant = format!(
        "[class]\nall = {{ every = '50ms' }}\n[plc.mixer]\nlink = 'tcp://{address}'\nstation = 1\n\
         tag.level = {{ at = 'R5:i16', class = 'all' }}\n"
    );
    let owned = |revision, gate| [("mixer".into(), PlcOwnership { revision, gate })].into();
    let plant = Plant::from_toml(&plant).unwrap();
    let polled = |bench: &Bench| bench.poller.stats().samples;
    bench.registry.apply_share(&plant, Share::Owned(&owned(7, Gate::closed())), &bench.pool, &bench.poller).unwrap();
    while polled(&bench) < 5 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let mut cursor = bench.buffer.cursor(0);
    assert!(timeout(Duration::from_millis(500), cursor.next(1)).await.is_err(), "a batch behind a closed gate");
    let owned = owned(9, Gate::always_open());
    bench.registry.apply_share(&plant, Share::Owned(&owned), &bench.pool, &bench.poller).unwrap();
    let entries = timeout(Duration::from_secs(20), cursor.next(1)).await.expect("the next ownership is delivered");
    assert_eq!(entries[0].batch.revision, 9);
}
