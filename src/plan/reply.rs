//! Replies, and the words of them that tags decode.

use super::{ReadRequest, ValueSlot};
use crate::command::Value;
use crate::element::Width;
use crate::tag::Tag;

/// The reply to a [`ReadRequest`].
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reply {
    /// Reply to [`ReadRequest::Discretes`].
    Bits(Vec<bool>),
    /// Reply to [`ReadRequest::Registers`].
    Words(Vec<u16>),
    /// Reply to [`ReadRequest::Registers32`].
    DWords(Vec<u32>),
    /// Reply to [`ReadRequest::Mixed`].
    Mixed(Vec<Value>),
}

impl Reply {
    /// Returns whether kind and number of the values are those of the request.
    pub(super) fn matches(&self, request: &ReadRequest) -> bool {
        match (self, request) {
            (Self::Bits(bits), ReadRequest::Discretes(request)) => bits.len() == request.count(),
            (Self::Words(words), ReadRequest::Registers(request)) => words.len() == request.count(),
            (Self::DWords(dwords), ReadRequest::Registers32(request)) => dwords.len() == request.count(),
            (Self::Mixed(values), ReadRequest::Mixed(request)) => {
                let widths = request.elements().iter().map(|element| element.width());
                values.iter().map(|value| value.width()).eq(widths)
            }
            (Self::Bits(_) | Self::Words(_) | Self::DWords(_) | Self::Mixed(_), _) => false,
        }
    }
}

/// The content of a reply as tags decode it: bits, or words, with the low word of 32 bits first.
///
/// Runs of bits and of words are kept without conversion.
#[derive(Clone, Debug)]
pub(crate) enum ReplyWords {
    Bits(Vec<bool>),
    Words(Vec<u16>),
}

impl ReplyWords {
    fn word(&self, at: usize) -> Option<u16> {
        match self {
            Self::Bits(bits) => bits.get(at).copied().map(u16::from),
            Self::Words(words) => words.get(at).copied(),
        }
    }
}

impl From<Reply> for ReplyWords {
    fn from(reply: Reply) -> Self {
        match reply {
            Reply::Bits(bits) => Self::Bits(bits),
            Reply::Words(words) => Self::Words(words),
            Reply::DWords(dwords) => Self::Words(dwords.into_iter().flat_map(halves).collect()),
            Reply::Mixed(values) => {
                let mut words = Vec::with_capacity(values.len() * 2);
                for value in values {
                    match value {
                        Value::Bit(on) => words.push(on.into()),
                        Value::Word(word) => words.push(word),
                        Value::DWord(double) => words.extend(halves(double)),
                    }
                }
                Self::Words(words)
            }
        }
    }
}

/// Splits 32 bits into words, the low word first.
fn halves(double: u32) -> [u16; 2] {
    let [a, b, c, d] = double.to_be_bytes();
    [u16::from_be_bytes([c, d]), u16::from_be_bytes([a, b])]
}

impl Tag {
    /// Returns the number of words of a reply for one value of this tag.
    pub(super) fn words_per_value(&self) -> usize {
        let words_per_element = match self.first().width() {
            Width::Bit | Width::Word => 1,
            Width::DWord => 2,
        };
        words_per_element * self.elements_per_value()
    }

    /// Appends the elements of one value, from its place in a reply on, to `raw`.
    ///
    /// Returns `None` if the reply is too short.
    pub(super) fn append_value(&self, words: &ReplyWords, slot: ValueSlot, raw: &mut Vec<Value>) -> Option<()> {
        let word = |n: usize| words.word(usize::from(slot.word).checked_add(n)?);
        match self.first().width() {
            Width::Bit => raw.push(Value::Bit(match slot.bit {
                None => word(0)? != 0,
                Some(bit) => word(0)?.checked_shr(bit.into())? & 1 == 1,
            })),
            Width::Word => {
                for n in 0..self.words_per_value() {
                    raw.push(Value::Word(word(n)?));
                }
            }
            Width::DWord => {
                for low in (0..self.words_per_value()).step_by(2) {
                    raw.push(Value::DWord(u32::from(word(low + 1)?) << 16 | u32::from(word(low)?)));
                }
            }
        }
        Some(())
    }
}
