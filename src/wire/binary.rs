//! The binary framing: the M series, over serial and TCP.
//!
//! ```text
//! header   id   length   payload                  CRC      terminator
//! 51h/52h  10h  2 bytes  station command data …   2 bytes  55h AAh
//! ```
//!
//! 51h is a query, 52h a reply. The length is that of the payload, big-endian. The CRC is
//! CRC-16/MODBUS over length and payload, low byte first. The terminator can also occur inside the
//! payload, so the length decides where a frame ends. Source: protocol reference, section 2 (manual
//! 001, sections 1 and 2).

use std::io;

use bytes::BytesMut;
use tokio_util::codec::{Decoder, Encoder};

use super::field::{FieldError, FieldReader, FieldWriter};
use super::frame::{Discard, EncodeError, Found, FoundFrame, Frame, MAX_FRAME_LEN, Received, Side};
use super::framing::Framing;
use super::{bulk, crc16, element_list};
use crate::element::Element;

/// The first byte of a query.
pub const QUERY: u8 = 0x51;
/// The first byte of a reply.
pub const REPLY: u8 = 0x52;
/// The second byte of every frame.
pub const ID: u8 = 0x10;
/// The last two bytes of every frame.
pub const TERMINATOR: [u8; 2] = [0x55, 0xAA];

/// The `tokio_util` codec of the binary framing.
///
/// [`client`](Self::client) sends queries and receives replies, [`plc`](Self::plc) the other way
/// round. Decoding yields [`Received`], for noise as well, and errors of the transport only.
///
/// The decoder waits for all bytes that the length field announces, even if a complete frame is
/// among them: a payload may contain one. If the line falls silent,
/// [`skip_partial`](Self::skip_partial) discards the incomplete frame. At the end of the input,
/// `decode_eof` does so.
///
/// ```
/// use bytes::BytesMut;
/// use fatek::wire::{BinaryCodec, Received};
/// use tokio_util::codec::Decoder;
///
/// let mut buffer = BytesMut::from(&b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA"[..]);
/// let Some(Received::Frame(frame)) = BinaryCodec::client().decode(&mut buffer)? else { panic!() };
/// assert_eq!((frame.station, frame.command, &frame.data[..]), (1, 0x41, &b"\x00"[..]));
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct BinaryCodec {
    side: Side,
    max_frame_len: usize,
    /// The buffer began with an incomplete frame when it was last decoded.
    partial: bool,
    /// Discard the incomplete frame if it is still incomplete when it is decoded next.
    give_up: bool,
}

impl BinaryCodec {
    /// A codec that sends queries and receives replies, with the default limit, [`MAX_FRAME_LEN`].
    #[must_use]
    pub fn client() -> Self {
        Self { side: Side::Client, max_frame_len: MAX_FRAME_LEN, partial: false, give_up: false }
    }

    /// A codec that receives queries and sends replies, with the default limit, [`MAX_FRAME_LEN`].
    #[must_use]
    pub fn plc() -> Self {
        Self { side: Side::Plc, ..Self::client() }
    }

    /// Sets the longest frame, in bytes from header to terminator.
    #[must_use]
    pub fn max_frame_len(mut self, bytes: usize) -> Self {
        self.max_frame_len = bytes;
        self
    }

    /// Discards the first byte of an incomplete frame; see
    /// [`Codec::skip_partial`](super::Codec::skip_partial).
    pub fn skip_partial(&mut self) {
        self.give_up = self.partial;
    }

    /// Resets the decoder, for a buffer that has been cleared.
    pub fn reset(&mut self) {
        self.partial = false;
        self.give_up = false;
    }

    /// See [`Codec::find`](super::Codec::find).
    pub(super) fn find(&mut self, received: &[u8]) -> Option<Found> {
        self.partial = false;
        let garbage = begin(received, 0);
        if garbage > 0 {
            return Some(Found::noise(garbage, Discard::Garbage));
        }
        if received.is_empty() {
            return None;
        }
        let give_up = std::mem::take(&mut self.give_up);
        let reason = match measure(received, self.max_frame_len) {
            Measure::Partial if give_up => Discard::Truncated,
            Measure::Partial => {
                self.partial = true;
                return None;
            }
            Measure::Bad(reason) => reason,
            Measure::Whole { len, good: true } => {
                let own = received.first() == Some(&self.emits());
                let content = if own { Err(Discard::WrongSide) } else { Ok(content(received, len)) };
                return Some(Found { len, content });
            }
            Measure::Whole { good: false, .. } => Discard::BadChecksum,
        };
        // Not a frame. A good one may begin inside it, so only the bytes up to the next possible
        // beginning are discarded.
        Some(Found::noise(begin(received, 1), reason))
    }

    fn emits(&self) -> u8 {
        match self.side {
            Side::Client => QUERY,
            Side::Plc => REPLY,
        }
    }
}

impl Decoder for BinaryCodec {
    type Item = Received;
    type Error = io::Error;

    fn decode(&mut self, src: &mut BytesMut) -> Result<Option<Received>, io::Error> {
        Ok(self.find(src).map(|found| found.take_from(src)))
    }

