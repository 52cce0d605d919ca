use std::fmt;
use std::path::PathBuf;

use crate::endpoint::ParseEndpointError;
use crate::file::FileError;
use crate::printable::excerpt;
use crate::tag::{ParseTagError, Tag};
use crate::tag_table::{TableFileError, fmt_first};

/// A fault of the configuration of a plant.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlantFault {
    /// The text is not UTF-8.
    #[error("the text is not UTF-8")]
    NotUtf8,
    /// The syntax of TOML is broken.
    #[error("{message}")]
    #[non_exhaustive]
    Syntax {
        /// The rule of TOML.
        message: String,
    },
    /// A required key is missing.
    #[error("it is missing")]
    Missing,
    /// The key is unknown.
    #[error("the key is unknown (known: {known})")]
    #[non_exhaustive]
    Unknown {
        /// The keys that are known.
        known: &'static str,
    },
    /// The value is of another kind.
    #[error("{expected} is expected, and this is a {found}")]
    #[non_exhaustive]
    Kind {
        /// The kind expected.
        expected: &'static str,
        /// Its kind.
        found: &'static str,
    },
    /// The name is too long, or has another character.
    #[error("`{}` is not a name: 1 to 64 of the characters A-Z a-z 0-9 _ - are", excerpt(text))]
    #[non_exhaustive]
    Name {
        /// The text.
        text: String,
    },
    /// The name of a tag is a tag itself.
    #[error("`{name}` is not a name: it is a tag itself")]
    #[non_exhaustive]
    NameIsTag {
        /// The text.
        name: String,
    },
    /// The name occurs twice.
    #[error("the name `{name}` stands in line {first_line} already")]
    #[non_exhaustive]
    DoubleName {
        /// The name.
        name: String,
        /// The line of the first one.
        first_line: usize,
    },
    /// Two PLCs have one link and station.
    #[error("`{other}` has this link and station already")]
    #[non_exhaustive]
    DoubleStation {
        /// The first of them.
        other: String,
    },
    /// One line, such as a serial port, has two settings.
    #[error("`{other}` has this line with other settings")]
    #[non_exhaustive]
    OtherSettings {
        /// The first PLC of the line.
        other: String,
    },
    /// The text is not a time.
    #[error("`{}` is not a time: more than 0 and at most 24h, such as 500ms, 1.5s or 10m", excerpt(text))]
    #[non_exhaustive]
    Time {
        /// The text.
        text: String,
    },
    /// The number is not a station.
    #[error("{number} is not a station: 1 to 254 are")]
    #[non_exhaustive]
    Station {
        /// The number, as in the file.
        number: String,
    },
    /// The number is too small, or not finite.
    #[error("{number} is not possible: the number is finite{}", AtLeast(*min))]
    #[non_exhaustive]
    Number {
        /// The number, as in the file.
        number: String,
        /// The smallest one.
        min: f64,
    },
    /// The smallest number is larger than the largest.
    #[error("min is larger than max")]
    MinAboveMax,
    /// The limits of a write do not suit the tag.
    #[error("min and max are of numbers, and pulse is of one discrete")]
    WrongRule,
    /// A deadband of a tag without numbers.
    #[error("a deadband is of numbers, and {tag} has none")]
    #[non_exhaustive]
    Deadband {
        /// The tag.
        tag: Tag,
    },
    /// A period that is too short to be polled.
    #[error("a period is 1ms or more")]
    Period,
    /// The text is not an endpoint.
    #[error(transparent)]
    Endpoint(ParseEndpointError),
    /// The text is not a tag.
    #[error(transparent)]
    Tag(ParseTagError),
    /// There is no such class or template.
    #[error("there is no {kind} `{}`", excerpt(name))]
    #[non_exhaustive]
    NoSuch {
        /// `class` or `template`.
        kind: &'static str,
        /// The name.
        name: String,
    },
    /// The table of tags cannot be loaded.
    #[error(transparent)]
    Table(TableFileError),
    /// A text that is not in a file names a table of tags.
    #[error("tables of tags are beside a file: load it, instead of its text")]
    NoFiles,
}

/// A fault of the configuration of a plant with its place.
#[derive(Clone, Debug, thiserror::Error)]
#[error("line {line}{}: {fault}", Of(key))]
pub struct PlantError {
    pub(super) line: usize,
    pub(super) key: String,
    pub(super) fault: PlantFault,
}

impl PlantError {
    /// The line, from 1.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }

    /// The path of the key, such as `plc.mixer.station`; empty for a fault of the syntax.
    #[must_use]
    pub fn key(&self) -> &str {
        &self.key
    }

    /// The fault.
    #[must_use]
    pub fn fault(&self) -> &PlantFault {
        &self.fault
    }
}

/// Displays the smallest number, if there is one.
struct AtLeast(f64);

impl fmt::Display for AtLeast {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0 > f64::MIN { write!(f, ", and at least {}", self.0) } else { Ok(()) }
    }
}

/// Displays a key behind a line.
struct Of<'k>(&'k str);

impl fmt::Display for Of<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() { Ok(()) } else { write!(f, ", {}", excerpt(self.0)) }
    }
}

/// All faults of the configuration of a plant, at least one, in the order of their lines.
///
/// Displays the first twenty, each on a line, and the number of the others.
#[derive(Clone, Debug)]
pub struct PlantErrors(Vec<PlantError>);

impl PlantErrors {
    pub(super) fn new(mut faults: Vec<PlantError>) -> Self {
        faults.sort_by_key(|fault| fault.line);
        Self(faults)
    }

    pub(super) fn not_utf8() -> Self {
        Self(vec![PlantError { line: 1, key: String::new(), fault: PlantFault::NotUtf8 }])
    }

    /// Iterates over the faults.
    pub fn iter(&self) -> impl Iterator<Item = &PlantError> {
        self.0.iter()
    }
}

impl fmt::Display for PlantErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt_first(&self.0, f)
    }
}

impl std::error::Error for PlantErrors {}

/// The reason why the file of a plant cannot be loaded.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlantFileError {
    /// The file cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The configuration has faults.
    #[error("{}: {errors}", excerpt(&path.to_string_lossy()))]
    #[non_exhaustive]
    Plant {
        /// The file.
        path: PathBuf,
        /// Its faults.
        errors: PlantErrors,
    },
}
