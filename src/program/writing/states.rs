//! The names of the states of a writing, of its steps, and of what comes of these.

use crate::command::{DetailedStatus, ProgramPage, StatusFlags};

/// What is to be done next; [`Writing::told`](super::Writing::told) then takes what came of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::program) enum Step {
    /// 53.
    Status,
    /// 40.
    Flags,
    /// 4F.
    Read(u16),
    /// 50: the program's page.
    Write(u16),
    /// 41.
    Stop,
    /// 41.
    Run,
    /// Nothing, for a moment.
    Pause,
    /// Confirm all that was read: see [`Writing::confirmed`](super::Writing::confirmed).
    Confirm,
    /// All is done: see [`Writing::report`](super::Writing::report).
    Done,
    /// It cannot go on: take [`Writing::failure`](super::Writing::failure).
    Failed,
}

/// What came of a step.
#[derive(Debug)]
pub(in crate::program) enum Told {
    Status(DetailedStatus),
    Flags(StatusFlags),
    Page(ProgramPage),
    Done,
}

/// What a run is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::program) enum Goal {
    /// To find out which pages differ.
    Compare,
    /// To find out which pages would be written, and whether that would be refused.
    DryRun,
    /// To write them.
    Write,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::program) enum State {
    Fit,
    Kind,
    Compare(u16),
    Look,
    Stop {
        left: u32,
    },
    Stopped {
        left: u32,
    },
    StopPause {
        left: u32,
    },
    Write {
        left: u32,
    },
    ReadBack {
        left: u32,
    },
    /// A page was refused: does it run?
    Refused,
    /// Between two pages: is it still stopped?
    Check,
    Verify(u16),
    Final,
    Run {
        left: u32,
    },
    Running {
        left: u32,
    },
    RunPause {
        left: u32,
    },
    Done,
    // A failure. What it is stands in `failure`.
    LastLook,
    StopAgain {
        left: u32,
    },
    StoppedAgain {
        left: u32,
    },
    StopAgainPause {
        left: u32,
    },
    Failed,
}
