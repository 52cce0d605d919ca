//! The elements of a PLC, such as `X0`, `R12` and `DR100`, and their values.
//!
//! An element is a [`Symbol`] (`X`, `WM`, `DR` …) and a decimal address. The three widths are three
//! types, because a command takes elements of one width: [`Discrete`] (1 bit), [`Register`] (16
//! bits) and [`Register32`] (32 bits). [`Element`] is any of them.
//!
//! ```
//! use fatek::{Element, Register, register};
//!
//! const LEVEL: Register = register!("R12"); // checked by the compiler
//! assert_eq!("r00012".parse::<Register>()?, LEVEL);
//! assert_eq!(LEVEL.to_string(), "R12");
//! assert_eq!(format!("{LEVEL:#}"), "R00012"); // as the ASCII framing sends it
//! assert!("WM4".parse::<Element>().is_err()); // words of discretes start at multiples of 8
//! # Ok::<(), fatek::element::ParseElementError>(())
//! ```
//!
//! Two rules go beyond the table of symbols:
//!
//! - An address fits the framing of a link: discretes, `RT` and `RC` have up to 9999 in ASCII and
//!   up to 65535 in binary. An element has an address of either framing. The call checks it before
//!   anything is sent.
//! - `C200` to `C255` are counters of 32 bits, with one address each: `DRC200`, `DRC201` and so on.
//!   They are read and written one by one, and there is no `RC200` and no pair `DRC199`.
//!
//! No input can cause a panic in this module. Source: protocol reference, section 3 (manuals 000
//! and 002 section 4.1, 001 section 2.4).

mod error;
mod macros;
mod symbol;
mod value;

use std::fmt;
use std::str::FromStr;

pub use error::{ElementError, ParseElementError};
pub(crate) use symbol::{LONGEST_ADDRESS, LONGEST_SYMBOL, MemoryArea};
pub use symbol::{Symbol, Width};
pub use value::Value;

use crate::wire::Framing;

/// An element of 1 bit: an input `X`, an output `Y`, a relay `M`, a step `S`, the contact of a
/// timer `T` or counter `C`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Discrete {
    symbol: Symbol,
    address: u16,
}

/// An element of 16 bits: `R`, `D`, `F`, the value of a timer `RT` or counter `RC`, or 16 discretes
/// together (`WX` …).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Register {
    symbol: Symbol,
    address: u16,
}

/// An element of 32 bits: two registers (`DR0` is `R0`, the low word, and `R1`), or 32 discretes
/// together (`DWM0` …).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Register32 {
    symbol: Symbol,
    address: u16,
}

/// An element of any width.
///
/// The protocol has these three widths and no others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Element {
    /// 1 bit.
    Discrete(Discrete),
    /// 16 bits.
    Register(Register),
    /// 32 bits.
    Register32(Register32),
}

one_width!(Discrete, Width::Bit, "X0");
one_width!(Register, Width::Word, "R0");
one_width!(Register32, Width::DWord, "DR0");

impl Register {
    /// The data register `R address`: every address is legal.
    #[must_use]
    pub const fn r(address: u16) -> Self {
        Self { symbol: Symbol::R, address }
    }

    /// The data register `D address`: every address is legal.
    #[must_use]
    pub const fn d(address: u16) -> Self {
        Self { symbol: Symbol::D, address }
    }

    /// The file register `F address`: every address is legal.
    #[must_use]
    pub const fn f(address: u16) -> Self {
        Self { symbol: Symbol::F, address }
    }

    /// The 32-bit element whose low word is this one: `DR0` for `R0`, `DWM8` for `WM8`.
    ///
    /// # Errors
    /// [`ElementError::OutOfRange`] when the high word would lie past the last address;
    /// [`ElementError::Counter`] for `RC199`.
    pub const fn widened(self) -> Result<Register32, ElementError> {
        Register32::new(self.symbol.area().dword(), self.address)
    }
}

impl Register32 {
    /// The 16-bit element that is the low word of this one: `R0` for `DR0`, `WM8` for `DWM8`.
    ///
    /// # Errors
    /// [`ElementError::Counter`] for `DRC200` to `DRC255`, which are not pairs.
    pub const fn low(self) -> Result<Register, ElementError> {
        Register::new(self.symbol.area().word(), self.address)
    }
}

impl Element {
    /// The element with this symbol and address.
    ///
    /// # Errors
    /// [`ElementError::OutOfRange`], [`ElementError::Misaligned`] or [`ElementError::Counter`].
    pub const fn new(symbol: Symbol, address: u16) -> Result<Self, ElementError> {
        match symbol.check(address as u32) {
            Ok(address) => Ok(Self::unchecked(symbol, address)),
            Err(error) => Err(error),
        }
    }

    /// The element of a received request.
    ///
    /// A counter of 32 bits may be named as one of 16 bits: the PLC decides, and a gateway forwards
    /// a request unchanged.
    pub(crate) fn received(symbol: Symbol, address: u32, framing: Framing) -> Result<Self, ElementError> {
        let element = Self::unchecked(symbol, symbol.check_form(address)?);
        element.check_in(framing)?;
        Ok(element)
    }

