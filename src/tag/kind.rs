//! What the values of a tag are made of, and how they are written.

use super::scale::Scale;
use super::text::{self, ByteOrder};
use super::{TagType, TagValue, ValueError};
use crate::command::Value;

/// What one value is made of: a type on elements of a width, and a scale if it has one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum Kind {
    Plain(Shape),
    /// A number of this shape, with gain and offset.
    Scaled(Shape, Scale),
    Text(ByteOrder),
}

/// A value of a fixed number of bits.
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

impl Kind {
    /// The bits of one value; of a text, those of one register.
    pub(super) fn bits(self) -> u32 {
        match self {
            Self::Plain(shape) | Self::Scaled(shape, _) => shape.bits(),
            Self::Text(_) => 16,
        }
    }

    pub(super) fn scale(self) -> Option<Scale> {
        if let Self::Scaled(_, scale) = self { Some(scale) } else { None }
    }

    /// The value that these elements hold.
    pub(super) fn value(self, elements: &[Value]) -> TagValue {
        match self {
            Self::Plain(shape) => shape.value(join(elements)),
            Self::Scaled(shape, scale) => TagValue::Scaled(scale.value(shape, join(elements))),
            Self::Text(order) => {
                TagValue::Text(text::decode(elements.iter().map(|element| low(bits(*element))), order))
            }
        }
    }

    pub(super) fn parse(self, text: &str) -> Result<TagValue, ValueError> {
        if text.is_empty() {
            return Err(ValueError::Empty);
        }
        match self {
            Self::Plain(shape) => shape.parse(text),
            Self::Scaled(..) => match text.parse() {
                Ok(number) if !has_overflowed(number, text) => Ok(TagValue::Scaled(number)),
                _ => Err(ValueError::NotDecimal),
            },
            Self::Text(_) => Ok(TagValue::Text(text::parse(text)?)),
        }
    }

    /// What it is, for errors: `u16 of 16 bits`, `scaled`, `text`.
    pub(super) fn description(self) -> String {
        match self {
            Self::Plain(shape) => shape.description(),
            Self::Scaled(..) => "scaled".to_owned(),
            Self::Text(_) => "text".to_owned(),
        }
    }
}

impl Shape {
    pub(super) const fn bits(self) -> u32 {
        match self {
            Self::Bool => 1,
            Self::U16 | Self::I16 | Self::Hex16 => 16,
            Self::U32 | Self::I32 | Self::F32 | Self::Hex32 => 32,
        }
    }

    pub(super) fn tag_type(self) -> TagType {
        match self {
            Self::Bool => TagType::Bool,
            Self::U16 => TagType::U16,
            Self::I16 => TagType::I16,
            Self::U32 => TagType::U32,
            Self::I32 => TagType::I32,
            Self::F32 => TagType::F32,
            Self::Hex16 | Self::Hex32 => TagType::Hex,
        }
    }

    pub(super) fn description(self) -> String {
        format!("{} of {} bits", self.tag_type(), self.bits())
    }

    /// The value of these bits.
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

    /// The bits of the number nearest to this one; `None` if that is out of range.
    #[allow(clippy::cast_possible_truncation, reason = "to the nearest f32 is what is asked for")]
    pub(super) fn nearest(self, number: f64) -> Option<u32> {
        // Rounded, a number within i64 has no fraction that a cast could lose; NaN is within nothing.
        let integer = Some(number.round()).filter(|n| n.abs() < 1e18).map(|n| n as i64);
        match self {
            Self::F32 => {
                let float = number as f32;
                (float.is_finite() || !number.is_finite()).then_some(float.to_bits())
            }
            Self::U16 => Some(u16::try_from(integer?).ok()?.into()),
            Self::I16 => Some(i16::try_from(integer?).ok()?.cast_unsigned().into()),
            Self::U32 => u32::try_from(integer?).ok(),
            Self::I32 => Some(i32::try_from(integer?).ok()?.cast_unsigned()),
            Self::Bool | Self::Hex16 | Self::Hex32 => None,
        }
    }

    fn parse(self, text: &str) -> Result<TagValue, ValueError> {
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
    if has_overflowed(number.into(), text) { Err(ValueError::OutOfRange { tag_type }) } else { Ok(number) }
}

/// `inf` is meant; `1e39` that has become it is not.
fn has_overflowed(number: f64, text: &str) -> bool {
    number.is_infinite() && text.bytes().any(|b| b.is_ascii_digit())
}

#[allow(clippy::cast_possible_truncation, reason = "the low half is what is asked for")]
pub(super) fn low(bits: u32) -> u16 {
    bits as u16
}

pub(super) fn high(bits: u32) -> u16 {
    low(bits >> 16)
}

/// The bits of one value, from the elements that hold it: the low word first.
fn join(elements: &[Value]) -> u32 {
    elements.iter().rev().fold(0, |joined, element| match *element {
        Value::Word(word) => joined << 16 | u32::from(word),
        Value::Bit(_) | Value::DWord(_) => bits(*element),
    })
}

fn bits(element: Value) -> u32 {
    match element {
        Value::Bit(on) => on.into(),
        Value::Word(word) => word.into(),
        Value::DWord(double) => double,
    }
}
