//! Bridges that share PLCs, as processes, with a real nats-server: takeover, handover, loss of the store, commands.
//!
//! `FATEK_FLEET_KILLS` sets how often a bridge is killed (100 in a campaign, 2 otherwise).

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use fatek::discrete;
use fatek::register;
use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use serde_json::{Value, json};
use tempfile::TempDir;

use common::bridge::{Bridge, PATIENCE, write_config};
use common::mosquitto::Mosquitto;
use common::mqtt_subscriber::Subscriber;
use common::nats::NatsServer;

const LEASE: Duration = Duration::from_secs(1);
const PLCS: usize = 6;

/// A batch that a bridge has written to stdout, and when.
#[derive(Debug)]
struct Line {
    bridge: &'static str,
    at: Instant,
    batch: Value,
}

impl Line {
    fn plc(&self) -> &str {
        self.batch["plc"].as_str().unwrap()
    }

    fn number(&self, key: &str) -> u64 {
        self.batch[key].as_u64().unwrap_or_else(|| panic!("{key} is missing: {}", self.batch))
    }
}

/// Simulated PLCs, a server, and the bridges' configuration.
struct Fleet {
    nats: NatsServer,
    plcs: Vec<(Server, Plc)>,
    folder: TempDir,
    lines: (Sender<Line>, Receiver<Line>),
}

impl Fleet {
    /// `None`: nats-server is missing.
    async fn new() -> Option<Self> {
        let folder = TempDir::new().unwrap();
        let nats = NatsServer::start(folder.path())?;
        let plcs = loop {
            let mut plcs = Vec::new();
            for _ in 0..PLCS {
                let plc = Plc::new();
                let bus = Bus::new().with_station(1, plc.clone()).unwrap();
                plcs.push((Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap(), plc));
            }
            let owner = |(server, _): &(Server, Plc)| {
                let endpoint = format!("tcp://{}", server.local_addr()).parse().unwrap();
                fatek_bridge::fleet::placed(&fatek_bridge::fleet::link_id(&endpoint, None), ["hall-1", "hall-2"])
            };
            // Placement is by addresses. Each of the two is to get one.
            if ["hall-1", "hall-2"].iter().all(|member| plcs.iter().any(|plc| owner(plc) == Some(*member))) {
                break plcs;
            }
        };
        let fleet = Self { nats, plcs, folder, lines: channel() };
        fleet.init().await;
        Some(fleet)
    }

    async fn init(&self) {
        let path = write_config(self.folder.path(), &self.config());
        let config = fatek_bridge::config::Config::load(&path).unwrap();
        let fleet = config.fleet.unwrap();
        fatek_bridge::fleet::init(&config.nats.unwrap(), &fleet.id, &fleet.bucket).await.unwrap();
    }

    fn config(&self) -> String {
        self.config_with("[stdout]\n")
    }

    /// The configuration, with these outputs.
    fn config_with(&self, outputs: &str) -> String {
        let mut text = format!(
            "[bridge]\nhttp = '127.0.0.1:0'\nbuffer = {{ dir = 'buffer' }}\n{outputs}\
             [nats]\nurl = 'nats://127.0.0.1:{}'\nwrite = true\n\
             [fleet]\nid = 'plant-a'\nbucket = 'leases'\nlease = '{LEASE:?}'\n\
             [class.fast]\nevery = '50ms'\n",
            self.nats.port()
        );
        for (n, (server, _)) in self.plcs.iter().enumerate() {
            text.push_str(&format!(
                "[plc.mixer{n}]\nlink = 'tcp://{}'\nstation = 1\n\
                 tag.level = {{ at = 'R5', class = 'fast', write = {{}} }}\n\
                 tag.start = {{ at = 'M5', class = 'fast', write = {{ pulse = '50ms' }} }}\n",
                server.local_addr()
            ));
        }
        text
    }

    fn start(&self, id: &'static str) -> Bridge {
        let folder = self.folder.path().join(id);
        std::fs::create_dir_all(&folder).unwrap();
        let config = write_config(&folder, &self.config());
        let mut bridge = Bridge::start_with(&config, &folder, &[("FATEK_BRIDGE_ID", id)]);
        let (lines, all) = (bridge.take_lines(), self.lines.0.clone());
        std::thread::spawn(move || {
            for line in lines {
                let batch = serde_json::from_str(&line).unwrap();
                if all.send(Line { bridge: id, at: Instant::now(), batch }).is_err() {
                    return;
                }
            }
        });
        bridge
    }

