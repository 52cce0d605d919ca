//! `fatek top` and `fatek watch --plot` on a pseudo-terminal.
#![cfg(all(feature = "cli", unix))]

mod process;
mod terminal;

use process::{FATEK, Folder, Sim, fatek, run};
use std::process::Command;
use terminal::Program;

/// Starts a command of station 1 of a simulator.
fn start(sim: &Sim, args: &[&str]) -> Program {
    Program::start(&[&["--link", &sim.url, "--station", "1"], args].concat(), (80, 24), &[])
}

#[test]
fn values_appear_and_a_confirmed_write_reaches_the_plc() {
    let sim = Sim::start(&["--set", "R0=4711", "M7=on"]);
    let mut top = start(&sim, &["top", "R0", "R1:i16", "M7", "--interval", "20ms"]);
    top.wait_for("the values", |screen| screen.contains("4711") && screen.contains("M7   ") && screen.contains("good"));
    assert!(top.screen().starts_with(" fatek top · 1 PLC · 3 tags · every 20ms"), "{}", top.screen());

    // Not confirmed.
    top.types("jw-5\r");
    top.wait_for("the prompt", |screen| screen.contains("Write it?"));
    let prompt = top.screen();
    for line in [&format!("PLC  1 ({} station 1)", sim.url), "Tag  R1:i16", "Now  0", "New  -5"] {
        assert!(prompt.contains(line), "{line}: {prompt}");
    }
    top.types("n");
    top.wait_for("the refusal", |screen| screen.contains("nothing was written"));
    assert_eq!(sim.fatek(&["read", "R1:i16", "--format", "csv"]).ok(), "tag,type,value\nR1,i16,0\n");

    top.types("w-5\r");
    top.wait_for("the prompt", |screen| screen.contains("Write it?"));
    // A later frame: the first one is known to be on the terminal, and a `y` is of the time after.
    sim.fatek(&["write", "R1=3"]).ok();
    top.wait_for("the present value", |screen| screen.contains("Now  3 "));
    top.types("y");
    top.wait_for("the result", |screen| screen.contains("wrote R1:i16=-5"));
    assert_eq!(sim.fatek(&["read", "R1:i16", "--format", "csv"]).ok(), "tag,type,value\nR1,i16,-5\n");
    top.wait_for("the value", |screen| screen.lines().any(|line| line.starts_with("R1:i16  ") && line.contains("-5")));

    top.types("q");
    assert_eq!(top.end(), (0, String::new()));
}

#[test]
fn the_terminal_is_restored_at_every_end() {
    let sim = Sim::start(&[]);
    let folder = Folder::new("top-ends");
    let plant = folder.file("plant.toml");
    std::fs::write(&plant, format!("[plc.mixer]\nlink = '{}'\nstation = 1\ntag.level = 'R0'\n", sim.url)).unwrap();
    let named = ["--config", &plant, "@mixer", "watch", "--plot", "level", "--interval", "20ms"];
    let options = ["--link", &sim.url, "--station", "1", "top"];
    for (args, shown) in [(&options[..], "online"), (&named, "level  0")] {
        for end in ["q", "\x03", "INT", "TERM", "HUP"] {
            let mut program = Program::start(args, (80, 24), &[]);
            program.wait_for("the display", |screen| screen.contains(shown));
            match end {
                "q" | "\x03" => program.types(end),
                signal => program.signal(signal),
            }
            // `end` checks the settings of the terminal and its screen.
            assert_eq!(program.end(), (0, String::new()), "{shown} {end:?}");
        }
    }
}

#[test]
fn a_lost_plc_and_a_new_size_are_shown() {
    let sim = Sim::start(&["--set", "R0=4711"]);
    let mut top = start(&sim, &["--timeout", "100ms", "top", "R0", "--interval", "20ms"]);
    top.wait_for("the value", |screen| screen.contains("4711"));
    top.resize((40, 12));
    top.wait_for("the new size", |screen| {
        screen.lines().count() == 12 && screen.contains("4711") && screen.contains("TAG")
    });
    drop(sim);
    top.wait_for("the failure", |screen| {
        screen.contains("stale") && ["no link", "offline"].iter().any(|word| screen.contains(word))
    });
    top.resize((1, 1));
    top.resize((120, 40));
    top.wait_for("the counters", |screen| screen.lines().count() == 40 && screen.contains("ADDRESS"));
    top.types("q");
    assert_eq!(top.end(), (0, String::new()));
}

#[test]
fn no_color_and_locales_without_utf_8_are_respected() {
    let sim = Sim::start(&["--set", "R0=4711"]);
    let args = ["--link", &sim.url, "--station", "1", "top", "R0", "--interval", "20ms"];
    let bytes = |variables: &[(&str, &str)]| {
        let mut top = Program::start(&args, (80, 24), variables);
        top.wait_for("the value", |screen| {
            screen.contains("4711") && screen.contains("good") && screen.contains("online")
        });
        top.types("q");
        assert_eq!(top.end(), (0, String::new()));
        top.received().to_vec()
    };
    let has = |bytes: &[u8], wanted: &str| bytes.windows(wanted.len()).any(|window| window == wanted.as_bytes());
    let coloured = bytes(&[]);
    // The foreground of `good` and `online`.
    assert!(has(&coloured, "\x1b[38;5;2"), "{:?}", String::from_utf8_lossy(&coloured));
    let plain = bytes(&[("NO_COLOR", "1"), ("LC_ALL", "C")]);
    assert!(!has(&plain, "\x1b[38;") && !has(&plain, "\x1b[48;"), "{:?}", String::from_utf8_lossy(&plain));
    assert!(plain.is_ascii() && !coloured.is_ascii());
}

