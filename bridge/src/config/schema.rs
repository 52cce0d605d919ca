//! JSON Schema of the configuration, for editors.
//!
//! The sections of the bridge follow from their types, and so do their texts. Those of the plant are in
//! `plant.schema.json`; a test compares their keys with those that the parser knows.

use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use super::{BridgeSection, FleetSection, MqttSection, NatsSection, StdoutSection};

/// The sections of the plant.
const PLANT: &str = include_str!("plant.schema.json");

/// All sections of the bridge, for the schema alone.
#[derive(schemars::JsonSchema)]
#[schemars(deny_unknown_fields)]
#[allow(dead_code, reason = "its schema is used, and no value")]
struct BridgeFile {
    bridge: Option<BridgeSection>,
    mqtt: Option<MqttSection>,
    nats: Option<NatsSection>,
    stdout: Option<StdoutSection>,
    fleet: Option<FleetSection>,
}

/// The JSON Schema (draft 2020-12) of a configuration.
#[must_use]
pub fn schema() -> Value {
    let generator = SchemaSettings::draft2020_12().into_generator();
    let mut schema = generator.into_root_schema_for::<BridgeFile>().to_value();
    tidy(&mut schema);
    // A constant of this file: a test parses it.
    let plant: Value = serde_json::from_str(PLANT).unwrap_or_default();
    for part in ["properties", "$defs"] {
        let entries = plant.get(part).and_then(Value::as_object).cloned().unwrap_or_default();
        match schema.get_mut(part).and_then(Value::as_object_mut) {
            Some(present) => present.extend(entries),
            None => drop(schema.as_object_mut().map(|schema| schema.insert(part.to_owned(), entries.into()))),
        }
    }
    if let Some(schema) = schema.as_object_mut() {
        schema.insert("title".to_owned(), "Configuration of fatek-bridge".into());
        schema.insert("description".to_owned(), "Carries data of FATEK PLCs to MQTT, NATS and a web page.".into());
        schema.insert("anyOf".to_owned(), json!([{ "required": ["plc"] }, { "required": ["bus"] }]));
    }
    schema
}

/// Adapts a schema to TOML, which has no null, and removes defaults that are of this host.
fn tidy(schema: &mut Value) {
    match schema {
        Value::Object(object) => {
            tidy_object(object);
            object.values_mut().for_each(tidy);
        }
        Value::Array(items) => items.iter_mut().for_each(tidy),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

fn tidy_object(object: &mut Map<String, Value>) {
    let is_null = |value: &Value| value == "null" || value.get("type").is_some_and(|kind| kind == "null");
    if let Some(Value::Array(kinds)) = object.get_mut("type") {
        kinds.retain(|kind| !is_null(kind));
        if let [kind] = kinds.as_slice() {
            let kind = kind.clone();
            object.insert("type".to_owned(), kind);
        }
    }
    if let Some(Value::Array(choices)) = object.get_mut("anyOf") {
        choices.retain(|choice| !is_null(choice));
        if let [Value::Object(only)] = choices.as_slice() {
            let only = only.clone();
            object.remove("anyOf");
            for (key, value) in only {
                object.entry(key).or_insert(value);
            }
        }
    }
    // Of the bridge the default is the name of this host; that of a whole table repeats those of its keys.
    object.retain(|key, value| key != "default" || !(value.is_null() || value.is_object()));
    if let Some(id) = object.get_mut("properties").and_then(|keys| keys.get_mut("id")).and_then(Value::as_object_mut) {
        id.remove("default");
    }
}

#[cfg(test)]
mod tests;
