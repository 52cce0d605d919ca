//! Configuration: a TOML file with the sections of the bridge, and those of a plant.
//!
//! The sections `class`, `template`, `plc` and `bus` are read by [`fatek::plant`], and the command line
//! `fatek` uses the same file. `sim` belongs to `fatek sim` and to the demo. All other sections are read here;
//! unknown sections and keys are faults. All faults of a file are reported, each with its line and key.
//!
//! ```text
//! text ─▶ Source (TOML, lines) ─▶ sections (serde) ─▶ rules ─▶ Config, with paths resolved
//!    └──▶ fatek::plant ─────────────────────────────────────────▲
//! ```

mod environment;
mod error;
mod fleet;
mod print;
mod rules;
mod schema;
mod sections;
mod source;
mod stored;
mod suggestion;
mod url;
mod values;

use std::path::{Path, PathBuf};

use fatek::plant::Plant;

pub use self::environment::Environment;
pub use self::error::{ConfigError, ConfigFault};
pub use self::print::{plant_text, print};
pub use self::schema::schema;
pub use self::sections::{BridgeSection, BufferSection, FleetSection, MqttSection, NatsSection};
pub use self::sections::{PlantSource, StdoutSection};
use self::source::Source;
pub use self::stored::StoredPlant;
pub use self::url::{Mqtt, Nats, Protocol, ServerUrl};
pub use self::values::{ByteSize, Name, Period};
use crate::output::OutputKind;

/// The configuration. Its paths are resolved.
#[derive(Clone, Debug)]
pub struct Config {
    /// The file.
    pub path: PathBuf,
    /// The variables and options that it was read with.
    pub environment: Environment,
    /// The bridge itself.
    pub bridge: BridgeSection,
    /// The output to an MQTT broker.
    pub mqtt: Option<MqttSection>,
    /// The output to NATS JetStream.
    pub nats: Option<NatsSection>,
    /// The output to stdout.
    pub stdout: Option<StdoutSection>,
    /// Several bridges that share the PLCs.
    pub fleet: Option<FleetSection>,
    /// The PLCs with their tags.
    pub plant: Plant,
    /// The plant of the store of the fleet, if `plant` is that one.
    pub stored: Option<StoredPlant>,
}

/// The sections that a file can have: those of the bridge, those of the plant, and that of the simulator.
const SECTIONS: [&str; 10] = ["bridge", "mqtt", "nats", "stdout", "fleet", "class", "template", "plc", "bus", "sim"];

