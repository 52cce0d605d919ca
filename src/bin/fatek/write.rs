//! Subcommand `fatek write TAG=VALUE…`.

use std::cell::Cell;

use fatek::memory_map::special_range;
use fatek::tag::Assignment;
use fatek::{Element, Error, Station};

use crate::args::WriteArgs;
use crate::failure::Failure;
use crate::output::Output;
use crate::signal::unless_signalled;

pub(crate) async fn write(station: &Station, args: &WriteArgs, output: &Output) -> Result<(), Failure> {
    let assignments = args.assignments.as_slice();
    let tags = || assignments.iter().map(Assignment::tag);
    refuse_special(args.special, tags().flat_map(|tag| tag.elements()))?;
    args.model.check(station, tags()).await?;
    let done = Cell::new(0);
    let ended = unless_signalled(write_all(station, assignments, output, &done)).await?;
    ended.map_err(|signal| Failure::interrupted(progress(assignments, done.get()))(signal))?
}

/// Refuses elements of a special range, unless `--special` was given.
pub(crate) fn refuse_special(allowed: bool, mut elements: impl Iterator<Item = Element>) -> Result<(), Failure> {
    match elements.find_map(|element| Some((element, special_range(element)?))) {
        Some((element, range)) if !allowed => Err(Failure::Usage(format!(
            "{element} is special ({range}): writing it can cause system or I/O errors; to write it, give --special"
        ))),
        Some(_) | None => Ok(()),
    }
}

/// Writes the values in their order. `done`: the number of assignments written.
async fn write_all(
    station: &Station,
    assignments: &[Assignment],
    output: &Output,
    done: &Cell<usize>,
) -> Result<(), Failure> {
    for assignment in assignments {
        station.write_all([assignment.clone()]).await.map_err(|error| {
            let tag = assignment.tag();
            // The error of a partial write names the values that were written.
            let in_doubt = !matches!(error, Error::PartlyWritten { .. }) && error.may_have_executed();
            let doubt = if in_doubt { " (it may have been written)" } else { "" };
            Failure::of(format_args!("{tag}{doubt}"))(error)
        })?;
        done.set(done.get() + 1);
        output.remark(format_args!("wrote {assignment}"));
    }
    Ok(())
}

/// Number of values written, and the tag whose write was interrupted.
fn progress(assignments: &[Assignment], done: usize) -> String {
    let count = |assignments: &[Assignment]| -> usize {
        assignments.iter().map(|assignment| assignment.tag().singles().count()).sum()
    };
    let (written, rest) = assignments.split_at(done.min(assignments.len()));
    let perhaps = match rest.first().map(Assignment::tag) {
        Some(tag) if tag.singles().count() > 1 => format!(", {tag} perhaps or in part"),
        Some(tag) => format!(", {tag} perhaps"),
        None => String::new(),
    };
    format!(": {} of {} values were written{perhaps}", count(written), count(assignments))
}
