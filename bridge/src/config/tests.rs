use std::collections::BTreeMap;
use std::time::Duration;

use super::*;

const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples");

/// A PLC, without which no configuration is complete.
const PLC: &str = "[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\ntag.level = 'R5'\n";

/// The server of a fleet.
const NATS: &str = "[nats]\nurl = 'nats://h'\n";

/// Writes a configuration and reads it.
fn read_with(text: &str, environment: &Environment) -> (tempfile::TempDir, Result<Config, ConfigError>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plant.toml");
    std::fs::write(&path, text).unwrap();
    let config = Config::read(&path, environment);
    (folder, config)
}

fn read(text: &str) -> Config {
    let (_folder, config) = read_with(text, &Environment::default());
    config.unwrap_or_else(|error| panic!("{error}"))
}

/// The faults of a text, without the name of the file.
fn faults(text: &str) -> Vec<String> {
    let (_folder, config) = read_with(text, &Environment::default());
    match config.unwrap_err() {
        ConfigError::Faults { faults, .. } => faults.iter().map(ToString::to_string).collect(),
        ConfigError::Io { error, .. } => panic!("{error}"),
    }
}

#[test]
fn the_example_has_each_key_of_the_documentation() {
    let config = Config::load(&Path::new(EXAMPLES).join("plant.toml")).unwrap();
    assert_eq!(config.bridge.id.as_str(), "hall-2");
    assert_eq!(config.bridge.http.to_string(), "127.0.0.1:9187");
    let BufferSection { max, max_age, memory, sync, .. } = config.bridge.buffer;
    assert_eq!(config.bridge.connects_per_second, 1000);
    assert_eq!((max.0, max_age.0, memory.0, sync), (1 << 30, Duration::from_secs(7 * 86_400), 64 << 20, false));
    let mqtt = config.mqtt.as_ref().unwrap();
    assert_eq!((mqtt.url.to_string().as_str(), mqtt.user.as_deref()), ("mqtts://broker.plant:8883", Some("hall2")));
    assert_eq!((mqtt.prefix.as_str(), mqtt.write), ("fatek", true));
    assert_eq!(mqtt.home_assistant.as_ref().map(Name::as_str), Some("homeassistant"));
    let nats = config.nats.as_ref().unwrap();
    assert_eq!((nats.url.to_string().as_str(), nats.stream.as_str()), ("tls://nats.plant:4222", "FATEK"));
    assert_eq!((nats.prefix.as_str(), nats.write), ("fatek", false));
    assert_eq!(config.outputs().into_iter().map(OutputKind::name).collect::<Vec<_>>(), ["stdout", "mqtt", "nats"]);
    let tags: BTreeMap<_, _> = config.plant.plcs().map(|plc| (plc.name(), plc.tags().count())).collect();
    let expected = [("mixer", 6), ("boiler", 6), ("pump1", 3), ("pump2", 3), ("pump3", 3), ("pump4", 3)];
    assert_eq!(tags, BTreeMap::from(expected));
    // Paths are beside the file, and absolute.
    for path in [&mqtt.password_file, &mqtt.ca_file, &nats.creds_file, &config.bridge.token_file] {
        assert!(path.as_ref().is_some_and(|path| path.starts_with(EXAMPLES)), "{path:?}");
    }
}

#[test]
fn the_minimal_example_has_the_defaults() {
    let config = Config::load(&Path::new(EXAMPLES).join("minimal.toml")).unwrap();
    assert_eq!((config.bridge, config.mqtt, config.nats), (BridgeSection::default(), None, None));
    assert_eq!(config.stdout, Some(StdoutSection {}));
}

