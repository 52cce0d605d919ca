//! The values of a tag from data formats: the feature `serde`.

use std::fmt;

use serde::Deserializer;
use serde::de::{self, DeserializeSeed, IgnoredAny, SeqAccess, Visitor};

use super::codec::Number;
use super::types::{Format, Storage};
use super::{GivenKind, ParseValueError, Tag, TagValue, ValueError};

/// Reads the values of a tag; made by [`Tag::values_seed`].
#[derive(Clone, Copy, Debug)]
#[must_use]
pub struct ValuesSeed {
    tag: Tag,
}

impl Tag {
    /// Reads the values of this tag from a data format, such as a JSON document (feature `serde`).
    ///
    /// The number `7` alone has no type, so the tag gives it: a tag of one value takes the value, or a
    /// list of it, and one of several values a list of [`value_count`](Self::value_count) items. The
    /// values are those that a [`Sample`](crate::poll::Sample) or a [`TagValue`] serializes as:
    ///
    /// - `bool`: `true` and `false`.
    /// - Integers and decimal digits: whole numbers within the range of the type. A float is refused.
    /// - `f32` and `f64`: floats, of which the nearest value is taken, and integers that the type has
    ///   exactly.
    /// - Scaled values: all numbers whose raw number is within the range of the type.
    /// - Texts: strings.
    /// - All types except texts: a string as in [`parse_values`](Self::parse_values), such as `"NaN"`,
    ///   `"-inf"` or `"0x00FF"`.
    ///
    /// The data format must be self-describing, as JSON, TOML and CBOR are.
    ///
    /// ```
    /// use fatek::tag;
    /// use fatek::tag::TagValue;
    /// use serde::de::DeserializeSeed;
    ///
    /// let mut json = serde_json::Deserializer::from_str("[-1, \"0x7FFF\"]");
    /// let values = tag!("R0-R1:i16").values_seed().deserialize(&mut json)?;
    /// assert_eq!(values, [TagValue::I16(-1), TagValue::I16(0x7FFF)]);
    ///
    /// let mut json = serde_json::Deserializer::from_str("70000");
    /// let error = tag!("R0").values_seed().deserialize(&mut json).unwrap_err();
    /// assert!(error.to_string().starts_with("`70000` is not a value for R0: out of range: u16 takes 0 to 65535"));
    /// # Ok::<(), serde_json::Error>(())
    /// ```
    ///
    /// # Errors
    /// The error of the data format has the text of [`ParseValueError`] for a value that breaks a rule,
    /// and of [`ValueError::Count`] for another number of values.
    pub const fn values_seed(&self) -> ValuesSeed {
        ValuesSeed { tag: *self }
    }

    /// The value of a string.
    fn natural_text(&self, text: &str) -> Result<TagValue, ValueError> {
        match self.storage {
            Storage::Text(_) => Ok(TagValue::Text(text.to_owned())),
            Storage::Bits(..) | Storage::BitsOf(_) => self.parse_one(text),
        }
    }

    /// The value of a state.
    fn natural_bool(&self, on: bool) -> Result<TagValue, ValueError> {
        match self.storage {
            Storage::Bits(Format::Bool, _) | Storage::BitsOf(_) => Ok(TagValue::Bool(on)),
            Storage::Bits(..) | Storage::Text(_) => {
                Err(ValueError::Kind { tag_type: self.tag_type(), kind: GivenKind::State })
            }
        }
    }
}

impl<'de> DeserializeSeed<'de> for ValuesSeed {
    type Value = Vec<TagValue>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

/// Passes a natural value on to the only value of a tag.
macro_rules! single_values {
    ($($visit:ident $type:ty;)*) => {
        $(
            fn $visit<E: de::Error>(self, value: $type) -> Result<Self::Value, E> {
                self.check_count(1).map_err(E::custom)?;
                Ok(vec![ValueSeed { tag: self.tag }.$visit(value)?])
            }
        )*
    };
}

impl<'de> Visitor<'de> for ValuesSeed {
    type Value = Vec<TagValue>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.tag.value_count() {
            1 => write!(f, "a value of {}", self.tag),
            count => write!(f, "a list of the {count} values of {}", self.tag),
        }
    }

