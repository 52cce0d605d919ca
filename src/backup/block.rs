//! The ranges of a backup, and which parts of them one request names.

use std::ops::Range;

use super::{InvalidBackup, Missing};
use crate::command::{Value, most_in_one_request};
use crate::element::{Element, MemoryArea};
use crate::error::ErrorCode;
use crate::tag::{Tag, TagType};

/// What is known of an element.
pub(super) type Cell = Result<Value, Missing>;

/// One range, with a cell for each element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Block {
    pub(super) range: Tag,
    pub(super) cells: Vec<Cell>,
}

/// Consecutive elements of one block, few enough for one request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Chunk {
    /// Which block, and its range.
    pub(super) block: usize,
    pub(super) range: Tag,
    /// The first element, counted from the first of the block.
    pub(super) start: usize,
    pub(super) count: usize,
}

impl Chunk {
    pub(super) fn places(self) -> Range<usize> {
        self.start..self.start.saturating_add(self.count)
    }

    /// Its elements, as people write them.
    pub(super) fn names(self) -> Tag {
        part(self.range, &self.places())
    }
}

/// A range without what does not matter here: of its type there is left whether a value takes two registers.
pub(super) fn plain(range: Tag) -> Tag {
    let pairs = !range.tag_type().is_text() && range.elements_per_value() == 2;
    let tag_type = if pairs { TagType::U32 } else { TagType::default_for(range.first().width()) };
    // The elements are those of a tag, and so is their number.
    Tag::spanning(range.first(), tag_type, range.element_count()).unwrap_or(range)
}

/// These elements of a range, without a type.
pub(super) fn part(range: Tag, places: &Range<usize>) -> Tag {
    let first = range.first().nth(places.start).unwrap_or(range.first());
    Tag::spanning(first, TagType::default_for(first.width()), places.len()).unwrap_or(range)
}

/// Where an element, or a range, lies in the memory of a PLC: the symbol of its smallest parts, and their first and last
/// addresses.
fn memory(range: Tag) -> (MemoryArea, u16, u16) {
    let first = range.first();
    let last = first.nth(range.element_count().saturating_sub(1)).unwrap_or(first);
    // Consecutive elements touch, so the step from one to the next is what each of them covers.
    let end = last.address().saturating_add(last.symbol().step().saturating_sub(1));
    (first.symbol().area(), first.address(), end)
}

/// The discretes that these elements are: their first, and how many they are.
pub(super) fn discretes(range: Tag) -> Option<(crate::Discrete, usize)> {
    let (area, first, last) = memory(range);
    let discrete = crate::Discrete::new(area.smallest(), first).ok()?;
    Some((discrete, usize::from(last.saturating_sub(first)).saturating_add(1)))
}

/// Whether the PLC itself says what these are, again and again: inputs follow what is wired to them, the contacts of timers
/// and counters their values.
pub(super) fn is_not_for_restoring(range: Tag) -> bool {
    range.first().symbol().area().is_derived()
}

/// That no two of these share memory, by whatever names.
pub(super) fn check_overlaps(ranges: &[Tag]) -> Result<(), InvalidBackup> {
    let mut sorted: Vec<_> = ranges.iter().map(|&range| (memory(range), range)).collect();
    sorted.sort_unstable_by_key(|&(memory, _)| memory);
    for (((symbol, _, end), first), ((next, start, _), second)) in sorted.iter().zip(sorted.iter().skip(1)) {
        if symbol == next && start <= end {
            return Err(InvalidBackup::Overlap { first: *first, second: *second });
        }
    }
    Ok(())
}

/// The longest runs of places where this holds.
pub(super) fn runs<T>(items: &[T], mut holds: impl FnMut(&T) -> bool) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for (place, item) in items.iter().enumerate() {
        if holds(item) {
            match runs.last_mut() {
                Some(run) if run.end == place => run.end = place.saturating_add(1),
                _ => runs.push(place..place.saturating_add(1)),
            }
        }
    }
    runs
}

/// The longest runs of values with an element where this holds. Values of so many elements are in them as a whole.
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

