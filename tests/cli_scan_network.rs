//! `fatek scan --network` and `--discover` as a process, on loopback networks.
//!
//! Each test has a network of its own, 127.1.N.0, so that tests can run at once. Linux only: other
//! systems have 127.0.0.1 alone.
#![cfg(all(feature = "cli", target_os = "linux"))]

mod process;

use std::io::{Read, Write};
use std::net::{TcpListener, UdpSocket};
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fatek::ErrorCode;
use fatek::command::{BriefStatus, Code, ReadStatus, Request, encode_refusal, encode_reply};
use fatek::sim::{Bus, Fault, Faults, Plc, Rule, Server, UdpServer};
use fatek::wire::{Codec, Framing, Received, Side};
use process::{FATEK, Output, fatek};
use serde_json::Value;
use tokio_util::codec::Decoder;

/// Scans without waiting for places in the rate. The timeout is longer than any answer takes.
async fn scan(args: &[&str]) -> Output {
    let args = [&["scan", "--rate", "10000", "--timeout", "1s"], args].concat();
    let args: Vec<String> = args.iter().map(ToString::to_string).collect();
    let run = move || fatek(&args.iter().map(String::as_str).collect::<Vec<_>>());
    tokio::task::spawn_blocking(run).await.unwrap()
}

fn rows(found: &Output) -> Vec<Value> {
    found.stdout.parse::<Value>().unwrap().as_array().unwrap().clone()
}

/// The row as `link station answer`.
fn summary(row: &Value) -> String {
    format!("{} {} {}", row["link"].as_str().unwrap(), row["station"], row["answer"].as_str().unwrap())
}

fn bus(stations: &[u8], faults: &Faults) -> Bus {
    let bus = stations.iter().fold(Bus::new(), |bus, &station| bus.with_station(station, Plc::new()).unwrap());
    bus.with_faults(faults.clone())
}

/// A port that is free on an address; most likely also on the others of its network.
fn free_port(address: &str) -> u16 {
    TcpListener::bind((address, 0)).unwrap().local_addr().unwrap().port()
}

