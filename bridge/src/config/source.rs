//! The text of a configuration: its lines, its sections, and the faults in them.

use serde::Deserialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue, ValueDeserializer};

use super::error::ConfigFault;
use super::suggestion::{known_keys, of_serde};

/// A text that is TOML.
pub(super) struct Source<'t> {
    lines: Lines,
    root: DeTable<'t>,
}

/// The positions of all line feeds.
struct Lines(Vec<usize>);

impl Lines {
    fn of(text: &str) -> Self {
        Self(text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at).collect())
    }

    /// The line of a position, from 1.
    fn at(&self, position: usize) -> usize {
        self.0.partition_point(|&feed| feed < position).saturating_add(1)
    }
}

impl<'t> Source<'t> {
    /// Parses a text. The fault is the first one of the syntax.
    pub(super) fn parse(text: &'t str) -> Result<Self, ConfigFault> {
        let lines = Lines::of(text);
        match DeTable::parse(text) {
            Ok(root) => Ok(Self { lines, root: root.into_inner() }),
            Err(error) => {
                let line = error.span().map_or(1, |span| lines.at(span.start));
                Err(ConfigFault { line: Some(line), key: String::new(), rule: error.message().to_owned() })
            }
        }
    }

    /// Reports the sections that are not known.
    pub(super) fn check_sections(&self, known: &[&str], faults: &mut Vec<ConfigFault>) {
        for key in self.root.keys().filter(|key| !known.contains(&key.get_ref().as_ref())) {
            let name = key.get_ref().as_ref();
            let rule = known_keys(name, known).replace("the key", "the section");
            faults.push(ConfigFault { line: Some(self.lines.at(key.span().start)), key: name.to_owned(), rule });
        }
    }

    /// Returns whether it has a key of this path.
    pub(super) fn has_key(&self, path: &[&str]) -> bool {
        let Some((last, tables)) = path.split_last() else { return false };
        let mut table = Some(&self.root);
        for name in tables {
            let found = table.and_then(|table| table.iter().find(|(key, _)| key.get_ref() == name));
            table = found.and_then(|(_, value)| value.get_ref().as_table());
        }
        table.is_some_and(|table| table.keys().any(|key| key.get_ref() == last))
    }

    /// The section of this name; `None` if it is missing or has faults, which are added to the others.
    ///
    /// After a fault its key is left out and the others are checked, so that all faults are found.
    pub(super) fn section<T: Deserialize<'t>>(&self, name: &str, faults: &mut Vec<ConfigFault>) -> Option<T> {
        let (section_key, value) = self.root.iter().find(|(key, _)| key.get_ref() == name)?;
        let mut value = value.clone();
        let mut faulty: Vec<Vec<String>> = Vec::new();
        loop {
            let error = match T::deserialize(ValueDeserializer::from(value.clone())) {
                Ok(section) => return faulty.is_empty().then_some(section),
                Err(error) => error,
            };
            let start = section_key.span().start;
            let position = error.span().map_or(start, |span| span.start);
            let path = path_at(value.get_ref(), position);
            let missing = error.message().strip_prefix("missing field `").and_then(|rest| rest.strip_suffix('`'));
            let (at, rule) = match missing {
                Some(field) => ([path.as_slice(), &[field.to_owned()]].concat(), "it is missing".to_owned()),
                None => (path.clone(), of_serde(error.message())),
            };
            // A required key that was left out is not missing.
            if !faulty.contains(&at) {
                let line = self.lines.at(if path.is_empty() { start } else { position });
                let key = [&[name.to_owned()], at.as_slice()].concat().join(".");
                faults.push(ConfigFault { line: Some(line), key, rule });
            }
            faulty.push(at);
            if !remove(value.get_mut(), &path) {
                return None;
            }
        }
    }

    /// A fault of a key of this path, with its line.
    pub(super) fn fault(&self, path: &[&str], rule: impl Into<String>) -> ConfigFault {
        let mut table = Some(&self.root);
        let mut position = 0;
        for name in path {
            let found = table.and_then(|table| table.iter().find(|(key, _)| key.get_ref() == name));
            let Some((key, value)) = found else { break };
            position = key.span().start;
            table = value.get_ref().as_table();
        }
        ConfigFault { line: Some(self.lines.at(position)), key: path.join("."), rule: rule.into() }
    }
}

/// The keys that lead to the value, or to the key, at this position.
fn path_at(value: &DeValue<'_>, position: usize) -> Vec<String> {
    let Some(table) = value.as_table() else { return Vec::new() };
    for (key, value) in table.iter() {
        let below = path_at(value.get_ref(), position);
        if !below.is_empty() || key.span().contains(&position) || value.span().contains(&position) {
            return [vec![key.get_ref().to_string()], below].concat();
        }
    }
    Vec::new()
}

/// Removes the key of this path and returns whether it was there.
fn remove(value: &mut DeValue<'_>, path: &[String]) -> bool {
    match (path, value) {
        ([key], DeValue::Table(table)) => table.remove(key.as_str()).is_some(),
        ([first, rest @ ..], DeValue::Table(table)) => {
            table.get_mut(first.as_str()).is_some_and(|value: &mut Spanned<DeValue<'_>>| remove(value.get_mut(), rest))
        }
        ([..], _) => false,
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields, expecting = "a table")]
    struct Section {
        url: String,
        #[serde(default)]
        size: u8,
        #[serde(default)]
        inner: Inner,
    }

    #[derive(Debug, Default, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Inner {
        a: u8,
    }

    fn faults(text: &str) -> Vec<String> {
        let source = Source::parse(text).unwrap();
        let mut faults = Vec::new();
        let section: Option<Section> = source.section("mqtt", &mut faults);
        assert_eq!(section.is_some(), faults.is_empty() && text.contains("mqtt"));
        faults.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_section_reports_all_faults_with_line_and_key() {
        assert!(faults("[mqtt]\nurl = 'a'\ninner = { a = 1 }\n").is_empty());
        assert!(faults("[other]\n").is_empty());
        let all = faults("\n[mqtt]\nsizes = 3\nsize = 300\nurl = 5\ninner = { b = 1 }\n[mqtt.more]\nx = 1\n");
        let expected = [
            "line 3, mqtt.sizes: the key is unknown; did you mean `size`? (known: url size inner)",
            "line 4, mqtt.size: ",
            "line 5, mqtt.url: ",
            "line 6, mqtt.inner.b: the key is unknown",
            "line 6, mqtt.inner.a: it is missing",
            "line 7, mqtt.more: the key is unknown",
        ];
        assert_eq!(all.len(), expected.len(), "{all:#?}");
        for expected in expected {
            assert!(all.iter().any(|fault| fault.starts_with(expected)), "{expected}: {all:#?}");
        }
    }

    #[test]
    fn a_missing_key_is_a_fault_of_the_line_of_its_section() {
        assert_eq!(faults("\n[mqtt]\nsize = 1\n"), ["line 2, mqtt.url: it is missing"]);
        assert_eq!(faults("\nmqtt.size = 1\n"), ["line 2, mqtt.url: it is missing"]);
        let [fault] = &faults("mqtt = 5\n")[..] else { panic!() };
        assert_eq!(fault, "line 1, mqtt: a table is expected, and this is a number");
    }

    #[test]
    fn the_line_of_a_fault_of_the_syntax_is_known() {
        let fault = Source::parse("[mqtt]\nurl = \n").err().unwrap();
        assert!(fault.to_string().starts_with("line 2: "), "{fault}");
    }
}
