//! `fatek backup` and `fatek restore` as processes, against `fatek sim` as another process.
#![cfg(feature = "cli")]

mod process;

use std::fs;
use std::sync::atomic::{AtomicUsize, Ordering};

use self::process::{Folder, Output, ScriptedPlc, Sim, ascii, fatek};

/// Saves a backup of R0 to R99 and M0 to M9 of this PLC; returns the file.
fn saved(sim: &Sim, folder: &Folder) -> String {
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "R0-R99", "M0-M9", "-q"]).ok();
    file
}

fn values(sim: &Sim, tags: &[&str]) -> Vec<String> {
    let read = sim.fatek(&[&["read", "--format", "csv"], tags].concat()).ok();
    read.lines().skip(1).map(|line| line.rsplit(',').next().unwrap().to_owned()).collect()
}

#[test]
fn a_backup_is_compared_and_restored_in_both_framings() {
    for framing in ["ascii", "binary"] {
        let (sim, folder) = (Sim::start(&["--framing", framing, "--set", "R5=7", "M3=1"]), Folder::new(framing));
        let file = folder.file("plant.backup");
        let ran = sim.fatek(&["backup", &file, "R0-R99", "M0-M9", "R200-R203:f32"]);
        assert!(ran.stderr.starts_with("reading: 64 of 114, 128 bytes"), "{ran:?}");
        assert!(ran.stderr.ends_with("plant.backup: 114 elements\n"), "{ran:?}");
        assert_eq!(ran.ok(), "");
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.starts_with("fatek file 1: backup\n"), "{text}");
        assert!(text.contains("\nrange R0-R99\nR0 0000 0000 0000 0000 0000 0007 0000 0000\n"), "{text}");

        let same = sim.fatek(&["backup", &file, "--compare"]);
        assert!(same.stderr.ends_with("all 114 elements are equal\n"), "{same:?}");
        assert_eq!(same.ok(), "", "no header without a row");
        sim.fatek(&["write", "R5=9", "R6=1", "M3=0", "R100=5"]).ok();
        let differs = sim.fatek(&["backup", &file, "--compare", "--format", "json"]);
        assert_eq!(differs.status, 7, "{differs:?}");
        assert!(differs.stderr.ends_with("error: 3 of 114 elements differ\n"), "{differs:?}");
        let expected = serde_json::json!([
            { "element": "R5", "backup": 7, "plc": 9 },
            { "element": "R6", "backup": 0, "plc": 1 },
            { "element": "M3", "backup": true, "plc": false },
        ]);
        assert_eq!(differs.stdout.parse::<serde_json::Value>().unwrap(), expected);

        let dry = sim.fatek(&["restore", &file, "R0-R5", "--dry-run", "--format", "csv"]);
        assert!(dry.stderr.ends_with("1 of 6 elements would be written\n"), "{dry:?}");
        assert_eq!(dry.ok(), "element,backup,plc\nR5,7,9\n");
        assert_eq!(values(&sim, &["R5", "R6", "M3"]), ["9", "1", "0"], "nothing was written");

        let restored = sim.fatek(&["restore", &file, "R0-R5", "M0-M9", "--yes"]);
        assert!(restored.stderr.contains("\nverifying: 16 of 16, 14 bytes"), "{restored:?}");
        assert!(restored.stderr.ends_with("16 elements compared, 2 differed, 2 written\n"), "{restored:?}");
        assert_eq!(restored.ok(), "");
        assert_eq!(values(&sim, &["R5", "R6", "M3", "R100"]), ["7", "1", "1", "5"]);
        sim.fatek(&["restore", &file, "-y"]).ok();
        assert_eq!(values(&sim, &["R5", "R6", "M3", "R100"]), ["7", "0", "1", "5"]);
        assert_eq!(sim.fatek(&["restore", &file, "-y", "-q"]).stderr, "");
    }
}

