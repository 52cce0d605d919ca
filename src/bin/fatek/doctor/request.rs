//! Requests of an examination: frames, also of requests that no client should send, and the shape of their replies.

use bytes::{BufMut, Bytes, BytesMut};
use fatek::Symbol;
use fatek::command::Code;
use fatek::wire::{Codec, Frame, Framing, Side};
use tokio_util::codec::Encoder;

use super::exchange::Answer;

/// A request to the PLC, and the shape of its reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) frame: Frame,
    pub(crate) shape: Shape,
}

/// The data of a reply behind its error code, in characters (ASCII) or bytes (binary).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Shape {
    Len(usize),
    AtLeast(usize),
    /// The data of the request, without an error code.
    Echo,
    /// A program page: with an error digit or without.
    Page,
    /// Any: no document has a reply to such a request.
    Any,
}

/// Makes the requests to one station.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Requests {
    pub(crate) framing: Framing,
    pub(crate) station: u8,
}

/// The width of a value in a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unit {
    Bit,
    Word,
    DWord,
}

impl Requests {
    /// A command without data.
    pub(crate) fn plain(self, command: u8, shape: Shape) -> Request {
        self.raw(command, Vec::new(), shape)
    }

    /// The brief status.
    pub(crate) fn status(self) -> Request {
        self.plain(0x40, Shape::Len(3 * self.byte_len()))
    }

    /// The detailed status: 28 bytes or more.
    pub(crate) fn detailed(self) -> Request {
        self.plain(0x53, Shape::AtLeast(28 * self.byte_len()))
    }

    pub(crate) fn loop_back(self, data: impl Into<Vec<u8>>) -> Request {
        self.raw(Code::LoopBack.into(), data.into(), Shape::Echo)
    }

    /// A page of the program. ASCII framing only.
    pub(crate) fn page(self, page: u16) -> Request {
        self.raw(Code::ReadProgramPage.into(), format!("{page:04X}").into(), Shape::Page)
    }

    /// A read of consecutive elements by 43, 44 or 46, such as 3 from `R12` on. The number may break the limits.
    pub(crate) fn read(self, command: Code, n: u16, first: &str) -> Request {
        let mut data = self.count(n);
        data.extend(self.element(first));
        let len = usize::from(n) * self.value_len(unit_of(first));
        self.raw(command.into(), data, Shape::Len(len))
    }

    /// A mixed read (48).
    pub(crate) fn mixed<S: AsRef<str>>(self, elements: &[S]) -> Request {
        // A list of more than 255 elements is never made.
        let mut data = self.count(u16::try_from(elements.len()).unwrap_or(u16::MAX));
        let mut len = 0;
        for element in elements {
            data.extend(self.element(element.as_ref()));
            len += self.value_len(unit_of(element.as_ref()));
        }
        self.raw(Code::ReadMixed.into(), data, Shape::Len(len))
    }

    /// A write of one element by 45, 47 or 49.
    pub(crate) fn write(self, command: Code, element: &str, value: u16) -> Request {
        let mut data = self.count(1);
        data.extend(self.element(element));
        match (unit_of(element), self.framing) {
            (Unit::Bit, Framing::Ascii) => data.push(b'0' + u8::from(value != 0)),
            (Unit::Bit, Framing::Binary | _) => data.push(u8::from(value != 0)),
            (Unit::Word | Unit::DWord, Framing::Ascii) => data.extend(format!("{value:04X}").bytes()),
            (Unit::Word | Unit::DWord, Framing::Binary | _) => data.extend(value.to_be_bytes()),
        }
        self.raw(command.into(), data, Shape::Len(0))
    }

    /// A control of one discrete (42): 3 sets it, 4 resets it.
    pub(crate) fn control(self, code: u8, discrete: &str) -> Request {
        let mut data = match self.framing {
            Framing::Ascii => format!("{code:X}").into_bytes(),
            Framing::Binary | _ => vec![code],
        };
        data.extend(self.element(discrete));
        self.raw(Code::ControlDiscrete.into(), data, Shape::Len(0))
    }

    pub(crate) fn raw(self, command: u8, data: Vec<u8>, shape: Shape) -> Request {
        Request { frame: Frame { station: self.station, command, data: data.into() }, shape }
    }

    /// The number of elements as it is sent; of 256, 00.
    pub(crate) fn count(self, n: u16) -> Vec<u8> {
        let [_, n] = n.to_be_bytes();
        match self.framing {
            Framing::Ascii => format!("{n:02X}").into_bytes(),
            Framing::Binary | _ => vec![n],
        }
    }

    /// An element as it is sent. The address may be one that no element has.
    pub(crate) fn element(self, text: &str) -> Vec<u8> {
        let (letters, digits) = split(text);
        let address: u16 = digits.parse().unwrap_or_default();
        let places = Symbol::from_letters(letters.as_bytes()).map_or(4, Symbol::digits);
        match self.framing {
            Framing::Ascii => format!("{letters}{address:0places$}").into_bytes(),
            Framing::Binary | _ => [letters.as_bytes(), &address.to_be_bytes()].concat(),
        }
    }

    /// The frame as bytes. A frame that cannot be encoded is empty.
    pub(crate) fn encode(self, frame: &Frame) -> Bytes {
        let mut bytes = BytesMut::new();
        let encoded = Codec::new(self.framing, Side::Client).encode(frame, &mut bytes);
        debug_assert!(encoded.is_ok(), "{encoded:?}");
        bytes.freeze()
    }

