use std::fmt;

use super::types::Storage;
use super::{ScaleError, Tag, TagType, TagValue};
use crate::element::{Element, ElementError, Symbol, Width};
use crate::printable::excerpt;

/// A rule that a tag breaks.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TagError {
    /// The text, or an end of the range, is not an element.
    #[error(transparent)]
    Element(#[from] ElementError),
    /// The type is unknown.
    #[error("the type is unknown (known: {})", Names(TagType::ALL.iter().copied()))]
    UnknownType,
    /// A bit of a register has a type other than `bool`.
    #[error("a bit of a register is bool, not {tag_type}")]
    #[non_exhaustive]
    BitType {
        /// The type.
        tag_type: TagType,
    },
    /// The number of a bit is missing, or not decimal digits.
    #[error("{element}. is followed by the number of a bit, such as {element}.0")]
    #[non_exhaustive]
    BadBit {
        /// The register.
        element: Element,
    },
    /// The register does not have this bit, or the element is a discrete.
    #[error("{element} is {}, which has no bit {bit}", element.width())]
    #[non_exhaustive]
    NoBit {
        /// The element.
        element: Element,
        /// The bit.
        bit: u8,
    },
    /// The bits of a range are in two registers.
    #[error("the bits of a range are in one register, and this range is from {first} to {last}")]
    #[non_exhaustive]
    BitsOfTwo {
        /// The register of the first bit.
        first: Element,
        /// The register of the last bit.
        last: Element,
    },
    /// The last bit precedes the first.
    #[error("the range goes backwards, from {element}.{first} to {element}.{last}")]
    #[non_exhaustive]
    BackwardBits {
        /// The register.
        element: Element,
        /// The first bit.
        first: u8,
        /// The last bit.
        last: u8,
    },
    /// The type does not exist for elements of this width.
    #[error(
        "{symbol} is {}, which has no type {tag_type} (it has: {})",
        Elements(*symbol, *tag_type), TypesOf(*symbol, *tag_type)
    )]
    WrongType {
        /// The symbol of the elements.
        symbol: Symbol,
        /// The type.
        tag_type: TagType,
    },
    /// The ends of the range have different symbols.
    #[error("a range has elements of one symbol, and this one is from {first} to {last}")]
    TwoSymbols {
        /// The symbol of the first element.
        first: Symbol,
        /// The symbol of the last element.
        last: Symbol,
    },
    /// The last element precedes the first.
    #[error("the range goes backwards, from {first} to {last}")]
    Backwards {
        /// The first element.
        first: Element,
        /// The last element.
        last: Element,
    },
    /// The last element is not a whole number of steps behind the first.
    #[error(
        "{last} does not follow {first}, because {} is counted in steps of {}",
        first.symbol(), first.step()
    )]
    OffStep {
        /// The first element.
        first: Element,
        /// The last element.
        last: Element,
    },
    /// The range is not a whole number of values.
    #[error("a value of {tag_type} takes {per_value} elements, and the range has {count}")]
    Uneven {
        /// Number of elements of the range.
        count: usize,
        /// Number of elements per value.
        per_value: usize,
        /// The type.
        tag_type: TagType,
    },
    /// The tag would have several texts. A text is a whole range.
    #[error("a tag has one text, as long as its range, not several from {first} on")]
    #[non_exhaustive]
    SeveralTexts {
        /// The first element.
        first: Element,
    },
    /// The text is longer than one request.
    #[error("a text comes from one request, which holds {max} registers, and the range has {registers}")]
    #[non_exhaustive]
    LongText {
        /// Number of registers of the text.
        registers: usize,
        /// Maximum number of registers.
        max: usize,
    },
    /// Gain and offset are invalid.
    #[error(transparent)]
    Scale(#[from] ScaleError),
    /// A gain or offset stands behind an element without a type.
    #[error("a gain or offset needs a type before it, such as in R5:u16*0.1")]
    ScaleWithoutType,
    /// The type cannot have a gain or offset.
    #[error("{tag_type} takes neither gain nor offset (types that do: {})", Names(scalable()))]
    #[non_exhaustive]
    NotScalable {
        /// The type.
        tag_type: TagType,
    },
    /// The tag has no values.
    #[error("a tag has at least one value")]
    NoValues,
    /// The elements reach past the last address.
    #[error(
        "{count} elements from {first} on reach past the last address, {}{}",
        first.symbol(), first.last_consecutive()
    )]
    PastTheEnd {
        /// The first element.
        first: Element,
        /// Number of elements.
        count: usize,
    },
}

