use std::time::Duration;

use super::*;
use crate::command::{
    ControlDiscrete, ControlPlc, DiscreteControl, LoopBack, ReadDisabled, ReadDiscretes, ReadMixed, ReadProgramPage,
    ReadRegisters, Value, WriteDiscretes, WriteMixed, WriteRegisters,
};
use crate::{discrete, element, register, register32};

#[test]
fn a_rule_without_a_scope_always_applies() {
    let mut rule = Rule::new(Fault::DropReply);
    assert_eq!(results(&mut rule, 5), [true; 5]);
    assert_eq!(rule.times_applied(), 5);
}

#[test]
fn skip_and_times_limit_a_rule() {
    let mut rule = Rule::new(Fault::DropReply).skip(2).times(3);
    assert_eq!(results(&mut rule, 7), [false, false, true, true, true, false, false]);
    assert_eq!(rule.times_applied(), 3);
    assert_eq!(results(&mut rule.with_counts_reset(), 3), [false, false, true]);
    assert_eq!(results(&mut Rule::new(Fault::DropReply).times(0), 2), [false; 2]);
}

#[test]
fn only_requests_in_the_scope_are_counted() {
    let mut rule = Rule::new(Fault::DropReply).station(1).skip(1);
    let mut rng = FaultRng::new(0, 0, 0);
    let other = Subject { station: Some(2), ..subject() };
    assert!(!rule.matches(&other, &mut rng));
    assert!(!rule.matches(&subject(), &mut rng), "skipped: the first request to station 1");
    assert!(!rule.matches(&other, &mut rng));
    assert!(rule.matches(&subject(), &mut rng));
}

#[test]
fn chances_match_their_settings() {
    let applied = |rule: Rule| {
        let mut rule = rule;
        results(&mut rule, 20_000);
        rule.times_applied()
    };
    let rule = || Rule::new(Fault::DropReply);
    assert!((900..=1100).contains(&applied(rule().per_mille(50))));
    assert!((1850..=2150).contains(&applied(rule().one_in(10))));
    assert_eq!(applied(rule().one_in(1)), 20_000);
    assert_eq!(applied(rule().per_mille(1000)), 20_000);
    assert_eq!(applied(rule().per_mille(u16::MAX)), 20_000);
    assert_eq!(applied(rule().per_mille(0)), 0);
    assert_eq!(applied(rule().one_in(0)), 0);
}

#[test]
fn a_rule_matches_the_command_of_the_frame() {
    let rule = Rule::new(Fault::DropReply).command(Code::WriteRegisters);
    assert!(rule.has_in_scope(&Subject { command: Some(Code::WriteRegisters), request: None, ..subject() }));
    assert!(!rule.has_in_scope(&Subject { command: Some(Code::ReadRegisters), ..subject() }));
    assert!(!rule.has_in_scope(&Subject { command: None, ..subject() }));
}

