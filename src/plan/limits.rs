use super::PlanError;
use crate::command::{MAX_MIXED_READ_UNITS, MAX_POINTS, MAX_UNITS};
use crate::element::{Element, Symbol, Width};

/// What a device takes, where that is less than the protocol has.
///
/// ```
/// use fatek::element;
/// use fatek::plan::Limits;
///
/// let limits = Limits::new()
///     .max_registers(32)?
///     .no_mixed_reads()
///     .readable(element!("R0"), element!("R3839"))? // of R, nothing else
///     .readable(element!("R5000"), element!("R5998"))?;
/// assert!(Limits::new().max_registers(65).is_err());
/// # let _ = limits;
/// # Ok::<(), fatek::plan::PlanError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Limits {
    max_registers: usize,
    max_points: usize,
    max_mixed: usize,
    readable: Ranges,
    avoided: Ranges,
    /// Before which elements a run must end. Sorted.
    splits: Vec<(Symbol, u16)>,
}

/// Ranges of elements: sorted; those that touch are one.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
struct Ranges(Vec<Range>);

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
struct Range {
    symbol: Symbol,
    first: u16,
    last: u16,
}

impl Limits {
    /// The protocol's own limits: 64 units, 256 points, and every address that exists.
    #[must_use]
    pub fn new() -> Self {
        Self {
            max_registers: MAX_UNITS,
            max_points: MAX_POINTS,
            max_mixed: MAX_MIXED_READ_UNITS,
            readable: Ranges::default(),
            avoided: Ranges::default(),
            splits: Vec::new(),
        }
    }

    /// The most 16-bit registers in one request 46, where 32 bits count two.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 2, which a 32-bit value takes, to 64.
    pub fn max_registers(self, units: usize) -> Result<Self, PlanError> {
        Ok(Self { max_registers: within("max_registers", units, 2, MAX_UNITS)?, ..self })
    }

    /// The most discretes in one request 44.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 to 256.
    pub fn max_points(self, points: usize) -> Result<Self, PlanError> {
        Ok(Self { max_points: within("max_points", points, 1, MAX_POINTS)?, ..self })
    }

    /// The most units in one request 48, where 32 bits count two.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 to 64.
    pub fn max_mixed(self, units: usize) -> Result<Self, PlanError> {
        Ok(Self { max_mixed: within("max_mixed", units, 1, MAX_MIXED_READ_UNITS)?, ..self })
    }

    /// For devices that do not know command 48.
    #[must_use]
    pub fn no_mixed_reads(self) -> Self {
        Self { max_mixed: 0, ..self }
    }

    /// These elements, both ends among them, can be read; call it once for each range. For a symbol with a range,
    /// nothing outside its ranges is asked for, neither a tag nor a gap between two. Symbols without one are not
    /// limited.
    ///
    /// A range of `R` holds for `DR` too, but one of `M` not for `WM`: a device may allow the one and not the other.
    ///
    /// # Errors
    /// [`PlanError::Range`] unless both ends are of one symbol of 1 or 16 bits, the lower one first.
    pub fn readable(mut self, first: Element, last: Element) -> Result<Self, PlanError> {
        self.readable.extend([Range::new(first, last)?]);
        Ok(self)
    }

    /// These elements, both ends among them, are not read to get at something else: no run leads through them. A tag on
    /// them is read all the same. For addresses that the device refuses, or that are better left alone.
    ///
    /// As with [`readable`](Self::readable), a range of `R` holds for `DR` too, but one of `M` not for `WM`.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::element;
    /// use fatek::plan::{CostModel, Limits, Plan};
    /// use fatek::wire::Framing;
    ///
    /// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    /// let limits = Limits::new().no_mixed_reads();
    /// let plan = |limits| Plan::builder(network).limits(limits).tags(["R0", "R9"].map(|tag| tag.parse().unwrap())).build();
    /// assert_eq!(plan(limits.clone())?.requests().len(), 1); // R0 to R9
    /// assert_eq!(plan(limits.avoid(element!("R4"), element!("R5"))?)?.requests().len(), 2);
    /// # Ok::<(), fatek::plan::PlanError>(())
    /// ```
    ///
    /// # Errors
    /// [`PlanError::Range`] unless both ends are of one symbol of 1 or 16 bits, the lower one first.
    pub fn avoid(mut self, first: Element, last: Element) -> Result<Self, PlanError> {
        self.avoided.extend([Range::new(first, last)?]);
        Ok(self)
    }

