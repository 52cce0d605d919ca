//! Tags of a table with common elements.

use std::fmt;

use super::TagEntry;

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
pub(super) fn overlaps(entries: &[TagEntry]) -> Vec<Overlap<'_>> {
    // Several bits of one register are no fault, nor is the register beside them.
    let mut by_memory: Vec<(usize, &TagEntry)> =
        entries.iter().enumerate().filter(|(_, entry)| !entry.tag.is_bits_of_register()).collect();
    by_memory.sort_by_key(|(number, entry)| (entry.tag.memory(), *number));
    let mut found = Vec::new();
    let mut farthest: Option<(usize, &TagEntry)> = None;
    for (number, entry) in by_memory {
        let (area, begin, end) = entry.tag.memory();
        let shared = farthest.filter(|(_, other)| {
            let (other_area, _, other_end) = other.tag.memory();
            other_area == area && begin <= other_end
        });
        match shared {
            Some((other_number, other)) => {
                let (first, second) = if other_number < number { (other, entry) } else { (entry, other) };
                found.push(Overlap { first, second });
                if end > other.tag.memory().2 {
                    farthest = Some((number, entry));
                }
            }
            None => farthest = Some((number, entry)),
        }
    }
    found.sort_by_key(|overlap| (overlap.second.line, overlap.first.line));
    found
}
