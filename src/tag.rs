//! Tags: elements as people write them, with the type that their bits stand for.
//!
//! A [`Tag`] is an element, or a range of consecutive elements with both ends in it, and a [`TagType`]. An
//! [`Assignment`] is a tag with a value for each place. Both are parsed from text and print themselves as text that
//! parses to the same; they turn the [`Value`]s of the protocol into [`TagValue`]s and back.
//!
//! | tag | what it is |
//! |---|---|
//! | `M100` | a discrete, on or off |
//! | `R0-R9`, `R0-9` | ten registers, each a `u16` |
//! | `WM0-WM32` | the three words `WM0`, `WM16` and `WM32` |
//! | `R5:i16` | a register, signed |
//! | `DR2:i32` | a 32-bit register, signed |
//! | `R100:f32` | the registers `R100`, the low word, and `R101` as one float |
//! | `R0-R9:f32` | the same ten registers as five floats |
//! | `WY8:hex` | 16 outputs as four hexadecimal digits |
//! | `R5:i16*0.1-40` | a register, signed, times a gain of 0.1, plus an offset of -40; see [`Scale`] |
//! | `R0-R9:u16*0.01`, `R100:f32+3` | every number but `hex` can have a gain, an offset or both |
//! | `R0-R9:text` | ten registers as one text of up to 20 characters, the low byte of each first |
//! | `R0-R9:text-hi` | the same, the high byte first |
//!
//! A text is read and written by one request, so it has at most 64 registers. Its characters are the 256 of Latin-1, and
//! NULs at its end are not seen; in an assignment it stands in double quotes, which may be left out around plain words.
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
//! assert_eq!(tag.decode(&[Value::Word(0x4241), Value::Word(0x0043)])?, [TagValue::Text("ABC".to_owned())]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! This module does no I/O, and nothing in it panics, whatever the text. Source: protocol reference, section 3, for
//! the order of words in 32 bits.

mod assignment;
mod error;
mod kind;
mod parse;
mod scale;
mod text;
mod types;
mod value;

use std::fmt;
use std::str::FromStr;

pub use assignment::Assignment;
pub use error::{ParseAssignmentError, ParseTagError, ParseTagTypeError, ParseValueError, TagError, ValueError};
pub use scale::{Scale, ScaleError};
pub use types::TagType;
pub use value::TagValue;

use self::kind::{Kind, Shape, high, low};
use crate::command::{MAX_UNITS, Value};
use crate::element::{Element, Width};

/// Elements, and the type that their bits stand for: see [the module](self).
///
/// It has at least one value, and all of its elements exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Tag {
    first: Element,
    /// How many elements, not values.
    count: usize,
    tag_type: TagType,
    kind: Kind,
}

impl Tag {
    /// `values` values of a type, one after the other from `first` on. A text of this many values is of one, and one
    /// register long; for a longer one there is [`spanning`](Self::spanning).
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
    /// [`TagError::WrongType`], [`TagError::NoValues`], [`TagError::SeveralTexts`] and [`TagError::PastTheEnd`].
    pub fn new(first: impl Into<Element>, tag_type: TagType, values: usize) -> Result<Self, TagError> {
        let first = first.into();
        let kind = kind(first, tag_type)?;
        if tag_type.is_text() && values > 1 {
            return Err(TagError::SeveralTexts { first });
        }
        let per_value = if kind.bits() > first.width().bits() { 2 } else { 1 };
        Self::checked(first, values.saturating_mul(per_value), tag_type, kind)
    }

    /// So many elements from `first` on: as many values of the type as they hold, or one text.
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
    /// [`TagError::WrongType`], [`TagError::NoValues`], [`TagError::Uneven`], [`TagError::LongText`] and
    /// [`TagError::PastTheEnd`].
    pub fn spanning(first: impl Into<Element>, tag_type: TagType, elements: usize) -> Result<Self, TagError> {
        let first = first.into();
        let kind = kind(first, tag_type)?;
        if kind.bits() > first.width().bits() && !elements.is_multiple_of(2) {
            return Err(TagError::Uneven { count: elements, tag_type });
        }
        if tag_type.is_text() && elements > MAX_UNITS {
            return Err(TagError::LongText { registers: elements, max: MAX_UNITS });
        }
        Self::checked(first, elements, tag_type, kind)
    }

