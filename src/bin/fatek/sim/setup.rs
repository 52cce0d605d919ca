//! Simulated PLCs with their memory, values, movements and faults: of the options, and of the section `sim`
//! of a plant configuration. Options have precedence.

use std::path::Path;

use fatek::backup::Backup;
use fatek::plant::PlantPlc;
use fatek::program::Program;
use fatek::sim::{Fault, FaultRate, Model, Plc};

use super::section::{self, Section};
use super::setting;
use crate::args::SimArgs;
use crate::failure::Failure;
use crate::printable::excerpt;
use crate::transfer::{shown, warn_of_unknown_fields};

/// A PLC to be simulated.
#[derive(Clone)]
pub(super) struct SimPlc<'p> {
    /// Its name in the plant, or its station number.
    pub(super) label: String,
    pub(super) station: u8,
    /// The PLC of the plant, with its tags.
    pub(super) tags: Option<&'p PlantPlc>,
}

impl<'p> SimPlc<'p> {
    pub(super) fn of_station(station: u8) -> Self {
        Self { label: station.to_string(), station, tags: None }
    }

    pub(super) fn of_plant(plc: &'p PlantPlc) -> Self {
        Self { label: plc.name().to_owned(), station: plc.station(), tags: Some(plc) }
    }
}

/// The settings of all PLCs: the options, and the sections of a plant configuration.
pub(super) struct Setup<'a> {
    args: &'a SimArgs,
    sections: Vec<Section>,
    /// The labels of all PLCs.
    labels: Vec<String>,
}

/// Splits `PLC/` from a text; only before `=`, since a value may have a slash.
fn split_plc(text: &str) -> (Option<&str>, &str) {
    let name_len = text.find('=').unwrap_or(text.len());
    match text.find('/').filter(|&at| at < name_len) {
        Some(at) => (Some(text[..at].trim()), &text[at + 1..]),
        None => (None, text),
    }
}

/// The file of `--memory` or `--program` for this PLC: the last `PLC=FILE`, else the last `FILE`.
fn file_of<'t>(texts: &'t [String], plc: &SimPlc<'_>, labels: &[String]) -> Option<&'t Path> {
    let split = |text: &'t String| match text.split_once('=') {
        Some((name, file)) if labels.iter().any(|label| label == name) => (Some(name), file),
        // The name of a file can have an equals sign.
        Some(_) | None => (None, text.as_str()),
    };
    let of_plc = |own: bool| {
        texts.iter().rev().map(split).find(|(name, _)| match name {
            Some(name) => own && *name == plc.label,
            None => !own,
        })
    };
    of_plc(true).or_else(|| of_plc(false)).map(|(_, file)| Path::new(file))
}

