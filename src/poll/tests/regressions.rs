//! Regressions of the poller.

use std::time::Duration;

use super::rig::{TestRig, ms, tags};
use crate::command::Code;
use crate::element::Symbol;
use crate::error::{Error, ErrorCode};
use crate::plan::{Limits, ReadRequest, Reply};
use crate::poll::station_poller::PollStep;
use crate::poll::{Quality, Reason, Sample, ScanClass, TagId};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

fn add(rig: &mut TestRig, class: ScanClass, texts: &[String]) -> Vec<TagId> {
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    rig.add(class, &texts)
}

pub(super) fn refusal() -> Error {
    Error::Plc { station: 1, code: Code::ReadRegisters, error: ErrorCode::IllegalAddress, repeated: false }
}

/// With a period longer than the probe interval, the second refused tag was never probed.
#[test]
fn every_refused_tag_is_probed() {
    let mut rig = TestRig::new(1);
    rig.plc.refused.extend([1, 2].map(|a| (Symbol::R, a)));
    let ids = rig.add(every(120_000), &["R0", "R1", "R2", "R3"]); // `probe_refused` is a minute by default
    rig.run(Duration::from_secs(600));
    rig.plc.refused.remove(&(Symbol::R, 2)); // R1 stays refused
    rig.run(Duration::from_secs(24 * 3600));
    assert!(rig.latest(ids[2]).is_good(), "R2 has been readable for a day and is {}", rig.latest(ids[2]).quality);
}

#[test]
fn every_refused_tag_is_probed_with_a_period_of_a_second() {
    let mut rig = TestRig::new(1);
    let texts: Vec<String> = (0..100).map(|n| format!("R{n}")).collect();
    rig.plc.refused.extend((0..100).map(|a| (Symbol::R, a)));
    let ids = add(&mut rig, every(1000), &texts);
    rig.run(Duration::from_secs(60));
    rig.plc.refused.remove(&(Symbol::R, 90));
    rig.run(Duration::from_secs(400));
    assert!(rig.latest(ids[90]).is_good(), "{}", rig.latest(ids[90]).quality);
}

/// A probe without a reply was always the next one due.
#[test]
fn a_probe_without_a_reply_does_not_starve_the_others() {
    let mut rig = TestRig::new(1);
    rig.plc.refused.extend([1, 2].map(|a| (Symbol::R, a)));
    let ids = rig.add(every(1000).probe_refused(ms(10_000)), &["R0", "R1", "R2", "R3"]);
    rig.run(ms(5500));
    rig.plc.ignored = Some((Symbol::R, 1));
    rig.plc.refused.clear();
    rig.run(ms(100_000));
    assert!(rig.latest(ids[2]).is_good(), "{}", rig.latest(ids[2]).quality);
}

/// Values stayed good in a first cycle that took longer than `stale_after`.
#[test]
fn a_value_goes_stale_in_a_long_first_cycle() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.response_time = ms(200);
    let texts: Vec<String> = (0..40).map(|n| format!("R{}", n * 95)).collect();
    let ids = add(&mut rig, every(100), &texts);
    let mut worst = Duration::ZERO;
    for _ in 0..30 {
        rig.run(ms(200));
        for id in &ids {
            let sample = rig.latest(*id);
            if sample.is_good() {
                worst = worst.max(rig.now - sample.at.instant);
            }
        }
    }
    assert!(worst <= ms(500), "good at an age of {worst:?}, and stale_after is 300 ms");
}

#[test]
fn a_value_goes_stale_in_a_first_cycle_without_replies() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.timeout = Duration::from_secs(20);
    rig.plc.ignored = Some((Symbol::R, 1000));
    let ids = rig.add(every(1000), &["R1000", "R0"]);
    let mut samples = Vec::new();
    // The first request has its reply, the second one is in flight.
    let PollStep::Read(_) = rig.poller.next_step(rig.stamp(), &mut samples) else { panic!() };
    rig.now += ms(5);
    rig.answer(Ok(Reply::Words(vec![7])), None, &mut samples);
    let PollStep::Read(_) = rig.poller.next_step(rig.stamp(), &mut samples) else { panic!() };
    rig.now += ms(20_000);
    rig.poller.age(rig.stamp(), &mut samples);
    assert!(!rig.latest(ids[0]).is_good(), "good at an age of 20 s, and stale_after is 3 s");
}

