use std::time::Duration;

use super::*;

const PLANT: &str = r#"
[bridge]
id = "hall-2"
anything = [1, 2]

[class]
fast = { every = "500ms", stale_after = "3s" }
slow = { every = "10s" }

[template.tank]
level = { at = "R5:i16*0.1-40", class = "fast", unit = "%", deadband = 0.2, heartbeat = "60s" }
alarm = { at = "M7", class = "fast", on_change = true }
name = "R10-R19:text"

[plc.mixer]
link = "tcp://192.168.2.3:500"
station = 1
use = ["tank"]
tag.total = { at = "DR100:u32", class = "slow", group = "sums", comment = "since the start" }
tag.setpoint = { at = "R200:f32", write = { min = 0, max = 80.0 } }
tag.start = { at = "M100", write = { pulse = "500ms" } }
tag.mode = { at = "R300", write = {} }

[bus.line1]
host = "hall-2"
link = "serial:/dev/ttyUSB0?baud=19200&frame=7E1"
stations = { pump1 = 1, pump2 = 2 }
use = ["tank"]
"#;

#[test]
fn plcs_of_buses_follow_the_others() {
    let text = "[bus.line]\nlink = 'serial:a'\nstations = { zed = 1, ann = 2 }\n\
                [plc.mixer]\nlink = 'tcp://h'\nstation = 1\n[plc.boiler]\nlink = 'tcp://i'\nstation = 1\n";
    let plant = Plant::from_toml(text).unwrap();
    let names: Vec<&str> = plant.plcs().map(PlantPlc::name).collect();
    assert_eq!(names, ["mixer", "boiler", "zed", "ann"]);
}

#[test]
fn polled_tags_have_the_rule_for_their_samples() {
    let plant = Plant::from_toml(PLANT).unwrap();
    let mixer = plant.plc("mixer").unwrap();
    let polled = |name: &str| mixer.tag(name).unwrap().poll_tag();
    let tag = |name: &str| PollTag::new(name, mixer.tag(name).unwrap().tag());
    assert_eq!(polled("level"), tag("level").deadband(0.2).heartbeat(Duration::from_secs(60)));
    assert_eq!(polled("alarm"), tag("alarm").on_change(true));
    assert_eq!(polled("total"), tag("total"));
}

#[test]
fn rules_that_a_poller_would_refuse_are_faults() {
    let text = "[class]\nfast = { every = '999us' }\n[plc.mixer]\nlink = 'tcp://h'\nstation = 1\n\
                tag.alarm = { at = 'M7', deadband = 0.5 }\ntag.level = { at = 'R5', deadband = 0.5 }\n\
                tag.start = { at = 'M8', deadband = 0 }\n";
    let errors = Plant::from_toml(text).unwrap_err().to_string();
    let expected = "line 2, class.fast.every: a period is 1ms or more\n\
                    line 6, plc.mixer.tag.alarm.deadband: a deadband is of numbers, and M7 has none";
    assert_eq!(errors, expected);
}

#[test]
fn a_plant_has_the_plcs_classes_and_tags_of_its_file() {
    let plant = Plant::from_toml(PLANT).unwrap();
    let names: Vec<&str> = plant.plcs().map(PlantPlc::name).collect();
    assert_eq!(names, ["mixer", "pump1", "pump2"]);
    let fast = plant.class("fast").unwrap();
    assert_eq!((fast.every(), fast.scan_class().period()), (Duration::from_millis(500), Duration::from_millis(500)));
    assert_eq!(plant.classes().map(PlantClass::name).collect::<Vec<_>>(), ["fast", "slow"]);

    let mixer = plant.plc("mixer").unwrap();
    assert_eq!((mixer.endpoint().to_string().as_str(), mixer.station()), ("tcp://192.168.2.3:500", 1));
    assert_eq!((mixer.bus(), mixer.hosts().count(), mixer.line()), (None, 0, 15));
    let tags: Vec<&str> = mixer.tags().map(PlantTag::name).collect();
    assert_eq!(tags, ["level", "alarm", "name", "total", "setpoint", "start", "mode"]);
    let level = mixer.tag("level").unwrap();
    assert_eq!(
        (level.tag().to_string().as_str(), level.class(), level.unit()),
        ("R5:i16*0.1-40", Some("fast"), Some("%"))
    );
    assert_eq!((level.deadband(), level.heartbeat(), level.line()), (Some(0.2), Some(Duration::from_secs(60)), 11));
    assert!(mixer.tag("alarm").unwrap().is_on_change() && !level.is_on_change() && level.write().is_none());
    let total = mixer.tag("total").unwrap();
    assert_eq!((total.group(), total.comment()), (Some("sums"), Some("since the start")));
    let rule = |name: &str| mixer.tag(name).unwrap().write();
    assert_eq!(rule("setpoint"), Some(WriteRule { min: Some(0.0), max: Some(80.0), pulse: None }));
    assert_eq!(rule("start"), Some(WriteRule { pulse: Some(Duration::from_millis(500)), ..WriteRule::default() }));
    assert_eq!(rule("mode"), Some(WriteRule::default()));

    let pump = plant.plc("pump2").unwrap();
    assert_eq!((pump.bus(), pump.station(), pump.hosts().collect::<Vec<_>>()), (Some("line1"), 2, vec!["hall-2"]));
    assert_eq!(pump.endpoint().to_string(), "serial:/dev/ttyUSB0?baud=19200");
    assert_eq!(pump.tags().count(), 3);
}

