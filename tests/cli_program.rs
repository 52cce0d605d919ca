//! `fatek program` as a process, against `fatek sim` as another process.
#![cfg(feature = "cli")]

mod process;

use std::fs;

use std::sync::atomic::{AtomicUsize, Ordering};

use self::process::{Folder, Output, ScriptedPlc, Sim, fatek};

/// A program of 640 words; pages 3 and 7 are not blank.
fn raw_program() -> Vec<u8> {
    let mut bytes = vec![0; 11 * 128];
    bytes[..128].fill(0xFF);
    bytes[..6].copy_from_slice(b"FB00\x02\x80");
    bytes[3 * 128..4 * 128].fill(0x33);
    bytes[7 * 128..8 * 128].fill(0x77);
    bytes
}

fn program(sim: &Sim, args: &[&str]) -> Output {
    sim.fatek(&[&["program"], args].concat())
}

#[test]
fn a_program_is_read_shown_written_and_verified() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-whole"));
    let (blank, raw, read) = (folder.file("blank.program"), folder.file("new.bin"), folder.file("read.bin"));
    fs::write(&raw, raw_program()).unwrap();

    let ran = program(&sim, &["read", &blank]);
    assert!(ran.stderr.contains("reading: 1 of 11, 128 bytes"), "{ran:?}");
    assert!(ran.stderr.ends_with("blank.program: FB00, 640 words, 11 pages\n"), "{ran:?}");
    assert_eq!(ran.ok(), "");
    assert!(fs::read_to_string(&blank).unwrap().starts_with("fatek file 1: program\n"));

    let info: serde_json::Value = fatek(&["program", "info", &blank, "--format", "json"]).ok().parse().unwrap();
    assert_eq!((&info["kind"], &info["ladder_words"], &info["pages"]), (&"FB".into(), &640.into(), &11.into()));
    assert_eq!(
        (&info["program_capacity"], &info["os_version"], &info["ran"]),
        (&"FBE 13K".into(), &"3.1".into(), &false.into())
    );
    let info = fatek(&["program", "info", "--raw", &raw]).ok();
    assert!(info.starts_with("FIELD             VALUE\nkind              FB\n"), "{info}");
    assert!(info.contains("\nread_at           unknown\n"), "{info}");

    let differs = program(&sim, &["verify", "--raw", &raw]);
    assert_eq!((differs.status, differs.stdout.as_str()), (7, "PAGE\n3\n7\n"), "{differs:?}");
    assert!(differs.stderr.ends_with("error: 2 of 11 pages differ\n"), "{differs:?}");

    let dry = program(&sim, &["write", "--raw", &raw, "--dry-run", "--format", "csv", "-q"]);
    assert_eq!((dry.stdout.as_str(), dry.stderr.as_str(), dry.status), ("page\n3\n7\n", "", 0));
    assert_eq!(program(&sim, &["verify", &blank]).status, 0, "nothing was written");

    let written = program(&sim, &["write", "--raw", &raw, "--yes"]);
    assert!(written.stderr.ends_with("2 of 11 pages written and compared; the PLC is stopped\n"), "{written:?}");
    assert_eq!(written.ok(), "");
    let same = program(&sim, &["verify", "--raw", &raw]);
    assert!(same.stderr.ends_with("all 11 pages are equal\n"), "{same:?}");
    assert_eq!(same.ok(), "", "no header without a row");
    program(&sim, &["read", "--raw", "--twice", &read, "-q"]).ok();
    assert_eq!(fs::read(&read).unwrap(), raw_program());
}

