//! Commands that wait while a reload takes the right to write from their output.

mod common;

use std::net::SocketAddr;
use std::time::{Duration, Instant, SystemTime};

use common::bridge::{Bridge, PATIENCE, write_config};
use common::http::request;
use common::mqtt_broker::Broker;
use fatek::command::Code;
use fatek::sim::{Bus, Fault, Faults, Plc, Rule, Server};
use fatek::wire::Framing;
use fatek_bridge::batch::milliseconds;
use serde_json::json;
use tempfile::TempDir;
use tokio::time::sleep;

const COMMANDS: &str = "fatek/hall-2/mixer/cmd";

/// The value of a metric of the commands for `mixer`; 0 if there is none.
async fn metric(page: SocketAddr, name: &str) -> u32 {
    let text = format!("GET /metrics HTTP/1.1\r\nHost: {page}\r\nConnection: close\r\n\r\n");
    let answer = request(page, &text).await.unwrap();
    let line = answer.body.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.map_or(0, |value| value.parse().unwrap())
}

async fn wait_for(page: SocketAddr, name: &str, is_right: impl Fn(u32) -> bool) {
    let until = Instant::now() + PATIENCE;
    while !is_right(metric(page, name).await) {
        assert!(Instant::now() < until, "{name} is {}", metric(page, name).await);
        sleep(Duration::from_millis(20)).await;
    }
}

/// Without the gate of the output, both commands were written after the log said "reloaded": R200 = 7, and R201 = 8.
#[tokio::test(flavor = "multi_thread")]
async fn write_false_by_a_reload_stops_commands_that_wait() {
    let (plc, faults, broker) = (Plc::new(), Faults::new(1).log_capacity(10_000), Broker::start().await);
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let folder = TempDir::new().unwrap();
    let text = format!(
        "[bridge]\nid = 'hall-2'\nhttp = '127.0.0.1:0'\nbuffer = {{ dir = 'buffer' }}\n\
         [mqtt]\nurl = '{}'\nwrite = true\n[plc.mixer]\nlink = '{}'\nstation = 1\n\
         tag.valve = {{ at = 'M5', write = {{}} }}\ntag.speed = {{ at = 'R200', write = {{}} }}\n\
         tag.level = {{ at = 'R201', write = {{}} }}\n",
        broker.url(),
        server.endpoint()
    );
    let bridge = Bridge::start(&write_config(folder.path(), &text), folder.path());
    bridge.wait_for_log("the page is at http://");
    let log = bridge.log();
    let address = log.split_once("the page is at http://").unwrap().1;
    let page: SocketAddr = address.split_whitespace().next().unwrap().parse().unwrap();
    let is_subscribed = |broker: &Broker| broker.subscriptions().iter().any(|filter| filter == "fatek/hall-2/+/cmd");
    broker.wait_for("subscription", is_subscribed).await;
    // Each write of the valve takes a second, in which no reply comes; the last two wait for all four.
    faults.set_rules([Rule::new(Fault::Ignore).command(Code::WriteDiscretes)]);
    let valve = |id| (id, "valve", json!(true));
    let last = [("5", "speed", json!(7)), ("6", "level", json!(8))];
    for (id, tag, value) in ["1", "2", "3", "4"].map(valve).into_iter().chain(last) {
        let ts = milliseconds(SystemTime::now());
        broker.send(COMMANDS, &json!({ "id": id, "tag": tag, "value": value, "ts": ts }).to_string(), false, None);
    }
    let waiting = r#"fatek_commands_waiting{plc="mixer"}"#;
    wait_for(page, waiting, |waiting| waiting >= 5).await;
    write_config(folder.path(), &text.replace("write = true", "write = false"));
    bridge.signal("HUP");
    bridge.wait_for_log("reloaded; ");
    wait_for(page, waiting, |waiting| waiting == 0).await;
    assert_eq!(faults.log().changes(1), [], "{}", bridge.log());
    assert_eq!(metric(page, r#"fatek_commands_total{plc="mixer",result="ok"}"#).await, 0);
    assert!(metric(page, r#"fatek_commands_total{plc="mixer",result="refused"}"#).await >= 2);
}
