//! Words of discretes that a PLC refuses.

use std::time::Duration;

use super::rig::{TestRig, elements, ms};
use crate::element::Symbol;
use crate::error::ErrorCode;
use crate::plan::{Limits, ReadRequest};
use crate::poll::{ScanClass, TagId};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

fn singles(area: &str, count: usize, step: usize) -> Vec<String> {
    (0..count).map(|n| format!("{area}{}", n * step)).collect()
}

fn add(rig: &mut TestRig, class: ScanClass, texts: &[String]) -> Vec<TagId> {
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    rig.add(class, &texts)
}

/// M0 to M99 are read as words. The PLC refuses these, but none of the discretes.
#[test]
fn words_of_discretes_are_refused_and_every_discrete_is_read() {
    let mut rig = TestRig::new(1);
    rig.plc.words = false;
    let mut texts = singles("M", 100, 1);
    texts.extend(singles("R", 20, 3));
    let ids = add(&mut rig, every(1000), &texts);
    rig.run(ms(500));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()), "in the first cycle already");
    assert_eq!(rig.poller.classes().next().unwrap().refusals, 2, "the request, and the request again");
    assert!(rig.take_requests().iter().any(has_words));
    rig.run(ms(5000));
    assert!(!rig.take_requests().iter().any(has_words), "learned");
    assert_eq!(rig.poller.classes().next().unwrap().refused_tags, 0);
    // Words are tried again after the lifetime of a learned limit.
    rig.plc.words = true;
    rig.run(Duration::from_secs(601));
    rig.take_requests();
    rig.run(ms(1000));
    assert!(rig.take_requests().iter().any(has_words));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
}

fn has_words(request: &ReadRequest) -> bool {
    has_words_of(request, Symbol::M)
}

fn has_words_of(request: &ReadRequest, discrete: Symbol) -> bool {
    let of_area = |symbol: Symbol| symbol != discrete && symbol.area().smallest() == discrete;
    elements(request).iter().any(|element| of_area(element.symbol()))
}

/// The word that contains a refused discrete is refused as well, and the others are read as words.
#[test]
fn a_refused_discrete_is_found_within_words() {
    for wrong in [0, 7, 8, 50, 99] {
        let mut rig = TestRig::new(1);
        rig.plc.refused.insert((Symbol::M, wrong));
        let texts = singles("M", 100, 1);
        let ids = add(&mut rig, every(1000), &texts);
        rig.run(ms(2500));
        for (n, id) in ids.iter().enumerate() {
            assert_eq!(rig.latest(*id).is_good(), n != usize::from(wrong), "M{n}, {wrong}");
        }
        rig.take_requests();
        rig.run(ms(1000));
        assert!(rig.take_requests().iter().any(has_words), "M{wrong}");
        assert_eq!(rig.poller.classes().next().unwrap().refused_tags, 1);
    }
}

/// Before, a refusal with NotSupported was taken for a failure: no discrete was ever read.
#[test]
fn each_code_of_a_refusal_is_one() {
    for code in [
        ErrorCode::IllegalValue,
        ErrorCode::IllegalFormat,
        ErrorCode::IllegalAddress,
        ErrorCode::NotSupported,
        ErrorCode::Unknown(12),
    ] {
        let mut rig = TestRig::new(1);
        (rig.plc.words, rig.plc.code) = (false, code);
        let ids = add(&mut rig, every(1000), &singles("M", 256, 1));
        rig.run(ms(500));
        assert!(ids.iter().all(|id| rig.latest(*id).is_good()), "{code:?}");
        // Mixed reads are as optional as words.
        let mut rig = TestRig::new(1);
        (rig.plc.mixed, rig.plc.code) = (false, code);
        let ids = add(&mut rig, every(1000), &singles("R", 20, 100));
        rig.run(ms(500));
        assert!(ids.iter().all(|id| rig.latest(*id).is_good()), "{code:?}");
    }
}

/// Before, each refused request read only its part of the tag: a class whose period is longer than the
/// lifetime of a learned limit never had a value.
#[test]
fn a_tag_of_several_requests_is_read_in_the_same_cycle() {
    for period in [1000, 900_000] {
        let mut rig = TestRig::new(1);
        rig.plc.words = false;
        let ids = rig.add(every(period), &["M0-M1999"]);
        for _ in 0..3 {
            rig.run(ms(500));
            assert!(rig.latest(ids[0]).is_good(), "{}", rig.latest(ids[0]).quality);
            rig.run(ms(period - 500));
        }
    }
}

/// Before, each of the four requests was refused twice.
#[test]
fn excluded_words_are_not_sent_in_the_rest_of_the_cycle() {
    let mut rig = TestRig::new(1);
    rig.plc.words = false;
    let ids = add(&mut rig, every(1000), &singles("M", 4096, 1));
    rig.run(ms(900));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    assert_eq!(rig.take_requests().iter().filter(|request| has_words(request)).count(), 2);
}

