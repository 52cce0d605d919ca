//! The plant of the store of a fleet, in place of that of the file.

use std::path::PathBuf;
use std::sync::Arc;

use fatek::plant::Plant;

use super::source::Source;
use super::{Config, ConfigError, ConfigFault, error, fleet};

/// The sections of a plant that come from the store of a fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredPlant {
    /// Its version: the revision of the store. `None`: a copy that this member kept, of a version that is not known.
    pub version: Option<u64>,
    /// Its text, TOML.
    pub text: Arc<str>,
}

impl StoredPlant {
    /// Its name in messages, in place of that of a file.
    #[must_use]
    pub fn name(&self) -> PathBuf {
        match self.version {
            Some(version) => format!("version {version} of the plant"),
            None => "the copy of the plant".to_owned(),
        }
        .into()
    }

    /// Parses it, by the rules of a fleet. Lines are those of its text.
    ///
    /// # Errors
    /// [`ConfigError`] with all faults.
    pub fn parse(&self) -> Result<Plant, ConfigError> {
        let fail = |faults: Vec<ConfigFault>| Err(ConfigError::faults(&self.name(), faults));
        let source = match Source::parse(&self.text) {
            Ok(source) => source,
            Err(fault) => return fail(vec![fault]),
        };
        let plant = match Plant::from_toml(&self.text) {
            Ok(plant) => plant,
            Err(errors) => return fail(error::faults_of(&errors, &self.text)),
        };
        let mut faults = Vec::new();
        source.check_sections(&PLANT_SECTIONS, &mut faults);
        fleet::check(&plant, &source, &mut faults);
        if plant.plcs().next().is_none() {
            faults.push(error::no_plc());
        }
        if faults.is_empty() { Ok(plant) } else { fail(faults) }
    }
}

/// The sections of a plant.
pub(super) const PLANT_SECTIONS: [&str; 4] = ["class", "template", "plc", "bus"];

impl Config {
    /// This configuration with a plant of the store in place of its own.
    ///
    /// # Errors
    /// [`ConfigError`] with all faults of the plant.
    pub fn with_plant(&self, stored: StoredPlant) -> Result<Self, ConfigError> {
        let plant = stored.parse()?;
        Ok(Self { plant, stored: Some(stored), ..self.clone() })
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::{Environment, plant_text};
    use crate::fleet::config_hash;

    const OWN: &str = "[nats]\nurl = 'nats://h'\n[fleet]\nid = 'a'\nconfig = 'store'\n";
    const PLC: &str = "[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\n";

    fn stored(text: &str) -> StoredPlant {
        StoredPlant { version: Some(7), text: text.into() }
    }

    fn read(folder: &Path, text: &str) -> Result<Config, ConfigError> {
        std::fs::write(folder.join("own.toml"), text).unwrap();
        Config::read(&folder.join("own.toml"), &Environment::default())
    }

    #[test]
    fn a_member_has_its_sections_from_its_file_and_plcs_from_the_store() {
        let folder = tempfile::tempdir().unwrap();
        let own = read(folder.path(), &format!("{OWN}[bridge]\nid = 'hall-1'\n")).unwrap();
        assert_eq!((own.plant.plcs().count(), own.has_stored_plant()), (0, true));
        let config = own.with_plant(stored(PLC)).unwrap();
        assert_eq!((config.plant.plcs().count(), config.bridge.id.as_str()), (1, "hall-1"));
        // A reload reads the file alone.
        let mut own = format!("{OWN}weight = 3\n[bridge]\nid = 'hall-1'\n");
        std::fs::write(&config.path, &own).unwrap();
        let again = config.reload().unwrap();
        assert_eq!(
            (again.plant.plcs().count(), again.fleet.clone().unwrap().weight, again.stored),
            (1, 3, config.stored.clone())
        );
        own = own.replace("store", "file") + PLC;
        std::fs::write(&config.path, &own).unwrap();
        let error = config.reload().unwrap_err().to_string();
        assert!(error.ends_with("own.toml: fleet.config: a change of it needs a restart"), "{error}");
    }

    #[test]
    fn faults_of_the_stored_plant_have_its_version_and_lines() {
        let config = Config::from_text(Path::new("own.toml"), OWN, &Environment::default()).unwrap();
        for (text, fault) in [
            ("x", "line 1: "),
            ("\n[plc.a]\nlink = 'tcp://h'\n", "line 2, plc.a.station: it is missing"),
            ("\n[bus.a]\nlink = 'serial:/dev/ttyS0'\nstations = { x = 1 }\n", "line 2, bus.a.host: a serial port has"),
            ("", "line 1, plc: there is no PLC"),
            (&format!("{PLC}[nats]\nurl = 'nats://other'\n"), "line 4, nats: the section is unknown"),
        ] {
            let error = config.with_plant(stored(text)).unwrap_err().to_string();
            assert!(error.starts_with(&format!("version 7 of the plant: {fault}")), "{error}");
        }
    }

    /// Each key of a plant, and a table of tags with characters that need escapes.
    #[test]
    fn the_text_for_the_store_is_the_same_plant() {
        let folder = tempfile::tempdir().unwrap();
        let csv = "name,at,class,unit,comment,group\n\
            level,R100:f32,fast,m,\"a \"\"b\"\"\n\\ \u{e9}\u{7}\",tank\nalarm,M7,,,,\n";
        std::fs::write(folder.path().join("a b.csv"), csv).unwrap();
        let plant = "# comment\n[class]\nfast = { every = '500ms' }\nslow = { every = '10s', stale_after = '1m' }\n\
            [template.tank]\nname = { at = 'R10-R19:text', class = 'slow', heartbeat = '60s' }\n\
            low = { at = 'M1', on_change = true }\ntags = 'R77'\n\
            [plc.boiler]\nlink = 'udp://h:5?framing=binary'\nstation = 1\nuse = ['tank']\ntags = 'a b.csv'\n\
            only = ['x', 'y']\n\
            tag.own = { at = 'R5', deadband = 0.1, write = { min = -1.5, max = 1e3 }, unit = \"'\\\"\" }\n\
            tag.start = { at = 'M9', write = { pulse = '1s' } }\n\
            [bus.line1]\nlink = 'serial:/dev/ttyS0?baud=19200'\nstations = { p1 = 1, p2 = 2 }\nuse = ['tank']\n\
            host = 'x'\n\
            [sim.boiler]\nfault = 'drop=1%'\n";
        let config = read(folder.path(), &format!("{OWN}{plant}")).unwrap();
        let text = plant_text(&config.path, &Environment::default()).unwrap();
        let again = config.with_plant(stored(&text)).unwrap_or_else(|error| panic!("{error}\n{text}"));
        assert_eq!(config_hash(&again), config_hash(&config), "{text}");
        assert_eq!(config.plant.plc("boiler").unwrap().tags().count(), 7);
        assert!(!text.contains("nats") && !text.contains("a b.csv") && !text.contains("sim"), "{text}");
        for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/examples")).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "toml") {
                let config = Config::load(&path).unwrap();
                let text = plant_text(&path, &Environment::default()).unwrap();
                let Ok(again) = config.with_plant(stored(&text)) else { continue };
                assert_eq!(config_hash(&again), config_hash(&config), "{text}");
            }
        }
    }
}
