use std::time::Duration;

use super::lab::{Lab, ms};
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
        _ => "another",
    };
    samples.iter().map(kind).collect()
}

#[test]
fn an_error_is_never_a_zero() {
    let mut lab = Lab::new(1);
    lab.plc.silent = true;
    let ids = lab.add(every(100), &["R0", "M0"]);
    assert_eq!(kinds(&[lab.latest(ids[0])]), ["bad: not yet read"]);
    assert_eq!(lab.latest(ids[0]).value(), None);
    lab.run(ms(350));
    let news = lab.news();
    assert_eq!(kinds(&news), ["bad: failed"; 2]);
    assert!(news.iter().all(|sample| sample.values().is_empty()));
    assert!(matches!(news[0].quality.reason(), Some(Reason::Failed(e)) if matches!(**e, Error::Timeout { .. })));
}

#[test]
fn a_value_goes_stale_with_the_first_failure_and_bad_when_it_is_too_old() {
    let mut lab = Lab::new(1);
    let class = every(1000).bad_after(ms(3000));
    let id = lab.try_add(class, vec![PollTag::new("level", "R0".parse().unwrap()).on_change()], false).unwrap()[0];
    lab.run(ms(500));
    let good = lab.news();
    assert_eq!(kinds(&good), ["good"]);
    lab.plc.silent = true;
    lab.run(ms(5000));
    let news = lab.news();
    assert_eq!(kinds(&news), ["stale: failed", "bad: failed"]);
    assert_eq!(news[0].values(), good[0].values(), "the last good value");
    assert_eq!(news[0].at, good[0].at, "and its time");
    assert_eq!(news[1].values(), []);
    assert!(news[1].at.instant >= good[0].at.instant + ms(3000));
    assert!(news[1].at.instant <= good[0].at.instant + ms(3010), "on time, though nothing came");
    lab.plc.silent = false;
    lab.run(ms(1000));
    assert_eq!(kinds(&lab.news()), ["good"]);
    assert!(lab.latest(id).is_good());
}

#[test]
fn a_value_is_overdue_while_the_answer_takes_long() {
    let mut lab = Lab::new(1);
    let tag = PollTag::new("level", "R0".parse().unwrap()).on_change();
    lab.try_add(every(100).stale_after(ms(250)).bad_after(ms(600)), vec![tag], false).unwrap();
    lab.run(ms(50));
    lab.news();
    lab.plc.latency = ms(2000);
    lab.run(ms(500));
    let news = lab.news();
    assert_eq!(kinds(&news), ["stale: overdue", "bad: overdue", "good"]);
    assert_eq!(news[1].at.instant - lab.start, ms(605));
}

#[test]
fn on_change_is_by_value_and_quality() {
    let mut lab = Lab::new(1);
    lab.plc.timeout = ms(50);
    lab.plc.frozen = true;
    let tag = PollTag::new("level", "R0-R9".parse().unwrap()).on_change();
    lab.try_add(every(100), vec![tag], false).unwrap();
    lab.run(ms(2000));
    assert_eq!(kinds(&lab.news()), ["good"]);
    lab.plc.silent = true;
    lab.run(ms(300));
    lab.plc.silent = false;
    lab.run(ms(2000));
    assert_eq!(kinds(&lab.news()), ["stale: failed", "good"], "the same value, and good again");
    lab.plc.frozen = false;
    lab.run(ms(950));
    assert!(kinds(&lab.news()).len() >= 9);
}

#[test]
fn a_heartbeat_repeats_what_has_not_changed() {
    let mut lab = Lab::new(1);
    lab.plc.timeout = ms(50);
    lab.plc.frozen = true;
    let tag = PollTag::new("level", "R0".parse().unwrap()).heartbeat(ms(1000));
    lab.try_add(every(100), vec![tag], false).unwrap();
    lab.run(ms(5050));
    let at: Vec<Duration> = lab.news().iter().map(|sample| sample.at.instant - lab.start).collect();
    assert_eq!(at, [5, 1005, 2005, 3005, 4005, 5005].map(ms));
    lab.plc.silent = true;
    lab.run(ms(3000));
    assert_eq!(kinds(&lab.news()), ["stale: failed", "bad: failed", "bad: failed", "bad: failed"]);
}

#[test]
fn a_deadband_is_measured_from_the_last_sample() {
    use crate::poll::Stamp;
    use crate::poll::point::Point;
    use crate::tag::TagValue;
    let at = Stamp::now();
    let tag = PollTag::new("level", "R0:f32".parse().unwrap()).deadband(1.0);
    let mut point = Point::new(crate::poll::TagId(1), tag, None, at);
    let mut samples = Vec::new();
    let drift = [10.0, 10.5, 11.0, 11.25, 12.0, 12.25, 12.5, f32::NAN, f32::NAN, 12.5, f32::INFINITY, f32::INFINITY];
    for value in drift {
        point.read(vec![TagValue::F32(value)], at, &mut samples);
    }
    let told: Vec<String> = samples.iter().map(|sample| sample.value().unwrap().to_string()).collect();
    assert_eq!(told, ["10.0", "11.25", "12.5", "NaN", "12.5", "inf"]);
}
