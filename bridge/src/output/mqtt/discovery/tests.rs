use std::collections::HashSet;

use fatek::plant::Plant;

use super::*;

const PLANT: &str = r#"
[plc.mixer_1]
link = "tcp://192.0.2.3:500"
station = 1
tag.level = { at = "R5:i16*0.1-40", unit = "%" }
tag.alarm = { at = "M7" }
tag.name = { at = "R10-R19:text" }
tag.profile = { at = "R30-R33" }
tag.mask = { at = "R40:hex" }
tag.setpoint = { at = "R200:f32", unit = "bar", write = { min = 0.5, max = 80.0 } }
tag.count = { at = "R210:i16", write = {} }
tag.pump = { at = "M8", write = {} }
tag.start = { at = "M100", write = { pulse = "500ms" } }
"#;

fn messages(writes: bool) -> Vec<(String, Value)> {
    let plant = Plant::from_toml(PLANT).unwrap();
    let topics = Topics::mqtt(&Name::constant("fatek"), &Name::constant("hall-2"));
    let discovery = Discovery::new(Name::constant("homeassistant"), topics, ["fatek", "hall-2"], writes);
    let messages = discovery.messages(plant.plc("mixer_1").unwrap());
    assert!(messages.iter().all(|(topic, _)| discovery.is_own(topic)));
    messages.into_iter().map(|(topic, payload)| (topic, serde_json::from_slice(&payload).unwrap())).collect()
}

/// The messages of a tag by component.
fn of_tag(tag: &str, writes: bool) -> Vec<(String, Value)> {
    let end = format!("/fatek_-hall-2/mixer__1_-{tag}/config");
    let component = |topic: &str| topic.strip_suffix(&end).map(|start| start.rsplit('/').next().unwrap().to_owned());
    messages(writes).into_iter().filter_map(|(topic, message)| Some((component(&topic)?, message))).collect()
}

fn one(tag: &str, writes: bool) -> (String, Value) {
    let mut all = of_tag(tag, writes);
    assert_eq!(all.len(), 1, "{all:?}");
    all.remove(0)
}

#[test]
fn every_entity_has_the_keys_that_its_component_requires() {
    let mut ids = HashSet::new();
    for (topic, message) in messages(true) {
        let component = topic.split('/').nth(1).unwrap();
        let required: &[&str] = match component {
            "sensor" => &["state_topic", "value_template"],
            "binary_sensor" => &["state_topic", "value_template", "payload_on", "payload_off"],
            "number" => &["state_topic", "value_template", "command_topic", "command_template", "min", "max", "step"],
            "switch" => &[
                "state_topic",
                "value_template",
                "command_topic",
                "command_template",
                "state_on",
                "state_off",
                "payload_on",
                "payload_off",
            ],
            "button" => &["command_topic", "command_template", "payload_press"],
            other => panic!("component {other}"),
        };
        for key in required.iter().chain(&["name", "unique_id", "device", "origin", "availability"]) {
            assert!(!message[key].is_null(), "{topic} lacks {key}: {message}");
        }
        assert_eq!(message["device"]["identifiers"], json!(["fatek_-hall-2_-mixer__1"]));
        assert_eq!(message["device"]["name"], "mixer_1");
        let topics: Vec<_> = message["availability"].as_array().unwrap().iter().map(|one| &one["topic"]).collect();
        assert_eq!(topics, ["fatek/hall-2/state", "fatek/hall-2/mixer_1/state"]);
        assert_eq!(message["availability_mode"], "all");
        assert!(ids.insert((component.to_owned(), message["unique_id"].clone())), "{topic}: not unique");
        let name = topic.split('/').nth(3).unwrap();
        assert!(name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-'), "{name}");
    }
    assert_eq!(ids.len(), 10);
}

#[test]
fn the_component_follows_the_tag_and_its_write_rule() {
    for (tag, read, write) in [
        ("level", "sensor", "sensor"),
        ("alarm", "binary_sensor", "binary_sensor"),
        ("name", "sensor", "sensor"),
        ("profile", "sensor", "sensor"),
        ("mask", "sensor", "sensor"),
        ("setpoint", "sensor", "number"),
        ("count", "sensor", "number"),
        ("pump", "binary_sensor", "switch"),
    ] {
        assert_eq!((one(tag, false).0.as_str(), one(tag, true).0.as_str()), (read, write), "{tag}");
    }
    let pulse: Vec<String> = of_tag("start", true).into_iter().map(|(component, _)| component).collect();
    assert_eq!(pulse, ["button", "binary_sensor"]);
    assert_eq!(one("start", false).0, "binary_sensor");
    assert!(messages(false).iter().all(|(_, message)| message.get("command_topic").is_none()));
}

#[test]
fn units_limits_and_steps_are_those_of_the_tag() {
    let (_, level) = one("level", true);
    assert_eq!((&level["unit_of_measurement"], &level["state_class"]), (&json!("%"), &json!("measurement")));
    let (_, setpoint) = one("setpoint", true);
    assert_eq!(setpoint["unit_of_measurement"], "bar");
    assert_eq!((&setpoint["min"], &setpoint["max"], &setpoint["step"]), (&json!(0.5), &json!(80.0), &json!(0.001)));
    assert_eq!(setpoint["command_topic"], "fatek/hall-2/mixer_1/cmd");
    let (_, count) = one("count", true);
    assert_eq!((&count["min"], &count["max"], &count["step"]), (&json!(-32768.0), &json!(32767.0), &json!(1.0)));
    // A text has no number that a history could be made of.
    assert!(one("name", true).1.get("state_class").is_none());
    let tag = |text: &str| text.parse::<Tag>().unwrap();
    assert_eq!((range(tag("R0:u16*-2+5")), step(tag("R0:u16*-2+5"))), ((-131_065.0, 5.0), 2.0));
}

#[test]
fn no_entity_takes_the_values_of_a_replay() {
    let mut count = 0;
    for (topic, message) in messages(true).into_iter().chain(messages(false)) {
        if message["state_topic"].is_null() {
            assert!(topic.contains("/button/"), "{topic}");
            continue;
        }
        let template = message["value_template"].as_str().unwrap();
        let start = "{% set v = none if value_json.hist is defined else value_json.d.get('";
        assert!(template.starts_with(start), "{topic}: {template}");
        // The template has no other way to a value.
        assert_eq!(template.matches("value").count(), 2, "{topic}: {template}");
        count += 1;
    }
    assert_eq!(count, 18);
}

#[test]
fn different_names_give_different_ids() {
    let mut ids = HashSet::new();
    let names = ["a", "a_", "_a", "a-", "-a", "a_-a", "a__", "__a", "_", "-", "_-", "-_", "a-_a"];
    for first in names {
        for second in names {
            assert!(ids.insert(joined(&[first, second])), "{first} {second}");
        }
    }
}

#[test]
fn topics_of_others_are_not_own() {
    let topics = Topics::mqtt(&Name::constant("fatek"), &Name::constant("hall-2"));
    let discovery = Discovery::new(Name::constant("ha"), topics, ["fatek", "hall-2"], false);
    assert_eq!(discovery.filter(), "ha/+/fatek_-hall-2/+/config");
    assert!(discovery.is_own("ha/sensor/fatek_-hall-2/x/config"));
    for other in ["ha/sensor/fatek_-hall-20/x/config", "ha/sensor/fatek_-hall-2/config", "ha/status", "ha", ""] {
        assert!(!discovery.is_own(other), "{other}");
    }
}
