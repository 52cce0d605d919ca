//! `fatek read`, `write` and the commands for forced discretes, against `fatek sim` as another process.
#![cfg(feature = "cli")]

mod process;

use std::time::{Duration, Instant};

use process::{ScriptedPlc, Sim, ascii, run_and_signal};

const FRAMINGS: [&str; 2] = ["ascii", "binary"];

/// Before: seven requests for these tags.
#[test]
fn read_sends_the_requests_that_plan_shows() {
    let tags = ["R0", "R5", "R10:i16", "R20", "M0", "M9", "X3", "R100:f32", "D0", "DR40"];
    for framing in FRAMINGS {
        let sim = Sim::start(&["--framing", framing, "--set", "R10:i16=-7", "M9=1"]);
        let plan = sim.fatek(&[&["plan", "--format", "json"][..], &tags].concat()).ok();
        let plan: serde_json::Value = plan.parse().unwrap();
        let planned = plan["requests"].as_array().unwrap().len();
        let read = sim.fatek(&[&["read", "-vv", "--format", "csv"][..], &tags].concat());
        // A new connection begins with a check.
        let sent = read.stderr.lines().filter(|line| line.contains(" sending ")).count() - 1;
        assert_eq!((sent, planned), (1, 1), "{framing}: {}", read.stderr);
        let rows = read.ok();
        assert_eq!(rows.lines().count(), 1 + tags.len());
        assert!(rows.contains("\nR10,i16,-7\n") && rows.contains("\nM9,bool,1\n"), "{rows}");
    }
}

#[test]
fn refused_tags_do_not_hide_the_others() {
    let sim = Sim::start(&["--set", "R0=5", "M3=1"]);
    let read = sim.fatek(&["read", "R0", "R9999", "M3", "--format", "csv"]);
    assert_eq!((read.status, read.stdout.as_str()), (3, "tag,type,value\nR0,u16,5\nM3,bool,1\n"), "{read:?}");
    let reason = "R9999: station 1 refused read registers (46h): illegal address (A)\n";
    assert_eq!(read.stderr, format!("{reason}error: 1 of 3 tags refused, whole or in part\n"));
    let strict = sim.fatek(&["read", "--strict", "R0", "R9999", "M3"]);
    assert_eq!((strict.status, strict.stdout.as_str(), &strict.stderr), (3, "", &read.stderr));
    let alone = sim.fatek(&["read", "R9999"]);
    assert_eq!((alone.status, alone.stdout, alone.stderr), (3, String::new(), format!("error: {reason}")));
}

/// The simulated FBe-28MC has R0 to R4167.
#[test]
fn a_range_is_read_up_to_the_end_of_the_memory() {
    for (model, tag, count, last, first_refused) in [
        ("fbe-28mc", "R0-R4500", 4168, "R4167", "R4168"),
        ("fbe-28mc", "R4160-R4200", 8, "R4167", "R4168"),
        ("fbe-28mc", "R4160-R4175:f32", 4, "R4167", "R4168"),
        ("fbe-28mc", "DR4161-DR4169", 3, "DR4165", "DR4167"),
        ("fbe-28mc", "M2000-M2010", 2, "M2001", "M2002"),
    ] {
        let sim = Sim::start(&["--model", model]);
        let read = sim.fatek(&["read", tag, "--format", "csv"]);
        assert_eq!((read.status, read.stdout.lines().count()), (3, 1 + count), "{tag}: {}", read.stderr);
        let reason = format!(
            "{tag}: read up to {last}; {first_refused} is refused, and those behind it were not tried: station 1 refused read "
        );
        assert!(read.stderr.starts_with(&reason), "{}", read.stderr);
    }
}

