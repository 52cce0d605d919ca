//! A writing as a [`Job`](crate::link::job::Job): what was read is confirmed before it is acted upon.
//!
//! Only what reads belongs to the job: what has become of a write, the page that is read back tells.

use super::states::State;
use super::{Goal, PlcState, ProgramAction, Writing};
use crate::error::Error;

/// Where a request stands: a writing can go back there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::program) struct Mark {
    state: State,
    looked_at: usize,
    written: usize,
}

/// The continuation of a writing when all that was read is confirmed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Then {
    /// All pages have been compared.
    Compared,
    /// A PLC that runs holds a half.
    SetRunning,
    /// It runs, or does not.
    Flags(bool),
    /// All pages have been read once more.
    Verified,
    /// The next page is read. It should be equal to the one before, so its reply is told from a duplicate only behind a check.
    NextPage,
}

impl Writing {
    /// The mark of what is asked for now.
    pub(in crate::program) fn mark(&self) -> Mark {
        Mark { state: self.state, looked_at: self.looked_at.len(), written: self.written.len() }
    }

    /// Takes the result of [`Step::Confirm`](super::Step::Confirm): `Some` is the mark of the first result that is not good.
    pub(in crate::program) fn confirmed(&mut self, result: Result<Option<Mark>, Error>) {
        let then = self.confirms.take();
        if !matches!(result, Ok(None)) && matches!(then, Some(Then::Flags(_))) {
            self.plc = PlcState::Unknown;
        }
        match (result, then) {
            (Ok(None), then) => {
                self.all_good();
                match then {
                    Some(Then::Compared) => self.all_compared(),
                    Some(Then::SetRunning) => {
                        self.sort_out();
                        self.stop_again();
                    }
                    Some(Then::Flags(running)) => self.flags(running),
                    Some(Then::Verified) => self.verified(),
                    Some(Then::NextPage) | None => {}
                }
            }
            (Ok(Some(mark)), _) => self.rewind(mark),
            (Err(error), _) => self.lost_at(ProgramAction::Confirm, error),
        }
    }

    /// Results from this mark on are not good: they are read again.
    pub(in crate::program) fn rewind(&mut self, mark: Mark) {
        self.confirms = None;
        match self.state {
            State::Fit => {}
            State::Kind | State::Compare(_) => {
                if let State::Compare(page) = self.state
                    && !self.looked_at.iter().any(|&(looked_at, _)| looked_at == page)
                {
                    self.uncompared.push(page);
                }
                if matches!(mark.state, State::Compare(_)) {
                    let again = self.looked_at.drain(mark.looked_at.min(self.looked_at.len())..).rev();
                    self.uncompared.extend(again.map(|(page, _)| page));
                    if let Some(page) = self.uncompared.pop() {
                        self.state = State::Compare(page);
                    }
                } else {
                    // The status and the header come first.
                    self.looked_at.clear();
                    self.pending.clear();
                    self.state = State::Fit;
                }
            }
            State::Look
            | State::Stop { .. }
            | State::Stopped { .. }
            | State::StopPause { .. }
            | State::Write { .. }
            | State::ReadBack { .. }
            | State::Refused
            | State::Check
            | State::Final => self.read_back_from(mark.written),
            State::Verify(page) => {
                let from = if let State::Verify(first) = mark.state { first.min(page) } else { 0 };
                self.looked_at.retain(|&(page, _)| page < from);
                self.state = State::Verify(from);
            }
            // Asked again.
            State::Run { .. }
            | State::Running { .. }
            | State::RunPause { .. }
            | State::LastLook
            | State::StopAgain { .. }
            | State::StoppedAgain { .. }
            | State::StopAgainPause { .. }
            | State::Done
            | State::Failed => {}
        }
    }

    /// The results of a job that has failed are not good from this mark on: the pages written since are not said to be.
    pub(in crate::program) fn distrust(&mut self, mark: Option<Mark>) {
        if let Some(mark) = mark.filter(|_| self.goal == Goal::Write) {
            self.take_back(mark.written);
        }
    }

    fn all_good(&mut self) {
        self.unconfirmed = false;
        // Written and read back, or the same before.
        self.touched &= !self.whole();
    }

    /// Pages that were written are to be read back again, from this one on. Before that it is looked at whether the PLC is still
    /// stopped.
    fn read_back_from(&mut self, written: usize) {
        self.to_read_back.extend(self.in_doubt);
        let any = self.take_back(written) || self.in_doubt.is_some();
        if any {
            self.state = if self.pending.is_empty() { State::Final } else { State::Check };
        } else if matches!(self.state, State::Write { .. } | State::ReadBack { .. }) {
            self.state = State::Check;
        }
        // Else the status is asked for again.
    }

    /// These pages are no longer said to be written; says whether there are any.
    fn take_back(&mut self, written: usize) -> bool {
        let again = self.written.split_off(written.min(self.written.len()));
        let any = !again.is_empty();
        self.touched |= any;
        self.to_read_back.extend(&again);
        // The first of them comes first.
        self.pending.extend(again.into_iter().rev());
        any
    }
}
