use std::time::Duration;

use super::lab::{Lab, ms, tags};
use crate::element::Symbol;
use crate::error::ErrorCode;
use crate::plan::{Limits, ReadRequest};
use crate::poll::{Quality, Reason, ScanClass, TagId};

fn every(milliseconds: u64) -> ScanClass {
    ScanClass::every(ms(milliseconds)).phase(Duration::ZERO)
}

fn registers(count: usize, step: usize) -> Vec<String> {
    (0..count).map(|n| format!("R{}", n * step)).collect()
}

fn add(lab: &mut Lab, class: ScanClass, texts: &[String]) -> Vec<TagId> {
    let texts: Vec<&str> = texts.iter().map(String::as_str).collect();
    lab.add(class, &texts)
}

fn is_refused(lab: &mut Lab, id: TagId) -> bool {
    matches!(lab.latest(id).quality, Quality::Bad(Reason::Refused(ErrorCode::IllegalAddress)))
}

#[test]
fn a_refused_address_is_found_and_its_neighbours_go_on() {
    for wrong in 0..64_u16 {
        let mut lab = Lab::new(1);
        lab.plc.refused.insert((Symbol::R, wrong));
        let ids = add(&mut lab, every(1000), &registers(64, 1));
        lab.run(ms(500));
        let asked = lab.asked().len();
        assert!(asked <= 1 + 2 * 6, "R{wrong}: {asked} requests, 2 log2 n and 1 is enough");
        for (n, id) in ids.iter().enumerate() {
            let sample = lab.latest(*id);
            assert_eq!(sample.is_good(), n != usize::from(wrong), "R{n}: {}", sample.quality);
            assert_eq!(is_refused(&mut lab, *id), n == usize::from(wrong));
            assert_eq!(sample.values().is_empty(), n == usize::from(wrong));
        }
        // From then on, no request touches it, until it is probed.
        lab.run(ms(1000));
        for request in lab.asked() {
            assert!(!super::lab::elements(&request).iter().any(|e| e.address() == wrong), "R{wrong}: {request}");
        }
        assert_eq!(lab.device.classes().next().unwrap().refused_tags, 1);
    }
}

#[test]
fn a_gap_that_is_refused_is_read_through_no_more() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.refused.insert((Symbol::R, 5));
    let ids = lab.add(every(1000), &["R0", "R3", "R8", "R10"]);
    lab.run(ms(500));
    assert_eq!(lab.asked().len(), 4, "the whole, its halves, and the whole again");
    lab.run(ms(1000));
    let requests = lab.asked();
    assert_eq!(requests.len(), 2, "{requests:?}");
    assert!(ids.iter().all(|id| lab.latest(*id).is_good()));
    assert_eq!(lab.device.classes().next().unwrap().refusals, 2);
    // After a while it is tried again.
    lab.run(Duration::from_secs(601));
    assert_eq!(lab.device.classes().next().unwrap().refusals, 4);
}

#[test]
fn a_device_that_takes_less_is_asked_for_less() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.max_registers = 20;
    lab.plc.max_points = 100;
    let mut texts = registers(60, 1);
    texts.extend((0..200).map(|n| format!("M{n}")));
    let ids = add(&mut lab, every(1000), &texts);
    lab.run(ms(5500));
    lab.asked();
    lab.run(ms(1000));
    for request in lab.asked() {
        match request {
            ReadRequest::Registers(r) => assert!((15..=20).contains(&r.count()), "{}", r.count()),
            ReadRequest::Discretes(r) => assert!((50..=100).contains(&r.count()), "{}", r.count()),
            other => panic!("{other}"),
        }
    }
    assert!(ids.iter().all(|id| lab.latest(*id).is_good()));
}

#[test]
fn a_tag_longer_than_the_device_takes_is_read_in_parts() {
    let mut lab = Lab::new(1);
    lab.plc.max_registers = 10;
    let ids = lab.add(every(1000), &["R3-R181", "D0-D99:f32", "WM0-WM320"]);
    lab.plc.refused.insert((Symbol::F, 77));
    let refused = lab.add(every(1000), &["F0-F99"]);
    lab.run(ms(20_500));
    assert!(ids.iter().all(|id| lab.latest(*id).is_good()));
    assert!(is_refused(&mut lab, refused[0]), "one of its registers is refused, so all of it is");
}

