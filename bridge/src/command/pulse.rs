//! Pulses: a discrete that is set, and reset after a time.
//!
//! ```text
//!  record stored ──▶ set sent ──┬─ confirmed ──▶ On ── time is over ──▶ Ending ── confirmed ──▶ Clearing ──▶ gone
//!                               ├─ unknown ────▶ On (without a command)    │ ▲
//!                               └─ not sent ───▶ gone                failed▼ │back-off
//!  record of an earlier run ───────────────────────────────────────────▶ Waiting
//! ```
//!
//! Invariants:
//! - The record is on disk from before the set is sent until the reset is confirmed.
//! - A place has one pulse at a time.

use std::time::Duration;

use fatek::tag::{Tag, TagValue};
use serde::{Deserialize, Serialize};

use super::journal::Key;
use super::reply::Reply;
use crate::backoff::Backoff;

/// Where a pulse is: the PLC is named by its address, since another one can get its name.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Place {
    pub(super) endpoint: String,
    pub(super) station: u8,
    /// The discrete.
    pub(super) tag: String,
}

/// A pulse on disk.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct PulseRecord {
    /// The name of the PLC.
    pub(super) plc: String,
    /// The name of the tag.
    pub(super) name: String,
    /// The id of the command.
    pub(super) id: String,
    /// The time when it began, in milliseconds since 1970.
    pub(super) at: u64,
}

/// A pulse that is stored.
#[derive(Debug)]
pub(super) struct Pulse {
    pub(super) record: PulseRecord,
    pub(super) tag: Tag,
    pub(super) state: PulseState,
    /// The command that gets its reply at the end.
    pub(super) command: Option<Key>,
    /// `true` if it is ended before its time.
    pub(super) is_cut: bool,
    /// `true` once a failure of its end was logged.
    pub(super) is_reported: bool,
    pub(super) backoff: Backoff,
}

#[derive(Debug, PartialEq)]
pub(super) enum PulseState {
    /// The command is being stored, or its set is on the way.
    Beginning,
    /// Set until this time.
    On(Duration),
    /// The reset is on the way.
    Ending,
    /// The reset failed, and is sent again at this time.
    Waiting(Duration),
    /// The reset is confirmed. The value is being read for the reply.
    Reading,
    /// The removal of its record is on the way to the disk, with the reply of its command.
    Clearing(Option<Reply>),
    /// The removal failed, and is tried again at this time.
    Stored(Duration),
}

impl Pulse {
    pub(super) fn new(record: PulseRecord, tag: Tag, state: PulseState) -> Self {
        Self { record, tag, state, command: None, is_cut: false, is_reported: false, backoff: Backoff::default() }
    }

    /// The time of its next step, if it waits for a time.
    pub(super) fn due(&self) -> Option<Duration> {
        match self.state {
            PulseState::On(at) | PulseState::Waiting(at) | PulseState::Stored(at) => Some(at),
            PulseState::Beginning | PulseState::Ending | PulseState::Reading | PulseState::Clearing(_) => None,
        }
    }

    /// Returns whether it is left to the next start: its PLC or the disk does not answer.
    pub(super) fn is_waiting(&self) -> bool {
        matches!(self.state, PulseState::Waiting(_) | PulseState::Stored(_))
    }
}

/// The value of the end.
pub(super) fn off() -> Vec<TagValue> {
    vec![TagValue::Bool(false)]
}
