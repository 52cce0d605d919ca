//! `fatek record` between the command line and a simulated PLC, and `fatek replay` of it both ways.
#![cfg(all(feature = "cli", unix))]

mod process;

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use self::process::{FATEK, Folder, Output, ScriptedPlc, Sim, fatek, run_at_terminal_on};

/// A running `fatek record` or `fatek replay --listen`, killed on drop.
struct Listening {
    child: Child,
    stdout: BufReader<ChildStdout>,
    /// URL for clients, with the framing.
    url: String,
}

impl Listening {
    fn start(args: &[&str]) -> Self {
        let mut command = Command::new(FATEK);
        command.args(args).env_remove("FATEK_LINK").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        let url = line.strip_prefix("listening ").and_then(|line| line.strip_suffix('\n'));
        let framing = if args.iter().any(|arg| arg.contains("binary")) { "?framing=binary" } else { "" };
        let url = format!("{}{framing}", url.unwrap_or_else(|| panic!("{line:?}")));
        Self { child, stdout, url }
    }

    fn record(file: &str, sim: &Sim) -> Self {
        let scheme = sim.url.split_once("://").unwrap().0;
        Self::start(&["record", file, "--listen", &format!("{scheme}://127.0.0.1:0"), "--link", &sim.url])
    }

    fn fatek(&self, args: &[&str]) -> Output {
        fatek(&[&["--link", &self.url, "--station", "1"], args].concat())
    }

