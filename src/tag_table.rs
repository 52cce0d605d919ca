//! Tables of tags: names for tags, with class, unit, comment and group, from files of a spreadsheet
//! or in TOML (feature `config`).
//!
//! # CSV
//!
//! ```csv
//! name,at,class,unit,comment,group
//! level,R100:f32,fast,m,"level of the tank, above the valve",tank
//! temperature,R5:i16*0.1-40,slow,°C,,tank
//! alarm,M7,fast,,,
//! ```
//!
//! - The first line has the titles, in any order and case. `name` and `at` are required.
//! - Cells are separated by commas, semicolons or tabs, the most frequent one of the titles, or the one of
//!   a line `sep=;` before them. Double quotes enclose a cell with separators, and `""` is a quote in it.
//! - Lines end with LF, CRLF or CR. The text is UTF-8, with or without a byte order mark.
//! - Blanks around a cell are removed. Empty lines, lines that begin with `#`, and columns without a
//!   title or whose title begins with `#`, are ignored.
//!
//! # TOML
//!
//! ```toml
//! alarm = "M7"
//! level = { at = "R100:f32", class = "fast", unit = "m", group = "tank" }
//!
//! [temperature]
//! at = "R5:i16*0.1-40"
//! class = "slow"
//! ```
//!
//! # Rules
//!
//! - A name, a class and a group have 1 to 64 of the characters `A-Z a-z 0-9 _ -`. A name is not a tag
//!   itself, such as `R5`.
//! - No two tags have one name. [`TagTable::overlaps`] finds tags with common elements, which are no
//!   error.
//! - All faults of a file are reported, each with line and column.
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::tag_table::TagTable;
//!
//! let table = TagTable::from_csv("name;at;unit\r\nlevel;R100:f32;m\r\nalarm;M7;\r\n")?;
//! let (level, alarm): (f32, bool) = station.read((table.tag("level")?, table.tag("alarm")?)).await?;
//! assert_eq!((level, alarm, table.get("level").and_then(|entry| entry.unit())), (0.0, false, Some("m")));
//!
//! let error = TagTable::from_csv("name,at\nlevel,R100:f33\n").unwrap_err().to_string();
//! assert!(error.starts_with("line 2, at: `R100:f33` is not a tag: the type is unknown"));
//! # Ok(()) });
//! ```

mod csv;
mod draft;
mod error;
mod overlap;
mod toml;

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

pub(crate) use self::draft::is_name;
pub(crate) use self::error::fmt_first;
pub use self::error::{Fault, TableError, TableErrors, TableFileError, UnknownTag};
pub use self::overlap::Overlap;
pub(crate) use self::toml::kind;
use crate::poll::PollTag;
use crate::tag::Tag;

/// Tags with names; see [the module](self).
#[derive(Clone, Debug, Default)]
pub struct TagTable {
    entries: Vec<TagEntry>,
    /// The number of the entry of each name.
    numbers: HashMap<Arc<str>, usize>,
}

/// A tag of a [`TagTable`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TagEntry {
    name: Arc<str>,
    tag: Tag,
    class: Option<Box<str>>,
    unit: Option<Box<str>>,
    comment: Option<Box<str>>,
    group: Option<Box<str>>,
    line: usize,
}

impl TagTable {
    /// Parses a table in CSV.
    ///
    /// # Errors
    /// [`TableErrors`] has all faults.
    pub fn from_csv(text: &str) -> Result<Self, TableErrors> {
        csv::parse(text).finish()
    }

    /// Parses a table in TOML.
    ///
    /// # Errors
    /// [`TableErrors`] has all faults; of faults of the syntax, the first.
    pub fn from_toml(text: &str) -> Result<Self, TableErrors> {
        toml::parse(text).finish()
    }

