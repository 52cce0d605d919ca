//! Tags: elements with a data type, written as text.
//!
//! A [`Tag`] is an element or a range of consecutive elements, both ends included, with a
//! [`TagType`]. An [`Assignment`] is a tag with its values. Both are parsed from text, and display
//! as text that parses to the same. They convert the [`Value`]s of the protocol to [`TagValue`]s and
//! back.
//!
//! | tag | meaning |
//! |---|---|
//! | `M100` | a discrete |
//! | `R0-R9`, `R0-9` | ten registers, each a `u16` |
//! | `WM0-WM32` | the three words `WM0`, `WM16` and `WM32` |
//! | `DR0-DR4` | the three registers of 32 bits `DR0`, `DR2` and `DR4` |
//! | `DRC200-DRC205` | six counters of 32 bits: `DRC200` to `DRC255` have one address each |
//! | `R5:i16` | a register, signed |
//! | `DR2:i32` | a 32-bit register, signed |
//! | `R100:f32` | the registers `R100`, the low word, and `R101` as one float |
//! | `R100:f32-hi` | the same with the high word in `R100` |
//! | `R0-R9:f32` | ten registers as five floats |
//! | `R5:bcd16`, `R5:bcd32` | four decimal digits, one in each four bits; or eight in two registers |
//! | `R0:i64`, `DR0:f64` | four registers, or two of 32 bits, as one number of 64 bits |
//! | `WY8:hex` | 16 outputs as four hexadecimal digits |
//! | `R5:i16*0.1-40` | a register, signed, with a gain of 0.1 and an offset of -40; see [`Scale`] |
//! | `R0-R9:u16*0.01`, `R100:f32+3` | numbers up to 32 bits (no `hex`, no BCD) can have a gain or an offset |
//! | `R0-R9:text` | ten registers as one text of up to 20 characters, low byte first |
//! | `R0-R9:text-hi` | the same, high byte first |
//!
//! Names of other systems are accepted for types: `float` is `f32`, `double` is `f64`, `int` and
//! `int16` are `i16`, `dint` is `i32`, `lint` is `i64`, `word` is `u16`, and so on.
//!
//! A text is read and written by one request, so it has at most 64 registers. Its characters are
//! Latin-1; NULs at its end are removed. In an assignment it is in double quotes, optional around
//! plain words.
//!
//! ```
//! use fatek::command::Value;
//! use fatek::tag::{Assignment, Tag, TagValue};
//!
//! let tag: Tag = "R100:f32".parse()?;
//! assert_eq!(tag.decode(&[Value::Word(0x1000), Value::Word(0xC3FA)])?, [TagValue::F32(-500.125)]);
//!
//! let assignment: Assignment = "R5-R6:i16=-1,0x10".parse()?;
//! assert_eq!(assignment.encode(), [Value::Word(0xFFFF), Value::Word(0x0010)]);
//!
//! let tag: Tag = "R5:i16*0.1".parse()?;
//! assert_eq!(tag.decode(&[Value::Word(123)])?, [TagValue::Scaled(12.3)]);
//!
//! let tag: Tag = "R0-R1:text".parse()?;
//! let text = TagValue::Text("ABC".to_owned());
//! assert_eq!(tag.decode(&[Value::Word(0x4241), Value::Word(0x0043)])?, [text]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`Station::read`](crate::Station::read) and [`Station::write`](crate::Station::write) convert the
//! values of tags to Rust types ([`FromTag`]) and back ([`IntoTagValues`]).
//!
//! No I/O. No text can cause a panic.
//!
//! Source: protocol reference, section 3, for the order of words in 32 bits.

mod assignment;
mod codec;
mod convert;
mod error;
mod parse;
mod scale;
mod sets;
mod text;
mod types;

use std::fmt;
use std::str::FromStr;