#[test]
fn a_fleet_has_defaults_and_bounds() {
    let text = format!("[fleet]\nid = 'plant-a'\nbucket = 'fatek_leases'\nlease = '3s'\nweight = 1\n{NATS}{PLC}");
    let config = read(&text);
    let fleet = config.fleet.clone().unwrap();
    assert_eq!((fleet.id.as_str(), fleet.lease.0, fleet.weight), ("plant-a", Duration::from_secs(3), 1));
    assert_eq!((config.topic_id().as_str(), read(PLC).topic_id()), ("plant-a", &BridgeSection::default().id));
    assert_eq!(read(&format!("[fleet]\nid = 'plant-a'\n{NATS}{PLC}")).fleet.unwrap(), fleet);
    for lease in ["500ms", "1m"] {
        read(&text.replace("3s", lease));
    }
    assert_eq!(
        faults(&format!("{PLC}[fleet]\nlease = '499ms'\nid = 'a'\nweight = 0\n")),
        [
            "line 5, fleet: it needs the section nats: its server holds the leases",
            "line 6, fleet.lease: a lease is 500ms to 1m",
            "line 8, fleet.weight: a weight is 1 to 1000"
        ]
    );
    assert_eq!(faults(&text.replace("nats://h", "h")).len(), 1, "a section with a fault is there");
}

#[test]
fn the_rate_of_connections_has_bounds() {
    let with = |rate: &str| format!("[bridge]\nconnects_per_second = {rate}\n{PLC}");
    for rate in [1, 100_000] {
        assert_eq!(read(&with(&rate.to_string())).bridge.connects_per_second, rate);
    }
    for rate in ["0", "100001"] {
        assert_eq!(faults(&with(rate)), ["line 2, bridge.connects_per_second: it is 1 to 100000"]);
    }
    assert_eq!(faults(&with("-1")).len(), 1);
}

#[test]
fn each_plc_of_a_fleet_has_one_owner() {
    const PORT: &str = "[bus.line1]\nlink = 'serial:/dev/ttyS0'\nstations = { a = 1, b = 2 }\n";
    let fleet = format!("[fleet]\nid = 'a'\n{NATS}");
    let of = |text: &str| faults(&format!("{fleet}{PLC}{text}"));
    let one_host = "bus.line1.host: a serial port has one host: in a fleet, `host` names the member";
    assert_eq!(of(PORT), [format!("line 9, {one_host}")]);
    assert_eq!(
        of(&format!("{PORT}only = ['x', 'y']\n")),
        [format!("line 12, {}", one_host.replacen("host", "only", 1))]
    );
    assert_eq!(of(&format!("{PORT}host = 'a b'\n")), [format!("line 12, bus.line1.host: {}", values::NAME_RULE)]);
    for text in [
        format!("{PORT}host = 'x'\n"),
        format!("{PORT}only = ['x']\n"),
        // A port of the same name on another host.
        format!("{PORT}host = 'x'\n{}host = 'y'\n", PORT.replace("line1", "line2").replace("a = 1, b", "c")),
        "[plc.b]\nlink = 'tcp://10.0.0.4'\nstation = 1\nonly = ['x', 'y']\n".to_owned(),
        "[plc.b]\nlink = 'tcp://10.0.0.3:500'\nstation = 2\n".to_owned(),
    ] {
        read(&format!("{fleet}{PLC}{text}"));
    }
    for (text, fault) in [
        (
            "[plc.b]\nlink = 'tcp://10.0.0.3'\nstation = 2\nonly = ['x']\n",
            "line 12, plc.b.only: mixer has this link with other hosts: a link has one owner",
        ),
        (
            "[plc.b]\nlink = 'tcp://10.0.0.3?copies=2'\nstation = 2\n",
            "line 10, plc.b.link: mixer has this address with other options: in a fleet, they have one link",
        ),
        (
            "[bus.mixer]\nlink = 'tcp://10.0.0.4'\nstations = { b = 1 }\n",
            "line 9, bus.mixer: a PLC of another link has this name: in a fleet, a link has the name of its bus or \
             its PLC",
        ),
    ] {
        assert_eq!(of(text), [fault]);
        read(&format!("{PLC}{text}"));
    }
    read(&format!("{PLC}{PORT}only = ['a b', 'y']\n"));
    assert_eq!(
        faults(&format!("{PLC}{PORT}host = 'x'\n[plc.c]\nlink = 'serial:/dev/ttyS0'\nstation = 3\nhost = 'y'\n")),
        ["line 8, bus.line1.host: c has this port on another host: that needs the section fleet"]
    );
}

