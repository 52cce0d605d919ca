//! Errors of the configuration.

use std::io;
use std::path::{Path, PathBuf};

use fatek::plant::PlantFileError;

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// A fault of the syntax or of a key of the bridge.
    #[error("{}: line {line}: {message}", path.display())]
    Toml {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The key, if it is known, and the rule.
        message: String,
    },
    /// Faults of the PLCs and their tags.
    #[error(transparent)]
    Plant(PlantFileError),
    /// Keys that do not fit together.
    #[error("{}: {key}: {rule}", path.display())]
    Rule {
        /// The file.
        path: PathBuf,
        /// The key or section.
        key: String,
        /// The rule.
        rule: String,
    },
}

impl ConfigError {
    pub(super) fn io(path: &Path, error: io::Error) -> Self {
        Self::Io { path: path.to_owned(), error }
    }

    pub(super) fn toml(path: &Path, text: &str, error: &toml::de::Error) -> Self {
        let at = error.span().map_or(0, |span| span.start).min(text.len());
        let line = text.as_bytes().iter().take(at).filter(|byte| **byte == b'\n').count().saturating_add(1);
        Self::Toml { path: path.to_owned(), line, message: error.message().to_owned() }
    }
}
