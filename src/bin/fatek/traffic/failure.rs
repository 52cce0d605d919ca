//! Errors of traffic that is read, recorded or replayed, with their exit statuses.

use std::io;

use crate::printable::excerpt;

#[derive(Debug, thiserror::Error)]
pub(crate) enum TrafficFailure {
    /// A source cannot be read.
    #[error("{name}: cannot read it: {error}")]
    NotRead { name: String, error: io::Error },
    /// A source is damaged, or of another kind.
    #[error("{name}: {}", excerpt(rule))]
    Damaged { name: String, rule: String },
    /// A recording cannot be written.
    #[error("{name}: cannot write it: {error}")]
    NotWritten { name: String, error: io::Error },
    /// A recording replaces no file.
    #[error("{name}: it exists already, and a recording replaces no file: choose another name")]
    Exists { name: String },
    /// No stream to the PLC.
    #[error("cannot connect to {}: {error}", excerpt(url))]
    NotConnected { url: String, error: io::Error },
    /// A connection of a recording that cannot be made again.
    #[error("{}: lost: {error}", excerpt(ends))]
    Lost { ends: String, error: io::Error },
}

impl TrafficFailure {
    /// Exit status, as listed in `fatek --help`.
    pub(crate) fn exit_status(&self) -> u8 {
        match self {
            Self::NotRead { .. } | Self::NotWritten { .. } | Self::Exists { .. } => 1,
            Self::NotConnected { .. } | Self::Lost { .. } => 5,
            Self::Damaged { .. } => 7,
        }
    }
}
