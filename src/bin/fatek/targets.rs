//! The PLCs of a command: of `--link` and `--station`, or of a plant configuration (`--config`, `@NAME`).

use std::collections::{HashMap, HashSet};
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, ValueHint};
use clap_complete::ArgValueCompleter;
use fatek::plant::{Plant, PlantPlc};
use fatek::{Endpoint, Link, Station};

use crate::args::Plc;
use crate::failure::Failure;
use crate::printable::excerpt;
use crate::{complete, connect};

/// Options that choose PLCs of a plant configuration.
#[derive(Debug, Args)]
#[command(next_help_heading = "Plant")]
pub(crate) struct PlantArgs {
    /// Plant configuration: PLCs with their links, stations and tags (TOML)
    #[arg(long, global = true, env = "FATEK_CONFIG", hide_env_values = true, value_name = "FILE")]
    #[arg(value_hint = ValueHint::FilePath)]
    config: Option<OsString>,
    /// PLC of the plant configuration, also written @NAME; all: each of them. Before the command
    ///
    /// It has its own link and station, and the names of its tags stand for
    /// tags. `read`, `watch` and `top` take several.
    #[arg(long = "plc", id = "plcs", value_name = "NAME", add = ArgValueCompleter::new(complete::plcs))]
    names: Vec<String>,
    /// `true` if --config is on the command line, and not in the environment alone.
    #[arg(skip)]
    pub(crate) is_given: bool,
    /// `true` if --link or --station are on the command line.
    #[arg(skip)]
    pub(crate) has_other_plc: bool,
}

/// The PLCs of a plant configuration to be simulated.
#[derive(Debug)]
pub(crate) struct SimulatedPlant {
    pub(crate) path: PathBuf,
    pub(crate) text: String,
    /// The folder of the file.
    pub(crate) folder: PathBuf,
    /// Those that were chosen.
    pub(crate) plcs: Vec<PlantPlc>,
    /// The names of all.
    pub(crate) names: Vec<String>,
}

/// The PLCs that were chosen by name.
#[derive(Debug, Default)]
pub(crate) struct Chosen(Vec<PlantPlc>);

/// A station of a command.
#[derive(Debug)]
pub(crate) struct Target {
    /// Its name, or its number.
    pub(crate) label: String,
    pub(crate) station: Station,
    /// URL of its link.
    pub(crate) url: String,
    /// Its tags, if it is one of a plant.
    pub(crate) plc: Option<PlantPlc>,
}

impl PlantArgs {
    pub(crate) fn load(&self) -> Result<Chosen, Failure> {
        if self.names.is_empty() {
            return Ok(Chosen(Vec::new()));
        }
        if self.has_other_plc {
            return Err(Failure::Usage(
                "a PLC of the plant has its own link and station: leave out --link and --station".to_owned(),
            ));
        }
        Ok(Chosen(choose(&Plant::load(self.path()?)?, self.names.iter().map(String::as_str))?))
    }

    /// The plant that `sim` simulates: the PLCs that were chosen by name, or all of a --config on the
    /// command line. `None`: the simulated PLCs are those of the options.
    pub(crate) fn simulated(&self) -> Result<Option<SimulatedPlant>, Failure> {
        if self.names.is_empty() && !self.is_given {
            return Ok(None);
        }
        let path = PathBuf::from(self.path()?);
        let plant = Plant::load(&path)?;
        let names = if self.names.is_empty() { vec!["all"] } else { self.names.iter().map(String::as_str).collect() };
        let plcs = choose(&plant, names.into_iter())?;
        let file_failure = |error| Failure::ClientConfig { path: path.clone(), error };
        let text = fs::read_to_string(&path).map_err(file_failure)?;
        let folder = fs::canonicalize(&path).map_err(file_failure)?.parent().unwrap_or(Path::new("/")).to_owned();
        let names = plant.plcs().map(|plc| plc.name().to_owned()).collect();
        Ok(Some(SimulatedPlant { path, text, folder, plcs, names }))
    }

