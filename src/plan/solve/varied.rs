//! Lengths of requests for many values: neighbours of different lengths need no proofs.

use super::super::cost::CostModel;
use super::super::layout::{Cells, Draft};
use super::super::limits::Limits;
use super::{Outcome, Share};

/// The lengths of requests for many values.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Lengths {
    /// As long as the limits allow.
    Longest,
    /// Shorter by a value than that, where the request before has the same length.
    Varied,
}

/// Returns the units that a mixed read has more with this value behind another one. They are sorted.
pub(super) fn units_behind(last: Option<&(usize, Cells)>, value: Cells) -> u32 {
    let shared = match last {
        Some((_, last)) if last.area == value.area => last.end().saturating_sub(value.first).min(value.len),
        Some(_) | None => 0,
    };
    (value.len - shared) * value.area.units()
}

/// Returns the bytes of values in the reply of a mixed read. They are sorted.
pub(super) fn value_bytes(values: &[(usize, Cells)], cost: &CostModel) -> usize {
    let mut last: Option<&(usize, Cells)> = None;
    let mut bytes = 0;
    for value in values {
        let cells = units_behind(last, value.1) / value.1.area.units();
        bytes += cells as usize * cost.value_bytes(value.1.area.width());
        last = Some(value);
    }
    bytes
}

/// Divides runs that adjoin, so that no two neighbours have one length.
///
/// The values are those of the area. Values that lie across the joint of two runs may be left to a mixed
/// read.
pub(super) fn varied_runs(mut runs: Outcome, values: &[(usize, Cells)], limits: &Limits) -> Outcome {
    let span = |(draft, _): &Share| match draft {
        Draft::Run(run) => Some((run.first, run.end())),
        Draft::Mixed(_) => None,
    };
    runs.sort_unstable_by_key(span);
    let adjoin = |a: &Share, b: &Share| span(a).zip(span(b)).is_some_and(|(a, b)| b.0 <= a.1);
    let mut varied = Outcome::new();
    for chain in runs.chunk_by(adjoin) {
        let lengths: Vec<u32> = chain.iter().filter_map(span).map(|(first, end)| end - first).collect();
        if lengths.windows(2).all(|pair| matches!(pair, [a, b] if a != b)) {
            varied.extend(chain.iter().cloned());
            continue;
        }
        let first = chain.first().and_then(span).map_or(0, |(first, _)| first);
        let start = values.partition_point(|(_, value)| value.first < first);
        let mut rest = values.get(start..).unwrap_or_default().iter();
        let parts = || chain.iter().flat_map(|(_, parts)| parts);
        // Both are in the order of their cells.
        let chosen: Vec<(usize, Cells)> = parts().map_while(|part| rest.find(|(n, _)| n == part).copied()).collect();
        let has_all = chosen.len() == parts().count();
        debug_assert!(has_all, "the runs have the order of the values");
        varied.extend(if has_all { varied_chain(&chosen, limits) } else { chain.to_vec() });
    }
    varied
}

/// Divides values without gaps between them into runs, each as long as the limits allow, or shorter by
/// a value if it would have the length of the one before.
fn varied_chain(values: &[(usize, Cells)], limits: &Limits) -> Outcome {
    let mut runs = Outcome::new();
    let mut run: Vec<(usize, Cells)> = Vec::new();
    let mut length_before = None;
    let mut close = |run: &mut Vec<(usize, Cells)>, may_vary: bool| {
        let Some((_, first)) = run.first().copied() else { return };
        let length = |run: &[(usize, Cells)]| run.last().map_or(0, |(_, last)| last.end() - first.first);
        let is_varied = may_vary && run.len() > 1 && length_before == Some(length(run));
        let next = if is_varied { run.pop() } else { None };
        let len = length(run);
        length_before = Some(len);
        runs.push((Draft::Run(Cells { len, ..first }), run.iter().map(|(n, _)| *n).collect()));
        run.clear();
        run.extend(next);
    };
    for (n, value) in values {
        if run.last().is_some_and(|(_, last)| !limits.has_no_ranges() && last.must_split_from(*value, limits)) {
            close(&mut run, false);
        }
        let is_full = |run: &[(usize, Cells)]| {
            run.first().is_some_and(|(_, first)| value.end() - first.first > value.area.max_run(limits))
        };
        if is_full(&run) {
            close(&mut run, true);
        }
        // Two values may be too long for one run.
        if is_full(&run) {
            close(&mut run, false);
        }
        run.push((*n, *value));
    }
    close(&mut run, false);
    runs
}
