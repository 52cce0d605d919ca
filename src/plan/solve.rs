//! The solver: distributes parts among requests at minimum cost.

mod area;
mod discretes;

use std::borrow::Cow;

use self::area::solve_area;
use self::discretes::Candidates;
use super::cost::CostModel;
use super::layout::{self, Cells, Draft};
use super::limits::Limits;
use super::words;

/// The maximum number of parts for which all partitions are compared.
pub(super) const MAX_EXACT_PARTS: usize = 8;

/// Cells that must come from one request: a value or a group. They are sorted.
pub(super) type Part = Vec<Cells>;

/// A request and the indices of the parts that it reads.
pub(super) type Share = (Draft, Vec<usize>);

/// Distributes groups and values among requests. Parts are numbered with the groups first.
///
/// Each group must fit in some request and each value in a run. The values are sorted and distinct,
/// and none lies within another part.
pub(super) fn solve(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Share> {
    if let Some(share) = single_request(groups, values, limits, cost) {
        vec![share]
    } else if groups.len() + values.len() <= MAX_EXACT_PARTS {
        solve_exact(groups, values, limits, cost)
    } else {
        solve_large(groups, values, limits, cost)
    }
}

fn price_of(shares: &[Share], cost: &CostModel) -> u64 {
    shares.iter().map(|(draft, _)| draft.cost(cost)).sum()
}

/// Returns a single request for all parts if two requests cannot be cheaper.
///
/// Two requests have the bytes of all values and twice the overhead. This quick test succeeds for
/// most small sets.
pub(super) fn single_request(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Share> {
    let cells = sorted(groups.iter().flatten().chain(values));
    let draft = Draft::cheapest(&cells, limits, cost)?;
    let two = mixed_overhead(cost)
        .saturating_mul(2)
        .saturating_add(cost.bytes_cost(layout::least_value_bytes(&cells, limits, cost)));
    (draft.cost(cost) <= two).then(|| (draft, (0..groups.len() + values.len()).collect()))
}

/// Finds the cheapest partition: for each set of parts, the best request with the first part and
/// any others, and the best plan for the rest. Takes 3^n steps.
pub(super) fn solve_exact(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Share> {
    let parts: Vec<Part> = groups.iter().cloned().chain(values.iter().map(|&value| vec![value])).collect();
    let all = (1_usize << parts.len()) - 1;
    let members = |set: usize| (0..parts.len()).filter(move |n| set >> n & 1 == 1);
    let drafts: Vec<Option<Draft>> =
        (0..=all).map(|set| Draft::cheapest(&sorted(members(set).flat_map(|n| &parts[n])), limits, cost)).collect();
    let costs: Vec<Option<u64>> = drafts.iter().map(|draft| draft.as_ref().map(|draft| draft.cost(cost))).collect();
    let mut best = vec![(0_u64, 0_usize)];
    for set in 1..=all {
        let lowest = set & set.wrapping_neg();
        let others = set ^ lowest;
        let mut cheapest = (u64::MAX, lowest);
        let mut some = others;
        loop {
            let request = some | lowest;
            if let Some(price) = costs[request] {
                cheapest = cheapest.min((price.saturating_add(best[set ^ request].0), request));
            }
            if some == 0 {
                break;
            }
            some = (some - 1) & others;
        }
        best.push(cheapest);
    }
    let mut shares = Vec::new();
    let mut set = all;
    while set != 0 {
        let request = best[set].1;
        if let Some(draft) = &drafts[request] {
            shares.push((draft.clone(), members(request).collect()));
        }
        set ^= request;
    }
    shares.reverse();
    shares
}

/// Places each group as its own cheapest request, and then the values by a dynamic program.
///
/// The program runs for several prices of a unit in a mixed read; the cheapest outcome counts.
pub(super) fn solve_large(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Share> {
    let (mut shares, open_bins) = place_groups(groups, limits, cost);
    let first_value = groups.len();
    let rest: Vec<(usize, Cells)> = values.iter().enumerate().map(|(n, &value)| (first_value + n, value)).collect();
    let rest = absorb_into_runs(rest, &mut shares);

    let candidates = discretes::candidates(&rest, limits, cost);
    let mut best: Option<(u64, Outcome)> = None;
    let mut consider = |unit_price: Option<u64>| {
        let outcome = pack_values((&rest, &candidates), unit_price, &open_bins, limits, cost);
        let price = price_of(&outcome, cost);
        if best.as_ref().is_none_or(|(cheapest, _)| price < *cheapest) {
            best = Some((price, outcome));
        }
    };
    consider(None);
    if limits.mixed_units() > 0 {
        let share = mixed_overhead(cost) / u64::from(limits.mixed_units());
        for unit_price in [0, share / 2, share, share * 3 / 2, share * 2, share * 4] {
            consider(Some(unit_price));
        }
    }
    if let Some((_, outcome)) = best {
        shares.extend(outcome);
    }
    shares
}

/// Returns a lower bound of the cost of any plan for these values without words of discretes.
///
/// A mixed read has its fixed cost and at most as many units as the limits allow, so each unit costs
/// at least its share. The dynamic program is exact for that price.
pub(super) fn least_cost(values: &[Cells], limits: &Limits, cost: &CostModel) -> u64 {
    let values: Vec<(usize, Cells)> = values.iter().copied().enumerate().collect();
    let unit_price = mixed_overhead(cost).checked_div(limits.mixed_units().into());
    let areas = values.chunk_by(|(_, a), (_, b)| a.area == b.area);
    areas.map(|area| solve_area(area, unit_price, limits, cost, &mut Vec::new(), &mut Vec::new())).sum()
}

/// A mixed read that is being filled.
#[derive(Clone, Debug, Default)]
struct Bin {
    parts: Vec<usize>,
    cells: Vec<Cells>,
    units: u32,
}

type Outcome = Vec<Share>;

fn mixed_overhead(cost: &CostModel) -> u64 {
    cost.cost(cost.request_bytes() + cost.reply_bytes())
}

fn units(cells: &[Cells]) -> u32 {
    cells.iter().map(|cells| cells.len * cells.area.units()).sum()
}

fn sorted<'a>(cells: impl Iterator<Item = &'a Cells>) -> Vec<Cells> {
    let mut cells: Vec<Cells> = cells.copied().collect();
    cells.sort_unstable_by_key(|cells| cells.key());
    cells
}

/// Places groups as runs, joined where that is cheaper, or in mixed reads that have room.
fn place_groups(groups: &[Part], limits: &Limits, cost: &CostModel) -> (Vec<Share>, Vec<Bin>) {
    let mut runs: Vec<(Cells, Vec<usize>)> = Vec::new();
    let mut bins: Vec<Bin> = Vec::new();
    for (n, group) in groups.iter().enumerate() {
        match Draft::cheapest(group, limits, cost) {
            Some(Draft::Run(run)) => runs.push((run, vec![n])),
            Some(Draft::Mixed(_)) | None => {
                // Only the last few bins, so that the time stays linear.
                let with_group = |bin: &Bin| {
                    let cells = sorted(bin.cells.iter().chain(group));
                    Draft::mixed(&cells, limits, cost).map(|draft| draft.mixed_units())
                };
                let mut open = bins.iter_mut().rev().take(8);
                let (bin, units) = match open.find_map(|bin| with_group(bin).map(|units| (bin, units))) {
                    Some(found) => found,
                    None => {
                        let units = with_group(&Bin::default()).unwrap_or(0);
                        bins.push(Bin::default());
                        let last = bins.len() - 1;
                        (&mut bins[last], units)
                    }
                };
                bin.parts.push(n);
                bin.cells.extend(group);
                bin.units = units;
            }
        }
    }
    runs.sort_unstable_by_key(|(run, _)| run.key());
    let mut joined: Vec<(Cells, Vec<usize>)> = Vec::new();
    for (run, parts) in runs {
        if let Some((last, those)) = joined.last_mut()
            && let Some(Draft::Run(both)) = Draft::run(&[*last, run], limits)
            && Draft::Run(both).cost(cost) <= Draft::Run(*last).cost(cost).saturating_add(Draft::Run(run).cost(cost))
        {
            *last = both;
            those.extend(parts);
        } else {
            joined.push((run, parts));
        }
    }
    (joined.into_iter().map(|(run, parts)| (Draft::Run(run), parts)).collect(), bins)
}

/// Assigns values to the runs of groups that contain them, and returns the others. Both are sorted.
fn absorb_into_runs(values: Vec<(usize, Cells)>, shares: &mut [Share]) -> Vec<(usize, Cells)> {
    let mut rest = Vec::with_capacity(values.len());
    for (n, value) in values {
        let after = shares.partition_point(|(draft, _)| match draft {
            Draft::Run(run) => (run.area, run.first) <= (value.area, value.first),
            Draft::Mixed(_) => false,
        });
        // Runs rarely overlap. A value that lies only in an earlier run is read once more.
        match after.checked_sub(1).and_then(|before| shares.get_mut(before)) {
            Some((Draft::Run(run), parts)) if run.contains(value) => parts.push(n),
            Some((Draft::Run(_) | Draft::Mixed(_), _)) | None => rest.push((n, value)),
        }
    }
    rest
}

/// Returns one outcome: runs where they are cheaper, and mixed reads of the remaining values.
fn pack_values(
    values: (&[(usize, Cells)], &[Candidates]),
    unit_price: Option<u64>,
    open: &[Bin],
    limits: &Limits,
    cost: &CostModel,
) -> Outcome {
    let (values, words) = with_words(values, unit_price, limits, cost);
    let mut shares = pack_chosen(&values, unit_price, open, limits, cost);
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
    unit_price: Option<u64>,
    open: &[Bin],
    limits: &Limits,
    cost: &CostModel,
) -> Outcome {
    let mut shares = Outcome::new();
    let mut left = Vec::new();
    for area in values.chunk_by(|(_, a), (_, b)| a.area == b.area) {
        solve_area(area, unit_price, limits, cost, &mut shares, &mut left);
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
    for (n, value) in left {
        let shared = match bin.last() {
            Some((_, last)) if last.area == value.area => last.end().saturating_sub(value.first).min(value.len),
            _ => 0,
        };
        let more = (value.len - shared) * value.area.units();
        if filled + more > limits.mixed_units() {
            pack_mixed(&bin, limits, cost, &mut shares);
            bin.clear();
            filled = units(&[value]);
        } else {
            filled += more;
        }
        bin.push((n, value));
    }
    pack_mixed(&bin, limits, cost, &mut shares);
    shares
}

/// Closes a bin with groups. Values that make its list ambiguous are packed elsewhere.
fn close_bin(bin: Bin, limits: &Limits, cost: &CostModel, shares: &mut Outcome) {
    let cells = sorted(bin.cells.iter());
    if let Some(draft) = Draft::mixed(&cells, limits, cost) {
        shares.push((draft, bin.parts));
        return;
    }
    // The groups alone are not ambiguous. Values have one entry each, at the ends of the lists.
    let mut bin = bin;
    let mut values = Vec::new();
    while let (Some(n), Some(value)) = (bin.parts.pop(), bin.cells.pop()) {
        values.push((n, value));
        if let Some(draft) = Draft::mixed(&sorted(bin.cells.iter()), limits, cost) {
            shares.push((draft, bin.parts));
            break;
        }
    }
    values.sort_unstable_by_key(|(_, value)| value.key());
    pack_mixed(&values, limits, cost, shares);
}

/// Reads values by one mixed read, by runs if cheaper, or in halves if the list is ambiguous.
fn pack_mixed(values: &[(usize, Cells)], limits: &Limits, cost: &CostModel, shares: &mut Outcome) {
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
            let mut halves = Outcome::new();
            let (low, high) = values.split_at(values.len() / 2);
            pack_mixed(low, limits, cost, &mut halves);
            pack_mixed(high, limits, cost, &mut halves);
            let halved = halves.iter().map(|(draft, _)| draft.cost(cost)).sum::<u64>();
            shares.extend(if halved < price { halves } else { runs });
        }
        _ => shares.extend(runs),
    }
}
