//! Subcommand `fatek read TAG…`.

mod alone;

use std::fmt;

use fatek::tag::{Tag, TagValue};
use fatek::{Element, Error, Limits, Plan};
use futures::future::join_all;

use crate::args::ReadArgs;
use crate::failure::Failure;
use crate::names::NamedTag;
use crate::output::{Cell, Output, Rows, complain};
use crate::targets::Target;

pub(crate) async fn read(targets: &[Target], args: &ReadArgs, output: &Output) -> Result<(), Failure> {
    let several = targets.len() > 1;
    // All tags are checked, and all plans made, before the first value is read.
    let mut tags = Vec::with_capacity(targets.len());
    for target in targets {
        tags.push(args.table.load(target.plc.as_ref())?.tags(&args.tags)?);
    }
    let mut reads = Vec::with_capacity(targets.len());
    for (target, tags) in targets.iter().zip(&tags) {
        let in_target = |failure: Failure| if several { failure.in_target(&target.label) } else { failure };
        let limits = limits(target, tags, args, several).await.map_err(in_target)?;
        reads.push(read_all(target, tags, limits).map_err(in_target)?);
    }
    let mut results: Vec<TagResult<'_>> = Vec::new();
    for of_target in join_all(reads).await {
        results.extend(of_target?);
    }
    let failure = failure(&results, several);
    let mut rows = rows(several);
    if failure.is_none() || !args.strict {
        results.iter().for_each(|result| result.add_to(&mut rows, several));
    }
    let Some(failure) = failure else { return output.rows(&rows) };
    if !rows.is_empty() {
        output.rows(&rows)?;
    }
    // A single tag without values has its reason in the message of the failure.
    if results.len() > 1 || !rows.is_empty() || results.iter().any(TagResult::has_end) {
        complain_of(&results, several);
    }
    Err(failure)
}

/// Prints the reasons of all missing values: of a PLC without replies, the first.
fn complain_of(results: &[TagResult<'_>], several: bool) {
    // The results of a PLC stand together.
    for of_plc in results.chunk_by(|one, other| one.plc == other.plc) {
        let mut unanswered = 0_usize;
        for result in of_plc {
            let Some(missing) = &result.missing else { continue };
            let is_refused = missing.error.error_code().is_some();
            unanswered += usize::from(!is_refused);
            if is_refused || unanswered == 1 {
                complain(format_args!("{}: {missing}", result.subject(several)));
            }
        }
        if let (Some(first), 2..) = (of_plc.first(), unanswered) {
            let plc = if several { format!("{}: ", first.plc) } else { String::new() };
            complain(format_args!("{plc}{} other tags without values for the same reason", unanswered - 1));
        }
    }
}

/// The limits of `--model`. If the status of one of several PLCs cannot be read, its tags have the reason.
async fn limits(
    target: &Target,
    tags: &[NamedTag],
    args: &ReadArgs,
    several: bool,
) -> Result<Result<Limits, Error>, Failure> {
    let checked = args.model.check(&target.station, tags.iter().map(|named| named.tag)).await;
    if let Err(Failure::Call(error)) = checked {
        return if several { Ok(Err(error)) } else { Err(Failure::Call(error)) };
    }
    checked.map(Ok)
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
    end: Option<(Element, Option<Element>)>,
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.end {
            Some((first, Some(last))) => {
                write!(f, "read up to {last}; {first} is refused, and those behind it were not tried: {}", self.error)
            }
            Some((first, None)) => write!(f, "{first} is refused: {}", self.error),
            None => write!(f, "{}", self.error),
        }
    }
}

