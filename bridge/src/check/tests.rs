use super::*;

const ROUND_TRIP: Duration = Duration::from_millis(5);

fn report_in(folder: &Path, text: &str, environment: &Environment) -> Report {
    let path = folder.join("plant.toml");
    std::fs::write(&path, text).unwrap();
    Report::of(&path, environment, ROUND_TRIP)
}

fn report(text: &str) -> Report {
    let folder = tempfile::tempdir().unwrap();
    report_in(folder.path(), text, &Environment::default())
}

/// A configuration without a finding.
const GOOD: &str = "[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\ntag.level = 'R5'\n[stdout]\n";

fn findings(text: &str) -> Vec<String> {
    report(text).findings.iter().map(ToString::to_string).collect()
}

#[test]
fn a_good_configuration_has_no_findings() {
    let report = report(GOOD);
    assert_eq!(report.findings, []);
    assert!(report.to_string().ends_with("plant.toml: no faults"), "{report}");
    let [plan] = &report.plans[..] else { panic!("{report}") };
    assert_eq!((plan.plc.as_str(), plan.tags, plan.requests, &plan.class), ("mixer", 1, 1, &None));
    assert_eq!(plan.every, Duration::from_secs(1));
}

#[test]
fn the_load_of_a_line_is_that_of_its_bytes() {
    let bus = |baud: u32, stations: &str| {
        format!(
            "[class]\nfast = {{ every = '100ms' }}\n[template.t]\nx = {{ at = 'R0', class = 'fast' }}\n\
             [bus.line]\nlink = 'serial:/dev/ttyX?baud={baud}'\nstations = {{ {stations} }}\nuse = ['t']\n[stdout]\n"
        )
    };
    let one = report(&bus(9600, "a = 1"));
    let [link] = &one.links[..] else { panic!("{one}") };
    // A request of 13 and a reply of 13 characters of 10 bits at 9600 bit/s, ten times a second.
    let [plan] = &one.plans[..] else { panic!("{one}") };
    let bytes = Duration::from_secs_f64(plan.bytes as f64 * 10.0 / 9600.0);
    assert!(plan.time > bytes + ROUND_TRIP && plan.time < bytes + ROUND_TRIP * 3, "{plan:?}");
    assert!((link.load - plan.time.as_secs_f64() * 10.0).abs() < 1e-9, "{link:?}");
    assert!((link.requests_per_second - 10.0 * plan.requests as f64).abs() < 1e-9, "{link:?}");
    assert!((link.bytes_per_second - 10.0 * plan.bytes as f64).abs() < 1e-9, "{link:?}");
    let four = report(&bus(9600, "a = 1, b = 2, c = 3, d = 4"));
    let [link] = &four.links[..] else { panic!("{four}") };
    assert!((link.load - 4.0 * one.links[0].load).abs() < 1e-9 && link.plcs == 4, "{link:?}");
    let texts: Vec<String> = four.findings.iter().map(ToString::to_string).collect();
    assert!(link.load > 1.0 && texts.iter().any(|text| text.contains("values come late")), "{texts:?}");
    let fast = report(&bus(115_200, "a = 1"));
    assert!(fast.links[0].load < one.links[0].load / 2.0, "{fast}");
}

#[test]
fn a_longer_round_trip_is_more_load() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plant.toml");
    std::fs::write(&path, GOOD).unwrap();
    let load = |round_trip| Report::of(&path, &Environment::default(), Duration::from_millis(round_trip)).links[0].load;
    // One request with a proof or without, each second.
    assert!(load(105) - load(5) > 0.099, "{}", load(105));
}

#[test]
fn tables_have_at_most_80_columns() {
    let long = "x".repeat(64);
    let text = format!(
        "[class]\n{long} = {{ every = '500ms' }}\n[plc.{long}]\n\
         link = 'serial:/dev/serial/by-id/usb-FTDI_USB-RS485_Cable_FT0ABCDE-if00-port0?baud=115200&frame=8N1'\n\
         station = 254\ntag.{long} = {{ at = 'R0-R3000', class = '{long}' }}\n\
         [mqtt]\nurl = 'mqtts://{long}.plant'\nprefix = '{long}'\n"
    );
    let report = report(&text);
    let shown = report.to_string();
    let tables = shown.split("\n\n").take(3);
    for line in tables.flat_map(str::lines) {
        assert!(line.chars().count() <= 80, "{} columns: {line}", line.chars().count());
    }
    assert_eq!(report.outputs.len(), 1, "{shown}");
}