    /// The batches that have come until a condition of the last owner and batch time of each PLC holds.
    fn until(&self, what: &str, is_true: impl Fn(&BTreeMap<String, Line>) -> bool) -> Vec<Line> {
        let (begin, mut taken, mut last) = (Instant::now(), Vec::new(), BTreeMap::new());
        while !is_true(&last) {
            assert!(begin.elapsed() < PATIENCE, "{what}: {last:#?}");
            let Ok(line) = self.lines.1.recv_timeout(Duration::from_millis(10)) else { continue };
            if let Some(before) = last.insert(line.plc().to_owned(), line) {
                taken.push(before);
            }
        }
        taken.extend(last.into_values());
        taken.sort_by_key(|line| line.at);
        taken
    }

    /// Waits until each PLC is polled by one of these, and each of them polls one.
    fn shared_by(&self, bridges: &[&str]) -> Vec<Line> {
        self.until(&format!("all are polled by {bridges:?}"), |last| {
            last.len() == PLCS
                && last.values().all(|line| bridges.contains(&line.bridge))
                && bridges.iter().all(|bridge| last.values().any(|line| line.bridge == *bridge))
        })
    }

    /// Drops all batches that have come.
    fn forget(&self) {
        while self.lines.1.try_recv().is_ok() {}
    }
}

/// The last owner of each PLC.
fn owners(lines: &[Line]) -> BTreeMap<String, &'static str> {
    lines.iter().map(|line| (line.plc().to_owned(), line.bridge)).collect()
}

/// Asserts that the fencing tokens of each PLC rise, that each is of one bridge, and that ids differ.
fn check_order(lines: &[Line]) {
    let mut last: BTreeMap<&str, (u64, u64, &str)> = BTreeMap::new();
    for line in lines.iter().filter(|line| line.batch["hist"].is_null()) {
        let (rev, seq) = (line.number("rev"), line.number("seq"));
        if let Some((before, last_seq, bridge)) = last.insert(line.plc(), (rev, seq, line.bridge)) {
            assert!(rev > before || rev == before && bridge == line.bridge && seq > last_seq, "{before} then {line:?}");
            assert!(seq > last_seq, "the sequence goes on: {last_seq} then {line:?}");
        }
    }
}