#[test]
fn an_option_takes_the_place_of_the_id_also_in_a_reload() {
    let id = Name::parse("hall-3").unwrap();
    let environment = Environment::with_id(Some(&id));
    let (_folder, config) = read_with(&format!("[bridge]\nid = 'x'\n{PLC}"), &environment);
    let config = config.unwrap();
    assert_eq!((&config.bridge.id, &config.reload().unwrap().bridge.id), (&id, &id));
}

#[test]
fn all_faults_are_reported_with_file_line_key_and_rule() {
    let text = "[bridge]\nid = 'a/b'\nhttp = 'localhost'\nbuffer = { mem = '1MiB', max_age = '7 days ago' }\n\
                [mqtt]\nurl = 'mqtt://me:secret@broker'\npassword = 'secret'\n\
                [nats]\nstreem = 'X'\n\
                [outputs]\n\
                [plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 300\ntags = 'none.csv'\n\
                tag.level = { at = 'R5', clas = 'x' }\n";
    let all = faults(text);
    let expected = [
        "line 2, bridge.id: a name has 1 to 64 of the characters",
        "line 3, bridge.http: it is an address with a port, such as 127.0.0.1:9187",
        "line 4, bridge.buffer.mem: the key is unknown (known: dir max max_age memory sync)",
        "line 4, bridge.buffer.max_age: a time is a number with a unit",
        "line 6, mqtt.url: the URL has no user and no password: they are in user and password_file",
        "line 7, mqtt.password: the key is unknown",
        "line 9, nats.streem: the key is unknown; did you mean `stream`?",
        "line 8, nats.url: it is missing",
        "line 10, outputs: the section is unknown (known: bridge mqtt nats stdout fleet class template plc bus sim)",
        "line 13, plc.mixer.station: 300 is not a station",
        "line 14, plc.mixer.tags: ",
        "line 15, plc.mixer.tag.level.clas: the key is unknown; did you mean `class`?",
    ];
    for expected in expected {
        assert!(all.iter().any(|fault| fault.starts_with(expected)), "{expected}: {all:#?}");
    }
    assert_eq!(all.len(), expected.len(), "{all:#?}");
    assert!(!all.concat().contains("secret"), "{all:#?}");
    let lines: Vec<&str> = all.iter().map(|fault| fault.split([',', ':']).next().unwrap()).collect();
    let number = |line: &&str| line["line ".len()..].parse::<usize>().unwrap();
    assert!(lines.is_sorted_by_key(number), "{lines:?}");
}

