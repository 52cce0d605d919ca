//! `fatek` as a process, against `fatek sim` as another process.
#![cfg(feature = "cli")]

mod process;

use std::io::Read;
use std::net::TcpListener;
use std::process::{Command, Stdio};

use process::{FATEK, Folder, ScriptedPlc, Sim, ascii, fatek, run};

const FRAMINGS: [&str; 2] = ["ascii", "binary"];

#[test]
fn values_are_read_in_both_framings_and_all_formats() {
    for framing in FRAMINGS {
        let sim =
            Sim::start(&["--framing", framing, "--set", "R0=5", "R1:i16=-2", "--set", "R100:f32=0.1", "M0-M2=1,0,1"]);
        let table = sim.fatek(&["read", "R0", "R1:i16", "R100:f32", "DR100:f32", "WM0:hex", "M0-M2"]).ok();
        assert_eq!(
            table,
            "TAG    TYPE  VALUE\nR0     u16   5\nR1     i16   -2\nR100   f32   0.1\nDR100  f32   0.1\nWM0    hex   0x0005\n\
             M0     bool  1\nM1     bool  0\nM2     bool  1\n"
        );
        let csv = sim.fatek(&["read", "R0-R1", "M0", "--format", "csv"]).ok();
        assert_eq!(csv, "tag,type,value\nR0,u16,5\nR1,u16,65534\nM0,bool,1\n");
        let json = sim.fatek(&["--format", "json", "read", "R0-R1", "M0", "R100:f32", "R0:hex"]).ok();
        let expected = serde_json::json!([
            { "tag": "R0", "type": "u16", "value": 5 },
            { "tag": "R1", "type": "u16", "value": 65534 },
            { "tag": "M0", "type": "bool", "value": true },
            { "tag": "R100", "type": "f32", "value": 0.1 },
            { "tag": "R0", "type": "hex", "value": "0x0005" },
        ]);
        assert_eq!(json.parse::<serde_json::Value>().unwrap(), expected);
    }
}

#[test]
fn written_values_are_read_back_in_both_framings() {
    for framing in FRAMINGS {
        let sim = Sim::start(&["--framing", framing]);
        let written = [
            "R5:i16=-7",
            "R100:f32=-500.125",
            "DR2:i32=-100000",
            "D0-D2=1,2,3",
            "Y0-Y2=on,off,true",
            "WM0:hex=0xAAAA",
            "R200-R203:u32=4294967295,7",
            "DWM32=4026531841",
            "R300:f32=nan",
            "R302:f32=-inf",
            "RT0=12",
            "RC1=0x00FF",
        ];
        let done = sim.fatek(&[&["write"][..], &written].concat());
        assert_eq!(done.stdout, "", "data only");
        assert!(done.stderr.contains("wrote R100:f32=-500.125\n"), "{done:?}");
        done.ok();
        let tags = written.map(|assignment| assignment.split('=').next().unwrap());
        let read = sim.fatek(&[&["read", "--format", "csv"][..], &tags].concat()).ok();
        let values: Vec<_> = read.lines().skip(1).map(|line| line.rsplit(',').next().unwrap()).collect();
        assert_eq!(
            values,
            [
                "-7",
                "-500.125",
                "-100000",
                "1",
                "2",
                "3",
                "1",
                "0",
                "1",
                "0xAAAA",
                "4294967295",
                "7",
                "4026531841",
                "NaN",
                "-inf",
                "12",
                "255",
            ]
        );
        // Low word first.
        assert_eq!(
            sim.fatek(&["read", "R100-R101:hex", "--format", "csv"]).ok(),
            "tag,type,value\nR100,hex,0x1000\nR101,hex,0xC3FA\n"
        );
        let json: serde_json::Value = sim.fatek(&["read", "R300-R303:f32", "--format=json"]).ok().parse().unwrap();
        assert_eq!((&json[0]["value"], &json[1]["value"]), (&"NaN".into(), &"-inf".into()));
        assert_eq!(sim.fatek(&["-q", "write", "R0=1"]).stderr, "");
    }
}

