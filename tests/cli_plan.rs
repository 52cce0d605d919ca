//! `fatek plan`: its output for each line and limit. It sends nothing.
#![cfg(feature = "cli")]

mod process;

use std::time::Duration;

use fatek::endpoint::SerialSettings;
use fatek::wire::Framing;
use fatek::{CostModel, Limits, Plan};
use process::{Output, ScriptedPlc, ascii, fatek};

const TAGS: [&str; 6] = ["R0-R9", "R12:f32", "R900", "D7", "M3", "R20-R29:text"];

fn plan(args: &[&str]) -> Output {
    fatek(&[&["plan"], &TAGS[..], args].concat())
}

/// The library's explanation of the same plan.
fn explained(cost: CostModel, limits: Limits) -> String {
    let plan = Plan::builder(cost).limits(limits).tags(TAGS.map(|tag| tag.parse().unwrap())).build().unwrap();
    format!("{}\n", plan.explain())
}

#[test]
fn the_plan_equals_that_of_the_library() {
    let (ascii, binary) = (Framing::Ascii, Framing::Binary);
    let ms = Duration::from_millis;
    let slow = SerialSettings::new(ascii);
    let fast = SerialSettings::new(ascii).with_baud(115_200).unwrap();
    let limits = Limits::new;
    for (args, cost, limits) in [
        (&[][..], CostModel::network(ascii, ms(5)), limits()),
        (&["--round-trip", "12ms"], CostModel::network(ascii, ms(12)), limits()),
        (&["--framing", "binary"], CostModel::network(binary, ms(5)), limits()),
        (&["--link", "tcp://192.0.2.1:500?framing=binary"], CostModel::network(binary, ms(5)), limits()),
        (&["--link", "udp://192.0.2.1", "--round-trip", "1ms"], CostModel::network(ascii, ms(1)), limits()),
        (&["--baud", "9600"], CostModel::serial(slow, ascii), limits()),
        (&["--link", "tcp://192.0.2.1", "--baud", "115200"], CostModel::serial(fast, ascii), limits()),
        (&["--link", "serial:/dev/nowhere?baud=115200"], CostModel::serial(fast, ascii), limits()),
        (&["--link", "serial:/dev/nowhere", "--baud", "115200"], CostModel::serial(fast, ascii), limits()),
        (
            &["--baud", "9600", "--round-trip", "30ms"],
            CostModel::serial(slow, ascii).with_response_time(ms(30)),
            limits(),
        ),
        // The second and the third were priced as the default before.
        (
            &["--link", "tcp://192.0.2.1?copies=2", "--no-mixed"],
            CostModel::network(ascii, ms(5)),
            limits().mixed_reads(false),
        ),
        (
            &["--link", "tcp://192.0.2.1?copies=0", "--no-mixed"],
            CostModel::network(ascii, ms(5)).with_proofs(false),
            limits().mixed_reads(false),
        ),
        (
            &["--link", "tcp://192.0.2.1?one_request=true&quiet=700ms", "--no-mixed"],
            CostModel::network(ascii, ms(5)).with_overhead(ms(700)).with_proofs(false),
            limits().mixed_reads(false),
        ),
        (&["--no-mixed"], CostModel::network(ascii, ms(5)), limits().mixed_reads(false)),
        (&["--max-registers", "10"], CostModel::network(ascii, ms(5)), limits().max_registers(10).unwrap()),
        (&["--max-points", "8"], CostModel::network(ascii, ms(5)), limits().max_points(8).unwrap()),
        (&["--max-mixed", "16"], CostModel::network(ascii, ms(5)), limits().max_mixed(16).unwrap()),
        (
            &["--no-mixed", "--readable", "R0-R15", "--readable", "R20-R3839"],
            CostModel::network(ascii, ms(5)),
            limits()
                .mixed_reads(false)
                .readable(fatek::element!("R0"), fatek::element!("R15"))
                .and_then(|limits| limits.readable(fatek::element!("R20"), fatek::element!("R3839")))
                .unwrap(),
        ),
    ] {
        assert_eq!(plan(args).ok(), explained(cost, limits), "{args:?}");
    }
}

