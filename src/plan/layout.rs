//! Elements as cells: positions in an area, so that neighbours are neighbours in numbers.

use std::cmp::Reverse;

use super::ReadRequest;
use super::cost::CostModel;
use super::limits::Limits;
use crate::command::{InvalidRequest, ReadDiscretes, ReadMixed, ReadRegisters};
use crate::element::{Discrete, Element, Register, Register32, Symbol, Width};

/// Cells that one request can read in one go: of one symbol, in one readable range, at addresses one step apart.
///
/// The cell is the smallest part that can be read: 16 bits for `R` and `DR` alike. Only `DRC` stays as it is, because
/// some counters have 32 bits, which may not be two registers `RC`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Area {
    symbol: Symbol,
    segment: u32,
    /// What addresses leave after division by the step: `WM0` and `WM8` are not in one run.
    residue: u16,
}

/// Consecutive cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Cells {
    pub(super) area: Area,
    pub(super) first: u32,
    pub(super) len: u32,
}

impl Area {
    pub(super) fn width(self) -> Width {
        self.symbol.width()
    }

    /// What one cell counts against a limit.
    pub(super) fn units(self) -> u32 {
        if self.width() == Width::DWord { 2 } else { 1 }
    }

    /// How many 16-bit words a cell is kept in.
    pub(super) fn words(self) -> u32 {
        self.units()
    }

    /// The symbol that reads two cells as one element, in a mixed request.
    pub(super) fn dword(self) -> Option<Symbol> {
        let area = self.symbol.area();
        (self.width() == Width::Word && area.has_pairs()).then(|| area.dword())
    }

    /// The most cells in a run.
    pub(super) fn max_run(self, limits: &Limits) -> u32 {
        limits.units(self.width()) / self.units()
    }

    fn element(self, symbol: Symbol, cell: u32) -> Result<Element, InvalidRequest> {
        Ok(Element::new(symbol, self.address(cell))?)
    }

    fn address(self, cell: u32) -> u16 {
        let address = cell * u32::from(self.symbol.step()) + u32::from(self.residue);
        u16::try_from(address).unwrap_or(u16::MAX)
    }

    /// The symbol that the ranges of [`Limits`] name it by: a range of `RC` is one of `DRC` too.
    fn listed(self) -> Symbol {
        if self.width() == Width::DWord { self.symbol.area().word() } else { self.symbol }
    }
}

impl Cells {
    /// Where `elements` consecutive elements lie; `None` if a limit says that they cannot be read.
    pub(super) fn of(first: Element, elements: usize, limits: &Limits) -> Option<Self> {
        let per_element = u32::from(cell_symbol(first).1);
        let symbol = cell_symbol(first).0;
        let step = symbol.step();
        let area = Area { symbol, segment: 0, residue: first.address() % step };
        let listed = area.listed();
        let segment = limits.segment(listed, first.address())?;
        let cells = Self {
            area: Area { segment, ..area },
            first: u32::from(first.address() / step),
            len: u32::try_from(elements).ok()? * per_element,
        };
        let last = cells.area.element(symbol, cells.end() - 1).ok()?;
        let last = if symbol.width() == Width::DWord { last.address() + 1 } else { last.address() };
        (limits.segment(listed, last) == Some(segment)).then_some(cells)
    }

    pub(super) fn end(self) -> u32 {
        self.first + self.len
    }

    pub(super) fn key(self) -> (Area, u32, Reverse<u32>) {
        (self.area, self.first, Reverse(self.len))
    }

    /// Whether no run leads from these to others of the area that begin at the same cell or behind it: there is something
    /// between them that is to be avoided, or a place where runs must end. Cells with such a place within are read alone.
    pub(super) fn is_barred_from(self, next: Self, limits: &Limits) -> bool {
        let address = |cell: u32| self.area.address(cell);
        let listed = self.area.listed();
        let gap = next.first > self.end() && limits.avoids(listed, address(self.end()), address(next.first - 1));
        let end = self.end().max(next.end());
        gap || (end > self.first + 1 && limits.splits(listed, address(self.first + 1), address(end - 1)))
    }

    pub(super) fn hold(self, other: Self) -> bool {
        self.area == other.area && self.first <= other.first && other.end() <= self.end()
    }
}

/// Whether a run that holds these leads where it must not. They are sorted, and of one area.
fn is_barred(cells: &[Cells], limits: &Limits) -> bool {
    if limits.let_runs_be() {
        return false;
    }
    let Some((first, rest)) = cells.split_first() else { return false };
    let mut before = *first;
    rest.iter().any(|next| {
        let barred = before.is_barred_from(*next, limits);
        before.len = before.end().max(next.end()) - before.first;
        barred
    })
}

