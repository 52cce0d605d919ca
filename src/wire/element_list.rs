//! The symbols in a list of elements of the binary framing.
//!
//! A symbol has one to three letters, and its length is not sent: `52 54 …` is `RT`, or `R` at an
//! address from 5400h. A parse must use the data up to its end. Most lists have one parse. A list
//! with two is ambiguous and must not be sent: the PLC may take the other one.

use super::field::FieldError;
use super::framing::Framing;
use crate::element::{Element, LONGEST_SYMBOL, Symbol};

/// The lengths of the symbols of `elements` elements, each followed by `values` values of its
/// width, up to the end of `data`.
pub(crate) fn symbol_lengths(data: &[u8], elements: usize, values: usize) -> Result<Vec<u8>, FieldError> {
    // Breadth first: level n has the positions where element n can begin. Nearly always there is
    // one, and never more than the data has bytes.
    let mut levels: Vec<Vec<Start>> = vec![vec![Start { at: 0, parses: 1, from: 0, length: 0 }]];
    for _ in 0..elements {
        let mut next: Vec<Start> = Vec::new();
        for (from, start) in levels.last().into_iter().flatten().enumerate() {
            for (length, at) in elements_at(data, start.at, values) {
                match next.iter_mut().find(|other| other.at == at) {
                    Some(other) => other.parses = other.parses.saturating_add(start.parses),
                    None => next.push(Start { at, parses: start.parses, from, length }),
                }
            }
        }
        if next.is_empty() {
            return Err(why_no_list(data));
        }
        levels.push(next);
    }
    let last = levels.last().into_iter().flatten().enumerate().find(|(_, start)| start.at == data.len());
    let mut index = match last {
        Some((index, Start { parses: 1, .. })) => index,
        Some(_) => return Err(FieldError::Ambiguous),
        None => return Err(why_no_list(data)),
    };
    // Back from the end, along the only parse.
    let mut lengths = Vec::with_capacity(levels.len());
    while let (Some(level), true) = (levels.pop(), !levels.is_empty()) {
        let start = level.get(index).ok_or(FieldError::Unreadable)?;
        lengths.push(start.length);
        index = start.from;
    }
    lengths.reverse();
    Ok(lengths)
}

/// A position where an element can begin.
struct Start {
    at: usize,
    /// The number of parses of the data before it.
    parses: u8,
    /// The index of the start before it, of one parse, and the length of the symbol there.
    from: usize,
    length: u8,
}

/// The elements that can begin at `at`: the length of the symbol, and the start of the next
/// element.
fn elements_at(data: &[u8], at: usize, values: usize) -> impl Iterator<Item = (u8, usize)> {
    (1..=LONGEST_SYMBOL).filter_map(move |length| {
        let element = element(data.get(at..)?, length)?;
        let value = Framing::Binary.value_len(element.width());
        let end = at.checked_add(length)?.checked_add(2)?.checked_add(values.checked_mul(value)?)?;
        Some((u8::try_from(length).ok()?, end))
    })
}

fn element(data: &[u8], length: usize) -> Option<Element> {
    let (letters, rest) = data.split_at_checked(length)?;
    let address = u16::from_be_bytes(*rest.first_chunk()?);
    // An address out of range is no element, and so no parse.
    Element::received(symbol(letters)?, address.into(), Framing::Binary).ok()
}

/// The symbol with these letters, upper case only.
pub(crate) fn symbol(letters: &[u8]) -> Option<Symbol> {
    Symbol::from_letters(letters).filter(|symbol| symbol.as_str().as_bytes() == letters)
}

/// The rule that the first element breaks. A PLC refuses a bad address with another code than a bad
/// format.
fn why_no_list(data: &[u8]) -> FieldError {
    for length in (1..=LONGEST_SYMBOL).rev() {
        let Some((letters, rest)) = data.split_at_checked(length) else { continue };
        let Some(address) = rest.first_chunk() else { continue };
        let address = u16::from_be_bytes(*address).into();
        let element = symbol(letters).map(|symbol| Element::received(symbol, address, Framing::Binary));
        if let Some(Err(error)) = element {
            return error.into();
        }
    }
    FieldError::Unreadable
}