#[test]
fn a_rule_matches_an_element_by_any_symbol() {
    let r100 = Rule::new(Fault::DropReply).element(element!("R100"));
    let m8 = Rule::new(Fault::DropReply).elements(discrete!("M8"), 8); // M8 to M15
    for (request, in_r100, in_m8) in [
        (Request::ReadRegisters(ReadRegisters::new(register!("R100"), 1).unwrap()), true, false),
        (Request::ReadRegisters(ReadRegisters::new(register!("R90"), 11).unwrap()), true, false),
        (Request::ReadRegisters(ReadRegisters::new(register!("R90"), 10).unwrap()), false, false),
        (Request::ReadRegisters(ReadRegisters::new(register!("D100"), 1).unwrap()), false, false),
        (Request::ReadRegisters32(ReadRegisters::new(register32!("DR99"), 1).unwrap()), true, false),
        (Request::ReadRegisters32(ReadRegisters::new(register32!("DR90"), 5).unwrap()), false, false),
        (Request::WriteRegisters(WriteRegisters::new(register!("R99"), [1, 2]).unwrap()), true, false),
        (Request::WriteRegisters32(WriteRegisters::new(register32!("DR101"), [1]).unwrap()), false, false),
        (Request::ReadRegisters(ReadRegisters::new(register!("WM0"), 1).unwrap()), false, true),
        (Request::ReadRegisters(ReadRegisters::new(register!("WM16"), 1).unwrap()), false, false),
        (Request::ReadDiscretes(ReadDiscretes::new(discrete!("M0"), 9).unwrap()), false, true),
        (Request::ReadDiscretes(ReadDiscretes::new(discrete!("M0"), 8).unwrap()), false, false),
        (Request::ReadDisabled(ReadDisabled::new(discrete!("M15"), 1).unwrap()), false, true),
        (Request::WriteDiscretes(WriteDiscretes::new(discrete!("Y8"), [true; 8]).unwrap()), false, false),
        (Request::ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, discrete!("M9"))), false, true),
        (Request::ReadMixed(ReadMixed::new([element!("X0"), element!("DR99")]).unwrap()), true, false),
        (
            Request::WriteMixed(
                WriteMixed::new([(element!("R100"), Value::Word(1)), (element!("WM8"), Value::Word(1))]).unwrap(),
            ),
            true,
            true,
        ),
        (Request::ControlPlc(ControlPlc::Run), false, false),
        (Request::LoopBack(LoopBack::new("R00100").unwrap()), false, false),
        (Request::ReadProgramPage(ReadProgramPage::new(100)), false, false),
    ] {
        let subject = Subject { request: Some(&request), ..subject() };
        assert_eq!((r100.has_in_scope(&subject), m8.has_in_scope(&subject)), (in_r100, in_m8), "{request:?}");
    }
    assert!(!r100.has_in_scope(&subject()), "an unreadable request accesses no element");
}

#[test]
fn an_element_range_can_be_empty_or_reach_the_end() {
    let last = Request::ReadRegisters(ReadRegisters::new(register!("R65535"), 1).unwrap());
    let subject = Subject { request: Some(&last), ..subject() };
    for count in [1, 2, usize::MAX] {
        assert!(Rule::new(Fault::DropReply).elements(register!("R65535"), count).has_in_scope(&subject));
    }
    assert!(Rule::new(Fault::DropReply).elements(register32!("DR65534"), 1).has_in_scope(&subject));
    assert!(!Rule::new(Fault::DropReply).elements(register!("R65535"), 0).has_in_scope(&subject));
    assert!(!Rule::new(Fault::DropReply).elements(register!("R0"), 65_535).has_in_scope(&subject));
}

#[test]
fn each_fault_applies_to_its_targets_only() {
    let targets_of = |fault: Fault| {
        let targets = [
            FaultTarget::Station,
            FaultTarget::AbsentStation,
            FaultTarget::Broadcast,
            FaultTarget::BroadcastListener,
            FaultTarget::Connection,
        ];
        targets.map(|target| fault.applies_to(target))
    };
    let time = Duration::ZERO;
    assert_eq!(targets_of(Fault::Echo), [true, true, true, false, false]);
    assert_eq!(targets_of(Fault::Disconnect(crate::sim::DisconnectAt::BeforeReply)), [true, true, true, false, false]);
    assert_eq!(targets_of(Fault::Ignore), [true, false, true, false, false]);
    assert_eq!(targets_of(Fault::BadChecksum), [true, false, false, false, false]);
    assert_eq!(targets_of(Fault::duplicate()), [true, false, false, false, false]);
    assert_eq!(targets_of(Fault::LeftOver { min: time, max: time }), [true, false, false, false, false]);
    let answer = Fault::AnswerBroadcast { station: None, min: time, max: time, error: None };
    assert_eq!(targets_of(answer), [false, false, false, true, false]);
    assert_eq!(targets_of(Fault::Refuse), [false, false, false, false, true]);
}

fn results(rule: &mut Rule, requests: u64) -> Vec<bool> {
    (0..requests).map(|nth| rule.matches(&subject(), &mut FaultRng::new(7, 1, nth))).collect()
}

fn subject() -> Subject<'static> {
    Subject { target: FaultTarget::Station, station: Some(1), command: Some(Code::ReadStatus), request: None }
}
