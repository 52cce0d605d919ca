//! What can go wrong, and whose fault it is.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use crate::command::{Code, InvalidRequest};

/// The error code of a reply.
///
/// Source: protocol reference, section 4 (manuals 000 and 002 section 3, 001 section 2.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ErrorCode {
    /// 2: illegal value.
    #[error("illegal value (2)")]
    IllegalValue,
    /// 3: the memory is a ROM pack.
    #[error("write prohibited, the PLC has a ROM pack (3)")]
    WriteProhibited,
    /// 4: illegal format, or the command cannot be executed.
    #[error("illegal format, or the command cannot be executed (4)")]
    IllegalFormat,
    /// 5: cannot run, the checksum of the ladder is wrong.
    #[error("cannot run: ladder checksum error (5)")]
    LadderChecksum,
    /// 6: cannot run, the id of the PLC is not that of the ladder.
    #[error("cannot run: the PLC's id is not the ladder's (6)")]
    IdMismatch,
    /// 7: cannot run, the ladder does not pass the syntax check.
    #[error("cannot run: syntax error (7)")]
    Syntax,
    /// 9: cannot run, the ladder uses a function that the PLC does not have.
    #[error("cannot run: function not supported (9)")]
    NotSupported,
    /// A: illegal address.
    #[error("illegal address (A)")]
    IllegalAddress,
    /// A code that no manual names.
    #[error("unknown error code ({0:X})")]
    Unknown(u8),
}

impl ErrorCode {
    /// The error with this code; `None` for 0, which says that all went well.
    #[must_use]
    pub fn from_u8(code: u8) -> Option<Self> {
        Some(match code {
            0x0 => return None,
            0x2 => Self::IllegalValue,
            0x3 => Self::WriteProhibited,
            0x4 => Self::IllegalFormat,
            0x5 => Self::LadderChecksum,
            0x6 => Self::IdMismatch,
            0x7 => Self::Syntax,
            0x9 => Self::NotSupported,
            0xA => Self::IllegalAddress,
            other => Self::Unknown(other),
        })
    }
}

impl From<ErrorCode> for u8 {
    fn from(code: ErrorCode) -> Self {
        match code {
            ErrorCode::IllegalValue => 0x2,
            ErrorCode::WriteProhibited => 0x3,
            ErrorCode::IllegalFormat => 0x4,
            ErrorCode::LadderChecksum => 0x5,
            ErrorCode::IdMismatch => 0x6,
            ErrorCode::Syntax => 0x7,
            ErrorCode::NotSupported => 0x9,
            ErrorCode::IllegalAddress => 0xA,
            // An error must never look like success, even one that is none.
            ErrorCode::Unknown(code) => code.max(1),
        }
    }
}

