//! Memory maps of PLC models: the elements that a model has, and the use of each range.
//!
//! The protocol can address more elements than any PLC has, and a PLC answers error A for the rest.
//! A [`MemoryMap`] refuses such an element before anything is sent, and gives the planner its
//! [`Limits`]:
//!
//! ```
//! use fatek::element;
//! use fatek::memory_map::{MemoryMap, PlcModel};
//!
//! let map = MemoryMap::of(PlcModel::Fbs20Mc);
//! assert!(map.check(element!("R8071"), 1).is_ok());
//! let error = map.check(element!("R4160"), 10).unwrap_err();
//! assert_eq!(error.to_string(), "R4168 is not in the memory map of an FBS-20MC, which has R0-R4167 R5000-R8071");
//! let limits = map.limits(); // for plans and pollers
//! # let _ = limits;
//! ```
//!
//! The model is chosen, because the detailed status (53) does not tell the series. Without a chosen
//! model, [`MemoryMap::from_status`] takes the counts of 53. These do not show gaps: an FBs reports
//! 8072 registers `R`, although R4168 to R4999 do not exist.
//!
//! [`special_range`] has the ranges that are dangerous to write, and [`NAMED_ELEMENTS`] the special
//! relays and registers that the manuals at hand name.
//!
//! Only figures of manuals, of HMI documents or of users are here. File registers `F` are in no map,
//! because no source at hand confirms their number; a map does not limit areas that it does not have.

mod model;
mod special;

use std::fmt;

pub use self::model::{ParsePlcModelError, PlcModel};
pub use self::special::{Evidence, NAMED_ELEMENTS, NamedElement, SpecialRange, special_range};
use crate::command::DetailedStatus;
use crate::element::{Element, MemoryArea, Symbol};
use crate::plan::Limits;
use crate::tag::Tag;

/// The elements of a PLC: ranges of each memory area, with their use.
///
/// An area without any range is not limited: the map has no figures for it, and the PLC decides.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemoryMap {
    model: Option<PlcModel>,
    ranges: Vec<AreaRange>,
    extents: Vec<Extent>,
}

/// A range of elements with one use, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub struct AreaRange {
    /// The first element: of 1 bit or 16 bits, or a counter of 32 bits.
    pub first: Element,
    /// The last element, of the same symbol.
    pub last: Element,
    /// The use of the elements.
    pub usage: AreaUsage,
}

/// The use of a range of elements.
///
/// Source: FBs instruction manual, list of memory areas. No manual at hand has the reply of a PLC to
/// a write of inputs, of analog inputs or of read-only registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum AreaUsage {
    /// Counted by 53 of a PLC whose model is not known.
    Unspecified,
    /// No use of its own: for the user program.
    General,
    /// Inputs, set from their wiring in each scan.
    Input,
    /// Outputs, which switch connected loads.
    Output,
    /// Contacts of timers and counters, set from their values.
    Contact,
    /// Analog inputs, set by the PLC.
    AnalogInput,
    /// Analog outputs.
    AnalogOutput,
    /// Special relays and registers of the system.
    Special,
    /// Registers in part used by the system.
    PartlySystem,
    /// Registers that can be configured as read-only for the user program.
    ProgramReadOnly,
}

/// Addresses of one memory area without a gap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Extent {
    pub(crate) area: MemoryArea,
    pub(crate) first: u16,
    pub(crate) last: u16,
}

/// Error: an element is not in the memory map of a PLC.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct NotInMap {
    /// The first element that the map does not have.
    pub element: Element,
    /// The model of the map; `None` for a map by the counts of 53.
    pub model: Option<PlcModel>,
    /// First and last smallest element of each gapless range of the same memory area.
    pub existing: Vec<(Element, Element)>,
}

impl MemoryMap {
    /// The map of a model.
    #[must_use]
    pub fn of(model: PlcModel) -> Self {
        Self::new(Some(model), model.ranges().collect())
    }

    /// A map with the counts in a detailed status (53), for a PLC whose model is not known.
    ///
    /// The counts do not show gaps. A count of 0 does not limit its area.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::memory_map::MemoryMap;
    ///
    /// let map = MemoryMap::from_status(&station.read_detailed_status().await?);
    /// assert!(map.check(fatek::element!("D3072"), 1).is_err());
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn from_status(status: &DetailedStatus) -> Self {
        let counts = [
            (Symbol::X, status.discrete_inputs()),
            (Symbol::Y, status.discrete_outputs()),
            (Symbol::M, status.m_relays()),
            (Symbol::S, status.s_relays()),
            (Symbol::T, status.timers()),
            (Symbol::C, status.counters()),
            (Symbol::RT, status.timers()),
            (Symbol::RC, status.counters()),
            (Symbol::R, status.r_registers()),
            (Symbol::D, status.d_registers()),
        ];
        let ranges = counts.into_iter().filter_map(|(symbol, count)| {
            let last = count.checked_sub(1)?;
            Some(Extent { area: symbol.area(), first: 0, last }.elements())
        });
        let range = |(first, last)| AreaRange { first, last, usage: AreaUsage::Unspecified };
        Self::new(None, ranges.flatten().map(range).collect())
    }

    fn new(model: Option<PlcModel>, ranges: Vec<AreaRange>) -> Self {
        let extents = Extent::merged(&ranges);
        Self { model, ranges, extents }
    }