impl TagError {
    /// The rule without the names of the input, for errors of the compiler.
    #[doc(hidden)]
    #[must_use]
    pub const fn rule(&self) -> &'static str {
        match self {
            Self::Element(ElementError::UnknownSymbol) => "not a tag: no element has these letters",
            Self::Element(ElementError::MissingAddress { .. } | ElementError::BadAddress { .. }) => {
                "not a tag: the letters of an element are followed by decimal digits and nothing else"
            }
            Self::Element(ElementError::Misaligned { .. }) => {
                "not a tag: the address of a word of discretes is a multiple of 8"
            }
            Self::Element(ElementError::Counter { .. } | ElementError::NotConsecutive { .. }) => {
                "not a tag: DRC200 to DRC255 are counters of 32 bits, with one address each"
            }
            Self::Element(
                ElementError::OutOfRange { .. } | ElementError::PastFraming { .. } | ElementError::WrongWidth { .. },
            ) => "not a tag: the address is past the last one",
            Self::UnknownType => "not a tag: the type is unknown",
            Self::WrongType { .. } => "not a tag: elements of this width do not have this type",
            Self::BitType { .. } => "not a tag: a bit of a register is bool",
            Self::BadBit { .. } => "not a tag: the number of a bit is missing, or not decimal digits",
            Self::NoBit { .. } => "not a tag: the element does not have this bit",
            Self::BitsOfTwo { .. } => "not a tag: the bits of a range are in one register",
            Self::TwoSymbols { .. } => "not a tag: a range has elements of one symbol",
            Self::Backwards { .. } | Self::BackwardBits { .. } => "not a tag: the range goes backwards",
            Self::OffStep { .. } => "not a tag: the last element is not a whole number of steps behind the first",
            Self::Uneven { .. } => "not a tag: the range is not a whole number of values",
            Self::SeveralTexts { .. } => "not a tag: a tag has one text",
            Self::LongText { .. } => "not a tag: a text has at most 64 registers",
            Self::Scale(ScaleError::Malformed) => {
                "not a tag: a scale is *GAIN, +OFFSET, -OFFSET or both in this order, such as *0.1-40"
            }
            Self::Scale(ScaleError::NotConst) => {
                "a number of a scale in a constant has at most 15 digits, and an exponent from -22 to 22"
            }
            Self::Scale(ScaleError::Gain { .. } | ScaleError::Offset { .. } | ScaleError::Coarse { .. }) => {
                "not a tag: the numbers of its scale are out of range"
            }
            Self::ScaleWithoutType => "not a tag: a gain or offset needs a type before it, such as in R5:u16*0.1",
            Self::NotScalable { .. } => "not a tag: this type takes neither gain nor offset",
            Self::NoValues => "not a tag: it has no values",
            Self::PastTheEnd { .. } => "not a tag: the elements reach past the last address",
        }
    }
}

/// A text that is not a tag, with the rule that it breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{}` is not a tag: {reason}", excerpt(input))]
pub struct ParseTagError {
    pub(super) input: String,
    pub(super) reason: TagError,
}

impl ParseTagError {
    /// The text.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The rule that it breaks.
    #[must_use]
    pub fn reason(&self) -> &TagError {
        &self.reason
    }
}

/// A text that is not the name of a type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{}` is not a type (known: {known})", excerpt(.0), known = Names(TagType::ALL.iter().copied()))]
pub struct ParseTagTypeError(pub(super) String);

