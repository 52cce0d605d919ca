//! The output to NATS JetStream, with a real server.
//!
//! `FATEK_BRIDGE_KILLS` sets how often the server is killed (20 in a campaign, 5 otherwise), `FATEK_BRIDGE_STALL` for
//! how many seconds it stands still (600 in a campaign, 12 otherwise).

mod common;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use async_nats::jetstream::{self, stream};
use fatek::plant::Plant;
use fatek::poll::Poller;
use fatek::sim::{Bus, Fault, Faults, Plc, Rule};
use fatek::wire::Framing;
use fatek::{Pool, register};
use fatek_bridge::batch::Batch;
use fatek_bridge::buffer::Buffer;
use fatek_bridge::command::{CommandSettings, Commands, Storage};
use fatek_bridge::config::{Config, NatsSection};
use fatek_bridge::output::{BridgeNames, Health, OutputKind, OutputParts, nats};
use fatek_bridge::registry::{Elsewhere, Registry};
use futures::StreamExt as _;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use common::nats::{NatsServer, PATIENCE, Stored};

/// The output under test, with its buffer.
struct Output {
    buffer: Buffer,
    health: Arc<Health>,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

/// A section, by the configuration that a user would write.
fn section(folder: &Path, url: &str, more: &str) -> (NatsSection, Config) {
    let text = format!(
        "[bridge]\nid = 'hall-2'\n[nats]\nurl = '{url}'\n{more}\n[plc.mixer]\nlink = 'tcp://127.0.0.1:9'\nstation = 1\n"
    );
    let path = folder.join("plant.toml");
    std::fs::write(&path, text).unwrap();
    let config = Config::load(&path).unwrap();
    (config.nats.clone().unwrap(), config)
}

impl Output {
    fn start(folder: &Path, port: u16, more: &str) -> Self {
        let url = format!("nats://127.0.0.1:{port}");
        Self::start_with(section(folder, &url, more), Registry::default(), None)
    }

    fn start_with((section, config): (NatsSection, Config), registry: Registry, commands: Option<Commands>) -> Self {
        // The second cursor is that of another output.
        let buffer = Buffer::in_memory(2, 256 << 20);
        let health = Arc::new(Health::new(OutputKind::Nats));
        let stop = CancellationToken::new();
        let parts = OutputParts {
            names: BridgeNames::of(&config),
            registry,
            cursor: buffer.cursor(0),
            health: health.clone(),
            commands,
            stop: stop.clone(),
        };
        let task = tokio::spawn(nats::run(section, parts));
        Self { buffer, health, stop, task }
    }

    fn push(&self, plc: &str, seq: u64) {
        let data = json!({ "level": seq }).to_string().into();
        self.buffer.push(Batch { plc: plc.into(), revision: 0, seq, ts: seq, samples: 1, data });
    }