#[test]
fn without_a_terminal_there_is_a_usage_error() {
    // No PLC listens there: a request would give status 5.
    let plc = ["--link", "tcp://127.0.0.1:9", "--station", "1"];
    let usage = |args: &[&str]| fatek(&[&plc, args].concat()).usage();
    let text = usage(&["top", "R0"]);
    assert!(text.starts_with("error: top needs a terminal, at stdin and stdout; `read` and `watch` print"), "{text}");
    let text = usage(&["watch", "--plot", "R0"]);
    assert!(text.starts_with("error: watch --plot needs a terminal, at stdin and stdout; without --plot"), "{text}");
    assert!(usage(&["top", "--format", "json"]).contains("top draws on a terminal and has no --format"));
    let (status, screen) = Program::start(&[&plc[..], &["top"]].concat(), (80, 24), &[("TERM", "dumb")]).end();
    assert!(status == 2 && screen.contains("TERM is dumb"), "{status}: {screen}");
    let (status, screen) = Program::start(&[&plc[..], &["-v", "top"]].concat(), (80, 24), &[]).end();
    assert!(status == 2 && screen.contains("redirect them"), "{status}: {screen}");
    let (status, screen) = Program::start(&[&plc[..], &["watch", "--plot", "R0:text"]].concat(), (80, 24), &[]).end();
    assert!(status == 2 && screen.contains("R0:text has no numbers to plot"), "{status}: {screen}");
    let no_tag = run(Command::new(FATEK).args(plc).args(["watch", "--plot", "R0", "R1"]));
    assert_eq!(no_tag.status, 2, "{no_tag:?}");
}

#[test]
fn ctrl_l_redraws_the_screen() {
    let sim = Sim::start(&["--set", "R0=4711"]);
    for command in [&["top", "R0"][..], &["watch", "--plot", "R0"]] {
        let mut program = start(&sim, &[command, &["--interval", "20ms"]].concat());
        program.wait_for("the value", |screen| screen.contains("4711"));
        // It waited for the place of the cursor, which came with the next key, and ended after 2 s
        // with status 1.
        program.types("\x0c");
        program.wait_for_bytes("the clearing", b"\x1b[2J");
        program.wait_for("the value", |screen| screen.contains("4711"));
        sim.fatek(&["write", "R0=815"]).ok();
        program.wait_for("the next value", |screen| screen.contains("815"));
        program.types("q");
        assert_eq!(program.end(), (0, String::new()), "{command:?}");
        sim.fatek(&["write", "R0=4711"]).ok();
    }
}

#[test]
fn keys_typed_before_the_prompt_do_not_confirm() {
    let sim = Sim::start(&[]);
    let value = || sim.fatek(&["read", "R0", "--format", "csv"]).ok();
    let mut top = start(&sim, &["top", "R0"]);
    top.wait_for("the value", |screen| screen.contains("good"));
    for _ in 0..5 {
        top.types("w7");
        top.wait_for("the value", |screen| screen.contains("new value of R0: 7"));
        // That takes longer than the time between two frames for keys, so that the next frame is
        // due: it was drawn between the two keys.
        assert_eq!(value(), "tag,type,value\nR0,u16,0\n");
        // `wrote R0=7`, when the `y` was taken after the first frame of the prompt.
        top.types("\ry");
        top.wait_for("the prompt", |screen| screen.contains("Write it?"));
        top.types("n");
        top.wait_for("the refusal", |screen| screen.contains("nothing was written"));
    }
    assert_eq!(value(), "tag,type,value\nR0,u16,0\n");
    top.types("q");
    assert_eq!(top.end(), (0, String::new()));
}

#[test]
fn escape_and_other_keys_close_the_prompt() {
    let sim = Sim::start(&[]);
    let mut top = start(&sim, &["top", "R0", "--interval", "20ms"]);
    top.wait_for("the value", |screen| screen.contains("good"));
    // Esc with `y`, or Alt-y, gave `wrote R0=7`. The left key and F5 left the prompt open.
    for keys in ["\x1by", "\x1b", "\x1b[D", "\x1b[15~"] {
        top.types("w7\r");
        top.wait_for("the prompt", |screen| screen.contains("Write it?"));
        top.types(keys);
        top.wait_for("the refusal", |screen| screen.contains("nothing was written"));
        // Clears the message.
        top.types("j");
        top.wait_for("the keys", |screen| screen.contains("q quit"));
    }
    assert_eq!(sim.fatek(&["read", "R0", "--format", "csv"]).ok(), "tag,type,value\nR0,u16,0\n");
    top.types("q");
    assert_eq!(top.end(), (0, String::new()));
}
