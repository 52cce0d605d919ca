//! The bridge as a process: start, reload, drain and end.

mod common;

use std::io::Write as _;
use std::time::{Duration, Instant};

use common::bridge::{Bridge, write_config};
use common::mqtt_broker::{Action, Broker};
use fatek::sim::{Bus, Fault, Faults, Plc, Rule, Server};
use fatek::wire::Framing;
use serde_json::Value;
use tempfile::TempDir;

/// A simulated PLC, a folder, and a configuration of the PLC with two tags that are read each 200 ms.
struct Plant {
    server: Server,
    folder: TempDir,
}

impl Plant {
    async fn new() -> Self {
        let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_station(2, Plc::new()).unwrap();
        let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
        Self { server, folder: TempDir::new().unwrap() }
    }

    fn config(&self, more: &str) -> String {
        let address = self.server.local_addr();
        format!(
            "[bridge]\nid = 'test'\nhttp = '127.0.0.1:0'\n[stdout]\n\
             [class]\nfast = {{ every = '200ms' }}\nother = {{ every = '300ms' }}\n\
             [plc.mixer]\nlink = 'tcp://{address}'\nstation = 1\n\
             tag.level = {{ at = 'R5:i16', class = 'fast' }}\n{more}"
        )
    }

    fn start(&self, more: &str) -> Bridge {
        let config = write_config(self.folder.path(), &self.config(more));
        Bridge::start(&config, self.folder.path())
    }

    fn write(&self, more: &str) {
        write_config(self.folder.path(), &self.config(more));
    }
}

