//! Import of tables of tags: CSV or TOML in, sections of a configuration out.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use fatek::Endpoint;
use fatek::plant::{Plant, PlantErrors};
use fatek::tag_table::{TableFileError, TagEntry, TagTable};
use toml::Value;

use crate::config::{Name, Period};
use crate::printable::excerpt;

/// The section that takes the tags.
#[derive(Clone, Debug)]
pub enum Target {
    /// A PLC.
    Plc {
        /// Its name.
        name: Name,
        /// Its link.
        link: Endpoint,
        /// Its station.
        station: u8,
    },
    /// A template, for several PLCs.
    Template {
        /// Its name.
        name: Name,
    },
}

/// Tables that cannot be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// A table cannot be loaded. It displays all faults with line and column.
    #[error(transparent)]
    Table(#[from] TableFileError),
    /// Two tables have a tag of one name.
    #[error("{}: line {line}, name: `{name}` is in line {first_line} of {} already", shown(file), shown(first_file))]
    DoubleName {
        /// The second table.
        file: PathBuf,
        /// The line of the second tag.
        line: usize,
        /// The name.
        name: String,
        /// The first table.
        first_file: PathBuf,
        /// The line of the first tag.
        first_line: usize,
    },
    /// A class was given a period, and no tag has it.
    #[error("--class {0}: no tag has this class")]
    UnusedClass(Name),
    /// The sections have a fault.
    #[error("{0}")]
    Plant(PlantErrors),
}

/// Sections of a configuration.
#[derive(Clone, Debug)]
pub struct Imported {
    /// The text, TOML.
    pub text: String,
    /// The number of tags.
    pub tags: usize,
    /// The classes without a period of their own, which have the default.
    pub assumed_classes: Vec<String>,
}

/// The period of classes that were given none.
pub const DEFAULT_PERIOD: Duration = Duration::from_secs(1);

/// Imports tables. `classes`: periods of the classes that the tables name. Blocks until the disk has read
/// them.
///
/// # Errors
/// [`ImportError`], which names the table and its faults.
pub fn import(tables: &[PathBuf], target: &Target, classes: &[(Name, Period)]) -> Result<Imported, ImportError> {
    let loaded = tables.iter().map(|path| Ok((path.as_path(), TagTable::load(path)?)));
    let loaded = loaded.collect::<Result<Vec<_>, TableFileError>>()?;
    let tags: Vec<(&Path, &TagEntry)> =
        loaded.iter().flat_map(|(path, table)| table.iter().map(move |tag| (*path, tag))).collect();
    let mut names: HashMap<&str, (&Path, &TagEntry)> = HashMap::new();
    for (path, tag) in &tags {
        if let Some((first_path, first)) = names.insert(tag.name(), (path, tag)) {
            return Err(ImportError::DoubleName {
                file: path.to_path_buf(),
                line: tag.line(),
                name: tag.name().to_owned(),
                first_file: first_path.to_path_buf(),
                first_line: first.line(),
            });
        }
    }
    let (section, assumed_classes) = class_section(&tags, classes)?;
    let mut text = String::new();
    for (path, table) in &loaded {
        // Writing to a string does not fail.
        let _ = writeln!(text, "# {} tags of {}", table.len(), shown(path));
    }
    text.push_str(&section);
    let prefix = match target {
        Target::Plc { name, link, station } => {
            let _ = writeln!(text, "\n[plc.{name}]\nlink = {}\nstation = {station}", quoted(&link.to_string()));
            "tag."
        }
        Target::Template { name } => {
            let _ = writeln!(text, "\n[template.{name}]");
            ""
        }
    };
    for (_, tag) in &tags {
        let _ = writeln!(text, "{prefix}{} = {}", tag.name(), toml_of(tag));
    }
    Plant::from_toml(&text).map_err(ImportError::Plant)?;
    Ok(Imported { text, tags: tags.len(), assumed_classes })
}

/// The section of the classes, and the names of those with the default period.
fn class_section(
    tags: &[(&Path, &TagEntry)],
    classes: &[(Name, Period)],
) -> Result<(String, Vec<String>), ImportError> {
    let mut used: Vec<&str> = Vec::new();
    for class in tags.iter().filter_map(|(_, tag)| tag.class()) {
        if !used.contains(&class) {
            used.push(class);
        }
    }
    if let Some((name, _)) = classes.iter().find(|(name, _)| !used.contains(&name.as_str())) {
        return Err(ImportError::UnusedClass(name.clone()));
    }
    let (mut section, mut assumed) = (String::new(), Vec::new());
    if !used.is_empty() {
        section.push_str("\n[class]\n");
    }
    for class in used {
        // The last one of a name counts, as with other options.
        let given = classes.iter().rev().find(|(name, _)| name.as_str() == class).map(|(_, period)| *period);
        if given.is_none() {
            assumed.push(class.to_owned());
        }
        let _ = writeln!(section, "{class} = {{ every = \"{}\" }}", given.unwrap_or(Period(DEFAULT_PERIOD)));
    }
    Ok((section, assumed))
}