    /// Loads a file: TOML if its name ends in `.toml`, else CSV. Blocks until the disk has read it.
    ///
    /// # Errors
    /// [`TableFileError`], which names the file and all faults.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, TableFileError> {
        let path = path.as_ref();
        let content = crate::file::load(path)?;
        let of_file = |errors| TableFileError::Table { path: path.to_owned(), errors };
        let text = std::str::from_utf8(&content).map_err(|error| of_file(TableErrors::not_utf8(&content, error)))?;
        let is_toml = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("toml"));
        if is_toml { Self::from_toml(text) } else { Self::from_csv(text) }.map_err(of_file)
    }

    /// The entry of a name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&TagEntry> {
        self.entries.get(*self.numbers.get(name)?)
    }

    /// The tag of a name, or the tag that the text is.
    ///
    /// # Errors
    /// [`UnknownTag`] if the text is neither.
    pub fn tag(&self, text: &str) -> Result<Tag, UnknownTag> {
        match self.get(text) {
            Some(entry) => Ok(entry.tag),
            None => text.parse().map_err(|reason| UnknownTag { reason, names: self.names_like(text) }),
        }
    }

    /// The entries, in the order of the file.
    pub fn iter(&self) -> impl Iterator<Item = &TagEntry> {
        self.entries.iter()
    }

    /// The tags, in the order of the file.
    pub fn tags(&self) -> impl Iterator<Item = Tag> {
        self.entries.iter().map(|entry| entry.tag)
    }

    /// The classes in use, in the order of their first tags, with their tags. `None` is the class of
    /// the tags without one.
    ///
    /// ```
    /// # async fn example(polled: fatek::poll::PolledStation) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fatek::poll::ScanClass;
    /// use fatek::tag_table::{TagEntry, TagTable};
    ///
    /// let table = TagTable::load("mixer.csv")?;
    /// for (class, entries) in table.by_class() {
    ///     let period = if class == Some("fast") { Duration::from_millis(500) } else { Duration::from_secs(10) };
    ///     polled.add(ScanClass::every(period), entries.into_iter().map(TagEntry::poll_tag))?;
    /// }
    /// # Ok(()) }
    /// ```
    #[must_use]
    pub fn by_class(&self) -> Vec<(Option<&str>, Vec<&TagEntry>)> {
        let mut classes: Vec<(Option<&str>, Vec<&TagEntry>)> = Vec::new();
        let mut numbers: HashMap<Option<&str>, usize> = HashMap::new();
        for entry in &self.entries {
            let number = *numbers.entry(entry.class()).or_insert(classes.len());
            match classes.get_mut(number) {
                Some((_, entries)) => entries.push(entry),
                None => classes.push((entry.class(), vec![entry])),
            }
        }
        classes
    }

    /// Number of tags.
    #[must_use]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Returns whether it has no tags.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Tags with common elements: for each tag that shares elements with an earlier one in the memory of
    /// the PLC, the one of these that reaches farthest.
    ///
    /// They are often meant: a word and its parts. A register and its bits are left out.
    #[must_use]
    pub fn overlaps(&self) -> Vec<Overlap<'_>> {
        overlap::overlaps(&self.entries)
    }

    /// Some names that a mistyped one may stand for: those that are equal in another case, or begin as it
    /// does.
    fn names_like(&self, text: &str) -> Vec<Arc<str>> {
        const MAX: usize = 5;
        let begin: String = text.to_lowercase().chars().take(2).collect();
        let names = self.entries.iter().map(|entry| &entry.name);
        names.filter(|name| name.to_lowercase().starts_with(&begin)).take(MAX).cloned().collect()
    }
}

impl TagEntry {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    /// The name of its scan class.
    #[must_use]
    pub fn class(&self) -> Option<&str> {
        self.class.as_deref()
    }

    /// The unit of its values.
    #[must_use]
    pub fn unit(&self) -> Option<&str> {
        self.unit.as_deref()
    }

    /// Its comment.
    #[must_use]
    pub fn comment(&self) -> Option<&str> {
        self.comment.as_deref()
    }

    /// The name of its group.
    #[must_use]
    pub fn group(&self) -> Option<&str> {
        self.group.as_deref()
    }

    /// The line of the file where it begins, from 1.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }

    /// The tag with its name, for a [`Poller`](crate::Poller).
    pub fn poll_tag(&self) -> PollTag {
        PollTag::new(self.name.clone(), self.tag)
    }
}

#[cfg(test)]
mod tests;
