//! The other end of the line: frames of PLCs, right and wrong, each with a mark that says which request it answers.

use fatek::command::PAGE_WORDS;
use fatek::wire::{Framing, Side};

use super::op::{LACKS, Spoilt};
use super::witness::{COMMON, Mark};
use crate::book::{carried, framed};

/// Bytes that come together, and the mark of the frame that they are, or are a part of.
pub(crate) type Said = (Vec<u8>, Option<Mark>);

/// Where the tags of pages begin, which no other reply has.
const PAGES: u16 = 0xF00;

pub(crate) struct Plc {
    framing: Framing,
    /// Commands that it does not know, by the bits of [`LACKS`].
    pub(crate) lacks: u8,
    /// The rest of a frame that has begun.
    pub(crate) held_back: Vec<Said>,
    /// All answers so far, with the requests.
    said: Vec<(Said, Vec<u8>, u8)>,
    /// Each reply has other registers.
    tag: u16,
}

impl Plc {
    pub(crate) fn new(framing: Framing) -> Self {
        Self { framing, lacks: 0, held_back: Vec::new(), said: Vec::new(), tag: 0 }
    }

    /// The answer of a station to a numbered request; a refusal, if there is a code.
    pub(crate) fn answer(&mut self, asked: Option<(usize, Vec<u8>)>, station: u8, refusal: u8) -> Vec<Said> {
        let Some((number, asked)) = asked else { return Vec::new() };
        let broadcast = carried(self.framing, &asked).station == 0;
        let mark = Mark { request: Some(number), order: Mark::order_of(number), tag: 0, refusal: None, broadcast };
        self.say(&asked, station, refusal, mark)
    }

    /// The answer of the station that was asked.
    pub(crate) fn answer_own(&mut self, asked: Option<(usize, Vec<u8>)>) -> Vec<Said> {
        let station = asked.as_ref().map_or(0, |(_, asked)| carried(self.framing, asked).station);
        self.answer(asked, station, 0)
    }

    /// The last answer, or one before it, once more.
    pub(crate) fn copy(&self, back: usize) -> Vec<Said> {
        self.said.iter().rev().nth(back).map(|(said, ..)| said.clone()).into_iter().collect()
    }

    /// Another answer to the request that was answered last.
    pub(crate) fn second(&mut self, refusal: u8) -> Vec<Said> {
        let Some(((_, Some(mark)), asked, station)) = self.said.last().cloned() else { return Vec::new() };
        let refusal = if mark.refusal.is_none() { refusal.max(1) } else { 0 };
        self.say(&asked, station, refusal, Mark { refusal: None, ..mark })
    }

    /// The reply to an equal request of an earlier process, made before this one of the link.
    pub(crate) fn left_over(&mut self, asked: &[u8], before: usize, refusal: u8) -> Vec<Said> {
        if asked.is_empty() {
            return Vec::new();
        }
        let station = carried(self.framing, asked).station;
        let order = Mark::order_before(before);
        let mark = Mark { request: None, order, tag: 0, refusal: None, broadcast: false };
        self.say(asked, station, refusal, mark)
    }

    fn say(&mut self, asked: &[u8], station: u8, refusal: u8, mark: Mark) -> Vec<Said> {
        let frame = carried(self.framing, asked);
        let lacks = (0..).zip(LACKS).any(|(bit, command)| self.lacks >> bit & 1 == 1 && command == frame.command);
        let refusal = if lacks { refusal.max(4) } else { refusal };
        self.tag += 1;
        let tag = match frame.data[..] {
            // Nobody edits the program meanwhile, so each page has its own content, but for those that are equal.
            [.., last] if frame.command == 0x4F && last & 1 == 1 => COMMON,
            [.., last] if frame.command == 0x4F => PAGES | u16::from(last),
            _ => self.tag,
        };
        let data = self.data(&frame, refusal, tag);
        // In the ASCII framing, a code is one digit.
        let code = if self.framing == Framing::Binary { refusal } else { refusal & 15 };
        let mark = Mark { tag, refusal: (code > 0).then_some(code), ..mark };
        let bytes = framed(self.framing, Side::Plc, station, frame.command, &data);
        self.said.push(((bytes.clone(), Some(mark)), asked.to_vec(), station));
        vec![(bytes, Some(mark))]
    }

    fn data(&self, asked: &fatek::wire::Frame, refusal: u8, tag: u16) -> Vec<u8> {
        let number = |n: u8| match self.framing {
            Framing::Binary => vec![n],
            _ => format!("{:X}", n & 15).into_bytes(),
        };
        let word = |word: u16| match self.framing {
            Framing::Binary => word.to_be_bytes().to_vec(),
            _ => format!("{word:04X}").into_bytes(),
        };
        let words = |begin, count| (0..count).fold(begin, |data, n: u16| [data, word(tag | n << 12)].concat());
        match (refusal, asked.command) {
            (1.., _) => number(refusal),
            (_, 0x4E) => asked.data.to_vec(),
            (_, 0x46 | 0x48) => {
                let count = match self.framing {
                    Framing::Binary => u16::from(asked.data[0]),
                    _ => u16::from(asked.data[1] & 15),
                };
                words(number(0), count)
            }
            (_, 0x4F) => words(Vec::new(), u16::try_from(PAGE_WORDS).unwrap_or_default()),
            (_, 0x53) => words(number(0), 32),
            (_, 0x40) => [number(0), word(1), word(2)[..word(2).len() / 2].to_vec()].concat(),
            _ => number(0),
        }
    }

    /// Something like the answer to a request.
    pub(crate) fn spoilt(&mut self, asked: Option<(usize, Vec<u8>)>, how: Spoilt) -> Vec<Said> {
        let Some((answer, mark)) = self.answer_own(asked).pop() else { return Vec::new() };
        let frame = carried(self.framing, &answer);
        let (mut station, mut command, mut data) = (frame.station, frame.command, frame.data.to_vec());
        match how {
            Spoilt::Station(by) => station = station.wrapping_add(by) % 4,
            Spoilt::Command(other) => command = 0x40 | other & 15,
            Spoilt::Shorter => data.truncate(data.len().saturating_sub(1)),
            Spoilt::Longer => data.push(b'0'),
            Spoilt::Doubled => return vec![(answer.repeat(2), mark)],
            Spoilt::Begun(len) => {
                let (begun, rest) = answer.split_at(usize::from(len) % answer.len());
                self.held_back = vec![(rest.to_vec(), mark)];
                return vec![(begun.to_vec(), mark)];
            }
            Spoilt::Checksum => {
                let mut answer = answer;
                let at = answer.len() - 3;
                answer[at] ^= 1;
                return vec![(answer, None)];
            }
        }
        vec![(framed(self.framing, Side::Plc, station, command, &data), None)]
    }
}
