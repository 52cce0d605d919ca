//! Discretes read as bits of words: `WM0` is M0 to M15.
//!
//! Words begin at multiples of 8, so each discrete is in two words that overlap. Discretes are
//! counted here in octets, the eight addresses between two multiples of 8; a word has two octets.

use std::collections::BTreeMap;

use super::cost::CostModel;
use super::layout::{self, Cells, Draft};
use super::limits::{Limits, WORD_BITS};
use crate::element::{Element, Symbol, Width};
use crate::wire::Framing;

/// Areas of discretes.
///
/// T and C are not among them: whether a PLC has words of their states is not known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct WordAreas(u8);

impl WordAreas {
    pub(crate) const SYMBOLS: [Symbol; 4] = [Symbol::X, Symbol::Y, Symbol::M, Symbol::S];

    pub(crate) fn all() -> Self {
        Self((1 << Self::SYMBOLS.len()) - 1)
    }

    pub(crate) fn is_empty(self) -> bool {
        self.0 == 0
    }

    pub(crate) fn contains(self, discrete: Symbol) -> bool {
        self.0 & Self::mask(discrete) != 0
    }

    pub(crate) fn contains_all(self, areas: Self) -> bool {
        self.0 & areas.0 == areas.0
    }

    /// Adds an area; symbols without words have no effect.
    pub(super) fn insert(&mut self, discrete: Symbol) {
        self.0 |= Self::mask(discrete);
    }

    /// The area of the discretes with this symbol; none for symbols without words.
    pub(crate) fn of(discrete: Symbol) -> Self {
        Self(Self::mask(discrete))
    }

    /// These areas and others.
    #[must_use]
    pub(crate) fn and(self, areas: Self) -> Self {
        Self(self.0 | areas.0)
    }

    /// The areas that are in both.
    #[must_use]
    pub(crate) fn common(self, areas: Self) -> Self {
        Self(self.0 & areas.0)
    }

    #[must_use]
    pub(crate) fn without(self, areas: Self) -> Self {
        Self(self.0 & !areas.0)
    }

    fn mask(discrete: Symbol) -> u8 {
        Self::SYMBOLS.iter().position(|symbol| *symbol == discrete).map_or(0, |n| 1 << n)
    }
}

/// The number of discretes in an octet.
pub(super) const OCTET: u16 = 8;

/// Returns the word that begins at this address; `None` if it must not be read for discretes.
pub(super) fn word_at(discrete: Symbol, address: u16, limits: &Limits, framing: Framing) -> Option<Cells> {
    if !limits.allows_word(discrete, address, framing) {
        return None;
    }
    Cells::of(Element::new(discrete.area().word(), address).ok()?, 1, limits)
}

/// Returns the address of the word with a discrete at `address`, for words with this residue
/// modulo 16.
pub(super) fn word_address(address: u16, residue: u16) -> Option<u16> {
    Some(address.checked_sub(residue)? / WORD_BITS * WORD_BITS + residue)
}

/// The residues modulo 16 of the addresses of words that may be read for discretes.
pub(super) fn residues(limits: &Limits) -> impl Iterator<Item = u16> {
    [0, OCTET].into_iter().filter(|residue| limits.allows_words_at(*residue))
}

/// Returns whether the cells are discretes that may be read as words.
pub(super) fn has_words(cells: &Cells, limits: &Limits) -> bool {
    cells.area.width() == Width::Bit && limits.has_words_of(cells.area.symbol())
}

