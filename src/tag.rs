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
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! This module does no I/O, and nothing in it panics, whatever the text. Source: protocol reference, section 3, for
//! the order of words in 32 bits.

mod error;
mod types;

use std::fmt;
use std::str::FromStr;

pub use error::{ParseAssignmentError, ParseTagError, ParseTagTypeError, ParseValueError, TagError, ValueError};
pub use types::{TagType, TagValue};

use self::types::{Shape, high, low};
use crate::command::Value;
use crate::element::{Element, Symbol, Width};

/// Elements, and the type that their bits stand for: see [the module](self).
///
/// It has at least one value, and all of its elements exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Tag {
    first: Element,
    /// How many elements, not values.
    count: usize,
    tag_type: TagType,
    shape: Shape,
}

impl Tag {
    /// `values` values of a type, one after the other from `first` on.
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
    /// [`TagError::WrongType`], [`TagError::NoValues`] and [`TagError::PastTheEnd`].
    pub fn new(first: impl Into<Element>, tag_type: TagType, values: usize) -> Result<Self, TagError> {
        let first = first.into();
        let Some(shape) = tag_type.shape(first.width()) else {
            return Err(TagError::WrongType { symbol: first.symbol(), tag_type });
        };
        let per_value = if shape.bits() > first.width().bits() { 2 } else { 1 };
        let count = values.saturating_mul(per_value);
        let last = count.checked_sub(1).ok_or(TagError::NoValues)?;
        match first.nth(last) {
            Ok(_) => Ok(Self { first, count, tag_type, shape }),
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

    /// How many elements it has.
    #[must_use]
    pub fn element_count(&self) -> usize {
        self.count
    }

    /// How many values it has: as many as elements, or half as many where a value takes two.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.count / self.elements_per_value()
    }

    /// How many elements one value takes: 2 for 32 bits on 16-bit registers, else 1.
    #[must_use]
    pub fn elements_per_value(&self) -> usize {
        if self.shape.bits() > self.first.width().bits() { 2 } else { 1 }
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
        Ok(raw.chunks(self.elements_per_value()).map(|elements| self.shape.value(join(elements))).collect())
    }

    /// What the elements are to hold, for these values.
    ///
    /// The result goes to [`elements`](Self::elements), in their order.
    ///
    /// # Errors
    /// [`ValueError::Count`] unless there are [`value_count`](Self::value_count) of them, [`ValueError::WrongType`]
    /// when one is of another type.
    pub fn encode(&self, values: &[TagValue]) -> Result<Vec<Value>, ValueError> {
        self.check(values)?;
        Ok(self.split(values))
    }

    /// Reads the values of this tag: as many as it has, with commas between.
    ///
    /// - numbers: decimal, with a sign if need be; `f32` also with a point or an exponent, `nan` and `inf`
    /// - `bool`: `0` `1` `false` `true` `off` `on`
    /// - every type: the bits after `0x`, so `0xFFFF` as `i16` is -1; `hex` takes no other form, for nobody can know
    ///   what `10` was meant to be, and `f32` takes all 8 digits
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
        let error = |input: &str, reason| ParseValueError { input: input.to_owned(), tag: *self, reason };
        // Counted first, so that the time it takes is bounded by the tag.
        let given = text.split(',').count();
        if given != self.value_count() {
            return Err(error(text, ValueError::Count { tag: *self, expected: self.value_count(), given }));
        }
        let one = |item: &str| self.shape.parse(item.trim()).map_err(|reason| error(item.trim(), reason));
        text.split(',').map(one).collect()
    }

    fn check(&self, values: &[TagValue]) -> Result<(), ValueError> {
        if values.len() != self.value_count() {
            return Err(ValueError::Count { tag: *self, expected: self.value_count(), given: values.len() });
        }
        match values.iter().find(|value| value.shape() != self.shape) {
            Some(&value) => Err(ValueError::WrongType { tag: *self, value }),
            None => Ok(()),
        }
    }

    fn split(&self, values: &[TagValue]) -> Vec<Value> {
        let mut raw = Vec::with_capacity(self.count);
        for bits in values.iter().map(|value| value.bits()) {
            match (self.first.width(), self.elements_per_value()) {
                (Width::Bit, _) => raw.push(Value::Bit(bits != 0)),
                (Width::Word, 1) => raw.push(Value::Word(low(bits))),
                (Width::Word, _) => raw.extend([Value::Word(low(bits)), Value::Word(high(bits))]),
                (Width::Double, _) => raw.push(Value::Double(bits)),
            }
        }
        raw
    }
}

impl From<Element> for Tag {
    /// The element alone, with the type that is the default for it.
    fn from(first: Element) -> Self {
        let (tag_type, shape) = match first.width() {
            Width::Bit => (TagType::Bool, Shape::Bool),
            Width::Word => (TagType::U16, Shape::U16),
            Width::Double => (TagType::U32, Shape::U32),
        };
        Self { first, count: 1, tag_type, shape }
    }
}

