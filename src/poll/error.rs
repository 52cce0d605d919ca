use std::time::Duration;

use crate::plan::PlanError;
use crate::tag::Tag;

/// Why a tag is not polled.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PollError {
    /// A period that is too short or too long.
    #[error("a period of {period:?}: it can be {min:?} to {max:?}")]
    #[non_exhaustive]
    Period {
        /// What was given.
        period: Duration,
        /// The shortest.
        min: Duration,
        /// The longest.
        max: Duration,
    },
    /// A deadband that makes no sense.
    #[error("a deadband of {deadband} for {name} ({tag}): it must be finite and not negative, and is for numbers only")]
    #[non_exhaustive]
    Deadband {
        /// The tag's name.
        name: String,
        /// The tag.
        tag: Tag,
        /// What was given.
        deadband: f64,
    },
    /// A tag that no plan can read.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// No tag at all, where some must come from one scan.
    #[error("no tags were given")]
    NoTags,
    /// The poller, or the polling of this station, has been closed.
    #[error("the poller is closed")]
    Closed,
    /// There is no Tokio runtime here to poll on.
    #[error("polling needs a Tokio runtime, and there is none here")]
    NoRuntime,
}
