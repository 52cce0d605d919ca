//! The solver: distributes parts among requests at minimum cost, with their proofs.

mod area;
mod discretes;
mod groups;
mod pack;
pub(super) mod sequence;
mod varied;

use self::area::solve_area;
use self::groups::{absorb_into_runs, place_groups, varied_bins};
use self::pack::pack_values;
use self::sequence::Candidate;
use self::varied::Lengths;
use super::cost::CostModel;
use super::layout::{self, Cells, Draft};
use super::limits::{Limits, WORD_BITS};
use super::order;
use super::proofs::{Exchange, ProofPrices};
use super::words;
use crate::element::Width;
use crate::wire::Framing;

/// The maximum number of parts for which all partitions are compared.
pub(super) const MAX_EXACT_PARTS: usize = 8;

/// Cells that must come from one request: a value or a group. They are sorted.
pub(super) type Part = Vec<Cells>;

/// A request and the indices of the parts that it reads.
pub(super) type Share = (Draft, Vec<usize>);

/// Requests in the order in which they are sent, and their cost.
#[derive(Debug)]
pub(super) struct Solution {
    pub(super) shares: Vec<Share>,
    /// The cost of the requests in nanoseconds, without proofs.
    requests: u64,
    /// The cost of their proofs.
    pub(super) proofs: u64,
}

impl Solution {
    /// Orders requests.
    fn new(shares: Vec<Share>, limits: &Limits, cost: &CostModel) -> Self {
        let exchanges = order::exchanges(shares.iter().map(|(draft, _)| draft), limits, cost);
        let (order, proofs) = order::cheapest_order(&exchanges, ProofPrices::new(cost));
        let requests = price_of(&shares, cost);
        let mut shares: Vec<Option<Share>> = shares.into_iter().map(Some).collect();
        let ordered = order.into_iter().filter_map(|n| shares.get_mut(n)?.take()).collect();
        debug_assert!(shares.iter().all(Option::is_none), "each request once");
        Self { shares: ordered, requests, proofs }
    }

    pub(super) fn price(&self) -> u64 {
        self.requests.saturating_add(self.proofs)
    }
}

