use std::time::Duration;

use super::rig::{TestRig, ms, tags};
use crate::capabilities::Refused;
use crate::command::ReadMixed;
use crate::element::Symbol;
use crate::error::ErrorCode;
use crate::plan::{Limits, ReadRequest};
use crate::poll::learned_limit::{LearnedLimit, LearnedLimits, SplitPoint};
use crate::poll::{Quality, Reason, ScanClass, TagId};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

fn registers(count: usize, step: usize) -> Vec<String> {
    (0..count).map(|n| format!("R{}", n * step)).collect()
}

fn add(rig: &mut TestRig, class: ScanClass, texts: &[String]) -> Vec<TagId> {
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    rig.add(class, &texts)
}

fn is_refused(rig: &mut TestRig, id: TagId) -> bool {
    matches!(rig.latest(id).quality, Quality::Bad(Reason::Refused(ErrorCode::IllegalAddress)))
}

#[test]
fn a_refused_register_is_found_and_the_others_are_read() {
    for wrong in 0..64_u16 {
        let mut rig = TestRig::new(1);
        rig.plc.refused.insert((Symbol::R, wrong));
        let ids = add(&mut rig, every(1000), &registers(64, 1));
        rig.run(ms(500));
        let requests = rig.take_requests().len();
        assert!(requests <= 1 + 2 * 6, "R{wrong}: {requests} requests; 1 + 2 log2 n suffice");
        for (n, id) in ids.iter().enumerate() {
            let sample = rig.latest(*id);
            assert_eq!(sample.is_good(), n != usize::from(wrong), "R{n}: {}", sample.quality);
            assert_eq!(is_refused(&mut rig, *id), n == usize::from(wrong));
            assert_eq!(sample.values().is_empty(), n == usize::from(wrong));
        }
        // No request reads it until its probe.
        rig.run(ms(1000));
        for request in rig.take_requests() {
            assert!(!super::rig::elements(&request).iter().any(|e| e.address() == wrong), "R{wrong}: {request}");
        }
        assert_eq!(rig.poller.classes().next().unwrap().refused_tags, 1);
    }
}

#[test]
fn a_refused_gap_is_not_read_through_again() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.refused.insert((Symbol::R, 5));
    let ids = rig.add(every(1000), &["R0", "R3", "R8", "R10"]);
    rig.run(ms(500));
    assert_eq!(rig.take_requests().len(), 4, "the request, its halves, and the request again");
    rig.run(ms(1000));
    let requests = rig.take_requests();
    assert_eq!(requests.len(), 2, "{requests:?}");
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    assert_eq!(rig.poller.classes().next().unwrap().refusals, 2);
    // It is tried again after the lifetime of a learned limit.
    rig.run(Duration::from_secs(601));
    assert_eq!(rig.poller.classes().next().unwrap().refusals, 4);
}

#[test]
fn a_lower_length_limit_of_the_plc_is_learned() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false).words_of_discretes(false));
    rig.plc.max_registers = 20;
    rig.plc.max_points = 100;
    let mut texts = registers(60, 1);
    texts.extend((0..200).map(|n| format!("M{n}")));
    let ids = add(&mut rig, every(1000), &texts);
    rig.run(ms(5500));
    rig.take_requests();
    rig.run(ms(1000));
    let (mut registers, mut points) = (0, 0);
    for request in rig.take_requests() {
        match request {
            ReadRequest::Registers(r) => registers = r.count().max(registers),
            ReadRequest::Discretes(r) => points = r.count().max(points),
            other => panic!("{other}"),
        }
    }
    assert!((15..=20).contains(&registers) && (50..=100).contains(&points), "{registers}, {points}");
    let learned = rig.poller.take_learned();
    assert!(learned.contains(&Refused::Registers(registers)), "{learned:?}");
    assert!(learned.contains(&Refused::Points(points)), "{learned:?}");
    assert_eq!(rig.poller.take_learned(), []);
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
}

#[test]
fn a_tag_longer_than_the_limit_is_read_in_parts() {
    let mut rig = TestRig::new(1);
    rig.plc.max_registers = 10;
    let ids = rig.add(every(1000), &["R3-R181", "D0-D99:f32", "WM0-WM320"]);
    rig.plc.refused.insert((Symbol::F, 77));
    let refused = rig.add(every(1000), &["F0-F99"]);
    rig.run(ms(20_500));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    assert!(is_refused(&mut rig, refused[0]), "the tag is refused because one of its registers is");
}

