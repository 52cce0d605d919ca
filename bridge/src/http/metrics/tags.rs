//! Values of tags, with their quality and age.
//!
//! A tag that is not good has no value here, so that Prometheus never records an old value as a new one: its
//! series ends, and goes on when the tag is good again. Texts have no value either.

use std::fmt;
use std::time::Instant;

use fatek::plant::PlantTag;
use prometheus_client::registry::Unit;
use serde_json::Value;

use super::{Labels, Writer};
use crate::http::Shared;
use crate::http::view::{Grade, TagState};
use crate::registry::PolledPlc;

/// A tag with its state.
struct Tag<'t> {
    plc: &'t str,
    tag: &'t PlantTag,
    state: TagState,
}

pub(super) fn write(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let registry = shared.bridge.registry.read();
    let tags: Vec<Tag<'_>> = registry.iter().flat_map(tags_of).collect();
    let infos = tags.iter().map(|tag| {
        let unit = tag.tag.unit().unwrap_or_default();
        let mut labels = tag.labels();
        labels.extend([("unit", unit), ("class", tag.tag.class().unwrap_or("default"))]);
        labels
    });
    to.info("tag", "Unit and scan class of a tag", infos)?;
    let indexes: Vec<String> = (0..tags.iter().map(|tag| tag.tag.tag().value_count()).max().unwrap_or(0))
        .map(|index| index.to_string())
        .collect();
    let help = "Value of a tag that is good; with the label index, one of several values";
    to.gauge("tag_value", None, help, tags.iter().flat_map(|tag| tag.values(&indexes)))?;
    let grades = tags.iter().map(|tag| (tag.labels(), code(tag.state.grade)));
    to.gauge("tag_quality", None, "2: good; 1: stale, later readings failed; 0: bad, without a value", grades)?;
    let now = Instant::now();
    let ages = tags.iter().filter(|tag| tag.state.grade != Grade::Bad);
    let ages = ages.map(|tag| (tag.labels(), tag.state.age(now).0.as_secs_f64()));
    to.gauge("tag_age", Some(Unit::Seconds), "Time since the reply with the last value", ages)
}

fn tags_of(plc: &PolledPlc) -> impl Iterator<Item = Tag<'_>> {
    let mut samples: std::collections::HashMap<_, _> =
        plc.polled.snapshot().into_iter().map(|sample| (sample.id, sample)).collect();
    plc.plc.tags().zip(&plc.ids).filter_map(move |(tag, id)| {
        let state = TagState::of(&samples.remove(id)?);
        Some(Tag { plc: plc.plc.name(), tag, state })
    })
}

impl Tag<'_> {
    fn labels(&self) -> Labels<'_> {
        vec![("plc", self.plc), ("tag", self.tag.name())]
    }

    fn values<'t>(&'t self, indexes: &'t [String]) -> Vec<(Labels<'t>, f64)> {
        let several: &[Value] = match (&self.state.value, self.state.grade) {
            (_, Grade::Stale | Grade::Bad) => &[],
            (Value::Array(several), Grade::Good) => several,
            (single, Grade::Good) => {
                return number(single).map(|number| (self.labels(), number)).into_iter().collect();
            }
        };
        let sample = |(value, index): (&Value, &'t String)| {
            let mut labels = self.labels();
            labels.push(("index", index));
            Some((labels, number(value)?))
        };
        several.iter().zip(indexes).filter_map(sample).collect()
    }
}

/// A value as a number: a discrete is 0 or 1; texts are none.
fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Bool(on) => Some(f64::from(u8::from(*on))),
        Value::Number(number) => number.as_f64(),
        Value::Null | Value::String(_) | Value::Array(_) | Value::Object(_) => None,
    }
}

fn code(grade: Grade) -> u64 {
    match grade {
        Grade::Good => 2,
        Grade::Stale => 1,
        Grade::Bad => 0,
    }
}
