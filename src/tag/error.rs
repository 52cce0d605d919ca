use std::fmt;

use super::{Tag, TagType, TagValue};
use crate::command::Value;
use crate::element::{Element, ElementError, Symbol, Width};

/// The rule that a tag breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TagError {
    /// An end of the range, or the whole, is no element.
    #[error(transparent)]
    Element(#[from] ElementError),
    /// There is no such type.
    #[error(transparent)]
    Type(#[from] ParseTagTypeError),
    /// The type does not exist on such elements.
    #[error("{symbol} is {}, which has no type {tag_type} (it has: {})", symbol.width(), TypesOf(symbol.width()))]
    WrongType {
        /// The symbol of the elements.
        symbol: Symbol,
        /// The type asked for.
        tag_type: TagType,
    },
    /// The ends of the range have different symbols.
    #[error("a range has one kind of element, and this goes from {first} to {last}")]
    TwoSymbols {
        /// The symbol of its first element.
        first: Symbol,
        /// The symbol of its last element.
        last: Symbol,
    },
    /// The range ends before it begins.
    #[error("the range goes backwards, from {first} to {last}")]
    Backwards {
        /// Where it begins.
        first: Element,
        /// Where it ends.
        last: Element,
    },
    /// The end of the range is not one of the elements that follow its begin.
    #[error("{last} does not follow {first}, because {} is counted in steps of {}", first.symbol(), first.symbol().step())]
    OffStep {
        /// Where it begins.
        first: Element,
        /// Where it ends.
        last: Element,
    },
    /// A range with an uneven number of 16-bit registers, where a value takes two of them.
    #[error("{tag_type} takes two 16-bit registers, and the range has {count}, an uneven number")]
    Uneven {
        /// How many elements the range has.
        count: usize,
        /// The type.
        tag_type: TagType,
    },
    /// A tag of no values at all.
    #[error("a tag has at least one value")]
    NoValues,
    /// The elements reach past the last address.
    #[error(
        "{count} elements from {first} on reach past the last address, {}{}",
        first.symbol(), first.symbol().last_address()
    )]
    PastTheEnd {
        /// The first element.
        first: Element,
        /// How many elements are needed.
        count: usize,
    },
}

/// A text that is not a tag: the text, and the rule it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{input}` is not a tag: {reason}")]
pub struct ParseTagError {
    pub(super) input: String,
    pub(super) reason: TagError,
}

impl ParseTagError {
    /// The text as given.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The rule it breaks.
    #[must_use]
    pub fn reason(&self) -> &TagError {
        &self.reason
    }
}

/// A text that names no type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is not a type (known: {known})", known = Names(TagType::ALL.iter().copied()))]
pub struct ParseTagTypeError(pub(super) String);

/// The rule that a value, or a number of values, breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ValueError {
    /// Too few or too many.
    #[error("{tag} takes {expected} of them, not {given}")]
    Count {
        /// The tag.
        tag: Tag,
        /// How many it takes.
        expected: usize,
        /// How many there are.
        given: usize,
    },
    /// A raw value is not as wide as the tag's elements.
    #[error("{tag} has elements of {} bits, and {value} has {}", tag.first.width().bits(), value.width().bits())]
    WrongWidth {
        /// The tag.
        tag: Tag,
        /// The raw value.
        value: Value,
    },
    /// A value is of another type than the tag.
    #[error("{tag} is {} of {} bits, and {value} is {} of {}", tag.tag_type, tag.shape.bits(), value.tag_type(), value.shape().bits())]
    WrongType {
        /// The tag.
        tag: Tag,
        /// The value.
        value: TagValue,
    },
    /// It is not written as values of this type are.
    #[error("{tag_type} takes {}", tag_type.takes())]
    Malformed {
        /// The type.
        tag_type: TagType,
    },
    /// It is a number, and too small or too large for the type.
    #[error("it does not fit: {tag_type} takes {}", tag_type.takes())]
    OutOfRange {
        /// The type.
        tag_type: TagType,
    },
    /// There is no value where one should be.
    #[error("a value is missing")]
    Empty,
    /// A hexadecimal value without its mark, which could also be a decimal one.
    #[error("a hexadecimal value begins with 0x, such as 0x{}", if *bits > 16 { "0000BEEF" } else { "00FF" })]
    NotMarked {
        /// How many bits the value has.
        bits: u32,
    },
    /// `0x` is not followed by hexadecimal digits alone, or by too many of them.
    #[error("0x must be followed by 1 to {max} hexadecimal digits")]
    BadHex {
        /// The most digits that the type takes.
        max: u32,
    },
    /// `0x` for a float, without all the digits of its bits.
    #[error("as the bits of f32, 0x must be followed by all 8 digits, such as 0x3F800000 for 1.0")]
    PartialBits,
}

/// A text that is not the value, or the values, of a tag: the text, and the rule it breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{input}` is not a value for {tag}: {reason}")]
pub struct ParseValueError {
    pub(super) input: String,
    pub(super) tag: Tag,
    pub(super) reason: ValueError,
}

impl ParseValueError {
    /// The text of the value as given; all of them when their number is wrong.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The tag it was to be a value for.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    /// The rule it breaks.
    #[must_use]
    pub fn reason(&self) -> &ValueError {
        &self.reason
    }
}

/// A text that is not an assignment.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ParseAssignmentError {
    /// There is no `=`.
    #[error("`{input}` is not an assignment: it must be TAG=VALUE, such as R5=7")]
    NoValue {
        /// The text as given.
        input: String,
    },
    /// What stands before `=` is no tag.
    #[error(transparent)]
    Tag(#[from] ParseTagError),
    /// What stands behind it is no value of that tag.
    #[error(transparent)]
    Value(#[from] ParseValueError),
}

/// The types that elements of a width can have, for [`TagError::WrongType`].
struct TypesOf(Width);

impl fmt::Display for TypesOf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Names(TagType::ALL.iter().copied().filter(|tag_type| tag_type.shape(self.0).is_some())).fmt(f)
    }
}

struct Names<I>(I);

impl<I: Iterator<Item = TagType> + Clone> fmt::Display for Names<I> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, tag_type) in self.0.clone().enumerate() {
            write!(f, "{}{tag_type}", if i > 0 { " " } else { "" })?;
        }
        Ok(())
    }
}
