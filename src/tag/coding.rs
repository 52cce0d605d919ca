//! Values of a tag and the values of its elements, both ways.

use super::scale::parse_scaled;
use super::types::{Format, Storage, WordOrder};
use super::{ParseValueError, Tag, TagValue, ValueError, text};
use crate::command::Value;
use crate::element::{ElementError, Width};

impl Tag {
    /// Decodes the values of its elements.
    ///
    /// `raw`: the values of [`elements`](Self::elements), in their order.
    ///
    /// # Errors
    /// [`ValueError::Count`] unless there is one per element; [`ElementError::WrongWidth`] in
    /// [`ValueError::Element`] if one has not the width of the elements.
    pub fn decode(&self, raw: &[Value]) -> Result<Vec<TagValue>, ValueError> {
        if raw.len() != self.count {
            return Err(ValueError::Count { tag: *self, expected: self.count, given: raw.len() });
        }
        if let Some(value) = raw.iter().find(|value| value.width() != self.first.width()) {
            return Err(ElementError::WrongWidth { element: self.first, expected: value.width() }.into());
        }
        Ok(self.decode_checked(raw))
    }

    /// Encodes values for its elements.
    ///
    /// Returns one value for each of [`elements`](Self::elements), in their order.
    ///
    /// # Errors
    /// - [`ValueError::Count`] unless there are [`value_count`](Self::value_count) values
    /// - [`ValueError::WrongType`] for a value of another type
    /// - [`ValueError::BitsOfRegister`] for bits of a register, since a write replaces all of its bits
    /// - [`ValueError::RawOutOfRange`] for a scaled value whose raw number does not fit
    /// - [`ValueError::TooLong`] and [`ValueError::NotLatin1`] for a text that does not fit
    pub fn encode(&self, values: &[TagValue]) -> Result<Vec<Value>, ValueError> {
        if values.len() != self.value_count() {
            return Err(ValueError::Count { tag: *self, expected: self.value_count(), given: values.len() });
        }
        let mut raw = Vec::with_capacity(self.count);
        values.iter().try_for_each(|value| self.encode_one(value, &mut raw))?;
        Ok(raw)
    }

    /// Parses the values of this tag, separated by commas.
    ///
    /// - Numbers: decimal, with an optional sign. `f32` and `f64` also with decimals or an exponent,
    ///   `nan` and `inf`.
    /// - `bool`: `0` `1` `false` `true` `off` `on`.
    /// - All these types: the bits as `0x` and hexadecimal digits, so `0xFFFF` as `i16` is -1.
    ///   `f32` takes all 8 digits, `f64` all 16. `hex` takes only this form, since `10` is ambiguous.
    /// - Scaled values: decimal, with decimals or an exponent, `nan` and `inf`, but not `0x`. The
    ///   nearest raw number is written.
    /// - A text: in double quotes, with `\\` before `"` and `\\`, and `\\n`, `\\r`, `\\t`, `\\0` or
    ///   `\\x` and two hexadecimal digits for control characters. Quotes are optional without such
    ///   characters, commas, and blanks at the ends.
    ///
    /// ```
    /// use fatek::tag::{Tag, TagValue};
    ///
    /// let tag: Tag = "M0-M2".parse()?;
    /// assert_eq!(tag.parse_values("on, 0, true")?, [true, false, true].map(TagValue::Bool));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`ParseValueError`], with the value and the rule that it breaks.
    pub fn parse_values(&self, text: &str) -> Result<Vec<TagValue>, ParseValueError> {
        // Bits of a register are values, but not encoded.
        if self.is_bits_of_register() { self.parse_each(text, |_| Ok(())) } else { Ok(self.parse_and_encode(text)?.0) }
    }

    /// Parses values, and encodes them for the elements.
    pub(super) fn parse_and_encode(&self, text: &str) -> Result<(Vec<TagValue>, Vec<Value>), ParseValueError> {
        let mut raw = Vec::new();
        let values = self.parse_each(text, |value| self.encode_one(value, &mut raw))?;
        Ok((values, raw))
    }

    /// Parses values, and checks each.
    fn parse_each(
        &self,
        text: &str,
        mut check: impl FnMut(&TagValue) -> Result<(), ValueError>,
    ) -> Result<Vec<TagValue>, ParseValueError> {
        let error = |input: &str, reason| ParseValueError::new(input, *self, reason);
        let mut values = Vec::new();
        let mut take = |item: &str| {
            let item = item.trim();
            let value = self.parse_one(item).map_err(|reason| error(item, reason))?;
            check(&value).map_err(|reason| error(item, reason))?;
            values.push(value);
            Ok(())
        };
        if self.tag_type.is_text() {
            // Not split: the parser of texts refuses commas outside of quotes.
            take(text)?;
        } else {
            // Counted first, so that the length of the tag bounds the time.
            let given = text.split(',').count();
            if given != self.value_count() {
                return Err(error(text, ValueError::Count { tag: *self, expected: self.value_count(), given }));
            }
            text.split(',').try_for_each(take)?;
        }
        Ok(values)
    }

    /// Values of this tag, all zero.
    pub(crate) fn zeros(&self) -> Vec<TagValue> {
        let zero = match self.first.width() {
            Width::Bit => Value::Bit(false),
            Width::Word => Value::Word(0),
            Width::DWord => Value::DWord(0),
        };
        self.decode_checked(&vec![zero; self.count])
    }

    /// Decodes elements whose number and width are those of the tag.
    fn decode_checked(&self, raw: &[Value]) -> Vec<TagValue> {
        if let (Storage::BitsOf(range), [register]) = (self.storage, raw) {
            return range.states(bits(*register)).map(TagValue::Bool).collect();
        }
        raw.chunks(self.elements_per_value()).map(|elements| self.decode_one(elements)).collect()
    }