#[test]
fn a_resumed_restore_counts_earlier_writes() {
    let (sim, folder) = (Sim::start(&[]), Folder::new("restore-before"));
    let file = saved(&sim, &folder);
    sim.fatek(&["write", "R5=9", "R80=1"]).ok();
    let of = |request: &[u8], code: &[u8; 2]| usize::from(request.get(3..5) == Some(code));
    // All is written, but no read is answered until the next attempt, which begins with two more 40.
    let (attempts, writes) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let plc = ScriptedPlc::proxy(&sim, move |request| {
        attempts.fetch_add(of(request, b"40"), Ordering::Relaxed);
        // The second of two equal writes is a 49, so that its reply has another shape.
        writes.fetch_add(of(request, b"47") + of(request, b"49"), Ordering::Relaxed);
        of(request, b"46") == 0 || attempts.load(Ordering::Relaxed) > 2 || writes.load(Ordering::Relaxed) < 2
    });
    let ran = plc.fatek(&["--timeout", "50ms", "restore", &file, "--yes"]);
    assert_eq!(ran.status, 0, "{ran:?}");
    assert!(
        ran.stderr.ends_with("\n110 elements compared, 0 differed, 0 written; 2 written by earlier attempts\n"),
        "{ran:?}"
    );
    assert_eq!(values(&sim, &["R5", "R80"]), ["0", "0"]);
}

#[test]
fn special_elements_of_a_file_are_restored_by_choice() {
    let (sim, folder) = (Sim::start(&["--set", "R3839=1", "R3840=2"]), Folder::new("backup-special"));
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "R3839-R3840"]).ok();
    sim.fatek(&["write", "R3839-R3840=0,0", "--special"]).ok();
    for args in [&["restore", &file, "--yes"][..], &["restore", &file, "--dry-run"]] {
        let refused = sim.fatek(args);
        assert_eq!(refused.status, 2, "{refused:?}");
        assert!(refused.stderr.contains("has the special element R3840: "), "{refused:?}");
    }
    assert_eq!(values(&sim, &["R3839", "R3840"]), ["0", "0"]);
    let skipped = sim.fatek(&["restore", &file, "--yes", "--special", "skip"]);
    assert!(
        skipped.stderr.contains("R3840 skipped: special elements; to write them give --special write"),
        "{skipped:?}"
    );
    assert_eq!((skipped.status, values(&sim, &["R3839", "R3840"])), (0, vec!["1".to_owned(), "0".to_owned()]));
    sim.fatek(&["restore", &file, "--yes", "--special", "write"]).ok();
    assert_eq!(values(&sim, &["R3839", "R3840"]), ["1", "2"]);
}

#[test]
fn missing_elements_are_reported_and_empty_backups_not_saved() {
    let (sim, folder) = (Sim::start(&["--last", "R99", "--set", "R0=1"]), Folder::new("backup-missing"));
    let file = folder.file("plant.backup");
    let ran = sim.fatek(&["backup", &file, "R90-R109", "M0-M9"]);
    assert_eq!((ran.status, ran.stdout.as_str()), (3, ""), "{ran:?}");
    assert!(ran.stderr.contains("\nR100-R109 is missing: refused: illegal address (A)\n"), "{ran:?}");
    assert!(ran.stderr.contains("error: 10 of 30 elements are missing; the others were saved to "), "{ran:?}");
    let text = fs::read_to_string(&file).unwrap();
    assert!(text.contains("\nmissing R100-R109 refused A\n") && !text.contains("R100 "), "{text}");
    sim.fatek(&["backup", &file, "--compare"]).ok();

    let nothing = sim.fatek(&["backup", &file, "R100-R109"]);
    assert_eq!(nothing.status, 3, "{nothing:?}");
    assert!(nothing.stderr.ends_with("error: 10 of 10 elements are missing; nothing was saved\n"), "{nothing:?}");
    assert_eq!(fs::read_to_string(&file).unwrap(), text);

    let large = Sim::start(&["--set", "R95=3"]);
    let larger = folder.file("larger.backup");
    large.fatek(&["backup", &larger, "R90-R109"]).ok();
    let refused = sim.fatek(&["restore", &larger, "--yes"]);
    assert_eq!(refused.status, 3, "{refused:?}");
    assert!(refused.stderr.contains("\nR100-R109 was refused: illegal address (A)\n"), "{refused:?}");
    assert!(refused.stderr.contains("error: the PLC refuses 10 of the elements, so none was written"), "{refused:?}");
    assert_eq!(values(&sim, &["R95"]), ["0"]);
}

