//! The ASCII framing: all FB, FBe, FBs and B1 PLCs, over serial, TCP and UDP.
//!
//! ```text
//! STX  station  command  data          LRC    ETX
//! 02h  2 hex    2 hex    0..500 chars  2 hex  03h
//! ```
//!
//! The LRC is the low byte of the sum of every byte from STX to the end of the data. Numbers are hexadecimal, upper
//! case when sent and either case when received; element addresses are decimal. Source: protocol reference,
//! section 1 (manuals 000 and 002, section 2).

use std::io;

use bytes::{BufMut, Bytes, BytesMut};
use tokio_util::codec::{Decoder, Encoder};

use super::field::{FieldError, FieldReader, FieldWriter};
use super::frame::{Discard, EncodeError, Frame, MAX_FRAME_LEN, Received};
use crate::element::{Element, ElementError, LONGEST_SYMBOL, Symbol};

/// The start code.
pub const STX: u8 = 0x02;
/// The end code.
pub const ETX: u8 = 0x03;

/// The `tokio_util` codec of the ASCII framing.
///
/// One type serves both sides: the framing does not tell queries from replies. Decoding yields [`Received`], which
/// counts noise as items instead of failing; the only errors come from the transport.
///
/// ```
/// use bytes::BytesMut;
/// use fatek::wire::{AsciiCodec, Discard, Received};
/// use tokio_util::codec::Decoder;
///
/// let mut buffer = BytesMut::from(&b"\x06\x020140C7\x03"[..]); // a stray byte, then a status query
/// let mut codec = AsciiCodec::new();
/// let Some(Received::Discarded { reason, .. }) = codec.decode(&mut buffer)? else { panic!() };
/// assert_eq!(reason, Discard::Garbage);
/// let Some(Received::Frame(frame)) = codec.decode(&mut buffer)? else { panic!() };
/// assert_eq!((frame.station, frame.command, frame.data.len()), (1, 0x40, 0));
/// assert_eq!(codec.decode(&mut buffer)?, None);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct AsciiCodec {
    max_frame_len: usize,
    /// How much of the buffer holds no STX or ETX that is still to be looked at.
    scanned: usize,
}

impl AsciiCodec {
    /// A codec with the default limit, [`MAX_FRAME_LEN`].
    #[must_use]
    pub fn new() -> Self {
        Self { max_frame_len: MAX_FRAME_LEN, scanned: 0 }
    }

    /// Sets the longest frame, in bytes from STX to ETX.
    #[must_use]
    pub fn max_frame_len(mut self, bytes: usize) -> Self {
        self.max_frame_len = bytes;
        self
    }

    /// Gives up the frame that has begun but not ended; see [`Codec::skip_partial`](super::Codec::skip_partial).
    ///
    /// In this framing nothing has to be done: a frame that was cut off ends at the next STX.
    pub fn skip_partial(&mut self) {}

    /// Forgets where it was, for a buffer that has been emptied.
    pub fn reset(&mut self) {
        self.scanned = 0;
    }

    fn discard(&mut self, src: &mut BytesMut, len: usize, reason: Discard) -> Received {
        self.scanned = 0;
        Received::Discarded { reason, bytes: src.split_to(len.min(src.len())).freeze() }
    }
}

impl Default for AsciiCodec {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder for AsciiCodec {
    type Item = Received;
    type Error = io::Error;

    fn decode(&mut self, src: &mut BytesMut) -> Result<Option<Received>, io::Error> {
        match src.first() {
            None => return Ok(None),
            Some(&STX) => {}
            Some(_) => {
                let garbage = position(src, 0, |b| b == STX).unwrap_or(src.len());
                return Ok(Some(self.discard(src, garbage, Discard::Garbage)));
            }
        }
        // The data of a frame holds neither code, so the first of them ends this frame one way or the other.
        let mark = position(src, self.scanned.max(1), |b| b == STX || b == ETX);
        let end = mark.unwrap_or(src.len());
        if end >= self.max_frame_len {
            return Ok(Some(self.discard(src, end, Discard::TooLong)));
        }
        let Some(mark) = mark else {
            self.scanned = src.len();
            return Ok(None);
        };
        if src.get(mark) == Some(&STX) {
            return Ok(Some(self.discard(src, mark, Discard::Truncated)));
        }
        self.scanned = 0;
        let bytes = src.split_to(mark.saturating_add(1)).freeze();
        Ok(Some(match parse(&bytes) {
            Ok(frame) => Received::Frame(frame),
            Err(reason) => Received::Discarded { reason, bytes },
        }))
    }

