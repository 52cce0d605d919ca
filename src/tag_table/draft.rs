//! A table while it is parsed: what both formats have in common.

use std::collections::hash_map::Entry;
use std::sync::Arc;

use super::{Fault, TableError, TableErrors, TagEntry, TagTable};
use crate::tag::Tag;

/// The values of a tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
    Name,
    At,
    Class,
    Unit,
    Comment,
    Group,
}

impl Column {
    pub(super) const ALL: [Self; 6] = [Self::Name, Self::At, Self::Class, Self::Unit, Self::Comment, Self::Group];

    pub(super) const fn as_str(self) -> &'static str {
        match self {
            Self::Name => "name",
            Self::At => "at",
            Self::Class => "class",
            Self::Unit => "unit",
            Self::Comment => "comment",
            Self::Group => "group",
        }
    }

    /// The column with this title, in either case.
    pub(super) fn titled(title: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|column| column.as_str().eq_ignore_ascii_case(title))
    }
}

/// The tags up to now, and all faults.
#[derive(Default)]
pub(super) struct Draft {
    table: TagTable,
    faults: Vec<TableError>,
}

/// The texts of a tag, each with its line; empty ones are missing.
pub(super) struct Row<'t> {
    line: usize,
    texts: [Option<(usize, &'t str)>; Column::ALL.len()],
}

impl<'t> Row<'t> {
    /// A row that begins in this line.
    pub(super) fn at(line: usize) -> Self {
        Self { line, texts: [None; Column::ALL.len()] }
    }

    pub(super) fn set(&mut self, column: Column, line: usize, text: &'t str) {
        if let (Some(place), false) = (self.texts.get_mut(column as usize), text.is_empty()) {
            *place = Some((line, text));
        }
    }

    fn get(&self, column: Column) -> Option<(usize, &'t str)> {
        self.texts.get(column as usize).copied().flatten()
    }
}

impl Draft {
    pub(super) fn fault(&mut self, line: usize, column: Option<&str>, fault: Fault) {
        self.faults.push(TableError { line, column: column.map(Into::into), fault });
    }

    pub(super) fn is_good(&self) -> bool {
        self.faults.is_empty()
    }

    /// Adds a tag, or its faults.
    pub(super) fn add(&mut self, row: &Row<'_>) {
        let faults_before = self.faults.len();
        let name = self.required(row, Column::Name).map(|(line, name)| (line, self.name(line, Column::Name, name)));
        let tag = self.required(row, Column::At).and_then(|(line, at)| match at.parse::<Tag>() {
            Ok(tag) => Some(tag),
            Err(error) => {
                self.fault(line, Some(Column::At.as_str()), Fault::Tag(error));
                None
            }
        });
        let named = |draft: &mut Self, column| {
            let (line, text) = row.get(column)?;
            draft.name(line, column, text).map(Into::into)
        };
        let (class, group) = (named(self, Column::Class), named(self, Column::Group));
        let free = |column| row.get(column).map(|(_, text)| text.into());
        let (Some((line, Some(name))), Some(tag), true) = (name, tag, self.faults.len() == faults_before) else {
            return;
        };
        let name: Arc<str> = name.into();
        match self.table.numbers.entry(name.clone()) {
            Entry::Occupied(first) => {
                let first_line = self.table.entries.get(*first.get()).map_or(0, |entry| entry.line);
                let fault = Fault::DoubleName { name: name.to_string(), first_line };
                self.fault(line, Some(Column::Name.as_str()), fault);
            }
            Entry::Vacant(place) => {
                place.insert(self.table.entries.len());
                let (unit, comment) = (free(Column::Unit), free(Column::Comment));
                self.table.entries.push(TagEntry { name, tag, class, unit, comment, group, line: row.line });
            }
        }
    }

    fn required<'t>(&mut self, row: &Row<'t>, column: Column) -> Option<(usize, &'t str)> {
        let text = row.get(column);
        if text.is_none() {
            self.fault(row.line, Some(column.as_str()), Fault::Missing);
        }
        text
    }

    /// A name of a tag, a class or a group, or its fault.
    fn name<'t>(&mut self, line: usize, column: Column, text: &'t str) -> Option<&'t str> {
        let fault = if !is_name(text) {
            Fault::Name { text: text.to_owned() }
        } else if column == Column::Name && text.parse::<Tag>().is_ok() {
            Fault::NameIsTag { name: text.to_owned() }
        } else {
            return Some(text);
        };
        self.fault(line, Some(column.as_str()), fault);
        None
    }

    pub(super) fn finish(self) -> Result<TagTable, TableErrors> {
        if self.faults.is_empty() {
            return Ok(self.table);
        }
        let mut faults = self.faults;
        faults.sort_by_key(|fault| fault.line);
        Err(TableErrors::new(faults))
    }
}

/// Returns whether a text is a name: 1 to 64 of the characters `A-Z a-z 0-9 _ -`.
pub(crate) fn is_name(text: &str) -> bool {
    let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-');
    (1..=64).contains(&text.len()) && text.bytes().all(is_allowed)
}
