use std::collections::BTreeSet;
use std::process::{Command, Stdio};

use fatek::plant::{Plant, PlantFault};
use serde::de::{self, Deserialize, Visitor};

use super::*;
use crate::config::BufferSection;

/// A deserializer that fails with the keys of the struct that is asked for.
struct Keys;

#[derive(Debug)]
struct Found(&'static [&'static str]);

impl std::fmt::Display for Found {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}", self.0)
    }
}

impl std::error::Error for Found {}

impl de::Error for Found {
    fn custom<T: std::fmt::Display>(_: T) -> Self {
        Self(&[])
    }
}

impl<'de> de::Deserializer<'de> for Keys {
    type Error = Found;

    fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value, Found> {
        Err(Found(&[]))
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _: &'static str,
        fields: &'static [&'static str],
        _: V,
    ) -> Result<V::Value, Found> {
        Err(Found(fields))
    }

    serde::forward_to_deserialize_any! {
        bool i8 i16 i32 i64 u8 u16 u32 u64 f32 f64 char str string bytes byte_buf option unit unit_struct
        newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

fn keys_of<'de, T: Deserialize<'de> + std::fmt::Debug>() -> BTreeSet<String> {
    let Found(keys) = T::deserialize(Keys).unwrap_err();
    keys.iter().map(|key| (*key).to_owned()).collect()
}

/// The keys of an object of the schema, which takes no others. References are followed.
fn keys_at(schema: &Value, pointer: &str) -> BTreeSet<String> {
    let mut object = schema.pointer(pointer).unwrap_or_else(|| panic!("{pointer}"));
    while let Some(Value::String(reference)) = object.get("$ref") {
        object = schema.pointer(reference.trim_start_matches('#')).unwrap_or_else(|| panic!("{reference}"));
    }
    assert_eq!(object.get("additionalProperties"), Some(&Value::Bool(false)), "{pointer}: {object:#}");
    let keys = object.get("properties").and_then(Value::as_object);
    keys.into_iter().flatten().map(|(key, _)| key.clone()).collect()
}

#[test]
fn the_schema_has_the_keys_of_the_sections() {
    let schema = schema();
    for (pointer, keys) in [
        ("/properties/bridge", keys_of::<BridgeSection>()),
        ("/properties/mqtt", keys_of::<MqttSection>()),
        ("/properties/nats", keys_of::<NatsSection>()),
        ("/properties/stdout", keys_of::<StdoutSection>()),
        ("/properties/fleet", keys_of::<FleetSection>()),
        ("/$defs/BufferSection", keys_of::<BufferSection>()),
    ] {
        assert_eq!(keys_at(&schema, pointer), keys, "{pointer}");
    }
    let sections: BTreeSet<String> = crate::config::SECTIONS.iter().map(|name| (*name).to_owned()).collect();
    assert_eq!(keys_at(&schema, ""), sections);
}

/// The keys that the parser of a plant knows where the text has the key `x`.
fn known(text: &str) -> BTreeSet<String> {
    let errors = Plant::from_toml(text).unwrap_err();
    let known = errors.iter().find_map(|error| {
        let PlantFault::Unknown { known, .. } = error.fault() else { return None };
        Some(*known)
    });
    known.unwrap_or_else(|| panic!("{errors}")).split(' ').map(str::to_owned).collect()
}

#[test]
fn the_schema_has_the_keys_of_a_plant() {
    let schema = schema();
    for (pointer, text) in [
        ("/$defs/class", "class.a.x = 1"),
        ("/$defs/plc", "plc.a.x = 1"),
        ("/$defs/bus", "bus.a.x = 1"),
        ("/$defs/tag/anyOf/1", "template.a.b.x = 1"),
        ("/$defs/write", "template.a.b = { at = 'R0', write = { x = 1 } }"),
    ] {
        assert_eq!(keys_at(&schema, pointer), known(text), "{pointer}");
    }
}

/// Validates documents by an implementation of another origin. Returns for each whether it is valid, or
/// `None` without Python and its module `jsonschema` (Debian: python3-jsonschema).
fn validate(documents: &[Value]) -> Option<Vec<bool>> {
    const SCRIPT: &str = "import json, sys\nimport jsonschema\n\
        schema, documents = json.load(sys.stdin)\n\
        jsonschema.Draft202012Validator.check_schema(schema)\n\
        validator = jsonschema.Draft202012Validator(schema)\n\
        print(json.dumps([validator.is_valid(document) for document in documents]))\n";
    let mut python = Command::new("python3")
        .args(["-c", SCRIPT])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .ok()?;
    serde_json::to_writer(python.stdin.take().unwrap(), &json!([schema(), documents])).unwrap();
    let output = python.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    if errors.contains("No module named 'jsonschema'") {
        return None;
    }
    assert!(output.status.success(), "{errors}");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

fn document(text: &str) -> Value {
    let table: toml::Table = toml::from_str(text).unwrap_or_else(|error| panic!("{error}\n{text}"));
    serde_json::to_value(table).unwrap()
}

#[test]
fn examples_are_valid_and_faults_are_not() {
    const PLC: &str = "[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\ntag.level = 'R5'\n";
    let examples = concat!(env!("CARGO_MANIFEST_DIR"), "/examples");
    let mut cases: Vec<(String, bool)> = Vec::new();
    for entry in std::fs::read_dir(examples).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "toml") {
            cases.push((std::fs::read_to_string(path).unwrap(), true));
        }
    }
    assert!(cases.len() >= 3, "{}", cases.len());
    cases.push((PLC.to_owned(), true));
    let fleet =
        "[nats]\nurl = 'nats://h'\n[fleet]\nid = 'plant-a'\nbucket = 'fatek_leases'\nlease = '3s'\nweight = 1\n";
    cases.push((format!("{PLC}{fleet}"), true));
    for fault in [
        "[outputs]\n",
        "[bridge]\nid = 'a/b'\n",
        "[bridge]\nhttp = 5\n",
        "[bridge]\nbuffer.mem = '1MiB'\n",
        "[bridge]\nbuffer.max = '1 GiBi'\n",
        "[bridge]\nbuffer.max_age = 7\n",
        "[mqtt]\nuser = 'me'\n",
        "[mqtt]\nurl = 'http://broker'\n",
        "[mqtt]\nurl = 'mqtt://me:secret@broker'\n",
        "[mqtt]\nurl = 'mqtt://broker'\npassword = 'secret'\n",
        "[mqtt]\nurl = 'mqtt://broker'\nwrite = 'yes'\n",
        "[nats]\nurl = 'nats://a'\nstreem = 'X'\n",
        "[stdout]\nx = 1\n",
        "[fleet]\nid = 'a'\nweight = 0\n",
        "[class]\nfast = '500ms'\n",
        "[class]\nfast = { every = 500 }\n",
        "[class]\nfast = {}\n",
        "[plc.a]\nlink = 'http://h'\nstation = 1\n",
        "[plc.a]\nlink = 'tcp://h'\nstation = 255\n",
        "[plc.a]\nlink = 'tcp://h'\n",
        "[plc.'a b']\nlink = 'tcp://h'\nstation = 1\n",
        "[plc.a]\nlink = 'tcp://h'\nstation = 1\ntag.x = 5\n",
        "[plc.a]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'R5', clas = 'fast' }\n",
        "[plc.a]\nlink = 'tcp://h'\nstation = 1\ntag.x = { at = 'R5', write = { mini = 0 } }\n",
        "[bus.a]\nlink = 'tcp://h'\nstations = [1, 2]\n",
        "[bus.a]\nlink = 'tcp://h'\nstations = { x = 1 }\ntag.level = 'R5'\n",
    ] {
        cases.push((format!("{PLC}{fault}"), false));
    }
    cases.push(("[stdout]\n".to_owned(), false));
    let documents: Vec<Value> = cases.iter().map(|(text, _)| document(text)).collect();
    let Some(results) = validate(&documents) else {
        assert!(std::env::var_os("FATEK_BRIDGE_REQUIRE_SERVERS").is_none(), "python3-jsonschema is missing");
        eprintln!("skipped: Python has no module jsonschema (Debian: python3-jsonschema)");
        return;
    };
    assert_eq!(results.len(), cases.len());
    for ((text, expected), is_valid) in cases.iter().zip(results) {
        assert_eq!(is_valid, *expected, "{text}");
    }
}