pub use assignment::Assignment;
pub use convert::{FromTag, IntoTagValues};
pub use error::{
    ParseAssignmentError, ParseTagError, ParseTagTypeError, ParseValueError, TagAccessError, TagError, ValueError,
};
pub use scale::{Scale, ScaleError};
pub use sets::{FromTags, IntoAssignment, IntoAssignments, IntoTag, One, Several, TagSet};
pub use types::{TagType, TagValue};

use self::scale::parse_scaled;
use self::types::{Storage, WordOrder};
use crate::command::{MAX_UNITS, Value};
use crate::element::{Element, ElementError, MemoryArea, Width};
use crate::wire::Framing;

/// An element or a range of elements, with a data type; see [the module](self).
///
/// A tag has at least one value, and all of its elements exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Tag {
    first: Element,
    /// Number of elements, not of values.
    count: usize,
    tag_type: TagType,
    storage: Storage,
    scale: Option<Scale>,
}

impl Tag {
    /// A tag of consecutive values of a type, from `first` on.
    ///
    /// A text has one value of one register; for a longer text, use [`spanning`](Self::spanning).
    ///
    /// ```
    /// use fatek::register;
    /// use fatek::tag::{Tag, TagType};
    ///
    /// let levels = Tag::new(register!("R0"), TagType::F32, 5)?;
    /// assert_eq!(levels.to_string(), "R0-R9:f32");
    /// # Ok::<(), fatek::tag::TagError>(())
    /// ```
    ///
    /// # Errors
    /// [`TagError::WrongType`], [`TagError::NoValues`], [`TagError::SeveralTexts`] and
    /// [`TagError::PastTheEnd`].
    pub fn new(first: impl Into<Element>, tag_type: TagType, values: usize) -> Result<Self, TagError> {
        let first = first.into();
        let storage = storage(first, tag_type)?;
        if tag_type.is_text() && values > 1 {
            return Err(TagError::SeveralTexts { first });
        }
        // On overflow, the elements are past the last address, too.
        let elements = values.saturating_mul(storage.elements_per_value(first.width()));
        Self::checked(first, elements, tag_type, storage)
    }

    /// A tag of consecutive elements, from `first` on: as many values as they hold, or one text.
    ///
    /// ```
    /// use fatek::register;
    /// use fatek::tag::{Tag, TagType};
    ///
    /// assert_eq!(Tag::spanning(register!("R0"), TagType::Text, 10)?.to_string(), "R0-R9:text");
    /// assert_eq!(Tag::spanning(register!("R0"), TagType::F32, 10)?.value_count(), 5);
    /// # Ok::<(), fatek::tag::TagError>(())
    /// ```
    ///
    /// # Errors
    /// [`TagError::WrongType`], [`TagError::NoValues`], [`TagError::Uneven`],
    /// [`TagError::LongText`] and [`TagError::PastTheEnd`].
    pub fn spanning(first: impl Into<Element>, tag_type: TagType, elements: usize) -> Result<Self, TagError> {
        let first = first.into();
        let storage = storage(first, tag_type)?;
        let per_value = storage.elements_per_value(first.width());
        if !elements.is_multiple_of(per_value) {
            return Err(TagError::Uneven { count: elements, per_value, tag_type });
        }
        if tag_type.is_text() && elements > MAX_UNITS {
            return Err(TagError::LongText { registers: elements, max: MAX_UNITS });
        }
        Self::checked(first, elements, tag_type, storage)
    }

    /// Sets gain and offset of the values.
    ///
    /// ```
    /// use fatek::element;
    /// use fatek::tag::{Scale, Tag};
    ///
    /// let level = Tag::from(element!("R5")).scaled(Scale::new(0.01, 0.0)?)?;
    /// assert_eq!(level.to_string(), "R5:u16*0.01");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`TagError::NotScalable`] for `bool`, `hex`, decimal digits, 64 bits and texts.
    pub fn scaled(self, scale: Scale) -> Result<Self, TagError> {
        if !self.tag_type.is_scalable() {
            return Err(TagError::NotScalable { tag_type: self.tag_type });
        }
        Ok(Self { scale: Some(scale), ..self })
    }

