use std::fmt;
use std::str::FromStr;

use bytes::Bytes;

use crate::element::{Symbol, Width};

/// The longest frame the codecs accept and make by default, in bytes.
///
/// The longest that the protocol has are 508 bytes in ASCII and 270 in binary.
pub const MAX_FRAME_LEN: usize = 1024;

/// How frames look on the wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Framing {
    /// `STX … LRC ETX`: all FB, FBe, FBs and B1 PLCs.
    #[default]
    Ascii,
    /// `51h/52h 10h … CRC 55h AAh`: the M series.
    Binary,
}

impl Framing {
    /// The length of an element in a request: letters and address.
    pub(crate) fn element_len(self, symbol: Symbol) -> usize {
        let address = match self {
            Self::Ascii => symbol.digits(),
            Self::Binary => 2,
        };
        symbol.as_str().len().saturating_add(address)
    }

    /// The length of a value of this width in a request or a reply.
    pub(crate) fn value_len(self, width: Width) -> usize {
        match (width, self) {
            (Width::Bit, _) => 1,
            (Width::Word, Self::Ascii) => 4,
            (Width::Word, Self::Binary) => 2,
            (Width::Double, Self::Ascii) => 8,
            (Width::Double, Self::Binary) => 4,
        }
    }

    /// The length of a frame without data.
    pub(crate) fn overhead(self) -> usize {
        match self {
            Self::Ascii => 8,
            Self::Binary => 10,
        }
    }
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
#[error("`{0}` is not a framing: it must be `ascii` or `binary`")]
pub struct ParseFramingError(String);

/// Which end of the line a codec stands on.
///
/// The binary framing marks queries and replies with different headers; the ASCII framing does not tell them apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Side {
    /// Sends queries, receives replies.
    Client,
    /// Receives queries, sends replies: the PLC.
    Plc,
}

/// What a frame carries, in either framing.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Frame {
    /// The station number: 0 is the broadcast, 1 to 254 are PLCs; 255 is no station but can be received.
    pub station: u8,
    /// The command code, such as `0x46`.
    pub command: u8,
    /// All between the command and the checksum: characters in ASCII, bytes in binary.
    pub data: Bytes,
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "Frame {{ station: {}, command: {:02X}h, data: b\"{}\" }}",
            self.station,
            self.command,
            self.data.escape_ascii()
        )
    }
}

/// What a decoder found.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Received {
    /// A whole frame with a good checksum.
    Frame(Frame),
    /// Bytes that are no part of a good frame, and why they were passed over.
    Discarded {
        /// Why.
        reason: Discard,
        /// The bytes themselves.
        bytes: Bytes,
    },
}

impl Received {
    /// The frame, if it is one.
    #[must_use]
    pub fn frame(self) -> Option<Frame> {
        match self {
            Self::Frame(frame) => Some(frame),
            Self::Discarded { .. } => None,
        }
    }
}

/// Why received bytes were passed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Discard {
    /// Bytes outside any frame.
    Garbage,
    /// A frame that was cut off: another began inside it, or the input ended.
    Truncated,
    /// Begins and ends like a frame, but its checksum is wrong.
    BadChecksum,
    /// Begins like a frame, but its fields are not those of one.
    Malformed,
    /// Begins like a frame, and is longer than the limit.
    TooLong,
    /// A good frame of the other direction: on a client, an echo of a query. Binary framing only.
    WrongSide,
}

impl fmt::Display for Discard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Garbage => "garbage between frames",
            Self::Truncated => "a truncated frame",
            Self::BadChecksum => "a frame with a bad checksum",
            Self::Malformed => "a malformed frame",
            Self::TooLong => "an over-long frame",
            Self::WrongSide => "a frame of the other direction",
        })
    }
}

/// Why a frame was not encoded or a stream failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The frame would be longer than the limit.
    #[error("a frame of {len} bytes is over the limit of {max}")]
    TooLong {
        /// What it would be, in bytes.
        len: usize,
        /// The limit, in bytes.
        max: usize,
    },
    /// The data has a byte that the ASCII framing cannot carry: only printable characters, 20h to 7Eh, can pass.
    #[error(
        "the byte {byte:02X}h at position {position} of the data cannot be sent in the ASCII framing (20h to 7Eh can)"
    )]
    NotPrintable {
        /// The byte.
        byte: u8,
        /// Where it stands in the data, from 0.
        position: usize,
    },
    /// The transport failed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_shown_with_its_data_as_text() {
        let frame = Frame { station: 7, command: 0x4E, data: Bytes::from_static(b"AB\x02") };
        assert_eq!(format!("{frame:?}"), r#"Frame { station: 7, command: 4Eh, data: b"AB\x02" }"#);
    }
}
