//! Discovery of Home Assistant: an entity a tag, and a device a PLC. No I/O.
//!
//! | tag | component |
//! |---|---|
//! | discrete, or one bit | `binary_sensor`; writable: `switch`; with a pulse: `button`, and `binary_sensor` |
//! | one number | `sensor`; writable: `number` |
//! | text, hexadecimal number, several values | `sensor` of a text |
//!
//! All entities of a PLC take their values from its batches. A tag that a batch lacks keeps its value, and so do
//! all tags with a batch that is a replay; a tag that is stale or bad becomes unknown. An entity is available while
//! the bridge and the PLC are online; in a fleet, while the PLC is.

use bytes::Bytes;
use fatek::plant::{PlantPlc, PlantTag, WriteRule};
use fatek::tag::{Tag, TagType};
use serde_json::{Map, Value, json};

use crate::config::Name;
use crate::fleet::is_serial;
use crate::topic::Topics;

/// Discovery topics and messages of a bridge.
#[derive(Clone, Debug)]
pub(super) struct Discovery {
    /// The first level of discovery topics.
    prefix: Name,
    /// The second name in topics: of the bridge.
    node: String,
    topics: Topics,
    /// `true`: tags with a write rule can be written.
    writes: bool,
}

/// The limits of a `number` whose tag has no smaller ones: numbers that a f64 has exactly, with a decimal.
const LARGEST: f64 = 1e15;
/// The smallest step that Home Assistant takes.
const SMALLEST_STEP: f64 = 0.001;

impl Discovery {
    pub(super) fn new(prefix: Name, topics: Topics, bridge: [&str; 2], writes: bool) -> Self {
        Self { prefix, node: joined(&bridge), topics, writes }
    }

    /// The first level of all of its topics.
    pub(super) fn prefix(&self) -> &str {
        self.prefix.as_str()
    }

    /// The topic by which Home Assistant says that it has started.
    pub(super) fn status_topic(&self) -> String {
        format!("{}/status", self.prefix)
    }

    /// The filter of the discovery topics of the bridge.
    pub(super) fn filter(&self) -> String {
        format!("{}/+/{}/+/config", self.prefix, self.node)
    }

    /// Returns whether this is a discovery topic of the bridge.
    pub(super) fn is_own(&self, topic: &str) -> bool {
        let levels: Vec<&str> = topic.split('/').collect();
        matches!(levels[..], [prefix, _, node, _, "config"] if prefix == self.prefix.as_str() && node == self.node)
    }

    /// The messages of a PLC, with their topics.
    pub(super) fn messages(&self, plc: &PlantPlc) -> Vec<(String, Bytes)> {
        plc.tags().flat_map(|tag| self.entities(plc, tag)).collect()
    }

    fn entities(&self, plc: &PlantPlc, tag: &PlantTag) -> Vec<(String, Bytes)> {
        let rule = tag.write().filter(|_| self.writes);
        let is_one = tag.tag().value_count() == 1;
        let is_text = tag.tag().tag_type().is_text() || tag.tag().tag_type() == TagType::Hex;
        match (tag.tag().tag_type(), rule) {
            (_, _) if !is_one || is_text => vec![self.entity("sensor", plc, tag, text_sensor(tag.name()))],
            (TagType::Bool, None) => vec![self.entity("binary_sensor", plc, tag, binary_sensor(tag.name()))],
            (TagType::Bool, Some(WriteRule { pulse: Some(_), .. })) => vec![
                self.entity("button", plc, tag, self.button(plc.name(), tag.name())),
                self.entity("binary_sensor", plc, tag, binary_sensor(tag.name())),
            ],
            (TagType::Bool, Some(_)) => vec![self.entity("switch", plc, tag, self.switch(plc.name(), tag.name()))],
            (_, Some(rule)) => vec![self.entity("number", plc, tag, self.number(plc.name(), tag, rule))],
            (_, None) => vec![self.entity("sensor", plc, tag, sensor(tag))],
        }
    }

    /// Topic and message of an entity, with the fields that all have.
    fn entity(&self, component: &str, plc_settings: &PlantPlc, tag: &PlantTag, special: Value) -> (String, Bytes) {
        let plc = plc_settings.name();
        let id = joined(&[plc, tag.name()]);
        let topic = format!("{}/{component}/{}/{id}/config", self.prefix, self.node);
        let available = "{{ 'online' if value_json is defined and value_json.online else 'offline' }}";
        let plc_state = json!({ "topic": self.topics.plc_state(plc), "value_template": available });
        // A PLC of a fleet is available also without the member that has sent this, unless no other has its port.
        let availability: Vec<Value> = if self.topics.is_fleet() {
            let host = plc_settings.hosts().next().filter(|_| is_serial(plc_settings));
            let of_host =
                host.map(|host| json!({ "topic": self.topics.member_state(host), "value_template": available }));
            of_host.into_iter().chain([plc_state]).collect()
        } else {
            vec![json!({ "topic": self.topics.bridge_state(), "value_template": available }), plc_state]
        };
        let mut message = json!({
            "name": tag.name(),
            "unique_id": format!("{}_-{id}", self.node),
            "device": {
                "identifiers": [format!("{}_-{}", self.node, joined(&[plc]))],
                "name": plc,
                "manufacturer": "FATEK",
            },
            "origin": { "name": "fatek-bridge", "sw_version": env!("CARGO_PKG_VERSION") },
            "availability": availability,
            "availability_mode": "all",
            "qos": 1,
        });
        // A button has no state.
        if component != "button" {
            message["state_topic"] = json!(self.topics.data(plc));
        }
        if let (Value::Object(message), Value::Object(special)) = (&mut message, special) {
            message.extend(special);
        }
        (topic, message.to_string().into())
    }

