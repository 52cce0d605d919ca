//! The elements that are to be restored, and their states.

use std::ops::Range;

use super::block::{Block, Cell, part, runs, runs_by, runs_of_values};
use super::{Difference, RefusedRange};
use crate::command::{RequestLengths, Value};
use crate::error::ErrorCode;
use crate::memory_map::special_range;
use crate::tag::Tag;

/// The state of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ElementState {
    /// The backup has no value of it.
    Absent,
    /// It is still to be compared.
    Unknown,
    /// The PLC refused to read it.
    NotGiven(ErrorCode),
    Same,
    Differs,
    /// It differs and stays as it is.
    Forced,
    /// It was sent, and is not confirmed.
    InDoubt,
    /// It was sent, and a read found that it differs: it is to be sent again.
    ToRepeat,
    Written,
    /// The PLC refused to write it.
    NotTaken(ErrorCode),
}

impl ElementState {
    /// Returns whether it is to be written.
    pub(super) fn differs(self) -> bool {
        matches!(self, Self::Differs | Self::ToRepeat)
    }
}

/// An element of a range.
#[derive(Clone, Copy, Debug)]
pub(super) struct TargetElement {
    /// Its value in the backup.
    pub(super) wanted: Option<Value>,
    /// Its value in the PLC before it was written.
    pub(super) found: Option<Value>,
    pub(super) state: ElementState,
}

/// A range of the backup, with what is known of its elements in the PLC.
#[derive(Clone, Debug)]
pub(super) struct Target {
    pub(super) range: Tag,
    pub(super) elements: Vec<TargetElement>,
}

impl Target {
    pub(super) fn new(block: &Block) -> Self {
        // A value with a missing half is missing.
        let values = block.cells.chunks(block.range.elements_per_value().max(1));
        let elements = values.flat_map(|value| {
            let whole = value.iter().all(Cell::is_ok);
            let wanted = move |cell: &Cell| cell.ok().filter(|_| whole);
            value.iter().map(move |cell| TargetElement {
                wanted: wanted(cell),
                found: None,
                state: ElementState::Absent,
            })
        });
        Self { range: block.range, elements: elements.collect() }
    }

    /// The ranges of special elements, and of values with such an element.
    pub(super) fn special(&self) -> Vec<Tag> {
        self.special_runs().iter().map(|run| part(self.range, run)).collect()
    }

    /// Takes special elements as if the backup had no value of them.
    pub(super) fn skip_special(&mut self) {
        for run in self.special_runs() {
            self.elements.get_mut(run).into_iter().flatten().for_each(|element| element.wanted = None);
        }
    }

    /// The indices of values with a special element.
    fn special_runs(&self) -> Vec<Range<usize>> {
        let special: Vec<bool> = self.range.elements().map(|element| special_range(element).is_some()).collect();
        runs_of_values(&special, self.range.elements_per_value(), |&special| special)
    }

    /// Before the comparison.
    pub(super) fn forget(&mut self) {
        for element in &mut self.elements {
            element.found = None;
            element.state = if element.wanted.is_some() { ElementState::Unknown } else { ElementState::Absent };
        }
    }

    /// After the comparison, before forced discretes are read.
    pub(super) fn unforce(&mut self) {
        for element in self.elements.iter_mut().filter(|element| element.state == ElementState::Forced) {
            let is_same = element.found == element.wanted;
            element.state = if is_same { ElementState::Same } else { ElementState::Differs };
        }
    }

    /// The elements in such a state.
    pub(super) fn ranges(&self, holds: impl Fn(ElementState) -> bool) -> Vec<Tag> {
        runs(&self.elements, |element| holds(element.state)).iter().map(|run| part(self.range, run)).collect()
    }

    /// The values with an element that differs, whole.
    pub(super) fn differing(&self) -> Vec<Range<usize>> {
        runs_of_values(&self.elements, self.range.elements_per_value(), |element| element.state.differs())
    }

    /// The values that differ, with up to `bridge` equal elements between two of them if that saves
    /// a request.
    pub(super) fn to_write(&self, bridge: usize, lengths: RequestLengths) -> Vec<Range<usize>> {
        let most = lengths.most(self.range.first());
        let mut merged: Vec<Range<usize>> = Vec::new();
        for run in self.differing() {
            match merged.last_mut() {
                // Runs ascend, so the end of a run is behind the start of the one before.
                Some(last)
                    if self.bridges(last.end..run.start, bridge) && run.end.saturating_sub(last.start) <= most =>
                {
                    last.end = run.end;
                }
                Some(_) | None => merged.push(run),
            }
        }
        merged
    }

    pub(super) fn ranges_to_write(&self, bridge: usize, lengths: RequestLengths) -> Vec<Tag> {
        self.to_write(bridge, lengths).iter().map(|run| part(self.range, run)).collect()
    }

    fn bridges(&self, gap: Range<usize>, most: usize) -> bool {
        let is_same = |element: &TargetElement| element.state == ElementState::Same;
        gap.len() <= most && self.elements.get(gap).is_some_and(|elements| elements.iter().all(is_same))
    }

    pub(super) fn differences(&self) -> Vec<Difference> {
        let elements = self.range.elements().zip(&self.elements);
        let differences = elements.filter_map(|(element, known)| {
            let (expected, found) = (known.wanted?, known.found?);
            (expected != found).then_some(Difference { element, expected, found: Some(found) })
        });
        differences.collect()
    }

    pub(super) fn refused(&self) -> Vec<RefusedRange> {
        let error = |element: &TargetElement| {
            if let ElementState::NotGiven(error) | ElementState::NotTaken(error) = element.state {
                Some(error)
            } else {
                None
            }
        };
        let refused = |(run, error)| RefusedRange { range: part(self.range, &run), error };
        runs_by(&self.elements, error).into_iter().map(refused).collect()
    }
}