#[test]
fn stop_and_run_are_done_only_on_request() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-running"));
    let (raw, old) = (folder.file("new.bin"), folder.file("old.bin"));
    fs::write(&raw, raw_program()).unwrap();
    program(&sim, &["read", "--raw", &old]).ok();
    sim.fatek(&["run"]).ok();
    let runs = || sim.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,true");

    let refused = program(&sim, &["write", "--raw", &raw, "--yes"]);
    assert_eq!(refused.status, 7, "{refused:?}");
    assert!(refused.stderr.contains("the PLC runs, nothing was written: stop it first"), "{refused:?}");
    assert!(runs());

    let written = program(&sim, &["write", "--raw", &raw, "--yes", "--stop", "--run", "--all", "--verify"]);
    assert!(written.stderr.contains("11 of 11 pages written and compared; the PLC runs\n"), "{written:?}");
    assert!(written.stderr.contains("\nverifying: 11 of 11, 1408 bytes"), "{written:?}");
    assert!(!written.stderr.contains("comparing"), "{written:?}");
    assert!(runs());

    let written = program(&sim, &["write", "--raw", &old, "-y", "--stop"]);
    assert!(
        written.stderr.ends_with("2 of 11 pages written and compared; the PLC ran before and is now stopped\n"),
        "{written:?}"
    );
    assert!(!runs());
    let same = program(&sim, &["write", "--raw", &old, "-y", "-n"]);
    assert!(same.stderr.ends_with("\n0 of 11 pages would be written\n"), "{same:?}");
    let same = program(&sim, &["write", "--raw", &old, "-y"]);
    assert!(same.stderr.ends_with("\nall 11 pages are equal, nothing was written; the PLC is stopped\n"), "{same:?}");
}

#[test]
fn a_dry_run_follows_the_options_and_fails_like_a_write() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-dry"));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    let dry =
        |args: &[&str]| program(&sim, &[&["write", "--raw", &raw, "--dry-run", "--format", "csv"], args].concat());
    let all = dry(&["--all"]);
    assert!(
        all.stderr.ends_with("11 of 11 pages would be written; the PLC is stopped, and would stay stopped\n"),
        "{all:?}"
    );
    assert_eq!(all.ok(), "page\n0\n1\n2\n3\n4\n5\n6\n7\n8\n9\n10\n");

    sim.fatek(&["run"]).ok();
    let refused = dry(&["--all"]);
    let real = program(&sim, &["write", "--raw", &raw, "--yes", "--all"]);
    assert_eq!((refused.status, refused.stdout.as_str()), (7, ""), "{refused:?}");
    assert_eq!((real.status, &real.stderr), (refused.status, &refused.stderr));
    assert!(
        refused.stderr.ends_with("error: the PLC runs, nothing was written: stop it first, or give --stop\n"),
        "{refused:?}"
    );
    for (args, would) in [(&["--stop"][..], "stopped"), (&["--stop", "--run"], "stopped and started again")] {
        let dry = dry(args);
        let stderr = format!("2 of 11 pages would be written; the PLC runs, and would be {would}\n");
        assert!(dry.stderr.ends_with(&stderr), "{dry:?}");
        assert_eq!(dry.ok(), "page\n3\n7\n");
    }
    assert!(sim.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,true"));
    assert_eq!(program(&sim, &["verify", "--raw", &raw]).status, 7, "nothing was written");

    let other = Sim::start(&["--ladder-words", "1280"]);
    let misfit = |how| program(&other, &["write", "--raw", &raw, how]);
    let (dry, real) = (misfit("--dry-run"), misfit("--yes"));
    assert_eq!((dry.status, &dry.stderr), (7, &real.stderr), "{real:?}");
    assert!(dry.stderr.contains("a ladder of 640 words, and the PLC one of 1280"), "{dry:?}");
}

/// Returns whether this is a request of this command.
fn is_command(request: &[u8], command: &[u8; 2]) -> bool {
    request.get(3..5) == Some(command)
}

/// Number of requests of this command.
fn count(received: &[u8], command: &[u8; 2]) -> usize {
    received.split(|&byte| byte == 0x02).filter(|request| request.get(2..4) == Some(command)).count()
}

#[test]
#[cfg(unix)]
fn an_interrupted_write_reports_its_pages_and_the_remedy() {
    interrupted_write("INT", 130);
}

