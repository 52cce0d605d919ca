//! The order of the stages, and run control: when to look, stop and run.

use self::ControlStage::{LastLook, Look, Ready, Run};
use super::ElementStage::{self, Check, Compare, Forced, Verify, Write};
use super::{RestoreGoal, RestoreStage, Restoring};
use crate::backup::RestoreFailure;
use crate::backup::options::IfRunning;
use crate::backup::target::{ElementState, Target};
use crate::transfer::{PlcState, RunEvent};

/// A stage whose requests are those of run control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::backup) enum ControlStage {
    Look,
    /// Just before the first write: is the PLC still stopped? A PLC that runs is stopped here, if
    /// that is chosen and was not done before.
    Ready,
    /// Was the PLC stopped all the time?
    LastLook,
    Run,
}

impl Restoring {
    /// Enters a stage of run control.
    pub(super) fn control(&mut self, stage: ControlStage) {
        self.stage = RestoreStage::Control(stage);
        match stage {
            Look => self.control.first_look(),
            Ready if self.control.plc() == PlcState::Running => self.control.stop(),
            Ready if self.options.if_running == IfRunning::Stop && !self.control.was_stopped() => self.control.halt(),
            Ready | LastLook => self.control.look(),
            Run => self.control.run(),
        }
        self.queue(Vec::new());
    }

    /// Leaves a stage whose elements are settled.
    pub(super) fn leave(&mut self, stage: ElementStage) -> Result<(), RestoreFailure> {
        let runs = self.control.plc() == PlcState::Running;
        let must_be_stopped = self.options.if_running != IfRunning::Continue;
        match stage {
            Compare => {
                let count = self.count(|state| matches!(state, ElementState::NotGiven(_)));
                if count > 0 {
                    return Err(RestoreFailure::NotThere { count });
                }
                self.read_or_write(Forced);
            }
            Forced if self.goal == RestoreGoal::Compare => self.stage = RestoreStage::Done,
            Forced if must_be_stopped && self.count(ElementState::differs) > 0 => {
                // The comparison has taken time: a PLC that was stopped may run now.
                self.control(Ready);
            }
            Forced => self.read_or_write(Write),
            Write | Check if self.has_sent() => self.read_or_write(Verify),
            Write | Check | Verify if must_be_stopped && !runs => self.control(LastLook),
            Write | Check | Verify => self.end()?,
        }
        Ok(())
    }

    /// Returns whether a write was sent in this run, and its elements are settled.
    fn has_sent(&self) -> bool {
        let sent = |state| matches!(state, ElementState::Written | ElementState::InDoubt | ElementState::NotTaken(_));
        self.count(sent) > 0
    }

    /// All elements are read back, and the state of the PLC is as it should be.
    fn end(&mut self) -> Result<(), RestoreFailure> {
        if !self.remaining.is_empty() {
            return Err(RestoreFailure::Differs { count: self.remaining.len() });
        }
        let run = self.options.run_again && self.control.is_run_due();
        if run {
            self.control(Run);
        } else {
            self.stage = RestoreStage::Done;
        }
        Ok(())
    }

    pub(super) fn controlled(&mut self, stage: ControlStage, event: RunEvent) -> Result<(), RestoreFailure> {
        match (stage, event) {
            (Look, RunEvent::Seen(running)) => {
                if running {
                    self.control.forget_stop();
                }
                if running && self.options.if_running == IfRunning::Refuse {
                    return Err(RestoreFailure::Running);
                }
                self.read_or_write(Compare);
            }
            (Ready, RunEvent::Obeyed) => {
                // Elements may have changed until the PLC stopped.
                self.targets.iter_mut().for_each(Target::forget);
                self.read_or_write(Compare);
            }
            (Ready, RunEvent::Seen(false)) => self.read_or_write(Write),
            (Ready, RunEvent::Seen(true)) => match self.options.if_running {
                // It was stopped before.
                IfRunning::Stop => return Err(self.set_running()),
                IfRunning::Continue | IfRunning::Refuse => return Err(RestoreFailure::Running),
            },
            (LastLook, RunEvent::Seen(true)) if self.has_sent() => return Err(self.set_running()),
            (LastLook, RunEvent::Seen(true)) if self.options.if_running == IfRunning::Refuse => {
                return Err(RestoreFailure::Running);
            }
            // A PLC that runs holds all elements, and this run has written none.
            (LastLook, RunEvent::Seen(_)) => self.end()?,
            (LastLook, RunEvent::Failed(failure)) => {
                self.control.forget_status();
                // Of two failures the first one is reported.
                return Err(match self.remaining.len() {
                    0 => failure.into(),
                    count => RestoreFailure::Differs { count },
                });
            }
            (Run, RunEvent::Obeyed) => self.stage = RestoreStage::Done,
            (_, RunEvent::Failed(failure)) => return Err(failure.into()),
            (stage, event @ (RunEvent::Seen(_) | RunEvent::Obeyed | RunEvent::Secured)) => {
                debug_assert!(false, "{event:?} in {stage:?}");
            }
        }
        Ok(())
    }

    /// Another client has started the PLC and may need it: it is not stopped again, and not started
    /// by a later run.
    fn set_running(&mut self) -> RestoreFailure {
        self.control.leave_to_others();
        RestoreFailure::SetRunning { differing: self.remaining.len() }
    }
}
