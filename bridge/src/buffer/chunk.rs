//! The index of the chunks on disk. No I/O.
//!
//! A chunk is a row of the file: records of batches with consecutive positions, so that the file has few
//! rows and each fills its pages.

use std::collections::VecDeque;

/// A chunk on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Chunk {
    /// The position of its first batch, and its key in the file.
    pub(super) first: u64,
    /// The number of its batches.
    pub(super) count: u32,
    /// Its length in bytes.
    pub(super) len: u32,
    /// When its first batch was pushed, in milliseconds of the buffer's time.
    pub(super) oldest: u64,
    /// When its last batch was pushed.
    pub(super) newest: u64,
}

impl Chunk {
    /// The position behind its last batch.
    pub(super) fn end(&self) -> u64 {
        self.first.saturating_add(self.count.into())
    }

    /// The bytes of the file that it takes.
    pub(super) fn cost(&self) -> u64 {
        cost(self.len)
    }
}

/// The size of a page of redb.
const PAGE: u64 = 4096;
/// The bytes of a chunk's page besides its records: header, key and offsets.
pub(super) const PAGE_OVERHEAD: u32 = 64;
/// The bytes of a chunk in the pages above it, and in the index.
const ROW: u64 = 128;

/// The bytes of the file that a chunk of this length takes. redb allocates a power of two of pages.
pub(super) fn cost(len: u32) -> u64 {
    let pages = u64::from(len.saturating_add(PAGE_OVERHEAD)).div_ceil(PAGE).next_power_of_two();
    pages.saturating_mul(PAGE).saturating_add(ROW)
}

/// The chunks in the order of their positions.
///
/// Invariants: chunks do not overlap; `cost` is the sum of theirs.
#[derive(Debug, Default)]
pub(super) struct Chunks {
    rows: VecDeque<Row>,
    cost: u64,
}

#[derive(Clone, Copy, Debug)]
struct Row {
    chunk: Chunk,
    /// The batches in all rows that were ever put before it.
    before: u64,
}

impl Chunks {
    pub(super) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The bytes of the file that they take.
    pub(super) fn cost(&self) -> u64 {
        self.cost
    }

    pub(super) fn front(&self) -> Option<Chunk> {
        self.rows.front().map(|row| row.chunk)
    }

    pub(super) fn back(&self) -> Option<Chunk> {
        self.rows.back().map(|row| row.chunk)
    }

    /// Appends a chunk; in place of the last if that has the same key.
    pub(super) fn put(&mut self, chunk: Chunk) {
        let mut before = self.total();
        if let Some(last) = self.rows.back().copied().filter(|last| last.chunk.first == chunk.first) {
            self.rows.pop_back();
            self.cost = self.cost.saturating_sub(last.chunk.cost());
            before = last.before;
        }
        debug_assert!(self.back().is_none_or(|last| last.end() <= chunk.first), "chunks do not overlap");
        self.cost = self.cost.saturating_add(chunk.cost());
        self.rows.push_back(Row { chunk, before });
    }

    pub(super) fn pop_front(&mut self) -> Option<Chunk> {
        let row = self.rows.pop_front()?;
        self.cost = self.cost.saturating_sub(row.chunk.cost());
        Some(row.chunk)
    }

    /// Takes all but the first `count` batches, of `len` bytes, from the chunk with this key.
    pub(super) fn truncate(&mut self, first: u64, count: u32, len: u32) {
        let at = self.index(first);
        let Some(row) = self.rows.get_mut(at).filter(|row| row.chunk.first == first) else { return };
        let lost = u64::from(row.chunk.count.saturating_sub(count));
        self.cost = self.cost.saturating_sub(row.chunk.cost());
        if count == 0 {
            self.rows.remove(at);
        } else {
            row.chunk = Chunk { count, len, ..row.chunk };
            self.cost = self.cost.saturating_add(row.chunk.cost());
        }
        let behind = if count == 0 { at } else { at.saturating_add(1) };
        self.rows.range_mut(behind..).for_each(|row| row.before = row.before.saturating_sub(lost));
    }

    pub(super) fn clear(&mut self) {
        self.rows.clear();
        self.cost = 0;
    }

    /// The chunks with batches at or behind a position.
    pub(super) fn from(&self, position: u64) -> impl Iterator<Item = Chunk> + '_ {
        self.rows.range(self.index(position)..).map(|row| row.chunk)
    }

    /// The number of batches in `begin..end`.
    pub(super) fn count(&self, begin: u64, end: u64) -> u64 {
        self.before(end).saturating_sub(self.before(begin))
    }

    /// The first row with a batch at or behind a position.
    fn index(&self, position: u64) -> usize {
        self.rows.partition_point(|row| row.chunk.end() <= position)
    }

    /// The batches that were ever put before a position.
    fn before(&self, position: u64) -> u64 {
        let row = self.rows.get(self.index(position));
        row.map_or(self.total(), |row| row.before.saturating_add(position.saturating_sub(row.chunk.first)))
    }

    fn total(&self) -> u64 {
        self.rows.back().map_or(0, |row| row.before.saturating_add(row.chunk.count.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chunk(first: u64, count: u32) -> Chunk {
        Chunk { first, count, len: 100, oldest: first, newest: first + u64::from(count) }
    }

    #[test]
    fn chunks_count_batches_across_gaps() {
        let mut chunks = Chunks::default();
        [chunk(10, 5), chunk(20, 5), chunk(25, 1)].into_iter().for_each(|chunk| chunks.put(chunk));
        assert_eq!(chunks.count(0, 99), 11);
        assert_eq!((chunks.count(12, 22), chunks.count(15, 20), chunks.count(26, 99)), (5, 0, 0));
        chunks.put(chunk(25, 4));
        assert_eq!((chunks.count(24, 29), chunks.count(24, 27)), (5, 3));
        assert_eq!(chunks.pop_front(), Some(chunk(10, 5)));
        assert_eq!((chunks.count(0, 99), chunks.count(22, 26)), (9, 4));
        assert_eq!(chunks.from(22).map(|chunk| chunk.first).collect::<Vec<_>>(), [20, 25]);
        assert_eq!(chunks.cost(), 2 * cost(100));
    }

    #[test]
    fn the_end_of_a_chunk_is_removed_from_the_counts() {
        let mut chunks = Chunks::default();
        [chunk(10, 5), chunk(15, 5), chunk(25, 5)].into_iter().for_each(|chunk| chunks.put(chunk));
        chunks.truncate(15, 2, 40);
        assert_eq!((chunks.count(0, 99), chunks.count(10, 17), chunks.count(17, 25)), (12, 7, 0));
        chunks.truncate(10, 0, 0);
        assert_eq!((chunks.count(0, 99), chunks.count(25, 27)), (7, 2));
        chunks.put(chunk(30, 1));
        assert_eq!(chunks.count(0, 99), 8);
        assert_eq!(chunks.cost(), 3 * cost(100));
    }

    #[test]
    fn the_cost_of_a_chunk_is_that_of_whole_pages() {
        let page = |len| (cost(len) - ROW) / PAGE;
        assert_eq!((page(1), page(4096 - PAGE_OVERHEAD), page(4096)), (1, 1, 2));
        assert_eq!((page(16384 - PAGE_OVERHEAD), page(16384)), (4, 8));
    }
}
