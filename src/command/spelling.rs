//! Spellings: requests for the same elements whose replies differ in shape.
//!
//! The protocol has no transaction id. The link distinguishes the reply to a request from a
//! duplicate of the previous reply by its shape, so it needs a second way to ask for the same
//! elements:
//!
//! | request | other spellings |
//! |---|---|
//! | 46 N, 44 N | one element more, behind or before; 48 of the same elements; in a longer read one element less |
//! | 43 N | one element more, behind or before; in a longer read one element less |
//! | 48 list | the first element once more, behind the list |
//! | 47 N, 45 N | 49 of the same elements; in a longer write 49 of as many as it takes |
//!
//! All other requests have one spelling. A reply to 48 has the data of a reply to 46 or 44 after
//! another command code.

use super::{
    Code, Command, MAX_MIXED_READ_UNITS, MAX_MIXED_WRITE_UNITS, MAX_POINTS, ReadMixed, WriteMixed, most_in_one_request,
};
use crate::element::{Element, Value, Width};
use crate::wire::{FieldWriter, Framing};

/// A way to encode a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Spelling {
    /// The command that is sent.
    pub(crate) code: Code,
    /// The number of elements in the request; 0 for commands without elements.
    pub(crate) count: u16,
    /// The request begins one element earlier than asked for.
    pub(crate) before: bool,
}

impl Spelling {
    pub(crate) fn new(code: Code, count: usize) -> Self {
        debug_assert!(count <= MAX_POINTS, "a request names at most {MAX_POINTS} elements");
        Self { code, count: u16::try_from(count).unwrap_or(u16::MAX), before: false }
    }

    /// The number of elements in the request from the first one asked for.
    pub(crate) fn count_behind(self) -> usize {
        let before = usize::from(self.before);
        debug_assert!(usize::from(self.count) >= before, "the element before is counted");
        usize::from(self.count).saturating_sub(before)
    }

    /// The first element in the request for elements from this one on.
    pub(super) fn first(self, first: Element) -> Element {
        let first_of_all = if self.before { previous(first) } else { Some(first) };
        debug_assert!(first_of_all.is_some(), "a spelling with an element before has one");
        first_of_all.unwrap_or(first)
    }
}

/// A spelling that can replace the plain one, and its cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Candidate {
    pub(crate) spelling: Spelling,
    /// An element that is not asked for. It may be read only if the PLC has answered it before.
    pub(crate) extra: Option<Element>,
    /// The bytes that request and reply have more than in the plain spelling.
    pub(crate) more_bytes: usize,
    /// The number of elements left to the next request.
    pub(crate) left: u16,
    /// The units of the elements in it, as [`Capabilities`](crate::Capabilities) count them.
    pub(crate) units: u16,
}

/// The other spellings of a request.
pub(crate) type Candidates = [Option<Candidate>; 4];

/// No other spelling.
pub(crate) const NONE: Candidates = [None; 4];

/// Consecutive elements that a request reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    pub(crate) first: Element,
    pub(crate) count: usize,
}

impl Run {
    /// Returns whether the list of its elements is known. A received request may name a run of
    /// counters of 32 bits, or a half of one: the manuals do not say which memory that is.
    fn is_known(self) -> bool {
        let exists = Element::new(self.first.symbol(), self.first.address()).is_ok();
        let is_one_by_one = self.count == 1 || !self.first.is_counter_of_32_bits();
        exists && is_one_by_one && self.first.nth(self.count.saturating_sub(1)).is_ok()
    }

    /// The other spellings of a read with this command; `longer`: it is a part of a longer read.
    pub(super) fn read_candidates(self, code: Code, longer: bool, framing: Framing) -> Candidates {
        if !self.is_known() {
            return NONE;
        }
        let one_less = if longer { self.one_less(code) } else { None };
        let mixed = if code == Code::ReadDisabled { None } else { self.mixed_read(framing) };
        [one_less, self.one_more(code, framing, false), self.one_more(code, framing, true), mixed]
    }

    /// The other spellings of a write of these values; `longer`: it is a part of a longer write.
    pub(super) fn write_candidates(
        self,
        longer: bool,
        framing: Framing,
        values: &[impl Into<Value> + Copy],
    ) -> Candidates {
        let most = MAX_MIXED_WRITE_UNITS / self.first.width().units();
        if !self.is_known() || self.count > most && !longer {
            return NONE;
        }
        let count = self.count.min(most);
        if self.is_surely_unambiguous(count, framing) {
            return [Some(self.mixed(Code::WriteMixed, count, framing)), None, None, None];
        }
        // The values, too, decide whether a list is ambiguous in the binary framing.
        let items = self.first.run(count).zip(values.iter().map(|&value| value.into()));
        let request = WriteMixed::new(items.collect::<Vec<_>>());
        if !request.is_ok_and(|request| request.check(framing).is_ok()) {
            return NONE;
        }
        [Some(self.mixed(Code::WriteMixed, count, framing)), None, None, None]
    }

    fn mixed_read(self, framing: Framing) -> Option<Candidate> {
        if self.count * self.first.width().units() > MAX_MIXED_READ_UNITS {
            return None;
        }
        if !self.is_surely_unambiguous(self.count, framing) {
            ReadMixed::new(self.first.run(self.count).collect::<Vec<_>>()).ok()?.check(framing).ok()?;
        }
        Some(self.mixed(Code::ReadMixed, self.count, framing))
    }

