//! Texts of files, arguments and PLCs on the terminal: no control character is printed raw, and no
//! error is long.
#![cfg(feature = "cli")]

mod process;

use std::fs;

use self::process::{Folder, Output, Sim, fatek};

/// A colour, a window title, a C1 control, a direction, and a line feed.
const EVIL: &str = "\x1b[31m\x1b]0;t\x07\u{9b}2J\u{202e}\ne";
const SHOWN: &str = r"\u{1b}[31m\u{1b}]0;t\u{7}\u{9b}2J\u{202e}\ne";

#[track_caller]
fn assert_tame(ran: &Output, lines: usize) {
    let raw = |c: &char| c.is_control() && *c != '\n' || *c == '\u{202e}';
    assert_eq!(ran.stderr.chars().find(raw), None, "{ran:?}");
    assert_eq!(ran.stdout.chars().find(raw), None, "{ran:?}");
    assert_eq!(ran.stderr.lines().count(), lines, "{ran:?}");
}

#[test]
fn no_argument_or_file_name_is_printed_raw() {
    let folder = Folder::new("evil");
    let file = folder.file(&format!("a{EVIL}"));
    fs::write(&file, "x").unwrap();
    let to = |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:1", "--station", "1"], args].concat());
    let link = format!("tcp://a{EVIL}:500");
    // Before: each printed ESC, BEL, U+009B, U+202E and the line feed as they are.
    for (ran, lines) in [
        (fatek(&["program", "info", &file]), 1),
        (fatek(&["program", "info", &format!("{file}/none")]), 1),
        (to(&["program", "read", &format!("{file}/none")]), 1),
        (to(&["restore", &file, "--yes"]), 1),
        (fatek(&["--link", &link, "--station", "1", "status"]), 3),
        (fatek(&["--link", "tcp://h", "--station", EVIL, "status"]), 3),
        (fatek(&["sim", "--listen", &format!("tcp://{EVIL}")]), 3),
        (fatek(&["decode", EVIL]), 3),
        (to(&["read", &format!("R0{EVIL}")]), 3),
        (to(&["write", &format!("R0={EVIL}")]), 3),
    ] {
        assert!(ran.status > 0, "{ran:?}");
        assert!(ran.stderr.contains(SHOWN), "{ran:?}");
        assert_tame(&ran, lines);
    }
    // Arguments that clap refuses itself.
    let flag = format!("--x{EVIL}");
    for args in [&["read", "R0", "--format", EVIL][..], &[EVIL], &["read", &flag], &["read", "R0", &flag]] {
        let ran = fatek(args);
        assert_eq!(ran.status, 2, "{ran:?}");
        // Before: `tip: to pass '--x...' as a value` had the line feed.
        let raw = |c: char| c.is_control() && c != '\n' || c == '\u{202e}';
        assert!(!ran.stderr.contains(raw) && !ran.stderr.contains("\ne"), "{ran:?}");
    }
}

#[test]
fn a_log_line_has_no_control_characters() {
    let port = "serial:/dev/none\u{202e}\u{2066}";
    let ran = fatek(&["--link", port, "--station", "1", "-vv", "status"]);
    assert_eq!(ran.status, 5, "{ran:?}");
    // Before: the error had U+202E and U+2066 as they are.
    assert!(ran.stderr.contains(r"none\u{202e}\u{2066}"), "{ran:?}");
    assert!(!ran.stderr.contains(['\u{202e}', '\u{2066}', '\x1b']), "{ran:?}");
}

