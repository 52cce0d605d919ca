//! From the cells that are needed to the requests that read them.

use std::collections::VecDeque;

use super::cost::CostModel;
use super::layout::{self, Cells, Draft, ItemCost};
use super::limits::Limits;

/// Up to so many parts, every way to share them out among requests is looked at.
pub(super) const EXACT: usize = 8;

/// What must come from one request: a value, or a group of them. Its cells are sorted.
pub(super) type Part = Vec<Cells>;

/// A request, and the parts that it reads.
pub(super) type Share = (Draft, Vec<usize>);

/// Every part can be read by some request alone, those of one value by a run; these come last, sorted and distinct, none
/// within another part.
pub(super) fn solve(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Share> {
    if let Some(share) = one_for_all(groups, values, limits, cost) {
        vec![share]
    } else if groups.len() + values.len() <= EXACT {
        exact(groups, values, limits, cost)
    } else {
        large(groups, values, limits, cost)
    }
}

/// One request for all parts, if no two requests can be cheaper: these have all the values, too, and more than one
/// request's share of what stands around them. So it is with most small sets, and all else takes much longer.
fn one_for_all(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Option<Share> {
    let cells = sorted(groups.iter().flatten().chain(values));
    let draft = Draft::cheapest(&cells, limits, cost)?;
    let two = mixed_overhead(cost).saturating_mul(2).saturating_add(cost.bytes_cost(layout::value_bytes(&cells, cost)));
    (draft.cost(cost) <= two).then(|| (draft, (0..groups.len() + values.len()).collect()))
}

/// The cheapest of all ways to share the parts out: for each set of parts, the best request that holds the first of
/// them and some others, and the best plan for what is left. 3ⁿ steps.
pub(super) fn exact(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Share> {
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

/// Groups first, each at its own best; then the values, by a dynamic program with several prices for a place in a
/// mixed request, of which the cheapest outcome is taken.
pub(super) fn large(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Vec<Share> {
    let (mut shares, open) = place_groups(groups, limits, cost);
    let first_value = groups.len();
    let rest: Vec<(usize, Cells)> = values.iter().enumerate().map(|(n, &value)| (first_value + n, value)).collect();
    let rest = absorb(rest, &mut shares);
    let mut bins: Vec<Bin> = open;

    let mut best: Option<(u64, Outcome)> = None;
    let mut consider = |place: Option<u64>| {
        let outcome = share_out(&rest, place, &bins, limits, cost);
        let price = outcome.iter().map(|(draft, _)| draft.cost(cost)).sum::<u64>();
        if best.as_ref().is_none_or(|(cheapest, _)| price < *cheapest) {
            best = Some((price, outcome));
        }
    };
    consider(None);
    if limits.mixed_units() > 0 {
        let share = mixed_overhead(cost) / u64::from(limits.mixed_units());
        for place in [0, share / 2, share, share * 3 / 2, share * 2, share * 4] {
            consider(Some(place));
        }
    }
    if let Some((_, outcome)) = best {
        bins.clear();
        shares.extend(outcome);
    }
    shares
}

/// A mixed request that is being filled.
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

/// The groups whose best request is a run, as runs, neighbours joined where that is cheaper; the others in mixed
/// requests that have room left.
fn place_groups(groups: &[Part], limits: &Limits, cost: &CostModel) -> (Vec<Share>, Vec<Bin>) {
    let mut runs: Vec<(Cells, Vec<usize>)> = Vec::new();
    let mut bins: Vec<Bin> = Vec::new();
    for (n, group) in groups.iter().enumerate() {
        match Draft::cheapest(group, limits, cost) {
            Some(Draft::Run(run)) => runs.push((run, vec![n])),
            _ => {
                // The last few only, so that the work does not grow with the number of requests.
                let fits = |bin: &&mut Bin| {
                    let cells = sorted(bin.cells.iter().chain(group));
                    bin.units + units(group) <= limits.mixed_units() && Draft::mixed(&cells, limits, cost).is_some()
                };
                let bin = match bins.iter_mut().rev().take(8).find(fits) {
                    Some(bin) => bin,
                    None => {
                        bins.push(Bin::default());
                        let last = bins.len() - 1;
                        &mut bins[last]
                    }
                };
                bin.parts.push(n);
                bin.cells.extend(group);
                bin.units += units(group);
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

/// Gives the values that lie in a group's run to it, and the others back. Both are sorted.
fn absorb(values: Vec<(usize, Cells)>, shares: &mut [Share]) -> Vec<(usize, Cells)> {
    let mut rest = Vec::with_capacity(values.len());
    for (n, value) in values {
        let after = shares.partition_point(|(draft, _)| match draft {
            Draft::Run(run) => (run.area, run.first) <= (value.area, value.first),
            Draft::Mixed(_) => false,
        });
        // Runs of one area may overlap, but hardly ever do: looking at the last one is enough to be right.
        match after.checked_sub(1).and_then(|before| shares.get_mut(before)) {
            Some((Draft::Run(run), parts)) if run.hold(value) => parts.push(n),
            _ => rest.push((n, value)),
        }
    }
    rest
}

/// One outcome: runs where they are cheaper, and what is left over packed into mixed requests.
fn share_out(
    values: &[(usize, Cells)],
    place: Option<u64>,
    open: &[Bin],
    limits: &Limits,
    cost: &CostModel,
) -> Outcome {
    let mut shares = Outcome::new();
    let mut left = Vec::new();
    for area in values.chunk_by(|(_, a), (_, b)| a.area == b.area) {
        choose(area, place, limits, cost, &mut shares, &mut left);
    }
    let mut left = left.into_iter().peekable();
    for bin in open {
        let mut bin = bin.clone();
        // Cells are counted singly here, so that neighbours in the bin are no matter.
        while let Some((n, value)) = left.next_if(|(_, value)| bin.units + units(&[*value]) <= limits.mixed_units()) {
            bin.parts.push(n);
            bin.cells.push(value);
            bin.units += units(&[value]);
        }
        close(bin, limits, cost, &mut shares);
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
            fill(&bin, limits, cost, &mut shares);
            bin.clear();
            filled = units(&[value]);
        } else {
            filled += more;
        }
        bin.push((n, value));
    }
    fill(&bin, limits, cost, &mut shares);
    shares
}

/// A mixed request with groups in it; if the values among them give the list two readings, they go elsewhere.
fn close(bin: Bin, limits: &Limits, cost: &CostModel, shares: &mut Outcome) {
    let cells = sorted(bin.cells.iter());
    if let Some(draft) = Draft::mixed(&cells, limits, cost) {
        shares.push((draft, bin.parts));
        return;
    }
    // The groups had passed together before any value came: parts and cells of values stand at the end.
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
    fill(&values, limits, cost, shares);
}

/// The values as one mixed request, or as runs if that is cheaper, or in halves if the list has two readings.
fn fill(values: &[(usize, Cells)], limits: &Limits, cost: &CostModel, shares: &mut Outcome) {
    if values.is_empty() {
        return;
    }
    let cells: Vec<Cells> = values.iter().map(|(_, value)| *value).collect();
    let mut runs = Outcome::new();
    let mut none = Vec::new();
    for area in values.chunk_by(|(_, a), (_, b)| a.area == b.area) {
        choose(area, None, limits, cost, &mut runs, &mut none);
    }
    let price = runs.iter().map(|(draft, _)| draft.cost(cost)).sum::<u64>();
    match Draft::mixed(&cells, limits, cost) {
        Some(draft) if draft.cost(cost) < price => shares.push((draft, values.iter().map(|(n, _)| *n).collect())),
        None if values.len() > 1 => {
            let mut halves = Outcome::new();
            let (low, high) = values.split_at(values.len() / 2);
            fill(low, limits, cost, &mut halves);
            fill(high, limits, cost, &mut halves);
            let halved = halves.iter().map(|(draft, _)| draft.cost(cost)).sum::<u64>();
            shares.extend(if halved < price { halves } else { runs });
        }
        _ => shares.extend(runs),
    }
}

/// How a value is read, when it is the last of those looked at so far.
#[derive(Clone, Copy)]
enum How {
    /// At the end of a run that begins with this value.
    Run { from: usize },
    /// In a mixed request; the stretch of neighbours there has an even or odd number of cells.
    Mixed { before: Ending },
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Ending {
    Run,
    Even,
    Odd,
}

/// The cheapest way to read the values of one area, when a unit in a mixed request has this price beside its bytes;
/// `None`: no mixed requests.
///
/// Values are sorted and none holds another, so the values of a run follow each other in an optimum: of two runs that
/// cross, the one can give the other what both cover. `costs[i]` is the price of the first `i` values for each ending.
/// The best begin of a run is kept in a queue, as its distance enters the price linearly: O(n).
fn choose(
    values: &[(usize, Cells)],
    place: Option<u64>,
    limits: &Limits,
    cost: &CostModel,
    shares: &mut Outcome,
    left: &mut Vec<(usize, Cells)>,
) {
    let Some((_, first)) = values.first() else { return };
    let area = first.area;
    let max_run = area.max_run(limits);
    let (run_fixed, per_cell) = {
        let one = Draft::Run(Cells { len: 1, ..*first }).cost(cost);
        let cell = cost.bytes_cost(cost.value_bytes(area.width()));
        (one - cell, cell)
    };
    let item = ItemCost::new(area, cost);
    let unit = place.map(|place| place.saturating_mul(u64::from(area.units())));

    const NEVER: u64 = u64::MAX / 4;
    // Run, Even, Odd.
    let mut costs = vec![[0, NEVER, NEVER]];
    let mut hows: Vec<[How; 3]> = Vec::with_capacity(values.len());
    let mut begins: VecDeque<(u64, usize)> = VecDeque::new();
    let distance = |cell: u32| u64::from(cell - first.first) * per_cell;
    // Kept above zero: what lies between the first value and a begin is not paid.
    let all = distance(values.last().map_or(first.first, |(_, last)| last.first));

    for (i, (_, value)) in values.iter().enumerate() {
        let before = costs[i];
        let cheapest = before.into_iter().min().unwrap_or(NEVER);
        let key = cheapest + (all - distance(value.first));
        if i > 0 && !limits.let_runs_be() && values[i - 1].1.is_barred_from(*value, limits) {
            begins.clear();
        }
        while begins.back().is_some_and(|(worse, _)| *worse >= key) {
            begins.pop_back();
        }
        begins.push_back((key, i));
        while begins.front().is_some_and(|(_, from)| value.end() - values[*from].1.first > max_run) {
            begins.pop_front();
        }
        let (run, from) = match begins.front() {
            Some((key, from)) => (*key + run_fixed + distance(value.end()) - all, *from),
            None => (NEVER, i),
        };
        let mut here = [run, NEVER, NEVER];
        let mut how = [How::Run { from }; 3];
        let fits = value.len * area.units() <= limits.mixed_units();
        if let Some(unit) = unit.filter(|_| fits) {
            let neighbour = i > 0 && value.first <= values[i - 1].1.end();
            for ending in [Ending::Run, Ending::Even, Ending::Odd] {
                let continues = neighbour && ending != Ending::Run;
                let new = if continues { value.end() - values[i - 1].1.end() } else { value.len };
                let odd = continues && ending == Ending::Odd;
                let price = before[ending as usize] + item.cost(new, odd) + unit * u64::from(new);
                let now = if (new % 2 == 1) == odd { 1 } else { 2 };
                if price < here[now] {
                    here[now] = price;
                    how[now] = How::Mixed { before: ending };
                }
            }
        }
        costs.push(here);
        hows.push(how);
    }

    // Back from the end.
    let mut at = values.len();
    let cheapest = |costs: &[u64; 3]| (0..3).min_by_key(|n| costs[*n]).unwrap_or(0);
    let mut ending = cheapest(&costs[at]);
    let mut mixed = Vec::new();
    while at > 0 {
        match hows[at - 1][ending] {
            How::Run { from } => {
                let (start, end) = (values[from].1, values[at - 1].1);
                let run = Cells { len: end.end() - start.first, ..start };
                shares.push((Draft::Run(run), values[from..at].iter().map(|(n, _)| *n).collect()));
                at = from;
                ending = cheapest(&costs[at]);
            }
            How::Mixed { before } => {
                at -= 1;
                mixed.push(values[at]);
                ending = before as usize;
            }
        }
    }
    left.extend(mixed.into_iter().rev());
}
