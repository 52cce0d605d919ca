//! Parser of tags.

use super::{Tag, TagError, TagType};
use crate::element::{Element, ElementError, Symbol};

pub(super) fn parse(text: &str) -> Result<Tag, TagError> {
    let Some((elements, tag_type)) = text.split_once(':') else {
        return parse_elements(text, None);
    };
    // The `-` of `f32-hi` belongs to the name, that of `i16-40` begins a scale.
    let begins_scale = |&(at, c): &(usize, char)| {
        let is_order = || tag_type.get(at..at + 3).is_some_and(|text| text.eq_ignore_ascii_case("-hi"));
        matches!(c, '*' | '+') || c == '-' && !is_order()
    };
    let name_end = tag_type.char_indices().find(begins_scale).map(|(at, _)| at);
    let (name, scale) = tag_type.split_at(name_end.unwrap_or(tag_type.len()));
    let tag = parse_elements(elements, Some(name.parse()?))?;
    if scale.is_empty() { Ok(tag) } else { tag.scaled(scale.parse()?) }
}

fn parse_elements(elements: &str, tag_type: Option<TagType>) -> Result<Tag, TagError> {
    let (first, last) = match elements.split_once('-') {
        Some((first, last)) => (Element::parse(first)?, Some(last)),
        None => (Element::parse(elements)?, None),
    };
    let tag_type = tag_type.unwrap_or(TagType::default_for(first.width()));
    let Some(last) = last else {
        return Tag::new(first, tag_type, 1);
    };
    if tag_type.storage(first.width()).is_none() {
        return Err(TagError::WrongType { symbol: first.symbol(), tag_type });
    }
    Tag::spanning(first, tag_type, elements_between(first, parse_last(first.symbol(), last)?)?)
}

/// Parses the end of a range: `R9`, or `9` if the range begins with an `R`.
fn parse_last(first: Symbol, text: &str) -> Result<Element, TagError> {
    if text.is_empty() || text.starts_with(|c: char| c.is_ascii_digit()) {
        return Ok(Element::parse(&format!("{first}{text}"))?);
    }
    let last = Element::parse(text)?;
    match last.symbol() {
        symbol if symbol == first => Ok(last),
        symbol => Err(TagError::TwoSymbols { first, last: symbol }),
    }
}

fn elements_between(first: Element, last: Element) -> Result<usize, TagError> {
    let Some(distance) = last.address().checked_sub(first.address()) else {
        return Err(TagError::Backwards { first, last });
    };
    let (symbol, address) = (first.symbol(), last.address());
    if !first.is_consecutive_with(address) {
        return Err(ElementError::NotConsecutive { symbol, first: first.address(), address }.into());
    }
    let step = first.step();
    if !distance.is_multiple_of(step) {
        return Err(TagError::OffStep { first, last });
    }
    Ok(usize::from(distance / step) + 1)
}
