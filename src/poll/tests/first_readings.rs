//! Readings of tags that have none yet: ahead of the due time of their class.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::rig::{TestRig, line, ms};
use crate::poll::ScanClass;
use crate::poll::schedule::{ClassSchedule, LineSchedule, PollerSchedule};

const HOUR: Duration = Duration::from_secs(3600);

/// Each waited for its phase: up to an hour.
#[test]
fn the_first_reading_of_an_hourly_class_is_at_once_and_that_of_a_later_tag_within_a_second() {
    let hourly = ScanClass::every(HOUR);
    let mut rig = TestRig::new(1);
    rig.add(hourly, &["R0"]);
    // Added by another call, and read together.
    rig.add(hourly, &["R100"]);
    rig.run(ms(300));
    assert_eq!(rig.plc.requests.len(), 1, "one cycle: {:?}", rig.plc.requests);
    let later = rig.add(hourly, &["R200"]);
    rig.run(ms(500));
    assert_eq!(rig.plc.requests.len(), 1, "no cycle before a second has passed");
    rig.run(ms(500));
    assert!(rig.latest(later[0]).is_good());
    let early = rig.plc.requests.len();
    rig.run(HOUR);
    assert!(rig.plc.requests.len() > early, "read by its phase, too");
    rig.run(ms(10));
    assert_eq!(rig.poller.classes().next().unwrap().cycles, 3);
}

#[test]
fn a_due_time_that_passes_in_the_first_reading_is_no_overrun() {
    for seed in 0..20 {
        let mut rig = TestRig::new(seed);
        rig.plc.response_time = ms(90);
        rig.add(ScanClass::every(ms(100)), &["R0"]);
        rig.run(ms(2000));
        let stats = rig.poller.classes().next().unwrap();
        assert_eq!(stats.overruns, 0, "seed {seed}");
        assert!(stats.cycles >= 19, "seed {seed}: {stats:?}");
    }
}

#[test]
fn first_readings_of_many_lines_are_spread() {
    let now = Instant::now();
    let poller = Arc::new(PollerSchedule::new(now));
    let reserve = |at| LineSchedule::new(poller.clone()).reserve(at, ms(5));
    let times: Vec<_> = (0..5001).map(|_| reserve(now)).collect();
    assert!(times[0] - now <= ms(10));
    assert_eq!(times[5000] - times[0], ms(1000));
    assert!(reserve(now + ms(5000)) - now <= ms(5010), "a pause is no debt");
}

/// Ten stations of a slow bus began their slow cycles at once: fast tags of each waited for a slow request of all.
#[test]
fn first_readings_of_one_line_leave_half_of_its_time() {
    let now = Instant::now();
    let line = line(now);
    let times: Vec<_> = (0..10).map(|_| line.reserve(now, ms(500)) - now).collect();
    assert!(times.windows(2).all(|pair| pair[1] - pair[0] == ms(1000)), "{times:?}");
}

/// The only reading of an hour had failed, and the next one came by the phase.
#[test]
fn a_first_reading_is_repeated_until_it_succeeds() {
    let mut rig = TestRig::new(1);
    rig.plc.silent = true;
    let ids = rig.add(ScanClass::every(HOUR), &["R0"]);
    rig.run(ms(20_000));
    rig.plc.silent = false;
    rig.run(ms(20_000));
    assert!(rig.latest(ids[0]).is_good());
    let attempts = rig.plc.requests.len();
    assert!((4..=8).contains(&attempts), "the pauses double: {attempts}");
    let read = rig.plc.requests.len();
    rig.run(HOUR / 100);
    assert_eq!(rig.plc.requests.len(), read, "no early reading without new tags");
}

#[test]
fn an_early_cycle_without_values_replaces_no_due_time() {
    let (now, class) = (Instant::now(), ScanClass::every(ms(10_000)));
    let line = line(now);
    let schedule = || {
        let mut schedule = ClassSchedule::new(now + ms(300));
        schedule.tags_added(&class, false, &line, now, ms(5));
        assert!(schedule.begin(&class, now + ms(100)).is_some());
        schedule
    };
    let mut complete = schedule();
    assert_eq!(complete.end(&class, now + ms(400), true), 0, "no overrun");
    assert_eq!(complete.next_due(), now + ms(10_300));
    let mut failed = schedule();
    assert_eq!(failed.end(&class, now + ms(400), false), 0, "no overrun");
    assert_eq!(failed.next_due(), now + ms(300));
    let due = failed.begin(&class, now + ms(400)).unwrap();
    assert_eq!((due.at, due.overruns), (now + ms(300), 0));
}

/// The due time after their addition was taken for theirs, and skipped since a cycle was running: they waited for 60 s.
#[test]
fn tags_that_are_added_in_a_cycle_which_overruns_are_read_within_a_second_of_it() {
    let (now, class) = (Instant::now(), ScanClass::every(ms(60_000)));
    let line = line(now);
    let mut schedule = ClassSchedule::new(now + ms(300));
    schedule.tags_added(&class, false, &line, now, ms(5));
    assert!(schedule.begin(&class, now + ms(100)).is_some());
    schedule.tags_added(&class, true, &line, now + ms(200), ms(5));
    schedule.end(&class, now + ms(400), true);
    assert_eq!(schedule.next_due(), now + ms(1100));
    assert!(schedule.begin(&class, now + ms(1100)).is_some());
    schedule.end(&class, now + ms(1200), false);
    assert_eq!(schedule.next_due(), now + ms(2200), "repeated: the tags are unread");
}