/// Returns the runs of words that contain discretes, and words of the same area among them.
///
/// The run that ends first comes first: of two equally long runs, it reads fewer discretes behind
/// the last one.
pub(super) fn runs(cells: &[Cells], limits: &Limits, framing: Framing) -> [Option<Draft>; 2] {
    let Some(symbol) = cells.iter().find(|cells| has_words(cells, limits)).map(|cells| cells.area.symbol()) else {
        return [None, None];
    };
    let bounds = |cells: &Cells| {
        let discretes = cells.area.symbol() == symbol || cells.area.discrete() == Some(symbol);
        discretes.then(|| cells.addresses().next()).flatten()
    };
    let Some(first) = cells.iter().map(bounds).try_fold(u16::MAX, |least, first| Some(least.min(first?))) else {
        return [None, None];
    };
    let last = cells.iter().filter_map(bounds).max().unwrap_or(first);
    if u32::from(last - first) / u32::from(WORD_BITS) > limits.units(Width::Word) {
        return [None, None];
    }
    let mut runs = [None, None];
    for (run, residue) in runs.iter_mut().zip(residues(limits)) {
        *run = run_at(cells, symbol, residue, limits, framing);
    }
    let [a, b] = &runs;
    if let (Some(Draft::Run(a)), Some(Draft::Run(b))) = (a, b)
        && b.addresses().last() < a.addresses().last()
    {
        runs.reverse();
    }
    runs
}

fn run_at(cells: &[Cells], symbol: Symbol, residue: u16, limits: &Limits, framing: Framing) -> Option<Draft> {
    let (discretes, tags): (Vec<Cells>, Vec<Cells>) = cells.iter().partition(|cells| cells.area.symbol() == symbol);
    let mut words = tags.clone();
    for discrete in discretes.iter().flat_map(|cells| cells.addresses().map(|address| cells.at(address))) {
        let contains = |word: &Cells| word.find_bit(discrete).is_some();
        if !words.last().is_some_and(contains) && !tags.iter().any(contains) {
            let address = word_address(discrete.addresses().next()?, residue)?;
            words.push(word_at(symbol, address, limits, framing)?);
        }
    }
    words.sort_unstable_by_key(|word| word.key());
    Draft::run(&words, limits)
}

