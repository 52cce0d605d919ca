//! The elements of a PLC: what a request can name.
//!
//! An element is a [`Symbol`] (`X`, `WM`, `DR` …) and a decimal address. Its [`Width`] decides which
//! commands can name it, so the three widths are three types: [`Discrete`] (one bit), [`Register`]
//! (16 bits) and [`Register32`] (32 bits); [`Element`] is any of them.
//!
//! ```
//! use fatek::{Element, Register, register};
//!
//! const LEVEL: Register = register!("R12"); // checked by the compiler
//! assert_eq!("r00012".parse::<Register>()?, LEVEL);
//! assert_eq!(LEVEL.to_string(), "R12"); // as people write it
//! assert_eq!(format!("{LEVEL:#}"), "R00012"); // as the ASCII framing sends it
//! assert!("WM4".parse::<Element>().is_err()); // words of discretes start at multiples of 8
//! # Ok::<(), fatek::element::ParseElementError>(())
//! ```
//!
//! Nothing in this module panics, whatever the input. Source: protocol reference, section 3 (manuals 000 and
//! 002 section 4.1, 001 section 2.4).

use std::fmt;
use std::str::FromStr;

// One row an element, as in the manuals' table: the check against the standard is to read this.
//
// - digits: decimal digits of the address in the ASCII framing
// - last:   the largest address
// - step:   the distance to the next consecutive element
// - align:  addresses must be a multiple of it
symbols! {
    // width  symbol  digits  last  step  align
    Bit     X    4   9999   1  1;
    Bit     Y    4   9999   1  1;
    Bit     M    4   9999   1  1;
    Bit     S    4   9999   1  1;
    Bit     T    4   9999   1  1;
    Bit     C    4   9999   1  1;

    Word    WX   4   9984  16  8;
    Word    WY   4   9984  16  8;
    Word    WM   4   9984  16  8;
    Word    WS   4   9984  16  8;
    Word    WT   4   9984  16  8;
    Word    WC   4   9984  16  8;
    Word    RT   4   9999   1  1;
    Word    RC   4   9999   1  1;
    Word    R    5  65535   1  1;
    Word    D    5  65535   1  1;
    Word    F    5  65535   1  1;

    Double  DWX  4   9968  32  8;
    Double  DWY  4   9968  32  8;
    Double  DWM  4   9968  32  8;
    Double  DWS  4   9968  32  8;
    Double  DWT  4   9968  32  8;
    Double  DWC  4   9968  32  8;
    Double  DRT  4   9998   2  1;
    Double  DRC  4   9998   2  1;
    Double  DR   5  65534   2  1;
    Double  DD   5  65534   2  1;
    Double  DF   5  65534   2  1;
}

/// The length of the longest symbol, in letters.
pub(crate) const LONGEST_SYMBOL: usize = 3;

impl Symbol {
    /// The letters, upper case: one to three of them.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        self.row().letters
    }

    /// How many bits an element of this symbol holds.
    #[must_use]
    pub const fn width(self) -> Width {
        self.row().width
    }

    /// How many decimal digits its address has in the ASCII framing: 4 or 5.
    #[must_use]
    pub const fn digits(self) -> usize {
        self.row().digits
    }

    /// The largest address the protocol has for it. A PLC's own limit is usually smaller: it answers
    /// [`IllegalAddress`](crate::ErrorCode::IllegalAddress) beyond that.
    #[must_use]
    pub const fn last_address(self) -> u16 {
        self.row().last
    }

    /// The distance between the addresses of consecutive elements: 16 for `WX`, 2 for `DR`, 1 for `R`.
    #[must_use]
    pub const fn step(self) -> u16 {
        self.row().step
    }

    /// What its addresses must be a multiple of: 8 for words and double words of discretes, else 1.
    #[must_use]
    pub const fn alignment(self) -> u16 {
        self.row().align
    }

    /// The symbol with these letters, in either case.
    #[must_use]
    pub const fn from_letters(letters: &[u8]) -> Option<Self> {
        let mut i = 0;
        while i < Self::ALL.len() {
            if Self::ALL[i].as_str().as_bytes().eq_ignore_ascii_case(letters) {
                return Some(Self::ALL[i]);
            }
            i += 1;
        }
        None
    }

    const fn check(self, address: u32) -> Result<u16, ElementError> {
        let row = self.row();
        if address > row.last as u32 {
            return Err(ElementError::OutOfRange { symbol: self, address });
        }
        let address = address as u16;
        if !address.is_multiple_of(row.align) {
            return Err(ElementError::Misaligned { symbol: self, address });
        }
        Ok(address)
    }
}

impl fmt::Display for Symbol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

/// How many bits an element holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Width {
    /// One bit: a discrete.
    Bit,
    /// 16 bits: a register, or 16 discretes together.
    Word,
    /// 32 bits: two consecutive registers, or 32 discretes together.
    Double,
}

