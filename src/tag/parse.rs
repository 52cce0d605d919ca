//! Parser of tags, for texts and for constants: all but the numbers of a scale are parsed by the
//! same functions.

use super::scale::Scale;
use super::{Tag, TagError, TagType};
use crate::element::{Element, ElementError, Symbol};

/// Parses a tag.
pub(super) fn parse(text: &str) -> Result<Tag, TagError> {
    let parts = Parts::of(text);
    let tag = parts.unscaled()?;
    match parts.scale {
        None => Ok(tag),
        Some(scale) => tag.scaled(scale.parse()?),
    }
}

/// As [`parse`], in constants. The numbers of a scale have at most 15 digits here.
pub(super) const fn parse_const(text: &str) -> Result<Tag, TagError> {
    let parts = Parts::of(text);
    match (parts.unscaled(), parts.scale) {
        (Ok(tag), Some(scale)) => match Scale::parse_const(scale) {
            Ok(scale) => tag.scaled(scale),
            Err(error) => Err(TagError::Scale(error)),
        },
        (result, _) => result,
    }
}

/// The parts of a text: `R0-R9`, `:f32`, `*0.1-40`.
#[derive(Clone, Copy)]
struct Parts<'t> {
    elements: &'t str,
    type_name: Option<&'t str>,
    scale: Option<&'t str>,
}

impl<'t> Parts<'t> {
    const fn of(text: &'t str) -> Self {
        let Some((elements, rest)) = split_once(text, b':') else {
            return Self { elements: text, type_name: None, scale: None };
        };
        let bytes = rest.as_bytes();
        let mut end = 0;
        while end < bytes.len() && !begins_scale(bytes, end) {
            end += 1;
        }
        let (name, scale) = rest.split_at(end);
        Self { elements, type_name: Some(name), scale: if scale.is_empty() { None } else { Some(scale) } }
    }

    /// The tag without its scale.
    const fn unscaled(self) -> Result<Tag, TagError> {
        // An element has neither.
        if split_once(self.elements, b'*').is_some() || split_once(self.elements, b'+').is_some() {
            return Err(TagError::ScaleWithoutType);
        }
        let tag_type = match self.type_name {
            None => None,
            Some(name) => match TagType::named(name) {
                Some(tag_type) => Some(tag_type),
                None => return Err(TagError::UnknownType),
            },
        };
        let (first, last) = match split_once(self.elements, b'-') {
            Some((first, last)) => (first, Some(last)),
            None => (self.elements, None),
        };
        if let Some((register, bit)) = split_once(first, b'.') {
            return bits(register, bit, last, tag_type);
        }
        let first = match Element::parse(first) {
            Ok(first) => first,
            Err(error) => return Err(TagError::Element(error)),
        };
        let tag_type = match tag_type {
            Some(tag_type) => tag_type,
            None => TagType::default_for(first.width()),
        };
        let Some(last) = last else {
            return Tag::of_values(first, tag_type, 1);
        };
        if tag_type.storage(first.width()).is_none() {
            return Err(TagError::WrongType { symbol: first.symbol(), tag_type });
        }
        match last_of_range(first, last) {
            Ok(last) => match elements_between(first, last) {
                Ok(elements) => Tag::of_elements(first, tag_type, elements),
                Err(error) => Err(error),
            },
            Err(error) => Err(error),
        }
    }
}

/// The `-` of `f32-hi` belongs to the name, that of `i16-40` begins a scale.
const fn begins_scale(text: &[u8], at: usize) -> bool {
    match text[at] {
        b'*' | b'+' => true,
        b'-' => {
            let is_order = at + 2 < text.len()
                && text[at + 1].eq_ignore_ascii_case(&b'h')
                && text[at + 2].eq_ignore_ascii_case(&b'i');
            !is_order
        }
        _ => false,
    }
}

