//! The commands of a fleet, with a real nats-server. Members are the protocol alone: no PLC is asked.

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use fatek_bridge::config::{Config, Environment, Name};
use fatek_bridge::fleet::{self, Event, Fleet, FleetSettings, FleetTask, PlantLinks};
use serde_json::Value;
use tokio::task::JoinHandle;

use common::bridge::{Bridge, write_config};
use common::nats::{NatsServer, PATIENCE};

const LEASE: Duration = Duration::from_millis(1500);

const PLANT: &str = "\
    [fleet]\nid = 'plant-a'\nbucket = 'leases'\nlease = '1500ms'\n\
    [class]\nfast = { every = '1s' }\n\
    [bus.port]\nlink = 'serial:/dev/ttyX'\nstations = { pump = 1 }\nhost = 'hall-1'\n\
    [plc.gate]\nlink = 'tcp://127.0.0.2:9'\nstation = 1\nonly = ['hall-2', 'hall-3']\n";

/// Writes a configuration with this number of PLCs that all members reach.
fn config(folder: &Path, port: u16, plcs: usize) -> PathBuf {
    let plcs = (0..plcs).map(|n| format!("[plc.plc{n}]\nlink = 'tcp://127.0.0.1:{}'\nstation = 1\n", 1000 + n));
    let text = format!("[nats]\nurl = 'nats://127.0.0.1:{port}'\n{PLANT}{}", plcs.collect::<String>());
    write_config(folder, &text)
}

fn run(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    for variable in ["RUST_LOG", "STATE_DIRECTORY", "FATEK_BRIDGE_ID", "FATEK_BRIDGE_CONFIG"] {
        command.env_remove(variable);
    }
    command.args(arguments).output().unwrap()
}

/// Runs a command of a fleet. Returns its status and what it prints.
fn fleet(command: &str, path: &Path, more: &[&str]) -> (i32, String) {
    let output = run(&[&["fleet", command, path.to_str().unwrap()], more].concat());
    let text = [output.stdout, output.stderr].concat();
    (output.status.code().unwrap(), String::from_utf8(text).unwrap())
}

fn status(path: &Path) -> Value {
    let (code, text) = fleet("status", path, &["--json"]);
    assert_eq!(code, 0, "{text}");
    serde_json::from_str(&text).unwrap()
}

/// Waits until the status of the fleet is as it is expected.
async fn until(what: &str, path: &Path, is_true: impl Fn(&Value) -> bool) -> Value {
    let begin = Instant::now();
    loop {
        let shown = status(path);
        if is_true(&shown) {
            return shown;
        }
        assert!(begin.elapsed() < PATIENCE, "{what}: {shown:#}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

struct Member {
    fleet: Fleet,
    task: FleetTask,
    events: JoinHandle<()>,
}

impl Member {
    fn start(path: &Path, id: &str) -> Self {
        let environment = Environment { id: Some(id.to_owned()), ..Environment::default() };
        let config = Config::read(path, &environment).unwrap();
        let settings = FleetSettings {
            nats: config.nats.clone().unwrap(),
            bucket: Name::parse("leases").unwrap(),
            lease: LEASE,
            member: fleet::member(&config),
            links: PlantLinks::of(&config.plant).specs().to_vec(),
        };
        let (fleet, mut events, task) = Fleet::start(settings).unwrap();
        let events = tokio::spawn(async move {
            while let Some(event) = events.recv().await {
                match event {
                    Event::Owned(_) => {}
                    Event::Close(closing) => closing.closed(),
                }
            }
        });
        Self { fleet, task, events }
    }

    /// Ends it as SIGKILL would.
    fn kill(&self) {
        self.task.abort();
        self.events.abort();
    }
}

fn owners<'v>(shown: &'v Value, owner: &str) -> Vec<&'v str> {
    let links = shown["links"].as_array().unwrap().iter();
    links.filter(|link| link["owner"] == owner).filter_map(|link| link["link"].as_str()).collect()
}

fn link<'v>(shown: &'v Value, name: &str) -> &'v Value {
    shown["links"].as_array().unwrap().iter().find(|link| link["link"] == name).unwrap()
}