/// Before: the process was killed, and left the PLC stopped without a word.
#[test]
#[cfg(unix)]
fn a_write_ends_in_order_when_the_terminal_is_closed() {
    interrupted_write("HUP", 129);
}

#[cfg(unix)]
fn interrupted_write(signal: &str, expected: i32) {
    use self::process::run_and_signal;

    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new(&format!("program-interrupted-{signal}")));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    sim.fatek(&["run"]).ok();
    let pages = AtomicUsize::new(0);
    // The fourth page is written, but not answered.
    let plc = ScriptedPlc::proxy(&sim, move |request| {
        !is_command(request, b"50") || pages.fetch_add(1, Ordering::Relaxed) < 3
    });
    let write = ["program", "write", "--raw", &raw, "--yes", "--all", "--stop", "--run"];
    let (status, stderr) = run_and_signal(&plc, signal, &write, |received| count(received, b"50") == 4);
    assert_eq!(status, expected, "{stderr}");
    let state = format!(
        "error: interrupted by SIG{signal}: 3 of the 11 pages that differ are written (1-3), page 4 perhaps, and the \
         PLC ran before and is stopped now: write the rest before it runs; repeat the command, then start the PLC \
         with `fatek run`\n"
    );
    assert!(stderr.ends_with(&state), "{stderr}");
    assert!(sim.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,false"));
    let again = sim.fatek(&write);
    assert!(again.stderr.ends_with("pages written and compared; the PLC is stopped\n"), "{again:?}");
    program(&sim, &["verify", "--raw", &raw]).ok();
    sim.fatek(&["run"]).ok();
}

#[test]
#[cfg(unix)]
fn an_interrupted_read_leaves_the_old_file() {
    use self::process::run_and_signal;

    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-read-interrupted"));
    let file = folder.file("a.program");
    fs::write(&file, "the old one").unwrap();
    let pages = AtomicUsize::new(0);
    let plc = ScriptedPlc::proxy(&sim, move |request| {
        !is_command(request, b"4F") || pages.fetch_add(1, Ordering::Relaxed) < 5
    });
    let (status, stderr) =
        run_and_signal(&plc, "INT", &["program", "read", &file], |received| count(received, b"4F") == 6);
    assert_eq!(status, 130, "{stderr}");
    // The pages are blank, and a page equal to the one before it is read twice. Only pages
    // confirmed by a check count.
    assert!(stderr.contains("\nerror: interrupted by SIGINT after "), "{stderr}");
    assert!(stderr.ends_with(" pages: nothing was saved\n"), "{stderr}");
    assert_eq!(fs::read_to_string(&file).unwrap(), "the old one");
    assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 1);
}

#[test]
fn a_write_is_resumed_five_times_at_most() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-five"));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    // One page of each run is written, and then nothing until the next run begins.
    let pages = AtomicUsize::new(0);
    let plc = ScriptedPlc::proxy(&sim, move |request| {
        if is_command(request, b"53") {
            pages.store(0, Ordering::Relaxed);
        }
        if is_command(request, b"50") {
            pages.fetch_add(1, Ordering::Relaxed);
        }
        pages.load(Ordering::Relaxed) < 2
    });
    let write = ["--timeout", "50ms", "program", "write", "--raw", &raw, "--yes", "--all"];
    let ran = plc.fatek(&write);
    assert_eq!((ran.status, ran.stderr.matches("; resuming\n").count()), (4, 5), "{ran:?}");
    assert_eq!(count(&plc.received(), b"53"), 6, "{ran:?}");
    let last = ran.stderr.lines().rfind(|line| line.starts_with("error: ")).unwrap();
    assert!(last.contains("1 of the 6 pages that differ are written (6), page 7 perhaps, and "), "{ran:?}");
    assert!(last.ends_with("write the rest before it runs; repeat the command"), "{ran:?}");

    // No page is written: resuming is useless.
    let sim = Sim::start(&["--ladder-words", "640"]);
    let plc = ScriptedPlc::proxy(&sim, |request| !is_command(request, b"50"));
    let ran = plc.fatek(&write[..7]);
    assert_eq!((ran.status, ran.stderr.matches("resuming").count()), (4, 0), "{ran:?}");
}

