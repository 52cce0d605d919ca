//! Tags of bits of a register: `R5.3`, `DR10.0-DR10.7`.
//!
//! Invariants:
//! - The bits of a tag lie in one register, and each exists.
//! - A bit of a word of discretes is the discrete itself: `WM16.3` is `M19`.
//! - Nothing encodes such a tag, since the write would replace the other bits of the register. So
//!   [`Station::modify_bits`](crate::Station::modify_bits) is the only way to change them.

use super::types::Storage;
use super::{Tag, TagError, TagType};
use crate::command::Value;
#[cfg(feature = "config")]
use crate::element::MemoryArea;
use crate::element::{Element, Width};

/// Consecutive bits of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct BitRange {
    pub(super) first: u8,
    /// At least 1.
    pub(super) count: u8,
}

impl BitRange {
    /// The states of the bits of a register, the lowest first.
    pub(super) fn states(self, register: u64) -> impl Iterator<Item = bool> {
        (self.first..self.first.saturating_add(self.count)).map(move |bit| register >> bit & 1 == 1)
    }

    /// A register with these states of its bits, and its other bits as they are.
    pub(super) fn with_states(self, register: u64, states: &[bool]) -> u64 {
        let bits = self.first..self.first.saturating_add(self.count);
        bits.zip(states).fold(register, |register, (bit, &on)| register & !(1 << bit) | u64::from(on) << bit)
    }
}

impl Tag {
    /// A tag of `count` bits of a register, from bit `first` on; bit 0 is the lowest.
    ///
    /// Its values are `bool`. The bits of a word of discretes are its discretes: bit 3 of `WM16` is
    /// `M19`. Bits of registers cannot be written by themselves; see
    /// [`Station::modify_bits`](crate::Station::modify_bits).
    ///
    /// ```
    /// use fatek::tag::Tag;
    /// use fatek::{element, tag};
    ///
    /// assert_eq!(Tag::bits(element!("R5"), 3, 1)?, tag!("R5.3"));
    /// assert_eq!(Tag::bits(element!("DR10"), 24, 8)?.to_string(), "DR10.24-DR10.31");
    /// assert_eq!(Tag::bits(element!("WM16"), 3, 1)?, tag!("M19"));
    /// # Ok::<(), fatek::tag::TagError>(())
    /// ```
    ///
    /// # Errors
    /// [`TagError::NoBit`] for a discrete and past the last bit; [`TagError::NoValues`].
    pub const fn bits(register: Element, first: u8, count: u8) -> Result<Self, TagError> {
        if count == 0 {
            return Err(TagError::NoValues);
        }
        // The last bit, or one that no register has.
        let last = first.saturating_add(count - 1);
        if matches!(register.width(), Width::Bit) || last as u32 >= register.width().bits() {
            return Err(TagError::NoBit { element: register, bit: last });
        }
        let area = register.symbol().area();
        if area.bits_per_address() == 1 {
            let address = register.address().saturating_add(first as u16);
            return match Element::new(area.smallest(), address) {
                Ok(discrete) => Self::checked(discrete, count as usize, TagType::Bool),
                Err(error) => Err(TagError::Element(error)),
            };
        }
        let storage = Storage::BitsOf(BitRange { first, count });
        Ok(Self { first: register, count: 1, tag_type: TagType::Bool, storage, scale: None })
    }

    /// Returns whether its values are bits of a register, such as `R5.3`.
    #[must_use]
    pub const fn is_bits_of_register(&self) -> bool {
        matches!(self.storage, Storage::BitsOf(_))
    }

    /// Where its bits are, if they are bits of a register: the area, and the first and the last bit, counted
    /// through the area.
    #[cfg(feature = "config")]
    pub(crate) fn bit_memory(&self) -> Option<((MemoryArea, bool), u32, u32)> {
        let Storage::BitsOf(bits) = self.storage else { return None };
        // A counter of 32 bits has one address.
        let is_counter = self.first.is_counter_of_32_bits();
        let bits_per_address = if is_counter { 32 } else { self.first.symbol().area().bits_per_address() };
        let first = u32::from(self.first.address()) * bits_per_address + u32::from(bits.first);
        Some(((self.first.symbol().area(), is_counter), first, first + u32::from(bits.count) - 1))
    }

    /// The value of its register with these states of its bits; `None` if it has no register or another
    /// number of bits.
    pub(crate) fn modified(&self, register: Value, states: &[bool]) -> Option<Value> {
        let Storage::BitsOf(bits) = self.storage else { return None };
        if states.len() != usize::from(bits.count) {
            return None;
        }
        let modified = bits.with_states(super::coding::bits(register), states);
        Some(super::coding::of_width(modified, register.width()))
    }
}
