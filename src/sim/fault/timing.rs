use std::time::Duration;

use super::dice::Dice;

/// When a copy or a second answer is sent, relative to the reply or to the next request of the station.
///
/// The time is drawn when the request arrives. It runs from the last byte of the reply.
///
/// ```
/// use std::time::Duration;
/// use fatek::sim::{Fault, Rule, Timing};
///
/// // A copy when the next request has just arrived, half-way to its reply, or directly before its reply.
/// for per_mille in [0, 500, 1000] {
///     let timing = Timing::WithNextRequest {
///         min_per_mille: per_mille,
///         max_per_mille: per_mille,
///         at_latest: Duration::from_secs(1),
///     };
///     let rule = Rule::new(Fault::Duplicate(timing)).one_in(10);
/// }
/// // A copy at any moment within the second after the reply.
/// let rule = Rule::new(Fault::Duplicate(Timing::After { min: Duration::ZERO, max: Duration::from_secs(1) }));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Timing {
    /// A time after the reply, between the two, both included.
    After {
        /// The shortest.
        min: Duration,
        /// The longest.
        max: Duration,
    },
    /// Between the arrival of the next request to the same station and its reply.
    ///
    /// The share of that time is drawn between the two, both included: 0 is at the arrival, 500 half-way, 1000 directly
    /// before the reply. For a request that is lost, every share is its arrival.
    WithNextRequest {
        /// The smallest share, in thousandths.
        min_per_mille: u16,
        /// The largest share, in thousandths.
        max_per_mille: u16,
        /// This long after the reply, if no request has arrived by then.
        at_latest: Duration,
    },
    /// A time after the next reply of the same station, between the two, both included.
    ///
    /// Only [`Fault::RoamingDuplicate`](super::Fault::RoamingDuplicate) can come that late. What keeps the order is sent
    /// directly before that reply.
    AfterNextReply {
        /// The shortest.
        min: Duration,
        /// The longest.
        max: Duration,
        /// This long after the reply, if there has been no other reply by then.
        at_latest: Duration,
    },
}

impl Timing {
    /// Directly behind the reply, without a pause. On a stream both are handed over at once, when the last byte has come
    /// over the line; a copy that is handed over by itself comes [after](Self::After) at least a nanosecond.
    pub const AT_ONCE: Self = Self::After { min: Duration::ZERO, max: Duration::ZERO };

    pub(super) fn draw(self, dice: &mut Dice) -> DrawnTiming {
        match self {
            Self::After { min, max } => DrawnTiming::After(dice.between(min, max)),
            Self::WithNextRequest { min_per_mille, max_per_mille, at_latest } => {
                let span = u64::from(max_per_mille.saturating_sub(min_per_mille));
                let extra = u16::try_from(dice.below(span + 1)).unwrap_or_default();
                let per_mille = min_per_mille.min(max_per_mille).saturating_add(extra).min(1000);
                DrawnTiming::WithNextRequest { per_mille, at_latest }
            }
            Self::AfterNextReply { min, max, at_latest } => {
                DrawnTiming::AfterNextReply { after: dice.between(min, max), at_latest }
            }
        }
    }
}

/// A [`Timing`] without chance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DrawnTiming {
    After(Duration),
    WithNextRequest { per_mille: u16, at_latest: Duration },
    AfterNextReply { after: Duration, at_latest: Duration },
}