/// Requests that are still to be made, one after the other; what a request was refused for is found by halving it.
#[derive(Clone, Debug, Default)]
pub(super) struct Chunks {
    /// Runs of elements, of any length; the next one is the last.
    waiting: Vec<Chunk>,
}

impl Chunks {
    /// As few requests as name all of these, in this order; no value of two registers is split.
    pub(super) fn new(runs: impl IntoIterator<Item = (usize, Tag, Range<usize>)>) -> Self {
        let run = |(block, range, places): (usize, Tag, Range<usize>)| Chunk {
            block,
            range,
            start: places.start,
            count: places.len(),
        };
        let mut waiting: Vec<Chunk> = runs.into_iter().map(run).filter(|run| run.count > 0).collect();
        waiting.reverse();
        Self { waiting }
    }

    /// The next request: as many elements as one holds.
    pub(super) fn next(&self) -> Option<Chunk> {
        self.waiting.last().map(|run| Chunk { count: most_at_once(*run), ..*run })
    }

    /// The next one is settled.
    pub(super) fn done(&mut self) {
        self.done_first(usize::MAX);
    }

    /// The first elements of the next one are settled. The others of it come with the next request.
    pub(super) fn done_first(&mut self, count: usize) {
        let Some(run) = self.waiting.last_mut() else { return };
        let count = count.min(most_at_once(*run));
        run.start = run.start.saturating_add(count);
        run.count = run.count.saturating_sub(count);
        if run.count == 0 {
            self.waiting.pop();
        }
    }

    /// The next one was refused: its halves come in its place. A single value, or what there is of it, is given back.
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

    /// These are asked for again, before the others.
    pub(super) fn again(&mut self, chunks: impl IntoIterator<Item = Chunk>) {
        let mut runs: Vec<Chunk> = Vec::new();
        for chunk in chunks {
            match runs.last_mut() {
                Some(run) if run.block == chunk.block && run.places().end == chunk.start => {
                    run.count = run.count.saturating_add(chunk.count);
                }
                Some(_) | None => runs.push(chunk),
            }
        }
        self.waiting.extend(runs.into_iter().rev());
    }
}

/// How many elements of a run the next request names: values stay whole.
fn most_at_once(run: Chunk) -> usize {
    let most = most_in_one_request(run.range.first());
    if run.count <= most {
        return run.count;
    }
    let end = run.start.saturating_add(most);
    let past = end.checked_rem(run.range.elements_per_value()).unwrap_or(0);
    most.saturating_sub(past)
}

/// How many elements the first half has; values stay whole, and a value alone has no halves.
fn half(chunk: Chunk) -> Option<usize> {
    let per_value = chunk.range.elements_per_value();
    let half = chunk.count.checked_div(2).filter(|&half| half > 0)?;
    let past = chunk.start.saturating_add(half).checked_rem(per_value).unwrap_or(0);
    let (before, behind) = (half.saturating_sub(past), half.saturating_add(past));
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

    /// The values that a request for a part of it has brought.
    pub(super) fn fill(&mut self, chunk: Chunk, values: &[Value]) {
        let cells = self.cells.get_mut(chunk.places()).unwrap_or_default();
        cells.iter_mut().zip(values).for_each(|(cell, &value)| *cell = Ok(value));
    }

    /// The PLC does not give these.
    pub(super) fn refuse(&mut self, chunk: Chunk, error: ErrorCode) {
        let cells = self.cells.get_mut(chunk.places()).unwrap_or_default();
        cells.fill(Err(Missing::Refused(error)));
    }

    /// Its elements with what is known of them.
    pub(super) fn elements(&self) -> impl Iterator<Item = (Element, Cell)> {
        self.range.elements().zip(self.cells.iter().copied())
    }

    /// The place of an element.
    pub(super) fn place(&self, element: Element) -> Option<usize> {
        let first = self.range.first();
        if element.symbol() != first.symbol() {
            return None;
        }
        let (step, distance) = (first.symbol().step(), element.address().checked_sub(first.address())?);
        let place = usize::from(distance.checked_div(step)?);
        (distance.is_multiple_of(step) && place < self.cells.len()).then_some(place)
    }
}

#[cfg(test)]
mod tests;
