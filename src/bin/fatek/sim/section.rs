//! The section `sim` of a plant configuration: memory, values, movements and faults of its PLCs.

use std::path::{Path, PathBuf};

use fatek::sim::{Fault, FaultRate, Model};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::args::sim_model;
use crate::failure::Failure;
use crate::printable::excerpt;
use crate::transfer::shown;

/// Settings of one PLC, or of all (`all`).
#[derive(Debug)]
pub(super) struct Section {
    /// The name of the PLC.
    pub(super) plc: String,
    pub(super) model: Option<Model>,
    pub(super) memory: Option<PathBuf>,
    pub(super) program: Option<PathBuf>,
    /// Settings as of `--set`, each with its place in the file.
    pub(super) sets: Vec<(String, String)>,
    pub(super) faults: Vec<FaultRate>,
}

/// The name of the section for all PLCs.
pub(super) const ALL: &str = "all";

const KEYS: &str = "model memory program set fault";

/// The sections of a configuration whose syntax has been checked. `is_plc`: the names of its PLCs.
pub(super) fn sections(path: &Path, text: &str, is_plc: impl Fn(&str) -> bool) -> Result<Vec<Section>, Failure> {
    let file = File { path, text };
    let table =
        DeTable::parse(text).map_err(|error| Failure::Usage(format!("{}: {}", shown(path), error.message())))?;
    let Some((key, value)) = table.get_ref().iter().find(|(key, _)| key.get_ref() == "sim") else {
        return Ok(Vec::new());
    };
    let mut sections = Vec::new();
    for (name, value) in file.entries("sim", key, value)? {
        let plc: &str = name.get_ref();
        let key = format!("sim.{plc}");
        if plc != ALL && !is_plc(plc) {
            return Err(file.fault(name, &key, "the plant has no PLC of this name, which is not `all` either"));
        }
        sections.push(file.section(plc, &key, name, value)?);
    }
    Ok(sections)
}

type Key<'t> = Spanned<std::borrow::Cow<'t, str>>;
type Value<'t> = Spanned<DeValue<'t>>;

/// The text of a configuration, for the places of faults.
struct File<'t> {
    path: &'t Path,
    text: &'t str,
}

