//! What a listener makes of the bytes on a line, by the protocol reference: frames, and noise that may have been one.

use std::ops::Range;

use fatek::wire::Framing;

use super::witness::Mark;
use crate::book::{carried, places_by_the_book};
use fatek::wire::Side;

/// The longest frame that is waited for.
const LONGEST: usize = 1024;

#[derive(Debug)]
pub(crate) struct Ear {
    framing: Framing,
    heard: Vec<u8>,
    /// Of each byte, the frame that it is a part of.
    marks: Vec<Option<Mark>>,
}

#[derive(Debug)]
pub(crate) enum Heard {
    Frame {
        station: u8,
        command: u8,
        data: Vec<u8>,
        bytes: Vec<u8>,
        /// If all of its bytes are of one frame of the PLC.
        mark: Option<Mark>,
    },
    /// Whether a frame may have been lost with it, and how long it is.
    Noise { spoils: bool, len: usize },
}

impl Ear {
    pub(crate) fn new(framing: Framing) -> Self {
        Self { framing, heard: Vec::new(), marks: Vec::new() }
    }

    pub(crate) fn hear(&mut self, bytes: &[u8], marks: &[Option<Mark>]) {
        self.heard.extend(bytes);
        self.marks.extend(marks);
    }

    pub(crate) fn forget(&mut self) {
        self.heard.clear();
        self.marks.clear();
    }

    /// Whether a frame has begun and not ended.
    pub(crate) fn is_amid_a_frame(&self) -> bool {
        !self.heard.is_empty()
    }

    /// The next thing that is certain; after a silence, what has begun is none.
    pub(crate) fn next(&mut self, silence: bool) -> Option<Heard> {
        if self.heard.is_empty() {
            return None;
        }
        match self.framing {
            Framing::Binary => self.next_binary(silence),
            _ => self.next_ascii(),
        }
    }

    /// In ASCII, STX and ETX stand nowhere inside a frame.
    fn next_ascii(&mut self) -> Option<Heard> {
        let at =
            |from: usize, codes: &[u8]| self.heard.iter().skip(from).position(|b| codes.contains(b)).map(|n| n + from);
        if self.heard[0] != 2 {
            let noise = at(0, &[2]).unwrap_or(self.heard.len());
            return Some(self.noise(false, noise));
        }
        let end = at(1, &[2, 3]);
        let len = end.unwrap_or(self.heard.len());
        if len >= LONGEST {
            return Some(self.noise(true, len));
        }
        let end = end?;
        if self.heard[end] == 2 { Some(self.noise(true, end)) } else { Some(self.frame_or_noise(0..end + 1)) }
    }

    /// In binary, a frame ends where its length says.
    fn next_binary(&mut self, silence: bool) -> Option<Heard> {
        let noise = self.beginning(0);
        if noise > 0 {
            return Some(self.noise(false, noise));
        }
        let claimed = match self.heard[..] {
            [_, _, high, low, ..] => Some(usize::from(u16::from_be_bytes([high, low]))),
            _ => None,
        };
        match claimed.map(|payload| (payload, payload + 8)) {
            Some((payload, len)) if payload < 2 || len > LONGEST => {}
            Some((_, len)) if self.heard.len() >= len => {
                let echo = self.heard[0] == 0x51;
                if self.is_frame(0..len) {
                    // Good, but of the other direction: it cannot be taken for a reply.
                    return Some(if echo { self.noise(false, len) } else { self.frame_or_noise(0..len) });
                }
            }
            _ if !silence => return None,
            _ => {}
        }
        let next = self.beginning(1);
        Some(self.noise(true, next))
    }

    /// Where a header can be, from here on.
    fn beginning(&self, from: usize) -> usize {
        let header =
            |&at: &usize| matches!(self.heard[at], 0x51 | 0x52) && self.heard.get(at + 1).is_none_or(|&id| id == 0x10);
        (from..self.heard.len()).find(header).unwrap_or(self.heard.len())
    }

    fn is_frame(&self, place: Range<usize>) -> bool {
        let bytes = &self.heard[place];
        let receiver = if bytes[0] == 0x51 { Side::Plc } else { Side::Client };
        places_by_the_book(self.framing, receiver, bytes, LONGEST).first() == Some(&(0..bytes.len()))
    }

    fn frame_or_noise(&mut self, place: Range<usize>) -> Heard {
        if !self.is_frame(place.clone()) {
            return self.noise(true, place.end);
        }
        let marks: Vec<_> = self.marks.drain(place.clone()).collect();
        let mark = marks[0].filter(|first| marks.iter().all(|mark| mark.as_ref() == Some(first)));
        let bytes: Vec<u8> = self.heard.drain(place).collect();
        let frame = carried(self.framing, &bytes);
        Heard::Frame { station: frame.station, command: frame.command, data: frame.data.to_vec(), bytes, mark }
    }

    fn noise(&mut self, spoils: bool, len: usize) -> Heard {
        self.heard.drain(..len);
        self.marks.drain(..len);
        Heard::Noise { spoils, len }
    }
}
