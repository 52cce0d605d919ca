//! What was wrong once.

use std::time::Duration;

use super::lab::{Lab, ms, tags};
use crate::command::Code;
use crate::element::Symbol;
use crate::error::{Error, ErrorCode};
use crate::plan::{Limits, ReadRequest, Reply};
use crate::poll::device::Step;
use crate::poll::{Quality, Reason, Sample, ScanClass, TagId};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

fn add(lab: &mut Lab, class: ScanClass, texts: &[String]) -> Vec<TagId> {
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    lab.add(class, &texts)
}

pub(super) fn refusal() -> Error {
    Error::Plc { station: 1, code: Code::ReadRegisters, error: ErrorCode::IllegalAddress, repeated: false }
}

/// Two refused tags in a class whose period is the probe interval: the second one is never probed again.
#[test]
fn every_refused_tag_is_probed() {
    let mut lab = Lab::new(1);
    lab.plc.refused.extend([1, 2].map(|a| (Symbol::R, a)));
    let ids = lab.add(every(120_000), &["R0", "R1", "R2", "R3"]); // probe_refused: a minute, the default
    lab.run(Duration::from_secs(600));
    lab.plc.refused.remove(&(Symbol::R, 2)); // R1 stays wrong
    lab.run(Duration::from_secs(24 * 3600));
    assert!(lab.latest(ids[2]).is_good(), "R2 can be read for a day, and is {}", lab.latest(ids[2]).quality);
}

#[test]
fn every_refused_tag_is_probed_at_one_second() {
    let mut lab = Lab::new(1);
    let texts: Vec<String> = (0..100).map(|n| format!("R{n}")).collect();
    lab.plc.refused.extend((0..100).map(|a| (Symbol::R, a)));
    let ids = add(&mut lab, every(1000), &texts);
    lab.run(Duration::from_secs(60));
    lab.plc.refused.remove(&(Symbol::R, 90));
    lab.run(Duration::from_secs(400));
    assert!(lab.latest(ids[90]).is_good(), "{}", lab.latest(ids[90]).quality);
}

/// A probe that gets no answer is first in the row for ever.
#[test]
fn a_probe_without_an_answer_does_not_keep_the_others_from_theirs() {
    let mut lab = Lab::new(1);
    lab.plc.refused.extend([1, 2].map(|a| (Symbol::R, a)));
    let ids = lab.add(every(1000).probe_refused(ms(10_000)), &["R0", "R1", "R2", "R3"]);
    lab.run(ms(5500));
    lab.plc.silent_about = Some((Symbol::R, 1));
    lab.plc.refused.clear();
    lab.run(ms(100_000));
    assert!(lab.latest(ids[2]).is_good(), "{}", lab.latest(ids[2]).quality);
}

/// First cycle longer than stale_after.
#[test]
fn a_value_goes_stale_in_a_long_first_cycle() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.latency = ms(200);
    let texts: Vec<String> = (0..40).map(|n| format!("R{}", n * 95)).collect();
    let ids = add(&mut lab, every(100), &texts);
    let mut worst = Duration::ZERO;
    for _ in 0..30 {
        lab.run(ms(200));
        for id in &ids {
            let sample = lab.latest(*id);
            if sample.is_good() {
                worst = worst.max(lab.now - sample.at.instant);
            }
        }
    }
    assert!(worst <= ms(500), "good at an age of {worst:?}, stale_after is 300 ms");
}

#[test]
fn a_value_goes_stale_when_the_plc_falls_silent_in_the_first_cycle() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.timeout = Duration::from_secs(20);
    lab.plc.silent_about = Some((Symbol::R, 1000));
    let ids = lab.add(every(1000), &["R1000", "R0"]);
    let mut samples = Vec::new();
    // First request R0 answered, then the second is on its way.
    let Step::Read(_) = lab.device.next(lab.stamp(), &mut samples) else { panic!() };
    lab.now += ms(5);
    lab.answer(Ok(Reply::Words(vec![7])), None, &mut samples);
    let Step::Read(_) = lab.device.next(lab.stamp(), &mut samples) else { panic!() };
    lab.now += ms(20_000);
    lab.device.age(lab.stamp(), &mut samples);
    assert!(!lab.latest(ids[0]).is_good(), "20 s old and good, stale_after 3 s");
}