    single_values! {
        visit_bool bool;
        visit_i64 i64;
        visit_i128 i128;
        visit_u64 u64;
        visit_u128 u128;
        visit_f32 f32;
        visit_f64 f64;
        visit_str &str;
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Value, A::Error> {
        let expected = self.tag.value_count();
        // The length of the tag bounds the memory, not that of the list.
        let mut values = Vec::with_capacity(expected);
        while values.len() < expected {
            match items.next_element_seed(ValueSeed { tag: self.tag })? {
                Some(value) => values.push(value),
                None => break,
            }
        }
        let mut given = values.len();
        while given >= expected && items.next_element::<IgnoredAny>()?.is_some() {
            given = given.saturating_add(1);
        }
        self.check_count(given).map_err(de::Error::custom)?;
        Ok(values)
    }
}

impl ValuesSeed {
    fn check_count(&self, given: usize) -> Result<(), ValueError> {
        let expected = self.tag.value_count();
        if given == expected { Ok(()) } else { Err(ValueError::Count { tag: self.tag, expected, given }) }
    }
}

/// Reads one of the values of a tag.
#[derive(Clone, Copy)]
struct ValueSeed {
    tag: Tag,
}

impl ValueSeed {
    fn checked<E: de::Error>(
        self,
        input: &dyn fmt::Display,
        value: Result<TagValue, ValueError>,
    ) -> Result<TagValue, E> {
        let checked = value.and_then(|value| {
            // Bits of a register are never encoded, and each state is one of them.
            if !self.tag.is_bits_of_register() {
                self.tag.encode_one(&value, &mut Vec::new())?;
            }
            Ok(value)
        });
        checked.map_err(|reason| E::custom(ParseValueError::new(&input.to_string(), self.tag, reason)))
    }
}

impl<'de> DeserializeSeed<'de> for ValueSeed {
    type Value = TagValue;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl Visitor<'_> for ValueSeed {
    type Value = TagValue;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a value of {}", self.tag)
    }

    fn visit_bool<E: de::Error>(self, on: bool) -> Result<TagValue, E> {
        self.checked(&on, self.tag.natural_bool(on))
    }

    fn visit_i64<E: de::Error>(self, number: i64) -> Result<TagValue, E> {
        self.visit_i128(number.into())
    }

    fn visit_i128<E: de::Error>(self, number: i128) -> Result<TagValue, E> {
        self.checked(&number, self.tag.value_of_number(Number::Integer(number)))
    }

    fn visit_u64<E: de::Error>(self, number: u64) -> Result<TagValue, E> {
        self.visit_i128(number.into())
    }

    fn visit_u128<E: de::Error>(self, number: u128) -> Result<TagValue, E> {
        match i128::try_from(number) {
            Ok(number) => self.visit_i128(number),
            // No type has numbers of this size.
            Err(_) => self.checked(&number, Err(ValueError::OutOfRange { tag_type: self.tag.tag_type() })),
        }
    }

    fn visit_f64<E: de::Error>(self, number: f64) -> Result<TagValue, E> {
        // In JSON, an integer beyond 64 bits comes as a float.
        let is_integer = number >= 2_f64.powi(64) || number < -(2_f64.powi(63));
        let is_other_integer = |error: &ValueError| {
            is_integer && number.is_finite() && matches!(error, ValueError::Kind { kind: GivenKind::Float, .. })
        };
        let out_of_range = || ValueError::OutOfRange { tag_type: self.tag.tag_type() };
        let value = self.tag.value_of_number(Number::Double(number));
        let value = value.map_err(|error| if is_other_integer(&error) { out_of_range() } else { error });
        // Debug uses an exponent where Display would write up to 309 digits.
        self.checked(&format_args!("{number:?}"), value)
    }

    fn visit_f32<E: de::Error>(self, number: f32) -> Result<TagValue, E> {
        self.checked(&format_args!("{number:?}"), self.tag.value_of_number(Number::Single(number)))
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<TagValue, E> {
        self.checked(&text, self.tag.natural_text(text))
    }
}