/// Returns the cells of the cheapest mixed read of these cells, with discretes in words where that
/// is cheaper; `None` without such discretes, or if there are too many units. The cells are sorted.
///
/// Exact: of all choices of words, the result has the fewest bytes.
pub(super) fn cover(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Vec<Cells>> {
    let covers = covers(cells, limits, cost, limits.mixed_units(), Kept::Cheapest)?;
    let cheapest = covers.into_iter().min_by_key(|cover| (cover.bytes, cover.units))?;
    apply(cells, cheapest, limits, cost)
}

/// Returns the cells of mixed reads of these cells, with and without discretes in words, the one with
/// the fewest bytes first. The cells are sorted.
///
/// Up to [`MAX_EACH`] discretes, there is a choice for each length of the reply, and no choice of words
/// with that length has fewer bytes.
pub(super) fn choices(cells: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Vec<Cells>> {
    let discretes: u32 = cells.iter().filter(|cells| has_words(cells, limits)).map(|cells| cells.len).sum();
    let kept = if discretes <= MAX_EACH { Kept::EachLength } else { Kept::Cheapest };
    let mut covers = covers(cells, limits, cost, limits.mixed_units(), kept).unwrap_or_default();
    covers.sort_by_key(|cover| (cover.bytes, cover.units));
    let with_words = covers.into_iter().filter_map(|cover| apply(cells, cover, limits, cost));
    with_words.chain([cells.to_vec()]).collect()
}

/// The maximum number of discretes for which a choice of words is kept for each length of a reply.
const MAX_EACH: u32 = 16;

/// The choices of words that are kept.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kept {
    /// The cheapest for each number of units.
    Cheapest,
    /// The cheapest for each number of units and each length of the reply.
    EachLength,
}

/// Returns the fewest units of a mixed read of these cells. They are sorted.
pub(super) fn fewest_units(cells: &[Cells], limits: &Limits, cost: &CostModel) -> u32 {
    let covers = covers(cells, limits, cost, u32::MAX, Kept::Cheapest).unwrap_or_default();
    covers.iter().map(|cover| cover.units).min().unwrap_or(layout::mixed_units(cells))
}

/// Returns the choices of words for a mixed read of at most `max` units.
fn covers(cells: &[Cells], limits: &Limits, cost: &CostModel, max: u32, kept: Kept) -> Option<Vec<Cover>> {
    if !cells.iter().any(|cells| has_words(cells, limits)) {
        return None;
    }
    let mut areas: BTreeMap<Symbol, OctetMap> = BTreeMap::new();
    for cells in cells.iter().filter(|cells| has_words(cells, limits)) {
        let area = areas.entry(cells.area.symbol()).or_default();
        cells.addresses().for_each(|address| area.add_discrete(address));
    }
    let mut others = Vec::with_capacity(cells.len());
    for cells in cells.iter().filter(|cells| !has_words(cells, limits)) {
        if let Some(area) = cells.area.discrete().and_then(|symbol| areas.get_mut(&symbol)) {
            cells.addresses().for_each(|address| area.add_word(address));
        } else {
            others.push(*cells);
        }
    }
    let mut units = layout::mixed_units(&others);
    if areas.values().fold(units, |units, area| units.saturating_add(area.least_units())) > max {
        return None;
    }
    let prices = Prices::new(cost);
    let mut covers = vec![Cover { units, alone: 0, bytes: 0, words: Vec::new() }];
    for (symbol, area) in &areas {
        units = covers.iter().map(|cover| cover.units).min().unwrap_or(units);
        let allows = |octet: u16| {
            limits.allows_words_at(octet % 2 * OCTET) && limits.allows_word(*symbol, octet * OCTET, cost.framing())
        };
        // A mixed read has no double word over the edge of a readable range.
        let segment = |octet: u16| limits.segment(symbol.area().word(), octet * OCTET);
        let is_joined = |octet: u16| octet.checked_sub(2).is_some_and(|before| segment(before) == segment(octet));
        let here = area.covers(*symbol, (allows, is_joined), prices, max.saturating_sub(units), kept);
        let both = |a: &Cover, b: &Cover| Cover {
            units: a.units + b.units,
            alone: a.alone + b.alone,
            bytes: a.bytes + b.bytes,
            words: [a.words.as_slice(), &b.words].concat(),
        };
        covers = covers.iter().flat_map(|a| here.iter().map(|b| both(a, b))).collect();
        covers.retain(|cover| cover.units <= max);
        if kept == Kept::EachLength {
            covers.sort_by_key(|cover| (cover.units, cover.alone, cover.bytes));
            covers.dedup_by_key(|cover| (cover.units, cover.alone));
        }
    }
    Some(covers)
}

/// Replaces the discretes in words: those of the choice, and those among the cells.
fn apply(cells: &[Cells], cover: Cover, limits: &Limits, cost: &CostModel) -> Option<Vec<Cells>> {
    let mut words: Vec<Cells> = cells.iter().copied().filter(|cells| cells.area.discrete().is_some()).collect();
    for (symbol, octet) in cover.words {
        words.push(word_at(symbol, octet * OCTET, limits, cost.framing())?);
    }
    let mut in_words: BTreeMap<Symbol, Vec<u16>> = BTreeMap::new();
    for word in &words {
        if let Some(symbol) = word.area.discrete() {
            in_words.entry(symbol).or_default().extend(word.addresses());
        }
    }
    in_words.values_mut().for_each(|addresses| addresses.sort_unstable());
    let is_in_word = |cells: &Cells| {
        let Some(words) = in_words.get(&cells.area.symbol()) else { return false };
        cells.addresses().all(|address| {
            let next = words.partition_point(|word| *word <= address);
            next.checked_sub(1).and_then(|n| words.get(n)).is_some_and(|word| address - word < WORD_BITS)
        })
    };
    let mut chosen: Vec<Cells> = cells.iter().copied().filter(|cells| cells.area.discrete().is_none()).collect();
    chosen.retain(|cells| !(has_words(cells, limits) && is_in_word(cells)));
    chosen.extend(words);
    chosen.sort_unstable_by_key(|cells| cells.key());
    Some(chosen)
}

/// Returns a lower bound of the bytes of discretes in replies, as discretes or in words. `cells` are
/// all that are read.
pub(super) fn least_value_bytes(discretes: &[Cells], cells: &[Cells], cost: &CostModel) -> usize {
    let mut octets: BTreeMap<(Symbol, u16), usize> = BTreeMap::new();
    for stretch in discretes {
        for address in stretch.addresses() {
            *octets.entry((stretch.area.symbol(), address / OCTET)).or_default() += 1;
        }
    }
    let mut with_words: Vec<Symbol> = cells.iter().filter_map(|cells| cells.area.discrete()).collect();
    with_words.dedup();
    // A word has two octets. Words of tags may have discretes in them.
    let (bit, half) = (cost.value_bytes(Width::Bit), cost.value_bytes(Width::Word) / 2);
    let counted = octets.iter().filter(|((symbol, _), _)| !with_words.contains(symbol));
    counted.map(|(_, count)| (count * bit).min(half)).sum()
}

/// The bytes of the elements of a mixed read, in request and reply.
#[derive(Clone, Copy)]
struct Prices {
    discrete: usize,
    word: usize,
    /// A double word in place of two neighbouring words.
    dword: usize,
}

impl Prices {
    fn new(cost: &CostModel) -> Self {
        // All areas of discretes have symbols and addresses of one length.
        let item = |symbol: Symbol| cost.element_bytes(symbol) + cost.value_bytes(symbol.width());
        Self { discrete: item(Symbol::M), word: item(Symbol::WM), dword: item(Symbol::DWM) }
    }
}

/// A choice of words, and its units and bytes with the discretes that are in none of them.
struct Cover {
    units: u32,
    /// As in [`Choice`].
    alone: u32,
    bytes: usize,
    /// Area and first octet of each word that no tag has.
    words: Vec<(Symbol, u16)>,
}

/// The discretes of one area, and the words of it that are read in any case.
#[derive(Default)]
struct OctetMap {
    /// For each octet, the discretes in it as a bit mask, and whether a word begins there.
    octets: BTreeMap<u16, (u8, bool)>,
}

/// The words that begin in an octet, as the length of their stretch so far.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stretch {
    None,
    Odd,
    Even,
}

