//! `fatek decode` of texts of any shape, of logs, and of captures that are made here byte by byte.
#![cfg(feature = "cli")]

mod process;

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};

use self::process::{FATEK, Folder, Output, Sim, ascii, fatek, run};

const FRAME: &[u8] = b"\x02014603R0001275\x03";
const PLAIN: &str = "02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03";

/// Runs `fatek decode` with this standard input.
fn decode(args: &[&str], input: &[u8]) -> Output {
    let folder = Folder::new(&format!("decode-{:x}", input.as_ptr() as usize));
    let file = folder.file("input");
    std::fs::write(&file, input).unwrap();
    run(Command::new(FATEK).arg("decode").args(args).stdin(std::fs::File::open(&file).unwrap()))
}

#[test]
fn every_shape_of_text_is_the_same_frame() {
    let expected = fatek(&["decode", PLAIN]).ok();
    assert!(expected.starts_with("ASCII frame of 16 bytes: good\n"), "{expected}");
    let texts = [
        PLAIN,
        "0230 3134 3630 3352 3030 3031 3237 3503",
        r"\x02014603R0001275\x03",
        "uint8_t frame[] = { 0x02, 0x30, 0x31, 0x34, 0x36, 0x30, 0x33, 0x52, // R12\n 0x30, 0x30, 0x30, 0x31, 0x32, \
         0x37, 0x35, 0x03 };",
        "00000000: 0230 3134 3630 3352 3030 3031 3237 3503  .014603R0001275.\n",
        "00000000  02 30 31 34 36 30 33 52  30 30 30 31 32 37 35 03  |.014603R0001275.|\n00000010\n",
        "0000   02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03   .014603R0001275.\n",
    ];
    let folder = Folder::new("shapes");
    let file = folder.file("frame.txt");
    for text in texts {
        assert_eq!(fatek(&["decode", text]).ok(), expected, "{text}");
        assert_eq!(decode(&[], text.as_bytes()).ok(), expected, "{text}");
        assert_eq!(decode(&["-"], text.as_bytes()).ok(), expected, "{text}");
        std::fs::write(&file, text).unwrap();
        assert_eq!(fatek(&["decode", "--file", &file]).ok(), expected, "{text}");
    }
    // The bytes themselves.
    assert_eq!(decode(&[], FRAME).ok(), expected);
}

/// Programs that show packets copy them with their headers.
#[test]
fn the_payload_of_a_copied_packet_is_explained() {
    let (mut capture, mut at) = Capture::open();
    let before = capture.bytes.len() + 16;
    capture.asks(&mut at, FRAME);
    let stream: String = capture.bytes[before..].iter().map(|byte| format!("{byte:02x}")).collect();
    let decoded = fatek(&["decode", &stream]);
    assert_eq!(decoded.stdout, fatek(&["decode", PLAIN]).ok());
    assert_eq!(decoded.stderr, "58 bytes of a packet around its payload are left out\n");
}

#[test]
fn inputs_that_are_no_frames_are_refused() {
    let folder = Folder::new("decode-none");
    assert!(decode(&[], b"").usage().contains("has no bytes"));
    assert!(fatek(&["decode", "--file", &folder.file("x"), "02"]).usage().contains("cannot be used with"));
    assert!(fatek(&["decode", "--fields", "--format", "json", "02"]).usage().contains("--fields is for tables"));
    let missing = fatek(&["decode", "--file", &folder.file("none")]);
    assert_eq!(missing.status, 1, "{missing:?}");
    let dir = fatek(&["decode", "--file", folder.0.to_str().unwrap()]);
    assert_eq!(dir.status, 1, "{dir:?}");
    assert!(dir.stderr.contains("not a regular file"), "{dir:?}");
}

#[test]
fn a_log_is_a_conversation() {
    for args in [&["--set", "R0=7"][..], &["--set", "R0=7", "--framing", "binary"]] {
        let sim = Sim::start(args);
        let logged = sim.fatek(&["-vv", "read", "R0-R2"]);
        assert_eq!(logged.status, 0, "{logged:?}");
        let decoded = decode(&[], logged.stderr.as_bytes());
        assert!(decoded.stdout.contains("read registers (46h) R0 to R2: 7, 0, 0\n"), "{decoded:?}");
        assert!(decoded.stdout.contains(&format!("connection 1: {}", sim.url)), "{decoded:?}");
        assert!(decoded.stderr.starts_with("2 requests, 2 answered; round trip "), "{decoded:?}");
        // As an argument, without the other lines.
        let line = logged.stderr.lines().find(|line| line.contains("sending")).unwrap();
        assert!(fatek(&["decode", line]).ok().contains("NO REPLY: loop back (4Eh)"));
    }
}

