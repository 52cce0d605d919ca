//! Elements that a station has answered reads of.
//!
//! Invariant: at most [`MOST`] spans, which neither overlap nor touch. If there are more, the
//! oldest is forgotten.

use crate::element::{Element, Symbol};

/// Maximum number of spans of a station.
const MOST: usize = 16;

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct AnsweredElements {
    spans: Vec<Span>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Span {
    symbol: Symbol,
    first: u16,
    last: u16,
}

impl AnsweredElements {
    pub(super) fn new() -> Self {
        Self { spans: Vec::new() }
    }

    pub(super) fn contains(&self, element: Element) -> bool {
        self.spans.iter().any(|span| span.contains(element.symbol(), element.address()))
    }

    /// Adds consecutive elements, at least one.
    pub(super) fn add(&mut self, first: Element, count: usize) {
        debug_assert!(count > 0, "a run has no elements");
        // Mostly a run that was added before.
        let (symbol, address) = (first.symbol(), first.address());
        let behind = u32::try_from(count.saturating_sub(1)).unwrap_or(u32::MAX).saturating_mul(first.step().into());
        let last = u32::from(address).saturating_add(behind);
        let has = |span: &Span| span.contains(symbol, address) && last <= span.last.into();
        if self.spans.iter().any(has) {
            return;
        }
        let Ok(last) = first.nth(count.saturating_sub(1)) else { return };
        let mut new = Span { symbol, first: address, last: last.address() };
        self.spans.retain(|span| {
            let joins = span.touches(&new);
            if joins {
                new.first = new.first.min(span.first);
                new.last = new.last.max(span.last);
            }
            !joins
        });
        if self.spans.len() >= MOST {
            self.spans.remove(0);
        }
        // Most stations are read in one block.
        self.spans.reserve_exact(1);
        self.spans.push(new);
    }

    /// Forgets the span of this element.
    pub(super) fn forget(&mut self, element: Element) {
        self.spans.retain(|span| !span.contains(element.symbol(), element.address()));
    }
}

impl Span {
    fn contains(&self, symbol: Symbol, address: u16) -> bool {
        self.symbol == symbol && (self.first..=self.last).contains(&address)
    }

    fn touches(&self, other: &Self) -> bool {
        let Ok(first) = Element::new(self.symbol, self.first) else { return false };
        let step = first.step();
        self.symbol == other.symbol
            && first.is_consecutive_with(other.first)
            && self.first <= other.last.saturating_add(step)
            && other.first <= self.last.saturating_add(step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn element(text: &str) -> Element {
        text.parse().unwrap()
    }

    #[test]
    fn spans_that_overlap_or_touch_are_joined() {
        let mut answered = AnsweredElements::new();
        answered.add(element("R0"), 16);
        answered.add(element("R32"), 16);
        assert!(!answered.contains(element("R16")) && !answered.contains(element("D0")));
        answered.add(element("R16"), 16);
        assert_eq!(answered.spans.len(), 1);
        assert!(answered.contains(element("R0")) && answered.contains(element("R47")));
        assert!(!answered.contains(element("R48")));
        answered.add(element("WM0"), 2);
        answered.add(element("WM32"), 1);
        assert!(answered.contains(element("WM32")) && !answered.contains(element("WM48")));
        answered.forget(element("R5"));
        assert!(!answered.contains(element("R0")) && answered.contains(element("WM0")));
    }

    #[test]
    fn counters_of_32_bits_are_joined_by_one_address() {
        let mut answered = AnsweredElements::new();
        for counter in ["DRC198", "DRC200", "DRC202"] {
            answered.add(element(counter), 1);
        }
        // Before: two addresses apart was joined, so DRC201 counted as answered.
        assert!(answered.contains(element("DRC200")) && !answered.contains(element("DRC201")));
        answered.add(element("DRC201"), 1);
        assert_eq!(answered.spans.len(), 2);
    }

    #[test]
    fn the_oldest_of_too_many_spans_is_forgotten() {
        let mut answered = AnsweredElements::new();
        for n in 0..=MOST {
            answered.add(Element::new(Symbol::R, u16::try_from(10 * n).unwrap()).unwrap(), 1);
        }
        assert_eq!(answered.spans.len(), MOST);
        assert!(!answered.contains(element("R0")) && answered.contains(element("R10")));
    }
}
