//! Reference decoder of the model: splits received bytes into frames and noise.

use std::ops::Range;

use fatek::wire::Framing;

use super::oracle::Mark;
use crate::reference::{frame_content, reference_ranges};
use fatek::wire::Side;

/// Longest frame, in bytes.
const MAX_LEN: usize = 1024;

#[derive(Debug)]
pub(crate) struct LineDecoder {
    framing: Framing,
    buffer: Vec<u8>,
    /// For each byte, the mark of its frame.
    marks: Vec<Option<Mark>>,
}

#[derive(Debug)]
pub(crate) enum Decoded {
    Frame {
        station: u8,
        command: u8,
        data: Vec<u8>,
        bytes: Vec<u8>,
        /// Set if all bytes come from one frame of the PLC.
        mark: Option<Mark>,
    },
    /// `may_hide_frame`: a frame may have been lost in it.
    Noise { may_hide_frame: bool, len: usize },
}

impl LineDecoder {
    pub(crate) fn new(framing: Framing) -> Self {
        Self { framing, buffer: Vec::new(), marks: Vec::new() }
    }

    pub(crate) fn feed(&mut self, bytes: &[u8], marks: &[Option<Mark>]) {
        self.buffer.extend(bytes);
        self.marks.extend(marks);
    }

    pub(crate) fn clear(&mut self) {
        self.buffer.clear();
        self.marks.clear();
    }

    /// Returns whether a frame has begun and not ended.
    pub(crate) fn has_partial_frame(&self) -> bool {
        !self.buffer.is_empty()
    }

    /// Returns the next frame or noise. After a silence, a partial frame is noise.
    pub(crate) fn next(&mut self, silence: bool) -> Option<Decoded> {
        if self.buffer.is_empty() {
            return None;
        }
        match self.framing {
            Framing::Binary => self.next_binary(silence),
            _ => self.next_ascii(),
        }
    }

    /// In ASCII, STX and ETX never stand inside a frame.
    fn next_ascii(&mut self) -> Option<Decoded> {
        let at =
            |from: usize, codes: &[u8]| self.buffer.iter().skip(from).position(|b| codes.contains(b)).map(|n| n + from);
        if self.buffer[0] != 2 {
            let noise = at(0, &[2]).unwrap_or(self.buffer.len());
            return Some(self.noise(false, noise));
        }
        let end = at(1, &[2, 3]);
        let len = end.unwrap_or(self.buffer.len());
        if len >= MAX_LEN {
            return Some(self.noise(true, len));
        }
        let end = end?;
        if self.buffer[end] == 2 { Some(self.noise(true, end)) } else { Some(self.frame_or_noise(0..end + 1)) }
    }

    /// In binary, the length field decides where a frame ends.
    fn next_binary(&mut self, silence: bool) -> Option<Decoded> {
        let noise = self.next_header(0);
        if noise > 0 {
            return Some(self.noise(false, noise));
        }
        let claimed = match self.buffer[..] {
            [_, _, high, low, ..] => Some(usize::from(u16::from_be_bytes([high, low]))),
            _ => None,
        };
        match claimed.map(|payload| (payload, payload + 8)) {
            Some((payload, len)) if payload < 2 || len > MAX_LEN => {}
            Some((_, len)) if self.buffer.len() >= len => {
                let echo = self.buffer[0] == 0x51;
                if self.is_frame(0..len) {
                    // A good frame of the other direction cannot be taken for a reply.
                    return Some(if echo { self.noise(false, len) } else { self.frame_or_noise(0..len) });
                }
            }
            _ if !silence => return None,
            _ => {}
        }
        let next = self.next_header(1);
        Some(self.noise(true, next))
    }

    /// Position of the next possible header, from `from` on.
    fn next_header(&self, from: usize) -> usize {
        let header = |&at: &usize| {
            matches!(self.buffer[at], 0x51 | 0x52) && self.buffer.get(at + 1).is_none_or(|&id| id == 0x10)
        };
        (from..self.buffer.len()).find(header).unwrap_or(self.buffer.len())
    }

    fn is_frame(&self, place: Range<usize>) -> bool {
        let bytes = &self.buffer[place];
        let receiver = if bytes[0] == 0x51 { Side::Plc } else { Side::Client };
        reference_ranges(self.framing, receiver, bytes, MAX_LEN).first() == Some(&(0..bytes.len()))
    }

    fn frame_or_noise(&mut self, place: Range<usize>) -> Decoded {
        if !self.is_frame(place.clone()) {
            return self.noise(true, place.end);
        }
        let marks: Vec<_> = self.marks.drain(place.clone()).collect();
        let mark = marks[0].filter(|first| marks.iter().all(|mark| mark.as_ref() == Some(first)));
        let bytes: Vec<u8> = self.buffer.drain(place).collect();
        let frame = frame_content(self.framing, &bytes);
        Decoded::Frame { station: frame.station, command: frame.command, data: frame.data.to_vec(), bytes, mark }
    }

    fn noise(&mut self, may_hide_frame: bool, len: usize) -> Decoded {
        self.buffer.drain(..len);
        self.marks.drain(..len);
        Decoded::Noise { may_hide_frame, len }
    }
}
