//! Subcommand `fatek read TAG…`.

mod alone;

use std::fmt;

use fatek::tag::{Tag, TagValue};
use fatek::{Element, Error, Limits, Plan, Station};

use crate::args::ReadArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::{Output, Rows, complain};

pub(crate) async fn read(station: &Station, args: &ReadArgs, output: &Output) -> Result<(), Failure> {
    let tags = args.table.load()?.tags(&args.tags)?;
    let limits = args.model.check(station, tags.iter().map(|named| named.tag)).await?;
    let results = read_all(station, &tags, limits).await?;
    let failure = failure(&results);
    let mut rows = Rows::new(["tag", "type", "value"]);
    if failure.is_none() || !args.strict {
        results.iter().for_each(|(named, result)| add_rows(&mut rows, named, &result.values));
    }
    let Some(failure) = failure else { return output.rows(&rows) };
    if !rows.is_empty() {
        output.rows(&rows)?;
    }
    // A single tag without values has its reason in the message of the failure.
    if results.len() > 1 || !rows.is_empty() {
        for (named, result) in &results {
            if let Some(missing) = &result.missing {
                complain(format_args!("{}: {missing}", named.tag));
            }
        }
    }
    Err(failure)
}

/// Values of a tag from the first on, and why others are missing.
struct TagResult {
    values: Vec<TagValue>,
    missing: Option<Missing>,
}

/// Why values of a tag are missing.
struct Missing {
    error: Error,
    /// The first element that the PLC refuses, and the last one before it.
    end: Option<(Element, Element)>,
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.end {
            Some((first, last)) => write!(f, "read up to {last}; {first} is refused: {}", self.error),
            None => write!(f, "{}", self.error),
        }
    }
}

/// Reads all tags with the requests of a plan. Tags of a refused request are read once more, each alone:
/// another tag of the request may be the reason.
async fn read_all<'t>(
    station: &Station,
    tags: &'t [NamedTag],
    limits: Limits,
) -> Result<Vec<(&'t NamedTag, TagResult)>, Failure> {
    let builder = Plan::builder_for(station).limits(limits.within(&station.capabilities()));
    let plan = builder.tags(tags.iter().map(|named| named.tag)).build().map_err(Failure::usage)?;
    let readings = plan.read(station).await;
    let mut results = Vec::with_capacity(tags.len());
    for (named, (tag, values)) in tags.iter().zip(readings.iter()) {
        let result = match values {
            Ok(values) => TagResult { values, missing: None },
            Err(error) if error.error_code().is_some() => alone::read(station, &tag).await?,
            Err(error) => TagResult { values: Vec::new(), missing: Some(Missing { error: error.clone(), end: None }) },
        };
        results.push((named, result));
    }
    Ok(results)
}

/// The failure of the command, if values are missing: a call without a reply before refused tags.
fn failure(results: &[(&NamedTag, TagResult)]) -> Option<Failure> {
    let missing = || results.iter().filter_map(|(named, result)| Some((named, result, result.missing.as_ref()?)));
    if let Some((named, _, missing)) = missing().find(|(_, _, missing)| missing.error.error_code().is_none()) {
        return Some(Failure::of(named.tag)(missing.error.clone()));
    }
    let (named, result, first) = missing().next()?;
    if results.len() == 1 && result.values.is_empty() {
        return Some(Failure::of(named.tag)(first.error.clone()));
    }
    Some(Failure::RefusedTags { refused: missing().count(), all: results.len() })
}

fn add_rows(rows: &mut Rows, named: &NamedTag, values: &[TagValue]) {
    for (number, (single, value)) in named.tag.singles().zip(values).enumerate() {
        let label = named.label(number, || elements(&single));
        rows.push([label.into(), type_name(&single).into(), value.clone().into()]);
    }
}

/// Elements of a tag, without its type.
pub(crate) fn elements(tag: &Tag) -> String {
    let text = tag.to_string();
    text.split_once(':').map_or(text.clone(), |(elements, _)| elements.to_owned())
}

pub(crate) fn type_name(tag: &Tag) -> String {
    let name = tag.tag_type();
    tag.scale().map_or_else(|| name.to_string(), |scale| format!("{name}{scale}"))
}