    /// The same elements, their numbers after gain and offset.
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
    /// [`TagError::NotScalable`] for `bool`, `hex` and texts.
    pub fn scaled(self, scale: Scale) -> Result<Self, TagError> {
        match self.kind {
            Kind::Plain(shape) | Kind::Scaled(shape, _) if self.tag_type.is_scalable() => {
                Ok(Self { kind: Kind::Scaled(shape, scale), ..self })
            }
            Kind::Plain(_) | Kind::Scaled(..) | Kind::Text(_) => Err(TagError::NotScalable { tag_type: self.tag_type }),
        }
    }

    fn checked(first: Element, count: usize, tag_type: TagType, kind: Kind) -> Result<Self, TagError> {
        let last = count.checked_sub(1).ok_or(TagError::NoValues)?;
        match first.nth(last) {
            Ok(_) => Ok(Self { first, count, tag_type, kind }),
            Err(_) => Err(TagError::PastTheEnd { first, count }),
        }
    }

    /// The first element.
    #[must_use]
    pub fn first(&self) -> Element {
        self.first
    }

    /// What the bits stand for.
    #[must_use]
    pub fn tag_type(&self) -> TagType {
        self.tag_type
    }

    /// Gain and offset of its numbers, if it has them.
    #[must_use]
    pub fn scale(&self) -> Option<Scale> {
        self.kind.scale()
    }

    /// How many elements it has.
    #[must_use]
    pub fn element_count(&self) -> usize {
        self.count
    }

    /// How many values it has: as many as elements, half as many where a value takes two, and one if it is a text.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.count / self.elements_per_value()
    }

    /// How many elements one value takes: 2 for 32 bits on 16-bit registers, all of them for a text, else 1.
    #[must_use]
    pub fn elements_per_value(&self) -> usize {
        match self.kind {
            Kind::Text(_) => self.count,
            kind @ (Kind::Plain(_) | Kind::Scaled(..)) if kind.bits() > self.first.width().bits() => 2,
            Kind::Plain(_) | Kind::Scaled(..) => 1,
        }
    }

    /// Its elements, in order: what is to be read, or written.
    pub fn elements(&self) -> impl Iterator<Item = Element> + use<> {
        let first = self.first;
        (0..self.count).filter_map(move |n| first.nth(n).ok())
    }

    /// A tag for each value: `R0-R3:f32` has `R0:f32` and `R2:f32`.
    pub fn singles(&self) -> impl Iterator<Item = Self> + use<> {
        let (tag, per_value) = (*self, self.elements_per_value());
        self.elements().step_by(per_value).map(move |first| Self { first, count: per_value, ..tag })
    }

    /// What the elements hold, as values of the type.
    ///
    /// `raw` is what was read from [`elements`](Self::elements), in their order.
    ///
    /// # Errors
    /// [`ValueError::Count`] unless there is one for each element, [`ValueError::WrongWidth`] when one is not as wide
    /// as the elements are.
    pub fn decode(&self, raw: &[Value]) -> Result<Vec<TagValue>, ValueError> {
        if raw.len() != self.count {
            return Err(ValueError::Count { tag: *self, expected: self.count, given: raw.len() });
        }
        if let Some(&value) = raw.iter().find(|value| value.width() != self.first.width()) {
            return Err(ValueError::WrongWidth { tag: *self, value });
        }
        Ok(raw.chunks(self.elements_per_value()).map(|elements| self.kind.value(elements)).collect())
    }

    /// What the elements are to hold, for these values.
    ///
    /// The result goes to [`elements`](Self::elements), in their order.
    ///
    /// # Errors
    /// - [`ValueError::Count`] unless there are [`value_count`](Self::value_count) of them
    /// - [`ValueError::WrongType`] when one is of another type
    /// - [`ValueError::RawOutOfRange`] when one comes from no number that the elements can hold, by the scale
    /// - [`ValueError::TooLong`] and [`ValueError::NotLatin1`] when a text cannot be held
    pub fn encode(&self, values: &[TagValue]) -> Result<Vec<Value>, ValueError> {
        if values.len() != self.value_count() {
            return Err(ValueError::Count { tag: *self, expected: self.value_count(), given: values.len() });
        }
        let mut raw = Vec::with_capacity(self.count);
        values.iter().try_for_each(|value| self.encode_one(value, &mut raw))?;
        Ok(raw)
    }

    /// Reads the values of this tag: as many as it has, with commas between.
    ///
    /// - numbers: decimal, with a sign if need be; `f32` also with a point or an exponent, `nan` and `inf`
    /// - `bool`: `0` `1` `false` `true` `off` `on`
    /// - every type: the bits after `0x`, so `0xFFFF` as `i16` is -1; `hex` takes no other form, for nobody can know
    ///   what `10` was meant to be, and `f32` takes all 8 digits
    /// - scaled: decimal, with a point or an exponent, `nan` and `inf`; the nearest raw number is what is written, and
    ///   bits are not taken
    /// - a text: in double quotes, with `\\` before `"` and `\\`, and `\\n`, `\\r`, `\\t`, `\\0` or `\\x` and two hexadecimal
    ///   digits for what cannot be seen; without quotes if it has no such character, no comma and no blank at its ends
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
    /// [`ParseValueError`]: the value, and the rule that it breaks.
    pub fn parse_values(&self, text: &str) -> Result<Vec<TagValue>, ParseValueError> {
        Ok(self.parse_and_encode(text)?.0)
    }

    /// The values that the text names, and what the elements are to hold for them.
    fn parse_and_encode(&self, text: &str) -> Result<(Vec<TagValue>, Vec<Value>), ParseValueError> {
        let error = |input: &str, reason| ParseValueError::new(input, *self, reason);
        let (mut values, mut raw) = (Vec::new(), Vec::new());
        let mut take = |item: &str| {
            let item = item.trim();
            let value = self.kind.parse(item).map_err(|reason| error(item, reason))?;
            self.encode_one(&value, &mut raw).map_err(|reason| error(item, reason))?;
            values.push(value);
            Ok(())
        };
        if self.tag_type.is_text() {
            // Whatever stands in it: commas that are not in quotes are refused as such.
            take(text)?;
        } else {
            // Counted first, so that the time it takes is bounded by the tag.
            let given = text.split(',').count();
            if given != self.value_count() {
                return Err(error(text, ValueError::Count { tag: *self, expected: self.value_count(), given }));
            }
            text.split(',').try_for_each(take)?;
        }
        Ok((values, raw))
    }

    fn encode_one(&self, value: &TagValue, raw: &mut Vec<Value>) -> Result<(), ValueError> {
        let bits = match (self.kind, value) {
            (Kind::Text(order), TagValue::Text(text)) => {
                raw.extend(text::encode(text, self.count, order)?.into_iter().map(Value::Word));
                return Ok(());
            }
            (Kind::Scaled(shape, scale), &TagValue::Scaled(value)) => {
                let bits = scale.bits(shape, value);
                bits.ok_or(ValueError::RawOutOfRange { value, raw: scale.raw(value), tag_type: self.tag_type })?
            }
            (kind, value) => match value.bits() {
                Some((shape, bits)) if kind == Kind::Plain(shape) => bits,
                _ => return Err(ValueError::WrongType { tag: *self, value: value.clone() }),
            },
        };
        match (self.first.width(), self.elements_per_value()) {
            (Width::Bit, _) => raw.push(Value::Bit(bits != 0)),
            (Width::Word, 1) => raw.push(Value::Word(low(bits))),
            (Width::Word, _) => raw.extend([Value::Word(low(bits)), Value::Word(high(bits))]),
            (Width::DWord, _) => raw.push(Value::DWord(bits)),
        }
        Ok(())
    }
}

