//! Data types of tags, and their values.
//!
//! A new type needs changes in this file only:
//! - a row in `types!`;
//! - for a new format of values, a row in `formats!`;
//! - for a new Rust type of values, an entry in `primitives!`, `numbers!` and `tag_values!`, and for
//!   a new coding, an implementation of [`Codec`].

use std::fmt;
use std::str::FromStr;

use super::bits::BitRange;
use super::codec::from_digits;
use super::codec::{Bcd, Bit, Codec, Float, Hex, Integer, Number, Primitive, Real, primitives};
use super::convert::{numbers, tag_values};
use super::parse::is_equal_in_either_case;
use super::text::{ByteOrder, Quoted};
use super::{ParseTagTypeError, ValueError};
use crate::element::Width;

// One row per type.
//
// - discrete, word, dword: storage of a value on elements of that width: a format, or the first
//                          byte of a text; `-` if the type does not exist, in brackets if the high
//                          word is first
// - class:                 bool, number (scalable), bits (a number that is not scalable), or text
// - aliases:               other names, accepted and never displayed
// - takes:                 accepted values, for the documentation and for errors
types! {
    // type  name       discrete  word   dword  class    aliases              takes
    Bool     "bool"     Bool      -      -      Bool     "boolean bit"
                                             "0 or 1, false or true, off or on";
    U16      "u16"      -         U16    -      Number   "uint16 uint word ushort"
                                             "0 to 65535";
    I16      "i16"      -         I16    -      Number   "int16 int short"    "-32768 to 32767";
    U32      "u32"      -         U32    U32    Number   "uint32 udint dword" "0 to 4294967295";
    I32      "i32"      -         I32    I32    Number   "int32 dint"         "-2147483648 to 2147483647";
    F32      "f32"      -         F32    F32    Number   "float real float32"
                                             "-3.4028235e38 to 3.4028235e38, nan and inf";
    U64      "u64"      -         U64    U64    Bits     "uint64 ulint lword qword"
                                             "0 to 18446744073709551615";
    I64      "i64"      -         I64    I64    Bits     "int64 lint"
                                             "-9223372036854775808 to 9223372036854775807";
    F64      "f64"      -         F64    F64    Bits     "double lreal float64"
                                             "-1.7976931348623157e308 to 1.7976931348623157e308, nan and inf";
    Bcd16    "bcd16"    -         Bcd16  -      Bits     "bcd"                "0 to 9999";
    Bcd32    "bcd32"    -         Bcd32  Bcd32  Bits     ""                   "0 to 99999999";
    Hex      "hex"      -         Hex16  Hex32  Bits     ""
                                             "0x and up to 4 hexadecimal digits for 16 bits, 8 for 32";
    Text     "text"     -         Low    -      Text     "string ascii"
                                             "two characters per register, low byte first";
    TextHi   "text-hi"  -         High   -      Text     "string-hi ascii-hi"
                                             "two characters per register, high byte first";
    Bcd32Hi  "bcd32-hi" -         [Bcd32] -     Bits     ""                   "0 to 99999999";
    U32Hi    "u32-hi"   -         [U32]  -      Number   "uint32-hi udint-hi dword-hi"
                                             "0 to 4294967295";
    I32Hi    "i32-hi"   -         [I32]  -      Number   "int32-hi dint-hi"
                                             "-2147483648 to 2147483647";
    F32Hi    "f32-hi"   -         [F32]  -      Number   "float-hi real-hi float32-hi"
                                             "-3.4028235e38 to 3.4028235e38, nan and inf";
    U64Hi    "u64-hi"   -         [U64]  -      Bits     "uint64-hi ulint-hi lword-hi qword-hi"
                                             "0 to 18446744073709551615";
    I64Hi    "i64-hi"   -         [I64]  -      Bits     "int64-hi lint-hi"
                                             "-9223372036854775808 to 9223372036854775807";
    F64Hi    "f64-hi"   -         [F64]  -      Bits     "double-hi lreal-hi float64-hi"
                                             "-1.7976931348623157e308 to 1.7976931348623157e308, nan and inf";
}

// One row per format of values of a fixed number of bits.
formats! {
    // format  type  codec           value  documentation
    Bool       Bool  Bit          => bool   "State of a discrete; `true` is on.";
    U16        U16   Integer<u16> => u16    "16 bits, unsigned.";
    I16        I16   Integer<i16> => i16    "16 bits, signed.";
    U32        U32   Integer<u32> => u32    "32 bits, unsigned.";
    I32        I32   Integer<i32> => i32    "32 bits, signed.";
    F32        F32   Float<f32>   => f32    "32 bits, an IEEE-754 float.";
    U64        U64   Integer<u64> => u64    "64 bits, unsigned.";
    I64        I64   Integer<i64> => i64    "64 bits, signed.";
    F64        F64   Float<f64>   => f64    "64 bits, an IEEE-754 float.";
    Bcd16      Bcd16 Bcd<u16>     => u16    "16 bits, four decimal digits: 0x1234 for 1234, not the number.";
    Bcd32      Bcd32 Bcd<u32>     => u32    "32 bits, eight decimal digits: 0x12345678 for 12345678.";
    Hex16      Hex   Hex<u16>     => u16    "16 bits, displayed as four hexadecimal digits.";
    Hex32      Hex   Hex<u32>     => u32    "32 bits, displayed as eight hexadecimal digits.";
}