#[test]
fn links_of_a_fleet_have_hosts_and_topics_its_id() {
    let long = "x".repeat(64);
    let text = format!(
        "{GOOD}[bridge]\nid = 'hall-1'\nbuffer.dir = 'b'\n[nats]\nurl = 'nats://h'\n[fleet]\nid = 'plant-a'\n\
         [template.t]\nx = 'R0'\n[bus.line1]\nlink = 'serial:/dev/ttyX'\nstations = {{ a = 1, b = 2 }}\nuse = ['t']\n\
         host = 'hall-1'\n\
         [bus.{long}]\nlink = 'serial:/dev/ttyX?baud=115200&frame=8N1'\nstations = {{ c = 1 }}\nuse = ['t']\n\
         host = '{long}'\n"
    );
    let report = report(&text);
    assert_eq!(report.count(Severity::Fault), 0, "{report}");
    let of_link = |link: &LinkLoad| (link.id.clone().unwrap(), link.hosts.join(","), link.plcs);
    let links: Vec<_> = report.links.iter().map(of_link).collect();
    let expected = [("mixer", "", 1), ("line1", "hall-1", 2), (&*long, &*long, 1)];
    assert_eq!(links, expected.map(|(id, hosts, plcs)| (id.to_owned(), hosts.to_owned(), plcs)));
    let shown = report.to_string();
    for line in shown.split("\n\n").take(3).flat_map(str::lines) {
        assert!(line.chars().count() <= 80, "{} columns: {line}", line.chars().count());
    }
    assert!(shown.contains("mixer             tcp://10.0.0.3:500    all   "), "{shown}");
    assert!(shown.contains("fatek.plant-a.PLC.data"), "{shown}");
    // The ports of other hosts are not here.
    let of_port = report.findings.iter().filter(|finding| finding.key == "/dev/ttyX").count();
    let elsewhere = self::report(&text.replace("id = 'hall-1'", "id = 'hall-9'"));
    assert_eq!((of_port, elsewhere.findings), (1, Vec::new()));
    assert_eq!(report.to_json()["links"][1]["hosts"], json!(["hall-1"]));
    assert_eq!(report.to_json()["links"][0]["hosts"], json!([]));
    // Without a fleet there are no ids.
    let alone = self::report(&format!("{GOOD}[plc.b]\nlink = 'tcp://10.0.0.3'\nstation = 2\ntag.x = 'R0'\n"));
    let [link] = &alone.links[..] else { panic!("{alone}") };
    assert_eq!((&link.id, link.plcs), (&None, 2));
}

#[test]
fn faults_of_the_file_are_findings() {
    let report = report("[mqtt]\nurl = 'x'\n");
    assert_eq!((report.count(Severity::Fault), report.count(Severity::Warning)), (1, 0));
    assert!(report.to_string().contains("fault: line 2, mqtt.url: a URL is as"), "{report}");
    let missing = Report::of(Path::new("/nowhere/plant.toml"), &Environment::default(), ROUND_TRIP);
    assert_eq!(missing.count(Severity::Fault), 1);
    assert!(missing.to_string().starts_with("fault: the file cannot be read: "), "{missing}");
    let fleet = findings(&format!("{GOOD}[fleet]\nid = 'a'\n"));
    assert_eq!(fleet, ["fault: line 6, fleet: it needs the section nats: its server holds the leases"]);
    let many = findings(&GOOD.replace("'R5'", "{ at = 'R0-R100', class = 'x' }"));
    assert_eq!(many, ["fault: line 4, plc.mixer.tag.level.class: there is no class `x`"]);
}

#[test]
fn missing_files_are_findings() {
    let folder = tempfile::tempdir().unwrap();
    let text = format!(
        "{GOOD}[mqtt]\nurl = 'mqtts://broker'\nuser = 'me'\npassword_file = 'mqtt.pass'\nca_file = 'ca.pem'\n\
         [nats]\nurl = 'nats://10.0.0.9'\ncreds_file = 'nats.creds'\n\
         [bridge]\nbuffer.dir = 'file/buffer'\ntoken_file = 'token'\n\
         [bus.line]\nlink = 'serial:/dev/ttyNone'\nstations = {{ a = 1 }}\n"
    );
    std::fs::write(folder.path().join("file"), "").unwrap();
    let texts = |report: &Report| report.findings.iter().map(ToString::to_string).collect::<Vec<_>>();
    let found = texts(&report_in(folder.path(), &text, &Environment::default()));
    for expected in [
        "warning: bridge.token_file: it has no effect yet",
        "fault: mqtt.password_file: ",
        "fault: mqtt: ",
        "fault: nats.creds_file: ",
        "warning: bridge.buffer.dir: ",
        "warning: /dev/ttyNone: no device file",
        "warning: line 19, plc.a: it has no tags",
    ] {
        assert!(found.iter().any(|text| text.starts_with(expected)), "{expected}: {found:#?}");
    }
    assert!(found.iter().any(|text| text.contains("file is not a folder")), "{found:#?}");
    // The credentials of systemd are found, and the secret is not shown.
    let credentials = tempfile::tempdir().unwrap();
    std::fs::write(credentials.path().join("mqtt.pass"), "hunter2").unwrap();
    let environment = Environment { credentials: Some(credentials.path().to_owned()), ..Environment::default() };
    let found = texts(&report_in(folder.path(), &text, &environment));
    assert!(!found.iter().any(|text| text.starts_with("fault: mqtt.password_file")), "{found:#?}");
    assert!(!found.concat().contains("hunter2"));
}