/// Takes batches until one is of this PLC and has this tag, and returns it.
fn next_with(bridge: &Bridge, plc: &str, tag: &str) -> Value {
    loop {
        let batch = bridge.batch();
        if batch["plc"] == plc && !batch["d"][tag].is_null() {
            return batch;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn sigterm_delivers_all_samples_and_ends_with_success() {
    let plant = Plant::new().await;
    let mut bridge = plant.start("");
    let first = bridge.batch();
    assert_eq!((&first["plc"], &first["d"]["level"]), (&"mixer".into(), &0.into()), "{first}");
    bridge.signal("TERM");
    assert!(bridge.wait().success(), "{}", bridge.log());
    let mut seq = first["seq"].as_u64().unwrap();
    for batch in bridge.rest() {
        seq += 1;
        assert_eq!(batch["seq"], seq);
    }
}

/// The period of the tag that reloads must not disturb. Long, so that a busy machine is not taken for a fault: a cycle
/// that is missed takes twice as long.
const PERIOD: u64 = 500;

/// With a reload that stops and starts each PLC, pauses were 153 to 900 ms.
#[tokio::test(flavor = "multi_thread")]
async fn a_reload_disturbs_no_other_tag() {
    let plant = Plant::new().await;
    let steady = format!("tag.steady = {{ at = 'R6', class = 'steady' }}\n[class.steady]\nevery = '{PERIOD}ms'\n");
    let base = "tag.alarm = { at = 'M7', class = 'other' }\ntag.gone = { at = 'R9', class = 'other' }\n";
    let address = plant.server.local_addr();
    let changed = "tag.alarm = { at = 'M7', class = 'fast', on_change = true }\n";
    let added = format!("[plc.added]\nlink = 'tcp://{address}'\nstation = 2\ntag.total = 'DR0:u32'\n");
    let (base, changed) = (format!("{base}{steady}"), format!("{changed}{steady}{added}"));
    let bridge = plant.start(&base);
    // The first reading is ahead of the phase, and all others are at it.
    next_with(&bridge, "mixer", "steady");
    let mut last = next_with(&bridge, "mixer", "steady");
    let mut seq = last["seq"].as_u64().unwrap();
    let mut pauses: Vec<u64> = Vec::new();
    for round in 0..6 {
        let (text, plc, new) = match round % 2 {
            0 => (&changed, "added", "total"),
            _ => (&base, "mixer", "gone"),
        };
        plant.write(text);
        bridge.signal("HUP");
        let reloaded = Instant::now();
        let (mut seen_new, mut seen_alarm) = (false, false);
        while !seen_new || !seen_alarm || reloaded.elapsed() < Duration::from_millis(3 * PERIOD) {
            assert!(reloaded.elapsed() < common::bridge::PATIENCE, "round {round}: {}", bridge.log());
            let batch = bridge.batch();
            seen_new |= batch["plc"] == plc && batch["d"][new].is_number();
            if batch["plc"] != "mixer" {
                continue;
            }
            // The alarm is another tag for the poller, and reported once on change: that one must not be lost.
            seen_alarm |= batch["d"]["alarm"].is_boolean();
            seq += 1;
            assert_eq!(batch["seq"], seq, "a batch is missing: {batch}");
            if batch["d"]["steady"].is_number() {
                pauses.push(batch["ts"].as_u64().unwrap() - last["ts"].as_u64().unwrap());
                last = batch;
            }
        }
    }
    pauses.sort_unstable();
    println!("{} pauses of a tag of {PERIOD} ms around 6 reloads: {pauses:?} ms", pauses.len());
    // No cycle is missed in any round, and the tag is not read at once as one that is added.
    assert!(pauses.iter().all(|pause| (PERIOD / 2..PERIOD * 2 - PERIOD / 10).contains(pause)), "{pauses:?}");
    let log = bridge.log();
    assert_eq!(log.matches("reloaded; PLCs: ").count(), 6, "{log}");
    assert!(log.contains("reloaded; PLCs: 1 added, 0 moved, 0 removed; tags: 2 added, 2 removed, 2 kept"), "{log}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bad_file_changes_nothing_and_says_why() {
    let plant = Plant::new().await;
    let mut bridge = plant.start("");
    bridge.batch();
    plant.write("tag.other = { at = 'R7', class = 'nonsense' }\n");
    bridge.signal("HUP");
    bridge.wait_for_log("the configuration was not reloaded, and nothing has changed");
    bridge.wait_for_log("nonsense");
    assert!(bridge.log().contains("line 12"), "{}", bridge.log());
    let seq = bridge.batch()["seq"].as_u64().unwrap();
    assert_eq!(bridge.batch()["seq"], seq + 1);
    bridge.signal("TERM");
    assert!(bridge.wait().success());
}

#[tokio::test(flavor = "multi_thread")]
async fn settings_that_need_a_restart_are_named() {
    let plant = Plant::new().await;
    let bridge = plant.start("");
    bridge.batch();
    let text = plant.config("").replace("id = 'test'", "id = 'other'").replace("[stdout]\n", "");
    write_config(plant.folder.path(), &text);
    bridge.signal("HUP");
    bridge.wait_for_log("section bridge is in force after a restart of the bridge");
    bridge.wait_for_log("section stdout, which is new or gone, is in force after a restart");
    bridge.batch();
}

/// Without the cure it took 2.8 s after the second signal: the broker, and then the PLC, had their time to answer.
#[tokio::test(flavor = "multi_thread")]
async fn a_second_signal_ends_the_bridge_within_a_second() {
    let broker = Broker::start().await;
    broker.behave(|_| Action::Silence);
    let faults = Faults::new(1);
    let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_faults(faults.clone());
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let folder = TempDir::new().unwrap();
    let text = format!(
        "[bridge]\nid = 'test'\nhttp = '127.0.0.1:0'\nbuffer.dir = 'buffer'\n[mqtt]\nurl = '{}'\n\
         [plc.mixer]\nlink = '{}'\nstation = 1\ntag.level = 'R5'\n",
        broker.url(),
        server.endpoint()
    );
    let mut bridge = Bridge::start(&write_config(folder.path(), &text), folder.path());
    broker.wait_for("a batch", |broker| broker.received().iter().any(|one| one.topic == "fatek/test/mixer/data")).await;
    faults.set_rules([Rule::new(Fault::Ignore)]);
    // A client of the page that does not send the end of its request.
    bridge.wait_for_log("the page is at http://");
    let log = bridge.log();
    let page = log.split_once("the page is at http://").unwrap().1.split_whitespace().next().unwrap();
    let mut client = std::net::TcpStream::connect(page).unwrap();
    client.write_all(b"GET / HTTP/1.1\r\n").unwrap();
    tokio::time::sleep(Duration::from_millis(1500)).await;
    bridge.signal("TERM");
    tokio::time::sleep(Duration::from_millis(300)).await;
    bridge.signal("TERM");
    let begun = Instant::now();
    let status = bridge.wait();
    let took = begun.elapsed();
    println!("ended {took:?} after the second signal");
    assert!(status.success() && bridge.log().contains("a second signal"), "{}", bridge.log());
    // Half of it is for a busy machine.
    assert!(took < Duration::from_millis(1500), "{took:?}: {}", bridge.log());
    // The batch without an acknowledgement is on disk all the same.
    broker.behave(|_| Action::Ack);
    let count = |broker: &Broker| broker.received().iter().filter(|one| one.topic == "fatek/test/mixer/data").count();
    let before = count(&broker);
    let bridge = Bridge::start(&folder.path().join("plant.toml"), folder.path());
    broker.wait_for("it comes again", |broker| count(broker) > before).await;
    drop(bridge);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_of_stdout_that_stops_does_not_hold_up_the_end() {
    let plant = Plant::new().await;
    // The pipe of 64 KiB is full at once.
    let tags: String = (0..40)
        .map(|n| format!("tag.level{n} = {{ at = 'R{}-R{}:i16', class = 'fast' }}\n", n * 64, n * 64 + 63))
        .collect();
    let config = write_config(
        plant.folder.path(),
        &plant.config(&tags.replace("'fast'", "'busy'")).replace("other =", "busy = { every = '10ms' }\nother ="),
    );
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    command.arg("run").arg(config).stdin(std::process::Stdio::null());
    command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::inherit());
    let mut child = command.spawn().unwrap();
    tokio::time::sleep(Duration::from_secs(2)).await;
    let begun = Instant::now();
    assert!(std::process::Command::new("kill").arg(child.id().to_string()).status().unwrap().success());
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        assert!(begun.elapsed() < common::bridge::PATIENCE, "it does not end");
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    println!("ended {:?} after the signal", begun.elapsed());
    assert!(status.success());
}