#[test]
fn scaled_values_and_texts_are_read_and_written_in_all_formats() {
    for framing in FRAMINGS {
        let sim = Sim::start(&["--framing", framing, "--set", "R0-R2:text=\"a,\\\"b\\n\"", "R9:i16*0.1-40=-50.3"]);
        let written =
            ["R5-R6:u16*0.01=1.23,655.35", "D0:f32*0.5=0.05", "R10-R12:text-hi=two wo", "R20-R29:text=\"\\x1B é\""];
        let done = sim.fatek(&[&["write"][..], &written].concat());
        assert!(done.stderr.contains("wrote R10-R12:text-hi=\"two wo\"\n"), "{done:?}");
        done.ok();
        let tags = ["R0-R2:text", "R9:i16*0.1-40", "R5-R6:u16*0.01", "D0:f32*0.5", "R10-R12:text-hi", "R20-R29:text"];
        let read = |format| sim.fatek(&[&["read", "--format", format][..], &tags].concat()).ok();
        assert_eq!(
            read("table"),
            "TAG      TYPE        VALUE\nR0-R2    text        \"a,\\\"b\\n\"\nR9       i16*0.1-40  -50.3\n\
             R5       u16*0.01    1.23\nR6       u16*0.01    655.35\nD0       f32*0.5     0.05\n\
             R10-R12  text-hi     \"two wo\"\nR20-R29  text        \"\\x1B é\"\n"
        );
        assert_eq!(
            read("csv"),
            "tag,type,value\nR0-R2,text,\"a,\"\"b\n\"\nR9,i16*0.1-40,-50.3\nR5,u16*0.01,1.23\nR6,u16*0.01,655.35\n\
             D0,f32*0.5,0.05\nR10-R12,text-hi,two wo\nR20-R29,text,\u{1b} é\n"
        );
        let json: serde_json::Value = read("json").parse().unwrap();
        let values: Vec<_> = json.as_array().unwrap().iter().map(|row| row["value"].clone()).collect();
        let expected = serde_json::json!(["a,\"b\n", -50.3, 1.23, 655.35, 0.05, "two wo", "\u{1b} é"]);
        assert_eq!(serde_json::Value::from(values), expected);
        assert_eq!((&json[0]["tag"], &json[1]["type"]), (&"R0-R2".into(), &"i16*0.1-40".into()));
    }
}

#[test]
fn ranges_longer_than_a_request_are_read_and_written() {
    let sim = Sim::start(&[]);
    let values = |from: u32, to: u32| (from..=to).map(|n| n.to_string()).collect::<Vec<_>>().join(",");
    let states = (0..300).map(|n| if n % 3 == 0 { "1" } else { "0" }).collect::<Vec<_>>().join(",");
    let words = format!("R0-R199={}", values(1, 200));
    let pairs = format!("R1001-R1200:u32={}", values(70_001, 70_100));
    let doubles = format!("DR3000-DR3198={}", values(80_001, 80_100));
    sim.fatek(&["write", &words, &pairs, &doubles, &format!("M0-M299={states}")]).ok();
    for (tag, expected) in [
        ("R0-R199", values(1, 200)),
        ("R1001-R1200:u32", values(70_001, 70_100)),
        ("DR3000-DR3198", values(80_001, 80_100)),
        ("R3000-R3199:u32", values(80_001, 80_100)),
        ("M0-M299", states),
    ] {
        let read = sim.fatek(&["read", tag, "--format", "csv"]).ok();
        let values: Vec<_> = read.lines().skip(1).map(|line| line.rsplit(',').next().unwrap()).collect();
        assert_eq!(values.join(","), expected, "{tag}");
    }
}

#[test]
fn a_plc_is_started_stopped_and_forced() {
    for framing in FRAMINGS {
        let sim = Sim::start(&["--framing", framing]);
        let is_running = || {
            let status: serde_json::Value = sim.fatek(&["status", "--format", "json"]).ok().parse().unwrap();
            assert_eq!(status["detailed"]["ladder_words"], 13184);
            status["brief"]["running"].as_bool().unwrap()
        };
        assert!(!is_running());
        assert_eq!(sim.fatek(&["run"]).ok(), "");
        assert!(is_running());
        assert_eq!(sim.fatek(&["stop"]).ok(), "");
        assert!(!is_running());
        let states = || sim.fatek(&["read", "X0-X1", "M5", "--format", "csv"]).ok();
        sim.fatek(&["disable", "X0", "X1"]).ok();
        sim.fatek(&["set", "X0", "X1", "M5"]).ok();
        sim.fatek(&["reset", "X1"]).ok();
        assert_eq!(states(), "tag,type,value\nX0,bool,1\nX1,bool,0\nM5,bool,1\n");
        let enabled = sim.fatek(&["enable", "X0"]);
        assert!(enabled.stderr.contains("enable X0: done"), "{enabled:?}");
        enabled.ok();
    }
}

