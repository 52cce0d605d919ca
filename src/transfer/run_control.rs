//! STOP and RUN during a transfer, as a state machine without I/O and clock.
//!
//! ```text
//! look    Look (40) ─▶ Seen
//! stop    Stop (41) ─▶ Stopped? (40) ─▶ Obeyed       still running: pause, and Stop again
//! halt    Look (40) ─▶ Seen, or if it runs: as stop
//! run     Run (41) ──▶ Running? (40) ─▶ Obeyed       still stopped: pause, and Run again
//! secure  Look (40) ─▶ Secured, or if it runs: Stop (41) ⇄ Stopped? (40) ─▶ Secured
//! ```
//!
//! Inputs: the replies to the requests of [`next`](RunControl::next), and whether the held replies
//! are confirmed.
//!
//! Invariants:
//! - A status is used only when a check has confirmed it, except the first one of a run, which
//!   changes nothing in the PLC.
//! - The reply to STOP and RUN is no proof. The status decides, unless RUN is refused.
//! - From sending STOP or RUN until the next status, the state of the PLC is [`PlcState::Unknown`],
//!   unless the request certainly had no effect.
//! - STOP and RUN are sent at most `attempts` times each.
//! - A STOP that certainly had no effect, or that the PLC was not seen to obey before it runs
//!   again, does not count as a stop by this transfer. RUN is due only after a stop that counts.

use std::fmt;

use super::step::{Reply, Request};
use crate::error::{Error, ErrorCode};

/// State of a PLC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum PlcState {
    /// It ran when it last replied.
    Running,
    /// It was stopped when it last replied, and no request that may start it has been sent since.
    Stopped,
    /// It has not replied, or not since STOP or RUN was sent.
    Unknown,
}

impl fmt::Display for PlcState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Running => "the PLC runs",
            Self::Stopped => "the PLC is stopped",
            Self::Unknown => "whether the PLC runs is not known",
        })
    }
}

