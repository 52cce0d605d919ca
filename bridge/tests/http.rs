//! HTTP of the bridge: endpoints, rules and limits, against simulated PLCs.

mod common;

use std::fmt::Write as _;
use std::process::Stdio;
use std::time::Duration;

use common::http::{HttpBridge, command, request};
use common::plc::SimPlc;
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::timeout;

/// A configuration of one PLC. Its tags are stale for three seconds before they are bad.
fn config(sim: &SimPlc) -> String {
    format!(
        r#"
[bridge]
id = "hall-2"
http = "HTTP"
[stdout]
[class]
fast = {{ every = "400ms", stale_after = "800ms" }}
[plc.mixer]
link = "{}"
station = 1
tag.level = {{ at = "R5:i16*0.1", class = "fast", unit = "a\"b\\c", comment = "<b>" }}
tag.running = {{ at = "M7", class = "fast" }}
tag.name = {{ at = "R10-R11:text", class = "fast" }}
tag.recipe = {{ at = "R30-R32", class = "fast" }}
tag.ratio = {{ at = "R40:f32", class = "fast" }}
"#,
        sim.link()
    )
}

async fn bridge_with(sim: &SimPlc) -> HttpBridge {
    HttpBridge::start(&config(sim)).await
}

async fn mixer() -> SimPlc {
    let sim = SimPlc::start(&[]).await;
    let write = |register: u16, word: u16| sim.plc.write(fatek::Register::r(register), word).unwrap();
    write(5, 423);
    write(10, u16::from_le_bytes(*b"ab"));
    (30..33).for_each(|register| write(register, register));
    // Not a number.
    write(41, 0x7FC0);
    sim.plc.write(fatek::Discrete::parse("M7").unwrap(), true).unwrap();
    sim
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

/// The tag of an answer of `/api/tags`.
fn tag(answer: &str, name: &str) -> Value {
    let tags = json(answer)["tags"].as_array().unwrap().clone();
    tags.into_iter().find(|tag| tag["tag"] == name).unwrap_or_else(|| panic!("no {name} in {answer}"))
}

fn is_good(answer: &str) -> bool {
    tag(answer, "level")["quality"] == "good"
}

#[tokio::test(flavor = "multi_thread")]
async fn tags_have_values_while_they_are_good_or_stale() {
    let mut sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    let tags = bridge.get_until("/api/tags", is_good).await;
    let level = tag(&tags, "level");
    assert_eq!((&level["plc"], &level["at"], &level["value"]), (&"mixer".into(), &"R5:i16*0.1".into(), &42.3.into()));
    assert_eq!((&level["unit"], &level["why"]), (&"a\"b\\c".into(), &Value::Null));
    assert!(level["age_ms"].as_u64().unwrap() < 10_000 && level["ts"].as_u64().unwrap() > 1_700_000_000_000, "{level}");
    assert_eq!((&tag(&tags, "running")["value"], &tag(&tags, "name")["value"]), (&true.into(), &"ab".into()));
    assert_eq!((&tag(&tags, "recipe")["value"], &tag(&tags, "ratio")["value"]), (&json("[30,31,32]"), &"NaN".into()));
    assert_eq!(json(&bridge.get("/api/tags?plc=mixer").await.body)["tags"].as_array().unwrap().len(), 5);
    assert_eq!(bridge.get("/api/tags?plc=none").await.status, 404);
    assert_eq!(bridge.get("/api/tags?plcs=mixer").await.status, 400);

    sim.stop().await;
    let stale = bridge.get_until("/api/tags", |tags| tag(tags, "level")["quality"] == "stale").await;
    let level = tag(&stale, "level");
    assert!(level["value"] == 42.3 && !level["why"].as_str().unwrap().is_empty(), "{level}");
    let bad = bridge.get_until("/api/tags", |tags| tag(tags, "level")["quality"] == "bad").await;
    for name in ["level", "running", "name", "recipe", "ratio"] {
        assert_eq!(tag(&bad, name)["value"], Value::Null, "{name}");
    }
    assert_eq!((bridge.get("/readyz").await.status, bridge.get("/healthz").await.status), (200, 200));
    sim.resume().await;
    bridge.get_until("/api/tags", is_good).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_are_openmetrics_without_values_of_old_readings() {
    let mut sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    bridge.get_until("/api/tags", is_good).await;
    let open = "Accept: application/openmetrics-text;version=1.0.0;q=0.75,text/plain;version=0.0.4;q=0.5\r\n";
    let answer = bridge.get_with("/metrics", open).await;
    assert!(answer.head.contains("content-type: application/openmetrics-text; version=1.0.0; charset=utf-8"));
    let metrics = common::openmetrics::parse(&answer.body);
    let value = |series: &str| *metrics.get(series).unwrap_or_else(|| panic!("no {series} in {}", answer.body));
    assert_eq!(value(r#"fatek_tag_value{plc="mixer",tag="level"}"#), 42.3);
    assert_eq!(value(r#"fatek_tag_value{plc="mixer",tag="running"}"#), 1.0);
    assert_eq!(value(r#"fatek_tag_value{plc="mixer",tag="recipe",index="2"}"#), 32.0);
    assert_eq!(value(r#"fatek_tag_quality{plc="mixer",tag="level"}"#), 2.0);
    assert!(value(r#"fatek_tag_age_seconds{plc="mixer",tag="level"}"#) < 10.0);
    assert_eq!(value(r#"fatek_tag_info{plc="mixer",tag="level",unit="a\"b\\c",class="fast"}"#), 1.0);
    assert_eq!(value(r#"fatek_plc_online{plc="mixer"}"#), 1.0);
    assert!(value(r#"fatek_plc_round_trip_seconds{plc="mixer"}"#) > 0.0);
    assert!(value(r#"fatek_plc_requests_total{plc="mixer"}"#) > 0.0);
    assert_eq!(value(r#"fatek_class_tags{plc="mixer",class="fast"}"#), 5.0);
    assert_eq!(value(r#"fatek_class_period_seconds{plc="mixer",class="fast"}"#), 0.4);
    assert_eq!(value(&format!(r#"fatek_link_up{{link="{}"}}"#, sim.link())), 1.0);
    assert_eq!(value(&format!(r#"fatek_link_withheld_requests_total{{link="{}"}}"#, sim.link())), 0.0);
    assert_eq!(value(r#"fatek_pool_links{state="up"}"#), 1.0);
    assert_eq!(value(r#"fatek_output_connected{output="stdout"}"#), 1.0);
    assert!(value(r#"fatek_output_samples_total{output="stdout"}"#) > 0.0);
    // Texts and numbers that are none have no value.
    for name in ["name", "ratio"] {
        assert!(!metrics.contains_key(&format!(r#"fatek_tag_value{{plc="mixer",tag="{name}"}}"#)), "{name}");
    }
    let older = bridge.get_with("/metrics", "Accept: text/plain\r\n").await;
    assert!(older.head.contains("content-type: text/plain; version=0.0.4"));
    assert!(older.body.contains("# TYPE fatek_poller_samples_total counter\n"), "{}", older.body);

    sim.stop().await;
    let stopped = bridge
        .get_until("/metrics", |metrics| metrics.contains(r#"fatek_tag_quality{plc="mixer",tag="level"} 1"#))
        .await;
    assert!(!stopped.contains("\nfatek_tag_value{"), "a stale tag has no value: {stopped}");
    let bad = bridge
        .get_until("/metrics", |metrics| metrics.contains(r#"fatek_tag_quality{plc="mixer",tag="level"} 0"#))
        .await;
    assert!(!bad.contains("\nfatek_tag_value{") && !bad.contains("\nfatek_tag_age_seconds{"), "{bad}");
}

#[tokio::test(flavor = "multi_thread")]
async fn only_reads_of_this_machine_are_answered() {
    let sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    let status = async |method: &str, path: &str, host: &str| {
        let text = format!("{method} {path} HTTP/1.1\r\n{host}Content-Length: 0\r\nConnection: close\r\n\r\n");
        request(bridge.http, &text).await.unwrap().status
    };
    for path in ["/", "/app.js", "/events", "/metrics", "/api/tags", "/healthz", "/none"] {
        for method in ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"] {
            assert_eq!(status(method, path, "Host: localhost\r\n").await, 405, "{method} {path}");
        }
        // A name that resolves to 127.0.0.1, as in DNS rebinding.
        for host in ["evil.example", "evil.example:9187", "localhost.evil.example", "0.0.0.0", "192.168.2.3", ""] {
            assert_eq!(status("GET", path, &format!("Host: {host}\r\n")).await, 421, "{host} {path}");
        }
    }
    for host in ["localhost", "localhost:1234", "127.0.0.1", "[::1]:9187"] {
        assert_eq!(status("GET", "/api/tags", &format!("Host: {host}\r\n")).await, 200, "{host}");
    }
    assert_eq!(status("GET", "/none", "Host: localhost\r\n").await, 404);
    assert_eq!(status("GET", "/../Cargo.toml", "Host: localhost\r\n").await, 404);

    for path in ["/", "/metrics", "/none"] {
        let head = bridge.get(path).await.head;
        assert!(head.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{head}");
        assert!(head.contains("frame-ancestors 'none'") && !head.contains("unsafe"), "{head}");
        assert!(head.contains("x-content-type-options: nosniff") && head.contains("x-frame-options: deny"), "{head}");
        assert!(!head.contains("access-control-allow"), "{head}");
        assert!(
            head.contains(if path == "/" { "cache-control: no-cache" } else { "cache-control: no-store" }),
            "{head}"
        );
    }
    let head = bridge.get("/app.js").await.head;
    let tag = head.lines().find_map(|line| line.strip_prefix("etag: ")).unwrap();
    assert_eq!(bridge.get_with("/app.js", &format!("If-None-Match: {tag}\r\n")).await.status, 304);
}

/// Reads events until a text was seen a number of times, and returns all that was read.
async fn read_until(stream: &mut TcpStream, wanted: &str, times: usize) -> String {
    let reading = async {
        let (mut text, mut seen, mut searched) = (Vec::new(), 0, 0);
        let mut part = [0; 65_536];
        while seen < times {
            let size = stream.read(&mut part).await.unwrap();
            assert!(size > 0, "the stream ended");
            text.extend_from_slice(&part[..size]);
            while let Some(found) = text[searched..].windows(wanted.len()).position(|text| text == wanted.as_bytes()) {
                searched += found + wanted.len();
                seen += 1;
            }
            searched = searched.max(text.len().saturating_sub(wanted.len() - 1));
        }
        String::from_utf8_lossy(&text).into_owned()
    };
    timeout(Duration::from_secs(60), reading).await.expect("no such event")
}

async fn open_events(bridge: &HttpBridge) -> TcpStream {
    let mut stream = TcpStream::connect(bridge.http).await.unwrap();
    stream.write_all(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").await.unwrap();
    stream
}

#[tokio::test(flavor = "multi_thread")]
async fn events_are_a_snapshot_and_then_changes() {
    let sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    bridge.get_until("/api/tags", is_good).await;
    let mut stream = open_events(&bridge).await;
    let text = read_until(&mut stream, "event: changes\n", 1).await;
    let snapshot = text.split("event: snapshot\ndata: ").nth(1).unwrap().split("\n\n").next().unwrap();
    let snapshot = json(snapshot);
    assert_eq!(snapshot["plcs"][0]["plc"], "mixer");
    assert_eq!(snapshot["plcs"][0]["tags"].as_array().unwrap().len(), snapshot["values"].as_array().unwrap().len());
    assert!(text.find("event: snapshot") < text.find("event: changes"), "{text}");
    // A value that changes is in the next changes, by the place of its tag.
    let place = snapshot["plcs"][0]["tags"].as_array().unwrap().iter().position(|tag| tag["tag"] == "level").unwrap();
    sim.plc.write(fatek::Register::r(5), 777_u16).unwrap();
    read_until(&mut stream, &format!("[{place},[77.7,\"good\","), 1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_limited_number_of_readers_is_served() {
    let sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    let mut streams = Vec::new();
    for _ in 0..32 {
        let mut stream = open_events(&bridge).await;
        read_until(&mut stream, "event: snapshot\n", 1).await;
        streams.push(stream);
    }
    let answer = bridge.get("/events").await;
    assert_eq!(answer.status, 503, "{}", answer.head);
    assert!(answer.head.contains("retry-after:"), "{}", answer.head);
    assert_eq!(bridge.get("/api/status").await.status, 200);
    drop(streams);
    bridge.get_until("/metrics", |metrics| metrics.contains("fatek_page_streams 0\n")).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_port_that_is_in_use_is_a_clear_error() {
    let sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    let second = command(&bridge.folder().join("bridge.toml")).stderr(Stdio::piped()).output().await.unwrap();
    let error = String::from_utf8_lossy(&second.stderr).into_owned();
    assert_eq!(second.status.code(), Some(1), "{error}");
    let expected = format!("cannot listen on {}: Address already in use", bridge.http);
    assert!(error.contains(&expected) && error.contains("another program has this port"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_snapshot_of_history_has_the_last_values() {
    let sim = mixer().await;
    let bridge = bridge_with(&sim).await;
    let has_two = |answer: &str| {
        let level = &json(answer)["tags"]["level"];
        level.as_array().is_some_and(|values| values.len() >= 2)
    };
    let history = bridge.get_until("/api/history?plc=mixer&tags=level,running", has_two).await;
    let history = json(&history);
    assert!((history["tags"]["level"][0].as_f64().unwrap() - 42.3).abs() < 1e-4, "{history}");
    assert_eq!(history["tags"]["running"][0], 1.0, "{history}");
    for (query, status) in [("plc=none&tags=level", 404), ("plc=mixer&tags=none", 404), ("plc=mixer", 400)] {
        assert_eq!(bridge.get(&format!("/api/history?{query}")).await.status, status, "{query}");
    }
    let many = vec!["level"; 257].join(",");
    assert_eq!(bridge.get(&format!("/api/history?plc=mixer&tags={many}")).await.status, 400);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_reader_gets_a_snapshot_and_one_that_stops_is_dropped() {
    // Each tag changes with each frame, so that the buffers of the system are soon full.
    let sim = SimPlc::start(&[("R0-R2999", "random(0..65535,100ms)")]).await;
    let mut config = format!(
        "[bridge]\nhttp = \"HTTP\"\n[class]\nfast = {{ every = \"200ms\", stale_after = \"5s\" }}\n\
         [plc.store]\nlink = \"{}\"\nstation = 1\n",
        sim.link()
    );
    (0..3000)
        .for_each(|place| config.push_str(&format!("tag.place-{place} = {{ at = \"R{place}\", class = \"fast\" }}\n")));
    let bridge = HttpBridge::start(&config).await;
    let open = async || {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(32 * 1024).unwrap();
        let mut stream = socket.connect(bridge.http).await.unwrap();
        stream.write_all(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").await.unwrap();
        stream
    };
    let (mut slow, stopped) = (open().await, open().await);
    let memory = || {
        let pid = bridge.child.id().unwrap();
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmRSS")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
    };
    let before = memory();
    let began = std::time::Instant::now();
    let mut fast = open_events(&bridge).await;
    // The one that reads is not held up: these are 13 s of frames, of 66 kB each.
    read_until(&mut fast, "event: changes\n", 26).await;
    drop(fast);
    read_until(&mut slow, "event: snapshot\n", 2).await;
    drop(slow);
    let metrics = bridge.get("/metrics").await.body;
    assert!(!metrics.contains("fatek_page_resyncs_total 0"), "{metrics}");
    // The one that does not read at all ends after 30 s.
    bridge.get_until("/metrics", |metrics| metrics.contains("fatek_page_streams 0\n")).await;
    println!("memory before and after: {before} and {} KiB; dropped after {:?}", memory(), began.elapsed());
    drop(stopped);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reload_sends_a_snapshot_and_keeps_the_history() {
    let (sim, agitator) = (mixer().await, mixer().await);
    let bridge = bridge_with(&sim).await;
    let has_two = |answer: &str| json(answer)["tags"]["level"].as_array().is_some_and(|values| values.len() >= 2);
    bridge.get_until("/api/history?plc=mixer&tags=level", has_two).await;
    let mut stream = open_events(&bridge).await;
    read_until(&mut stream, "event: changes\n", 1).await;
    // The order of the tags is another one then, and a PLC is before the one that stays.
    let text = config(&sim).replace("HTTP", &bridge.http.to_string()).replace("tag.running", "tag.motor");
    let text = format!("{text}[plc.agitator]\nlink = \"{}\"\nstation = 1\ntag.speed = \"R6\"\n", agitator.link());
    std::fs::write(bridge.folder().join("bridge.toml"), text).unwrap();
    let pid = bridge.child.id().unwrap().to_string();
    assert!(std::process::Command::new("kill").args(["-s", "HUP", &pid]).status().unwrap().success());
    let text = read_until(&mut stream, "event: snapshot\n", 1).await + &read_until(&mut stream, "\n\n", 1).await;
    let snapshot = json(text.rsplit("event: snapshot\ndata: ").next().unwrap().split("\n\n").next().unwrap());
    assert_eq!((&snapshot["plcs"][0]["plc"], &snapshot["plcs"][1]["plc"]), (&"agitator".into(), &"mixer".into()));
    let names: Vec<&str> =
        snapshot["plcs"][1]["tags"].as_array().unwrap().iter().map(|tag| tag["tag"].as_str().unwrap()).collect();
    assert!(names.contains(&"motor") && !names.contains(&"running"), "{names:?}");
    let history = bridge.get("/api/history?plc=mixer&tags=level").await.body;
    assert!(has_two(&history), "{history}");
    assert_eq!(bridge.get("/api/history?plc=mixer&tags=running").await.status, 404);
    bridge
        .get_until("/metrics", |metrics| metrics.contains(r#"fatek_tag_quality{plc="agitator",tag="speed"} 2"#))
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bridge_whose_buffer_is_full_is_alive_but_not_ready() {
    let sim = SimPlc::start(&[("R0-R999", "random(0..65535,100ms)")]).await;
    let mut config = format!(
        "[bridge]\nhttp = \"HTTP\"\nbuffer = {{ memory = \"256KiB\" }}\n[stdout]\n\
         [class]\nfast = {{ every = \"200ms\" }}\n[plc.store]\nlink = \"{}\"\nstation = 1\n",
        sim.link()
    );
    (0..1000)
        .for_each(|place| writeln!(config, "tag.place-{place} = {{ at = \"R{place}\", class = \"fast\" }}").unwrap());
    // An output that takes nothing: a pipe that is not read.
    let mut bridge = HttpBridge::start_with(&config, Stdio::piped()).await;
    bridge.get_until("/readyz", |answer| answer.contains("full")).await;
    assert_eq!((bridge.get("/readyz").await.status, bridge.get("/healthz").await.status), (503, 200));
    let drops = |metrics: &str| !metrics.contains("fatek_output_dropped_batches_total{output=\"stdout\"} 0\n");
    bridge.get_until("/metrics", drops).await;
    let mut stdout = bridge.child.stdout.take().unwrap();
    tokio::spawn(async move { tokio::io::copy(&mut stdout, &mut tokio::io::sink()).await });
    bridge.get_until("/readyz", |answer| answer == "ok\n").await;
}
