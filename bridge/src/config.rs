//! Configuration: a TOML file with the sections of the bridge, and those of a plant.
//!
//! The sections `class`, `template`, `plc` and `bus` are read by [`fatek::plant`], and the command line
//! uses the same file. All other sections are read here; unknown sections and keys are errors.

mod error;
mod values;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fatek::plant::Plant;
use serde::Deserialize;
use serde::de::IgnoredAny;

pub use self::error::ConfigError;
pub use self::values::{ByteSize, Name, Period};

/// The configuration.
#[derive(Clone, Debug)]
pub struct Config {
    /// The file.
    pub path: PathBuf,
    /// The bridge itself.
    pub bridge: BridgeSection,
    /// The output to an MQTT broker.
    pub mqtt: Option<MqttSection>,
    /// The output to NATS JetStream.
    pub nats: Option<NatsSection>,
    /// The output to stdout.
    pub stdout: Option<StdoutSection>,
    /// The PLCs with their tags.
    pub plant: Plant,
}

/// All sections of the file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    bridge: BridgeSection,
    mqtt: Option<MqttSection>,
    nats: Option<NatsSection>,
    stdout: Option<StdoutSection>,
    // Of the plant.
    #[serde(rename = "class")]
    _class: Option<IgnoredAny>,
    #[serde(rename = "template")]
    _template: Option<IgnoredAny>,
    #[serde(rename = "plc")]
    _plc: Option<IgnoredAny>,
    #[serde(rename = "bus")]
    _bus: Option<IgnoredAny>,
}

/// `[bridge]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BridgeSection {
    /// The name of the bridge in topics.
    pub id: Name,
    /// The address of page, metrics and health.
    pub http: SocketAddr,
    /// The file with the token of everything that writes over HTTP; without it nothing writes.
    pub token_file: Option<PathBuf>,
    /// The buffer between the PLCs and the outputs.
    pub buffer: BufferSection,
}

impl Default for BridgeSection {
    fn default() -> Self {
        Self {
            id: Name::of_host(),
            http: SocketAddr::from(([127, 0, 0, 1], 9187)),
            token_file: None,
            buffer: BufferSection::default(),
        }
    }
}

/// `bridge.buffer`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BufferSection {
    /// The folder of the file, relative to `$STATE_DIRECTORY`; without it the buffer is in memory alone.
    pub dir: Option<PathBuf>,
    /// The largest size on disk.
    pub max: ByteSize,
    /// The largest age of a batch.
    pub max_age: Period,
    /// The largest size in memory.
    pub memory: ByteSize,
    /// `true`: each batch is on disk before it is delivered.
    pub sync: bool,
}

impl Default for BufferSection {
    fn default() -> Self {
        Self {
            dir: None,
            max: ByteSize(1 << 30),
            max_age: Period(Duration::from_secs(7 * 24 * 3600)),
            memory: ByteSize(64 << 20),
            sync: false,
        }
    }
}

/// `[mqtt]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MqttSection {
    /// `mqtt://HOST[:PORT]`, or `mqtts://` with TLS.
    pub url: String,
    /// The user.
    pub user: Option<String>,
    /// The file with the password, in `$CREDENTIALS_DIRECTORY` if it is relative.
    pub password_file: Option<PathBuf>,
    /// The first level of all topics.
    #[serde(default = "default_prefix")]
    pub prefix: Name,
    /// The prefix of Home Assistant's discovery topics; without it none are published.
    pub home_assistant: Option<Name>,
    /// `true`: commands are taken.
    #[serde(default)]
    pub write: bool,
    /// Certificates to trust instead of those of the system.
    pub ca_file: Option<PathBuf>,
    /// The certificate of the client.
    pub cert_file: Option<PathBuf>,
    /// Its key.
    pub key_file: Option<PathBuf>,
}

/// `[nats]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NatsSection {
    /// `nats://HOST[:PORT]`, or `tls://`.
    pub url: String,
    /// The file with the credentials, in `$CREDENTIALS_DIRECTORY` if it is relative.
    pub creds_file: Option<PathBuf>,
    /// The name of the stream that captures the data.
    #[serde(default = "default_stream")]
    pub stream: Name,
    /// The first token of all subjects.
    #[serde(default = "default_prefix")]
    pub prefix: Name,
    /// `true`: commands are taken.
    #[serde(default)]
    pub write: bool,
    /// Certificates to trust instead of those of the system.
    pub ca_file: Option<PathBuf>,
    /// The certificate of the client.
    pub cert_file: Option<PathBuf>,
    /// Its key.
    pub key_file: Option<PathBuf>,
}

/// `[stdout]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StdoutSection {}

fn default_prefix() -> Name {
    Name::constant("fatek")
}

fn default_stream() -> Name {
    Name::constant("FATEK")
}

impl Config {
    /// Loads a file, and the tables of tags that it names. Blocks until the disk has read them.
    ///
    /// # Errors
    /// [`ConfigError`] names the file and each fault with its line.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|error| ConfigError::io(path, error))?;
        let File { bridge, mqtt, nats, stdout, .. } =
            toml::from_str(&text).map_err(|error| ConfigError::toml(path, &text, &error))?;
        let plant = Plant::load(path).map_err(ConfigError::Plant)?;
        let config = Self { path: path.to_owned(), bridge, mqtt, nats, stdout, plant };
        config.check()?;
        Ok(config)
    }

    /// The names of the outputs that are configured, in the order of their cursors.
    #[must_use]
    pub fn outputs(&self) -> Vec<&'static str> {
        let outputs = [("stdout", self.stdout.is_some()), ("mqtt", self.mqtt.is_some()), ("nats", self.nats.is_some())];
        outputs.into_iter().filter(|(_, is_on)| *is_on).map(|(name, _)| name).collect()
    }

    fn check(&self) -> Result<(), ConfigError> {
        let rule = |section: &str, cert: &Option<PathBuf>, key: &Option<PathBuf>| match (cert, key) {
            (Some(_), Some(_)) | (None, None) => Ok(()),
            (Some(_), None) => Err(self.fault(section, "cert_file needs key_file")),
            (None, Some(_)) => Err(self.fault(section, "key_file needs cert_file")),
        };
        if let Some(mqtt) = &self.mqtt {
            rule("mqtt", &mqtt.cert_file, &mqtt.key_file)?;
        }
        if let Some(nats) = &self.nats {
            rule("nats", &nats.cert_file, &nats.key_file)?;
        }
        if self.plant.plcs().next().is_none() {
            return Err(self.fault("plc", "there is no PLC"));
        }
        Ok(())
    }

    fn fault(&self, key: &str, rule: &str) -> ConfigError {
        ConfigError::Rule { path: self.path.clone(), key: key.to_owned(), rule: rule.to_owned() }
    }
}
