//! Spans of elements, compared by memory rather than by symbol.

use crate::element::{Element, MemoryArea};

/// Addresses of one memory area, both ends included. Empty if `last` is below `first`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Span {
    area: MemoryArea,
    first: u16,
    last: u16,
}

impl Span {
    pub(super) fn new(first: Element, count: usize) -> Self {
        let area = first.symbol().area();
        let Some(others) = count.checked_sub(1) else { return Self { area, first: 1, last: 0 } };
        // Elements past the last address do not exist, so the span ends there.
        let behind = u16::try_from(others.saturating_mul(first.step().into())).unwrap_or(u16::MAX);
        Self { area, first: first.address(), last: first.covered().1.saturating_add(behind) }
    }

    pub(super) fn overlaps(self, other: Self) -> bool {
        let empty = self.first > self.last || other.first > other.last;
        !empty && self.area == other.area && self.first <= other.last && other.first <= self.last
    }
}