    async fn until(&self, what: &str, is_true: impl Fn(&Self) -> bool) {
        let until = Instant::now() + PATIENCE;
        while !is_true(self) {
            assert!(Instant::now() < until, "{what}: {:?}, lag {}", self.health, self.lag());
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    fn lag(&self) -> u64 {
        self.buffer.stats()[0].lag
    }

    async fn drained(&self) {
        self.until("drained", |output| output.lag() == 0).await;
    }

    async fn stop(self) {
        self.stop.cancel();
        tokio::time::timeout(PATIENCE, self.task).await.unwrap().unwrap();
    }
}

/// The sequence numbers of each PLC, in the order of the stream.
fn seqs(stored: &[Stored]) -> BTreeMap<String, Vec<u64>> {
    let mut seqs: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    for Stored { subject, id, message } in stored {
        let seq = message["seq"].as_u64().unwrap();
        let plc = subject.strip_prefix("fatek.hall-2.").unwrap().strip_suffix(".data").unwrap();
        assert_eq!(*id, format!("hall-2.{plc}.{seq}"));
        assert_eq!(message["d"], json!({ "level": seq }));
        seqs.entry(plc.to_owned()).or_default().push(seq);
    }
    seqs
}

fn all(plcs: &[&str], last: u64) -> BTreeMap<String, Vec<u64>> {
    plcs.iter().map(|plc| ((*plc).to_owned(), (1..=last).collect())).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn batches_arrive_once_and_in_order_while_the_server_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::start(folder.path()) else { return };
    let kills: u64 = std::env::var("FATEK_BRIDGE_KILLS").ok().and_then(|text| text.parse().ok()).unwrap_or(5);
    let output = Output::start(folder.path(), server.port(), "");
    let (plcs, buffer) = (["mixer", "boiler", "pump"], output.buffer.clone());
    let pushing = CancellationToken::new();
    let pusher = tokio::spawn({
        let pushing = pushing.clone();
        async move {
            let mut seq = 0;
            while !pushing.is_cancelled() {
                for _ in 0..5 {
                    seq += 1;
                    for plc in plcs {
                        let data = json!({ "level": seq }).to_string().into();
                        buffer.push(Batch { plc: plc.into(), revision: 0, seq, ts: seq, samples: 1, data });
                    }
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            seq
        }
    });
    for kill in 0..kills {
        let before = output.health.delivered().0;
        output.until("delivers", |output| output.health.delivered().0 > before + 200).await;
        server.kill();
        tokio::time::sleep(Duration::from_millis(kill % 3 * 150)).await;
        server.run();
    }
    pushing.cancel();
    let last = pusher.await.unwrap();
    output.drained().await;
    let stored = server.stored("FATEK").await;
    let replays = stored.iter().filter(|stored| stored.message["hist"] == json!(true)).count();
    println!(
        "{kills} kills: {} batches, 0 lost, {replays} replays, {} reconnects",
        stored.len(),
        output.health.reconnects()
    );
    assert_eq!(seqs(&stored), all(&plcs, last));
    assert!(output.health.reconnects() >= kills);
    output.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_comes_later_gets_everything() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::stopped(folder.path(), "") else { return };
    let output = Output::start(folder.path(), server.port(), "");
    (1..=1000).for_each(|seq| output.push("mixer", seq));
    output.until("fails", |output| output.health.failure().is_some()).await;
    assert!(!output.health.is_connected());
    server.run();
    output.drained().await;
    assert_eq!(seqs(&server.stored("FATEK").await), all(&["mixer"], 1000));
    output.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_that_is_deleted_is_made_again() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let output = Output::start(folder.path(), server.port(), "");
    (1..=10).for_each(|seq| output.push("mixer", seq));
    output.drained().await;
    let context = jetstream::new(server.client().await);
    let config = context.get_stream("FATEK").await.unwrap().cached_info().config.clone();
    assert_eq!(config.subjects, ["fatek.*.*.data"]);
    context.delete_stream("FATEK").await.unwrap();
    (11..=20).for_each(|seq| output.push("mixer", seq));
    output.drained().await;
    let stored = server.stored("FATEK").await;
    assert_eq!(seqs(&stored)["mixer"], (11..=20).collect::<Vec<u64>>());
    assert_eq!(output.health.failure(), None);
    output.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_that_does_not_capture_the_batches_is_named_in_the_error() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let context = jetstream::new(server.client().await);
    let mut config =
        stream::Config { name: "FATEK".into(), subjects: vec!["other".into()], ..stream::Config::default() };
    context.create_stream(config.clone()).await.unwrap();
    let output = Output::start(folder.path(), server.port(), "");
    (1..=10).for_each(|seq| output.push("mixer", seq));
    let names = |output: &Output| {
        let failure = output.health.failure().unwrap_or_default();
        failure.contains("the stream FATEK captures other, and not fatek.hall-2.*.data: add it")
    };
    output.until("an error", names).await;
    assert_eq!(output.lag(), 10);
    config.subjects.push("fatek.hall-2.*.data".into());
    context.update_stream(config).await.unwrap();
    output.drained().await;
    assert_eq!(seqs(&server.stored("FATEK").await), all(&["mixer"], 10));
    output.stop().await;
}

/// A full stream that refuses new messages: they are kept until there is room.
#[tokio::test(flavor = "multi_thread")]
async fn batches_that_the_stream_refuses_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let context = jetstream::new(server.client().await);
    let config = stream::Config {
        name: "FATEK".into(),
        subjects: vec!["fatek.*.*.data".into()],
        max_messages: 5,
        discard: stream::DiscardPolicy::New,
        max_message_size: 1000,
        ..stream::Config::default()
    };
    context.create_stream(config.clone()).await.unwrap();
    let output = Output::start(folder.path(), server.port(), "");
    (1..=8).for_each(|seq| output.push("mixer", seq));
    let refuses = |output: &Output| output.health.refused() > 0 && output.lag() == 3;
    output.until("refuses", refuses).await;
    assert!(output.health.failure().unwrap().contains("maximum messages exceeded"), "{:?}", output.health);
    context.update_stream(stream::Config { max_messages: 100, ..config }).await.unwrap();
    output.drained().await;
    assert_eq!(seqs(&server.stored("FATEK").await), all(&["mixer"], 8));
    // One that is too large for the stream is given up, and counted.
    let data = json!({ "name": "x".repeat(2000) }).to_string().into();
    output.buffer.push(Batch { plc: "mixer".into(), revision: 0, seq: 9, ts: 9, samples: 1, data });
    output.push("mixer", 10);
    output.drained().await;
    assert_eq!((output.health.skipped(), output.health.delivered().0), (1, 9));
    output.stop().await;
}

/// A server that stands still for longer than the acknowledgements may take.
#[tokio::test(flavor = "multi_thread")]
async fn a_stalled_server_holds_up_no_other_output_and_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let output = Output::start(folder.path(), server.port(), "");
    let mut other = output.buffer.cursor(1);
    output.push("mixer", 1);
    output.drained().await;
    server.signal("STOP");
    let (begin, mut worst) = (Instant::now(), Duration::ZERO);
    let mut last = 1;
    let stall = std::env::var("FATEK_BRIDGE_STALL").ok().and_then(|text| text.parse().ok()).unwrap_or(12);
    while begin.elapsed() < Duration::from_secs(stall) {
        last += 1;
        output.push("mixer", last);
        let pushed = Instant::now();
        let entries = loop {
            let entries = other.next(100).await;
            if entries.last().is_some_and(|entry| entry.batch.seq == last) {
                break entries;
            }
        };
        worst = worst.max(pushed.elapsed());
        other.acknowledge(entries.last().unwrap().position);
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let stalled = output.lag();
    server.signal("CONT");
    output.drained().await;
    println!("stalled for {stall} s: {stalled} batches waited; the other output waited {worst:?} at most");
    assert!(stalled > 100 && worst < Duration::from_secs(2), "{stalled} {worst:?}");
    assert_eq!(seqs(&server.stored("FATEK").await), all(&["mixer"], last));
    output.stop().await;
}

/// A PLC with its registry.
async fn plant(plc: &Plc) -> (fatek::sim::Server, Poller, Registry) {
    let server = plc.serve("127.0.0.1:0").await.unwrap();
    let (poller, registry) = polled(&server);
    (server, poller, registry)
}

fn polled(server: &fatek::sim::Server) -> (Poller, Registry) {
    let plant = Plant::from_toml(&format!(
        "[plc.mixer]\nlink = '{}'\nstation = 1\ntag.setpoint = {{ at = 'R200:u16', write = {{ max = 80 }} }}\n\
         tag.level = 'R5'\n",
        server.endpoint()
    ))
    .unwrap();
    let (poller, registry) = (Poller::new(), Registry::default());
    registry.apply(&plant, &Pool::new(), &poller.handle()).unwrap();
    (poller, registry)
}

fn command(id: &str, tag: &str, value: Value) -> bytes::Bytes {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_millis();
    json!({ "id": id, "tag": tag, "value": value, "ts": u64::try_from(now).unwrap() }).to_string().into()
}

async fn request(client: &async_nats::Client, payload: bytes::Bytes) -> Value {
    let reply = client.request("fatek.hall-2.mixer.cmd", payload).await.unwrap();
    serde_json::from_slice(&reply.payload).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn commands_are_executed_and_get_their_replies() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::start(folder.path()) else { return };
    let plc = Plc::new();
    let (_plc_server, _poller, registry) = plant(&plc).await;
    let storage = Storage::File(folder.path().join("commands.redb"));
    let commands = Commands::start(CommandSettings::new(storage), registry.clone()).await.unwrap();
    let url = format!("nats://127.0.0.1:{}", server.port());
    let output = Output::start_with(section(folder.path(), &url, "write = true"), registry, Some(commands.clone()));
    let client = server.client().await;
    let mut states = client.subscribe("fatek.hall-2.state").await.unwrap();
    let mut replies = client.subscribe("fatek.hall-2.mixer.cmd.reply").await.unwrap();
    client.flush().await.unwrap();
    output.until("connected", |output| output.health.is_connected()).await;
    // The subscription is there when the first state comes.
    assert_eq!(serde_json::from_slice::<Value>(&states.next().await.unwrap().payload).unwrap()["online"], true);
    let ok = request(&client, command("1", "setpoint", json!(42))).await;
    assert_eq!(ok, json!({"id": "1", "result": "ok", "why": null, "read_back": 42}));
    assert_eq!(plc.read(register!("R200")), 42_u16.into());
    let refused = request(&client, command("2", "setpoint", json!(81))).await;
    assert_eq!(refused, json!({"id": "2", "result": "refused", "why": "range: 81 is above 80", "read_back": null}));
    assert_eq!(request(&client, command("3", "level", json!(1))).await["result"], "refused");
    assert_eq!(request(&client, "nonsense".into()).await["id"], Value::Null);
    // A repetition gets the same reply, and is not written again.
    let repeated = command("4", "setpoint", json!(7));
    assert_eq!(request(&client, repeated.clone()).await["result"], "ok");
    plc.write(register!("R200"), 0_u16).unwrap();
    assert_eq!(request(&client, repeated.clone()).await["read_back"], 7);
    assert_eq!(plc.read(register!("R200")), 0_u16.into());
    // Without a reply subject, and with one that would delete the stream.
    let subject = "fatek.hall-2.mixer.cmd";
    client.publish(subject, command("5", "setpoint", json!(8))).await.unwrap();
    client
        .publish_with_reply(subject, "$JS.API.STREAM.DELETE.FATEK", command("6", "setpoint", json!(9)))
        .await
        .unwrap();
    for id in ["5", "6"] {
        let reply = replies.next().await.unwrap();
        assert_eq!(serde_json::from_slice::<Value>(&reply.payload).unwrap()["id"], id);
    }
    // The server is killed and comes back: commands are taken again.
    server.kill();
    server.run();
    output.until("connected again", |output| output.health.reconnects() > 0 && output.health.is_connected()).await;
    let again = async {
        loop {
            if let Ok(reply) = client.request(subject, repeated.clone()).await {
                break serde_json::from_slice::<Value>(&reply.payload).unwrap();
            }
        }
    };
    assert_eq!(tokio::time::timeout(PATIENCE, again).await.unwrap()["read_back"], 7);
    let stats = commands.stats().plcs["mixer"];
    assert_eq!((stats.ok, stats.refused, stats.unknown), (4, 3, 0), "{stats:?}");
    output.stop().await;
    let goodbye = async {
        loop {
            let state: Value = serde_json::from_slice(&states.next().await.unwrap().payload).unwrap();
            if state["online"] == false {
                break;
            }
        }
    };
    tokio::time::timeout(PATIENCE, goodbye).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn without_write_nothing_takes_commands_and_states_are_published() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let plc = Plc::new();
    let (_plc_server, _poller, registry) = plant(&plc).await;
    let commands = Commands::start(CommandSettings::new(Storage::Memory), registry.clone()).await.unwrap();
    let client = server.client().await;
    let mut states = client.subscribe("fatek.hall-2.mixer.state").await.unwrap();
    client.flush().await.unwrap();
    let url = format!("nats://127.0.0.1:{}", server.port());
    let output = Output::start_with(section(folder.path(), &url, ""), registry, Some(commands));
    let online = async {
        loop {
            let state: Value = serde_json::from_slice(&states.next().await.unwrap().payload).unwrap();
            if state["online"] == true {
                break;
            }
        }
    };
    tokio::time::timeout(PATIENCE, online).await.expect("the state of the PLC");
    let failed = client.request("fatek.hall-2.mixer.cmd", command("1", "setpoint", json!(1))).await;
    assert!(failed.unwrap_err().to_string().contains("no responders"));
    assert_eq!(plc.read(register!("R200")), 0_u16.into());
    output.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn tls_is_checked_by_the_given_certificates() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let authority = |name: &str| {
        let key = rcgen::KeyPair::generate().unwrap();
        let mut params = rcgen::CertificateParams::new(Vec::<String>::new()).unwrap();
        params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        let certificate = params.self_signed(&key).unwrap();
        std::fs::write(path(name), certificate.pem()).unwrap();
        rcgen::Issuer::new(params, key)
    };
    let (issuer, _other) = (authority("ca.pem"), authority("other.pem"));
    for (name, subject) in [("server", "localhost"), ("client", "bridge")] {
        let key = rcgen::KeyPair::generate().unwrap();
        let params = rcgen::CertificateParams::new(vec![subject.to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &issuer).unwrap();
        std::fs::write(path(&format!("{name}.pem")), certificate.pem()).unwrap();
        std::fs::write(path(&format!("{name}.key")), key.serialize_pem()).unwrap();
    }
    let tls = format!(
        "tls {{ cert_file: {0:?}/server.pem, key_file: {0:?}/server.key, ca_file: {0:?}/ca.pem, verify: true }}\n",
        folder.path()
    );
    let tls = tls.replace("\"/", "/").replace(&format!("{:?}", folder.path()), &folder.path().display().to_string());
    let Some(server) = NatsServer::start_with(folder.path(), &tls) else { return };
    let url = format!("tls://localhost:{}", server.port());
    let client = "cert_file = 'client.pem'\nkey_file = 'client.key'";
    for (more, expected) in [
        (format!("ca_file = 'other.pem'\n{client}"), Err("invalid peer certificate")),
        ("ca_file = 'ca.pem'".to_owned(), Err("certificate")),
        (format!("ca_file = 'ca.pem'\n{client}"), Ok(())),
    ] {
        let output = Output::start_with(section(folder.path(), &url, &more), Registry::default(), None);
        match expected {
            Ok(()) => {
                output.push("mixer", 1);
                output.drained().await;
            }
            Err(text) => {
                output.until("an error", |output| output.health.failure().is_some()).await;
                let failure = output.health.failure().unwrap().to_lowercase();
                assert!(failure.contains(text), "{failure}");
            }
        }
        output.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_user_with_a_password_is_let_in() {
    let folder = tempfile::tempdir().unwrap();
    let users = "authorization { user: bridge, password: hunter2 }\n";
    let Some(server) = NatsServer::start_with(folder.path(), users) else { return };
    let url = format!("nats://127.0.0.1:{}", server.port());
    std::fs::write(folder.path().join("good"), "hunter2\n").unwrap();
    std::fs::write(folder.path().join("bad"), "hunter3\n").unwrap();
    for (more, is_let_in) in [
        ("", false),
        ("user = 'bridge'\npassword_file = 'bad'", false),
        ("user = 'bridge'\npassword_file = 'good'", true),
    ] {
        let output = Output::start_with(section(folder.path(), &url, more), Registry::default(), None);
        if is_let_in {
            output.push("mixer", 1);
            output.drained().await;
        } else {
            output.until("an error", |output| output.health.failure().is_some()).await;
            let failure = output.health.failure().unwrap();
            assert!(failure.to_lowercase().contains("authorization") && !failure.contains("hunter"), "{failure}");
        }
        output.stop().await;
    }
}

/// Without the cure the client waited in vain: the output ended before the write did.
#[tokio::test(flavor = "multi_thread")]
async fn a_command_under_way_gets_its_reply_when_the_output_ends() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let (plc, faults) = (Plc::new(), Faults::new(1));
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
    let plc_server = fatek::sim::Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let (_poller, registry) = polled(&plc_server);
    let commands = Commands::start(CommandSettings::new(Storage::Memory), registry.clone()).await.unwrap();
    let url = format!("nats://127.0.0.1:{}", server.port());
    let output = Output::start_with(section(folder.path(), &url, "write = true"), registry, Some(commands));
    let client = server.client().await;
    output.until("connected", |output| output.health.is_connected()).await;
    assert_eq!(first_reply(&client).await["result"], "ok");
    let delay = Duration::from_millis(150);
    faults.set_rules([Rule::new(Fault::Delay { min: delay, max: delay })]);
    let asked = client.clone();
    let reply = tokio::spawn(async move { request(&asked, command("2", "setpoint", json!(42))).await });
    output.until("it is executed", |_| plc.read(register!("R200")) == 42_u16.into()).await;
    output.stop().await;
    let reply = tokio::time::timeout(PATIENCE, reply).await.unwrap().unwrap();
    assert_eq!((&reply["id"], &reply["result"]), (&json!("2"), &json!("ok")), "{reply}");
}

/// The reply to a command, which is sent until the output has subscribed.
async fn first_reply(client: &async_nats::Client) -> Value {
    let payload = command("1", "setpoint", json!(1));
    let ask = async {
        loop {
            if let Ok(reply) = client.request("fatek.hall-2.mixer.cmd", payload.clone()).await {
                break serde_json::from_slice(&reply.payload).unwrap();
            }
        }
    };
    tokio::time::timeout(PATIENCE, ask).await.unwrap()
}

/// A network that takes 150 ms from the client to the server. Bytes are lost that are under way when the client closes
/// its connection, as at a server that fails to write to it.
async fn slow_network(server: u16) -> u16 {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    tokio::spawn(async move {
        while let Ok((client, _)) = listener.accept().await {
            let (mut from_client, mut to_client) = client.into_split();
            let server = tokio::net::TcpStream::connect(("127.0.0.1", server)).await.unwrap();
            let (mut from_server, mut to_server) = server.into_split();
            tokio::spawn(async move { tokio::io::copy(&mut from_server, &mut to_client).await });
            let (under_way, mut arriving) = tokio::sync::mpsc::unbounded_channel();
            tokio::spawn(async move {
                let mut bytes = vec![0; 64 << 10];
                while let Ok(len @ 1..) = from_client.read(&mut bytes).await {
                    let due = tokio::time::Instant::now() + Duration::from_millis(150);
                    under_way.send((due, bytes[..len].to_vec())).unwrap();
                }
            });
            tokio::spawn(async move {
                while let Some((due, bytes)) = arriving.recv().await {
                    tokio::time::sleep_until(due).await;
                    // The client has closed it.
                    if arriving.is_closed() || to_server.write_all(&bytes).await.is_err() {
                        break;
                    }
                }
            });
        }
    });
    port
}

/// The last member of a fleet stops: it says that no PLC has a member.
///
/// While only the state of the bridge was published at the end, this test gave no state of the PLC: a subscriber knew
/// after 30 s of silence. While the end did not wait for the server, the last states were lost.
#[tokio::test(flavor = "multi_thread")]
async fn an_output_that_stops_publishes_the_last_states() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let (_plc_server, _poller, registry) = plant(&Plc::new()).await;
    let client = server.client().await;
    let mut states = client.subscribe("fatek.hall-2.>").await.unwrap();
    client.flush().await.unwrap();
    let output = Output::start_with(
        section(folder.path(), &format!("nats://127.0.0.1:{}", slow_network(server.port()).await), ""),
        registry.clone(),
        None,
    );
    let mut next = async |what: &str| -> (String, Value) {
        let message = tokio::time::timeout(PATIENCE, states.next()).await.expect(what).unwrap();
        (message.subject.to_string(), serde_json::from_slice(&message.payload).unwrap())
    };
    while next("the state of the PLC").await.0 != "fatek.hall-2.mixer.state" {}
    registry.give_up([(&"mixer".into(), Elsewhere::Lost)]);
    output.stop().await;
    let mut last = None;
    loop {
        let (subject, state) = next("the last state").await;
        match subject.as_str() {
            "fatek.hall-2.state" if state["online"] == false => break,
            "fatek.hall-2.mixer.state" => last = Some(state),
            _ => {}
        }
    }
    assert_eq!(last, Some(json!({ "online": false, "why": "fleet: no member polls it" })));
}
