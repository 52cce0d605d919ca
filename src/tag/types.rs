use std::fmt;
use std::str::FromStr;

use super::{ParseTagTypeError, ValueError};
use crate::element::Width;

// One row a type.
//
// - discrete, word, double: what a value is made of on elements of that width; `-` where the type does not exist
// - takes:                  how values are written, for the documentation and for errors
types! {
    // variant  name    discrete  word   double  takes
    Bool        "bool"  Bool      -      -       "0 or 1, false or true, off or on";
    U16         "u16"   -         U16    -       "0 to 65535";
    I16         "i16"   -         I16    -       "-32768 to 32767";
    U32         "u32"   -         U32    U32     "0 to 4294967295";
    I32         "i32"   -         I32    I32     "-2147483648 to 2147483647";
    F32         "f32"   -         F32    F32     "-3.4028235e38 to 3.4028235e38, nan and inf";
    Hex         "hex"   -         Hex16  Hex32   "0x and hexadecimal digits, up to 4 for 16 bits and up to 8 for 32";
}

impl TagType {
    /// The type of a tag that names none: `bool` for a discrete, `u16` for a 16-bit register, `u32` for 32 bits.
    #[must_use]
    pub const fn default_for(width: Width) -> Self {
        match width {
            Width::Bit => Self::Bool,
            Width::Word => Self::U16,
            Width::Double => Self::U32,
        }
    }

    /// How many elements of this width one value takes: 2 for 32 bits on 16-bit registers, else 1; `None` where the
    /// type does not exist.
    #[must_use]
    pub const fn elements_per_value(self, width: Width) -> Option<usize> {
        match self.shape(width) {
            Some(shape) if shape.bits() > width.bits() => Some(2),
            Some(_) => Some(1),
            None => None,
        }
    }
}

impl fmt::Display for TagType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl FromStr for TagType {
    type Err = ParseTagTypeError;

    /// Reads the name of a type, in either case.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL.iter().find(|tag_type| tag_type.as_str().eq_ignore_ascii_case(text));
        found.copied().ok_or_else(|| ParseTagTypeError(text.to_owned()))
    }
}

/// A value of a tag's type.
///
/// It prints itself as text that parses to the same, floats with as few digits as that takes. The payload of a NaN is
/// not printed.
#[derive(Clone, Copy, Debug, PartialEq)]
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
}

impl TagValue {
    /// The type it is of.
    #[must_use]
    pub fn tag_type(self) -> TagType {
        match self {
            Self::Bool(_) => TagType::Bool,
            Self::U16(_) => TagType::U16,
            Self::I16(_) => TagType::I16,
            Self::U32(_) => TagType::U32,
            Self::I32(_) => TagType::I32,
            Self::F32(_) => TagType::F32,
            Self::Hex16(_) | Self::Hex32(_) => TagType::Hex,
        }
    }

    pub fn as_f64(&self) -> Option<f64> {
        Some(match *self {
            Self::Bool(_) => return None,
            Self::U16(value) | Self::Hex16(value) => value.into(),
            Self::I16(value) => value.into(),
            Self::U32(value) | Self::Hex32(value) => value.into(),
            Self::I32(value) => value.into(),
            Self::F32(value) => value.into(),
        })
    }

    /// Its bits, filled up with zeros.
    pub(super) fn bits(self) -> u32 {
        match self {
            Self::Bool(on) => on.into(),
            Self::U16(value) | Self::Hex16(value) => value.into(),
            Self::I16(value) => value.cast_unsigned().into(),
            Self::U32(value) | Self::Hex32(value) => value,
            Self::I32(value) => value.cast_unsigned(),
            Self::F32(value) => value.to_bits(),
        }
    }

    pub(super) fn shape(self) -> Shape {
        match self {
            Self::Bool(_) => Shape::Bool,
            Self::U16(_) => Shape::U16,
            Self::I16(_) => Shape::I16,
            Self::U32(_) => Shape::U32,
            Self::I32(_) => Shape::I32,
            Self::F32(_) => Shape::F32,
            Self::Hex16(_) => Shape::Hex16,
            Self::Hex32(_) => Shape::Hex32,
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
            // Debug has an exponent where Display would write up to 39 digits.
            Self::F32(value) => write!(f, "{value:?}"),
            Self::Hex16(value) => write!(f, "{value:#06X}"),
            Self::Hex32(value) => write!(f, "{value:#010X}"),
        }
    }
}

/// What one value is made of: a type on elements of a width.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum Shape {
    Bool,
    U16,
    I16,
    U32,
    I32,
    F32,
    Hex16,
    Hex32,
}

impl Shape {
    pub(super) const fn bits(self) -> u32 {
        match self {
            Self::Bool => 1,
            Self::U16 | Self::I16 | Self::Hex16 => 16,
            Self::U32 | Self::I32 | Self::F32 | Self::Hex32 => 32,
        }
    }

