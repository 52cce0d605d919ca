//! The names of the states of a restoring, of its steps, and of what comes of these.

use crate::backup::block::Chunk;
use crate::command::Value;
use crate::element::Discrete;
use crate::tag::Tag;

/// What a run is to come to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::backup) enum Goal {
    /// Nothing is changed.
    Compare,
    Restore,
}

/// What is to be done next. The reply to it is said to [`Restoring::handle`](super::Restoring::handle).
#[derive(Clone, Debug, PartialEq)]
pub(in crate::backup) enum Step {
    /// Ask for 40.
    Status,
    Stop,
    Run,
    /// Give the PLC a moment.
    Pause,
    Read(Chunk),
    /// Ask which of so many discretes are disabled.
    ReadForced(Discrete, usize),
    /// Write these elements.
    Write(Tag, Vec<Value>),
    /// Confirm all that was read: see [`Restoring::confirmed`](super::Restoring::confirmed).
    Confirm,
    Done,
}

/// What has come of a step.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::backup) enum Reply {
    /// Whether the PLC runs.
    Running(bool),
    Values(Vec<Value>),
    Forced(Vec<bool>),
    Done,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::backup) enum State {
    Look,
    Stop,
    Stopped,
    /// It does not stop at once.
    PauseToStop,
    Compare,
    Forced,
    /// Whether it still stands still, before anything is written.
    Ready,
    Write,
    /// What has become of a write without an answer.
    Check,
    Verify,
    /// Whether it has stood still all the time.
    LastLook,
    Run,
    Running,
    PauseToRun,
    Done,
}

impl State {
    /// Whether it reads elements, all of which are confirmed before it is left.
    pub(super) fn reads(self) -> bool {
        match self {
            Self::Compare | Self::Forced | Self::Verify => true,
            Self::Look
            | Self::Stop
            | Self::Stopped
            | Self::PauseToStop
            | Self::Ready
            | Self::Write
            | Self::Check
            | Self::LastLook
            | Self::Run
            | Self::Running
            | Self::PauseToRun
            | Self::Done => false,
        }
    }

    /// What it asks for with this, for an error.
    pub(super) fn doing(self, chunk: Chunk) -> String {
        let names = chunk.names();
        match self {
            Self::Write => format!("writing {names}"),
            Self::Forced => format!("asking which of {names} are forced"),
            _ => format!("reading {names}"),
        }
    }
}
