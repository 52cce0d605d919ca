use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::printable::excerpt;

/// Error: the content of a file cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The file was not written by this library.
    #[error("not a file of this kind: it does not begin with `fatek file`")]
    Foreign,
    /// The file has another major version.
    #[error("format version {} needs a newer version of this library, which reads version {known}", excerpt(found))]
    #[non_exhaustive]
    Version {
        /// The version of the file.
        found: String,
        /// The major version that this library reads.
        known: u32,
    },
    /// The file has another kind of content.
    #[error("it holds `{}`, where `{expected}` was expected", excerpt(found))]
    #[non_exhaustive]
    Kind {
        /// The kind of its content.
        found: String,
        /// The kind that was expected.
        expected: &'static str,
    },
    /// The end of the file is missing.
    #[error("it is cut off: {expected} bytes were expected, and there are {found}")]
    #[non_exhaustive]
    CutOff {
        /// Its length, as it states.
        expected: u64,
        /// Its length.
        found: u64,
    },
    /// The file goes on after its last line.
    #[error("it is too long: {expected} bytes were expected, and there are {found}")]
    #[non_exhaustive]
    TooLong {
        /// Its length, as it states.
        expected: u64,
        /// Its length.
        found: u64,
    },
    /// The file was changed.
    #[error("it is damaged: its checksum is {computed:08X}, and it states {stated:08X}")]
    #[non_exhaustive]
    Checksum {
        /// The checksum that it states.
        stated: u32,
        /// The checksum of its content.
        computed: u32,
    },
    /// The content breaks a rule that is not about one line.
    #[error("{rule}")]
    #[non_exhaustive]
    Content {
        /// The rule.
        rule: String,
    },
    /// A line breaks a rule of the format.
    #[error("line {line}: {rule}")]
    #[non_exhaustive]
    Line {
        /// The number of the line, from 1.
        line: usize,
        /// The rule.
        rule: String,
    },
}

impl FormatError {
    pub(crate) fn content(rule: impl ToString) -> Self {
        Self::Content { rule: rule.to_string() }
    }

    pub(crate) fn line(line: usize, rule: impl Into<String>) -> Self {
        Self::Line { line, rule: rule.into() }
    }
}

/// Error: a file cannot be saved or loaded. A file that cannot be saved is as it was before.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum FileError {
    /// The system refused.
    #[non_exhaustive]
    Io {
        /// The file.
        path: PathBuf,
        /// The action that failed.
        doing: &'static str,
        /// The error of the system.
        source: Arc<io::Error>,
    },
    /// The name belongs to a folder, a pipe, a device or a broken link. These are neither read nor
    /// replaced: opening a pipe, for instance, could block for ever.
    #[non_exhaustive]
    NotAFile {
        /// The name.
        path: PathBuf,
    },
    /// The file is larger than any file of this library.
    #[non_exhaustive]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The largest size in bytes.
        limit: u64,
    },
    /// The content of the file is wrong.
    #[non_exhaustive]
    Format {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: FormatError,
    },
}

impl fmt::Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Io { path, doing, source } => write!(f, "{}: cannot {doing}: {source}", shown(path)),
            Self::NotAFile { path } => write!(f, "{}: not a regular file", shown(path)),
            Self::TooLarge { path, limit } => {
                write!(f, "{}: not a file of this kind: it has more than {limit} bytes", shown(path))
            }
            Self::Format { path, source } => write!(f, "{}: {source}", shown(path)),
        }
    }
}

impl std::error::Error for FileError {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Io { source, .. } => source.source(),
            Self::Format { source, .. } => source.source(),
            Self::NotAFile { .. } | Self::TooLarge { .. } => None,
        }
    }
}

/// The name of a file on one line, shortened if it is very long.
fn shown(path: &Path) -> String {
    excerpt(&path.to_string_lossy()).to_string()
}