/// The refusal of another request made a one-scan group bad for ten minutes.
#[test]
fn one_transient_refusal_does_not_make_a_group_bad() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    let group: Vec<String> = (0..40).map(|n| format!("D{n}")).collect();
    let group: Vec<&str> = group.iter().map(String::as_str).collect();
    let group = rig.try_add(every(1000), tags(&group), true).unwrap();
    let texts: Vec<String> = (0..64).map(|n| format!("R{n}")).collect();
    let ids = add(&mut rig, every(1000), &texts);
    rig.run(ms(10_500));
    assert!(group.iter().chain(&ids).all(|id| rig.latest(*id).is_good()));
    // The PLC refuses one request of 64 registers R and accepts the next.
    let mut samples = Vec::new();
    loop {
        match rig.poller.next_step(rig.stamp(), &mut samples) {
            PollStep::Wait(until) => rig.now = until.unwrap(),
            PollStep::Confirm => rig.confirm(&mut samples),
            PollStep::Read(request) => {
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
                rig.now += ms(5);
                rig.answer(result, None, &mut samples);
                if is {
                    break;
                }
            }
        }
    }
    let mut bad = Duration::ZERO;
    for _ in 0..1000 {
        rig.run(ms(1000));
        if matches!(rig.latest(group[0]).quality, Quality::Bad(_)) {
            bad += ms(1000);
        }
    }
    assert!(bad < ms(5000), "the group was readable all the time and bad for {bad:?}");
}

/// A refusal of six requests within a plan must not raise the requests per cycle afterwards.
#[test]
fn a_short_refusal_of_all_leaves_no_learned_limit() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    let texts: Vec<String> = (0..640).map(|n| format!("R{n}")).collect();
    add(&mut rig, every(1000), &texts);
    rig.run(ms(10_500));
    let before = rig.poller.classes().next().unwrap().requests_per_cycle;
    rig.plc.refuses_all = true;
    // Six requests are refused.
    let n = rig.plc.requests.len();
    while rig.plc.requests.len() < n + 6 {
        rig.step(rig.now + ms(2000));
    }
    rig.plc.refuses_all = false;
    rig.run(ms(3000));
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!(stats.requests_per_cycle, before);
}

/// Bounds the requests for long tags on addresses that the PLC does not have.
#[test]
fn a_long_refused_tag_is_not_halved_to_single_registers() {
    for (texts, most) in
        [(&["R0-R2999"][..], 150), (&["R0-R999", "R0-R999:i16"], 150), (&["R0-R999", "R500-R1499:i16"], 150)]
    {
        let mut rig = TestRig::new(1);
        rig.plc.refused.extend((500..3840).map(|address| (Symbol::R, address)));
        rig.add(every(1000), texts);
        let other = rig.add(every(1000), &["D7"]);
        rig.run(ms(900));
        let first = rig.take_requests().len();
        assert!(first <= most, "{texts:?}: {first} requests at first");
        assert!(rig.latest(other[0]).is_good());
        rig.run(Duration::from_secs(600));
        let later = rig.take_requests().len();
        assert!(later <= 600 + 30 * most, "{texts:?}: {later} requests in ten minutes");
    }
}

/// The others of a group were read by separate requests after the removal.
#[test]
fn a_group_stays_one_scan_when_a_tag_is_removed() {
    let mut rig = TestRig::new(1);
    let group = rig.try_add(every(1000), tags(&["R0", "R1", "R2"]), true).unwrap();
    let mut samples = Vec::new();
    let PollStep::Read(_) = rig.poller.next_step(rig.stamp(), &mut samples) else { panic!() };
    rig.poller.remove(group[1], rig.now);
    rig.now += ms(5);
    rig.answer(Err(refusal()), None, &mut samples);
    let mut n = 0;
    while let Some(request) = rig.request(&mut samples) {
        rig.now += ms(5);
        n += 1;
        rig.answer(Ok(Reply::Words(vec![n; super::rig::elements(&request).len()])), None, &mut samples);
    }
    assert_eq!(rig.latest(group[0]).at, rig.latest(group[2]).at);
}

