//! `fatek doctor` as a process. The checks themselves are tested in `src/bin/fatek/doctor/tests.rs`.
#![cfg(feature = "cli")]

mod process;

use std::fs;
use std::net::SocketAddr;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::command::Code;
use fatek::sim::{Bus, Fault, Faults, Model, Plc, Rule, Server};
use fatek::wire::Framing;
use fatek::{Value as PlcValue, register};
use process::{FATEK, Folder, Output, ScriptedPlc, Sim, fatek};
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// Verdicts that a busy machine can change.
const OF_TIME: [&str; 4] = ["module-timeout", "pause-in-frame", "in-time", "answered"];

/// A value of R0 that occurs nowhere else: D431h.
const SECRET: &str = "R0=54321";

/// Runs the command line against a simulated PLC with these faults.
async fn examine(plc: Plc, faults: Faults, args: &'static [&'static str]) -> Output {
    let bus = Bus::new().with_station(1, plc).unwrap().with_faults(faults);
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let url = format!("tcp://{}", server.local_addr());
    let ran = tokio::task::spawn_blocking(move || fatek(&[&["--link", &url], args].concat())).await.unwrap();
    server.shutdown().await;
    ran
}

/// Runs an examination with few requests at a high rate.
fn quick(sim: &Sim, args: &[&str]) -> Output {
    sim.fatek(&[&["doctor", "--quick", "--rate", "1000"], args].concat())
}

fn document(ran: &Output) -> Value {
    ran.stdout.parse().unwrap_or_else(|error| panic!("{error}: {ran:?}"))
}

fn names(document: &Value, verdict: &str) -> Vec<String> {
    let checks = document["checks"].as_array().unwrap().iter().filter(|check| check["verdict"] == verdict);
    let names = checks.map(|check| check["check"].as_str().unwrap().to_owned());
    names.filter(|name| !OF_TIME.contains(&&name[..])).collect()
}

#[test]
fn json_has_each_check_and_nothing_private() {
    for framing in ["ascii", "binary"] {
        let sim = Sim::start(&["--framing", framing, "--set", SECRET]);
        let ran = quick(&sim, &["--format", "json", "--evidence"]);
        let found = document(&ran);
        assert_eq!(names(&found, "contradicts"), [""; 0], "{ran:?}");
        assert!([0, 7].contains(&ran.status), "{ran:?}");
        assert!(names(&found, "holds").len() > 35, "{ran:?}");
        assert_eq!((&found["transport"], &found["framing"]), (&"tcp".into(), &framing.into()));
        assert!(found["response_times_ms"]["median"].as_f64().unwrap() > 0.0);
        let registers =
            found["checks"].as_array().unwrap().iter().find(|check| check["check"] == "registers-46").unwrap();
        assert_eq!(registers["assumed"], "registers are read (46)");
        assert_eq!(registers["evidence"].as_array().unwrap().len(), 2, "{registers}");
        assert!(ran.stderr.contains("reading only\n"), "{}", ran.stderr);
        // Neither the value of R0, as text of ASCII digits or as bytes, nor the address.
        for private in ["127.0.0.1", "44343331", "D431"] {
            assert!(!ran.stdout.contains(private) && !ran.stderr.contains(private), "{private}: {ran:?}");
        }
        let shown = quick(&sim, &["--format", "json", "--evidence", "--values", "--with-address"]).stdout;
        assert!(shown.contains("127.0.0.1") && (shown.contains("44343331") || shown.contains("D431")), "{shown}");
    }
}

/// Before, a frame of another command and bytes outside of frames were shown with their values.
#[tokio::test(flavor = "multi_thread")]
async fn evidence_of_bad_replies_has_no_values() {
    for fault in [
        Fault::WrongCommand,
        Fault::BadChecksum,
        Fault::GarbageBefore { max_len: 4 },
        Fault::GarbageInside { max_len: 1 },
        Fault::Truncated { by: 1 },
    ] {
        let plc = Plc::new();
        plc.write(register!("R0"), 0xD431_u16).unwrap();
        let faults = Faults::new(3).rule(Rule::new(fault.clone()).command(Code::ReadRegisters).one_in(4));
        let args = &["--station", "1", "doctor", "--quick", "--rate", "1000", "--timeout", "200ms", "--evidence"];
        let ran = examine(plc, faults, args).await;
        // D43 as ASCII digits; R0 itself is read by each of several checks.
        assert!(!ran.stdout.contains("443433") && ran.stdout.contains("not shown"), "{fault:?}: {ran:?}");
    }
}

