//! The configuration as TOML, with the defaults that are in force.
//!
//! The sections of the bridge have all their keys, and a class its `stale_after`. The sections of the plant
//! are as in the file, without comments. The text is a configuration itself: it is the same one, also in
//! another folder. Secrets are not in it, since they are not in the file; paths of secrets are as written.

use std::fmt::Write as _;
use std::path::Path;

use fatek::tag_table::{TableFileError, TagTable};
use serde::Serialize;
use toml::{Table, Value};

use super::environment::{Environment, beside};
use super::source::Source;
use super::stored::PLANT_SECTIONS;
use super::{Config, ConfigError, ConfigFault, Period, Sections};
use crate::import::toml_of;

/// Prints a configuration without faults.
///
/// # Errors
/// Those of [`Config::read`].
pub fn print(path: &Path, environment: &Environment) -> Result<String, ConfigError> {
    let config = Config::read(path, environment)?;
    let text = std::fs::read_to_string(path).map_err(|error| ConfigError::io(path, error))?;
    let mut faults = Vec::new();
    // A file that has changed since it was checked.
    let changed = |faults| ConfigError::faults(path, faults);
    let source = Source::parse(&text).map_err(|fault| changed(vec![fault]))?;
    let sections = Sections::of(&source, environment, &mut faults);
    if !faults.is_empty() {
        return Err(changed(faults));
    }
    let table: Table = text.parse().unwrap_or_default();
    let mut printed = String::new();
    let Sections { bridge, mqtt, nats, stdout, fleet } = sections;
    own_section(&mut printed, "bridge", &bridge);
    classes(&mut printed, &config);
    if let Some(templates) = table.get("template").and_then(Value::as_table) {
        for (name, tags) in templates {
            begin(&mut printed, &format!("template.{name}"));
            entries(&mut printed, "", tags);
        }
    }
    for section in ["plc", "bus"] {
        for (name, keys) in table.get(section).and_then(Value::as_table).into_iter().flatten() {
            begin(&mut printed, &format!("{section}.{name}"));
            entries(&mut printed, "", &with_resolved_table(keys, path));
        }
    }
    mqtt.iter().for_each(|section| own_section(&mut printed, "mqtt", section));
    nats.iter().for_each(|section| own_section(&mut printed, "nats", section));
    stdout.iter().for_each(|section| own_section(&mut printed, "stdout", section));
    fleet.iter().for_each(|section| own_section(&mut printed, "fleet", section));
    if let Some(sim) = table.get("sim").and_then(Value::as_table) {
        for (name, keys) in sim {
            begin(&mut printed, &format!("sim.{name}"));
            entries(&mut printed, "", keys);
        }
    }
    Ok(printed)
}

/// The sections of a plant, with tables of tags as keys `tag`, for the store of a fleet. Comments are left out.
///
/// # Errors
/// Those of [`Config::read`].
pub fn plant_text(path: &Path, environment: &Environment) -> Result<String, ConfigError> {
    Config::read(path, environment)?;
    let text = std::fs::read_to_string(path).map_err(|error| ConfigError::io(path, error))?;
    let table: Table = text.parse().unwrap_or_default();
    let mut printed = String::new();
    for section in PLANT_SECTIONS {
        let Some(keys) = table.get(section).and_then(Value::as_table) else { continue };
        if section == "class" {
            begin(&mut printed, section);
            entries(&mut printed, "", &Value::Table(keys.clone()));
            continue;
        }
        for (name, keys) in keys {
            begin(&mut printed, &format!("{section}.{name}"));
            let mut keys = keys.clone();
            // A template has tags alone, also one of this name.
            let tags = keys.as_table_mut().filter(|_| section == "plc").and_then(|keys| keys.remove("tags"));
            entries(&mut printed, "", &keys);
            let Some(tags) = tags.as_ref().and_then(Value::as_str) else { continue };
            let table = TagTable::load(path.parent().unwrap_or(Path::new("")).join(tags));
            // A table that has changed since it was read above.
            let changed =
                |error: TableFileError| ConfigFault { line: None, key: "tags".into(), rule: error.to_string() };
            let table = table.map_err(|error| ConfigError::faults(path, vec![changed(error)]))?;
            for tag in table.iter() {
                let _ = writeln!(printed, "tag.{} = {}", tag.name(), toml_of(tag));
            }
        }
    }
    Ok(printed)
}

fn begin(printed: &mut String, section: &str) {
    // Writing to a string does not fail.
    let _ = writeln!(printed, "{}[{section}]", if printed.is_empty() { "" } else { "\n" });
}

fn own_section(printed: &mut String, name: &str, section: &impl Serialize) {
    begin(printed, name);
    if let Ok(section) = Value::try_from(section) {
        entries(printed, "", &section);
    }
}

/// Writes a line for each key. The tags of a PLC are a line each, too.
fn entries(printed: &mut String, prefix: &str, value: &Value) {
    for (key, value) in value.as_table().into_iter().flatten() {
        if prefix.is_empty() && matches!(key.as_str(), "tag" | "set") && value.is_table() {
            entries(printed, &format!("{key}."), value);
        } else {
            let _ = writeln!(printed, "{prefix}{} = {value}", Key(key));
        }
    }
}

