//! The ranges of a backup, and the requests for them.

use std::ops::Range;

use super::{InvalidBackup, Missing};
use crate::command::{RequestLengths, Value};
use crate::element::Element;
use crate::error::ErrorCode;
use crate::tag::{Tag, TagType};
use crate::transfer::Request;

/// The value of an element, or why it is missing.
pub(super) type Cell = Result<Value, Missing>;

/// A range with a cell for each element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Block {
    pub(super) range: Tag,
    pub(super) cells: Vec<Cell>,
}

/// Consecutive elements of one block, few enough for one request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Chunk {
    /// The number of the block.
    pub(super) block: usize,
    /// The range of the block.
    pub(super) range: Tag,
    /// The index of the first element in the block.
    pub(super) start: usize,
    pub(super) count: usize,
}

impl Chunk {
    /// The indices of its elements in the block.
    pub(super) fn indices(self) -> Range<usize> {
        // A block has at most 65536 elements.
        self.start..self.start.saturating_add(self.count)
    }

    /// The indices in the block of a run of its elements.
    pub(super) fn within(self, run: &Range<usize>) -> Range<usize> {
        self.start.saturating_add(run.start)..self.start.saturating_add(run.end)
    }

    /// Its elements.
    pub(super) fn tag(self) -> Tag {
        part(self.range, &self.indices())
    }

    /// Its first elements, those of a shorter reply.
    pub(super) fn first(self, count: usize) -> Self {
        Self { count: self.count.min(count), ..self }
    }

    /// The request that reads it. `shorter`: the last element may be left to the next request,
    /// unless that would split a value.
    pub(super) fn read(self, shorter: bool) -> Request {
        Request::Read { range: self.tag(), shorter: shorter && self.range.elements_per_value() == 1 }
    }
}

/// The range of a backup: of its type only the number of registers of a value matters. A text has
/// values of one register.
pub(super) fn plain(range: Tag) -> Tag {
    let per_value = if range.tag_type().is_text() { 1 } else { range.elements_per_value() };
    let spanning = |&tag_type: &TagType| Tag::spanning(range.first(), tag_type, range.element_count()).ok();
    let mut numbers = TagType::ALL.iter().filter(|tag_type| !tag_type.is_text()).filter_map(spanning);
    // The first type of the table with this size. The type of the range has it.
    numbers.find(|tag| tag.elements_per_value() == per_value).unwrap_or(range)
}

/// The elements of a range with these indices, without a type.
pub(super) fn part(range: Tag, indices: &Range<usize>) -> Tag {
    let first = range.first().nth(indices.start).unwrap_or(range.first());
    Tag::spanning(first, TagType::default_for(first.width()), indices.len()).unwrap_or(range)
}

/// The discretes of a range: the first, and their count. `None` for registers.
pub(super) fn discretes(range: Tag) -> Option<(crate::Discrete, usize)> {
    let (area, first, last) = range.memory();
    let discrete = crate::Discrete::new(area.smallest(), first).ok()?;
    Some((discrete, usize::from(last.saturating_sub(first)).saturating_add(1)))
}

/// Returns whether the PLC overwrites these in every scan: inputs, and the contacts of timers and
/// counters.
pub(super) fn is_never_restored(range: Tag) -> bool {
    range.first().symbol().area().is_derived()
}

/// Checks that a range is not of bits of a register: its elements would be whole registers.
pub(super) fn check_whole(range: Tag) -> Result<(), InvalidBackup> {
    if range.is_bits_of_register() { Err(InvalidBackup::BitsOfRegister { range }) } else { Ok(()) }
}

/// Checks that no two ranges share memory, under any names.
pub(super) fn check_overlaps(ranges: &[Tag]) -> Result<(), InvalidBackup> {
    let mut sorted: Vec<_> = ranges.iter().map(|&range| (range.memory(), range)).collect();
    sorted.sort_unstable_by_key(|&(memory, _)| memory);
    for (((symbol, _, end), first), ((next, start, _), second)) in sorted.iter().zip(sorted.iter().skip(1)) {
        if symbol == next && start <= end {
            return Err(InvalidBackup::Overlap { first: *first, second: *second });
        }
    }
    Ok(())
}

/// The longest runs of indices whose items fulfil a condition.
pub(super) fn runs<T>(items: &[T], mut holds: impl FnMut(&T) -> bool) -> Vec<Range<usize>> {
    runs_by(items, |item| holds(item).then_some(())).into_iter().map(|(run, ())| run).collect()
}

/// The longest runs of items with the same key. Items without a key are in no run.
pub(super) fn runs_by<T, K: PartialEq>(items: &[T], mut key: impl FnMut(&T) -> Option<K>) -> Vec<(Range<usize>, K)> {
    let mut runs: Vec<(Range<usize>, K)> = Vec::new();
    for (index, item) in items.iter().enumerate() {
        let Some(key) = key(item) else { continue };
        let end = index.saturating_add(1);
        match runs.last_mut() {
            Some((run, same)) if run.end == index && *same == key => run.end = end,
            Some(_) | None => runs.push((index..end, key)),
        }
    }
    runs
}

/// The longest runs of whole values with an element that fulfils a condition.
pub(super) fn runs_of_values<T>(
    items: &[T],
    per_value: usize,
    holds: impl FnMut(&T) -> bool + Copy,
) -> Vec<Range<usize>> {
    let per_value = per_value.max(1);
    let values: Vec<bool> = items.chunks(per_value).map(|value| value.iter().any(holds)).collect();
    let elements = |value: usize| value.saturating_mul(per_value).min(items.len());
    runs(&values, |&holds| holds).into_iter().map(|run| elements(run.start)..elements(run.end)).collect()
}

