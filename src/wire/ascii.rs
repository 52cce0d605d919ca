//! The ASCII framing: all FB, FBe, FBs and B1 PLCs, over serial, TCP and UDP.
//!
//! ```text
//! STX  station  command  data          LRC    ETX
//! 02h  2 hex    2 hex    0..500 chars  2 hex  03h
//! ```
//!
//! The LRC is the low byte of the sum of all bytes from STX to the end of the data. Numbers are
//! hexadecimal: upper case is sent, either case is received. Addresses of elements are decimal.
//! Source: protocol reference, section 1 (manuals 000 and 002, section 2).

use std::io;

use bytes::BytesMut;
use tokio_util::codec::{Decoder, Encoder};

use super::bulk;
use super::field::{FieldError, FieldReader, FieldWriter};
use super::frame::{Discard, EncodeError, Found, FoundFrame, Frame, MAX_FRAME_LEN, Received};
use super::framing::Framing;
use crate::element::{Element, ElementError, LONGEST_ADDRESS, LONGEST_SYMBOL, Symbol};
use crate::hex;

/// The first byte of a frame.
pub const STX: u8 = 0x02;
/// The last byte of a frame.
pub const ETX: u8 = 0x03;

/// The `tokio_util` codec of the ASCII framing.
///
/// It serves both sides, because queries and replies have the same form in this framing. Decoding
/// yields [`Received`], for noise as well, and errors of the transport only.
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
    /// The length of the beginning of the buffer that was searched for STX and ETX.
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

    /// Discards the first byte of an incomplete frame; see
    /// [`Codec::skip_partial`](super::Codec::skip_partial).
    ///
    /// Does nothing in this framing: a frame that was cut off ends at the next STX.
    pub fn skip_partial(&mut self) {}

    /// Resets the decoder, for a buffer that has been cleared.
    pub fn reset(&mut self) {
        self.scanned = 0;
    }

    /// See [`Codec::find`](super::Codec::find).
    pub(super) fn find(&mut self, received: &[u8]) -> Option<Found> {
        match received.first() {
            None => return None,
            Some(&STX) => {}
            Some(_) => {
                let garbage = memchr::memchr(STX, received).unwrap_or(received.len());
                return Some(self.discard(garbage, Discard::Garbage));
            }
        }
        // Data contains neither STX nor ETX, so the first of them ends this frame.
        let from = self.scanned.max(1);
        let rest = received.get(from..).unwrap_or_default();
        let mark = memchr::memchr2(STX, ETX, rest).map(|at| at.saturating_add(from));
        let end = mark.unwrap_or(received.len());
        if end >= self.max_frame_len {
            return Some(self.discard(end, Discard::TooLong));
        }
        let Some(mark) = mark else {
            self.scanned = received.len();
            return None;
        };
        if received.get(mark) == Some(&STX) {
            return Some(self.discard(mark, Discard::Truncated));
        }
        self.scanned = 0;
        let len = mark.saturating_add(1);
        let content = parse(received.get(..len).unwrap_or_default()).map(|(station, command)| {
            let end = len.saturating_sub(TAIL);
            FoundFrame { station, command, data: HEAD.min(end)..end }
        });
        Some(Found { len, content })
    }

    fn discard(&mut self, len: usize, reason: Discard) -> Found {
        self.scanned = 0;
        Found::noise(len, reason)
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
        Ok(self.find(src).map(|found| found.take_from(src)))
    }

    fn decode_eof(&mut self, src: &mut BytesMut) -> Result<Option<Received>, io::Error> {
        Ok(match self.decode(src)? {
            None if !src.is_empty() => Some(self.discard(src.len(), Discard::Truncated).take_from(src)),
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
        if let Some((position, byte)) = find_unprintable(&frame.data) {
            return Err(EncodeError::NotPrintable { byte, position });
        }
        dst.reserve(len);
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

/// Appends a frame. The closure writes its data.
pub(crate) fn emit(dst: &mut BytesMut, station: u8, command: u8, data: impl FnOnce(&mut AsciiWriter<'_>)) {
    let start = dst.len();
    let ([s1, s0], [c1, c0]) = (hex::of_byte(station), hex::of_byte(command));
    dst.extend_from_slice(&[STX, s1, s0, c1, c0]);
    data(&mut AsciiWriter { dst });
    let [l1, l0] = hex::of_byte(lrc(dst.get(start..).unwrap_or_default()));
    dst.extend_from_slice(&[l1, l0, ETX]);
}

/// The first byte that is not a printable character, and its position.
///
/// Such bytes cannot be sent: STX and ETX would end the frame, and a line of 7 data bits drops the
/// eighth.
pub(crate) fn find_unprintable(data: &[u8]) -> Option<(usize, u8)> {
    let printable = |byte: &u8| (0x20..=0x7E).contains(byte);
    // No early exit: nearly always all are printable, and a plain loop is vectorised.
    if data.iter().fold(true, |all, byte| all & printable(byte)) {
        return None;
    }
    data.iter().copied().enumerate().find(|(_, byte)| !printable(byte))
}

/// STX, station and command.
const HEAD: usize = 5;
/// LRC and ETX.
const TAIL: usize = 3;
/// A frame without data.
pub(crate) const OVERHEAD: usize = HEAD + TAIL;

/// The LRC: the low byte of the sum.
#[must_use]
pub fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |sum, &byte| sum.wrapping_add(byte))
}

/// The station and the command of a complete frame, STX to ETX, with a good checksum.
fn parse(bytes: &[u8]) -> Result<(u8, u8), Discard> {
    let body_len = bytes.len().checked_sub(TAIL).ok_or(Discard::Malformed)?;
    let (body, tail) = bytes.split_at_checked(body_len).ok_or(Discard::Malformed)?;
    let mut header = AsciiReader::new(body.get(1..).unwrap_or_default());
    let [station, command] = header.word().map_err(|_| Discard::Malformed)?.to_be_bytes();
    let stated = AsciiReader::new(tail).byte().map_err(|_| Discard::BadChecksum)?;
    if stated == lrc(body) { Ok((station, command)) } else { Err(Discard::BadChecksum) }
}

/// The character in place of each digit of an address that the field cannot hold.
const NO_DIGIT: u8 = b'?';

/// Writes fields as characters.
///
/// An element past the last address of this framing is written without an address: `M????`, which no
/// PLC takes for an element. [`Command::check`](crate::command::Command::check) refuses it before.
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
        // A code above F has no digit. It must not look like another code, least of all like 0,
        // success.
        self.dst.extend_from_slice(&[hex::digit(code.min(0x0F))]);
    }

    fn byte(&mut self, byte: u8) {
        self.dst.extend_from_slice(&hex::of_byte(byte));
    }

    fn word(&mut self, word: u16) {
        self.dst.extend_from_slice(&hex::of_word(word));
    }

    fn dword(&mut self, dword: u32) {
        self.dst.extend_from_slice(&hex::of_dword(dword));
    }

    fn element(&mut self, element: Element) {
        let (letters, digits) = (element.symbol().as_str().as_bytes(), element.symbol().digits());
        // Filled from the end, and appended at once: a mixed read has 64 elements.
        let mut field = [NO_DIGIT; LONGEST_SYMBOL + LONGEST_ADDRESS];
        let mut places = field.iter_mut().rev();
        // The low digits of an address with more than the field has would name another element.
        let is_short = element.check_in(Framing::Ascii).is_ok();
        let mut address = element.address();
        for place in places.by_ref().take(digits).filter(|_| is_short) {
            let [low, _] = (address % 10).to_le_bytes();
            *place = hex::digit(low);
            address /= 10;
        }
        places.zip(letters.iter().rev()).for_each(|(place, &letter)| *place = letter);
        let unused = field.len().saturating_sub(letters.len().saturating_add(digits));
        self.dst.extend_from_slice(field.get(unused..).unwrap_or_default());
    }

    fn bits(&mut self, bits: &[bool]) {
        bulk::put(self.dst, bits, |bit| [b'0' | u8::from(bit)]);
    }

    fn words(&mut self, words: &[u16]) {
        bulk::put(self.dst, words, hex::of_word);
    }

    fn dwords(&mut self, dwords: &[u32]) {
        bulk::put(self.dst, dwords, hex::of_dword);
    }

    fn raw(&mut self, bytes: &[u8]) {
        self.dst.extend_from_slice(bytes);
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

    /// The next `N` characters, which must be digits.
    fn digits<const N: usize>(&mut self) -> Result<[u8; N], FieldError> {
        match self.data.split_first_chunk() {
            Some((digits, rest)) if hex::are_digits(digits) => {
                self.data = rest;
                Ok(*digits)
            }
            _ => Err(self.not_digits(N)),
        }
    }

    /// The reason why the next `count` characters are not digits.
    fn not_digits(&self, count: usize) -> FieldError {
        let first = self.data.iter().take(count).find(|character| !character.is_ascii_hexdigit());
        first.map_or(FieldError::Truncated, |&character| FieldError::NotHex(character))
    }

    /// One value of `N` digits for each place of the slice.
    fn values<T, const N: usize>(&mut self, into: &mut [T], value: impl Fn([u8; N]) -> T) -> Result<(), FieldError> {
        let count = into.len().saturating_mul(N);
        match self.data.split_at_checked(count) {
            Some((digits, rest)) if hex::are_digits(digits) => {
                self.data = rest;
                bulk::fill(into, digits, value);
                Ok(())
            }
            _ => Err(self.not_digits(count)),
        }
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
        let [digit] = self.digits()?;
        Ok(hex::value(digit))
    }

    fn byte(&mut self) -> Result<u8, FieldError> {
        self.digits().map(hex::byte)
    }

    fn word(&mut self) -> Result<u16, FieldError> {
        self.digits().map(hex::word)
    }

    fn dword(&mut self) -> Result<u32, FieldError> {
        self.digits().map(hex::dword)
    }

    fn bits(&mut self, into: &mut [bool]) -> Result<(), FieldError> {
        if let Some((bits, rest)) = self.data.split_at_checked(into.len())
            && bits.iter().fold(0, |all, bit| all | bit ^ b'0') <= 1
        {
            self.data = rest;
            bulk::fill(into, bits, |[bit]| bit & 1 == 1);
            return Ok(());
        }
        // One by one: the first wrong one is the error.
        into.iter_mut().try_for_each(|bit| self.bit().map(|value| *bit = value))
    }

    fn words(&mut self, into: &mut [u16]) -> Result<(), FieldError> {
        self.values(into, hex::word)
    }

    fn dwords(&mut self, into: &mut [u32]) -> Result<(), FieldError> {
        self.values(into, hex::dword)
    }

    fn layout(&mut self, _elements: usize, _values: usize) -> Result<(), FieldError> {
        Ok(())
    }

    fn element(&mut self) -> Result<Element, FieldError> {
        // The longest symbol first. In `RA0012`, the `A` is then a wrong digit of `R`, not an
        // unknown symbol.
        let mut symbols = (1..=LONGEST_SYMBOL).rev().filter_map(|length| {
            let (letters, rest) = self.data.split_at_checked(length)?;
            Some((Symbol::from_letters(letters)?, rest))
        });
        let (symbol, rest) = symbols.next().ok_or(ElementError::UnknownSymbol)?;
        let (digits, rest) = rest.split_at_checked(symbol.digits()).ok_or(FieldError::Truncated)?;
        let mut address = 0_u32;
        for &digit in digits {
            let value = digit.is_ascii_digit().then_some(digit & 0x0F).ok_or(FieldError::NotDecimal(digit))?;
            // At most five digits.
            address = address.saturating_mul(10).saturating_add(u32::from(value));
        }
        self.data = rest;
        Ok(Element::received(symbol, address, Framing::Ascii)?)
    }

    fn rest(&mut self) -> &[u8] {
        std::mem::take(&mut self.data)
    }

    fn is_empty(&self) -> bool {
        self.data.is_empty()
    }
}

#[cfg(test)]
mod tests;
