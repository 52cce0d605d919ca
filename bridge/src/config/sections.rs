//! The sections of the bridge. Their documentation is also that of the JSON schema: it is for users.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use schemars::JsonSchema;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use super::url::{Mqtt, Nats, ServerUrl};
use super::values::{ByteSize, Name, Period};
use crate::secret::{Secret, SecretError};

/// The bridge itself.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct BridgeSection {
    /// The name of the bridge in topics. Default: the name of the host.
    pub id: Name,
    /// The address of page, metrics and health: loopback unless told otherwise.
    #[serde(deserialize_with = "address")]
    #[schemars(with = "String")]
    pub http: SocketAddr,
    /// The file with the token of everything that writes over HTTP; without it nothing writes.
    pub token_file: Option<PathBuf>,
    /// The connections to PLCs that are opened in a second, at most: 1 to 100000.
    #[schemars(range(min = 1, max = 100_000))]
    pub connects_per_second: u32,
    /// The buffer between the PLCs and the outputs.
    pub buffer: BufferSection,
}

impl Default for BridgeSection {
    fn default() -> Self {
        Self {
            id: Name::of_host(),
            http: SocketAddr::from(([127, 0, 0, 1], 9187)),
            token_file: None,
            connects_per_second: 1000,
            buffer: BufferSection::default(),
        }
    }
}

impl BridgeSection {
    /// The token of everything that writes over HTTP, if there is one. Blocks until the disk has read it.
    ///
    /// # Errors
    /// [`SecretError`] if its file cannot be used.
    pub fn token(&self) -> Result<Option<Secret>, SecretError> {
        Secret::find(TOKEN_VARIABLE, self.token_file.as_deref())
    }
}

/// The variable in place of the content of `bridge.token_file`.
pub(crate) const TOKEN_VARIABLE: &str = "FATEK_BRIDGE_HTTP_TOKEN";

/// The buffer between the PLCs and the outputs.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct BufferSection {
    /// The folder of the file, relative to `$STATE_DIRECTORY`; without it the buffer is in memory alone.
    pub dir: Option<PathBuf>,
    /// The largest size on disk.
    pub max: ByteSize,
    /// The largest age of data.
    pub max_age: Period,
    /// The largest size in memory.
    pub memory: ByteSize,
    /// `true`: data is on disk before it is delivered.
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

/// The output to an MQTT broker, version 5.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, expecting = "a table")]
pub struct MqttSection {
    /// `mqtt://HOST[:PORT]`, or `mqtts://` with TLS. Default port: 1883, with TLS 8883.
    pub url: ServerUrl<Mqtt>,
    /// The user.
    pub user: Option<String>,
    /// The file with the password, in `$CREDENTIALS_DIRECTORY` or beside the configuration.
    pub password_file: Option<PathBuf>,
    /// The first level of all topics.
    #[serde(default = "default_prefix")]
    pub prefix: Name,
    /// The prefix of Home Assistant's discovery topics; without it none are published.
    pub home_assistant: Option<Name>,
    /// `true`: commands are taken, for tags with `write` alone.
    #[serde(default)]
    pub write: bool,
    /// `true`: a batch that no client has subscribed to is kept and sent again. Default: it counts as delivered.
    #[serde(default)]
    pub require_subscribers: bool,
    /// Certificates to trust in place of those of the system, PEM.
    pub ca_file: Option<PathBuf>,
    /// The certificate of the client, PEM; needs `key_file`.
    pub cert_file: Option<PathBuf>,
    /// The key of the client's certificate, PEM; needs `cert_file`.
    pub key_file: Option<PathBuf>,
}

impl MqttSection {
    /// The password, if there is one. Blocks until the disk has read it.
    ///
    /// # Errors
    /// [`SecretError`] if its file cannot be used.
    pub fn password(&self) -> Result<Option<Secret>, SecretError> {
        Secret::find(PASSWORD_VARIABLE, self.password_file.as_deref())
    }
}

/// The variable in place of the content of `mqtt.password_file`.
pub(crate) const PASSWORD_VARIABLE: &str = "FATEK_BRIDGE_MQTT_PASSWORD";