    fn decode_eof(&mut self, src: &mut BytesMut) -> Result<Option<Received>, io::Error> {
        Ok(match self.decode(src)? {
            None if !src.is_empty() => {
                let len = src.len();
                Some(self.discard(src, len, Discard::Truncated))
            }
            item => item,
        })
    }
}

impl Encoder<&Frame> for AsciiCodec {
    type Error = EncodeError;

    fn encode(&mut self, frame: &Frame, dst: &mut BytesMut) -> Result<(), EncodeError> {
        let len = frame.data.len().saturating_add(OVERHEAD);
        if len > self.max_frame_len {
            return Err(EncodeError::TooLong { len, max: self.max_frame_len });
        }
        check_printable(&frame.data)?;
        emit(dst, frame.station, frame.command, |fields| fields.raw(&frame.data));
        Ok(())
    }
}

impl Encoder<Frame> for AsciiCodec {
    type Error = EncodeError;

    fn encode(&mut self, frame: Frame, dst: &mut BytesMut) -> Result<(), EncodeError> {
        self.encode(&frame, dst)
    }
}

/// Appends a frame whose data the closure writes.
pub(crate) fn emit(dst: &mut BytesMut, station: u8, command: u8, data: impl FnOnce(&mut AsciiWriter<'_>)) {
    let start = dst.len();
    let mut writer = AsciiWriter { dst };
    writer.dst.put_u8(STX);
    writer.byte(station);
    writer.byte(command);
    data(&mut writer);
    let sum = lrc(writer.dst.get(start..).unwrap_or_default());
    writer.byte(sum);
    writer.dst.put_u8(ETX);
}

/// Only printable characters can stand between STX and ETX: the two codes end the frame, and a line of 7 data bits
/// drops the eighth.
pub(crate) fn check_printable(data: &[u8]) -> Result<(), EncodeError> {
    match data.iter().position(|b| !(0x20..=0x7E).contains(b)) {
        None => Ok(()),
        Some(position) => {
            Err(EncodeError::NotPrintable { byte: data.get(position).copied().unwrap_or_default(), position })
        }
    }
}

/// All of a frame but its data: STX, station, command, LRC, ETX.
pub(crate) const OVERHEAD: usize = 8;

/// The low byte of the sum.
#[must_use]
pub fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |sum, &byte| sum.wrapping_add(byte))
}

/// Reads one whole frame, STX to ETX.
fn parse(bytes: &Bytes) -> Result<Frame, Discard> {
    let body_len = bytes.len().checked_sub(3).ok_or(Discard::Malformed)?;
    let (body, tail) = bytes.split_at_checked(body_len).ok_or(Discard::Malformed)?;
    let mut header = AsciiReader::new(body.get(1..).unwrap_or_default());
    let station = header.byte().map_err(|_| Discard::Malformed)?;
    let command = header.byte().map_err(|_| Discard::Malformed)?;
    let stated = AsciiReader::new(tail).byte().map_err(|_| Discard::BadChecksum)?;
    if stated != lrc(body) {
        return Err(Discard::BadChecksum);
    }
    Ok(Frame { station, command, data: bytes.slice(5..body_len) })
}

fn position(bytes: &[u8], from: usize, found: impl Fn(u8) -> bool) -> Option<usize> {
    let at = bytes.get(from..)?.iter().position(|&b| found(b))?;
    from.checked_add(at)
}

/// Writes fields as characters.
#[derive(Debug)]
pub struct AsciiWriter<'a> {
    dst: &'a mut BytesMut,
}

impl<'a> AsciiWriter<'a> {
    /// Appends to this buffer.
    pub fn new(dst: &'a mut BytesMut) -> Self {
        Self { dst }
    }
}

