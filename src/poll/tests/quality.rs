use std::time::Duration;

use super::rig::{TestRig, ms};
use crate::error::Error;
use crate::poll::{PollTag, Quality, Reason, Sample, ScanClass};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

fn kinds(samples: &[Sample]) -> Vec<&'static str> {
    let kind = |sample: &Sample| match &sample.quality {
        Quality::Good => "good",
        Quality::Stale(Reason::Failed(_)) => "stale: failed",
        Quality::Stale(Reason::Overdue) => "stale: overdue",
        Quality::Bad(Reason::Failed(_)) => "bad: failed",
        Quality::Bad(Reason::Overdue) => "bad: overdue",
        Quality::Bad(Reason::NotYetRead) => "bad: not yet read",
        Quality::Bad(Reason::Refused(_)) => "bad: refused",
        other @ (Quality::Stale(_) | Quality::Bad(Reason::NoPlan(_))) => panic!("{other}"),
    };
    samples.iter().map(kind).collect()
}

#[test]
fn a_failure_never_yields_a_value() {
    let mut rig = TestRig::new(1);
    rig.plc.silent = true;
    let ids = rig.add(every(100), &["R0", "M0"]);
    assert_eq!(kinds(&[rig.latest(ids[0])]), ["bad: not yet read"]);
    assert_eq!(rig.latest(ids[0]).value(), None);
    rig.run(ms(350));
    let samples = rig.new_samples();
    assert_eq!(kinds(&samples), ["bad: failed"; 2]);
    assert!(samples.iter().all(|sample| sample.values().is_empty()));
    assert!(matches!(samples[0].quality.reason(), Some(Reason::Failed(e)) if matches!(**e, Error::Timeout { .. })));
}

#[test]
fn a_value_is_stale_after_a_failure_and_bad_when_too_old() {
    let mut rig = TestRig::new(1);
    let class = every(1000).bad_after(ms(3000));
    let id = rig.try_add(class, vec![PollTag::new("level", "R0".parse().unwrap()).on_change(true)], false).unwrap()[0];
    rig.run(ms(500));
    let good = rig.new_samples();
    assert_eq!(kinds(&good), ["good"]);
    rig.plc.silent = true;
    rig.run(ms(5000));
    let samples = rig.new_samples();
    assert_eq!(kinds(&samples), ["stale: failed", "bad: failed"]);
    assert_eq!(samples[0].values(), good[0].values(), "the last good value");
    assert_eq!(samples[0].at, good[0].at, "and its time");
    assert_eq!(samples[1].values(), []);
    assert!(samples[1].at.instant >= good[0].at.instant + ms(3000));
    assert!(samples[1].at.instant <= good[0].at.instant + ms(3010), "on time without a reply");
    rig.plc.silent = false;
    rig.run(ms(1000));
    assert_eq!(kinds(&rig.new_samples()), ["good"]);
    assert!(rig.latest(id).is_good());
}

/// With the time of the last failure, a batch of stale values got a new time in each cycle.
#[test]
fn a_stale_sample_has_the_time_since_when_it_is_stale() {
    let mut rig = TestRig::new(1);
    rig.plc.timeout = ms(50);
    rig.add(every(100).stale_after(ms(1000)).bad_after(ms(60_000)), &["R0"]);
    rig.run(ms(50));
    let good = rig.new_samples();
    assert_eq!((kinds(&good), good[0].stale_since), (vec!["good"], None));
    rig.plc.silent = true;
    rig.run(ms(500));
    let stale = rig.new_samples();
    assert!(stale.len() >= 3 && kinds(&stale).iter().all(|kind| *kind == "stale: failed"), "{:?}", kinds(&stale));
    for sample in &stale {
        let since = sample.stale_since.expect("it is stale");
        assert_eq!(
            (since.instant - rig.start, sample.at),
            (ms(150), good[0].at),
            "the end of the first failed request"
        );
    }
    rig.plc.silent = false;
    rig.run(ms(1000));
    assert!(rig.new_samples().iter().all(|sample| sample.is_good() && sample.stale_since.is_none()));
}

