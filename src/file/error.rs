use std::io;
use std::path::PathBuf;
use std::sync::Arc;

/// Why the content of a file was not taken.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// It was not written by this library.
    #[error("this is no file of this kind: it does not begin with `fatek file`")]
    Foreign,
    /// It was written by a later version of this library.
    #[error("the format's version is {found}, and only version {known} is known here")]
    #[non_exhaustive]
    Version {
        /// What the file says.
        found: String,
        /// What this library knows.
        known: u32,
    },
    /// It holds something else.
    #[error("it holds `{found}`, where `{expected}` was expected")]
    #[non_exhaustive]
    Kind {
        /// What it holds.
        found: String,
        /// What was asked for.
        expected: &'static str,
    },
    /// Its end is missing.
    #[error("it is cut off: {expected} bytes were expected, and there are {found}")]
    #[non_exhaustive]
    CutOff {
        /// How long it must be.
        expected: u64,
        /// How long it is.
        found: u64,
    },
    /// Something follows its end.
    #[error("it is too long: {expected} bytes were expected, and there are {found}")]
    #[non_exhaustive]
    TooLong {
        /// How long it must be.
        expected: u64,
        /// How long it is.
        found: u64,
    },
    /// Something in it has been changed.
    #[error("it is damaged: its checksum is {computed:08X}, and it says {stated:08X}")]
    #[non_exhaustive]
    Checksum {
        /// What the file says.
        stated: u32,
        /// What was computed.
        computed: u32,
    },
    /// What it holds makes no sense.
    #[error("{rule}")]
    #[non_exhaustive]
    Content {
        /// Which rule it breaks.
        rule: String,
    },
    /// A line breaks a rule of the format.
    #[error("line {line}: {rule}")]
    #[non_exhaustive]
    Line {
        /// Which one, from 1.
        line: usize,
        /// What is wrong with it.
        rule: String,
    },
}

impl FormatError {
    pub(crate) fn line(line: usize, rule: impl Into<String>) -> Self {
        Self::Line { line, rule: rule.into() }
    }
}

/// Why a file could not be saved or loaded.
///
/// A file that could not be saved is as it was before.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FileError {
    /// The system refused.
    #[error("{}: cannot {doing}: {source}", path.display())]
    #[non_exhaustive]
    Io {
        /// Which file.
        path: PathBuf,
        /// What was tried.
        doing: &'static str,
        /// Why not.
        source: Arc<io::Error>,
    },
    /// There is something under this name that is no file, and it is not replaced by one.
    #[error("{}: this is not a regular file, and is left as it is", path.display())]
    #[non_exhaustive]
    NotAFile {
        /// Which name.
        path: PathBuf,
    },
    /// It is larger than any file of this library.
    #[error("{}: it has more than {limit} bytes, which is no file of this kind", path.display())]
    #[non_exhaustive]
    TooLarge {
        /// Which file.
        path: PathBuf,
        /// How many bytes it can have.
        limit: u64,
    },
    /// Its content is wrong.
    #[error("{}: {source}", path.display())]
    #[non_exhaustive]
    Format {
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        source: FormatError,
    },
}