#[test]
fn each_key_of_the_bridge_has_a_description() {
    let schema = schema();
    let definitions = schema["$defs"].as_object().unwrap();
    let sections = definitions.iter().filter(|(name, _)| name.ends_with("Section"));
    let mut count = 0;
    for (name, section) in sections {
        for (key, value) in section.get("properties").and_then(Value::as_object).into_iter().flatten() {
            assert!(value.get("description").is_some(), "{name}.{key}: {value}");
            count += 1;
        }
    }
    assert!(count > 20, "{count}");
    assert!(!schema.to_string().contains("null"), "TOML has no null: {schema:#}");
}

/// All keys of the objects of a schema, besides names that the user chooses.
fn all_keys(schema: &Value, keys: &mut BTreeSet<String>) {
    if let Some(properties) = schema.get("properties").and_then(Value::as_object) {
        keys.extend(properties.keys().cloned());
    }
    match schema {
        Value::Object(object) => object.values().for_each(|value| all_keys(value, keys)),
        Value::Array(items) => items.iter().for_each(|value| all_keys(value, keys)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

#[test]
fn the_documentation_names_each_key() {
    let documentation = include_str!("../../../docs/setup.md");
    let mut keys = BTreeSet::new();
    all_keys(&schema()["$defs"], &mut keys);
    assert!(keys.len() > 35 && keys.contains("heartbeat") && keys.contains("password_file"), "{keys:?}");
    for key in keys {
        let is_named = ["`", ".", "`tag."].iter().any(|before| documentation.contains(&format!("{before}{key}`")));
        assert!(is_named || key == "buffer" || key == "tag", "docs/setup.md does not name the key `{key}`");
    }
}
