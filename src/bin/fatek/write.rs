//! `fatek write TAG=VALUE…`

use fatek::command::{InvalidRequest, Value};
use fatek::tag::Assignment;
use fatek::{Element, Error, Station};

use crate::failure::Failure;
use crate::output::Output;
use crate::read::most;

pub(crate) async fn write(station: &Station, assignments: &[Assignment], output: &Output) -> Result<(), Failure> {
    for assignment in assignments {
        send(station, assignment).await.map_err(|error| {
            let tag = assignment.tag();
            let doubt = if error.may_have_executed() { " (it may have been written)" } else { "" };
            Failure::of(format_args!("{tag}{doubt}"))(error)
        })?;
        output.remark(format_args!("wrote {assignment}"));
    }
    Ok(())
}

/// Writes the elements of a tag, in as many requests as that takes.
async fn send(station: &Station, assignment: &Assignment) -> Result<(), Error> {
    let (tag, raw) = (assignment.tag(), assignment.encode());
    let mut done = 0;
    for values in raw.chunks(most(tag.first().width())) {
        match tag.first().nth(done).map_err(InvalidRequest::from)? {
            Element::Discrete(first) => station.write_discretes(first, &bits(values)).await?,
            Element::Register(first) => station.write_registers(first, &words(values)).await?,
            Element::Register32(first) => station.write_registers32(first, &doubles(values)).await?,
        }
        done += values.len();
    }
    Ok(())
}

// An assignment's raw values are as wide as its elements: each of these takes all that it is given.

fn bits(values: &[Value]) -> Vec<bool> {
    values.iter().filter_map(|value| if let Value::Bit(on) = *value { Some(on) } else { None }).collect()
}

fn words(values: &[Value]) -> Vec<u16> {
    values.iter().filter_map(|value| if let Value::Word(word) = *value { Some(word) } else { None }).collect()
}

fn doubles(values: &[Value]) -> Vec<u32> {
    values.iter().filter_map(|value| if let Value::Double(double) = *value { Some(double) } else { None }).collect()
}
