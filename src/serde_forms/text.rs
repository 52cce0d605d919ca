//! Types whose form is their text: that of `Display` and `FromStr`.

use std::fmt;

use serde::de::{self, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::element::{Discrete, Element, Register, Register32, Symbol};
use crate::endpoint::Endpoint;
use crate::printable::excerpt;
use crate::tag::{Assignment, Scale, Tag, TagType};
use crate::wire::Framing;

macro_rules! text_forms {
    ($($type:ident $expected:literal $parse:expr;)*) => {
        $(
            impl Serialize for $type {
                fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                    serializer.collect_str(self)
                }
            }

            impl<'de> Deserialize<'de> for $type {
                fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                    struct Text;

                    impl Visitor<'_> for Text {
                        type Value = $type;

                        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                            f.write_str($expected)
                        }

                        fn visit_str<E: de::Error>(self, text: &str) -> Result<$type, E> {
                            $parse(text).map_err(E::custom)
                        }
                    }

                    deserializer.deserialize_str(Text)
                }
            }
        )*
    };
}

// One row per type.
//
// - expected: the text, for the error about another kind of value, such as a number
// - parse:    the parser; its error names the text and the rule that it breaks
text_forms! {
    // type     expected                                parse
    Assignment  "an assignment, such as \"R5=7\""        str::parse;
    Discrete    "a discrete, such as \"M10\""            str::parse;
    Element     "an element, such as \"R12\""            str::parse;
    Endpoint    "a URL, such as \"tcp://10.0.0.1:500\""  str::parse;
    Framing     "\"ascii\" or \"binary\""                str::parse;
    Register    "a register, such as \"R12\""            str::parse;
    Register32  "a register of 32 bits, such as \"DR0\"" str::parse;
    Scale       "a scale, such as \"*0.1-40\""           parse_scale;
    Symbol      "a symbol, such as \"R\""                parse_symbol;
    Tag         "a tag, such as \"R100:f32\""            str::parse;
    TagType     "a type, such as \"f32\""                str::parse;
}

/// The error of a scale alone does not name the text, since a tag with a scale names it.
fn parse_scale(text: &str) -> Result<Scale, String> {
    text.parse().map_err(|error| format!("`{}` is not a scale: {error}", excerpt(text)))
}

fn parse_symbol(text: &str) -> Result<Symbol, String> {
    Symbol::from_letters(text.as_bytes())
        .ok_or_else(|| format!("`{}` is not a symbol: no element has these letters", excerpt(text)))
}