fn state<'v>(shown: &'v Value, member: &str) -> Option<&'v str> {
    shown["members"].as_array().unwrap().iter().find(|found| found["member"] == member)?["state"].as_str()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_store_is_made_once_and_its_loss_is_explained() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::start(folder.path()) else { return };
    let path = config(folder.path(), server.port(), 1);
    let url = format!("error: nats://127.0.0.1:{}: ", server.port());
    for command in ["status", "drain", "move"] {
        let more: &[&str] = match command {
            "drain" => &["hall-1"],
            "move" => &["plc0", "hall-1"],
            _ => &[],
        };
        let missing = format!("{url}the store leases does not exist: fatek-bridge fleet init makes it\n");
        assert_eq!(fleet(command, &path, more), (1, missing), "{command}");
    }
    let (code, text) = fleet("init", &path, &[]);
    assert!(code == 0 && text.starts_with("The store leases was made, with 1 replica.\n"), "{text}");
    let there = "The store leases is there already: nothing has changed.\n";
    assert_eq!(fleet("init", &path, &[]), (0, there.to_owned()));
    let (code, text) = fleet("status", &path, &[]);
    assert!(code == 0 && text.contains("\nwarning: no member runs\n"), "{text}");

    // Orders for members that do not run.
    let (code, text) = fleet("drain", &path, &["hall-1"]);
    assert_eq!((code, &*text), (0, "hall-1 gets no links when it is started: it does not run now.\n"));
    let (_, text) = fleet("status", &path, &[]);
    assert!(text.contains("\nhall-1 gets no links when it is started: fleet drain --undo ends that\n"), "{text}");
    let (code, text) = fleet("move", &path, &["plc0", "hall-9"]);
    assert_eq!((code, &*text), (0, "plc0 goes to hall-9 when that is started: it does not run now.\n"));

    for (command, more, error) in [
        ("move", &["plc9", "hall-1"][..], "there is no link plc9 (known: gate plc0 port): a link has the name of its"),
        ("move", &["port", "hall-2"], "port is a serial port of hall-1: it cannot be moved"),
        ("move", &["gate", "hall-1"], "hall-1 does not reach gate: `only` has hall-2, hall-3"),
        ("move", &["plc0"], "the following required arguments were not provided"),
        ("move", &["plc0", "a/b"], "invalid value 'a/b'"),
    ] {
        let (code, text) = fleet(command, &path, more);
        assert!(code == 2 && text.contains(error), "{more:?}: {text}");
    }
    let alone = write_config(&tempfile::tempdir().unwrap().keep(), "[plc.a]\nlink = 'tcp://h'\nstation = 1\n");
    let (code, text) = fleet("status", &alone, &[]);
    assert!(code == 2 && text.ends_with("plant.toml: it has no section fleet\n"), "{text}");
    std::fs::remove_dir_all(alone.parent().unwrap()).unwrap();

    server.kill();
    for command in ["init", "status"] {
        let (code, text) = fleet(command, &path, &[]);
        assert!(code == 1 && text.starts_with(&url) && text.lines().count() == 1, "{command}: {text}");
    }
}

/// Without a status of its own, seen to fail with `Some(1)`: systemd started the member again, and that took the new
/// store for that of its fleet.
#[tokio::test(flavor = "multi_thread")]
async fn a_member_ends_with_a_status_that_tells_why() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let path = config(folder.path(), server.port(), 1);
    let text = format!("[bridge]\nhttp = '127.0.0.1:0'\n{}", std::fs::read_to_string(&path).unwrap());
    write_config(folder.path(), &text);
    let start = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
        command.args(["run", path.to_str().unwrap(), "--id", "hall-2"]).env("STATE_DIRECTORY", folder.path());
        Bridge::spawn(command)
    };
    let mut without_store = start();
    assert_eq!(without_store.wait().code(), Some(1));
    assert!(without_store.log().contains("fatek-bridge fleet init makes it"), "{}", without_store.log());

    assert_eq!(fleet("init", &path, &[]).0, 0);
    let mut member = start();
    until("it runs", &path, |shown| state(shown, "hall-2") == Some("active")).await;
    let context = async_nats::jetstream::new(server.client().await);
    context.delete_stream("KV_leases").await.unwrap();
    assert_eq!(fleet("init", &path, &[]).0, 0);
    assert_eq!(member.wait().code(), Some(3), "{}", member.log());
    assert!(member.log().contains("error: the store was "), "{}", member.log());

    // A start accepts the store as it is.
    let mut again = start();
    until("it runs again", &path, |shown| state(shown, "hall-2") == Some("active")).await;
    again.signal("TERM");
    assert_eq!(again.wait().code(), Some(0), "{}", again.log());
    let unit = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/packaging/fatek-bridge.service")).unwrap();
    assert!(unit.contains("\nRestartPreventExitStatus=2 3\n"));
}

