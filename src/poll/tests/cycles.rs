use std::sync::Arc;
use std::time::Duration;

use super::lab::{Lab, ms, tags};
use crate::plan::{CostModel, Limits};
use crate::poll::device::Device;
use crate::poll::known::Polled;
use crate::poll::{PollError, PollTag, ScanClass};
use crate::wire::Framing;

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

#[test]
fn tags_of_a_class_are_read_together_on_its_grid() {
    let mut lab = Lab::new(1);
    let ids = lab.add(every(100), &["R0", "R1:i16", "R2:f32", "M5"]);
    lab.run(ms(1000));
    let cycles: Vec<Duration> = lab.plc.asked.iter().map(|(at, _)| *at - lab.start).collect();
    assert_eq!(cycles, (0..=10).map(|n| ms(100 * n)).collect::<Vec<_>>());
    assert_eq!(lab.news().len(), 11 * ids.len());
    for id in ids {
        assert!(lab.latest(id).is_good());
        assert_eq!(lab.latest(id).at.instant, lab.start + ms(1005), "the time of the reply");
    }
}

#[test]
fn a_random_phase_is_somewhere_in_the_period_and_stays_there() {
    let mut phases: Vec<Duration> = Vec::new();
    for seed in 0..50 {
        let mut lab = Lab::new(seed);
        lab.add(ScanClass::every(ms(100)), &["R0"]);
        lab.run(ms(1000));
        let at: Vec<Duration> = lab.plc.asked.iter().map(|(at, _)| *at - lab.start).collect();
        assert!(at[0] < ms(100), "seed {seed}: {at:?}");
        assert!(at.windows(2).all(|pair| pair[1] - pair[0] == ms(100)), "seed {seed}: {at:?}");
        phases.push(at[0]);
    }
    let early = phases.iter().filter(|phase| **phase < ms(50)).count();
    assert!((10..40).contains(&early), "{early} of 50 in the first half");
}

#[test]
fn an_overrun_is_skipped_and_counted() {
    let mut lab = Lab::new(1);
    lab.plc.latency = ms(250);
    lab.add(every(100), &["R0"]);
    lab.run(ms(2900));
    let at: Vec<Duration> = lab.plc.asked.iter().map(|(at, _)| *at - lab.start).collect();
    assert_eq!(at, (0..10).map(|n| ms(300 * n)).collect::<Vec<_>>(), "on the grid, none queued");
    let stats = lab.device.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.overruns), (10, 20));
}

#[test]
fn times_at_which_nothing_ran_here_are_overruns_too() {
    let mut lab = Lab::new(1);
    lab.add(every(100), &["R0"]);
    lab.run(ms(50));
    lab.now += ms(1000); // the machine was asleep
    lab.run(ms(170));
    let at: Vec<Duration> = lab.plc.asked.iter().map(|(at, _)| *at - lab.start).collect();
    assert_eq!(at, [ms(0), ms(1050), ms(1100), ms(1200)]);
    let stats = lab.device.classes().next().unwrap();
    assert_eq!((stats.cycles, stats.overruns), (4, 9));
}

#[test]
fn a_fast_class_comes_between_the_requests_of_a_slow_one() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.latency = ms(20);
    let slow: Vec<String> = (0..40).map(|n| format!("R{}", n * 100)).collect();
    let slow: Vec<&str> = slow.iter().map(String::as_str).collect();
    lab.add(every(2000), &slow);
    let fast = lab.add(every(100), &["D7"]);
    lab.run(ms(2000));
    let reads: Vec<Duration> =
        lab.samples.iter().filter(|s| s.id == fast[0]).map(|s| s.at.instant - lab.start).collect();
    assert!(reads.len() >= 20, "{reads:?}");
    // It waits for the request on the wire, and no longer.
    assert!(reads.windows(2).all(|pair| pair[1] - pair[0] <= ms(120)), "{reads:?}");
    let stats: Vec<_> = lab.device.classes().collect();
    assert_eq!((stats[0].overruns, stats[1].overruns), (0, 0));
}

#[test]
fn a_slow_class_gets_its_turn_beside_a_fast_one_that_has_no_time_to_spare() {
    let mut lab = Lab::new(1);
    lab.plc.latency = ms(30);
    lab.add(every(20), &["D7"]);
    let slow = lab.add(every(500), &["R0", "R500:f32", "M3"]);
    lab.run(ms(3000));
    let reads = lab.samples.iter().filter(|s| s.id == slow[0]).count();
    assert!((5..=7).contains(&reads), "{reads} readings in six periods");
}