impl File<'_> {
    fn section(&self, plc: &str, path: &str, name: &Key<'_>, value: &Value<'_>) -> Result<Section, Failure> {
        let mut section = Section {
            plc: plc.to_owned(),
            model: None,
            memory: None,
            program: None,
            sets: Vec::new(),
            faults: Vec::new(),
        };
        let beside = |file: String| self.path.parent().unwrap_or(Path::new("")).join(file);
        for (key, value) in self.entries(path, name, value)? {
            let full = format!("{path}.{}", key.get_ref());
            let fault = |rule: &dyn std::fmt::Display| self.fault(key, &full, rule);
            match &**key.get_ref() {
                "model" => section.model = Some(sim_model(&self.text(&full, key, value)?).map_err(|e| fault(&e))?),
                "memory" => section.memory = Some(beside(self.text(&full, key, value)?)),
                "program" => section.program = Some(beside(self.text(&full, key, value)?)),
                "fault" => {
                    section.faults = FaultRate::parse_list(&self.text(&full, key, value)?).map_err(|e| fault(&e))?;
                    if plc != ALL && section.faults.iter().any(|rate| *rate.fault() == Fault::Refuse) {
                        return Err(fault(&"`refuse` is of connections: it takes no PLC"));
                    }
                }
                "set" => {
                    for (tag, value) in self.entries(&full, key, value)? {
                        let full = format!("{full}.{}", tag.get_ref());
                        let value = self.text(&full, tag, value)?;
                        section.sets.push((format!("{}={value}", tag.get_ref()), self.place(tag, &full)));
                    }
                }
                _ => return Err(fault(&format_args!("the key is unknown (known: {KEYS})"))),
            }
        }
        Ok(section)
    }

    /// The entries of a table, in the order of the file.
    fn entries<'t>(
        &self,
        path: &str,
        key: &Key<'_>,
        value: &'t Value<'t>,
    ) -> Result<Vec<(&'t Key<'t>, &'t Value<'t>)>, Failure> {
        let table = value.get_ref().as_table().ok_or_else(|| self.fault(key, path, "a table is expected"))?;
        let mut entries: Vec<_> = table.iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);
        Ok(entries)
    }

    /// The text of a text, a number or a truth value.
    fn text(&self, path: &str, key: &Key<'_>, value: &Value<'_>) -> Result<String, Failure> {
        match value.get_ref() {
            DeValue::String(text) => Ok(text.to_string()),
            DeValue::Integer(number) if number.radix() == 10 => Ok(number.as_str().to_owned()),
            DeValue::Float(number) => Ok(number.as_str().to_owned()),
            DeValue::Boolean(on) => Ok(on.to_string()),
            DeValue::Integer(_) | DeValue::Datetime(_) | DeValue::Array(_) | DeValue::Table(_) => {
                Err(self.fault(key, path, "a text, a decimal number, or true or false is expected"))
            }
        }
    }

    fn fault(&self, key: &Key<'_>, path: &str, rule: impl std::fmt::Display) -> Failure {
        Failure::Usage(format!("{}: {rule}", self.place(key, path)))
    }

    fn place(&self, key: &Key<'_>, path: &str) -> String {
        let before = self.text.as_bytes().iter().take(key.span().start);
        let line = before.filter(|byte| **byte == b'\n').count() + 1;
        format!("{}: line {line}, {}", shown(self.path), excerpt(path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Vec<Section>, String> {
        sections(Path::new("plant.toml"), text, |name| name == "mixer").map_err(|failure| failure.to_string())
    }

    #[test]
    fn sections_have_settings_of_one_plc_or_of_all() {
        let text = "[bridge]\nx = 1\n[sim.all]\nfault = 'drop=1%'\n[sim.mixer]\nmodel = 'largest'\n\
                    memory = 'a.backup'\nprogram = '/b.program'\nset.level = 'ramp(0..1,1s)'\n\
                    set.'R0-R1' = '1,2'\nset.R5 = 7\nset.M0 = true\n";
        let sections = parse(text).unwrap();
        let [all, mixer] = &sections[..] else { panic!("{sections:?}") };
        assert_eq!((all.plc.as_str(), all.faults.len()), ("all", 1));
        assert_eq!((mixer.plc.as_str(), mixer.model.as_ref()), ("mixer", Some(&Model::largest())));
        assert_eq!(mixer.memory.as_deref(), Some(Path::new("a.backup")));
        assert_eq!(mixer.program.as_deref(), Some(Path::new("/b.program")));
        let sets: Vec<&str> = mixer.sets.iter().map(|(text, _)| text.as_str()).collect();
        assert_eq!(sets, ["level=ramp(0..1,1s)", "R0-R1=1,2", "R5=7", "M0=true"]);
        assert_eq!(mixer.sets[0].1, "plant.toml: line 9, sim.mixer.set.level");
        assert!(parse("[plc.mixer]\n").unwrap().is_empty());
    }

    #[test]
    fn faults_have_line_and_key() {
        for (text, fault) in [
            ("sim = 1", "line 1, sim: a table is expected"),
            ("[sim]\nmixer = 1", "line 2, sim.mixer: a table is expected"),
            ("\n[sim.x]\n", "line 2, sim.x: the plant has no PLC of this name"),
            ("[sim.mixer]\nmodle = 'x'", "line 2, sim.mixer.modle: the key is unknown (known: model memory"),
            ("[sim.mixer]\nmodel = 'x'", "line 2, sim.mixer.model: `x` is not a known model"),
            ("[sim.mixer]\nfault = 'drop'", "line 2, sim.mixer.fault: `drop` is not a fault: "),
            ("[sim.mixer]\nfault = 'refuse=1%'", "line 2, sim.mixer.fault: `refuse` is of connections: "),
            ("[sim.mixer]\nset.R0 = []", "line 2, sim.mixer.set.R0: a text, a decimal number, or true or false"),
            ("[sim.mixer]\nset.R0 = 0x10", "line 2, sim.mixer.set.R0: a text, a decimal number, or true or false"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.starts_with(&format!("plant.toml: {fault}")), "{error}");
        }
    }
}
