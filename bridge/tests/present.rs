//! Present values after an outage of the broker, and after a start of Home Assistant.

mod common;

use common::bridge::{Bridge, write_config};
use common::mqtt_broker::{Action, Broker, Received};
use fatek::element;
use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use serde_json::Value;
use tempfile::TempDir;

/// A bridge with a PLC that answers and one that does not, at a broker that records everything.
struct Setup {
    broker: Broker,
    plc: Plc,
    bridge: Bridge,
    _server: Server,
    _folder: TempDir,
}

impl Setup {
    async fn start(more: &str) -> Self {
        let plc = Plc::new();
        let bus = Bus::new().with_station(1, plc.clone()).unwrap();
        let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
        let (broker, folder) = (Broker::start().await, TempDir::new().unwrap());
        let text = format!(
            "[bridge]\nid = 'hall-2'\nhttp = '127.0.0.1:0'\n[mqtt]\nurl = '{}'\n{more}\
             [class]\nfast = {{ every = '100ms' }}\nslow = {{ every = '1h' }}\n\
             [plc.mixer]\nlink = '{link}'\nstation = 1\n\
             tag.alarm = {{ at = 'M7', class = 'fast', on_change = true }}\n\
             tag.recipe = {{ at = 'R5', class = 'slow', on_change = true }}\n\
             [plc.dead]\nlink = 'tcp://127.0.0.1:1'\nstation = 2\n\
             tag.level = {{ at = 'R5', class = 'fast', on_change = true }}\n",
            broker.url(),
            link = server.endpoint(),
        );
        let bridge = Bridge::start(&write_config(folder.path(), &text), folder.path());
        Self { broker, plc, bridge, _server: server, _folder: folder }
    }

    /// The batches that have this tag, in the order of their arrival.
    fn batches(broker: &Broker, plc: &str, tag: &str) -> Vec<Value> {
        let topic = format!("fatek/hall-2/{plc}/data");
        let received = broker.received().into_iter().filter(|received| received.topic == topic);
        let batches = received.map(|received| serde_json::from_slice::<Value>(&received.payload).unwrap());
        batches.filter(|batch| !batch["d"][tag].is_null()).collect()
    }

    /// Waits until there are this many batches with the tag, and returns them.
    async fn wait_for(&self, plc: &str, tag: &str, count: usize) -> Vec<Value> {
        let what = format!("{count} batches of {plc} with {tag}");
        self.broker.wait_for(&what, |broker| Self::batches(broker, plc, tag).len() >= count).await;
        Self::batches(&self.broker, plc, tag)
    }
}

fn is_hist(batch: &Value) -> bool {
    batch["hist"] == true
}

/// Without the cure the alarm came as a replay alone, and Home Assistant showed `false` until its next change.
#[tokio::test(flavor = "multi_thread")]
async fn after_an_outage_the_present_values_follow_the_backlog() {
    let mut setup = Setup::start("").await;
    let alarm = setup.wait_for("mixer", "alarm", 1).await;
    assert!(!is_hist(&alarm[0]) && alarm[0]["d"]["alarm"] == false, "{alarm:?}");
    let recipe = setup.wait_for("mixer", "recipe", 1).await;
    let level = setup.wait_for("dead", "level", 1).await;
    // Each batch costs the connection, and is lost.
    setup.broker.behave(|received: &Received| match received.topic.ends_with("/data") {
        true => Action::Lose,
        false => Action::Ack,
    });
    setup.plc.write(element!("M7"), true).unwrap();
    setup.broker.wait_for("losses", |broker| broker.connected().len() >= 3).await;
    setup.broker.behave(|_| Action::Ack);

    let after = setup.wait_for("mixer", "alarm", 3).await;
    assert!(is_hist(&after[1]) && after[1]["d"]["alarm"] == true, "the backlog comes first: {after:?}");
    assert!(!is_hist(&after[2]) && after[2]["d"]["alarm"] == true, "{after:?}");
    let number = |batch: &Value, key: &str| batch[key].as_u64().unwrap();
    assert!(number(&after[2], "seq") > number(&after[1], "seq"), "{after:?}");
    assert!(number(&after[2], "ts") > number(&after[1], "ts"), "it was read since: {after:?}");
    // A value that was not read since keeps its time: the next reading of its class is an hour away, or less.
    let again = setup.wait_for("mixer", "recipe", 2).await;
    assert!(!is_hist(&again[1]) && again[1]["ts"] == recipe[0]["ts"], "{recipe:?} {again:?}");
    assert!(number(&again[1], "seq") > number(&recipe[0], "seq"));
    // A bad tag has no value, and the time since when it is bad.
    let dead = setup.wait_for("dead", "level", 2).await;
    assert!(!is_hist(&dead[1]) && dead[1]["d"]["level"]["q"] == "bad", "{dead:?}");
    assert!(number(&dead[1], "ts") >= number(&level[0], "ts"), "{level:?} {dead:?}");
    setup.bridge.signal("TERM");
    assert!(setup.bridge.wait().success(), "{}", setup.bridge.log());
}

/// Without the cure the tag was unknown to Home Assistant until its next change.
#[tokio::test(flavor = "multi_thread")]
async fn home_assistant_gets_the_present_values_after_its_start() {
    let setup = Setup::start("home_assistant = 'ha'\n").await;
    // After the first discovery messages, and then after its birth.
    for round in 0..2 {
        let before = Setup::batches(&setup.broker, "mixer", "alarm").len().max(1);
        if round == 1 {
            setup.broker.send("ha/status", "online", false, None);
        }
        let after = setup.wait_for("mixer", "alarm", before + 1).await;
        assert!(after.iter().all(|batch| !is_hist(batch)), "{after:?}");
        let config = "ha/binary_sensor/fatek_-hall-2/mixer_-alarm/config";
        let entities = setup.broker.received().iter().filter(|received| received.topic == config).count();
        assert_eq!(entities, round + 1, "the entity is there before its value");
    }
}
