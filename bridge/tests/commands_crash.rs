//! Commands over NATS while the bridge is killed: an id is written once at most, and each pulse ends.
//!
//! `FATEK_BRIDGE_CRASHES` sets the number of kills (50 in a campaign, 6 otherwise).

mod common;

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use fatek::discrete;
use fatek::sim::{Bus, Change, Faults, Plc, Server};
use fatek::wire::Framing;
use serde_json::{Value, json};

use common::bridge::{Bridge, PATIENCE, write_config};
use common::nats::NatsServer;

fn now() -> u64 {
    u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_at_any_moment_it_writes_an_id_once_and_ends_each_pulse() {
    let folder = tempfile::tempdir().unwrap();
    let Some(nats) = NatsServer::start(folder.path()) else { return };
    let crashes: u64 = std::env::var("FATEK_BRIDGE_CRASHES").ok().and_then(|text| text.parse().ok()).unwrap_or(6);
    let (plc, faults) = (Plc::new(), Faults::new(1).log_capacity(1_000_000));
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let config = format!(
        "[bridge]\nid = 'hall-2'\nhttp = '127.0.0.1:0'\nbuffer = {{ dir = 'buffer' }}\n\
         [nats]\nurl = 'nats://127.0.0.1:{}'\nwrite = true\n\
         [plc.mixer]\nlink = '{}'\nstation = 1\n\
         tag.count = {{ at = 'DR300', write = {{}} }}\ntag.start = {{ at = 'M100', write = {{ pulse = '100ms' }} }}\n",
        nats.port(),
        server.endpoint()
    );
    let config = write_config(folder.path(), &config);
    let client = nats.client().await;
    let (mut sent, mut replies): (BTreeMap<String, bytes::Bytes>, BTreeMap<String, Value>) = Default::default();
    let mut rng = fastrand::Rng::with_seed(7);
    let mut next = 0;
    for round in 0..=crashes {
        let mut bridge = Bridge::start(&config, folder.path());
        bridge.wait_for_log("nats: connected");
        // Those without a reply are sent again, as a client does.
        let mut batch: Vec<String> = sent.keys().filter(|id| !replies.contains_key(*id)).cloned().collect();
        for n in 0..8 {
            next += 1;
            let (tag, value) = if n == 3 { ("start", json!(true)) } else { ("count", json!(next)) };
            let payload = json!({ "id": next.to_string(), "tag": tag, "value": value, "ts": now() }).to_string();
            sent.insert(next.to_string(), payload.into());
            batch.push(next.to_string());
        }
        let mut requests = tokio::task::JoinSet::new();
        for id in batch {
            let (client, payload) = (client.clone(), sent[&id].clone());
            requests.spawn(async move {
                let reply = client.request("fatek.hall-2.mixer.cmd", payload).await;
                reply.ok().map(|reply| (id, serde_json::from_slice::<Value>(&reply.payload).unwrap()))
            });
        }
        if round < crashes {
            tokio::time::sleep(Duration::from_millis(rng.u64(0..600))).await;
            bridge.signal("KILL");
            bridge.wait();
        }
        // Requests that were taken by the killed bridge get no reply.
        let patience = if round < crashes { Duration::from_millis(100) } else { PATIENCE };
        while let Ok(Some(answer)) = tokio::time::timeout(patience, requests.join_next()).await {
            replies.extend(answer.unwrap());
        }
        if round == crashes {
            let until = std::time::Instant::now() + PATIENCE;
            while plc.read(discrete!("M100")) == true.into() {
                assert!(std::time::Instant::now() < until, "M100 stays on; the log:\n{}", bridge.log());
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
            bridge.signal("TERM");
            assert!(bridge.wait().success(), "{}", bridge.log());
        }
    }
    let changes = faults.log().changes(1);
    let mut written: BTreeMap<String, u32> = BTreeMap::new();
    for change in &changes {
        if let Some(value) = change.to_string().strip_prefix("DR300 = ") {
            *written.entry(value.to_owned()).or_default() += 1;
        }
    }
    let sets = changes.iter().filter(|change| **change == Change::value(discrete!("M100"), true)).count();
    let results = |result: &str| replies.values().filter(|reply| reply["result"] == result).count();
    println!(
        "{crashes} kills: {} commands, {} written, {sets} pulses, replies ok {}, refused {}, unknown {}, none {}",
        sent.len(),
        written.len(),
        results("ok"),
        results("refused"),
        results("unknown"),
        sent.len() - replies.len()
    );
    assert!(written.values().all(|times| *times == 1), "written twice: {written:?}");
    assert!(sets as u64 <= crashes + 1, "{sets} pulses");
    for (id, reply) in &replies {
        let is_pulse = sent[id].windows(7).any(|part| part == b"\"start\"");
        let is_written = written.contains_key(id);
        match reply["result"].as_str().unwrap() {
            "ok" => assert!(is_pulse || is_written, "{reply}"),
            "refused" => assert!(!is_written, "{reply}"),
            _ => {}
        }
    }
    assert!(results("ok") >= 8, "{replies:?}");
}