/// The tag as a value of TOML: its text, or a table.
pub(crate) fn toml_of(tag: &TagEntry) -> String {
    let at = quoted(&tag.tag().to_string());
    let texts = [("class", tag.class()), ("unit", tag.unit()), ("comment", tag.comment()), ("group", tag.group())];
    let keys: Vec<String> =
        texts.iter().filter_map(|(key, text)| Some(format!("{key} = {}", quoted((*text)?)))).collect();
    if keys.is_empty() { at } else { format!("{{ at = {at}, {} }}", keys.join(", ")) }
}

/// A text as TOML, with escapes, on one line.
fn quoted(text: &str) -> String {
    let quoted = Value::String(text.to_owned()).to_string();
    // Texts with line feeds or quotes have other forms, which take several lines.
    let is_basic = quoted.starts_with('"') && !quoted.starts_with("\"\"\"") || quoted == "\"\"";
    if is_basic { quoted } else { serde_json::Value::from(text).to_string() }
}

fn shown(path: &Path) -> String {
    excerpt(&path.to_string_lossy()).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(folder: &Path, name: &str, text: &str) -> PathBuf {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    fn name(text: &str) -> Name {
        Name::parse(text).unwrap()
    }

    fn mixer() -> Target {
        Target::Plc { name: name("mixer"), link: "tcp://192.168.2.3".parse().unwrap(), station: 2 }
    }

    #[test]
    fn tables_give_the_tags_of_a_plc() {
        let folder = tempfile::tempdir().unwrap();
        let csv = "name;at;class;unit;comment\nlevel;R5:i16*0.1;fast;%;\"a \"\"b\"\"\u{7}\n\\ é\"\nalarm;M7;;;\n";
        let tables = [
            table(folder.path(), "a.csv", csv),
            table(folder.path(), "b.toml", "total = { at = 'DR10:u32', class = 'slow', group = 'sums' }\n"),
        ];
        let fast = (name("fast"), Period(Duration::from_millis(500)));
        let imported = import(&tables, &mixer(), &[fast]).unwrap();
        assert_eq!((imported.tags, imported.assumed_classes), (3, vec!["slow".to_owned()]));
        let plant = Plant::from_toml(&imported.text).unwrap();
        let plc = plant.plc("mixer").unwrap();
        assert_eq!((plc.endpoint().to_string().as_str(), plc.station()), ("tcp://192.168.2.3:500", 2));
        let level = plc.tag("level").unwrap();
        assert_eq!((level.tag().to_string().as_str(), level.unit()), ("R5:i16*0.1", Some("%")));
        assert_eq!(level.comment(), Some("a \"b\"\u{7}\n\\ é"));
        assert_eq!(plc.tag("total").unwrap().group(), Some("sums"));
        let periods: Vec<_> = plant.classes().map(|class| (class.name(), class.every())).collect();
        assert_eq!(periods, [("fast", Duration::from_millis(500)), ("slow", DEFAULT_PERIOD)]);
        // One line for each tag.
        assert_eq!(imported.text.lines().filter(|line| line.starts_with("tag.")).count(), 3);
    }

    #[test]
    fn a_template_has_the_tags_alone() {
        let folder = tempfile::tempdir().unwrap();
        let tables = [table(folder.path(), "a.csv", "name,at\nlevel,R5\n")];
        let imported = import(&tables, &Target::Template { name: name("tank") }, &[]).unwrap();
        assert!(imported.text.ends_with("\n\n[template.tank]\nlevel = \"R5\"\n"), "{}", imported.text);
        assert!(!imported.text.contains("[class]"));
    }

    #[test]
    fn faults_name_the_table_the_line_and_the_column() {
        let folder = tempfile::tempdir().unwrap();
        let good = table(folder.path(), "a.csv", "name,at\nlevel,R5\n");
        let again = table(folder.path(), "b.csv", "name,at\nx,R6\nlevel,R7\n");
        let bad = table(folder.path(), "c.csv", "name,at\na b,R6\nx,R99999\n");
        let error = |tables: &[&PathBuf], classes: &[(Name, Period)]| {
            let tables: Vec<PathBuf> = tables.iter().map(|path| (*path).clone()).collect();
            import(&tables, &mixer(), classes).unwrap_err().to_string()
        };
        let text = error(&[&good, &again], &[]);
        assert!(
            text.contains("b.csv: line 3, name: `level` is in line 2 of ") && text.ends_with("a.csv already"),
            "{text}"
        );
        let text = error(&[&bad], &[]);
        assert!(text.contains("c.csv: line 2, name: `a b` is not a name") && text.contains("line 3, at: "), "{text}");
        let text = error(&[&good], &[(name("fast"), Period(DEFAULT_PERIOD))]);
        assert_eq!(text, "--class fast: no tag has this class");
    }
}
