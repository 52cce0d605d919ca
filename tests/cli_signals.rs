//! Signals, pipes at stdout, and named pipes as files: `fatek` as a process.
#![cfg(all(feature = "cli", unix))]

mod process;

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use process::{FATEK, Folder, ScriptedPlc, Sim, ascii, fatek, run_and_signal};

const SIGNALS: [(&str, i32); 3] = [("INT", 130), ("TERM", 143), ("HUP", 129)];

/// Waits for the end of a process; `None` if it still runs after this time.
fn ended_within(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let begun = Instant::now();
    while begun.elapsed() < limit {
        if let Some(status) = child.try_wait().unwrap() {
            return Some(status);
        }
        sleep(Duration::from_millis(10));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    None
}

fn signal(child: &Child, name: &str) {
    Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
}

/// Starts `fatek watch` of these tags, with a pipe at stdout.
fn watch(sim: &Sim, args: &[&str]) -> Child {
    let mut command = Command::new(FATEK);
    command.args(["--link", &sim.url, "--station", "1", "--quiet", "watch"]).args(args);
    command.stdout(Stdio::piped()).spawn().unwrap()
}

/// Before: the process was killed by the signal, without a word about the values.
#[test]
fn an_interrupted_write_reports_the_values_written() {
    for (name, status) in SIGNALS {
        let writes = AtomicUsize::new(0);
        // The third write is not answered.
        let plc = ScriptedPlc::start(move |request| {
            let code = String::from_utf8(request[3..5].to_vec()).unwrap();
            if writes.fetch_add(1, Ordering::Relaxed) < 2 { ascii(&format!("01{code}0")) } else { Vec::new() }
        });
        let third = |received: &[u8]| received.windows(5).filter(|window| window == b"R0000").count() >= 3;
        let write = ["write", "R0=1", "R1=2", "R2-R3=3,4", "R4=5"];
        let (found, stderr) = run_and_signal(&plc, name, &write, third);
        let expected = format!(
            "wrote R0=1\nwrote R1=2\nerror: interrupted by SIG{name}: 2 of 5 values were written, R2-R3 perhaps or in \
             part\n"
        );
        assert_eq!((found, stderr.as_str()), (status, expected.as_str()));

        let plc = ScriptedPlc::start(|_| Vec::new());
        let (found, stderr) = run_and_signal(&plc, name, &["set", "M0", "M1"], |received| {
            received.windows(5).any(|window| window == b"M0000")
        });
        let expected = format!("error: interrupted by SIG{name}: 0 of 2 commands were executed, set M0 perhaps\n");
        assert_eq!((found, stderr.as_str()), (status, expected.as_str()));
    }
}

/// Before: a signal was noticed only when the pipe was read again.
#[test]
fn a_full_pipe_does_not_keep_watch_alive() {
    let sim = Sim::start(&[]);
    let mut watching = watch(&sim, &["R0-R199", "--interval", "10ms"]);
    // A line has 40 bytes: 200 lines each 10 ms soon fill the pipe of 64 KiB.
    sleep(Duration::from_millis(1500));
    signal(&watching, "TERM");
    let status = ended_within(&mut watching, Duration::from_secs(5)).expect("it ends");
    assert_eq!(status.code(), Some(143));
}

/// Before: without a change, and so without a line, the closed pipe was not noticed.
#[cfg(target_os = "linux")]
#[test]
fn watch_ends_when_its_reader_has_gone() {
    let sim = Sim::start(&[]);
    let mut watching = watch(&sim, &["R0", "--on-change", "--interval", "500ms"]);
    let mut lines = BufReader::new(watching.stdout.take().unwrap()).lines();
    assert!(lines.next().unwrap().unwrap().starts_with("TIME"));
    assert!(lines.next().unwrap().unwrap().ends_with("R0   0"));
    drop(lines);
    let status = ended_within(&mut watching, Duration::from_secs(5)).expect("it ends");
    assert_eq!(status.code(), Some(0));
}

/// Before: SIGHUP killed `watch`, without its summary.
#[test]
fn watch_ends_in_order_at_every_signal() {
    let sim = Sim::start(&[]);
    for (name, _) in SIGNALS {
        let mut command = Command::new(FATEK);
        command.args(["--link", &sim.url, "--station", "1", "watch", "R0", "--interval", "10ms"]);
        let mut watching = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        BufReader::new(watching.stdout.as_mut().unwrap()).read_line(&mut String::new()).unwrap();
        signal(&watching, name);
        let status = ended_within(&mut watching, Duration::from_secs(5)).expect("it ends");
        let mut stderr = String::new();
        watching.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
        assert_eq!(status.code(), Some(0), "{name}: {stderr}");
        assert!(stderr.contains(" poll cycle"), "{name}: {stderr}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_command_started_by_nohup_stays_at_hangup() {
    let sim = Sim::start(&[]);
    let mut command = Command::new("nohup");
    command.arg(FATEK).args(["--link", &sim.url, "--station", "1", "--quiet", "watch", "R0", "--interval", "10ms"]);
    let mut watching = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut lines = BufReader::new(watching.stdout.take().unwrap()).lines();
    lines.nth(1).unwrap().unwrap();
    signal(&watching, "HUP");
    for _ in 0..20 {
        lines.next().expect("it goes on").unwrap();
    }
    signal(&watching, "TERM");
    assert_eq!(ended_within(&mut watching, Duration::from_secs(5)).expect("it ends").code(), Some(0));
}

/// Before: it waited for a program that opens the pipe to write.
#[test]
fn named_pipes_are_refused_as_files() {
    let folder = Folder::new("pipes");
    let pipe = folder.file("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let sim = Sim::start(&[]);
    for args in [
        &["program", "info", &pipe][..],
        &["program", "info", "--raw", &pipe],
        &["program", "verify", &pipe],
        &["program", "write", &pipe, "--yes"],
        &["program", "read", &pipe],
        &["restore", &pipe, "--yes"],
        &["backup", &pipe, "--compare"],
        &["backup", &pipe, "R0"],
    ] {
        let mut command = Command::new(FATEK);
        command.args(["--link", &sim.url, "--station", "1"]).args(args).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let status = ended_within(&mut child, Duration::from_secs(5)).unwrap_or_else(|| panic!("{args:?} waits"));
        let mut stderr = String::new();
        child.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
        assert_eq!((status.code(), stderr), (Some(1), format!("error: {pipe}: not a regular file\n")), "{args:?}");
    }
}

/// Before: SIGHUP killed the simulator.
#[test]
fn a_simulator_ends_in_order_at_every_signal() {
    for (name, _) in SIGNALS {
        let mut sim = Sim::start(&[]);
        sim.fatek(&["read", "R0"]).ok();
        signal(&sim.child, name);
        assert_eq!(ended_within(&mut sim.child, Duration::from_secs(5)).expect("it ends").code(), Some(0), "{name}");
    }
}

/// Before: only TCP was accepted, and only one address.
#[test]
fn a_simulator_listens_on_tcp_and_udp_at_once() {
    let mut sim = Sim::start(&["--listen", "udp://127.0.0.1:0", "--listen", "tcp://127.0.0.1:0", "--set", "R0=5"]);
    let mut line = String::new();
    sim.stdout.read_line(&mut line).unwrap();
    let tcp = line.strip_prefix("listening ").unwrap().trim_end().to_owned();
    assert!(sim.url.starts_with("udp://127.0.0.1:") && tcp.starts_with("tcp://127.0.0.1:"), "{} {tcp}", sim.url);
    sim.fatek(&["write", "R1=7"]).ok();
    let read = fatek(&["--link", &tcp, "--station", "1", "read", "R0-R1", "--format", "csv"]).ok();
    assert_eq!(read, "tag,type,value\nR0,u16,5\nR1,u16,7\n");
}

#[test]
fn places_to_listen_are_checked() {
    for (url, rule) in [
        ("http://127.0.0.1:1", "it must begin with `tcp://`, `udp://` or `serial:`"),
        ("udp://127.0.0.1", "as in `udp://127.0.0.1:0`"),
        ("udp://127.0.0.1:0?baud=9600", "it takes the option `framing` only"),
        ("tcp://127.0.0.1:0?framing=x", "`x` is not a framing: it must be `ascii` or `binary`"),
        ("serial:", "the path of the port is missing"),
        ("serial:/dev/ttyS0?framing=binary&frame=7E1", "8 data bits"),
        ("serial:/dev/ttyS0?copies=2", "it takes the options `baud`, `frame` and `framing` only"),
        ("serial:/dev/ttyS0?frame=9X1", "frame"),
    ] {
        let stderr = fatek(&["sim", "--listen", url]).usage();
        assert!(stderr.starts_with(&format!("error: cannot listen on `{url}`: ")) && stderr.contains(rule), "{stderr}");
    }
    let absent = fatek(&["sim", "--listen", "serial:/dev/none"]);
    assert_eq!(absent.status, 5, "{absent:?}");
    assert!(absent.stderr.starts_with("error: cannot listen on serial:/dev/none: "), "{absent:?}");
}

/// Linux only: macOS refuses a baud rate for pseudo-terminals.
#[cfg(all(target_os = "linux", feature = "serial"))]
#[test]
fn a_simulator_serves_a_serial_port_and_reopens_it() {
    use std::os::unix::fs::symlink;

    let folder = Folder::new("sim-serial");
    let path = folder.file("port");
    let (line, port) = pseudo_terminal();
    symlink(&port, &path).unwrap();
    let url = format!("serial:{path}?baud=19200");
    let mut sim = Sim::start(&["--listen", &url]);
    assert_eq!(sim.url, url);
    start_plc(&line);

    // The adapter is unplugged, and comes back as another device.
    let (next, port) = pseudo_terminal();
    std::fs::remove_file(&path).unwrap();
    symlink(&port, &path).unwrap();
    drop(line);
    start_plc(&next);
    signal(&sim.child, "TERM");
    assert_eq!(ended_within(&mut sim.child, Duration::from_secs(5)).expect("it ends").code(), Some(0));
}

/// Sends RUN to station 1, until the reply comes: the port may not be open yet.
#[cfg(all(target_os = "linux", feature = "serial"))]
fn start_plc(mut line: &std::fs::File) {
    use std::io::Write;

    let (sender, receiver) = std::sync::mpsc::channel();
    let mut reader = line.try_clone().unwrap();
    std::thread::spawn(move || {
        let mut reply = [0; 9];
        // An error: the other side is not open.
        while reader.read_exact(&mut reply).is_err() {
            sleep(Duration::from_millis(20));
        }
        sender.send(reply)
    });
    for _ in 0..10 {
        line.write_all(b"\x0201411F9\x03").unwrap();
        if let Ok(reply) = receiver.recv_timeout(Duration::from_millis(500)) {
            assert_eq!(&reply, b"\x0201410F8\x03");
            return;
        }
    }
    panic!("no reply");
}

/// Makes a pseudo-terminal. Returns its line side, and the path of its port.
#[cfg(all(target_os = "linux", feature = "serial"))]
fn pseudo_terminal() -> (std::fs::File, String) {
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
    use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

    // A child that inherits the line side keeps the port from being lost.
    let line = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&line).unwrap();
    unlockpt(&line).unwrap();
    // Otherwise it echoes until the port is opened.
    let mut settings = tcgetattr(&line).unwrap();
    settings.make_raw();
    tcsetattr(&line, OptionalActions::Now, &settings).unwrap();
    let path = ptsname(&line, Vec::new()).unwrap().into_string().unwrap();
    (line.into(), path)
}