    fn decode_eof(&mut self, src: &mut BytesMut) -> Result<Option<Received>, io::Error> {
        loop {
            match self.decode(src)? {
                None if src.is_empty() => return Ok(None),
                None => self.skip_partial(),
                item => return Ok(item),
            }
        }
    }
}

impl Encoder<&Frame> for BinaryCodec {
    type Error = EncodeError;

    fn encode(&mut self, frame: &Frame, dst: &mut BytesMut) -> Result<(), EncodeError> {
        let len = frame.data.len().saturating_add(OVERHEAD);
        let max = self.max_frame_len.min(LONGEST);
        if len > max {
            return Err(EncodeError::TooLong { len, max });
        }
        dst.reserve(len);
        emit(dst, self.side, frame.station, frame.command, |fields| fields.raw(&frame.data));
        Ok(())
    }
}

impl Encoder<Frame> for BinaryCodec {
    type Error = EncodeError;

    fn encode(&mut self, frame: Frame, dst: &mut BytesMut) -> Result<(), EncodeError> {
        self.encode(&frame, dst)
    }
}

/// Appends a frame. The closure writes its data, at most 65,533 bytes.
pub(crate) fn emit(dst: &mut BytesMut, side: Side, station: u8, command: u8, data: impl FnOnce(&mut BinaryWriter<'_>)) {
    let header = match side {
        Side::Client => QUERY,
        Side::Plc => REPLY,
    };
    let start = dst.len();
    dst.extend_from_slice(&[header, ID, 0, 0, station, command]);
    data(&mut BinaryWriter { dst });
    let payload = dst.len().saturating_sub(start).saturating_sub(HEAD);
    let length_field = start.saturating_add(2);
    debug_assert!(payload <= usize::from(u16::MAX), "the callers check the length");
    // A payload that does not fit would be sent with length 0, which no PLC answers.
    let length = u16::try_from(payload).unwrap_or_default().to_be_bytes();
    if let Some(field) = dst.get_mut(length_field..).and_then(|tail| tail.first_chunk_mut()) {
        *field = length;
    }
    let [low, high] = crc(dst.get(length_field..).unwrap_or_default()).to_le_bytes();
    let [end, of_frame] = TERMINATOR;
    dst.extend_from_slice(&[low, high, end, of_frame]);
}

/// CRC-16/MODBUS.
#[must_use]
pub fn crc(bytes: &[u8]) -> u16 {
    crc16::checksum(bytes)
}

/// Header, id and length.
const HEAD: usize = 4;
/// CRC and terminator.
const TAIL: usize = 4;
/// A frame without data: head, station, command, tail.
pub(crate) const OVERHEAD: usize = HEAD + 2 + TAIL;
/// The longest frame that the length field can announce.
const LONGEST: usize = 65_535 + HEAD + TAIL;

/// The first position from `from` on where a frame can begin; the end of the buffer if there is
/// none.
fn begin(bytes: &[u8], from: usize) -> usize {
    let tail = bytes.get(from..).unwrap_or_default();
    let at = tail.iter().enumerate().position(|(i, &byte)| {
        let id = tail.get(i.saturating_add(1));
        matches!(byte, QUERY | REPLY) && id.is_none_or(|&id| id == ID)
    });
    at.map_or(bytes.len(), |at| from.saturating_add(at))
}

enum Measure {
    /// The beginning of what may be a frame.
    Partial,
    /// Not a frame.
    Bad(Discard),
    /// A complete frame, and whether checksum and terminator are good.
    Whole { len: usize, good: bool },
}

/// Measures the frame at the beginning of the buffer, whose header and id are good.
fn measure(bytes: &[u8], max: usize) -> Measure {
    let Some(&[_, _, high, low]) = bytes.first_chunk::<HEAD>() else {
        return Measure::Partial;
    };
    let payload = usize::from(u16::from_be_bytes([high, low]));
    let len = payload.saturating_add(HEAD).saturating_add(TAIL);
    if payload < 2 {
        return Measure::Bad(Discard::Malformed);
    }
    if len > max {
        return Measure::Bad(Discard::TooLong);
    }
    let Some(frame) = bytes.get(..len) else {
        return Measure::Partial;
    };
    // The terminator first: it is cheap to check, and most noise fails it, so no CRC is computed.
    let good = frame
        .strip_suffix(&TERMINATOR)
        .and_then(<[u8]>::split_last_chunk)
        .is_some_and(|(covered, stated)| u16::from_le_bytes(*stated) == crc(covered.get(2..).unwrap_or_default()));
    Measure::Whole { len, good }
}

/// The content of a complete, good frame of this length at the beginning of received bytes.
fn content(received: &[u8], len: usize) -> FoundFrame {
    debug_assert!(len >= OVERHEAD, "a good frame has a station, which is not 0 for want of one");
    let station = received.get(HEAD).copied().unwrap_or_default();
    let command = received.get(HEAD + 1).copied().unwrap_or_default();
    FoundFrame { station, command, data: HEAD + 2..len.saturating_sub(TAIL) }
}

/// Writes fields as bytes.
#[derive(Debug)]
pub struct BinaryWriter<'a> {
    dst: &'a mut BytesMut,
}