#[test]
fn missing_mixed_reads_are_learned() {
    let mut rig = TestRig::new(1);
    rig.plc.mixed = false;
    let ids = rig.add(every(1000), &["R0", "D100", "M7", "RT3", "RC9", "Y0", "R900:f32"]);
    rig.run(ms(10_500));
    rig.take_requests();
    rig.run(ms(1000));
    assert!(rig.take_requests().iter().all(|request| !matches!(request, ReadRequest::Mixed(_))));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
    assert_eq!(rig.poller.take_learned(), [Refused::MixedReads]);
    assert_eq!(rig.poller.classes().next().unwrap().refused_tags, 0);
}

/// The poller does without mixed reads, although one was accepted before: other users of the station do not.
/// Before, the station was said to refuse the command.
#[test]
fn a_refusal_behind_an_accepted_mixed_read_is_not_one_of_the_command() {
    let mixed = |count: u16| {
        let elements = (0..count).map(|n| crate::element::Register::r(n * 10).into()).collect::<Vec<_>>();
        ReadRequest::Mixed(ReadMixed::new(elements).unwrap())
    };
    let split_point = SplitPoint { left_end: 1, right_start: 1, right_len: 1 };
    for (accepted, learned) in [(None, vec![Refused::MixedReads]), (Some(mixed(20)), vec![])] {
        let mut limits = LearnedLimits::default();
        if let Some(request) = &accepted {
            limits.record_accepted(request, crate::plan::WordAreas::default());
        }
        let limit = limits.explanation(&mixed(2), split_point).unwrap();
        assert_eq!(limit, LearnedLimit::Mixed(0));
        limits.learn(limit, tokio::time::Instant::now());
        assert_eq!(limits.take_new(), learned, "{accepted:?}");
        assert_eq!(limits.apply(&Limits::new()), Limits::new().mixed_reads(false));
    }
}

#[test]
fn an_accepted_probe_restores_all_refused_tags() {
    let mut rig = TestRig::new(1);
    rig.plc.refused.extend([10, 20, 30].map(|address| (Symbol::R, address)));
    let ids = add(&mut rig, every(1000).probe_refused(ms(10_000)), &registers(40, 1));
    rig.run(ms(9_500));
    assert_eq!(ids.iter().filter(|id| is_refused(&mut rig, **id)).count(), 3);
    let cycles = rig.poller.classes().next().unwrap();
    rig.run(ms(30_000));
    let later = rig.poller.classes().next().unwrap();
    let probes = later.refusals - cycles.refusals;
    assert!((6..=9).contains(&probes), "{probes} probes of three tags in 30 s");
    rig.plc.refused.clear();
    rig.run(ms(11_000));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()), "all are read after the first accepted probe");
    rig.take_requests();
    rig.run(ms(1000));
    assert_eq!(rig.take_requests().len(), 1, "in one request again");
}

#[test]
fn the_first_probe_ends_a_refusal_of_everything() {
    let mut rig = TestRig::new(1);
    let ids = add(&mut rig, every(1000).probe_refused(ms(10_000)), &registers(60, 1));
    rig.run(ms(1500));
    rig.plc.refuses_all = true;
    rig.take_requests();
    rig.run(ms(8000));
    assert!(ids.iter().all(|id| is_refused(&mut rig, *id)));
    assert!(rig.take_requests().len() <= 2 * 60, "each tag was tried once");
    rig.plc.refuses_all = false;
    rig.run(ms(4000));
    assert!(ids.iter().all(|id| rig.latest(*id).is_good()));
}

#[test]
fn a_refused_group_is_bad_and_other_tags_are_not() {
    let mut rig = TestRig::new(1);
    rig.plc.refused.insert((Symbol::D, 5));
    let group = rig.try_add(every(1000), tags(&["R0", "D5", "M7"]), true).unwrap();
    let others = rig.add(every(1000), &["R0", "D4", "D6", "M7", "M8"]);
    rig.run(ms(2500));
    assert!(group.iter().all(|id| is_refused(&mut rig, *id)));
    assert!(others.iter().all(|id| rig.latest(*id).is_good()));
}

#[test]
fn a_request_without_a_reply_does_not_starve_the_others() {
    let mut rig = TestRig::with_limits(1, Limits::new().mixed_reads(false));
    rig.plc.ignored = Some((Symbol::R, 1000));
    let ids = rig.add(every(1000), &["R0", "R1000", "R2000", "R3000", "D0", "D1000"]);
    rig.run(ms(20_500));
    for (n, id) in ids.iter().enumerate() {
        let sample = rig.latest(*id);
        assert_eq!(sample.is_good(), n != 1, "tag {n}: {}", sample.quality);
    }
    let stats = rig.poller.classes().next().unwrap();
    assert_eq!((stats.abandoned, stats.overruns), (stats.cycles, 0));
}
