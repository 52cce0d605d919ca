//! Settings that are allowed, and probably not meant.

use std::collections::{BTreeSet, HashMap};

use fatek::memory_map::special_range;
use fatek::plant::{PlantPlc, PlantTag};

use super::{Finding, Severity, finding};
use crate::config::Config;

/// A memory limit below this holds a few batches only.
const SMALL_MEMORY: u64 = 1 << 20;

pub(super) fn check(config: &Config, findings: &mut Vec<Finding>) {
    let mut warn = |line: Option<usize>, key: String, text: String| {
        findings.push(Finding { severity: Severity::Warning, line, key, text });
    };
    classes(config, &mut warn);
    // Tags of a template are those of several PLCs: one warning for all of them.
    let mut lines: BTreeSet<usize> = BTreeSet::new();
    for plc in config.plant.plcs() {
        let key = format!("plc.{}", plc.name());
        if plc.tags().next().is_none() {
            warn(Some(plc.line()), key.clone(), "it has no tags: nothing is read".to_owned());
        }
        for tag in plc.tags() {
            if let Some(text) = write_fault(tag)
                && lines.insert(tag.line())
            {
                warn(Some(tag.line()), format!("{key}.tag.{}", tag.name()), text);
            }
        }
    }
    // In a fleet it is a fault.
    if config.fleet.is_none() {
        addresses(config, &mut warn);
    }
    commands(config, &mut warn);
    outputs(config, &mut warn);
    buffer(config, &mut warn);
    if !config.bridge.http.ip().is_loopback() {
        let text = format!("the page on {} is open to everyone on the network", config.bridge.http);
        warn(None, "bridge.http".to_owned(), text);
    }
    templates(config, findings);
}

/// Takes the line, the key and the text of a warning.
type Warn<'w> = &'w mut dyn FnMut(Option<usize>, String, String);

fn classes(config: &Config, warn: Warn<'_>) {
    let used: BTreeSet<&str> = config.plant.plcs().flat_map(PlantPlc::tags).filter_map(PlantTag::class).collect();
    for class in config.plant.classes() {
        let key = format!("class.{}", class.name());
        if !used.contains(class.name()) {
            warn(None, key.clone(), "no tag has this class".to_owned());
        }
        if class.stale_after().is_some_and(|age| age < class.every().saturating_mul(2)) {
            let text = "it is less than two periods, and raised to them".to_owned();
            warn(None, format!("{key}.stale_after"), text);
        }
    }
}

/// PLCs at one address with different options: each of them has a connection of its own.
fn addresses(config: &Config, warn: Warn<'_>) {
    let mut first: HashMap<String, &PlantPlc> = HashMap::new();
    for plc in config.plant.plcs() {
        let link = plc.endpoint().to_string();
        let address = link.split('?').next().unwrap_or_default();
        match first.get(address) {
            Some(other) if other.endpoint() != plc.endpoint() => {
                let text = format!("{} has this address with other options: there are two connections", other.name());
                warn(Some(plc.line()), format!("plc.{}.link", plc.name()), text);
            }
            Some(_) => {}
            None => drop(first.insert(address.to_owned(), plc)),
        }
    }
}

/// The danger of a tag that can be written.
fn write_fault(tag: &PlantTag) -> Option<String> {
    let rule = tag.write()?;
    let special = tag.tag().elements().find_map(|element| Some((element, special_range(element)?)));
    if let Some((element, range)) = special {
        return Some(format!("{element} is special ({range}): writing it can cause system or I/O errors"));
    }
    if tag.tag().is_bits_of_register() {
        let text = "a write of one bit rewrites the whole register, and undoes what the PLC has changed in it \
                    meanwhile: use a discrete (M)";
        return Some(text.to_owned());
    }
    let is_number = tag.tag().tag_type().is_number();
    (is_number && (rule.min.is_none() || rule.max.is_none()))
        .then(|| "write has no min or no max: numbers without a limit can be written".to_owned())
}

fn commands(config: &Config, warn: Warn<'_>) {
    let is_writable = config.plant.plcs().flat_map(PlantPlc::tags).any(|tag| tag.write().is_some());
    let outputs = [
        ("mqtt.write", config.mqtt.as_ref().is_some_and(|mqtt| mqtt.write)),
        ("nats.write", config.nats.as_ref().is_some_and(|nats| nats.write)),
    ];
    let takes_commands = outputs.iter().any(|(_, write)| *write);
    for (key, _) in outputs.iter().filter(|(_, write)| *write && !is_writable) {
        warn(None, (*key).to_owned(), "no tag has a key `write`: all commands are refused".to_owned());
    }
    if is_writable && !takes_commands && (config.mqtt.is_some() || config.nats.is_some()) {
        let text = "tags have a key `write`, and no output takes commands (write = true)".to_owned();
        warn(None, "mqtt.write, nats.write".to_owned(), text);
    }
}

fn outputs(config: &Config, warn: Warn<'_>) {
    if config.outputs().is_empty() {
        let text = "there is no output: values are on the page and in /metrics alone".to_owned();
        warn(None, "mqtt, nats, stdout".to_owned(), text);
    }
    if config.mqtt.as_ref().is_some_and(|mqtt| mqtt.require_subscribers) && config.plant.plcs().count() > 1 {
        let text = "batches of a PLC without a subscriber are dropped after 10 minutes, or at once of a large backlog, \
                    while those of others are taken: subscribe to every PLC";
        warn(None, "mqtt.require_subscribers".to_owned(), text.to_owned());
    }
    if let Some(mqtt) = &config.mqtt
        && !mqtt.url.is_tls()
        && !mqtt.url.is_loopback()
        && mqtt.user.is_some()
    {
        let text = "the password is sent without encryption: mqtts:// has TLS".to_owned();
        warn(None, "mqtt.url".to_owned(), text);
    }
}

fn buffer(config: &Config, warn: Warn<'_>) {
    let buffer = &config.bridge.buffer;
    let has_server = config.mqtt.is_some() || config.nats.is_some();
    if buffer.dir.is_none() && has_server {
        let text = "without it the buffer is in memory alone, and a restart loses data that is not delivered";
        warn(None, "bridge.buffer.dir".to_owned(), text.to_owned());
    }
    if buffer.dir.is_none() && buffer.sync {
        warn(None, "bridge.buffer.sync".to_owned(), "it has no effect without dir".to_owned());
    }
    if buffer.memory.0 < SMALL_MEMORY {
        let text = format!("{} is little: data is dropped as soon as an output is slow", buffer.memory);
        warn(None, "bridge.buffer.memory".to_owned(), text);
    }
    if buffer.dir.is_some() && buffer.max.0 < buffer.memory.0 {
        warn(None, "bridge.buffer.max".to_owned(), "it is less than the limit in memory".to_owned());
    }
}

/// Templates that no PLC has. The file was parsed before.
fn templates(config: &Config, findings: &mut Vec<Finding>) {
    let text = std::fs::read_to_string(&config.path).unwrap_or_default();
    let Ok(table) = text.parse::<toml::Table>() else { return };
    let section = |name: &str| table.get(name).and_then(toml::Value::as_table).into_iter().flatten();
    let users = section("plc").chain(section("bus"));
    let used: BTreeSet<&str> =
        users.filter_map(|(_, keys)| keys.get("use")?.as_array()).flatten().filter_map(toml::Value::as_str).collect();
    for (name, _) in section("template").filter(|(name, _)| !used.contains(name.as_str())) {
        findings.push(finding(Severity::Warning, format!("template.{name}"), "no PLC and no bus uses it"));
    }
}
