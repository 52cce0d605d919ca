use std::array;
use std::collections::BTreeMap;

use super::Error;
use crate::command::Value;
use crate::element::{Discrete, Element, ElementError, MemoryArea, Register, Register32};

/// Memory of all elements. Allocated on the first write; elements that were never written are 0.
///
/// Each area is an array of bytes, least significant first: eight discretes per byte, two bytes per
/// register. A word is two bytes and a double word four at any address, so overlapping elements
/// share their bytes. Counters of 32 bits have four bytes each, behind the registers of their area.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory {
    pages: BTreeMap<(MemoryArea, usize), Box<[u8; PAGE_LEN]>>,
}

impl Memory {
    pub(super) fn read(&self, element: Element) -> Value {
        match element {
            Element::Discrete(discrete) => self.bit(discrete).into(),
            Element::Register(register) => self.word(register).into(),
            Element::Register32(register) => self.dword(register).into(),
        }
    }

    /// Writes a value. On [`ElementError::WrongWidth`] nothing is written.
    pub(super) fn write(&mut self, element: Element, value: Value) -> Result<(), Error> {
        match (element, value) {
            (Element::Discrete(discrete), Value::Bit(on)) => self.set_bit(discrete, on),
            (Element::Register(register), Value::Word(word)) => self.set_word(register, word),
            (Element::Register32(register), Value::DWord(double)) => self.set_dword(register, double),
            (Element::Discrete(_) | Element::Register(_) | Element::Register32(_), _) => {
                return Err(ElementError::WrongWidth { element, expected: value.width() }.into());
            }
        }
        Ok(())
    }

    pub(super) fn bit(&self, discrete: Discrete) -> bool {
        let [byte] = self.bytes(discrete.into());
        byte & bit_mask(discrete) != 0
    }

    pub(super) fn set_bit(&mut self, discrete: Discrete, on: bool) {
        let [byte] = self.bytes(discrete.into());
        let byte = if on { byte | bit_mask(discrete) } else { byte & !bit_mask(discrete) };
        self.set_bytes(discrete.into(), [byte]);
    }

    pub(super) fn word(&self, register: Register) -> u16 {
        u16::from_le_bytes(self.bytes(register.into()))
    }

    pub(super) fn set_word(&mut self, register: Register, word: u16) {
        self.set_bytes(register.into(), word.to_le_bytes());
    }

    pub(super) fn dword(&self, register: Register32) -> u32 {
        u32::from_le_bytes(self.bytes(register.into()))
    }

    pub(super) fn set_dword(&mut self, register: Register32, double: u32) {
        self.set_bytes(register.into(), double.to_le_bytes());
    }

    fn bytes<const N: usize>(&self, element: Element) -> [u8; N] {
        let (area, first) = locate(element);
        array::from_fn(|i| {
            let at = first + i;
            self.pages.get(&(area, at / PAGE_LEN)).map_or(0, |page| page[at % PAGE_LEN])
        })
    }

    fn set_bytes<const N: usize>(&mut self, element: Element, bytes: [u8; N]) {
        let (area, first) = locate(element);
        for (at, byte) in (first..).zip(bytes) {
            let key = (area, at / PAGE_LEN);
            // An absent page reads as zeros, so zeros need no allocation.
            if byte != 0 || self.pages.contains_key(&key) {
                self.pages.entry(key).or_insert_with(|| Box::new([0; PAGE_LEN]))[at % PAGE_LEN] = byte;
            }
        }
    }
}

/// Bytes per allocation: 32 registers or 512 discretes.
const PAGE_LEN: usize = 64;

/// The area of an element, and its first byte there.
fn locate(element: Element) -> (MemoryArea, usize) {
    let area = element.symbol().area();
    let bytes_before = |addresses: usize| addresses * area.bits_per_address() as usize / 8;
    let address = usize::from(element.address());
    if element.is_counter_of_32_bits() {
        let [first, _] = area.word().counters();
        return (area, bytes_before(1 << 16) + 4 * (address - usize::from(first)));
    }
    (area, bytes_before(address))
}

fn bit_mask(discrete: Discrete) -> u8 {
    1 << (discrete.address() % 8)
}

#[cfg(test)]
mod tests;