    fn switch(&self, plc: &str, tag: &str) -> Value {
        let mut fields = self.command(plc, tag);
        fields.extend(fields_of(json!({
            "value_template": bit_template(tag),
            "state_on": "ON", "state_off": "OFF",
            "payload_on": "true", "payload_off": "false",
        })));
        Value::Object(fields)
    }

    fn button(&self, plc: &str, tag: &str) -> Value {
        let mut fields = self.command(plc, tag);
        fields.extend(fields_of(json!({ "payload_press": "true" })));
        Value::Object(fields)
    }

    fn number(&self, plc: &str, tag: &PlantTag, rule: WriteRule) -> Value {
        let (lowest, highest) = range(tag.tag());
        let (min, max) = (rule.min.unwrap_or(lowest), rule.max.unwrap_or(highest));
        // Home Assistant reports an error for each state out of the limits.
        let value = format!("{{{{ v if {min} <= v <= {max} else 'None' }}}}");
        let mut fields = self.command(plc, tag.name());
        fields.extend(fields_of(json!({
            "value_template": number_template(tag.name(), &value),
            "min": min, "max": max, "step": step(tag.tag()), "mode": "box",
        })));
        with_unit(&mut fields, tag);
        Value::Object(fields)
    }

    /// Topic and payload of commands. Their id and time are those of Home Assistant.
    fn command(&self, plc: &str, tag: &str) -> Map<String, Value> {
        let id = "ha-{{ (now().timestamp() * 1000000) | int }}";
        let ts = "{{ (now().timestamp() * 1000) | int }}";
        let template = format!(r#"{{"id":"{id}","tag":"{tag}","value":{{{{ value }}}},"ts":{ts}}}"#);
        fields_of(json!({ "command_topic": self.topics.commands(plc), "command_template": template }))
    }
}

fn fields_of(value: Value) -> Map<String, Value> {
    if let Value::Object(fields) = value { fields } else { Map::new() }
}

fn with_unit(fields: &mut Map<String, Value>, tag: &PlantTag) {
    if let Some(unit) = tag.unit() {
        fields.insert("unit_of_measurement".to_owned(), json!(unit));
    }
}

fn binary_sensor(tag: &str) -> Value {
    json!({ "value_template": bit_template(tag), "payload_on": "ON", "payload_off": "OFF" })
}

fn sensor(tag: &PlantTag) -> Value {
    let mut fields = fields_of(json!({
        "value_template": number_template(tag.name(), "{{ v }}"),
        "state_class": "measurement",
    }));
    with_unit(&mut fields, tag);
    Value::Object(fields)
}

fn text_sensor(tag: &str) -> Value {
    // A state has at most 255 characters. An empty one would be a state: so the present one is repeated.
    let template = format!(
        "{}{{% if v is mapping %}}None{{% elif v is string %}}{{{{ v[:255] }}}}\
         {{% elif v is sequence %}}{{{{ (v | join(', '))[:255] }}}}{{% else %}}{{{{ this.state }}}}{{% endif %}}",
        set(tag)
    );
    json!({ "value_template": template })
}

/// `v`: the value of the tag; none if the batch lacks it or is a replay, a mapping if it is stale or bad.
///
/// Home Assistant takes each value as the present one: an old alarm must not start an automation.
fn set(tag: &str) -> String {
    format!("{{% set v = none if value_json.hist is defined else value_json.d.get('{tag}') %}}")
}

/// A number; nothing if the batch lacks it; `None`, which makes it unknown, for everything else, as of a NaN.
fn number_template(tag: &str, value: &str) -> String {
    format!("{}{{% if v is number %}}{value}{{% elif v is not none %}}None{{% endif %}}", set(tag))
}

/// A state; nothing if the batch lacks it; `None`, which makes it unknown, for everything else.
fn bit_template(tag: &str) -> String {
    format!(
        "{}{{% if v is boolean %}}{{{{ 'ON' if v else 'OFF' }}}}{{% elif v is not none %}}None{{% endif %}}",
        set(tag)
    )
}

/// The values that a tag can have.
fn range(tag: Tag) -> (f64, f64) {
    let (low, high) = match tag.tag_type().as_str().trim_end_matches("-hi") {
        "u16" => (0.0, f64::from(u16::MAX)),
        "i16" => (f64::from(i16::MIN), f64::from(i16::MAX)),
        "u32" => (0.0, f64::from(u32::MAX)),
        "i32" => (f64::from(i32::MIN), f64::from(i32::MAX)),
        "u64" => (0.0, LARGEST),
        "bcd16" => (0.0, 9999.0),
        "bcd32" => (0.0, 99_999_999.0),
        _ => (-LARGEST, LARGEST),
    };
    let Some(scale) = tag.scale() else { return (low, high) };
    let ends = [low, high].map(|end| end * scale.gain() + scale.offset());
    (ends[0].min(ends[1]), ends[0].max(ends[1]))
}

/// The difference of two values of a tag that follow each other.
fn step(tag: Tag) -> f64 {
    let is_float = matches!(tag.tag_type().as_str().trim_end_matches("-hi"), "f32" | "f64");
    let raw = if is_float { SMALLEST_STEP } else { 1.0 };
    tag.scale().map_or(raw, |scale| raw * scale.gain().abs()).max(SMALLEST_STEP)
}

/// Names as one name of the characters `A-Z a-z 0-9 _ -`, different for different names: `a_b`, `c` is `a__b_-c`.
fn joined(names: &[&str]) -> String {
    let escaped: Vec<String> = names.iter().map(|name| name.replace('_', "__")).collect();
    escaped.join("_-")
}

#[cfg(test)]
mod tests;
