//! Tags and assignments as text.

use fatek::Value;
use fatek::tag::{Assignment, Tag, TagType};

use crate::text::round_trip;

pub fn run(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    round_trip::<TagType>(&text);
    let name = text.split('=').next().unwrap_or_default();
    if let Some(tag) = round_trip::<Tag>(name) {
        assert_eq!(tag.elements().count(), tag.element_count());
        if tag.is_bits_of_register() {
            assert_eq!(tag.element_count(), 1);
        } else {
            assert_eq!(tag.value_count() * tag.elements_per_value(), tag.element_count());
        }
        // Longer tags are slow and cover nothing new.
        if tag.element_count() <= 64 {
            any_memory_is_a_value(tag, input);
        }
    }
    // Compared by encoded memory, because NaN is not equal to itself.
    let Ok(assignment) = text.parse::<Assignment>() else { return };
    let printed = assignment.to_string();
    match printed.parse::<Assignment>() {
        Ok(again) => assert_eq!(again.encode(), assignment.encode(), "`{text}` prints as `{printed}`"),
        Err(error) => panic!("`{text}` prints as `{printed}`, which does not parse: {error}"),
    }
    let tag = assignment.tag();
    assert_eq!(tag.encode(assignment.values()), Ok(assignment.encode()));
    assert_eq!(assignment.encode().len(), tag.element_count());
}

/// Invariant: any memory decodes to values, which encode to the same memory. Floats may differ, as
/// scaled numbers and NaN.
fn any_memory_is_a_value(tag: Tag, bytes: &[u8]) {
    let mut bytes = bytes.iter().rev().copied().chain(std::iter::repeat(0));
    let mut next = || bytes.next().unwrap_or_default();
    let raw: Vec<Value> = tag
        .elements()
        .map(|element| match element.width().units() {
            2 => Value::DWord(u32::from_be_bytes([next(), next(), next(), next()])),
            _ if element.width() == fatek::Width::Bit => Value::Bit(next() & 1 == 1),
            _ => Value::Word(u16::from_be_bytes([next(), next()])),
        })
        .collect();
    let values = tag.decode(&raw).unwrap();
    if tag.is_bits_of_register() {
        // Invariant: nothing encodes them, since a write would replace the other bits.
        assert!(tag.encode(&values).is_err(), "{tag}: {values:?}");
        assert!(Assignment::new(tag, values).is_err(), "{tag}");
        return;
    }
    let exact = !matches!(tag.tag_type(), TagType::F32 | TagType::F32Hi | TagType::F64 | TagType::F64Hi);
    match tag.encode(&values) {
        Ok(again) if exact => assert_eq!(again, raw, "{tag}: {values:?}"),
        Ok(again) => assert_eq!(again.len(), raw.len()),
        Err(error) => assert!(!exact, "{tag}: {values:?}: {error}"),
    }
    if exact {
        let assignment = Assignment::new(tag, values).unwrap();
        let printed = assignment.to_string();
        assert_eq!(printed.parse::<Assignment>().map(|again| again.encode()), Ok(raw), "{printed}");
    }
}
