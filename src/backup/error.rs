use std::fmt;

use super::{Backup, RestoreReport};
use crate::command::DetailedStatus;
use crate::error::Error;
use crate::printable::excerpt;
use crate::tag::Tag;
use crate::transfer::{OtherStation, RunCause, RunCommand, RunFailure};

/// Error: ranges are not a backup.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidBackup {
    /// There is no range.
    #[error("there are no ranges: at least one was expected")]
    Empty,
    /// A range is bits of a register, and a backup has whole registers: a restore would write its other
    /// bits, too.
    #[error("{range} is a part of {}, and a backup has whole registers", range.first())]
    #[non_exhaustive]
    BitsOfRegister {
        /// The range.
        range: Tag,
    },
    /// Two ranges share memory.
    #[error("{first} and {second} share memory")]
    #[non_exhaustive]
    Overlap {
        /// One of them.
        first: Tag,
        /// The other.
        second: Tag,
    },
    /// A range is not part of one range of the backup.
    #[error("{range} is not wholly in one range of the backup")]
    #[non_exhaustive]
    NotIn {
        /// The range.
        range: Tag,
    },
    /// A range would split a value of the backup.
    #[error("{range} would split a value of several registers: the backup has {whole}")]
    #[non_exhaustive]
    SplitsPair {
        /// The range.
        range: Tag,
        /// The range of the backup.
        whole: Tag,
    },
}

/// Error: a backup cannot be read.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum BackupError {
    /// The ranges are not a backup. Nothing was sent.
    Invalid(InvalidBackup),
    /// A request failed otherwise than by a refusal.
    #[non_exhaustive]
    Call {
        /// The elements that have been read; all others are [`NotRead`](super::Missing::NotRead).
        /// [`TakeBackup::resume`](super::TakeBackup::resume) continues with it.
        partial: Box<Backup>,
        /// The error of the request.
        source: Error,
    },
    /// The backup was begun with another station. Nothing was sent.
    #[non_exhaustive]
    OtherStation {
        /// The station of the backup.
        backup: u8,
        /// The station of this run.
        station: u8,
    },
    /// The backup was begun with a PLC of another model, by its status (53). Nothing else was read.
    #[non_exhaustive]
    OtherPlc {
        /// The status of the PLC that it was begun with.
        backup: Box<DetailedStatus>,
        /// The status of this one; `None` if it refuses 53.
        plc: Option<Box<DetailedStatus>>,
    },
}

impl fmt::Display for BackupError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Invalid(invalid) => invalid.fmt(f),
            Self::Call { partial, source } => {
                let (values, all) = (partial.value_count(), partial.element_count());
                write!(f, "{values} of {all} elements were read, and then: {source}")
            }
            Self::OtherStation { backup, station } => {
                write!(f, "the backup was begun with station {backup}, and cannot continue with station {station}")
            }
            Self::OtherPlc { backup, plc } => write!(
                f,
                "the backup was begun with another PLC ({}), and cannot continue with this one ({})",
                model(Some(backup)),
                model(plc.as_deref())
            ),
        }
    }
}

impl std::error::Error for BackupError {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Invalid(invalid) => invalid.source(),
            Self::Call { source, .. } => source.source(),
            Self::OtherStation { .. } | Self::OtherPlc { .. } => None,
        }
    }
}

fn model(status: Option<&DetailedStatus>) -> String {
    status.map_or("which does not report its type".to_owned(), |status| {
        format!("main unit {}, I/O points code {}", status.main_unit(), status.io_points_code())
    })
}

/// The reason why a backup was not restored, or not completely.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum RestoreFailure {
    /// A request failed: no reply, no connection, a refusal.
    #[non_exhaustive]
    Call {
        /// The action that failed.
        doing: String,
        /// The error of the request.
        source: Error,
    },
    /// An earlier run has stopped another station, and did not succeed. Nothing was sent, and the
    /// report is about the other station.
    #[non_exhaustive]
    OtherStation {
        /// The station of the earlier run, and its endpoint.
        begun: String,
        /// The station of this run, and its endpoint.
        station: String,
    },
    /// The backup has special elements, and their treatment was not chosen. Nothing was sent.
    #[non_exhaustive]
    Special {
        /// The first of them.
        range: Tag,
    },
    /// The PLC is not the one that was read: see [`RestoreReport::other_plc`]. Nothing was written.
    OtherPlc,
    /// The PLC runs, and had to be stopped already. Nothing was written.
    Running,
    /// STOP was sent, and the PLC still runs.
    StillRunning,
    /// Another client started the PLC, which had to be stopped. It keeps running; its program may have
    /// changed restored elements, before or after they were read back.
    #[non_exhaustive]
    SetRunning {
        /// The number of elements that differed when all were read back: see
        /// [`RestoreReport::remaining`].
        differing: usize,
    },
    /// The PLC does not have all elements: see [`RestoreReport::refused`].
    #[non_exhaustive]
    NotThere {
        /// The number of elements.
        count: usize,
    },
    /// Elements do not hold their value of the backup: see [`RestoreReport::remaining`].
    #[non_exhaustive]
    Differs {
        /// The number of elements.
        count: usize,
    },
    /// All elements are restored. RUN was sent, and the PLC does not run.
    NotRunning,
}