#[test]
fn all_faults_are_reported_with_line_and_key() {
    let text = r#"
[class]
fast = { every = "0s", often = 1 }
"a b" = { every = "1s" }
[template.tank]
level = { at = "R5:i17", class = "fast" }
R7 = "R8"
[plc.mixer]
link = "tpc://host"
station = 255
use = ["tank", "tonk"]
tag.level = { unit = "m", class = "never" }
tag.bad = { at = "R0", write = { min = 5, max = 4 }, deadband = -1, on_change = "yes" }
tag.start = { at = "R9", write = { pulse = "1s" } }
tags = "t.csv"
speed = 1
[plc.a]
link = "tcp://h"
station = 1
tag.x = "R0"
tag.y = 7
[plc.b]
link = "tcp://h"
station = 1
[bus.line]
link = "udp://h2"
stations = { a = 3, c = "4" }
"#;
    let errors = Plant::from_toml(text).unwrap_err();
    let all: Vec<String> = errors.iter().map(ToString::to_string).collect();
    let expected = [
        "line 3, class.fast.every: `0s` is not a time: more than 0 and at most 24h, such as 500ms, 1.5s or 10m",
        "line 3, class.fast.often: the key is unknown (known: every stale_after)",
        "line 4, class.a b: `a b` is not a name: 1 to 64 of the characters A-Z a-z 0-9 _ - are",
        "line 6, template.tank.level.at: `R5:i17` is not a tag: ",
        "line 6, template.tank.level.class: there is no class `fast`",
        "line 7, template.tank.R7: `R7` is not a name: it is a tag itself",
        "line 9, plc.mixer.link: `tpc://host` is not an endpoint: ",
        "line 10, plc.mixer.station: 255 is not a station: 1 to 254 are",
        "line 11, plc.mixer.use: there is no template `tonk`",
        "line 12, plc.mixer.tag.level.at: it is missing",
        "line 12, plc.mixer.tag.level.class: there is no class `never`",
        "line 13, plc.mixer.tag.bad.deadband: -1 is not possible: the number is finite, and at least 0",
        "line 13, plc.mixer.tag.bad.on_change: true or false is expected, and this is a text",
        "line 13, plc.mixer.tag.bad.write: min is larger than max",
        "line 14, plc.mixer.tag.start.write: min and max are of numbers, and pulse is of one discrete",
        "line 15, plc.mixer.tags: tables of tags are beside a file: load it, instead of its text",
        "line 16, plc.mixer.speed: the key is unknown (known: link station use tag tags host only)",
        "line 21, plc.a.tag.y: a text or a table is expected, and this is a number",
        "line 22, plc.b: `a` has this link and station already",
        "line 27, bus.line: the name `a` stands in line 17 already",
        "line 27, bus.line.stations.c: a decimal integer is expected, and this is a text",
    ];
    for expected in expected {
        assert!(all.iter().any(|error| error.starts_with(expected)), "{expected}\n{all:#?}");
    }
    assert_eq!(all.len(), expected.len(), "{all:#?}");
    assert!(errors.to_string().ends_with("\nand 1 more"), "{errors}");
    let lines = "[plc.a]\nlink = 'serial:/dev/ttyS1'\nstation = 1\n\
                 [plc.b]\nlink = 'serial:/dev/ttyS1?baud=19200'\nstation = 2\ntag.x = { at = 'R0', group = 'a b' }\n";
    let error = Plant::from_toml(lines).unwrap_err().to_string();
    let expected =
        "line 4, plc.b: `a` has this line with other settings\nline 7, plc.b.tag.x.group: `a b` is not a name: ";
    assert!(error.starts_with(expected), "{error}");
    let syntax = Plant::from_toml("[plc\n").unwrap_err();
    assert!(syntax.to_string().starts_with("line 1: "), "{syntax}");
}

