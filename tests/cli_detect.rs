//! `fatek detect` as a process, on pseudo-terminals and over TCP.
//!
//! A pseudo-terminal has no speed. The PLC at its other end looks at the settings of the port, and
//! answers only if they are its own.
#![cfg(all(feature = "cli", feature = "serial", target_os = "linux"))]

mod process;

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use bytes::BytesMut;
use fatek::command::{BriefStatus, DetailedStatus, ReadDetailedStatus, ReadStatus, encode_reply};
use fatek::wire::{Codec, Framing, Side};
use process::{FATEK, Output, Sim, fatek};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{ControlModes, InputModes, Termios, tcgetattr};
use serde_json::Value;
use tokio_util::codec::Decoder;

/// A serial line, with a PLC or something else at its other end.
struct Wire {
    path: String,
    received: Arc<Mutex<Vec<u8>>>,
    /// The other end.
    terminal: File,
    /// Keeps the port open: a line needs both sides open.
    _port: File,
}

/// Settings of a port, as far as a pseudo-terminal keeps them: not the number of data bits.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Seen {
    baud: u32,
    parity: char,
    two_stop_bits: bool,
}

impl Seen {
    fn of(termios: &Termios) -> Self {
        let parity = match (
            termios.input_modes.contains(InputModes::INPCK),
            termios.control_modes.contains(ControlModes::PARODD),
        ) {
            (false, _) => 'N',
            (true, false) => 'E',
            (true, true) => 'O',
        };
        let two_stop_bits = termios.control_modes.contains(ControlModes::CSTOPB);
        Self { baud: termios.output_speed(), parity, two_stop_bits }
    }
}

const fn seen(baud: u32, parity: char) -> Seen {
    Seen { baud, parity, two_stop_bits: false }
}

impl Wire {
    /// `answer`: the bytes for a request and the settings of the port.
    fn new(mut answer: impl FnMut(&[u8], Seen) -> Vec<u8> + Send + 'static) -> Self {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&terminal).unwrap();
        unlockpt(&terminal).unwrap();
        let path = ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
        let port = OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let received = Arc::<Mutex<Vec<u8>>>::default();
        let (log, terminal) = (received.clone(), File::from(terminal));
        let mut reader = terminal.try_clone().unwrap();
        // The thread ends with the process.
        thread::spawn(move || {
            let mut buffer = [0; 1024];
            while let Ok(len @ 1..) = reader.read(&mut buffer) {
                log.lock().unwrap().extend_from_slice(&buffer[..len]);
                let reply = answer(&buffer[..len], Seen::of(&tcgetattr(&reader).unwrap()));
                if reader.write_all(&reply).is_err() {
                    return;
                }
            }
        });
        Self { path, received, terminal, _port: port }
    }

    /// A line with a PLC of these settings; others garble what is sent and received.
    fn with_plc(settings: Seen, framing: Framing, stations: &'static [u8]) -> Self {
        Self::new(move |request, seen| if seen == settings { plc(request, framing, stations) } else { Vec::new() })
    }

    fn detect(&self, args: &[&str]) -> Output {
        fatek(&[&["detect", &self.path, "--timeout", "1s"], args].concat())
    }

    /// Another master, which sends a frame every 10 ms. Its thread ends with the process.
    fn send_all_the_time(&self) {
        let mut terminal = self.terminal.try_clone().unwrap();
        thread::spawn(move || {
            while terminal.write_all(&process::ascii("094603R00012")).is_ok() {
                thread::sleep(Duration::from_millis(10));
            }
        });
    }

    /// Returns whether the status of station 1 was asked.
    fn was_asked(&self) -> bool {
        self.received().windows(5).any(|bytes| bytes == b"\x020140")
    }

    /// All bytes that were received.
    fn received(&self) -> Vec<u8> {
        self.received.lock().unwrap().clone()
    }
}