/// A queue of requests. A refused request is halved until the elements are found that caused it.
#[derive(Clone, Debug)]
pub(super) struct Chunks {
    /// Runs of elements of any length, the next one last.
    waiting: Vec<Chunk>,
    lengths: RequestLengths,
}

impl Chunks {
    pub(super) const EMPTY: Self = Self { waiting: Vec::new(), lengths: RequestLengths::PROTOCOL };

    /// The fewest requests of these lengths for these runs, in this order. No value is split: one that
    /// is longer is a request of its own.
    pub(super) fn new(runs: impl IntoIterator<Item = (usize, Tag, Range<usize>)>, lengths: RequestLengths) -> Self {
        let run = |(block, range, indices): (usize, Tag, Range<usize>)| Chunk {
            block,
            range,
            start: indices.start,
            count: indices.len(),
        };
        let mut waiting: Vec<Chunk> = runs.into_iter().map(run).filter(|run| run.count > 0).collect();
        waiting.reverse();
        Self { waiting, lengths }
    }

    /// The next request, with as many elements as it can hold.
    pub(super) fn next(&self) -> Option<Chunk> {
        self.waiting.last().map(|run| Chunk { count: most_at_once(*run, self.lengths), ..*run })
    }

    /// The next one is settled.
    pub(super) fn done(&mut self) {
        self.done_first(usize::MAX);
    }

    /// The first elements of the next one are settled. Its others come with the request after it.
    pub(super) fn done_first(&mut self, count: usize) {
        let Some(run) = self.waiting.last_mut() else { return };
        let count = count.min(most_at_once(*run, self.lengths));
        run.start = run.start.saturating_add(count);
        run.count = run.count.saturating_sub(count);
        if run.count == 0 {
            self.waiting.pop();
        }
    }

    /// The next one was refused: its halves replace it. A single value is returned instead.
    pub(super) fn refused(&mut self) -> Option<Chunk> {
        let chunk = self.next()?;
        self.done();
        let Some(half) = half(chunk) else { return Some(chunk) };
        let rest = chunk.count.saturating_sub(half);
        self.waiting.push(Chunk { start: chunk.start.saturating_add(half), count: rest, ..chunk });
        self.waiting.push(Chunk { count: half, ..chunk });
        None
    }

    /// These come first.
    pub(super) fn prepend(&mut self, other: Self) {
        self.waiting.extend(other.waiting);
    }

    /// These come again, before the others.
    pub(super) fn again(&mut self, chunks: impl IntoIterator<Item = Chunk>) {
        let mut runs: Vec<Chunk> = Vec::new();
        for chunk in chunks {
            match runs.last_mut() {
                Some(run) if run.block == chunk.block && run.indices().end == chunk.start => {
                    run.count = run.count.saturating_add(chunk.count);
                }
                Some(_) | None => runs.push(chunk),
            }
        }
        self.waiting.extend(runs.into_iter().rev());
    }
}

/// The number of elements of a run in one request: values stay whole. It is 1 for counters of 32
/// bits, whose values have one element.
fn most_at_once(run: Chunk, lengths: RequestLengths) -> usize {
    let (most, per_value) = (lengths.most(run.range.first()), run.range.elements_per_value());
    if run.count <= most {
        return run.count;
    }
    let end = run.start.saturating_add(most);
    let past = end.checked_rem(per_value).unwrap_or(0);
    // A value that is longer than a request is asked for whole, and refused.
    most.saturating_sub(past).max(per_value).min(run.count)
}

/// The number of elements in the first half: values stay whole, and a single value has no halves.
fn half(chunk: Chunk) -> Option<usize> {
    let per_value = chunk.range.elements_per_value();
    let half = chunk.count.checked_div(2).filter(|&half| half > 0)?;
    let past = chunk.start.saturating_add(half).checked_rem(per_value).unwrap_or(0);
    let behind = half.saturating_add(per_value.saturating_sub(past));
    let before = half.saturating_sub(past);
    match (before > 0, behind < chunk.count) {
        (true, _) => Some(before),
        (false, true) => Some(behind),
        (false, false) => None,
    }
}

impl Block {
    pub(super) fn new(range: Tag) -> Self {
        Self { range, cells: vec![Err(Missing::NotRead); range.element_count()] }
    }

    /// Stores the values of a reply.
    pub(super) fn fill(&mut self, chunk: Chunk, values: &[Value]) {
        self.part(chunk).iter_mut().zip(values).for_each(|(cell, &value)| *cell = Ok(value));
    }

    /// Stores a refusal.
    pub(super) fn refuse(&mut self, chunk: Chunk, error: ErrorCode) {
        self.part(chunk).fill(Err(Missing::Refused(error)));
    }

    fn part(&mut self, chunk: Chunk) -> &mut [Cell] {
        let cells = self.cells.get_mut(chunk.indices());
        debug_assert!(cells.is_some(), "{chunk:?} is no part of the block");
        cells.unwrap_or_default()
    }

    /// Its elements with their cells.
    pub(super) fn elements(&self) -> impl Iterator<Item = (Element, Cell)> {
        self.range.elements().zip(self.cells.iter().copied())
    }

    /// The index of an element.
    pub(super) fn index(&self, element: Element) -> Option<usize> {
        let first = self.range.first();
        if element.symbol() != first.symbol() || !first.is_consecutive_with(element.address()) {
            return None;
        }
        let (step, distance) = (first.step(), element.address().checked_sub(first.address())?);
        let index = usize::from(distance.checked_div(step)?);
        (distance.is_multiple_of(step) && index < self.cells.len()).then_some(index)
    }
}

#[cfg(test)]
mod tests;
