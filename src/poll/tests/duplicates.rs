//! Duplicates of replies that come out of order: see [`Job`](crate::link::job::Job).

use std::time::Duration;

use super::lab::{Lab, ms, value};
use crate::element::Register;
use crate::error::Error;
use crate::plan::Limits;
use crate::poll::{Quality, Reason, ScanClass};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

/// Ten registers that take ten requests, all replies to which have one shape.
fn lab() -> Lab {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.one_shape = true;
    let texts: Vec<String> = (0..10).map(|n| format!("R{}", 100 * n)).collect();
    lab.add(every(1000), &texts.iter().map(String::as_str).collect::<Vec<_>>());
    lab
}

/// The good samples that the PLC did not hold when it answered.
fn wrong(lab: &mut Lab) -> usize {
    let samples = lab.news();
    let is_wrong = |sample: &&crate::poll::Sample| {
        let address: u16 = sample.name[1..].parse().unwrap();
        let epoch = lab.plc.epochs[&sample.at.instant];
        let held = value(epoch, Register::r(address).into());
        sample.is_good() && crate::command::Value::Word(word(sample)) != held
    };
    samples.iter().filter(is_wrong).count()
}

fn word(sample: &crate::poll::Sample) -> u16 {
    match sample.value() {
        Some(crate::tag::TagValue::U16(word)) => *word,
        other => panic!("{other:?}"),
    }
}

/// Without the check at the end of a cycle no copy at its last request was noticed: see the figures of the test of this name in
/// `tests/poll.rs`.
#[test]
fn no_sample_is_a_roaming_duplicate() {
    let mut sum = 0;
    for at in 1..=40 {
        let mut lab = lab();
        lab.plc.roams_at = Some(at);
        lab.run(ms(9500));
        assert_eq!((lab.plc.roamed, lab.repeated), (1, 1), "request {at}");
        sum += wrong(&mut lab);
        let stats = lab.device.classes().next().unwrap();
        assert_eq!((stats.cycles, stats.abandoned), (10, 0));
    }
    assert_eq!(sum, 0);
}

#[test]
fn a_cycle_of_equal_shapes_costs_one_check() {
    let mut lab = lab();
    lab.run(ms(9500));
    assert_eq!((lab.plc.asked.len(), lab.plc.checks), (100, 10));
    assert_eq!(lab.news().len(), 100);
}

#[test]
fn a_cycle_of_one_request_costs_no_check() {
    let mut lab = Lab::new(1);
    lab.plc.one_shape = true;
    lab.add(every(1000), &["R0", "R1"]);
    lab.run(ms(9500));
    assert_eq!((lab.plc.asked.len(), lab.plc.checks), (10, 0));
}

#[test]
fn a_cycle_is_abandoned_when_duplicates_do_not_end() {
    let mut lab = lab();
    let end = lab.start + ms(900);
    while lab.now < end && lab.step(end) {
        lab.plc.left_over = true;
    }
    let stats = lab.device.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.abandoned, lab.repeated), (1, 1, 3));
    let samples = lab.news();
    assert_eq!(samples.len(), 10);
    for sample in samples {
        let Quality::Bad(Reason::Failed(error)) = &sample.quality else { panic!("{sample:?}") };
        assert!(matches!(**error, Error::Duplicates { station: 1, .. }), "{error}");
    }
    // What was held is given back.
    lab.run(ms(2000));
    assert!(lab.news().iter().all(crate::poll::Sample::is_good));
}

#[test]
fn values_before_a_request_without_an_answer_are_given() {
    let mut lab = lab();
    // The last request.
    lab.plc.silent_about = Some((crate::element::Symbol::R, 0));
    lab.run(ms(900));
    let (good, other): (Vec<_>, Vec<_>) = lab.news().into_iter().partition(crate::poll::Sample::is_good);
    assert_eq!((good.len(), other.len(), lab.plc.checks), (9, 1, 1));
    assert!(good.iter().all(|sample| sample.at.instant < lab.start + ms(100)), "the time of the reply");
}

#[test]
fn a_refusal_is_confirmed_before_a_tag_is_blamed() {
    let mut lab = Lab::new(1);
    let ids = lab.add(every(1000), &["R0"]);
    let mut samples = Vec::new();
    assert!(lab.request(&mut samples).is_some());
    // It was a copy of an older refusal: the true reply is left over.
    lab.answer(Err(super::regressions::refusal()), None, &mut samples);
    lab.plc.left_over = true;
    assert!(lab.request(&mut samples).is_some(), "it is asked again");
    lab.answer(Ok(crate::plan::Reply::Words(vec![7])), None, &mut samples);
    assert!(lab.latest(ids[0]).is_good());
    assert_eq!(samples.len(), 1);
}

#[test]
fn a_tag_removed_while_its_value_is_held_has_no_sample() {
    let mut lab = lab();
    let mut samples = Vec::new();
    let ids: Vec<_> = (1..=10).map(crate::poll::TagId).collect();
    for _ in 0..9 {
        let request = lab.request(&mut samples).unwrap();
        lab.answer(Ok(crate::plan::Reply::Words(vec![7; super::lab::elements(&request).len()])), None, &mut samples);
    }
    assert!(samples.is_empty(), "all are held");
    assert!(lab.device.remove(ids[0], lab.now));
    assert!(lab.request(&mut samples).is_some());
    lab.answer(Ok(crate::plan::Reply::Words(vec![7])), None, &mut samples);
    assert!(lab.request(&mut samples).is_none());
    let mut seen: Vec<_> = samples.iter().map(|sample| sample.id).collect();
    seen.sort_unstable();
    assert_eq!(seen, ids[1..]);
}
