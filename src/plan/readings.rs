use super::{Plan, ReadRequest, Slot};
use crate::command::Value;
use crate::element::Width;
use crate::tag::{Tag, TagValue};

/// What a PLC answered to a [`ReadRequest`].
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reply {
    /// To [`ReadRequest::Discretes`].
    Bits(Vec<bool>),
    /// To [`ReadRequest::Registers`].
    Words(Vec<u16>),
    /// To [`ReadRequest::Registers32`].
    DWords(Vec<u32>),
    /// To [`ReadRequest::Mixed`].
    Mixed(Vec<Value>),
}

impl Reply {
    pub(super) fn answers(&self, request: &ReadRequest) -> bool {
        match (self, request) {
            (Self::Bits(bits), ReadRequest::Discretes(request)) => bits.len() == request.count(),
            (Self::Words(words), ReadRequest::Registers(request)) => words.len() == request.count(),
            (Self::DWords(doubles), ReadRequest::Registers32(request)) => doubles.len() == request.count(),
            (Self::Mixed(values), ReadRequest::Mixed(request)) => {
                let widths = request.elements().iter().map(|element| element.width());
                values.iter().map(|value| value.width()).eq(widths)
            }
            _ => false,
        }
    }
}

/// A reply, as tags look into it: bits, or words with the low one first. Runs of bits and words are as they came.
#[derive(Clone, Debug)]
pub(crate) enum Words {
    Bits(Vec<bool>),
    Words(Vec<u16>),
}

impl Words {
    fn word(&self, at: usize) -> Option<u16> {
        match self {
            Self::Bits(bits) => bits.get(at).copied().map(u16::from),
            Self::Words(words) => words.get(at).copied(),
        }
    }
}

impl From<Reply> for Words {
    fn from(reply: Reply) -> Self {
        match reply {
            Reply::Bits(bits) => Self::Bits(bits),
            Reply::Words(words) => Self::Words(words),
            Reply::DWords(doubles) => Self::Words(doubles.into_iter().flat_map(halves).collect()),
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

/// The low word first.
fn halves(double: u32) -> [u16; 2] {
    let [a, b, c, d] = double.to_be_bytes();
    [u16::from_be_bytes([c, d]), u16::from_be_bytes([a, b])]
}

/// What came back for the tags of a [`Plan`]: the replies themselves, which tags look into.
///
/// ```
/// use std::time::Duration;
/// use fatek::plan::{CostModel, Plan, Reply};
/// use fatek::tag::TagValue;
/// use fatek::wire::Framing;
///
/// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
/// let plan = Plan::builder(network).tags(["R0:i16", "R1:f32"].map(|tag| tag.parse().unwrap())).build()?;
/// let reply = Reply::Words(vec![0xFFFF, 0x1000, 0xC3FA]); // to the plan's only request, R0 to R2
/// let readings = plan.scatter([Ok::<_, fatek::Error>(reply)])?;
/// assert!(matches!(readings.tag(0), Some(Ok(values)) if values == [TagValue::I16(-1)]));
/// assert!(matches!(readings.tag(1), Some(Ok(values)) if values == [TagValue::F32(-500.125)]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Readings<'p, E> {
    plan: &'p Plan,
    /// One for each request.
    replies: Vec<Result<Words, E>>,
}

impl<'p, E> Readings<'p, E> {
    pub(super) fn new(plan: &'p Plan, replies: Vec<Result<Words, E>>) -> Self {
        Self { plan, replies }
    }

    /// The values of the tag with this number, or the error of the first of its requests that failed. `None`: the plan has
    /// no tag with this number.
    pub fn tag(&self, number: usize) -> Option<Result<Vec<TagValue>, &E>> {
        self.plan.tags.get(number).map(|tag| self.values(number, tag))
    }

    /// Each tag of the plan, in the order they were added, with its values or the error of a request that it needs.
    pub fn iter(&self) -> impl Iterator<Item = (Tag, Result<Vec<TagValue>, &E>)> {
        self.plan.tags.iter().enumerate().map(|(n, tag)| (*tag, self.values(n, tag)))
    }

    /// The requests that failed: their number in [`Plan::requests`], and why.
    pub fn errors(&self) -> impl Iterator<Item = (usize, &E)> {
        self.replies.iter().enumerate().filter_map(|(n, reply)| Some((n, reply.as_ref().err()?)))
    }

    fn values(&self, number: usize, tag: &Tag) -> Result<Vec<TagValue>, &E> {
        let mut raw = Vec::with_capacity(tag.element_count());
        for slot in self.plan.slots(number).unwrap_or_default() {
            self.value(tag, *slot, &mut raw)?;
        }
        // The plan has counted the elements, and their width is the tag's.
        Ok(tag.decode(&raw).unwrap_or_default())
    }

    fn value(&self, tag: &Tag, slot: Slot, raw: &mut Vec<Value>) -> Result<(), &E> {
        let words = self.replies[slot.request as usize].as_ref()?;
        // Replies have the shape that the plan asked for: link and `scatter` have checked it.
        let _ = tag.take(words, slot.word as usize, raw);
        Ok(())
    }
}

impl Tag {
    /// How many words of a reply a slot of this tag has.
    pub(super) fn slot_words(&self) -> usize {
        let words_per_element = match self.first().width() {
            Width::Bit | Width::Word => 1,
            Width::DWord => 2,
        };
        words_per_element * self.elements_per_value()
    }

    /// Takes the elements of a slot from the words of its reply; `None`: they are not in it.
    pub(super) fn take(&self, words: &Words, at: usize, raw: &mut Vec<Value>) -> Option<()> {
        let word = |n: usize| words.word(at.checked_add(n)?);
        match self.first().width() {
            Width::Bit => raw.push(Value::Bit(word(0)? != 0)),
            Width::Word => {
                for n in 0..self.slot_words() {
                    raw.push(Value::Word(word(n)?));
                }
            }
            Width::DWord => {
                for low in (0..self.slot_words()).step_by(2) {
                    raw.push(Value::DWord(u32::from(word(low + 1)?) << 16 | u32::from(word(low)?)));
                }
            }
        }
        Some(())
    }
}