impl<'a> BinaryWriter<'a> {
    /// Appends to this buffer.
    pub fn new(dst: &'a mut BytesMut) -> Self {
        Self { dst }
    }
}

impl FieldWriter for BinaryWriter<'_> {
    fn count(&mut self, count: usize) {
        let [low, ..] = count.to_le_bytes();
        self.dst.extend_from_slice(&[low]);
    }

    fn code(&mut self, code: u8) {
        self.dst.extend_from_slice(&[code]);
    }

    fn byte(&mut self, byte: u8) {
        self.dst.extend_from_slice(&[byte]);
    }

    fn word(&mut self, word: u16) {
        self.dst.extend_from_slice(&word.to_be_bytes());
    }

    fn dword(&mut self, dword: u32) {
        self.dst.extend_from_slice(&dword.to_be_bytes());
    }

    fn element(&mut self, element: Element) {
        let [high, low] = element.address().to_be_bytes();
        // Appended at once: each append checks the room in the buffer.
        match *element.symbol().as_str().as_bytes() {
            [a] => self.dst.extend_from_slice(&[a, high, low]),
            [a, b] => self.dst.extend_from_slice(&[a, b, high, low]),
            ref symbol => {
                self.dst.extend_from_slice(symbol);
                self.dst.extend_from_slice(&[high, low]);
            }
        }
    }

    fn bits(&mut self, bits: &[bool]) {
        bulk::put(self.dst, bits, |bit| [u8::from(bit)]);
    }

    fn words(&mut self, words: &[u16]) {
        bulk::put(self.dst, words, u16::to_be_bytes);
    }

    fn dwords(&mut self, dwords: &[u32]) {
        bulk::put(self.dst, dwords, u32::to_be_bytes);
    }

    fn raw(&mut self, bytes: &[u8]) {
        self.dst.extend_from_slice(bytes);
    }
}

/// Reads fields from bytes.
#[derive(Clone, Debug)]
pub struct BinaryReader<'a> {
    data: &'a [u8],
    /// The lengths of the symbols that follow, the next one last.
    symbols: Vec<u8>,
}

impl<'a> BinaryReader<'a> {
    /// Reads this data.
    #[must_use]
    pub fn new(data: &'a [u8]) -> Self {
        Self { data, symbols: Vec::new() }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], FieldError> {
        let (taken, rest) = self.data.split_first_chunk().ok_or(FieldError::Truncated)?;
        self.data = rest;
        Ok(*taken)
    }

    /// One value of `N` bytes for each place of the slice.
    fn values<T, const N: usize>(&mut self, into: &mut [T], value: impl Fn([u8; N]) -> T) -> Result<(), FieldError> {
        let (taken, rest) = self.data.split_at_checked(into.len().saturating_mul(N)).ok_or(FieldError::Truncated)?;
        self.data = rest;
        bulk::fill(into, taken, value);
        Ok(())
    }
}

impl FieldReader for BinaryReader<'_> {
    fn count(&mut self) -> Result<usize, FieldError> {
        Ok(match self.byte()? {
            0 => 256,
            n => usize::from(n),
        })
    }

    fn code(&mut self) -> Result<u8, FieldError> {
        self.byte()
    }

    fn byte(&mut self) -> Result<u8, FieldError> {
        let [byte] = self.take()?;
        Ok(byte)
    }

    fn word(&mut self) -> Result<u16, FieldError> {
        Ok(u16::from_be_bytes(self.take()?))
    }

    fn dword(&mut self) -> Result<u32, FieldError> {
        Ok(u32::from_be_bytes(self.take()?))
    }

    fn bits(&mut self, into: &mut [bool]) -> Result<(), FieldError> {
        if let Some((bits, rest)) = self.data.split_at_checked(into.len())
            && bits.iter().fold(0, |all, bit| all | bit) <= 1
        {
            self.data = rest;
            bulk::fill(into, bits, |[bit]| bit & 1 == 1);
            return Ok(());
        }
        // One by one: the first wrong one is the error.
        into.iter_mut().try_for_each(|bit| self.bit().map(|value| *bit = value))
    }

    fn words(&mut self, into: &mut [u16]) -> Result<(), FieldError> {
        self.values(into, u16::from_be_bytes)
    }

    fn dwords(&mut self, into: &mut [u32]) -> Result<(), FieldError> {
        self.values(into, u32::from_be_bytes)
    }

    fn layout(&mut self, elements: usize, values: usize) -> Result<(), FieldError> {
        self.symbols = element_list::symbol_lengths(self.data, elements, values)?;
        self.symbols.reverse();
        Ok(())
    }

    fn element(&mut self) -> Result<Element, FieldError> {
        let length = self.symbols.pop().ok_or(FieldError::Unreadable)?;
        let (letters, rest) = self.data.split_at_checked(usize::from(length)).ok_or(FieldError::Truncated)?;
        let symbol = element_list::symbol(letters).ok_or(FieldError::Unreadable)?;
        self.data = rest;
        Ok(Element::received(symbol, self.word()?.into(), Framing::Binary)?)
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