/// Answers of PLCs to the requests of a detection. Any other request fails the test: it does not answer.
fn plc(bytes: &[u8], framing: Framing, stations: &[u8]) -> Vec<u8> {
    let (mut codec, mut buffer, mut replies) = (Codec::new(framing, Side::Plc), BytesMut::from(bytes), BytesMut::new());
    while let Ok(Some(item)) = codec.decode(&mut buffer) {
        let Some(frame) = item.frame().filter(|frame| stations.contains(&frame.station)) else { continue };
        match frame.command {
            0x40 => {
                let status = BriefStatus::from_raw([1, 0, 0]);
                encode_reply(&ReadStatus, Ok(&status), framing, frame.station, &mut replies);
            }
            0x53 => {
                let mut raw = [0; 64];
                raw[1] = 1;
                raw[3] = 0x40;
                let status = DetailedStatus::from(raw);
                encode_reply(&ReadDetailedStatus, Ok(&status), framing, frame.station, &mut replies);
            }
            _ => {}
        }
    }
    replies.to_vec()
}

fn rows(found: &Output) -> Vec<Value> {
    found.stdout.parse::<Value>().unwrap().as_array().unwrap().clone()
}

/// Each choice is narrowed, so that few requests wait for their timeout.
#[test]
fn speed_frame_framing_and_station_are_found() {
    for (settings, framing, args, link) in [
        (seen(9600, 'E'), Framing::Ascii, &[][..], ""),
        (seen(19_200, 'E'), Framing::Ascii, &[], "?baud=19200"),
        (seen(19_200, 'N'), Framing::Ascii, &["--baud", "19200", "--frame", "7E1,8N1"], "?baud=19200&frame=8N1"),
        (
            seen(115_200, 'N'),
            Framing::Binary,
            &["--baud", "9600,115200", "--framing", "binary"],
            "?baud=115200&framing=binary",
        ),
        (seen(4800, 'O'), Framing::Ascii, &["--baud", "4800", "--frame", "7E1,7O1"], "?baud=4800&frame=7O1"),
    ] {
        let wire = Wire::with_plc(settings, framing, &[1]);
        let found = wire.detect(&[args, &["--stations", "1", "--format", "json"]].concat());
        assert_eq!(found.status, 0, "{found:?}");
        let [row] = &rows(&found)[..] else { panic!("{found:?}") };
        assert_eq!(row["link"], format!("serial:{}{link}", wire.path), "{found:?}");
        assert_eq!((&row["baud"], &row["framing"]), (&settings.baud.into(), &framing.to_string().into()));
        assert_eq!((&row["station"], &row["answer"], &row["running"]), (&1.into(), &"sure".into(), &true.into()));
        assert_eq!((&row["main_unit"], &row["os_version"]), (&"MC".into(), &"4.0".into()));
        assert_eq!((&row["requests"], &row["replies"], &row["note"]), (&4.into(), &4.into(), &Value::Null));
        // The next command can be pasted.
        let link = row["link"].as_str().unwrap();
        let quoted = if link.contains('?') { format!("'{link}'") } else { link.to_owned() };
        let hint = format!("hint: to read more: fatek --link {quoted} --station 1 status\n");
        assert!(found.stderr.ends_with(&hint), "{found:?}");
    }
}

#[test]
fn other_stations_of_the_line_are_found_with_the_same_setting() {
    let wire = Wire::with_plc(seen(9600, 'E'), Framing::Ascii, &[2, 4]);
    let args = ["--baud", "9600", "--frame", "7E1"];
    let found = wire.detect(&args);
    assert!(found.stderr.starts_with("trying 1 setting with stations 1-4: 4 requests, up to 5 s\n"), "{found:?}");
    let table = found.ok();
    let lines: Vec<&str> = table.lines().collect();
    assert!(lines[0].starts_with("LINK "), "{table}");
    assert!(lines[1].contains(" 2        sure    true     MC 4.0"), "{table}");
    assert!(lines[2].contains(" 4        sure "), "{table}");
    assert_eq!(lines.len(), 3, "{table}");
    // Nothing but the two statuses is read.
    let received = wire.received();
    let codes: Vec<&[u8]> = received.split(|byte| *byte == 0x02).filter_map(|frame| frame.get(2..4)).collect();
    assert!(codes.len() > 8 && codes.iter().all(|code| matches!(*code, b"40" | b"53")), "{codes:?}");
}