/// Without the rule, two halls with the same adapter had no configuration in common: "`a` has this link and station
/// already".
#[test]
fn a_serial_port_belongs_to_its_host() {
    let bus = |name: &str, plc: &str, link: &str, hosts: &str| {
        format!("[bus.{name}]\nlink = '{link}'\nstations = {{ {plc} = 1 }}\n{hosts}\n")
    };
    let first = bus("line1", "a", "serial:/dev/ttyS1", "host = 'hall-1'");
    let with = |link, hosts| Plant::from_toml(&format!("{first}{}", bus("line2", "b", link, hosts)));
    for link in ["serial:/dev/ttyS1", "serial:/dev/ttyS1?baud=19200"] {
        assert_eq!(with(link, "host = 'hall-2'").unwrap().plcs().count(), 2);
        for hosts in ["", "host = 'hall-1'", "only = ['hall-2', 'hall-1']"] {
            let error = with(link, hosts).unwrap_err().to_string();
            assert!(error.contains(", bus.line2: `a` has this li"), "{hosts}: {error}");
        }
    }
    let network = bus("line1", "a", "tcp://h", "only = ['hall-1']") + &bus("line2", "b", "tcp://h", "only = ['x']");
    assert!(Plant::from_toml(&network).is_err());
}

#[test]
fn a_file_may_name_tables_of_tags_beside_it() {
    let folder = std::env::temp_dir().join(format!("fatek-plant-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).unwrap();
    write("boiler.csv", "name,at,class,unit\nlevel,R100:f32,fast,m\nalarm,M7,,\n");
    let plant = "[class]\nfast = { every = '1s' }\n[plc.boiler]\nlink = 'tcp://h'\nstation = 1\ntags = 'boiler.csv'\n";
    write("plant.toml", plant);
    let loaded = Plant::load(folder.join("plant.toml")).unwrap();
    let boiler = loaded.plc("boiler").unwrap();
    assert_eq!(boiler.tags().map(PlantTag::name).collect::<Vec<_>>(), ["level", "alarm"]);
    assert_eq!((boiler.tag("level").unwrap().class(), boiler.tag("alarm").unwrap().class()), (Some("fast"), None));

    write("boiler.csv", "name,at,class\nlevel,R100:f33,fast\n");
    let error = Plant::load(folder.join("plant.toml")).unwrap_err().to_string();
    assert!(
        error.contains("plant.toml: line 6, plc.boiler.tags: ") && error.contains("boiler.csv: line 2, at: "),
        "{error}"
    );
    write("boiler.csv", "name,at,class\nlevel,R100:f32,slow\n");
    let error = Plant::load(folder.join("plant.toml")).unwrap_err().to_string();
    assert!(error.ends_with("line 6, plc.boiler.tags: there is no class `slow`"), "{error}");
    std::fs::write(folder.join("plant.toml"), b"\xFF").unwrap();
    assert!(Plant::load(folder.join("plant.toml")).unwrap_err().to_string().ends_with("the text is not UTF-8"));
    std::fs::remove_dir_all(&folder).unwrap();
    assert!(matches!(Plant::load(folder.join("plant.toml")), Err(PlantFileError::File(_))));
}

proptest::proptest! {
    #[test]
    fn no_text_panics(at in 0..PLANT.len(), len in 0..40_usize, other in "\\PC{0,12}") {
        let mut text = PLANT.to_owned();
        if text.is_char_boundary(at) && text.is_char_boundary((at + len).min(text.len())) {
            text.replace_range(at..(at + len).min(PLANT.len()), &other);
            let _ = Plant::from_toml(&text);
        }
    }
}
