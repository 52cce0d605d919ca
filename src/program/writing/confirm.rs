//! Checks and duplicates: what was read is used when it is confirmed, and read again otherwise.
//!
//! Only reads belong to the job. The result of a write shows in the page that is read back.

use super::{LookAt, WriteMark, WriteStage, Writing};
use crate::error::Error;
use crate::program::{ProgramAction, ProgramError};

/// An action that waits for a check, besides a status of run control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pending {
    AllCompared,
    /// The PLC runs and holds a half-written program.
    HalfRuns,
    AllVerified,
    /// The next page is to be read.
    NextPage,
}

impl Writing {
    pub(super) fn take_confirmation(&mut self, result: Result<(), Error>) {
        let pending = self.to_confirm.take();
        if result.is_ok() {
            self.unconfirmed = false;
            // Written and read back, or equal before.
            self.touched &= !self.whole();
        }
        match (result, pending) {
            (result, None) => {
                if let Some(event) = self.control.confirmed(result) {
                    self.controlled(event);
                }
            }
            (Ok(()), Some(Pending::AllCompared)) => self.all_compared(),
            (Ok(()), Some(Pending::HalfRuns)) => {
                self.sort_out();
                self.set_running();
            }
            (Ok(()), Some(Pending::AllVerified)) => self.all_verified(),
            (Ok(()), Some(Pending::NextPage)) => {}
            (Err(source), Some(_)) => self.give_up(ProgramError::Call { action: ProgramAction::Confirm, source }),
        }
    }

    pub(super) fn go_back(&mut self, mark: WriteMark) {
        self.to_confirm = None;
        match self.stage {
            WriteStage::Fit | WriteStage::Done | WriteStage::Failed => {}
            WriteStage::End(_) | WriteStage::Kind | WriteStage::LastPage | WriteStage::Compare(_) => {
                self.compare_from(mark);
            }
            WriteStage::Look(_) | WriteStage::Write { .. } | WriteStage::ReadBack { .. } => {
                self.read_back_from(mark.written);
            }
            WriteStage::Verify(page) => {
                let from = if let WriteStage::Verify(first) = mark.stage { first.min(page) } else { 0 };
                self.comparisons.retain(|&(page, _)| page < from);
                self.stage = WriteStage::Verify(from);
            }
            WriteStage::Run | WriteStage::Secure => self.control.rewind(),
        }
    }

    fn compare_from(&mut self, mark: WriteMark) {
        if let WriteStage::Compare(page) = self.stage
            && !self.comparisons.iter().any(|&(compared, _)| compared == page)
        {
            self.uncompared.push(page);
        }
        if matches!(mark.stage, WriteStage::Compare(_)) {
            let again = self.comparisons.drain(mark.compared.min(self.comparisons.len())..).rev();
            self.uncompared.extend(again.map(|(page, _)| page));
            if let Some(page) = self.uncompared.pop() {
                self.stage = WriteStage::Compare(page);
            }
        } else {
            // Status and header come first.
            self.comparisons.clear();
            self.pending.clear();
            self.stage = WriteStage::Fit;
        }
    }

    /// Written pages are read back again, from this one on, if the PLC is still stopped.
    fn read_back_from(&mut self, written: usize) {
        self.to_read_back.extend(self.in_doubt);
        let any = self.take_back(written) || self.in_doubt.is_some();
        let is_writing = matches!(self.stage, WriteStage::Write { .. } | WriteStage::ReadBack { .. });
        if any && self.pending.is_empty() {
            self.look(LookAt::End);
        } else if any || is_writing {
            self.look(LookAt::BetweenPages);
        } else {
            self.control.rewind();
        }
    }

    /// Pages from this one on no longer count as written. Returns whether there are any.
    pub(super) fn take_back(&mut self, written: usize) -> bool {
        let again = self.written.split_off(written.min(self.written.len()));
        let any = !again.is_empty();
        self.touched |= any;
        self.to_read_back.extend(&again);
        // The first of them comes first.
        self.pending.extend(again.into_iter().rev());
        any
    }
}