#[test]
fn missing_replies_and_noise_lower_the_confidence() {
    let mut requests = 0;
    let wire = Wire::new(move |request, _| {
        requests += 1;
        match requests {
            2 => Vec::new(),
            _ => [b"\xff\xfe", &plc(request, Framing::Ascii, &[1])[..]].concat(),
        }
    });
    let found = wire.detect(&["--baud", "9600", "--frame", "7E1", "--stations", "1", "--format", "json"]);
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!(row["answer"], "likely");
    assert_eq!(row["note"], "3 of 4 requests answered; 8 bytes that are no frame");
}

#[test]
fn garbage_is_explained_and_is_status_4() {
    // With any other parity, characters come as zeros; with 8N1, 7E1 is seen as it is on the line.
    let wire = Wire::new(|request, seen| match seen.parity {
        'N' => b"\x020140001400059\x03".iter().map(|byte| byte | u8::from(byte.count_ones() % 2 == 1) << 7).collect(),
        _ => vec![0; request.len()],
    });
    let found = wire.detect(&["--baud", "9600", "--frame", "7O1,8N1", "--stations", "1", "--format", "json"]);
    assert_eq!((found.status, found.stdout.as_str()), (4, "[]\n"), "{found:?}");
    let zeros = "?frame=7O1: 8 bytes that are no frame (00 00 00 00 00 00 00 00): characters of another parity or \
                 speed are read as 00\n";
    assert!(found.stderr.contains(zeros), "{found:?}");
    assert!(found.stderr.contains("bit 7 is an even parity of the others: perhaps 7E1\n"), "{found:?}");
    assert!(found.stderr.ends_with("error: no answer to 3 requests\n"), "{found:?}");
}

#[test]
fn a_silent_or_echoing_line_is_status_4_with_hints() {
    let args = ["--baud", "9600", "--frame", "7E1", "--stations", "1"];
    let silent = Wire::new(|_, _| Vec::new()).detect(&args);
    assert_eq!((silent.status, silent.stdout.as_str()), (4, ""), "{silent:?}");
    assert!(silent.stderr.contains("hint: nothing came: check power and cable"), "{silent:?}");
    let quiet = Wire::new(|_, _| Vec::new()).detect(&[&args[..], &["--quiet"]].concat());
    assert_eq!(quiet.stderr, "error: no answer to 1 request\n");

    let echo = Wire::new(|request, _| request.to_vec()).detect(&args);
    assert_eq!((echo.status, echo.stdout.as_str()), (4, ""), "{echo:?}");
    assert!(echo.stderr.contains(": requests are echoed, so that adapter and port work\n"), "{echo:?}");
}

#[test]
fn frames_of_another_master_are_shown() {
    let wire = Wire::new(|_, _| process::ascii("094603R00012"));
    let found = wire.detect(&["--baud", "9600", "--frame", "7E1", "--stations", "1", "--format", "csv"]);
    assert_eq!(found.status, 4, "{found:?}");
    let row = found.stdout.lines().nth(1).unwrap();
    assert!(row.contains(",9600,7E1,ascii,9,heard,,,,,,,a frame of station 9: read registers (46h)"), "{row}");
    assert!(found.stderr.contains("hint: frames of another master or station came"), "{found:?}");
}

#[test]
fn nothing_is_sent_to_a_busy_line() {
    let args = ["--baud", "9600", "--frame", "7E1", "--stations", "1", "--format", "csv"];
    let wire = Wire::new(|_, _| Vec::new());
    wire.send_all_the_time();
    let found = wire.detect(&args);
    assert_eq!(found.status, 4, "{found:?}");
    assert!(found.stdout.contains(",9600,7E1,ascii,9,heard,"), "{found:?}");
    let busy = "error: the line is busy, nothing was sent: stop the other master, or give --busy\n";
    assert!(found.stderr.ends_with(busy), "{found:?}");
    assert!(!wire.was_asked(), "{:?}", wire.received());

    let found = wire.detect(&[&args[..], &["--busy"]].concat());
    assert_eq!(found.status, 4, "{found:?}");
    assert!(found.stderr.ends_with("error: no answer to 1 request\n") && wire.was_asked(), "{found:?}");
}