/// Controls one PLC for all runs of a transfer.
#[derive(Clone, Debug)]
pub(crate) struct RunControl {
    attempts: u32,
    state: ControlState,
    /// The current operation is [`secure`](Self::secure).
    securing: bool,
    /// A look that finds the PLC running is followed by STOP.
    halting: bool,
    /// A status that is not confirmed: whether the PLC runs.
    unconfirmed: Option<bool>,
    plc: PlcState,
    /// This transfer has stopped the PLC, or may have.
    was_stopped: bool,
    /// The PLC has been seen to obey; then `was_stopped` stays.
    has_obeyed: bool,
    /// RUN is not due although this transfer stopped the PLC.
    stays_stopped: bool,
    /// The error of the last STOP or RUN.
    command_error: Option<Error>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ControlState {
    Idle,
    Look,
    /// A look whose status need not be confirmed.
    FirstLook,
    /// The attempts that are left, this one included.
    Send(RunCommand, u32),
    Observe(RunCommand, u32),
    Pause(RunCommand, u32),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RunCommand {
    Stop,
    Run,
}

/// The end of an operation.
#[derive(Debug)]
pub(crate) enum RunEvent {
    /// [`look`](RunControl::look): whether the PLC runs. [`halt`](RunControl::halt): it is stopped
    /// already.
    Seen(bool),
    /// [`halt`](RunControl::halt), [`stop`](RunControl::stop), [`run`](RunControl::run): the PLC
    /// was seen to obey.
    Obeyed,
    /// [`secure`](RunControl::secure): [`plc`](RunControl::plc) is as far as it is known.
    Secured,
    /// Any but `secure`.
    Failed(RunFailure),
}

#[derive(Debug)]
pub(crate) struct RunFailure {
    pub(crate) cause: RunCause,
    /// The error of the last STOP or RUN of this operation, if it had one.
    pub(crate) command_error: Option<(RunCommand, Error)>,
}

#[derive(Debug)]
pub(crate) enum RunCause {
    /// The status had no usable reply.
    NoStatus(Error),
    /// The status was not confirmed.
    NotConfirmed(Error),
    /// All attempts were made.
    NotObeyed(RunCommand),
    /// The PLC refused RUN.
    RunRefused { error: ErrorCode, source: Error },
}

impl RunControl {
    /// Sends STOP and RUN at most this number of times each, at least once.
    pub(crate) fn new(attempts: u32) -> Self {
        Self {
            attempts: attempts.max(1),
            state: ControlState::Idle,
            securing: false,
            halting: false,
            unconfirmed: None,
            plc: PlcState::Unknown,
            was_stopped: false,
            has_obeyed: false,
            stays_stopped: false,
            command_error: None,
        }
    }

    /// A run of the transfer begins. `over`: the last one succeeded, so its stop no longer counts.
    pub(crate) fn begin(&mut self, over: bool) {
        self.cancel();
        self.plc = PlcState::Unknown;
        if over {
            self.forget_stop();
        }
    }

    /// Ends the current operation.
    pub(crate) fn cancel(&mut self) {
        self.enter(ControlState::Idle);
    }

    /// Reads the status.
    pub(crate) fn look(&mut self) {
        self.enter(ControlState::Look);
    }

    /// Reads the status at the beginning of a run, without a check: later replies are confirmed
    /// with it, or the transfer looks again.
    pub(crate) fn first_look(&mut self) {
        self.enter(ControlState::FirstLook);
    }

    /// Reads the status, and stops the PLC if it runs.
    pub(crate) fn halt(&mut self) {
        self.look();
        self.halting = true;
    }

    /// Stops the PLC, which runs.
    pub(crate) fn stop(&mut self) {
        self.cancel();
        self.send(RunCommand::Stop, self.attempts);
    }

    /// Starts the PLC.
    pub(crate) fn run(&mut self) {
        self.cancel();
        self.send(RunCommand::Run, self.attempts);
    }

    /// Leaves the PLC stopped after a failure, as far as possible. `runs`: a status just said so.
    pub(crate) fn secure(&mut self, runs: bool) {
        self.halt();
        self.securing = true;
        if runs {
            self.send(RunCommand::Stop, self.attempts);
        }
    }

    /// The status, as [`plc`](Self::plc) from a reply other than that to [`Request::Status`].
    pub(crate) fn saw(&mut self, running: bool) {
        self.plc = if running { PlcState::Running } else { PlcState::Stopped };
        if running {
            self.was_stopped = self.has_obeyed;
        } else {
            self.has_obeyed |= self.was_stopped;
        }
    }

    /// The stop by this transfer no longer counts: another client has started the PLC since.
    pub(crate) fn forget_stop(&mut self) {
        (self.was_stopped, self.has_obeyed, self.stays_stopped) = (false, false, false);
    }

    /// Another client has taken over: RUN is not due, even if the PLC is stopped later.
    pub(crate) fn leave_to_others(&mut self) {
        self.stays_stopped = true;
    }

    /// The last status is too old to be relied on.
    pub(crate) fn forget_status(&mut self) {
        self.plc = PlcState::Unknown;
    }

    /// The state of the PLC. Before the result of STOP or RUN it is not known: a dropped future may
    /// have sent it.
    pub(crate) fn plc(&self) -> PlcState {
        if matches!(self.state, ControlState::Send(..)) { PlcState::Unknown } else { self.plc }
    }

    /// Returns whether this transfer has stopped the PLC, or may have.
    pub(crate) fn was_stopped(&self) -> bool {
        self.was_stopped
    }

    /// Returns whether the PLC ran before this transfer stopped it, and should run again.
    pub(crate) fn is_run_due(&self) -> bool {
        self.was_stopped && !self.stays_stopped && self.plc != PlcState::Running
    }

    /// The request of the current operation; `None` between two operations.
    pub(crate) fn next(&self) -> Option<Request> {
        match self.state {
            ControlState::Idle => None,
            ControlState::Look | ControlState::FirstLook | ControlState::Observe(..) => Some(Request::Status),
            ControlState::Send(RunCommand::Stop, _) => Some(Request::Stop),
            ControlState::Send(RunCommand::Run, _) => Some(Request::Run),
            ControlState::Pause(..) => Some(Request::Pause),
        }
    }

    /// Returns whether a status is to be confirmed.
    pub(crate) fn must_confirm(&self) -> bool {
        self.unconfirmed.is_some()
    }

    /// Handles the result of the request.
    pub(crate) fn handle(&mut self, result: Result<Reply, Error>) -> Option<RunEvent> {
        match (self.state, result) {
            (ControlState::Idle, _) => None,
            (ControlState::Pause(command, left), _) => {
                self.send(command, left);
                None
            }
            (ControlState::Send(command, left), result) => self.sent(command, left, result.err()),
            (ControlState::FirstLook, Ok(Reply::Status(status))) => {
                let running = status.flags().running();
                self.saw(running);
                Some(self.finish(RunEvent::Seen(running)))
            }
            (ControlState::Look | ControlState::Observe(..), Ok(Reply::Status(status))) => {
                self.unconfirmed = Some(status.flags().running());
                None
            }
            (ControlState::Look | ControlState::FirstLook | ControlState::Observe(..), Ok(reply)) => {
                debug_assert!(false, "no reply to a status: {reply:?}");
                None
            }
            (ControlState::Look | ControlState::FirstLook | ControlState::Observe(..), Err(error)) => {
                if self.securing && self.state == ControlState::Look {
                    self.plc = PlcState::Unknown;
                }
                Some(self.end(RunCause::NoStatus(error)))
            }
        }
    }

    /// Handles the result of confirming the status.
    pub(crate) fn confirmed(&mut self, result: Result<(), Error>) -> Option<RunEvent> {
        let running = self.unconfirmed.take()?;
        if let Err(error) = result {
            self.plc = PlcState::Unknown;
            return Some(self.end(RunCause::NotConfirmed(error)));
        }
        self.saw(running);
        match self.state {
            ControlState::Look if running && self.halting => {
                self.send(RunCommand::Stop, self.attempts);
                None
            }
            ControlState::Look if self.securing => Some(self.finish(RunEvent::Secured)),
            ControlState::Look => Some(self.finish(RunEvent::Seen(running))),
            ControlState::Observe(command, left) => self.observed(command, left, running),
            // No status is read there.
            ControlState::Idle | ControlState::FirstLook | ControlState::Send(..) | ControlState::Pause(..) => None,
        }
    }

    /// The status may be the reply to another request: reads it again.
    pub(crate) fn rewind(&mut self) {
        if self.unconfirmed.take().is_some() {
            self.plc = PlcState::Unknown;
        }
    }

    fn enter(&mut self, state: ControlState) {
        (self.state, self.securing, self.halting, self.unconfirmed, self.command_error) =
            (state, false, false, None, None);
    }

    fn send(&mut self, command: RunCommand, left: u32) {
        if command == RunCommand::Stop && !self.securing {
            // Before it is sent: the future may be dropped while it is.
            (self.was_stopped, self.stays_stopped) = (true, false);
        }
        self.state = ControlState::Send(command, left);
    }

    fn sent(&mut self, command: RunCommand, left: u32, error: Option<Error>) -> Option<RunEvent> {
        let had_no_effect = error.as_ref().is_some_and(|error| !error.may_have_executed());
        if !had_no_effect {
            self.plc = PlcState::Unknown;
        } else if command == RunCommand::Stop && !self.securing {
            self.was_stopped = self.has_obeyed;
        }
        self.state = ControlState::Observe(command, left);
        self.command_error = error;
        match (command, &self.command_error) {
            (RunCommand::Run, Some(source @ Error::Plc { error, repeated: false, .. })) => {
                let (error, source) = (*error, source.clone());
                Some(self.end(RunCause::RunRefused { error, source }))
            }
            (RunCommand::Stop | RunCommand::Run, _) => None,
        }
    }

    fn observed(&mut self, command: RunCommand, left: u32, running: bool) -> Option<RunEvent> {
        if running == (command == RunCommand::Run) {
            return Some(self.finish(if self.securing { RunEvent::Secured } else { RunEvent::Obeyed }));
        }
        match left.checked_sub(1) {
            Some(left @ 1..) => {
                self.state = ControlState::Pause(command, left);
                None
            }
            Some(0) | None => Some(self.end(RunCause::NotObeyed(command))),
        }
    }

    fn end(&mut self, cause: RunCause) -> RunEvent {
        if self.securing {
            return self.finish(RunEvent::Secured);
        }
        let command = match self.state {
            ControlState::Send(command, _) | ControlState::Observe(command, _) | ControlState::Pause(command, _) => {
                Some(command)
            }
            ControlState::Idle | ControlState::Look | ControlState::FirstLook => None,
        };
        let command_error = command.zip(self.command_error.take());
        self.finish(RunEvent::Failed(RunFailure { cause, command_error }))
    }

    fn finish(&mut self, event: RunEvent) -> RunEvent {
        self.cancel();
        event
    }
}

#[cfg(test)]
mod tests;
