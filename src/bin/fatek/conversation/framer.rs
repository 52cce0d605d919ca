//! Frames of one connection: bytes and times in, frames with their bytes out.

use std::time::Duration;

use bytes::{Bytes, BytesMut};
use fatek::wire::ascii::STX;
use fatek::wire::binary::{ID, QUERY, REPLY};
use fatek::wire::{Codec, Discard, Framing, MAX_FRAME_LEN, Received, Side};
use tokio_util::codec::Decoder;

use super::{Direction, Timestamp};

/// Longest pause within a frame: the beginning of a frame is not completed after it.
const FRAME_TIMEOUT: Duration = Duration::from_secs(2);

/// Bytes that are decoded at a time, which bounds the copy of the bytes of an item.
const STEP: usize = 512;

/// Splits the bytes of both directions into frames.
///
/// The framing is that of the first frame of either direction, unless it is given. Before it is known,
/// bytes wait, up to the length of a frame.
#[derive(Debug)]
pub(super) struct Framer {
    framing: Option<Framing>,
    to_plc: OneWay,
    from_plc: OneWay,
}

/// An item of a codec, with its bytes and the time of the last of them.
#[derive(Debug)]
pub(super) struct Framed {
    pub(super) direction: Direction,
    pub(super) at: Timestamp,
    pub(super) received: Received,
    pub(super) bytes: Bytes,
    pub(super) framing: Framing,
}

/// One direction.
#[derive(Debug, Default)]
struct OneWay {
    codec: Option<Codec>,
    buffer: BytesMut,
    /// Time of the last bytes.
    at: Timestamp,
}

impl Framer {
    pub(super) fn new(framing: Option<Framing>) -> Self {
        Self { framing, to_plc: OneWay::default(), from_plc: OneWay::default() }
    }

    /// Takes bytes, and returns the items that are complete with them. `is_datagram`: no frame goes on
    /// behind them.
    pub(super) fn push(&mut self, direction: Direction, at: Timestamp, bytes: &[u8], is_datagram: bool) -> Vec<Framed> {
        let mut framed = Vec::new();
        let last_at = self.one_way(direction).at;
        if at.saturating_sub(last_at) > FRAME_TIMEOUT {
            framed = self.flush(direction, last_at);
        }
        self.one_way(direction).at = at;
        for bytes in bytes.chunks(STEP) {
            self.one_way(direction).buffer.extend_from_slice(bytes);
            self.decode(direction, at, false, &mut framed);
        }
        if is_datagram {
            framed.append(&mut self.flush(direction, at));
        }
        framed
    }

    /// Ends an incomplete frame.
    pub(super) fn flush(&mut self, direction: Direction, at: Timestamp) -> Vec<Framed> {
        let mut framed = Vec::new();
        self.decode(direction, at, true, &mut framed);
        framed
    }

    fn one_way(&mut self, direction: Direction) -> &mut OneWay {
        match direction {
            Direction::ToPlc => &mut self.to_plc,
            Direction::FromPlc => &mut self.from_plc,
        }
    }

    fn decode(&mut self, direction: Direction, at: Timestamp, ends: bool, framed: &mut Vec<Framed>) {
        let known = self.framing;
        let one_way = self.one_way(direction);
        let Some(framing) = known.or_else(|| detect(&one_way.buffer)) else {
            if ends && !one_way.buffer.is_empty() || one_way.buffer.len() > MAX_FRAME_LEN {
                let bytes = one_way.buffer.split().freeze();
                let received = Received::Discarded { reason: Discard::Garbage, bytes: bytes.clone() };
                framed.push(Framed { direction, at, received, bytes, framing: Framing::default() });
            }
            return;
        };
        self.framing = Some(framing);
        let side = match direction {
            Direction::ToPlc => Side::Plc,
            Direction::FromPlc => Side::Client,
        };
        let OneWay { codec, buffer, .. } = self.one_way(direction);
        let codec = codec.get_or_insert_with(|| Codec::new(framing, side));
        loop {
            let before = buffer.to_vec();
            // The codecs do no I/O, so they return no errors.
            let item = if ends { codec.decode_eof(buffer) } else { codec.decode(buffer) };
            let Some(mut received) = item.ok().flatten() else { break };
            let consumed = before.get(..before.len().saturating_sub(buffer.len())).unwrap_or_default();
            // Copies: a part of the buffer keeps all of it in memory.
            let bytes = Bytes::copy_from_slice(consumed);
            if let Received::Frame(frame) = &mut received {
                frame.data = Bytes::copy_from_slice(&frame.data);
            }
            framed.push(Framed { direction, at, received, bytes, framing });
        }
    }
}

/// Framing of the first bytes that can begin a frame.
fn detect(bytes: &[u8]) -> Option<Framing> {
    bytes.iter().enumerate().find_map(|(i, &byte)| match byte {
        STX => Some(Framing::Ascii),
        QUERY | REPLY if bytes.get(i + 1) == Some(&ID) => Some(Framing::Binary),
        _ => None,
    })
}
