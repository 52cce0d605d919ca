//! Tags of the command line: texts, or names of a table of tags (`--tags`).

use std::ffi::OsString;

use clap::{Args, ValueHint};

use fatek::plant::{LimitError, PlantPlc, PlantTag};
use fatek::tag::{Assignment, Tag, TagValue};
use fatek::tag_table::{TagEntry, TagTable};

use crate::failure::Failure;
use crate::hint;
use crate::output::Output;
use crate::write::Write;

/// Option of the commands that take tags.
#[derive(Debug, Args)]
pub(crate) struct TableArgs {
    /// Table of tags (CSV, or TOML if the name ends in .toml), whose names stand for tags
    #[arg(long = "tags", id = "table", env = "FATEK_TAGS", hide_env_values = true, value_name = "FILE")]
    #[arg(value_hint = ValueHint::FilePath)]
    path: Option<OsString>,
}

/// The names that stand for tags: of the table of tags and of the PLC of a plant, if there are any.
#[derive(Debug)]
pub(crate) struct Table {
    table: Option<TagTable>,
    plc: Option<PlantPlc>,
}

/// A tag with the name to be printed, if it was given by name.
#[derive(Clone, Debug)]
pub(crate) struct NamedTag {
    pub(crate) tag: Tag,
    name: Option<String>,
}

impl NamedTag {
    /// Its name, if it was given by name.
    pub(crate) fn name(&self) -> Option<&str> {
        self.name.as_deref()
    }

    /// Its values, each as a tag with its label.
    pub(crate) fn singles(&self) -> impl Iterator<Item = (String, Self)> {
        let singles = self.tag.singles().enumerate();
        singles.map(|(number, tag)| (self.label(number, || tag.to_string()), Self { tag, name: self.name.clone() }))
    }

    /// The tag in a message, with its name if it was given by name.
    pub(crate) fn subject(&self) -> String {
        self.name.as_ref().map_or_else(|| self.tag.to_string(), |name| format!("{name} ({})", self.tag))
    }

    /// The text of its value with this number, and of the only one.
    pub(crate) fn label(&self, number: usize, unnamed: impl FnOnce() -> String) -> String {
        match &self.name {
            Some(name) if self.tag.value_count() > 1 => format!("{name}[{number}]"),
            Some(name) => name.clone(),
            None => unnamed(),
        }
    }
}

impl TableArgs {
    /// Loads the table, if there is one. `plc`: a PLC of a plant, whose tags have names, too.
    pub(crate) fn load(&self, plc: Option<&PlantPlc>) -> Result<Table, Failure> {
        // An empty variable counts as unset.
        let path = self.path.as_ref().filter(|path| !path.is_empty());
        Ok(Table { table: path.map(TagTable::load).transpose()?, plc: plc.cloned() })
    }
}

impl Table {
    /// The names of a PLC of a plant.
    #[cfg(test)]
    pub(crate) fn of_plc(plc: &PlantPlc) -> Self {
        Self { table: None, plc: Some(plc.clone()) }
    }

    /// The tags of these texts; without any, all tags of the table.
    pub(crate) fn tags(&self, texts: &[String]) -> Result<Vec<NamedTag>, Failure> {
        if texts.is_empty() && (self.table.is_some() || self.plc.is_some()) {
            let all = self.all();
            return if all.is_empty() { Err(Failure::Usage("there are no tags".to_owned())) } else { Ok(all) };
        }
        let named = |text: &String| {
            let tag = self.tag(text)?;
            Ok(NamedTag { tag, name: self.named(text).is_some().then(|| text.clone()) })
        };
        if texts.is_empty() {
            return Err(Failure::Usage(
                "no tag is given, and no table of tags (--tags) or PLC of a plant (@NAME)".to_owned(),
            ));
        }
        texts.iter().map(named).collect()
    }

    /// All tags of the PLC of a plant, else of the table.
    pub(crate) fn all(&self) -> Vec<NamedTag> {
        let named = |(name, tag): (&str, Tag)| NamedTag { tag, name: Some(name.to_owned()) };
        // The PLC was named on the command line, the table perhaps in the environment.
        match (&self.plc, &self.table) {
            (Some(plc), _) => plc.tags().map(|tag| named((tag.name(), tag.tag()))).collect(),
            (None, table) => {
                table.iter().flat_map(TagTable::iter).map(|entry| named((entry.name(), entry.tag()))).collect()
            }
        }
    }

    /// The writes of these texts, each a tag or a name with its values. `modify_bits`: bits of registers
    /// are taken, too.
    pub(crate) fn writes(&self, texts: &[String], modify_bits: bool) -> Result<Vec<Write>, Failure> {
        let write = |text: &String| {
            let Some((name, values)) = text.split_once('=') else {
                // An error: it has no value.
                let assignment: Assignment = text.parse().map_err(Failure::usage)?;
                return Ok(Write::values_of(assignment, None));
            };
            self.write(self.tag(name)?, name, values, modify_bits)
        };
        texts.iter().map(write).collect()
    }