    /// Ends it by a signal such as `INT`. Returns its status and output.
    fn end(mut self, signal: &str) -> (Option<i32>, String, String) {
        Command::new("kill").args([&format!("-{signal}"), &self.child.id().to_string()]).status().unwrap();
        let (mut stdout, mut stderr) = (String::new(), String::new());
        self.stdout.read_to_string(&mut stdout).unwrap();
        self.child.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
        (self.child.wait().unwrap().code(), stdout, stderr)
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const READ: [&str; 6] = ["read", "R0-R3", "M0-M3", "R100:f32", "--format", "json"];

/// Before: the request was sent at once, although the endpoint asks for a pause.
#[test]
fn the_first_request_waits_for_the_device_to_settle() {
    let (sim, folder) = (Sim::start(&[]), Folder::new("replay-settle"));
    let file = folder.file("status.recording");
    let recorder = Listening::record(&file, &sim);
    recorder.fatek(&["status"]).ok();
    recorder.end("INT");
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}?settle=400ms", listener.local_addr().unwrap());
    let device = thread::spawn(move || {
        let (mut client, _) = listener.accept().unwrap();
        let accepted = Instant::now();
        client.read_exact(&mut [0]).unwrap();
        accepted.elapsed()
    });
    fatek(&["replay", &file, "--link", &url, "--timeout", "50ms"]);
    // A lower limit: a slow machine takes longer.
    assert!(device.join().unwrap() >= Duration::from_millis(300));
}

#[test]
fn a_recorded_read_is_decoded_and_replayed_both_ways() {
    for args in [&["--set", "R0=7"][..], &["--set", "R0=7", "--framing", "binary"]] {
        let (folder, sim) = (Folder::new("record"), Sim::start(args));
        let file = folder.file("a.recording");
        let recorder = Listening::record(&file, &sim);
        let expected = sim.fatek(&READ).ok();
        assert_eq!(recorder.fatek(&READ).ok(), expected, "the proxy changes nothing");
        let (status, stdout, stderr) = recorder.end("INT");
        assert_eq!((status, stdout.as_str()), (Some(0), ""), "{stderr}");
        assert!(stderr.contains("; 1 connections, "), "{stderr}");

        let decoded = fatek(&["decode", "--file", &file]).ok();
        assert!(decoded.contains("loop back (4Eh)") && decoded.contains("mixed read (48h) "), "{decoded}");
        assert_eq!(decoded.lines().filter(|line| line.starts_with("connection ")).count(), 1, "{decoded}");

        // Other requests than at first: the loop-back has another number.
        let replay = Listening::start(&[&["replay", &file, "--listen", "tcp://127.0.0.1:0"], &args[2..]].concat());
        assert_eq!(replay.fatek(&READ).ok(), expected, "as recorded");
        assert_eq!(replay.fatek(&READ).ok(), expected, "and again");
        let unknown = replay.fatek(&["read", "R9", "--timeout", "30ms"]);
        assert_eq!(unknown.status, 4, "{unknown:?}");
        let (status, _, stderr) = replay.end("TERM");
        assert_eq!(status, Some(0), "{stderr}");
        // Once, though it was asked three times.
        assert_eq!(stderr.matches("no recorded reply: station 1: read registers (46h) R9").count(), 1, "{stderr}");
        assert!(stderr.contains(" requests answered, 3 without a recorded reply"), "{stderr}");

        let same = fatek(&["replay", &file, "--link", &sim.url]);
        assert_eq!((same.status, same.stdout.as_str()), (0, ""), "{same:?}");
        assert_eq!(same.stderr, "2 of 2 requests sent, 0 replies differ\n");
        sim.fatek(&["write", "R1=9"]).ok();
        let other = fatek(&["replay", &file, "--link", &sim.url, "--format", "json"]);
        assert_eq!(other.status, 7, "{other:?}");
        let rows: serde_json::Value = other.stdout.parse().unwrap();
        assert_eq!(rows.as_array().unwrap().len(), 1, "{other:?}");
        assert_eq!((&rows[0]["request"], &rows[0]["station"]), (&2.into(), &1.into()));
        assert_ne!(rows[0]["recorded"], rows[0]["now"], "{other:?}");
        assert!(other.stderr.ends_with("error: 1 of 2 replies differ\n"), "{other:?}");
    }
}

#[test]
fn datagrams_are_recorded_and_replayed() {
    let (folder, sim) = (Folder::new("record-udp"), Sim::start(&["--listen", "udp://127.0.0.1:0", "--set", "R0=7"]));
    let file = folder.file("a.recording");
    let recorder = Listening::record(&file, &sim);
    let expected = recorder.fatek(&READ).ok();
    assert_eq!(recorder.end("INT").0, Some(0));
    assert!(fs::read_to_string(&file).unwrap().contains(r#""datagram":true"#));
    assert!(fatek(&["decode", "--file", &file]).ok().contains("connection 1: udp 127.0.0.1:"));
    let replay = Listening::start(&["replay", &file, "--listen", "udp://127.0.0.1:0", "--timing", "recorded"]);
    assert_eq!(replay.fatek(&READ).ok(), expected);
    assert_eq!(fatek(&["replay", &file, "--link", &sim.url]).status, 0);
    let tcp = fatek(&["record", &folder.file("b"), "--link", "udp://127.0.0.1:5"]).usage();
    assert!(tcp.contains("a link over UDP is recorded with --listen udp://HOST:PORT"), "{tcp}");
}

#[test]
fn a_killed_recorder_has_lost_nothing_and_replaces_no_file() {
    let (folder, sim) = (Folder::new("record-kill"), Sim::start(&[]));
    let file = folder.file("a.recording");
    let recorder = Listening::record(&file, &sim);
    recorder.fatek(&["write", "R0=5"]).ok();
    // SIGKILL cannot be handled.
    assert_eq!(recorder.end("KILL").0, None);
    let content = fs::read_to_string(&file).unwrap();
    assert!(content.ends_with("}\n"), "{content}");
    assert!(fatek(&["decode", "--file", &file]).ok().contains("write registers (47h) R0 = 5: done"));

    let again = fatek(&["record", &file, "--link", &sim.url]);
    assert_eq!((again.status, again.stdout.as_str()), (1, ""), "{again:?}");
    assert!(again.stderr.contains("it exists already"), "{again:?}");
    assert_eq!(fs::read_to_string(&file).unwrap(), content);
    let nowhere = fatek(&["record", &folder.file("none/a"), "--link", &sim.url]);
    assert_eq!(nowhere.status, 1, "{nowhere:?}");

    // The last line is cut off, as by a power failure.
    fs::write(&file, &content[..content.len() - 9]).unwrap();
    let cut = fatek(&["decode", "--file", &file]);
    assert_eq!(cut.status, 0, "{cut:?}");
    assert!(cut.stderr.contains(", the last, is cut off\n"), "{cut:?}");
}

#[test]
fn writes_are_sent_only_if_asked_for() {
    let (folder, sim) = (Folder::new("replay-writes"), Sim::start(&[]));
    let file = folder.file("a.recording");
    let recorder = Listening::record(&file, &sim);
    recorder.fatek(&["write", "R0=5"]).ok();
    recorder.fatek(&["read", "R1"]).ok();
    recorder.end("INT");
    sim.fatek(&["write", "R0=6"]).ok();
    let value = || sim.fatek(&["read", "R0", "--format", "csv"]).ok();
    let is_unchanged = || value().contains("R0,u16,6");
    assert!(is_unchanged(), "{}", value());
    let replay = |args: &[&str]| fatek(&[&["replay", &file, "--link", &sim.url], args].concat());

    let refused = replay(&[]).usage();
    assert!(refused.contains("the first is station 1: write registers (47h) R0 = 5; to leave them out"), "{refused}");
    assert!(is_unchanged(), "without a choice");
    assert!(replay(&["--writes", "send"]).usage().contains("give --yes"));
    assert!(is_unchanged(), "without a consent");
    let listed = replay(&["--dry-run"]);
    assert_eq!(listed.status, 0, "{listed:?}");
    assert!(listed.stdout.contains("write registers (47h) R0 = 5  true\n"), "{listed:?}");
    assert!(is_unchanged(), "with --dry-run");
    assert_eq!(replay(&["--writes", "skip"]).status, 0);
    assert!(is_unchanged(), "with --writes skip");
    let args = ["replay", &file, "--writes", "send"];
    let (status, shown) = run_at_terminal_on(&sim.url, &args, "n\n");
    assert_eq!(status, 1, "{shown}");
    assert!(shown.contains("Send 4 requests to tcp://127.0.0.1:"), "{shown}");
    assert!(is_unchanged(), "after the answer n");

    assert_eq!(replay(&["--writes", "send", "--yes"]).status, 0);
    assert!(value().contains("R0,u16,5"), "{}", value());
}

#[test]
fn the_largest_size_ends_the_recording_and_not_the_conversation() {
    let (folder, sim) = (Folder::new("record-size"), Sim::start(&[]));
    let file = folder.file("a.recording");
    let args = ["record", &file, "--link", &sim.url, "--max-size", "1K"];
    let recorder = Listening::start(&args);
    for _ in 0..10 {
        recorder.fatek(&READ).ok();
    }
    let (status, _, stderr) = recorder.end("INT");
    assert_eq!(status, Some(0));
    assert!(stderr.contains("it has 1024 bytes (--max-size); the rest is not recorded"), "{stderr}");
    assert!((500..=1024).contains(&fs::metadata(&file).unwrap().len()));
    assert_eq!(fatek(&["decode", "--file", &file]).status, 0);
}

#[test]
fn a_recording_on_stdout_is_decoded_at_once() {
    let sim = Sim::start(&[]);
    let mut recorder = Command::new(FATEK)
        .args(["record", "-", "--link", &sim.url])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stderr = BufReader::new(recorder.stderr.take().unwrap());
    let mut line = String::new();
    stderr.read_line(&mut line).unwrap();
    let url = line.strip_prefix("listening ").unwrap_or_else(|| panic!("{line:?}")).trim_end();
    let stdout = recorder.stdout.take().unwrap();
    let mut decoder = Command::new(FATEK)
        .args(["decode", "--format", "json"])
        .stdin(stdout)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    fatek(&["--link", url, "--station", "1", "read", "R0"]).ok();
    let mut stdout = BufReader::new(decoder.stdout.take().unwrap());
    let mut line = String::new();
    // A line for the loop-back and one for the read, while the recorder runs.
    stdout.read_line(&mut line).unwrap();
    stdout.read_line(&mut line).unwrap();
    assert!(line.contains("read registers (46h) R0"), "{line}");
    recorder.kill().unwrap();
    recorder.wait().unwrap();
    // The decoder ends with the recorder.
    assert!(decoder.wait().unwrap().success());
}

#[test]
fn a_plc_that_is_not_there_is_reported() {
    let folder = Folder::new("record-none");
    let file = folder.file("a.recording");
    let recorder = Listening::start(&["record", &file, "--link", "tcp://127.0.0.1:1"]);
    let read = recorder.fatek(&["read", "R0", "--timeout", "300ms"]);
    assert!(read.status > 3, "{read:?}");
    let (status, _, stderr) = recorder.end("INT");
    assert_eq!(status, Some(0));
    assert!(stderr.contains("cannot connect: "), "{stderr}");

    let sim = Sim::start(&[]);
    let recorder = Listening::record(&folder.file("b.recording"), &sim);
    recorder.fatek(&["read", "R0"]).ok();
    recorder.end("INT");
    let gone = fatek(&["replay", &folder.file("b.recording"), "--link", "tcp://127.0.0.1:1"]);
    assert_eq!(gone.status, 5, "{gone:?}");
    let silent = Sim::start(&["--station", "9"]);
    let silent = fatek(&["replay", &folder.file("b.recording"), "--link", &silent.url, "--timeout", "30ms"]);
    assert_eq!(silent.status, 7, "{silent:?}");
    assert_eq!(silent.stdout.matches("  no reply\n").count(), 2, "{silent:?}");
}

#[test]
fn files_that_are_no_recordings_are_refused() {
    let folder = Folder::new("replay-bad");
    let file = folder.file("a");
    for (content, rule) in [
        ("hello\n", "neither a recording, nor a capture, nor a log of -vv"),
        ("{\"fatek\":\"recording\",\"version\":9}\n", "version 9 needs a newer `fatek`"),
        ("{\"fatek\":\"recording\",\"version\":1,\"started\":\"2026-11-29T18:00:00Z\"}\n", "it has no requests"),
        (
            "{\"fatek\":\"recording\",\"version\":1,\"started\":\"2026-11-29T18:00:00Z\"}\n{\"us\":1,\u{1b}\n{}\n",
            "line 2: no JSON",
        ),
    ] {
        fs::write(&file, content).unwrap();
        for args in [&["--link", "tcp://127.0.0.1:1"][..], &["--listen", "tcp://127.0.0.1:0"]] {
            let refused = fatek(&[&["replay", &file], args].concat());
            assert_eq!((refused.status, refused.stdout.as_str()), (7, ""), "{refused:?}");
            assert!(refused.stderr.contains(rule), "{refused:?}");
        }
    }
    assert!(fatek(&["replay", &file]).usage().contains("no link"));
}

/// The header of a recording, and its events.
fn recording(framing: &str, events: &[&str]) -> String {
    let header = format!(
        "{{\"fatek\":\"recording\",\"version\":1,\"started\":\"2026-11-29T18:00:00Z\",\"framing\":\"{framing}\"}}\n"
    );
    events.iter().fold(header, |text, event| text + event + "\n")
}

/// An event of connection 1 at this time.
fn passed(micros: u64, to: &str, content: &str) -> String {
    let digits: String = process::ascii(content).iter().map(|byte| format!("{byte:02x}")).collect();
    format!("{{\"us\":{micros},\"connection\":1,\"to\":\"{to}\",\"bytes\":\"{digits}\"}}")
}

/// Before: the copy was the reply to the second request, and so was the frame of three values: 2 of 3
/// replies differed, with status 7.
#[test]
fn doubled_and_late_replies_are_not_those_of_other_requests() {
    let folder = Folder::new("replay-doubled");
    let file = folder.file("a.recording");
    let exchanges = [("014601R00000", "014600007"), ("014601R00001", "014600008"), ("014601R00002", "014600009")];
    let exchange = |(i, (request, reply)): (u64, (&str, &str))| {
        [passed(2000 * i, "plc", request), passed(2000 * i + 1000, "client", reply)]
    };
    let events: Vec<String> = (0..).zip(exchanges).flat_map(exchange).collect();
    let events: Vec<&str> = events.iter().map(String::as_str).collect();
    fs::write(&file, recording("ascii", &events)).unwrap();
    let plc = ScriptedPlc::start(|request| match &request[11..13] {
        b"00" => process::ascii("014600007"),
        b"01" => ["014600007", "014600008"].map(process::ascii).concat(),
        _ => ["01460000100020003", "014600009"].map(process::ascii).concat(),
    });
    let same = fatek(&["replay", &file, "--link", &plc.url]);
    assert_eq!((same.status, same.stdout.as_str()), (0, ""), "{same:?}");
    // An equal reply to another request is one, if nothing else comes.
    let plc = ScriptedPlc::start(|_| process::ascii("014600007"));
    let other = fatek(&["replay", &file, "--link", &plc.url]);
    assert!(other.stderr.ends_with("error: 2 of 3 replies differ\n"), "{other:?}");
}

/// Before: it waited without end after the first request.
#[test]
fn pauses_without_end_are_refused_before_anything_is_sent() {
    let folder = Folder::new("replay-pause");
    let file = folder.file("a.recording");
    let events = [passed(0, "plc", "014601R00000"), passed(u64::MAX, "plc", "014601R00001")];
    fs::write(&file, recording("ascii", &events.each_ref().map(String::as_str))).unwrap();
    let plc = ScriptedPlc::start(|_| process::ascii("014600007"));
    let refused = fatek(&["replay", &file, "--link", &plc.url, "--timing", "recorded"]);
    assert_eq!(refused.status, 7, "{refused:?}");
    assert!(refused.stderr.contains("the most is 24 h; give --timing fast"), "{refused:?}");
    assert!(plc.received().is_empty());
}

/// Before: status 0, since a serial port that ended was a connection that ended.
#[cfg(feature = "serial")]
#[test]
fn a_recording_of_a_serial_port_fails_with_its_link() {
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

    let folder = Folder::new("record-serial");
    let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&terminal).unwrap();
    unlockpt(&terminal).unwrap();
    let path = ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
    let listen = format!("serial:{path}");
    let failed =
        fatek(&["record", &folder.file("a"), "--listen", &listen, "--link", "tcp://127.0.0.1:1", "--timeout", "1s"]);
    assert_eq!(failed.status, 5, "{failed:?}");
    assert!(failed.stderr.contains("cannot connect to tcp://127.0.0.1:1"), "{failed:?}");
}

/// Before: `neither a recording, nor a capture, nor a log of -vv`.
#[test]
fn a_log_with_other_lines_before_it_is_replayed() {
    let (folder, sim) = (Folder::new("replay-log"), Sim::start(&["--set", "R0=7"]));
    let file = folder.file("a.log");
    let logged = sim.fatek(&["-vv", "read", "R0"]);
    fs::write(&file, format!("warning: x\n{}", logged.stderr)).unwrap();
    assert_eq!(fatek(&["replay", &file, "--link", &sim.url]).status, 0);
}

/// Before: the reply was neither passed on nor recorded, 2 s after the client had closed its direction.
#[test]
fn a_reply_after_the_client_has_closed_its_direction_is_passed_on() {
    let folder = Folder::new("record-half");
    let file = folder.file("a.recording");
    let plc = TcpListener::bind("127.0.0.1:0").unwrap();
    let link = format!("tcp://{}", plc.local_addr().unwrap());
    let recorder = Listening::start(&["record", &file, "--link", &link]);
    let mut client = TcpStream::connect(recorder.url.strip_prefix("tcp://").unwrap()).unwrap();
    client.write_all(&process::ascii("014601R00000")).unwrap();
    client.shutdown(Shutdown::Write).unwrap();
    let (mut stream, _) = plc.accept().unwrap();
    let mut request = Vec::new();
    // The end of the client is passed on.
    stream.read_to_end(&mut request).unwrap();
    assert_eq!(request, process::ascii("014601R00000"));
    // Longer than the limit was before.
    thread::sleep(Duration::from_millis(2500));
    stream.write_all(&process::ascii("014600007")).unwrap();
    drop(stream);
    let mut reply = Vec::new();
    client.read_to_end(&mut reply).unwrap();
    assert_eq!(reply, process::ascii("014600007"));
    assert_eq!(recorder.end("INT").0, Some(0));
    assert!(fatek(&["decode", "--file", &file]).ok().contains("read registers (46h) R0: 7"));
}
