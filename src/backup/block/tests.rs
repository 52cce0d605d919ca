use proptest::prelude::*;

use super::*;
use crate::element::Symbol;

fn tag(text: &str) -> Tag {
    text.parse().unwrap()
}

/// All requests for a range of which these places are refused: those that were answered, and what was found.
fn isolate(range: Tag, refused: &[usize], lengths: RequestLengths) -> (Vec<Chunk>, Vec<Chunk>) {
    let mut chunks = Chunks::new([(0, range, 0..range.element_count())], lengths);
    let (mut answered, mut found) = (Vec::new(), Vec::new());
    while let Some(chunk) = chunks.next() {
        if refused.iter().any(|place| chunk.indices().contains(place)) {
            found.extend(chunks.refused());
        } else {
            answered.push(chunk);
            chunks.done();
        }
    }
    (answered, found)
}

#[test]
fn requests_are_as_long_as_they_can_be_and_no_pair_is_split() {
    for (range, places, expected) in [
        ("R0-R199", 0..200, vec![(0, 64), (64, 64), (128, 64), (192, 8)]),
        ("R0-R199:u32", 1..200, vec![(1, 63), (64, 64), (128, 64), (192, 8)]),
        ("DR0-DR198", 0..100, vec![(0, 32), (32, 32), (64, 32), (96, 4)]),
        ("M0-M299", 5..300, vec![(5, 256), (261, 39)]),
        ("R7", 0..1, vec![(0, 1)]),
        ("R7", 0..0, vec![]),
    ] {
        let mut chunks = Chunks::new([(0, tag(range), places)], RequestLengths::PROTOCOL);
        let mut made = Vec::new();
        while let Some(chunk) = chunks.next() {
            made.push((chunk.start, chunk.count));
            chunks.done();
        }
        assert_eq!(made, expected, "{range}");
    }
}

#[test]
fn requests_keep_to_shorter_lengths_and_values_stay_whole() {
    for (range, points, units, expected) in [
        ("R0-R24", None, Some(10), vec![(0, 10), (10, 10), (20, 5)]),
        ("R0-R24", Some(3), Some(200), vec![(0, 25)]),
        ("M0-M49", Some(20), Some(2), vec![(0, 20), (20, 20), (40, 10)]),
        ("DR0-DR12", None, Some(5), vec![(0, 2), (2, 2), (4, 2), (6, 1)]),
        ("R0-R9:u32", None, Some(5), vec![(0, 4), (4, 4), (8, 2)]),
        ("R0-R9:u32", None, Some(2), vec![(0, 2), (2, 2), (4, 2), (6, 2), (8, 2)]),
        ("R0-R11:u64", None, Some(3), vec![(0, 4), (4, 4), (8, 4)]),
        ("R0-R3:u64", None, Some(2), vec![(0, 4)]),
    ] {
        let lengths = RequestLengths::PROTOCOL.within(points, units);
        let (answered, found) = isolate(tag(range), &[], lengths);
        let made: Vec<_> = answered.iter().map(|chunk| (chunk.start, chunk.count)).collect();
        assert_eq!((made, found), (expected, vec![]), "{range}");
    }
}

#[test]
fn words_and_double_words_name_their_discretes() {
    for (range, expected) in [
        ("M5-M9", Some(("M5", 5))),
        ("WM8-WM24", Some(("M8", 32))),
        ("DWY16", Some(("Y16", 32))),
        ("R0-R9", None),
        ("RT0", None),
    ] {
        let found = discretes(tag(range)).map(|(first, count)| (first.to_string(), count));
        assert_eq!(found, expected.map(|(first, count)| (first.to_owned(), count)), "{range}");
    }
    let left_out: Vec<_> = Symbol::ALL
        .iter()
        .filter(|&&symbol| is_never_restored(Element::new(symbol, 0).unwrap().into()))
        .map(|symbol| symbol.as_str())
        .collect();
    assert_eq!(left_out, ["X", "T", "C", "WX", "WT", "WC", "DWX", "DWT", "DWC"]);
}

proptest! {
    #[test]
    fn exactly_what_is_refused_is_found_and_values_stay_whole(
        count in 1_usize..300,
        kind in 0_usize..5,
        units in 1_usize..80,
        refused in prop::collection::btree_set(0_usize..300, 0..6),
    ) {
        let (range, per_value) = match kind {
            0 => (format!("R0-R{}", count - 1), 1),
            1 => (format!("M0-M{}", count - 1), 1),
            2 => (format!("DR0-DR{}", 2 * count - 2), 1),
            3 => (format!("R1-R{}:i32", 2 * count), 2),
            _ => (format!("R1-R{}:i64", 4 * count), 4),
        };
        let range = plain(range.parse().unwrap());
        let lengths = RequestLengths::PROTOCOL.within(Some(units), Some(units));
        let refused: Vec<usize> = refused.into_iter().filter(|&place| place < range.element_count()).collect();
        let (answered, found) = isolate(range, &refused, lengths);
        let values: std::collections::BTreeSet<_> = refused.iter().map(|place| place / per_value * per_value).collect();
        let found_values: Vec<_> = found.iter().map(|chunk| (chunk.start, chunk.count)).collect();
        prop_assert_eq!(found_values, values.into_iter().map(|start| (start, per_value)).collect::<Vec<_>>());
        let mut covered: Vec<usize> = answered.iter().chain(&found).flat_map(|chunk| chunk.indices()).collect();
        covered.sort_unstable();
        prop_assert!(covered.into_iter().eq(0..range.element_count()), "each once");
        for chunk in answered {
            prop_assert!(chunk.count <= lengths.most(range.first()).max(per_value));
            prop_assert!(chunk.start.is_multiple_of(per_value) && chunk.count.is_multiple_of(per_value), "{chunk:?}");
        }
    }
}
