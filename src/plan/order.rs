//! The order of the requests of a plan: that with the least time for proofs.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use super::cost::CostModel;
use super::layout::Draft;
use super::limits::Limits;
use super::proofs::{Exchange, ProofPrices, ReplyShape};
use super::solve::MAX_EXACT_PARTS;
use super::solve::sequence::{self, Candidate};

/// Returns the exchanges of these requests.
pub(super) fn exchanges<'d>(
    drafts: impl Iterator<Item = &'d Draft> + Clone,
    limits: &Limits,
    cost: &CostModel,
) -> Vec<Exchange> {
    let mut count: BTreeMap<ReplyShape, usize> = BTreeMap::new();
    for draft in drafts.clone() {
        *count.entry(ReplyShape::of(draft, cost)).or_default() += 1;
    }
    let exchange = |draft| {
        let shape = ReplyShape::of(draft, cost);
        // The other spelling takes longer to find.
        if count.get(&shape) == Some(&1) { Exchange::distinct(shape) } else { Exchange::of(draft, limits, cost) }
    };
    drafts.map(exchange).collect()
}

/// Returns the order in which the requests are sent, as indices, and the price of their proofs.
///
/// Up to eight requests, no order is cheaper. Requests that need no proofs stay as they are.
pub(super) fn cheapest_order(exchanges: &[Exchange], prices: ProofPrices) -> (Vec<usize>, u64) {
    let given: Vec<usize> = (0..exchanges.len()).collect();
    let price = price(exchanges, &given, prices);
    if price == 0 {
        return (given, 0);
    }
    if exchanges.len() <= MAX_EXACT_PARTS {
        let mut candidates: Vec<Vec<Candidate>> = vec![Vec::new(); 1 << exchanges.len()];
        for (n, exchange) in exchanges.iter().enumerate() {
            candidates[1 << n].push(Candidate { cost: 0, exchange: *exchange });
        }
        let cheaper = sequence::cheapest(&candidates, prices, price);
        let order = |(set, _): &(usize, usize)| set.trailing_zeros() as usize;
        return match cheaper {
            Some(sequence) => (sequence.steps.iter().map(order).collect(), sequence.price),
            None => (given, price),
        };
    }
    let interleaved = cheap_order(exchanges, prices);
    if interleaved.1 < price { interleaved } else { (given, price) }
}

/// Returns an order of many requests that is mostly the cheapest, and its price. O(n log n).
///
/// The shape with the most requests left goes next, unless it went before. The last request has a
/// shape of its own, or, if there is none, another spelling with a shape of its own.
pub(super) fn cheap_order(exchanges: &[Exchange], prices: ProofPrices) -> (Vec<usize>, u64) {
    let orders = ends(exchanges).into_iter().map(|end| interleaved(exchanges, &end));
    let priced = orders.map(|order| (price(exchanges, &order, prices), order));
    let (price, order) = priced.min_by_key(|(price, _)| *price).unwrap_or_default();
    debug_assert_eq!(order.iter().collect::<BTreeSet<_>>().len(), exchanges.len(), "each request once");
    (order, price)
}

/// Returns the price of the proofs of requests in this order.
fn price(exchanges: &[Exchange], order: &[usize], prices: ProofPrices) -> u64 {
    let (mut price, mut last, mut is_repeated) = (0_u64, None, false);
    let mut shapes: BTreeSet<ReplyShape> = BTreeSet::new();
    for exchange in order.iter().filter_map(|n| exchanges.get(*n)) {
        let (proof, shape) = exchange.behind(last, prices);
        price = price.saturating_add(proof);
        last = Some(shape);
        is_repeated = !shapes.insert(shape);
    }
    price.saturating_add(prices.end(is_repeated))
}

/// Returns the requests that may go last, in their order: those that save the check at the end.
fn ends(exchanges: &[Exchange]) -> Vec<Vec<usize>> {
    let mut by_shape: BTreeMap<ReplyShape, Vec<usize>> = BTreeMap::new();
    for (n, exchange) in exchanges.iter().enumerate() {
        by_shape.entry(exchange.shape).or_default().push(n);
    }
    let has_own_shape = |exchange: &Exchange| by_shape.get(&exchange.shape).is_some_and(|all| all.len() == 1);
    if let Some(last) = exchanges.iter().rposition(has_own_shape) {
        return vec![vec![last]];
    }
    let has_own_spelling = |(n, exchange): (usize, &Exchange)| {
        let (price, shape) = exchange.other()?;
        let before = by_shape.get(&exchange.shape)?.iter().find(|other| **other != n)?;
        (!by_shape.contains_key(&shape)).then_some((price, vec![*before, n]))
    };
    let pair = exchanges.iter().enumerate().filter_map(has_own_spelling).min();
    [Some(Vec::new()), pair.map(|(_, pair)| pair)].into_iter().flatten().collect()
}

/// Returns an order with few neighbours of one shape, and with these requests at the end.
fn interleaved(exchanges: &[Exchange], end: &[usize]) -> Vec<usize> {
    let mut by_shape: BTreeMap<ReplyShape, Vec<usize>> = BTreeMap::new();
    for (n, exchange) in exchanges.iter().enumerate().filter(|(n, _)| !end.contains(n)) {
        by_shape.entry(exchange.shape).or_default().push(n);
    }
    // Those that are left without a neighbour of another shape have the cheapest spellings.
    let price = |n: &usize| exchanges.get(*n).and_then(Exchange::other).map_or(u64::MAX, |(price, _)| price);
    by_shape.values_mut().for_each(|all| all.sort_by_key(|n| Reverse(price(n))));
    let mut heap: BinaryHeap<(usize, Reverse<usize>, ReplyShape)> =
        by_shape.iter().filter_map(|(shape, all)| Some((all.len(), Reverse(*all.first()?), *shape))).collect();
    let mut order = Vec::with_capacity(exchanges.len());
    let mut waiting = None;
    while let Some((left, _, shape)) = heap.pop() {
        let all = by_shape.get(&shape).map(Vec::as_slice).unwrap_or_default();
        let at = all.len().saturating_sub(left);
        order.extend(all.get(at));
        heap.extend(waiting.take());
        let next = all.get(at + 1).map(|next| (left - 1, Reverse(*next), shape));
        if heap.is_empty() { heap.extend(next) } else { waiting = next }
    }
    order.extend(end);
    order
}