impl FieldWriter for AsciiWriter<'_> {
    fn count(&mut self, count: usize) {
        let [low, ..] = count.to_le_bytes();
        self.byte(low);
    }

    fn code(&mut self, code: u8) {
        // A code that has no digit of its own must not look like another one, least of all like 0.
        self.dst.put_u8(digit(code.min(0x0F)));
    }

    fn byte(&mut self, byte: u8) {
        self.dst.put_slice(&[digit(byte >> 4), digit(byte & 0x0F)]);
    }

    fn word(&mut self, word: u16) {
        let [high, low] = word.to_be_bytes();
        self.dst.put_slice(&[digit(high >> 4), digit(high & 0x0F), digit(low >> 4), digit(low & 0x0F)]);
    }

    fn double(&mut self, double: u32) {
        for byte in double.to_be_bytes() {
            self.byte(byte);
        }
    }

    fn element(&mut self, element: Element) {
        self.dst.put_slice(element.symbol().as_str().as_bytes());
        let mut divisor = 10_u32.pow(u32::try_from(element.symbol().digits()).unwrap_or_default());
        let mut address = u32::from(element.address());
        while divisor > 1 {
            address = address.checked_rem(divisor).unwrap_or_default();
            divisor = divisor.checked_div(10).unwrap_or_default();
            let value = address.checked_div(divisor).unwrap_or_default();
            self.dst.put_u8(digit(u8::try_from(value).unwrap_or_default()));
        }
    }

    fn raw(&mut self, bytes: &[u8]) {
        self.dst.put_slice(bytes);
    }
}

/// Reads fields from characters.
#[derive(Clone, Debug)]
pub struct AsciiReader<'a> {
    data: &'a [u8],
}

impl<'a> AsciiReader<'a> {
    /// Reads this data.
    #[must_use]
    pub fn new(data: &'a [u8]) -> Self {
        Self { data }
    }

    fn character(&mut self) -> Result<u8, FieldError> {
        let (&first, rest) = self.data.split_first().ok_or(FieldError::Truncated)?;
        self.data = rest;
        Ok(first)
    }
}

impl FieldReader for AsciiReader<'_> {
    fn count(&mut self) -> Result<usize, FieldError> {
        Ok(match self.byte()? {
            0 => 256,
            n => usize::from(n),
        })
    }

    fn code(&mut self) -> Result<u8, FieldError> {
        let character = self.character()?;
        hex(character).ok_or(FieldError::NotHex(character))
    }

    fn byte(&mut self) -> Result<u8, FieldError> {
        let high = self.code()?;
        Ok(high << 4 | self.code()?)
    }

    fn word(&mut self) -> Result<u16, FieldError> {
        Ok(u16::from_be_bytes([self.byte()?, self.byte()?]))
    }

    fn double(&mut self) -> Result<u32, FieldError> {
        Ok(u32::from_be_bytes([self.byte()?, self.byte()?, self.byte()?, self.byte()?]))
    }

    fn layout(&mut self, _elements: usize, _values: usize) -> Result<(), FieldError> {
        Ok(())
    }

    fn element(&mut self) -> Result<Element, FieldError> {
        // The longest symbol that fits, so that a hexadecimal digit in the address is called that: `RA0012`.
        let mut symbols = (1..=LONGEST_SYMBOL).rev().filter_map(|length| {
            let (letters, rest) = self.data.split_at_checked(length)?;
            Some((Symbol::from_letters(letters)?, rest))
        });
        let (symbol, rest) = symbols.next().ok_or(ElementError::UnknownSymbol)?;
        let (digits, rest) = rest.split_at_checked(symbol.digits()).ok_or(FieldError::Truncated)?;
        let mut address = 0_u32;
        for &digit in digits {
            let value = digit.is_ascii_digit().then_some(digit & 0x0F).ok_or(FieldError::NotDecimal(digit))?;
            address = address.saturating_mul(10).saturating_add(u32::from(value));
        }
        self.data = rest;
        let address = u16::try_from(address).map_err(|_| ElementError::OutOfRange { symbol, address })?;
        Ok(Element::new(symbol, address)?)
    }

    fn rest(&mut self) -> &[u8] {
        std::mem::take(&mut self.data)
    }

    fn is_empty(&self) -> bool {
        self.data.is_empty()
    }
}

fn digit(value: u8) -> u8 {
    match value {
        0..=9 => b'0'.wrapping_add(value),
        _ => b'A'.wrapping_add(value.wrapping_sub(10)),
    }
}

fn hex(character: u8) -> Option<u8> {
    char::from(character).to_digit(16).and_then(|d| u8::try_from(d).ok())
}

#[cfg(test)]
mod tests;
