//! `fatek watch` as a process.
#![cfg(feature = "cli")]

mod process;

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use process::{FATEK, ScriptedPlc, Sim, fatek};
use serde_json::Value;

fn watch(url: &str, args: &[&str]) -> process::Output {
    fatek(&[&["--link", url, "--station", "1", "watch", "--interval", "20ms"], args].concat())
}

#[test]
fn samples_are_printed_in_all_formats() {
    let sim = Sim::start(&["--set", "R0=5", "R5=523", "M0-M2=1,0,1"]);
    let ran = watch(&sim.url, &["R0", "R5:u16*0.1-40", "M0-M2", "--count", "15", "--format", "json"]);
    let lines: Vec<Value> = ran.ok().lines().map(|line| line.parse().unwrap()).collect();
    assert_eq!(lines.len(), 15);
    let all = |tag: &str| {
        let of = lines.iter().filter(|line| line["tag"] == tag);
        of.map(|line| line["value"].to_string()).collect::<Vec<_>>()
    };
    assert_eq!(all("R0"), ["5"; 3]);
    assert_eq!(all("R5:u16*0.1-40"), ["12.3"; 3]);
    assert_eq!((all("M0"), all("M1")), (vec!["true".to_owned(); 3], vec!["false".to_owned(); 3]));
    for line in &lines {
        assert_eq!(line["quality"], "good");
        assert!(line["time"].as_str().unwrap().ends_with('Z') && line["time"].as_str().unwrap().len() == 24, "{line}");
    }
    let csv = watch(&sim.url, &["R0", "--count", "2", "--format", "csv"]).ok();
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!((lines.len(), lines[0]), (3, "time,tag,value,quality"));
    assert!(lines[1..].iter().all(|line| line.ends_with(",R0,5,good")), "{csv}");
    let table = watch(&sim.url, &["R0", "M0", "--count", "2"]);
    assert!(table.stderr.contains("2 lines"), "{table:?}");
    let table = table.ok();
    assert!(table.starts_with("TIME                      TAG  VALUE\n"), "{table}");
    assert!(table.lines().any(|line| line.ends_with("Z  R0   5")), "{table}");
}

#[test]
fn on_change_only_changes_are_printed() {
    let sim = Sim::start(&["--set", "R0=5", "R1=100"]);
    let url = sim.url.clone();
    let args = ["--link", &url, "--station", "1", "watch", "--interval", "20ms", "R0", "R1", "--deadband", "10"];
    let mut watcher = Command::new(FATEK).args(args).args(["--count", "3"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(watcher.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.next().unwrap().starts_with("TIME"));
    let mut value = || lines.next().unwrap().split_once("Z  ").unwrap().1.to_owned();
    let mut first = [value(), value()];
    first.sort_unstable();
    assert_eq!(first, ["R0   5", "R1   100"]);
    // A change within the deadband, and one beyond it.
    sim.fatek(&["write", "R0=9", "R1=110"]).ok();
    sim.fatek(&["write", "R1=111"]).ok();
    assert_eq!(value(), "R1   111");
    assert!(watcher.wait().unwrap().success());
}

#[test]
fn unreadable_tags_are_reported_and_not_zero() {
    let sim = Sim::start(&["--last", "R99", "--set", "R0=5"]);
    let ran = watch(&sim.url, &["R0", "R200", "--count", "2", "--on-change", "--format", "json"]);
    let lines: Vec<Value> = ran.ok().lines().map(|line| line.parse().unwrap()).collect();
    let of = |tag: &str| lines.iter().find(|line| line["tag"] == tag).unwrap();
    assert_eq!((&of("R0")["value"], &of("R0")["quality"]), (&Value::from(5), &Value::from("good")));
    assert_eq!(of("R200")["value"], Value::Null);
    assert_eq!(of("R200")["quality"], "bad: refused by the PLC: illegal address (A)");

    let silent = ScriptedPlc::start(|_| Vec::new());
    let table = fatek(&[
        "--link",
        &silent.url,
        "--station",
        "1",
        "--timeout",
        "50ms",
        "watch",
        "R0",
        "--interval",
        "20ms",
        "--count",
        "1",
    ])
    .ok();
    let line = table.lines().nth(1).unwrap();
    assert!(line.contains("Z  R0   (bad: station 1 did not answer read registers"), "{table}");
}

#[test]
fn invalid_arguments_send_nothing() {
    let plc = ScriptedPlc::start(|_| panic!("nothing should be sent"));
    for args in [
        &["R0", "--interval", "0s"][..],
        &["R0", "--interval", "soon"],
        &["R0", "--deadband", "wide"],
        &["R0", "--deadband=-1"],
        &["R0", "--count", "0"],
        &["Q0"],
        &[],
    ] {
        assert_eq!(fatek(&[&["--link", &plc.url, "--station", "1", "watch"], args].concat()).status, 2, "{args:?}");
    }
}
