use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::time::Instant;

use crate::error::{Error, ErrorCode};
use crate::plan::PlanError;
use crate::tag::TagValue;

/// Which tag of a [`Poller`](super::Poller): no two are the same, not even after one was removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TagId(pub(super) u64);

impl fmt::Display for TagId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// What was read, or that it could not be.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Sample {
    /// Which tag.
    pub id: TagId,
    /// Its name.
    pub name: Arc<str>,
    /// Whether the values can be relied on.
    pub quality: Quality,
    /// When the reply with the values came; for a bad sample, when that was known.
    pub at: Stamp,
    pub(super) values: Option<Arc<[TagValue]>>,
}

impl Sample {
    /// The values: as many as the tag has, or none if the sample is bad.
    #[must_use]
    pub fn values(&self) -> &[TagValue] {
        self.values.as_deref().unwrap_or_default()
    }

    /// The first value, and the only one of most tags; `None` if the sample is bad.
    #[must_use]
    pub fn value(&self) -> Option<&TagValue> {
        self.values().first()
    }

    /// Whether the values are what the PLC has just answered.
    #[must_use]
    pub fn is_good(&self) -> bool {
        matches!(self.quality, Quality::Good)
    }
}

/// Whether values can be relied on. There are no values in a bad sample, so an error is never taken for a zero.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Quality {
    /// The PLC has just answered this.
    Good,
    /// The last values that the PLC answered: it was asked again since, or should have been, and this came of it.
    Stale(Reason),
    /// No values: never read, refused, or too old.
    Bad(Reason),
}

impl Quality {
    /// Why it is not good.
    #[must_use]
    pub fn reason(&self) -> Option<&Reason> {
        match self {
            Self::Good => None,
            Self::Stale(reason) | Self::Bad(reason) => Some(reason),
        }
    }

    /// Whether a consumer would see a difference: details that are new each time, such as when the next probe is due, are
    /// none.
    pub(super) fn differs_from(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Good, Self::Good) => false,
            (Self::Stale(a), Self::Stale(b)) | (Self::Bad(a), Self::Bad(b)) => a.differs_from(b),
            _ => true,
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

/// Why a sample is not good.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Reason {
    /// It has not been read yet.
    NotYetRead,
    /// The request failed.
    Failed(Arc<Error>),
    /// The PLC refuses this tag, by itself. It is tried again now and then.
    Refused(ErrorCode),
    /// No answer for longer than [`ScanClass::stale_after`](super::ScanClass::stale_after), and no failure either.
    Overdue,
    /// The tag cannot be read in one request any more, with what has been learned of the PLC.
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

/// A point in time, by both clocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Stamp {
    /// By the clock that only goes forward.
    pub instant: Instant,
    /// By the clock on the wall.
    pub time: SystemTime,
}

impl Stamp {
    /// Now.
    pub(super) fn now() -> Self {
        Self { instant: Instant::now(), time: SystemTime::now() }
    }

    /// The time of an instant that has just been.
    pub(super) fn of(instant: Instant) -> Self {
        let now = Self::now();
        let ago = now.instant.saturating_duration_since(instant);
        Self { instant, time: now.time.checked_sub(ago).unwrap_or(now.time) }
    }

    /// How long ago it was at another time.
    pub(super) fn age(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.instant)
    }
}
