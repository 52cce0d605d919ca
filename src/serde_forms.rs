#![doc = include_str!("../docs/SERDE.md")]
//!
//! The implementations are in this module, one file per kind of form.

mod capabilities;
mod duration;
mod error;
mod names;
mod options;
mod plan;
mod poll;
mod sample;
mod settings;
mod stats;
mod text;
mod value;

#[cfg(test)]
mod tests;

use std::fmt;

use self::duration::DurationText;

/// Implements both directions of a type by its form: a private struct with derived implementations.
///
/// A form has `of`, which makes it of a value or returns the rule that the value breaks, and `make`,
/// which makes the value by the setters of its type.
macro_rules! through_forms {
    ($($type:ty => $form:ty;)*) => {
        $(
            impl serde::Serialize for $type {
                fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                    <$form>::of(self).map_err(serde::ser::Error::custom)?.serialize(serializer)
                }
            }

            impl<'de> serde::Deserialize<'de> for $type {
                fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                    <$form>::deserialize(deserializer)?.make().map_err(serde::de::Error::custom)
                }
            }
        )*
    };
}
use through_forms;

/// The error of a setting that a setter would have changed: it is beyond the limit of the setter.
fn check_kept<T: PartialEq + fmt::Display>(name: &str, given: T, kept: T) -> Result<(), String> {
    if given == kept { Ok(()) } else { Err(format!("`{name}` is {given}, and must be at most {kept}")) }
}