/// Why a call failed.
///
/// [`may_have_executed`](Self::may_have_executed) tells whether the PLC may have done what was asked all the same.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The caller's fault: the request breaks a rule of the protocol. Nothing was sent.
    #[error("invalid request: {0}")]
    Invalid(#[from] InvalidRequest),
    /// The PLC's answer: it refused the request.
    #[error("station {station} refused {code}: {error}")]
    #[non_exhaustive]
    Plc {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// What it answered.
        error: ErrorCode,
        /// Whether the request had been sent before, without an answer: it may have been executed then.
        repeated: bool,
    },
    /// Nothing came back in time.
    #[error("station {station} did not answer {code} within {after:?}{}", unsent(*sent))]
    #[non_exhaustive]
    Timeout {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// How long was waited.
        after: Duration,
        /// Whether the request itself had been sent; `false` when the station did not answer the loop-back that had
        /// to come before it.
        sent: bool,
    },
    /// Something came back in time, and none of it was a reply to this request.
    #[error("station {station} gave no usable reply to {code} within {after:?}: {reason}")]
    #[non_exhaustive]
    BadReply {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// How long was waited.
        after: Duration,
        /// What was wrong with the last thing that came.
        reason: String,
        /// Whether the request itself had been sent.
        sent: bool,
    },
    /// Replies to earlier requests may still be under way: what came back may be one of them, or the station has not proven
    /// the contrary in time.
    #[error("station {station}, {code}: {}", out_of_step(*sent, *after))]
    #[non_exhaustive]
    OutOfStep {
        /// The station.
        station: u8,
        /// The command.
        code: Code,
        /// How long was waited.
        after: Duration,
        /// Whether the request itself had been sent; `false` when the station refuses the check (4E) and was not silent for the
        /// quiet time, or that is longer than the call may take.
        sent: bool,
    },
    /// Replies came twice and out of order while several requests belonged together, each time that they were repeated.
    #[error(
        "station {station} sends duplicates of replies out of order: the results of several requests cannot be trusted"
    )]
    #[non_exhaustive]
    Duplicates {
        /// The station.
        station: u8,
        /// Whether a request may have been executed whose reply cannot be trusted: `true` for writes.
        sent: bool,
    },
    /// The station has not answered several times in a row; nothing is sent to it until it answers a probe.
    #[error("station {station} is offline; the next probe is due in {probe_in:?}")]
    #[non_exhaustive]
    Offline {
        /// The station.
        station: u8,
        /// When it is asked next whether it is there.
        probe_in: Duration,
        /// Whether the request had been sent before the station was found to be offline.
        sent: bool,
    },
    /// More calls wait for this station than the link holds. Nothing was sent.
    #[error("{limit} calls are waiting for station {station} already")]
    #[non_exhaustive]
    QueueFull {
        /// The station.
        station: u8,
        /// How many calls can wait.
        limit: usize,
    },
    /// The connection could not be opened.
    #[error("cannot connect to {endpoint}: {source}")]
    #[non_exhaustive]
    Connect {
        /// Where to.
        endpoint: String,
        /// Why not.
        source: Arc<io::Error>,
        /// Whether the request had been sent before, over a connection that was lost.
        sent: bool,
    },
    /// The connection was lost.
    #[error("the connection to {endpoint} was lost: {source}")]
    #[non_exhaustive]
    Disconnected {
        /// Where to.
        endpoint: String,
        /// How.
        source: Arc<io::Error>,
        /// Whether the request, or a part of it, had been sent.
        sent: bool,
    },
    /// A write that takes several requests failed after the first of them, or was not confirmed in the end: the values before
    /// `written` are in the PLC.
    #[error("{written} of {count} values were written, and then: {source}")]
    #[non_exhaustive]
    PartlyWritten {
        /// How many values, from the first one on, were written for certain.
        written: usize,
        /// How many there were.
        count: usize,
        /// What became of the next request. Its [`may_have_executed`](Self::may_have_executed) tells whether the values
        /// behind `written`, as many as one request takes, may have been written, too; those behind them were not.
        source: Box<Error>,
    },
    /// The link has been closed, or its task has ended with its runtime.
    #[error("the link is closed")]
    #[non_exhaustive]
    Closed {
        /// Whether the request had been sent before.
        sent: bool,
    },
}

fn unsent(sent: bool) -> &'static str {
    if sent { "" } else { "; the request was not sent: other requests, or the check before it, had not been answered" }
}

fn out_of_step(sent: bool, after: Duration) -> String {
    match sent {
        true => "the reply may be a late one, or a duplicate of one, to an earlier request".to_owned(),
        false => format!(
            "not sent within {after:?}: replies to earlier requests may be under way, and the station refuses the check, so it \
             must be silent for the quiet time first"
        ),
    }
}

impl Error {
    /// Whether the PLC may have executed the request.
    ///
    /// Of a write in several requests that is any of them.
    ///
    /// `false` is certain: the request was never sent, or the PLC refused it. `true` means that nobody can know, and
    /// whether to repeat a write is the caller's to decide.
    #[must_use]
    pub fn may_have_executed(&self) -> bool {
        match self {
            Self::Invalid(_) | Self::QueueFull { .. } => false,
            Self::Plc { repeated, .. } => *repeated,
            Self::PartlyWritten { .. } => true,
            Self::Timeout { sent, .. }
            | Self::BadReply { sent, .. }
            | Self::OutOfStep { sent, .. }
            | Self::Duplicates { sent, .. }
            | Self::Offline { sent, .. }
            | Self::Connect { sent, .. }
            | Self::Disconnected { sent, .. }
            | Self::Closed { sent } => *sent,
        }
    }

    /// What the PLC answered, if that is the error.
    #[must_use]
    pub fn error_code(&self) -> Option<ErrorCode> {
        match self {
            Self::Plc { error, .. } => Some(*error),
            Self::PartlyWritten { source, .. } => source.error_code(),
            Self::Invalid(_)
            | Self::Timeout { .. }
            | Self::BadReply { .. }
            | Self::OutOfStep { .. }
            | Self::Duplicates { .. }
            | Self::Offline { .. }
            | Self::QueueFull { .. }
            | Self::Connect { .. }
            | Self::Disconnected { .. }
            | Self::Closed { .. } => None,
        }
    }
}
