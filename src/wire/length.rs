//! The length of frames and fields, in bytes.
#![allow(clippy::arithmetic_side_effects, reason = "sums of a few small constants")]

use super::{Framing, ascii, binary};
use crate::element::{Symbol, Width};

/// The longest frame of the protocol: 500 characters of data in the ASCII framing.
pub(crate) const LONGEST_FRAME: usize = 500 + ascii::OVERHEAD;

impl Framing {
    /// A frame without data.
    pub(crate) const fn frame_overhead(self) -> usize {
        match self {
            Self::Ascii => ascii::OVERHEAD,
            Self::Binary => binary::OVERHEAD,
        }
    }

    /// A request for elements, without the elements: the frame and their number.
    pub(crate) const fn request_overhead(self) -> usize {
        let count = match self {
            Self::Ascii => 2,
            Self::Binary => 1,
        };
        self.frame_overhead() + count
    }

    /// A reply without values: the frame and the error code.
    pub(crate) const fn reply_overhead(self) -> usize {
        self.frame_overhead() + 1
    }

    /// An element in a request: letters and address.
    pub(crate) const fn element_len(self, symbol: Symbol) -> usize {
        let address = match self {
            Self::Ascii => symbol.digits(),
            Self::Binary => 2,
        };
        symbol.as_str().len() + address
    }

    /// A value of this width in a request or a reply.
    pub(crate) const fn value_len(self, width: Width) -> usize {
        match (width, self) {
            (Width::Bit, _) => 1,
            (Width::Word, Self::Ascii) => 4,
            (Width::Word, Self::Binary) => 2,
            (Width::DWord, Self::Ascii) => 8,
            (Width::DWord, Self::Binary) => 4,
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::BytesMut;

    use super::*;
    use crate::element::{Element, Value};
    use crate::wire::{AsciiWriter, BinaryWriter, FieldWriter, Side};

    /// A frame with these fields, and the fields alone.
    fn lengths(framing: Framing, fields: impl Fn(&mut dyn FieldWriter)) -> (usize, usize) {
        let (mut frame, mut data) = (BytesMut::new(), BytesMut::new());
        match framing {
            Framing::Ascii => {
                ascii::emit(&mut frame, 1, 0x48, |writer| fields(writer));
                fields(&mut AsciiWriter::new(&mut data));
            }
            Framing::Binary => {
                binary::emit(&mut frame, Side::Client, 1, 0x48, |writer| fields(writer));
                fields(&mut BinaryWriter::new(&mut data));
            }
        }
        (frame.len(), data.len())
    }

    #[test]
    fn lengths_are_those_of_written_frames_and_fields() {
        for framing in [Framing::Ascii, Framing::Binary] {
            assert_eq!(lengths(framing, |_| {}), (framing.frame_overhead(), 0));
            assert_eq!(lengths(framing, |fields| fields.count(3)).0, framing.request_overhead());
            assert_eq!(lengths(framing, |fields| fields.code(0)).0, framing.reply_overhead());
            for &symbol in Symbol::ALL {
                let element = Element::new(symbol, 0).unwrap();
                assert_eq!(lengths(framing, |fields| fields.element(element)).1, framing.element_len(symbol));
            }
            for value in [Value::Bit(true), Value::Word(1), Value::DWord(1)] {
                assert_eq!(lengths(framing, |fields| fields.value(value)).1, framing.value_len(value.width()));
            }
        }
    }
}