impl Width {
    /// What an element of this width counts against a command's limit: 1, or 2 for 32 bits.
    #[must_use]
    pub const fn units(self) -> usize {
        match self {
            Self::Bit | Self::Word => 1,
            Self::Double => 2,
        }
    }

    /// 1, 16 or 32.
    #[must_use]
    pub const fn bits(self) -> u32 {
        match self {
            Self::Bit => 1,
            Self::Word => 16,
            Self::Double => 32,
        }
    }
}

impl fmt::Display for Width {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bit => "a discrete",
            Self::Word => "a 16-bit register",
            Self::Double => "a 32-bit register",
        })
    }
}

/// One bit: an input `X`, an output `Y`, a relay `M`, a step `S`, a timer's or counter's contact `T` or `C`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Discrete {
    symbol: Symbol,
    address: u16,
}

/// 16 bits: `R`, `D`, `F`, a timer's or counter's value `RT` or `RC`, or 16 discretes together (`WX` …).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Register {
    symbol: Symbol,
    address: u16,
}

/// 32 bits: a pair of registers (`DR0` is `R0`, the low word, and `R1`), or 32 discretes together (`DWM0` …).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Register32 {
    symbol: Symbol,
    address: u16,
}

/// Any element.
///
/// The widths are the protocol's own three, so this enum is complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Element {
    /// One bit.
    Discrete(Discrete),
    /// 16 bits.
    Register(Register),
    /// 32 bits.
    Register32(Register32),
}

one_width!(Discrete, Width::Bit, "X0");
one_width!(Register, Width::Word, "R0");
one_width!(Register32, Width::Double, "DR0");

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

    /// The 32-bit element whose low word is this one: `R0` gives `DR0`, `WM8` gives `DWM8`.
    ///
    /// # Errors
    /// [`ElementError::OutOfRange`] when the high word would lie past the last address.
    pub const fn widened(self) -> Result<Register32, ElementError> {
        let symbol = match self.symbol {
            Symbol::WX => Symbol::DWX,
            Symbol::WY => Symbol::DWY,
            Symbol::WM => Symbol::DWM,
            Symbol::WS => Symbol::DWS,
            Symbol::WT => Symbol::DWT,
            Symbol::WC => Symbol::DWC,
            Symbol::RT => Symbol::DRT,
            Symbol::RC => Symbol::DRC,
            Symbol::D => Symbol::DD,
            Symbol::F => Symbol::DF,
            _ => Symbol::DR,
        };
        Register32::new(symbol, self.address)
    }
}

impl Register32 {
    /// The 16-bit element that is the low word of this one: `DR0` gives `R0`, `DWM8` gives `WM8`.
    #[must_use]
    pub const fn low(self) -> Register {
        let symbol = match self.symbol {
            Symbol::DWX => Symbol::WX,
            Symbol::DWY => Symbol::WY,
            Symbol::DWM => Symbol::WM,
            Symbol::DWS => Symbol::WS,
            Symbol::DWT => Symbol::WT,
            Symbol::DWC => Symbol::WC,
            Symbol::DRT => Symbol::RT,
            Symbol::DRC => Symbol::RC,
            Symbol::DD => Symbol::D,
            Symbol::DF => Symbol::F,
            _ => Symbol::R,
        };
        Register { symbol, address: self.address }
    }
}

impl Element {
    /// The element with this symbol and address.
    ///
    /// # Errors
    /// [`ElementError::OutOfRange`] or [`ElementError::Misaligned`].
    pub const fn new(symbol: Symbol, address: u16) -> Result<Self, ElementError> {
        match symbol.check(address as u32) {
            Ok(address) => Ok(Self::unchecked(symbol, address)),
            Err(error) => Err(error),
        }
    }

