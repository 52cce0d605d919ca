//! Chooses, among many discretes, those that are read as words.

use std::collections::VecDeque;

use super::super::cost::CostModel;
use super::super::layout::Cells;
use super::super::limits::{Limits, WORD_BITS};
use super::super::words::{self, OCTET};
use crate::element::Width;

/// The discretes of one area after the choice.
#[derive(Default)]
pub(super) struct ChosenWords {
    /// Discretes that are read as such, alone or by runs.
    pub(super) discretes: Vec<(usize, Cells)>,
    /// Words, each with the discretes that it is read for.
    pub(super) words: Vec<(Cells, Vec<usize>)>,
}

/// A word that contains a discrete.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    address: u16,
    residue: u16,
    cells: Cells,
    /// The word before it may be read too, as a double word with this one.
    has_pair: bool,
}

/// The words that may be read for a discrete, by their residue modulo 16.
pub(super) type Candidates = [Option<Candidate>; 2];

/// Returns the words that may be read for each value; none for values that are not discretes.
pub(super) fn candidates(values: &[(usize, Cells)], limits: &Limits, cost: &CostModel) -> Vec<Candidates> {
    let framing = cost.framing();
    let mut before: Option<Candidates> = None;
    let of_value = |(_, value): &(usize, Cells)| {
        if !words::has_words(value, limits) {
            return [None, None];
        }
        let bit = value.addresses().next().unwrap_or(0);
        let symbol = value.area.symbol();
        let mut here = [None, None];
        for residue in words::residues(limits) {
            let n = usize::from(residue / OCTET);
            // Neighbours are often in one word.
            let known = before.and_then(|before| before[n]);
            let known = known.filter(|known: &Candidate| known.cells.find_bit(*value).is_some());
            here[n] = known.or_else(|| {
                let address = words::word_address(bit, residue)?;
                let cells = words::word_at(symbol, address, limits, framing)?;
                let pair = address.checked_sub(WORD_BITS);
                let has_pair = pair.is_some_and(|pair| {
                    let words = symbol.area().word();
                    limits.allows_word(symbol, pair, framing)
                        && limits.segment(words, pair) == limits.segment(words, address)
                });
                Some(Candidate { address, residue, cells, has_pair })
            });
        }
        before = Some(here);
        here
    };
    values.iter().map(of_value).collect()
}

/// How a discrete, and those before it back to `from`, are read.
#[derive(Clone, Copy)]
enum ReadMode {
    /// By themselves: by a run, or one by a mixed read.
    Discretes { from: usize },
    /// By words with this residue modulo 16.
    Words { from: usize, residue: u16 },
}

/// The starts of runs that may continue, the cheapest first.
#[derive(Default)]
struct RunStarts {
    /// The cost of the discretes before the run less that of the cells before it, and the index of
    /// its first discrete.
    starts: VecDeque<(u64, usize)>,
    /// The cells of the last discrete.
    last: Option<Cells>,
}

impl RunStarts {
    /// Adds a run that starts with the discrete `index`, and removes those that cannot continue to
    /// its `cells`. Returns the cheapest one.
    fn advance(
        &mut self,
        (index, cells): (usize, Cells),
        key: u64,
        limits: &Limits,
        is_too_long: impl Fn(usize) -> bool,
    ) -> Option<(u64, usize)> {
        let before = self.last.replace(cells);
        let splits = |before: Cells| {
            before.area != cells.area || !limits.has_no_ranges() && before.must_split_from(cells, limits)
        };
        if before.is_none_or(splits) {
            self.starts.clear();
        }
        while self.starts.back().is_some_and(|(worse, _)| *worse >= key) {
            self.starts.pop_back();
        }
        self.starts.push_back((key, index));
        while self.starts.front().is_some_and(|(_, from)| is_too_long(*from)) {
            self.starts.pop_front();
        }
        self.starts.front().copied()
    }

    fn clear(&mut self) {
        self.starts.clear();
        self.last = None;
    }
}

