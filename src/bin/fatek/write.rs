//! Subcommand `fatek write TAG=VALUE…`.

use std::cell::Cell;
use std::fmt;
use std::time::Duration;

use fatek::memory_map::special_range;
use fatek::plant::PlantPlc;
use fatek::tag::{Assignment, Tag, TagValue};
use fatek::{Element, Error, Station};
use tokio::time::MissedTickBehavior;

use crate::args::WriteArgs;
use crate::failure::Failure;
use crate::output::{Output, complain};
use crate::signal::unless_signalled;

/// A write of a tag.
#[derive(Clone, Debug)]
pub(crate) struct Write {
    /// The name that the tag was given by.
    name: Option<String>,
    what: What,
}

#[derive(Clone, Debug)]
enum What {
    Values(Assignment),
    /// Of bits of a register, which is read before.
    Bits {
        tag: Tag,
        states: Vec<bool>,
    },
}

impl Write {
    /// A write of values. `name`: of the tag, if it was given by name.
    pub(crate) fn values_of(assignment: Assignment, name: Option<String>) -> Self {
        Self { name, what: What::Values(assignment) }
    }

    /// A write of bits of a register.
    pub(crate) fn bits_of(tag: Tag, states: Vec<bool>, name: Option<String>) -> Self {
        Self { name, what: What::Bits { tag, states } }
    }

    pub(crate) fn tag(&self) -> Tag {
        match &self.what {
            What::Values(assignment) => assignment.tag(),
            What::Bits { tag, .. } => *tag,
        }
    }

    /// The values as they were given.
    fn values(&self) -> Vec<TagValue> {
        match &self.what {
            What::Values(assignment) => assignment.values().to_vec(),
            What::Bits { states, .. } => states.iter().map(|&state| state.into()).collect(),
        }
    }

    /// The values as they are read back: a scaled one is rounded to a raw number.
    pub(crate) fn stored_values(&self) -> Vec<TagValue> {
        match &self.what {
            What::Values(assignment) => {
                let stored = assignment.tag().decode(&assignment.encode());
                // An assignment has values for all of its elements.
                stored.unwrap_or_else(|_| self.values())
            }
            What::Bits { .. } => self.values(),
        }
    }

    /// Writes the values. The failure says if they may have been written.
    pub(crate) async fn send(&self, station: &Station) -> Result<(), Failure> {
        let sent = match &self.what {
            What::Values(assignment) => station.write_all([assignment.clone()]).await,
            What::Bits { tag, states } => station.modify_bits(tag, states).await,
        };
        sent.map_err(|error| {
            // The error of a partial write names the values that were written.
            let in_doubt = !matches!(error, Error::PartlyWritten { .. }) && error.may_have_executed();
            let doubt = if in_doubt { " (it may have been written)" } else { "" };
            Failure::of(format_args!("{}{doubt}", self.subject()))(error)
        })
    }

    /// The value with this number in a message.
    fn label(&self, number: usize, single: &Tag) -> String {
        match &self.name {
            Some(name) if self.tag().value_count() > 1 => format!("{name}[{number}]"),
            Some(name) => name.clone(),
            None => single.to_string(),
        }
    }

    /// The tag in a message, with its name if it was given by name.
    fn subject(&self) -> String {
        self.name.as_ref().map_or_else(|| self.tag().to_string(), |name| format!("{name} ({})", self.tag()))
    }
}

impl fmt::Display for Write {
    /// The values as they are stored, and those that were given if these differ: `R5:i16*0.1=21.5 (21.47 was given)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let texts = |values: &[TagValue]| values.iter().map(ToString::to_string).collect::<Vec<String>>().join(",");
        let (given, stored) = (texts(&self.values()), texts(&self.stored_values()));
        match &self.name {
            Some(name) => write!(f, "{name}={stored}")?,
            None => write!(f, "{}={stored}", self.tag())?,
        }
        if given == stored { Ok(()) } else { write!(f, " ({given} was given)") }
    }
}

