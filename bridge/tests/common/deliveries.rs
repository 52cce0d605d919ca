//! Checks of the batches that an output has delivered.

use std::collections::{BTreeMap, HashSet};

use serde_json::Value;

/// The result of a check.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Deliveries {
    /// Different batches.
    pub batches: usize,
    /// Batches that came more than once.
    pub duplicates: usize,
    /// Batches of the expected ones that did not come.
    pub lost: usize,
    /// Batches that came for the first time after a later one of the same PLC.
    pub out_of_order: usize,
    /// Batches that came again without the mark of a replay.
    pub unmarked: usize,
}

impl Deliveries {
    /// Checks batches, in the order in which they came, against the sequence numbers that each PLC should have.
    pub fn check<'b>(
        batches: impl IntoIterator<Item = (&'b str, &'b Value)>,
        expected: &BTreeMap<&str, std::ops::Range<u64>>,
    ) -> Self {
        let mut result = Self::default();
        let mut seen: BTreeMap<&str, HashSet<u64>> = BTreeMap::new();
        let mut highest: BTreeMap<&str, u64> = BTreeMap::new();
        for (plc, batch) in batches {
            let seq = batch["seq"].as_u64().unwrap();
            if !seen.entry(plc).or_default().insert(seq) {
                result.duplicates += 1;
                result.unmarked += usize::from(batch["hist"] != true);
                continue;
            }
            result.batches += 1;
            let highest = highest.entry(plc).or_insert(seq);
            result.out_of_order += usize::from(seq < *highest);
            *highest = seq.max(*highest);
        }
        for (plc, range) in expected {
            let seen = seen.get(plc);
            result.lost += range.clone().filter(|seq| !seen.is_some_and(|seen| seen.contains(seq))).count();
        }
        result
    }
}
