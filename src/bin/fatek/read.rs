//! Subcommand `fatek read TAG…`.

use fatek::tag::Tag;
use fatek::{Element, Error, Station, Value};

use crate::args::ReadArgs;
use crate::failure::Failure;
use crate::output::{Output, Rows};

pub(crate) async fn read(station: &Station, args: &ReadArgs, output: &Output) -> Result<(), Failure> {
    let tags = args.table.load()?.tags(&args.tags)?;
    args.model.check(station, tags.iter().map(|named| named.tag)).await?;
    let mut rows = Rows::new(["tag", "type", "value"]);
    for named in &tags {
        let tag = &named.tag;
        let raw = fetch(station, tag).await.map_err(Failure::of(tag))?;
        let values = tag.decode(&raw).map_err(Failure::usage)?;
        for (number, (single, value)) in tag.singles().zip(values).enumerate() {
            let label = named.label(number, || elements(&single));
            rows.push([label.into(), type_name(&single).into(), value.into()]);
        }
    }
    output.rows(&rows)
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

/// Reads the raw values of a tag.
async fn fetch(station: &Station, tag: &Tag) -> Result<Vec<Value>, Error> {
    let count = tag.element_count();
    Ok(match tag.first() {
        Element::Discrete(first) => values(station.read_discretes(first, count).await?),
        Element::Register(first) => values(station.read_registers(first, count).await?),
        Element::Register32(first) => values(station.read_registers32(first, count).await?),
    })
}

fn values(raw: Vec<impl Into<Value>>) -> Vec<Value> {
    raw.into_iter().map(Into::into).collect()
}
