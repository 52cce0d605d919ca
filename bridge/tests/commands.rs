//! Commands against simulated PLCs over TCP, with the file of the ids on disk.

mod common;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use fastrand::Rng;
use fatek::command::Code;
use fatek::plant::Plant;
use fatek::poll::Poller;
use fatek::sim::{Bus, Change, DisconnectAt, Fault, Faults, Plc, Rule, Server};
use fatek::wire::Framing;
use fatek::{ErrorCode, Pool, discrete, register};
use fatek_bridge::command::{CommandSettings, Commands, FILE_NAME, Outcome, Reply, Storage, WallClock};
use fatek_bridge::config::Config;
use fatek_bridge::registry::Registry;
use futures::future::join_all;
use serde_json::{Value, json};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);

const TAGS: &str = r#"
tag.setpoint = { at = "R200:f32", write = { min = 0.0, max = 80.0 } }
tag.speed = { at = "R210:i16*0.1", write = { min = -10, max = 10 } }
tag.recipe = { at = "R220-R223", write = { max = 500 } }
tag.name = { at = "R230-R234:text", write = {} }
tag.mode = { at = "R240.3", write = {} }
tag.valve = { at = "M5", write = {} }
tag.start = { at = "M100", write = { pulse = "200ms" } }
tag.long = { at = "M101", write = { pulse = "1h" } }
tag.level = "R5"
tag.alarm = "M7"
"#;

/// A simulated PLC with the commands for it.
struct Bench {
    folder: TempDir,
    plc: Plc,
    faults: Faults,
    server: Server,
    registry: Registry,
    _poller: Poller,
    commands: Commands,
}

fn settings(folder: &Path) -> CommandSettings {
    let mut settings = CommandSettings::new(Storage::File(folder.join(FILE_NAME)));
    // The tests are about other limits.
    (settings.limits.per_second, settings.limits.burst) = (100_000, 100_000);
    settings
}

fn plant(endpoint: &str, tags: &str) -> Plant {
    Plant::from_toml(&format!("[plc.mixer]\nlink = '{endpoint}'\nstation = 1\n{tags}")).unwrap()
}

fn registry(plant: &Plant) -> (Registry, Poller) {
    let (registry, poller) = (Registry::default(), Poller::new());
    let pool = Pool::builder().links(|link| link.response_timeout(Duration::from_millis(300))).build();
    registry.apply(plant, &pool, &poller.handle()).unwrap();
    (registry, poller)
}

impl Bench {
    async fn start() -> Self {
        Self::with_tags(TAGS).await
    }

    async fn with_tags(tags: &str) -> Self {
        let (plc, faults) = (Plc::new(), Faults::new(1).log_capacity(1_000_000));
        let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
        let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
        let (registry, poller) = registry(&plant(&server.endpoint().to_string(), tags));
        let folder = tempfile::tempdir().unwrap();
        let commands = Commands::start(settings(folder.path()), registry.clone()).await.unwrap();
        Self { folder, plc, faults, server, registry, _poller: poller, commands }
    }

    async fn send(&self, id: &str, tag: &str, value: Value) -> Reply {
        self.commands.execute("mixer", command(id, tag, value).as_bytes(), false).await
    }

    async fn restart(&mut self) {
        self.commands.close().await;
        self.commands = Commands::start(settings(self.folder.path()), self.registry.clone()).await.unwrap();
    }

    /// The writes of the PLC.
    fn changes(&self) -> Vec<Change> {
        self.faults.log().changes(1)
    }
}

fn now() -> u64 {
    u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis()).unwrap()
}

fn command(id: &str, tag: &str, value: Value) -> String {
    json!({ "id": id, "tag": tag, "value": value, "ts": now() }).to_string()
}