#[test]
fn tables_csv_and_reports_have_the_same_findings() {
    let sim = Sim::start(&["--set", SECRET]);
    let folder = Folder::new("doctor");
    let (markdown, json) = (folder.file("report.md"), folder.file("report.json"));
    let table = quick(&sim, &["--report", &markdown]);
    assert!(table.stdout.starts_with("Framing\n  holds        frames "), "{table:?}");
    assert!(table.stdout.contains("\nResponse times\n"), "{table:?}");
    assert!(table.stdout.lines().all(|line| line.chars().count() <= 80), "{table:?}");
    assert!(table.stderr.contains(&format!("saved {markdown}; docs/HARDWARE.md says where to send it\n")), "{table:?}");
    let report = fs::read_to_string(&markdown).unwrap();
    assert!(report.starts_with("# Examination of a PLC\n\n| | |\n|---|---|\n| fatek | "), "{report}");
    assert!(report.contains("\n## Error codes\n") && !report.contains("127.0.0.1"), "{report}");
    assert!(report.contains("| bad-address | holds | refused with error A | a register beyond all models"), "{report}");

    let csv = quick(&sim, &["--format", "csv", "--report", &json]).stdout;
    assert!(csv.starts_with("group,check,verdict,found,assumed,source\nFraming,frames,holds,"), "{csv}");
    let saved: Value = fs::read_to_string(&json).unwrap().parse().unwrap();
    assert_eq!(saved["checks"].as_array().unwrap().len(), csv.lines().count() - 1);
    assert_eq!(saved["address"], Value::Null);
    assert_eq!(quick(&sim, &["--quiet"]).stderr.lines().filter(|line| !line.starts_with("error:")).count(), 0);
}

#[test]
fn a_written_element_is_restored() {
    let sim = Sim::start(&["--set", "R3000=77", "M100=1"]);
    for (element, checks) in
        [("R3000", &["write-47", "write-49"][..]), ("M100", &["write-45", "write-49", "control-42"])]
    {
        let ran = quick(&sim, &["--write", element, "--yes", "--format", "json"]);
        let holds = names(&document(&ran), "holds");
        assert!(checks.iter().all(|check| holds.iter().any(|name| name == check)), "{element}: {ran:?}");
        assert!(ran.stderr.contains(&format!("writes and restores {element}\n")), "{ran:?}");
    }
    assert_eq!(
        sim.fatek(&["read", "R3000", "M100", "--format", "csv"]).ok(),
        "tag,type,value\nR3000,u16,77\nM100,bool,1\n"
    );
}

#[test]
fn wrong_arguments_send_nothing() {
    let plc = ScriptedPlc::start(|_| Vec::new());
    for (args, rule) in [
        (&["--write", "R3000"][..], "confirmation required, but there is no terminal"),
        (&["--write", "DR100", "--yes"], "give a discrete or a 16-bit register"),
        (&["--write", "R4000", "--yes"], "it is special (R3840-R4167)"),
        (&["--write", "D4053", "--yes"], "the system uses some of D4000-D4095"),
        (&["--write", "WY248", "--yes"], "a word of discretes has 16 elements"),
        (&["--write", "T0", "--yes"], "the PLC sets it"),
        (&["--rate", "0"], "0 is not in 1..=1000"),
        (&["--connections", "17"], "17 is not in 2..=16"),
        (&["--report", "/"], "/"),
    ] {
        let ran = plc.fatek(&[&["doctor"], args].concat());
        assert!([1, 2].contains(&ran.status) && ran.stdout.is_empty(), "{args:?}: {ran:?}");
        assert!(ran.stderr.contains(rule), "{args:?}: {ran:?}");
    }
    assert_eq!(plc.connections(), 0);
    assert!(fatek(&["doctor"]).usage().contains("give --link URL"));
}