impl TagResult<'_> {
    /// The tag in a message, with its PLC if there are several.
    fn subject(&self, several: bool) -> String {
        let tag = self.named.subject();
        if several { format!("{}: {tag}", self.plc) } else { tag }
    }

    /// Returns whether the element is known from which on the PLC refuses.
    fn has_end(&self) -> bool {
        self.missing.as_ref().is_some_and(|missing| missing.end.is_some())
    }

    fn add_to(&self, rows: &mut Rows, several: bool) {
        for (number, (single, value)) in self.named.tag.singles().zip(&self.values).enumerate() {
            let label: Cell = self.named.label(number, || elements(&single)).into();
            let (type_name, value): (Cell, Cell) = (type_name(&single).into(), value.clone().into());
            if several {
                rows.push([self.plc.into(), label, type_name, value]);
            } else {
                rows.push([label, type_name, value]);
            }
        }
    }
}

/// Reads all tags with the requests of a plan, and ranges that need several requests one by one: up to the
/// end of the memory. Tags of a refused request are read once more, each alone: another tag of the
/// request may be the reason. `limits`: those of the plan, or the reason why nothing is read.
fn read_all<'t>(
    target: &'t Target,
    tags: &'t [NamedTag],
    limits: Result<Limits, Error>,
) -> Result<impl Future<Output = Result<Vec<TagResult<'t>>, Failure>>, Failure> {
    let station = &target.station;
    let (limits, unread) = match limits {
        Ok(limits) => (limits, None),
        Err(error) => (Limits::new(), Some(error)),
    };
    let is_planned = |named: &&NamedTag| named.tag.element_count() <= alone::at_once(&named.tag);
    let builder = Plan::builder_for(station).limits(limits.within(&station.capabilities()));
    let planned = tags.iter().filter(is_planned).map(|named| named.tag);
    let plan = match planned.clone().next() {
        Some(_) => Some(builder.tags(planned).build().map_err(Failure::usage)?),
        None => None,
    };
    for named in tags.iter().filter(|named| !is_planned(named)) {
        named.tag.check_in(station.link().framing()).map_err(Failure::usage)?;
    }
    Ok(async move {
        if let Some(error) = unread {
            let missing = || Some(Missing { error: error.clone(), end: None });
            let unread = |named| TagResult { plc: &target.label, named, values: Vec::new(), missing: missing() };
            return Ok(tags.iter().map(unread).collect());
        }
        let mut readings = Vec::new();
        if let Some(plan) = &plan {
            let values = |(_, values): (_, Result<Vec<TagValue>, &Error>)| values.map_err(Clone::clone);
            readings = plan.read(station).await.iter().map(values).collect();
        }
        let mut readings = readings.into_iter();
        let mut results: Vec<TagResult<'t>> = Vec::with_capacity(tags.len());
        for named in tags {
            let reading = if is_planned(&named) { readings.next() } else { None };
            let (values, missing) = match (reading, unanswered(&results)) {
                (Some(Ok(values)), _) => (values, None),
                // A refused tag keeps its own reason.
                (Some(Err(error)), Some(_)) | (None, Some(error)) => (Vec::new(), Some(Missing { error, end: None })),
                (Some(Err(error)), None) if error.error_code().is_none() => {
                    (Vec::new(), Some(Missing { error, end: None }))
                }
                (Some(Err(_)) | None, None) => alone::read(station, &named.tag).await?,
            };
            results.push(TagResult { plc: &target.label, named, values, missing });
        }
        Ok(results)
    })
}

/// The error of a tag without a reply: further tags would wait as long.
fn unanswered(results: &[TagResult<'_>]) -> Option<Error> {
    let errors = results.iter().filter_map(|result| Some(&result.missing.as_ref()?.error));
    errors.into_iter().find(|error| error.error_code().is_none()).cloned()
}

/// The failure of the command, if values are missing: a call without a reply before refused tags.
fn failure(results: &[TagResult<'_>], several: bool) -> Option<Failure> {
    let missing = || results.iter().filter_map(|result| Some((result, result.missing.as_ref()?)));
    if let Some((result, missing)) = missing().find(|(_, missing)| missing.error.error_code().is_none()) {
        return Some(Failure::of(result.subject(several))(missing.error.clone()));
    }
    let (result, first) = missing().next()?;
    if results.len() == 1 && result.values.is_empty() && first.end.is_none() {
        return Some(Failure::of(result.subject(several))(first.error.clone()));
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
