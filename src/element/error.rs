use std::fmt;

use super::{Symbol, Width};

/// The rule that a symbol and an address break.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ElementError {
    /// The letters are no element's.
    #[error("no element has these letters (known: {})", Known)]
    UnknownSymbol,
    /// There are letters but no digits.
    #[error("{symbol} needs a decimal address, such as {symbol}0")]
    MissingAddress {
        /// The letters.
        symbol: Symbol,
    },
    /// What follows the letters is not decimal digits alone.
    #[error("the address of {symbol} must be decimal digits and nothing else")]
    BadAddress {
        /// The letters.
        symbol: Symbol,
    },
    /// The address is past the last one.
    #[error("{symbol}{address} is past the last address, {symbol}{}", symbol.last_address())]
    OutOfRange {
        /// The symbol.
        symbol: Symbol,
        /// The address asked for; `u32::MAX` for anything larger.
        address: u32,
    },
    /// The address is not a multiple of 8 where it must be.
    #[error("{symbol}{address}: the address of {symbol} must be a multiple of {}", symbol.alignment())]
    Misaligned {
        /// The symbol.
        symbol: Symbol,
        /// The address asked for.
        address: u16,
    },
    /// The element has another width than is needed here.
    #[error("{symbol} is {}, not {expected}", symbol.width())]
    WrongWidth {
        /// The symbol.
        symbol: Symbol,
        /// The width that is needed.
        expected: Width,
    },
}

/// A text that is not an element: the text, and the rule it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{input}` is not an element: {reason}")]
pub struct ParseElementError {
    pub(super) input: String,
    pub(super) reason: ElementError,
}

impl ParseElementError {
    /// The text as given.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The rule it breaks.
    #[must_use]
    pub fn reason(&self) -> ElementError {
        self.reason
    }
}

/// All symbols, for the message of [`ElementError::UnknownSymbol`].
struct Known;

impl fmt::Display for Known {
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
