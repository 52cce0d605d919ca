//! Tags: elements with a data type, written as text.
//!
//! A [`Tag`] is an element or a range of consecutive elements, both ends included, with a
//! [`TagType`]. An [`Assignment`] is a tag with its values. Both are parsed from text, and display
//! as text that parses to the same. They convert the [`Value`](crate::Value)s of the
//! protocol to [`TagValue`]s and back.
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
//! | `R5.3`, `R5.0-R5.7` | a bit of a register, or eight; bit 0 is the lowest |
//! | `WM16.3` | the discrete `M19`, which is bit 3 of the word |
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
mod bits;
mod codec;
mod coding;
mod convert;
mod decimal;
mod error;
mod fields;
mod macros;
mod parse;
mod scale;
#[cfg(feature = "serde")]
mod seed;
mod sets;
mod text;
mod types;

use std::fmt;
use std::str::FromStr;

pub use assignment::Assignment;
pub use convert::{FromTag, IntoTagValues};
pub use error::{
    GivenKind, ParseAssignmentError, ParseTagError, ParseTagTypeError, ParseValueError, TagAccessError, TagError,
    ValueError,
};
pub use fields::{Field, Tags};
#[doc(hidden)]
pub use fields::{fits_type, takes_type};
pub use scale::{Scale, ScaleError};
#[cfg(feature = "serde")]
pub use seed::ValuesSeed;
pub use sets::{FromTags, IntoAssignment, IntoAssignments, IntoTag, One, Several, TagSet};
pub use types::{TagType, TagValue};