/// A capture of Ethernet packets.
struct Capture {
    bytes: Vec<u8>,
    micros: u32,
}

/// Sequence numbers of the next bytes of client and PLC. They wrap soon.
struct Sequences {
    client: u32,
    plc: u32,
}

impl Capture {
    fn new() -> Self {
        let mut bytes = Vec::new();
        for word in [0xA1B2_C3D4, 0x0004_0002, 0, 0, 65_535, 1_u32] {
            bytes.extend(word.to_le_bytes());
        }
        Self { bytes, micros: 0 }
    }

    fn packet(&mut self, packet: &[u8]) {
        self.micros += 1000;
        let len = u32::try_from(packet.len()).unwrap();
        for word in [1_700_000_000, self.micros, len, len] {
            self.bytes.extend(word.to_le_bytes());
        }
        self.bytes.extend(packet);
    }

    /// A segment of TCP between 10.0.0.9:40000 and 10.0.0.3:500, with a VLAN tag.
    fn tcp(&mut self, to_plc: bool, flags: u8, sequence: u32, acknowledged: u32, payload: &[u8]) {
        let mut packet = vec![1; 12];
        packet.extend([0x81, 0x00, 0x00, 0x07, 0x08, 0x00]);
        let total = u16::try_from(40 + payload.len()).unwrap();
        packet.extend([0x45, 0]);
        packet.extend(total.to_be_bytes());
        packet.extend([0, 0, 0x40, 0, 64, 6, 0, 0]);
        let (client, plc) = ([10, 0, 0, 9], [10, 0, 0, 3]);
        let ports = |ports: [u16; 2]| ports.map(u16::to_be_bytes).concat();
        if to_plc {
            packet.extend([client, plc].concat());
            packet.extend(ports([40_000, 500]));
        } else {
            packet.extend([plc, client].concat());
            packet.extend(ports([500, 40_000]));
        }
        packet.extend(sequence.to_be_bytes());
        packet.extend(acknowledged.to_be_bytes());
        packet.extend([0x50, flags, 0x20, 0, 0, 0, 0, 0]);
        packet.extend(payload);
        self.packet(&packet);
    }

    fn open() -> (Self, Sequences) {
        let mut capture = Self::new();
        let (client, plc) = (u32::MAX - 20, 7000);
        capture.tcp(true, SYN, client, 0, b"");
        capture.tcp(false, SYN | ACK, plc, client.wrapping_add(1), b"");
        (capture, Sequences { client: client.wrapping_add(1), plc: plc + 1 })
    }

    fn asks(&mut self, at: &mut Sequences, bytes: &[u8]) {
        self.tcp(true, ACK, at.client, at.plc, bytes);
        at.client = at.client.wrapping_add(u32::try_from(bytes.len()).unwrap());
    }

    fn replies(&mut self, at: &mut Sequences, bytes: &[u8]) {
        self.tcp(false, ACK, at.plc, at.client, bytes);
        at.plc = at.plc.wrapping_add(u32::try_from(bytes.len()).unwrap());
    }
}

const SYN: u8 = 0x02;
const ACK: u8 = 0x10;

/// Exchanges of every kind, with the faults of networks.
fn capture() -> Vec<u8> {
    let (mut capture, mut at) = Capture::open();
    let read = |register: u16| ascii(&format!("014601R{register:05}"));
    // A request in two segments, the second of which comes first; a reply that is sent again.
    let request = read(12);
    let (first, second) = request.split_at(6);
    capture.tcp(true, ACK, at.client.wrapping_add(6), at.plc, second);
    capture.tcp(true, ACK, at.client, at.plc, first);
    at.client = at.client.wrapping_add(u32::try_from(request.len()).unwrap());
    let before = at.plc;
    capture.replies(&mut at, &ascii("014600007"));
    capture.tcp(false, ACK, before, at.client, &ascii("014600007"));
    // A request that is asked again, and whose reply comes twice.
    capture.asks(&mut at, &read(0));
    capture.asks(&mut at, &read(0));
    capture.replies(&mut at, &[ascii("014600001"), ascii("014600001")].concat());
    // A refusal, and a reply that the capture has lost, which the client has acknowledged.
    capture.asks(&mut at, &read(9999));
    capture.replies(&mut at, &ascii("0146A"));
    capture.asks(&mut at, &read(1));
    at.plc = at.plc.wrapping_add(11);
    capture.asks(&mut at, &read(2));
    // A frame with a wrong checksum; the client asks for other registers.
    let mut broken = ascii("014600003");
    broken[7] = b'4';
    capture.replies(&mut at, &broken);
    capture.asks(&mut at, &read(3));
    capture.replies(&mut at, &ascii("014600003"));
    capture.bytes
}

