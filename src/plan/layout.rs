//! Elements as cells: consecutive elements of an area have consecutive cell numbers.

use std::cmp::Reverse;

use super::ReadRequest;
use super::cost::CostModel;
use super::limits::{Limits, WORD_BITS};
use super::words;
use crate::command::{Code, InvalidRequest, ReadDiscretes, ReadMixed, ReadRegisters};
use crate::element::{Discrete, Element, Register, Register32, Symbol, Width};

/// The cells that a run can contain: one symbol, one readable range, addresses one step apart.
///
/// A cell is the smallest part that can be read: 16 bits for `R` and `DR` alike. Counters of 32
/// bits, `DRC200` to `DRC255`, have cells of 32 bits, and a run has one of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Area {
    symbol: Symbol,
    segment: u32,
    /// The address modulo the step: `WM0` and `WM8` are not in one run.
    residue: u16,
    /// The first address of the elements that are consecutive: `RC199` and `RC256` are not in one
    /// run, because counters of 32 bits are between them.
    stretch: u16,
}

/// Consecutive cells of an area.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Cells {
    pub(super) area: Area,
    pub(super) first: u32,
    pub(super) len: u32,
}

impl Area {
    pub(super) fn symbol(self) -> Symbol {
        self.symbol
    }

    pub(super) fn residue(self) -> u16 {
        self.residue
    }

    pub(super) fn width(self) -> Width {
        self.symbol.width()
    }

    /// Returns the units that a cell counts against a limit.
    pub(super) fn units(self) -> u32 {
        if self.width() == Width::DWord { 2 } else { 1 }
    }

    /// Returns the number of 16-bit words of a cell in [`ReplyWords`](super::ReplyWords).
    pub(super) fn words(self) -> u32 {
        self.units()
    }

    /// Returns the symbol that reads two cells as one element in a mixed read.
    pub(super) fn dword(self) -> Option<Symbol> {
        let area = self.symbol.area();
        (self.width() == Width::Word).then(|| area.dword())
    }

    /// Returns the maximum of cells in a run.
    pub(super) fn max_run(self, limits: &Limits) -> u32 {
        if self.has_counters_of_32_bits() { 1 } else { limits.units(self.width()) / self.units() }
    }

    /// Returns whether its cells have 32 bits. All other elements of 32 bits are two cells.
    fn has_counters_of_32_bits(self) -> bool {
        self.width() == Width::DWord
    }

    /// Returns the symbol of the discretes in its words; `None` for other areas.
    pub(super) fn discrete(self) -> Option<Symbol> {
        let smallest = self.symbol.area().smallest();
        (self.width() == Width::Word && smallest.width() == Width::Bit).then_some(smallest)
    }

    fn element(self, symbol: Symbol, cell: u32) -> Result<Element, InvalidRequest> {
        Ok(Element::new(symbol, self.address(cell))?)
    }

    fn address(self, cell: u32) -> u16 {
        let address = cell * u32::from(self.step()) + u32::from(self.residue);
        debug_assert!(u16::try_from(address).is_ok(), "the cell of an element that exists");
        u16::try_from(address).unwrap_or(u16::MAX)
    }

    /// Returns the distance between the addresses of two cells.
    fn step(self) -> u16 {
        if self.has_counters_of_32_bits() { 1 } else { self.symbol.step() }
    }

    /// Returns the symbol by which [`Limits`] lists the area: a range of `RC` applies to `DRC` too.
    fn listed(self) -> Symbol {
        self.symbol.halved()
    }
}

impl Cells {
    /// Returns the cells of consecutive elements; `None` if they are not readable.
    pub(super) fn of(first: Element, elements: usize, limits: &Limits) -> Option<Self> {
        let (symbol, per_element) = cell_symbol(first);
        let [stretch, _] = first.symbol().consecutive(first.address());
        let area = Area { symbol, segment: 0, residue: 0, stretch };
        let step = area.step();
        let area = Area { residue: first.address() % step, ..area };
        let listed = area.listed();
        let segment = limits.segment(listed, first.address())?;
        let cells = Self {
            area: Area { segment, ..area },
            first: u32::from(first.address() / step),
            len: u32::try_from(elements).ok()? * per_element,
        };
        let last = cells.area.element(symbol, cells.end() - 1).ok()?;
        (limits.segment(listed, last.address()) == Some(segment)).then_some(cells)
    }

    pub(super) fn end(self) -> u32 {
        self.first + self.len
    }

    pub(super) fn key(self) -> (Area, u32, Reverse<u32>) {
        (self.area, self.first, Reverse(self.len))
    }

