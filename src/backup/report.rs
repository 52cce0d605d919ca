use std::fmt;

use super::{Difference, MissingRange};
use crate::error::ErrorCode;
use crate::program::PlcState;
use crate::tag::Tag;

/// How far a restoring came: what was found, written, and left out.
///
/// Its `Display` is a line for people.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RestoreReport {
    /// How many elements were compared.
    pub compared: usize,
    /// Those that were to be written, with what they held before.
    pub differences: Vec<Difference>,
    /// What was written for certain.
    pub written: Vec<Tag>,
    /// What may have been written: a request was sent, and not confirmed. Also what a read has then found to differ, until it is
    /// written again: something else may have changed it since.
    pub in_doubt: Vec<Tag>,
    /// What differs, with nothing known against it, and was never sent.
    pub unwritten: Vec<Tag>,
    /// What a run would write as it stands: what differs, the other half of a value of which one half does, and
    /// what is [bridged](super::RestoreOptions::bridge).
    pub to_write: Vec<Tag>,
    /// What the PLC refused to give when it was compared, or to take when it was written.
    pub refused: Vec<RefusedRange>,
    /// Forced discretes that differ, and were left as they are. Words, and values of two, with one in them, too.
    pub forced: Vec<Tag>,
    /// Inputs, and contacts of timers and counters, which are never written.
    pub left_out: Vec<Tag>,
    /// Those of them that differ. Only [`Restore::compare`](super::Restore::compare) looks at them.
    pub left_out_differences: Vec<Difference>,
    /// What the backup itself does not have. It was neither compared nor written.
    pub missing: Vec<MissingRange>,
    /// Elements that did not hold what they should when all was read once more.
    pub remaining: Vec<Difference>,
    /// Whether the PLC was running and has been stopped, by this run or by earlier ones of the same
    /// [`Restore`](super::Restore) that failed.
    pub was_stopped: bool,
    /// Whether it runs, as it last said: where it need not be stopped, in the beginning.
    pub plc: PlcState,
}

/// Consecutive elements that a PLC has refused to give or to take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RefusedRange {
    /// Which ones.
    pub range: Tag,
    /// What it answered.
    pub error: ErrorCode,
}

impl fmt::Display for RestoreReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { compared, differences, .. } = self;
        write!(f, "{compared} elements compared, {} differed, {} written", differences.len(), count(&self.written))?;
        for (ranges, what) in [(&self.in_doubt, "perhaps written"), (&self.unwritten, "not written")] {
            if !ranges.is_empty() {
                write!(f, ", {} {what}", count(ranges))?;
            }
        }
        if !self.forced.is_empty() {
            write!(f, ", {} left as they are forced", count(&self.forced))?;
        }
        if !self.missing.is_empty() {
            let missing: usize = self.missing.iter().map(|missing| missing.range.element_count()).sum();
            write!(f, ", {missing} missing in the backup")?;
        }
        if self.was_stopped { write!(f, "; it was stopped, and {}", self.plc) } else { Ok(()) }
    }
}

fn count(ranges: &[Tag]) -> usize {
    ranges.iter().map(Tag::element_count).sum()
}
