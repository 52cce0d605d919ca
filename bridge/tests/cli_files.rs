//! The commands that read files and print: check, print-config, import, schema, and the faults of all of them.

mod common;

use std::path::Path;
use std::process::{Command, Output, Stdio};

use common::bridge::write_config;
use serde_json::Value;

/// A program without variables that are configuration.
fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    for variable in ["RUST_LOG", "CREDENTIALS_DIRECTORY", "STATE_DIRECTORY", "FATEK_BRIDGE_CONFIG"] {
        command.env_remove(variable);
    }
    command.args(arguments).current_dir(env!("CARGO_MANIFEST_DIR"));
    command
}

fn run(arguments: &[&str]) -> Output {
    command(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// Runs a program that succeeds, and returns its output.
fn done(arguments: &[&str]) -> String {
    let output = run(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", text(&output.stderr));
    text(&output.stdout).to_owned()
}

const GOOD: &str = "[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\ntag.level = 'R5'\n[stdout]\n";

fn shown(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn the_status_of_a_check_tells_faults_and_warnings() {
    let folder = tempfile::tempdir().unwrap();
    let status = |text: &str, more: &[&str]| {
        let path = write_config(folder.path(), text);
        let output = run(&[&["check", shown(&path)], more].concat());
        assert!(output.stderr.is_empty(), "{}", self::text(&output.stderr));
        (output.status.code(), self::text(&output.stdout).to_owned())
    };
    assert_eq!(status(GOOD, &["--strict"]).0, Some(0));
    let warned = format!("{GOOD}[class]\nslow = {{ every = '10s' }}\n");
    let (code, output) = status(&warned, &[]);
    assert!(code == Some(0) && output.contains("warning: class.slow: no tag has this class"), "{output}");
    assert_eq!(status(&warned, &["--strict"]).0, Some(1));
    let (code, output) = status("[mqtt]\nurl = 'mqtt://a'\n", &[]);
    assert!(code == Some(2) && output.contains("fault: line 1, plc: there is no PLC"), "{output}");
    let fleet = format!("{GOOD}[fleet]\nid = 'a'\n");
    let (code, output) = status(&fleet, &[]);
    assert!(code == Some(2) && output.contains("fault: line 6, fleet: it needs the section nats"), "{output}");
    let run = run(&["run", shown(&write_config(folder.path(), &fleet))]);
    assert_eq!(run.status.code(), Some(2));
    assert!(self::text(&run.stderr).contains("plant.toml: line 6, fleet: it needs the section nats"));
}

#[test]
fn an_option_gives_the_id_before_the_variable() {
    let folder = tempfile::tempdir().unwrap();
    let path = write_config(folder.path(), &format!("{GOOD}[bridge]\nid = 'x'\n"));
    let printed = |more: &[&str]| {
        let mut command = command(&[&["print-config", shown(&path)], more].concat());
        let output = command.env("FATEK_BRIDGE_ID", "of-variable").output().unwrap();
        text(&output.stdout).to_owned()
    };
    assert!(printed(&[]).contains("id = \"of-variable\""), "{}", printed(&[]));
    assert!(printed(&["--id", "hall-3"]).contains("id = \"hall-3\""));
    let refused = run(&["check", shown(&path), "--id", "a/b"]);
    assert_eq!(refused.status.code(), Some(2));
}

#[test]
fn a_check_is_a_document_for_programs() {
    let document: Value = serde_json::from_str(&done(&["check", "examples/demo.toml", "--format", "json"])).unwrap();
    let plcs: Vec<&str> =
        document["plans"].as_array().unwrap().iter().filter_map(|plan| plan["plc"].as_str()).collect();
    assert!(plcs.contains(&"mixer") && plcs.contains(&"pump4"), "{plcs:?}");
    assert_eq!(document["links"].as_array().unwrap().len(), 3);
    assert_eq!(document["findings"], Value::Array(Vec::new()));
    let load = |round_trip: &str| {
        let document = done(&["check", "examples/demo.toml", "--format", "json", "--round-trip", round_trip]);
        let document: Value = serde_json::from_str(&document).unwrap();
        document["links"][0]["load_percent"].as_f64().unwrap()
    };
    assert!(load("50ms") > 5.0 * load("5ms"), "{}", load("50ms"));
}

#[test]
fn faults_are_the_same_for_run_and_print_config() {
    let folder = tempfile::tempdir().unwrap();
    let path = write_config(folder.path(), "[mqtt]\nurls = 'mqtt://me:hunter2@broker'\n[plc.mixer]\nstation = 0\n");
    let expected = [
        "line 1, mqtt.url: it is missing",
        "line 2, mqtt.urls: the key is unknown; did you mean `url`? (known: url user password_file",
        "line 3, plc.mixer.link: it is missing",
        "line 4, plc.mixer.station: 0 is not a station: 1 to 254 are",
    ];
    for name in ["run", "print-config"] {
        let output = run(&[name, shown(&path)]);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(2), ""), "{name}");
        let lines: Vec<&str> = text(&output.stderr).lines().collect();
        assert_eq!(lines.len(), expected.len(), "{lines:#?}");
        for (line, expected) in lines.iter().zip(expected) {
            assert!(line.starts_with(&format!("error: {}: {expected}", path.display())), "{line}");
        }
    }
}

#[test]
fn untrusted_texts_are_escaped() {
    let folder = tempfile::tempdir().unwrap();
    let path =
        write_config(folder.path(), "[plc.mixer]\nlink = \"\\u001b[2J\\nerror: x\"\nstation = 1\n\"a\\u001b\" = 1\n");
    for name in ["run", "check", "print-config"] {
        let output = run(&[name, shown(&path)]);
        let all = [output.stdout, output.stderr].concat();
        assert!(!all.contains(&0x1b) && text(&all).contains("\\u{1b}"), "{name}: {}", text(&all));
        assert!(!text(&all).lines().any(|line| line.starts_with("error: x")), "{}", text(&all));
    }
    let output = run(&["check", "no\u{1b}[2J"]);
    assert!(!output.stdout.contains(&0x1b) && output.status.code() == Some(2));
    let output = run(&["check", "--round-trip", "\u{1b}[2J", "x"]);
    assert!(!output.stderr.contains(&0x1b) && output.status.code() == Some(2));
}

#[test]
fn print_config_has_defaults_variables_and_no_secret() {
    let folder = tempfile::tempdir().unwrap();
    let mqtt = "[mqtt]\nurl = 'mqtt://broker'\nuser = 'me'\npassword_file = 'mqtt.pass'\n";
    let path = write_config(folder.path(), &format!("{GOOD}{mqtt}"));
    std::fs::write(folder.path().join("mqtt.pass"), "hunter2").unwrap();
    let mut command = command(&["print-config"]);
    command.env("FATEK_BRIDGE_CONFIG", &path).env("FATEK_BRIDGE_ID", "hall-9");
    command.env("FATEK_BRIDGE_HTTP", "127.0.0.1:1234").env("FATEK_BRIDGE_MQTT_PASSWORD", "hunter3");
    let output = command.output().unwrap();
    let printed = text(&output.stdout);
    assert!(output.status.success(), "{}", text(&output.stderr));
    for line in [
        "id = \"hall-9\"",
        "http = \"127.0.0.1:1234\"",
        "url = \"mqtt://broker:1883\"",
        "password_file = \"mqtt.pass\"",
    ] {
        assert!(printed.lines().any(|printed| printed == line), "{line}:\n{printed}");
    }
    assert!(!printed.contains("hunter"), "{printed}");
    let again = write_config(folder.path(), printed);
    assert_eq!(done(&["print-config", shown(&again)]), printed);
}

#[test]
fn secrets_are_found_in_files_and_variables() {
    let folder = tempfile::tempdir().unwrap();
    let mqtt = "[mqtt]\nurl = 'mqtt://127.0.0.1'\nuser = 'me'\npassword_file = 'mqtt.pass'\n[nats]\nurl = 'nats://a'\n\
                creds_file = 'nats.creds'\n[bridge]\ntoken_file = 'token'\nbuffer.dir = 'buffer'\n";
    let path = write_config(folder.path(), &format!("{GOOD}{mqtt}"));
    let faults = |command: &mut Command| {
        let output = command.output().unwrap();
        let lines = text(&output.stdout).lines().filter(|line| line.starts_with("fault: "));
        assert!(!text(&output.stdout).contains("hunter2"));
        lines.map(|line| line.split(": ").nth(1).unwrap().to_owned()).collect::<Vec<_>>()
    };
    // A token has no effect yet.
    let secrets = ["mqtt.password_file", "nats.creds_file"];
    assert_eq!(faults(&mut command(&["check", shown(&path)])), secrets);
    let mut variables = command(&["check", shown(&path)]);
    variables.env("FATEK_BRIDGE_HTTP_TOKEN", "hunter2").env("FATEK_BRIDGE_MQTT_PASSWORD", "hunter2");
    assert_eq!(faults(variables.env("FATEK_BRIDGE_NATS_CREDS", "hunter2")), [""; 0]);
    assert_eq!(faults(variables.env("FATEK_BRIDGE_NATS_CREDS", "")), ["nats.creds_file"]);
    let credentials = tempfile::tempdir().unwrap();
    ["mqtt.pass", "nats.creds", "token"].iter().for_each(|name| {
        std::fs::write(credentials.path().join(name), "hunter2\n").unwrap();
    });
    let mut service = command(&["check", shown(&path)]);
    assert_eq!(faults(service.env("CREDENTIALS_DIRECTORY", credentials.path())), [""; 0]);
}

#[test]
fn the_buffer_is_in_the_first_folder_of_states() {
    let folder = tempfile::tempdir().unwrap();
    let path = write_config(folder.path(), &format!("{GOOD}[bridge]\nbuffer.dir = 'buffer'\n"));
    let states = folder.path().join("states");
    std::fs::write(&states, "no folder").unwrap();
    let check = |variable: &str| {
        let output = command(&["check", shown(&path)]).env("STATE_DIRECTORY", variable).output().unwrap();
        text(&output.stdout).to_owned()
    };
    let found = check(&format!("{}:/nowhere", states.display()));
    assert!(found.contains(&format!("warning: bridge.buffer.dir: {} is not a folder", states.display())), "{found}");
    // Without the variable it is beside the configuration.
    assert!(check("").ends_with("plant.toml: no faults\n"), "{}", check(""));
}

#[test]
fn tables_of_tags_become_a_configuration_that_is_good() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["import", "examples/boiler.csv", "--link", "tcp://192.168.2.9", "--class", "fast=500ms"];
    let output = run(&arguments);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert_eq!(text(&output.stderr), "note: every 1s for the classes slow: --class NAME=TIME sets another period\n");
    let imported = text(&output.stdout);
    assert!(imported.contains("[plc.boiler]\nlink = \"tcp://192.168.2.9:500\"\nstation = 1\n"), "{imported}");
    let path = write_config(folder.path(), &format!("{imported}[stdout]\n"));
    let checked = run(&["check", shown(&path), "--strict"]);
    assert!(checked.status.success(), "{}", text(&checked.stdout));

    let bad = folder.path().join("bad.csv");
    std::fs::write(&bad, "name,at\nlevel,R99999\n").unwrap();
    for (arguments, message) in [
        (&["import", shown(&bad), "--link", "tcp://h"][..], "bad.csv: line 2, at: `R99999` is not a tag"),
        (&["import", "examples/boiler.csv"], "--link <URL>"),
        (&["import", "examples/boiler.csv", "--link", "http://h"], "`http://h` is not an endpoint"),
        (&["import", "examples/boiler.csv", "--link", "tcp://h", "--plc", "a b"], "a name has 1 to 64"),
        (
            &["import", "examples/boiler.csv", "--link", "tcp://h", "--class", "x=1s"],
            "--class x: no tag has this class",
        ),
        (&["import", "none.csv", "--link", "tcp://h"], "none.csv: cannot read it: No such file"),
        (&["import", "examples/boiler.csv", "--link", "tcp://h", "--template", "t"], "cannot be used with"),
    ] {
        let output = run(arguments);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(2), ""), "{arguments:?}");
        assert!(text(&output.stderr).contains(message), "{arguments:?}: {}", text(&output.stderr));
    }
}

#[test]
fn the_schema_is_a_document() {
    let schema: Value = serde_json::from_str(&done(&["schema"])).unwrap();
    assert_eq!(schema["$schema"], "https://json-schema.org/draft/2020-12/schema");
    assert!(schema["$defs"]["MqttSection"]["properties"]["url"]["description"].is_string());
}

#[test]
fn a_closed_stdout_is_no_error() {
    for arguments in [&["schema"][..], &["print-config", "examples/plant.toml"], &["check", "examples/demo.toml"]] {
        let mut child = command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{arguments:?}: {}", text(&output.stderr));
    }
}
