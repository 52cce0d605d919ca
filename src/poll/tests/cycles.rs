use std::sync::Arc;
use std::time::Duration;

use super::rig::{TestRig, line, ms, tags};
use crate::plan::{CostModel, Limits};
use crate::poll::context::StationParams;
use crate::poll::station_poller::StationPoller;
use crate::poll::{PollError, PollTag, ScanClass};
use crate::wire::Framing;

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

#[test]
fn tags_of_a_class_are_read_together_when_due() {
    let mut rig = TestRig::new(1);
    let ids = rig.add(every(100), &["R0", "R1:i16", "R2:f32", "M5"]);
    rig.run(ms(1000));
    let cycles: Vec<Duration> = rig.plc.requests.iter().map(|(at, _)| *at - rig.start).collect();
    assert_eq!(cycles, (0..=10).map(|n| ms(100 * n)).collect::<Vec<_>>());
    assert_eq!(rig.new_samples().len(), 11 * ids.len());
    for id in ids {
        assert!(rig.latest(id).is_good());
        assert_eq!(rig.latest(id).at.instant, rig.start + ms(1005), "the time of the reply");
    }
}

#[test]
fn a_random_phase_is_within_the_period_and_constant() {
    let mut phases: Vec<Duration> = Vec::new();
    for seed in 0..50 {
        let mut rig = TestRig::new(seed);
        rig.add(ScanClass::every(ms(100)), &["R0"]);
        rig.run(ms(1000));
        let at: Vec<Duration> = rig.plc.requests.iter().map(|(at, _)| *at - rig.start).collect();
        assert!(at[0] <= ms(10) && at[1] < ms(120), "seed {seed}: the first reading does not wait: {at:?}");
        let constant = &at[usize::from(at[1] - at[0] != ms(100))..];
        assert!(constant.windows(2).all(|pair| pair[1] - pair[0] == ms(100)), "seed {seed}: {at:?}");
        phases.push(constant[0]);
    }
    let early = phases.iter().filter(|phase| **phase < ms(50)).count();
    assert!((10..40).contains(&early), "{early} of 50 in the first half");
}

#[test]
fn an_overrun_is_skipped_and_counted() {
    let mut rig = TestRig::new(1);
    rig.plc.response_time = ms(250);
    rig.add(every(100), &["R0"]);
    rig.run(ms(2900));
    let at: Vec<Duration> = rig.plc.requests.iter().map(|(at, _)| *at - rig.start).collect();
    assert_eq!(at, (0..10).map(|n| ms(300 * n)).collect::<Vec<_>>(), "at due times, none queued");
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.overruns), (10, 20));
}

#[test]
fn cycles_missed_by_a_suspended_task_are_overruns() {
    let mut rig = TestRig::new(1);
    rig.add(every(100), &["R0"]);
    rig.run(ms(50));
    rig.now += ms(1000); // the task is not scheduled
    rig.run(ms(170));
    let at: Vec<Duration> = rig.plc.requests.iter().map(|(at, _)| *at - rig.start).collect();
    assert_eq!(at, [ms(0), ms(1050), ms(1100), ms(1200)]);
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.overruns), (4, 9));
}

#[test]
fn a_fast_class_runs_between_requests_of_a_slow_one() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.response_time = ms(20);
    let slow: Vec<String> = (0..40).map(|n| format!("R{}", n * 100)).collect();
    let slow: Vec<&str> = slow.iter().map(String::as_str).collect();
    rig.add(every(2000), &slow);
    let fast = rig.add(every(100), &["D7"]);
    rig.run(ms(2000));
    let reads: Vec<Duration> =
        rig.samples.iter().filter(|s| s.id == fast[0]).map(|s| s.at.instant - rig.start).collect();
    assert!(reads.len() >= 20, "{reads:?}");
    // It waits for the request in flight only.
    assert!(reads.windows(2).all(|pair| pair[1] - pair[0] <= ms(120)), "{reads:?}");
    let stats: Vec<_> = rig.poller.classes().collect();
    assert_eq!((stats[0].overruns, stats[1].overruns), (0, 0));
}

#[test]
fn a_saturating_fast_class_does_not_starve_a_slow_one() {
    let mut rig = TestRig::new(1);
    rig.plc.response_time = ms(30);
    rig.add(every(20), &["D7"]);
    let slow = rig.add(every(500), &["R0", "R500:f32", "M3"]);
    rig.run(ms(3000));
    let reads = rig.samples.iter().filter(|s| s.id == slow[0]).count();
    assert!((5..=7).contains(&reads), "{reads} reads in six periods");
}

#[test]
fn tags_are_added_and_removed_while_polling() {
    let mut rig = TestRig::new(1);
    let first = rig.add(every(100), &["R0"]);
    rig.run(ms(250));
    let second = rig.add(every(100), &["R1", "D0"]);
    rig.new_samples();
    rig.run(ms(100));
    assert_eq!(rig.new_samples().len(), 3);
    assert!(rig.poller.remove(first[0], rig.now));
    assert!(!rig.poller.remove(first[0], rig.now));
    rig.run(ms(100));
    let ids: Vec<_> = rig.new_samples().iter().map(|sample| sample.id).collect();
    assert_eq!(ids, second);
    assert!(second.iter().all(|id| rig.poller.remove(*id, rig.now)));
    rig.take_requests();
    rig.run(ms(1000));
    assert_eq!(rig.take_requests().len(), 0);
    assert_eq!(rig.new_samples().len(), 0);
    assert_eq!(rig.poller.classes().count(), 0);
    assert_eq!(rig.poller.counters().cycles, 5);
}