#[test]
fn an_error_quotes_200_characters_at_most() {
    let folder = Folder::new("long");
    let long = "x".repeat(100_000);
    let kind = folder.file("kind.program");
    fs::write(&kind, format!("fatek file 1: {EVIL}{long}\n")).unwrap();
    let kind = kind.as_str();
    let to = |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:1", "--station", "1"], args].concat());
    for (ran, before) in [
        (to(&["read", &long]), 200_215),
        (to(&["write", &format!("R0={long}")]), 200_000),
        (to(&["write", &format!("R0-R9:text={long}")]), 300_000),
        (to(&["read", &format!("R0:i16*{long}")]), 300_000),
        (to(&["read", &format!("R0:{long}")]), 300_000),
        (to(&["set", &long]), 200_000),
        (to(&["read", "R0", "--format", &long]), 100_000),
        (fatek(&[&long]), 100_000),
        (to(&["read", &format!("--{long}")]), 300_000),
        (fatek(&["--link", &format!("tcp://{}", ":".repeat(100_000)), "--station", "1", "status"]), 200_000),
        (fatek(&["--link", &format!("tcp://h?{long}"), "--station", "1", "status"]), 200_000),
        (fatek(&["--link", &format!("tcp://h?framing={long}"), "--station", "1", "status"]), 200_000),
        (fatek(&["--link", &format!("serial:x?baud={long}"), "--station", "1", "status"]), 200_000),
        (fatek(&["--link", "tcp://h", "--station", &long, "status"]), 100_000),
        (fatek(&["sim", "--listen", &long]), 100_000),
        (fatek(&["decode", &long]), 100_000),
        (fatek(&["program", "info", &long]), 100_000),
        (fatek(&["program", "info", kind]), 100_066),
    ] {
        let length = ran.stderr.len();
        assert!(ran.status > 0 && length < 1200, "{length} bytes, before about {before}: {}", ran.stderr);
    }
}

/// A PLC with a text that controls a terminal in R10, and one that is a formula in R20.
fn plc_with_texts() -> Sim {
    Sim::start(&["--set", r#"R10-R15:text="a\x1B[2J\x9B31m\n=""#, "R20-R29:text==cmd|calc", "R30=65531"])
}

#[test]
fn a_text_of_the_plc_is_escaped_on_a_terminal() {
    let sim = plc_with_texts();
    let table = sim.fatek(&["read", "R10-R15:text"]).ok();
    assert!(table.ends_with("\"a\\x1B[2J\\x9B31m\\n=\"\n"), "{table}");
    // Before: U+009B was printed as it is.
    let json = sim.fatek(&["read", "R10-R15:text", "--format", "json"]).ok();
    assert!(json.contains(r#""value": "a\u001b[2J\u009b31m\n=""#), "{json}");
    assert_eq!(json.parse::<serde_json::Value>().unwrap()[0]["value"], "a\x1b[2J\u{9b}31m\n=");
    // A file or pipe gets the text itself.
    let csv = sim.fatek(&["read", "R10-R15:text", "--format", "csv"]).ok();
    assert_eq!(csv, "tag,type,value\nR10-R15,text,\"a\x1b[2J\u{9b}31m\n=\"\n");
}

#[test]
#[cfg(unix)]
fn csv_on_a_terminal_is_escaped() {
    use self::process::run_at_terminal;

    let sim = plc_with_texts();
    // Before: both printed ESC and U+009B as they are.
    let (status, shown) = run_at_terminal(&sim, &["read", "R10-R15:text", "--format", "csv"], "");
    assert_eq!((status, shown.as_str()), (0, "tag,type,value\r\nR10-R15,text,a\\u{1b}[2J\\u{9b}31m\\n=\r\n"));
    let (_, shown) = run_at_terminal(&sim, &["watch", "R10-R15:text", "--count", "1", "--format", "csv"], "");
    assert!(shown.contains(r"a\u{1b}[2J\u{9b}31m\n=") && !shown.contains(['\x1b', '\u{9b}']), "{shown:?}");
    // An argument that clap refuses. Before: it was printed with ESC.
    let (status, shown) = run_at_terminal(&sim, &["read", "R0", "--format", "a\x1b[31mb"], "");
    assert!(status == 2 && shown.contains(r"a\u{1b}[31mb") && !shown.contains('\x1b'), "{shown:?}");
}

#[test]
fn csv_safe_prefixes_formulas_and_not_numbers() {
    let sim = plc_with_texts();
    let read = |format| sim.fatek(&["read", "R20-R29:text", "R30:i16", "R30:hex", "--format", format]).ok();
    // Before: the value `csv-safe` was unknown, and CSV had the formula only.
    assert_eq!(read("csv"), "tag,type,value\nR20-R29,text,=cmd|calc\nR30,i16,-5\nR30,hex,0xFFFB\n");
    assert_eq!(read("csv-safe"), "tag,type,value\nR20-R29,text,'=cmd|calc\nR30,i16,-5\nR30,hex,0xFFFB\n");
    let watched = sim.fatek(&["watch", "R20-R29:text", "--count", "1", "--format", "csv-safe"]).ok();
    assert!(watched.ends_with(",R20-R29:text,'=cmd|calc,good\n"), "{watched}");
}
