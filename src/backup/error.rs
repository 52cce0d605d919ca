use std::fmt;

use super::{Backup, RestoreReport};
use crate::command::DetailedStatus;
use crate::error::Error;
use crate::tag::Tag;

/// Why ranges are no backup: the ranges, and the rule.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidBackup {
    /// There is not a single range.
    #[error("there are no ranges: at least one was expected")]
    Empty,
    /// Two ranges share memory.
    #[error("{first} and {second} share memory: which of them would be restored?")]
    #[non_exhaustive]
    Overlap {
        /// One of them.
        first: Tag,
        /// The other.
        second: Tag,
    },
    /// A range is not in the backup.
    #[error("{range} is not wholly in one range of the backup")]
    #[non_exhaustive]
    NotIn {
        /// Which one.
        range: Tag,
    },
    /// A range has half a value of the backup.
    #[error("{range} would split a value of two registers: the backup has {whole}")]
    #[non_exhaustive]
    SplitsPair {
        /// Which one.
        range: Tag,
        /// What the backup has there.
        whole: Tag,
    },
}

/// Why there is no backup.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BackupError {
    /// The ranges are none for a backup. Nothing was sent.
    #[error(transparent)]
    Invalid(#[from] InvalidBackup),
    /// A request failed, and it was not the PLC that refused it.
    #[error("{} of {} elements were read, and then: {source}", partial.value_count(), partial.element_count())]
    #[non_exhaustive]
    Call {
        /// What has been read; the rest of it is [`NotRead`](super::Missing::NotRead).
        /// [`TakeBackup::resume`](super::TakeBackup::resume) goes on with it.
        partial: Box<Backup>,
        /// Why it went no further.
        source: Error,
    },
    /// The backup that is to go on was begun with another station. Nothing was sent.
    #[error("the backup was begun with station {backup}, and cannot go on with station {station}")]
    #[non_exhaustive]
    OtherStation {
        /// The station of the backup.
        backup: u8,
        /// The station that was to be read.
        station: u8,
    },
    /// The backup that is to go on was begun with a PLC of another model, by its status (53). Nothing else was asked.
    #[error(
        "the backup was begun with another PLC ({}), and cannot go on with this one ({})",
        model(Some(backup)),
        model(plc.as_deref())
    )]
    #[non_exhaustive]
    OtherPlc {
        /// The status of the PLC that it was begun with.
        backup: Box<DetailedStatus>,
        /// The status of this one; `None` if it refuses to tell, which the other one did not.
        plc: Option<Box<DetailedStatus>>,
    },
}

fn model(status: Option<&DetailedStatus>) -> String {
    status.map_or("which does not tell its type".to_owned(), |status| {
        format!("main unit {}, I/O points code {}", status.main_unit(), status.io_points_code())
    })
}

/// Why a backup was not restored, or not wholly.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RestoreFailure {
    /// A request failed: no answer, no connection, a refusal.
    #[error("{doing}: {source}")]
    #[non_exhaustive]
    Call {
        /// What was asked.
        doing: String,
        /// Why it failed.
        source: Error,
    },
    /// An earlier run of this restoring has stopped another station, and has not ended well. Nothing was sent, and the report is
    /// about the other one.
    #[error("the restoring was begun with {begun}, and cannot go on with {station}")]
    #[non_exhaustive]
    OtherStation {
        /// The station of the earlier run, and its endpoint.
        begun: String,
        /// The one that was to be restored now.
        station: String,
    },
    /// The PLC runs, and was to be stopped already. Nothing has been written.
    #[error("the PLC runs: stop it first, or choose `RestoreOptions::stop_first`")]
    Running,
    /// The PLC has been told to stop, and runs all the same.
    #[error("the PLC does not stop")]
    StillRunning,
    /// Somebody else has set the PLC running while it was restored, though it was to stand still. It goes on running; its
    /// program may have changed what was restored, before or after that was read back.
    #[error(
        "somebody has set the PLC running while it was restored{}",
        if *differing == 0 { String::new() } else { format!("; {differing} of the elements do not hold what they should") }
    )]
    #[non_exhaustive]
    SetRunning {
        /// How many elements did not hold what they should when all was read back: see [`RestoreReport::remaining`].
        differing: usize,
    },
    /// The PLC does not have all elements: see [`RestoreReport::refused`].
    #[error(
        "the PLC refuses to give {count} of the elements, so none was written; leave them out to restore the others"
    )]
    #[non_exhaustive]
    NotThere {
        /// How many.
        count: usize,
    },
    /// Elements do not hold what was to be restored: see [`RestoreReport::remaining`].
    #[error(
        "elements that do not hold what was to be restored: {count}; something changes them, or they cannot be written"
    )]
    #[non_exhaustive]
    Differs {
        /// How many.
        count: usize,
    },
    /// All has been restored. The PLC has been told to run again, and does not.
    #[error("all is restored, but the PLC does not run")]
    NotRunning,
}

/// Why a backup was not restored, and how far it came.
///
/// Restoring it again compares all, and writes what still differs.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct RestoreError {
    /// Why it went no further.
    pub source: RestoreFailure,
    /// What was written and what was not.
    pub report: Box<RestoreReport>,
}

impl fmt::Display for RestoreError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}; {}", self.source, self.report)
    }
}

impl std::error::Error for RestoreError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.source)
    }
}
