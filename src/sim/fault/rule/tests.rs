use std::time::Duration;

use super::*;
use crate::command::{
    ControlDiscrete, ControlPlc, DiscreteControl, LoopBack, ReadDisabled, ReadDiscretes, ReadMixed, ReadProgramPage,
    ReadRegisters, Value, WriteDiscretes, WriteMixed, WriteRegisters,
};
use crate::{discrete, element, register, register32};

#[test]
fn without_a_scope_it_strikes_every_time() {
    let mut rule = Rule::new(Fault::DropReply);
    assert_eq!(strikes(&mut rule, 5), [true; 5]);
    assert_eq!(rule.struck(), 5);
}

#[test]
fn it_skips_the_first_and_stops_after_the_last() {
    let mut rule = Rule::new(Fault::DropReply).skip(2).times(3);
    assert_eq!(strikes(&mut rule, 7), [false, false, true, true, true, false, false]);
    assert_eq!(rule.struck(), 3);
    assert_eq!(strikes(&mut rule.afresh(), 3), [false, false, true]);
    assert_eq!(strikes(&mut Rule::new(Fault::DropReply).times(0), 2), [false; 2]);
}

#[test]
fn only_what_is_in_the_scope_is_counted() {
    let mut rule = Rule::new(Fault::DropReply).station(1).skip(1);
    let mut dice = Dice::new(0, 0, 0);
    let other = Subject { station: Some(2), ..subject() };
    assert!(!rule.strikes(&other, &mut dice));
    assert!(!rule.strikes(&subject(), &mut dice), "the first one at station 1");
    assert!(!rule.strikes(&other, &mut dice));
    assert!(rule.strikes(&subject(), &mut dice));
}

#[test]
fn chance_is_as_it_says() {
    let struck = |rule: Rule| {
        let mut rule = rule;
        strikes(&mut rule, 20_000);
        rule.struck()
    };
    let rule = || Rule::new(Fault::DropReply);
    assert!((900..=1100).contains(&struck(rule().per_mille(50))));
    assert!((1850..=2150).contains(&struck(rule().one_in(10))));
    assert_eq!(struck(rule().one_in(1)), 20_000);
    assert_eq!(struck(rule().per_mille(1000)), 20_000);
    assert_eq!(struck(rule().per_mille(u16::MAX)), 20_000);
    assert_eq!(struck(rule().per_mille(0)), 0);
    assert_eq!(struck(rule().one_in(0)), 0);
}

#[test]
fn the_command_is_that_of_the_frame() {
    let rule = Rule::new(Fault::DropReply).command(Code::WriteRegisters);
    assert!(rule.covers(&Subject { command: Some(Code::WriteRegisters), request: None, ..subject() }));
    assert!(!rule.covers(&Subject { command: Some(Code::ReadRegisters), ..subject() }));
    assert!(!rule.covers(&Subject { command: None, ..subject() }));
}

#[test]
fn a_request_is_in_the_scope_if_it_touches_an_element_by_any_name() {
    let r100 = Rule::new(Fault::DropReply).element(element!("R100"));
    let m8 = Rule::new(Fault::DropReply).elements(discrete!("M8"), 8); // M8 to M15
    for (request, touches_r100, touches_m8) in [
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
        assert_eq!((r100.covers(&subject), m8.covers(&subject)), (touches_r100, touches_m8), "{request:?}");
    }
    assert!(!r100.covers(&subject()), "what cannot be read touches nothing");
}

#[test]
fn a_range_of_elements_may_be_empty_or_end_with_the_area() {
    let last = Request::ReadRegisters(ReadRegisters::new(register!("R65535"), 1).unwrap());
    let subject = Subject { request: Some(&last), ..subject() };
    for count in [1, 2, usize::MAX] {
        assert!(Rule::new(Fault::DropReply).elements(register!("R65535"), count).covers(&subject));
    }
    assert!(Rule::new(Fault::DropReply).elements(register32!("DR65534"), 1).covers(&subject));
    assert!(!Rule::new(Fault::DropReply).elements(register!("R65535"), 0).covers(&subject));
    assert!(!Rule::new(Fault::DropReply).elements(register!("R0"), 65_535).covers(&subject));
}

#[test]
fn a_fault_befalls_only_those_whom_it_can() {
    let befallen = |fault: Fault| {
        let addressees =
            [Addressee::Plc, Addressee::Nobody, Addressee::Everybody, Addressee::Listener, Addressee::Server];
        addressees.map(|addressee| fault.befalls(addressee))
    };
    let time = Duration::ZERO;
    assert_eq!(befallen(Fault::Echo), [true, true, true, false, false]);
    assert_eq!(befallen(Fault::Disconnect(crate::sim::Moment::BeforeReply)), [true, true, true, false, false]);
    assert_eq!(befallen(Fault::Ignore), [true, false, true, false, false]);
    assert_eq!(befallen(Fault::BadChecksum), [true, false, false, false, false]);
    assert_eq!(befallen(Fault::duplicate()), [true, false, false, false, false]);
    assert_eq!(befallen(Fault::LeftOver { min: time, max: time }), [true, false, false, false, false]);
    let answer = Fault::AnswerBroadcast { station: None, min: time, max: time, error: None };
    assert_eq!(befallen(answer), [false, false, false, true, false]);
    assert_eq!(befallen(Fault::Refuse), [false, false, false, false, true]);
}

fn strikes(rule: &mut Rule, requests: u64) -> Vec<bool> {
    (0..requests).map(|nth| rule.strikes(&subject(), &mut Dice::new(7, 1, nth))).collect()
}

fn subject() -> Subject<'static> {
    Subject { addressee: Addressee::Plc, station: Some(1), command: Some(Code::ReadStatus), request: None }
}
