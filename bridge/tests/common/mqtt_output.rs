//! The MQTT output in the process of the test, with a buffer that the test fills.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fatek::plant::Plant;
use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{Poller, Pool};
use fatek_bridge::batch::{Batch, milliseconds};
use fatek_bridge::buffer::Buffer;
use fatek_bridge::command::{CommandSettings, Commands, Storage};
use fatek_bridge::config::{MqttSection, Name};
use fatek_bridge::output::{BridgeNames, Health};
use fatek_bridge::output::{OutputKind, OutputParts, mqtt};
use fatek_bridge::registry::Registry;
use futures::StreamExt as _;
use serde_json::{Value, json};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

use super::bridge::PATIENCE;
use super::deliveries::Deliveries;
use super::mqtt_broker::{Broker, Received};

/// The PLCs of the batches, in turn.
pub const PLCS: [&str; 3] = ["mixer", "boiler", "pump-1"];

/// The output; a second output may take the same batches.
pub struct Output {
    pub buffer: Buffer,
    pub health: Arc<Health>,
    pub pushed: u64,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Output {
    /// An output without PLCs. `more`: keys of `[mqtt]`.
    pub fn start(url: &str, more: Value) -> Self {
        Self::start_with(url, more, Registry::default(), None)
    }

    pub fn start_with(url: &str, more: Value, registry: Registry, commands: Option<Commands>) -> Self {
        Self::start_after(url, more, None, registry, commands)
    }

    /// The output of the member `pc-1` of a fleet.
    pub fn start_member(url: &str, registry: Registry) -> Self {
        let member = Some(serde_json::from_value(json!("pc-1")).unwrap());
        Self::start_named(url, (json!({}), None), registry, None, member)
    }

    /// An output after a reload. `former`: keys of `[mqtt]` before it.
    pub fn start_after(
        url: &str,
        more: Value,
        former: Option<Value>,
        registry: Registry,
        commands: Option<Commands>,
    ) -> Self {
        Self::start_named(url, (more, former), registry, commands, None)
    }

    fn start_named(
        url: &str,
        (more, former): (Value, Option<Value>),
        registry: Registry,
        commands: Option<Commands>,
        member: Option<Name>,
    ) -> Self {
        let section = |more: &Value| -> MqttSection {
            let mut section = json!({ "url": url });
            section.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
            serde_json::from_value(section).unwrap()
        };
        let (section, former) = (section(&more), former.as_ref().map(section));
        let buffer = Buffer::in_memory(2, 1 << 30);
        let health = Arc::new(Health::new(OutputKind::Mqtt));
        let stop = CancellationToken::new();
        let names = BridgeNames { id: serde_json::from_value(json!("hall-2")).unwrap(), member };
        let cursor = buffer.cursor(0);
        let parts = OutputParts { names, registry, cursor, health: health.clone(), commands, stop: stop.clone() };
        let task = tokio::spawn(mqtt::run(section, former, parts));
        Self { buffer, health, stop, task, pushed: 0 }
    }

    pub fn push(&mut self, number: u64) {
        self.push_sized(number, 1);
    }

    /// Pushes batches with a text of this length.
    pub fn push_sized(&mut self, number: u64, length: usize) {
        for _ in 0..number {
            let (plc, seq) = (PLCS[usize::try_from(self.pushed % 3).unwrap()], self.pushed / 3);
            let data = json!({ "n": "x".repeat(length) }).to_string().into();
            let ts = milliseconds(SystemTime::now());
            self.buffer.push(Batch { plc: plc.into(), revision: 0, seq, ts, samples: 1, data });
            self.pushed += 1;
        }
    }

    /// The sequence numbers of each PLC.
    pub fn expected(&self) -> BTreeMap<&'static str, Range<u64>> {
        let count = |at: u64| (self.pushed + 2 - at) / 3;
        PLCS.into_iter().zip(0..).map(|(plc, at)| (plc, 0..count(at))).collect()
    }

    /// The batches that are not acknowledged.
    pub fn lag(&self) -> u64 {
        self.buffer.stats()[0].lag
    }

    pub async fn wait_for(&self, what: &str, mut holds: impl FnMut(&Self) -> bool) {
        let until = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < until, "{what}: not within {PATIENCE:?}; {:?}", self.health);
            sleep(Duration::from_millis(5)).await;
        }
    }

    pub async fn wait_until_delivered(&self) {
        self.wait_for("all delivered", |output| output.lag() == 0).await;
    }

    pub async fn wait_until_connected(&self) {
        self.wait_for("connected", |output| output.health.is_connected()).await;
    }

    /// Compares what the broker has with what was pushed.
    pub fn check(&self, broker: &Broker) -> Deliveries {
        let received: Vec<(String, Value)> = broker.received().iter().filter_map(batch).collect();
        Deliveries::check(received.iter().map(|(plc, batch)| (plc.as_str(), batch)), &self.expected())
    }

    /// Stops it, and returns the time that it takes.
    pub async fn stop(self) -> Duration {
        let begin = Instant::now();
        self.stop.cancel();
        timeout(PATIENCE, self.task).await.expect("it ends").expect("no panic");
        begin.elapsed()
    }
}

/// PLC and content of a batch.
pub fn batch(received: &Received) -> Option<(String, Value)> {
    let plc = received.topic.strip_prefix("fatek/hall-2/")?.strip_suffix("/data")?;
    Some((plc.to_owned(), serde_json::from_slice(&received.payload).unwrap()))
}

/// Polled PLCs in the process of the test: simulated stations 1 and 2 of one server.
pub struct PolledPlant {
    pub registry: Registry,
    pub plcs: [Plc; 2],
    pub server: Option<Server>,
    link: String,
    pool: Pool,
    poller: fatek::poll::PollerHandle,
    samples: JoinHandle<()>,
}

impl PolledPlant {
    /// PLCs of the names of [`PLCS`], without tags.
    pub async fn of_batches() -> Self {
        let plc = |(station, name)| format!("[plc.{name}]\nlink = 'LINK'\nstation = {station}\n");
        Self::start(&(1..).zip(PLCS).map(plc).collect::<String>()).await
    }

    /// Polls PLCs. `LINK` in the text is replaced by the address of the server.
    pub async fn start(text: &str) -> Self {
        let plcs = [Plc::new(), Plc::new()];
        let bus = Bus::new().with_station(1, plcs[0].clone()).unwrap().with_station(2, plcs[1].clone()).unwrap();
        let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
        let link = format!("tcp://{}", server.local_addr());
        let mut poller = Poller::new();
        let handle = poller.handle();
        let samples = tokio::spawn(async move { while poller.next().await.is_some() {} });
        let plant = Self {
            registry: Registry::default(),
            plcs,
            server: Some(server),
            link,
            pool: Pool::new(),
            poller: handle,
            samples,
        };
        plant.apply(text);
        plant
    }

    /// Applies another text.
    pub fn apply(&self, text: &str) {
        let plant = Plant::from_toml(&text.replace("LINK", &self.link)).unwrap();
        self.registry.apply(&plant, &self.pool, &self.poller).unwrap();
    }

    /// Commands for them, with ids in memory.
    pub async fn commands(&self) -> Commands {
        Commands::start(CommandSettings::new(Storage::Memory), self.registry.clone()).await.unwrap()
    }
}

impl Drop for PolledPlant {
    fn drop(&mut self) {
        self.samples.abort();
    }
}
