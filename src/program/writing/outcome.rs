//! How far a writing has come: after it has ended, and when it was abandoned.

use std::collections::BTreeSet;

use super::states::State;
use super::{PlcState, ProgramError, Writing};
use crate::program::{WriteProgramError, WriteReport, WriteState};

impl Writing {
    /// What was done, after [`Step::Done`](super::Step::Done).
    pub(in crate::program) fn report(&self) -> WriteReport {
        let WriteState { written, written_before, .. } = self.state();
        WriteReport {
            written,
            written_before,
            pages: self.program.header().page_count(),
            was_stopped: self.ran_before,
            running: self.plc == PlcState::Running,
        }
    }

    /// Why it went no further, after [`Step::Failed`](super::Step::Failed).
    pub(in crate::program) fn failure(&mut self) -> WriteProgramError {
        let source = self.failure.take().unwrap_or(ProgramError::NotRunning);
        WriteProgramError { source: Box::new(source), state: Box::new(self.state()) }
    }

    /// At any time.
    pub(in crate::program) fn state(&self) -> WriteState {
        let unwritten = self.unwritten();
        let before = self.written_before.iter().copied();
        WriteState {
            written: self.written.clone(),
            written_before: before.filter(|page| !self.written.contains(page) && !unwritten.contains(page)).collect(),
            unwritten,
            in_doubt: self.in_doubt().into_iter().collect(),
            touched: self.touched || !self.in_doubt().is_empty(),
            whole: self.whole(),
            was_stopped: self.ran_before,
            plc: match self.state {
                // Abandoned there, it may have been sent.
                State::Stop { .. } | State::StopAgain { .. } | State::Run { .. } => PlcState::Unknown,
                _ => self.plc,
            },
        }
    }

    /// The pages that are to be written, without those in doubt. Before all have been compared, those that were found by then.
    pub(super) fn unwritten(&self) -> Vec<u16> {
        let in_doubt = self.in_doubt();
        let found =
            self.looked_at.iter().filter(|_| !self.compared).filter(|&&looked_at| self.is_to_be_written(looked_at));
        let pending = self.pending.iter().chain(found.map(|(page, _)| page)).copied();
        let pending = pending.filter(|page| !in_doubt.contains(page));
        let mut pages: Vec<u16> = pending.chain(self.differing.iter().copied()).collect();
        pages.sort_unstable();
        pages
    }

    /// The pages whose write was sent, or is being sent, and that are not known to be as they should be.
    pub(super) fn in_doubt(&self) -> BTreeSet<u16> {
        let current = match self.state {
            // Abandoned there, it may have been sent.
            State::Write { .. } => self.pending.last().copied(),
            _ => self.in_doubt,
        };
        self.to_read_back.iter().copied().chain(current).collect()
    }
}
