use std::time::Duration;

use tokio::time::Instant;

use super::rng::FaultRng;

/// The time of a duplicate or second answer, relative to the reply or the next request.
///
/// It is drawn on arrival of the request and counted from the last byte of the reply.
///
/// ```
/// use std::time::Duration;
/// use fatek::sim::{Fault, Rule, Timing};
///
/// // A duplicate on arrival of the next request, half-way to its reply, or directly before it.
/// for per_mille in [0, 500, 1000] {
///     let timing = Timing::WithNextRequest {
///         min_per_mille: per_mille,
///         max_per_mille: per_mille,
///         at_latest: Duration::from_secs(1),
///     };
///     let rule = Rule::new(Fault::Duplicate(timing)).one_in(10);
/// }
/// // A duplicate at any time within the second after the reply.
/// let timing = Timing::After { min: Duration::ZERO, max: Duration::from_secs(1) };
/// let rule = Rule::new(Fault::Duplicate(timing));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Timing {
    /// A time after the reply, from `min` to `max`, both included.
    After {
        /// Shortest time.
        min: Duration,
        /// Longest time.
        max: Duration,
    },
    /// A time between the arrival of the next request to the same station and its reply.
    ///
    /// It is a share of that interval: 0 is on arrival, 500 half-way, 1000 directly before the
    /// reply. For a request that is lost, each share is its arrival.
    WithNextRequest {
        /// Smallest share, in thousandths.
        min_per_mille: u16,
        /// Largest share, in thousandths.
        max_per_mille: u16,
        /// Time after the reply if no request has arrived by then.
        at_latest: Duration,
    },
    /// A time after the next reply of the same station, from `min` to `max`, both included.
    ///
    /// Only for [`Fault::RoamingDuplicate`](super::Fault::RoamingDuplicate). Duplicates and second
    /// answers that stay in order are sent directly before that reply.
    AfterNextReply {
        /// Shortest time.
        min: Duration,
        /// Longest time.
        max: Duration,
        /// Time after the reply if no other reply has been sent by then.
        at_latest: Duration,
    },
}

impl Timing {
    /// Directly behind the reply, without a pause.
    ///
    /// On a stream both are delivered at once, after the last byte of both. For separate delivery,
    /// use [`After`](Self::After) a nanosecond.
    pub const AT_ONCE: Self = Self::After { min: Duration::ZERO, max: Duration::ZERO };

    pub(super) fn draw(self, rng: &mut FaultRng) -> DrawnTiming {
        match self {
            Self::After { min, max } => DrawnTiming::After(rng.between(min, max)),
            Self::WithNextRequest { min_per_mille, max_per_mille, at_latest } => {
                let span = u64::from(max_per_mille.saturating_sub(min_per_mille));
                // At most the span of two u16, so it fits.
                let extra = u16::try_from(rng.below(span + 1)).unwrap_or(u16::MAX);
                let per_mille = min_per_mille.min(max_per_mille).saturating_add(extra).min(1000);
                DrawnTiming::WithNextRequest { per_mille, at_latest }
            }
            Self::AfterNextReply { min, max, at_latest } => {
                DrawnTiming::AfterNextReply { after: rng.between(min, max), at_latest }
            }
        }
    }
}

/// A [`Timing`] with its times drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DrawnTiming {
    After(Duration),
    WithNextRequest { per_mille: u16, at_latest: Duration },
    AfterNextReply { after: Duration, at_latest: Duration },
}

/// Adds a time of at most a day: longer than any test waits, and within the range of the clock.
pub(in crate::sim::fault) fn later(at: Instant, by: Duration) -> Instant {
    at.checked_add(by.min(Duration::from_secs(86_400))).unwrap_or(at)
}
