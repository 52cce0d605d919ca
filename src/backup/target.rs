//! What is known of the elements that are to be restored.

use std::ops::Range;

use super::block::{Block, Cell, part, runs, runs_of_values};
use super::{Difference, RefusedRange};
use crate::command::{Value, most_in_one_request};
use crate::error::ErrorCode;
use crate::tag::Tag;

/// What is known of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mark {
    /// The backup has no value of it.
    Absent,
    /// It is still to be compared.
    Unknown,
    /// The PLC refuses to give it.
    NotGiven(ErrorCode),
    Same,
    Differs,
    /// It differs, and is to stay as it is.
    Forced,
    /// It has been sent, and not confirmed.
    Doubt,
    /// That, and a read has found that it differs: it is to be sent again.
    Again,
    Written,
    /// The PLC refuses to take it.
    NotTaken(ErrorCode),
}

impl Mark {
    /// Whether it is to be written.
    pub(super) fn differs(self) -> bool {
        matches!(self, Self::Differs | Self::Again)
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    pub(super) wanted: Option<Value>,
    /// What it held before it was written.
    pub(super) found: Option<Value>,
    pub(super) mark: Mark,
}

#[derive(Clone, Debug)]
pub(super) struct Target {
    pub(super) range: Tag,
    pub(super) slots: Vec<Slot>,
}

impl Target {
    pub(super) fn new(block: &Block) -> Self {
        // Half a value is none.
        let values = block.cells.chunks(block.range.elements_per_value().max(1));
        let slots = values.flat_map(|value| {
            let whole = value.iter().all(Cell::is_ok);
            value.iter().map(move |cell| Slot { wanted: cell.ok().filter(|_| whole), found: None, mark: Mark::Absent })
        });
        Self { range: block.range, slots: slots.collect() }
    }

    /// Nothing has been compared.
    pub(super) fn forget(&mut self) {
        for slot in &mut self.slots {
            slot.found = None;
            slot.mark = if slot.wanted.is_some() { Mark::Unknown } else { Mark::Absent };
        }
    }

    /// The elements whose mark is such.
    pub(super) fn ranges(&self, holds: impl Fn(Mark) -> bool) -> Vec<Tag> {
        runs(&self.slots, |slot| holds(slot.mark)).iter().map(|run| part(self.range, run)).collect()
    }

    /// The values that differ in some element, whole.
    pub(super) fn differing(&self) -> Vec<Range<usize>> {
        runs_of_values(&self.slots, self.range.elements_per_value(), |slot| slot.mark.differs())
    }

    /// What differs, and what is equal and stands between, as far as that may be written to save a request.
    pub(super) fn to_write(&self, bridge: usize) -> Vec<Range<usize>> {
        let most = most_in_one_request(self.range.first());
        let mut merged: Vec<Range<usize>> = Vec::new();
        for run in self.differing() {
            match merged.last_mut() {
                Some(last)
                    if self.bridges(last.end..run.start, bridge) && run.end.saturating_sub(last.start) <= most =>
                {
                    last.end = run.end;
                }
                _ => merged.push(run),
            }
        }
        merged
    }

    pub(super) fn ranges_to_write(&self, bridge: usize) -> Vec<Tag> {
        self.to_write(bridge).iter().map(|run| part(self.range, run)).collect()
    }

    fn bridges(&self, gap: Range<usize>, most: usize) -> bool {
        gap.len() <= most && self.slots.get(gap).is_some_and(|slots| slots.iter().all(|slot| slot.mark == Mark::Same))
    }

    pub(super) fn differences(&self) -> Vec<Difference> {
        let slots = self.range.elements().zip(&self.slots);
        let differences = slots.filter_map(|(element, slot)| {
            let (expected, found) = (slot.wanted?, slot.found?);
            (expected != found).then_some(Difference { element, expected, found: Some(found) })
        });
        differences.collect()
    }

    pub(super) fn refused(&self) -> Vec<RefusedRange> {
        let error = |slot: &Slot| match slot.mark {
            Mark::NotGiven(error) | Mark::NotTaken(error) => Some(error),
            _ => None,
        };
        let mut refused = Vec::new();
        let mut start = 0_usize;
        for same in self.slots.chunk_by(|one, next| error(one) == error(next)) {
            let end = start.saturating_add(same.len());
            if let Some(error) = same.first().and_then(error) {
                refused.push(RefusedRange { range: part(self.range, &(start..end)), error });
            }
            start = end;
        }
        refused
    }
}