#[test]
fn keys_that_do_not_fit_together_are_faults() {
    let of = |text: &str| faults(&format!("{PLC}{text}")).join("; ");
    for (text, fault) in [
        ("[mqtt]\nurl = 'mqtts://a'\ncert_file = 'c'\n", "line 7, mqtt.cert_file: it needs key_file"),
        ("[nats]\nurl = 'tls://a'\nkey_file = 'k'\n", "line 7, nats.key_file: it needs cert_file"),
        (
            "[mqtt]\nca_file = 'c'\nurl = 'mqtt://a'\n",
            "line 6, mqtt.ca_file: it is for TLS, and the scheme of the URL is without",
        ),
        ("[mqtt]\nurl = 'mqtt://a'\npassword_file = 'p'\n", "line 7, mqtt.password_file: it needs user"),
        ("[nats]\nurl = 'nats://a'\npassword_file = 'p'\n", "line 7, nats.password_file: it needs user"),
        (
            "[nats]\nurl = 'nats://a'\nuser = 'me'\ncreds_file = 'c'\n",
            "line 7, nats.user: it is in place of creds_file: only one of them is allowed",
        ),
        ("[bridge]\nbuffer.memory = '0B'\n", "line 6, bridge.buffer.memory: it is more than 0"),
        (
            "[mqtt]\nurl = 'mqtt://a'\nwrite = 'yes'\n",
            "line 7, mqtt.write: true or false is expected, and this is a text",
        ),
        ("[bridge]\nid = 5\n", "line 6, bridge.id: a text is expected, and this is a number"),
        ("[nats]\nurl = 'mqtt://a'\n", "line 6, nats.url: the scheme is nats, or tls with TLS, and not mqtt"),
        ("[stdout]\nx = true\n", "line 6, stdout.x: the key is unknown: the section has none"),
    ] {
        assert_eq!(of(text), fault);
    }
    let classes = "[class]\nfast = { every = '1s' }\n[template.tank]\n";
    assert_eq!(
        of(&format!(
            "use = ['tonk']\ntag.x = {{ at = 'R0', class = 'fats' }}\n\
             tag.y = {{ at = 'R0', class = 'z' }}\n{classes}"
        )),
        "line 5, plc.mixer.use: there is no template `tonk`; did you mean `tank`?; \
         line 6, plc.mixer.tag.x.class: there is no class `fats`; did you mean `fast`?; \
         line 7, plc.mixer.tag.y.class: there is no class `z`"
    );
    let [fault] = &faults("[stdout]\n")[..] else { panic!() };
    assert!(fault.starts_with("line 1, plc: there is no PLC"), "{fault}");
    let [fault] = &faults("[mqtt\n")[..] else { panic!() };
    assert!(fault.starts_with("line 1: "), "{fault}");
}

#[test]
fn variables_take_the_place_of_id_and_address() {
    let environment = |id: &str, http: &str| Environment {
        id: Some(id.to_owned()),
        http: Some(http.to_owned()),
        ..Environment::default()
    };
    let (_folder, config) = read_with(PLC, &environment("hall-9", "0.0.0.0:80"));
    let bridge = config.unwrap().bridge;
    assert_eq!((bridge.id.as_str(), bridge.http.to_string().as_str()), ("hall-9", "0.0.0.0:80"));
    let (_folder, config) = read_with(PLC, &environment("a/b", "80"));
    let error = config.unwrap_err().to_string();
    assert!(
        error.contains("$FATEK_BRIDGE_ID: a name has") && error.contains("$FATEK_BRIDGE_HTTP: it is an"),
        "{error}"
    );
}

/// Characters with a meaning in TOML, and others.
const INSERTED: &str = "[\\[\\]{}=.'\"a-z0-9\n\u{80}-\u{2ff} #]{0,12}";

proptest::proptest! {
    #[test]
    fn no_text_causes_a_panic(at in 0_usize..4000, length in 0_usize..60, insert in INSERTED) {
        let text = include_str!("../../examples/plant.toml").replace("tags = \"boiler.csv\"", "tag.x = 'R5'");
        let boundary = |at: usize| (0..=at.min(text.len())).rev().find(|&at| text.is_char_boundary(at)).unwrap_or(0);
        let (begin, end) = (boundary(at), boundary(at + length));
        let mutated = format!("{}{insert}{}", &text[..begin], &text[end..]);
        let parsed = Config::from_text(Path::new("plant.toml"), &mutated, &Environment::default());
        if let Err(error) = parsed {
            let lines = mutated.lines().count() + 1;
            let ConfigError::Faults { faults, .. } = error else { panic!("{error}") };
            proptest::prop_assert!(!faults.is_empty());
            for fault in faults {
                proptest::prop_assert!(fault.line.is_some_and(|line| (1..=lines).contains(&line)), "{}", fault);
                proptest::prop_assert!(!fault.to_string().chars().any(char::is_control), "{:?}", fault);
            }
        }
    }
}
