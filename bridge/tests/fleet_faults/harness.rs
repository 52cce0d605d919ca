//! Tests of the harness itself: a fault that it injects must be seen, and a stale request must be found.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use futures::StreamExt as _;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStdin, ChildStdout};
use tokio::sync::broadcast;
use tokio::time::{sleep, timeout};

use super::common::nats::NatsServer;
use super::member::{fake_clock, faketime, set_clock};
use super::oracle::Oracle;
use super::plcs::Plcs;
use super::processes::Processes;
use super::proxy::{Proxy, Sessions};
use super::recorder::{Recorder, make_store};

const PATIENCE: Duration = Duration::from_secs(20);

/// A process that sends a request to a PLC for each line.
struct Sender {
    _child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Sender {
    fn start(processes: &Processes, port: u16) -> Self {
        let script = format!(
            "exec 3<>/dev/tcp/127.0.0.1/{port}; while read -r line; do printf '\\x02014601R0001273\\x03' >&3; \
             IFS= read -r -d $'\\x03' reply <&3; echo sent; done"
        );
        let number = processes.add();
        let mut command = tokio::process::Command::new("bash");
        command.args(["-c", &script]).stdin(Stdio::piped()).stdout(Stdio::piped()).kill_on_drop(true);
        let mut child = command.spawn().unwrap();
        processes.started(number, child.id().unwrap());
        let (input, output) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        Self { _child: child, input, output }
    }

    async fn send(&mut self) {
        self.input.write_all(b"go\n").await.unwrap();
        let mut line = String::new();
        timeout(PATIENCE, self.output.read_line(&mut line)).await.expect("no reply of the PLC").unwrap();
        assert_eq!(line, "sent\n");
    }
}

/// The whole way from sockets and the store to the verdict.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stale_request_of_a_real_process_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let context = async_nats::jetstream::new(server.client().await);
    let subjects = vec!["$KV.leases.>".to_owned()];
    let stream = async_nats::jetstream::stream::Config {
        name: "KV_leases".to_owned(),
        subjects,
        max_messages_per_subject: 1,
        ..Default::default()
    };
    make_store(server.client().await, stream).await;
    let recorder = Recorder::start(server.port()).await;
    let take = async |session: &'static str| {
        context.publish("$KV.leases.l.plc1", session.into()).await.unwrap().await.unwrap();
    };
    let processes = Processes::default();
    let plcs = Plcs::start(1, processes.clone());
    let mut oracle = Oracle::new(vec!["plc1".to_owned()]);
    let sessions = [("a", 0), ("b", 1)].map(|(session, process)| (session.to_owned(), process)).into();
    let mut judge = async || {
        sleep(Duration::from_millis(20)).await;
        let record = plcs.take();
        recorder.catch_up().await;
        oracle.add(recorder.take());
        oracle.judge(&record, &sessions, |_| None);
        let judged = &oracle.judged;
        (judged.requests, judged.stale, judged.late, judged.unowned, judged.unknown)
    };

    take("a").await;
    let mut first = Sender::start(&processes, plcs.ports()[0]);
    first.send().await;
    first.send().await;
    assert_eq!(judge().await, (2, 0, 0, 0, 0));
    take("").await;
    take("b").await;
    let mut second = Sender::start(&processes, plcs.ports()[0]);
    // Taken, and not polled by its new owner yet.
    sleep(Duration::from_millis(20)).await;
    first.send().await;
    assert_eq!(judge().await, (3, 0, 1, 0, 0));
    second.send().await;
    assert_eq!(judge().await, (4, 0, 1, 0, 0));
    sleep(Duration::from_millis(20)).await;
    first.send().await;
    assert_eq!(judge().await, (5, 1, 1, 0, 0));
    // A process without a session.
    Sender::start(&processes, plcs.ports()[0]).send().await;
    assert_eq!(judge().await, (6, 1, 1, 1, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_proxy_holds_delays_and_repeats_messages() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let (sessions, moments) = (Sessions::default(), broadcast::channel(8).0);
    let proxy = Proxy::start(7, server.port(), sessions.clone(), moments.clone()).await;
    let mut acts = moments.subscribe();
    let direct = server.client().await;
    let mut subscription = direct.subscribe("$KV.leases.>").await.unwrap();
    direct.flush().await.unwrap();
    let client = async_nats::connect(proxy.url()).await.unwrap();
    client.publish("$KV.leases.w.s1", "x".into()).await.unwrap();
    assert!(timeout(PATIENCE, subscription.next()).await.unwrap().is_some());
    assert_eq!(acts.recv().await.unwrap().process, 7);
    assert_eq!(sessions.lock().unwrap().get("s1"), Some(&7));

    let late = Duration::from_millis(300);
    proxy.change(|way| way.up.delay = late);
    let begin = Instant::now();
    client.publish("$KV.leases.l.p", "s1".into()).await.unwrap();
    timeout(PATIENCE, subscription.next()).await.unwrap().unwrap();
    assert!(begin.elapsed() >= late, "{:?}", begin.elapsed());

    proxy.heal();
    proxy.repeat(true, 1, Duration::ZERO);
    client.publish("$KV.leases.l.p", "twice".into()).await.unwrap();
    for _ in 0..2 {
        assert_eq!(timeout(PATIENCE, subscription.next()).await.unwrap().unwrap().payload, "twice");
    }

    proxy.change(|way| way.up.is_held = true);
    client.publish("$KV.leases.l.p", "held".into()).await.unwrap();
    assert!(timeout(late, subscription.next()).await.is_err(), "it is held");
    // The client ends, and its message comes still.
    drop(client);
    sleep(Duration::from_millis(20)).await;
    proxy.heal();
    assert_eq!(timeout(PATIENCE, subscription.next()).await.unwrap().unwrap().payload, "held");

    proxy.change(|way| (way.is_refusing, way.resets) = (true, way.resets + 1));
    assert!(async_nats::connect(proxy.url()).await.is_err(), "it refuses");
}

/// The clocks as the bridge sees them: seconds of the wall clock, and of `CLOCK_BOOTTIME`.
#[test]
#[ignore = "a part of the next test, in a process with another wall clock"]
fn prints_the_clocks() {
    let wall = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs();
    println!("clocks {wall} {}", fatek_bridge::fleet::boot_time() / 1_000_000_000);
}

#[test]
fn a_faked_wall_clock_leaves_the_clock_of_leases_alone() {
    let Some(library) = faketime() else {
        assert!(std::env::var_os("FATEK_BRIDGE_REQUIRE_SERVERS").is_none(), "libfaketime is not installed");
        println!("skipped: libfaketime is not installed");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let clock = folder.path().join("clock");
    for step in [0, 3600, -3600] {
        set_clock(&clock, step);
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "harness::prints_the_clocks", "--ignored", "--nocapture"]);
        fake_clock(&mut command, &library, &clock);
        let output = String::from_utf8(command.output().unwrap().stdout).unwrap();
        let line = output.lines().find(|line| line.contains("clocks ")).unwrap_or_else(|| panic!("{output}"));
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let [wall, boot] = [words.len() - 2, words.len() - 1].map(|at| words[at].parse::<i64>().unwrap());
        let real = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_secs();
        let real = i64::try_from(real).unwrap();
        assert!((wall - real - step).abs() < 20, "step {step}: {wall}, in truth {real}");
        let boot_now = i64::try_from(fatek_bridge::fleet::boot_time() / 1_000_000_000).unwrap();
        assert!((boot - boot_now).abs() < 20, "step {step}: {boot}, in truth {boot_now}");
    }
}
