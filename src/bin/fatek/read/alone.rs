//! Reads a tag as far as the PLC has its elements.

use fatek::tag::{Tag, TagValue};
use fatek::{Element, Error, Station, Value};

use super::Missing;
use crate::failure::Failure;

/// Elements that are read at once: a multiple of the elements of any value, and one request mostly.
const AT_ONCE: usize = 64;

/// Reads the values of a tag up to the first element that the PLC refuses.
pub(super) async fn read(station: &Station, tag: &Tag) -> Result<(Vec<TagValue>, Option<Missing>), Failure> {
    let (first, count) = (tag.first(), tag.element_count());
    let mut raw = Vec::with_capacity(count);
    let mut refused = None;
    while raw.len() < count && refused.is_none() {
        let most = AT_ONCE.min(count - raw.len());
        let (read, error) = read_most(station, nth(first, raw.len())?, most).await?;
        raw.extend(read);
        refused = error;
    }
    let missing = match refused {
        None => None,
        Some(error) if error.error_code().is_some() && !raw.is_empty() => {
            Some(Missing { error, end: Some((nth(first, raw.len())?, nth(first, raw.len() - 1)?)) })
        }
        Some(error) => Some(Missing { error, end: None }),
    };
    let mut rest = &raw[..];
    let mut values = Vec::new();
    for single in tag.singles() {
        let Some((of_single, others)) = rest.split_at_checked(single.element_count()) else { break };
        values.extend(single.decode(of_single).map_err(Failure::usage)?);
        rest = others;
    }
    Ok((values, missing))
}

/// Reads as many of these elements as the PLC has, and returns the error of the first one that it refuses.
async fn read_most(station: &Station, first: Element, count: usize) -> Result<(Vec<Value>, Option<Error>), Failure> {
    let mut error = match read_elements(station, first, count).await {
        Ok(values) => return Ok((values, None)),
        Err(error) => error,
    };
    // Invariant: the PLC has `read` elements, and not `refused`.
    let (mut values, mut refused) = (Vec::new(), count);
    while error.error_code().is_some() && values.len() + 1 < refused {
        let middle = values.len().midpoint(refused);
        match read_elements(station, first, middle).await {
            Ok(read) => values = read,
            Err(other) => (error, refused) = (other, middle),
        }
    }
    Ok((values, Some(error)))
}

async fn read_elements(station: &Station, first: Element, count: usize) -> Result<Vec<Value>, Error> {
    Ok(match first {
        Element::Discrete(first) => values(station.read_discretes(first, count).await?),
        Element::Register(first) => values(station.read_registers(first, count).await?),
        Element::Register32(first) => values(station.read_registers32(first, count).await?),
    })
}

fn values(raw: Vec<impl Into<Value>>) -> Vec<Value> {
    raw.into_iter().map(Into::into).collect()
}

fn nth(first: Element, n: usize) -> Result<Element, Failure> {
    first.nth(n).map_err(Failure::usage)
}
