//! Reads a tag as far as the PLC has its elements.

use fatek::command::{MAX_POINTS, MAX_UNITS};
use fatek::element::Width;
use fatek::tag::{Tag, TagValue, ValueError};
use fatek::{Element, Error, Station, Value};

use super::Missing;
use crate::failure::Failure;

/// The elements of a tag that are read at once: those of one request.
pub(super) fn at_once(tag: &Tag) -> usize {
    match tag.first().width() {
        Width::Bit => MAX_POINTS,
        width @ (Width::Word | Width::DWord) => MAX_UNITS / width.units(),
    }
}

/// Reads the values of a tag up to the first element that the PLC refuses.
pub(super) async fn read(station: &Station, tag: &Tag) -> Result<(Vec<TagValue>, Option<Missing>), Failure> {
    let elements: Vec<Element> = tag.elements().collect();
    let mut raw = Vec::with_capacity(elements.len());
    let mut failed = None;
    while let Some(&first) = elements.get(raw.len()).filter(|_| failed.is_none()) {
        let most = at_once(tag).min(elements.len() - raw.len());
        let (read, error) = read_most(station, first, most).await;
        raw.extend(read);
        failed = error;
    }
    let missing = failed.map(|error| {
        let is_refusal = error.error_code().is_some();
        let before = raw.len().checked_sub(1).and_then(|last| elements.get(last));
        let end = elements.get(raw.len()).filter(|_| is_refusal && elements.len() > 1);
        Missing { error, end: end.map(|&first| (first, before.copied())) }
    });
    Ok((values(tag, &raw).map_err(Failure::usage)?, missing))
}

/// The values of the first elements of a tag.
fn values(tag: &Tag, raw: &[Value]) -> Result<Vec<TagValue>, ValueError> {
    if raw.len() == tag.element_count() {
        // Also several bits of one register.
        return tag.decode(raw);
    }
    let mut rest = raw;
    let mut values = Vec::new();
    for single in tag.singles() {
        let Some((of_single, others)) = rest.split_at_checked(single.element_count()) else { break };
        values.extend(single.decode(of_single)?);
        rest = others;
    }
    Ok(values)
}

/// Reads as many of these elements as the PLC has, and returns the error of the first one that it refuses.
async fn read_most(station: &Station, first: Element, count: usize) -> (Vec<Value>, Option<Error>) {
    let mut error = match read_elements(station, first, count).await {
        Ok(values) => return (values, None),
        Err(error) => error,
    };
    // Invariant: `values` were read, and a read of `refused` elements was refused.
    let (mut values, mut refused) = (Vec::new(), count);
    while error.error_code().is_some() && values.len() + 1 < refused {
        let middle = values.len().midpoint(refused);
        match read_elements(station, first, middle).await {
            Ok(read) => values = read,
            Err(other) => (error, refused) = (other, middle),
        }
    }
    // The device may take fewer elements at once.
    if let (true, false, Ok(next)) = (error.error_code().is_some(), values.is_empty(), first.nth(values.len())) {
        match read_elements(station, next, 1).await {
            Ok(one) => {
                values.extend(one);
                return (values, None);
            }
            Err(of_next) => error = of_next,
        }
    }
    (values, Some(error))
}

async fn read_elements(station: &Station, first: Element, count: usize) -> Result<Vec<Value>, Error> {
    Ok(match first {
        Element::Discrete(first) => into_values(station.read_discretes(first, count).await?),
        Element::Register(first) => into_values(station.read_registers(first, count).await?),
        Element::Register32(first) => into_values(station.read_registers32(first, count).await?),
    })
}

fn into_values(raw: Vec<impl Into<Value>>) -> Vec<Value> {
    raw.into_iter().map(Into::into).collect()
}