/// A rule that a value, or the number of values, breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ValueError {
    /// The number of values is wrong.
    #[error("the number of values is {given}, and {tag} takes {expected}")]
    Count {
        /// The tag.
        tag: Tag,
        /// Number of values that the tag takes.
        expected: usize,
        /// Number of values given.
        given: usize,
    },
    /// The tag is bits of a register, and a write would replace all of its bits.
    #[error(
        "{tag} is a part of {register}, and a write replaces all bits of {register}; \
         modify_bits reads, changes and writes them",
        register = tag.first()
    )]
    #[non_exhaustive]
    BitsOfRegister {
        /// The tag.
        tag: Tag,
    },
    /// A raw value has another width than the elements of the tag: [`ElementError::WrongWidth`].
    #[error(transparent)]
    Element(#[from] ElementError),
    /// A value is of another type than the tag.
    #[error("{tag} is {}, and {value} is {}", tag.description(), value.description())]
    WrongType {
        /// The tag.
        tag: Tag,
        /// The value.
        value: TagValue,
    },
    /// The text is not a value of this type.
    #[error("{tag_type} takes {}", tag_type.takes())]
    Malformed {
        /// The type.
        tag_type: TagType,
    },
    /// The number is too small or too large for the type.
    #[error("out of range: {tag_type} takes {}", tag_type.takes())]
    OutOfRange {
        /// The type.
        tag_type: TagType,
    },
    /// A float does not have the integer: the nearest one is another number.
    #[error("{tag_type} cannot represent this integer exactly")]
    #[non_exhaustive]
    Inexact {
        /// The type.
        tag_type: TagType,
    },
    /// A value of another kind: a number for a `bool`, or a float for an integer.
    #[error("{tag_type} takes no {kind}")]
    #[non_exhaustive]
    Kind {
        /// The type.
        tag_type: TagType,
        /// The kind of the value.
        kind: GivenKind,
    },
    /// The raw number of a scaled value is out of the range of the type.
    #[error("the raw number of {value:?} is {raw:?}, out of range: {tag_type} takes {}", tag_type.takes())]
    #[non_exhaustive]
    RawOutOfRange {
        /// The scaled value.
        value: f64,
        /// The raw number, not rounded.
        raw: f64,
        /// The type of the raw number.
        tag_type: TagType,
    },
    /// A scaled value is not a decimal number.
    #[error("a scaled value is a decimal number, such as 12.3 or -1e3")]
    NotDecimal,
    /// The text is longer than the elements.
    #[error("\"{}\" has {characters} characters, and {max} fit", excerpt(text))]
    #[non_exhaustive]
    TooLong {
        /// The text.
        text: String,
        /// Number of characters.
        characters: usize,
        /// Maximum number of characters.
        max: usize,
    },
    /// A character is not Latin-1.
    #[error("\"{}\" has the character {character:?}, which is not Latin-1", excerpt(text))]
    #[non_exhaustive]
    NotLatin1 {
        /// The text.
        text: String,
        /// The character.
        character: char,
    },
    /// A text without quotes has a character that needs them.
    #[error("a text with a comma, a quote, a backslash or a control character needs double quotes, such as \"a, b\"")]
    NotQuoted,
    /// The double quotes do not enclose the whole text.
    #[error("a text in double quotes must end with one, and a quote within it needs a backslash before it")]
    BadQuotes,
    /// The escape behind a backslash is unknown.
    #[error(r#"a backslash must be followed by one of " \ n r t 0, or by x and two hexadecimal digits"#)]
    BadEscape,
    /// A value is empty.
    #[error("a value is missing")]
    Empty,
    /// A hexadecimal value has no `0x`.
    #[error("a hexadecimal value begins with 0x, such as 0x{}", if *bits > 16 { "0000BEEF" } else { "00FF" })]
    NotMarked {
        /// Number of bits of the value.
        bits: u32,
    },
    /// `0x` is not followed by 1 to `max` hexadecimal digits.
    #[error("0x must be followed by 1 to {max} hexadecimal digits")]
    BadHex {
        /// Maximum number of digits.
        max: u32,
    },
    /// A float as `0x` has not all its digits.
    #[error("as the bits of {tag_type}, 0x must be followed by all {digits} digits")]
    #[non_exhaustive]
    PartialBits {
        /// The type.
        tag_type: TagType,
        /// Number of digits that it takes.
        digits: u32,
    },
}

/// The kind of a value that a type does not take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum GivenKind {
    /// A number, for a state or a text.
    Number,
    /// A number with a fraction or an exponent, for an integer.
    Float,
    /// `true` or `false`, for a number or a text.
    State,
}

impl fmt::Display for GivenKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Number => "numbers",
            Self::Float => "floats",
            Self::State => "true and false",
        })
    }
}

/// A text that is not a value of a tag, with the rule that it breaks.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`{}` is not a value for {tag}: {reason}", excerpt(input))]
pub struct ParseValueError {
    input: String,
    tag: Tag,
    /// Boxed, since it can contain a tag, too.
    reason: Box<ValueError>,
}

impl ParseValueError {
    pub(super) fn new(input: &str, tag: Tag, reason: ValueError) -> Self {
        Self { input: input.to_owned(), tag, reason: reason.into() }
    }

    /// The text of the value; the text of all values if their number is wrong.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    /// The rule that it breaks.
    #[must_use]
    pub fn reason(&self) -> &ValueError {
        &self.reason
    }
}

