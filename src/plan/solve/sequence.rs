//! The cheapest sequence of requests for a few parts, with the proofs between and behind them.
//!
//! A sequence ends with a check, unless its last reply has a shape that no other reply of it has. So
//! there are two kinds of programs over the sets of parts that are read so far, whose states have the
//! shape of the last reply: one for sequences that end with a check, and one for each shape that the
//! last reply alone may have. The second ones are made in the order of their lower bounds.
//!
//! A program takes at most 3^n steps for each request that may read a set and each shape of a reply.

use std::collections::BTreeMap;

use super::super::proofs::{Exchange, ProofPrices, ReplyShape};

/// A request that may read a set of parts.
#[derive(Clone, Debug)]
pub(in crate::plan) struct Candidate {
    /// Its cost without a proof.
    pub(in crate::plan) cost: u64,
    pub(in crate::plan) exchange: Exchange,
}

/// Requests in the order in which they are sent.
#[derive(Debug)]
pub(in crate::plan) struct Sequence {
    /// With proofs.
    pub(in crate::plan) price: u64,
    /// The set of parts of each request, and the index of its candidate.
    pub(in crate::plan) steps: Vec<(usize, usize)>,
}

/// The first requests of a sequence.
#[derive(Clone, Copy, Debug)]
struct State {
    /// The shape of the last reply; `None`: no request yet.
    last: Option<ReplyShape>,
    cost: u64,
    /// The set of parts and the index of the state before.
    before: (usize, usize),
    /// The last request: its set of parts, and the index of its candidate.
    step: (usize, usize),
}

/// The states of a program for each set of parts.
type States = Vec<Vec<State>>;

/// Finds the cheapest sequence for all parts; `None` if its price is not below `limit`.
///
/// The index of `candidates` is a set of parts, with a bit for each.
pub(in crate::plan) fn cheapest(candidates: &[Vec<Candidate>], prices: ProofPrices, limit: u64) -> Option<Sequence> {
    let all = candidates.len().checked_sub(1).filter(|all| *all > 0)?;
    let search = Search { candidates, prices, least: least_costs(candidates), all };
    let mut limit = limit;
    let mut best = None;
    let with_check = search.states(None, limit);
    for (n, state) in with_check[all].iter().enumerate() {
        let price = state.cost.saturating_add(prices.end(state.before.0 != 0));
        if price < limit {
            limit = price;
            best = Some(Sequence { price, steps: trace(&with_check, (all, n)) });
        }
    }
    for (bound, own) in search.own_shapes(&with_check) {
        if bound >= limit {
            break;
        }
        let states = search.states(Some(own), limit);
        for (set, last) in candidates.iter().enumerate().take(all) {
            let rest = all ^ set;
            for (n, candidate) in last.iter().enumerate() {
                for (at, state) in states[rest].iter().enumerate() {
                    let (proof, shape) = candidate.exchange.behind(state.last, prices);
                    let price = state.cost.saturating_add(candidate.cost).saturating_add(proof);
                    if shape == own && price < limit {
                        limit = price;
                        let mut steps = trace(&states, (rest, at));
                        steps.push((set, n));
                        best = Some(Sequence { price, steps });
                    }
                }
            }
        }
    }
    best
}

/// Returns the least cost of the requests for each set of parts, without proofs.
pub(super) fn least_costs(candidates: &[Vec<Candidate>]) -> Vec<u64> {
    let cheapest: Vec<Option<u64>> =
        candidates.iter().map(|all| all.iter().map(|candidate| candidate.cost).min()).collect();
    let mut least = vec![0_u64];
    for set in 1..candidates.len() {
        let lowest = set & set.wrapping_neg();
        let others = set ^ lowest;
        let mut cost = u64::MAX;
        let mut some = others;
        loop {
            let request = some | lowest;
            if let Some(price) = cheapest[request] {
                cost = cost.min(price.saturating_add(least[set ^ request]));
            }
            if some == 0 {
                break;
            }
            some = (some - 1) & others;
        }
        least.push(cost);
    }
    least
}

struct Search<'c> {
    candidates: &'c [Vec<Candidate>],
    prices: ProofPrices,
    least: Vec<u64>,
    /// The set of all parts.
    all: usize,
}

impl Search<'_> {
    /// Runs the program for sequences without a reply of the shape `excluded`, as far as they may cost
    /// less than `limit`.
    fn states(&self, excluded: Option<ReplyShape>, limit: u64) -> States {
        let mut states: States = vec![Vec::new(); self.candidates.len()];
        states[0].push(State { last: None, cost: 0, before: (0, 0), step: (0, 0) });
        for set in 0..self.all {
            let rest = self.all ^ set;
            for at in 0..states[set].len() {
                let State { last, cost, .. } = states[set][at];
                let mut request = rest;
                while request != 0 {
                    let left = self.least[rest ^ request];
                    for (n, candidate) in self.candidates[request].iter().enumerate() {
                        let (proof, shape) = candidate.exchange.behind(last, self.prices);
                        let cost = cost.saturating_add(candidate.cost).saturating_add(proof);
                        if Some(shape) == excluded || cost.saturating_add(left) >= limit {
                            continue;
                        }
                        let next = State { last: Some(shape), cost, before: (set, at), step: (request, n) };
                        let known = states[set | request].iter_mut().find(|known| known.last == next.last);
                        match known {
                            Some(known) if known.cost <= cost => {}
                            Some(known) => *known = next,
                            None => states[set | request].push(next),
                        }
                    }
                    request = (request - 1) & rest;
                }
            }
        }
        states
    }

    /// Returns the shapes that a last reply may have, each with a lower bound of the sequences with it.
    /// The lowest one comes first.
    fn own_shapes(&self, with_check: &States) -> Vec<(u64, ReplyShape)> {
        let mut bounds: BTreeMap<ReplyShape, u64> = BTreeMap::new();
        for (set, last) in self.candidates.iter().enumerate().take(self.all) {
            let Some(before) = with_check[self.all ^ set].iter().map(|state| state.cost).min() else { continue };
            for candidate in last {
                let cost = before.saturating_add(candidate.cost);
                let plain = Some((cost, candidate.exchange.shape));
                let other = candidate.exchange.other().map(|(price, shape)| (cost.saturating_add(price), shape));
                for (bound, shape) in [plain, other].into_iter().flatten() {
                    bounds.entry(shape).and_modify(|least| *least = bound.min(*least)).or_insert(bound);
                }
            }
        }
        let mut bounds: Vec<(u64, ReplyShape)> = bounds.into_iter().map(|(shape, bound)| (bound, shape)).collect();
        bounds.sort_unstable();
        bounds
    }
}

/// Returns the requests that lead to a state.
fn trace(states: &States, (mut set, mut at): (usize, usize)) -> Vec<(usize, usize)> {
    let mut steps = Vec::new();
    while set != 0 {
        let State { before, step, .. } = states[set][at];
        steps.push(step);
        (set, at) = before;
    }
    steps.reverse();
    steps
}