#[test]
fn status_is_printed_even_without_the_detailed_one() {
    let sim = Sim::start(&["--ladder-words", "8192"]);
    let table = sim.fatek(&["status"]).ok();
    assert!(table.contains("brief     running                false\n"), "{table}");
    assert!(table.contains("detailed  ladder_words           8192\n"), "{table}");
    assert!(sim.fatek(&["status", "--format", "csv"]).ok().contains("detailed,ladder_words,8192\n"));

    let old = ScriptedPlc::start(|request| match &request[3..5] {
        b"40" => ascii("01400010000"),
        _ => ascii("01534"),
    });
    let status = old.fatek(&["status", "--format", "json"]);
    assert!(status.stderr.contains("no detailed status: station 1 refused"), "{status:?}");
    let json: serde_json::Value = status.ok().parse().unwrap();
    assert_eq!((&json["brief"]["running"], &json["detailed"]), (&true.into(), &serde_json::Value::Null));
}

#[test]
fn simulated_stations_have_their_own_memory() {
    let sim = Sim::start(&["--station", "1", "--station", "2", "--set", "R0=5"]);
    fatek(&["--link", &sim.url, "--station", "2", "write", "R0=6"]).ok();
    for (station, value) in [("1", "5"), ("2", "6")] {
        let read = fatek(&["--link", &sim.url, "--station", station, "read", "R0", "--format", "csv"]).ok();
        assert_eq!(read, format!("tag,type,value\nR0,u16,{value}\n"));
    }
}

#[test]
#[cfg(unix)]
fn a_simulator_serves_until_it_is_signalled() {
    let mut sim = Sim::start(&["--listen", "tcp://127.0.0.1:0"]);
    assert!(sim.url.starts_with("tcp://127.0.0.1:"), "{}", sim.url);
    sim.fatek(&["read", "R0"]).ok();
    Command::new("kill").arg(sim.child.id().to_string()).status().unwrap();
    assert_eq!(sim.child.wait().unwrap().code(), Some(0));
    let mut rest = String::new();
    sim.stdout.read_to_string(&mut rest).unwrap();
    assert_eq!(rest, "");
    assert_eq!(sim.fatek(&["read", "R0"]).status, 5);
}

#[test]
fn the_environment_sets_the_defaults() {
    let sim = Sim::start(&["--station", "7", "--set", "R0=5"]);
    let with = |link: &str, station: &str, args: &[&str]| {
        run(Command::new(FATEK).args(args).env("FATEK_LINK", link).env("FATEK_STATION", station))
    };
    with(&sim.url, "7", &["read", "R0"]).ok();
    // Options take precedence, before and after the subcommand.
    with("tcp://127.0.0.1:1", "9", &["--link", &sim.url, "read", "--station", "7", "R0"]).ok();
    with("tcp://127.0.0.1:1", "9", &["read", "R0", "--station", "7", "--link", &sim.url]).ok();
    with(&sim.url, "9", &["--station", "8", "read", "R0", "--station", "7"]).ok();
    assert!(with("", "1", &["read", "R0"]).usage().contains("give --link URL, or set FATEK_LINK"));
    assert!(with(&sim.url, "", &["read", "R0"]).usage().contains("give --station N, or set FATEK_STATION"));
    assert!(with(&sim.url, "seven", &["read", "R0"]).usage().contains("`seven` is not a station"));
    with("nonsense", "nonsense", &["decode", "02 30 31 34 30 43 37 03"]).ok();
}

#[test]
fn an_error_of_the_plc_is_status_3() {
    for framing in FRAMINGS {
        let sim = Sim::start(&["--framing", framing, "--last", "R100"]);
        let refused = sim.fatek(&["read", "R101"]);
        assert_eq!((refused.status, refused.stdout.as_str()), (3, ""));
        assert_eq!(refused.stderr, "error: R101: station 1 refused read registers (46h): illegal address (A)\n");
        assert_eq!(sim.fatek(&["write", "R100:f32=1"]).status, 3);
        sim.fatek(&["read", "R100"]).ok();
    }
}