    fn path(&self) -> Result<&OsString, Failure> {
        // An empty variable counts as unset.
        let path = self.config.as_ref().filter(|path| !path.is_empty());
        path.ok_or_else(|| Failure::Usage("no plant configuration: give --config FILE, or set FATEK_CONFIG".to_owned()))
    }
}

/// The PLCs of these names, each once.
fn choose<'n>(plant: &Plant, names: impl Iterator<Item = &'n str>) -> Result<Vec<PlantPlc>, Failure> {
    let mut chosen = Vec::new();
    for name in names {
        if name == "all" {
            chosen.extend(plant.plcs().cloned());
        } else {
            chosen.push(plant.plc(name).ok_or_else(|| Failure::Usage(unknown(name, plant)))?.clone());
        }
    }
    // A PLC may be chosen twice.
    let mut names = HashSet::new();
    chosen.retain(|plc: &PlantPlc| names.insert(plc.name().to_owned()));
    if chosen.is_empty() { Err(Failure::Usage("the plant has no PLCs".to_owned())) } else { Ok(chosen) }
}

fn unknown(name: &str, plant: &Plant) -> String {
    const SHOWN: usize = 10;
    let names: Vec<&str> = plant.plcs().map(PlantPlc::name).take(SHOWN).collect();
    let others = plant.plcs().skip(SHOWN).count();
    let more = if others > 0 { format!(" and {others} more") } else { String::new() };
    format!("the plant has no PLC `{}` (it has: {}{more})", excerpt(name), names.join(" "))
}

impl Chosen {
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The PLC for a command that takes one; `None` if none was chosen by name.
    pub(crate) fn one(&self) -> Result<Option<&PlantPlc>, Failure> {
        match &self.0[..] {
            [] => Ok(None),
            [plc] => Ok(Some(plc)),
            several => Err(Failure::Usage(format!("this command takes one PLC, not {}", several.len()))),
        }
    }

    /// Link and station of the PLC that was chosen, or those of the options.
    pub(crate) fn plc(&self, options: Plc) -> Result<Plc, Failure> {
        Ok(match self.one()? {
            None => options,
            Some(plc) => Plc {
                links: vec![plc.endpoint().to_string()],
                station: Some(plc.station().to_string()),
                capabilities: options.capabilities,
            },
        })
    }

    /// The stations of a command that takes several. Stations of one endpoint share a link. `once`: the
    /// command does not wait for a station that falls silent.
    pub(crate) fn targets(&self, options: &Plc, timeout: Option<Duration>, once: bool) -> Result<Vec<Target>, Failure> {
        if self.0.is_empty() {
            return of_options(options, timeout, once);
        }
        check_capabilities(options, self.0.len())?;
        let mut links: HashMap<String, Link> = HashMap::new();
        let mut targets = Vec::new();
        for plc in &self.0 {
            let of_link = self.0.iter().filter(|other| other.endpoint() == plc.endpoint()).count();
            let open = || link(plc.endpoint().clone(), timeout, of_link, once);
            let link = links.entry(plc.endpoint().to_string()).or_insert_with(open);
            let station = connect::with_capabilities(link.station(plc.station()).map_err(Failure::usage)?, options)?;
            let url = plc.endpoint().to_string();
            targets.push(Target { label: plc.name().to_owned(), station, url, plc: Some(plc.clone()) });
        }
        Ok(targets)
    }
}

