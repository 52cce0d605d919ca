//! Forms of the document, round trips, and errors.

mod document;
mod errors;
mod round_trips;

use std::cell::Cell;

use serde::de::{DeserializeOwned, DeserializeSeed as _};
use serde::{Deserialize, Deserializer, Serialize};

use crate::tag::{Tag, TagValue};

fn tag(text: &str) -> Tag {
    text.parse().unwrap()
}

fn json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).unwrap()
}

fn read_json<T: DeserializeOwned>(json: &str) -> Result<T, String> {
    serde_json::from_str(json).map_err(|error| error.to_string())
}

/// The values of a tag from JSON; the error without its place.
fn read_values(tag: Tag, json: &str) -> Result<Vec<TagValue>, String> {
    let mut deserializer = serde_json::Deserializer::from_str(json);
    let values = tag.values_seed().deserialize(&mut deserializer).map_err(|error| error.to_string())?;
    deserializer.end().map_err(|error| error.to_string())?;
    Ok(values)
}

/// Writes and reads a value in a binary format.
fn through_cbor<T: Serialize + DeserializeOwned>(value: &T) -> T {
    let mut bytes = Vec::new();
    ciborium::into_writer(value, &mut bytes).unwrap();
    ciborium::from_reader(bytes.as_slice()).unwrap()
}

thread_local! {
    /// The tag of [`OfTag`]: the reader of CBOR takes no seeds.
    static TAG: Cell<Option<Tag>> = const { Cell::new(None) };
}

/// The values of the tag of this thread.
struct OfTag(Vec<TagValue>);

impl<'de> Deserialize<'de> for OfTag {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        TAG.get().unwrap().values_seed().deserialize(deserializer).map(Self)
    }
}

fn values_through_cbor(tag: Tag, values: &[TagValue]) -> Vec<TagValue> {
    let mut bytes = Vec::new();
    ciborium::into_writer(values, &mut bytes).unwrap();
    TAG.set(Some(tag));
    let OfTag(values) = ciborium::from_reader(bytes.as_slice()).unwrap();
    values
}