impl<'a> Setup<'a> {
    /// The settings of these PLCs, which are all.
    ///
    /// The PLCs in front of `/` must be among them, and settings for all PLCs be for one of them at least: a name
    /// that others lack is not for these.
    pub(super) fn new(args: &'a SimArgs, plcs: &[SimPlc<'_>], sections: Vec<Section>) -> Result<Self, Failure> {
        for (option, texts) in [("--set", &args.sets), ("--fault", &args.faults)] {
            for text in texts {
                let (Some(name), _) = split_plc(text) else { continue };
                if !plcs.iter().any(|plc| plc.label == name) {
                    const SHOWN: usize = 10;
                    let known: Vec<&str> = plcs.iter().map(|plc| plc.label.as_str()).take(SHOWN).collect();
                    let more = if plcs.len() > SHOWN { " ..." } else { "" };
                    return Err(Failure::Usage(format!(
                        "{option} {}: there is no simulated PLC `{}` (there are: {}{more})",
                        excerpt(text),
                        excerpt(name),
                        known.join(" ")
                    )));
                }
            }
        }
        let of_options = args.sets.iter().filter(|text| split_plc(text).0.is_none());
        let of_options = of_options.map(|text| (text, format!("--set {}", excerpt(text))));
        let general = sections.iter().filter(|section| section.plc == section::ALL);
        let of_file = general.flat_map(|section| &section.sets).map(|(text, place)| (text, place.clone()));
        for (text, place) in of_options.chain(of_file) {
            if !plcs.iter().any(|plc| setting::is_for(text, plc.tags)) {
                let name = text.split_once('=').map_or(text.as_str(), |(name, _)| name);
                return Err(Failure::Usage(format!(
                    "{place}: `{}` is neither a tag nor the name of a tag of a simulated PLC",
                    excerpt(name)
                )));
            }
        }
        let labels = plcs.iter().map(|plc| plc.label.clone()).collect();
        Ok(Self { args, sections, labels })
    }

    /// The PLC with its memory and its values.
    pub(super) fn plc(&self, of: &SimPlc<'_>, seed: u64) -> Result<Plc, Failure> {
        let Self { args, sections, labels } = self;
        // The section of all PLCs precedes that of this one.
        let own = |section: &&Section| section.plc == of.label && section.plc != section::ALL;
        let general = sections.iter().find(|section| section.plc == section::ALL);
        let sections: Vec<&Section> = general.into_iter().chain(sections.iter().find(own)).collect();
        let last =
            |property: fn(&Section) -> Option<&Path>| sections.iter().rev().find_map(|section| property(section));
        let memory = file_of(&args.memory, of, labels).or_else(|| last(|section| section.memory.as_deref()));
        let program = file_of(&args.program, of, labels).or_else(|| last(|section| section.program.as_deref()));

        let memory = memory.map(|path| load(path, Backup::load, Backup::unknown_fields)).transpose()?;
        let program = program.map(|path| load(path, Program::load, Program::unknown_fields)).transpose()?;
        let given = args.model.clone().or_else(|| sections.iter().rev().find_map(|section| section.model.clone()));
        let mut model = match (given, &memory, &program) {
            (Some(model), _, _) => model,
            (None, Some((_, backup)), _) => Model::of_backup(backup),
            (None, None, Some((_, program))) => {
                Model::default().statuses(program.brief_status().as_ref(), program.status())
            }
            (None, None, None) => Model::default(),
        };
        if let Some((_, program)) = &program {
            model = model.for_program(program);
        }
        model = args.last.iter().fold(model, |model, &element| model.last(element));
        if let Some(words) = args.ladder_words {
            model = model.ladder_words(words);
        }

        let plc = Plc::with_model(model);
        if let Some((path, backup)) = &memory {
            plc.write_backup(backup).map_err(|error| Failure::Usage(format!("{}: {error}", shown(path))))?;
            if backup.brief_status().is_some_and(|status| status.flags().running()) {
                plc.run();
            }
        }
        if let Some((path, program)) = &program {
            plc.set_program(program).map_err(|error| Failure::Usage(format!("{}: {error}", shown(path))))?;
        }
        if args.clock.is_some() {
            plc.set_clock(args.clock);
        }
        let apply = |text: &str, place: &str| {
            setting::apply(text, &plc, of.tags, seed).map_err(|rule| Failure::Usage(format!("{place}: {rule}")))
        };
        for section in sections {
            for (text, place) in &section.sets {
                if section.plc != section::ALL || setting::is_for(text, of.tags) {
                    apply(text, place)?;
                }
            }
        }
        for text in &args.sets {
            let (name, setting) = split_plc(text);
            let is_for = match name {
                Some(name) => name == of.label,
                None => setting::is_for(setting, of.tags),
            };
            if is_for {
                apply(setting, &format!("--set {}", excerpt(text)))?;
            }
        }
        Ok(plc)
    }

    /// The faults of a bus with these PLCs. Those of options come first, then those of one PLC, since the first
    /// of a kind applies. For each PLC, a fault replaces those of the same name behind it.
    pub(super) fn faults(&self, plcs: &[SimPlc<'_>]) -> Result<Vec<LimitedFault>, Failure> {
        let mut faults: Vec<LimitedFault> = Vec::new();
        for text in &self.args.faults {
            let (name, list) = split_plc(text);
            let rates = FaultRate::parse_list(list)
                .map_err(|error| Failure::Usage(format!("--fault {}: {error}", excerpt(text))))?;
            let limit = plcs.iter().find(|plc| name == Some(plc.label.as_str()));
            if name.is_some() && rates.iter().any(|rate| *rate.fault() == Fault::Refuse) {
                return Err(Failure::Usage(format!(
                    "--fault {}: `refuse` is of connections: it takes no PLC",
                    excerpt(text)
                )));
            }
            // One with the name of a PLC of another bus does not concern this one.
            if name.is_none() || limit.is_some() {
                faults.extend(rates.into_iter().map(|rate| limited(limit, rate)));
            }
        }
        let (general, own): (Vec<_>, Vec<_>) = self.sections.iter().partition(|section| section.plc == section::ALL);
        for section in own.into_iter().chain(general) {
            let is_general = section.plc == section::ALL;
            let earlier = faults.len();
            for rate in &section.faults {
                let is_replaced = |plc: &SimPlc<'_>| {
                    faults.iter().take(earlier).any(|(station, _, other)| {
                        other.name() == rate.name() && station.is_none_or(|station| station == plc.station)
                    })
                };
                let of_section = plcs.iter().filter(|plc| is_general || plc.label == section.plc);
                let remaining: Vec<&SimPlc<'_>> = of_section.filter(|plc| !is_replaced(plc)).collect();
                if is_general && remaining.len() == plcs.len() {
                    faults.push(limited(None, rate.clone()));
                } else {
                    faults.extend(remaining.into_iter().map(|plc| limited(Some(plc), rate.clone())));
                }
            }
        }
        Ok(faults)
    }
}

/// The station number of the only backup, if it is for all PLCs.
pub(super) fn station_of_memory(args: &SimArgs) -> Result<Option<u8>, Failure> {
    let is_for_one = |text: &str| text.split_once('=').is_some_and(|(name, _)| name.parse::<u8>().is_ok());
    match &args.memory[..] {
        [file] if !is_for_one(file) => Ok(Backup::load(Path::new(file))?.station()),
        _ => Ok(None),
    }
}

/// A fault with the station that it is limited to, and the label of that PLC.
type LimitedFault = (Option<u8>, Option<String>, FaultRate);

fn limited(limit: Option<&SimPlc<'_>>, rate: FaultRate) -> LimitedFault {
    (limit.map(|plc| plc.station), limit.map(|plc| plc.label.clone()), rate)
}

/// Loads a saved file, with its path.
fn load<'p, T>(
    path: &'p Path,
    load: impl FnOnce(&'p Path) -> Result<T, fatek::file::FileError>,
    unknown: impl FnOnce(&T) -> &[String],
) -> Result<(&'p Path, T), Failure> {
    let file = load(path)?;
    warn_of_unknown_fields(path, unknown(&file));
    Ok((path, file))
}