#[tokio::test(flavor = "multi_thread")]
async fn an_operator_sees_and_changes_who_owns_what() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let path = config(folder.path(), server.port(), 20);
    assert_eq!(fleet("init", &path, &[]).0, 0);
    let hall_1 = Member::start(&path, "hall-1");
    let hall_2 = Member::start(&path, "hall-2");
    let is_settled = |shown: &Value| {
        let count = |id| owners(shown, id).len();
        shown["counts"]["without_owner"] == 0 && count("hall-1") + count("hall-2") == 22 && count("hall-1") > 3
    };
    let shown = until("all are owned", &path, is_settled).await;
    assert_eq!(shown["warnings"], Value::Array(Vec::new()), "{shown:#}");
    assert_eq!((&shown["fleet"], &shown["replicas"]), (&Value::from("plant-a"), &Value::from(1)));
    assert_eq!((state(&shown, "hall-1"), state(&shown, "hall-2")), (Some("active"), Some("active")));
    assert!(owners(&shown, "hall-1").contains(&"port") && owners(&shown, "hall-2").contains(&"gate"), "{shown:#}");
    let gate = link(&shown, "gate").clone();
    assert!(gate["rev"].as_u64().unwrap() > 0 && gate["owned_for_ms"].as_u64().unwrap() < 60_000, "{gate}");
    let (_, table) = fleet("status", &path, &[]);
    for part in ["MEMBER  STATE   LINKS", "\nhall-1  active", "\nport   hall-1      -      -\n", "\ngate   hall-2  "] {
        assert!(table.contains(part), "{part}:\n{table}");
    }

    let count = |member: &Value| member["links"].as_u64().unwrap();
    assert_eq!(shown["members"].as_array().unwrap().iter().map(count).sum::<u64>(), 22);

    let (_, text) = fleet("drain", &path, &["hall-1"]);
    assert!(text.starts_with("hall-1 gives its links to the others."), "{text}");
    let is_drained = |shown: &Value| owners(shown, "hall-1") == ["port"] && state(shown, "hall-1") == Some("draining");
    let shown = until("hall-1 has given all away", &path, is_drained).await;
    assert_eq!(shown["drained"], serde_json::json!(["hall-1"]));
    let later = link(&shown, "gate");
    assert!(later["rev"] == gate["rev"] && later["owned_for_ms"].as_u64() > gate["owned_for_ms"].as_u64(), "{later}");
    assert_eq!(fleet("drain", &path, &["hall-1", "--undo"]).1, "hall-1 gets links again.\n");
    until("it has its share again", &path, is_settled).await;

    for member in ["hall-1", "hall-2"] {
        assert_eq!(fleet("move", &path, &["plc7", member]), (0, format!("plc7 goes to {member}.\n")));
        let shown = until("it is moved", &path, |shown| link(shown, "plc7")["owner"] == member).await;
        assert_eq!(link(&shown, "plc7")["moved"], member);
    }
    assert_eq!(fleet("move", &path, &["plc7", "--undo"]).0, 0);
    until("it is placed again", &path, |shown| link(shown, "plc7")["moved"] == Value::Null).await;

    // A file with another plant.
    let other = tempfile::tempdir().unwrap();
    let shown = status(&config(other.path(), server.port(), 19));
    let warnings = shown["warnings"].to_string();
    assert!(warnings.contains("hall-1 has the configuration ") && warnings.contains("hall-2 has the"), "{warnings}");

    // Without another member, nothing marks a session as dead.
    hall_2.fleet.leave();
    until("hall-2 has left", &path, |shown| state(shown, "hall-2").is_none()).await;
    assert_eq!(
        fleet("drain", &path, &["hall-1"]).1,
        "hall-1 keeps its links: there is no other member to take them.\n"
    );
    hall_1.kill();
    let shown = until("hall-1 is silent", &path, |shown| state(shown, "hall-1") == Some("silent")).await;
    assert!(shown["warnings"].to_string().contains("no member runs"), "{shown:#}");
}

