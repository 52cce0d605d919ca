//! Secrets in files or variables: relative paths are in `$CREDENTIALS_DIRECTORY`, where systemd puts them.

use std::fmt;
use std::path::{Path, PathBuf};

/// A secret; its `Debug` form hides it.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

/// A file of a secret that cannot be used. It names the file, and never its content.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct SecretError {
    path: PathBuf,
    reason: String,
}

impl Secret {
    /// Reads a file, without the line feed at its end. Blocks until the disk has read it.
    ///
    /// # Errors
    /// [`SecretError`] if the file cannot be read, is empty, or is not UTF-8.
    pub fn load(path: &Path) -> Result<Self, SecretError> {
        let path = located(path);
        let failed = |reason: String| SecretError { path: path.clone(), reason };
        let text = std::fs::read_to_string(&path).map_err(|error| failed(error.to_string()))?;
        let secret = text.trim_end_matches(['\n', '\r']);
        if secret.is_empty() {
            return Err(failed("the file is empty".to_owned()));
        }
        Ok(Self(secret.to_owned()))
    }

    /// The secret of a variable of the environment if it is set and not empty, else of a file. `None` without
    /// both. Blocks until the disk has read it.
    ///
    /// # Errors
    /// Those of [`load`](Self::load).
    pub fn find(variable: &str, file: Option<&Path>) -> Result<Option<Self>, SecretError> {
        match std::env::var(variable).ok().filter(|secret| !secret.is_empty()) {
            Some(secret) => Ok(Some(Self(secret))),
            None => file.map(Self::load).transpose(),
        }
    }

    /// The secret itself. It must not reach a log.
    #[must_use]
    pub fn expose(&self) -> &str {
        &self.0
    }

    /// Compares in a time that does not depend on where the texts differ.
    #[must_use]
    pub fn is(&self, other: &str) -> bool {
        let differences = self.0.bytes().zip(other.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
        self.0.len() == other.len() && differences == 0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(hidden)")
    }
}

/// The path of a credential: a relative one is in `$CREDENTIALS_DIRECTORY` if that is set.
#[must_use]
pub fn located(path: &Path) -> PathBuf {
    match std::env::var_os("CREDENTIALS_DIRECTORY") {
        Some(folder) => Path::new(&folder).join(path),
        None => path.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_is_read_without_its_line_feed_and_is_hidden() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pass");
        std::fs::write(&path, "top secret\r\n").unwrap();
        let secret = Secret::load(&path).unwrap();
        assert_eq!(secret.expose(), "top secret");
        assert_eq!(format!("{secret:?}"), "Secret(hidden)");
        assert!(secret.is("top secret") && !secret.is("top secreT") && !secret.is("top") && !secret.is(""));
        std::fs::write(&path, "\n").unwrap();
        assert!(Secret::load(&path).unwrap_err().to_string().ends_with("pass: the file is empty"));
        assert!(Secret::load(&folder.path().join("none")).is_err());
    }
}