/// One refusal of something else, and a one-scan group is bad for ten minutes.
#[test]
fn one_transient_refusal_does_not_make_a_group_bad() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    let group: Vec<String> = (0..40).map(|n| format!("D{n}")).collect();
    let group: Vec<&str> = group.iter().map(String::as_str).collect();
    let group = lab.try_add(every(1000), tags(&group), true).unwrap();
    let texts: Vec<String> = (0..64).map(|n| format!("R{n}")).collect();
    let ids = add(&mut lab, every(1000), &texts);
    lab.run(ms(10_500));
    assert!(group.iter().chain(&ids).all(|id| lab.latest(*id).is_good()));
    // A refusal of one request, of 64 registers R; the next is taken.
    let mut samples = Vec::new();
    loop {
        match lab.device.next(lab.stamp(), &mut samples) {
            Step::Wait(until) => lab.now = until.unwrap(),
            Step::Confirm => lab.confirm(&mut samples),
            Step::Read(request) => {
                let is = matches!(&*request, ReadRequest::Registers(r) if r.count() == 64);
                let result = if is {
                    Err(Error::Plc {
                        station: 1,
                        code: Code::ReadRegisters,
                        error: ErrorCode::IllegalFormat,
                        repeated: false,
                    })
                } else {
                    let n = match &*request {
                        ReadRequest::Registers(r) => r.count(),
                        _ => panic!(),
                    };
                    Ok(Reply::Words(vec![1; n]))
                };
                lab.now += ms(5);
                lab.answer(result, None, &mut samples);
                if is {
                    break;
                }
            }
        }
    }
    let mut bad = Duration::ZERO;
    for _ in 0..1000 {
        lab.run(ms(1000));
        if matches!(lab.latest(group[0]).quality, Quality::Bad(_)) {
            bad += ms(1000);
        }
    }
    assert!(bad < ms(5000), "the group could be read all the time and was bad for {bad:?}");
}

/// A refusal of all for 30 ms in the middle of a plan: how many requests a cycle after it.
#[test]
fn a_short_refusal_of_all_teaches_nothing_for_long() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    let texts: Vec<String> = (0..640).map(|n| format!("R{n}")).collect();
    add(&mut lab, every(1000), &texts);
    lab.run(ms(10_500));
    let before = lab.device.classes().next().unwrap().requests_per_cycle;
    lab.plc.refuses_all = true;
    // 6 requests are refused
    let n = lab.plc.asked.len();
    while lab.plc.asked.len() < n + 6 {
        lab.step(lab.now + ms(2000));
    }
    lab.plc.refuses_all = false;
    lab.run(ms(3000));
    let stats = lab.device.classes().next().unwrap();
    assert_eq!(stats.requests_per_cycle, before);
}

/// A long tag on addresses that the PLC does not have: how many requests.
#[test]
fn a_long_refused_tag_is_not_taken_apart_to_the_last_register() {
    for (texts, most) in
        [(&["R0-R2999"][..], 150), (&["R0-R999", "R0-R999:i16"], 150), (&["R0-R999", "R500-R1499:i16"], 150)]
    {
        let mut lab = Lab::new(1);
        lab.plc.refused.extend((500..3840).map(|address| (Symbol::R, address)));
        lab.add(every(1000), texts);
        let other = lab.add(every(1000), &["D7"]);
        lab.run(ms(900));
        let first = lab.asked().len();
        assert!(first <= most, "{texts:?}: {first} requests at first");
        assert!(lab.latest(other[0]).is_good());
        lab.run(Duration::from_secs(600));
        let later = lab.asked().len();
        assert!(later <= 600 + 30 * most, "{texts:?}: {later} requests in ten minutes");
    }
}

/// A tag of a group removed while the group is taken apart.
#[test]
fn a_group_stays_one_scan_when_a_tag_of_it_is_removed_in_the_middle() {
    let mut lab = Lab::new(1);
    let group = lab.try_add(every(1000), tags(&["R0", "R1", "R2"]), true).unwrap();
    let mut samples = Vec::new();
    let Step::Read(_) = lab.device.next(lab.stamp(), &mut samples) else { panic!() };
    lab.device.remove(group[1], lab.now);
    lab.now += ms(5);
    lab.answer(Err(refusal()), None, &mut samples);
    let mut n = 0;
    while let Some(request) = lab.request(&mut samples) {
        lab.now += ms(5);
        n += 1;
        lab.answer(Ok(Reply::Words(vec![n; super::lab::elements(&request).len()])), None, &mut samples);
    }
    assert_eq!(lab.latest(group[0]).at, lab.latest(group[2]).at);
}