#[test]
fn a_detailed_status_without_a_reply_lowers_the_confidence() {
    let wire = Wire::new(|request, _| match request.get(3..5) {
        Some(b"53") => b"\xff\xfe".to_vec(),
        _ => plc(request, Framing::Ascii, &[1]),
    });
    let found = wire.detect(&["--baud", "9600", "--frame", "7E1", "--stations", "1", "--format", "json"]);
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!(row["answer"], "likely");
    assert_eq!(row["note"], "no answer to the detailed status (53); 2 bytes that are no frame");
}

#[test]
fn a_line_that_is_lost_at_each_request_is_status_5() {
    let closed = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let lost = fatek(&["detect", &format!("udp://{closed}"), "--timeout", "5s", "--stations", "1"]);
    assert_eq!(lost.status, 5, "{lost:?}");
    assert!(lost.stderr.contains("the line was lost at each of 2 requests: "), "{lost:?}");
}

#[test]
fn framing_and_station_are_found_over_tcp() {
    let sim = Sim::start(&["--framing", "binary", "--station", "3"]);
    let address = sim.url.split('?').next().unwrap();
    let found = fatek(&["detect", address, "--timeout", "1s", "--stations", "2-3", "--format", "json"]);
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!((&row["link"], &row["station"], &row["baud"]), (&sim.url.clone().into(), &3.into(), &Value::Null));
    let refused = fatek(&["detect", address, "--baud", "9600"]).usage();
    assert!(refused.contains("no --baud or --frame"), "{refused}");
}

/// Also after a frame that it does not understand.
#[test]
fn a_device_that_closes_after_each_reply_is_detected() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", listener.local_addr().unwrap());
    thread::spawn(move || {
        for stream in listener.incoming() {
            let (mut stream, mut request) = (stream.unwrap(), [0; 64]);
            let Ok(len @ 1..) = stream.read(&mut request) else { continue };
            stream.write_all(&plc(&request[..len], Framing::Binary, &[1])).unwrap();
        }
    });
    let found = fatek(&["detect", &url, "--timeout", "1s", "--stations", "1", "--format", "json"]);
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!((&row["framing"], &row["answer"], &row["main_unit"]), (&"binary".into(), &"sure".into(), &"MC".into()));
}

#[test]
fn a_port_that_cannot_be_opened_is_status_5() {
    let missing = fatek(&["detect", "/dev/fatek-missing"]);
    assert_eq!(missing.status, 5, "{missing:?}");
    assert!(missing.stderr.ends_with("; `fatek ports` lists the ports\n"), "{missing:?}");
    let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    assert_eq!(fatek(&["detect", &format!("tcp://{closed}")]).status, 5);
}

#[test]
fn invalid_arguments_send_nothing() {
    let wire = Wire::new(|_, _| Vec::new());
    for (args, rule) in [
        (&["--baud", "5"][..], "expected a number from 300 to 921600"),
        (&["--frame", "9E1"], "such as 7E1"),
        (&["--frame", "7E1", "--framing", "binary"], "needs 8 data bits"),
        (&["--stations", "0-3"], "is not a list of stations"),
    ] {
        let usage = wire.detect(args).usage();
        assert!(usage.contains(rule), "{args:?}: {usage}");
    }
    let url = format!("serial:{}?baud=9600", wire.path);
    assert!(fatek(&["detect", &url]).usage().contains("to narrow it, give --baud"));
    assert!(wire.received().is_empty());
}

#[test]
fn a_signal_ends_it_with_the_stations_so_far() {
    let wire = Wire::with_plc(seen(9600, 'E'), Framing::Ascii, &[1]);
    let mut command = Command::new(FATEK);
    command.args(["detect", &wire.path, "--timeout", "60s", "--format", "csv"]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // Station 2 is asked when station 1 has answered, and does not answer.
    while !wire.received().windows(5).any(|bytes| bytes == b"\x020240") {
        thread::sleep(Duration::from_millis(5));
    }
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let ended = child.wait_with_output().unwrap();
    let (stdout, stderr) = (String::from_utf8(ended.stdout).unwrap(), String::from_utf8(ended.stderr).unwrap());
    assert_eq!(ended.status.code(), Some(130), "{stderr}");
    assert!(stdout.contains(",9600,7E1,ascii,1,sure,4,4,true,MC,4.0,"), "{stdout}");
    assert!(stderr.ends_with("error: interrupted by SIGINT\n"), "{stderr}");
}
