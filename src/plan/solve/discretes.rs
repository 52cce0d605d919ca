//! Chooses, among many discretes, those that are read as words.

use std::collections::VecDeque;

use super::super::cost::CostModel;
use super::super::layout::Cells;
use super::super::limits::{Limits, WORD_BITS};
use super::super::words;
use crate::element::Width;

/// The discretes of one area after the choice.
#[derive(Default)]
pub(super) struct ChosenWords {
    /// Discretes that are read as such, alone or by runs.
    pub(super) discretes: Vec<(usize, Cells)>,
    /// Words, each with the discretes that it is read for.
    pub(super) words: Vec<(Cells, Vec<usize>)>,
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
    values: &[(usize, Cells)],
    unit_price: Option<u64>,
    limits: &Limits,
    cost: &CostModel,
) -> ChosenWords {
    let Some((_, first)) = values.first() else { return ChosenWords::default() };
    let symbol = first.area.symbol();
    let word_symbol = symbol.area().word();
    let framing = cost.framing();
    let run_cost =
        |symbol, bytes| cost.cost(cost.request_bytes() + cost.reply_bytes() + cost.element_bytes(symbol) + bytes);
    let (bit_run, word_run) = (run_cost(symbol, 0), run_cost(word_symbol, 0));
    let (per_bit, per_word) =
        (cost.bytes_cost(cost.value_bytes(Width::Bit)), cost.bytes_cost(cost.value_bytes(Width::Word)));
    let item = |symbol: crate::element::Symbol, units: u64, price: u64| {
        cost.bytes_cost(cost.element_bytes(symbol) + cost.value_bytes(symbol.width())) + units * price
    };
    let unit_price = unit_price.filter(|_| limits.mixed_units() > 0);
    let residues: Vec<u16> = words::residues(limits).collect();
    let (max_bits, max_words) = (limits.units(Width::Bit), limits.units(Width::Word));
    let address = |index: usize| values.get(index).and_then(|(_, value)| value.addresses().next()).unwrap_or(0);
    let all = u64::from(values.last().map_or(first.first, |(_, last)| last.first) - first.first) + 1;

    let mut costs: Vec<u64> = vec![0];
    let mut modes: Vec<ReadMode> = Vec::with_capacity(values.len());
    let mut bit_starts = RunStarts::default();
    let mut word_starts: Vec<RunStarts> = residues.iter().map(|_| RunStarts::default()).collect();
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
        let bit = address(i);
        let mut at: Vec<(u16, u16, usize)> = Vec::with_capacity(2);
        for (n, residue) in residues.iter().enumerate() {
            let word = words::word_address(bit, *residue)
                .and_then(|word| Some((word, words::word_at(symbol, word, limits, framing)?)));
            match word {
                Some((word, _)) => at.push((word, *residue, n)),
                None => word_starts[n].clear(),
            }
        }
        // Of equally cheap words, the one that ends first.
        at.sort_unstable();
        for (word, residue, n) in at {
            let Some(cells) = words::word_at(symbol, word, limits, framing) else { continue };
            // Words before the first discrete are not read: the key stays positive.
            let words_to = |cell: u32| u64::from(cell) * per_word;
            let last_word = u64::from(u16::MAX / WORD_BITS) + 1;
            let key = before + (last_word * per_word - words_to(cells.first));
            let too_long = |from: usize| {
                let start = words::word_address(address(from), residue).unwrap_or(0);
                u32::from(word - start) / u32::from(WORD_BITS) >= max_words
            };
            if let Some((key, from)) = word_starts[n].advance((i, cells), key, limits, too_long) {
                let price = key + word_run + words_to(cells.end()) - last_word * per_word;
                consider(price, ReadMode::Words { from, residue });
            }
            let Some(price) = unit_price else { continue };
            let from = first_from(values, i, word);
            consider(costs[from] + item(word_symbol, 1, price), ReadMode::Words { from, residue });
            if let Some(start) = word.checked_sub(WORD_BITS)
                && limits.mixed_units() > 1
                && words::word_at(symbol, start, limits, framing).is_some()
            {
                let from = first_from(values, i, start);
                let dword = symbol.area().dword();
                consider(costs[from] + item(dword, 2, price), ReadMode::Words { from, residue });
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
                for (n, value) in values[from..at].iter().rev() {
                    match chosen.words.last_mut() {
                        Some((word, discretes))
                            if word.area.residue() == residue && word.find_bit(*value).is_some() =>
                        {
                            discretes.push(*n);
                        }
                        Some(_) | None => {
                            let address = value.addresses().next().and_then(|bit| words::word_address(bit, residue));
                            let word = address.and_then(|word| words::word_at(symbol, word, limits, framing));
                            debug_assert!(word.is_some(), "a word that was considered");
                            match word {
                                Some(word) => chosen.words.push((word, vec![*n])),
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
