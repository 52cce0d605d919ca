//! Values of elements and tags as natural values.

use serde::{Serialize, Serializer};

use crate::element::Value;
use crate::tag::TagValue;

impl Serialize for Value {
    /// `bool` for a discrete, else a number.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match *self {
            Self::Bit(on) => serializer.serialize_bool(on),
            Self::Word(word) => serializer.serialize_u16(word),
            Self::DWord(dword) => serializer.serialize_u32(dword),
        }
    }
}

impl Serialize for TagValue {
    /// `bool`, a number or a text. Texts that [`Tag::values_seed`](crate::Tag::values_seed) reads as
    /// numbers: hexadecimal numbers, decimal digits beyond 9, NaN and infinities.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Bool(on) => serializer.serialize_bool(*on),
            Self::U16(number) => serializer.serialize_u16(*number),
            Self::I16(number) => serializer.serialize_i16(*number),
            Self::U32(number) => serializer.serialize_u32(*number),
            Self::I32(number) => serializer.serialize_i32(*number),
            Self::U64(number) => serializer.serialize_u64(*number),
            Self::I64(number) => serializer.serialize_i64(*number),
            Self::F64(number) | Self::Scaled(number) if number.is_finite() => serializer.serialize_f64(*number),
            // By its shortest text: 0.1, not 0.10000000149011612, in every format. The nearest `f32` of
            // that number is the value.
            Self::F32(number) if number.is_finite() => match number.to_string().parse() {
                Ok(shortest) => serializer.serialize_f64(shortest),
                Err(_) => serializer.serialize_f32(*number),
            },
            Self::Bcd16(_) | Self::Bcd32(_) => match u32::try_from(self) {
                Ok(number) => serializer.serialize_u32(number),
                Err(_) => serializer.collect_str(self),
            },
            Self::F32(_) | Self::F64(_) | Self::Scaled(_) | Self::Hex16(_) | Self::Hex32(_) => {
                serializer.collect_str(self)
            }
            Self::Text(text) => serializer.serialize_str(text),
        }
    }
}
