use super::PlanError;
use super::words::WordAreas;
use crate::capabilities::Capabilities;
use crate::command::{Code, MAX_MIXED_READ_UNITS, MAX_POINTS, MAX_UNITS};
use crate::element::{Element, Symbol, Width};
use crate::wire::Framing;

/// The limits of a PLC where they are lower than those of the protocol: lengths and addresses.
///
/// ```
/// use fatek::element;
/// use fatek::plan::Limits;
///
/// let limits = Limits::new()
///     .max_registers(32)?
///     .mixed_reads(false)
///     .readable(element!("R0"), element!("R3839"))? // no other register R
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
    /// The elements that no run reads together with the one before. Sorted.
    split_points: Vec<(Symbol, u16)>,
    /// The areas whose discretes may be read as words.
    word_areas: WordAreas,
    /// Words of discretes begin at multiples of this.
    word_alignment: u16,
}

/// Sorted ranges of elements; adjacent and overlapping ones are merged.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
struct Ranges(Vec<Range>);

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
struct Range {
    symbol: Symbol,
    first: u16,
    last: u16,
}

impl Limits {
    /// Returns the limits of the protocol: 64 units, 256 discretes, and every address.
    #[must_use]
    pub fn new() -> Self {
        Self {
            max_registers: MAX_UNITS,
            max_points: MAX_POINTS,
            max_mixed: MAX_MIXED_READ_UNITS,
            readable: Ranges::default(),
            avoided: Ranges::default(),
            split_points: Vec::new(),
            word_areas: WordAreas::all(),
            word_alignment: 8,
        }
    }

    /// Sets the maximum of 16-bit registers in one request 46, where 32 bits count two.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 2 to 64; a 32-bit value needs 2.
    pub fn max_registers(self, units: usize) -> Result<Self, PlanError> {
        Ok(Self { max_registers: check_range("max_registers", units, 2, MAX_UNITS)?, ..self })
    }

    /// Sets the maximum of discretes in one request 44.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 to 256.
    pub fn max_points(self, points: usize) -> Result<Self, PlanError> {
        Ok(Self { max_points: check_range("max_points", points, 1, MAX_POINTS)?, ..self })
    }

    /// Sets the maximum of units in one request 48, where 32 bits count two.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 to 64.
    pub fn max_mixed(self, units: usize) -> Result<Self, PlanError> {
        Ok(Self { max_mixed: check_range("max_mixed", units, 1, MAX_MIXED_READ_UNITS)?, ..self })
    }

    /// Sets whether mixed reads are used: `false` is for PLCs without command 48. Default: `true`.
    ///
    /// [`max_mixed`](Self::max_mixed) allows them again.
    #[must_use]
    pub fn mixed_reads(self, allowed: bool) -> Self {
        let max_mixed = match (allowed, self.max_mixed) {
            (false, _) => 0,
            (true, 0) => MAX_MIXED_READ_UNITS,
            (true, units) => units,
        };
        Self { max_mixed, ..self }
    }

    /// Sets whether discretes X, Y, M and S may be read as bits of words, such as M0 to M15 as
    /// `WM0`. Default: `true`.
    ///
    /// A word has the bytes of four discretes in a reply, or of two in the binary framing, and one unit
    /// of a mixed read. It can
    /// contain up to 15 discretes that no tag reads, all of them within the readable ranges and none
    /// to avoid. `false` is for PLCs that refuse words of discretes: [`Plan::read`](super::Plan::read)
    /// reads their discretes by a second request.
    ///
    /// ```
    /// use fatek::endpoint::SerialSettings;
    /// use fatek::plan::{CostModel, Limits, Plan};
    /// use fatek::wire::Framing;
    ///
    /// let serial = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
    /// let first = |limits| {
    ///     let tags = ["M0-M255"].map(|tag| tag.parse().unwrap());
    ///     let plan = Plan::builder(serial).limits(limits).tags(tags).build().unwrap();
    ///     plan.requests()[0].request().to_string()
    /// };
    /// assert_eq!(first(Limits::new()), "46 WM0-WM240");
    /// assert_eq!(first(Limits::new().words_of_discretes(false)), "44 M0-M255");
    /// ```
    #[must_use]
    pub fn words_of_discretes(self, allowed: bool) -> Self {
        Self { word_areas: if allowed { WordAreas::all() } else { WordAreas::default() }, ..self }
    }

    /// Sets whether discretes are read by words at multiples of 16 only: `true` is for devices that
    /// refuse `WM8`. Default: `false`, for multiples of 8.
    ///
    /// Tags such as `WM8` are read all the same.
    #[must_use]
    pub fn words_at_multiples_of_16(self, only: bool) -> Self {
        Self { word_alignment: if only { 16 } else { 8 }, ..self }
    }

