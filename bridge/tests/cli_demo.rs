//! The demo, as a process: values move, a PLC falls silent, and it ends by itself.

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::process::Command;
use std::time::{Duration, Instant};

use common::bridge::{Bridge, PATIENCE};
use serde_json::Value;

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    command.arg("demo").args(arguments).env_remove("RUST_LOG");
    command
}

#[test]
fn values_of_all_plcs_move_and_the_demo_ends() {
    let started = Instant::now();
    let mut demo = Bridge::spawn(command(&["--http", "127.0.0.1:0", "--for", "8s"]));
    let batches = demo.rest();
    assert!(demo.wait().success(), "{}", demo.log());
    assert!(started.elapsed() >= Duration::from_secs(8));
    let mut values: BTreeMap<(String, String), BTreeSet<String>> = BTreeMap::new();
    for batch in &batches {
        for (tag, value) in batch["d"].as_object().unwrap() {
            let key = (batch["plc"].as_str().unwrap().to_owned(), tag.clone());
            values.entry(key).or_default().insert(value.to_string());
        }
    }
    let plcs: BTreeSet<&str> = values.keys().map(|(plc, _)| plc.as_str()).collect();
    assert_eq!(Vec::from_iter(plcs), ["boiler", "mixer", "pump1", "pump2", "pump3", "pump4"]);
    for (plc, tag) in [("mixer", "level"), ("mixer", "temperature"), ("boiler", "flow"), ("pump4", "speed")] {
        let different = &values[&(plc.to_owned(), tag.to_owned())];
        assert!(different.len() >= 3, "{plc}.{tag}: {different:?}");
    }
    let constant = &values[&("mixer".to_owned(), "recipe".to_owned())];
    assert_eq!(Vec::from_iter(constant), ["\"strawberry\""]);
    println!("{} batches of {} tags", batches.len(), values.len());
}

#[test]
fn a_silent_plc_is_seen_and_comes_back() {
    let mut demo = Bridge::spawn(command(&["--http", "127.0.0.1:0"]));
    let started = Instant::now();
    let mut seen: Vec<(&str, Duration)> = Vec::new();
    while seen.len() < 3 {
        assert!(started.elapsed() < PATIENCE * 2, "{seen:?}");
        let batch = demo.batch();
        let Some(speed) = batch["d"].get("running").filter(|_| batch["plc"] == "pump4") else { continue };
        let quality = match speed {
            Value::Bool(_) => "good",
            Value::Object(bad) => {
                assert!(bad.contains_key("why") && bad.contains_key("ts"), "{batch}");
                "not good"
            }
            other @ (Value::Null | Value::Number(_) | Value::String(_) | Value::Array(_)) => panic!("{other}"),
        };
        if seen.last().is_none_or(|(last, _)| *last != quality) {
            seen.push((quality, started.elapsed()));
        }
    }
    let order: Vec<&str> = seen.iter().map(|(quality, _)| *quality).collect();
    assert_eq!(order, ["good", "not good", "good"]);
    println!("quality of pump4: {seen:?}");
    demo.signal("INT");
    assert!(demo.wait().success(), "{}", demo.log());
}

#[test]
fn the_page_has_another_port_if_its_own_is_taken() {
    // Taken by this test, or by another program.
    let _taken = TcpListener::bind("127.0.0.1:9187");
    let demo = Bridge::spawn(command(&["--quiet", "--for", "1s"]));
    demo.wait_for_log("Page: http://127.0.0.1:");
    let log = demo.log();
    let page = log.lines().find_map(|line| line.strip_prefix("Page: http://127.0.0.1:")).unwrap();
    let port: u16 = page.parse().unwrap();
    assert!(port != 9187 && port != 0, "{port}");
    assert!(log.contains("Simulated PLCs: mixer, boiler, pump1, pump2, pump3, pump4"), "{log}");
    assert_eq!(demo.line(), None, "quiet");
}

/// The answer to a request for a path of the page.
fn get(address: &str, path: &str) -> std::io::Result<String> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).map(|_| answer)
}

#[test]
fn the_page_shows_the_plcs() {
    let demo = Bridge::spawn(command(&["--http", "127.0.0.1:0", "--quiet"]));
    demo.wait_for_log("Ctrl-C ends the demo.");
    let log = demo.log();
    let address = log.lines().find_map(|line| line.strip_prefix("Page: http://")).unwrap().to_owned();
    let until = Instant::now() + PATIENCE;
    loop {
        let tags = get(&address, "/api/tags").unwrap_or_default();
        if tags.contains("pump4") && tags.contains("42") {
            assert!(tags.starts_with("HTTP/1.1 200 ") && tags.contains("setpoint"), "{tags}");
            break;
        }
        assert!(Instant::now() < until, "{tags}\n{}", demo.log());
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(get(&address, "/").unwrap().starts_with("HTTP/1.1 200 "));
}

#[test]
fn the_configuration_is_printed_and_is_that_of_the_examples() {
    let output = command(&["--print-config"]).output().unwrap();
    let example = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/demo.toml")).unwrap();
    assert!(output.status.success());
    assert_eq!(String::from_utf8(output.stdout).unwrap(), example);
}

#[test]
fn arguments_that_cannot_be_are_refused() {
    for (arguments, message) in [
        (&["--for", "10ms"][..], "the demo runs for 1s or more"),
        (&["--http", "localhost"], "invalid value 'localhost'"),
    ] {
        let output = command(arguments).output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && error.contains(message), "{error}");
    }
}
