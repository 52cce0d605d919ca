//! The order of the requests of a plan: neighbours have replies of different shapes.

use std::collections::BTreeMap;

use super::PlannedRequest;
use crate::command::Code;

/// The shape of a reply, as far as it tells replies apart: the command, and the length.
type ReplyShape = (Code, usize);

fn shape(planned: &PlannedRequest) -> ReplyShape {
    (planned.request.code(), planned.reply_bytes)
}

/// Returns the order in which the requests are sent, as indices.
///
/// The last request has a shape of its own, if there is one: then no check ends the job. Among the
/// others, no two neighbours have replies of one shape, if that is possible: between such requests the
/// link sends a check or another spelling. Requests that are in such an order stay as they are.
pub(super) fn distinct_order(requests: &[PlannedRequest]) -> Vec<usize> {
    let mut by_shape: BTreeMap<ReplyShape, Vec<usize>> = BTreeMap::new();
    for (n, planned) in requests.iter().enumerate() {
        by_shape.entry(shape(planned)).or_default().push(n);
    }
    let has_one = |planned: &PlannedRequest| by_shape.get(&shape(planned)).is_some_and(|all| all.len() == 1);
    let last = requests.iter().rposition(has_one);
    let is_distinct = requests.windows(2).all(|pair| matches!(pair, [a, b] if shape(a) != shape(b)));
    if is_distinct && last.is_none_or(|last| last + 1 == requests.len()) {
        return (0..requests.len()).collect();
    }
    // The shape with the most requests left goes next, unless it went before. A heap of counts.
    let mut heap: std::collections::BinaryHeap<(usize, std::cmp::Reverse<usize>, ReplyShape)> = by_shape
        .iter()
        .filter(|(_, all)| last.is_none_or(|last| !all.contains(&last)))
        .filter_map(|(shape, all)| Some((all.len(), std::cmp::Reverse(*all.first()?), *shape)))
        .collect();
    let mut order = Vec::with_capacity(requests.len());
    let mut waiting = None;
    let mut taken: BTreeMap<ReplyShape, usize> = BTreeMap::new();
    while let Some((left, _, shape)) = heap.pop() {
        let at = taken.entry(shape).or_default();
        order.extend(by_shape.get(&shape).and_then(|all| all.get(*at)));
        *at += 1;
        heap.extend(waiting.take());
        let next = by_shape.get(&shape).and_then(|all| all.get(*at)).copied();
        let next = next.map(|next| (left - 1, std::cmp::Reverse(next), shape));
        if heap.is_empty() { heap.extend(next) } else { waiting = next }
    }
    order.extend(last);
    assert_eq!(order.len(), requests.len(), "each request once: values are found by the place of theirs");
    order
}
