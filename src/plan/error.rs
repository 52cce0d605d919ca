use std::fmt;

use crate::command::InvalidRequest;
use crate::element::{Element, Symbol};
use crate::error::Error;
use crate::tag::{Tag, TagAccessError};

/// The reason why there is no plan, or why replies do not match it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A limit of the PLC is out of range.
    #[error("{name} is {given}, and must be {min} to {max}")]
    #[non_exhaustive]
    Limit {
        /// The name of the limit.
        name: &'static str,
        /// The given limit.
        given: usize,
        /// The minimum.
        min: usize,
        /// The maximum.
        max: usize,
    },
    /// Two elements are not the ends of a range.
    #[error(
        "{first} to {last} is not a range: both ends must have one symbol of 1 or 16 bits (or be DRC200 to DRC255), the lower one first"
    )]
    #[non_exhaustive]
    Range {
        /// The first element given.
        first: Element,
        /// The last element given.
        last: Element,
    },
    /// Plans do not read the discretes with this symbol as words, because no source says that a PLC has
    /// these words.
    #[error("{symbol} has no words of discretes that plans read: only X, Y, M and S have")]
    #[non_exhaustive]
    NoWords {
        /// The symbol.
        symbol: Symbol,
    },
    /// A tag is outside of the readable ranges.
    #[error("{element} of the tag {tag} is not in a readable range of the PLC, or only in part")]
    #[non_exhaustive]
    NotReadable {
        /// The tag.
        tag: Tag,
        /// The first of its elements outside of the ranges.
        element: Element,
    },
    /// No single request can read tags, or a text, that must come from one scan.
    #[error(
        "{} must come from one scan, but no single request can read that: {}, and one run would be too long, of \
         several kinds, or across unreadable or avoided elements",
        WhichTags(first, *tags), WhyNotMixed(*units, *max)
    )]
    #[non_exhaustive]
    OneScan {
        /// The first of the tags.
        first: Tag,
        /// The number of tags.
        tags: usize,
        /// Their units, where 32 bits count two.
        units: usize,
        /// The maximum of a mixed read; 0 without mixed reads.
        max: usize,
    },
    /// The planner has assigned a tag to no request that reads it. This is a defect of this crate, please
    /// report it with the tags of the plan.
    #[error("the plan has no request for a value of {tag}: please report this defect of the planner")]
    #[non_exhaustive]
    Unassigned {
        /// The tag.
        tag: Tag,
    },
    /// The tags have too many values for a plan.
    #[error("the tags have more than {max} values")]
    #[non_exhaustive]
    TooManyValues {
        /// The maximum.
        max: usize,
    },
    /// A reply is missing, or the kind or number of its values does not match its request.
    #[error("no matching reply for request {request} of the plan")]
    #[non_exhaustive]
    Reply {
        /// The index of the request.
        request: usize,
    },
    /// A request violates a rule of the protocol.
    #[error(transparent)]
    Request(#[from] InvalidRequest),
}

impl PlanError {
    /// The error of a call that reads tags.
    pub(crate) fn into_call_error(self) -> Error {
        match self {
            Self::Request(invalid) => Error::Invalid(invalid),
            Self::Limit { .. }
            | Self::Range { .. }
            | Self::NoWords { .. }
            | Self::NotReadable { .. }
            | Self::OneScan { .. }
            | Self::Unassigned { .. }
            | Self::TooManyValues { .. }
            | Self::Reply { .. } => TagAccessError::NoPlan { reason: self.to_string() }.into(),
        }
    }
}

/// Displays the tags of [`PlanError::OneScan`].
struct WhichTags<'t>(&'t Tag, usize);

impl fmt::Display for WhichTags<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self(tag, 1) => tag.fmt(f),
            Self(first, tags) => write!(f, "the {tags} tags from {first} on"),
        }
    }
}

/// Displays why no mixed read is possible: the units, and the maximum of a mixed read.
struct WhyNotMixed(usize, usize);

impl fmt::Display for WhyNotMixed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self(_, 0) => f.write_str("there are no mixed reads"),
            Self(units, max) if units > max => {
                write!(f, "{units} units exceed the {max} of a mixed read")
            }
            Self(..) => f.write_str("a mixed read would be ambiguous in the binary framing"),
        }
    }
}
