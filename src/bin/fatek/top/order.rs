//! Orders of the tags.

use std::cmp::Ordering;

use fatek::tag::TagValue;

use super::history::number;
use super::model::{Data, TagInfo};

/// A key to sort by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum SortKey {
    /// As given on the command line, or in the file.
    #[default]
    Given,
    Name,
    /// Numbers before texts, missing values last.
    Value,
    /// The worst first.
    Quality,
    /// The newest first.
    Age,
    /// PLC, in their order, with the tags by name.
    Plc,
}

const KEYS: [SortKey; 6] =
    [SortKey::Given, SortKey::Name, SortKey::Value, SortKey::Quality, SortKey::Age, SortKey::Plc];

/// A sort key with its direction. Equal tags stay in the order in which they were given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Order {
    pub(super) key: SortKey,
    pub(super) is_reversed: bool,
}

impl SortKey {
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Given => "as given",
            Self::Name => "by name",
            Self::Value => "by value",
            Self::Quality => "by quality",
            Self::Age => "by age",
            Self::Plc => "by PLC",
        }
    }
}

impl Order {
    /// The order by the next key.
    pub(super) fn next(self) -> Self {
        let place = KEYS.iter().position(|key| *key == self.key).unwrap_or(0);
        Self { key: KEYS[(place + 1) % KEYS.len()], is_reversed: false }
    }

    pub(super) fn reversed(self) -> Self {
        Self { is_reversed: !self.is_reversed, ..self }
    }

    /// Sorts the numbers of tags, which are in the order given.
    pub(super) fn sort(self, numbers: &mut [usize], tags: &[TagInfo], data: &Data) {
        let compare = |&a: &usize, &b: &usize| {
            let (one, other) = (&data.tags[a], &data.tags[b]);
            let by_name = || compare_names(&tags[a].label, &tags[b].label);
            match self.key {
                SortKey::Given => a.cmp(&b),
                SortKey::Name => by_name(),
                SortKey::Value => compare_values(one.value.as_ref(), other.value.as_ref(), self.is_reversed),
                SortKey::Quality => one.level.cmp(&other.level),
                SortKey::Age => other.at.cmp(&one.at),
                SortKey::Plc => tags[a].plc.cmp(&tags[b].plc).then_with(by_name),
            }
        };
        if self.is_reversed && self.key != SortKey::Value {
            numbers.sort_by(|a, b| compare(b, a));
        } else {
            numbers.sort_by(compare);
        }
    }
}

/// Compares values; a missing one is the last in both directions.
fn compare_values(one: Option<&TagValue>, other: Option<&TagValue>, is_reversed: bool) -> Ordering {
    let (Some(one), Some(other)) = (one, other) else {
        return one.is_none().cmp(&other.is_none());
    };
    let ordering = match (number(one), number(other)) {
        (Some(one), Some(other)) => one.total_cmp(&other),
        (None, None) => one.to_string().cmp(&other.to_string()),
        (one, other) => one.is_none().cmp(&other.is_none()),
    };
    if is_reversed { ordering.reverse() } else { ordering }
}

/// Compares names: without regard to case, and numbers in them as numbers, so that R9 is before
/// R10.
fn compare_names(one: &str, other: &str) -> Ordering {
    let (mut one, mut other) = (parts(one), parts(other));
    loop {
        match (one.next(), other.next()) {
            (None, None) => return Ordering::Equal,
            (None, Some(_)) => return Ordering::Less,
            (Some(_), None) => return Ordering::Greater,
            (Some(one), Some(other)) => match one.cmp(&other) {
                Ordering::Equal => {}
                unequal @ (Ordering::Less | Ordering::Greater) => return unequal,
            },
        }
    }
}

/// A number, by its length without leading zeros and its digits, or a character of a name.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Part<'n> {
    Number(usize, &'n str),
    Character(char),
}

fn parts(mut name: &str) -> impl Iterator<Item = Part<'_>> {
    std::iter::from_fn(move || {
        let digits = name.bytes().take_while(u8::is_ascii_digit).count();
        let (part, rest) = name.split_at(if digits > 0 { digits } else { name.chars().next()?.len_utf8() });
        name = rest;
        if digits > 0 {
            let number = part.trim_start_matches('0');
            return Some(Part::Number(number.len(), number));
        }
        part.chars().next().map(|character| Part::Character(character.to_ascii_lowercase()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_compared_with_their_numbers() {
        let mut names = ["R10", "r9", "R9[10]", "R9[2]", "M1", "level", "Alarm", "R007", "R"];
        names.sort_by(|one, other| compare_names(one, other));
        assert_eq!(names, ["Alarm", "level", "M1", "R", "R007", "r9", "R9[2]", "R9[10]", "R10"]);
    }

    #[test]
    fn values_are_ordered_with_missing_ones_last() {
        let text = |text: &str| Some(TagValue::Text(text.to_owned()));
        let mut values =
            [None, text("b"), Some(TagValue::U16(7)), Some(TagValue::Bool(true)), text("a"), Some(TagValue::F32(-1.5))];
        let shown = |values: &[Option<TagValue>]| {
            let shown = values.iter().map(|value| value.as_ref().map_or("none".to_owned(), ToString::to_string));
            shown.collect::<Vec<_>>().join(" ")
        };
        values.sort_by(|one, other| compare_values(one.as_ref(), other.as_ref(), false));
        assert_eq!(shown(&values), "-1.5 1 7 \"a\" \"b\" none");
        values.sort_by(|one, other| compare_values(one.as_ref(), other.as_ref(), true));
        assert_eq!(shown(&values), "\"b\" \"a\" 7 1 -1.5 none");
    }

    #[test]
    fn the_keys_follow_each_other_in_a_circle() {
        let mut order = Order::default().reversed();
        let mut words = Vec::new();
        for _ in 0..KEYS.len() {
            order = order.next();
            assert!(!order.is_reversed);
            words.push(order.key.word());
        }
        assert_eq!(words, ["by name", "by value", "by quality", "by age", "by PLC", "as given"]);
    }
}
