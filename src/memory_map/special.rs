//! Special relays and registers: the ranges that are dangerous to write, and the elements by name.

use std::fmt;

use crate::element;
use crate::element::Element;

/// A range of special relays or registers, both ends included.
///
/// Writing them can cause system or I/O errors. Its `Display` is the range: `R3840-R4167`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub struct SpecialRange {
    /// The first element.
    pub first: Element,
    /// The last element.
    pub last: Element,
}

/// The ranges of every model at hand: analog inputs, analog outputs and special registers; special
/// relays.
///
/// Source: FBs instruction manual, which warns of system and I/O errors.
static SPECIAL_RANGES: [SpecialRange; 2] = [
    SpecialRange { first: element!("R3840"), last: element!("R4167") },
    SpecialRange { first: element!("M1912"), last: element!("M2001") },
];

/// Returns the special range that an element lies in, wholly or in part: R3840 to R4167 or M1912
/// to M2001. Writing there can cause system or I/O errors.
///
/// It does not depend on the model, because the ranges of all models at hand are the same.
/// `Station::write…` does not ask for it; `fatek write` and a restore do.
///
/// ```
/// use fatek::memory_map::special_range;
/// use fatek::{element, register};
///
/// assert_eq!(special_range(register!("R3839")), None);
/// assert_eq!(special_range(element!("DR3839")).unwrap().to_string(), "R3840-R4167"); // R3839 and R3840
/// assert_eq!(special_range(element!("WM1904")).unwrap().to_string(), "M1912-M2001");
/// ```
#[must_use]
pub fn special_range(element: impl Into<Element>) -> Option<SpecialRange> {
    let element = element.into();
    let ((first, last), area) = (element.covered(), element.symbol().area());
    let overlaps = |range: &&SpecialRange| {
        range.first.symbol().area() == area && range.first.address() <= last && first <= range.last.address()
    };
    SPECIAL_RANGES.iter().find(overlaps).copied()
}

impl fmt::Display for SpecialRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.first, self.last)
    }
}

/// The kind of source that names an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Evidence {
    /// A manual of the maker.
    Manual,
    /// A report or a program of a user.
    User,
}

/// A special relay or register with its meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub struct NamedElement {
    /// The element.
    pub element: Element,
    /// Its meaning.
    pub meaning: &'static str,
    /// The kind of source.
    pub evidence: Evidence,
}

/// The special relays and registers of the FBs series that a source at hand names, by symbol and
/// address.
///
/// Sources: FBs manual, chapters on the clock and on communication settings, instruction manual and
/// contents of its second volume; notes of users where [`Evidence::User`] says so.
pub static NAMED_ELEMENTS: &[NamedElement] = &[
    user(element!("M1924"), "on in the first scan"),
    manual(element!("M1952"), "1 lets the clock registers be set"),
    manual(element!("M1953"), "rounds the clock by up to 30 s"),
    manual(element!("M1954"), "1 if there is a clock"),
    manual(element!("M1955"), "1 if a value set in the clock is wrong"),
    manual(element!("M1969"), "an illegal indirect write has happened"),
    user(element!("M1992"), "pulse output finished"),
    user(element!("M1993"), "pulse output finished"),
    manual(element!("R4047"), "protocol of the ports 1 to 4"),
    manual(element!("R4050"), "baud rate of port 0"),
    manual(element!("R4128"), "clock: second"),
    manual(element!("R4129"), "clock: minute"),
    manual(element!("R4130"), "clock: hour"),
    manual(element!("R4131"), "clock: day"),
    manual(element!("R4132"), "clock: month"),
    manual(element!("R4133"), "clock: year, 0 to 99"),
    manual(element!("R4134"), "clock: weekday, 0 to 6"),
    manual(element!("R4135"), "clock: hour in the high byte, minute in the low byte"),
    manual(element!("R4162"), "time base of internal interrupts"),
    manual(element!("D4053"), "0 if there is no clock chip, in MA units"),
];

const fn manual(element: Element, meaning: &'static str) -> NamedElement {
    NamedElement { element, meaning, evidence: Evidence::Manual }
}

const fn user(element: Element, meaning: &'static str) -> NamedElement {
    NamedElement { element, meaning, evidence: Evidence::User }
}
