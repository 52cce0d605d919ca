use std::fmt;

use super::{Difference, MissingRange};
use crate::error::ErrorCode;
use crate::file::{PlcDifference, listed};
use crate::tag::Tag;
use crate::transfer::PlcState;

/// How far the restoring of a backup has come.
///
/// Its `Display` is one line for people.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RestoreReport {
    /// The number of elements that were compared.
    pub compared: usize,
    /// Elements that differed before anything was written, with their values.
    pub differences: Vec<Difference>,
    /// Elements that were certainly written.
    pub written: Vec<Tag>,
    /// Elements that may have been written: they were sent, and not confirmed. Also those that a
    /// read then found different, until they are written again: the program may have changed them
    /// since.
    pub in_doubt: Vec<Tag>,
    /// Elements that differ and were never sent.
    pub unwritten: Vec<Tag>,
    /// Elements that a run would write now: those that differ, the other half of such a value, and
    /// [bridged](super::RestoreOptions::bridge) ones.
    pub to_write: Vec<Tag>,
    /// Elements that the PLC refused to read or to write.
    pub refused: Vec<RefusedRange>,
    /// Forced discretes that differ and were not written, and words and values of several words with
    /// such a discrete.
    pub forced: Vec<Tag>,
    /// Inputs, and contacts of timers and counters, which are never written.
    pub left_out: Vec<Tag>,
    /// Those of them that differ. Only [`Restore::compare`](super::Restore::compare) reads them.
    pub left_out_differences: Vec<Difference>,
    /// Special elements of the backup that a restore does not write, because
    /// [`SpecialElements::Write`](super::SpecialElements::Write) was not chosen. With
    /// [`SpecialElements::Skip`](super::SpecialElements::Skip) they were not compared either.
    pub special: Vec<Tag>,
    /// Elements without a value in the backup. They were neither compared nor written.
    pub missing: Vec<MissingRange>,
    /// How the PLC differs from the one that was read, as far as the backup states that: station
    /// number, model, version of the operating system. Empty until the status of the PLC is read.
    pub other_plc: Vec<PlcDifference>,
    /// Elements that did not hold their value when all were read back.
    pub remaining: Vec<Difference>,
    /// `true` if the PLC ran and was stopped, by this run or an earlier one of the same
    /// [`Restore`](super::Restore) that failed.
    pub was_stopped: bool,
    /// `true` if the PLC runs, by its last status. If it need not be stopped, that is the first
    /// status.
    pub plc: PlcState,
}

/// Consecutive elements that a PLC refused to read or to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RefusedRange {
    /// The elements.
    pub range: Tag,
    /// The reply of the PLC.
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
        if !self.special.is_empty() {
            write!(f, ", {} special not to be written", count(&self.special))?;
        }
        if !self.missing.is_empty() {
            let missing: usize = self.missing.iter().map(|missing| missing.range.element_count()).sum();
            write!(f, ", {missing} missing in the backup")?;
        }
        if !self.other_plc.is_empty() {
            write!(f, "; another PLC than that of the backup: {}", listed(&self.other_plc))?;
        }
        if self.was_stopped { write!(f, "; it was stopped, and {}", self.plc) } else { Ok(()) }
    }
}

fn count(ranges: &[Tag]) -> usize {
    ranges.iter().map(Tag::element_count).sum()
}
