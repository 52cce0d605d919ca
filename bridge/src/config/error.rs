//! Errors of the configuration.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use fatek::plant::{PlantError, PlantErrors, PlantFault, PlantFileError};

use super::suggestion::{known_keys, meant};
use crate::printable::excerpt;

/// A configuration that cannot be used. It displays a line for each fault.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: {error}", excerpt(&path.to_string_lossy()))]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// The file has faults.
    #[error("{}", Lines(path, faults))]
    Faults {
        /// The file.
        path: PathBuf,
        /// All faults that were found, at least one, in the order of their lines.
        faults: Vec<ConfigFault>,
    },
}

/// A fault of the configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigFault {
    /// The line of the file, from 1; `None`: the fault is not in the file, but in the environment.
    pub line: Option<usize>,
    /// The path of the key, such as `mqtt.url`; empty for a fault of the syntax.
    pub key: String,
    /// The rule that is broken.
    pub rule: String,
}

impl fmt::Display for ConfigFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { line, key, rule } = self;
        if let Some(line) = line {
            write!(f, "line {line}{} ", if key.is_empty() { ":" } else { "," })?;
        }
        if key.is_empty() { write!(f, "{rule}") } else { write!(f, "{}: {rule}", excerpt(key)) }
    }
}

/// Displays each fault on a line, behind the name of the file.
struct Lines<'f>(&'f Path, &'f [ConfigFault]);

impl fmt::Display for Lines<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(path, faults) = self;
        let path = path.to_string_lossy();
        for (number, fault) in faults.iter().enumerate() {
            write!(f, "{}{}: {fault}", if number > 0 { "\n" } else { "" }, excerpt(&path))?;
        }
        Ok(())
    }
}

impl ConfigError {
    pub(super) fn io(path: &Path, error: io::Error) -> Self {
        Self::Io { path: path.to_owned(), error }
    }

    pub(super) fn faults(path: &Path, mut faults: Vec<ConfigFault>) -> Self {
        faults.sort_by_key(|fault| fault.line);
        Self::Faults { path: path.to_owned(), faults }
    }
}

/// The fault of a plant without PLCs.
pub(super) fn no_plc() -> ConfigFault {
    let rule = "there is no PLC: a section such as [plc.mixer] with link and station adds one".to_owned();
    ConfigFault { line: Some(1), key: "plc".to_owned(), rule }
}

/// The faults of the sections of a plant.
pub(super) fn plant_faults(error: PlantFileError, text: &str) -> Vec<ConfigFault> {
    let PlantFileError::Plant { errors, .. } = &error else {
        return vec![ConfigFault { line: None, key: String::new(), rule: error.to_string() }];
    };
    faults_of(errors, text)
}

/// The faults of a plant, with the key or name that was probably meant.
pub(super) fn faults_of(errors: &PlantErrors, text: &str) -> Vec<ConfigFault> {
    let table: toml::Table = text.parse().unwrap_or_default();
    let rule = |error: &PlantError| {
        if let PlantFault::Unknown { known, .. } = error.fault() {
            let key = error.key().rsplit('.').next().unwrap_or_default();
            return known_keys(key, &known.split(' ').collect::<Vec<_>>());
        }
        let PlantFault::NoSuch { kind, name, .. } = error.fault() else { return error.fault().to_string() };
        let names = table.get(*kind).and_then(toml::Value::as_table).into_iter().flatten();
        let names: Vec<&str> = names.map(|(name, _)| name.as_str()).collect();
        format!("{}{}", error.fault(), meant(name, &names))
    };
    let fault =
        |error: &PlantError| ConfigFault { line: Some(error.line()), key: error.key().to_owned(), rule: rule(error) };
    errors.iter().map(fault).collect()
}