#[test]
fn the_memory_map_of_a_model_is_checked_first() {
    let sim = Sim::start(&["--model", "largest", "--set", "R4168=7"]);
    sim.fatek(&["read", "R4168"]).ok();
    for args in [
        &["read", "R0", "R4167-R4168", "--model", "fbs-20mc"][..],
        &["write", "R0=1", "R4168=1", "--model", "fbs-20mc"],
        &["watch", "R4168", "--count", "1", "--model", "fbs-20mc"],
        &["backup", "unused.backup", "R4000-R5000", "--model", "fbs-20mc"],
    ] {
        let ran = sim.fatek(args);
        assert_eq!(ran.status, 2, "{ran:?}");
        assert!(
            ran.stderr.contains("R4168 is not in the memory map of an FBS-20MC, which has R0-R4167 R5000-"),
            "{ran:?}"
        );
    }
    sim.fatek(&["read", "R0", "--model", "auto"]).ok();
    let counted = sim.fatek(&["read", "D3072", "--model", "auto"]);
    assert_eq!(counted.status, 2, "{counted:?}");
    assert!(counted.stderr.contains("D3072 is not in the memory map of this PLC by its status (53)"), "{counted:?}");
    let unknown = sim.fatek(&["read", "R0", "--model", "m-1"]).usage();
    assert!(unknown.contains("`m-1` is not a known model (known: fbe-28mc fbs-20mc)"), "{unknown}");
}

#[test]
fn the_simulator_has_the_memory_of_a_model() {
    let sim = Sim::start(&[]);
    assert_eq!(sim.fatek(&["read", "R4160-R5010"]).status, 3);
    assert_eq!(sim.fatek(&["read", "D3072"]).status, 3);
    let newer = Sim::start(&["--model", "FBS-20MC"]);
    newer.fatek(&["read", "D3072", "R4160-R4167", "R5000-R5010"]).ok();
    assert!(newer.fatek(&["status"]).ok().contains("32768"));
}

#[test]
fn special_elements_are_written_only_with_the_option() {
    let sim = Sim::start(&[]);
    for args in [&["write", "R0=1", "R3840=1"][..], &["write", "DR3839=1"], &["set", "M0", "M1912"]] {
        let ran = sim.fatek(args);
        assert_eq!(ran.status, 2, "{ran:?}");
        assert!(ran.stderr.contains("give --special"), "{ran:?}");
    }
    let read = sim.fatek(&["read", "R0", "M0", "--format", "csv"]).ok();
    assert_eq!(read, "tag,type,value\nR0,u16,0\nM0,bool,0\n");
    sim.fatek(&["write", "R3840=1", "--special"]).ok();
    sim.fatek(&["set", "M1912", "--special"]).ok();
    let read = sim.fatek(&["read", "R3840", "M1912", "--format", "csv"]).ok();
    assert_eq!(read, "tag,type,value\nR3840,u16,1\nM1912,bool,1\n");
}

#[test]
fn a_probe_prints_what_the_plc_supports() {
    let sim = Sim::start(&[]);
    let table = sim.fatek(&["probe", "--format", "csv"]).ok();
    for row in [
        "48 mixed read,supported",
        "45 write discretes,unknown",
        "words of M,multiples of 8",
        "registers in one request,64",
        "discretes in one request,256",
        "step of DRC in a run,unknown",
    ] {
        assert!(table.lines().any(|line| line == row), "{row}: {table}");
    }
    let json: serde_json::Value = sim.fatek(&["probe", "--format", "json"]).ok().parse().unwrap();
    assert_eq!((&json["commands"]["4E"], &json["max_mixed"]), (&"supported".into(), &64.into()));
}

