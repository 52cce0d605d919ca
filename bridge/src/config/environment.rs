//! The environment of the process, as far as it is configuration.
//!
//! | variable | what |
//! |---|---|
//! | `FATEK_BRIDGE_CONFIG` | the file, where the command line names none |
//! | `FATEK_BRIDGE_ID` | in place of `bridge.id`, unless the option `--id` takes it |
//! | `FATEK_BRIDGE_HTTP` | in place of `bridge.http` |
//! | `FATEK_BRIDGE_HTTP_TOKEN` | in place of the content of `bridge.token_file` |
//! | `FATEK_BRIDGE_MQTT_PASSWORD` | in place of the content of `mqtt.password_file` |
//! | `FATEK_BRIDGE_NATS_CREDS` | in place of the content of `nats.creds_file` |
//! | `FATEK_BRIDGE_NATS_PASSWORD` | in place of the content of `nats.password_file` |
//! | `CREDENTIALS_DIRECTORY` | the folder of secrets, set by systemd |
//! | `STATE_DIRECTORY` | the folder of the buffer, set by systemd |
//!
//! An empty variable is as one that is not set.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::values::Name;

/// The variables besides those of secrets, which [`Secret`](crate::secret::Secret) reads.
#[derive(Clone, Debug, Default)]
pub struct Environment {
    /// `--id`, else `FATEK_BRIDGE_ID`.
    pub id: Option<String>,
    /// `FATEK_BRIDGE_HTTP`.
    pub http: Option<String>,
    /// `CREDENTIALS_DIRECTORY`.
    pub credentials: Option<PathBuf>,
    /// `STATE_DIRECTORY`; of several folders the first.
    pub state: Option<PathBuf>,
}

/// The variable in place of `bridge.id`.
pub(super) const ID_VARIABLE: &str = "FATEK_BRIDGE_ID";
/// The variable in place of `bridge.http`.
pub(super) const HTTP_VARIABLE: &str = "FATEK_BRIDGE_HTTP";

impl Environment {
    /// The environment of this process.
    #[must_use]
    pub fn of_process() -> Self {
        let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
        let text = |value: OsString| value.to_string_lossy().into_owned();
        let state = set("STATE_DIRECTORY").and_then(|folders| std::env::split_paths(&folders).next());
        Self {
            id: set(ID_VARIABLE).map(text),
            http: set(HTTP_VARIABLE).map(text),
            credentials: set("CREDENTIALS_DIRECTORY").map(PathBuf::from),
            state,
        }
    }

    /// The environment of this process, with the id that the command line gives.
    #[must_use]
    pub fn with_id(id: Option<&Name>) -> Self {
        let environment = Self::of_process();
        Self { id: id.map(Name::to_string).or(environment.id), ..environment }
    }

    /// The path of a secret or certificate: in the folder of credentials if it is there, else beside the
    /// configuration.
    #[must_use]
    pub fn credential(&self, path: &Path, config: &Path) -> PathBuf {
        let credential = self.credentials.as_ref().map(|folder| folder.join(path));
        credential.filter(|path| path.exists()).unwrap_or_else(|| beside(config, path))
    }

    /// The path of the buffer: in the folder of states, else beside the configuration.
    #[must_use]
    pub fn state(&self, path: &Path, config: &Path) -> PathBuf {
        self.state.as_ref().map_or_else(|| beside(config, path), |folder| folder.join(path))
    }
}

/// A relative path beside a file. It is absolute, so that nothing else is put in front of it.
pub(super) fn beside(file: &Path, path: &Path) -> PathBuf {
    let joined = file.parent().unwrap_or(Path::new("")).join(path);
    std::path::absolute(&joined).unwrap_or(joined)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_paths_are_in_the_folders_of_systemd_or_beside_the_file() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("pass"), "x").unwrap();
        let config = Path::new("/etc/fatek-bridge/plant.toml");
        let none = Environment::default();
        let systemd = Environment {
            credentials: Some(folder.path().to_owned()),
            state: Some(PathBuf::from("/var/lib/fatek-bridge")),
            ..Environment::default()
        };
        let (pass, ca, absolute) = (Path::new("pass"), Path::new("ca.pem"), Path::new("/run/pass"));
        assert_eq!(none.credential(pass, config), Path::new("/etc/fatek-bridge/pass"));
        assert_eq!(systemd.credential(pass, config), folder.path().join("pass"));
        assert_eq!(systemd.credential(ca, config), Path::new("/etc/fatek-bridge/ca.pem"));
        assert_eq!(systemd.credential(absolute, config), absolute);
        assert_eq!(none.state(Path::new("buffer"), config), Path::new("/etc/fatek-bridge/buffer"));
        assert_eq!(systemd.state(Path::new("buffer"), config), Path::new("/var/lib/fatek-bridge/buffer"));
        assert!(beside(Path::new("plant.toml"), pass).is_absolute());
    }
}
