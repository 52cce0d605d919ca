//! Subcommand `fatek read TAG…`.

mod alone;

use std::fmt;

use fatek::tag::{Tag, TagValue};
use fatek::{Element, Error, Plan};
use futures::future::join_all;

use crate::args::ReadArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::{Cell, Output, Rows, complain};
use crate::targets::Target;

pub(crate) async fn read(targets: &[Target], args: &ReadArgs, output: &Output) -> Result<(), Failure> {
    // All tags are checked before the first request.
    let mut tags = Vec::with_capacity(targets.len());
    for target in targets {
        tags.push(args.table.load(target.plc.as_ref())?.tags(&args.tags)?);
    }
    let reads = targets.iter().zip(&tags).map(|(target, tags)| read_all(target, tags, args));
    let mut results = Vec::new();
    for of_target in join_all(reads).await {
        results.extend(of_target?);
    }
    let failure = failure(&results);
    let mut rows = rows(targets.len() > 1);
    if failure.is_none() || !args.strict {
        results.iter().for_each(|result| result.add_to(&mut rows));
    }
    let Some(failure) = failure else { return output.rows(&rows) };
    if !rows.is_empty() {
        output.rows(&rows)?;
    }
    // A single tag without values has its reason in the message of the failure.
    if results.len() > 1 || !rows.is_empty() {
        for result in &results {
            if let Some(missing) = &result.missing {
                complain(format_args!("{}: {missing}", result.subject(targets.len() > 1)));
            }
        }
    }
    Err(failure)
}

/// The rows of one PLC, or of several.
fn rows(several: bool) -> Rows {
    if several { Rows::new(["plc", "tag", "type", "value"]) } else { Rows::new(["tag", "type", "value"]) }
}

/// Values of a tag from the first on, and why others are missing.
struct TagResult<'t> {
    plc: &'t str,
    named: &'t NamedTag,
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

impl TagResult<'_> {
    /// The tag in a message, with its PLC if there are several.
    fn subject(&self, several: bool) -> String {
        if several { format!("{}: {}", self.plc, self.named.tag) } else { self.named.tag.to_string() }
    }

    fn add_to(&self, rows: &mut Rows) {
        for (number, (single, value)) in self.named.tag.singles().zip(&self.values).enumerate() {
            let label: Cell = self.named.label(number, || elements(&single)).into();
            let (type_name, value): (Cell, Cell) = (type_name(&single).into(), value.clone().into());
            match rows.columns() {
                4 => rows.push([self.plc.into(), label, type_name, value]),
                _ => rows.push([label, type_name, value]),
            }
        }
    }
}

/// Reads all tags with the requests of a plan. Tags of a refused request are read once more, each alone:
/// another tag of the request may be the reason.
async fn read_all<'t>(
    target: &'t Target,
    tags: &'t [NamedTag],
    args: &ReadArgs,
) -> Result<Vec<TagResult<'t>>, Failure> {
    let station = &target.station;
    let limits = args.model.check(station, tags.iter().map(|named| named.tag)).await?;
    let builder = Plan::builder_for(station).limits(limits.within(&station.capabilities()));
    let plan = builder.tags(tags.iter().map(|named| named.tag)).build().map_err(Failure::usage)?;
    let readings = plan.read(station).await;
    let mut results = Vec::with_capacity(tags.len());
    for (named, (tag, values)) in tags.iter().zip(readings.iter()) {
        let (values, missing) = match values {
            Ok(values) => (values, None),
            Err(error) if error.error_code().is_some() => alone::read(station, &tag).await?,
            Err(error) => (Vec::new(), Some(Missing { error: error.clone(), end: None })),
        };
        results.push(TagResult { plc: &target.label, named, values, missing });
    }
    Ok(results)
}

/// The failure of the command, if values are missing: a call without a reply before refused tags.
fn failure(results: &[TagResult<'_>]) -> Option<Failure> {
    let missing = || results.iter().filter_map(|result| Some((result, result.missing.as_ref()?)));
    let several = results.iter().any(|result| result.plc != results.first().map_or("", |first| first.plc));
    if let Some((result, missing)) = missing().find(|(_, missing)| missing.error.error_code().is_none()) {
        return Some(Failure::of(result.subject(several))(missing.error.clone()));
    }
    let (result, first) = missing().next()?;
    if results.len() == 1 && result.values.is_empty() {
        return Some(Failure::of(result.named.tag)(first.error.clone()));
    }
    Some(Failure::RefusedTags { refused: missing().count(), all: results.len() })
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