#[test]
fn gaps_of_a_backup_are_reported_on_compare_and_restore() {
    let (sim, folder) = (Sim::start(&["--last", "R99"]), Folder::new("backup-lacking"));
    let file = folder.file("plant.backup");
    assert_eq!(sim.fatek(&["backup", &file, "R90-R109"]).status, 3);
    let large = Sim::start(&["--set", "R95=3", "R105=9"]);
    let missing = "\nR100-R109 is missing in the backup: refused: illegal address (A)\n";
    let restored = large.fatek(&["restore", &file, "--yes"]);
    assert!(restored.stderr.contains(missing), "{restored:?}");
    assert!(restored.stderr.ends_with(" 1 written, 10 missing in the backup\n"), "{restored:?}");
    restored.ok();
    assert_eq!(values(&large, &["R95", "R105"]), ["0", "9"]);
    let compared = large.fatek(&["backup", &file, "--compare"]);
    assert!(compared.stderr.contains(missing), "{compared:?}");
    compared.ok();
}

#[test]
fn stop_and_run_are_done_only_on_request() {
    let (sim, folder) = (Sim::start(&["--set", "R5=7"]), Folder::new("backup-running"));
    let file = saved(&sim, &folder);
    sim.fatek(&["run"]).ok();
    let runs = || sim.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,true");
    let restore = |args: &[&str]| {
        sim.fatek(&["write", "R5=1", "-q"]).ok();
        sim.fatek(&[&["restore", &file, "--yes"], args].concat())
    };
    let refused = restore(&["--require-stopped"]);
    assert_eq!(refused.status, 7, "{refused:?}");
    assert!(refused.stderr.starts_with("error: the PLC runs: stop it first"), "{refused:?}");
    assert_eq!((runs(), values(&sim, &["R5"])), (true, vec!["1".to_owned()]));

    assert!(restore(&[]).stderr.ends_with("1 differed, 1 written\n") && runs());
    let again = restore(&["--stop", "--run"]);
    assert!(again.stderr.ends_with("1 written; it was stopped, and the PLC runs\n") && runs(), "{again:?}");
    let stopped = restore(&["--stop"]);
    assert!(stopped.stderr.ends_with("1 written; it was stopped, and the PLC is stopped\n") && !runs(), "{stopped:?}");
    assert_eq!(values(&sim, &["R5"]), ["7"]);
    assert!(restore(&["--run"]).usage().contains("--stop"));
}