    /// Avoids all of these consecutive elements, of any width.
    pub(crate) fn avoid_all(mut self, elements: impl IntoIterator<Item = (Element, usize)>) -> Self {
        let range = |(first, count): (Element, usize)| {
            let last = first.nth(count.checked_sub(1)?).ok()?;
            let (symbol, last) = match last {
                Element::Register32(double) => {
                    let low = double.low().symbol();
                    (low, last.address().saturating_add(low.step()))
                }
                Element::Discrete(_) | Element::Register(_) => (last.symbol(), last.address()),
            };
            Some(Range { symbol, first: first.address(), last })
        };
        self.avoided.extend(elements.into_iter().filter_map(range));
        self
    }

    /// No run leads from what is before these elements to them.
    pub(crate) fn split_before(mut self, elements: impl IntoIterator<Item = Element>) -> Self {
        let cell = |element: Element| match element {
            Element::Register32(double) => (double.low().symbol(), double.address()),
            Element::Discrete(_) | Element::Register(_) => (element.symbol(), element.address()),
        };
        self.splits.extend(elements.into_iter().map(cell));
        self.splits.sort_unstable();
        self
    }

    /// The same with no more than so many registers, points and units of a mixed read in a request: with what was learned
    /// from a device. 0 units: no mixed reads.
    pub(crate) fn at_most(self, registers: usize, points: usize, mixed: usize) -> Self {
        Self {
            max_registers: self.max_registers.min(registers.max(2)),
            max_points: self.max_points.min(points.max(1)),
            max_mixed: self.max_mixed.min(mixed),
            ..self
        }
    }

    /// How many units of elements as wide as this one request takes.
    pub(super) fn units(&self, width: Width) -> u32 {
        let units = if width == Width::Bit { self.max_points } else { self.max_registers };
        u32::try_from(units).unwrap_or(u32::MAX)
    }

    /// 0 if there are no mixed reads.
    pub(super) fn mixed_units(&self) -> u32 {
        u32::try_from(self.max_mixed).unwrap_or(u32::MAX)
    }

    /// Which of the readable ranges holds an address; `None` if none does.
    pub(super) fn segment(&self, symbol: Symbol, address: u16) -> Option<u32> {
        let ranges = self.readable.of(symbol);
        if ranges.is_empty() {
            return Some(0);
        }
        let n = ranges.partition_point(|range| range.first <= address).checked_sub(1)?;
        ranges.get(n).filter(|range| address <= range.last)?;
        u32::try_from(n).ok()
    }

    /// Whether one of these addresses, both ends among them, is to be avoided.
    pub(super) fn avoids(&self, symbol: Symbol, first: u16, last: u16) -> bool {
        let ranges = self.avoided.of(symbol);
        let before = ranges.partition_point(|range| range.first <= last);
        before.checked_sub(1).and_then(|n| ranges.get(n)).is_some_and(|range| first <= range.last)
    }

    /// Whether a run must end before one of these addresses, both ends among them.
    pub(super) fn splits(&self, symbol: Symbol, first: u16, last: u16) -> bool {
        let at = self.splits.partition_point(|split| *split < (symbol, first));
        self.splits.get(at).is_some_and(|split| *split <= (symbol, last))
    }

    /// Whether runs are as long as they like to be, and go where they like.
    pub(super) fn let_runs_be(&self) -> bool {
        self.avoided.0.is_empty() && self.splits.is_empty()
    }
}

impl Range {
    fn new(first: Element, last: Element) -> Result<Self, PlanError> {
        let symbol = first.symbol();
        if last.symbol() != symbol || first.address() > last.address() || symbol.width() == Width::DWord {
            return Err(PlanError::Range { first, last });
        }
        Ok(Self { symbol, first: first.address(), last: last.address() })
    }
}

impl Ranges {
    fn extend(&mut self, ranges: impl IntoIterator<Item = Range>) {
        self.0.extend(ranges);
        self.0.sort_unstable();
        self.0.dedup_by(|next, range| {
            let touch = next.symbol == range.symbol
                && u32::from(next.first) <= u32::from(range.last) + u32::from(next.symbol.alignment());
            if touch {
                range.last = range.last.max(next.last);
            }
            touch
        });
    }

    fn of(&self, symbol: Symbol) -> &[Range] {
        let start = self.0.partition_point(|range| range.symbol < symbol);
        let end = self.0.partition_point(|range| range.symbol <= symbol);
        self.0.get(start..end).unwrap_or_default()
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self::new()
    }
}

fn within(name: &'static str, given: usize, min: usize, max: usize) -> Result<usize, PlanError> {
    if (min..=max).contains(&given) { Ok(given) } else { Err(PlanError::Limit { name, given, min, max }) }
}