/// Before: the first bit alone was printed, and a range was read twice.
#[test]
fn all_values_of_a_tag_beside_a_refused_one_are_printed() {
    let sim = Sim::start(&["--set", "R5=0x00A5", "R100:f32=0.5", "R10-R13:text=abc", "RC0=3", "DRC200=7"]);
    let tags = ["R9999", "R5.0-R5.3", "R100:f32", "R10-R13:text", "DRC200-DRC202", "R5:i16*0.1"];
    let read = sim.fatek(&[&["read", "--format", "csv"][..], &tags].concat());
    let rows = "tag,type,value\nR5.0,bool,1\nR5.1,bool,0\nR5.2,bool,1\nR5.3,bool,0\nR100,f32,0.5\nR10-R13,text,abc\n\
                DRC200,u32,7\nDRC201,u32,0\nDRC202,u32,0\nR5,i16*0.1,16.5\n";
    assert_eq!((read.status, read.stdout.as_str()), (3, rows), "{}", read.stderr);
    let long = sim.fatek(&["read", "R0-R65535", "-vv", "--format", "csv"]);
    let sent = long.stderr.lines().filter(|line| line.contains(" sending ")).count();
    assert!(long.stdout.lines().count() == 4169 && sent < 160, "{sent} requests");
}

/// A device that takes fewer elements at once than the protocol has.
#[test]
fn a_limit_of_the_device_is_not_the_end_of_its_memory() {
    let plc = ScriptedPlc::start(|request| {
        let count = usize::from_str_radix(std::str::from_utf8(&request[5..7]).unwrap(), 16).unwrap();
        ascii(&if request[3..5] == *b"46" && count <= 20 {
            format!("01460{}", "0007".repeat(count))
        } else {
            "01462".to_owned()
        })
    });
    let link = format!("{}?copies=0", plc.url);
    let read = process::fatek(&["--link", &link, "--station", "1", "read", "R0-R99", "--format", "csv"]);
    assert_eq!((read.status, read.stdout.lines().count()), (0, 101), "{}", read.stderr);
}

/// Before: 20 s, since each request waited for its replies.
#[test]
fn a_silent_plc_costs_one_request() {
    let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let link = format!("tcp://{}", silent.local_addr().unwrap());
    let began = Instant::now();
    let read =
        process::fatek(&["--link", &link, "--station", "1", "--timeout", "100ms", "read", "R0-R4000", "M0", "D5"]);
    assert_eq!((read.status, read.stdout.as_str()), (4, ""), "{read:?}");
    assert!(began.elapsed() < Duration::from_secs(5), "{:?}", began.elapsed());
    assert!(read.stderr.contains("\n2 other tags without values for the same reason\n"), "{read:?}");
}

#[test]
fn written_values_are_verified() {
    let sim = Sim::start(&[]);
    let write = sim.fatek(&["write", "R5:i16=-7", "R10-R11=1,2", "R20-R23:text=abc", "M3=on", "--verify"]);
    assert_eq!(write.status, 0, "{write:?}");
    let pulse = sim.fatek(&["write", "M5=1", "M5=0", "--verify"]);
    assert_eq!(pulse.status, 0, "{pulse:?}");
    let bits = sim.fatek(&["write", "R5.3=0", "R5.0=1", "--modify-bits", "--verify"]);
    assert_eq!(bits.status, 0, "{bits:?}");
    let refused = sim.fatek(&["write", "R9999=1", "--verify"]);
    assert_eq!(refused.status, 3, "{refused:?}");

    // The program of this PLC sets R0 to 9 in each scan.
    let plc = ScriptedPlc::start(|request| ascii(if request[3..5] == *b"46" { "014600009" } else { "01470" }));
    let link = format!("{}?copies=0", plc.url);
    let differs = process::fatek(&["--link", &link, "--station", "1", "write", "R0=5", "--verify"]);
    let lines = "wrote R0=5\nR0: 5 was written, and 9 is read\n\
                 error: 1 of 1 values read back differ from those written\n";
    assert_eq!((differs.status, differs.stderr.as_str()), (7, lines));
}

