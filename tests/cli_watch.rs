//! `fatek watch` as a process.
#![cfg(feature = "cli")]

mod process;

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use process::{FATEK, Folder, ScriptedPlc, Sim, fatek};
use serde_json::Value;

fn watch(url: &str, args: &[&str]) -> process::Output {
    fatek(&[&["--link", url, "--station", "1", "watch", "--interval", "20ms"], args].concat())
}

#[test]
fn samples_are_printed_in_all_formats() {
    let sim = Sim::start(&["--set", "R0=5", "R5=523", "M0-M2=1,0,1"]);
    let ran = watch(&sim.url, &["R0", "R5:u16*0.1-40", "M0-M2", "--count", "3", "--format", "json"]);
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
    let table = watch(&sim.url, &["R0", "M0", "--count", "1"]);
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
    let mut watcher = Command::new(FATEK).args(args).stdout(Stdio::piped()).spawn().unwrap();
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
    watcher.kill().unwrap();
    watcher.wait().unwrap();
}

#[test]
fn unreadable_tags_are_reported_and_not_zero() {
    let sim = Sim::start(&["--last", "R99", "--set", "R0=5"]);
    let ran = watch(&sim.url, &["R0", "R200", "--count", "1", "--on-change", "--format", "json"]);
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

// Before: --count counted lines, and a value that did not change was watched without an end.
#[test]
fn readings_are_counted_also_without_a_change() {
    let sim = Sim::start(&["--set", "R0=5", "R1=6"]);
    let ran = watch(&sim.url, &["R0", "R1", "--count", "3", "--on-change", "--format", "csv"]);
    assert!(ran.stderr.contains("3 poll cycles") || ran.stderr.contains("4 poll cycles"), "{ran:?}");
    let csv = ran.ok();
    assert_eq!(csv.lines().count(), 3, "the header and the first values: {csv}");
    // A reading that fails counts, too.
    let silent = ScriptedPlc::start(|_| Vec::new());
    let ran = fatek(
        &[
            &["--link", &silent.url, "--station", "1", "--timeout", "30ms", "watch", "R0", "R1"][..],
            &["--interval", "20ms", "--count", "2", "--format", "csv"],
        ]
        .concat(),
    );
    assert_eq!(ran.ok().lines().filter(|line| line.contains("bad: station 1 did not answer")).count(), 4);
}

#[test]
fn a_duration_ends_the_command() {
    let sim = Sim::start(&["--set", "R0=5"]);
    let started = std::time::Instant::now();
    let lines = watch(&sim.url, &["R0", "--for", "300ms", "--format", "csv"]).ok().lines().count();
    assert!(started.elapsed() >= std::time::Duration::from_millis(300));
    assert!(lines >= 2, "the header and a value");
}

#[test]
fn wide_lines_have_a_column_for_each_tag() {
    let sim = Sim::start(&["--last", "R99", "--set", "R0=5", "M0=1"]);
    let csv = watch(&sim.url, &["R0", "M0", "R200", "--wide", "--count", "2", "--format", "csv"]).ok();
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines[0], "time,R0,M0,R200,quality");
    assert_eq!(lines.len(), 3, "{csv}");
    let refused = "Z,5,1,,R200: bad: refused by the PLC: illegal address (A)";
    assert!(lines[1..].iter().all(|line| line.ends_with(refused)), "{csv}");

    let json = watch(&sim.url, &["R0", "M0", "--wide", "--count", "1", "--format", "json"]).ok();
    let line: Value = json.parse().unwrap();
    assert_eq!(line["values"].to_string(), r#"{"R0":5,"M0":true}"#);
    assert_eq!((&line["quality"], line.as_object().unwrap().len()), (&Value::from("good"), 3));

    let table = watch(&sim.url, &["R0", "M0", "R0", "--wide", "--count", "3", "--on-change"]).ok();
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines[0], "TIME                            R0        M0        R0  QUALITY");
    assert_eq!(lines.len(), 2, "only the first reading is a change: {table}");
    assert!(lines[1].ends_with("Z         5         1         5  good"), "{table}");

    // Several PLCs share the columns of tags with the same name.
    let both = sim
        .fatek(&["watch", "--station", "1-2", "--timeout", "50ms", "R0", "--wide", "--count", "1", "--format", "csv"])
        .ok();
    let mut lines: Vec<&str> = both.lines().map(|line| line.split_once(',').unwrap().1).collect();
    lines[1..].sort_unstable();
    assert_eq!(lines[..2], ["plc,R0,quality", "1,5,good"]);
    assert!(lines[2].starts_with("2,,") && lines[2].contains("bad: station 2 did not answer"), "{both}");
}

#[test]
fn times_are_local_by_choice() {
    let sim = Sim::start(&["--set", "R0=5"]);
    let command = |zone: &str| {
        let mut command = Command::new(FATEK);
        command.args(["--link", &sim.url, "--station", "1", "watch", "R0", "--count", "1", "--local-time"]);
        String::from_utf8(command.env("TZ", zone).output().unwrap().stdout).unwrap()
    };
    let table = command("<+0330>-3:30");
    let line = table.lines().nth(1).unwrap();
    assert!(line.contains("+03:30  R0   5") && line.len() == 29 + 2 + 6, "{table}");
}

#[test]
fn lines_are_logged_to_a_file_too() {
    let sim = Sim::start(&["--set", "R0=5"]);
    let folder = Folder::new("watch-log");
    let path = folder.0.join("log.csv");
    let log = path.to_str().unwrap();
    for _ in 0..2 {
        let json = watch(&sim.url, &["R0", "--count", "2", "--format", "json", "--log", log]).ok();
        assert_eq!(json.lines().count(), 2);
    }
    let text = std::fs::read_to_string(&path).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!((lines.len(), lines[0]), (5, "time,tag,value,quality"), "{text}");
    assert!(lines[1..].iter().all(|line| line.ends_with("Z,R0,5,good")), "{text}");
    // Another kind of line does not fit into this file.
    let ran = watch(&sim.url, &["R0", "--count", "2", "--wide", "--log", log]);
    assert_eq!(ran.status, 1);
    assert!(ran.stderr.contains("log.csv: it has other columns"), "{ran:?}");
    assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
    // Small files.
    sim.fatek(&[
        "watch",
        "R0",
        "--interval",
        "1ms",
        "--count",
        "120",
        "-q",
        "--log",
        log,
        "--log-size",
        "1K",
        "--log-keep",
        "2",
    ])
    .ok();
    let mut names: Vec<_> = std::fs::read_dir(&folder.0).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["log.csv", "log.csv.1", "log.csv.2"]);
    for name in names {
        let text = std::fs::read_to_string(folder.0.join(name)).unwrap();
        assert!(text.len() <= 1024 && text.starts_with("time,tag,value,quality\n") && text.ends_with('\n'), "{text}");
    }
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
        &["R0", "--for", "0s"],
        &["R0", "--wide", "--deadband", "1"],
        &["R0", "--log-size", "1M"],
        &["R0", "--log", "never.csv", "--log-size", "5"],
        &["Q0"],
        &[],
    ] {
        assert_eq!(fatek(&[&["--link", &plc.url, "--station", "1", "watch"], args].concat()).status, 2, "{args:?}");
    }
}