primitives!(u16, i16, u32, i32, f32, u64, i64, f64);

// One row per Rust type that a tag can be read into: the formats whose values it holds, all of them
// and exactly; behind the bar those of decimal digits.
numbers! {
    bool: Bool |;
    u16: U16 Hex16 | Bcd16;
    i16: I16 | Bcd16;
    u32: U16 U32 Hex16 Hex32 | Bcd16 Bcd32;
    i32: U16 I16 I32 Hex16 | Bcd16 Bcd32;
    u64: U16 U32 U64 Hex16 Hex32 | Bcd16 Bcd32;
    i64: U16 I16 U32 I32 I64 Hex16 Hex32 | Bcd16 Bcd32;
    f32: U16 I16 F32 |;
    f64: U16 I16 U32 I32 F32 F64 Scaled | Bcd16 Bcd32;
}

// One row per Rust type that is a value by itself.
tag_values! {
    bool => Bool, "A value of type `bool`.";
    u16 => U16, "A value of type `u16`.";
    i16 => I16, "A value of type `i16`.";
    u32 => U32, "A value of type `u32`.";
    i32 => I32, "A value of type `i32`.";
    f32 => F32, "A value of type `f32`.";
    u64 => U64, "A value of type `u64`.";
    i64 => I64, "A value of type `i64`.";
    f64 => F64, "A value of type `f64`.";
    String => Text, "A text.";
    &str => Text, "A text.";
}

impl Real for f64 {
    fn nearest(number: f64) -> Self {
        number
    }

    fn of_single(number: f32) -> Self {
        number.into()
    }
}

impl Real for f32 {
    #[allow(clippy::cast_possible_truncation, reason = "the nearest f32 is wanted")]
    fn nearest(number: f64) -> Self {
        number as Self
    }

    fn of_single(number: f32) -> Self {
        number
    }
}

/// Storage of a value in elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum Storage {
    /// A fixed number of bits, with the order of words that a value of several elements has.
    Bits(Format, WordOrder),
    /// A text over all elements of a tag.
    Text(ByteOrder),
    /// Bits of the only element.
    BitsOf(BitRange),
}

/// The order of the elements of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum WordOrder {
    LowFirst,
    HighFirst,
}

impl Storage {
    /// Number of elements of a value; for a text, of its shortest one.
    pub(super) const fn elements_per_value(self, width: Width) -> usize {
        match self {
            Self::Bits(format, _) => format.bits().div_ceil(width.bits()) as usize,
            Self::Text(_) | Self::BitsOf(_) => 1,
        }
    }
}

/// Group of types.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Class {
    Bool,
    Number,
    Bits,
    Text,
}

impl TagType {
    /// The default type of a width: `bool` for a discrete, `u16` for 16 bits, `u32` for 32 bits.
    #[must_use]
    pub const fn default_for(width: Width) -> Self {
        Self::default_of(width).0
    }

    /// The default type of a width, with its storage.
    pub(super) const fn default_of(width: Width) -> (Self, Storage) {
        match width {
            Width::Bit => (Self::Bool, Storage::Bits(Format::Bool, WordOrder::LowFirst)),
            Width::Word => (Self::U16, Storage::Bits(Format::U16, WordOrder::LowFirst)),
            Width::DWord => (Self::U32, Storage::Bits(Format::U32, WordOrder::LowFirst)),
        }
    }

    /// Returns whether its values are numbers: all types except `bool` and texts.
    #[must_use]
    pub const fn is_number(self) -> bool {
        matches!(self.class(), Class::Number | Class::Bits)
    }

    /// Returns whether it is a text, so that all elements of a tag are one value.
    #[must_use]
    pub const fn is_text(self) -> bool {
        matches!(self.class(), Class::Text)
    }

    /// Returns whether it can have a [`Scale`](super::Scale): all numbers up to 32 bits except `hex`
    /// and decimal digits.
    #[must_use]
    pub const fn is_scalable(self) -> bool {
        matches!(self.class(), Class::Number)
    }
}

impl fmt::Display for TagType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl FromStr for TagType {
    type Err = ParseTagTypeError;

    /// Parses the name of a type, or an alias of it such as `float`, `dint` or `word`, in either case.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::named(text).ok_or_else(|| ParseTagTypeError(text.to_owned()))
    }
}

