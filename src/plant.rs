//! A plant: the PLCs of a configuration file with their links, stations, tags and scan classes
//! (feature `config`).
//!
//! ```toml
//! [class]
//! fast = { every = "500ms", stale_after = "3s" }
//! slow = { every = "10s" }
//!
//! [template.tank]                       # tags of several PLCs
//! level = { at = "R5:i16*0.1-40", class = "fast", unit = "%", deadband = 0.2, heartbeat = "60s" }
//! alarm = { at = "M7", class = "fast", on_change = true }
//!
//! [plc.mixer]
//! link = "tcp://192.168.2.3:500"
//! station = 1
//! use = ["tank"]
//! tag.total = { at = "DR100:u32", class = "slow" }
//! tag.setpoint = { at = "R200:f32", write = { min = 0.0, max = 80.0 } }
//! tag.start = { at = "M100", write = { pulse = "500ms" } }
//!
//! [plc.boiler]
//! link = "udp://192.168.2.9:500"
//! station = 1
//! tags = "boiler.csv"                   # a table of tags, beside this file
//!
//! [bus.line1]                           # several stations of one link
//! link = "serial:/dev/ttyUSB0?baud=19200"
//! stations = { pump1 = 1, pump2 = 2 }
//! use = ["tank"]
//! ```
//!
//! # Rules
//!
//! - Other sections are ignored: `sim` belongs to `fatek sim`, the others to other programs. Within `class`,
//!   `template`, `plc` and `bus` unknown keys are faults.
//! - Names of PLCs, buses, tags, classes and templates have 1 to 64 of the characters `A-Z a-z 0-9 _ -`. Names of
//!   PLCs are unique, those of a bus included; so are the tags of a PLC.
//! - A tag is its text, or a table with `at` and any of `class`, `unit`, `comment`, `group`, `deadband`,
//!   `heartbeat`, `on_change` and `write`. Nothing is writable by its name without `write`.
//! - Periods and times are texts such as `"500ms"`, `"1.5s"`, `"10m"`: more than 0, at most a day.
//! - `host` and `only` name the hosts of a fleet that can reach the link. A serial port belongs to its host: the same
//!   name with another `host` is another port.
//! - All faults of a file are reported, each with line and key.
//!
//! ```
//! use fatek::plant::Plant;
//!
//! let plant = Plant::from_toml("[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\ntag.level = 'R5:i16'\n")?;
//! let mixer = plant.plc("mixer").unwrap();
//! assert_eq!((mixer.station(), mixer.tag("level").unwrap().tag().to_string()), (1, "R5:i16".to_owned()));
//!
//! let error = Plant::from_toml("[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 300\n").unwrap_err();
//! assert_eq!(error.to_string(), "line 3, plc.mixer.station: 300 is not a station: 1 to 254 are");
//! # Ok::<(), fatek::plant::PlantErrors>(())
//! ```

mod error;
mod limits;
mod parse;
mod section;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

pub use self::error::{PlantError, PlantErrors, PlantFault, PlantFileError};
pub use self::limits::LimitError;
use crate::endpoint::Endpoint;
use crate::poll::{PollTag, ScanClass};
use crate::tag::Tag;
use crate::tag_table::TagTable;

/// The PLCs of a configuration; see [the module](self).
#[derive(Clone, Debug, Default)]
pub struct Plant {
    classes: Vec<PlantClass>,
    plcs: Vec<PlantPlc>,
}

/// A scan class of a [`Plant`].
#[derive(Clone, Debug, PartialEq)]
pub struct PlantClass {
    name: Arc<str>,
    every: Duration,
    stale_after: Option<Duration>,
}

/// A PLC of a [`Plant`].
#[derive(Clone, Debug)]
pub struct PlantPlc {
    name: Arc<str>,
    endpoint: Endpoint,
    station: u8,
    bus: Option<Arc<str>>,
    hosts: Vec<String>,
    tags: Vec<PlantTag>,
    line: usize,
}

/// A tag of a [`PlantPlc`].
#[derive(Clone, Debug, PartialEq)]
pub struct PlantTag {
    name: Arc<str>,
    tag: Tag,
    class: Option<Arc<str>>,
    unit: Option<Box<str>>,
    comment: Option<Box<str>>,
    group: Option<Box<str>>,
    deadband: Option<f64>,
    heartbeat: Option<Duration>,
    on_change: bool,
    write: Option<WriteRule>,
    line: usize,
}

/// The values that may be written to a [`PlantTag`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct WriteRule {
    /// The smallest number.
    pub min: Option<f64>,
    /// The largest number.
    pub max: Option<f64>,
    /// The time after which a discrete that was set on is set off again.
    pub pulse: Option<Duration>,
}

impl Plant {
    /// Parses a configuration without tables of tags in other files.
    ///
    /// # Errors
    /// [`PlantErrors`] has all faults; of faults of the syntax, the first.
    pub fn from_toml(text: &str) -> Result<Self, PlantErrors> {
        parse::parse(text, &mut |_| Err(PlantFault::NoFiles))
    }