impl Config {
    /// Reads a file and the tables of tags that it names, with the variables of this process. Blocks until the disk
    /// has read them.
    ///
    /// # Errors
    /// [`ConfigError`] names the file and all faults with their lines.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::read(path, &Environment::of_process())
    }

    /// Reads the file of a configuration again, with the same variables and options. A plant of the store stays.
    /// Blocks as [`load`](Self::load) does.
    ///
    /// # Errors
    /// Those of [`load`](Self::load); a fault if the file wants to have its plant from elsewhere.
    pub fn reload(&self) -> Result<Self, ConfigError> {
        let config = Self::read(&self.path, &self.environment)?;
        if config.has_stored_plant() != self.has_stored_plant() {
            let rule = "a change of it needs a restart".to_owned();
            let fault = ConfigFault { line: None, key: "fleet.config".to_owned(), rule };
            return Err(ConfigError::faults(&self.path, vec![fault]));
        }
        match &self.stored {
            Some(stored) => config.with_plant(stored.clone()),
            None => Ok(config),
        }
    }

    /// Returns whether its plant is that of the store of the fleet.
    #[must_use]
    pub fn has_stored_plant(&self) -> bool {
        self.fleet.as_ref().is_some_and(|fleet| fleet.config == PlantSource::Store)
    }

    /// Reads a file as [`load`](Self::load) does, with other variables.
    ///
    /// # Errors
    /// Those of [`load`](Self::load).
    pub fn read(path: &Path, environment: &Environment) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|error| ConfigError::io(path, error))?;
        Self::parse(path, &text, Plant::load(path).map_err(|error| error::plant_faults(error, &text)), environment)
    }

    /// Parses a text that names no tables of tags. `path`: its name in messages, and for relative paths.
    ///
    /// # Errors
    /// Those of [`load`](Self::load), without reading.
    pub fn from_text(path: &Path, text: &str, environment: &Environment) -> Result<Self, ConfigError> {
        let plant = Plant::from_toml(text).map_err(|errors| error::faults_of(&errors, text));
        Self::parse(path, text, plant, environment)
    }

    fn parse(
        path: &Path,
        text: &str,
        plant: Result<Plant, Vec<ConfigFault>>,
        environment: &Environment,
    ) -> Result<Self, ConfigError> {
        let mut faults = Vec::new();
        let source = match Source::parse(text) {
            Ok(source) => source,
            // The plant has the same one.
            Err(fault) => return Err(ConfigError::faults(path, vec![fault])),
        };
        let sections = Sections::of(&source, environment, &mut faults);
        let plant = plant.map_err(|of_plant| faults.extend(of_plant)).ok();
        if let Some(plant) = &plant {
            match sections.fleet {
                Some(_) => fleet::check(plant, &source, &mut faults),
                None => fleet::check_without(plant, &source, &mut faults),
            }
        }
        let (Some(plant), true) = (plant, faults.is_empty()) else { return Err(ConfigError::faults(path, faults)) };
        let is_stored = sections.fleet.as_ref().is_some_and(|fleet| fleet.config == PlantSource::Store);
        if plant.plcs().next().is_none() && !is_stored {
            return Err(ConfigError::faults(path, vec![error::no_plc()]));
        }
        Ok(sections.resolve(path, environment, plant))
    }

    /// The id in topics: that of the fleet, or of the bridge.
    #[must_use]
    pub fn topic_id(&self) -> &Name {
        self.fleet.as_ref().map_or(&self.bridge.id, |fleet| &fleet.id)
    }

    /// The outputs that are configured, in the order of their cursors.
    #[must_use]
    pub fn outputs(&self) -> Vec<OutputKind> {
        let is_on = |kind: &OutputKind| match kind {
            OutputKind::Stdout => self.stdout.is_some(),
            OutputKind::Mqtt => self.mqtt.is_some(),
            OutputKind::Nats => self.nats.is_some(),
        };
        [OutputKind::Stdout, OutputKind::Mqtt, OutputKind::Nats].into_iter().filter(is_on).collect()
    }

    /// Returns whether the section of an output has `write = true`.
    #[must_use]
    pub fn takes_commands(&self, output: OutputKind) -> bool {
        match output {
            OutputKind::Stdout => false,
            OutputKind::Mqtt => self.mqtt.as_ref().is_some_and(|mqtt| mqtt.write),
            OutputKind::Nats => self.nats.as_ref().is_some_and(|nats| nats.write),
        }
    }
}

/// The sections of the bridge as the file has them, with defaults.
#[derive(Debug, Default)]
struct Sections {
    bridge: BridgeSection,
    mqtt: Option<MqttSection>,
    nats: Option<NatsSection>,
    stdout: Option<StdoutSection>,
    fleet: Option<FleetSection>,
}

impl Sections {
    fn of(source: &Source<'_>, environment: &Environment, faults: &mut Vec<ConfigFault>) -> Self {
        source.check_sections(&SECTIONS, faults);
        let mut sections = Self {
            bridge: source.section("bridge", faults).unwrap_or_default(),
            mqtt: source.section("mqtt", faults),
            nats: source.section("nats", faults),
            stdout: source.section("stdout", faults),
            fleet: source.section("fleet", faults),
        };
        rules::check(&sections, source, faults);
        rules::apply(environment, &mut sections.bridge, faults);
        sections
    }

    /// The configuration, with all paths as the environment says.
    fn resolve(self, path: &Path, environment: &Environment, plant: Plant) -> Config {
        let Self { mut bridge, mut mqtt, mut nats, stdout, fleet } = self;
        let credential = |file: &mut Option<PathBuf>| {
            *file = file.take().map(|file| environment.credential(&file, path));
        };
        credential(&mut bridge.token_file);
        bridge.buffer.dir = bridge.buffer.dir.map(|dir| environment.state(&dir, path));
        if let Some(MqttSection { password_file, ca_file, cert_file, key_file, .. }) = &mut mqtt {
            [password_file, ca_file, cert_file, key_file].into_iter().for_each(credential);
        }
        if let Some(NatsSection { creds_file, password_file, ca_file, cert_file, key_file, .. }) = &mut nats {
            [creds_file, password_file, ca_file, cert_file, key_file].into_iter().for_each(credential);
        }
        let (path, environment) = (path.to_owned(), environment.clone());
        Config { path, environment, bridge, mqtt, nats, stdout, fleet, plant, stored: None }
    }
}

#[cfg(test)]
mod tests;