/// Chooses words for the discretes of one area, which are sorted and distinct.
///
/// A dynamic program over the discretes: `costs[i]` is the cost of the first `i`. Runs of discretes
/// and of words are found as in [`solve_area`](super::solve_area); a mixed read has a discrete, a
/// word or a double word. `unit_price` is the price of a unit of a mixed read; `None`: no mixed
/// reads.
pub(super) fn choose_words(
    (values, candidates): (&[(usize, Cells)], &[Candidates]),
    unit_price: Option<u64>,
    limits: &Limits,
    cost: &CostModel,
) -> ChosenWords {
    let Some((_, first)) = values.first() else { return ChosenWords::default() };
    let symbol = first.area.symbol();
    let (word_symbol, dword_symbol) = (symbol.area().word(), symbol.area().dword());
    let run_cost =
        |symbol, bytes| cost.cost(cost.request_bytes() + cost.reply_bytes() + cost.element_bytes(symbol) + bytes);
    let (bit_run, word_run) = (run_cost(symbol, 0), run_cost(word_symbol, 0));
    let (per_bit, per_word) =
        (cost.bytes_cost(cost.value_bytes(Width::Bit)), cost.bytes_cost(cost.value_bytes(Width::Word)));
    let item = |symbol: crate::element::Symbol, units: u64, price: u64| {
        cost.bytes_cost(cost.element_bytes(symbol) + cost.value_bytes(symbol.width())) + units * price
    };
    let unit_price = unit_price.filter(|_| limits.mixed_units() > 0);
    let (max_bits, max_words) = (limits.units(Width::Bit), limits.units(Width::Word));
    let address = |index: usize| values.get(index).and_then(|(_, value)| value.addresses().next()).unwrap_or(0);
    let all = u64::from(values.last().map_or(first.first, |(_, last)| last.first) - first.first) + 1;

    let mut costs: Vec<u64> = vec![0];
    let mut modes: Vec<ReadMode> = Vec::with_capacity(values.len());
    let mut bit_starts = RunStarts::default();
    let mut word_starts = [RunStarts::default(), RunStarts::default()];
    for (i, (_, value)) in values.iter().enumerate() {
        let before = costs[i];
        let mut best = (u64::MAX, ReadMode::Discretes { from: i });
        let mut consider = |price: u64, mode: ReadMode| {
            if price < best.0 {
                best = (price, mode);
            }
        };
        let bits_to = |cell: u32| u64::from(cell - first.first) * per_bit;
        let too_long = |from: usize| value.end() - values[from].1.first > max_bits;
        let key = before + (all * per_bit - bits_to(value.first));
        if let Some((key, from)) = bit_starts.advance((i, *value), key, limits, too_long) {
            consider(key + bit_run + bits_to(value.end()) - all * per_bit, ReadMode::Discretes { from });
        }
        if let Some(price) = unit_price {
            consider(before + item(symbol, 1, price), ReadMode::Discretes { from: i });
        }
        // Of equally cheap words, the one that ends first.
        let mut at = candidates[i];
        at.sort_unstable_by_key(|candidate| candidate.map(|candidate| candidate.address));
        for residue in [0, 1] {
            if candidates[i][residue].is_none() {
                word_starts[residue].clear();
            }
        }
        for Candidate { address: word, residue, cells, has_pair } in at.into_iter().flatten() {
            // Words before the first discrete are not read: the key stays positive.
            let words_to = |cell: u32| u64::from(cell) * per_word;
            let last_word = u64::from(u16::MAX / WORD_BITS) + 1;
            let key = before + (last_word * per_word - words_to(cells.first));
            let starts = &mut word_starts[usize::from(residue / OCTET)];
            let too_long = |from: usize| {
                let start = words::word_address(address(from), residue).unwrap_or(0);
                u32::from(word - start) / u32::from(WORD_BITS) >= max_words
            };
            if let Some((key, from)) = starts.advance((i, cells), key, limits, too_long) {
                let price = key + word_run + words_to(cells.end()) - last_word * per_word;
                consider(price, ReadMode::Words { from, residue });
            }
            let Some(price) = unit_price else { continue };
            let from = first_from(values, i, word);
            consider(costs[from] + item(word_symbol, 1, price), ReadMode::Words { from, residue });
            if has_pair && limits.mixed_units() > 1 {
                let from = first_from(values, i, word - WORD_BITS);
                consider(costs[from] + item(dword_symbol, 2, price), ReadMode::Words { from, residue });
            }
        }
        costs.push(best.0);
        modes.push(best.1);
    }

    let mut chosen = ChosenWords::default();
    let mut at = values.len();
    while at > 0 {
        match modes[at - 1] {
            ReadMode::Discretes { from } => {
                chosen.discretes.extend(values[from..at].iter().rev().copied());
                at = from;
            }
            ReadMode::Words { from, residue } => {
                for ((n, value), candidate) in values[from..at].iter().zip(&candidates[from..at]).rev() {
                    match chosen.words.last_mut() {
                        Some((word, discretes))
                            if word.area.residue() == residue && word.find_bit(*value).is_some() =>
                        {
                            discretes.push(*n);
                        }
                        Some(_) | None => {
                            debug_assert!(candidate[usize::from(residue / OCTET)].is_some(), "it was considered");
                            match candidate[usize::from(residue / OCTET)] {
                                Some(Candidate { cells, .. }) => chosen.words.push((cells, vec![*n])),
                                None => chosen.discretes.push((*n, *value)),
                            }
                        }
                    }
                }
                at = from;
            }
        }
    }
    chosen.discretes.reverse();
    chosen.words.reverse();
    chosen
}

/// Returns the index of the first discrete at this address or later, up to `last`.
fn first_from(values: &[(usize, Cells)], last: usize, address: u16) -> usize {
    let is_before = |(_, value): &(usize, Cells)| value.addresses().next().is_none_or(|bit| bit < address);
    // A word has 16 discretes, a double word 32.
    let from = last.saturating_sub(2 * usize::from(WORD_BITS));
    from + values.get(from..=last).unwrap_or_default().partition_point(is_before)
}