    /// Parses an element: letters in either case, then decimal digits, such as `R12`, `R00012` or
    /// `dwm0`.
    ///
    /// Unlike [`FromStr`] it can be used in constants, and its error does not hold the input.
    ///
    /// # Errors
    /// Every [`ElementError`] of a symbol or an address.
    pub const fn parse(text: &str) -> Result<Self, ElementError> {
        let bytes = text.as_bytes();
        let mut split = 0;
        while split < bytes.len() && bytes[split].is_ascii_alphabetic() {
            split += 1;
        }
        let (letters, digits) = bytes.split_at(split);
        let Some(symbol) = Symbol::from_letters(letters) else {
            return Err(ElementError::UnknownSymbol);
        };
        Self::parse_address(symbol, digits)
    }

    /// Parses the decimal digits behind a symbol.
    pub(crate) const fn parse_address(symbol: Symbol, digits: &[u8]) -> Result<Self, ElementError> {
        if digits.is_empty() {
            return Err(ElementError::MissingAddress { symbol });
        }
        let mut address = 0_u32;
        let mut i = 0;
        while i < digits.len() {
            if !digits[i].is_ascii_digit() {
                return Err(ElementError::BadAddress { symbol });
            }
            // A number of any length stays above every limit.
            address = address.saturating_mul(10).saturating_add((digits[i] - b'0') as u32);
            i += 1;
        }
        match symbol.check(address) {
            Ok(address) => Ok(Self::unchecked(symbol, address)),
            Err(error) => Err(error),
        }
    }

    /// Its symbol.
    #[must_use]
    pub const fn symbol(self) -> Symbol {
        match self {
            Self::Discrete(e) => e.symbol,
            Self::Register(e) => e.symbol,
            Self::Register32(e) => e.symbol,
        }
    }

    /// Its address.
    #[must_use]
    pub const fn address(self) -> u16 {
        match self {
            Self::Discrete(e) => e.address,
            Self::Register(e) => e.address,
            Self::Register32(e) => e.address,
        }
    }

    /// Its width.
    #[must_use]
    pub const fn width(self) -> Width {
        self.symbol().width()
    }

    /// The `n`-th element after this one; the 0th is itself.
    ///
    /// Its address is `n` times [`step`](Self::step) further on.
    ///
    /// # Errors
    /// [`ElementError::OutOfRange`] when there is none. [`ElementError::Counter`] or
    /// [`ElementError::NotConsecutive`] when counters of 32 bits begin or end in between: no
    /// element follows `RC199`, `DRC198` or `DRC255`.
    #[inline]
    pub const fn nth(self, n: usize) -> Result<Self, ElementError> {
        if n == 0 {
            return Ok(self);
        }
        let symbol = self.symbol();
        // An address beyond u32 stays above every limit.
        let n = if n > u32::MAX as usize { u32::MAX } else { n as u32 };
        let address = (self.address() as u32).saturating_add(n.saturating_mul(self.step() as u32));
        // Without counters of 32 bits only the last address counts: the alignment stays.
        if !symbol.has_counters() && address <= symbol.last_address() as u32 {
            return Ok(self.at(address as u16));
        }
        match symbol.check(address) {
            Ok(address) if self.is_consecutive_with(address) => Ok(self.at(address)),
            Ok(address) => Err(ElementError::NotConsecutive { symbol, first: self.address(), address }),
            Err(error) => Err(error),
        }
    }

    /// The element of the same symbol at this address.
    const fn at(self, address: u16) -> Self {
        match self {
            Self::Discrete(e) => Self::Discrete(Discrete { address, ..e }),
            Self::Register(e) => Self::Register(Register { address, ..e }),
            Self::Register32(e) => Self::Register32(Register32 { address, ..e }),
        }
    }

    /// This element and those after it, `count` in all, or fewer if fewer follow.
    pub(crate) fn run(self, count: usize) -> impl Iterator<Item = Self> + Clone {
        let (first, step) = (self.address(), self.step());
        // A received request can name half a counter of 32 bits, which no other element follows.
        let others = if self.nth(1).is_ok() { (self.last_consecutive() - first) / step } else { 0 };
        let addresses = (0..=others).take(count).map(move |n| first + n * step);
        addresses.map(move |address| self.at(address))
    }

    /// The distance to the address of the next element: that of [`Symbol::step`], and 1 for
    /// counters of 32 bits.
    #[must_use]
    #[inline]
    pub const fn step(self) -> u16 {
        if self.is_counter_of_32_bits() { 1 } else { self.symbol().step() }
    }

    /// Returns whether it is a counter of 32 bits: `DRC200` to `DRC255`.
    ///
    /// They are read and written one by one: by 48 and 49, or by 46 and 47 with one element.
    #[must_use]
    #[inline]
    pub const fn is_counter_of_32_bits(self) -> bool {
        let [first, last] = self.symbol().counters();
        first <= self.address() && self.address() <= last
    }