    pub(super) fn parse_one(&self, text: &str) -> Result<TagValue, ValueError> {
        if text.is_empty() {
            return Err(ValueError::Empty);
        }
        match (self.storage, self.scale) {
            (Storage::Bits(format, _), None) => format.parse(text),
            (Storage::Bits(..), Some(_)) => Ok(TagValue::Scaled(parse_scaled(text)?)),
            (Storage::Text(_), _) => Ok(TagValue::Text(text::parse(text)?)),
            (Storage::BitsOf(_), _) => Format::Bool.parse(text),
        }
    }

    fn decode_one(&self, elements: &[Value]) -> TagValue {
        match (self.storage, self.scale) {
            (Storage::Bits(format, order), None) => format.value(join(elements, order)),
            (Storage::Bits(format, order), Some(scale)) => TagValue::Scaled(scale.value(format, join(elements, order))),
            (Storage::BitsOf(range), _) => Format::Bool.value(join(elements, WordOrder::LowFirst) >> range.first & 1),
            (Storage::Text(order), _) => {
                TagValue::Text(text::decode(elements.iter().map(|&element| low_word(bits(element))), order))
            }
        }
    }

    pub(super) fn encode_one(&self, value: &TagValue, raw: &mut Vec<Value>) -> Result<(), ValueError> {
        let (bits, order) = match (self.storage, self.scale, value) {
            (Storage::BitsOf(_), _, _) => return Err(ValueError::BitsOfRegister { tag: *self }),
            (Storage::Text(order), _, TagValue::Text(text)) => {
                raw.extend(text::encode(text, self.count, order)?.into_iter().map(Value::Word));
                return Ok(());
            }
            (Storage::Bits(format, order), Some(scale), &TagValue::Scaled(value)) => {
                let bits = scale.bits(format, value);
                (
                    bits.ok_or(ValueError::RawOutOfRange { value, raw: scale.raw(value), tag_type: self.tag_type })?,
                    order,
                )
            }
            (Storage::Bits(own, order), None, value) => match value.bits() {
                Some((format, bits)) if format == own => (bits, order),
                Some(_) | None => return Err(ValueError::WrongType { tag: *self, value: value.clone() }),
            },
            (Storage::Text(_) | Storage::Bits(..), _, value) => {
                return Err(ValueError::WrongType { tag: *self, value: value.clone() });
            }
        };
        raw.extend(split(bits, order, self.first.width(), self.elements_per_value()));
        Ok(())
    }

    /// Appends the elements of the value nearest to a number. Returns `false`, and appends nothing, if the
    /// tag has no such value, or is a text or bits of a register.
    #[cfg(feature = "sim")]
    pub(crate) fn encode_nearest(&self, number: f64, raw: &mut Vec<Value>) -> bool {
        let Storage::Bits(format, order) = self.storage else { return false };
        let bits = match self.scale {
            Some(scale) => scale.bits(format, number),
            // Beyond the numbers of a float, the nearest integer is none either.
            None if format.is_float() => format.nearest(number),
            None => format.nearest(number).or_else(|| format.nearest_integer(number)),
        };
        let Some(bits) = bits else { return false };
        raw.extend(split(bits, order, self.first.width(), self.elements_per_value()));
        true
    }

    /// Returns whether its values are integers or states: numbers without fractions.
    #[cfg(feature = "sim")]
    pub(crate) fn is_integral(&self) -> bool {
        matches!(self.storage, Storage::Bits(format, _) if !format.is_float()) && self.scale.is_none()
    }

    /// The type of its values, for errors: `u16 of 16 bits`, `scaled`, `text`.
    pub(super) fn description(&self) -> String {
        match (self.storage, self.scale) {
            (Storage::Bits(..), Some(_)) => "scaled".to_owned(),
            (Storage::Bits(format, _), None) => format.description(),
            (Storage::Text(_), _) => "text".to_owned(),
            (Storage::BitsOf(_), _) => Format::Bool.description(),
        }
    }
}

/// The bits of the elements of one value.
fn join(elements: &[Value], order: WordOrder) -> u64 {
    let joined = |joined: u64, element: &Value| joined << element.width().bits() | bits(*element);
    match order {
        WordOrder::LowFirst => elements.iter().rev().fold(0, joined),
        WordOrder::HighFirst => elements.iter().fold(0, joined),
    }
}

/// The elements of one value from its bits.
fn split(bits: u64, order: WordOrder, width: Width, elements: usize) -> impl Iterator<Item = Value> {
    let place = move |n: usize| match order {
        WordOrder::LowFirst => n,
        WordOrder::HighFirst => elements - 1 - n,
    };
    let parts = (0..elements).map(move |n| bits >> (place(n) as u32 * width.bits()));
    parts.map(move |bits| of_width(bits, width))
}

/// The value of an element from its bits, of which the lowest are taken.
pub(super) fn of_width(bits: u64, width: Width) -> Value {
    match width {
        Width::Bit => Value::Bit(bits != 0),
        Width::Word => Value::Word(low_word(bits)),
        Width::DWord => Value::DWord(low_double(bits)),
    }
}

pub(super) fn bits(element: Value) -> u64 {
    match element {
        Value::Bit(on) => on.into(),
        Value::Word(word) => word.into(),
        Value::DWord(double) => double.into(),
    }
}

#[allow(clippy::cast_possible_truncation, reason = "the low word is wanted")]
fn low_word(bits: u64) -> u16 {
    bits as u16
}

#[allow(clippy::cast_possible_truncation, reason = "the low double word is wanted")]
fn low_double(bits: u64) -> u32 {
    bits as u32
}
