//! How far a writing has come: after its end, or when its future was dropped.

use std::collections::BTreeSet;

use super::{WriteStage, Writing};
use crate::program::{WriteReport, WriteState};
use crate::transfer::PlcState;

impl Writing {
    /// The report of a run that succeeded.
    pub(in crate::program) fn report(&self) -> WriteReport {
        let WriteState { written, written_before, was_stopped, plc, other_plc, .. } = self.state();
        let pages = self.program.page_count();
        WriteReport { written, written_before, pages, was_stopped, running: plc == PlcState::Running, other_plc }
    }

    /// The state at any time.
    pub(in crate::program) fn state(&self) -> WriteState {
        let (unwritten, in_doubt) = (self.unwritten(), self.in_doubt());
        let before = self.written_before.iter().copied();
        WriteState {
            written: self.written.clone(),
            written_before: before.filter(|page| !self.written.contains(page) && !unwritten.contains(page)).collect(),
            unwritten,
            touched: self.touched || !in_doubt.is_empty(),
            in_doubt: in_doubt.into_iter().collect(),
            whole: self.whole(),
            was_stopped: self.control.was_stopped(),
            plc: self.control.plc(),
            other_plc: self.other_plc.clone(),
        }
    }

    /// Pages to write, without those in doubt; before all are compared, those found by then.
    pub(super) fn unwritten(&self) -> Vec<u16> {
        let in_doubt = self.in_doubt();
        let comparisons = self.comparisons.iter().filter(|_| !self.compared);
        let found = comparisons.filter(|&&(page, differs)| self.is_to_be_written(page, differs));
        let pending = self.pending.iter().chain(found.map(|(page, _)| page)).copied();
        let pending = pending.filter(|page| !in_doubt.contains(page));
        let mut pages: Vec<u16> = pending.chain(self.differing.iter().copied()).collect();
        pages.sort_unstable();
        pages
    }

    /// Pages whose write was or is being sent, and whose content is not known.
    pub(super) fn in_doubt(&self) -> BTreeSet<u16> {
        // The future may be dropped while a page is sent.
        let current = if let WriteStage::Write { page, .. } = self.stage { Some(page) } else { self.in_doubt };
        self.to_read_back.iter().copied().chain(current).collect()
    }
}
