//! The MQTT output against a broker that fails at exact moments.

mod common;

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use common::bridge::PATIENCE;
use common::deliveries::Deliveries;
use common::mqtt_broker::{Action, Broker, Received};
use fatek_bridge::batch::Batch;
use fatek_bridge::buffer::Buffer;
use fatek_bridge::config::{MqttSection, Name};
use fatek_bridge::output::Health;
use fatek_bridge::output::mqtt::{self, MqttParts};
use fatek_bridge::registry::Registry;
use serde_json::{Value, json};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

/// The output with a buffer that the test fills, and a second output that takes everything at once.
struct Output {
    buffer: Buffer,
    health: Arc<Health>,
    stop: CancellationToken,
    task: JoinHandle<()>,
    pushed: u64,
}

impl Output {
    fn start(broker: &Broker) -> Self {
        Self::start_with(broker, json!({}))
    }

    /// `more`: keys of `[mqtt]`.
    fn start_with(broker: &Broker, more: Value) -> Self {
        Self::start_at(&broker.url(), more, Registry::default())
    }

    fn start_at(url: &str, more: Value, registry: Registry) -> Self {
        let mut section = json!({ "url": url });
        section.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        let section: MqttSection = serde_json::from_value(section).unwrap();
        let buffer = Buffer::in_memory(2, 1 << 30);
        let health = Arc::new(Health::new("mqtt"));
        let stop = CancellationToken::new();
        let id: Name = serde_json::from_value(json!("hall-2")).unwrap();
        let (cursor, commands) = (buffer.cursor(0), None);
        let parts = MqttParts { id, registry, cursor, health: health.clone(), commands, stop: stop.clone() };
        let task = tokio::spawn(mqtt::run(section, parts));
        Self { buffer, health, stop, task, pushed: 0 }
    }

    fn push(&mut self, number: u64) {
        self.push_sized(number, 1);
    }

    /// Pushes batches with a text of this length, in turn of three PLCs.
    fn push_sized(&mut self, number: u64, length: usize) {
        for _ in 0..number {
            let (plc, seq) = (PLCS[usize::try_from(self.pushed % 3).unwrap()], self.pushed / 3);
            let data = json!({ "n": "x".repeat(length) }).to_string().into();
            self.buffer.push(Batch { plc: plc.into(), seq, ts: seq, samples: 1, data });
            self.pushed += 1;
        }
    }

    fn expected(&self) -> BTreeMap<&'static str, Range<u64>> {
        let count = |at: u64| (self.pushed + 2 - at) / 3;
        PLCS.into_iter().zip(0..).map(|(plc, at)| (plc, 0..count(at))).collect()
    }

    fn lag(&self) -> u64 {
        self.buffer.stats()[0].lag
    }

    async fn wait_for(&self, what: &str, mut holds: impl FnMut(&Self) -> bool) {
        let until = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < until, "{what}: not within {PATIENCE:?}; {:?}", self.health);
            sleep(Duration::from_millis(5)).await;
        }
    }

    async fn wait_until_delivered(&self) {
        self.wait_for("all delivered", |output| output.lag() == 0).await;
    }

    fn check(&self, broker: &Broker) -> Deliveries {
        let received: Vec<(String, Value)> = broker.received().iter().filter_map(batch).collect();
        Deliveries::check(received.iter().map(|(plc, batch)| (plc.as_str(), batch)), &self.expected())
    }

    async fn stop(self) {
        self.stop.cancel();
        timeout(PATIENCE, self.task).await.expect("it ends").expect("no panic");
    }
}

const PLCS: [&str; 3] = ["mixer", "boiler", "pump-1"];

/// PLC and content of a batch.
fn batch(received: &Received) -> Option<(String, Value)> {
    let plc = received.topic.strip_prefix("fatek/hall-2/")?.strip_suffix("/data")?;
    Some((plc.to_owned(), serde_json::from_slice(&received.payload).unwrap()))
}