    /// Its model; `None` if it has the counts of 53.
    #[must_use]
    pub fn model(&self) -> Option<PlcModel> {
        self.model
    }

    /// The ranges, by area and address.
    #[must_use]
    pub fn ranges(&self) -> &[AreaRange] {
        &self.ranges
    }

    /// Returns the use of an element, that of its first address; `None` if the map does not have it.
    #[must_use]
    pub fn usage(&self, element: impl Into<Element>) -> Option<AreaUsage> {
        let element = element.into();
        let ((address, _), area) = (element.covered(), element.symbol().area());
        let range = self.ranges.iter().find(|range| {
            range.first.symbol().area() == area && (range.first.address()..=range.last.address()).contains(&address)
        })?;
        Some(range.usage)
    }

    /// Checks that the PLC has `count` consecutive elements from `first` on.
    ///
    /// An element of 16 or 32 bits must exist as a whole: with relays up to M2001 there is no
    /// WM1992.
    ///
    /// # Errors
    /// [`NotInMap`] with the first element that does not exist.
    pub fn check(&self, first: impl Into<Element>, count: usize) -> Result<(), NotInMap> {
        let first = first.into();
        // A run past the last address of the protocol has no such element.
        match first.run(count).find(|&element| !self.has(element)) {
            Some(element) => Err(self.error(element)),
            None => Ok(()),
        }
    }

    /// Checks that the PLC has all elements of a tag.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub fn check_tag(&self, tag: &Tag) -> Result<(), NotInMap> {
        self.check(tag.first(), tag.element_count())
    }

    /// Returns the limits of plans and pollers: only elements of the map are readable.
    ///
    /// Lengths of requests are those of the protocol.
    #[must_use]
    pub fn limits(&self) -> Limits {
        let ranges = self.extents.iter().flat_map(Extent::readable);
        ranges.fold(Limits::new(), |limits, (first, last)| {
            let narrowed = limits.clone().readable(first, last);
            debug_assert!(narrowed.is_ok(), "both ends of {first} to {last} have one symbol and ascend");
            narrowed.unwrap_or(limits)
        })
    }

    fn has(&self, element: Element) -> bool {
        let area = element.symbol().area();
        Extent::have(&self.extents, element) || self.extents.iter().all(|extent| extent.area != area)
    }

    fn error(&self, element: Element) -> NotInMap {
        let area = element.symbol().area();
        let existing = self.extents.iter().filter(|extent| extent.area == area).flat_map(Extent::elements);
        NotInMap { element, model: self.model, existing: existing.collect() }
    }
}

impl Extent {
    /// The addresses of ranges, adjacent ranges of an area as one.
    pub(crate) fn merged(ranges: &[AreaRange]) -> Vec<Self> {
        let mut extents: Vec<Self> = Vec::new();
        for range in ranges {
            let (area, first, last) = (range.first.symbol().area(), range.first.address(), range.last.address());
            match extents.last_mut() {
                Some(before) if before.area == area && before.last.checked_add(1) == Some(first) => before.last = last,
                Some(_) | None => extents.push(Self { area, first, last }),
            }
        }
        extents
    }

    /// Returns whether one of these has an element as a whole.
    pub(crate) fn have(extents: &[Self], element: Element) -> bool {
        let ((first, last), area) = (element.covered(), element.symbol().area());
        extents.iter().any(|extent| extent.area == area && extent.first <= first && last <= extent.last)
    }

    /// First and last smallest element; counters of 32 bits are a range of their own.
    fn elements(&self) -> Vec<(Element, Element)> {
        let [first_counter, last_counter] = self.area.word().counters();
        let range = |symbol, first: u16, last: u16| {
            let ends = (Element::new(symbol, first).ok()?, Element::new(symbol, last).ok()?);
            (first <= last).then_some(ends)
        };
        if first_counter > last_counter {
            return range(self.area.smallest(), self.first, self.last).into_iter().collect();
        }
        let below = range(self.area.smallest(), self.first, self.last.min(first_counter.saturating_sub(1)));
        let counters = range(self.area.dword(), self.first.max(first_counter), self.last.min(last_counter));
        below.into_iter().chain(counters).collect()
    }

    /// The readable ranges of the smallest elements, and of words of discretes.
    fn readable(&self) -> Vec<(Element, Element)> {
        let mut ranges = self.elements();
        let word = self.area.word();
        if word != self.area.smallest() {
            let first = self.first.checked_next_multiple_of(word.alignment());
            let last = self.last.checked_sub(word.step().saturating_sub(1));
            let aligned = last.map(|last| last.saturating_sub(last.checked_rem(word.alignment()).unwrap_or(0)));
            let ends = first.zip(aligned).filter(|(first, last)| first <= last);
            let ends = ends.and_then(|(first, last)| Element::new(word, first).ok().zip(Element::new(word, last).ok()));
            ranges.extend(ends);
        }
        ranges
    }
}

impl fmt::Display for NotInMap {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is not in the memory map of ", self.element)?;
        match self.model {
            Some(model) => write!(f, "an {model}")?,
            None => f.write_str("this PLC by its status (53)")?,
        }
        for (n, (first, last)) in self.existing.iter().enumerate() {
            write!(f, "{} {first}-{last}", if n == 0 { ", which has" } else { "" })?;
        }
        Ok(())
    }
}

impl std::error::Error for NotInMap {}

#[cfg(test)]
mod tests;