#[tokio::test(flavor = "multi_thread")]
async fn plcs_are_found_over_tcp_and_udp_in_both_framings() {
    let port = free_port("127.1.1.5");
    let faults = Faults::new(1);
    let tcp = Server::bind(("127.1.1.5", port), bus(&[1, 3], &faults), Framing::Ascii).await.unwrap();
    let udp = UdpServer::bind(("127.1.1.5", port), bus(&[1, 3], &faults), Framing::Ascii).await.unwrap();
    let binary = Server::bind(("127.1.1.9", port), bus(&[2], &faults), Framing::Binary).await.unwrap();
    let only_udp = UdpServer::bind(("127.1.1.30", port), bus(&[1], &faults), Framing::Binary).await.unwrap();
    // Outside of the network: its own address and that of its broadcast.
    let outside = Server::bind(("127.1.1.31", port), bus(&[1], &faults), Framing::Ascii).await.unwrap();

    let number = port.to_string();
    let ports = ["--network", "127.1.1.0/27", "--tcp", &number, "--udp", &number, "--stations", "1-3"];
    let found = scan(&[&ports[..], &["--format", "json"]].concat()).await;
    assert_eq!(found.status, 0, "{found:?}");
    let rows = rows(&found);
    assert_eq!(
        rows.iter().map(summary).collect::<Vec<_>>(),
        [
            format!("tcp://127.1.1.5:{port} 1 ok"),
            format!("tcp://127.1.1.5:{port} 3 ok"),
            format!("udp://127.1.1.5:{port} 1 ok"),
            format!("udp://127.1.1.5:{port} 3 ok"),
            format!("tcp://127.1.1.9:{port}?framing=binary 2 ok"),
            format!("udp://127.1.1.30:{port}?framing=binary 1 ok"),
        ]
    );
    let last = &rows[5];
    assert_eq!((&last["host"], &last["transport"]), (&"127.1.1.30".into(), &"udp".into()));
    assert_eq!((&last["port"], &last["framing"]), (&port.into(), &"binary".into()));
    assert_eq!(
        (&last["running"], &last["main_unit"], &last["os_version"]),
        (&false.into(), &"MC".into(), &"3.1".into())
    );
    assert!(last["time_ms"].as_f64().is_some_and(|time| time > 0.0 && time < 1000.0), "{last}");
    let ends = format!(
        "30 hosts scanned, 6 stations answered, 0 with bad replies\nports: 56 refused, 0 without an answer, 0 not \
         tried\nhint: to read more: fatek --link tcp://127.1.1.5:{port} --station 1 status\n"
    );
    assert!(found.stderr.ends_with(&ends), "{found:?}");
    assert!(found.stderr.starts_with("scanning 30 hosts, tcp "), "{found:?}");

    let table = ["--network", "127.1.1.0/27", "--tcp", &number, "--stations", "1", "--framing", "ascii", "--quiet"];
    let table = scan(&table).await;
    assert_eq!(table.stderr, "", "{table:?}");
    let table = table.ok();
    assert!(table.starts_with("LINK ") && table.contains("  1        ok      false    MC 3.1"), "{table}");
    assert_eq!(table.lines().count(), 3, "a station, and a silent port: {table}");

    // Nothing but the two statuses is read.
    let entries = faults.log().entries();
    let only_reads = |request: &Request| matches!(request, Request::ReadStatus(_) | Request::ReadDetailedStatus(_));
    assert!(entries.iter().all(|entry| entry.request().is_none_or(only_reads)), "{entries:?}");
    for server in [tcp, binary, outside] {
        server.shutdown().await;
    }
    for server in [udp, only_udp] {
        server.shutdown().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_choice_of_transport_and_framing_leaves_out_the_others() {
    let faults = Faults::new(1);
    let server = Server::bind("127.1.2.1:0", bus(&[1], &faults), Framing::Ascii).await.unwrap();
    let port = server.local_addr().port().to_string();
    let network = ["--network", "127.1.2.1,127.1.2.2-3", "--tcp", &port, "--stations", "1", "--format", "csv"];
    let ascii = scan(&[&network[..], &["--framing", "ascii"]].concat()).await;
    let header = "link,host,transport,port,framing,station,answer,running,main_unit,os_version,time_ms,note\n";
    assert!(ascii.stdout.starts_with(header), "{ascii:?}");
    assert_eq!((ascii.status, ascii.stdout.lines().count()), (0, 2), "{ascii:?}");
    assert!(ascii.stderr.contains("3 hosts scanned, 1 station answered"), "{ascii:?}");
    assert!(ascii.stderr.contains("ports: 2 refused, 0 without"), "UDP is not tried: {ascii:?}");

    // A port that accepts connections, and answers in no framing that is asked.
    let binary = scan(&[&network[..], &["--framing", "binary"]].concat()).await;
    assert_eq!(binary.status, 4, "{binary:?}");
    assert!(binary.stdout.contains(",,silent,"), "{binary:?}");
    assert!(binary.stderr.ends_with("error: no station answered on 3 hosts\n"), "{binary:?}");
    assert!(
        binary.stderr.contains("hint: to find other stations of a silent port: fatek scan --link tcp://127.1.2.1:"),
        "{binary:?}"
    );
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn each_kind_of_answer_is_reported() {
    let faults = Faults::new(7);
    let rule = |station, fault| Rule::new(fault).station(station);
    faults.set_rules([
        rule(2, Fault::Error(ErrorCode::IllegalFormat)),
        rule(3, Fault::Delay { min: Duration::from_millis(1300), max: Duration::from_millis(1300) }),
        rule(5, Fault::GarbageBefore { max_len: 5 }),
        rule(6, Fault::Error(ErrorCode::IllegalFormat)).command(Code::ReadDetailedStatus),
    ]);
    let server = Server::bind("127.1.3.1:0", bus(&[1, 2, 3, 5, 6], &faults), Framing::Ascii).await.unwrap();
    let port = server.local_addr().port().to_string();
    let found = scan(&["--network", "127.1.3.1", "--tcp", &port, "--stations", "1-6", "--format", "json"]).await;
    assert_eq!(found.status, 6, "{found:?}");
    let rows = rows(&found);
    let column = |key: &str| rows.iter().map(|row| row[key].clone()).collect::<Vec<_>>();
    assert_eq!(column("station"), [1, 2, 3, 5, 6]);
    assert_eq!(column("answer"), ["ok", "refused", "late", "bad", "ok"], "{rows:#?}");
    assert_eq!(rows[1]["note"], "illegal format, or the command cannot be executed (4)");
    assert!(rows[2]["note"].as_str().unwrap().contains("increase --timeout"), "{rows:#?}");
    assert!(rows[3]["note"].as_str().unwrap().ends_with(" bytes that are no frame"), "{rows:#?}");
    assert_eq!(column("main_unit")[4], Value::Null, "a model without a detailed status");
    server.shutdown().await;
}

/// Closes the connection after a frame that it does not understand.
#[tokio::test(flavor = "multi_thread")]
async fn a_binary_device_that_closes_after_an_ascii_frame_is_found() {
    let listener = TcpListener::bind("127.1.10.1:0").unwrap();
    let port = listener.local_addr().unwrap().port().to_string();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let (mut stream, mut request) = (stream.unwrap(), [0; 64]);
            while let Ok(len @ 1..) = stream.read(&mut request) {
                let (mut codec, mut bytes) = (Codec::new(Framing::Binary, Side::Plc), BytesMut::from(&request[..len]));
                let Some(frame) = codec.decode(&mut bytes).unwrap().and_then(Received::frame) else { break };
                let mut reply = BytesMut::new();
                if frame.command == 0x40 {
                    let status = BriefStatus::from_raw([1, 0, 0]);
                    encode_reply(&ReadStatus, Ok(&status), Framing::Binary, frame.station, &mut reply);
                } else {
                    encode_refusal(0x53, ErrorCode::IllegalFormat, Framing::Binary, frame.station, &mut reply);
                }
                stream.write_all(&reply).unwrap();
            }
        }
    });
    let found = scan(&["--network", "127.1.10.1", "--tcp", &port, "--stations", "1", "--format", "json"]).await;
    assert_eq!(found.status, 0, "{found:?}");
    let expected = format!("tcp://127.1.10.1:{port}?framing=binary 1 ok");
    assert_eq!(rows(&found).iter().map(summary).collect::<Vec<_>>(), [expected]);
}