#[cfg(unix)]
#[test]
fn a_watchdog_is_written_until_a_signal() {
    let sim = Sim::start(&[]);
    let mut plc = ScriptedPlc::proxy(&sim, |_| true);
    // All writes are alike then.
    plc.url += "?copies=0";
    let writes = |received: &[u8]| received.windows(11).filter(|bytes| bytes == b"4701R000000").count();
    let began = Instant::now();
    let write = ["write", "R0=7", "--every", "50ms"];
    let (code, stderr) = run_and_signal(&plc, "INT", &write, |received| writes(received) >= 5);
    assert!(began.elapsed() >= Duration::from_millis(200));
    assert_eq!((code, stderr.lines().next()), (0, Some("wrote R0=7")), "{stderr}");
    assert_eq!(sim.fatek(&["read", "R0", "--format", "csv"]).ok(), "tag,type,value\nR0,u16,7\n");
    let refused = sim.fatek(&["write", "R9999=1", "--every", "50ms"]);
    assert_eq!(refused.status, 3, "{refused:?}");
}

#[test]
fn forced_discretes_are_listed_with_their_states() {
    let sim = Sim::start(&[]);
    let none = sim.fatek(&["forced"]);
    assert_eq!((none.status, none.stdout.as_str()), (0, ""), "{none:?}");
    assert!(none.stderr.starts_with("0 of ") && none.stderr.ends_with(" discretes are disabled\n"), "{none:?}");
    assert_eq!(sim.fatek(&["forced", "--format", "json"]).ok(), "[]\n");
    sim.fatek(&["disable", "M0-M7", "X3"]).ok();
    sim.fatek(&["set", "M2-M4", "X3"]).ok();
    let list = "discrete,state\nX3,1\nM0,0\nM1,0\nM2,1\nM3,1\nM4,1\nM5,0\nM6,0\nM7,0\n";
    assert_eq!(sim.fatek(&["forced", "--format", "csv"]).ok(), list);
    assert_eq!(
        sim.fatek(&["forced", "M4-M99", "M5", "--format", "csv"]).ok(),
        "discrete,state\nM4,1\nM5,0\nM6,0\nM7,0\n"
    );
    let register = sim.fatek(&["set", "M0", "R5"]).usage();
    assert!(register.contains("R5 is a 16-bit register, and only discretes can be forced"), "{register}");
}

#[test]
fn a_value_of_another_type_is_suggested() {
    for (assignment, other) in [("R0=-5", "R0:i16=-5"), ("DR0=-70000", "DR0:i32=-70000"), ("R0=21.5", "R0:f32=21.5")] {
        let write = process::fatek(&["--link", "tcp://127.0.0.1:1", "--station", "1", "write", assignment]).usage();
        assert!(write.contains(&format!("; perhaps {other}")), "{write}");
    }
}

#[test]
fn an_unanswered_command_says_what_to_try() {
    let sim = Sim::start(&[]);
    let to_station_9 = ["--link", &sim.url, "--station", "9", "--timeout", "50ms", "read", "R0"];
    let silent = process::fatek(&to_station_9);
    assert_eq!(silent.status, 4, "{silent:?}");
    assert!(silent.stderr.contains("\nhint: nothing came: `fatek scan` finds the stations of a link\n"), "{silent:?}");
    assert!(silent.stderr.ends_with("hint: docs/CONNECT.md has more causes\n"), "{silent:?}");
    let hinted: [&[&str]; 4] =
        [&["ping", "-c", "1"], &["program", "read", "never"], &["backup", "never", "R0"], &["clock"]];
    for command in hinted {
        let silent = process::fatek(&[&to_station_9[..6], command].concat());
        assert_eq!(silent.status, 4, "{silent:?}");
        assert!(silent.stderr.contains("\nhint: nothing came: `fatek scan`"), "{silent:?}");
    }
    let none = process::fatek(&["--link", &sim.url, "scan", "9", "--timeout", "50ms"]);
    assert_eq!(none.status, 4, "{none:?}");
    assert!(none.stderr.contains("\nhint: nothing came: try a longer --timeout"), "{none:?}");
    let quiet = process::fatek(&[&to_station_9[..], &["--quiet"]].concat());
    assert_eq!((quiet.status, quiet.stderr.lines().count()), (4, 1), "{quiet:?}");
}
