//! The limits of the commands, and the error that names the limit that a request breaks.

use std::fmt;

use super::Code;
use crate::element::{Element, ElementError, Value, Width};
use crate::wire::Framing;

/// 43, 44 and 45: the most discretes in one request.
pub const MAX_POINTS: usize = 256;
/// 46 and 47: the most units in one request. A 32-bit register counts two.
pub const MAX_UNITS: usize = 64;
/// 48: the most units in one request. A 32-bit register counts two.
pub const MAX_MIXED_READ_UNITS: usize = 64;
/// 49: the most units in one request. A 32-bit register counts two.
pub const MAX_MIXED_WRITE_UNITS: usize = 32;
/// 4E: the most data: characters in the ASCII framing, bytes in the binary one.
pub const MAX_LOOP_BACK: usize = 256;

/// A request that breaks a rule of the protocol, and was not sent.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum InvalidRequest {
    /// The symbol or the address of an element is wrong.
    #[error(transparent)]
    Element(#[from] ElementError),
    /// Too few or too many elements or bytes.
    #[error("{code}: {count} items were asked for, and it takes {min} to {max}")]
    Count {
        /// The command.
        code: Code,
        /// The number of items.
        count: usize,
        /// The smallest number.
        min: usize,
        /// The largest number.
        max: usize,
    },
    /// Too many units; a 32-bit register counts two.
    #[error("{code}: the elements count {units} units (a 32-bit register counts 2), and it takes at most {max}")]
    Units {
        /// The command.
        code: Code,
        /// The number of units.
        units: usize,
        /// The largest number.
        max: usize,
    },
    /// Consecutive elements beyond the last address.
    #[error("{count} elements from {first} on reach past the last address, {}", last(*first))]
    PastTheEnd {
        /// The first element.
        first: Element,
        /// The number of elements.
        count: usize,
    },
    /// A value of another width than its element.
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
    /// A list of elements that the PLC can decode in two ways. Binary framing only.
    ///
    /// The length of a symbol is not sent. `R` at address 5400h begins like `RT`, so `RT87 X0` has
    /// the bytes of `R21504 WX0`. A shorter list may be unambiguous; a single element always is.
    #[error(
        "{code}: in the binary framing {} can also be read as other elements; ask for them one by one",
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
        /// Its position, from 0.
        position: usize,
    },
    /// A broadcast of a command that reads. PLCs do not answer broadcasts.
    #[error("{code} cannot be broadcast: it reads, and PLCs do not answer broadcasts")]
    NoBroadcast {
        /// The command.
        code: Code,
    },
    /// Not the number of a station.
    #[error("{station} is not a station: PLCs are 1 to 254 (0 is the broadcast, which `Link::broadcast` is for)")]
    Station {
        /// The number.
        station: u8,
    },
}

/// Elements, separated by blanks.
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

/// The last element with the symbol of this one.
fn last(element: Element) -> String {
    format!("{0}{1}", element.symbol(), element.symbol().last_address())
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

/// The most consecutive elements of this width in one request.
pub(crate) fn most_in_one_request(first: Element) -> usize {
    match first.width() {
        Width::Bit => MAX_POINTS,
        width @ (Width::Word | Width::DWord) => MAX_UNITS / width.units(),
    }
}

/// Checks consecutive elements of one request: their number, and that all exist.
pub(super) fn consecutive(code: Code, first: Element, n: usize) -> Result<(), InvalidRequest> {
    count(code, n, 1, most_in_one_request(first))?;
    exist(first, n)
}

/// Checks consecutive elements of several requests: that there is at least one, and that all exist.
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