    /// The frame as bytes, with a wrong checksum.
    pub(crate) fn corrupt(self, frame: &Frame) -> Bytes {
        let mut bytes = BytesMut::from(&self.encode(frame)[..]);
        // The last digit of the checksum is before ETX; the low byte of the CRC before its high byte and the end.
        let behind = if self.framing == Framing::Ascii { 2 } else { 4 };
        if let Some(at) = bytes.len().checked_sub(behind) {
            let wrong = if self.framing == Framing::Ascii && bytes[at] != b'0' { b'0' } else { bytes[at] ^ 1 };
            bytes[at] = wrong;
        }
        bytes.freeze()
    }

    /// Characters or bytes of a byte.
    pub(crate) fn byte_len(self) -> usize {
        if self.framing == Framing::Ascii { 2 } else { 1 }
    }

    fn value_len(self, unit: Unit) -> usize {
        match unit {
            Unit::Bit => 1,
            Unit::Word => 2 * self.byte_len(),
            Unit::DWord => 4 * self.byte_len(),
        }
    }

    /// The bytes of a status.
    pub(crate) fn bytes(self, data: &[u8]) -> Vec<u8> {
        self.numbers(data, 1).into_iter().map(|byte| u8::try_from(byte).unwrap_or_default()).collect()
    }

    pub(crate) fn words(self, data: &[u8]) -> Vec<u16> {
        self.numbers(data, 2).into_iter().map(|word| u16::try_from(word).unwrap_or_default()).collect()
    }

    pub(crate) fn dwords(self, data: &[u8]) -> Vec<u32> {
        self.numbers(data, 4)
    }

    pub(crate) fn bits(self, data: &[u8]) -> Vec<bool> {
        data.iter().map(|&state| state == b'1' || state == 1).collect()
    }

    /// The value of one discrete or of one word that was read.
    pub(crate) fn value(self, read: &Request, answer: Answer<'_>) -> Option<u16> {
        let Answer::Data(data) = answer else { return None };
        if read.frame.command == u8::from(Code::ReadDiscretes) {
            self.bits(data).first().map(|&state| state.into())
        } else {
            self.words(data).first().copied()
        }
    }

    /// The numbers of this many bytes each. Digits that are none count as 0.
    fn numbers(self, data: &[u8], bytes: usize) -> Vec<u32> {
        let number = |part: &[u8]| match self.framing {
            Framing::Ascii => {
                std::str::from_utf8(part).ok().and_then(|part| u32::from_str_radix(part, 16).ok()).unwrap_or_default()
            }
            Framing::Binary | _ => part.iter().fold(0, |number, &byte| number << 8 | u32::from(byte)),
        };
        data.chunks_exact(bytes * self.byte_len()).map(number).collect()
    }
}

/// The unit of an element's value.
pub(crate) fn unit_of(element: &str) -> Unit {
    let (letters, _) = split(element);
    match Symbol::from_letters(letters.as_bytes()).map(|symbol| symbol.width().bits()) {
        Some(1) => Unit::Bit,
        Some(32) => Unit::DWord,
        Some(_) | None => Unit::Word,
    }
}

fn split(element: &str) -> (&str, &str) {
    let at = element.find(|c: char| c.is_ascii_digit()).unwrap_or(element.len());
    element.split_at(at)
}

/// Requests one behind the other, as one write.
pub(crate) fn joined(parts: &[Bytes]) -> Bytes {
    let mut all = BytesMut::new();
    parts.iter().for_each(|part| all.put_slice(part));
    all.freeze()
}

#[cfg(test)]
mod tests {
    use super::*;

    const ASCII: Requests = Requests { framing: Framing::Ascii, station: 1 };
    const BINARY: Requests = Requests { framing: Framing::Binary, station: 1 };

    #[test]
    fn requests_are_those_of_the_manuals() {
        let read = ASCII.read(Code::ReadRegisters, 3, "R12");
        assert_eq!(ASCII.encode(&read.frame), &b"\x02014603R0001275\x03"[..]);
        let read = BINARY.read(Code::ReadDiscretes, 15, "Y0");
        assert_eq!(BINARY.encode(&read.frame)[..], [0x51, 0x10, 0, 6, 1, 0x44, 15, b'Y', 0, 0, 4, 0xD2, 0x55, 0xAA]);
        let mixed = ASCII.mixed(&["R1", "Y9", "DWM0"]);
        assert_eq!((&mixed.frame.data[..], mixed.shape), (&b"03R00001Y0009DWM0000"[..], Shape::Len(13)));
        assert_eq!(ASCII.read(Code::ReadDiscretes, 256, "M0").frame.data, "00M0000");
        assert_eq!(ASCII.write(Code::WriteRegisters, "R5", 0xAB).frame.data, "01R0000500AB");
        assert_eq!(BINARY.write(Code::WriteDiscretes, "M5", 1).frame.data, &b"\x01M\0\x05\x01"[..]);
    }

    #[test]
    fn a_corrupt_frame_differs_in_its_checksum_alone() {
        for requests in [ASCII, BINARY] {
            for n in 1..64 {
                let frame = requests.read(Code::ReadRegisters, n, "R0").frame;
                let (good, bad) = (requests.encode(&frame), requests.corrupt(&frame));
                let differing: Vec<_> = (0..good.len()).filter(|&at| good[at] != bad[at]).collect();
                let at = if requests.framing == Framing::Ascii { good.len() - 2 } else { good.len() - 4 };
                assert_eq!(differing, [at], "{n}");
            }
        }
    }

    #[test]
    fn values_are_read_in_both_framings() {
        assert_eq!(ASCII.words(b"10A57FC4"), [0x10A5, 0x7FC4]);
        assert_eq!(BINARY.words(&[0x10, 0xA5, 0x7F]), [0x10A5]);
        assert_eq!(ASCII.dwords(b"003547BA"), [0x0035_47BA]);
        assert_eq!(ASCII.bits(b"101"), [true, false, true]);
        assert_eq!(ASCII.words(b"XYZ0"), [0]);
    }
}