    /// Adds a readable range, from `first` to `last` inclusive.
    ///
    /// For a symbol with readable ranges, no request reads outside of them, neither for a tag nor
    /// in a gap. Symbols without a range are not limited. A range of `R` applies to `DR` too. A
    /// range of `M` does not apply to a tag of `WM`, because a PLC may allow one and not the other;
    /// a word that is read for discretes, or in a gap, is within the ranges of both. Counters of 32
    /// bits belong to `RC`: beside a range of `RC`, they need one such as `DRC200` to `DRC255`.
    ///
    /// # Errors
    /// [`PlanError::Range`] unless both ends have one symbol of 1 or 16 bits, or are counters of 32
    /// bits, the lower first.
    pub fn readable(mut self, first: Element, last: Element) -> Result<Self, PlanError> {
        self.readable.extend([Range::new(first, last)?]);
        Ok(self)
    }

    /// Adds a range to avoid, from `first` to `last` inclusive: no run reads through it.
    ///
    /// A tag in the range is read all the same. Use it for addresses that the PLC refuses or that
    /// should not be read needlessly. As with [`readable`](Self::readable), a range of `R` applies
    /// to `DR` too, and a range of `M` to words that are read for discretes or in a gap, but not to
    /// a tag of `WM`.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::element;
    /// use fatek::plan::{CostModel, Limits, Plan};
    /// use fatek::wire::Framing;
    ///
    /// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    /// let limits = Limits::new().mixed_reads(false);
    /// let tags = ["R0", "R9"].map(|tag| tag.parse().unwrap());
    /// let plan = |limits| Plan::builder(network).limits(limits).tags(tags).build();
    /// assert_eq!(plan(limits.clone())?.requests().len(), 1); // R0 to R9
    /// assert_eq!(plan(limits.avoid(element!("R4"), element!("R5"))?)?.requests().len(), 2);
    /// # Ok::<(), fatek::plan::PlanError>(())
    /// ```
    ///
    /// # Errors
    /// [`PlanError::Range`] unless both ends have one symbol of 1 or 16 bits, the lower first.
    pub fn avoid(mut self, first: Element, last: Element) -> Result<Self, PlanError> {
        self.avoided.extend([Range::new(first, last)?]);
        Ok(self)
    }

    /// Avoids ranges given by their first element, of any width, and the number of elements.
    pub(crate) fn avoid_all(mut self, elements: impl IntoIterator<Item = (Element, usize)>) -> Self {
        let range = |(first, count): (Element, usize)| {
            let last = first.nth(count.checked_sub(1)?).ok()?;
            let symbol = first.symbol().halved();
            // The last cell of a pair is its high word.
            let to_last_cell = match last.width() {
                Width::DWord if !last.is_counter_of_32_bits() => symbol.step(),
                Width::Bit | Width::Word | Width::DWord => 0,
            };
            Some(Range { symbol, first: first.address(), last: last.address() + to_last_cell })
        };
        self.avoided.extend(elements.into_iter().filter_map(range));
        self
    }

    /// Adds split points: no run reads one of these elements together with the one before.
    pub(crate) fn split_before(mut self, elements: impl IntoIterator<Item = Element>) -> Self {
        let cell = |element: Element| (element.symbol().halved(), element.address());
        self.split_points.extend(elements.into_iter().map(cell));
        self.split_points.sort_unstable();
        self
    }

    /// Lowers the limits to what a station supports.
    ///
    /// ```
    /// use fatek::capabilities::{Capabilities, Support};
    /// use fatek::command::Code;
    /// use fatek::plan::Limits;
    ///
    /// let known = Capabilities::new().with_command(Code::ReadMixed, Support::Refused).with_max_registers(32)?;
    /// assert_eq!(Limits::new().within(&known), Limits::new().mixed_reads(false).max_registers(32)?);
    /// # Ok::<(), fatek::plan::PlanError>(())
    /// ```
    #[must_use]
    pub fn within(self, capabilities: &Capabilities) -> Self {
        let or_any = |max: Option<usize>| max.unwrap_or(usize::MAX);
        let mixed = if capabilities.lacks(Code::ReadMixed) { 0 } else { or_any(capabilities.max_mixed()) };
        let limits = self
            .at_most(or_any(capabilities.max_registers()), or_any(capabilities.max_points()), mixed)
            .without_words(capabilities.refused_words());
        if capabilities.has_words_at_16() { limits.words_at_multiples_of_16(true) } else { limits }
    }

    /// Lowers the maximum of registers, discretes and units of a mixed read to learned limits.
    ///
    /// 0 units exclude mixed reads.
    pub(crate) fn at_most(self, registers: usize, points: usize, mixed: usize) -> Self {
        Self {
            max_registers: self.max_registers.min(registers.max(2)),
            max_points: self.max_points.min(points.max(1)),
            max_mixed: self.max_mixed.min(mixed),
            ..self
        }
    }

    /// Excludes words of the discretes of these areas.
    pub(crate) fn without_words(self, areas: WordAreas) -> Self {
        Self { word_areas: self.word_areas.without(areas), ..self }
    }

    /// Returns whether discretes with this symbol may be read as words.
    pub(super) fn has_words_of(&self, discrete: Symbol) -> bool {
        self.word_areas.contains(discrete)
    }

