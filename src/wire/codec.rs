use bytes::BytesMut;
use tokio_util::codec::{Decoder, Encoder};

use super::{AsciiCodec, BinaryCodec, EncodeError, Frame, Framing, Received, Side};

/// Either codec, chosen when the program runs.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Codec {
    /// The ASCII framing.
    Ascii(AsciiCodec),
    /// The binary framing.
    Binary(BinaryCodec),
}

impl Codec {
    /// The codec of a framing, with the default limits.
    #[must_use]
    pub fn new(framing: Framing, side: Side) -> Self {
        match (framing, side) {
            (Framing::Ascii, _) => Self::Ascii(AsciiCodec::new()),
            (Framing::Binary, Side::Client) => Self::Binary(BinaryCodec::client()),
            (Framing::Binary, Side::Plc) => Self::Binary(BinaryCodec::plc()),
        }
    }

    /// Its framing.
    #[must_use]
    pub fn framing(&self) -> Framing {
        match self {
            Self::Ascii(_) => Framing::Ascii,
            Self::Binary(_) => Framing::Binary,
        }
    }

    /// Gives up the frame that has begun but not ended, so that decoding goes on behind its first byte.
    ///
    /// For a line that has fallen silent in the middle of what looked like a frame: what is left of the buffer may
    /// hold a whole one. Does nothing when the buffer holds no beginning of a frame.
    pub fn skip_partial(&mut self) {
        match self {
            Self::Ascii(codec) => codec.skip_partial(),
            Self::Binary(codec) => codec.skip_partial(),
        }
    }

    /// Forgets where it was, for a buffer that has been emptied.
    pub fn reset(&mut self) {
        match self {
            Self::Ascii(codec) => codec.reset(),
            Self::Binary(codec) => codec.reset(),
        }
    }
}

impl Decoder for Codec {
    type Item = Received;
    type Error = std::io::Error;

    fn decode(&mut self, src: &mut BytesMut) -> Result<Option<Received>, Self::Error> {
        match self {
            Self::Ascii(codec) => codec.decode(src),
            Self::Binary(codec) => codec.decode(src),
        }
    }

    fn decode_eof(&mut self, src: &mut BytesMut) -> Result<Option<Received>, Self::Error> {
        match self {
            Self::Ascii(codec) => codec.decode_eof(src),
            Self::Binary(codec) => codec.decode_eof(src),
        }
    }
}

impl Encoder<&Frame> for Codec {
    type Error = EncodeError;

    fn encode(&mut self, frame: &Frame, dst: &mut BytesMut) -> Result<(), EncodeError> {
        match self {
            Self::Ascii(codec) => codec.encode(frame, dst),
            Self::Binary(codec) => codec.encode(frame, dst),
        }
    }
}

impl Encoder<Frame> for Codec {
    type Error = EncodeError;

    fn encode(&mut self, frame: Frame, dst: &mut BytesMut) -> Result<(), EncodeError> {
        self.encode(&frame, dst)
    }
}
