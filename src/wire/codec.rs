use bytes::BytesMut;
use tokio_util::codec::{Decoder, Encoder};

use super::{AsciiCodec, BinaryCodec, EncodeError, Found, Frame, Framing, Received, Side};

/// The codec of either framing, chosen at run time.
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

    /// Discards the first byte of an incomplete frame, so that the rest of the buffer is decoded.
    ///
    /// For a line that falls silent within a frame: bytes that only look like the beginning of a
    /// frame can hide a complete one. Does nothing if the buffer does not begin with an incomplete
    /// frame.
    pub fn skip_partial(&mut self) {
        match self {
            Self::Ascii(codec) => codec.skip_partial(),
            Self::Binary(codec) => codec.skip_partial(),
        }
    }

    /// Finds the next frame or noise at the beginning of received bytes. The caller removes it before
    /// the next call. `None`: more bytes are needed.
    pub(crate) fn find(&mut self, received: &[u8]) -> Option<Found> {
        match self {
            Self::Ascii(codec) => codec.find(received),
            Self::Binary(codec) => codec.find(received),
        }
    }

    /// Resets the decoder, for a buffer that has been cleared.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_codec_after_reset_decodes_like_a_new_one() {
        let ascii: &[u8] = b"\x0201410F8\x03";
        let binary: &[u8] = b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";
        for (framing, frame) in [(Framing::Ascii, ascii), (Framing::Binary, binary)] {
            let mut codec = Codec::new(framing, Side::Client);
            assert_eq!(codec.framing(), framing);
            assert_eq!(codec.decode(&mut BytesMut::from(&frame[..frame.len() - 2])).unwrap(), None, "{framing}");
            codec.skip_partial();
            codec.reset();
            let mut buffer = BytesMut::from(&frame[..5]);
            assert_eq!(codec.decode(&mut buffer).unwrap(), None, "{framing}: nothing is given up");
            buffer.extend_from_slice(&frame[5..]);
            let found = codec.decode(&mut buffer).unwrap().and_then(Received::frame);
            assert_eq!(found.map(|frame| (frame.station, frame.command)), Some((1, 0x41)), "{framing}");
        }
    }
}
