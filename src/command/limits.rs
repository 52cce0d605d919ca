//! The limits of the commands, and the error that names the limit that a request breaks.

use std::fmt;

use super::{Code, Command, Run};
use crate::element::{Element, ElementError, Width};
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
    #[error(
        "{count} elements from {first} on reach past the last address, {}{}",
        first.symbol(), first.last_consecutive()
    )]
    PastTheEnd {
        /// The first element.
        first: Element,
        /// The number of elements.
        count: usize,
    },
    /// Several counters of 32 bits as a run. `DRC200` to `DRC255` are read and written one by one.
    #[error("{code}: {first} is a counter of 32 bits, and these are read and written one by one, not {count} at once")]
    #[non_exhaustive]
    OneByOne {
        /// The command.
        code: Code,
        /// The first element.
        first: Element,
        /// The number of elements.
        count: usize,
    },
    /// A value of several elements is longer than a request to this station may be, and no request
    /// splits a value. See [`Capabilities`](crate::Capabilities).
    #[error("{code}: the value from {first} on has {count} elements, and the station takes {max} in one request")]
    #[non_exhaustive]
    ValueTooLong {
        /// The command.
        code: Code,
        /// The first element.
        first: Element,
        /// The number of elements of the value.
        count: usize,
        /// The largest number.
        max: usize,
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

/// Checks that the framing has the command and the addresses of all elements.
pub(super) fn in_framing<C: Command>(request: &C, framing: Framing) -> Result<(), InvalidRequest> {
    if !C::CODE.is_in(framing) {
        return Err(InvalidRequest::NotInFraming { code: C::CODE, framing });
    }
    Ok(addresses_in(request, framing)?)
}

/// Checks that the framing has the addresses of all elements.
pub(super) fn addresses_in(request: &impl Command, framing: Framing) -> Result<(), ElementError> {
    let mut result = Ok(());
    request.for_each_run(&mut |Run { first, count }| {
        if result.is_ok() {
            result = run_in(first, count, framing);
        }
    });
    result
}

/// Checks that the framing has the addresses of consecutive elements, which exist.
#[inline]
fn run_in(first: Element, count: usize, framing: Framing) -> Result<(), ElementError> {
    // Most elements are far from any limit, and every call is checked.
    let most = usize::from(first.symbol().last_address_in(framing).saturating_sub(first.address()));
    if count.max(1).saturating_mul(first.step().into()) <= most {
        return Ok(());
    }
    first.check_in(framing)?;
    first.nth(count.saturating_sub(1)).map_or(Ok(()), |last| last.check_in(framing))
}

pub(super) fn count(code: Code, count: usize, min: usize, max: usize) -> Result<(), InvalidRequest> {
    if (min..=max).contains(&count) { Ok(()) } else { Err(InvalidRequest::Count { code, count, min, max }) }
}

pub(super) fn units(code: Code, units: usize, max: usize) -> Result<(), InvalidRequest> {
    if units <= max { Ok(()) } else { Err(InvalidRequest::Units { code, units, max }) }
}

/// The longest requests for consecutive elements: those of the protocol, or shorter ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct RequestLengths {
    points: usize,
    units: usize,
}

impl RequestLengths {
    pub(crate) const PROTOCOL: Self = Self { points: MAX_POINTS, units: MAX_UNITS };

    /// The shorter of these and `points` discretes, `units` of registers; `None`: no limit is known.
    pub(crate) fn within(self, points: Option<usize>, units: Option<usize>) -> Self {
        let lower = |own: usize, other: Option<usize>| other.map_or(own, |other| own.min(other));
        Self { points: lower(self.points, points), units: lower(self.units, units) }
    }

    /// The most consecutive elements from this one on in one request; at least 1.
    #[inline]
    pub(crate) fn most(self, first: Element) -> usize {
        if first.is_counter_of_32_bits() { 1 } else { self.most_of_width(first.width()) }
    }

    fn most_of_width(self, width: Width) -> usize {
        let most = match width {
            Width::Bit => self.points,
            Width::Word | Width::DWord => self.units / width.units(),
        };
        most.max(1)
    }
}

/// The most consecutive elements from this one on in one request.
pub(crate) fn most_in_one_request(first: Element) -> usize {
    RequestLengths::PROTOCOL.most(first)
}

fn most_of_width(width: Width) -> usize {
    RequestLengths::PROTOCOL.most_of_width(width)
}

/// Checks consecutive elements of one request: their number, and that all exist.
pub(super) fn consecutive(code: Code, first: Element, n: usize) -> Result<(), InvalidRequest> {
    count(code, n, 1, most_of_width(first.width()))?;
    // As in `RequestLengths::most`.
    if n > 1 && first.is_counter_of_32_bits() {
        return Err(InvalidRequest::OneByOne { code, first, count: n });
    }
    exist(first, n)
}

/// Checks consecutive elements of a received request.
///
/// A run of counters of 32 bits passes: the PLC decides, and a gateway forwards a request unchanged.
pub(super) fn received(code: Code, Run { first, count: n }: Run) -> Result<(), InvalidRequest> {
    let last = usize::from(first.address()) + n.saturating_sub(1) * usize::from(first.symbol().step());
    count(code, n, 1, most_of_width(first.width()))?;
    if last > usize::from(first.symbol().last_address()) {
        return Err(InvalidRequest::PastTheEnd { first, count: n });
    }
    Ok(())
}

/// Checks consecutive elements of several requests: that there is at least one, and that all exist
/// in this framing.
pub(crate) fn check_range(code: Code, first: Element, n: usize, framing: Framing) -> Result<(), InvalidRequest> {
    first.check_in(framing)?;
    // Both limits are at the first element or behind it.
    let last = first.last_consecutive().min(first.symbol().last_address_in(framing));
    let others = (last - first.address()) / first.step();
    count(code, n, 1, (usize::from(others) + 1).max(n))?;
    exist(first, n)?;
    Ok(run_in(first, n, framing)?)
}

fn exist(first: Element, n: usize) -> Result<(), InvalidRequest> {
    // Most elements are far from any limit.
    let symbol = first.symbol();
    let most = usize::from(symbol.last_address().saturating_sub(first.address()));
    if !symbol.has_counters() && n.saturating_mul(symbol.step().into()) <= most {
        return Ok(());
    }
    if first.nth(n - 1).is_ok() { Ok(()) } else { Err(InvalidRequest::PastTheEnd { first, count: n }) }
}
