//! Places one-scan groups, among many values.

use super::super::cost::CostModel;
use super::super::layout::{Cells, Draft};
use super::super::limits::Limits;
use super::pack::pack_mixed;
use super::{Outcome, Part, Share, sorted};

/// A mixed read that is being filled.
#[derive(Clone, Debug, Default)]
pub(super) struct Bin {
    pub(super) parts: Vec<usize>,
    pub(super) cells: Vec<Cells>,
    pub(super) units: u32,
}

impl Bin {
    /// Adds a group if there is a mixed read with it.
    fn add(&mut self, part: usize, group: &[Cells], limits: &Limits, cost: &CostModel) -> bool {
        let cells = sorted(self.cells.iter().chain(group));
        let Some(draft) = Draft::mixed(&cells, limits, cost) else { return false };
        self.parts.push(part);
        self.cells.extend(group);
        self.units = draft.mixed_units();
        true
    }
}

/// Places groups as runs, joined where that is cheaper, or in mixed reads that have room.
pub(super) fn place_groups(groups: &[Part], limits: &Limits, cost: &CostModel) -> (Vec<Share>, Vec<Bin>) {
    let mut runs: Vec<(Cells, Vec<usize>)> = Vec::new();
    let mut bins: Vec<Bin> = Vec::new();
    for (n, group) in groups.iter().enumerate() {
        match Draft::cheapest(group, limits, cost) {
            Some(Draft::Run(run)) => runs.push((run, vec![n])),
            Some(Draft::Mixed(_)) | None => {
                // Only the last few bins, so that the time stays linear.
                let mut open = bins.iter_mut().rev().take(8);
                if !open.any(|bin| bin.add(n, group, limits, cost)) {
                    let mut bin = Bin::default();
                    let fits = bin.add(n, group, limits, cost);
                    debug_assert!(fits, "each group fits in a request");
                    bins.push(bin);
                }
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

/// Moves a group from each mixed read whose reply has the length of the one before to further ones.
pub(super) fn varied_bins(bins: &[Bin], groups: &[Part], limits: &Limits, cost: &CostModel) -> Vec<Bin> {
    let length = |bin: &Bin| Draft::mixed(&sorted(bin.cells.iter()), limits, cost).map(|draft| draft.bytes(cost).1);
    let mut varied: Vec<Bin> = Vec::with_capacity(bins.len());
    let mut further: Vec<Bin> = Vec::new();
    let mut length_before = None;
    for bin in bins {
        let here = length(bin);
        let Some((moved, kept)) = bin.parts.split_last().filter(|(_, kept)| !kept.is_empty() && here == length_before)
        else {
            length_before = here;
            varied.push(bin.clone());
            continue;
        };
        let mut rest = Bin::default();
        let fits = kept.iter().all(|part| rest.add(*part, &groups[*part], limits, cost));
        let mut alone = Bin::default();
        // Fewer groups may be ambiguous in the binary framing.
        if !fits || !alone.add(*moved, &groups[*moved], limits, cost) {
            varied.push(bin.clone());
            continue;
        }
        length_before = length(&rest);
        varied.push(rest);
        if !further.last_mut().is_some_and(|last| last.add(*moved, &groups[*moved], limits, cost)) {
            further.push(alone);
        }
    }
    varied.extend(further);
    varied
}

/// Assigns values to the runs of groups that contain them, and returns the others. Both are sorted.
pub(super) fn absorb_into_runs(values: Vec<(usize, Cells)>, shares: &mut [Share]) -> Vec<(usize, Cells)> {
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

/// Closes a bin with groups. Values that make its list ambiguous are packed elsewhere.
pub(super) fn close_bin(bin: Bin, limits: &Limits, cost: &CostModel, shares: &mut Outcome) {
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