    /// Returns whether no run may read these cells and `next`, which begins at the same cell or
    /// later.
    ///
    /// The reason is a gap to avoid between them, or a split point. Cells with a split point within
    /// are read alone.
    pub(super) fn must_split_from(self, next: Self, limits: &Limits) -> bool {
        let address = |cell: u32| self.area.address(cell);
        let listed = self.area.listed();
        let has_gap = next.first > self.end();
        let gap = has_gap && limits.avoids_any(listed, address(self.end()), address(next.first - 1));
        let end = self.end().max(next.end());
        let split = |symbol, first, last| first <= last && limits.must_split_within(symbol, first, last);
        if gap || (end > self.first + 1 && split(listed, address(self.first + 1), address(end - 1))) {
            return true;
        }
        // Words have discretes in them, whose limits apply to the gap as well.
        let Some(discrete) = self.area.discrete() else { return false };
        let (first, last) = (self.address_of_bit(self.first, 0), self.address_of_bit(end - 1, WORD_BITS - 1));
        // Without a gap, there may be no cell behind these.
        let avoids_gap =
            || !limits.allows_word_gap(discrete, self.address_of_bit(self.end(), 0), address(next.first) - 1);
        (has_gap && avoids_gap()) || split(discrete, first.saturating_add(1), last)
    }

    /// Returns the address of a discrete in a word.
    fn address_of_bit(self, cell: u32, bit: u16) -> u16 {
        self.area.address(cell).saturating_add(bit)
    }

    /// Returns the cell with this address, which is one of its own.
    pub(super) fn at(self, address: u16) -> Self {
        Self { first: u32::from(address / self.area.step()), len: 1, ..self }
    }

    /// Returns the addresses of its cells.
    pub(super) fn addresses(self) -> impl Iterator<Item = u16> {
        (self.first..self.end()).map(move |cell| self.area.address(cell))
    }

    /// Returns the position of a discrete in these words: the cell and the bit. `None` if it is not
    /// in them.
    pub(super) fn find_bit(self, discrete: Self) -> Option<(u32, u8)> {
        if self.area.discrete()? != discrete.area.symbol {
            return None;
        }
        let from_first = discrete.first.checked_sub(u32::from(self.area.address(self.first)))?;
        let cell = self.first + from_first / u32::from(WORD_BITS);
        let bit = u8::try_from(from_first % u32::from(WORD_BITS)).ok()?;
        (cell < self.end()).then_some((cell, bit))
    }

    /// Returns whether a high byte of its addresses is a letter, which the binary framing may take for a
    /// part of the symbol.
    pub(super) fn may_be_read_otherwise(self) -> bool {
        self.addresses().any(|address| address.to_be_bytes()[0].is_ascii_uppercase())
    }

    /// Divides it into elements of two cells, and one of one cell at the end.
    fn pairs(self) -> impl Iterator<Item = Self> {
        let pair = if self.area.dword().is_some() { 2 } else { 1 };
        let starts = (self.first..self.end()).step_by(pair as usize);
        starts.map(move |first| Self { first, len: pair.min(self.end() - first), ..self })
    }

    /// Returns whether it contains all cells of `other`.
    pub(super) fn contains(self, other: Self) -> bool {
        self.area == other.area && self.first <= other.first && other.end() <= self.end()
    }
}

/// Returns whether no run may read all of these cells, which are sorted and of one area.
fn must_split(cells: &[Cells], limits: &Limits) -> bool {
    if limits.has_no_ranges() {
        return false;
    }
    let Some((first, rest)) = cells.split_first() else { return false };
    let mut before = *first;
    rest.iter().any(|next| {
        let must_split = before.must_split_from(*next, limits);
        before.len = before.end().max(next.end()) - before.first;
        must_split
    })
}

/// Returns the symbol of the cells of an element, and their number.
fn cell_symbol(element: Element) -> (Symbol, u32) {
    let symbol = element.symbol();
    match element.width() {
        Width::DWord if !element.is_counter_of_32_bits() => (symbol.halved(), 2),
        Width::Bit | Width::Word | Width::DWord => (symbol, 1),
    }
}

/// Merges cells that are adjacent or overlap. The input is sorted.
fn stretches(cells: &[Cells]) -> Vec<Cells> {
    let mut stretches: Vec<Cells> = Vec::new();
    for next in cells {
        match stretches.last_mut() {
            Some(last) if last.area == next.area && next.first <= last.end() => {
                last.len = last.end().max(next.end()) - last.first;
            }
            Some(_) | None => stretches.push(*next),
        }
    }
    stretches
}

/// Returns the units of a mixed read of these cells, which are sorted.
pub(super) fn mixed_units(cells: &[Cells]) -> u32 {
    stretches(cells).iter().map(|stretch| stretch.len * stretch.area.units()).sum()
}