/// The symbol of the cells of an element, and how many of them it has.
fn cell_symbol(element: Element) -> (Symbol, u8) {
    match element {
        Element::Register32(e) if e.symbol().area().has_pairs() => (e.low().symbol(), 2),
        Element::Discrete(_) | Element::Register(_) | Element::Register32(_) => (element.symbol(), 1),
    }
}

/// Cells that touch or overlap, as one; they are sorted.
fn stretches(cells: &[Cells]) -> Vec<Cells> {
    let mut stretches: Vec<Cells> = Vec::new();
    for next in cells {
        match stretches.last_mut() {
            Some(last) if last.area == next.area && next.first <= last.end() => {
                last.len = last.end().max(next.end()) - last.first;
            }
            _ => stretches.push(*next),
        }
    }
    stretches
}

/// How many units a mixed request for these has. They are sorted.
pub(super) fn mixed_units(cells: &[Cells]) -> u32 {
    stretches(cells).iter().map(|stretch| stretch.len * stretch.area.units()).sum()
}

/// The bytes of the values of these in a reply, without those of anything else. They are sorted.
pub(super) fn value_bytes(cells: &[Cells], cost: &CostModel) -> usize {
    let bytes = |s: Cells| usize::try_from(s.len).unwrap_or(usize::MAX) * cost.value_bytes(s.area.width());
    stretches(cells).into_iter().map(bytes).sum()
}

/// A request, as cells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Draft {
    /// 44 or 46.
    Run(Cells),
    /// 48: elements of one or two cells, sorted.
    Mixed(Vec<Cells>),
}

impl Draft {
    /// The run that holds all of these, if there is one. They are sorted.
    pub(super) fn run(cells: &[Cells], limits: &Limits) -> Option<Self> {
        let (first, last) = (cells.first()?, cells.last()?);
        let end = cells.iter().map(|cells| cells.end()).max()?;
        let run = Cells { len: end - first.first, ..*first };
        let fits = first.area == last.area && run.len <= run.area.max_run(limits);
        (fits && !is_barred(cells, limits)).then_some(Self::Run(run))
    }

    /// The mixed request that holds all of these and nothing else, if there is one. They are sorted.
    ///
    /// Neighbours are read in pairs: `DR0` is shorter than `R0 R1`.
    pub(super) fn mixed(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Self> {
        if mixed_units(cells) > limits.mixed_units() {
            return None;
        }
        let mut items = Vec::with_capacity(cells.len());
        for stretch in stretches(cells) {
            let pair = if stretch.area.dword().is_some() { 2 } else { 1 };
            let mut first = stretch.first;
            while first < stretch.end() {
                let len = pair.min(stretch.end() - first);
                items.push(Cells { first, len, ..stretch });
                first += len;
            }
        }
        let draft = Self::Mixed(items);
        // In the binary framing, some lists have two readings.
        draft.request().ok()?.check(cost.framing()).ok()?;
        Some(draft)
    }

    /// The cheapest request for all of these. They are sorted.
    pub(super) fn cheapest(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Self> {
        let run = Self::run(cells, limits);
        let mixed = Self::mixed(cells, limits, cost);
        [run, mixed].into_iter().flatten().min_by_key(|draft| draft.cost(cost))
    }

    pub(super) fn cost(&self, cost: &CostModel) -> u64 {
        let (request, reply) = self.bytes(cost);
        cost.cost(request + reply)
    }

    /// The bytes of the request and of its reply.
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

    /// Where in the words of the reply these cells begin, and `None` if they are not in it.
    pub(super) fn find(&self, cells: Cells, words_before: &[u32]) -> Option<u32> {
        match self {
            Self::Run(run) => run.hold(cells).then(|| (cells.first - run.first) * run.area.words()),
            Self::Mixed(items) => {
                let after = items.partition_point(|item| (item.area, item.first) <= (cells.area, cells.first));
                let n = after.checked_sub(1)?;
                let (item, before) = (items.get(n)?, words_before.get(n)?);
                let held = item.area == cells.area && cells.first < item.end();
                held.then(|| before + (cells.first - item.first) * item.area.words())
            }
        }
    }

    /// For each element of a mixed request, how many words come before it.
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

/// What an element of a mixed request costs, alone and as the second of a pair.
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

    /// What so many cells more cost, at the end of a stretch that has an odd number of them, or an even one.
    pub(super) fn cost(self, cells: u32, odd: bool) -> u64 {
        // The odd one has been paid for alone, and finds its partner.
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