impl TagType {
    /// The type with this name or alias, in either case.
    pub(super) const fn named(text: &str) -> Option<Self> {
        let text = text.as_bytes();
        let mut n = 0;
        while n < Self::ALL.len() {
            let tag_type = Self::ALL[n];
            if is_one_of(text, tag_type.as_str()) || is_one_of(text, tag_type.aliases()) {
                return Some(tag_type);
            }
            n += 1;
        }
        None
    }
}

/// Returns whether a text is one of these names, which are separated by blanks.
const fn is_one_of(text: &[u8], names: &str) -> bool {
    let mut rest = names.as_bytes();
    while !rest.is_empty() {
        let mut end = 0;
        while end < rest.len() && rest[end] != b' ' {
            end += 1;
        }
        let (name, behind) = rest.split_at(end);
        if is_equal_in_either_case(name, text) {
            return true;
        }
        rest = match behind {
            [_, rest @ ..] => rest,
            [] => behind,
        };
    }
    false
}

impl Format {
    /// Type and width, for errors: `u16 of 16 bits`, `bool`.
    pub(super) fn description(self) -> String {
        if self.bits() == 1 {
            self.tag_type().to_string()
        } else {
            format!("{} of {} bits", self.tag_type(), self.bits())
        }
    }
}

impl TagValue {
    /// Returns whether both have the same bits: 0.0 and -0.0 differ, and a NaN equals itself.
    pub(crate) fn is_identical(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Scaled(a), Self::Scaled(b)) => a.to_bits() == b.to_bits(),
            (a, b) => match (a.bits(), b.bits()) {
                (Some(a), Some(b)) => a == b,
                (None, _) | (_, None) => a == b,
            },
        }
    }

    /// The distance of two integers of 64 bits, which [`as_f64`](Self::as_f64) may round to the same
    /// number; `None` for others.
    #[allow(clippy::cast_precision_loss, reason = "small distances are exact")]
    pub(crate) fn integer_distance(&self, other: &Self) -> Option<f64> {
        match (self, other) {
            (Self::U64(a), Self::U64(b)) => Some(a.abs_diff(*b) as f64),
            (Self::I64(a), Self::I64(b)) => Some(a.abs_diff(*b) as f64),
            (_, _) => None,
        }
    }

    /// Returns whether it has decimal digits of which one is beyond 9.
    pub(super) fn is_no_number(&self) -> bool {
        matches!(self, Self::Bcd16(_) | Self::Bcd32(_)) && self.as_f64().is_none()
    }

    /// Its type, for errors: `u16 of 16 bits`, `scaled`, `text`.
    pub(super) fn description(&self) -> String {
        match self.bits() {
            Some((format, _)) => format.description(),
            None if matches!(self, Self::Text(_)) => "text".to_owned(),
            None => "scaled".to_owned(),
        }
    }
}

macro_rules! types {
    ($($variant:ident $name:literal $discrete:tt $word:tt $dword:tt $class:ident $other:literal $takes:literal;)*) => {
        /// Data type of a tag.
        ///
        /// Discretes, and bits of registers, are `bool`. 16-bit registers, and words of discretes, have
        /// all other types: a value of 32 bits takes two of them, one of 64 bits four, the low word
        /// first, or with `-hi` the high word; a text takes up to 64. 32-bit registers have the types
        /// of 32 and 64 bits without `-hi`, and `hex`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[non_exhaustive]
        pub enum TagType {
            $(
                #[doc = concat!("`", $name, "`: ", $takes, ".")]
                $variant,
            )*
        }

        impl TagType {
            /// All types.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// Its name in a tag.
            #[must_use]
            pub const fn as_str(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }

            /// Its other names, separated by blanks.
            pub(super) const fn aliases(self) -> &'static str {
                match self {
                    $(Self::$variant => $other,)*
                }
            }

            /// Its accepted values, for errors.
            pub(super) const fn takes(self) -> &'static str {
                match self {
                    $(Self::$variant => $takes,)*
                }
            }

            const fn class(self) -> Class {
                match self {
                    $(Self::$variant => Class::$class,)*
                }
            }

            /// Storage of a value on elements of a width; `None` if the type does not exist there.
            pub(super) const fn storage(self, width: Width) -> Option<Storage> {
                match (self, width) {
                    $(
                        (Self::$variant, Width::Bit) => types!(@storage $discrete),
                        (Self::$variant, Width::Word) => types!(@storage $word),
                        (Self::$variant, Width::DWord) => types!(@storage $dword),
                    )*
                }
            }
        }
    };
    (@storage -) => { None };
    (@storage Low) => { Some(Storage::Text(ByteOrder::LowFirst)) };
    (@storage High) => { Some(Storage::Text(ByteOrder::HighFirst)) };
    (@storage [$format:ident]) => { Some(Storage::Bits(Format::$format, WordOrder::HighFirst)) };
    (@storage $format:ident) => { Some(Storage::Bits(Format::$format, WordOrder::LowFirst)) };
}
use types;

