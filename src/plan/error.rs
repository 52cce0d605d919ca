use std::fmt;

use crate::command::InvalidRequest;
use crate::element::Element;
use crate::tag::Tag;

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A limit of the device that makes no sense.
    #[error("{name} is {given}, and it can be {min} to {max}")]
    #[non_exhaustive]
    Limit {
        /// Which limit.
        name: &'static str,
        /// What was given.
        given: usize,
        /// The least it can be.
        min: usize,
        /// The most it can be.
        max: usize,
    },
    /// A readable range that is none.
    #[error("{first} to {last} is no range: both ends must be of one symbol of 1 or 16 bits, the lower one first")]
    #[non_exhaustive]
    Range {
        /// The first element given.
        first: Element,
        /// The last element given.
        last: Element,
    },
    /// A tag outside the ranges that the device can read.
    #[error("{element} of the tag {tag} is not in a readable range of the device, or only in part")]
    #[non_exhaustive]
    NotReadable {
        /// The tag.
        tag: Tag,
        /// The first of its elements that cannot be read.
        element: Element,
    },
    /// Tags that must come from one scan, which a text must too, and that no request holds together.
    #[error(
        "{} must come from one scan, but no single request of the device reads that: {}, and as one run it is too long, of \
         several kinds, or reaches across what cannot be read",
        WhichTags(first, *tags), WhyNotMixed(*units, *max)
    )]
    #[non_exhaustive]
    OneScan {
        /// The first of the tags.
        first: Tag,
        /// How many they are.
        tags: usize,
        /// How many units they count, where 32 bits count two.
        units: usize,
        /// The most that one mixed read takes; 0 if there are none.
        max: usize,
    },
    /// More values than a plan holds.
    #[error("the tags have more than {max} values")]
    #[non_exhaustive]
    TooManyValues {
        /// The most a plan holds.
        max: usize,
    },
    /// A reply that does not belong to its request: another kind of value, or another number of them, or none at all.
    #[error("what was given for request {request} of the plan is no reply to it")]
    #[non_exhaustive]
    Reply {
        /// Which request, from 0.
        request: usize,
    },
    /// A request that breaks a rule of the protocol.
    #[error(transparent)]
    Request(#[from] InvalidRequest),
}

/// What must come from one scan, for [`PlanError::OneScan`].
struct WhichTags<'t>(&'t Tag, usize);

impl fmt::Display for WhichTags<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self(tag, 1) => tag.fmt(f),
            Self(first, tags) => write!(f, "the {tags} tags from {first} on"),
        }
    }
}

/// Why no mixed read reads it: its units, and the most of a mixed read.
struct WhyNotMixed(usize, usize);

impl fmt::Display for WhyNotMixed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self(_, 0) => f.write_str("there are no mixed reads"),
            Self(units, max) if units > max => {
                write!(f, "{units} units are too many for a mixed read, which takes {max}")
            }
            Self(..) => f.write_str("as a mixed read, the list has two readings in the binary framing"),
        }
    }
}