/// Returns a lower bound of the bytes of these cells in replies. The cells are sorted.
pub(super) fn least_value_bytes(cells: &[Cells], limits: &Limits, cost: &CostModel) -> usize {
    let as_word = |stretch: &Cells| stretch.area.width() == Width::Bit && limits.has_words_of(stretch.area.symbol);
    let bytes = |s: Cells| usize::try_from(s.len).unwrap_or(usize::MAX) * cost.value_bytes(s.area.width());
    let (discretes, others): (Vec<Cells>, Vec<Cells>) = stretches(cells).into_iter().partition(as_word);
    others.into_iter().map(bytes).sum::<usize>() + words::least_value_bytes(&discretes, cells, cost)
}

/// A request in terms of cells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Draft {
    /// A run, 44 or 46.
    Run(Cells),
    /// A mixed read, 48: elements of one or two cells. Stretches of neighbours are sorted, the first or
    /// the last one first.
    Mixed(Vec<Cells>),
}

impl Draft {
    /// Returns the run that contains all of these cells, if there is one. They are sorted.
    pub(super) fn run(cells: &[Cells], limits: &Limits) -> Option<Self> {
        let (first, last) = (cells.first()?, cells.last()?);
        let end = cells.iter().map(|cells| cells.end()).max()?;
        let run = Cells { len: end - first.first, ..*first };
        let fits = first.area == last.area && run.len <= run.area.max_run(limits);
        (fits && !must_split(cells, limits)).then_some(Self::Run(run))
    }

