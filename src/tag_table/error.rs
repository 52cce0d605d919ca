use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

use crate::file::FileError;
use crate::printable::excerpt;
use crate::tag::ParseTagError;

/// A fault of a table of tags.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// The text is not UTF-8.
    #[error("the text is not UTF-8; save it as CSV UTF-8")]
    NotUtf8,
    /// The syntax of the format is broken.
    #[error("{message}")]
    #[non_exhaustive]
    Syntax {
        /// The rule of the format.
        message: String,
    },
    /// A cell begins with a double quote, and none closes it.
    #[error("a double quote opens a cell, and none closes it; a quote in such a cell is written twice")]
    OpenQuote,
    /// Text follows a double quote that closes a cell.
    #[error("text follows a double quote that closes a cell; a quote in such a cell is written twice")]
    BehindQuote,
    /// The table has no titles.
    #[error("the first line has the titles of the columns, at least name and at")]
    NoTitles,
    /// A required column, or a value of it, is missing.
    #[error("it is missing")]
    Missing,
    /// A column, or key, is unknown.
    #[error("`{}` is unknown (known: {known})", excerpt(title))]
    #[non_exhaustive]
    Unknown {
        /// Its title.
        title: String,
        /// The titles or keys that are known.
        known: &'static str,
    },
    /// A table of TOML is within that of a tag.
    #[error("`{}` is a table within a tag, and tags have none", excerpt(key))]
    #[non_exhaustive]
    Nested {
        /// Its key.
        key: String,
    },
    /// Two columns have one title.
    #[error("two columns have this title")]
    DoubleColumn,
    /// A line has a cell behind the last title.
    #[error("the line has more cells than there are titles")]
    MoreCells,
    /// A value of TOML is of another kind.
    #[error("a {expected} is expected, and this is a {found}")]
    #[non_exhaustive]
    Kind {
        /// The kind expected.
        expected: &'static str,
        /// Its kind.
        found: &'static str,
    },
    /// A name, class or group is too long, or has another character.
    #[error("`{}` is not a name: 1 to 64 of the characters A-Z a-z 0-9 _ - are", excerpt(text))]
    #[non_exhaustive]
    Name {
        /// The text.
        text: String,
    },
    /// A name is a tag itself.
    #[error("`{name}` is not a name: it is a tag itself")]
    #[non_exhaustive]
    NameIsTag {
        /// The text.
        name: String,
    },
    /// A name occurs twice.
    #[error("the name `{name}` stands in line {first_line} already")]
    #[non_exhaustive]
    DoubleName {
        /// The name.
        name: String,
        /// The line of the first one.
        first_line: usize,
    },
    /// The text is not a tag.
    #[error(transparent)]
    Tag(ParseTagError),
}

/// A fault of a table of tags with its place.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}{}: {fault}", Of(column.as_deref()))]
pub struct TableError {
    pub(super) line: usize,
    pub(super) column: Option<Box<str>>,
    pub(super) fault: Fault,
}

impl TableError {
    /// The line, from 1.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }

    /// The title of the column, or the key.
    #[must_use]
    pub fn column(&self) -> Option<&str> {
        self.column.as_deref()
    }

    /// The fault.
    #[must_use]
    pub fn fault(&self) -> &Fault {
        &self.fault
    }
}

/// Displays a column behind a line.
struct Of<'c>(Option<&'c str>);

impl fmt::Display for Of<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.map_or(Ok(()), |column| write!(f, ", {}", excerpt(column)))
    }
}

/// All faults of a table of tags, at least one, in the order of their lines.
///
/// Displays the first twenty, each on a line, and the number of the others.
#[derive(Clone, Debug, PartialEq)]
pub struct TableErrors(Vec<TableError>);

impl TableErrors {
    pub(super) fn new(faults: Vec<TableError>) -> Self {
        Self(faults)
    }

    pub(super) fn not_utf8(content: &[u8], error: std::str::Utf8Error) -> Self {
        let before = content.get(..error.valid_up_to()).unwrap_or_default();
        Self(vec![TableError { line: line_at(before), column: None, fault: Fault::NotUtf8 }])
    }

    /// Iterates over the faults.
    pub fn iter(&self) -> impl Iterator<Item = &TableError> {
        self.0.iter()
    }
}

/// The line behind these bytes, from 1.
fn line_at(before: &[u8]) -> usize {
    before.iter().filter(|&&byte| byte == b'\n').count().saturating_add(1)
}

impl fmt::Display for TableErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt_first(&self.0, f)
    }
}

/// Displays the first twenty faults of a file, each on a line, and the number of the others.
pub(crate) fn fmt_first(faults: &[impl fmt::Display], f: &mut fmt::Formatter<'_>) -> fmt::Result {
    const SHOWN: usize = 20;
    for (number, error) in faults.iter().take(SHOWN).enumerate() {
        write!(f, "{}{error}", if number > 0 { "\n" } else { "" })?;
    }
    match faults.len().saturating_sub(SHOWN) {
        0 => Ok(()),
        others => write!(f, "\nand {others} more"),
    }
}

impl std::error::Error for TableErrors {}

/// The reason why a file of a table of tags cannot be loaded.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TableFileError {
    /// The file cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The table has faults.
    #[error("{}: {errors}", excerpt(&path.to_string_lossy()))]
    #[non_exhaustive]
    Table {
        /// The file.
        path: PathBuf,
        /// Its faults.
        errors: TableErrors,
    },
}

/// A text that is neither a name of a table nor a tag.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{reason}{}", Names(names))]
pub struct UnknownTag {
    pub(super) reason: ParseTagError,
    pub(super) names: Vec<Arc<str>>,
}

impl UnknownTag {
    /// The reason why it is not a tag.
    #[must_use]
    pub fn reason(&self) -> &ParseTagError {
        &self.reason
    }

    /// Up to five names of the table that are like it.
    pub fn similar_names(&self) -> impl Iterator<Item = &str> {
        self.names.iter().map(|name| &**name)
    }
}

/// Displays that a text is not a name, and names like it.
struct Names<'n>(&'n [Arc<str>]);

impl fmt::Display for Names<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("; nor is it a name of the table")?;
        for (number, name) in self.0.iter().enumerate() {
            write!(f, "{}{name}", if number == 0 { " (similar names: " } else { ", " })?;
        }
        f.write_str(if self.0.is_empty() { "" } else { ")" })
    }
}