#[test]
fn a_dry_run_predicts_the_real_run() {
    let (sim, folder) = (Sim::start(&["--set", "R5=7"]), Folder::new("backup-dry"));
    let file = folder.file("plant.backup");
    // One half of the first value differs; M3 is forced, and X0 is an input.
    sim.fatek(&["backup", &file, "R0-R9:f32", "M0-M9", "X0-X9"]).ok();
    sim.fatek(&["disable", "M3"]).ok();
    let disturb = || {
        sim.fatek(&["run", "-q"]).ok();
        sim.fatek(&["write", "R0=1", "M4=1", "M6=1", "-q"]).ok();
        sim.fatek(&["set", "M3", "X0", "-q"]).ok();
    };
    let restore = |args: &[&str]| {
        disturb();
        sim.fatek(&[&["restore", &file, "--format", "csv"], args].concat())
    };
    for (args, written, stopped) in [
        (&[][..], 4, ""),
        (&["--bridge", "1"], 5, ""),
        (&["--stop"], 4, "; the PLC runs, and would be stopped"),
        (&["--stop", "--run"], 4, "; the PLC runs, and would be stopped and started again"),
    ] {
        let dry = restore(&[&["--dry-run"], args].concat());
        assert!(dry.stderr.ends_with(&format!("\n{written} of 30 elements would be written{stopped}\n")), "{dry:?}");
        assert_eq!(dry.ok(), "element,backup,plc\nR0,0,1\nM4,0,1\nM6,0,1\n");
        assert_eq!(values(&sim, &["R0", "M4"]), ["1", "1"]);
        assert!(sim.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,true"));
        let real = restore(&[&["--yes"], args].concat());
        assert!(real.stderr.contains(&format!("differed, {written} written")), "{real:?}");
        real.ok();
    }
    // Refusals of the real run.
    for (args, status) in [(&["--require-stopped"][..], 7), (&["--require-stopped", "R0-R9:f32"], 7)] {
        let (dry, real) = (restore(&[&["--dry-run"], args].concat()), restore(&[&["--yes"], args].concat()));
        assert_eq!((dry.status, &dry.stderr, &dry.stdout), (status, &real.stderr, &real.stdout), "{dry:?}");
        assert_eq!((dry.status, dry.stderr.starts_with("error: the PLC runs")), (real.status, true), "{dry:?}");
    }
    // Without a difference the PLC is not stopped.
    sim.fatek(&["restore", &file, "--yes"]).ok();
    let dry = sim.fatek(&["restore", &file, "--dry-run", "--stop"]);
    assert!(dry.stderr.ends_with("\n0 of 30 elements would be written\n"), "{dry:?}");
}

#[test]
fn ranges_missing_in_the_file_send_nothing() {
    let (sim, folder) = (Sim::start(&["--last", "R99"]), Folder::new("backup-nothing"));
    let file = folder.file("plant.backup");
    assert_eq!(sim.fatek(&["backup", &file, "R90-R109"]).status, 3);
    let without_plc = |args: &[&str]| fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1"], args].concat());
    for args in [&["restore", &file, "R100-R109", "--yes"][..], &["backup", &file, "R101", "--compare"]] {
        let stderr = without_plc(args).usage();
        assert!(stderr.contains("plant.backup has no value in these ranges: R10"), "{stderr}");
        assert!(stderr.contains(" is missing, refused: illegal address (A)"), "{stderr}");
    }
}

#[test]
fn forced_discretes_and_inputs_are_left_out() {
    let (sim, folder) = (Sim::start(&[]), Folder::new("backup-forced"));
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "X0-X9", "M0-M9"]).ok();
    sim.fatek(&["disable", "M3"]).ok();
    sim.fatek(&["set", "M3", "M4", "X0"]).ok();
    let restored = sim.fatek(&["restore", &file, "--yes"]);
    assert!(restored.stderr.contains("\nX0-X9 skipped: "), "{restored:?}");
    assert!(
        restored.stderr.contains("\nM3 skipped: it differs, but is disabled; to write it give --forced\n"),
        "{restored:?}"
    );
    restored.ok();
    assert_eq!(values(&sim, &["M3", "M4", "X0"]), ["1", "0", "1"]);
    sim.fatek(&["restore", &file, "--yes", "--forced"]).ok();
    assert_eq!(values(&sim, &["M3", "X0"]), ["0", "1"]);
}

#[test]
fn compare_reports_inputs_that_differ() {
    let (sim, folder) = (Sim::start(&[]), Folder::new("backup-inputs"));
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "X0-X9", "R0"]).ok();
    sim.fatek(&["backup", &file, "--compare"]).ok();
    sim.fatek(&["set", "X3"]).ok();
    let compared = sim.fatek(&["backup", &file, "--compare", "--format", "csv"]);
    assert_eq!((compared.status, compared.stdout.as_str()), (7, "element,backup,plc\nX3,0,1\n"), "{compared:?}");
    assert!(compared.stderr.ends_with("error: 1 of 11 elements differ\n"), "{compared:?}");
    let dry = sim.fatek(&["restore", &file, "--dry-run", "--format", "csv"]);
    assert!(dry.stderr.ends_with("\n0 of 11 elements would be written\n"), "{dry:?}");
    assert_eq!(dry.ok(), "element,backup,plc\n");
    let small = Sim::start(&["--last", "X7"]).fatek(&["backup", &file, "--compare"]);
    assert!(small.stderr.contains("\nX8-X9 was refused: illegal address (A)\n"), "{small:?}");
    assert_eq!(small.status, 7, "{small:?}");
}