use self::bits::BitRange;
use self::types::{Storage, ValueKind};
use crate::command::MAX_UNITS;
use crate::element::{Element, ElementError, MemoryArea};
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
        Self::of_values(first.into(), tag_type, values)
    }

    /// [`new`](Self::new), in constants.
    const fn of_values(first: Element, tag_type: TagType, values: usize) -> Result<Self, TagError> {
        let storage = match storage(first, tag_type) {
            Ok(storage) => storage,
            Err(error) => return Err(error),
        };
        if tag_type.is_text() && values > 1 {
            return Err(TagError::SeveralTexts { first });
        }
        // On overflow, the elements are past the last address, too.
        let elements = values.saturating_mul(storage.elements_per_value(first.width()));
        Self::checked(first, elements, tag_type)
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
        Self::of_elements(first.into(), tag_type, elements)
    }

    /// [`spanning`](Self::spanning), in constants.
    const fn of_elements(first: Element, tag_type: TagType, elements: usize) -> Result<Self, TagError> {
        let per_value = match storage(first, tag_type) {
            Ok(storage) => storage.elements_per_value(first.width()),
            Err(error) => return Err(error),
        };
        if !elements.is_multiple_of(per_value) {
            return Err(TagError::Uneven { count: elements, per_value, tag_type });
        }
        if tag_type.is_text() && elements > MAX_UNITS {
            return Err(TagError::LongText { registers: elements, max: MAX_UNITS });
        }
        Self::checked(first, elements, tag_type)
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
    pub const fn scaled(self, scale: Scale) -> Result<Self, TagError> {
        if !self.tag_type.is_scalable() {
            return Err(TagError::NotScalable { tag_type: self.tag_type });
        }
        Ok(Self { scale: Some(scale), ..self })
    }

    const fn checked(first: Element, count: usize, tag_type: TagType) -> Result<Self, TagError> {
        let Some(last) = count.checked_sub(1) else {
            return Err(TagError::NoValues);
        };
        match (storage(first, tag_type), first.nth(last)) {
            (Ok(storage), Ok(_)) => Ok(Self { first, count, tag_type, storage, scale: None }),
            (Ok(_), Err(_)) => Err(TagError::PastTheEnd { first, count }),
            (Err(error), _) => Err(error),
        }
    }

    /// Parses a tag as [`FromStr`] does, in constants: for [`tag!`](crate::tag!).
    ///
    /// The numbers of a scale have at most 15 digits here, and exponents from -22 to 22.
    ///
    /// # Errors
    /// The rule that the text breaks.
    pub const fn parse(text: &str) -> Result<Self, TagError> {
        parse::parse_const(text)
    }

    /// The first element.
    #[must_use]
    pub const fn first(&self) -> Element {
        self.first
    }

    /// The data type.
    #[must_use]
    pub const fn tag_type(&self) -> TagType {
        self.tag_type
    }

    /// Gain and offset, if it has them.
    #[must_use]
    pub const fn scale(&self) -> Option<Scale> {
        self.scale
    }

    /// Number of elements.
    #[must_use]
    pub const fn element_count(&self) -> usize {
        self.count
    }

    /// Number of values; 1 for a text.
    #[must_use]
    pub const fn value_count(&self) -> usize {
        match self.storage {
            Storage::BitsOf(bits) => bits.count as usize,
            Storage::Bits(..) | Storage::Text(_) => self.slot_count(),
        }
    }

    /// Number of elements per value: 2 for 32 bits and 4 for 64 bits on 16-bit registers, 2 for 64
    /// bits on 32-bit registers, all for a text, else 1. All bits of a register come from one.
    #[must_use]
    pub const fn elements_per_value(&self) -> usize {
        match self.storage {
            Storage::Text(_) => self.count,
            Storage::Bits(..) | Storage::BitsOf(_) => self.storage.elements_per_value(self.first.width()),
        }
    }

    /// The kind of its values.
    const fn kind(&self) -> ValueKind {
        match (self.storage, self.scale) {
            (Storage::Bits(..), Some(_)) => ValueKind::Scaled,
            (Storage::Bits(format, _), None) => format.kind(),
            (Storage::Text(_), _) => ValueKind::Text,
            (Storage::BitsOf(_), _) => ValueKind::Bool,
        }
    }

    /// Number of parts that are read as a whole: values, or the register of bits.
    pub(crate) const fn slot_count(&self) -> usize {
        self.count / self.elements_per_value()
    }

    /// Its elements in order, to be read or written.
    pub fn elements(&self) -> impl Iterator<Item = Element> + use<> {
        self.first.run(self.count)
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
        let tag = *self;
        (0..self.value_count()).filter_map(move |n| tag.single(n))
    }

    /// A tag of its value with this number.
    fn single(&self, number: usize) -> Option<Self> {
        if let Storage::BitsOf(bits) = self.storage {
            let first = bits.first.checked_add(u8::try_from(number).ok()?)?;
            return Some(Self { storage: Storage::BitsOf(BitRange { first, count: 1 }), ..*self });
        }
        let count = self.elements_per_value();
        Some(Self { first: self.first.nth(number.checked_mul(count)?).ok()?, count, ..*self })
    }

    /// A tag of its first value.
    pub(crate) fn first_value(&self) -> Option<Self> {
        self.single(0)
    }

    /// Its memory: the area, and the first and last addresses of its smallest parts.
    pub(crate) fn memory(&self) -> (MemoryArea, u16, u16) {
        let last = self.first.nth(self.count - 1).unwrap_or(self.first);
        (self.first.symbol().area(), self.first.address(), last.covered().1)
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
        if let Storage::BitsOf(bits) = self.storage {
            write!(f, "{}.{}", self.first, bits.first)?;
            return match bits.count.saturating_add(bits.first) {
                last if bits.count > 1 => write!(f, "-{}.{}", self.first, last - 1),
                _ => Ok(()),
            };
        }
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
const fn storage(first: Element, tag_type: TagType) -> Result<Storage, TagError> {
    match tag_type.storage(first.width()) {
        // Counters of 32 bits are read one by one, so none is a part of a longer value.
        Some(storage) if !first.is_counter_of_32_bits() || storage.elements_per_value(first.width()) == 1 => {
            Ok(storage)
        }
        Some(_) | None => Err(TagError::WrongType { symbol: first.symbol(), tag_type }),
    }
}

#[cfg(test)]
mod tests;