    /// The write of the values of a text to a tag, which was given by this name or by its elements.
    pub(crate) fn write(&self, tag: Tag, name: &str, values: &str, modify_bits: bool) -> Result<Write, Failure> {
        let values = tag.parse_values(values).map_err(|error| match hint::with_other_type(&tag, name, values) {
            Some(other) => Failure::Usage(format!("{error}; perhaps {other}")),
            None => Failure::usage(error),
        })?;
        self.check_rule(name, &tag, &values)?;
        // Not for a part of a named tag.
        let given_name = (self.named(name) == Some(tag)).then(|| name.to_owned());
        if !tag.is_bits_of_register() {
            let assignment = Assignment::new(tag, values).map_err(Failure::usage)?;
            return Ok(Write::values_of(assignment, given_name));
        }
        if !modify_bits {
            return Err(Failure::Usage(format!(
                "{tag} is a part of {register}, and a write replaces all bits of {register}; \
                 --modify-bits reads, changes and writes them",
                register = tag.first()
            )));
        }
        let states = values.iter().map(|value| *value == TagValue::Bool(true)).collect();
        Ok(Write::bits_of(tag, states, given_name))
    }

    /// Unit and comment of the tag of a name; empty without them.
    pub(crate) fn unit_and_comment(&self, name: &str) -> (&str, &str) {
        let of_plc = self.plc.as_ref().and_then(|plc| plc.tag(name)).map(|tag| (tag.unit(), tag.comment()));
        let of_table = || self.table.as_ref()?.get(name).map(|entry| (entry.unit(), entry.comment()));
        let (unit, comment) = of_plc.or_else(of_table).unwrap_or_default();
        (unit.unwrap_or_default(), comment.unwrap_or_default())
    }

    /// Prints the tags of the table that have common elements: of all its tags, or of those that were given.
    pub(crate) fn remark_overlaps(&self, given: &[String], output: &Output) {
        let is_given = |entry: &TagEntry| given.is_empty() || given.iter().any(|name| name == entry.name());
        for overlap in self.table.iter().flat_map(TagTable::overlaps) {
            if is_given(overlap.first) || is_given(overlap.second) {
                output.remark(format_args!("{overlap}"));
            }
        }
    }

    /// The tag of a name: of the PLC of a plant, else of the table.
    fn named(&self, name: &str) -> Option<Tag> {
        let of_plc = self.plc.as_ref().and_then(|plc| plc.tag(name)).map(PlantTag::tag);
        of_plc.or_else(|| Some(self.table.as_ref()?.get(name)?.tag()))
    }

    /// Checks that a tag of a plant is writable.
    pub(crate) fn check_writable(&self, name: &str) -> Result<(), Failure> {
        match self.plc.as_ref().and_then(|plc| plc.tag(name)) {
            Some(tag) if tag.write().is_none() => Err(refused(tag, name, "is not writable: it has no `write`")),
            Some(_) | None => Ok(()),
        }
    }

    /// Checks the values of a write against the rule of a tag of a plant. `tag`: its elements that are written.
    fn check_rule(&self, name: &str, tag: &Tag, values: &[TagValue]) -> Result<(), Failure> {
        self.check_writable(name)?;
        let Some((of_plant, rule)) =
            self.plc.as_ref().and_then(|plc| plc.tag(name)).and_then(|tag| Some((tag, tag.write()?)))
        else {
            return Ok(());
        };
        rule.check(tag, values).map_err(|error| {
            // By its text, since NaN is no other NaN.
            let is_given = |value: &TagValue| values.iter().any(|given| given.to_string() == value.to_string());
            let stored = |value: &TagValue| match is_given(value) {
                true => String::new(),
                false => format!(", and {value} would be stored"),
            };
            let reason = match &error {
                LimitError::Below { value, min, .. } => format!("is at least {min}{}", stored(value)),
                LimitError::Above { value, max, .. } => format!("is at most {max}{}", stored(value)),
                other @ (LimitError::Value(_) | _) => return Failure::usage(other),
            };
            refused(of_plant, name, &reason)
        })
    }

    fn tag(&self, text: &str) -> Result<Tag, Failure> {
        match (self.named(text), &self.table, &self.plc) {
            (Some(tag), _, _) => Ok(tag),
            (None, Some(table), _) => table.tag(text).map_err(Failure::usage),
            (None, None, Some(plc)) => text
                .parse()
                .map_err(|error| Failure::Usage(format!("{error}; nor is it a name of the tags of {}", plc.name()))),
            (None, None, None) => text.parse().map_err(Failure::usage),
        }
    }
}

/// The refusal of a write by the rule of a tag of a plant.
fn refused(tag: &PlantTag, name: &str, reason: &str) -> Failure {
    Failure::Usage(format!("{name} {reason} in the plant; to write it nevertheless, name {}", tag.tag()))
}