/// A file of `probe` is taken by the other commands, and a bad one is refused before anything is sent.
#[test]
fn capabilities_of_a_file_are_kept_to() {
    let (sim, folder) = (Sim::start(&[]), Folder::new("capabilities"));
    let (found, low, bad) = (folder.file("found.json"), folder.file("low.json"), folder.file("bad.json"));
    std::fs::write(&found, sim.fatek(&["probe", "--format", "json"]).ok()).unwrap();
    sim.fatek(&["--capabilities", &found, "read", "R0-R99"]).ok();
    std::fs::write(&low, r#"{"max_registers": 10, "commands": {"48": "refused"}}"#).unwrap();
    let reads = |args: &[&str]| fatek(&[&["plan", "--format", "csv"], args].concat()).ok().lines().count() - 1;
    // Four, because two of one length in succession need a check in between.
    assert_eq!((reads(&["R0-R29"]), reads(&["R0-R29", "--capabilities", &low])), (1, 4));
    sim.fatek(&["read", "R0-R29", "--capabilities", &low]).ok();
    std::fs::write(&bad, r#"{"max_registers": 65}"#).unwrap();
    let ran = sim.fatek(&["read", "R0", "--capabilities", &bad]);
    assert!(ran.stderr.contains("bad.json: max_registers is 65, and must be 2 to 64"), "{ran:?}");
    assert_eq!((ran.status, ran.stdout.as_str()), (2, ""));
}

#[test]
fn a_plan_keeps_to_a_model_and_reads_no_words_if_told() {
    let plan = |args: &[&str]| fatek(&[&["plan", "--format", "csv"], args].concat());
    assert!(plan(&["M0-M255"]).ok().contains("46 WM0-WM240"));
    assert!(plan(&["M0-M255", "--no-words"]).ok().contains("44 M0-M255"));
    let ran = plan(&["R4160-R4170", "--model", "fbs-20mc"]);
    assert_eq!(ran.status, 2, "{ran:?}");
    assert!(ran.stderr.contains("R4168"), "{ran:?}");
    // R4168 to R4999 are not read through.
    assert_eq!(plan(&["R4167", "R5000", "--model", "fbs-20mc", "--no-mixed"]).ok().lines().count(), 3);
    let bits = plan(&["R0", "--readable", "R5.3"]);
    assert!(bits.stderr.contains("--readable R5.3: a range has whole registers"), "{bits:?}");
}

#[test]
fn the_clock_of_a_plc_without_one_is_status_3() {
    let sim = Sim::start(&[]);
    let ran = sim.fatek(&["clock"]);
    assert_eq!((ran.status, ran.stderr.as_str()), (3, "error: station 1: the PLC has no clock: M1954 is 0\n"));
    let bad = sim.fatek(&["clock", "--set", "noon"]);
    assert!(bad.stderr.contains("`noon` is not a time such as 2026-11-29T06:30:00"), "{bad:?}");
    assert_eq!(bad.status, 2);
}

#[test]
fn no_reply_is_status_4() {
    let sim = Sim::start(&[]);
    let absent = fatek(&["--link", &sim.url, "--station", "9", "--timeout", "100ms", "read", "R0"]);
    assert_eq!((absent.status, absent.stdout.as_str()), (4, ""), "{absent:?}");
    assert!(
        absent.stderr.starts_with("error: R0: station 9 did not answer the check before read registers (46h)"),
        "{absent:?}"
    );
    let absent = fatek(&["--link", &sim.url, "--station", "9", "--timeout", "100ms", "write", "R0=1"]);
    assert_eq!(absent.status, 4, "{absent:?}");
    // Even the check was not answered.
    assert!(
        absent.stderr.starts_with("error: R0: station 9 did not answer the check before write registers (47h)"),
        "{absent:?}"
    );
    assert!(absent.stderr.contains("the request was not sent"), "{absent:?}");
    let silent = ScriptedPlc::start(|_| Vec::new());
    let unanswered = silent.fatek(&["--timeout", "100ms", "write", "R0=1"]);
    assert_eq!(unanswered.status, 4, "{unanswered:?}");
    assert!(unanswered.stderr.contains("R0 (it may have been written): "), "{unanswered:?}");
}

#[test]
fn no_connection_is_status_5() {
    let closed = {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        format!("tcp://{}", listener.local_addr().unwrap())
    };
    let refused = fatek(&["--link", &closed, "--station", "1", "read", "R0"]);
    assert_eq!((refused.status, refused.stdout.as_str()), (5, ""), "{refused:?}");
    assert!(refused.stderr.contains(&format!("cannot connect to {closed}")), "{refused:?}");
    assert_eq!(fatek(&["--link", &closed, "--station", "1", "ping", "-c", "2"]).status, 5);
}

#[test]
fn a_bad_reply_is_status_6() {
    // Good frame, station and command, but one word too few.
    let too_short = ScriptedPlc::start(|_| ascii("01460ABCD"));
    let read = too_short.fatek(&["--timeout", "200ms", "read", "R0-R1"]);
    assert_eq!((read.status, read.stdout.as_str()), (6, ""), "{read:?}");
    assert!(read.stderr.contains("gave no usable reply to read registers (46h)"), "{read:?}");
}

#[test]
fn invalid_arguments_send_nothing() {
    let plc = ScriptedPlc::start(|_| ascii("01460ABCD"));
    let link = plc.url.as_str();
    for (args, error) in [
        (&["read", "R0", "Q0"][..], "`Q0` is not a tag: no element has these letters"),
        (&["read", "R0", "R65536"], "`R65536` is not a tag: R65536 is past the last address, R65535"),
        (&["read", "R0-R8:f32"], "`R0-R8:f32` is not a tag: a value of f32 takes 2 elements, and the range has 9"),
        (&["read", "R0:bool"], "R is a 16-bit register, which has no type bool"),
        (&["read", "WM4"], "the address of WM must be a multiple of 8"),
        (&["read"], "no tag is given"),
        (&["write", "R0=1", "R1=65536"], "`65536` is not a value for R1: out of range: u16 takes 0 to 65535"),
        (&["write", "R0=1", "R1"], "`R1` is not an assignment: it must be TAG=VALUE"),
        (&["write", "R0-R2=1,2"], "`1,2` is not a value for R0-R2: the number of values is 2, and R0-R2 takes 3"),
        (&["write", "R0:hex=10"], "`10` is not a value for R0:hex: a hexadecimal value begins with 0x"),
        (&["write", "R0:u16*0.1=6553.6"], "the raw number of 6553.6 is 65536.0, out of range: u16 takes 0 to"),
        (&["write", "R0-R1:text=a,b"], "a text with a comma, a quote, a backslash or a control character needs double"),
        (&["write", "R0-R1:text=hello"], "\"hello\" has 5 characters, and 4 fit"),
        (&["read", "R0:u16*0"], "`R0:u16*0` is not a tag: the gain is 0.0, and it must be from 1e-200 to 1e200"),
        (&["set", "M0", "R0"], "R0 is a 16-bit register, and only discretes can be forced"),
        (&["read", "M9990-M10000"], "M10000 is past the last address of the ascii framing, M9999"),
        (&["set", "M10000"], "M10000 is past the last address of the ascii framing, M9999"),
        (&["read", "RC200"], "`RC200` is not a tag: RC200 does not exist: DRC200 to DRC255 are counters of 32 bits"),
        (&["write", "DRC199=1"], "DRC199 does not exist: DRC200 to DRC255 are counters of 32 bits"),
        (&["ping", "-c", "0"], "invalid value '0' for '--count <N>'"),
        (&["ping", "-s", "257"], "257 is not in 0..=256"),
        (&["read", "R0", "--timeout", "5"], "expected a number with a unit"),
        (&["read", "R0", "--timeout", "25h"], "the limit is 24h"),
        (&["watch", "R0", "--interval", "0h"], "it must be more than 0"),
        (&["read", "R0", "--format", "xml"], "invalid value 'xml' for '--format <FORMAT>'"),
        (&["read", "R0", "--station", "0"], "`0` is not a station: it must be a number from 1 to 254"),
        (&["read", "R0", "--station", "255"], "`255` is not a station: it must be a number from 1 to 254"),
        (&["read", "R0", "--station", "+1"], "`+1` is not a station: it must be a number from 1 to 254"),
        (&["read", "R0", "--link", "http://plc"], "`http://plc` is not an endpoint: unknown transport `http`"),
        (&["decode", "02 4"], "it ends with a single digit"),
        (&["decode", "02 4G"], "character 5, 'G', is not a hexadecimal digit"),
        (&["sim", "--listen", "127.0.0.1:0"], "cannot listen on `127.0.0.1:0`: it must begin with `tcp://`"),
        (&["sim", "--listen", "tcp://127.0.0.1"], "it must have a host and a port"),
        (&["sim", "--station", "255"], "255 is not in 1..=254"),
        (&["sim", "--set", "R0"], "`R0` is not an assignment"),
        (&["sim", "--last", "R9", "--set", "R10=1"], "--set R10=1: R10 is beyond the memory of this model"),
        (&["fly"], "unrecognized subcommand 'fly'"),
        (&[], "Usage: fatek"),
    ] {
        let ran = fatek(&[&["--link", link, "--station", "1"], args].concat());
        let usage = ran.usage();
        assert!(usage.contains(error), "{args:?} should say: {error}\n{usage}");
    }
    assert_eq!(plc.connections(), 0);
    assert_eq!(plc.received(), b"");
}

#[test]
fn a_value_of_two_registers_is_written_in_one_request() {
    let plc = ScriptedPlc::start(|_| ascii("01470"));
    plc.fatek(&["write", "R100:f32=-500.125"]).ok();
    let received = plc.received();
    let (check, write) = received.split_at(16);
    assert!(check.starts_with(b"\x02014E") && check.ends_with(b"\x03"), "{check:?}");
    assert_eq!(write, ascii("014702R001001000C3FA"));
}

#[test]
fn pings_are_timed_and_lost_ones_are_status_4() {
    for framing in FRAMINGS {
        let sim = Sim::start(&["--framing", framing]);
        let ping = sim.fatek(&["ping", "-c", "3", "-i", "0s"]);
        assert!(ping.stderr.starts_with("3 sent, 3 received\nround trip: min "), "{ping:?}");
        let lines = ping.ok();
        assert_eq!(lines.lines().count(), 3);
        assert!(lines.starts_with("1: 16 bytes in "), "{lines}");
        let json = sim.fatek(&["ping", "-c", "2", "-i", "0s", "-s", "256", "--format", "json"]).ok();
        let json: serde_json::Value = json.parse().unwrap();
        assert_eq!((&json[1]["sequence"], &json[1]["bytes"]), (&2.into(), &256.into()));
        assert!(json[0]["time_ms"].as_f64().unwrap() > 0.0);
        sim.fatek(&["ping", "-c", "1", "-s", "0"]).ok();
    }
    let sim = Sim::start(&[]);
    let lost = fatek(&["--link", &sim.url, "--station", "9", "ping", "-c", "2", "-i", "0s", "--timeout", "50ms"]);
    assert_eq!(lost.status, 4, "{lost:?}");
    assert!(lost.stderr.contains("2 sent, 0 received\nerror: 2 of 2 requests had no reply\n"), "{lost:?}");
}

#[test]
fn decode_explains_good_and_bad_frames() {
    let good = fatek(&["decode", "02:30:31:34:36", "0x30,0x33 52303030313237 35", "03"]).ok();
    assert!(good.starts_with("ASCII frame of 16 bytes: good\n"), "{good}");
    assert!(good.contains("request  element  52 30 30 30 31 32  R12, a 16-bit register\n"), "{good}");

    let bad = fatek(&["decode", "51 10 00 02 01 40 A1 85 55 AA"]);
    assert_eq!(bad.status, 6);
    assert!(bad.stdout.contains("frame  CRC         A1 85  BAD: found A1 85, computed A1 84\n"), "{bad:?}");
    assert!(bad.stdout.contains("frame  command     40     read brief status (40h)\n"), "{bad:?}");
    assert!(bad.stderr.contains("fault: CRC: found A1 85"), "{bad:?}");

    let query = "51 10 00 02 01 40 A1 84 55 AA";
    fatek(&["decode", "--framing", "binary", query]).ok();
    assert_eq!(fatek(&["decode", "--framing", "ascii", query]).status, 6);

    let json: serde_json::Value = fatek(&["decode", query, "--format", "json"]).ok().parse().unwrap();
    assert_eq!((&json[0]["framing"], &json[0]["good"]), (&"binary".into(), &true.into()));
    assert_eq!(json[0]["fields"][3]["field"], "station");
    let csv = fatek(&["decode", query, "--format", "csv"]).ok();
    assert!(csv.starts_with("frame,part,field,bytes,meaning\n1,frame,header,51,request\n"), "{csv}");
}

#[test]
fn a_closed_output_pipe_is_no_error() {
    let sim = Sim::start(&["--model", "largest"]);
    for format in ["table", "csv", "json"] {
        let mut command = Command::new(FATEK);
        command.args(["--link", &sim.url, "--station", "1", "--format", format, "read", "R0-R5999"]);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        assert_eq!((output.status.code(), String::from_utf8(output.stderr).unwrap()), (Some(0), String::new()));
    }
}

#[test]
fn help_and_version_go_to_stdout() {
    assert!(fatek(&["--help"]).ok().contains("Exit status:"));
    assert!(fatek(&["read", "--help"]).ok().contains("Examples:"));
    assert!(fatek(&["--version"]).ok().starts_with("fatek "));
}
