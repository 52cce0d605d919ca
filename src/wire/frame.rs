use std::fmt;
use std::ops::Range;

use bytes::{Bytes, BytesMut};

/// The longest frame, in bytes, that the codecs decode and encode by default.
///
/// The longest frames of the protocol have 508 bytes in ASCII and 270 in binary.
pub const MAX_FRAME_LEN: usize = 1024;

/// The end of the line that a codec serves.
///
/// Queries and replies have different headers in the binary framing and the same form in the ASCII
/// framing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Side {
    /// Sends queries, receives replies.
    Client,
    /// Receives queries, sends replies: the PLC.
    Plc,
}

/// The content of a frame, in either framing.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Frame {
    /// The station number: 0 for a broadcast, 1 to 254 for a PLC. 255 is no station, but can be
    /// received.
    pub station: u8,
    /// The command code, such as `0x46`.
    pub command: u8,
    /// The data between command and checksum: characters in ASCII, bytes in binary.
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

/// An item that a codec decodes.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Received {
    /// A complete frame with a good checksum.
    Frame(Frame),
    /// Bytes that belong to no good frame.
    Discarded {
        /// The reason.
        reason: Discard,
        /// The bytes.
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

/// A frame or noise at the beginning of received bytes, which stay where they are: a [`Received`]
/// shares their memory, which costs more than to decode a short frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Found {
    /// The number of bytes that it takes.
    pub(crate) len: usize,
    pub(crate) content: Result<FoundFrame, Discard>,
}

/// A good frame in received bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FoundFrame {
    pub(crate) station: u8,
    pub(crate) command: u8,
    /// The place of the data.
    pub(crate) data: Range<usize>,
}

impl Found {
    pub(super) fn noise(len: usize, reason: Discard) -> Self {
        Self { len, content: Err(reason) }
    }

    /// Takes it from the bytes that it was found in.
    pub(super) fn take_from(self, src: &mut BytesMut) -> Received {
        debug_assert!(self.len <= src.len(), "it was found in other bytes");
        let bytes = src.split_to(self.len.min(src.len())).freeze();
        match self.content {
            Ok(FoundFrame { station, command, data }) => {
                debug_assert!(data.start <= data.end && data.end <= bytes.len(), "the data are within the frame");
                let (start, end) = (data.start.min(bytes.len()), data.end.min(bytes.len()));
                Received::Frame(Frame { station, command, data: bytes.slice(start.min(end)..end) })
            }
            Err(reason) => Received::Discarded { reason, bytes },
        }
    }
}

/// The reason why received bytes were discarded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Discard {
    /// Bytes outside any frame.
    Garbage,
    /// The beginning of a frame: another frame begins inside it, or the input ends.
    Truncated,
    /// A frame with a wrong checksum.
    BadChecksum,
    /// The beginning of a frame, followed by fields that no frame has.
    Malformed,
    /// The beginning of a frame that is longer than the limit.
    TooLong,
    /// A good frame of the other direction, such as the echo of a query at a client. Binary framing
    /// only.
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

/// The error of encoding a frame, or of the stream it is written to.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The frame would be longer than the limit.
    #[error("a frame of {len} bytes is over the limit of {max}")]
    TooLong {
        /// Its length, in bytes.
        len: usize,
        /// The limit, in bytes.
        max: usize,
    },
    /// The data has a byte that the ASCII framing cannot carry: it carries printable characters,
    /// 20h to 7Eh.
    #[error(
        "the byte {byte:02X}h at position {position} of the data cannot be sent in the ASCII framing (20h to 7Eh can)"
    )]
    NotPrintable {
        /// The byte.
        byte: u8,
        /// Its position in the data, from 0.
        position: usize,
    },
    /// The transport failed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// A hash of the content of a frame: equal for equal frames, and hardly ever for others.
pub(crate) fn fingerprint(command: u8, data: &[u8]) -> u64 {
    const FACTOR: u64 = 0x9E37_79B9_7F4A_7C15;
    let (words, rest) = data.as_chunks::<8>();
    let mut last = [0; 8];
    last.iter_mut().zip(rest).for_each(|(place, &byte)| *place = byte);
    let seed = u64::from(command) << 32 | u64::try_from(data.len()).unwrap_or(u64::MAX);
    words.iter().chain([&last]).fold(seed.wrapping_mul(FACTOR), |hash, word| {
        (hash.rotate_left(23) ^ u64::from_le_bytes(*word)).wrapping_mul(FACTOR)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_that_differ_in_command_or_length_have_other_fingerprints() {
        let frames: [(u8, &[u8]); 8] = [
            (0x46, b""),
            (0x48, b""),
            (0x46, b"\0"),
            (0x46, b"\0\0"),
            (0x48, b"\0\0"),
            (0x46, b"00001"),
            (0x48, b"00001"),
            (0x46, b"0000100001"),
        ];
        let prints: std::collections::HashSet<u64> =
            frames.iter().map(|&(code, data)| fingerprint(code, data)).collect();
        assert_eq!(prints.len(), frames.len());
    }

    #[test]
    fn debug_shows_the_data_of_a_frame_as_text() {
        let frame = Frame { station: 7, command: 0x4E, data: Bytes::from_static(b"AB\x02") };
        assert_eq!(format!("{frame:?}"), r#"Frame { station: 7, command: 4Eh, data: b"AB\x02" }"#);
    }
}