/// Each port of a PLC has a setting of its own.
#[tokio::test(flavor = "multi_thread")]
async fn two_ports_of_a_host_may_have_two_framings() {
    let faults = Faults::new(1);
    let port = free_port("127.1.11.1");
    let tcp = Server::bind(("127.1.11.1", port), bus(&[1], &faults), Framing::Ascii).await.unwrap();
    let udp = UdpServer::bind(("127.1.11.1", port), bus(&[1], &faults), Framing::Binary).await.unwrap();
    let number = port.to_string();
    let ports = ["--network", "127.1.11.1", "--tcp", &number, "--udp", &number, "--stations", "1"];
    let found = scan(&[&ports[..], &["--retries", "0", "--format", "json"]].concat()).await;
    assert_eq!(
        rows(&found).iter().map(summary).collect::<Vec<_>>(),
        [format!("tcp://127.1.11.1:{port} 1 ok"), format!("udp://127.1.11.1:{port}?framing=binary 1 ok")]
    );
    tcp.shutdown().await;
    udp.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_late_reply_of_the_last_station_is_late() {
    let faults = Faults::new(1);
    let late = Duration::from_millis(1300);
    faults.add_rule(Rule::new(Fault::Delay { min: late, max: late }).station(2));
    let server = Server::bind("127.1.12.1:0", bus(&[1, 2], &faults), Framing::Ascii).await.unwrap();
    let port = server.local_addr().port().to_string();
    for (stations, expected) in [("2", &["2 late"][..]), ("1-2", &["1 ok", "2 late"])] {
        let found =
            scan(&["--network", "127.1.12.1", "--tcp", &port, "--stations", stations, "--format", "json"]).await;
        assert_eq!(found.status, 6, "{found:?}");
        let expected: Vec<_> = expected.iter().map(|text| format!("tcp://127.1.12.1:{port} {text}")).collect();
        assert_eq!(rows(&found).iter().map(summary).collect::<Vec<_>>(), expected);
    }
    server.shutdown().await;
}

/// Answers the first request of each connection, and closes it.
#[tokio::test(flavor = "multi_thread")]
async fn a_device_that_closes_after_each_reply_is_scanned_whole() {
    let listener = TcpListener::bind("127.1.4.1:0").unwrap();
    let port = listener.local_addr().unwrap().port().to_string();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let (mut stream, mut request) = (stream.unwrap(), [0; 64]);
            let Ok(len @ 1..) = stream.read(&mut request) else { continue };
            let station = std::str::from_utf8(&request[1..3]).unwrap();
            let reply = match request.get(3..5) {
                Some(b"40") if len > 5 => format!("{station}400010000"),
                _ => format!("{station}534"),
            };
            stream.write_all(&process::ascii(&reply)).unwrap();
        }
    });
    let found = scan(&["--network", "127.1.4.1", "--tcp", &port, "--stations", "1,2", "--format", "json"]).await;
    assert_eq!(found.status, 0, "{found:?}");
    assert_eq!(
        rows(&found).iter().map(summary).collect::<Vec<_>>(),
        [format!("tcp://127.1.4.1:{port} 1 ok"), format!("tcp://127.1.4.1:{port} 2 ok")]
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn another_protocol_is_reported_and_is_no_plc() {
    let socket = UdpSocket::bind("127.1.5.1:0").unwrap();
    let port = socket.local_addr().unwrap().port().to_string();
    thread::spawn(move || {
        let mut buffer = [0; 64];
        while let Ok((_, sender)) = socket.recv_from(&mut buffer) {
            socket.send_to(b"\x00\x01IKE", sender).unwrap();
        }
    });
    let args = ["--network", "127.1.5.1", "--udp", &port, "--stations", "1", "--retries", "0", "--format", "json"];
    let found = scan(&args).await;
    assert_eq!(found.status, 4, "{found:?}");
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!((&row["answer"], &row["station"]), (&"other".into(), &Value::Null));
    assert_eq!(row["note"], "10 bytes that are no frame; another protocol (IPsec has UDP 500, too)?");
}

/// Over UDP a lost request looks like a host that is not there.
#[tokio::test(flavor = "multi_thread")]
async fn a_lost_datagram_is_sent_again_over_udp() {
    let faults = Faults::new(1);
    faults.add_rule(Rule::new(Fault::Ignore).times(1));
    let server = UdpServer::bind("127.1.6.1:0", bus(&[1], &faults), Framing::Ascii).await.unwrap();
    let port = server.local_addr().port().to_string();
    let found = scan(&["--network", "127.1.6.1", "--udp", &port, "--stations", "1", "--format", "json"]).await;
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!((found.status, &row["note"]), (0, &"after 2 requests".into()), "{found:?}");

    faults.add_rule(Rule::new(Fault::Ignore).times(1));
    let args = ["--network", "127.1.6.1", "--udp", &port, "--stations", "1", "--framing", "ascii", "--retries", "0"];
    let lost = scan(&args).await;
    assert_eq!((lost.status, lost.stdout.as_str()), (4, ""), "{lost:?}");
    assert!(lost.stderr.contains("ports: 0 refused, 1 without an answer"), "{lost:?}");
    server.shutdown().await;
}

/// Connections are counted at a host; their times do not depend on the speed of the machine.
#[test]
fn the_rate_bounds_the_connections_per_second() {
    let port = free_port("127.1.7.1");
    let accepted: Vec<_> = (1..=6).map(|host| TcpListener::bind((format!("127.1.7.{host}"), port)).unwrap()).collect();
    let begun = Instant::now();
    let number = port.to_string();
    let args = ["scan", "--network", "127.1.7.1-6", "--tcp", &number, "--rate", "10", "--timeout", "10ms"];
    assert_eq!(fatek(&args).status, 4);
    // The first of six connections is opened at once.
    assert!(begun.elapsed() >= Duration::from_millis(500), "{:?}", begun.elapsed());
    drop(accepted);
}

#[test]
fn the_rate_bounds_the_datagrams_per_second() {
    let silent = UdpSocket::bind("127.1.13.1:0").unwrap();
    let port = silent.local_addr().unwrap().port().to_string();
    let begun = Instant::now();
    let args = ["scan", "--network", "127.1.13.1", "--udp", &port, "--rate", "10", "--timeout", "10ms"];
    let stations = ["--stations", "1-6", "--retries", "0", "--framing", "ascii"];
    assert_eq!(fatek(&[&args[..], &stations].concat()).status, 4);
    // The first of six datagrams is sent at once.
    assert!(begun.elapsed() >= Duration::from_millis(500), "{:?}", begun.elapsed());
}

#[test]
fn invalid_arguments_send_nothing() {
    let scan = |args: &[&str]| fatek(&[&["scan"], args].concat()).usage();
    for (args, rule) in [
        (&["--network", "10.0.0.0/15"][..], "131070 hosts are more than 65536"),
        (&["--network", "10.0.0.0/16,10.1.0.0/16"], "131068 hosts are more than 65536"),
        (&["--network", "fd00::/64"], "/112 or longer"),
        (&["--network", "192.168.1.0/33"], "the length of its prefix"),
        (&["--network", "224.0.0.1"], "is not the address of a host"),
        (&["--network", "::ffff:224.0.0.1"], "224.0.0.1 is not the address of a host"),
        (&["--network", "ff02::1%lo"], "ff02::1 is not the address of a host"),
        (&["--network", "0x0"], "0x0: 0.0.0.0 is not the address of a host"),
        (&["--network", "127.0.0.1", "--link", "tcp://127.0.0.1"], "cannot be used with"),
        (&["--network", "127.0.0.1", "--tcp", "0"], "0 is not in 1..=65535"),
        (&["--network", "127.0.0.1", "--rate", "0"], "0 is not in 1..=10000"),
        (&["--network", "127.0.0.1", "--at-once", "513"], "513 is not in 1..=512"),
        (&["--network", "127.0.0.1", "--stations", "1-300"], "is not a list of stations"),
        (&["--network", "127.0.0.1", "--stations", "1", "2"], "cannot be used with"),
        (&["--tcp", "500"], "--network"),
        (&["--discover", "--network", "127.0.0.1"], "cannot be used with"),
        (&["--discover", "--broadcast", "host"], "`host` is not an IPv4 address"),
        (&["--discover", "--broadcast", "127.0.0.1:0"], "is not an IPv4 address"),
    ] {
        let usage = scan(args);
        assert!(usage.contains(rule), "{args:?}: {usage}");
    }
}

#[test]
fn a_name_without_an_address_is_status_5() {
    // Longer than a label can be, so that no server of names is asked.
    let name = "a".repeat(70);
    let failed = fatek(&["scan", "--network", &name]);
    assert_eq!(failed.status, 5, "{failed:?}");
    assert!(failed.stderr.starts_with(&format!("error: the address of {name} is not known: ")), "{failed:?}");
}

#[test]
fn a_single_ipv6_host_is_scanned() {
    let Ok(listener) = TcpListener::bind("[::1]:0") else {
        eprintln!("skipped: this machine has no IPv6");
        return;
    };
    let port = listener.local_addr().unwrap().port();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            while stream.read(&mut [0; 64]).is_ok_and(|len| len > 0) {
                let _ = stream.write_all(&process::ascii("01400010000"));
            }
        }
    });
    let args = ["scan", "--network", "::1", "--tcp", &port.to_string(), "--stations", "1", "--timeout", "1s"];
    let found = fatek(&[&args[..], &["--format", "json"]].concat());
    assert_eq!(rows(&found)[0]["link"], format!("tcp://[::1]:{port}"), "{found:?}");
}

