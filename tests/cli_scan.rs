//! `fatek scan` as a process, on buses with good and faulty stations.
#![cfg(feature = "cli")]

mod process;

use std::time::Duration;

use fatek::ErrorCode;
use fatek::command::Code;
use fatek::sim::{Bus, Fault, Faults, Model, Plc, Rule, Server};
use fatek::wire::Framing;
use process::{Output, ScriptedPlc, Sim, ascii, fatek};
use serde_json::{Value, json};

fn scan(url: &str, args: &[&str]) -> Output {
    fatek(&[&["--link", url, "scan", "--timeout", "300ms"], args].concat())
}

fn documents(ran: &Output) -> Vec<Value> {
    ran.stdout.parse::<Value>().unwrap().as_array().unwrap().clone()
}

#[test]
fn stations_are_found_in_both_framings_and_all_formats() {
    for framing in ["ascii", "binary"] {
        let sim = Sim::start(&["--framing", framing, "--station", "1", "--station", "3", "--station", "6"]);
        fatek(&["--link", &sim.url, "--station", "3", "run"]).ok();
        let found = scan(&sim.url, &["1-6", "--format", "json"]);
        assert!(found.stderr.ends_with("6 stations scanned, 3 answered, 0 with bad replies\n"), "{found:?}");
        let found: Vec<Value> = documents(&found);
        let what = |key: &str| found.iter().map(|found| found[key].clone()).collect::<Vec<_>>();
        assert_eq!(what("station"), [1, 3, 6]);
        assert_eq!(what("answer"), ["ok", "ok", "ok"]);
        assert_eq!(what("running"), [false, true, false]);
        assert_eq!(what("note"), [Value::Null, Value::Null, Value::Null]);
        assert!(what("time_ms").iter().all(|time| time.as_f64().is_some_and(|time| time > 0.0 && time < 300.0)));
        let csv = scan(&sim.url, &["3", "--format", "csv"]).ok();
        assert!(
            csv.starts_with("station,answer,running,main_unit,os_version,time_ms,note\n3,ok,true,MC,3.1,"),
            "{csv}"
        );
        let table = scan(&sim.url, &["1-3"]).ok();
        assert!(table.starts_with("STATION  ANSWER  RUNNING  MAIN_UNIT  OS_VERSION"), "{table}");
        assert_eq!(table.lines().count(), 3);
    }
}

#[test]
fn without_a_terminal_results_are_printed_line_by_line() {
    let sim = Sim::start(&["--station", "2", "--station", "4"]);
    let found = scan(&sim.url, &["1-4"]);
    assert_eq!(found.stderr, "station 2: ok\nstation 4: ok\n4 stations scanned, 2 answered, 0 with bad replies\n");
    assert_eq!(scan(&sim.url, &["1-4", "--quiet"]).stderr, "");
}

#[test]
fn no_reply_at_all_is_status_4() {
    let sim = Sim::start(&["--station", "9"]);
    let found = scan(&sim.url, &["2-4", "--format", "json"]);
    assert_eq!((found.status, found.stdout.as_str()), (4, "[]\n"), "{found:?}");
    assert!(found.stderr.contains("error: none of 3 stations answered\nhint: "), "{found:?}");
    assert_eq!(scan(&sim.url, &["8"]).status, 4);
    // By default all stations are scanned.
    let all = fatek(&["--link", &sim.url, "scan", "--timeout", "5ms"]);
    assert!(all.stderr.contains("254 stations scanned, "), "{all:?}");
}

#[test]
fn no_connection_is_status_5() {
    let closed = format!("tcp://{}", std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap());
    assert_eq!(scan(&closed, &["1-3"]).status, 5);
}

#[test]
fn invalid_arguments_send_nothing() {
    let plc = ScriptedPlc::start(|_| ascii("01400010000"));
    let rule = "expected a station or a range of stations from 1 to 254, such as 5 or 1-16";
    for range in ["0", "0-9", "1-255", "9-1", "1-", "-", "+1", "1-2-3", "a", "1–9", "999"] {
        let usage = scan(&plc.url, &["--", range]).usage();
        assert!(usage.contains(rule), "{range}: {usage}");
    }
    assert!(fatek(&["scan"]).usage().contains("give --link URL, or set FATEK_LINK"));
    assert!(scan(&plc.url, &["--retries", "11"]).usage().contains("11 is not in 0..=10"));
    assert_eq!((plc.connections(), plc.received()), (0, vec![]));
}

#[tokio::test(flavor = "multi_thread")]
async fn each_kind_of_bad_reply_is_reported_with_status_6() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let faults = Faults::new(7);
        let mut bus = Bus::new();
        for station in 1..=8 {
            bus = bus.with_station(station, Plc::with_model(Model::default())).unwrap();
        }
        let rule = |station, fault| Rule::new(fault).station(station);
        faults.set_rules([
            rule(2, Fault::BadChecksum),
            rule(3, Fault::duplicate()),
            rule(4, Fault::GarbageBefore { max_len: 5 }),
            rule(5, Fault::Error(ErrorCode::IllegalFormat)),
            rule(6, Fault::Delay { min: Duration::from_millis(450), max: Duration::from_millis(450) }),
            rule(7, Fault::WrongCommand).times(1),
            rule(8, Fault::Ignore).command(Code::ReadDetailedStatus),
        ]);
        let bus = bus.with_faults(faults.clone());
        let server = Server::bind("127.0.0.1:0", bus, framing).await.unwrap();
        let url = format!("tcp://{}?framing={framing}", server.local_addr());
        let found = tokio::task::spawn_blocking(move || scan(&url, &["1-9", "--format", "json"])).await.unwrap();
        assert_eq!(found.status, 6, "{found:?}");
        assert!(
            found
                .stderr
                .ends_with("9 stations scanned, 8 answered, 5 with bad replies\nerror: stations with bad replies: 5\n"),
            "{found:?}"
        );
        let found = documents(&found);
        let what = |key: &str| found.iter().map(|found| found[key].clone()).collect::<Vec<_>>();
        assert_eq!(what("station"), [1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!(what("answer"), ["ok", "bad", "bad", "bad", "refused", "late", "bad", "ok"], "{found:#?}");
        let note = |station: usize| found[station - 1]["note"].as_str().unwrap_or_default().to_owned();
        assert_eq!(found[0]["note"], Value::Null);
        assert!(note(2).contains("read brief status (40h): "), "{}", note(2));
        assert!(note(3).contains("; second station with this number?"), "{}", note(3));
        assert!(note(4).contains("garbage: "), "{}", note(4));
        assert!(note(5).contains("read brief status (40h): illegal format"), "{}", note(5));
        assert!(note(6).contains("frames after the timeout: "), "{}", note(6));
        assert!(note(7).contains("a reply to command"), "{}", note(7));
        assert!(note(8).contains("did not answer read detailed status (53h)"), "{}", note(8));
        assert_eq!((&found[7]["running"], &found[7]["main_unit"]), (&json!(false), &Value::Null));

        // Stations are scanned in order, and never the broadcast address.
        let scanned: Vec<u8> = faults.log().entries().iter().map(|entry| entry.station().unwrap()).collect();
        assert!(scanned.is_sorted() && scanned.first() == Some(&1) && scanned.last() == Some(&9), "{scanned:?}");
        server.shutdown().await;
    }
}