#[test]
fn exchanges_of_a_capture_are_paired_and_marked() {
    let decoded = decode(&[], &capture());
    let expected = [
        "from 2023-11-14T22:13:20.001000Z",
        "",
        "     TIME s   TRIP ms   #  ST  EXCHANGE",
        "connection 1: tcp 10.0.0.9:40000 > 10.0.0.3:500",
        "   0.003000     1.000   1   1  read registers (46h) R12: 7",
        "   0.006000             1   1  RETRIED: read registers (46h) R0",
        "   0.007000     1.000   1   1  attempt 2: read registers (46h) R0: 1",
        "   0.008000             1   1  DOUBLED: read registers (46h) \"00001\"",
        "   0.009000     1.000   1   1  REFUSED: read registers (46h) R9999: illegal address (A)",
        "   0.013000             1      MISSING: 11 bytes from the PLC",
        "   0.013000             1      BAD: 13 bytes from the PLC",
        "                              LRC: found C0, computed C4",
        "   0.011000             1   1  NO REPLY: read registers (46h) R1",
        "   0.012000             1   1  NO REPLY: read registers (46h) R2",
        "   0.014000     1.000   1   1  read registers (46h) R3: 3",
    ];
    assert_eq!(decoded.stdout.lines().collect::<Vec<_>>(), expected, "{decoded:?}");
    assert_eq!(decoded.status, 6);
    let summary = "7 requests, 4 answered, 1 refused, 2 no reply, 1 retried, 1 doubled, 1 bad, 1 missing; round trip";
    assert!(decoded.stderr.starts_with(summary), "{decoded:?}");
    assert!(decoded.stderr.ends_with("error: bad frames: 1 of 10\n"), "{decoded:?}");
}

#[test]
fn other_formats_have_the_bytes_of_each_exchange() {
    let json = decode(&["--format", "json"], &capture());
    let objects: Vec<serde_json::Value> = json.stdout.lines().map(|line| line.parse().unwrap()).collect();
    assert_eq!(objects.len(), 10);
    let first = serde_json::json!({
        "time": "2023-11-14T22:13:20.004000Z", "since_ms": 3.0, "connection": 1, "station": 1, "result": "ok",
        "attempt": 1, "round_trip_ms": 1.0, "request": "read registers (46h) R12", "reply": "7",
        "request_bytes": "02 30 31 34 36 30 31 52 30 30 30 31 32 37 33 03",
        "reply_bytes": "02 30 31 34 36 30 30 30 30 37 43 34 03", "faults": [],
    });
    let differing = |object: &serde_json::Value| {
        let object = object.as_object().unwrap().iter();
        object.filter(|(name, value)| first[name.as_str()] != **value).map(|(name, _)| name.clone()).collect::<Vec<_>>()
    };
    assert_eq!(differing(&objects[0]), Vec::<String>::new(), "{}", objects[0]);
    assert_eq!(objects[5]["result"], "missing");
    assert_eq!(objects[6]["faults"].as_array().unwrap().len(), 1);

    let csv = decode(&["--format", "csv"], &capture()).stdout;
    assert_eq!(csv.lines().count(), 11);
    assert!(csv.starts_with("time,since_ms,connection,station,result,attempt,round_trip_ms,request,reply,"), "{csv}");

    let fields = decode(&["--fields"], &capture()).stdout;
    assert!(fields.contains("request  element  52 30 30 30 31 32  R12, a 16-bit register\n"), "{fields}");
    assert!(fields.contains("BAD: found "), "{fields}");
}