#[test]
fn tags_come_and_go_while_it_runs() {
    let mut lab = Lab::new(1);
    let first = lab.add(every(100), &["R0"]);
    lab.run(ms(250));
    let second = lab.add(every(100), &["R1", "D0"]);
    lab.news();
    lab.run(ms(100));
    assert_eq!(lab.news().len(), 3);
    assert!(lab.device.remove(first[0], lab.now));
    assert!(!lab.device.remove(first[0], lab.now));
    lab.run(ms(100));
    let ids: Vec<_> = lab.news().iter().map(|sample| sample.id).collect();
    assert_eq!(ids, second);
    assert!(second.iter().all(|id| lab.device.remove(*id, lab.now)));
    lab.asked();
    lab.run(ms(1000));
    assert_eq!(lab.asked().len(), 0);
    assert_eq!(lab.news().len(), 0);
    assert_eq!(lab.device.classes().count(), 0);
    assert_eq!(lab.device.counters().cycles, 5);
}

#[test]
fn a_tag_removed_while_its_request_is_on_its_way_has_no_sample() {
    use crate::plan::Reply;
    use crate::poll::device::Step;
    let mut lab = Lab::new(1);
    let ids = lab.add(every(100), &["R0", "R1"]);
    let mut samples = Vec::new();
    assert!(matches!(lab.device.next(lab.stamp(), &mut samples), Step::Read(_)));
    lab.device.remove(ids[0], lab.now);
    lab.answer(Ok(Reply::Words(vec![7, 8])), None, &mut samples);
    let ids_seen: Vec<_> = samples.iter().map(|sample| sample.id).collect();
    assert_eq!(ids_seen, [ids[1]]);
}

#[test]
fn bad_tags_and_classes_are_refused_whole() {
    let mut lab = Lab::new(1);
    let add = |lab: &mut Lab, class, tags, one_scan| lab.try_add(class, tags, one_scan).map(|_| ());
    assert!(matches!(add(&mut lab, every(0), tags(&["R0"]), false), Err(PollError::Period { .. })));
    let days = ScanClass::every(Duration::from_secs(86_401));
    assert!(matches!(add(&mut lab, days, tags(&["R0"]), false), Err(PollError::Period { .. })));
    for deadband in [f64::NAN, -1.0, f64::INFINITY] {
        let tag = PollTag::new("level", "R0".parse().unwrap()).deadband(deadband);
        let error = add(&mut lab, every(100), vec![tag], false).unwrap_err();
        assert!(matches!(error, PollError::Deadband { .. }) && error.to_string().contains("level"), "{error}");
    }
    let on_a_bit = PollTag::new("pump", "M0".parse().unwrap()).deadband(1.0);
    assert!(matches!(add(&mut lab, every(100), vec![on_a_bit], false), Err(PollError::Deadband { .. })));
    assert_eq!(add(&mut lab, every(100), Vec::new(), true), Err(PollError::NoTags));
    let too_many = tags(&["R0-R63", "M0"]);
    assert!(matches!(add(&mut lab, every(100), too_many, true), Err(PollError::Plan(_))));
    assert_eq!(lab.device.classes().count(), 0, "nothing of it was added");
}

#[test]
fn tags_of_one_scan_are_read_in_one_request() {
    let mut lab = Lab::new(1);
    let texts: Vec<String> = (0..80).map(|n| format!("R{}", n * 2)).collect();
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    lab.add(every(100), &texts);
    let group = lab.try_add(every(100), tags(&["R0", "D99", "M7", "R200:f32"]), true).unwrap();
    lab.run(ms(2000));
    for n in 0..10 {
        let of = |id| lab.samples.iter().filter(|s| s.id == id).nth(n).unwrap().at.instant;
        assert!(group.iter().all(|id| of(*id) == of(group[0])), "reading {n}");
    }
}

#[test]
fn a_longer_round_trip_makes_fewer_requests() {
    let mut lab = Lab::new(1);
    let cost = CostModel::network(Framing::Ascii, ms(5)).with_byte_time(ms(1));
    let polled = Polled { station: 1, retries: 2 };
    let limits = Arc::new(Limits::new().no_mixed_reads());
    lab.device = Device::new(polled, (limits, cost), lab.start, 1, Arc::default());
    let requests = |lab: &Lab| lab.device.classes().next().unwrap().requests_per_cycle;
    // The bytes of the reply are no latency.
    lab.plc.latency = ms(20);
    lab.add(every(2000), &["R0", "R30", "R60", "R100", "R130"]);
    lab.run(ms(10_000));
    assert_eq!(requests(&lab), 5);
    lab.plc.latency = ms(600);
    lab.run(ms(120_000));
    assert_eq!(requests(&lab), 2);
    lab.plc.latency = ms(20);
    lab.run(ms(100_000));
    assert_eq!(requests(&lab), 5);
}