    /// Returns whether a list of the first `count` elements is known to be unambiguous without
    /// parsing it.
    ///
    /// In the binary framing a symbol of one letter can be taken for a longer one only if a letter
    /// follows: the high byte of the address.
    fn is_surely_unambiguous(self, count: usize, framing: Framing) -> bool {
        let symbol = self.first.symbol().as_str();
        let Ok(last) = self.first.nth(count.saturating_sub(1)) else {
            debug_assert!(false, "the elements of a run are known");
            return false;
        };
        let high = self.first.address().to_be_bytes()[0]..=last.address().to_be_bytes()[0];
        let letters = b'A'..=b'Z';
        let apart = high.end() < letters.start() || letters.end() < high.start();
        framing == Framing::Ascii || symbol.len() == 1 && apart
    }

    /// The units of this many of its elements.
    fn units(self, count: usize) -> u16 {
        u16::try_from(count * self.first.width().units()).unwrap_or(u16::MAX)
    }

    fn mixed(self, code: Code, count: usize, framing: Framing) -> Candidate {
        Candidate {
            spelling: Spelling::new(code, count),
            extra: None,
            more_bytes: count.saturating_sub(1) * framing.element_len(self.first.symbol()),
            left: u16::try_from(self.count - count).unwrap_or(u16::MAX),
            units: self.units(count),
        }
    }

    fn one_more(self, code: Code, framing: Framing, before: bool) -> Option<Candidate> {
        if self.count >= most_in_one_request(self.first) {
            return None;
        }
        let extra = if before { previous(self.first)? } else { self.first.nth(self.count).ok()? };
        extra.check_in(framing).ok()?;
        let more_bytes = framing.value_len(self.first.width());
        let spelling = Spelling { before, ..Spelling::new(code, self.count + 1) };
        Some(Candidate { spelling, extra: Some(extra), more_bytes, left: 0, units: self.units(self.count + 1) })
    }

    fn one_less(self, code: Code) -> Option<Candidate> {
        let count = self.count.checked_sub(1).filter(|&count| count > 0)?;
        let spelling = Spelling::new(code, count);
        Some(Candidate { spelling, extra: None, more_bytes: 0, left: 1, units: self.units(count) })
    }
}

/// The other spelling of a mixed read: its first element once more at the end.
pub(super) fn mixed_read_candidates(elements: &[Element], framing: Framing) -> Candidates {
    let candidate = || {
        let &first = elements.first()?;
        let repeated: Vec<_> = elements.iter().copied().chain([first]).collect();
        let units: usize = repeated.iter().map(|element| element.width().units()).sum();
        ReadMixed::new(repeated).ok()?.check(framing).ok()?;
        Some(Candidate {
            spelling: Spelling::new(Code::ReadMixed, elements.len() + 1),
            extra: Some(first),
            more_bytes: framing.element_len(first.symbol()) + framing.value_len(first.width()),
            left: 0,
            units: u16::try_from(units).unwrap_or(u16::MAX),
        })
    };
    [candidate(), None, None, None]
}

/// Writes the fields of a read of consecutive elements in a spelling.
pub(super) fn read_fields<W: FieldWriter>(first: Element, spelling: Spelling, fields: &mut W) {
    let count = usize::from(spelling.count);
    fields.count(count);
    if spelling.code == Code::ReadMixed {
        elements(first, count).for_each(|element| fields.element(element));
    } else {
        fields.element(spelling.first(first));
    }
}

/// Removes the values that were not asked for, and leaves at most `count`.
pub(super) fn keep_asked<V>(values: &mut Vec<V>, spelling: Spelling, count: usize) {
    if spelling.before {
        values.remove(0);
    }
    values.truncate(count);
}

/// Writes the fields of a write to consecutive elements in a spelling.
pub(super) fn write_fields<W: FieldWriter, C: Command>(
    plain: &C,
    first: Element,
    values: &[impl Into<Value> + Copy],
    spelling: Spelling,
    fields: &mut W,
) {
    if spelling.code != Code::WriteMixed {
        return plain.write_request(fields);
    }
    debug_assert!(usize::from(spelling.count) <= values.len(), "a spelling names no other elements");
    let values = values.get(..spelling.count.into()).unwrap_or(values);
    fields.count(values.len());
    for (element, &value) in elements(first, values.len()).zip(values) {
        fields.element(element);
        fields.value(value.into());
    }
}

/// Consecutive elements of a mixed spelling.
///
/// Invariant: all of them exist, because only known runs have such a spelling.
fn elements(first: Element, count: usize) -> impl Iterator<Item = Element> {
    debug_assert!(first.nth(count.saturating_sub(1)).is_ok(), "{count} elements from {first} on");
    first.run(count)
}

/// The length of values in a reply, in bytes.
pub(super) fn values_len(width: Width, count: usize, framing: Framing) -> u32 {
    u32::try_from(framing.value_len(width) * count).unwrap_or(u32::MAX)
}

/// The element before this one.
fn previous(first: Element) -> Option<Element> {
    let previous = Element::new(first.symbol(), first.address().checked_sub(first.step())?).ok()?;
    previous.is_consecutive_with(first.address()).then_some(previous)
}

#[cfg(test)]
mod tests;