#[test]
fn elements_that_keep_another_value_are_status_7() {
    // A PLC whose R0 is always 5.
    let plc = ScriptedPlc::start(|request| match &request[3..5] {
        b"40" => ascii("01400010000"),
        b"46" => ascii("014600005"),
        b"47" => ascii("01470"),
        _ => ascii("01534"),
    });
    let (sim, folder) = (Sim::start(&[]), Folder::new("backup-stubborn"));
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "R0"]).ok();
    let unchanged = plc.fatek(&["restore", &file, "--yes", "--force", "--format", "csv"]);
    assert_eq!((unchanged.status, unchanged.stdout.as_str()), (7, "element,backup,plc\nR0,0,5\n"), "{unchanged:?}");
    assert!(unchanged.stderr.contains("error: 1 elements do not hold their value of the backup: "), "{unchanged:?}");
}

#[test]
fn a_plc_started_during_a_restore_is_status_7() {
    use std::sync::atomic::{AtomicBool, Ordering};

    // A PLC that is stopped until R0 has been written.
    let written = AtomicBool::new(false);
    let plc = ScriptedPlc::start(move |request| match (&request[3..5], written.load(Ordering::SeqCst)) {
        (b"40", false) => ascii("01400000000"),
        (b"40", true) => ascii("01400010000"),
        (b"46", false) => ascii("014600005"),
        (b"46", true) => ascii("014600000"),
        (b"47", _) => {
            written.store(true, Ordering::SeqCst);
            ascii("01470")
        }
        _ => ascii("01534"),
    });
    let (sim, folder) = (Sim::start(&[]), Folder::new("backup-set-running"));
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "R0"]).ok();
    let ran = plc.fatek(&["restore", &file, "--yes", "--force", "--require-stopped", "-q"]);
    assert_eq!(ran.status, 7, "{ran:?}");
    assert!(ran.stderr.starts_with("error: another client started the PLC while it was restored; 1 "), "{ran:?}");
}

#[test]
fn without_yes_or_with_a_bad_file_nothing_is_sent() {
    let (sim, folder) = (Sim::start(&["--set", "R5=7"]), Folder::new("backup-unasked"));
    let file = saved(&sim, &folder);
    // No PLC listens there: a request would give status 5.
    let without_plc =
        |args: &[&str]| -> Output { fatek(&[&["--link", "tcp://127.0.0.1:9", "--station", "1"], args].concat()) };
    assert!(without_plc(&["restore", &file]).usage().contains("there is no terminal: give --yes or --dry-run"));
    assert!(
        without_plc(&["restore", &file, "R0-R100", "-y"])
            .usage()
            .contains("R0-R100 is not wholly in one range of the backup")
    );
    assert!(without_plc(&["backup", &file]).usage().contains("<RANGE>"));
    assert!(without_plc(&["backup", &file, "R0-R9", "DR4"]).usage().contains("R0-R9 and DR4 share memory"));
    assert_eq!(without_plc(&["restore", &file, "-y"]).status, 5);
    assert_eq!(without_plc(&["backup", &file, "R0"]).status, 5);

    let text = fs::read_to_string(&file).unwrap();
    for (bad, message) in [
        (text.replace("0007", "0008"), "it is damaged: its checksum is"),
        (text[..text.len() - 30].to_owned(), "it is cut off"),
        ("[Interface]\n".to_owned(), "it does not begin with `fatek file`"),
        (text.replace(": backup", ": program"), "it holds `program`, where `backup` was expected"),
    ] {
        let other = folder.file("other");
        fs::write(&other, &bad).unwrap();
        for args in [["restore", &other, "-y"], ["backup", &other, "--compare"]] {
            let ran = without_plc(&args);
            assert_eq!(ran.status, 7, "{ran:?}");
            assert!(ran.stderr.contains("other: ") && ran.stderr.contains(message), "{ran:?}");
        }
    }
    assert_eq!(fs::read_to_string(&file).unwrap(), text, "a failed backup changes nothing");
    assert_eq!(without_plc(&["restore", &folder.file("none"), "-y"]).status, 1);
}