    /// Returns whether discretes may be read as words at addresses with this residue modulo 16.
    pub(super) fn allows_words_at(&self, residue: u16) -> bool {
        residue.is_multiple_of(self.word_alignment)
    }

    /// Returns whether the word at this address may be read for discretes with this symbol.
    pub(super) fn allows_word(&self, discrete: Symbol, address: u16, framing: Framing) -> bool {
        let word = discrete.area().word();
        self.has_words_of(discrete)
            && address <= word.last_address_in(framing)
            && (self.has_no_ranges() || self.allows_word_gap(discrete, address, address + (WORD_BITS - 1)))
            && self.segment(word, address).is_some()
            // A word that overlaps the other one.
            && !self.avoids_any(word, address.saturating_sub(WORD_BITS - 1), address.saturating_add(WORD_BITS - 1))
    }

    /// Returns whether the discretes from `first` to `last` may be read although no tag has them.
    pub(super) fn allows_word_gap(&self, discrete: Symbol, first: u16, last: u16) -> bool {
        let segment = self.segment(discrete, first);
        segment.is_some()
            && segment == self.segment(discrete, last)
            && !self.avoids_any(discrete, first, last)
            && !(first < last && self.must_split_within(discrete, first + 1, last))
    }

    /// Returns the maximum of units in a run of elements of this width.
    pub(super) fn units(&self, width: Width) -> u32 {
        as_u32(if width == Width::Bit { self.max_points } else { self.max_registers })
    }

    /// Returns the maximum of units in a mixed read; 0 without mixed reads.
    pub(super) fn mixed_units(&self) -> u32 {
        as_u32(self.max_mixed)
    }

    /// Returns the maxima of registers, of discretes, and of units of a mixed read.
    #[cfg(feature = "serde")]
    pub(crate) fn maxima(&self) -> [usize; 3] {
        [self.max_registers, self.max_points, self.max_mixed]
    }

    /// Returns the areas whose discretes are read as words, and whether only at multiples of 16.
    #[cfg(feature = "serde")]
    pub(crate) fn words(&self) -> (WordAreas, bool) {
        (self.word_areas, self.word_alignment == WORD_BITS)
    }

    /// Returns the readable ranges and those to avoid, by symbol and both addresses.
    #[cfg(feature = "serde")]
    pub(crate) fn ranges(&self) -> [Vec<(Symbol, u16, u16)>; 2] {
        [&self.readable, &self.avoided]
            .map(|Ranges(ranges)| ranges.iter().map(|range| (range.symbol, range.first, range.last)).collect())
    }

    /// Returns the index of the readable range with this address; `None` if it is not readable.
    pub(crate) fn segment(&self, symbol: Symbol, address: u16) -> Option<u32> {
        let ranges = self.readable.for_symbol(symbol);
        if ranges.is_empty() {
            return Some(0);
        }
        let n = ranges.partition_point(|range| range.first <= address).checked_sub(1)?;
        ranges.get(n).filter(|range| address <= range.last)?;
        u32::try_from(n).ok()
    }

    /// Returns whether an address from `first` to `last` inclusive is to be avoided.
    pub(super) fn avoids_any(&self, symbol: Symbol, first: u16, last: u16) -> bool {
        let ranges = self.avoided.for_symbol(symbol);
        let before = ranges.partition_point(|range| range.first <= last);
        before.checked_sub(1).and_then(|n| ranges.get(n)).is_some_and(|range| first <= range.last)
    }

    /// Returns whether there is a split point before an address from `first` to `last` inclusive.
    pub(super) fn must_split_within(&self, symbol: Symbol, first: u16, last: u16) -> bool {
        let at = self.split_points.partition_point(|split| *split < (symbol, first));
        self.split_points.get(at).is_some_and(|split| *split <= (symbol, last))
    }

    /// Returns whether there are no readable ranges, nothing to avoid and no split points.
    pub(super) fn has_no_ranges(&self) -> bool {
        self.readable.0.is_empty() && self.avoided.0.is_empty() && self.split_points.is_empty()
    }
}

impl Range {
    fn new(first: Element, last: Element) -> Result<Self, PlanError> {
        let has_cells = |end: Element| end.width() != Width::DWord || end.is_counter_of_32_bits();
        if last.symbol() != first.symbol() || first.address() > last.address() || !has_cells(first) || !has_cells(last)
        {
            return Err(PlanError::Range { first, last });
        }
        Ok(Self { symbol: first.symbol().halved(), first: first.address(), last: last.address() })
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

    fn for_symbol(&self, symbol: Symbol) -> &[Range] {
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

/// The number of discretes in a word.
pub(super) const WORD_BITS: u16 = 16;

/// A limit, which is at most that of the protocol.
fn as_u32(limit: usize) -> u32 {
    debug_assert!(limit <= MAX_POINTS);
    u32::try_from(limit).unwrap_or(u32::MAX)
}

/// Checks a setting against its range.
pub(crate) fn check_range(name: &'static str, given: usize, min: usize, max: usize) -> Result<usize, PlanError> {
    if (min..=max).contains(&given) { Ok(given) } else { Err(PlanError::Limit { name, given, min, max }) }
}