#[test]
fn a_tag_removed_with_a_request_in_flight_has_no_sample() {
    use crate::plan::Reply;
    use crate::poll::station_poller::PollStep;
    let mut rig = TestRig::new(1);
    let ids = rig.add(every(100), &["R0", "R1"]);
    let mut samples = Vec::new();
    assert!(matches!(rig.poller.next_step(rig.stamp(), &mut samples), PollStep::Read(_)));
    rig.poller.remove(ids[0], rig.now);
    rig.answer(Ok(Reply::Words(vec![7, 8])), None, &mut samples);
    let ids_seen: Vec<_> = samples.iter().map(|sample| sample.id).collect();
    assert_eq!(ids_seen, [ids[1]]);
}

#[test]
fn invalid_tags_and_classes_add_nothing() {
    let mut rig = TestRig::new(1);
    let add = |rig: &mut TestRig, class, tags, one_scan| rig.try_add(class, tags, one_scan).map(|_| ());
    assert!(matches!(add(&mut rig, every(0), tags(&["R0"]), false), Err(PollError::Period { .. })));
    let days = ScanClass::every(Duration::from_secs(86_401));
    assert!(matches!(add(&mut rig, days, tags(&["R0"]), false), Err(PollError::Period { .. })));
    for deadband in [f64::NAN, -1.0, f64::INFINITY] {
        let tag = PollTag::new("level", "R0".parse().unwrap()).deadband(deadband);
        let error = add(&mut rig, every(100), vec![tag], false).unwrap_err();
        assert!(matches!(error, PollError::Deadband { .. }) && error.to_string().contains("level"), "{error}");
    }
    let on_a_bit = PollTag::new("pump", "M0".parse().unwrap()).deadband(1.0);
    assert!(matches!(add(&mut rig, every(100), vec![on_a_bit], false), Err(PollError::Deadband { .. })));
    assert_eq!(add(&mut rig, every(100), Vec::new(), true), Err(PollError::NoTags));
    let too_many = tags(&["R0-R63", "M0"]);
    assert!(matches!(add(&mut rig, every(100), too_many, true), Err(PollError::Plan(_))));
    assert_eq!(rig.poller.classes().count(), 0, "nothing was added");
}

#[test]
fn tags_of_one_scan_are_read_in_one_request() {
    let mut rig = TestRig::new(1);
    let texts: Vec<String> = (0..80).map(|n| format!("R{}", n * 2)).collect();
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    rig.add(every(100), &texts);
    let group = rig.try_add(every(100), tags(&["R0", "D99", "M7", "R200:f32"]), true).unwrap();
    rig.run(ms(2000));
    for n in 0..10 {
        let of = |id| rig.samples.iter().filter(|s| s.id == id).nth(n).unwrap().at.instant;
        assert!(group.iter().all(|id| of(*id) == of(group[0])), "cycle {n}");
    }
}

#[test]
fn a_longer_response_time_makes_fewer_requests() {
    let mut rig = TestRig::new(1);
    let cost = CostModel::network(Framing::Ascii, ms(5)).with_byte_time(ms(1));
    let polled = StationParams { station: 1, retries: 2 };
    let limits = Arc::new(Limits::new().mixed_reads(false));
    rig.poller = StationPoller::new(polled, (limits, cost), line(rig.start), 1, Arc::default());
    let requests = |rig: &TestRig| rig.poller.classes().next().unwrap().requests_per_cycle;
    // The time of the reply's bytes does not count as response time.
    rig.plc.response_time = ms(20);
    rig.add(every(2000), &["R0", "R30", "R60", "R100", "R130"]);
    rig.run(ms(10_000));
    assert_eq!(requests(&rig), 5);
    rig.plc.response_time = ms(600);
    rig.run(ms(120_000));
    assert_eq!(requests(&rig), 2);
    rig.plc.response_time = ms(20);
    rig.run(ms(100_000));
    assert_eq!(requests(&rig), 5);
}

#[test]
fn samples_of_a_reading_name_its_cycle_also_if_it_fails() {
    let mut rig = TestRig::new(1);
    rig.plc.refused.insert((crate::element::Symbol::R, 900));
    let ids = rig.add(every(1000), &["R0", "M5", "R900"]);
    assert_eq!(rig.latest(ids[0]).cycle, 0, "before the first cycle");
    rig.run(ms(1900));
    rig.plc.silent = true;
    rig.run(ms(1000));
    rig.plc.silent = false;
    rig.run(ms(1000));
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.completed, stats.abandoned), (4, 4, 1));
    let samples = rig.new_samples();
    for id in ids {
        let mut cycles: Vec<u64> = samples.iter().filter(|sample| sample.id == id).map(|sample| sample.cycle).collect();
        // Age may report a value again, as of the cycle that has read it.
        cycles.dedup();
        assert_eq!(cycles, [1, 2, 3, 4]);
    }
    assert!(samples.iter().filter(|sample| sample.cycle == 3).all(|sample| !sample.is_good()), "the silent one");
}