/// A key, in quotes if it has other characters than those of a bare one.
struct Key<'k>(&'k str);

impl std::fmt::Display for Key<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let is_bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        match self.0.chars().all(is_bare) && !self.0.is_empty() {
            true => f.write_str(self.0),
            false => Value::String(self.0.to_owned()).fmt(f),
        }
    }
}

/// The classes with the age at which their values become stale.
fn classes(printed: &mut String, config: &Config) {
    if config.plant.classes().next().is_some() {
        begin(printed, "class");
    }
    for class in config.plant.classes() {
        let stale_after = class.stale_after().unwrap_or(class.every().saturating_mul(3));
        let (every, stale_after) = (Period(class.every()), Period(stale_after));
        let _ = writeln!(printed, "{} = {{ every = \"{every}\", stale_after = \"{stale_after}\" }}", class.name());
    }
}

/// The keys of a PLC, with the path of its table of tags made absolute.
fn with_resolved_table(keys: &Value, config: &Path) -> Value {
    let mut keys = keys.clone();
    if let Some(Value::String(tags)) = keys.get_mut("tags") {
        *tags = beside(config, Path::new(tags.as_str())).to_string_lossy().into_owned();
    }
    keys
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All that a configuration says, without lines and the paths that depend on the folder.
    fn content(config: &Config) -> String {
        let Config { bridge, mqtt, nats, stdout, fleet, plant, .. } = config;
        let mut text = format!("{bridge:#?} {mqtt:#?} {nats:#?} {stdout:#?} {fleet:#?}\n");
        for class in plant.classes() {
            let stale_after = class.stale_after().unwrap_or(class.every() * 3);
            let _ = writeln!(text, "{} {:?} {stale_after:?}", class.name(), class.every());
        }
        for plc in plant.plcs() {
            let hosts: Vec<&str> = plc.hosts().collect();
            let _ = writeln!(text, "{} {} {} {:?} {hosts:?}", plc.name(), plc.endpoint(), plc.station(), plc.bus());
            for tag in plc.tags() {
                let texts = (tag.name(), tag.tag(), tag.class(), tag.unit(), tag.comment(), tag.group());
                let _ = writeln!(text, "{texts:?} {:?} {:?}", tag.poll_tag(), tag.write());
            }
        }
        text
    }

    #[test]
    fn the_printed_text_is_the_same_configuration_in_the_same_folder() {
        let environment = Environment::default();
        let examples = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/examples"));
        let mut count = 0;
        for entry in std::fs::read_dir(examples).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_none_or(|extension| extension != "toml") {
                continue;
            }
            let folder = tempfile::tempdir().unwrap();
            let copy = folder.path().join("copy.toml");
            let printed = print(&path, &environment).unwrap();
            std::fs::write(&copy, &printed).unwrap();
            let (first, second) = (Config::read(&path, &environment), Config::read(&copy, &environment));
            let (first, second) = (first.unwrap(), second.unwrap_or_else(|error| panic!("{error}\n{printed}")));
            let of_folder = |config: &Config, folder: &Path| content(config).replace(&*folder.to_string_lossy(), "");
            let (first, second) = (of_folder(&first, examples), of_folder(&second, folder.path()));
            let difference = first.lines().zip(second.lines()).find(|(first, second)| first != second);
            assert_eq!((difference, first.len()), (None, second.len()), "{printed}");
            assert_eq!(print(&copy, &environment).unwrap(), printed);
            count += 1;
        }
        assert!(count >= 3, "{count}");
    }

    #[test]
    fn defaults_are_printed_and_comments_are_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("plant.toml");
        let text = "# comment\n[class]\nfast = { every = '500ms' }\n[plc.mixer]\nlink = 'tcp://h'\nstation = 1\n\
                    tags = 'a b.csv'\ntag.level = { at = 'R5', comment = \"a \\\"b\\\" \\u001b\" }\n\
                    [mqtt]\nurl = 'mqtt://broker'\n[stdout]\n[sim.mixer]\nset.'R0 - R1' = '1,2'\nfault = 'drop=1%'\n";
        std::fs::write(&path, text).unwrap();
        std::fs::write(folder.path().join("a b.csv"), "name,at\nx,R7\n").unwrap();
        let environment = Environment { id: Some("hall-9".to_owned()), ..Environment::default() };
        let printed = print(&path, &environment).unwrap();
        let tags = format!("tags = \"{}\"", folder.path().join("a b.csv").display());
        for line in [
            "[bridge]",
            "id = \"hall-9\"",
            "http = \"127.0.0.1:9187\"",
            "buffer = { max = \"1GiB\", max_age = \"7days\", memory = \"64MiB\", sync = false }",
            "fast = { every = \"500ms\", stale_after = \"1s 500ms\" }",
            &tags,
            "url = \"mqtt://broker:1883\"",
            "prefix = \"fatek\"",
            "write = false",
            "[stdout]",
            "fault = \"drop=1%\"",
        ] {
            assert!(printed.lines().any(|printed| printed == line), "{line}:\n{printed}");
        }
        assert!(!printed.contains("# comment") && !printed.contains('\u{1b}'), "{printed}");
    }
}