macro_rules! formats {
    ($($variant:ident $tag_type:ident $codec:ty => $value:ident $doc:literal;)*) => {
        /// Format of a value of a fixed number of bits.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub(super) enum Format {
            $($variant,)*
        }

        /// The kind of a [`TagValue`].
        #[derive(Clone, Copy)]
        pub(super) enum ValueKind {
            $($variant,)*
            Scaled,
            Text,
        }

        /// A value of a tag.
        ///
        /// Displays as text that parses to the same value: floats in their shortest form, texts in
        /// double quotes with escapes for invisible characters. The payload of a NaN is not
        /// displayed.
        #[derive(Clone, Debug, PartialEq)]
        #[non_exhaustive]
        pub enum TagValue {
            $(
                #[doc = $doc]
                $variant($value),
            )*
            /// A number after gain and offset; see [`Scale`](super::Scale).
            Scaled(f64),
            /// A text, without the NULs at its end.
            Text(String),
        }

        impl Format {
            pub(super) const fn bits(self) -> u32 {
                match self {
                    $(Self::$variant => <$codec as Codec>::BITS,)*
                }
            }

            pub(super) const fn kind(self) -> ValueKind {
                match self {
                    $(Self::$variant => ValueKind::$variant,)*
                }
            }

            pub(super) const fn is_float(self) -> bool {
                match self {
                    $(Self::$variant => <$codec as Codec>::IS_FLOAT,)*
                }
            }

            pub(super) const fn tag_type(self) -> TagType {
                match self {
                    $(Self::$variant => TagType::$tag_type,)*
                }
            }

            /// The value of these bits.
            pub(super) fn value(self, bits: u64) -> TagValue {
                match self {
                    $(Self::$variant => TagValue::$variant(<$codec>::decode(bits)),)*
                }
            }

            /// The number of decimals of the value of these bits.
            pub(super) fn decimals(self, bits: u64) -> u8 {
                match self {
                    $(Self::$variant => <$codec>::decimals(<$codec>::decode(bits)),)*
                }
            }

            /// The value of a number to be written; `None` if the format does not have it.
            pub(super) fn take(self, number: Number) -> Option<TagValue> {
                match self {
                    $(Self::$variant => <$codec>::take(number).map(TagValue::$variant),)*
                }
            }

            /// The bits of the value nearest to a number; `None` if it is out of range.
            pub(super) fn nearest(self, number: f64) -> Option<u64> {
                match self {
                    $(Self::$variant => <$codec>::nearest(number).map(<$codec>::encode),)*
                }
            }

            /// The bits of the integer nearest to a number, for formats without fractions; `None` if it is
            /// out of range. A state is 0 or 1.
            #[cfg(feature = "sim")]
            pub(super) fn nearest_integer(self, number: f64) -> Option<u64> {
                let rounded = number.round();
                if self == Self::Bool {
                    return [0.0, 1.0].contains(&rounded).then(|| u64::from(rounded == 1.0));
                }
                #[allow(clippy::cast_possible_truncation, reason = "the cast saturates, out of all ranges")]
                let integer = Number::Integer(rounded as i128);
                self.take(integer).and_then(|value| value.bits()).map(|(_, bits)| bits)
            }

            pub(super) fn parse(self, text: &str) -> Result<TagValue, ValueError> {
                Ok(match self {
                    $(
                        Self::$variant => {
                            TagValue::$variant(<$codec>::parse(text, TagType::$tag_type)?)
                        }
                    )*
                })
            }
        }

        impl TagValue {
            /// The value as a number: 31 for `0x001F`; `None` for `bool`, texts and
            /// decimal digits beyond 9. Beyond 2^53 it is the nearest `f64`.
            #[must_use]
            pub fn as_f64(&self) -> Option<f64> {
                match *self {
                    $(Self::$variant(value) => <$codec>::number(value),)*
                    Self::Scaled(value) => Some(value),
                    Self::Text(_) => None,
                }
            }

            /// Its format and its bits; `None` if they depend on the tag.
            pub(super) fn bits(&self) -> Option<(Format, u64)> {
                match *self {
                    $(Self::$variant(value) => Some((Format::$variant, <$codec>::encode(value))),)*
                    Self::Scaled(_) | Self::Text(_) => None,
                }
            }
        }

        impl fmt::Display for TagValue {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Self::$variant(value) => <$codec>::display(*value, f),)*
                    // Debug uses an exponent where Display would write up to 309 digits.
                    Self::Scaled(value) => write!(f, "{value:?}"),
                    Self::Text(text) => Quoted(text).fmt(f),
                }
            }
        }
    };
}
use formats;
