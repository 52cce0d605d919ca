use crate::printable::excerpt;
use std::fmt;
use std::str::FromStr;

/// The form of frames and fields on the wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Framing {
    /// `STX … LRC ETX`: all FB, FBe, FBs and B1 PLCs.
    #[default]
    Ascii,
    /// `51h/52h 10h … CRC 55h AAh`: the M series.
    Binary,
}

impl fmt::Display for Framing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Ascii => "ascii",
            Self::Binary => "binary",
        })
    }
}

impl FromStr for Framing {
    type Err = ParseFramingError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.to_ascii_lowercase().as_str() {
            "ascii" => Ok(Self::Ascii),
            "binary" => Ok(Self::Binary),
            _ => Err(ParseFramingError(text.to_owned())),
        }
    }
}

/// A text that names no framing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{}` is not a framing: it must be `ascii` or `binary`", excerpt(.0))]
pub struct ParseFramingError(String);