/// Parses bits of a register: `R5.3`, `R5.0-R5.7` or `R5.0-7`.
const fn bits(register: &str, bit: &str, last: Option<&str>, tag_type: Option<TagType>) -> Result<Tag, TagError> {
    let register = match Element::parse(register) {
        Ok(register) => register,
        Err(error) => return Err(TagError::Element(error)),
    };
    match tag_type {
        None | Some(TagType::Bool) => {}
        Some(tag_type) => return Err(TagError::BitType { tag_type }),
    }
    let first = match bit_number(register, bit) {
        Ok(bit) => bit,
        Err(error) => return Err(error),
    };
    let last = match last {
        None => first,
        Some(text) => match last_bit(register, text) {
            Ok(bit) => bit,
            Err(error) => return Err(error),
        },
    };
    match last.checked_sub(first) {
        // At most 31: both are bits of a register.
        Some(distance) => Tag::bits(register, first, distance + 1),
        None => Err(TagError::BackwardBits { element: register, first, last }),
    }
}

/// Parses the end of a range of bits: `R5.7`, or `7`.
const fn last_bit(register: Element, text: &str) -> Result<u8, TagError> {
    let Some((last, bit)) = split_once(text, b'.') else {
        return bit_number(register, text);
    };
    match Element::parse(last) {
        Ok(last) if is_same(last, register) => bit_number(register, bit),
        Ok(last) => Err(TagError::BitsOfTwo { first: register, last }),
        Err(error) => Err(TagError::Element(error)),
    }
}

const fn bit_number(register: Element, text: &str) -> Result<u8, TagError> {
    let digits = text.as_bytes();
    let mut number = 0_u8;
    let mut n = 0;
    while n < digits.len() {
        if !digits[n].is_ascii_digit() {
            return Err(TagError::BadBit { element: register });
        }
        // A number of any length stays above every limit.
        number = number.saturating_mul(10).saturating_add(digits[n] - b'0');
        n += 1;
    }
    if digits.is_empty() {
        return Err(TagError::BadBit { element: register });
    }
    if number as u32 >= register.width().bits() {
        return Err(TagError::NoBit { element: register, bit: number });
    }
    Ok(number)
}

/// Parses the end of a range: `R9`, or `9` if the range begins with an `R`.
const fn last_of_range(first: Element, text: &str) -> Result<Element, TagError> {
    let symbol = first.symbol();
    let last = match text.as_bytes() {
        [] | [b'0'..=b'9', ..] => Element::parse_address(symbol, text.as_bytes()),
        _ => Element::parse(text),
    };
    match last {
        Ok(last) if is_same_symbol(last.symbol(), symbol) => Ok(last),
        Ok(last) => Err(TagError::TwoSymbols { first: symbol, last: last.symbol() }),
        Err(error) => Err(TagError::Element(error)),
    }
}

const fn elements_between(first: Element, last: Element) -> Result<usize, TagError> {
    let Some(distance) = last.address().checked_sub(first.address()) else {
        return Err(TagError::Backwards { first, last });
    };
    let (symbol, address) = (first.symbol(), last.address());
    if !first.is_consecutive_with(address) {
        return Err(TagError::Element(ElementError::NotConsecutive { symbol, first: first.address(), address }));
    }
    let step = first.step();
    if distance % step != 0 {
        return Err(TagError::OffStep { first, last });
    }
    Ok((distance / step) as usize + 1)
}

const fn is_same_symbol(a: Symbol, b: Symbol) -> bool {
    a as u8 == b as u8
}

const fn is_same(a: Element, b: Element) -> bool {
    is_same_symbol(a.symbol(), b.symbol()) && a.address() == b.address()
}

/// [`str::split_once`] at an ASCII character, in constants.
const fn split_once(text: &str, at: u8) -> Option<(&str, &str)> {
    let bytes = text.as_bytes();
    let mut n = 0;
    while n < bytes.len() {
        if bytes[n] == at {
            let (before, rest) = text.split_at(n);
            let (_, behind) = rest.split_at(1);
            return Some((before, behind));
        }
        n += 1;
    }
    None
}

/// Compares two ASCII texts in either case, in constants.
pub(super) const fn is_equal_in_either_case(a: &[u8], b: &[u8]) -> bool {
    let mut n = 0;
    while n < a.len() && n < b.len() && a[n].eq_ignore_ascii_case(&b[n]) {
        n += 1;
    }
    n == a.len() && n == b.len()
}