#[test]
fn a_secret_that_all_users_can_read_is_a_warning() {
    use std::os::unix::fs::PermissionsExt as _;

    let folder = tempfile::tempdir().unwrap();
    let text = format!("{GOOD}[bridge]\ntoken_file = 'token'\n");
    let token = folder.path().join("token");
    std::fs::write(&token, "hunter2").unwrap();
    let found = |mode| {
        std::fs::set_permissions(&token, std::fs::Permissions::from_mode(mode)).unwrap();
        let report = report_in(folder.path(), &text, &Environment::default());
        report.findings.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    // Without the first warning, a user took the page for protected.
    let no_effect = format!("warning: bridge.token_file: {TOKEN_RULE}");
    assert_eq!(found(0o600), [no_effect.as_str()]);
    let warned = found(0o644);
    assert!(warned.len() == 2 && warned[0] == no_effect, "{warned:?}");
    assert!(warned[1].starts_with("warning: bridge.token_file: ") && warned[1].contains("chmod 600"), "{warned:?}");
}

#[test]
fn settings_that_are_probably_not_meant_are_warnings() {
    for (text, expected) in [
        ("[class]\nslow = { every = '10s' }\n", "class.slow: no tag has this class"),
        (
            "[class]\nslow = { every = '10s', stale_after = '15s' }\n",
            "class.slow.stale_after: it is less than two periods, and raised to them",
        ),
        ("[template.tank]\nlevel = 'R5'\n", "template.tank: no PLC and no bus uses it"),
        ("[plc.b]\nlink = 'tcp://h'\nstation = 1\n", "line 6, plc.b: it has no tags: nothing is read"),
        (
            "[plc.b]\nlink = 'tcp://10.0.0.3:500?framing=binary'\nstation = 2\ntag.x = 'R0'\n",
            "line 6, plc.b.link: mixer has this address with other options: there are two connections",
        ),
        ("[bridge]\nhttp = '0.0.0.0:80'\n", "bridge.http: the page on 0.0.0.0:80 is open to everyone on the network"),
        ("[bridge]\nbuffer.memory = '64KiB'\n", "bridge.buffer.memory: 64KiB is little"),
        ("[bridge]\nbuffer.sync = true\n", "bridge.buffer.sync: it has no effect without dir"),
        ("[mqtt]\nurl = 'mqtt://h'\nuser = 'me'\n", "mqtt.url: the password is sent without encryption"),
        ("[mqtt]\nurl = 'mqtt://h'\n", "bridge.buffer.dir: without it the buffer is in memory alone"),
        (
            "[plc.b]\nlink = 'tcp://h'\nstation = 1\ntag.x = 'R0'\n[mqtt]\nurl = 'mqtt://h'\n\
             require_subscribers = true\n",
            "mqtt.require_subscribers: batches of a PLC without a subscriber are dropped after 10 minutes",
        ),
        ("[mqtt]\nurl = 'mqtt://h'\nwrite = true\n", "mqtt.write: no tag has a key `write`"),
        (
            "[nats]\nurl = 'nats://h'\n[plc.b]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'M1', write = {} }\n",
            "mqtt.write, nats.write: tags have a key `write`, and no output takes commands",
        ),
        (
            "[plc.b]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'R4000', write = { min = 0, max = 1 } }\n",
            "line 9, plc.b.tag.x: R4000 is special (R3840-R4167)",
        ),
        (
            "[plc.b]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'M1990', write = {} }\n",
            "line 9, plc.b.tag.x: M1990 is special (M1912-M2001)",
        ),
        (
            "[plc.b]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'R60.3', write = {} }\n",
            "line 9, plc.b.tag.x: a write of one bit rewrites the whole register",
        ),
        (
            "[plc.b]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'R0', write = { min = 0 } }\n",
            "line 9, plc.b.tag.x: write has no min or no max",
        ),
    ] {
        let found = findings(&format!("{GOOD}{text}"));
        let expected = format!("warning: {expected}");
        assert!(found.iter().any(|found| found.starts_with(&expected)), "{expected}: {found:#?}");
    }
    // Of a single PLC nothing is dropped.
    let single = findings(&format!("{GOOD}[mqtt]\nurl = 'mqtt://h'\nrequire_subscribers = true\n"));
    assert!(!single.iter().any(|found| found.contains("require_subscribers")), "{single:#?}");
    let without_output = findings(&GOOD.replace("[stdout]\n", ""));
    assert_eq!(
        without_output,
        ["warning: mqtt, nats, stdout: there is no output: values are on the page and in /metrics alone"]
    );
}

#[test]
fn the_document_has_all_parts() {
    let report = report(&format!("{GOOD}[mqtt]\nurl = 'mqtt://broker'\n"));
    let document = report.to_json();
    assert_eq!(document["plans"][0]["plc"], "mixer");
    assert_eq!(document["links"][0]["link"], "tcp://10.0.0.3:500");
    assert!(document["links"][0]["load_percent"].as_f64().unwrap() > 0.0);
    assert_eq!(document["outputs"][1]["server"], "mqtt://broker:1883");
    assert_eq!(document["findings"][0]["severity"], "warning");
    assert_eq!(document["findings"][0]["key"], "bridge.buffer.dir");
}
