//! Tables and values of TOML with their places, and the faults found in them.

use std::ops::Range;
use std::time::Duration;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::{PlantError, PlantFault};
use crate::tag_table::{is_name, kind};

/// The faults up to now.
pub(super) struct Faults {
    /// The positions of all line feeds.
    feeds: Vec<usize>,
    list: Vec<PlantError>,
}

impl Faults {
    pub(super) fn of(text: &str) -> Self {
        let feeds = text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at).collect();
        Self { feeds, list: Vec::new() }
    }

    /// The line of a span, from 1.
    pub(super) fn line(&self, span: &Range<usize>) -> usize {
        self.feeds.partition_point(|&feed| feed < span.start).saturating_add(1)
    }

    pub(super) fn push(&mut self, line: usize, key: &str, fault: PlantFault) {
        self.list.push(PlantError { line, key: key.to_owned(), fault });
    }

    pub(super) fn len(&self) -> usize {
        self.list.len()
    }

    pub(super) fn into_list(self) -> Vec<PlantError> {
        self.list
    }
}

/// A table whose keys are taken one by one. Keys that are not taken are faults.
pub(super) struct Section<'t> {
    path: String,
    line: usize,
    table: &'t DeTable<'t>,
    taken: Vec<&'static str>,
}

/// A value and its place.
pub(super) struct Field<'t> {
    path: String,
    line: usize,
    value: &'t DeValue<'t>,
}

impl<'t> Section<'t> {
    pub(super) fn new(path: impl Into<String>, line: usize, table: &'t DeTable<'t>) -> Self {
        Self { path: path.into(), line, table, taken: Vec::new() }
    }

    pub(super) fn path(&self) -> &str {
        &self.path
    }

    pub(super) fn line(&self) -> usize {
        self.line
    }

    /// All keys with their values, in the order of the file.
    pub(super) fn entries(&self, faults: &Faults) -> Vec<(&'t str, Field<'t>)> {
        let mut entries: Vec<_> = self.table.iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);
        let field =
            |key: &'t Spanned<_>, value| self.field(AsRef::<str>::as_ref(key.get_ref()), &key.span(), value, faults);
        entries.into_iter().map(|(key, value)| (AsRef::<str>::as_ref(key.get_ref()), field(key, value))).collect()
    }

    pub(super) fn take(&mut self, key: &'static str, faults: &Faults) -> Option<Field<'t>> {
        self.taken.push(key);
        let (name, value) = self.table.iter().find(|(name, _)| name.get_ref() == key)?;
        Some(self.field(key, &name.span(), value, faults))
    }

    pub(super) fn require(&mut self, key: &'static str, faults: &mut Faults) -> Option<Field<'t>> {
        let field = self.take(key, faults);
        if field.is_none() {
            faults.push(self.line, &format!("{}.{key}", self.path), PlantFault::Missing);
        }
        field
    }

    /// Reports all keys that were not taken.
    pub(super) fn finish(self, known: &'static str, faults: &mut Faults) {
        for (key, field) in self.entries(faults) {
            if !self.taken.contains(&key) {
                faults.push(field.line, &field.path, PlantFault::Unknown { known });
            }
        }
    }

    fn field(&self, key: &str, span: &Range<usize>, value: &'t Spanned<DeValue<'t>>, faults: &Faults) -> Field<'t> {
        let path = if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) };
        Field { path, line: faults.line(span), value: value.get_ref() }
    }
}

impl<'t> Field<'t> {
    pub(super) fn line(&self) -> usize {
        self.line
    }

    pub(super) fn fault(&self, fault: PlantFault, faults: &mut Faults) {
        faults.push(self.line, &self.path, fault);
    }

    fn expected<T>(&self, value: Option<T>, expected: &'static str, faults: &mut Faults) -> Option<T> {
        if value.is_none() {
            self.fault(PlantFault::Kind { expected, found: kind(self.value) }, faults);
        }
        value
    }

    pub(super) fn is_text(&self) -> bool {
        self.value.is_str()
    }

    pub(super) fn text(&self, faults: &mut Faults) -> Option<&'t str> {
        self.expected(self.value.as_str(), "a text", faults)
    }

    pub(super) fn flag(&self, faults: &mut Faults) -> Option<bool> {
        self.expected(self.value.as_bool(), "true or false", faults)
    }

    pub(super) fn table(&self, faults: &mut Faults) -> Option<Section<'t>> {
        self.table_or("a table", faults)
    }

    /// The table. `expected`: the kinds that are possible here.
    pub(super) fn table_or(&self, expected: &'static str, faults: &mut Faults) -> Option<Section<'t>> {
        let table = self.expected(self.value.as_table(), expected, faults)?;
        Some(Section::new(self.path.clone(), self.line, table))
    }

    pub(super) fn texts(&self, faults: &mut Faults) -> Option<Vec<&'t str>> {
        let array = self.expected(self.value.as_array(), "a list of texts", faults)?;
        let texts: Option<Vec<&str>> = array.iter().map(|item| item.get_ref().as_str()).collect();
        self.expected(texts, "a list of texts", faults)
    }

    /// A finite number of at least `min`.
    pub(super) fn number(&self, min: f64, faults: &mut Faults) -> Option<f64> {
        let digits = match self.value {
            DeValue::Integer(number) if number.radix() == 10 => Some(number.as_str()),
            DeValue::Float(number) => Some(number.as_str()),
            DeValue::String(_)
            | DeValue::Integer(_)
            | DeValue::Boolean(_)
            | DeValue::Datetime(_)
            | DeValue::Array(_)
            | DeValue::Table(_) => None,
        };
        let digits = self.expected(digits, "a decimal number", faults)?;
        match digits.parse::<f64>() {
            Ok(number) if number.is_finite() && number >= min => Some(number),
            Ok(_) | Err(_) => {
                self.fault(PlantFault::Number { number: digits.to_owned(), min }, faults);
                None
            }
        }
    }

    pub(super) fn station(&self, faults: &mut Faults) -> Option<u8> {
        let digits = self.value.as_integer().filter(|number| number.radix() == 10).map(|number| number.as_str());
        let digits = self.expected(digits, "a decimal integer", faults)?;
        match digits.parse() {
            Ok(station @ 1..=254) => Some(station),
            Ok(_) | Err(_) => {
                self.fault(PlantFault::Station { number: digits.to_owned() }, faults);
                None
            }
        }
    }

    /// A time of more than 0, at most a day.
    pub(super) fn time(&self, faults: &mut Faults) -> Option<Duration> {
        const DAY: Duration = Duration::from_secs(24 * 3600);
        let text = self.text(faults)?;
        match humantime::parse_duration(text) {
            Ok(time) if !time.is_zero() && time <= DAY => Some(time),
            Ok(_) | Err(_) => {
                self.fault(PlantFault::Time { text: text.to_owned() }, faults);
                None
            }
        }
    }

    /// Checks that the key of this field is a name.
    pub(super) fn is_named(&self, name: &str, faults: &mut Faults) -> bool {
        let is_name = is_name(name);
        if !is_name {
            self.fault(PlantFault::Name { text: name.to_owned() }, faults);
        }
        is_name
    }
}