impl From<Element> for Tag {
    /// The element alone, with the type that is the default for it.
    fn from(first: Element) -> Self {
        let (tag_type, shape) = match first.width() {
            Width::Bit => (TagType::Bool, Shape::Bool),
            Width::Word => (TagType::U16, Shape::U16),
            Width::DWord => (TagType::U32, Shape::U32),
        };
        Self { first, count: 1, tag_type, kind: Kind::Plain(shape) }
    }
}

impl FromStr for Tag {
    type Err = ParseTagError;

    /// Reads `ELEMENT`, `ELEMENT:TYPE`, `FIRST-LAST` or `FIRST-LAST:TYPE`, in either case; the letters of `LAST` may
    /// be left out. Behind the type there can be a [`Scale`].
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse::parse(text).map_err(|reason| ParseTagError { input: text.to_owned(), reason })
    }
}

impl fmt::Display for Tag {
    /// The shortest text that parses to the same: the type is left out where it is the default, and the range where
    /// the first element and the type tell it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.first)?;
        let told = if self.tag_type.is_text() { 1 } else { self.elements_per_value() };
        if self.count > told
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

/// What values of a type are made of on these elements.
fn kind(first: Element, tag_type: TagType) -> Result<Kind, TagError> {
    tag_type.kind(first.width()).ok_or(TagError::WrongType { symbol: first.symbol(), tag_type })
}

#[cfg(test)]
mod tests;
