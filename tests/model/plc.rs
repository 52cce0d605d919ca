//! The other end of the line: frames of PLCs, each with the mark of the request that it answers.

use fatek::command::PAGE_WORDS;
use fatek::wire::{Framing, Side};

use super::op::{Corruption, UNSUPPORTED};
use super::oracle::{COMMON_TAG, Mark};
use crate::reference::{frame_content, framed};

/// Bytes that arrive together, with the mark of their frame.
pub(crate) type Chunk = (Vec<u8>, Option<Mark>);

/// Range of tags of program pages; no other reply has them.
const PAGE_TAGS: u16 = 0xF00;

pub(crate) struct Plc {
    framing: Framing,
    /// Unsupported commands, as bits of [`UNSUPPORTED`].
    pub(crate) unsupported: u8,
    /// Rest of a partial frame.
    pub(crate) held_back: Vec<Chunk>,
    /// All answers so far, each with its request and station.
    replies: Vec<(Chunk, Vec<u8>, u8)>,
    /// Content of the last reply; each reply has another.
    tag: u16,
}

impl Plc {
    pub(crate) fn new(framing: Framing) -> Self {
        Self { framing, unsupported: 0, held_back: Vec::new(), replies: Vec::new(), tag: 0 }
    }

    /// Answers a numbered request as `station`. A refusal code of 0 means a positive reply.
    pub(crate) fn answer(&mut self, request: Option<(usize, Vec<u8>)>, station: u8, refusal: u8) -> Vec<Chunk> {
        let Some((number, request)) = request else { return Vec::new() };
        let broadcast = frame_content(self.framing, &request).station == 0;
        let mark = Mark { request: Some(number), order: Mark::order_of(number), tag: 0, refusal: None, broadcast };
        self.reply_to(&request, station, refusal, mark)
    }

    /// Answers a request as the station that it addresses.
    pub(crate) fn answer_own(&mut self, request: Option<(usize, Vec<u8>)>) -> Vec<Chunk> {
        let station = request.as_ref().map_or(0, |(_, request)| frame_content(self.framing, request).station);
        self.answer(request, station, 0)
    }

    /// Repeats the last answer, or the one `back` answers before it.
    pub(crate) fn copy(&self, back: usize) -> Vec<Chunk> {
        self.replies.iter().rev().nth(back).map(|(reply, ..)| reply.clone()).into_iter().collect()
    }

    /// Answers the last answered request once more, differently.
    pub(crate) fn second_answer(&mut self, refusal: u8) -> Vec<Chunk> {
        let Some(((_, Some(mark)), request, station)) = self.replies.last().cloned() else { return Vec::new() };
        let refusal = if mark.refusal.is_none() { refusal.max(1) } else { 0 };
        self.reply_to(&request, station, refusal, Mark { refusal: None, ..mark })
    }

    /// Answers an equal request that an earlier process sent before request number `before`.
    pub(crate) fn left_over(&mut self, request: &[u8], before: usize, refusal: u8) -> Vec<Chunk> {
        if request.is_empty() {
            return Vec::new();
        }
        let station = frame_content(self.framing, request).station;
        let order = Mark::order_before(before);
        let mark = Mark { request: None, order, tag: 0, refusal: None, broadcast: false };
        self.reply_to(request, station, refusal, mark)
    }

    fn reply_to(&mut self, request: &[u8], station: u8, refusal: u8, mark: Mark) -> Vec<Chunk> {
        let frame = frame_content(self.framing, request);
        let unsupported =
            (0..).zip(UNSUPPORTED).any(|(bit, command)| self.unsupported >> bit & 1 == 1 && command == frame.command);
        let refusal = if unsupported { refusal.max(4) } else { refusal };
        self.tag += 1;
        let tag = match frame.data[..] {
            // The program is not edited meanwhile: each page keeps its content.
            [.., last] if frame.command == 0x4F && last & 1 == 1 => COMMON_TAG,
            [.., last] if frame.command == 0x4F => PAGE_TAGS | u16::from(last),
            _ => self.tag,
        };
        let data = self.data(&frame, refusal, tag);
        // In ASCII, an error code is one digit.
        let code = if self.framing == Framing::Binary { refusal } else { refusal & 15 };
        let mark = Mark { tag, refusal: (code > 0).then_some(code), ..mark };
        let bytes = framed(self.framing, Side::Plc, station, frame.command, &data);
        self.replies.push(((bytes.clone(), Some(mark)), request.to_vec(), station));
        vec![(bytes, Some(mark))]
    }

    fn data(&self, request: &fatek::wire::Frame, refusal: u8, tag: u16) -> Vec<u8> {
        let number = |n: u8| match self.framing {
            Framing::Binary => vec![n],
            _ => format!("{:X}", n & 15).into_bytes(),
        };
        let word = |word: u16| match self.framing {
            Framing::Binary => word.to_be_bytes().to_vec(),
            _ => format!("{word:04X}").into_bytes(),
        };
        let words = |begin, count| (0..count).fold(begin, |data, n: u16| [data, word(tag | n << 12)].concat());
        match (refusal, request.command) {
            (1.., _) => number(refusal),
            (_, 0x4E) => request.data.to_vec(),
            (_, 0x46 | 0x48) => {
                let count = match self.framing {
                    Framing::Binary => u16::from(request.data[0]),
                    _ => u16::from(request.data[1] & 15),
                };
                words(number(0), count)
            }
            (_, 0x4F) => words(Vec::new(), u16::try_from(PAGE_WORDS).unwrap_or_default()),
            (_, 0x53) => words(number(0), 32),
            (_, 0x40) => [number(0), word(1), word(2)[..word(2).len() / 2].to_vec()].concat(),
            _ => number(0),
        }
    }

    /// Answers a request with a corrupt frame.
    pub(crate) fn corrupted(&mut self, request: Option<(usize, Vec<u8>)>, how: Corruption) -> Vec<Chunk> {
        let Some((answer, mark)) = self.answer_own(request).pop() else { return Vec::new() };
        let frame = frame_content(self.framing, &answer);
        let (mut station, mut command, mut data) = (frame.station, frame.command, frame.data.to_vec());
        match how {
            Corruption::Station(by) => station = station.wrapping_add(by) % 4,
            Corruption::Command(other) => command = 0x40 | other & 15,
            Corruption::Shorter => data.truncate(data.len().saturating_sub(1)),
            Corruption::Longer => data.push(b'0'),
            Corruption::Doubled => return vec![(answer.repeat(2), mark)],
            Corruption::Begun(len) => {
                let (begun, rest) = answer.split_at(usize::from(len) % answer.len());
                self.held_back = vec![(rest.to_vec(), mark)];
                return vec![(begun.to_vec(), mark)];
            }
            Corruption::Checksum => {
                let mut answer = answer;
                let at = answer.len() - 3;
                answer[at] ^= 1;
                return vec![(answer, None)];
            }
        }
        vec![(framed(self.framing, Side::Plc, station, command, &data), None)]
    }
}