#[test]
fn a_device_without_mixed_reads_is_found_out() {
    let mut lab = Lab::new(1);
    lab.plc.mixed = false;
    let ids = lab.add(every(1000), &["R0", "D100", "M7", "RT3", "RC9", "Y0", "R900:f32"]);
    lab.run(ms(10_500));
    lab.asked();
    lab.run(ms(1000));
    assert!(lab.asked().iter().all(|request| !matches!(request, ReadRequest::Mixed(_))));
    assert!(ids.iter().all(|id| lab.latest(*id).is_good()));
    assert_eq!(lab.device.classes().next().unwrap().refused_tags, 0);
}

#[test]
fn a_refused_tag_is_probed_now_and_then_and_comes_back_with_the_others() {
    let mut lab = Lab::new(1);
    lab.plc.refused.extend([10, 20, 30].map(|address| (Symbol::R, address)));
    let ids = add(&mut lab, every(1000).probe_refused(ms(10_000)), &registers(40, 1));
    lab.run(ms(9_500));
    assert_eq!(ids.iter().filter(|id| is_refused(&mut lab, **id)).count(), 3);
    let cycles = lab.device.classes().next().unwrap();
    lab.run(ms(30_000));
    let later = lab.device.classes().next().unwrap();
    let probes = later.refusals - cycles.refusals;
    assert!((6..=9).contains(&probes), "{probes} probes of three tags in 30 s");
    lab.plc.refused.clear();
    lab.run(ms(11_000));
    assert!(ids.iter().all(|id| lab.latest(*id).is_good()), "all at the first probe that is answered");
    lab.asked();
    lab.run(ms(1000));
    assert_eq!(lab.asked().len(), 1, "and in one request again");
}

#[test]
fn a_plc_that_refuses_all_for_a_while_is_back_with_the_first_probe() {
    let mut lab = Lab::new(1);
    let ids = add(&mut lab, every(1000).probe_refused(ms(10_000)), &registers(60, 1));
    lab.run(ms(1500));
    lab.plc.refuses_all = true;
    lab.asked();
    lab.run(ms(8000));
    assert!(ids.iter().all(|id| is_refused(&mut lab, *id)));
    assert!(lab.asked().len() <= 2 * 60, "each was tried once");
    lab.plc.refuses_all = false;
    lab.run(ms(4000));
    assert!(ids.iter().all(|id| lab.latest(*id).is_good()));
}

#[test]
fn a_refused_group_is_bad_as_a_whole_and_nobody_else() {
    let mut lab = Lab::new(1);
    lab.plc.refused.insert((Symbol::D, 5));
    let group = lab.try_add(every(1000), tags(&["R0", "D5", "M7"]), true).unwrap();
    let others = lab.add(every(1000), &["R0", "D4", "D6", "M7", "M8"]);
    lab.run(ms(2500));
    assert!(group.iter().all(|id| is_refused(&mut lab, *id)));
    assert!(others.iter().all(|id| lab.latest(*id).is_good()));
}

#[test]
fn one_request_that_is_never_answered_does_not_keep_the_others_from_theirs() {
    let mut lab = Lab::with_limits(1, Limits::new().no_mixed_reads());
    lab.plc.silent_about = Some((Symbol::R, 1000));
    let ids = lab.add(every(1000), &["R0", "R1000", "R2000", "R3000", "D0", "D1000"]);
    lab.run(ms(20_500));
    for (n, id) in ids.iter().enumerate() {
        let sample = lab.latest(*id);
        assert_eq!(sample.is_good(), n != 1, "tag {n}: {}", sample.quality);
    }
    let stats = lab.device.classes().next().unwrap();
    assert_eq!((stats.abandoned, stats.overruns), (stats.cycles, 0));
}