async fn until(what: &str, is_true: impl Fn() -> bool) {
    let begin = Instant::now();
    while !is_true() {
        assert!(begin.elapsed() < PATIENCE, "{what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

fn ok(reply: &Reply) -> &Value {
    assert_eq!((reply.result(), reply.why()), (Outcome::Ok, None), "{reply:?}");
    reply.read_back().unwrap()
}

fn is(reply: &Reply, result: Outcome, why: &str) {
    assert_eq!(reply.result(), result, "{reply:?}");
    assert!(reply.why().unwrap_or_default().starts_with(why), "{reply:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn writes_are_read_back_in_the_form_of_their_tags() {
    let bench = Bench::start().await;
    assert_eq!(*ok(&bench.send("1", "setpoint", json!(42.5)).await), json!(42.5));
    assert_eq!(*ok(&bench.send("2", "speed", json!(-2.34)).await), json!(-2.3));
    assert_eq!(*ok(&bench.send("3", "recipe", json!([1, 2, 3, 500])).await), json!([1, 2, 3, 500]));
    assert_eq!(*ok(&bench.send("4", "name", json!("pump 2")).await), json!("pump 2"));
    assert_eq!(*ok(&bench.send("5", "mode", json!(true)).await), json!(true));
    assert_eq!(*ok(&bench.send("6", "valve", json!(true)).await), json!(true));
    assert_eq!(bench.plc.read(register!("R240")), 8_u16.into());
    for (tag, value, why) in [
        ("setpoint", json!(80.5), "range: "),
        ("setpoint", json!("NaN"), "value: "),
        ("speed", json!(10.04), "range: "),
        ("recipe", json!([1, 2, 3]), "value: "),
        ("level", json!(1), "write: "),
        ("nothing", json!(1), "tag: "),
    ] {
        let before = bench.changes();
        is(&bench.send("7", tag, value).await, Outcome::Refused, why);
        assert_eq!(bench.changes(), before);
    }
    let retained = bench.commands.execute("mixer", command("8", "valve", json!(true)).as_bytes(), true).await;
    is(&retained, Outcome::Refused, "retained: ");
    let other = bench.commands.execute("boiler", command("9", "valve", json!(true)).as_bytes(), false).await;
    is(&other, Outcome::Refused, "plc: ");
    assert_eq!(bench.commands.stats().no_plc, 1);
}

/// The result tells whether the PLC can have executed the write.
#[tokio::test(flavor = "multi_thread")]
async fn results_follow_the_faults_of_the_line() {
    let bench = Bench::start().await;
    let writes = [Code::WriteDiscretes, Code::WriteMixed];
    let rules = |fault: Fault| writes.map(|code| Rule::new(fault.clone()).command(code));
    // Refused by the PLC: certain.
    bench.faults.set_rules(rules(Fault::Error(ErrorCode::WriteProhibited)));
    is(&bench.send("1", "valve", json!(true)).await, Outcome::Refused, "plc: station 1 refused");
    assert_eq!(bench.changes(), []);
    // The reply is lost: the PLC has executed it. A repetition gets the same reply, and nothing is sent.
    bench.faults.set_rules(rules(Fault::DropReply));
    let payload = command("2", "valve", json!(true));
    let unknown = bench.commands.execute("mixer", payload.as_bytes(), false).await;
    is(&unknown, Outcome::Unknown, "plc: station 1 did not answer");
    bench.faults.set_rules([]);
    assert_eq!(bench.commands.execute("mixer", payload.as_bytes(), false).await, unknown);
    assert_eq!(bench.changes(), [Change::value(discrete!("M5"), true)]);
    // The connection ends with the request, which was not executed: the bridge cannot know that.
    bench.faults.set_rules(rules(Fault::Disconnect(DisconnectAt::BeforeExecution)));
    is(&bench.send("3", "valve", json!(true)).await, Outcome::Unknown, "plc: ");
    // The link is down: not sent, so refused.
    let Bench { server, registry, .. } = bench;
    server.shutdown().await;
    let down = Commands::start(CommandSettings::new(Storage::Memory), registry).await.unwrap();
    let mut replies = Vec::new();
    for id in ["4", "5"] {
        replies.push(down.execute("mixer", command(id, "valve", json!(true)).as_bytes(), false).await);
    }
    // The first can be lost with the connection that has ended.
    is(&replies[1], Outcome::Refused, "plc: cannot connect");
    assert!(replies[0].result() != Outcome::Ok);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_id_is_executed_once_also_after_a_restart() {
    let mut bench = Bench::start().await;
    let (first, second) = (command("1", "setpoint", json!(42.5)), command("2", "setpoint", json!(7)));
    let other = command("1", "setpoint", json!(43.5));
    let execute = |commands: &Commands, payload: &str| {
        let (commands, payload) = (commands.clone(), payload.to_owned());
        async move { commands.execute("mixer", payload.as_bytes(), false).await }
    };
    // Ten at once share the result.
    let replies = join_all((0..10).map(|_| execute(&bench.commands, &first))).await;
    assert!(replies.iter().all(|reply| *reply == replies[0]) && *ok(&replies[0]) == json!(42.5));
    ok(&execute(&bench.commands, &second).await);
    let changes = bench.changes();
    for _ in 0..2 {
        assert_eq!(execute(&bench.commands, &first).await, replies[0]);
        is(&execute(&bench.commands, &other).await, Outcome::Refused, "id: it was used for another command");
        bench.restart().await;
    }
    assert_eq!(bench.changes(), changes);
    assert_eq!(bench.commands.stats().plcs.get("mixer").map(|stats| stats.ok), None);
    // Two bridges do not share the file.
    let error = Commands::start(settings(bench.folder.path()), bench.registry.clone()).await.unwrap_err();
    assert!(error.to_string().contains("commands.redb: "), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pulse_is_ok_after_its_end_and_others_do_not_wait() {
    let bench = Bench::start().await;
    let begin = Instant::now();
    let pulse = bench.send("1", "start", json!(true));
    let others = async {
        until("the pulse begins", || bench.plc.read(discrete!("M100")) == true.into()).await;
        is(&bench.send("2", "start", json!(true)).await, Outcome::Refused, "pulse: an earlier pulse");
        is(&bench.send("3", "start", json!(false)).await, Outcome::Refused, "pulse: the tag takes the value true");
        ok(&bench.send("4", "valve", json!(true)).await);
        bench.commands.stats().plcs["mixer"].pulses_open
    };
    let (pulse, open) = tokio::join!(pulse, others);
    assert_eq!((ok(&pulse), open), (&json!(false), 1));
    assert!(begin.elapsed() >= Duration::from_millis(200));
    let discretes = [
        Change::value(discrete!("M100"), true),
        Change::value(discrete!("M5"), true),
        Change::value(discrete!("M100"), false),
    ];
    assert_eq!(bench.changes(), discretes);
    assert_eq!(bench.commands.stats().plcs["mixer"].pulses_open, 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pulse_whose_end_was_lost_is_ended_after_a_restart() {
    let mut bench = Bench::start().await;
    let commands = bench.commands.clone();
    let pulse =
        tokio::spawn(
            async move { commands.execute("mixer", command("1", "long", json!(true)).as_bytes(), false).await },
        );
    until("the pulse begins", || bench.plc.read(discrete!("M101")) == true.into()).await;
    until("it is on", || bench.commands.stats().plcs["mixer"].pulses_open == 1).await;
    // The PLC does not answer when the bridge is closed, and when it starts anew.
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    bench.restart().await;
    let lost = pulse.await.unwrap();
    assert_eq!(lost.result(), Outcome::Unknown, "{lost:?}");
    assert_eq!(bench.plc.read(discrete!("M101")), true.into());
    assert_eq!(bench.commands.stats().plcs["mixer"].pulses_open, 1);
    tokio::time::sleep(Duration::from_secs(1)).await;
    bench.faults.set_rules([]);
    until("it is ended", || bench.commands.stats().plcs["mixer"].pulses_open == 0).await;
    assert_eq!(bench.plc.read(discrete!("M101")), false.into());
    let changes = bench.changes();
    bench.restart().await;
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(bench.changes(), changes, "it is ended once");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dead_plc_holds_up_no_other_and_its_queue_is_bounded() {
    let live = Bench::start().await;
    let silent = Server::bind("127.0.0.1:0", Bus::new(), Framing::Ascii).await.unwrap();
    let text = format!(
        "[plc.mixer]\nlink = '{}'\nstation = 1\n{TAGS}\n[plc.dead]\nlink = '{}'\nstation = 1\n{TAGS}",
        live.server.endpoint(),
        silent.endpoint()
    );
    let (registry, _poller) = registry(&Plant::from_toml(&text).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let commands = Commands::start(settings(folder.path()), registry).await.unwrap();
    let dead: Vec<_> = (0..100)
        .map(|n| {
            let commands = commands.clone();
            let payload = command(&format!("d{n}"), "valve", json!(true));
            tokio::spawn(async move { commands.execute("dead", payload.as_bytes(), false).await })
        })
        .collect();
    until("they wait", || commands.stats().plcs.get("dead").is_some_and(|dead| dead.waiting > 0)).await;
    let mut worst = Duration::ZERO;
    for n in 0..50 {
        let begin = Instant::now();
        ok(&commands.execute("mixer", command(&format!("m{n}"), "setpoint", json!(n)).as_bytes(), false).await);
        worst = worst.max(begin.elapsed());
    }
    let replies = join_all(dead).await;
    let busy = replies.iter().filter(|reply| reply.as_ref().unwrap().why().unwrap().starts_with("busy: ")).count();
    assert!(busy >= 100 - 33 - 2, "{busy}");
    println!("100 commands for a dead PLC, {busy} refused as busy; the others took {worst:?} at most");
    assert!(worst < Duration::from_secs(5));
    let all = replies.iter().map(|reply| reply.as_ref().unwrap().result()).filter(|result| *result == Outcome::Ok);
    assert_eq!(all.count(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_rate_of_commands_is_limited() {
    let bench = Bench::start().await;
    let commands = Commands::start(CommandSettings::new(Storage::Memory), bench.registry.clone()).await.unwrap();
    let mut results = (0, 0);
    for n in 0..60 {
        let reply = commands.execute("mixer", command(&n.to_string(), "valve", json!(true)).as_bytes(), false).await;
        match reply.result() {
            Outcome::Ok => results.0 += 1,
            Outcome::Refused => {
                is(&reply, Outcome::Refused, "rate: more than 10 commands per second");
                results.1 += 1;
            }
            Outcome::Unknown => panic!("{reply:?}"),
        }
    }
    assert!(results.0 >= 20 && results.0 + results.1 == 60, "{results:?}");
    assert_eq!(bench.changes().len(), results.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reload_applies_to_the_next_command() {
    let bench = Bench::start().await;
    ok(&bench.send("1", "setpoint", json!(70)).await);
    let endpoint = bench.server.endpoint().to_string();
    let poller = Poller::new();
    let tags = TAGS.replace("max = 80.0", "max = 60.0");
    bench.registry.apply(&plant(&endpoint, &tags), &Pool::new(), &poller.handle()).unwrap();
    is(&bench.send("2", "setpoint", json!(70)).await, Outcome::Refused, "range: 70.0 is above 60");
    let other = plant(&endpoint, &tags).plc("mixer").unwrap().endpoint().to_string();
    let gone = Plant::from_toml(&format!("[plc.boiler]\nlink = '{other}'\nstation = 1\ntag.level = 'R5'\n")).unwrap();
    bench.registry.apply(&gone, &Pool::new(), &poller.handle()).unwrap();
    is(&bench.send("3", "setpoint", json!(7)).await, Outcome::Refused, "plc: there is no PLC");
}

#[tokio::test(flavor = "multi_thread")]
async fn old_commands_are_refused_by_the_clock_of_the_bridge() {
    let bench = Bench::start().await;
    let offset = Arc::new(AtomicU64::new(0));
    let clock = WallClock::new({
        let offset = offset.clone();
        move || SystemTime::now() + Duration::from_millis(offset.load(Ordering::Relaxed))
    });
    let settings = CommandSettings { clock, ..CommandSettings::new(Storage::Memory) };
    let commands = Commands::start(settings, bench.registry.clone()).await.unwrap();
    let payload = command("1", "valve", json!(true));
    offset.store(60_000, Ordering::Relaxed);
    is(&commands.execute("mixer", payload.as_bytes(), false).await, Outcome::Refused, "old: its ts is 6");
    assert_eq!(bench.changes(), []);
    offset.store(0, Ordering::Relaxed);
    ok(&commands.execute("mixer", payload.as_bytes(), false).await);
    // A repetition of any age gets the reply.
    offset.store(60_000, Ordering::Relaxed);
    ok(&commands.execute("mixer", payload.as_bytes(), false).await);
    assert_eq!(bench.changes().len(), 1);
}

/// A mutation of a command: of its JSON, or of its bytes.
fn mutated(rng: &mut Rng, n: u32) -> Vec<u8> {
    let tags = ["setpoint", "speed", "recipe", "name", "mode", "valve", "start", "level", "alarm", "R200", "M7", "Y0"];
    let (tag, value) = match rng.u32(0..25) {
        0..4 => ("setpoint", json!(rng.u32(0..81))),
        4..8 => ("speed", json!(f64::from(rng.i32(-100..101)) / 10.0)),
        8..12 => ("recipe", json!([rng.u32(0..501), 2, 3, 4])),
        12..16 => ("name", json!("pump")),
        16..20 => ("mode", json!(rng.bool())),
        20..24 => ("valve", json!(rng.bool())),
        _ => ("start", json!(true)),
    };
    let mut message = json!({ "id": format!("c{n}"), "tag": tag, "value": value, "ts": now() });
    for _ in 0..rng.u32(0..3) {
        match rng.u32(0..9) {
            0 => message["tag"] = json!(tags[rng.usize(0..tags.len())]),
            1 => message["value"] = odd_value(rng),
            2 => message["ts"] = json!(now().wrapping_add_signed(rng.i64(-20_000..20_000))),
            3 => message["ts"] = odd_value(rng),
            4 => message["id"] = odd_value(rng),
            5 => message[["write", "force", "Tag", "plc"][rng.usize(0..4)]] = odd_value(rng),
            6 => drop(message.as_object_mut().unwrap().remove(["id", "tag", "value", "ts"][rng.usize(0..4)])),
            7 => message["id"] = json!(format!("c{}", rng.u32(0..n.max(1)))),
            _ => message["value"] = json!([message["value"].clone(), odd_value(rng)]),
        }
        if !message.is_object() || message.get("value").is_none() {
            break;
        }
    }
    let mut bytes = message.to_string().into_bytes();
    if rng.u32(0..3) == 0 {
        for _ in 0..rng.u32(1..4) {
            if bytes.is_empty() {
                break;
            }
            let at = rng.usize(0..bytes.len());
            match rng.u32(0..6) {
                0 => bytes[at] ^= 1 << rng.u32(0..8),
                1 => bytes.insert(at, rng.u8(..)),
                2 => drop(bytes.remove(at)),
                3 => bytes.truncate(at.max(1)),
                4 => {
                    let end = (at + rng.usize(0..20)).min(bytes.len());
                    let piece = bytes[at..end].to_vec();
                    bytes.splice(at..at, piece);
                }
                // A digit more, or another one.
                _ => bytes[at] = b"0123456789.-eE"[rng.usize(0..14)],
            }
        }
    }
    bytes
}

fn odd_value(rng: &mut Rng) -> Value {
    let values = [
        json!(null),
        json!(true),
        json!(-1),
        json!(80.0000001),
        json!(1e300),
        json!(-0.0),
        json!(u64::MAX),
        json!(65536),
        json!(501),
        json!("NaN"),
        json!("inf"),
        json!("0x7FC00000"),
        json!("0xFFFF"),
        json!("on"),
        json!(""),
        json!("a text that is much too long for five registers"),
        json!([]),
        json!([600, 600, 600, 600]),
        json!([1, 2, 3, 4, 5]),
        json!({}),
        json!({"value": 1}),
    ];
    values[rng.usize(0..values.len())].clone()
}

/// Asserts that the configuration allows each change. It does not use the rules of the bridge.
fn assert_allowed(changes: &[Change]) {
    let mut rest = changes;
    while let Some(change) = rest.first() {
        let Change::Value(element, value) = change else { panic!("{change} is not allowed") };
        let (name, number) =
            (element.to_string(), u32::try_from(value.to_string().parse::<i64>().unwrap_or(0)).unwrap());
        let mut len = 1;
        match name.as_str() {
            "R200" => {
                let Some(Change::Value(_, high)) = rest.get(1) else { panic!("half of R200") };
                let high: u32 = high.to_string().parse().unwrap();
                let setpoint = f32::from_bits(high << 16 | number);
                assert!((0.0..=80.0).contains(&setpoint), "setpoint = {setpoint}");
                len = 2;
            }
            "R210" => {
                let speed = u16::try_from(number).unwrap().cast_signed();
                assert!((-100..=100).contains(&speed), "speed = {speed}");
            }
            "R220" | "R221" | "R222" | "R223" => assert!(number <= 500, "recipe {number}"),
            "R230" | "R231" | "R232" | "R233" | "R234" | "M5" | "M100" => {}
            "R240" => assert!(number & !8 == 0, "other bits of R240: {number}"),
            _ => panic!("{change} is not allowed"),
        }
        rest = &rest[len..];
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn mutated_commands_write_nothing_that_is_not_allowed() {
    let bench = Bench::with_tags(&TAGS.replace("200ms", "10ms")).await;
    let count: u32 = std::env::var("FATEK_BRIDGE_MUTATIONS").ok().and_then(|text| text.parse().ok()).unwrap_or(10_000);
    let seed = std::env::var("FATEK_BRIDGE_SEED").ok().and_then(|text| text.parse().ok()).unwrap_or(17);
    let mut rng = Rng::with_seed(seed);
    let mut results = [0_u32; 3];
    let mut at_once = Vec::new();
    for n in 0..count {
        let payload = mutated(&mut rng, n);
        let (commands, retained) = (bench.commands.clone(), rng.u32(0..20) == 0);
        let plc = if rng.u32(0..20) == 0 { "boiler" } else { "mixer" };
        at_once.push(async move { commands.execute(plc, &payload, retained).await });
        if at_once.len() == 8 || n + 1 == count {
            for reply in join_all(std::mem::take(&mut at_once)).await {
                results[reply.result() as usize] += 1;
                assert!(reply.to_json().len() < 2000, "{reply:?}");
            }
        }
    }
    bench.commands.close().await;
    let changes = bench.changes();
    println!("seed {seed}: {count} messages, ok/refused/unknown {results:?}, {} changes", changes.len());
    assert_allowed(&changes);
    assert!(results[0] > count / 20 && results[1] > count / 4, "{results:?}");
    assert_eq!(bench.plc.read(discrete!("M100")), false.into());
    assert_eq!((bench.plc.read(register!("R5")), bench.plc.read(discrete!("M7"))), (0_u16.into(), false.into()));
}

/// Any bytes get a reply, and no bytes cause a panic.
#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_are_no_command_are_refused() {
    let bench = Bench::start().await;
    let mut rng = Rng::with_seed(3);
    for len in [0, 1, 10, 1000, 65_536, 65_537, 1 << 20] {
        let bytes: Vec<u8> = (0..len).map(|_| rng.u8(..)).collect();
        let reply = bench.commands.execute("mixer", &bytes, false).await;
        is(&reply, Outcome::Refused, "payload: ");
        assert_eq!(reply.id(), None);
    }
    assert_eq!(bench.changes(), []);
}

/// Without the guard of the task the bridge went on, and all later commands were refused as `closed`.
#[tokio::test(flavor = "multi_thread")]
async fn a_panic_of_the_task_is_told_to_the_caller_and_to_the_bridge() {
    let bench = Bench::start().await;
    let is_armed = Arc::new(AtomicU64::new(0));
    let clock = WallClock::new({
        let is_armed = is_armed.clone();
        // The test itself is no task of the runtime.
        move || {
            assert!(is_armed.load(Ordering::Relaxed) == 0 || tokio::task::try_id().is_none(), "a fault of the clock");
            SystemTime::now()
        }
    });
    let settings = CommandSettings { clock, ..CommandSettings::new(Storage::Memory) };
    let commands = Commands::start(settings, bench.registry.clone()).await.unwrap();
    ok(&commands.execute("mixer", command("1", "valve", json!(true)).as_bytes(), false).await);
    is_armed.store(1, Ordering::Relaxed);
    let reply = commands.execute("mixer", command("2", "valve", json!(true)).as_bytes(), false).await;
    is(&reply, Outcome::Unknown, "closed: ");
    tokio::time::timeout(PATIENCE, commands.ended()).await.unwrap();
}

/// Without the cure it gave the status 1, and the service manager started the bridge again and again, without data.
#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_file_of_commands_stops_commands_alone() {
    let folder = tempfile::tempdir().unwrap();
    let text = "[bridge]\nid = 'hall-2'\nbuffer = { dir = '.' }\n[mqtt]\nurl = 'mqtt://127.0.0.1:1'\nwrite = true\n\
                [plc.mixer]\nlink = 'tcp://127.0.0.1:1'\nstation = 1\ntag.valve = { at = 'M5', write = {} }\n";
    let path = folder.path().join("bridge.toml");
    std::fs::write(&path, text).unwrap();
    let config = Config::load(&path).unwrap();
    let file = folder.path().join(FILE_NAME);
    let good = Commands::start(settings(folder.path()), Registry::default()).await.unwrap();
    good.close().await;
    let half = std::fs::read(&file).unwrap();
    let half = half[..half.len() / 2].to_vec();
    // An empty file and one of zeros, as after a power failure: an empty one was taken for a new one, and the
    // command was executed again.
    for content in [b"not a database".to_vec(), half, vec![0; 1 << 20], Vec::new()] {
        std::fs::write(&file, &content).unwrap();
        let commands = Commands::start_for(&config, Registry::default(), Pool::new()).await.unwrap().unwrap();
        let failure = commands.failure().unwrap();
        assert!(failure.contains(FILE_NAME), "{failure}");
        let later = json!({ "id": "1", "tag": "valve", "value": true, "ts": now() + 60_000 }).to_string();
        is(&commands.execute("mixer", later.as_bytes(), false).await, Outcome::Refused, "storage: ");
        // It may be a repetition of one that the run before has executed.
        let reply = commands.execute("mixer", command("1", "valve", json!(true)).as_bytes(), false).await;
        is(&reply, Outcome::Unknown, "storage: an earlier run may have executed it");
        // An operator decides about it.
        assert_eq!(std::fs::read(&file).unwrap(), content);
        commands.close().await;
    }
}

/// Without the cure M100 stayed on, and the reply was `unknown` with "the PLC is not in the configuration".
#[tokio::test(flavor = "multi_thread")]
async fn a_pulse_is_ended_though_its_plc_left_the_configuration() {
    let mut bench = Bench::start().await;
    let other = Plant::from_toml("[plc.mixer]\nlink = 'tcp://127.0.0.1:1'\nstation = 1\ntag.level = 'R5'\n").unwrap();
    let remove = async {
        until("the pulse begins", || bench.plc.read(discrete!("M100")) == true.into()).await;
        until("it is confirmed", || bench.commands.stats().plcs["mixer"].pulses_open == 1).await;
        bench.registry.apply(&other, &Pool::new(), &Poller::new().handle()).unwrap();
    };
    let (reply, ()) = tokio::join!(bench.send("1", "start", json!(true)), remove);
    // It was read from the PLC of the pulse, not from the one that has its name now.
    assert_eq!(*ok(&reply), json!(false));
    assert_eq!(bench.plc.read(discrete!("M100")), false.into());
    // The same after a restart: the PLC does not answer, and has left the configuration at the next start.
    let endpoint = bench.server.endpoint().to_string();
    bench.registry.apply(&plant(&endpoint, TAGS), &Pool::new(), &Poller::new().handle()).unwrap();
    let commands = bench.commands.clone();
    let pulse =
        tokio::spawn(
            async move { commands.execute("mixer", command("2", "long", json!(true)).as_bytes(), false).await },
        );
    until("the pulse begins", || bench.plc.read(discrete!("M101")) == true.into()).await;
    bench.faults.set_rules([Rule::new(Fault::Ignore)]);
    bench.commands.close().await;
    assert_eq!(pulse.await.unwrap().result(), Outcome::Unknown);
    bench.registry.apply(&other, &Pool::new(), &Poller::new().handle()).unwrap();
    bench.faults.set_rules([]);
    bench.restart().await;
    until("it is ended", || bench.plc.read(discrete!("M101")) == false.into()).await;
    until("its end is known", || bench.commands.stats().plcs["mixer"].pulses_open == 0).await;
}
