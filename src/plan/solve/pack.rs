//! Packs many values into requests.

use std::borrow::Cow;

use super::super::cost::CostModel;
use super::super::layout::{Cells, Draft};
use super::super::limits::Limits;
use super::super::words;
use super::area::solve_area;
use super::discretes::{self, Candidates};
use super::groups::{Bin, close_bin};
use super::varied::{Lengths, units_behind, value_bytes, varied_runs};
use super::{Outcome, price_of, units};

/// Returns one outcome: runs where they are cheaper, and mixed reads of the remaining values.
pub(super) fn pack_values(
    values: (&[(usize, Cells)], &[Candidates]),
    (unit_price, lengths): (Option<u64>, Lengths),
    open: &[Bin],
    limits: &Limits,
    cost: &CostModel,
) -> Outcome {
    let (values, words) = with_words(values, unit_price, limits, cost);
    let mut shares = pack_chosen(&values, (unit_price, lengths), open, limits, cost);
    if !words.parts.is_empty() {
        shares.iter_mut().for_each(|(_, parts)| words.expand(parts));
    }
    shares
}

/// Words that are read for discretes, as values with numbers of their own.
struct WordValues {
    first: usize,
    /// For each word, the numbers of its discretes.
    parts: Vec<Vec<usize>>,
}

impl WordValues {
    /// Replaces words by their discretes.
    fn expand(&self, parts: &mut Vec<usize>) {
        let numbers = std::mem::take(parts);
        for n in numbers {
            match n.checked_sub(self.first).and_then(|word| self.parts.get(word)) {
                Some(discretes) => parts.extend(discretes),
                None => parts.push(n),
            }
        }
    }
}

/// Replaces discretes by words where that is cheaper. The values are sorted, before and after.
fn with_words<'v>(
    (values, candidates): (&'v [(usize, Cells)], &[Candidates]),
    unit_price: Option<u64>,
    limits: &Limits,
    cost: &CostModel,
) -> (Cow<'v, [(usize, Cells)]>, WordValues) {
    let first = values.iter().map(|(n, _)| n + 1).max().unwrap_or(0);
    let mut words = WordValues { first, parts: Vec::new() };
    if !values.iter().any(|(_, value)| words::has_words(value, limits)) {
        return (Cow::Borrowed(values), words);
    }
    let mut chosen = Vec::with_capacity(values.len());
    let mut rest = candidates;
    for area in values.chunk_by(|(_, a), (_, b)| a.area == b.area) {
        let (candidates, others) = rest.split_at(area.len());
        rest = others;
        if area.first().is_some_and(|(_, value)| words::has_words(value, limits)) {
            let choice = discretes::choose_words((area, candidates), unit_price, limits, cost);
            chosen.extend(choice.discretes);
            for (word, discretes) in choice.words {
                chosen.push((first + words.parts.len(), word));
                words.parts.push(discretes);
            }
        } else {
            chosen.extend_from_slice(area);
        }
    }
    chosen.sort_by_key(|(_, value)| value.key());
    (Cow::Owned(chosen), words)
}

/// Returns one outcome for values that are read as they are.
fn pack_chosen(
    values: &[(usize, Cells)],
    (unit_price, lengths): (Option<u64>, Lengths),
    open: &[Bin],
    limits: &Limits,
    cost: &CostModel,
) -> Outcome {
    let mut shares = Outcome::new();
    let mut left = Vec::new();
    for area in values.chunk_by(|(_, a), (_, b)| a.area == b.area) {
        let mut runs = Outcome::new();
        solve_area(area, unit_price, limits, cost, &mut runs, &mut left);
        shares.extend(if lengths == Lengths::Varied { varied_runs(runs, area, limits) } else { runs });
    }
    let mut left = left.into_iter().peekable();
    for bin in open {
        let mut bin = bin.clone();
        // An upper bound of the units: cells shared with the bin are counted twice.
        while let Some((n, value)) = left.next_if(|(_, value)| bin.units + units(&[*value]) <= limits.mixed_units()) {
            bin.parts.push(n);
            bin.cells.push(value);
            bin.units += units(&[value]);
        }
        close_bin(bin, limits, cost, &mut shares);
    }
    let mut bin: Vec<(usize, Cells)> = Vec::new();
    let mut filled = 0;
    let mut length_before = None;
    for (n, value) in left {
        let more = units_behind(bin.last(), value);
        if filled + more > limits.mixed_units() {
            let mut next = Vec::new();
            // A reply of the length of the one before needs a proof.
            if lengths == Lengths::Varied && length_before == Some(value_bytes(&bin, cost)) && bin.len() > 1 {
                next.extend(bin.pop());
            }
            length_before = Some(value_bytes(&bin, cost));
            pack_mixed(&bin, limits, cost, &mut shares);
            bin = next;
            filled = bin.iter().map(|(_, value)| units(&[*value])).sum::<u32>() + units_behind(bin.last(), value);
            // Two values of many units.
            if filled > limits.mixed_units() {
                pack_mixed(&bin, limits, cost, &mut shares);
                bin.clear();
                filled = units(&[value]);
            }
        } else {
            filled += more;
        }
        bin.push((n, value));
    }
    pack_mixed(&bin, limits, cost, &mut shares);
    shares
}

/// Reads values by one mixed read, by runs if cheaper, or by two mixed reads if the list is ambiguous.
pub(super) fn pack_mixed(values: &[(usize, Cells)], limits: &Limits, cost: &CostModel, shares: &mut Outcome) {
    if values.is_empty() {
        return;
    }
    let cells: Vec<Cells> = values.iter().map(|(_, value)| *value).collect();
    let mut runs = Outcome::new();
    let mut none = Vec::new();
    for area in values.chunk_by(|(_, a), (_, b)| a.area == b.area) {
        solve_area(area, None, limits, cost, &mut runs, &mut none);
    }
    let price = runs.iter().map(|(draft, _)| draft.cost(cost)).sum::<u64>();
    match Draft::mixed(&cells, limits, cost) {
        Some(draft) if draft.cost(cost) < price => shares.push((draft, values.iter().map(|(n, _)| *n).collect())),
        None if values.len() > 1 => {
            let mut divided = Outcome::new();
            let has_two_readings = |(_, value): &(usize, Cells)| value.may_be_read_otherwise();
            let (mut low, mut high): (Vec<_>, Vec<_>) = values.iter().partition(|value| !has_two_readings(value));
            if low.is_empty() || high.is_empty() {
                (low, high) = (values[..values.len() / 2].to_vec(), values[values.len() / 2..].to_vec());
            }
            pack_mixed(&low, limits, cost, &mut divided);
            pack_mixed(&high, limits, cost, &mut divided);
            shares.extend(if price_of(&divided, cost) < price { divided } else { runs });
        }
        _ => shares.extend(runs),
    }
}