#[test]
fn a_value_is_overdue_while_a_reply_takes_long() {
    let mut rig = TestRig::new(1);
    let tag = PollTag::new("level", "R0".parse().unwrap()).on_change(true);
    rig.try_add(every(100).stale_after(ms(250)).bad_after(ms(600)), vec![tag], false).unwrap();
    rig.run(ms(50));
    rig.new_samples();
    rig.plc.response_time = ms(2000);
    rig.run(ms(500));
    let samples = rig.new_samples();
    assert_eq!(kinds(&samples), ["stale: overdue", "bad: overdue", "good"]);
    assert_eq!(samples[1].at.instant - rig.start, ms(605));
    let since = samples.iter().map(|sample| sample.stale_since.map(|since| since.instant - rig.start));
    assert_eq!(since.collect::<Vec<_>>(), [Some(ms(255)), None, None]);
}

#[test]
fn on_change_reports_changes_of_value_and_quality() {
    let mut rig = TestRig::new(1);
    rig.plc.timeout = ms(50);
    rig.plc.frozen = true;
    let tag = PollTag::new("level", "R0-R9".parse().unwrap()).on_change(true);
    rig.try_add(every(100), vec![tag], false).unwrap();
    rig.run(ms(2000));
    assert_eq!(kinds(&rig.new_samples()), ["good"]);
    rig.plc.silent = true;
    rig.run(ms(300));
    rig.plc.silent = false;
    rig.run(ms(2000));
    assert_eq!(kinds(&rig.new_samples()), ["stale: failed", "good"], "the same value is good again");
    rig.plc.frozen = false;
    rig.run(ms(950));
    assert!(kinds(&rig.new_samples()).len() >= 9);
}

#[test]
fn a_heartbeat_repeats_an_unchanged_sample() {
    let mut rig = TestRig::new(1);
    rig.plc.timeout = ms(50);
    rig.plc.frozen = true;
    let tag = PollTag::new("level", "R0".parse().unwrap()).heartbeat(ms(1000));
    rig.try_add(every(100), vec![tag], false).unwrap();
    rig.run(ms(5050));
    let at: Vec<Duration> = rig.new_samples().iter().map(|sample| sample.at.instant - rig.start).collect();
    assert_eq!(at, [5, 1005, 2005, 3005, 4005, 5005].map(ms));
    rig.plc.silent = true;
    rig.run(ms(3000));
    assert_eq!(kinds(&rig.new_samples()), ["stale: failed", "bad: failed", "bad: failed", "bad: failed"]);
}

#[test]
fn a_report_of_all_tags_has_the_times_of_their_replies() {
    let mut rig = TestRig::new(1);
    rig.plc.timeout = ms(50);
    rig.plc.frozen = true;
    let on_change = |name: &str| PollTag::new(name, name.parse().unwrap()).on_change(true);
    // The slow class comes first by its ids.
    rig.try_add(every(10_000).stale_after(ms(60_000)), vec![on_change("R0")], false).unwrap();
    rig.try_add(every(1000).stale_after(ms(3000)).bad_after(ms(60_000)), vec![on_change("R5")], false).unwrap();
    let report = |rig: &mut TestRig| {
        let now = rig.stamp();
        rig.poller.report_all(now, &mut rig.samples);
        rig.new_samples().into_iter().map(|sample| (sample.name.to_string(), sample)).collect::<Vec<_>>()
    };
    let start = rig.start;
    let form = |samples: &[(String, Sample)]| -> Vec<(String, &str, Duration)> {
        let one = |(name, sample): &(String, Sample)| {
            (name.clone(), kinds(std::slice::from_ref(sample))[0], sample.at.instant - start)
        };
        samples.iter().map(one).collect()
    };
    assert_eq!(form(&report(&mut rig)), [], "nothing was read");
    rig.run(ms(4500));
    assert_eq!(rig.new_samples().len(), 2);
    // By the times of the replies, not of the report.
    let first = report(&mut rig);
    let slow = first[0].1.at.instant - rig.start;
    assert!(slow < ms(100), "{slow:?}");
    assert_eq!(form(&first), [("R0".into(), "good", slow), ("R5".into(), "good", ms(4005))]);
    rig.run(ms(2000));
    assert_eq!(rig.new_samples().len(), 0, "they are reported on change as before");
    // A stale tag has its last value with the time of that value, and comes last.
    rig.plc.silent = true;
    rig.run(ms(2000));
    assert_eq!(kinds(&rig.new_samples()), ["stale: failed"]);
    let second = report(&mut rig);
    assert_eq!(form(&second), [("R0".into(), "good", slow), ("R5".into(), "stale: failed", ms(6005))]);
    assert_eq!(second[1].1.values(), first[1].1.values());
}

