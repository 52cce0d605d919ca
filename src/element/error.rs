use std::fmt;

use super::{Element, Symbol, Width};
use crate::printable::excerpt;
use crate::wire::Framing;

/// The rule of the protocol that a symbol or an address breaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ElementError {
    /// The letters are not a symbol.
    #[error("no element has these letters (known: {})", AllSymbols)]
    UnknownSymbol,
    /// No digits follow the letters.
    #[error("{symbol} needs a decimal address, such as {symbol}0")]
    MissingAddress {
        /// The letters.
        symbol: Symbol,
    },
    /// Something other than decimal digits follows the letters.
    #[error("the address of {symbol} must be decimal digits and nothing else")]
    BadAddress {
        /// The letters.
        symbol: Symbol,
    },
    /// The address is past the last one.
    #[error("{}is past the last address, {symbol}{}", Given(*symbol, *address), symbol.last_address())]
    OutOfRange {
        /// The symbol.
        symbol: Symbol,
        /// The address; `u32::MAX` for larger ones.
        address: u32,
    },
    /// The address of a word of discretes is not a multiple of 8.
    #[error("{symbol}{address}: the address of {symbol} must be a multiple of {}", symbol.alignment())]
    Misaligned {
        /// The symbol.
        symbol: Symbol,
        /// The address.
        address: u16,
    },
    /// The address is past the last one of the framing of a link.
    #[error(
        "{symbol}{address} is past the last address of the {framing} framing, {symbol}{}",
        symbol.last_address_in(*framing)
    )]
    #[non_exhaustive]
    PastFraming {
        /// The symbol.
        symbol: Symbol,
        /// The address.
        address: u16,
        /// The framing.
        framing: Framing,
    },
    /// The element would be, or contain, half of a counter of 32 bits: `RC200`, `DRC199`.
    #[error("{symbol}{address} does not exist: {}", Counters(*symbol))]
    #[non_exhaustive]
    Counter {
        /// The symbol.
        symbol: Symbol,
        /// The address.
        address: u16,
    },
    /// An element does not follow another, because counters of 32 bits begin or end in between.
    #[error("{symbol}{address} does not follow {symbol}{first}: {}", Counters(*symbol))]
    #[non_exhaustive]
    NotConsecutive {
        /// The symbol of both.
        symbol: Symbol,
        /// The address of the first.
        first: u16,
        /// The address of the other.
        address: u16,
    },
    /// An element has another width than a type or a value.
    #[error("{element} is {}, not {expected}", element.width())]
    WrongWidth {
        /// The element.
        element: Element,
        /// The width of the type or the value.
        expected: Width,
    },
}

/// A text that is not an element, and the rule that it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{}` is not an element: {reason}", excerpt(input))]
pub struct ParseElementError {
    pub(super) input: String,
    pub(super) reason: ElementError,
}

impl ParseElementError {
    /// The text.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The rule that it breaks.
    #[must_use]
    pub fn reason(&self) -> ElementError {
        self.reason
    }
}

/// The rule of the counters in the area of a symbol.
struct Counters(Symbol);

impl fmt::Display for Counters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (dword, [first, last]) = (self.0.area().dword(), self.0.counters());
        write!(f, "{dword}{first} to {dword}{last} are counters of 32 bits, with one address each")
    }
}

/// All symbols, for the message of [`ElementError::UnknownSymbol`].
struct AllSymbols;

impl fmt::Display for AllSymbols {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, symbol) in Symbol::ALL.iter().enumerate() {
            if i > 0 {
                f.write_str(" ")?;
            }
            f.write_str(symbol.as_str())?;
        }
        Ok(())
    }
}

/// Displays an address that was given, unless it is too large to be known.
struct Given(Symbol, u32);

impl fmt::Display for Given {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(symbol, address) = *self;
        if address < u32::MAX { write!(f, "{symbol}{address} ") } else { write!(f, "the address of {symbol} ") }
    }
}