/// The sections of a member that has its plant from the store.
fn own(server: &NatsServer) -> String {
    format!(
        "[bridge]\nhttp = '127.0.0.1:0'\nbuffer = {{ dir = 'buffer' }}\n[nats]\nurl = 'nats://127.0.0.1:{}'\n\
         [fleet]\nid = 'plant-a'\nbucket = 'leases'\nlease = '1s'\nconfig = 'store'\n",
        server.port()
    )
}

fn plcs(names: &[&str]) -> String {
    let plc = |(n, name): (usize, &&str)| {
        format!("[plc.{name}]\nlink = 'tcp://127.0.0.1:{}'\nstation = 1\ntag.level = 'R5'\n", 1000 + n)
    };
    names.iter().enumerate().map(plc).collect()
}

/// A fleet whose plant is in the store.
struct Stored {
    folder: tempfile::TempDir,
    server: NatsServer,
    /// The file of the operator.
    path: PathBuf,
}

impl Stored {
    /// `None`: nats-server is missing.
    fn new() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let server = NatsServer::start(folder.path())?;
        let path = write_config(folder.path(), &own(&server));
        assert_eq!(fleet("init", &path, &[]).0, 0);
        Some(Self { folder, server, path })
    }

    fn push(&self, plant: &str, more: &[&str]) -> (i32, String) {
        write_config(self.folder.path(), &(own(&self.server) + plant));
        fleet("push", &self.path, more)
    }

    fn start(&self, id: &str) -> Bridge {
        let state = self.folder.path().join(id);
        std::fs::create_dir_all(&state).unwrap();
        let path = write_config(&state, &own(&self.server));
        let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
        command.args(["run", path.to_str().unwrap(), "--id", id]).env("STATE_DIRECTORY", state);
        Bridge::spawn(command)
    }

    /// Waits until these members own these links, by the plant of the store.
    async fn until_owned(&self, members: &[&str], links: usize) -> Value {
        let path = write_config(self.folder.path(), &own(&self.server));
        until("all own their links", &path, |shown| {
            let of_store = |member: &Value| member["config"] == shown["config"];
            let is_there = |id: &&str| state(shown, id) == Some("active");
            let owned = members.iter().map(|id| owners(shown, id).len()).sum::<usize>();
            members.iter().all(is_there) && owned == links && shown["members"].as_array().unwrap().iter().all(of_store)
        })
        .await
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_push_gives_the_plant_to_all_members() {
    let Some(fleet) = Stored::new() else { return };
    let mut early = fleet.start("hall-1");
    assert_eq!(early.wait().code(), Some(1));
    assert!(
        early.log().contains("the store has no plant yet: fatek-bridge fleet push puts it there"),
        "{}",
        early.log()
    );
    let (_, shown) = self::fleet("status", &fleet.path, &[]);
    assert!(shown.contains("warning: the store has no plant yet"), "{shown}");

    for (plant, fault) in [
        ("[plc.a]\nlink = 'tcp://h'\n", "line 11, plc.a.station: it is missing"),
        ("", "plc: there is no PLC"),
        ("[bus.a]\nlink = 'serial:/dev/ttyX'\nstations = { x = 1 }\n", "bus.a.host: a serial port has one host"),
    ] {
        let (code, text) = fleet.push(plant, &[]);
        assert!(code == 2 && text.contains(fault), "{fault}: {text}");
    }
    let (code, text) = fleet.push(&plcs(&["mixer", "gate"]), &[]);
    let expected =
        "Version 1 is in the store: 2 PLCs with 2 tags.\nNo member runs: they load it when they are started.\n";
    assert_eq!((code, &*text), (0, expected));

    let hall_1 = fleet.start("hall-1");
    hall_1.wait_for_log("version 1 of the plant");
    fleet.until_owned(&["hall-1"], 2).await;
    // One that is started later has the newest version, and so has one that runs.
    let (code, text) = fleet.push(&plcs(&["mixer", "gate", "pump"]), &[]);
    assert!(code == 0 && text.ends_with("All members have loaded it: hall-1.\n"), "{text}");
    let hall_2 = fleet.start("hall-2");
    let shown = fleet.until_owned(&["hall-1", "hall-2"], 3).await;
    assert_eq!((&shown["version"], &shown["warnings"]), (&Value::from(2), &Value::Array(Vec::new())), "{shown:#}");
    let (code, text) = fleet.push(&(plcs(&["mixer", "gate"]) + "# other comment\n"), &[]);
    assert!(code == 0 && text.ends_with("All members have loaded it: hall-1, hall-2.\n"), "{text}");
    let (code, text) = fleet.push(&plcs(&["mixer", "gate"]), &[]);
    assert_eq!((code, &*text), (0, "The store has this plant already: version 3 of the plant.\n"));
    // SIGHUP keeps the plant.
    hall_1.signal("HUP");
    hall_1.wait_for_log("reloaded; PLCs: 0 added, 0 moved, 0 removed");
    fleet.until_owned(&["hall-1", "hall-2"], 2).await;

    let (code, text) = fleet.push(&plcs(&["mixer", "door"]), &[]);
    assert!(code == 0 && text.ends_with("All members have loaded it: hall-1, hall-2.\n"), "{text}");
    let long = "x".repeat(4000);
    let tags = (0..300).map(|n| format!("tag.a{n}_ = {{ at = 'R5', comment = '{long}' }}\n"));
    let (code, text) = fleet.push(&(plcs(&["mixer"]) + &tags.collect::<String>()), &[]);
    assert!(code == 1 && text.contains("bytes, and the server takes 1048576: raise max_payload"), "{text}");
    write_config(fleet.folder.path(), &(own(&fleet.server).replace("config = 'store'\n", "") + &plcs(&["a"])));
    let (code, text) = self::fleet("push", &fleet.path, &[]);
    assert!(code == 2 && text.contains("fleet.config is not store"), "{text}");
    drop(hall_2);
}

/// Seen to fail with a roll-back that stores no plant (hall-1 keeps the refused one), and with a member that does not
/// store its refusal (none within 60 s).
#[tokio::test(flavor = "multi_thread")]
async fn a_push_is_rolled_back_if_a_member_refuses_it() {
    let Some(fleet) = Stored::new() else { return };
    assert_eq!(fleet.push(&plcs(&["mixer"]), &[]).0, 0);
    let hall_1 = fleet.start("hall-1");
    fleet.until_owned(&["hall-1"], 1).await;
    let keys = async_nats::jetstream::new(fleet.server.client().await).get_key_value("leases_config").await.unwrap();

    // A plant that was not checked: the member goes on, and says why.
    let version = keys.put("plant", "[plc.mixer]\nlink = 'tcp://h'\n".into()).await.unwrap();
    hall_1.wait_for_log(&format!("version {version} of the plant is refused, and nothing has changed"));
    let path = write_config(fleet.folder.path(), &own(&fleet.server));
    let begin = Instant::now();
    let refusal = loop {
        if let Some(value) = keys.get("r.hall-1").await.unwrap() {
            break serde_json::from_slice::<Value>(&value).unwrap();
        }
        assert!(begin.elapsed() < PATIENCE);
        tokio::time::sleep(Duration::from_millis(10)).await;
    };
    assert_eq!(refusal["version"], version);
    assert!(refusal["why"].as_str().unwrap().contains("line 1, plc.mixer.station: it is missing"), "{refusal}");
    let (code, text) = self::fleet("status", &path, &[]);
    assert!(
        code == 1 && text.contains(&format!("version {version} of the plant: line 1, plc.mixer.station")),
        "{text}"
    );
    let (code, text) = fleet.push(&plcs(&["mixer", "gate"]), &[]);
    assert!(code == 0 && text.ends_with("All members have loaded it: hall-1.\n"), "{text}");
    let good = fleet.until_owned(&["hall-1"], 2).await;

    // A member of an older program, which refuses a key that it does not know: the protocol of a member, and the test.
    let other = Member::start(&config(&tempfile::tempdir().unwrap().keep(), fleet.server.port(), 1), "hall-9");
    until("it runs", &path, |shown| state(shown, "hall-9") == Some("active")).await;
    write_config(fleet.folder.path(), &(own(&fleet.server) + &plcs(&["mixer", "gate", "pump"])));
    let before = keys.entry("plant").await.unwrap().unwrap().revision;
    let operator = fleet.path.clone();
    let pushed = tokio::task::spawn_blocking(move || self::fleet("push", &operator, &[]));
    let refusing = async {
        let version = loop {
            let now = keys.entry("plant").await.unwrap().unwrap().revision;
            if now > before {
                break now;
            }
            if pushed.is_finished() {
                return 0;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        };
        // The other one has loaded it by then.
        hall_1.wait_for_log(&format!("version {version} of the plant is in force"));
        let refusal = format!("{{\"version\":{version},\"why\":\"the key is unknown\"}}");
        keys.put("r.hall-9", refusal.into()).await.unwrap();
        version
    };
    let version = refusing.await;
    let (code, text) = pushed.await.unwrap();
    assert!(code == 1 && text.contains("error: hall-9 refuses it: the key is unknown\n"), "{text}");
    assert!(text.contains(&format!("error: version {version} was rolled back: version ")), "{text}");
    let after = until("hall-1 has the former plant", &path, |shown| owners(shown, "hall-1").len() == 2).await;
    assert_eq!(after["config"], good["config"]);
    other.fleet.leave();
    until("it has left", &path, |shown| state(shown, "hall-9").is_none()).await;

    // A member that does not answer, and one that is told to leave it.
    let other = Member::start(&config(&tempfile::tempdir().unwrap().keep(), fleet.server.port(), 1), "hall-9");
    until("it runs", &path, |shown| state(shown, "hall-9") == Some("active")).await;
    let (code, text) = fleet.push(&plcs(&["mixer", "gate", "pump"]), &["--timeout", "1s"]);
    assert!(code == 1 && text.contains("error: hall-9 has not loaded it within 1s"), "{text}");
    assert!(text.contains("was rolled back"), "{text}");
    let (code, text) = fleet.push(&plcs(&["mixer", "gate", "pump"]), &["--timeout", "1s", "--no-rollback"]);
    assert!(code == 1 && text.contains("stays in the store"), "{text}");
    until("hall-1 has the new plant", &path, |shown| owners(shown, "hall-1").len() == 3).await;
    other.kill();
}

/// Without the copy, seen to fail: the member waits for the store.
#[tokio::test(flavor = "multi_thread")]
async fn a_member_without_the_store_has_its_copy_of_the_plant() {
    let Some(mut fleet) = Stored::new() else { return };
    assert_eq!(fleet.push(&plcs(&["mixer", "gate"]), &[]).0, 0);
    let mut hall_1 = fleet.start("hall-1");
    fleet.until_owned(&["hall-1"], 2).await;
    hall_1.signal("TERM");
    assert_eq!(hall_1.wait().code(), Some(0), "{}", hall_1.log());
    fleet.server.kill();

    let mut hall_2 = fleet.start("hall-2");
    hall_2.wait_for_log("waiting for the plant, of which there is no copy here");
    hall_2.signal("TERM");
    assert_eq!(hall_2.wait().code(), Some(0), "a signal ends the wait: {}", hall_2.log());
    let hall_1 = fleet.start("hall-1");
    hall_1.wait_for_log("starting with the copy of the plant in the state folder");
    hall_1.wait_for_log("started; ");
    fleet.server.run();
    let hall_2 = fleet.start("hall-2");
    fleet.until_owned(&["hall-1", "hall-2"], 2).await;
    drop(hall_2);
}