pub(crate) async fn write(
    station: &Station,
    args: &WriteArgs,
    plc: Option<&PlantPlc>,
    output: &Output,
) -> Result<(), Failure> {
    let writes = args.table.load(plc)?.writes(&args.assignments, args.modify_bits)?;
    let writes = writes.as_slice();
    let tags = || writes.iter().map(Write::tag);
    refuse_special(args.special, tags().flat_map(|tag| tag.elements()))?;
    args.model.check(station, tags()).await?;
    let (done, last) = (Cell::new(0), Cell::new(None));
    let rounds = async {
        match args.every {
            None => write_round(station, writes, args.verify, output, &done).await,
            Some(interval) => write_every(station, writes, (interval, args.verify), output, (&done, &last)).await,
        }
    };
    let ended = unless_signalled(rounds).await?;
    match (ended, args.every) {
        (Ok(ended), _) => ended,
        // Between two rounds nothing is interrupted.
        (Err(_), Some(_)) if done.get() == writes.len() => last.take().map_or(Ok(()), Err),
        (Err(signal), _) => Err(Failure::interrupted(progress(writes, done.get()))(signal)),
    }
}

/// Writes all values again and again, until a refusal or an error of the command line. `last`: the failure of
/// the last round.
async fn write_every(
    station: &Station,
    writes: &[Write],
    (interval, verify): (Duration, bool),
    output: &Output,
    (done, last): (&Cell<usize>, &Cell<Option<Failure>>),
) -> Result<(), Failure> {
    let mut rounds = tokio::time::interval(interval);
    rounds.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        rounds.tick().await;
        done.set(0);
        match write_round(station, writes, verify, output, done).await {
            Err(failure) if [2, 3].contains(&failure.exit_status()) => return Err(failure),
            Err(failure) => {
                complain(format_args!("{failure}"));
                last.set(Some(failure));
            }
            Ok(()) => last.set(None),
        }
        done.set(writes.len());
    }
}

/// Writes the values in their order, and reads each back if it is to be verified. `done`: the number of
/// assignments written.
async fn write_round(
    station: &Station,
    writes: &[Write],
    verify: bool,
    output: &Output,
    done: &Cell<usize>,
) -> Result<(), Failure> {
    let (mut differing, mut all) = (0, 0);
    for write in writes {
        send(station, write, output).await?;
        done.set(done.get() + 1);
        if !verify {
            continue;
        }
        // At once: a later write may be of the same elements.
        let tag = write.tag();
        let back = station.read(tag).await;
        let read: Vec<TagValue> = back.map_err(Failure::of(format_args!("{} (read back)", write.subject())))?;
        let written = write.stored_values();
        all += written.len();
        for ((number, single), (written, read)) in tag.singles().enumerate().zip(written.into_iter().zip(read)) {
            if !is_stored_alike(&single, &written, &read) {
                differing += 1;
                let label = write.label(number, &single);
                complain(format_args!("{label}: {written} was written, and {read} is read"));
            }
        }
    }
    if differing > 0 { Err(Failure::NotAsWritten { differing, all }) } else { Ok(()) }
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

/// Returns whether two values of a tag have the same registers.
fn is_stored_alike(tag: &Tag, one: &TagValue, other: &TagValue) -> bool {
    match (tag.encode(std::slice::from_ref(one)), tag.encode(std::slice::from_ref(other))) {
        (Ok(one), Ok(other)) => one == other,
        // Bits of a register are not encoded.
        (Err(_), _) | (_, Err(_)) => one == other,
    }
}

async fn send(station: &Station, write: &Write, output: &Output) -> Result<(), Failure> {
    write.send(station).await?;
    output.remark(format_args!("wrote {write}"));
    Ok(())
}

/// Number of values written, and the tag whose write was interrupted.
fn progress(writes: &[Write], done: usize) -> String {
    let count = |writes: &[Write]| -> usize { writes.iter().map(|write| write.tag().value_count()).sum() };
    let (written, rest) = writes.split_at(done.min(writes.len()));
    let perhaps = match rest.first().map(Write::tag) {
        Some(tag) if tag.value_count() > 1 => format!(", {tag} perhaps or in part"),
        Some(tag) => format!(", {tag} perhaps"),
        None => String::new(),
    };
    format!(": {} of {} values were written{perhaps}", count(written), count(writes))
}