impl FromStr for Tag {
    type Err = ParseTagError;

    /// Reads `ELEMENT`, `ELEMENT:TYPE`, `FIRST-LAST` or `FIRST-LAST:TYPE`, in either case; the letters of `LAST` may
    /// be left out.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse_tag(text).map_err(|reason| ParseTagError { input: text.to_owned(), reason })
    }
}

impl fmt::Display for Tag {
    /// The shortest text that parses to the same: the type is left out where it is the default, and the range where
    /// there is one value.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.first)?;
        if let (2.., Some(last)) = (self.value_count(), self.elements().last()) {
            write!(f, "-{last}")?;
        }
        if self.tag_type != TagType::default_for(self.first.width()) {
            write!(f, ":{}", self.tag_type)?;
        }
        Ok(())
    }
}

/// A tag and its values: `R5=7`, `R0-R2=1,2,3`, `R100:f32=-1.5`.
#[derive(Clone, Debug, PartialEq)]
pub struct Assignment {
    tag: Tag,
    values: Vec<TagValue>,
}

impl Assignment {
    /// Gives these values to this tag.
    ///
    /// # Errors
    /// [`ValueError::Count`] unless there is one for each of the tag's, [`ValueError::WrongType`] when one is of
    /// another type.
    pub fn new(tag: Tag, values: impl Into<Vec<TagValue>>) -> Result<Self, ValueError> {
        let values = values.into();
        tag.check(&values)?;
        Ok(Self { tag, values })
    }

    /// The tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    /// The values: as many as the tag has, all of its type.
    #[must_use]
    pub fn values(&self) -> &[TagValue] {
        &self.values
    }

    /// What the tag's [`elements`](Tag::elements) are to hold, in their order.
    #[must_use]
    pub fn encode(&self) -> Vec<Value> {
        self.tag.split(&self.values)
    }
}

impl FromStr for Assignment {
    type Err = ParseAssignmentError;

    /// Reads `TAG=VALUE`, and `TAG=VALUE,VALUE…` for a tag of several values; see [`Tag::parse_values`].
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let Some((tag, values)) = text.split_once('=') else {
            return Err(ParseAssignmentError::NoValue { input: text.to_owned() });
        };
        let tag: Tag = tag.parse()?;
        Ok(Self { tag, values: tag.parse_values(values)? })
    }
}

impl fmt::Display for Assignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.tag)?;
        let mut separator = '=';
        for value in &self.values {
            write!(f, "{separator}{value}")?;
            separator = ',';
        }
        Ok(())
    }
}

fn parse_tag(text: &str) -> Result<Tag, TagError> {
    let (elements, tag_type) = match text.split_once(':') {
        Some((elements, name)) => (elements, Some(name.parse::<TagType>()?)),
        None => (text, None),
    };
    let (first, last) = match elements.split_once('-') {
        Some((first, last)) => (Element::parse(first)?, Some(last)),
        None => (Element::parse(elements)?, None),
    };
    let tag_type = tag_type.unwrap_or(TagType::default_for(first.width()));
    let Some(last) = last else {
        return Tag::new(first, tag_type, 1);
    };
    let Some(per_value) = tag_type.elements_per_value(first.width()) else {
        return Err(TagError::WrongType { symbol: first.symbol(), tag_type });
    };
    let count = elements_between(first, parse_last(first.symbol(), last)?)?;
    if !count.is_multiple_of(per_value) {
        return Err(TagError::Uneven { count, tag_type });
    }
    Tag::new(first, tag_type, count / per_value)
}

/// The end of a range: `R9`, or `9` after an `R`.
fn parse_last(first: Symbol, text: &str) -> Result<Element, TagError> {
    if text.is_empty() || text.starts_with(|c: char| c.is_ascii_digit()) {
        return Ok(Element::parse(&format!("{first}{text}"))?);
    }
    let last = Element::parse(text)?;
    match last.symbol() {
        symbol if symbol == first => Ok(last),
        symbol => Err(TagError::TwoSymbols { first, last: symbol }),
    }
}

fn elements_between(first: Element, last: Element) -> Result<usize, TagError> {
    let Some(distance) = last.address().checked_sub(first.address()) else {
        return Err(TagError::Backwards { first, last });
    };
    let step = first.symbol().step();
    if !distance.is_multiple_of(step) {
        return Err(TagError::OffStep { first, last });
    }
    Ok(usize::from(distance / step) + 1)
}

/// The bits of one value, from the elements that hold it: the low word first.
fn join(elements: &[Value]) -> u32 {
    elements.iter().rev().fold(0, |bits, element| match *element {
        Value::Bit(on) => on.into(),
        Value::Word(word) => bits << 16 | u32::from(word),
        Value::Double(double) => double,
    })
}

#[cfg(test)]
mod tests;