    /// Reads an element as people write it: letters in either case, then decimal digits (`R12`, `R00012`, `dwm0`).
    ///
    /// The same as [`FromStr`], but usable in constants, and its error does not hold the input.
    ///
    /// # Errors
    /// Every [`ElementError`] but [`ElementError::WrongWidth`].
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
        if digits.is_empty() {
            return Err(ElementError::MissingAddress { symbol });
        }
        let mut address = 0_u32;
        let mut i = 0;
        while i < digits.len() {
            if !digits[i].is_ascii_digit() {
                return Err(ElementError::BadAddress { symbol });
            }
            // Saturation keeps a number of any length above every limit.
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

    /// How many bits it holds.
    #[must_use]
    pub const fn width(self) -> Width {
        self.symbol().width()
    }

    /// The `n`-th consecutive element after this one; the 0th is itself.
    ///
    /// Words of discretes step by 16, double words by 32, pairs of registers by 2, all others by 1.
    ///
    /// # Errors
    /// [`ElementError::OutOfRange`] when there is none.
    pub const fn nth(self, n: usize) -> Result<Self, ElementError> {
        let symbol = self.symbol();
        // Past u32 is past every limit: saturation cannot turn a bad address into a good one.
        let n = if n > u32::MAX as usize { u32::MAX } else { n as u32 };
        let address = (self.address() as u32).saturating_add(n.saturating_mul(symbol.step() as u32));
        match symbol.check(address) {
            Ok(address) => Ok(Self::unchecked(symbol, address)),
            Err(error) => Err(error),
        }
    }

    const fn unchecked(symbol: Symbol, address: u16) -> Self {
        match symbol.width() {
            Width::Bit => Self::Discrete(Discrete { symbol, address }),
            Width::Word => Self::Register(Register { symbol, address }),
            Width::Double => Self::Register32(Register32 { symbol, address }),
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
    input: String,
    reason: ElementError,
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

struct Row {
    letters: &'static str,
    width: Width,
    digits: usize,
    last: u16,
    step: u16,
    align: u16,
}

/// A [`Discrete`] known when the program is compiled: `discrete!("M100")`. A wrong one does not compile.
///
/// ```
/// let lamp = fatek::discrete!("Y3");
/// assert_eq!(lamp.to_string(), "Y3");
/// ```
///
/// ```compile_fail
/// let _ = fatek::discrete!("Y10000"); // past the last address
/// ```
#[macro_export]
macro_rules! discrete {
    ($text:literal) => {
        $crate::known_element!(Discrete, $text, "is not a discrete (X, Y, M, S, T or C and 0..=9999)")
    };
}

/// A [`Register`] known when the program is compiled: `register!("R12")`. A wrong one does not compile.
///
/// ```
/// let speed = fatek::register!("R12");
/// assert_eq!(speed, fatek::Register::r(12));
/// ```
///
/// ```compile_fail
/// let _ = fatek::register!("WM4"); // not a multiple of 8
/// ```
#[macro_export]
macro_rules! register {
    ($text:literal) => {
        $crate::known_element!(Register, $text, "is not a 16-bit register the protocol has")
    };
}

/// A [`Register32`] known when the program is compiled: `register32!("DR100")`. A wrong one does not compile.
///
/// ```
/// assert_eq!(fatek::register32!("DR100").low(), fatek::Register::r(100));
/// ```
#[macro_export]
macro_rules! register32 {
    ($text:literal) => {
        $crate::known_element!(Register32, $text, "is not a 32-bit register the protocol has")
    };
}

/// An [`Element`] known when the program is compiled: `element!("DWM0")`. A wrong one does not compile.
///
/// ```
/// assert_eq!(fatek::element!("DWM0").to_string(), "DWM0");
/// ```
#[macro_export]
macro_rules! element {
    ($text:literal) => {
        $crate::known_element!(Element, $text, "is not an element the protocol has")
    };
}

#[doc(hidden)]
#[macro_export]
macro_rules! known_element {
    ($type:ident, $text:literal, $rule:literal) => {
        const {
            match $crate::$type::parse($text) {
                ::core::result::Result::Ok(element) => element,
                ::core::result::Result::Err(_) => ::core::panic!(::core::concat!($text, " ", $rule)),
            }
        }
    };
}

macro_rules! symbols {
    ($($width:ident $symbol:ident $digits:literal $last:literal $step:literal $align:literal;)*) => {
        /// The letters that say what kind of element it is.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[non_exhaustive]
        #[allow(missing_docs, reason = "the letters are the names; the table above is their description")]
        pub enum Symbol { $($symbol),* }

        impl Symbol {
            /// Every symbol, in the table's order.
            pub const ALL: &'static [Self] = &[$(Self::$symbol),*];

            const fn row(self) -> Row {
                match self {
                    $(Self::$symbol => Row {
                        letters: stringify!($symbol),
                        width: Width::$width,
                        digits: $digits,
                        last: $last,
                        step: $step,
                        align: $align,
                    }),*
                }
            }
        }
    };
}
use symbols;

macro_rules! one_width {
    ($type:ident, $width:expr, $example:literal) => {
        impl $type {
            /// The element with this symbol and address.
            ///
            /// # Errors
            /// [`ElementError::WrongWidth`], [`ElementError::OutOfRange`] or [`ElementError::Misaligned`].
            pub const fn new(symbol: Symbol, address: u16) -> Result<Self, ElementError> {
                match Element::new(symbol, address) {
                    Ok(element) => Self::narrow(element),
                    Err(error) => Err(error),
                }
            }

            /// Reads an element as people write it: letters in either case, then decimal digits.
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

            /// The `n`-th consecutive element after this one; the 0th is itself.
            ///
            /// # Errors
            /// [`ElementError::OutOfRange`] when there is none.
            pub const fn nth(self, n: usize) -> Result<Self, ElementError> {
                match Element::$type(self).nth(n) {
                    Ok(element) => Self::narrow(element),
                    Err(error) => Err(error),
                }
            }

            const fn narrow(element: Element) -> Result<Self, ElementError> {
                match element {
                    Element::$type(e) => Ok(e),
                    other => Err(ElementError::WrongWidth { symbol: other.symbol(), expected: $width }),
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