    /// First and last address that it covers, of discretes or of 16-bit registers.
    pub(crate) const fn covered(self) -> (u16, u16) {
        // Consecutive elements are adjacent, so each covers as many addresses as the step. No element
        // ends above 65535.
        let first = self.address();
        (first, first + (self.step() - 1))
    }

    /// Returns whether elements follow each other without a gap from this one to one at this
    /// address.
    pub(crate) const fn is_consecutive_with(self, address: u16) -> bool {
        let [first, last] = self.symbol().consecutive(self.address());
        first <= address && address <= last
    }

    /// The last address that elements consecutive with this one can have.
    pub(crate) const fn last_consecutive(self) -> u16 {
        let [_, last] = self.symbol().consecutive(self.address());
        let (last, of_symbol) = (last - (self.step() - 1), self.symbol().last_address());
        if last < of_symbol { last } else { of_symbol }
    }

    /// Checks its address against the limit of a framing.
    ///
    /// ```
    /// use fatek::wire::Framing;
    ///
    /// let relay = fatek::element!("M10000");
    /// assert!(relay.check_in(Framing::Binary).is_ok());
    /// let error = relay.check_in(Framing::Ascii).unwrap_err();
    /// assert_eq!(error.to_string(), "M10000 is past the last address of the ascii framing, M9999");
    /// ```
    ///
    /// # Errors
    /// [`ElementError::PastFraming`].
    pub const fn check_in(self, framing: Framing) -> Result<(), ElementError> {
        let (symbol, address) = (self.symbol(), self.address());
        if address > symbol.last_address_in(framing) {
            return Err(ElementError::PastFraming { symbol, address, framing });
        }
        Ok(())
    }

    const fn unchecked(symbol: Symbol, address: u16) -> Self {
        match symbol.width() {
            Width::Bit => Self::Discrete(Discrete { symbol, address }),
            Width::Word => Self::Register(Register { symbol, address }),
            Width::DWord => Self::Register32(Register32 { symbol, address }),
        }
    }
}

impl FromStr for Element {
    type Err = ParseElementError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::parse(text).map_err(|reason| ParseElementError { input: text.to_owned(), reason })
    }
}

impl fmt::Display for Element {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if f.alternate() {
            write!(f, "{}{:0digits$}", self.symbol(), self.address(), digits = self.symbol().digits())
        } else {
            write!(f, "{}{}", self.symbol(), self.address())
        }
    }
}

macro_rules! one_width {
    ($type:ident, $width:expr, $example:literal) => {
        impl $type {
            /// The element with this symbol and address.
            ///
            /// # Errors
            /// [`ElementError::WrongWidth`], and those of [`Element::new`].
            pub const fn new(symbol: Symbol, address: u16) -> Result<Self, ElementError> {
                match Element::new(symbol, address) {
                    Ok(element) => Self::narrow(element),
                    Err(error) => Err(error),
                }
            }

            /// Parses an element: letters in either case, then decimal digits.
            ///
            #[doc = concat!("```\nuse fatek::", stringify!($type), ";\n\nconst FIRST: bool = ")]
            #[doc = concat!(stringify!($type), "::parse(\"", $example, "\").is_ok();\nassert!(FIRST);\n```")]
            ///
            /// # Errors
            /// Any [`ElementError`].
            pub const fn parse(text: &str) -> Result<Self, ElementError> {
                match Element::parse(text) {
                    Ok(element) => Self::narrow(element),
                    Err(error) => Err(error),
                }
            }

            /// Its symbol.
            #[must_use]
            pub const fn symbol(self) -> Symbol {
                self.symbol
            }

            /// Its address.
            #[must_use]
            pub const fn address(self) -> u16 {
                self.address
            }

            /// The `n`-th element after this one; the 0th is itself.
            ///
            /// # Errors
            /// Those of [`Element::nth`].
            pub const fn nth(self, n: usize) -> Result<Self, ElementError> {
                match Element::$type(self).nth(n) {
                    Ok(element) => Self::narrow(element),
                    Err(error) => Err(error),
                }
            }

            const fn narrow(element: Element) -> Result<Self, ElementError> {
                match element {
                    Element::$type(e) => Ok(e),
                    other => Err(ElementError::WrongWidth { element: other, expected: $width }),
                }
            }
        }

        impl From<$type> for Element {
            fn from(element: $type) -> Self {
                Self::$type(element)
            }
        }

        impl TryFrom<Element> for $type {
            type Error = ElementError;

            fn try_from(element: Element) -> Result<Self, ElementError> {
                Self::narrow(element)
            }
        }

        impl FromStr for $type {
            type Err = ParseElementError;

            fn from_str(text: &str) -> Result<Self, Self::Err> {
                Self::parse(text).map_err(|reason| ParseElementError { input: text.to_owned(), reason })
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                Element::from(*self).fmt(f)
            }
        }
    };
}
use one_width;

#[cfg(test)]
mod tests;