/// A refused tag removed in the middle of the isolation.
#[test]
fn removing_the_culprit_in_the_middle_teaches_nothing() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.refused.insert((Symbol::R, 0));
    let texts: Vec<String> = (0..64).map(|n| format!("R{n}")).collect();
    let ids = add(&mut lab, every(1000), &texts);
    for _ in 0..3 {
        lab.step(lab.now + ms(1));
    }
    lab.device.remove(ids[0], lab.now);
    lab.run(ms(5000));
    let stats = lab.device.classes().next().unwrap();
    assert_eq!(stats.requests_per_cycle, 1);
}

/// Isolation in which one half is never answered: the other half is never read.
#[test]
fn a_silent_half_does_not_starve_the_other() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    let ids = lab.add(every(1000), &["R0", "R1", "R2", "R3"]);
    let mut samples = Vec::new();
    let end = lab.now + Duration::from_secs(100);
    while lab.now < end {
        match lab.device.next(lab.stamp(), &mut samples) {
            Step::Wait(until) => lab.now = until.unwrap(),
            Step::Confirm => lab.confirm(&mut samples),
            Step::Read(request) => {
                let cells: Vec<u16> = super::lab::elements(&request).iter().map(|e| e.address()).collect();
                let result = if cells.contains(&3) {
                    Err(refusal())
                } else if cells.contains(&0) {
                    lab.now += ms(300);
                    Err(Error::Timeout { station: 1, code: Code::ReadRegisters, after: ms(300), sent: true })
                } else {
                    Ok(Reply::Words(vec![1; cells.len()]))
                };
                lab.now += ms(5);
                lab.answer(result, None, &mut samples);
            }
        }
    }
    let good = |id| samples.iter().filter(|sample: &&Sample| sample.id == id && sample.is_good()).count();
    assert!(good(ids[2]) > 0, "the other half had its turn");
    assert!(matches!(lab.latest(ids[3]).quality, Quality::Bad(Reason::Refused(_))), "and what is at fault is known");
}

#[test]
fn a_class_with_reason_never_moves() {
    let _ = (Reason::Overdue, Quality::Good);
}

/// A group that fails to be planned: removed faulty member; the others wait for the probe.
#[test]
fn a_refused_group_is_tried_again_when_its_bad_tag_is_removed() {
    let mut lab = Lab::new(1);
    lab.plc.refused.insert((Symbol::D, 5));
    let group = lab.try_add(every(1000), tags(&["R0", "D5", "M7"]), true).unwrap();
    lab.run(ms(2500));
    lab.device.remove(group[1], lab.now);
    lab.run(ms(5000));
    assert!(lab.latest(group[0]).is_good());
}

/// A PLC that refuses runs across a boundary between two kinds of registers.
#[test]
fn a_boundary_is_not_a_length() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    let texts: Vec<String> = (0..640).map(|n| format!("R{n}")).collect();
    add(&mut lab, every(1000), &texts);
    let long = lab.add(every(1000), &["R40-R60:i16"]);
    let mut samples = Vec::new();
    let end = lab.now + Duration::from_secs(30);
    let mut refusals = 0;
    while lab.now < end {
        match lab.device.next(lab.stamp(), &mut samples) {
            Step::Wait(until) => lab.now = until.unwrap(),
            Step::Confirm => lab.confirm(&mut samples),
            Step::Read(request) => {
                let cells: Vec<u16> = super::lab::elements(&request).iter().map(|e| e.address()).collect();
                let result = if cells.contains(&49) && cells.contains(&50) {
                    refusals += 1;
                    Err(refusal())
                } else {
                    Ok(Reply::Words(vec![1; cells.len()]))
                };
                lab.now += ms(1);
                lab.answer(result, None, &mut samples);
            }
        }
    }
    assert!(refusals <= 20, "{refusals} refusals in 30 s");
    assert!(lab.device.classes().next().unwrap().requests_per_cycle <= 12);
    assert!(lab.latest(long[0]).is_good());
}