/// A choice of words in the octets so far.
#[derive(Clone, Copy)]
struct Choice {
    units: u32,
    /// The discretes that are in no word. They and the units determine the length of the reply.
    alone: u32,
    bytes: usize,
    /// The last octet in which a chosen word begins.
    reach: u16,
    /// The index of the last chosen word in the list of all of them.
    last: Option<usize>,
}

impl OctetMap {
    fn add_discrete(&mut self, address: u16) {
        self.octets.entry(address / OCTET).or_default().0 |= 1 << (address % OCTET);
    }

    fn add_word(&mut self, address: u16) {
        self.octets.entry(address / OCTET).or_default().1 = true;
    }

    /// A lower bound of the units.
    fn least_units(&self) -> u32 {
        let discretes = self.octets.values().filter(|(discretes, _)| *discretes != 0).count();
        let words = self.octets.values().filter(|(_, word)| *word).count();
        u32::try_from(words.max(discretes.div_ceil(2))).unwrap_or(u32::MAX)
    }

    /// Returns the choices of words without one that has more units and more bytes than another.
    ///
    /// A dynamic program over the octets. Its state is the stretch of words that begin in the last
    /// octet, and in the one before: neighbours of both residues modulo 16 form pairs.
    /// `allows`: the word that begins in this octet may be read; `is_joined`: as a double word with the
    /// one two octets before.
    fn covers(
        &self,
        symbol: Symbol,
        (allows, is_joined): (impl Fn(u16) -> bool, impl Fn(u16) -> bool),
        prices: Prices,
        max_units: u32,
        kept: Kept,
    ) -> Vec<Cover> {
        const STATES: [Stretch; 3] = [Stretch::None, Stretch::Odd, Stretch::Even];
        let mut octets: Vec<u16> = Vec::with_capacity(2 * self.octets.len());
        for (octet, (discretes, _)) in &self.octets {
            octets.extend((*discretes != 0).then(|| octet.checked_sub(1)).flatten());
            octets.push(*octet);
        }
        octets.sort_unstable();
        octets.dedup();

        // Indexed by the stretch of the last octet and of the one before.
        let mut choices: [Vec<Choice>; 9] = Default::default();
        choices[0].push(Choice { units: 0, alone: 0, bytes: 0, reach: 0, last: None });
        let mut chosen: Vec<(u16, Option<usize>)> = Vec::new();
        let mut before: Option<u16> = None;
        for octet in octets {
            let distance = before.map_or(u16::MAX, |before| octet - before);
            before = Some(octet);
            let (discretes, is_read) = self.octets.get(&octet).copied().unwrap_or_default();
            let may_read = is_read || allows(octet);
            let is_joined = is_joined(octet);
            let mut next: [Vec<Choice>; 9] = Default::default();
            for (state, choice) in choices.iter().enumerate().flat_map(|(n, list)| list.iter().map(move |c| (n, *c))) {
                let (last, second) = (STATES[state / 3], STATES[state % 3]);
                let (last, second) = match distance {
                    1 => (last, second),
                    2 => (Stretch::None, last),
                    _ => (Stretch::None, Stretch::None),
                };
                if may_read {
                    let (bytes, now) = match second {
                        Stretch::Odd if is_joined => (prices.dword - prices.word, Stretch::Even),
                        Stretch::None | Stretch::Odd | Stretch::Even => (prices.word, Stretch::Odd),
                    };
                    let mut with = Choice { units: choice.units + 1, bytes: choice.bytes + bytes, ..choice };
                    if !is_read {
                        with.reach = octet;
                        with.last = Some(chosen.len());
                        chosen.push((octet, choice.last));
                    }
                    add_choice(&mut next[now as usize * 3 + last as usize], with, max_units, kept);
                }
                if !is_read {
                    let alone = if last == Stretch::None { discretes.count_ones() } else { 0 };
                    let bytes = choice.bytes + prices.discrete * alone as usize;
                    let (units, alone) = (choice.units + alone, choice.alone + alone);
                    let without = Choice { units, alone, bytes, ..choice };
                    add_choice(&mut next[last as usize], without, max_units, kept);
                }
            }
            choices = next;
        }
        let mut best = Vec::new();
        choices.into_iter().flatten().for_each(|choice| add_choice(&mut best, choice, max_units, kept));
        let words = |mut at: Option<usize>| {
            std::iter::from_fn(|| {
                let (octet, before) = chosen.get(at?)?;
                at = *before;
                Some((symbol, *octet))
            })
            .collect()
        };
        best.into_iter()
            .map(|c| Cover { units: c.units, alone: c.alone, bytes: c.bytes, words: words(c.last) })
            .collect()
    }
}

/// Adds a choice unless another one has no more units and bytes.
fn add_choice(choices: &mut Vec<Choice>, new: Choice, max_units: u32, kept: Kept) {
    let length = |choice: &Choice| (choice.units, choice.alone);
    let is_comparable = |old: &Choice| kept == Kept::Cheapest || length(old) == length(&new);
    let is_worse = |old: &Choice| {
        is_comparable(old)
            && old.units <= new.units
            && old.bytes <= new.bytes
            && (old.units < new.units || old.bytes < new.bytes || old.reach <= new.reach)
    };
    if new.units > max_units || choices.iter().any(is_worse) {
        return;
    }
    choices.retain(|old| !is_comparable(old) || old.units < new.units || old.bytes < new.bytes);
    choices.push(new);
}