    pub(super) fn value(self, bits: u32) -> TagValue {
        match self {
            Self::Bool => TagValue::Bool(bits != 0),
            Self::U16 => TagValue::U16(low(bits)),
            Self::I16 => TagValue::I16(low(bits).cast_signed()),
            Self::U32 => TagValue::U32(bits),
            Self::I32 => TagValue::I32(bits.cast_signed()),
            Self::F32 => TagValue::F32(f32::from_bits(bits)),
            Self::Hex16 => TagValue::Hex16(low(bits)),
            Self::Hex32 => TagValue::Hex32(bits),
        }
    }

    pub(super) fn parse(self, text: &str) -> Result<TagValue, ValueError> {
        if text.is_empty() {
            return Err(ValueError::Empty);
        }
        if let Some(digits) = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
            return Ok(self.value(self.parse_bits(digits)?));
        }
        Ok(match self {
            Self::Bool => TagValue::Bool(parse_state(text)?),
            Self::U16 => TagValue::U16(parse_integer(text, TagType::U16)?),
            Self::I16 => TagValue::I16(parse_integer(text, TagType::I16)?),
            Self::U32 => TagValue::U32(parse_integer(text, TagType::U32)?),
            Self::I32 => TagValue::I32(parse_integer(text, TagType::I32)?),
            Self::F32 => TagValue::F32(parse_float(text)?),
            Self::Hex16 | Self::Hex32 => return Err(ValueError::NotMarked { bits: self.bits() }),
        })
    }

    fn parse_bits(self, digits: &str) -> Result<u32, ValueError> {
        if self == Self::Bool {
            return match digits {
                "0" => Ok(0),
                "1" => Ok(1),
                _ => Err(ValueError::Malformed { tag_type: TagType::Bool }),
            };
        }
        let max = self.bits() / 4;
        let is_hex = (1..=max as usize).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_hexdigit());
        let bits = u32::from_str_radix(digits, 16).ok().filter(|_| is_hex).ok_or(ValueError::BadHex { max })?;
        if self == Self::F32 && digits.len() < 8 { Err(ValueError::PartialBits) } else { Ok(bits) }
    }
}

fn parse_state(text: &str) -> Result<bool, ValueError> {
    match text.to_ascii_lowercase().as_str() {
        "0" | "false" | "off" => Ok(false),
        "1" | "true" | "on" => Ok(true),
        _ => Err(ValueError::Malformed { tag_type: TagType::Bool }),
    }
}

fn parse_integer<T: TryFrom<i64>>(text: &str, tag_type: TagType) -> Result<T, ValueError> {
    let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
    if digits.is_empty() || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return Err(ValueError::Malformed { tag_type });
    }
    // Digits alone are left, so what does not fit an i64 is too large for every type.
    let number: i64 = text.parse().map_err(|_| ValueError::OutOfRange { tag_type })?;
    T::try_from(number).map_err(|_| ValueError::OutOfRange { tag_type })
}

fn parse_float(text: &str) -> Result<f32, ValueError> {
    let tag_type = TagType::F32;
    let number: f32 = text.parse().map_err(|_| ValueError::Malformed { tag_type })?;
    // `inf` is meant; `1e39` that has become it is not.
    if number.is_infinite() && text.bytes().any(|b| b.is_ascii_digit()) {
        return Err(ValueError::OutOfRange { tag_type });
    }
    Ok(number)
}

#[allow(clippy::cast_possible_truncation, reason = "the low half is what is asked for")]
pub(super) fn low(bits: u32) -> u16 {
    bits as u16
}

pub(super) fn high(bits: u32) -> u16 {
    low(bits >> 16)
}

macro_rules! types {
    ($($variant:ident $name:literal $discrete:tt $word:tt $double:tt $takes:literal;)*) => {
        /// What the bits of a tag stand for.
        ///
        /// Discretes are `bool` and nothing else. A 16-bit register has every other type, and 32 bits take two of
        /// them, the low word first. A 32-bit register has every type of 32 bits, and `hex`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[non_exhaustive]
        pub enum TagType {
            $(
                #[doc = concat!("`", $name, "`: ", $takes, ".")]
                $variant,
            )*
        }

        impl TagType {
            /// Every type.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// Its name, as in a tag.
            #[must_use]
            pub const fn as_str(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }

            pub(super) const fn takes(self) -> &'static str {
                match self {
                    $(Self::$variant => $takes,)*
                }
            }

            /// What a value of the type is made of on elements of this width; `None` where the type does not exist.
            pub(super) const fn shape(self, width: Width) -> Option<Shape> {
                match (self, width) {
                    $(
                        (Self::$variant, Width::Bit) => types!(@shape $discrete),
                        (Self::$variant, Width::Word) => types!(@shape $word),
                        (Self::$variant, Width::Double) => types!(@shape $double),
                    )*
                }
            }
        }
    };
    (@shape -) => { None };
    (@shape $shape:ident) => { Some(Shape::$shape) };
}
use types;