/// One station, or a list of stations such as `1-4,9`, of each link.
fn of_options(options: &Plc, timeout: Option<Duration>, once: bool) -> Result<Vec<Target>, Failure> {
    let is_list = |text: &&String| text.contains([',', '-']);
    let numbers = match options.station.as_ref().filter(is_list) {
        Some(list) => numbers(list)?,
        None => vec![connect::number(options)?],
    };
    let mut endpoints: Vec<(&str, Endpoint)> = Vec::new();
    for url in &options.links {
        let endpoint = connect::endpoint(Some(url))?;
        if !endpoints.iter().any(|(_, other)| *other == endpoint) {
            endpoints.push((url, endpoint));
        }
    }
    if endpoints.is_empty() {
        // The usage error of a missing link.
        connect::endpoint(None)?;
    }
    let label = |url: &str, number: u8| match (endpoints.len(), numbers.len()) {
        (0 | 1, _) => number.to_string(),
        (_, 1) => url.to_owned(),
        (_, _) => format!("{number}@{url}"),
    };
    check_capabilities(options, endpoints.len().saturating_mul(numbers.len()))?;
    let mut targets = Vec::new();
    for (url, endpoint) in &endpoints {
        let link = link(endpoint.clone(), timeout, numbers.len(), once);
        for &number in &numbers {
            let station = connect::with_capabilities(link.station(number).map_err(Failure::usage)?, options)?;
            let (label, url) = (label(url, number), endpoint.to_string());
            targets.push(Target { label, station, url, plc: None });
        }
    }
    Ok(targets)
}

/// Refuses capabilities for this number of PLCs, unless it is one.
fn check_capabilities(options: &Plc, plcs: usize) -> Result<(), Failure> {
    if options.capabilities.is_some() && plcs > 1 {
        return Err(Failure::Usage(format!(
            "capabilities are those of one PLC, not of {plcs}: leave out --capabilities, and unset FATEK_CAPABILITIES"
        )));
    }
    Ok(())
}

/// Link of this number of stations. A single one that is watched is never offline: its return shows at once.
fn link(endpoint: Endpoint, timeout: Option<Duration>, stations: usize, once: bool) -> Link {
    if once || stations > 1 {
        connect::link_of_several(endpoint, timeout, stations)
    } else {
        connect::link(endpoint, connect::options(timeout), timeout)
    }
}

/// The numbers of a list of stations and ranges, each once.
pub(crate) fn numbers(list: &str) -> Result<Vec<u8>, Failure> {
    let fault = || {
        let rule = "stations are numbers from 1 to 254 and ranges, such as 1-4,9";
        Failure::Usage(format!("`{}` is not a list of stations: {rule}", excerpt(list)))
    };
    let number = |text: &str| text.trim().parse().ok().filter(|number| (1..=254_u8).contains(number));
    let mut all = Vec::new();
    for part in list.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last) = number(first).zip(number(last)).filter(|(first, last)| first <= last).ok_or_else(fault)?;
        for number in first..=last {
            if !all.contains(&number) {
                all.push(number);
            }
        }
    }
    Ok(all)
}

/// A list of stations as a text, with ranges: `stations 1-4,9`.
pub(crate) fn numbers_text(numbers: &[u8]) -> String {
    let noun = if numbers.len() == 1 { "station" } else { "stations" };
    let runs = numbers.chunk_by(|one, next| one.checked_add(1) == Some(*next));
    let run = |run: &[u8]| match run {
        [first, .., last] => format!("{first}-{last}"),
        others => others.iter().map(u8::to_string).collect(),
    };
    format!("{noun} {}", runs.map(run).collect::<Vec<_>>().join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_of_stations_have_numbers_and_ranges() {
        assert_eq!(numbers("1-4,9").unwrap(), [1, 2, 3, 4, 9]);
        assert_eq!(numbers("7, 1-2").unwrap(), [7, 1, 2]);
        assert_eq!(numbers("1-3,2-4,1").unwrap(), [1, 2, 3, 4], "each once");
        for text in ["stations 1-4,9", "stations 7,1-2", "station 254"] {
            let (_, list) = text.split_once(' ').unwrap();
            assert_eq!(numbers_text(&numbers(list).unwrap()), text);
        }
        for text in ["", "0-3", "4-1", "1,,2", "255", "1-", "a-b", "1-2-3"] {
            assert!(numbers(text).is_err(), "{text}");
        }
    }
}