    fn checked(first: Element, count: usize, tag_type: TagType, storage: Storage) -> Result<Self, TagError> {
        let last = count.checked_sub(1).ok_or(TagError::NoValues)?;
        match first.nth(last) {
            Ok(_) => Ok(Self { first, count, tag_type, storage, scale: None }),
            Err(_) => Err(TagError::PastTheEnd { first, count }),
        }
    }

    /// The first element.
    #[must_use]
    pub fn first(&self) -> Element {
        self.first
    }

    /// The data type.
    #[must_use]
    pub fn tag_type(&self) -> TagType {
        self.tag_type
    }

    /// Gain and offset, if it has them.
    #[must_use]
    pub fn scale(&self) -> Option<Scale> {
        self.scale
    }

    /// Number of elements.
    #[must_use]
    pub fn element_count(&self) -> usize {
        self.count
    }

    /// Number of values; 1 for a text.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.count / self.elements_per_value()
    }

    /// Number of elements per value: 2 for 32 bits and 4 for 64 bits on 16-bit registers, 2 for 64
    /// bits on 32-bit registers, all for a text, else 1.
    #[must_use]
    pub fn elements_per_value(&self) -> usize {
        match self.storage {
            Storage::Text(_) => self.count,
            Storage::Bits(..) => self.storage.elements_per_value(self.first.width()),
        }
    }

    /// Its elements in order, to be read or written.
    pub fn elements(&self) -> impl Iterator<Item = Element> + use<> {
        let first = self.first;
        (0..self.count).filter_map(move |n| first.nth(n).ok())
    }

    /// Checks the addresses of its elements against the limit of a framing.
    ///
    /// # Errors
    /// [`ElementError::PastFraming`] for the first element if it is past the limit, else for the last.
    pub fn check_in(&self, framing: Framing) -> Result<(), ElementError> {
        self.first.check_in(framing)?;
        self.first.nth(self.count - 1)?.check_in(framing)
    }

    /// A tag for each value: `R0-R3:f32` has `R0:f32` and `R2:f32`.
    pub fn singles(&self) -> impl Iterator<Item = Self> + use<> {
        let (tag, per_value) = (*self, self.elements_per_value());
        self.elements().step_by(per_value).map(move |first| Self { first, count: per_value, ..tag })
    }

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
        Ok(raw.chunks(self.elements_per_value()).map(|elements| self.decode_one(elements)).collect())
    }

    /// Encodes values for its elements.
    ///
    /// Returns one value for each of [`elements`](Self::elements), in their order.
    ///
    /// # Errors
    /// - [`ValueError::Count`] unless there are [`value_count`](Self::value_count) values
    /// - [`ValueError::WrongType`] for a value of another type
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
        Ok(self.parse_and_encode(text)?.0)
    }

    /// Parses values, and encodes them for the elements.
    fn parse_and_encode(&self, text: &str) -> Result<(Vec<TagValue>, Vec<Value>), ParseValueError> {
        let error = |input: &str, reason| ParseValueError::new(input, *self, reason);
        let (mut values, mut raw) = (Vec::new(), Vec::new());
        let mut take = |item: &str| {
            let item = item.trim();
            let value = self.parse_one(item).map_err(|reason| error(item, reason))?;
            self.encode_one(&value, &mut raw).map_err(|reason| error(item, reason))?;
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
        Ok((values, raw))
    }

    /// A tag of its first value.
    pub(crate) fn first_value(&self) -> Option<Self> {
        self.singles().next()
    }

    /// Its memory: the area, and the first and last addresses of its smallest parts.
    pub(crate) fn memory(&self) -> (MemoryArea, u16, u16) {
        let last = self.first.nth(self.count - 1).unwrap_or(self.first);
        // Consecutive elements touch, so each covers one step.
        let end = last.address().saturating_add(last.step() - 1);
        (self.first.symbol().area(), self.first.address(), end)
    }

    /// Values of this tag, all zero.
    pub(crate) fn zeros(&self) -> Vec<TagValue> {
        let zero = match self.first.width() {
            Width::Bit => Value::Bit(false),
            Width::Word => Value::Word(0),
            Width::DWord => Value::DWord(0),
        };
        vec![zero; self.count].chunks(self.elements_per_value()).map(|elements| self.decode_one(elements)).collect()
    }

    fn parse_one(&self, text: &str) -> Result<TagValue, ValueError> {
        if text.is_empty() {
            return Err(ValueError::Empty);
        }
        match (self.storage, self.scale) {
            (Storage::Bits(format, _), None) => format.parse(text),
            (Storage::Bits(..), Some(_)) => Ok(TagValue::Scaled(parse_scaled(text)?)),
            (Storage::Text(_), _) => Ok(TagValue::Text(text::parse(text)?)),
        }
    }

    fn decode_one(&self, elements: &[Value]) -> TagValue {
        match (self.storage, self.scale) {
            (Storage::Bits(format, order), None) => format.value(join(elements, order)),
            (Storage::Bits(format, order), Some(scale)) => TagValue::Scaled(scale.value(format, join(elements, order))),
            (Storage::Text(order), _) => {
                TagValue::Text(text::decode(elements.iter().map(|&element| low_word(bits(element))), order))
            }
        }
    }

    fn encode_one(&self, value: &TagValue, raw: &mut Vec<Value>) -> Result<(), ValueError> {
        let (bits, order) = match (self.storage, self.scale, value) {
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

    /// The type of its values, for errors: `u16 of 16 bits`, `scaled`, `text`.
    fn description(&self) -> String {
        match (self.storage, self.scale) {
            (Storage::Bits(..), Some(_)) => "scaled".to_owned(),
            (Storage::Bits(format, _), None) => format.description(),
            (Storage::Text(_), _) => "text".to_owned(),
        }
    }
}

impl From<Element> for Tag {
    /// A tag of this element, with the default type of its width.
    fn from(first: Element) -> Self {
        let (tag_type, storage) = TagType::default_of(first.width());
        Self { first, count: 1, tag_type, storage, scale: None }
    }
}

impl FromStr for Tag {
    type Err = ParseTagError;

    /// Parses `ELEMENT`, `ELEMENT:TYPE`, `FIRST-LAST` or `FIRST-LAST:TYPE`, in either case.
    ///
    /// The letters of `LAST` are optional. A [`Scale`] can follow the type.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse::parse(text).map_err(|reason| ParseTagError { input: text.to_owned(), reason })
    }
}

impl fmt::Display for Tag {
    /// The shortest text that parses to the same tag.
    ///
    /// Without the type if it is the default, and without the end of a range of one value.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.first)?;
        let implied = if self.tag_type.is_text() { 1 } else { self.elements_per_value() };
        if self.count > implied
            && let Ok(last) = self.first.nth(self.count - 1)
        {
            write!(f, "-{last}")?;
        }
        match self.scale() {
            Some(scale) => write!(f, ":{}{scale}", self.tag_type),
            None if self.tag_type == TagType::default_for(self.first.width()) => Ok(()),
            None => write!(f, ":{}", self.tag_type),
        }
    }
}

/// The storage of a value of this type, from `first` on.
fn storage(first: Element, tag_type: TagType) -> Result<Storage, TagError> {
    let storage = tag_type.storage(first.width());
    // Counters of 32 bits are read one by one, so none is a part of a longer value.
    let fits = |storage: &Storage| !first.is_counter_of_32_bits() || storage.elements_per_value(first.width()) == 1;
    storage.filter(fits).ok_or(TagError::WrongType { symbol: first.symbol(), tag_type })
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
    parts.map(move |bits| match width {
        Width::Bit => Value::Bit(bits != 0),
        Width::Word => Value::Word(low_word(bits)),
        Width::DWord => Value::DWord(low_double(bits)),
    })
}

fn bits(element: Value) -> u64 {
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

#[cfg(test)]
mod tests;
