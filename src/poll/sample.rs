use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::time::Instant;

use crate::error::{Error, ErrorCode};
use crate::plan::PlanError;
use crate::tag::TagValue;

/// The id of a tag in a [`Poller`](super::Poller). Ids of removed tags are not reused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TagId(pub(crate) u64);

impl fmt::Display for TagId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The values of a tag with their quality and time.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Sample {
    /// The id of the tag.
    pub id: TagId,
    /// The name of the tag.
    pub name: Arc<str>,
    /// The quality of the values.
    pub quality: Quality,
    /// The time of the reply with the values; of a bad sample, when it became bad.
    pub at: Stamp,
    /// When the values became stale: the time of the first failure since they were read, or of their age;
    /// `None` of a good or bad sample. Reports of a stale tag that follow have the same time.
    pub stale_since: Option<Stamp>,
    /// The last cycle of the tag's scan class that has read the tag or failed to, counted from 1; 0 before
    /// the first one. Samples of one station, class and cycle belong together.
    pub cycle: u64,
    pub(crate) values: Option<Arc<[TagValue]>>,
}

impl Sample {
    /// Returns the values of the tag; empty if the sample is bad.
    #[must_use]
    pub fn values(&self) -> &[TagValue] {
        self.values.as_deref().unwrap_or_default()
    }

    /// Returns the first value, which is the only one of most tags; `None` if the sample is bad.
    #[must_use]
    pub fn value(&self) -> Option<&TagValue> {
        self.values().first()
    }

    /// Returns whether the values come from the last reading.
    #[must_use]
    pub fn is_good(&self) -> bool {
        matches!(self.quality, Quality::Good)
    }
}

/// The quality of values. A bad sample has no values, so a failure is never taken for a zero.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Quality {
    /// The values of the last reading.
    Good,
    /// The last values read. A later reading failed or is overdue, for this reason.
    Stale(Reason),
    /// No values: never read, refused, or too old.
    Bad(Reason),
}

impl Quality {
    /// Returns the reason why the quality is not good.
    #[must_use]
    pub fn reason(&self) -> Option<&Reason> {
        match self {
            Self::Good => None,
            Self::Stale(reason) | Self::Bad(reason) => Some(reason),
        }
    }

    /// Returns whether the difference counts as a change for reports.
    ///
    /// Details of an error that differ each time, such as the time of the next probe, do not.
    pub(super) fn differs_from(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Good, Self::Good) => false,
            (Self::Stale(a), Self::Stale(b)) | (Self::Bad(a), Self::Bad(b)) => a.differs_from(b),
            (Self::Good | Self::Stale(_) | Self::Bad(_), _) => true,
        }
    }
}

impl fmt::Display for Quality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Good => f.write_str("good"),
            Self::Stale(reason) => write!(f, "stale: {reason}"),
            Self::Bad(reason) => write!(f, "bad: {reason}"),
        }
    }
}

/// The reason why a sample is not good.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Reason {
    /// The tag has not been read yet.
    NotYetRead,
    /// The request failed.
    Failed(Arc<Error>),
    /// The PLC refuses a request for this tag alone. The tag is probed periodically.
    Refused(ErrorCode),
    /// No reply and no failure within [`ScanClass::stale_after`](super::ScanClass::stale_after).
    Overdue,
    /// No single request can read the tag within the learned limits of the PLC.
    NoPlan(Arc<PlanError>),
}

impl Reason {
    fn differs_from(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Failed(a), Self::Failed(b)) => std::mem::discriminant(&**a) != std::mem::discriminant(&**b),
            (Self::Refused(a), Self::Refused(b)) => a != b,
            (a, b) => std::mem::discriminant(a) != std::mem::discriminant(b),
        }
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotYetRead => f.write_str("not read yet"),
            Self::Failed(error) => error.fmt(f),
            Self::Refused(code) => write!(f, "refused by the PLC: {code}"),
            Self::Overdue => f.write_str("overdue"),
            Self::NoPlan(error) => error.fmt(f),
        }
    }
}

/// A point in time, by the monotonic and the system clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Stamp {
    /// The monotonic time.
    pub instant: Instant,
    /// The system time.
    pub time: SystemTime,
}

impl Stamp {
    /// Returns the current time.
    pub(super) fn now() -> Self {
        Self { instant: Instant::now(), time: SystemTime::now() }
    }

    /// Returns the stamp of an instant in the recent past.
    pub(super) fn of(instant: Instant) -> Self {
        let now = Self::now();
        let ago = now.instant.saturating_duration_since(instant);
        Self { instant, time: now.time.checked_sub(ago).unwrap_or(now.time) }
    }

    /// Returns the age of the stamp at `now`.
    pub(super) fn age(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.instant)
    }
}
