//! Deviations of a simulated PLC from the protocol documents, other than [faults](super::fault): how it
//! always behaves, not what goes wrong now and then.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use tokio_util::codec::Encoder;

use super::Plc;
use super::bus::Bus;
use crate::command::Code;
use crate::wire::ascii::{self, ETX, STX};
use crate::wire::{AsciiCodec, BinaryCodec, Codec, Discard, Frame, Framing, Received, Side};

/// A way in which a PLC differs from the protocol documents, for tests of programs that must notice it.
///
/// ```
/// use bytes::BytesMut;
/// use fatek::sim::{Bus, Plc, Quirk};
/// use fatek::wire::{AsciiCodec, Framing};
/// use tokio_util::codec::Decoder;
///
/// // A PLC that reads 65 registers: the documents have 64.
/// let plc = Plc::new();
/// let registers = format!("0{}", "0000".repeat(65));
/// plc.add_quirk(Quirk::reply(0x46, "41R00000", Some(&registers)));
///
/// let bus = Bus::new().with_station(1, plc)?;
/// let mut line = BytesMut::from(&b"\x02014641R0000074\x03"[..]);
/// let mut reply = BytesMut::new();
/// bus.answer(&AsciiCodec::new().decode(&mut line)?.unwrap(), Framing::Ascii, &mut reply);
/// assert_eq!(reply.len(), 9 + 4 * 65);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Quirk {
    /// One request has a reply of its own. It is not executed.
    #[non_exhaustive]
    Reply {
        /// The code of the command.
        command: u8,
        /// The data of the request, all of it: characters in ASCII, bytes in binary.
        data: Bytes,
        /// The data of the reply, with the error code; `None`: no reply.
        reply: Option<Bytes>,
    },
    /// Replies have lower-case hexadecimal digits. ASCII framing only; loop-backs stay as they are.
    LowerCase,
    /// Zeros follow an error code.
    DataWithErrors,
    /// Requests with a wrong checksum are executed and answered.
    AnswersBadChecksum,
    /// Requests to other stations are executed and answered, under the number of this one.
    AnswersAnyStation,
    /// Of two reads that have arrived together, the second one is answered first.
    ///
    /// On a stream, and for a bus without faults. Loop-backs keep their place.
    ReadsReversed,
    /// A loop-back that has arrived together with the request before it is answered before that.
    ///
    /// On a stream, and for a bus without faults.
    LoopBackFirst,
    /// Connections are closed after this time without a request. For a bus without faults.
    ClosesIdle(Duration),
}

impl Quirk {
    /// A [`Quirk::Reply`].
    #[must_use]
    pub fn reply(command: u8, data: impl Into<Bytes>, reply: Option<&str>) -> Self {
        Self::Reply { command, data: data.into(), reply: reply.map(|reply| Bytes::copy_from_slice(reply.as_bytes())) }
    }
}

/// The quirks of a PLC.
#[derive(Clone, Debug, Default)]
pub(super) struct Quirks(Vec<Quirk>);

impl Quirks {
    pub(super) fn add(&mut self, quirk: Quirk) {
        self.0.push(quirk);
    }

    fn has(&self, quirk: &Quirk) -> bool {
        self.0.contains(quirk)
    }

    /// The data of the reply to a request that has one of its own.
    pub(super) fn own_reply(&self, request: &Frame) -> Option<Option<Bytes>> {
        self.0.iter().find_map(|quirk| match quirk {
            Quirk::Reply { command, data, reply } if *command == request.command && *data == request.data => {
                Some(reply.clone())
            }
            Quirk::Reply { .. }
            | Quirk::LowerCase
            | Quirk::DataWithErrors
            | Quirk::AnswersBadChecksum
            | Quirk::AnswersAnyStation
            | Quirk::ReadsReversed
            | Quirk::LoopBackFirst
            | Quirk::ClosesIdle(_) => None,
        })
    }

    /// Changes the reply that begins at `start`.
    pub(super) fn change_reply(&self, replies: &mut BytesMut, start: usize, request: &Frame, framing: Framing) {
        if replies.len() == start || request.command == u8::from(Code::LoopBack) {
            return;
        }
        let mut reply = replies.split_off(start);
        if self.has(&Quirk::DataWithErrors)
            && let Some(code) = refusal(&reply, framing)
        {
            reply.clear();
            let data = [&[code], &b"0000"[..]].concat();
            emit(&Frame { data: data.into(), ..request.clone() }, framing, &mut reply);
        }
        if framing == Framing::Ascii && self.has(&Quirk::LowerCase) {
            lower(&mut reply);
        }
        replies.unsplit(reply);
    }
}

/// The error code of a reply without data.
fn refusal(reply: &[u8], framing: Framing) -> Option<u8> {
    let code = match framing {
        Framing::Ascii => *reply.get(5)?,
        Framing::Binary => *reply.get(6)?,
    };
    let is_refusal = reply.len() == framing.reply_overhead() && code != b'0' && code != 0;
    is_refusal.then_some(code)
}

