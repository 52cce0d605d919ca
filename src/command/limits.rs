//! The limits of the commands, each in one place, and the error that names the one that is broken.

use std::fmt;

use super::{Code, Value};
use crate::element::{Element, ElementError, Width};
use crate::wire::Framing;

/// 43, 44 and 45: the most discretes in one request.
pub const MAX_POINTS: usize = 256;
/// 46 and 47: the most units in one request; a 32-bit register counts two.
pub const MAX_UNITS: usize = 64;
/// 48: the most units in one request; a 32-bit register counts two.
pub const MAX_MIXED_READ_UNITS: usize = 64;
/// 49: the most units in one request; a 32-bit register counts two.
pub const MAX_MIXED_WRITE_UNITS: usize = 32;
/// 4E: the most data, in characters or bytes.
pub const MAX_LOOP_BACK: usize = 256;

/// A request that was not sent, because it breaks a rule: what was asked, and the rule.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidRequest {
    /// No such element.
    #[error(transparent)]
    Element(#[from] ElementError),
    /// Too few or too many items.
    #[error("{code}: {count} items were asked for, and it takes {min} to {max}")]
    Count {
        /// The command.
        code: Code,
        /// How many items were asked for.
        count: usize,
        /// The fewest it takes.
        min: usize,
        /// The most it takes.
        max: usize,
    },
    /// Too many units, where 32-bit registers count two.
    #[error("{code}: the elements count {units} units (a 32-bit register counts 2), and it takes at most {max}")]
    Units {
        /// The command.
        code: Code,
        /// How many units were asked for.
        units: usize,
        /// The most it takes.
        max: usize,
    },
    /// Consecutive elements that reach past the last address.
    #[error("{count} elements from {first} on reach past the last address, {}{}", first.symbol(), first.symbol().last_address())]
    PastTheEnd {
        /// The first element.
        first: Element,
        /// How many were asked for.
        count: usize,
    },
    /// A value that is not as wide as its element.
    #[error("{element} is {}, and the value {value} is for {}", element.width(), value.width())]
    WrongWidth {
        /// The element.
        element: Element,
        /// The value.
        value: Value,
    },
    /// The framing does not have this command.
    #[error("{code} does not exist in the {framing} framing")]
    NotInFraming {
        /// The command.
        code: Code,
        /// The framing of the link.
        framing: Framing,
    },
    /// The binary framing would send these elements as bytes that can also be read as other elements.
    ///
    /// It does not say how long a symbol is: `R` at address 5400h begins as `RT` does, so `RT87 X0` is also `R21504 WX0`.
    /// Ask for fewer of them at once: one alone always has one reading.
    #[error(
        "{code}: as bytes of the binary framing, {} can also be read as other elements; ask for them one by one",
        List(elements)
    )]
    Ambiguous {
        /// The command.
        code: Code,
        /// The elements.
        elements: Vec<Element>,
    },
    /// Loop-back data that the ASCII framing cannot carry.
    #[error("{code}: the byte {byte:02X}h at position {position} cannot be sent in the ASCII framing (20h to 7Eh can)")]
    NotPrintable {
        /// The command.
        code: Code,
        /// The byte.
        byte: u8,
        /// Where it stands, from 0.
        position: usize,
    },
    /// A broadcast of a command that only reads: nobody would answer.
    #[error("{code} cannot be broadcast: all that it would bring is an answer, and nobody answers a broadcast")]
    NoBroadcast {
        /// The command.
        code: Code,
    },
    /// Not a station number.
    #[error("{station} is not a station: PLCs are 1 to 254 (0 is the broadcast, which `Link::broadcast` is for)")]
    Station {
        /// The number given.
        station: u8,
    },
}

/// Elements as people write them.
struct List<'a>(&'a [Element]);

impl fmt::Display for List<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, element) in self.0.iter().enumerate() {
            if i > 0 {
                f.write_str(" ")?;
            }
            write!(f, "{element}")?;
        }
        Ok(())
    }
}

pub(super) fn in_framing(code: Code, framing: Framing) -> Result<(), InvalidRequest> {
    if code.is_in(framing) { Ok(()) } else { Err(InvalidRequest::NotInFraming { code, framing }) }
}

pub(super) fn count(code: Code, count: usize, min: usize, max: usize) -> Result<(), InvalidRequest> {
    if (min..=max).contains(&count) { Ok(()) } else { Err(InvalidRequest::Count { code, count, min, max }) }
}

pub(super) fn units(code: Code, units: usize, max: usize) -> Result<(), InvalidRequest> {
    if units <= max { Ok(()) } else { Err(InvalidRequest::Units { code, units, max }) }
}

/// How many consecutive elements like this one a request takes.
pub(crate) fn most_in_one_request(first: Element) -> usize {
    match first.width() {
        Width::Bit => MAX_POINTS,
        width => MAX_UNITS / width.units(),
    }
}

/// Consecutive elements in one request: how many of this width it takes, and that all of them exist.
pub(super) fn consecutive(code: Code, first: Element, n: usize) -> Result<(), InvalidRequest> {
    count(code, n, 1, most_in_one_request(first))?;
    exist(first, n)
}

/// Consecutive elements in as many requests as they take: that there are some, and that all of them exist.
pub(crate) fn check_range(code: Code, first: Element, n: usize) -> Result<(), InvalidRequest> {
    let last = usize::from(first.symbol().last_address() - first.address());
    count(code, n, 1, (last / usize::from(first.symbol().step()) + 1).max(n))?;
    exist(first, n)
}

fn exist(first: Element, n: usize) -> Result<(), InvalidRequest> {
    match first.nth(n - 1) {
        Ok(_) => Ok(()),
        Err(_) => Err(InvalidRequest::PastTheEnd { first, count: n }),
    }
}