/// The output to NATS JetStream.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, expecting = "a table")]
pub struct NatsSection {
    /// `nats://HOST[:PORT]`, or `tls://`. Default port: 4222.
    pub url: ServerUrl<Nats>,
    /// The file with the credentials, in `$CREDENTIALS_DIRECTORY` or beside the configuration.
    pub creds_file: Option<PathBuf>,
    /// The user, in place of `creds_file`.
    pub user: Option<String>,
    /// The file with the password of the user, in `$CREDENTIALS_DIRECTORY` or beside the configuration.
    pub password_file: Option<PathBuf>,
    /// The name of the stream that captures the data.
    #[serde(default = "default_stream")]
    pub stream: Name,
    /// The first token of all subjects.
    #[serde(default = "default_prefix")]
    pub prefix: Name,
    /// `true`: commands are taken, for tags with `write` alone.
    #[serde(default)]
    pub write: bool,
    /// Certificates to trust in place of those of the system, PEM.
    pub ca_file: Option<PathBuf>,
    /// The certificate of the client, PEM; needs `key_file`.
    pub cert_file: Option<PathBuf>,
    /// The key of the client's certificate, PEM; needs `cert_file`.
    pub key_file: Option<PathBuf>,
}

impl NatsSection {
    /// The content of the credentials file, if there is one. Blocks until the disk has read it.
    ///
    /// # Errors
    /// [`SecretError`] if the file cannot be used.
    pub fn credentials(&self) -> Result<Option<Secret>, SecretError> {
        Secret::find(CREDENTIALS_VARIABLE, self.creds_file.as_deref())
    }

    /// The password, if there is one. Blocks until the disk has read it.
    ///
    /// # Errors
    /// [`SecretError`] if its file cannot be used.
    pub fn password(&self) -> Result<Option<Secret>, SecretError> {
        Secret::find(NATS_PASSWORD_VARIABLE, self.password_file.as_deref())
    }
}

/// The variable in place of the content of `nats.creds_file`.
pub(crate) const CREDENTIALS_VARIABLE: &str = "FATEK_BRIDGE_NATS_CREDS";

/// The variable in place of the content of `nats.password_file`.
pub(crate) const NATS_PASSWORD_VARIABLE: &str = "FATEK_BRIDGE_NATS_PASSWORD";

/// The output to stdout: lines of JSON, for trying and for pipes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, expecting = "a table")]
pub struct StdoutSection {}

/// Several bridges share the PLCs, through the server of the section `nats`.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, expecting = "a table")]
pub struct FleetSection {
    /// The name of the fleet, in place of that of the bridge in topics. `bridge.id` is then that of the member.
    pub id: Name,
    /// The bucket of the leases.
    #[serde(default = "default_bucket")]
    pub bucket: Name,
    /// The time after which the links of a silent bridge are taken over, 500ms to 1m.
    #[serde(default = "default_lease")]
    pub lease: Period,
    /// The share of this bridge, in comparison with the others: 1 to 1000.
    #[serde(default = "default_weight")]
    #[schemars(range(min = 1, max = 1000))]
    pub weight: u32,
    /// Where a member has its PLCs and classes from: `file`, this file; `store`, the store of the fleet, where
    /// `fleet push` puts them.
    #[serde(default)]
    pub config: PlantSource,
}

/// Where a member of a fleet has its PLCs and classes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PlantSource {
    /// Its own file.
    #[default]
    File,
    /// The store of the fleet, where `fleet push` puts them.
    Store,
}

/// The rule of `bridge.http`.
pub(super) const ADDRESS_RULE: &str = "it is an address with a port, such as 127.0.0.1:9187";

fn address<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SocketAddr, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse().map_err(|_| D::Error::custom(ADDRESS_RULE))
}

fn default_prefix() -> Name {
    Name::constant("fatek")
}

fn default_stream() -> Name {
    Name::constant("FATEK")
}

fn default_bucket() -> Name {
    Name::constant("fatek_leases")
}

fn default_lease() -> Period {
    Period(Duration::from_secs(3))
}

fn default_weight() -> u32 {
    1
}
