//! `fatek program` as its users meet it: as a process, against `fatek sim` as another one.
#![cfg(feature = "cli")]

mod process;

use std::fs;

use std::sync::atomic::{AtomicUsize, Ordering};

use self::process::{Fake, Folder, Ran, Sim, fatek};

/// A program of 640 words: pages 3 and 7 hold something.
fn raw_program() -> Vec<u8> {
    let mut bytes = vec![0; 11 * 128];
    bytes[..128].fill(0xFF);
    bytes[..6].copy_from_slice(b"FB00\x02\x80");
    bytes[3 * 128..4 * 128].fill(0x33);
    bytes[7 * 128..8 * 128].fill(0x77);
    bytes
}

fn program(sim: &Sim, args: &[&str]) -> Ran {
    sim.fatek(&[&["program"], args].concat())
}

#[test]
fn a_program_is_read_looked_into_written_and_verified() {
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
    assert_eq!(same.ok(), "PAGE\n");
    program(&sim, &["read", "--raw", "--twice", &read, "-q"]).ok();
    assert_eq!(fs::read(&read).unwrap(), raw_program());
}

#[test]
fn a_plc_that_runs_is_stopped_only_if_asked_and_runs_again_only_if_asked() {
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
fn a_dry_run_is_that_of_the_options_and_is_refused_where_the_writing_would_be() {
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
        let said = format!("2 of 11 pages would be written; the PLC runs, and would be {would}\n");
        assert!(dry.stderr.ends_with(&said), "{dry:?}");
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

/// Whether this is a request with this command.
fn is(request: &[u8], command: &[u8; 2]) -> bool {
    request.get(3..5) == Some(command)
}

/// How often such a request was received.
fn count(received: &[u8], command: &[u8; 2]) -> usize {
    received.split(|&byte| byte == 0x02).filter(|request| request.get(2..4) == Some(command)).count()
}

#[test]
#[cfg(unix)]
fn a_writing_that_is_interrupted_tells_which_pages_are_written_and_how_to_go_on() {
    use self::process::interrupted;

    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-interrupted"));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    sim.fatek(&["run"]).ok();
    let pages = AtomicUsize::new(0);
    // The fourth page is written, and not answered.
    let plc = Fake::before(&sim, move |request| !is(request, b"50") || pages.fetch_add(1, Ordering::Relaxed) < 3);
    let write = ["program", "write", "--raw", &raw, "--yes", "--all", "--stop", "--run"];
    let (status, said) = interrupted(&plc, &write, |received| count(received, b"50") == 4);
    assert_eq!(status, 1, "{said}");
    assert!(
        said.ends_with(
            "error: interrupted: 3 of the 11 pages that differ are written (1-3), page 4 perhaps, and the PLC ran before \
             and is stopped now: write the rest before it runs; repeat the command, then start the PLC with `fatek \
             run`\n"
        ),
        "{said}"
    );
    assert!(sim.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,false"));
    let again = sim.fatek(&write);
    assert!(again.stderr.ends_with("pages written and compared; the PLC is stopped\n"), "{again:?}");
    program(&sim, &["verify", "--raw", &raw]).ok();
    sim.fatek(&["run"]).ok();
}

#[test]
#[cfg(unix)]
fn a_reading_that_is_interrupted_leaves_the_file_as_it_was_and_nothing_beside_it() {
    use self::process::interrupted;

    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-read-interrupted"));
    let file = folder.file("a.program");
    fs::write(&file, "the old one").unwrap();
    let pages = AtomicUsize::new(0);
    let plc = Fake::before(&sim, move |request| !is(request, b"4F") || pages.fetch_add(1, Ordering::Relaxed) < 5);
    let (status, said) = interrupted(&plc, &["program", "read", &file], |received| count(received, b"4F") == 6);
    assert_eq!(status, 1, "{said}");
    // The pages are blank, and one that equals the page before it is asked for twice. Those that a check has confirmed count.
    assert!(said.contains("\nerror: interrupted after "), "{said}");
    assert!(said.ends_with(" pages: nothing was saved\n"), "{said}");
    assert_eq!(fs::read_to_string(&file).unwrap(), "the old one");
    assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 1);
}

#[test]
fn a_writing_goes_on_five_times_when_the_line_fails_and_then_no_more() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-five"));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    // Of each run one page gets through, and then nothing until the next one begins.
    let pages = AtomicUsize::new(0);
    let plc = Fake::before(&sim, move |request| {
        if is(request, b"53") {
            pages.store(0, Ordering::Relaxed);
        }
        if is(request, b"50") {
            pages.fetch_add(1, Ordering::Relaxed);
        }
        pages.load(Ordering::Relaxed) < 2
    });
    let write = ["--timeout", "50ms", "program", "write", "--raw", &raw, "--yes", "--all"];
    let ran = plc.fatek(&write);
    assert_eq!((ran.status, ran.stderr.matches("; resuming\n").count()), (4, 5), "{ran:?}");
    assert_eq!(count(&plc.received(), b"53"), 6, "{ran:?}");
    let last = ran.stderr.lines().last().unwrap();
    assert!(last.contains("1 of the 6 pages that differ are written (6), page 7 perhaps, and "), "{ran:?}");
    assert!(last.ends_with("write the rest before it runs; repeat the command"), "{ran:?}");

    // Nothing gets through: there is no use in going on.
    let sim = Sim::start(&["--ladder-words", "640"]);
    let plc = Fake::before(&sim, |request| !is(request, b"50"));
    let ran = plc.fatek(&write[..7]);
    assert_eq!((ran.status, ran.stderr.matches("resuming").count()), (4, 0), "{ran:?}");
}

#[test]
fn a_writing_that_goes_on_counts_what_it_has_written_before() {
    let (sim, folder) = (Sim::start(&["--ladder-words", "640"]), Folder::new("program-before"));
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    // All is written, and the last page is not read back any more: the next run finds nothing to do.
    let (runs, pages) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let plc = Fake::before(&sim, move |request| {
        runs.fetch_add(usize::from(is(request, b"53")), Ordering::Relaxed);
        pages.fetch_add(usize::from(is(request, b"50")), Ordering::Relaxed);
        !is(request, b"4F") || runs.load(Ordering::Relaxed) > 1 || pages.load(Ordering::Relaxed) < 2
    });
    let ran = plc.fatek(&["--timeout", "50ms", "program", "write", "--raw", &raw, "--yes"]);
    assert_eq!((ran.status, count(&plc.received(), b"53")), (0, 2), "{ran:?}");
    assert!(ran.stderr.ends_with("\n2 of 11 pages written and compared; the PLC is stopped\n"), "{ran:?}");
    program(&sim, &["verify", "--raw", &raw]).ok();
}

#[test]
fn where_nothing_can_be_saved_nothing_is_asked() {
    let folder = Folder::new("program-nowhere");
    let nobody = |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1"], args].concat());
    fs::write(folder.file("a"), "").unwrap();
    for (file, message) in [
        (folder.file("none/a"), "none/a: cannot make a new file in its folder: No such file"),
        (folder.file("a/b"), "a/b: cannot find it: Not a directory"),
        (folder.file("."), "not a regular file, so it is not replaced"),
    ] {
        for args in [&["program", "read", &file][..], &["backup", &file, "R0-R9"]] {
            // If anything were sent, the status would be 5.
            let ran = nobody(args);
            assert_eq!((ran.status, ran.stdout.as_str()), (1, ""), "{ran:?}");
            assert!(ran.stderr.contains(message), "{ran:?}");
        }
    }
    assert_eq!(nobody(&["program", "read", &folder.file("b")]).status, 5);
    assert!(!fs::exists(folder.file("b")).unwrap());
}

#[test]
fn without_a_terminal_writing_needs_a_yes_and_nothing_is_sent_without() {
    let folder = Folder::new("program-unasked");
    let raw = folder.file("new.bin");
    fs::write(&raw, raw_program()).unwrap();
    // Nobody listens there; if anything were sent, the status would be 5.
    let nobody = |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1", "program"], args].concat());
    let usage = nobody(&["write", "--raw", &raw]).usage();
    assert!(usage.contains("there is no terminal: give --yes or --dry-run"), "{usage}");
    assert_eq!(nobody(&["write", "--raw", &raw, "--yes"]).status, 5);
    assert!(nobody(&["write", "--raw", &raw, "--yes", "--run"]).usage().contains("--stop"));
}

#[test]
fn a_bad_file_is_refused_before_anything_is_sent_and_a_failed_reading_leaves_the_old_one() {
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

    let nobody = fatek(&["--link", "tcp://127.0.0.1:9", "--station", "1", "program", "read", &file]);
    assert_eq!(nobody.status, 5, "{nobody:?}");
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

/// At a terminal: what is asked, and what an answer does.
#[cfg(unix)]
mod terminal {
    use super::process::at_terminal;
    use super::*;

    fn answer(sim: &Sim, args: &[&str], answer: &str) -> (i32, String) {
        at_terminal(sim, &[&["program"], args].concat(), answer)
    }

    #[test]
    fn at_a_terminal_only_a_yes_changes_the_plc_and_a_bar_shows_how_far_it_is() {
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

        // Nothing is asked when nothing is to be changed, or when it was said before.
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
