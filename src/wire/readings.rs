//! How a list of elements can be read in the binary framing.
//!
//! A symbol is one to three letters, and nothing says how many: `52 54 …` is `RT`, or `R` at an address from 5400h.
//! Only a reading that fills the data to its end counts. Most lists have just one; a list with two must never be
//! sent, for nobody can know which one the PLC takes.

use super::field::FieldError;
use crate::element::{Element, LONGEST_SYMBOL, Symbol, Width};

/// The length of each symbol of `elements` elements, each followed by `values` values of its width, that fill `data`.
pub(crate) fn symbol_lengths(data: &[u8], elements: usize, values: usize) -> Result<Vec<u8>, FieldError> {
    // Level by level, where the next element can begin. There is hardly ever more than one place, and never more
    // than the data is long.
    let mut levels: Vec<Vec<Place>> = vec![vec![Place { at: 0, readings: 1, from: 0, length: 0 }]];
    for _ in 0..elements {
        let mut next: Vec<Place> = Vec::new();
        for (from, place) in levels.last().into_iter().flatten().enumerate() {
            for (length, at) in steps(data, place.at, values) {
                match next.iter_mut().find(|other| other.at == at) {
                    Some(other) => other.readings = other.readings.saturating_add(place.readings),
                    None => next.push(Place { at, readings: place.readings, from, length }),
                }
            }
        }
        if next.is_empty() {
            return Err(why_not(data));
        }
        levels.push(next);
    }
    let last = levels.last().into_iter().flatten().enumerate().find(|(_, place)| place.at == data.len());
    let mut index = match last {
        Some((index, Place { readings: 1, .. })) => index,
        Some(_) => return Err(FieldError::Ambiguous),
        None => return Err(why_not(data)),
    };
    // Back from the end: the one reading there is.
    let mut lengths = Vec::with_capacity(levels.len());
    while let (Some(level), true) = (levels.pop(), !levels.is_empty()) {
        let place = level.get(index).ok_or(FieldError::Unreadable)?;
        lengths.push(place.length);
        index = place.from;
    }
    lengths.reverse();
    Ok(lengths)
}

/// Where an element can begin, once the ones before it have been read.
struct Place {
    at: usize,
    /// In how many ways it is reached.
    readings: u8,
    /// The place before it, and the length of the symbol there; any one of them if there are several.
    from: usize,
    length: u8,
}

/// The elements that can be read at `at`: the length of the symbol, and where the next element begins.
fn steps(data: &[u8], at: usize, values: usize) -> impl Iterator<Item = (u8, usize)> {
    (1..=LONGEST_SYMBOL).filter_map(move |length| {
        let element = element(data.get(at..)?, length)?;
        let value = match element.width() {
            Width::Bit => 1,
            Width::Word => 2,
            Width::Double => 4_usize,
        };
        let end = at.checked_add(length)?.checked_add(2)?.checked_add(values.checked_mul(value)?)?;
        Some((u8::try_from(length).ok()?, end))
    })
}

fn element(data: &[u8], length: usize) -> Option<Element> {
    let (letters, rest) = data.split_at_checked(length)?;
    let address = u16::from_be_bytes(*rest.first_chunk()?);
    // An address that is out of range is no element, so it is no reading either.
    Element::new(symbol(letters)?, address).ok()
}

/// The symbol with exactly these letters: this framing has upper case only.
pub(crate) fn symbol(letters: &[u8]) -> Option<Symbol> {
    Symbol::from_letters(letters).filter(|symbol| symbol.as_str().as_bytes() == letters)
}

/// The rule that the data breaks, as far as its beginning tells: an address in a list that is otherwise well-formed
/// should be called that, for it is what the PLC answers.
fn why_not(data: &[u8]) -> FieldError {
    for length in (1..=LONGEST_SYMBOL).rev() {
        let Some((letters, rest)) = data.split_at_checked(length) else { continue };
        let Some(address) = rest.first_chunk() else { continue };
        if let Some(Err(error)) = symbol(letters).map(|symbol| Element::new(symbol, u16::from_be_bytes(*address))) {
            return error.into();
        }
    }
    FieldError::Unreadable
}
