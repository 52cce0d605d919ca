//! The bridge is killed with SIGKILL at any moment, also while the broker is away: at most a second of samples is
//! lost, and a sequence number always has the same data.
//!
//! Long campaign: `FATEK_BRIDGE_CRASHES=50 cargo test --test crash -- --nocapture`.

mod common;

use std::collections::HashMap;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde_json::Value;
use tokio::time::sleep;

use common::bridge::{Bridge, PATIENCE, write_config};
use common::mosquitto::Mosquitto;
use common::mqtt_proxy::Proxy;
use common::plc::SimPlc;

/// The promise is a second; the rest is for threads that a loaded machine lets wait.
const MOST_LOST: Duration = Duration::from_millis(2500);

fn now() -> u64 {
    u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis()).unwrap()
}

/// The batches that the broker took, without the marks of replays: each number once. A number with two contents
/// fails the test.
fn distinct(taken: Vec<(String, Value)>) -> Vec<(u64, u64)> {
    let mut known: HashMap<u64, Value> = HashMap::new();
    for (_, mut batch) in taken {
        batch.as_object_mut().unwrap().remove("hist");
        let seq = batch["seq"].as_u64().unwrap();
        let first = known.entry(seq).or_insert_with(|| batch.clone());
        assert_eq!(*first, batch, "two batches have the number {seq}");
    }
    let mut batches: Vec<_> = known.iter().map(|(seq, batch)| (*seq, batch["ts"].as_u64().unwrap())).collect();
    batches.sort_unstable();
    batches
}

/// Seen without the cure: with a buffer in memory alone, the worst of 4 kills lost 3.2 s.
async fn kill_again_and_again(sync: bool) {
    let Some(mut mosquitto) = Mosquitto::start() else { return };
    let crashes: u64 = std::env::var("FATEK_BRIDGE_CRASHES").ok().and_then(|text| text.parse().ok()).unwrap_or(4);
    let folder = tempfile::tempdir().unwrap();
    let (plc, proxy) = (SimPlc::start(&[]).await, Proxy::start(mosquitto.port()).await);
    let config = format!(
        "[bridge]\nid = 'hall-2'\nhttp = '127.0.0.1:0'\nbuffer = {{ dir = 'buffer', sync = {sync} }}\n[mqtt]\nurl = '{}'\n\
         [class]\nfast = {{ every = '20ms' }}\n[plc.mixer]\nlink = '{}'\nstation = 1\n\
         tag.level = {{ at = 'R5', class = 'fast' }}\ntag.speed = {{ at = 'R6', class = 'fast' }}\n",
        proxy.url(),
        plc.link(),
    );
    let config = write_config(folder.path(), &config);
    let mut random = fastrand::Rng::with_seed(11);
    // For each run: before the start of the bridge, when it was ready, and before it was killed.
    let mut runs = Vec::new();
    for _ in 0..crashes {
        let before = now();
        let mut bridge = Bridge::start(&config, folder.path());
        bridge.wait_for_log("started;");
        let ready = now();
        sleep(Duration::from_millis(random.u64(300..2500))).await;
        // Killed up to 4 s after the broker, so that the data has to come from the disk.
        if random.bool() {
            mosquitto.kill();
            sleep(Duration::from_millis(random.u64(..4000))).await;
        }
        runs.push((before, ready, now()));
        bridge.signal("KILL");
        bridge.wait();
        // It comes back, or stays away for another run.
        if random.bool() {
            mosquitto.kill();
            mosquitto.launch();
        }
    }
    mosquitto.kill();
    mosquitto.launch();
    let last_start = now();
    let mut bridge = Bridge::start(&config, folder.path());
    let until = Instant::now() + PATIENCE;
    while !proxy.taken().iter().any(|(_, batch)| batch["ts"].as_u64() > Some(last_start) && batch["hist"] != true) {
        assert!(Instant::now() < until, "nothing new at the broker:\n{}", bridge.log());
        sleep(Duration::from_millis(20)).await;
    }
    bridge.signal("TERM");
    assert!(bridge.wait().success(), "{}", bridge.log());

    let batches = distinct(proxy.taken());
    let mut lost = Vec::new();
    for (number, (before, ready, end)) in runs.iter().enumerate() {
        let next = runs.get(number + 1).map_or(last_start, |(before, ..)| *before);
        let of_run: Vec<_> = batches.iter().filter(|(_, ts)| (*before..next).contains(ts)).collect();
        let gaps = of_run.windows(2).filter(|pair| pair[1].0 != pair[0].0 + 1).count();
        assert_eq!(gaps, 0, "in the middle of run {number}");
        let last = of_run.last().map_or(*ready, |(_, ts)| *ts);
        lost.push(end.saturating_sub(last));
    }
    lost.sort_unstable();
    let (median, worst) = (lost[lost.len() / 2], lost[lost.len() - 1]);
    println!(
        "{crashes} kills, sync = {sync}: {} batches; lost before a kill: {median} ms (median), {worst} ms (worst)",
        batches.len()
    );
    assert!(Duration::from_millis(worst) <= MOST_LOST, "{lost:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kill_loses_a_second_at_most() {
    kill_again_and_again(false).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kill_with_sync_loses_less() {
    kill_again_and_again(true).await;
}