#[test]
fn a_capture_is_decoded_while_it_is_made() {
    let (mut capture, mut at) = Capture::open();
    capture.asks(&mut at, &ascii("014601R00012"));
    capture.replies(&mut at, &ascii("014600007"));
    let mut child = Command::new(FATEK)
        .args(["decode", "--format", "json"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let mut stdout = BufReader::new(child.stdout.take().unwrap());
    // Byte by byte, so that all headers come in pieces.
    for byte in &capture.bytes {
        stdin.write_all(&[*byte]).unwrap();
    }
    let mut line = String::new();
    stdout.read_line(&mut line).unwrap();
    assert!(line.contains(r#""request":"read registers (46h) R12","reply":"7""#), "{line}");
    drop(stdin);
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{output:?}");
}

#[test]
fn a_capture_of_another_port_says_which() {
    let bytes = capture();
    let other = decode(&["--port", "5000"], &bytes);
    assert_eq!((other.status, other.stdout.as_str()), (0, ""), "{other:?}");
    assert!(other.stderr.contains("has port 5000; most of them have port 500: try --port 500\n"), "{other:?}");
    let csv = decode(&["--port", "5000", "--format", "csv"], &bytes);
    assert_eq!(csv.stdout.lines().count(), 1, "{csv:?}");
}

#[test]
fn a_capture_that_is_cut_off_is_printed_up_to_there() {
    let bytes = capture();
    let cut = decode(&[], &bytes[..bytes.len() - 5]);
    assert_eq!(cut.status, 7, "{cut:?}");
    assert!(cut.stderr.contains("error: the standard input: it is cut off after byte "), "{cut:?}");
    // The reply to the last request is in the last packet.
    assert!(cut.stdout.ends_with("NO REPLY: read registers (46h) R3\n"), "{cut:?}");
}

#[test]
fn the_framing_can_be_given() {
    let binary = b"\x51\x10\x00\x02\x01\x40\xA1\x84\x55\xAA";
    let (mut capture, mut at) = Capture::open();
    capture.asks(&mut at, binary);
    assert_eq!(decode(&[], &capture.bytes).status, 0);
    let wrong = decode(&["--framing", "ascii"], &capture.bytes);
    assert_eq!(wrong.status, 6, "{wrong:?}");
}

#[test]
fn texts_of_a_capture_are_printed_escaped() {
    let (mut capture, mut at) = Capture::open();
    capture.asks(&mut at, b"\x1b[31m\x9b2J\x07");
    capture.asks(&mut at, &ascii("014E\x1b]0;t\x07"));
    for format in ["table", "json", "csv"] {
        let decoded = decode(&["--format", format], &capture.bytes);
        let raw = |text: &str| text.chars().any(|c| c.is_control() && c != '\n');
        assert!(!raw(&decoded.stdout) && !raw(&decoded.stderr), "{decoded:?}");
    }
}

/// Before: the second packet vanished, with status 0, and with the headers the dump was refused.
#[test]
fn each_packet_of_a_dump_is_explained() {
    let (mut capture, mut at) = Capture::open();
    let mut dump = String::new();
    for (number, bytes) in (0..).zip([FRAME, b"", FRAME]) {
        let before = capture.bytes.len() + 16;
        capture.asks(&mut at, bytes);
        dump += &format!("12:00:0{number}.5 IP 10.0.0.9.40000 > 10.0.0.3.500: Flags [P.], length 16\n");
        for (row, bytes) in capture.bytes[before..].chunks(16).enumerate() {
            let digits: String = bytes.iter().map(|byte| format!("{byte:02x} ")).collect();
            dump += &format!("\t0x{:04x}:  {digits}\n", 16 * row);
        }
    }
    let decoded = decode(&[], dump.as_bytes());
    assert_eq!(decoded.status, 0, "{decoded:?}");
    assert_eq!(decoded.stdout.matches("ASCII frame of 16 bytes: good\n").count(), 2, "{decoded:?}");
    assert_eq!(decoded.stderr, "174 bytes of packets around their payloads are left out\n");
}

/// Before: a line that the recording had made, with a wrong exchange.
#[test]
fn ends_of_a_connection_are_one_line() {
    let header = r#"{"fatek":"recording","version":1,"started":"2026-11-29T18:00:00Z"}"#;
    let open = r#"{"us":1,"connection":1,"open":"a\n   0.003000     1.000   1   1  forged\u001b[2J"}"#;
    let bytes = r#"{"us":2,"connection":1,"to":"plc","bytes":"06"}"#;
    let decoded = decode(&[], format!("{header}\n{open}\n{bytes}\n").as_bytes());
    assert!(decoded.stdout.contains("connection 1: a\\n   0.003000"), "{decoded:?}");
}