/// The refused tag is removed while the poller halves its request.
#[test]
fn removing_the_refused_tag_while_halving_learns_nothing() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.refused.insert((Symbol::R, 0));
    let texts: Vec<String> = (0..64).map(|n| format!("R{n}")).collect();
    let ids = add(&mut rig, every(1000), &texts);
    for _ in 0..3 {
        rig.step(rig.now + ms(1));
    }
    rig.poller.remove(ids[0], rig.now);
    rig.run(ms(5000));
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!(stats.requests_per_cycle, 1);
}

/// While one half had no reply, the other half was never read.
#[test]
fn a_silent_half_does_not_starve_the_other() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    let ids = rig.add(every(1000), &["R0", "R1", "R2", "R3"]);
    let mut samples = Vec::new();
    let end = rig.now + Duration::from_secs(100);
    while rig.now < end {
        match rig.poller.next_step(rig.stamp(), &mut samples) {
            PollStep::Wait(until) => rig.now = until.unwrap(),
            PollStep::Confirm => rig.confirm(&mut samples),
            PollStep::Read(request) => {
                let cells: Vec<u16> = super::rig::elements(&request).iter().map(|e| e.address()).collect();
                let result = if cells.contains(&3) {
                    Err(refusal())
                } else if cells.contains(&0) {
                    rig.now += ms(300);
                    Err(Error::timeout(1, Code::ReadRegisters, ms(300), true))
                } else {
                    Ok(Reply::Words(vec![1; cells.len()]))
                };
                rig.now += ms(5);
                rig.answer(result, None, &mut samples);
            }
        }
    }
    let good = |id| samples.iter().filter(|sample: &&Sample| sample.id == id && sample.is_good()).count();
    assert!(good(ids[2]) > 0, "the other half is read");
    assert!(matches!(rig.latest(ids[3]).quality, Quality::Bad(Reason::Refused(_))), "the refused tag is found");
}

/// The others of the group waited for their next probe.
#[test]
fn a_refused_group_is_probed_when_its_bad_tag_is_removed() {
    let mut rig = TestRig::new(1);
    rig.plc.refused.insert((Symbol::D, 5));
    let group = rig.try_add(every(1000), tags(&["R0", "D5", "M7"]), true).unwrap();
    rig.run(ms(2500));
    rig.poller.remove(group[1], rig.now);
    rig.run(ms(5000));
    assert!(rig.latest(group[0]).is_good());
}

/// The PLC refuses runs across a boundary between two kinds of registers, here R49 and R50.
#[test]
fn a_boundary_is_learned_as_a_split_not_as_a_length() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    let texts: Vec<String> = (0..640).map(|n| format!("R{n}")).collect();
    add(&mut rig, every(1000), &texts);
    let long = rig.add(every(1000), &["R40-R60:i16"]);
    let mut samples = Vec::new();
    let end = rig.now + Duration::from_secs(30);
    let mut refusals = 0;
    while rig.now < end {
        match rig.poller.next_step(rig.stamp(), &mut samples) {
            PollStep::Wait(until) => rig.now = until.unwrap(),
            PollStep::Confirm => rig.confirm(&mut samples),
            PollStep::Read(request) => {
                let cells: Vec<u16> = super::rig::elements(&request).iter().map(|e| e.address()).collect();
                let result = if cells.contains(&49) && cells.contains(&50) {
                    refusals += 1;
                    Err(refusal())
                } else {
                    Ok(Reply::Words(vec![1; cells.len()]))
                };
                rig.now += ms(1);
                rig.answer(result, None, &mut samples);
            }
        }
    }
    assert!(refusals <= 20, "{refusals} refusals in 30 s");
    assert!(rig.poller.classes().next().unwrap().requests_per_cycle <= 12);
    assert!(rig.latest(long[0]).is_good());
}
