use std::fmt;
use std::str::FromStr;

use super::ParseTagTypeError;
use super::kind::{Kind, Shape};
use super::text::ByteOrder;
use crate::element::Width;

// One row a type.
//
// - discrete, word, double: what a value is made of on elements of that width: a shape, or the first byte of a text;
//                           `-` where the type does not exist
// - takes:                  how values are written, for the documentation and for errors
types! {
    // variant  name      discrete  word   double  takes
    Bool        "bool"    Bool      -      -       "0 or 1, false or true, off or on";
    U16         "u16"     -         U16    -       "0 to 65535";
    I16         "i16"     -         I16    -       "-32768 to 32767";
    U32         "u32"     -         U32    U32     "0 to 4294967295";
    I32         "i32"     -         I32    I32     "-2147483648 to 2147483647";
    F32         "f32"     -         F32    F32     "-3.4028235e38 to 3.4028235e38, nan and inf";
    Hex         "hex"     -         Hex16  Hex32   "0x and hexadecimal digits, up to 4 for 16 bits and up to 8 for 32";
    Text        "text"    -         Low    -       "two characters a register, the low byte first; in double quotes, or bare";
    TextHi      "text-hi" -         High   -       "two characters a register, the high byte first; in double quotes, or bare";
}

impl TagType {
    /// The type of a tag that names none: `bool` for a discrete, `u16` for a 16-bit register, `u32` for 32 bits.
    #[must_use]
    pub const fn default_for(width: Width) -> Self {
        match width {
            Width::Bit => Self::Bool,
            Width::Word => Self::U16,
            Width::DWord => Self::U32,
        }
    }

    /// Whether its values are numbers, which can be compared: all but `bool` and texts.
    #[must_use]
    pub const fn is_number(self) -> bool {
        !matches!(self, Self::Bool) && !self.is_text()
    }

    /// Whether it is a text, so that all the elements of a tag are one value.
    #[must_use]
    pub const fn is_text(self) -> bool {
        matches!(self, Self::Text | Self::TextHi)
    }

    /// Whether a [`Scale`](super::Scale) can be had on it: every number but `hex`.
    #[must_use]
    pub const fn is_scalable(self) -> bool {
        matches!(self, Self::U16 | Self::I16 | Self::U32 | Self::I32 | Self::F32)
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

macro_rules! types {
    ($($variant:ident $name:literal $discrete:tt $word:tt $double:tt $takes:literal;)*) => {
        /// What the bits of a tag stand for.
        ///
        /// Discretes are `bool` and nothing else. A 16-bit register, a word of discretes too, has every other type; 32
        /// bits take two of them, the low word first, and a text up to 64. A 32-bit register has every type of 32 bits,
        /// and `hex`.
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
            pub(super) const fn kind(self, width: Width) -> Option<Kind> {
                match (self, width) {
                    $(
                        (Self::$variant, Width::Bit) => types!(@kind $discrete),
                        (Self::$variant, Width::Word) => types!(@kind $word),
                        (Self::$variant, Width::DWord) => types!(@kind $double),
                    )*
                }
            }
        }
    };
    (@kind -) => { None };
    (@kind Low) => { Some(Kind::Text(ByteOrder::LowFirst)) };
    (@kind High) => { Some(Kind::Text(ByteOrder::HighFirst)) };
    (@kind $shape:ident) => { Some(Kind::Plain(Shape::$shape)) };
}
use types;