/// The reason why a tag cannot be read into a Rust type, or a Rust value not be written to it.
/// Nothing was sent, but for [`NoNumber`](Self::NoNumber).
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TagAccessError {
    /// The text is not a tag.
    #[error(transparent)]
    Parse(#[from] ParseTagError),
    /// The Rust type cannot hold all values of the tag, or not their number.
    #[error("{} cannot be read into `{rust_type}`", Values(tag))]
    #[non_exhaustive]
    NotInto {
        /// The tag.
        tag: Tag,
        /// The Rust type.
        rust_type: String,
    },
    /// A value of decimal digits (BCD) has another digit.
    #[error("{tag} holds {value}, which is no decimal number")]
    #[non_exhaustive]
    NoNumber {
        /// The tag.
        tag: Tag,
        /// Its value, as hexadecimal digits.
        value: String,
    },
    /// A value cannot be written to the tag.
    #[error("{given} cannot be written to {}{}", Values(tag), Reason(reason.as_deref()))]
    #[non_exhaustive]
    Misfit {
        /// The tag.
        tag: Tag,
        /// The value, or the number of values.
        given: String,
        /// The rule that the value breaks, unless the kind or the number of values is wrong.
        reason: Option<Box<ValueError>>,
    },
    /// The tag is bits of a register, which are not written by themselves. See
    /// [`Station::modify_bits`](crate::Station::modify_bits).
    #[error(transparent)]
    BitsOfRegister(ValueError),
    /// The tag is not bits of a register, so [`Station::modify_bits`](crate::Station::modify_bits) does
    /// not take it.
    #[error("{tag} is not a bit of a register, such as R5.3: it is written by itself")]
    #[non_exhaustive]
    NotBitsOfRegister {
        /// The tag.
        tag: Tag,
    },
    /// A value of a tag is of another kind than the Rust type.
    #[error("{value} is {}, which cannot be converted to `{rust_type}`", value.description())]
    #[non_exhaustive]
    Conversion {
        /// The value.
        value: TagValue,
        /// The Rust type.
        rust_type: &'static str,
    },
    /// A value of the protocol has another width than the Rust type.
    #[error("a value of {found} is not `{rust_type}`")]
    #[non_exhaustive]
    Width {
        /// Its width.
        found: Width,
        /// The Rust type.
        rust_type: &'static str,
    },
    /// The number of tags is not that of the items of the Rust type.
    #[error("{tags} tags cannot be read into a Rust type of {items} items")]
    #[non_exhaustive]
    Number {
        /// The number of tags.
        tags: usize,
        /// The number of items of the Rust type.
        items: usize,
    },
    /// No plan reads the tags: they have too many values.
    #[error("the tags cannot be read: {reason}")]
    #[non_exhaustive]
    NoPlan {
        /// The rule that they break.
        reason: String,
    },
}

impl TagAccessError {
    /// The error of another number of values than that of the tag.
    pub(crate) fn misfit_of(tag: &Tag, given: usize) -> Self {
        let given = if given == 1 { "1 value".to_owned() } else { format!("{given} values") };
        Self::Misfit { tag: *tag, given, reason: None }
    }

    pub(super) fn conversion(value: &TagValue, rust_type: &'static str) -> Self {
        Self::Conversion { value: value.clone(), rust_type }
    }
}

/// Displays a tag with the kind and number of its values.
struct Values<'t>(&'t Tag);

impl fmt::Display for Values<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(tag) = self;
        match tag.value_count() {
            1 => write!(f, "{tag} ({})", tag.description()),
            count => write!(f, "{tag} ({count} values, each {})", tag.description()),
        }
    }
}

/// Displays the rule behind an error, if there is one.
struct Reason<'e>(Option<&'e ValueError>);

impl fmt::Display for Reason<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.map_or(Ok(()), |reason| write!(f, ": {reason}"))
    }
}

/// A text that is not an assignment.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ParseAssignmentError {
    /// The text has no `=`.
    #[error("`{}` is not an assignment: it must be TAG=VALUE, such as R5=7", excerpt(input))]
    NoValue {
        /// The text.
        input: String,
    },
    /// The text before `=` is not a tag.
    #[error(transparent)]
    Tag(#[from] ParseTagError),
    /// The text behind `=` is not a value of the tag.
    #[error(transparent)]
    Value(#[from] ParseValueError),
}

fn scalable() -> impl Iterator<Item = TagType> + Clone {
    TagType::ALL.iter().copied().filter(|tag_type| tag_type.is_scalable())
}

/// Returns whether the type is missing only for counters of 32 bits, which are no parts of longer values.
fn is_of_counters(symbol: Symbol, missing: TagType) -> bool {
    missing.storage(symbol.width()).is_some()
}

/// Displays the kind of the elements that lack a type.
struct Elements(Symbol, TagType);

impl fmt::Display for Elements {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(symbol, missing) = *self;
        if is_of_counters(symbol, missing) { f.write_str("a counter of 32 bits here") } else { symbol.width().fmt(f) }
    }
}

/// Displays the types of elements that lack one.
struct TypesOf(Symbol, TagType);

impl fmt::Display for TypesOf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(symbol, missing) = *self;
        let (width, counters) = (symbol.width(), is_of_counters(symbol, missing));
        let has = |storage: Storage| !counters || storage.elements_per_value(width) == 1;
        Names(TagType::ALL.iter().copied().filter(|tag_type| tag_type.storage(width).is_some_and(has))).fmt(f)
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