#[test]
#[cfg(unix)]
fn at_a_terminal_a_restore_needs_a_yes() {
    use self::process::run_at_terminal;

    let (sim, folder) = (Sim::start(&["--set", "R5=7"]), Folder::new("backup-terminal"));
    let file = saved(&sim, &folder);
    sim.fatek(&["write", "R5=9"]).ok();
    let (_, shown) = run_at_terminal(&sim, &["restore", &file, "--stop"], "n\n");
    assert!(shown.contains(&format!(" on {}? [y/N] ", sim.url)), "it is stopped already: {shown}");
    sim.fatek(&["run"]).ok();
    let (status, shown) = run_at_terminal(&sim, &["restore", &file, "--require-stopped"], "");
    assert!(
        status == 7 && shown.contains("error: the PLC runs: stop it first, or give --stop"),
        "no question before an error: {shown}"
    );
    for no in ["n\n", "\n"] {
        let (status, shown) = run_at_terminal(&sim, &["restore", &file, "--stop"], no);
        assert_eq!(status, 1, "{shown}");
        assert!(shown.contains("\r\nR5       7       9\r\n"), "{shown}");
        let question =
            format!("plant.backup to station 1 on {}? The PLC is stopped first and stays stopped. [y/N] ", sim.url);
        assert!(shown.contains("\nWrite 1 of 110 elements of ") && shown.contains(&question), "{shown}");
        assert!(shown.ends_with("error: not confirmed: nothing was changed\r\n"), "{shown}");
        assert_eq!(values(&sim, &["R5"]), ["9"]);
    }
    let (status, shown) = run_at_terminal(&sim, &["restore", &file], "y\n");
    assert_eq!(status, 0, "{shown}");
    assert!(shown.contains("[####################] verifying: 110 of 110, 202 bytes"), "{shown}");
    assert!(shown.ends_with("\r\n110 elements compared, 1 differed, 1 written\r\n"), "{shown}");
    assert_eq!(values(&sim, &["R5"]), ["7"]);
    // No question if nothing is to be changed, or with --yes.
    assert_eq!(run_at_terminal(&sim, &["restore", &file], "").0, 0);
    assert_eq!(run_at_terminal(&sim, &["restore", &file, "--yes"], "").0, 0);
}

#[test]
#[cfg(unix)]
fn an_interrupted_restore_reports_its_progress() {
    use std::process::{Command, Stdio};

    // A PLC that holds 0 and does not answer writes.
    let plc = ScriptedPlc::start(|request| match &request[3..5] {
        b"40" => ascii("01400010000"),
        b"46" => ascii("014600000"),
        b"47" => vec![],
        _ => ascii("01534"),
    });
    let (sim, folder) = (Sim::start(&["--set", "R0=1"]), Folder::new("backup-interrupted"));
    let file = folder.file("plant.backup");
    sim.fatek(&["backup", &file, "R0"]).ok();
    let mut command = Command::new(process::FATEK);
    command.args(["--link", &plc.url, "--station", "1", "--timeout", "60s", "restore", &file, "--yes", "--force"]);
    let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    while !plc.received().windows(2).any(|window| window == b"47") {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let ended = child.wait_with_output().unwrap();
    let stderr = String::from_utf8(ended.stderr).unwrap();
    assert_eq!(ended.status.code(), Some(130), "{stderr}");
    assert!(
        stderr.ends_with(
            "error: interrupted by SIGINT: 1 elements compared, 1 differed, 0 written, 1 perhaps written; another PLC \
             than that of the backup: program capacity not stated instead of FBE 13K, no detailed status (53)\n"
        ),
        "{stderr}"
    );
}
