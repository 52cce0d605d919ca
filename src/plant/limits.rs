//! The limits of the values that may be written to a tag.

use super::WriteRule;
use crate::tag::{Tag, TagValue, ValueError};

/// A value that a [`WriteRule`] does not permit.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LimitError {
    /// The value is less than the smallest one, or no number.
    #[error("{value} is below {min}")]
    #[non_exhaustive]
    Below {
        /// The value as it was given, or as it would be stored.
        value: TagValue,
        /// The smallest number.
        min: f64,
    },
    /// The value is more than the largest one.
    #[error("{value} is above {max}")]
    #[non_exhaustive]
    Above {
        /// The value as it was given, or as it would be stored.
        value: TagValue,
        /// The largest number.
        max: f64,
    },
    /// The value is no value of the tag.
    #[error(transparent)]
    Value(#[from] ValueError),
}

impl WriteRule {
    /// Checks values against the limits: as they are, and as they are stored. The PLC gets the nearest value that the
    /// tag has, which may lie beyond a limit.
    ///
    /// ```
    /// use fatek::plant::Plant;
    /// use fatek::tag::TagValue;
    ///
    /// let plant = Plant::from_toml(
    ///     "[plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\n\
    ///      tag.valve = { at = 'R5:i16*0.5', write = { max = 80.3 } }",
    /// )?;
    /// let valve = plant.plc("mixer").unwrap().tag("valve").unwrap();
    /// let check = |value: f64| valve.write().unwrap().check(&valve.tag(), &[TagValue::Scaled(value)]);
    /// assert!(check(80.0).is_ok());
    /// assert_eq!(check(80.3).unwrap_err().to_string(), "80.5 is above 80.3");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`LimitError`] for the first value beyond a limit, or that is no value of the tag. Values that are no
    /// numbers, and bits of registers, have no limits.
    pub fn check(&self, tag: &Tag, values: &[TagValue]) -> Result<(), LimitError> {
        if !tag.tag_type().is_number() {
            return Ok(());
        }
        let stored = tag.decode(&tag.encode(values)?)?;
        values.iter().chain(&stored).try_for_each(|value| self.check_number(value))
    }

    fn check_number(&self, value: &TagValue) -> Result<(), LimitError> {
        match (self.min, self.max) {
            (Some(min), _) if is_below(value, min) => Err(LimitError::Below { value: value.clone(), min }),
            (_, Some(max)) if is_above(value, max) => Err(LimitError::Above { value: value.clone(), max }),
            (_, _) => Ok(()),
        }
    }
}

/// An integer of 64 bits, which `as_f64` can round to a limit.
fn integer(value: &TagValue) -> Option<i128> {
    if let TagValue::U64(value) = *value {
        return Some(value.into());
    }
    if let TagValue::I64(value) = *value { Some(value.into()) } else { None }
}

/// NaN, and decimal digits beyond 9, are below any limit.
#[allow(clippy::cast_possible_truncation, reason = "the cast saturates, beyond all integers of 64 bits")]
fn is_below(value: &TagValue, min: f64) -> bool {
    match integer(value) {
        Some(integer) => integer < min.ceil() as i128,
        None => !value.as_f64().is_some_and(|number| number >= min),
    }
}

/// NaN, and decimal digits beyond 9, are above any limit.
#[allow(clippy::cast_possible_truncation, reason = "the cast saturates, beyond all integers of 64 bits")]
fn is_above(value: &TagValue, max: f64) -> bool {
    match integer(value) {
        Some(integer) => integer > max.floor() as i128,
        None => !value.as_f64().is_some_and(|number| number <= max),
    }
}