    /// Loads a file, and the tables of tags that it names; relative paths are beside it. Blocks until the
    /// disk has read them.
    ///
    /// # Errors
    /// [`PlantFileError`], which names the file and all faults.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, PlantFileError> {
        let path = path.as_ref();
        let content = crate::file::load(path)?;
        let of_file = |errors| PlantFileError::Plant { path: path.to_owned(), errors };
        let text = std::str::from_utf8(&content).map_err(|_| of_file(PlantErrors::not_utf8()))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut load = |table: &str| TagTable::load(folder.join(table)).map_err(PlantFault::Table);
        parse::parse(text, &mut load).map_err(of_file)
    }

    /// The PLCs: first those of the sections `plc`, then those of the buses, each in the order of the file.
    pub fn plcs(&self) -> impl Iterator<Item = &PlantPlc> {
        self.plcs.iter()
    }

    /// The PLC of this name.
    #[must_use]
    pub fn plc(&self, name: &str) -> Option<&PlantPlc> {
        self.plcs.iter().find(|plc| &*plc.name == name)
    }

    /// The scan classes, in the order of the file.
    pub fn classes(&self) -> impl Iterator<Item = &PlantClass> {
        self.classes.iter()
    }

    /// The scan class of this name.
    #[must_use]
    pub fn class(&self, name: &str) -> Option<&PlantClass> {
        self.classes.iter().find(|class| &*class.name == name)
    }
}

impl PlantClass {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its period.
    #[must_use]
    pub fn every(&self) -> Duration {
        self.every
    }

    /// The age at which its values become stale, if the file has one.
    #[must_use]
    pub fn stale_after(&self) -> Option<Duration> {
        self.stale_after
    }

    /// The class for a [`Poller`](crate::Poller).
    pub fn scan_class(&self) -> ScanClass {
        let class = ScanClass::every(self.every);
        self.stale_after.map_or(class, |age| class.stale_after(age))
    }
}

impl PlantPlc {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The endpoint of its link.
    #[must_use]
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Its station number, 1 to 254.
    #[must_use]
    pub fn station(&self) -> u8 {
        self.station
    }

    /// The name of its bus, if it is part of one.
    #[must_use]
    pub fn bus(&self) -> Option<&str> {
        self.bus.as_deref()
    }

    /// The hosts of a fleet that can reach its link: `host`, or `only`. Without any, all can.
    pub fn hosts(&self) -> impl Iterator<Item = &str> {
        self.hosts.iter().map(String::as_str)
    }

    /// Its tags: those of its templates, its own, and those of its table.
    pub fn tags(&self) -> impl Iterator<Item = &PlantTag> {
        self.tags.iter()
    }

    /// The tag of this name.
    #[must_use]
    pub fn tag(&self, name: &str) -> Option<&PlantTag> {
        self.tags.iter().find(|tag| &*tag.name == name)
    }

    /// The line of the file where it begins, from 1.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }
}

impl PlantTag {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    /// The name of its scan class, which the plant has.
    #[must_use]
    pub fn class(&self) -> Option<&str> {
        self.class.as_deref()
    }

    /// The unit of its values.
    #[must_use]
    pub fn unit(&self) -> Option<&str> {
        self.unit.as_deref()
    }

    /// Its comment.
    #[must_use]
    pub fn comment(&self) -> Option<&str> {
        self.comment.as_deref()
    }

    /// The name of its group.
    #[must_use]
    pub fn group(&self) -> Option<&str> {
        self.group.as_deref()
    }

    /// The change of a number below which it is not reported: 0 or more.
    #[must_use]
    pub fn deadband(&self) -> Option<f64> {
        self.deadband
    }

    /// The time after which an unchanged value is reported all the same.
    #[must_use]
    pub fn heartbeat(&self) -> Option<Duration> {
        self.heartbeat
    }

    /// Returns whether it is reported only when it changes.
    #[must_use]
    pub fn is_on_change(&self) -> bool {
        self.on_change
    }

    /// The values that may be written; `None`: it is not writable.
    #[must_use]
    pub fn write(&self) -> Option<WriteRule> {
        self.write
    }

    /// The line where it begins, from 1; of a tag of a table, the line that names the table.
    #[must_use]
    pub fn line(&self) -> usize {
        self.line
    }

    /// The tag with its name and the rule for its samples, for a [`Poller`](crate::Poller).
    pub fn poll_tag(&self) -> PollTag {
        let mut tag = PollTag::new(self.name.clone(), self.tag).on_change(self.on_change);
        if let Some(deadband) = self.deadband {
            tag = tag.deadband(deadband);
        }
        match self.heartbeat {
            Some(heartbeat) => tag.heartbeat(heartbeat),
            None => tag,
        }
    }
}

#[cfg(test)]
mod tests;