    /// Returns the cheapest mixed read of these cells, if there is one. They are sorted.
    ///
    /// Discretes are read as words where that is shorter, or where they would be too many.
    pub(super) fn mixed(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Self> {
        let with_words = words::cover(cells, limits, cost);
        let with_words = with_words.and_then(|cells| Self::mixed_of(&cells, limits, cost));
        with_words.or_else(|| Self::mixed_of(cells, limits, cost))
    }

    /// Returns the mixed read of exactly these cells, if there is one. They are sorted.
    ///
    /// Neighbours are read in pairs: `DR0` is shorter than `R0 R1`. If the list is ambiguous in the
    /// binary framing, the last stretch of neighbours comes first.
    pub(super) fn mixed_of(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Self> {
        if mixed_units(cells) > limits.mixed_units() {
            return None;
        }
        let in_order = |stretches: &mut dyn Iterator<Item = Cells>| {
            let draft = Self::Mixed(stretches.flat_map(Cells::pairs).collect());
            draft.request().is_ok_and(|request| request.check(cost.framing()).is_ok()).then_some(draft)
        };
        let stretches = stretches(cells);
        in_order(&mut stretches.iter().copied()).or_else(|| in_order(&mut stretches.iter().rev().copied()))
    }

    /// Returns a request of each kind for all of these cells, which are sorted: the runs, and for each
    /// length of the reply the cheapest mixed read.
    pub(super) fn options(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Self> {
        let run = Self::run(cells, limits);
        let words = words::runs(cells, limits, cost.framing());
        let mut options: Vec<Self> = [run].into_iter().chain(words).flatten().collect();
        let mut lengths = Vec::new();
        for choice in words::choices(cells, limits, cost) {
            if let Some(draft) = Self::mixed_of(&choice, limits, cost) {
                let (_, reply) = draft.bytes(cost);
                if !lengths.contains(&reply) {
                    lengths.push(reply);
                    options.push(draft);
                }
            }
        }
        options
    }

    /// Returns the cheapest request for all of these cells, which are sorted.
    pub(super) fn cheapest(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Self> {
        let run = Self::run(cells, limits);
        let words = words::runs(cells, limits, cost.framing());
        let mixed = Self::mixed(cells, limits, cost);
        [run].into_iter().chain(words).chain([mixed]).flatten().min_by_key(|draft| draft.cost(cost))
    }

    /// Returns the command.
    pub(super) fn code(&self) -> Code {
        match self {
            Self::Run(run) if run.area.width() == Width::Bit => Code::ReadDiscretes,
            Self::Run(_) => Code::ReadRegisters,
            Self::Mixed(_) => Code::ReadMixed,
        }
    }

    /// Returns the units of a run; `None` for a mixed read.
    pub(super) fn run_units(&self) -> Option<u32> {
        match self {
            Self::Run(run) => Some(run.len * run.area.units()),
            Self::Mixed(_) => None,
        }
    }

    /// Returns the cost of request and reply in nanoseconds.
    pub(super) fn cost(&self, cost: &CostModel) -> u64 {
        let (request, reply) = self.bytes(cost);
        cost.cost(request + reply)
    }

    /// Returns the length of the request and of its reply in bytes.
    pub(super) fn bytes(&self, cost: &CostModel) -> (usize, usize) {
        let (mut request, mut reply) = (cost.request_bytes(), cost.reply_bytes());
        match self {
            Self::Run(run) => {
                request += cost.element_bytes(run.area.symbol);
                reply += usize::try_from(run.len).unwrap_or(usize::MAX) * cost.value_bytes(run.area.width());
            }
            Self::Mixed(items) => {
                for item in items {
                    let symbol = item_symbol(*item);
                    request += cost.element_bytes(symbol);
                    reply += cost.value_bytes(symbol.width());
                }
            }
        }
        (request, reply)
    }

    pub(super) fn request(&self) -> Result<ReadRequest, InvalidRequest> {
        match self {
            Self::Run(run) => {
                let first = run.area.element(run.area.symbol, run.first)?;
                let count = usize::try_from(run.len).unwrap_or(usize::MAX);
                Ok(match run.area.width() {
                    Width::Bit => ReadRequest::Discretes(ReadDiscretes::new(Discrete::try_from(first)?, count)?),
                    Width::Word => ReadRequest::Registers(ReadRegisters::new(Register::try_from(first)?, count)?),
                    Width::DWord => ReadRequest::Registers32(ReadRegisters::new(Register32::try_from(first)?, count)?),
                })
            }
            Self::Mixed(items) => {
                let elements = items.iter().map(|item| item.area.element(item_symbol(*item), item.first));
                Ok(ReadRequest::Mixed(ReadMixed::new(elements.collect::<Result<Vec<_>, _>>()?)?))
            }
        }
    }

    /// Returns the first word of these cells in the reply, and the bit of a discrete that is read
    /// as part of a word; `None` if the reply does not have all of them, one behind the other.
    ///
    /// `words_before` is that of [`words_before`](Self::words_before).
    pub(super) fn find(&self, cells: Cells, words_before: &[u32]) -> Option<(u32, Option<u8>)> {
        match self {
            Self::Run(run) if run.contains(cells) => Some(((cells.first - run.first) * run.area.words(), None)),
            Self::Run(run) => run.find_bit(cells).map(|(cell, bit)| (cell - run.first, Some(bit))),
            Self::Mixed(items) => {
                let key = |item: &Cells| (item.area, item.first);
                let is_reversed = matches!(items.as_slice(), [first, .., last] if key(last) < key(first));
                let at = match is_reversed {
                    false => items.partition_point(|item| key(item) <= key(&cells)).checked_sub(1),
                    true => items.iter().position(|item| item.contains(Cells { len: 1, ..cells })),
                };
                let held = at.and_then(|n| Some((items.get(n)?, words_before.get(n)?)));
                let held = held.filter(|(item, _)| item.area == cells.area && cells.first < item.end());
                if let Some((item, before)) = held {
                    // Neighbours of one stretch follow in the list.
                    let mut end = item.first;
                    for next in items.get(at?..)?.iter().take_while(|next| next.area == cells.area) {
                        if next.first != end || end >= cells.end() {
                            break;
                        }
                        end = next.end();
                    }
                    let is_whole = end >= cells.end();
                    return is_whole.then(|| (before + (cells.first - item.first) * item.area.words(), None));
                }
                items.iter().zip(words_before).find_map(|(item, before)| {
                    let (cell, bit) = item.find_bit(cells)?;
                    Some((before + cell - item.first, Some(bit)))
                })
            }
        }
    }

    /// Returns the units of a mixed read; 0 for a run.
    pub(super) fn mixed_units(&self) -> u32 {
        match self {
            Self::Run(_) => 0,
            Self::Mixed(items) => items.iter().map(|item| item.len * item.area.units()).sum(),
        }
    }

    /// Returns, for each element of a mixed read, the number of words before it; empty for a run.
    pub(super) fn words_before(&self) -> Vec<u32> {
        let Self::Mixed(items) = self else { return Vec::new() };
        let mut before = 0;
        let count = |item: &Cells| {
            let here = before;
            before += item.len * item.area.words();
            here
        };
        items.iter().map(count).collect()
    }
}

/// The cost of an element of one cell, and of one of two cells, in a mixed read.
#[derive(Clone, Copy, Debug)]
pub(super) struct ItemCost {
    single: u64,
    double: u64,
}

impl ItemCost {
    pub(super) fn new(area: Area, cost: &CostModel) -> Self {
        let item = |symbol: Symbol| cost.bytes_cost(cost.element_bytes(symbol) + cost.value_bytes(symbol.width()));
        let single = item(area.symbol);
        Self { single, double: area.dword().map_or(2 * single, item) }
    }

    /// Returns the cost of cells added to a stretch that has an odd or an even number of cells.
    pub(super) fn cost(self, cells: u32, odd: bool) -> u64 {
        // The last cell of an odd stretch was counted as a single and becomes part of a pair.
        let cells = u64::from(cells) + u64::from(odd);
        let all = cells / 2 * self.double + cells % 2 * self.single;
        if odd { all - self.single } else { all }
    }
}

fn item_symbol(item: Cells) -> Symbol {
    match (item.len, item.area.dword()) {
        (2, Some(dword)) => dword,
        _ => item.area.symbol,
    }
}
