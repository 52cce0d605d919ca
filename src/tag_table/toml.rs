//! Tables in TOML.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::Fault;
use super::draft::{Column, Draft, Row};

/// Parses a table; all faults are in the draft.
pub(super) fn parse(text: &str) -> Draft {
    let mut draft = Draft::default();
    let feeds: Vec<usize> = text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at).collect();
    let line = |span: Range<usize>| feeds.partition_point(|&feed| feed < span.start).saturating_add(1);
    let table = match DeTable::parse(text) {
        Ok(table) => table.into_inner(),
        Err(error) => {
            let message = error.message().to_owned();
            draft.fault(error.span().map_or(1, &line), None, Fault::Syntax { message });
            return draft;
        }
    };
    // The order of the file, not of the names.
    let mut tags: Vec<_> = table.iter().collect();
    tags.sort_by_key(|(name, _)| name.span().start);
    for (name, value) in tags {
        let name_line = line(name.span());
        let mut row = Row::at(name_line);
        row.set(Column::Name, name_line, name.get_ref());
        if name.get_ref().is_empty() {
            draft.fault(name_line, None, Fault::Name { text: String::new() });
        } else if let Some(at) = value.get_ref().as_str() {
            row.set(Column::At, line(value.span()), at.trim());
            draft.add(&row);
        } else if let Some(keys) = value.get_ref().as_table() {
            if keys.iter().all(|(key, value)| set(&mut row, name.get_ref(), key.get_ref(), value, line, &mut draft)) {
                draft.add(&row);
            }
        } else {
            let found = kind(value.get_ref());
            draft.fault(name_line, Some(name.get_ref()), Fault::Kind { expected: "text or a table", found });
        }
    }
    draft
}

/// Sets the value of a key. Returns `false` after a fault.
fn set<'t>(
    row: &mut Row<'t>,
    name: &str,
    key: &str,
    value: &'t Spanned<DeValue<'t>>,
    line: impl Fn(Range<usize>) -> usize,
    draft: &mut Draft,
) -> bool {
    let at = line(value.span());
    // The name is the key of the whole.
    let column = Column::ALL.into_iter().find(|column| *column != Column::Name && column.as_str() == key);
    match (column, value.get_ref().as_str()) {
        (Some(column), Some(text)) => row.set(column, at, text.trim()),
        (Some(column), None) => {
            let found = kind(value.get_ref());
            draft.fault(at, Some(column.as_str()), Fault::Kind { expected: "text", found });
            return false;
        }
        (None, _) if value.get_ref().is_table() => {
            draft.fault(at, Some(name), Fault::Nested { key: key.to_owned() });
            return false;
        }
        (None, _) => {
            let known = "at class unit comment group";
            draft.fault(at, Some(name), Fault::Unknown { title: key.to_owned(), known });
            return false;
        }
    }
    true
}

/// The kind of a value, in messages.
pub(crate) fn kind(value: &DeValue<'_>) -> &'static str {
    match value {
        DeValue::String(_) => "text",
        DeValue::Integer(_) | DeValue::Float(_) => "number",
        DeValue::Boolean(_) => "truth value",
        DeValue::Datetime(_) => "date or time",
        DeValue::Array(_) => "list",
        DeValue::Table(_) => "table",
    }
}
