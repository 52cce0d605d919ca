//! A PLC that does not answer holds up no other one, on its bus or elsewhere.
//!
//! The rate of the others is compared before and after, in the same run.

mod common;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::{Duration, Instant};

use common::bridge::{Bridge, write_config};
use fatek::sim::{Bus, Fault, Faults, Plc, Rule, Server};
use fatek::wire::Framing;
use serde_json::Value;
use tempfile::TempDir;

/// The cycles of each measurement.
const CYCLES: u32 = 8;
/// The time after which the dead PLC counts as offline: it has not answered several times in a row.
const OFFLINE: Duration = Duration::from_secs(10);

fn head(period: Duration) -> String {
    format!(
        "[bridge]\nid = 'test'\nhttp = '127.0.0.1:0'\n[stdout]\n\
         [class]\nall = {{ every = '{}ms' }}\n[template.all]\nlevel = {{ at = 'R5:i16', class = 'all' }}\n",
        period.as_millis()
    )
}

/// Good samples of each PLC within a time.
fn count(bridge: &Bridge, time: Duration) -> BTreeMap<String, u32> {
    let mut counts = BTreeMap::new();
    let begun = Instant::now();
    while begun.elapsed() < time {
        let batch = bridge.batch();
        if let (Value::String(plc), true) = (&batch["plc"], batch["d"]["level"].is_number()) {
            *counts.entry(plc.clone()).or_insert(0) += 1;
        }
    }
    counts
}

/// Waits until a PLC has a sample that is not good, without a value.
fn wait_for_failure(bridge: &Bridge, plc: &str) {
    let begun = Instant::now();
    loop {
        let batch = bridge.batch();
        if batch["plc"] == plc && batch["d"]["level"].is_object() {
            println!("{plc} was seen to be dead after {:?}", begun.elapsed());
            return;
        }
        assert!(begun.elapsed() < common::bridge::PATIENCE, "{plc} is not seen to be dead");
    }
}

/// Compares the samples of all PLCs but the dead one. A machine that is busy makes both fewer.
fn compare(before: &BTreeMap<String, u32>, after: &BTreeMap<String, u32>, dead: &str, plcs: usize) {
    assert_eq!(before.len(), plcs, "each PLC answers at first");
    let sum = |counts: &BTreeMap<String, u32>| -> u32 {
        counts.iter().filter(|(plc, _)| *plc != dead).map(|(_, count)| count).sum()
    };
    let (before_sum, after_sum) = (sum(before), sum(after));
    let least = after.iter().filter(|(plc, _)| *plc != dead).map(|(_, count)| *count).min();
    println!("samples of {} others: {before_sum} before, {after_sum} after; the least of one: {least:?}", plcs - 1);
    assert_eq!(after.get(dead), None, "the dead PLC has no values");
    assert_eq!(after.len(), plcs - 1);
    assert!(f64::from(after_sum) >= f64::from(before_sum) * 0.95, "{before_sum} before, {after_sum} after");
    assert!(least >= Some(CYCLES / 2), "one PLC is slower than the others: {least:?} of {CYCLES}");
}

/// Without the state "offline" of a station, which makes calls fail at once until a probe is answered, each cycle
/// waits for the dead one on a bus of one request at a time.
#[tokio::test(flavor = "multi_thread")]
async fn one_dead_plc_of_fifty_on_one_bus() {
    let period = Duration::from_millis(500);
    let faults = Faults::new(1);
    let mut bus = Bus::new();
    for station in 1..=50 {
        bus = bus.with_station(station, Plc::new()).unwrap();
    }
    let server = Server::bind("127.0.0.1:0", bus.with_faults(faults.clone()), Framing::Ascii).await.unwrap();
    let mut config =
        head(period) + &format!("[bus.line]\nlink = 'tcp://{}'\nuse = ['all']\nstations = {{ ", server.local_addr());
    let stations: Vec<String> = (1..=50).map(|station| format!("plc_{station} = {station}")).collect();
    config += &format!("{} }}\n", stations.join(", "));
    let folder = TempDir::new().unwrap();
    let bridge = Bridge::start(&write_config(folder.path(), &config), folder.path());
    while bridge.batch()["plc"] != "plc_50" {}
    let before = count(&bridge, period * CYCLES);
    faults.add_rule(Rule::new(Fault::Ignore).station(17));
    wait_for_failure(&bridge, "plc_17");
    let _ = count(&bridge, OFFLINE);
    let after = count(&bridge, period * CYCLES);
    compare(&before, &after, "plc_17", 50);
}

#[tokio::test(flavor = "multi_thread")]
async fn one_dead_plc_of_a_thousand_over_tcp() {
    let period = Duration::from_millis(2000);
    let mut servers = Vec::new();
    let mut config = head(period);
    for plc in 0..1000 {
        let server = Plc::new().serve("127.0.0.1:0").await.unwrap();
        let address = server.local_addr();
        writeln!(config, "[plc.plc_{plc}]\nlink = 'tcp://{address}'\nstation = 1\nuse = ['all']").unwrap();
        servers.push(server);
    }
    let folder = TempDir::new().unwrap();
    let bridge = Bridge::start(&write_config(folder.path(), &config), folder.path());
    let mut seen = std::collections::HashSet::new();
    while seen.len() < 1000 {
        seen.insert(bridge.batch()["plc"].to_string());
    }
    let before = count(&bridge, period * CYCLES);
    servers[17].faults().unwrap().add_rule(Rule::new(Fault::Ignore));
    wait_for_failure(&bridge, "plc_17");
    let _ = count(&bridge, OFFLINE);
    let after = count(&bridge, period * CYCLES);
    compare(&before, &after, "plc_17", 1000);
}