/// Distributes groups and values among requests. Parts are numbered with the groups first.
///
/// Each group must fit in some request and each value in a run. The values are sorted and distinct,
/// and none lies within another part.
pub(super) fn solve(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Solution {
    if let Some(share) = single_request(groups, values, limits, cost) {
        Solution::new(vec![share], limits, cost)
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

/// Finds the cheapest sequence of requests.
///
/// First, the cheapest partition without proofs: for each set of parts, the best request with the first
/// part and any others, and the best plan for the rest, in 3^n steps. If its requests can be sent
/// without proofs, it is the best one. Otherwise a longer request with a reply of another shape may be
/// part of the best sequence: see [`sequence`].
pub(super) fn solve_exact(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Solution {
    let parts: Vec<Part> = groups.iter().cloned().chain(values.iter().map(|&value| vec![value])).collect();
    let all = (1_usize << parts.len()) - 1;
    let members = |set: usize| (0..parts.len()).filter(move |n| set >> n & 1 == 1);
    let is_too_large = sets_too_large(&parts, limits);
    let cells = |set: usize| sorted(members(set).flat_map(|n| &parts[n]));
    let draft = |set: usize| if is_too_large[set] { None } else { Draft::cheapest(&cells(set), limits, cost) };
    let drafts: Vec<Option<Draft>> = (0..=all).map(draft).collect();
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
    let solution = Solution::new(shares, limits, cost);
    // A list that is ambiguous in the binary framing may hide a cheaper one.
    if solution.proofs == 0 && cost.framing() == Framing::Ascii {
        return solution;
    }
    let options: Vec<Vec<Draft>> = (0..=all)
        .map(|set| match costs[set] {
            _ if set == 0 || is_too_large[set] => Vec::new(),
            // Without lists that are ambiguous, there is a cheapest request if there is any.
            None if cost.framing() == Framing::Ascii => Vec::new(),
            Some(price)
                if cost.framing() == Framing::Ascii && price.saturating_add(best[all ^ set].0) >= solution.price() =>
            {
                Vec::new()
            }
            Some(_) | None => Draft::options(&cells(set), limits, cost),
        })
        .collect();
    let candidate = |draft: &Draft| Candidate { cost: draft.cost(cost), exchange: Exchange::of(draft, limits, cost) };
    let candidates: Vec<Vec<Candidate>> =
        options.iter().map(|options| options.iter().map(candidate).collect()).collect();
    let Some(cheapest) = sequence::cheapest(&candidates, ProofPrices::new(cost), solution.price()) else {
        return solution;
    };
    let share = |(set, n): (usize, usize)| Some((options.get(set)?.get(n)?.clone(), members(set).collect()));
    Solution::new(cheapest.steps.into_iter().filter_map(share).collect(), limits, cost)
}

/// Returns, for each set of parts, whether its cells are too many for any request.
///
/// Sets with such a set in them are too large as well, so that few sets of large parts are sorted.
fn sets_too_large(parts: &[Part], limits: &Limits) -> Vec<bool> {
    let registers = limits.units(Width::Word).max(limits.mixed_units());
    let has_words = parts.iter().flatten().any(|cells| words::has_words(cells, limits));
    let discretes = if has_words { registers * u32::from(WORD_BITS) } else { limits.mixed_units() };
    let discretes = discretes.max(limits.units(Width::Bit));
    let mut is_too_large: Vec<bool> = Vec::with_capacity(1 << parts.len());
    for set in 0..1_usize << parts.len() {
        let members = || parts.iter().enumerate().filter(move |(n, _)| set >> n & 1 == 1).map(|(_, part)| part);
        let has_large_subset = || (0..parts.len()).any(|n| set >> n & 1 == 1 && is_too_large[set ^ 1 << n]);
        // Cells that several parts have count once.
        let exceeds = || members().map(|part| units(part)).fold(0, u32::saturating_add) > registers.min(discretes);
        let is_large = || {
            let cells = sorted(members().flatten());
            let (bits, others): (Vec<Cells>, Vec<Cells>) =
                cells.into_iter().partition(|cells| cells.area.width() == Width::Bit);
            layout::mixed_units(&bits) > discretes || layout::mixed_units(&others) > registers
        };
        is_too_large.push(has_large_subset() || exceeds() && is_large());
    }
    is_too_large
}

/// Places each group as its own cheapest request, and then the values by a dynamic program.
///
/// The program runs for several prices of a unit in a mixed read; the cheapest outcome counts. Each
/// outcome is also made with requests of different lengths, which need fewer proofs.
pub(super) fn solve_large(groups: &[Part], values: &[Cells], limits: &Limits, cost: &CostModel) -> Solution {
    let (mut shares, open_bins) = place_groups(groups, limits, cost);
    let first_value = groups.len();
    let rest: Vec<(usize, Cells)> = values.iter().enumerate().map(|(n, &value)| (first_value + n, value)).collect();
    let rest = absorb_into_runs(rest, &mut shares);

    let candidates = discretes::candidates(&rest, limits, cost);
    let varied_bins = varied_bins(&open_bins, groups, limits, cost);
    let mut best: Option<(u64, Outcome)> = None;
    let prices = ProofPrices::new(cost);
    let mut consider = |unit_price: Option<u64>| {
        for lengths in [Lengths::Longest, Lengths::Varied] {
            let open_bins = if lengths == Lengths::Varied { &varied_bins } else { &open_bins };
            let outcome = pack_values((&rest, &candidates), (unit_price, lengths), open_bins, limits, cost);
            let all = shares.iter().chain(&outcome).map(|(draft, _)| draft);
            let (_, proofs) = order::cheapest_order(&order::exchanges(all, limits, cost), prices);
            let price = price_of(&outcome, cost).saturating_add(proofs);
            if best.as_ref().is_none_or(|(cheapest, _)| price < *cheapest) {
                best = Some((price, outcome));
            }
            if proofs == 0 {
                break;
            }
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
    let solution = Solution::new(shares, limits, cost);
    if solution.proofs == 0 || solution.shares.len() > MAX_EXACT_PARTS {
        return solution;
    }
    joined(
        solution,
        |part| groups.get(part).map_or_else(|| &values[part - first_value..][..1], Vec::as_slice),
        limits,
        cost,
    )
}

/// Joins some of a few requests, or sends them in another form, if that saves more time for proofs.
fn joined<'p>(solution: Solution, part: impl Fn(usize) -> &'p [Cells], limits: &Limits, cost: &CostModel) -> Solution {
    let cells = |(_, parts): &Share| sorted(parts.iter().flat_map(|n| part(*n)));
    let whole: Vec<Part> = solution.shares.iter().map(cells).collect();
    if !whole.iter().all(|cells| Draft::cheapest(cells, limits, cost).is_some()) {
        return solution;
    }
    let joined = solve_exact(&whole, &[], limits, cost);
    if joined.price() >= solution.price() {
        return solution;
    }
    let parts_of = |requests: &[usize]| requests.iter().flat_map(|n| solution.shares[*n].1.iter().copied()).collect();
    let shares = joined.shares.into_iter().map(|(draft, requests)| (draft, parts_of(&requests))).collect();
    Solution { shares, ..joined }
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