/// The group is longer than a learned limit if its discretes are not words. Before, it was refused.
#[test]
fn a_group_is_read_without_words_if_it_exceeds_learned_limits() {
    for words_first in [false, true] {
        let mut rig = TestRig::new(1);
        (rig.plc.words, rig.plc.max_mixed) = (false, 50);
        if words_first {
            add(&mut rig, every(1000), &singles("M", 100, 1));
            rig.run(ms(2500));
        }
        // Teaches that mixed reads have 32 units at most.
        let scattered = add(&mut rig, every(1000), &singles("R", 64, 50));
        rig.run(ms(2500));
        assert!(scattered.iter().all(|id| rig.latest(*id).is_good()));
        let mut group = singles("D", 30, 50);
        group.extend(singles("M", 10, 1));
        let texts: Vec<&str> = group.iter().map(String::as_str).collect();
        let ids = rig.try_add(every(1000), super::rig::tags(&texts), true).unwrap();
        rig.run(ms(2500));
        for id in ids {
            assert!(rig.latest(id).is_good(), "{words_first}: {}", rig.latest(id).quality);
        }
    }
}

/// Before, one refused area excluded the words of all areas in the same request.
#[test]
fn words_of_other_areas_are_read_on() {
    let mut rig = TestRig::new(1);
    rig.plc.refuses_words_of = Some(Symbol::X);
    let known = add(&mut rig, every(1000), &singles("M", 64, 1));
    rig.run(ms(500));
    let mut both = singles("X", 64, 1);
    both.extend((0..64).map(|n| format!("M{}", 1000 + n)));
    let ids = add(&mut rig, every(1000), &both);
    rig.run(ms(2500));
    rig.take_requests();
    rig.run(ms(1000));
    let requests = rig.take_requests();
    assert!(requests.iter().any(|request| has_words_of(request, Symbol::M)), "{requests:?}");
    assert!(!requests.iter().any(|request| has_words_of(request, Symbol::X)), "{requests:?}");
    assert!(ids.iter().chain(&known).all(|id| rig.latest(*id).is_good()));
}

/// The PLC accepts words, but no more than 32 in a request. Before, they were all excluded.
#[test]
fn a_limit_of_length_is_learned_for_words_too() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.max_registers = 32;
    add(&mut rig, every(1000), &singles("M", 64, 1));
    rig.run(ms(500));
    let ids: Vec<String> = (0..1024).map(|n| format!("M{}", 1000 + n)).collect();
    let ids = add(&mut rig, every(1000), &ids);
    rig.run(ms(2500));
    rig.take_requests();
    rig.run(ms(1000));
    let requests = rig.take_requests();
    let longest = requests.iter().filter(|request| has_words(request)).map(|request| elements(request).len()).max();
    assert_eq!(longest, Some(32), "{requests:?}");
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    assert_eq!(rig.poller.classes().next().unwrap().refused_tags, 0);
}

/// One word behind the end of the memory is avoided, and the others are read. A PLC that refuses more
/// of them has none.
#[test]
fn a_single_refused_word_is_avoided_and_a_second_one_excludes_all() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    let ids = add(&mut rig, every(1000), &singles("M", 1024, 1));
    rig.run(ms(500));
    rig.plc.refused.insert((Symbol::WM, 512));
    rig.run(ms(5000));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    rig.take_requests();
    rig.run(ms(1000));
    let requests = rig.take_requests();
    assert!(requests.iter().any(has_words), "{requests:?}");
    let refusals = rig.poller.classes().next().unwrap().refusals;
    rig.run(ms(5000));
    assert_eq!(rig.poller.classes().next().unwrap().refusals, refusals, "no request repeats a refusal");
    // From now on, no word is accepted.
    rig.plc.words = false;
    rig.run(ms(5000));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    let refused = rig.poller.classes().next().unwrap().refusals - refusals;
    assert!(refused < 40, "{refused} refusals");
    rig.take_requests();
    rig.run(ms(1000));
    assert!(!rig.take_requests().iter().any(has_words));
}

/// Words of M were accepted before, and the group has too many of them for the PLC, or one behind its memory.
/// Before, such groups were refused.
#[test]
fn a_group_is_read_without_words_although_words_were_accepted() {
    for by_length in [false, true] {
        let mut rig = TestRig::new(1);
        add(&mut rig, every(1000), &singles("M", 32, 1));
        rig.run(ms(500));
        let group = if by_length {
            rig.plc.max_registers = 8;
            singles("M", 256, 1)
        } else {
            rig.plc.refused.insert((Symbol::WM, 1992));
            rig.plc.refused.insert((Symbol::WM, 2000));
            ["M2000", "M2001", "R100"].map(str::to_owned).to_vec()
        };
        let texts: Vec<&str> = group.iter().map(String::as_str).collect();
        let ids = rig.try_add(every(1000), super::rig::tags(&texts), true).unwrap();
        rig.run(ms(2500));
        for _ in 0..130 {
            for id in &ids {
                assert!(rig.latest(*id).is_good(), "{by_length}: {}", rig.latest(*id).quality);
            }
            rig.run(ms(1000));
        }
    }
}

/// Before, error 9 to a run of words was a failure once it was sent again: each cycle was abandoned.
#[test]
fn a_length_refused_as_not_supported_is_learned() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    (rig.plc.max_registers, rig.plc.length_code) = (32, ErrorCode::NotSupported);
    add(&mut rig, every(1000), &singles("M", 64, 1));
    rig.run(ms(500));
    let ids: Vec<String> = (0..1024).map(|n| format!("M{}", 1000 + n)).collect();
    let ids = add(&mut rig, every(1000), &ids);
    rig.run(ms(2500));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    let abandoned = rig.poller.classes().next().unwrap().abandoned;
    rig.run(ms(5000));
    assert_eq!(rig.poller.classes().next().unwrap().abandoned, abandoned);
}
