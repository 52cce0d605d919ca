//! Subcommand `fatek write TAG=VALUE…`.

use fatek::tag::Assignment;
use fatek::{Element, Error, Station, Value};

use crate::failure::Failure;
use crate::output::Output;

pub(crate) async fn write(station: &Station, assignments: &[Assignment], output: &Output) -> Result<(), Failure> {
    for assignment in assignments {
        send(station, assignment).await.map_err(|error| {
            let tag = assignment.tag();
            // The error of a partial write names the elements that were written.
            let in_doubt = !matches!(error, Error::PartlyWritten { .. }) && error.may_have_executed();
            let doubt = if in_doubt { " (it may have been written)" } else { "" };
            Failure::of(format_args!("{tag}{doubt}"))(error)
        })?;
        output.remark(format_args!("wrote {assignment}"));
    }
    Ok(())
}

/// Writes the elements of a tag.
async fn send(station: &Station, assignment: &Assignment) -> Result<(), Error> {
    let (tag, raw) = (assignment.tag(), assignment.encode());
    match tag.first() {
        Element::Discrete(first) => station.write_discretes(first, &bits(&raw)).await,
        Element::Register(first) => station.write_registers(first, &words(&raw)).await,
        Element::Register32(first) => station.write_registers32(first, &dwords(&raw)).await,
    }
}

// Invariant: the raw values of an assignment are as wide as its elements, so no value is filtered
// out.

fn bits(values: &[Value]) -> Vec<bool> {
    values.iter().filter_map(|value| if let Value::Bit(on) = *value { Some(on) } else { None }).collect()
}

fn words(values: &[Value]) -> Vec<u16> {
    values.iter().filter_map(|value| if let Value::Word(word) = *value { Some(word) } else { None }).collect()
}

fn dwords(values: &[Value]) -> Vec<u32> {
    values.iter().filter_map(|value| if let Value::DWord(double) = *value { Some(double) } else { None }).collect()
}