impl fmt::Display for RestoreFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Call { doing, source } => write!(f, "{doing}: {source}"),
            Self::OtherStation { begun, station } => {
                write!(f, "restoring was begun with {}, and cannot continue with {}", excerpt(begun), excerpt(station))
            }
            Self::Special { range } => write!(
                f,
                "the backup has special elements, {range}, and writing these can cause system or I/O errors: choose \
                 `RestoreOptions::special`"
            ),
            Self::OtherPlc => {
                f.write_str("the backup is of another PLC, and `RestoreOptions::accept_other_plc` was not chosen")
            }
            Self::Running => f.write_str("the PLC runs: stop it first, or choose `RestoreOptions::stop_first`"),
            Self::StillRunning => f.write_str("the PLC does not stop"),
            Self::SetRunning { differing } => {
                f.write_str("another client started the PLC while it was restored")?;
                match differing {
                    0 => Ok(()),
                    _ => write!(f, "; {differing} of the elements do not hold their value"),
                }
            }
            Self::NotThere { count } => write!(
                f,
                "the PLC refuses {count} of the elements, so none was written; leave them out to restore the others"
            ),
            Self::Differs { count } => write!(
                f,
                "{count} elements do not hold their value of the backup: the program changes them, or they are read-only"
            ),
            Self::NotRunning => f.write_str("all elements are restored, but the PLC does not run"),
        }
    }
}

impl std::error::Error for RestoreFailure {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Call { source, .. } => source.source(),
            Self::OtherStation { .. }
            | Self::Special { .. }
            | Self::OtherPlc
            | Self::Running
            | Self::StillRunning
            | Self::SetRunning { .. }
            | Self::NotThere { .. }
            | Self::Differs { .. }
            | Self::NotRunning => None,
        }
    }
}

impl From<InvalidBackup> for BackupError {
    fn from(invalid: InvalidBackup) -> Self {
        Self::Invalid(invalid)
    }
}

impl From<OtherStation> for RestoreFailure {
    fn from(OtherStation { begun, station }: OtherStation) -> Self {
        Self::OtherStation { begun, station }
    }
}

impl BackupError {
    /// The error of the request that failed, if that is the reason.
    #[must_use]
    pub fn call_error(&self) -> Option<&Error> {
        if let Self::Call { source, .. } = self { Some(source) } else { None }
    }
}

impl RestoreFailure {
    /// The error of the request that failed, if that is the reason.
    #[must_use]
    pub fn call_error(&self) -> Option<&Error> {
        if let Self::Call { source, .. } = self { Some(source) } else { None }
    }
}

impl From<RunFailure> for RestoreFailure {
    /// An error of STOP or RUN is the reason only if the request certainly had no effect.
    fn from(RunFailure { cause, command_error }: RunFailure) -> Self {
        let command_error = command_error.filter(|(_, error)| !error.may_have_executed());
        let (doing, source) = match (cause, command_error) {
            (RunCause::RunRefused { source, .. }, _) | (_, Some((RunCommand::Run, source))) => {
                ("running the PLC, which is still stopped", source)
            }
            (_, Some((RunCommand::Stop, source))) => ("stopping the PLC, which still runs", source),
            (RunCause::NoStatus(source), None) => ("reading the status", source),
            (RunCause::NotConfirmed(source), None) => ("confirming what was read", source),
            (RunCause::NotObeyed(RunCommand::Stop), None) => return Self::StillRunning,
            (RunCause::NotObeyed(RunCommand::Run), None) => return Self::NotRunning,
        };
        Self::Call { doing: doing.to_owned(), source }
    }
}

/// Error: a backup was not restored, or not completely; with the state of elements and PLC.
///
/// Restoring it again compares all elements and writes those that still differ.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct RestoreError {
    /// The reason.
    pub source: RestoreFailure,
    /// How far the restoring has come.
    pub report: Box<RestoreReport>,
}

impl fmt::Display for RestoreError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}; {}", self.source, self.report)
    }
}

impl std::error::Error for RestoreError {
    /// The cause behind the one that the text has.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.source.source()
    }
}