fn now() -> u64 {
    u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn plcs_are_shared_taken_over_and_handed_over() {
    let Some(fleet) = Fleet::new().await else { return };
    let kills: usize = std::env::var("FATEK_FLEET_KILLS").ok().map_or(2, |text| text.parse().unwrap());
    let mut first = fleet.start("hall-1");
    let mut second = fleet.start("hall-2");
    check_order(&fleet.shared_by(&["hall-1", "hall-2"]));

    let mut longest = Duration::ZERO;
    for kill in 0..kills {
        let (victim, other) = if kill % 2 == 0 { (&mut first, "hall-2") } else { (&mut second, "hall-1") };
        victim.signal("KILL");
        let begin = Instant::now();
        victim.wait();
        let lines = fleet.shared_by(&[other]);
        longest = longest.max(begin.elapsed());
        check_order(&lines);
        *victim = fleet.start(if kill % 2 == 0 { "hall-1" } else { "hall-2" });
        check_order(&fleet.shared_by(&["hall-1", "hall-2"]));
    }
    println!(
        "{kills} kills: the last PLC is polled again within {:.2} leases",
        longest.as_secs_f64() / LEASE.as_secs_f64()
    );

    // One that ends in order hands its PLCs over at once.
    first.signal("TERM");
    let begin = Instant::now();
    let lines = fleet.shared_by(&["hall-2"]);
    println!("handed over within {:?}", begin.elapsed());
    assert!(first.wait().success(), "{}", first.log());
    check_order(&lines);
    let mut longest = Duration::ZERO;
    let mut last: BTreeMap<&str, Instant> = BTreeMap::new();
    for line in &lines {
        if let Some(before) = last.insert(line.plc(), line.at) {
            longest = longest.max(line.at - before);
        }
    }
    println!("the longest pause of a PLC is {longest:?}");
    assert!(longest < LEASE, "it did not wait for the end of the lease");
}

#[tokio::test(flavor = "multi_thread")]
async fn bridges_pause_without_the_store_and_stop_when_it_was_deleted() {
    let Some(mut fleet) = Fleet::new().await else { return };
    let mut bridges = [fleet.start("hall-1"), fleet.start("hall-2")];
    fleet.shared_by(&["hall-1", "hall-2"]);
    fleet.nats.kill();
    for bridge in &bridges {
        bridge.wait_for_log("the store did not answer in time");
    }
    tokio::time::sleep(LEASE / 4).await;
    fleet.forget();
    tokio::time::sleep(LEASE).await;
    assert_eq!(fleet.lines.1.try_recv().map(|line| line.batch).ok(), None, "no PLC is polled");
    fleet.nats.run();
    check_order(&fleet.shared_by(&["hall-1", "hall-2"]));

    let client = fleet.nats.client().await;
    async_nats::jetstream::new(client).delete_stream("KV_leases").await.unwrap();
    bridges.iter().for_each(|bridge| bridge.wait_for_log("does not exist"));
    fleet.init().await;
    for bridge in &mut bridges {
        assert!(!bridge.wait().success(), "{}", bridge.log());
        assert!(bridge.log().contains("was deleted and made again"), "{}", bridge.log());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_is_executed_by_the_owner_alone() {
    let Some(fleet) = Fleet::new().await else { return };
    let bridges = [fleet.start("hall-1"), fleet.start("hall-2")];
    let owners = owners(&fleet.shared_by(&["hall-1", "hall-2"]));
    bridges.iter().for_each(|bridge| bridge.wait_for_log("nats: connected"));
    // A command from before the ownership is not executed: see below.
    tokio::time::sleep(Duration::from_millis(2100)).await;
    let client = fleet.nats.client().await;
    let inbox = client.new_inbox();
    let mut replies = client.subscribe(inbox.clone()).await.unwrap();
    let mut send = async |plc: &str, command: Value| {
        let subject = format!("fatek.plant-a.{plc}.cmd");
        client.publish_with_reply(subject, inbox.clone(), command.to_string().into()).await.unwrap();
        let reply = tokio::time::timeout(PATIENCE, futures::StreamExt::next(&mut replies)).await.unwrap().unwrap();
        // The other one is silent.
        let other = tokio::time::timeout(Duration::from_millis(200), futures::StreamExt::next(&mut replies)).await;
        assert!(other.is_err(), "two replies: {other:?}");
        serde_json::from_slice::<Value>(&reply.payload).unwrap()
    };
    for (n, (plc, _)) in owners.iter().enumerate() {
        let reply = send(plc, json!({ "id": format!("a{n}"), "tag": "level", "value": n + 7, "ts": now() })).await;
        assert_eq!(reply["result"], "ok", "{reply}");
        assert_eq!(fleet.plcs[n].1.read(register!("R5")), u16::try_from(n + 7).unwrap().into());
    }
    let reply = send("mixer0", json!({ "id": "p", "tag": "start", "value": true, "ts": now() })).await;
    assert!(reply["result"] == "refused" && reply["why"].as_str().unwrap().starts_with("pulse: "), "{reply}");
    assert_eq!(fleet.plcs[0].1.read(discrete!("M5")), false.into());

    // The new owner does not execute again what the one before may have executed.
    let victim = owners["mixer0"];
    let mut bridges = BTreeMap::from([("hall-1", &bridges[0]), ("hall-2", &bridges[1])]);
    let sent = now();
    bridges.remove(victim).unwrap().signal("KILL");
    fleet.forget();
    fleet.shared_by(&bridges.keys().copied().collect::<Vec<_>>());
    let reply = send("mixer0", json!({ "id": "a0", "tag": "level", "value": 99, "ts": sent })).await;
    assert_eq!(reply["result"], "unknown", "{reply}");
    assert_eq!(fleet.plcs[0].1.read(register!("R5")), 7_u16.into());
}

/// Retained messages are those of the owner: a member leaves those of PLCs that another one polls as they are.
///
/// While PLCs were announced as offline only if the member had published them before, one that it had for less than a
/// second stayed online without the store.
#[tokio::test(flavor = "multi_thread")]
async fn states_at_the_broker_are_those_of_the_owner() {
    let Some(mosquitto) = Mosquitto::start() else { return };
    let Some(mut fleet) = Fleet::new().await else { return };
    let outputs = format!("[mqtt]\nurl = '{}'\nhome_assistant = 'ha'\n", mosquitto.url());
    let start = |id: &'static str, fleet: &Fleet| {
        let folder = fleet.folder.path().join(id);
        std::fs::create_dir_all(&folder).unwrap();
        let config = write_config(&folder, &fleet.config_with(&outputs));
        Bridge::start_with(&config, &folder, &[("FATEK_BRIDGE_ID", id)])
    };
    let mut all = Subscriber::start(&mosquitto, "#").await;
    let mut bridges = vec![start("hall-1", &fleet), start("hall-2", &fleet)];
    let (mut states, mut entities): (BTreeMap<String, Value>, BTreeMap<String, Value>) = Default::default();
    let mut note = |all: &mut Subscriber| {
        while let Ok((topic, content, _)) = all.messages.try_recv() {
            if topic.starts_with("ha/") {
                entities.insert(topic, content);
            } else if topic.ends_with("/state") {
                states.insert(topic.strip_prefix("fatek/plant-a/").unwrap().to_owned(), content);
            }
        }
        let online = states.iter().filter(|(_, state)| state["online"] == true).map(|(topic, _)| topic.clone());
        let online: BTreeSet<String> = online.collect();
        let known = entities.values().filter(|entity| !entity.is_null()).count();
        (online, known)
    };
    let plcs = (0..PLCS).map(|n| format!("mixer{n}/state"));
    let expected = |members: &[&str]| -> BTreeSet<String> {
        plcs.clone().chain(members.iter().map(|member| format!("members/{member}/state"))).collect()
    };
    let mut until = async |all: &mut Subscriber, what: &str, states: &BTreeSet<String>, entities: usize| {
        let begin = Instant::now();
        loop {
            let seen = note(all);
            if seen == (states.clone(), entities) {
                return;
            }
            assert!(begin.elapsed() < PATIENCE, "{what}: {seen:?}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let both = expected(&["hall-1", "hall-2"]);
    until(&mut all, "both run", &both, 2 * PLCS).await;
    // The time in which messages of an earlier run are cleared.
    tokio::time::sleep(Duration::from_secs(11)).await;
    until(&mut all, "none clears those of the other", &both, 2 * PLCS).await;

    let mut first = bridges.remove(0);
    first.signal("TERM");
    assert!(first.wait().success(), "{}", first.log());
    until(&mut all, "one has all", &expected(&["hall-2"]), 2 * PLCS).await;

    // Without the store none polls, and the states say so.
    fleet.nats.kill();
    until(&mut all, "no PLC is online", &["members/hall-2/state".to_owned()].into(), 2 * PLCS).await;
    fleet.nats.run();
    until(&mut all, "one has all again", &expected(&["hall-2"]), 2 * PLCS).await;

    // The last one leaves. The killed server may have lost that hall-1 has left: it is silent for a lease first.
    tokio::time::sleep(LEASE * 2).await;
    bridges[0].signal("TERM");
    until(&mut all, "all are offline", &BTreeSet::new(), 2 * PLCS).await;
}

/// The server does not answer: the member waits for its answer to the end of the ownerships.
///
/// Without the cure it ended with its ownerships: 4.0 s after the second signal.
#[tokio::test(flavor = "multi_thread")]
async fn a_second_signal_ends_a_member_that_cannot_leave() {
    let Some(fleet) = Fleet::new().await else { return };
    let folder = fleet.folder.path().join("hall-1");
    std::fs::create_dir_all(&folder).unwrap();
    let text = fleet.config().replace(&format!("lease = '{LEASE:?}'"), "lease = '4s'");
    assert!(text.contains("'4s'"), "{text}");
    let mut bridge = Bridge::start_with(&write_config(&folder, &text), &folder, &[("FATEK_BRIDGE_ID", "hall-1")]);
    bridge.batch();
    fleet.nats.signal("STOP");
    bridge.signal("TERM");
    let mut begun = None;
    // Signals that come together are one.
    let status = loop {
        tokio::time::sleep(Duration::from_millis(100)).await;
        match bridge.ended() {
            Some(status) => break status,
            None => bridge.signal("TERM"),
        }
        begun.get_or_insert_with(Instant::now);
    };
    let took = begun.map(|begun| begun.elapsed()).unwrap_or_default();
    println!("ended {took:?} after the second signal");
    fleet.nats.signal("CONT");
    assert!(status.success() && bridge.log().contains("a second signal"), "{}", bridge.log());
    // It takes 0.5 s; the rest is for a busy machine.
    assert!(took < Duration::from_millis(1500), "{took:?}: {}", bridge.log());
}

/// While links had the names of their PLCs, the other member took the renamed one at once, and the PLC had two masters:
/// this test gave `hall-1 polls it`.
#[tokio::test(flavor = "multi_thread")]
async fn a_plc_with_another_name_has_the_same_master() {
    let Some(fleet) = Fleet::new().await else { return };
    let bridges = BTreeMap::from([("hall-1", fleet.start("hall-1")), ("hall-2", fleet.start("hall-2"))]);
    let owners = owners(&fleet.shared_by(&["hall-1", "hall-2"]));
    let (plc, owner) = owners.first_key_value().unwrap();
    let other = if *owner == "hall-1" { "hall-2" } else { "hall-1" };
    let reload = |id: &str| {
        let renamed = fleet.config().replace(&format!("[plc.{plc}]"), "[plc.kettle]");
        write_config(&fleet.folder.path().join(id), &renamed);
        bridges[id].signal("HUP");
        bridges[id].wait_for_log("reloaded;");
    };
    reload(other);
    fleet.forget();
    tokio::time::sleep(LEASE * 2).await;
    let lines: Vec<Line> = fleet.lines.1.try_iter().collect();
    assert!(lines.iter().all(|line| line.plc() != "kettle"), "{other} polls it");
    assert!(lines.iter().any(|line| line.plc() == plc && line.bridge == *owner));
    reload(owner);
    let lines = fleet.until("the owner polls it with its new name", |last| last.contains_key("kettle"));
    assert!(lines.iter().all(|line| line.plc() != "kettle" || line.bridge == *owner));
}