/// The first host answers, the second accepts the connection and stays silent.
#[tokio::test(flavor = "multi_thread")]
async fn a_signal_ends_the_scan_with_the_results_so_far() {
    let port = free_port("127.1.8.1");
    let server = Server::bind(("127.1.8.1", port), bus(&[1], &Faults::new(1)), Framing::Ascii).await.unwrap();
    let silent = TcpListener::bind(("127.1.8.2", port)).unwrap();
    let mut command = Command::new(FATEK);
    command.args(["scan", "--network", "127.1.8.1-2", "--tcp", &port.to_string(), "--stations", "1"]);
    command.args(["--timeout", "60s", "--at-once", "1", "--format", "csv"]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let ended = tokio::task::spawn_blocking(move || {
        // The first host is finished when the second is connected.
        let connection = silent.accept().unwrap();
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
        (child.wait_with_output().unwrap(), connection)
    });
    let (ended, _) = ended.await.unwrap();
    let (stdout, stderr) = (String::from_utf8(ended.stdout).unwrap(), String::from_utf8(ended.stderr).unwrap());
    assert_eq!(ended.status.code(), Some(130), "{stderr}");
    assert!(stdout.contains("127.1.8.1,tcp"), "{stdout}");
    assert!(stderr.ends_with("error: interrupted by SIGINT\n"), "{stderr}");
    assert!(stderr.contains("1 host scanned, 1 station answered"), "{stderr}");
    server.shutdown().await;
}

/// A module that answers both packets of a discovery with these bytes, and returns the packets.
fn module(address: &str, reply: Vec<u8>) -> (String, thread::JoinHandle<[Vec<u8>; 2]>) {
    let socket = UdpSocket::bind((address, 0)).unwrap();
    let url = socket.local_addr().unwrap().to_string();
    let thread = thread::spawn(move || {
        let mut buffer = [0; 64];
        [(); 2].map(|()| {
            let (len, sender) = socket.recv_from(&mut buffer).unwrap();
            socket.send_to(&reply, sender).unwrap();
            buffer[..len].to_vec()
        })
    });
    (url, thread)
}

/// A reply of the form that is publicly known.
fn reply_of_a_module() -> Vec<u8> {
    let mut reply = vec![0; 400];
    for (at, bytes) in [
        (0, &b"\x0A"[..]),
        (5, b"\x58\x76"),
        (9, b"\x38"),
        (11, b"\x00\x0D\xE0\x01\x02\x03"),
        (17, &[127, 1, 9, 1, 127, 1, 9, 254, 255, 255, 255, 0]),
        (29, b"PUMP\x1b[2J"),
        (41, b"Boiler house"),
        (76, b"\x01\xF4"),
        (79, b"\x01\xF6"),
    ] {
        reply[at..at + bytes.len()].copy_from_slice(bytes);
    }
    reply
}

fn discover(address: &str, args: &[&str]) -> Output {
    let fixed = ["scan", "--discover", "--broadcast", address, "--source-port", "0", "--timeout", "1s"];
    fatek(&[&fixed[..], args].concat())
}

#[test]
fn a_module_that_answers_the_discovery_is_shown_as_unverified() {
    let (address, module) = module("127.1.9.1", reply_of_a_module());
    let found = discover(&address, &["--format", "json"]);
    let packets = module.join().unwrap();
    assert_eq!(packets[0], [0x13, 0x0C, 0x2F, 0x9B, 0x77, 0x70, 0x89, 0xAA]);
    assert_eq!(packets[1], [0x09, 0x50, 0x83, 0x04, 0x5A, 0x22, 0x00, 0x22]);
    assert_eq!(found.status, 0, "{found:?}");
    assert!(found.stderr.contains("discovery of modules is unverified on hardware\n"), "{found:?}");
    assert!(found.stderr.contains("hint: to find its stations: fatek scan --network 127.1.9.1\n"), "{found:?}");
    // The same reply to both packets is one module.
    let [row] = &rows(&found)[..] else { panic!("{found:?}") };
    assert_eq!((&row["sender"], &row["address"]), (&"127.1.9.1".into(), &"127.1.9.1".into()));
    assert_eq!((&row["name"], &row["description"]), (&"PUMP\u{1b}[2J".into(), &"Boiler house".into()));
    assert_eq!((&row["firmware"], &row["mac"]), (&"5.6".into(), &"00:0d:e0:01:02:03".into()));
    assert_eq!((&row["fatek_port"], &row["modbus_port"]), (&500.into(), &502.into()));
    assert_eq!((&row["verified"], &row["note"]), (&false.into(), &Value::Null));
    assert!(!found.stdout.contains('\x1b'), "{found:?}");
}

/// The hint has the address of the sender, which is the one that the module can be reached at.
#[test]
fn the_hint_of_a_discovery_has_address_and_ports() {
    let mut reply = reply_of_a_module();
    reply[76..78].copy_from_slice(&5000_u16.to_be_bytes());
    let (address, _) = module("127.1.9.4", reply);
    let found = discover(&address, &[]);
    let hint = "hint: to find its stations: fatek scan --network 127.1.9.4 --tcp 5000 --udp 5000\n";
    assert!(found.stderr.contains(hint), "{found:?}");
}

#[test]
fn an_unknown_reply_is_shown_as_it_is_and_is_status_6() {
    let (address, _) = module("127.1.9.2", b"\x01\x02FATEK CBE\xff".to_vec());
    let found = discover(&address, &[]);
    assert_eq!(found.status, 6, "{found:?}");
    assert!(
        found.stdout.contains("unknown reply of 12 bytes: 0102464154454B20434245FF, with \"FATEK CBE\""),
        "{found:?}"
    );
    assert!(found.stderr.ends_with("error: replies of unknown form: 1\n"), "{found:?}");
}

#[test]
fn a_discovery_without_a_reply_is_status_4() {
    let socket = UdpSocket::bind("127.1.9.3:0").unwrap();
    let found = discover(&socket.local_addr().unwrap().to_string(), &["--format", "csv"]);
    assert_eq!(found.status, 4, "{found:?}");
    assert_eq!(found.stdout.lines().count(), 1, "{found:?}");
    assert!(found.stderr.ends_with("error: no module answered\n"), "{found:?}");
}
