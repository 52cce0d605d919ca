use std::fmt;

use super::kind::Shape;
use super::text::Quoted;

/// A value of a tag's type.
///
/// It prints itself as text that parses to the same: floats with as few digits as that takes, a text in double quotes
/// with everything escaped that could not be seen. The payload of a NaN is not printed.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum TagValue {
    /// The state of a discrete: `true` is on.
    Bool(bool),
    /// 16 bits, unsigned.
    U16(u16),
    /// 16 bits, signed.
    I16(i16),
    /// 32 bits, unsigned.
    U32(u32),
    /// 32 bits, signed.
    I32(i32),
    /// 32 bits, an IEEE-754 float.
    F32(f32),
    /// 16 bits, written as four hexadecimal digits.
    Hex16(u16),
    /// 32 bits, written as eight hexadecimal digits.
    Hex32(u32),
    /// A number of any type after gain and offset: see [`Scale`](super::Scale).
    Scaled(f64),
    /// The characters of a `text` or `text-hi`, without the NULs at its end.
    Text(String),
}

impl TagValue {
    /// The number that it is: 31 for `0x001F`, and none for `bool` and text.
    #[must_use]
    pub fn as_f64(&self) -> Option<f64> {
        Some(match *self {
            Self::Bool(_) | Self::Text(_) => return None,
            Self::U16(value) | Self::Hex16(value) => value.into(),
            Self::I16(value) => value.into(),
            Self::U32(value) | Self::Hex32(value) => value.into(),
            Self::I32(value) => value.into(),
            Self::F32(value) => value.into(),
            Self::Scaled(value) => value,
        })
    }

    /// Its shape and its bits, filled up with zeros; none if neither is known without the tag.
    pub(super) fn bits(&self) -> Option<(Shape, u32)> {
        Some(match *self {
            Self::Bool(on) => (Shape::Bool, on.into()),
            Self::U16(value) => (Shape::U16, value.into()),
            Self::I16(value) => (Shape::I16, value.cast_unsigned().into()),
            Self::U32(value) => (Shape::U32, value),
            Self::I32(value) => (Shape::I32, value.cast_unsigned()),
            Self::F32(value) => (Shape::F32, value.to_bits()),
            Self::Hex16(value) => (Shape::Hex16, value.into()),
            Self::Hex32(value) => (Shape::Hex32, value),
            Self::Scaled(_) | Self::Text(_) => return None,
        })
    }

    /// What it is, for errors: `u16 of 16 bits`, `scaled`, `text`.
    pub(super) fn description(&self) -> String {
        match self {
            Self::Scaled(_) => "scaled".to_owned(),
            Self::Text(_) => "text".to_owned(),
            Self::Bool(_)
            | Self::U16(_)
            | Self::I16(_)
            | Self::U32(_)
            | Self::I32(_)
            | Self::F32(_)
            | Self::Hex16(_)
            | Self::Hex32(_) => self.bits().map_or_else(String::new, |(shape, _)| shape.description()),
        }
    }
}

impl fmt::Display for TagValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(on) => u8::from(*on).fmt(f),
            Self::U16(value) => value.fmt(f),
            Self::I16(value) => value.fmt(f),
            Self::U32(value) => value.fmt(f),
            Self::I32(value) => value.fmt(f),
            // Debug has an exponent where Display would write up to 39 digits, or 309.
            Self::F32(value) => write!(f, "{value:?}"),
            Self::Scaled(value) => write!(f, "{value:?}"),
            Self::Hex16(value) => write!(f, "{value:#06X}"),
            Self::Hex32(value) => write!(f, "{value:#010X}"),
            Self::Text(text) => Quoted(text).fmt(f),
        }
    }
}
