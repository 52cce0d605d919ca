//! `fatek read TAG…`

use fatek::command::{InvalidRequest, MAX_POINTS, MAX_UNITS, Value};
use fatek::element::Width;
use fatek::tag::Tag;
use fatek::{Element, Error, Station};

use crate::failure::Failure;
use crate::output::{Output, Rows};

pub(crate) async fn read(station: &Station, tags: &[Tag], output: &Output) -> Result<(), Failure> {
    let mut rows = Rows::new(["tag", "type", "value"]);
    for tag in tags {
        let raw = fetch(station, tag).await.map_err(Failure::of(tag))?;
        let values = tag.decode(&raw).map_err(Failure::usage)?;
        for (single, value) in tag.singles().zip(values) {
            rows.push([single.first().to_string().into(), single.tag_type().as_str().into(), value.into()]);
        }
    }
    output.rows(&rows)
}

/// What the elements of a tag hold, in as many requests as that takes.
async fn fetch(station: &Station, tag: &Tag) -> Result<Vec<Value>, Error> {
    let mut raw = Vec::with_capacity(tag.element_count());
    while raw.len() < tag.element_count() {
        let first = tag.first().nth(raw.len()).map_err(InvalidRequest::from)?;
        let count = (tag.element_count() - raw.len()).min(most(first.width()));
        match first {
            Element::Discrete(first) => {
                raw.extend(station.read_discretes(first, count).await?.into_iter().map(Value::from))
            }
            Element::Register(first) => {
                raw.extend(station.read_registers(first, count).await?.into_iter().map(Value::from))
            }
            Element::Register32(first) => {
                raw.extend(station.read_registers32(first, count).await?.into_iter().map(Value::from));
            }
        }
    }
    Ok(raw)
}

/// How many elements of a width one request takes. An even number: a pair of words is never split.
pub(crate) fn most(width: Width) -> usize {
    match width {
        Width::Bit => MAX_POINTS,
        width => MAX_UNITS / width.units(),
    }
}