#[test]
fn a_deadband_is_measured_from_the_last_sample() {
    use crate::poll::Stamp;
    use crate::poll::tag_state::TagState;
    use crate::tag::TagValue;
    let at = Stamp::now();
    let tag = PollTag::new("level", "R0:f32".parse().unwrap()).deadband(1.0);
    let mut state = TagState::new(crate::poll::TagId(1), tag, None, at);
    let mut samples = Vec::new();
    let drift = [10.0, 10.5, 11.0, 11.25, 12.0, 12.25, 12.5, f32::NAN, f32::NAN, 12.5, f32::INFINITY, f32::INFINITY];
    for value in drift {
        state.set_values(vec![TagValue::F32(value)], at, &mut samples);
    }
    let reported: Vec<String> = samples.iter().map(|sample| sample.value().unwrap().to_string()).collect();
    assert_eq!(reported, ["10.0", "11.25", "12.5", "NaN", "12.5", "inf"]);
}

/// Before: values were compared as `f64`, so a counter of 64 bits beyond 2^53 kept its old value, good
/// and with the time of the new one.
#[test]
fn each_number_of_64_bits_is_a_new_value() {
    use crate::poll::Stamp;
    use crate::poll::tag_state::TagState;
    use crate::tag::TagValue;
    let at = Stamp::now();
    let big = 1 << 53;
    for (on_change, deadband, expected) in [(false, 0.0, 5), (true, 0.0, 4), (true, 1.0, 2)] {
        let tag = PollTag::new("counter", "R0:u64".parse().unwrap()).on_change(on_change).deadband(deadband);
        let tag = if on_change { tag } else { PollTag::new("counter", "R0:u64".parse().unwrap()) };
        let mut state = TagState::new(crate::poll::TagId(1), tag, None, at);
        let mut samples = Vec::new();
        for value in [big, big + 1, big + 1, big + 2, big + 3] {
            state.set_values(vec![TagValue::U64(value)], at, &mut samples);
        }
        let reported: Vec<&TagValue> = samples.iter().filter_map(|sample| sample.value()).collect();
        assert_eq!(reported.len(), expected, "on change: {on_change}, deadband {deadband}: {reported:?}");
        let last = if deadband > 0.0 { big + 2 } else { big + 3 };
        assert_eq!(reported.last(), Some(&&TagValue::U64(last)));
    }
    let tag = PollTag::new("position", "R0:i64".parse().unwrap()).on_change(true);
    let mut state = TagState::new(crate::poll::TagId(1), tag, None, at);
    let mut samples = Vec::new();
    for value in [i64::MIN, i64::MIN + 1, i64::MAX - 1, i64::MAX, i64::MAX] {
        state.set_values(vec![TagValue::I64(value)], at, &mut samples);
    }
    assert_eq!(samples.len(), 4);
}