#[test]
fn json_and_csv_list_the_tags_of_each_request() {
    let json: serde_json::Value = plan(&["--no-mixed", "--format", "json"]).ok().parse().unwrap();
    let requests = json["requests"].as_array().unwrap();
    let tags = |request: &serde_json::Value| request["tags"].as_array().unwrap().clone();
    assert_eq!(requests.iter().flat_map(tags).count(), TAGS.len());
    let text = requests.iter().find(|request| tags(request).contains(&"R20-R29:text".into())).unwrap();
    assert!(text["reads"].as_str().unwrap().starts_with("46 R0-R29"), "{text}");
    assert_eq!(json["values"], 15);
    let sum = |key: &str| requests.iter().map(|request| request[key].as_f64().unwrap()).sum::<f64>();
    assert_eq!(json["bytes"].as_f64(), Some(sum("bytes")));
    assert!((json["time_ms"].as_f64().unwrap() - sum("time_ms")).abs() < 0.01);
    assert_eq!(json["proofs_ms"], 0.0);
    let proven: serde_json::Value =
        fatek(&["plan", "R0", "R500", "R1000", "--no-mixed", "--format", "json"]).ok().parse().unwrap();
    let requests = proven["requests"].as_array().unwrap();
    let time: f64 = requests.iter().map(|request| request["time_ms"].as_f64().unwrap()).sum();
    let proofs = proven["proofs_ms"].as_f64().unwrap();
    assert!(proofs > 15.0 && (proven["time_ms"].as_f64().unwrap() - time - proofs).abs() < 0.01, "{proven}");
    let csv = plan(&["--no-mixed", "--format", "csv"]).ok();
    assert!(csv.starts_with("request,values,bytes,time_ms,reads,tags\n1,"), "{csv}");
    assert!(csv.contains("46 R0-R29,R0-R9 R12:f32 R20-R29:text\n"), "{csv}");
}

#[test]
fn an_impossible_plan_is_a_usage_error_and_sends_nothing() {
    let plc = ScriptedPlc::start(|_| ascii("01460ABCD"));
    for (args, error) in [
        (&["R0", "Q0"][..], "`Q0` is not a tag"),
        (&[], "no tag is given"),
        (&["R0", "--max-registers", "65"], "max_registers is 65, and must be 2 to 64"),
        (&["R0", "--max-points", "0"], "max_points is 0, and must be 1 to 256"),
        (&["R0", "--baud", "0"], "--baud 0: "),
        (&["R0", "--readable", "DR0-DR10"], "DR0 to DR10 is not a range"),
        (&["R0", "--readable", "R5-R9"], "R0 of the tag R0 is not in a readable range"),
        (&["R0", "--max-mixed", "4", "--no-mixed"], "cannot be used with"),
        (&["R0-R64", "--one-scan"], "R0-R64 must come from one scan, but no single request can read that"),
        (&["R0-R9:text", "--no-mixed", "--max-registers", "8"], "R0-R9:text must come from one scan"),
        (&["R0", "--link", "http://plc"], "`http://plc` is not an endpoint"),
    ] {
        let usage = fatek(&[&["--link", &plc.url, "plan"], args].concat()).usage();
        assert!(usage.contains(error), "{args:?} should say: {error}\n{usage}");
    }
    fatek(&["--link", &plc.url, "plan", "R0-R99", "M0", "--one-scan"]).usage();
    fatek(&["--link", &plc.url, "plan", "R0-R9", "M0", "--one-scan"]).ok();
    assert_eq!((plc.connections(), plc.received()), (0, vec![]));
}

#[test]
fn words_of_discretes_are_shown_with_the_tags_in_them() {
    let csv = fatek(&["plan", "M0-M255", "M7", "--baud", "9600", "--format", "csv"]).ok();
    assert!(csv.ends_with(",46 WM0-WM240,M0-M255 M7\n"), "{csv}");
    let table = fatek(&["plan", "M0-M255", "--baud", "9600"]).ok();
    assert!(table.contains("  46 WM0-WM240\n"), "{table}");
}