/// Appends a reply as a whole frame. One that cannot be encoded is left out.
pub(super) fn emit(frame: &Frame, framing: Framing, replies: &mut BytesMut) {
    let encoded = match framing {
        Framing::Ascii => AsciiCodec::new().encode(frame, replies),
        Framing::Binary => BinaryCodec::plc().encode(frame, replies),
    };
    debug_assert!(encoded.is_ok(), "{encoded:?}");
}

/// Rewrites an ASCII frame in lower case.
fn lower(frame: &mut BytesMut) {
    frame.make_ascii_lowercase();
    let Some(end) = frame.len().checked_sub(3) else { return };
    let sum = format!("{:02x}", ascii::lrc(&frame[..end]));
    frame[end..end + 2].copy_from_slice(sum.as_bytes());
}

impl Bus {
    /// Returns a received item as the PLCs of the line take it.
    pub(super) fn taken_for(&self, item: Received, framing: Framing) -> Received {
        let has = |quirk: &Quirk| self.plcs().find(|(_, plc)| plc.quirks().has(quirk)).map(|(station, _)| station);
        match item {
            Received::Discarded { reason: Discard::BadChecksum, bytes }
                if has(&Quirk::AnswersBadChecksum).is_some() =>
            {
                let frame = with_good_checksum(&bytes, framing);
                frame.map_or(Received::Discarded { reason: Discard::BadChecksum, bytes }, Received::Frame)
            }
            Received::Frame(frame) if frame.station != super::bus::BROADCAST && self.plc(frame.station).is_none() => {
                let station = has(&Quirk::AnswersAnyStation).unwrap_or(frame.station);
                Received::Frame(Frame { station, ..frame })
            }
            Received::Frame(_) | Received::Discarded { .. } => item,
        }
    }

    /// Returns whether requests that arrive together may be answered in another order.
    pub(super) fn reorders(&self) -> bool {
        let reorders = |quirks: &Quirks| quirks.has(&Quirk::ReadsReversed) || quirks.has(&Quirk::LoopBackFirst);
        self.plcs().any(|(_, plc)| reorders(&plc.quirks()))
    }

    /// Puts requests that have arrived together into the order in which they are answered.
    pub(super) fn reorder(&self, items: &mut [Received]) {
        let has = |quirk: &Quirk| self.plcs().any(|(_, plc)| plc.quirks().has(quirk));
        let command = |item: &Received| if let Received::Frame(frame) = item { Some(frame.command) } else { None };
        let loop_back = Some(u8::from(Code::LoopBack));
        for n in 1..items.len() {
            let (before, now) = (command(&items[n - 1]), command(&items[n]));
            let overtakes = match before.is_some() && before != loop_back {
                true if now == loop_back => has(&Quirk::LoopBackFirst),
                true => now.is_some() && has(&Quirk::ReadsReversed),
                false => false,
            };
            if overtakes {
                items.swap(n - 1, n);
            }
        }
    }

    /// The time without a request after which a connection is closed.
    pub(super) fn idle_limit(&self) -> Option<Duration> {
        self.plcs().find_map(|(_, plc)| plc.quirks().idle_limit())
    }
}

impl Quirks {
    fn idle_limit(&self) -> Option<Duration> {
        self.0.iter().find_map(|quirk| if let Quirk::ClosesIdle(after) = *quirk { Some(after) } else { None })
    }
}

/// The content of a frame with a wrong checksum.
fn with_good_checksum(bytes: &[u8], framing: Framing) -> Option<Frame> {
    let mut fixed = BytesMut::new();
    match framing {
        Framing::Ascii => {
            let content = bytes.strip_prefix(&[STX])?.strip_suffix(&[ETX])?;
            let (content, _) = content.split_at_checked(content.len().checked_sub(2)?)?;
            fixed.extend_from_slice(&[&[STX], content].concat());
            let sum = format!("{:02X}", ascii::lrc(&fixed));
            fixed.extend_from_slice(sum.as_bytes());
            fixed.extend_from_slice(&[ETX]);
        }
        Framing::Binary => {
            // Header, length, payload, CRC, end.
            let payload = bytes.get(4..bytes.len().checked_sub(4)?)?;
            let [station, command, data @ ..] = payload else { return None };
            return Some(Frame { station: *station, command: *command, data: Bytes::copy_from_slice(data) });
        }
    }
    let decoded = tokio_util::codec::Decoder::decode(&mut Codec::new(framing, Side::Plc), &mut fixed);
    decoded.ok().flatten().and_then(Received::frame)
}

impl Plc {
    /// Adds a deviation from the documents, for all requests from now on.
    pub fn add_quirk(&self, quirk: Quirk) {
        self.change_quirks(|quirks| quirks.add(quirk));
    }
}

#[cfg(test)]
mod tests;
