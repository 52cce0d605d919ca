//! A restoring as a [`Job`](crate::link::job::Job): what was read is confirmed before it is acted upon.
//!
//! Marks are states. A state begins again as a whole if a duplicate came among its replies.

use super::{Goal, Mark, Reply, Restoring, State};
use crate::backup::RestoreFailure;
use crate::backup::restore::IfRunning;
use crate::backup::target::{Slot, Target};
use crate::command::Value;
use crate::error::Error;
use crate::program::PlcState;

/// The continuation of a restoring when all that was read is confirmed.
#[derive(Clone, Debug)]
pub(super) enum Then {
    /// The state is left.
    Leave,
    /// The PLC has said whether it runs.
    Look(Reply),
    /// A write without an answer has been read back.
    Checked(Vec<Value>),
}

impl Restoring {
    /// The mark of what is asked for now.
    pub(in crate::backup) fn mark(&self) -> State {
        self.state
    }

    /// Whether a reply may have one element fewer than the chunk that is asked for.
    pub(in crate::backup) fn takes_shorter(&self) -> bool {
        self.state.reads()
    }

    /// Takes the result of [`Step::Confirm`](super::Step::Confirm): `Some` is the mark of the first result that is not good.
    pub(in crate::backup) fn confirmed(&mut self, result: Result<Option<State>, Error>) -> Result<(), RestoreFailure> {
        let then = self.confirms.take();
        match (result, then) {
            (Ok(None), Some(Then::Leave)) => {
                self.settle_doubts();
                self.leave()
            }
            (Ok(None), Some(Then::Look(reply))) => self.look(Ok(reply)),
            (Ok(None), Some(Then::Checked(values))) => {
                if let Some(chunk) = self.chunks.next() {
                    self.checked(chunk, &values);
                }
                Ok(())
            }
            (Ok(None), None) => Ok(()),
            (Ok(Some(mark)), _) => {
                self.rewind(mark);
                Ok(())
            }
            (Err(error), Some(Then::Look(_))) => {
                self.plc = PlcState::Unknown;
                self.look(Err(error))
            }
            (Err(source), _) => Err(RestoreFailure::Call { doing: "confirming what was read".to_owned(), source }),
        }
    }

    /// Results from this mark on are not good: the state begins again.
    pub(in crate::backup) fn rewind(&mut self, mark: State) {
        self.confirms = None;
        match self.state {
            State::Compare => {
                self.targets.iter_mut().chain(&mut self.left_out).for_each(Target::forget);
                match mark {
                    State::Look => self.enter(State::Look),
                    // It was told to stop, and whether it has is looked at again.
                    State::Stopped => self.state = State::Stopped,
                    State::Stop
                    | State::PauseToStop
                    | State::Compare
                    | State::Forced
                    | State::Ready
                    | State::Write
                    | State::Check
                    | State::Verify
                    | State::LastLook
                    | State::Run
                    | State::Running
                    | State::PauseToRun
                    | State::Done => self.enter(State::Compare),
                }
            }
            State::Forced => {
                self.targets.iter_mut().flat_map(|target| &mut target.slots).for_each(unforce);
                self.enter(State::Forced);
            }
            // The answer to the write may be another's. What became of these is read back in the end.
            State::Write => {
                self.doubt();
                if let Some(chunk) = self.chunks.next() {
                    self.settled(chunk);
                }
            }
            State::Check => {
                if mark == State::Write {
                    self.doubt();
                }
            }
            State::Verify => self.verify_again(),
            State::LastLook => {
                if matches!(mark, State::Write | State::Verify) {
                    self.verify_again();
                }
            }
            // Asked again.
            State::Look
            | State::Stop
            | State::Stopped
            | State::PauseToStop
            | State::Ready
            | State::Run
            | State::Running
            | State::PauseToRun
            | State::Done => {}
        }
    }

    /// Whether the PLC runs is known and confirmed, or there was no answer.
    pub(super) fn look(&mut self, reply: Result<Reply, Error>) -> Result<(), RestoreFailure> {
        match self.state {
            State::Ready => match (self.running(reply)?, self.options.if_running) {
                (false, _) => self.enter(State::Write),
                (true, IfRunning::Stop) if self.was_stopped => return Err(self.set_running()),
                (true, IfRunning::Stop) => {
                    self.ran = true;
                    self.enter(State::Stop);
                }
                (true, IfRunning::GoOn | IfRunning::Refuse) => return Err(RestoreFailure::Running),
            },
            State::LastLook => self.looked(reply)?,
            State::Running => match self.running(reply)? {
                true => self.enter(State::Done),
                false => self.again(State::PauseToRun, RestoreFailure::NotRunning)?,
            },
            State::Look
            | State::Stop
            | State::Stopped
            | State::PauseToStop
            | State::Compare
            | State::Forced
            | State::Write
            | State::Check
            | State::Verify
            | State::Run
            | State::PauseToRun
            | State::Done => {}
        }
        Ok(())
    }

    /// It has been written, and should have stood still.
    fn looked(&mut self, reply: Result<Reply, Error>) -> Result<(), RestoreFailure> {
        match self.running(reply) {
            Ok(false) => self.end(),
            Ok(true) if self.has_sent() => Err(self.set_running()),
            Ok(true) if self.options.if_running == IfRunning::Refuse => Err(RestoreFailure::Running),
            // It holds all, and this run has sent nothing.
            Ok(true) => self.end(),
            Err(failure) => {
                self.plc = PlcState::Unknown;
                // Of two failures the first one counts.
                let differing = self.remaining.len();
                Err(if differing > 0 { RestoreFailure::Differs { count: differing } } else { failure })
            }
        }
    }

    /// That these were written is not certain.
    fn doubt(&mut self) {
        let slots = self.targets.iter_mut().flat_map(|target| &mut target.slots);
        slots.filter(|slot| slot.mark == Mark::Written).for_each(|slot| slot.mark = Mark::Doubt);
    }

    /// All has been read back, which tells what has become of the writes that are in doubt.
    fn settle_doubts(&mut self) {
        if self.state != State::Verify {
            return;
        }
        for target in &mut self.targets {
            for (element, slot) in target.range.elements().zip(&mut target.slots) {
                let differs = || self.remaining.iter().any(|difference| difference.element == element);
                if slot.mark == Mark::Doubt && !differs() {
                    slot.mark = Mark::Written;
                }
            }
        }
    }

    fn verify_again(&mut self) {
        if self.goal == Goal::Restore {
            self.doubt();
            self.remaining.clear();
            self.enter(State::Verify);
        }
    }
}

/// As it was when it had been compared.
fn unforce(slot: &mut Slot) {
    if slot.mark == Mark::Forced {
        slot.mark = if slot.found == slot.wanted { Mark::Same } else { Mark::Differs };
    }
}
