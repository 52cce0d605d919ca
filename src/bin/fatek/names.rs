//! Tags of the command line: texts, or names of a table of tags (`--tags`).

use std::ffi::OsString;

use clap::Args;
use fatek::tag::{Tag, TagValue};
use fatek::tag_table::TagTable;

use crate::failure::Failure;
use crate::output::Output;
use crate::write::Write;

/// Option of the commands that take tags.
#[derive(Debug, Args)]
pub(crate) struct TableArgs {
    /// Table of tags (CSV, or TOML if the name ends in .toml), whose names stand for tags
    #[arg(long = "tags", id = "table", env = "FATEK_TAGS", hide_env_values = true, value_name = "FILE")]
    path: Option<OsString>,
}

/// A tag with the name to be printed, if it was given by name.
#[derive(Clone, Debug)]
pub(crate) struct NamedTag {
    pub(crate) tag: Tag,
    name: Option<String>,
}

impl NamedTag {
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
    /// The tags of these texts; without any, all tags of the table.
    pub(crate) fn tags(&self, texts: &[String]) -> Result<Vec<NamedTag>, Failure> {
        let table = self.load()?;
        if let (Some(table), true) = (&table, texts.is_empty()) {
            let named =
                |entry: &fatek::tag_table::TagEntry| NamedTag { tag: entry.tag(), name: Some(entry.name().to_owned()) };
            let all: Vec<NamedTag> = table.iter().map(named).collect();
            return if all.is_empty() { Err(Failure::Usage("the table has no tags".to_owned())) } else { Ok(all) };
        }
        let named = |text: &String| {
            let tag = tag(table.as_ref(), text)?;
            let is_name = table.as_ref().is_some_and(|table| table.get(text).is_some());
            Ok(NamedTag { tag, name: is_name.then(|| text.clone()) })
        };
        if texts.is_empty() {
            return Err(Failure::Usage("no tag is given, and no table of tags".to_owned()));
        }
        texts.iter().map(named).collect()
    }

    /// The writes of these texts, each a tag or a name with its values. `modify_bits`: bits of registers
    /// are taken, too.
    pub(crate) fn writes(&self, texts: &[String], modify_bits: bool) -> Result<Vec<Write>, Failure> {
        let table = self.load()?;
        let write = |text: &String| {
            let Some((name, values)) = text.split_once('=') else {
                return text.parse().map(Write::Values).map_err(Failure::usage);
            };
            let tag = tag(table.as_ref(), name)?;
            if tag.is_bits_of_register() {
                let values = tag.parse_values(values).map_err(Failure::usage)?;
                let states = values.iter().map(|value| *value == TagValue::Bool(true)).collect();
                return if modify_bits {
                    Ok(Write::Bits { tag, states })
                } else {
                    Err(Failure::Usage(format!(
                        "{tag} is a part of {register}, and a write replaces all bits of {register}; \
                         --modify-bits reads, changes and writes them",
                        register = tag.first()
                    )))
                };
            }
            format!("{tag}={values}").parse().map(Write::Values).map_err(Failure::usage)
        };
        texts.iter().map(write).collect()
    }

    /// Prints the tags of the table that have common elements.
    pub(crate) fn remark_overlaps(&self, output: &Output) -> Result<(), Failure> {
        if let Some(table) = self.load()? {
            table.overlaps().iter().for_each(|overlap| output.remark(format_args!("{overlap}")));
        }
        Ok(())
    }

    fn load(&self) -> Result<Option<TagTable>, Failure> {
        // An empty variable counts as unset.
        let path = self.path.as_ref().filter(|path| !path.is_empty());
        Ok(path.map(TagTable::load).transpose()?)
    }
}

fn tag(table: Option<&TagTable>, text: &str) -> Result<Tag, Failure> {
    match table {
        Some(table) => table.tag(text).map_err(Failure::usage),
        None => text.parse().map_err(Failure::usage),
    }
}
