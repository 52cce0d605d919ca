//! The ends of a writing that fails. A half-written PLC is never left running.

use super::states::{Goal, State, Step};
use super::{CONTROL_TRIES, PlcState, ProgramAction, ProgramError, Writing};
use crate::error::Error;

impl Writing {
    /// A request brought no answer of use. It may be the only one that fails: before a half-written PLC is left alone, it is
    /// looked at once more.
    pub(super) fn lost(&mut self, source: Error) {
        let action = match self.next() {
            Step::Read(page) => ProgramAction::ReadPage(page),
            Step::Write(page) => ProgramAction::WritePage(page),
            Step::Stop => ProgramAction::Stop,
            Step::Run => ProgramAction::Run,
            _ => ProgramAction::ReadStatus,
        };
        self.lost_at(action, source);
    }

    pub(super) fn lost_at(&mut self, action: ProgramAction, source: Error) {
        // Of two failures the first one counts.
        let excuse = self.excuse.take();
        self.failure.get_or_insert_with(|| excuse.unwrap_or(ProgramError::Call { action, source }));
        let ending = matches!(self.state, State::LastLook | State::StoppedAgain { .. });
        let look = !ending && self.goal == Goal::Write && self.half_written();
        if self.state == State::LastLook {
            self.plc = PlcState::Unknown;
        }
        self.state = if look { State::LastLook } else { State::Failed };
    }

    /// It cannot go on, though the PLC answers: if anything has been done to it, it must not be running.
    pub(super) fn fail(&mut self, error: ProgramError) {
        self.failure = Some(error);
        // What does not fit is not the PLC that was written.
        let fits = !matches!(self.state, State::Fit | State::Kind);
        let look = fits && self.goal == Goal::Write && self.half_written();
        self.state = if look { State::LastLook } else { State::Failed };
    }

    /// No attempt has done it: for the reason that the last one gave, or for this one.
    pub(super) fn give_up(&mut self, error: ProgramError) {
        let excuse = self.excuse.take();
        self.fail(excuse.unwrap_or(error));
    }

    pub(super) fn stop_again(&mut self) {
        self.failure = Some(ProgramError::SetRunning);
        self.state = if self.goal == Goal::Write { State::StopAgain { left: CONTROL_TRIES } } else { State::Failed };
    }
}
