//! Duplicates out of order: see [`Job`](crate::link::job::Job).

use std::time::Duration;

use super::rig::{TestRig, ms, value};
use crate::element::Register;
use crate::error::Error;
use crate::plan::Limits;
use crate::poll::{Quality, Reason, ScanClass};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

/// Ten registers read by ten requests whose replies have one shape.
fn rig() -> TestRig {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.one_shape = true;
    let texts: Vec<String> = (0..10).map(|n| format!("R{}", 100 * n)).collect();
    rig.add(every(1000), &texts.iter().map(String::as_str).collect::<Vec<_>>());
    rig
}

/// Counts good samples whose value the PLC did not hold at the time of the reply.
fn wrong(rig: &mut TestRig) -> usize {
    let samples = rig.new_samples();
    let is_wrong = |sample: &&crate::poll::Sample| {
        let address: u16 = sample.name[1..].parse().unwrap();
        let epoch = rig.plc.epochs[&sample.at.instant];
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

/// Without the check at the end of a cycle, no duplicate at its last request was detected. The test
/// of the same name in `tests/poll.rs` has the figures.
#[test]
fn no_sample_is_a_roaming_duplicate() {
    let mut sum = 0;
    for at in 1..=40 {
        let mut rig = rig();
        rig.plc.roams_at = Some(at);
        rig.run(ms(9500));
        assert_eq!((rig.plc.roamed, rig.repeated), (1, 1), "request {at}");
        sum += wrong(&mut rig);
        let stats = rig.poller.classes().next().unwrap();
        assert_eq!((stats.cycles, stats.abandoned), (10, 0));
    }
    assert_eq!(sum, 0);
}

#[test]
fn a_cycle_of_equal_shapes_costs_one_check() {
    let mut rig = rig();
    rig.run(ms(9500));
    assert_eq!((rig.plc.requests.len(), rig.plc.checks), (100, 10));
    assert_eq!(rig.new_samples().len(), 100);
}

#[test]
fn a_cycle_of_one_request_costs_no_check() {
    let mut rig = TestRig::new(1);
    rig.plc.one_shape = true;
    rig.add(every(1000), &["R0", "R1"]);
    rig.run(ms(9500));
    assert_eq!((rig.plc.requests.len(), rig.plc.checks), (10, 0));
}

#[test]
fn a_cycle_is_abandoned_when_duplicates_do_not_end() {
    let mut rig = rig();
    let end = rig.start + ms(900);
    while rig.now < end && rig.step(end) {
        rig.plc.stray_due = true;
    }
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.abandoned, rig.repeated), (1, 1, 3));
    let samples = rig.new_samples();
    assert_eq!(samples.len(), 10);
    for sample in samples {
        let Quality::Bad(Reason::Failed(error)) = &sample.quality else { panic!("{sample:?}") };
        assert!(matches!(**error, Error::Duplicates { station: 1, .. }), "{error}");
    }
    // The next cycle is good again.
    rig.run(ms(2000));
    assert!(rig.new_samples().iter().all(crate::poll::Sample::is_good));
}

#[test]
fn values_before_a_missing_reply_are_reported() {
    let mut rig = rig();
    // Read by the last request.
    rig.plc.ignored = Some((crate::element::Symbol::R, 0));
    rig.run(ms(900));
    let (good, other): (Vec<_>, Vec<_>) = rig.new_samples().into_iter().partition(crate::poll::Sample::is_good);
    assert_eq!((good.len(), other.len(), rig.plc.checks), (9, 1, 1));
    assert!(good.iter().all(|sample| sample.at.instant < rig.start + ms(100)), "the time of the reply");
}

#[test]
fn a_refusal_is_confirmed_before_a_tag_is_at_fault() {
    let mut rig = TestRig::new(1);
    let ids = rig.add(every(1000), &["R0"]);
    let mut samples = Vec::new();
    assert!(rig.request(&mut samples).is_some());
    // A duplicate of an older refusal: the true reply comes as a stray.
    rig.answer(Err(super::regressions::refusal()), None, &mut samples);
    rig.plc.stray_due = true;
    assert!(rig.request(&mut samples).is_some(), "the request is sent again");
    rig.answer(Ok(crate::plan::Reply::Words(vec![7])), None, &mut samples);
    assert!(rig.latest(ids[0]).is_good());
    assert_eq!(samples.len(), 1);
}

#[test]
fn a_tag_removed_while_its_value_is_held_has_no_sample() {
    let mut rig = rig();
    let mut samples = Vec::new();
    let ids: Vec<_> = (1..=10).map(crate::poll::TagId).collect();
    for _ in 0..9 {
        let request = rig.request(&mut samples).unwrap();
        rig.answer(Ok(crate::plan::Reply::Words(vec![7; super::rig::elements(&request).len()])), None, &mut samples);
    }
    assert!(samples.is_empty(), "all values are held");
    assert!(rig.poller.remove(ids[0], rig.now));
    assert!(rig.request(&mut samples).is_some());
    rig.answer(Ok(crate::plan::Reply::Words(vec![7])), None, &mut samples);
    assert!(rig.request(&mut samples).is_none());
    let mut seen: Vec<_> = samples.iter().map(|sample| sample.id).collect();
    seen.sort_unstable();
    assert_eq!(seen, ids[1..]);
}