fn is_batch(received: &Received) -> bool {
    received.topic.ends_with("/data")
}

/// Answers batches as the closure says, by their number from 1, and acknowledges all other messages.
fn on_batch(mut answer: impl FnMut(u64) -> Action + Send + 'static) -> impl FnMut(&Received) -> Action + Send {
    let mut number = 0;
    move |received| {
        if !is_batch(received) {
            return Action::Ack;
        }
        number += 1;
        answer(number)
    }
}

#[tokio::test]
async fn batches_are_delivered_with_qos_1_and_in_order() {
    let broker = Broker::start().await;
    let mut output = Output::start(&broker);
    output.push(1000);
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    assert_eq!(result, Deliveries { batches: 1000, ..Deliveries::default() });
    let received = broker.received();
    let batches: Vec<_> = received.iter().filter(|received| is_batch(received)).collect();
    assert!(batches.iter().all(|one| one.qos as u8 == 1 && !one.retain));
    assert_eq!(batch(batches[0]).unwrap().1, json!({ "seq": 0, "ts": 0, "d": { "n": "x" } }));
    assert_eq!(output.health.delivered(), (1000, 1000));
    output.stop().await;
}

#[tokio::test]
async fn birth_and_will_are_sent_at_each_connection() {
    let broker = Broker::start().await;
    broker.behave(on_batch(|number| if number % 4 == 0 { Action::Cut } else { Action::Ack }));
    let mut output = Output::start_with(&broker, json!({ "user": "me" }));
    for connections in 1..=3 {
        output.wait_for("connected", |output| output.health.is_connected()).await;
        broker.wait_for("connection", |broker| broker.connected().len() >= connections).await;
        output.push(4);
        broker.wait_for("loss", |broker| broker.connected()[connections - 1].is_closed).await;
    }
    let connected = broker.connected();
    for one in &connected {
        assert!(one.connect.clean_start && one.connect.client_id == "fatek-hall-2", "{:?}", one.connect);
        assert!((10..=30).contains(&one.connect.keep_alive), "{:?}", one.connect);
        assert_eq!(one.connect.properties.as_ref().unwrap().session_expiry_interval, Some(0));
        let will = one.will.as_ref().unwrap();
        assert_eq!((&will.topic[..], &will.message[..]), (&b"fatek/hall-2/state"[..], &b"{\"online\":false}"[..]));
        assert!(will.retain && will.qos as u8 == 1);
    }
    let births: Vec<_> = broker.received().into_iter().filter(|one| one.topic == "fatek/hall-2/state").collect();
    let of: Vec<usize> = births.iter().map(|birth| birth.connection).collect();
    assert!((1..=connected.len()).all(|connection| of.contains(&connection)), "{of:?}");
    for birth in births {
        let state: Value = serde_json::from_slice(&birth.payload).unwrap();
        assert_eq!((&state["online"], &state["version"]), (&json!(true), &json!(env!("CARGO_PKG_VERSION"))));
        assert!(birth.retain);
    }
    output.stop().await;
}

/// With an acknowledgement in the buffer when a message is sent, 60 of 3000 were lost.
#[tokio::test]
async fn a_connection_that_is_cut_at_any_message_loses_nothing() {
    let broker = Broker::start().await;
    let (mut random, mut cuts) = (fastrand::Rng::with_seed(17), 12);
    broker.behave(on_batch(move |_| {
        if cuts == 0 || random.u32(..60) > 0 {
            return Action::Ack;
        }
        cuts -= 1;
        if random.bool() { Action::Cut } else { Action::Lose }
    }));
    let mut output = Output::start(&broker);
    output.push(3000);
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    println!("12 cuts: {result:?}");
    assert_eq!((result.batches, result.lost, result.out_of_order, result.unmarked), (3000, 0, 0, 0));
    assert_eq!(output.health.reconnects(), 12);
    output.stop().await;
}