#[test]
fn a_resumed_write_counts_earlier_pages() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-before"));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    // All pages are written, but the last one cannot be read back. The next run finds no
    // difference.
    let (runs, pages) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let plc = ScriptedPlc::proxy(&sim, move |request| {
        runs.fetch_add(usize::from(is_command(request, b"53")), Ordering::Relaxed);
        pages.fetch_add(usize::from(is_command(request, b"50")), Ordering::Relaxed);
        !is_command(request, b"4F") || runs.load(Ordering::Relaxed) > 1 || pages.load(Ordering::Relaxed) < 2
    });
    let ran = plc.fatek(&["--timeout", "50ms", "program", "write", "--raw", &raw, "--yes"]);
    assert_eq!((ran.status, count(&plc.received(), b"53")), (0, 2), "{ran:?}");
    assert!(ran.stderr.ends_with("\n2 of 11 pages written and compared; the PLC is stopped\n"), "{ran:?}");
    program(&sim, &["verify", "--raw", &raw]).ok();
}

#[test]
fn an_unwritable_file_sends_nothing() {
    let folder = Folder::new("program-nowhere");
    let without_plc = |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1"], args].concat());
    fs::write(folder.file("a"), "").unwrap();
    for (file, message) in [
        (folder.file("none/a"), "none/a: cannot make a new file in its folder: No such file"),
        (folder.file("a/b"), "a/b: cannot find it: Not a directory"),
        (folder.file("."), "not a regular file"),
    ] {
        for args in [&["program", "read", &file][..], &["backup", &file, "R0-R9"]] {
            // A request would give status 5.
            let ran = without_plc(args);
            assert_eq!((ran.status, ran.stdout.as_str()), (1, ""), "{ran:?}");
            assert!(ran.stderr.contains(message), "{ran:?}");
        }
    }
    assert_eq!(without_plc(&["program", "read", &folder.file("b")]).status, 5);
    assert!(!fs::exists(folder.file("b")).unwrap());
}

#[test]
fn without_a_terminal_a_write_needs_yes() {
    let folder = Folder::new("program-unasked");
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    // No PLC listens there: a request would give status 5.
    let without_plc =
        |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1", "program"], args].concat());
    let usage = without_plc(&["write", "--raw", &raw]).usage();
    assert!(usage.contains("there is no terminal: give --yes or --dry-run"), "{usage}");
    assert_eq!(without_plc(&["write", "--raw", &raw, "--yes"]).status, 5);
    assert!(without_plc(&["write", "--raw", &raw, "--yes", "--run"]).usage().contains("--stop"));
}

#[test]
fn a_bad_file_sends_nothing_and_a_failed_read_keeps_the_old() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-damaged"));
    let file = folder.file("a.program");
    program(&sim, &["read", &file]).ok();
    let good = fs::read(&file).unwrap();
    let mut damaged = good.clone();
    damaged[500] ^= 1;
    for (content, message) in [
        (&damaged[..], "it is damaged: its checksum is"),
        (&good[..1000], "it is cut off: "),
        (b"MZ", "it does not begin with `fatek file`"),
    ] {
        fs::write(&file, content).unwrap();
        for args in [&["write", &file, "--yes"][..], &["verify", &file], &["info", &file]] {
            let ran = fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1", "program"], args].concat());
            assert_eq!((ran.status, ran.stdout.as_str()), (7, ""), "{ran:?}");
            assert!(ran.stderr.contains("a.program: ") && ran.stderr.contains(message), "{ran:?}");
        }
    }
    let other = Sim::start(&["--ladder-words", "1280"]);
    fs::write(&file, &good).unwrap();
    let misfit = program(&other, &["write", &file, "--yes"]);
    assert_eq!(misfit.status, 7);
    assert!(
        misfit.stderr.contains("the program has a ladder of 640 words, and the PLC one of 1280; nothing was written")
    );

    let without_plc = fatek(&["--link", "tcp://127.0.0.1:9", "--station", "1", "program", "read", &file]);
    assert_eq!(without_plc.status, 5, "{without_plc:?}");
    assert_eq!(fs::read(&file).unwrap(), good);
    assert_eq!(fatek(&["program", "info", &folder.file("none")]).status, 1);
    fs::write(&file, raw_program()).unwrap();
    let bare = fatek(&["program", "info", &file]);
    assert_eq!(bare.status, 7, "{bare:?}");
    assert!(bare.stderr.ends_with("; for a raw file give --raw\n"), "{bare:?}");
}

