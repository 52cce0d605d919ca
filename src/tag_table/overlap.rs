//! Tags of a table with common elements.

use std::fmt;

use super::TagEntry;
use crate::tag::Tag;

/// Two tags with common elements; see [`TagTable::overlaps`](super::TagTable::overlaps).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Overlap<'t> {
    /// The one that stands first in the file.
    pub first: &'t TagEntry,
    /// The other one.
    pub second: &'t TagEntry,
}

impl Overlap<'_> {
    /// Returns whether both have the same tag.
    #[must_use]
    pub fn is_same(&self) -> bool {
        self.first.tag == self.second.tag
    }
}

impl fmt::Display for Overlap<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { first, second } = self;
        write!(f, "line {}, {} ({}) ", second.line, second.name, second.tag)?;
        f.write_str(if self.is_same() { "is the same tag as" } else { "has elements of" })?;
        write!(f, " {} ({}) in line {}", first.name, first.tag, first.line)
    }
}

/// For each entry that begins within an earlier one, by memory, the one of these that reaches farthest.
///
/// Bits are compared with bits only: the register beside its bits is no fault.
pub(super) fn overlaps(entries: &[TagEntry]) -> Vec<Overlap<'_>> {
    let numbered = || entries.iter().enumerate();
    let mut found = Vec::new();
    sweep(numbered().filter(|(_, entry)| !entry.tag.is_bits_of_register()), |tag| Some(tag.memory()), &mut found);
    sweep(numbered(), |tag| tag.bit_memory(), &mut found);
    found.sort_by_key(|overlap| (overlap.second.line, overlap.first.line));
    found
}

/// Passes over the entries by area and begin; `extent` has area, begin and end.
fn sweep<'t, A: Ord + Copy, B: Ord + Copy>(
    entries: impl Iterator<Item = (usize, &'t TagEntry)>,
    extent: impl Fn(&Tag) -> Option<(A, B, B)>,
    found: &mut Vec<Overlap<'t>>,
) {
    let mut by_memory: Vec<_> =
        entries.filter_map(|(number, entry)| Some((extent(&entry.tag)?, number, entry))).collect();
    by_memory.sort_by_key(|(extent, number, _)| (*extent, *number));
    let mut farthest: Option<((A, B, B), usize, &TagEntry)> = None;
    for next @ ((area, begin, end), number, entry) in by_memory {
        match farthest {
            Some(((other_area, _, other_end), other_number, other)) if other_area == area && begin <= other_end => {
                let (first, second) = if other_number < number { (other, entry) } else { (entry, other) };
                found.push(Overlap { first, second });
                if end > other_end {
                    farthest = Some(next);
                }
            }
            Some(_) | None => farthest = Some(next),
        }
    }
}
