//! The log: its formats, the journal of systemd, and its filter.

mod common;

use std::fs::File;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use common::bridge::{Bridge, PATIENCE, write_config};
use common::plc::SimPlc;
use serde_json::Value;

/// A PLC that does not answer, and no port of the page that another test has.
const CONFIG: &str = "[bridge]\nhttp = '127.0.0.1:0'\n[plc.mixer]\nlink = 'tcp://127.0.0.1:1'\nstation = 1\n\
                      tag.level = 'R5'\n[stdout]\n";

fn command(config: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    command.arg("run").arg(config).args(arguments).env_remove("RUST_LOG").env_remove("JOURNAL_STREAM");
    command
}

fn config(folder: &Path) -> PathBuf {
    write_config(folder, CONFIG)
}

#[test]
fn lines_have_a_time_and_a_level() {
    let folder = tempfile::tempdir().unwrap();
    let bridge = Bridge::spawn(command(&config(folder.path()), &[]));
    bridge.wait_for_log("started");
    let log = bridge.log();
    let line = log.lines().find(|line| line.contains("started")).unwrap();
    assert!(line.starts_with("20") && line.contains("Z  INFO fatek_bridge"), "{line}");
}

#[test]
fn lines_of_json_are_documents() {
    let folder = tempfile::tempdir().unwrap();
    let bridge = Bridge::spawn(command(&config(folder.path()), &["--log-format", "json"]));
    bridge.wait_for_log("started");
    let log = bridge.log();
    let line = log.lines().find(|line| line.contains("started")).unwrap();
    let event: Value = serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"));
    assert_eq!(event["level"], "INFO");
    assert!(event["message"].as_str().unwrap().starts_with("started"), "{line}");
}

#[test]
fn lines_in_the_journal_begin_with_their_priority() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path());
    let path = folder.path().join("journal");
    // The stream of the journal, as systemd names it.
    let run = |stream: &dyn Fn(&File) -> String| {
        let journal = File::create(&path).unwrap();
        let stream = stream(&journal);
        let mut command = command(&config, &[]);
        command.env("JOURNAL_STREAM", stream).stdout(Stdio::null()).stderr(journal);
        let mut child = command.spawn().unwrap();
        let until = Instant::now() + PATIENCE;
        let log = loop {
            let log = std::fs::read_to_string(&path).unwrap();
            if log.contains("started") {
                break log;
            }
            assert!(Instant::now() < until, "{log}");
            std::thread::sleep(std::time::Duration::from_millis(10));
        };
        child.kill().unwrap();
        child.wait().unwrap();
        log.lines().find(|line| line.contains("started")).unwrap().to_owned()
    };
    let of = |file: &File| file.metadata().map(|metadata| format!("{}:{}", metadata.dev(), metadata.ino())).unwrap();
    let line = run(&of);
    assert!(line.starts_with("<6>fatek_bridge::run: started"), "{line}");
    // Another stream: stderr was redirected since.
    let line = run(&|_| "1:1".to_owned());
    assert!(line.starts_with("20") && line.contains("INFO"), "{line}");
}

/// Without the cure the log had not a word of it.
#[tokio::test(flavor = "multi_thread")]
async fn a_plc_that_falls_silent_and_comes_back_is_named() {
    let mut plc = SimPlc::start(&[]).await;
    let folder = tempfile::tempdir().unwrap();
    let text = format!(
        "[bridge]\nhttp = '127.0.0.1:0'\n[plc.mixer]\nlink = '{}'\nstation = 1\ntag.level = 'R5'\n\
         [plc.absent]\nlink = 'tcp://127.0.0.1:1'\nstation = 1\ntag.level = 'R5'\n[stdout]\n",
        plc.link()
    );
    let bridge = Bridge::spawn(command(&write_config(folder.path(), &text), &["--log-format", "json"]));
    let line = |plc: &str, message: &str| -> Option<Value> {
        let log = bridge.log();
        let mut events = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        events.rfind(|event| event["plc"] == plc && event["message"] == message)
    };
    let wait_for = async |plc: &str, message: &str| {
        let until = Instant::now() + PATIENCE;
        loop {
            if let Some(event) = line(plc, message) {
                return event;
            }
            assert!(Instant::now() < until, "no {message:?} of {plc}: {}", bridge.log());
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    };
    // One that has never answered has some seconds for it.
    let absent = wait_for("absent", "the PLC does not answer").await;
    assert!(absent["level"] == "WARN" && absent["why"].as_str().unwrap().contains("refused"), "{absent}");
    assert_eq!(line("mixer", "the PLC does not answer"), None);
    plc.stop().await;
    assert_eq!(wait_for("mixer", "the PLC does not answer").await["level"], "WARN");
    plc.resume().await;
    assert_eq!(wait_for("mixer", "the PLC answers again").await["level"], "INFO");
}

#[test]
fn a_filter_is_applied_and_a_bad_one_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path());
    let mut bridge = Bridge::spawn(command(&config, &["--log", "error"]));
    // It has started when a signal ends it in order.
    assert!(bridge.batch()["d"]["level"]["q"].is_string());
    bridge.signal("TERM");
    assert!(bridge.wait().success());
    assert!(!bridge.log().contains("INFO"), "{}", bridge.log());
    let output = command(&config, &["--log", "x=y=z"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8(output.stderr).unwrap().starts_with("error: --log: "));
}

/// Without the warning, a user took the page for protected.
#[test]
fn a_token_without_effect_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let text = CONFIG.replace("[bridge]\n", "[bridge]\ntoken_file = 'token'\n");
    let bridge = Bridge::spawn(command(&write_config(folder.path(), &text), &[]));
    bridge.wait_for_log("started");
    assert!(bridge.log().contains("WARN") && bridge.log().contains("bridge.token_file: it has no effect"));
    let bridge = Bridge::spawn(command(&config(folder.path()), &[]));
    bridge.wait_for_log("started");
    assert!(!bridge.log().contains("token_file"), "{}", bridge.log());
}