#[test]
fn in_the_binary_framing_there_are_no_programs() {
    let (sim, folder) = (Sim::start(&["--framing", "binary"]), Folder::new("program-binary"));
    let ran = program(&sim, &["read", &folder.file("a.program")]);
    assert_eq!(ran.status, 2, "{ran:?}");
    assert!(ran.stderr.contains("does not exist in the binary framing"), "{ran:?}");
    assert!(!fs::exists(folder.file("a.program")).unwrap());
}

/// Questions at a terminal, and the effect of the answers.
#[cfg(unix)]
mod terminal {
    use super::process::run_at_terminal;
    use super::*;

    fn answer(sim: &Sim, args: &[&str], answer: &str) -> (i32, String) {
        run_at_terminal(sim, &[&["program"], args].concat(), answer)
    }

    #[test]
    fn at_a_terminal_a_write_needs_a_yes_and_shows_a_bar() {
        let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-terminal"));
        let raw = folder.file("new.bin");
        fs::write(&raw, raw_program()).unwrap();
        let write = ["write", "--raw", &raw, "--stop"];
        for no in ["n\n", "\n", "maybe\n"] {
            let (status, shown) = answer(&sim, &write, no);
            assert_eq!(status, 1, "{shown}");
            let question = format!(
                "new.bin (FB00, 640 words) to station 1 on {}? The PLC is stopped first and stays stopped. [y/N] ",
                sim.url
            );
            assert!(shown.contains(&question), "{shown}");
            assert!(shown.ends_with("error: not confirmed: nothing was changed\r\n"), "{shown}");
            assert_eq!(program(&sim, &["verify", "--raw", &raw]).status, 7);
        }
        let (status, shown) = answer(&sim, &write, "y\n");
        assert_eq!(status, 0, "{shown}");
        assert!(shown.contains("[#>------------------] comparing: 1 of 11, 128 bytes"), "{shown}");
        assert!(shown.contains("[####################] writing: 2 of 2, 512 bytes"), "{shown}");
        assert!(shown.ends_with("\r\n2 of 11 pages written and compared; the PLC is stopped\r\n"), "{shown}");
        assert_eq!(program(&sim, &["verify", "--raw", &raw]).status, 0);

        // No question if nothing is to be changed, or with --yes.
        assert_eq!(answer(&sim, &["write", "--raw", &raw, "--dry-run"], "").0, 0);
        assert_eq!(answer(&sim, &["write", "--raw", &raw, "--yes"], "").0, 0);
    }
}

#[test]
fn a_file_of_a_newer_minor_version_is_read_with_a_warning() {
    let fixture = |name: &str| format!("{}/tests/fixtures/{name}", env!("CARGO_MANIFEST_DIR"));
    let ran = fatek(&["program", "info", &fixture("program-1.9.program")]);
    assert!(
        ran.stderr.ends_with(
            "program-1.9.program has a newer format version; unknown fields are ignored: name, tool, comment\n"
        ),
        "{ran:?}"
    );
    assert!(ran.ok().contains("64"));
    let refused = fatek(&["program", "info", &fixture("program-2.program")]);
    assert_eq!(refused.status, 7);
    assert!(refused.stderr.contains("format version 2 needs a newer version of this library"), "{refused:?}");
}