#[test]
fn a_plc_that_is_not_there_is_status_4_or_5() {
    let closed = format!("tcp://{}", std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap());
    let ran = fatek(&["--link", &closed, "--station", "1", "doctor"]);
    assert_eq!((ran.status, ran.stdout.as_str()), (5, ""), "{ran:?}");
    let sim = Sim::start(&["--station", "9"]);
    let ran = sim.fatek(&["doctor", "--timeout", "20ms"]);
    assert_eq!((ran.status, ran.stdout.as_str()), (4, ""), "{ran:?}");
    assert!(ran.stderr.contains("hint: "), "{ran:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_contradiction_is_status_7_and_a_plc_that_falls_silent_status_4() {
    let args = &["--station", "1", "doctor", "--quick", "--rate", "1000", "--timeout", "2s", "--format", "json"];
    let ran = examine(Plc::with_model(Model::default().main_unit(7)), Faults::new(1), args).await;
    assert_eq!((ran.status, names(&document(&ran), "contradicts")), (7, vec!["main-unit".to_owned()]), "{ran:?}");
    assert!(ran.stderr.ends_with("assumptions are contradicted\n"), "{ran:?}");

    let silent = Faults::new(1).rule(Rule::new(Fault::Ignore).skip(25));
    let ran = examine(Plc::new(), silent, args).await;
    let found = document(&ran);
    assert_eq!((ran.status, &found["ended_early"]), (4, &"the PLC did not answer any more".into()), "{ran:?}");
    assert!(names(&found, "holds").contains(&"registers-46".to_owned()), "{ran:?}");
    assert!(names(&found, "open").contains(&"bad-checksum".to_owned()), "{ran:?}");
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread")]
async fn ctrl_c_prints_the_result_so_far_and_restores() {
    let plc = Plc::new();
    plc.write(register!("R3000"), 77_u16).unwrap();
    // The value is read before it is written, and not answered any more then.
    let silent = Rule::new(Fault::Ignore).command(Code::ReadRegisters).element(register!("R3000")).skip(1);
    let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(Faults::new(1).rule(silent));
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let url = format!("tcp://{}", server.local_addr());
    let mut command = Command::new(FATEK);
    command.args(["--link", &url, "--station", "1", "doctor", "--quick", "--rate", "1000", "--timeout", "3s"]);
    command.args(["--write", "R3000", "--yes"]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let written = async {
        while plc.read(register!("R3000")) == PlcValue::Word(77) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), written).await.expect("R3000 is written");
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let ran = tokio::task::spawn_blocking(move || child.wait_with_output().unwrap()).await.unwrap();
    let (stdout, stderr) = (String::from_utf8(ran.stdout).unwrap(), String::from_utf8(ran.stderr).unwrap());
    assert_eq!(ran.status.code(), Some(130), "{stderr}");
    assert!(stdout.contains("  holds        registers-46     answered\n"), "{stdout}");
    assert!(stdout.contains("  open         write-47         not examined: ended early\n"), "{stdout}");
    assert!(stderr.ends_with("error: interrupted by SIGINT\n"), "{stderr}");
    assert_eq!(plc.read(register!("R3000")), PlcValue::Word(77), "{stderr}");
    server.shutdown().await;
}

/// Forwards connections to a PLC, and records what the client sends on each of them.
async fn recorder(plc: SocketAddr) -> (String, Arc<Mutex<Vec<Vec<u8>>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("tcp://{}", listener.local_addr().unwrap());
    let recorded = Arc::<Mutex<Vec<Vec<u8>>>>::default();
    let records = recorded.clone();
    tokio::spawn(async move {
        while let Ok((mut client, _)) = listener.accept().await {
            let mut plc = TcpStream::connect(plc).await.unwrap();
            let records = records.clone();
            tokio::spawn(async move {
                let place = {
                    let mut records = records.lock().unwrap();
                    records.push(Vec::new());
                    records.len() - 1
                };
                let ((mut from_client, mut to_client), (mut from_plc, mut to_plc)) = (client.split(), plc.split());
                let requests = async {
                    let mut buffer = [0; 1024];
                    while let Ok(len @ 1..) = from_client.read(&mut buffer).await {
                        records.lock().unwrap()[place].extend(&buffer[..len]);
                        to_plc.write_all(&buffer[..len]).await.unwrap();
                    }
                };
                tokio::select! { () = requests => {}, _ = tokio::io::copy(&mut from_plc, &mut to_client) => {} }
            });
        }
    });
    (url, recorded)
}

/// The command of each frame that an examination sends, of wrong requests as well.
#[tokio::test(flavor = "multi_thread")]
async fn only_reads_are_sent() {
    let faults = Faults::new(1);
    let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_faults(faults.clone());
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let (url, recorded) = recorder(server.local_addr()).await;
    let args = ["--station", "1", "doctor", "--rate", "1000", "--connections", "2"];
    let ran = tokio::task::spawn_blocking(move || fatek(&[&["--link", &url], &args[..]].concat())).await.unwrap();
    assert!([0, 7].contains(&ran.status), "{ran:?}");
    assert_eq!(faults.log().writes(), 0);
    let reads: [&[u8]; 8] = [b"40", b"43", b"44", b"46", b"48", b"4E", b"4F", b"53"];
    let recorded = recorded.lock().unwrap().clone();
    // No data has an ETX.
    let frames: Vec<&[u8]> = recorded.iter().flat_map(|bytes| bytes.split_inclusive(|&byte| byte == 3)).collect();
    let is_read = |frame: &&[u8]| frame[0] == 2 && reads.contains(&&frame[3..5]);
    assert!(recorded.len() > 1 && frames.len() > 200, "{}", frames.len());
    assert_eq!(frames.iter().find(|frame| !is_read(frame)), None);
    server.shutdown().await;
}
