use std::fmt;

use super::text::Quoted;
use super::{ScaleError, Tag, TagType, TagValue};
use crate::command::Value;
use crate::element::{Element, ElementError, Symbol, Width};

/// The rule that a tag breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
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
    /// Several texts in one tag: a text is its whole range.
    #[error("a tag has one text, as long as its range, and not several from {first} on")]
    #[non_exhaustive]
    SeveralTexts {
        /// The first element.
        first: Element,
    },
    /// A text that one request does not hold.
    #[error("a text comes from one request, which holds {max} registers, and the range has {registers}")]
    #[non_exhaustive]
    LongText {
        /// How many registers it would have.
        registers: usize,
        /// The most it can have.
        max: usize,
    },
    /// No gain and no offset.
    #[error(transparent)]
    Scale(#[from] ScaleError),
    /// Gain and offset on what is no number.
    #[error("{tag_type} takes neither gain nor offset (those that do: {})", Names(scalable()))]
    #[non_exhaustive]
    NotScalable {
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
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
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
    #[error("{tag} is {}, and {value} is {}", tag.kind.description(), value.description())]
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
    /// A value comes from no number that the elements can hold, by the tag's scale.
    #[error("{value:?} comes from the raw number {raw:?}, which does not fit: {tag_type} takes {}", tag_type.takes())]
    #[non_exhaustive]
    RawOutOfRange {
        /// The value.
        value: f64,
        /// What it comes from, before it is rounded.
        raw: f64,
        /// The type of the raw number.
        tag_type: TagType,
    },
    /// It is not a decimal number, where a scaled value should be.
    #[error("a scaled value is a decimal number, such as 12.3 or -1e3")]
    NotDecimal,
    /// There are more characters than the elements hold.
    #[error("{} has {characters} characters, and {most} fit", Quoted(text))]
    #[non_exhaustive]
    TooLong {
        /// The text.
        text: String,
        /// How many characters it has.
        characters: usize,
        /// How many the elements hold.
        most: usize,
    },
    /// A character that no byte stands for.
    #[error("{} has the character {character:?}, and only the 256 of Latin-1 can be held", Quoted(text))]
    #[non_exhaustive]
    NotLatin1 {
        /// The text.
        text: String,
        /// The character.
        character: char,
    },
    /// A bare text that could be taken for something else.
    #[error("text with a comma, a quote, a backslash or a control character stands in double quotes, such as \"a, b\"")]
    NotQuoted,
    /// Double quotes that do not enclose the text.
    #[error("text in double quotes ends with one, and a quote within it stands behind a backslash")]
    BadQuotes,
    /// A backslash before something that it does not go with.
    #[error(r#"a backslash stands before one of " \ n r t 0, or before x and two hexadecimal digits"#)]
    BadEscape,
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
    input: String,
    tag: Tag,
    /// In a box, for it can hold a tag too.
    reason: Box<ValueError>,
}

impl ParseValueError {
    pub(super) fn new(input: &str, tag: Tag, reason: ValueError) -> Self {
        Self { input: input.to_owned(), tag, reason: reason.into() }
    }

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

fn scalable() -> impl Iterator<Item = TagType> + Clone {
    TagType::ALL.iter().copied().filter(|tag_type| tag_type.is_scalable())
}

/// The types that elements of a width can have, for [`TagError::WrongType`].
struct TypesOf(Width);

impl fmt::Display for TypesOf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Names(TagType::ALL.iter().copied().filter(|tag_type| tag_type.kind(self.0).is_some())).fmt(f)
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
