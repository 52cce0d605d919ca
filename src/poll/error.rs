use std::time::Duration;

use crate::plan::PlanError;
use crate::tag::{Tag, TagAccessError};

/// The reason why tags or a station cannot be polled.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PollError {
    /// The period is too short or too long.
    #[error("the period is {period:?}, and must be {min:?} to {max:?}")]
    #[non_exhaustive]
    Period {
        /// The given period.
        period: Duration,
        /// The shortest allowed.
        min: Duration,
        /// The longest allowed.
        max: Duration,
    },
    /// The deadband is negative or not finite, or the tag is no number.
    #[error("the deadband of {name} ({tag}) is {deadband}: it must be finite, not negative, and of a number")]
    #[non_exhaustive]
    Deadband {
        /// The tag's name.
        name: String,
        /// The tag.
        tag: Tag,
        /// The given deadband.
        deadband: f64,
    },
    /// No plan can read the tags.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The type of a field of a struct does not fit its tag.
    #[error(transparent)]
    Tag(Box<TagAccessError>),
    /// [`PolledStation::add_one_scan`](super::PolledStation::add_one_scan) without tags.
    #[error("no tags were given")]
    NoTags,
    /// The poller is closed, or polling of this station was stopped.
    #[error("the poller is closed")]
    Closed,
    /// The call is made outside of a Tokio runtime.
    #[error("polling needs a Tokio runtime")]
    NoRuntime,
}
