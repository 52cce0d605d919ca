//! Effect of each fault on executed requests and sent bytes.

use super::*;

#[test]
fn without_faults_replies_come_at_once_in_order() {
    let mut bench = Bench::of([]);
    bench.receive(0, &[SET, READ_2, READ].concat());
    assert_eq!(bench.all(), [at(0, IS_SET), at(0, IS_0_OF_2), at(0, IS_5)]);
}

#[test]
fn ignore_does_not_execute_and_drop_reply_does() {
    for (fault, r0) in [(Fault::Ignore, 0), (Fault::DropReply, 5)] {
        let mut bench = Bench::of([Rule::new(fault).times(1)]);
        bench.receive(0, SET);
        assert_eq!(bench.r0(), r0);
        bench.receive(1, READ_2);
        assert_eq!(bench.all(), [at(1000, IS_0_OF_2)]);
    }
}

#[test]
fn an_error_is_answered_and_nothing_is_executed() {
    let mut bench = Bench::of([Rule::new(Fault::Error(ErrorCode::IllegalAddress)).times(1)]);
    bench.receive(0, SET);
    assert_eq!(bench.r0(), 0);
    assert_eq!(bench.all(), [at(0, b"\x020147A0F\x03")]);
    assert_eq!(under(Fault::Error(ErrorCode::Unknown(1)), READ), [at(0, b"\x0201461FE\x03")]);
}

#[test]
fn each_fault_changes_the_reply_as_documented() {
    for (fault, reply) in [
        (Fault::WrongStation, &b"\x02024600000BE\x03"[..]),
        (Fault::WrongCommand, b"\x02014700000BE\x03"),
        (Fault::Truncated { by: 1 }, b"\x02014600008D\x03"),
        (Fault::Extended { by: 1 }, b"\x020146000000ED\x03"),
        (Fault::BadChecksum, b"\x02014600001BD\x03"),
        (Fault::duplicate(), b"\x02014600000BD\x03\x02014600000BD\x03"),
        (Fault::Delay { min: Duration::ZERO, max: Duration::ZERO }, IS_0),
        (Fault::Refuse, IS_0),
    ] {
        assert_eq!(under(fault.clone(), READ), [at(0, reply)], "{fault:?}");
    }
}

#[test]
fn garbage_comes_with_the_reply() {
    let [(0, before)] = &under(Fault::GarbageBefore { max_len: 3 }, READ)[..] else { panic!("one write") };
    assert!(before.ends_with(&text(IS_0)) && before.len() > text(IS_0).len(), "{before}");
    let [(0, inside)] = &under(Fault::GarbageInside { max_len: 3 }, READ)[..] else { panic!("one write") };
    assert_ne!(*inside, text(IS_0));
}

#[test]
fn a_split_reply_comes_in_pieces_with_pauses() {
    let split = |pieces, pause_ms| under(Fault::Split { pieces, pause: Duration::from_millis(pause_ms) }, READ);
    assert_eq!(split(3, 40), [at(0, b"\x02014"), at(40_000, b"6000"), at(80_000, b"00BD\x03")]);
    assert_eq!(split(0, 40), [at(0, IS_0)]);
    assert_eq!(split(usize::MAX, 0).len(), IS_0.len());
    // The line is busy until the last piece is sent.
    let fault = Fault::Split { pieces: 2, pause: Duration::from_millis(10) };
    let mut bench = Bench::of([Rule::new(fault).station(1)]);
    bench.receive(0, &[READ, READ_2].concat());
    assert_eq!(bench.all(), [at(0, b"\x0201460"), at(10_000, b"0000BD\x03"), at(10_000, IS_0_OF_2)]);
}

#[test]
fn an_echo_has_the_bytes_of_the_request_and_comes_first() {
    let lower_case = b"\x02014701r00000000a82\x03";
    assert_eq!(under(Fault::Echo, lower_case), [at(0, lower_case), at(0, IS_SET)]);
    // For broadcasts, absent stations and offline stations, too.
    for unanswered in [BROADCAST_7, READ_ABSENT] {
        assert_eq!(under(Fault::Echo, unanswered), [at(0, unanswered)]);
    }
    let mut bench = Bench::of([Rule::new(Fault::Ignore), Rule::new(Fault::Echo)]);
    bench.receive(0, SET);
    assert_eq!(bench.r0(), 0);
    assert_eq!(bench.all(), [at(0, SET)]);
}

#[test]
fn an_echo_does_not_wait_for_a_busy_station() {
    let mut bench = Bench::of([Rule::new(delay_ms(50, 50)).times(1), Rule::new(Fault::Echo)]);
    bench.receive(0, READ);
    bench.receive(10, SET);
    assert_eq!(bench.all(), [at(0, READ), at(10_000, SET), at(50_000, IS_0), at(50_000, IS_SET)]);
}

#[test]
fn an_echo_in_the_binary_framing_is_the_query() {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap();
    let bus = bus.with_faults(Faults::new(1).rule(Rule::new(Fault::Echo)));
    let mut session = Session::new(bus.clone(), bus.conditions().unwrap().clone(), Framing::Binary);
    let stop = &b"\x51\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA"[..];
    let item = Codec::new(Framing::Binary, Side::Plc).decode(&mut stop.into()).unwrap().unwrap();
    let now = Instant::now();
    session.receive(item, Bytes::from_static(stop), now);
    assert_eq!(session.next_output(now), Some(Output::Bytes(Bytes::from_static(stop))));
    let reply = b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";
    assert_eq!(session.next_output(now), Some(Output::Bytes(Bytes::from_static(reply))));
}

#[test]
fn disconnect_closes_at_the_given_point() {
    for (point, r0, sent) in [
        (DisconnectAt::BeforeExecution, 0, vec![closed(0)]),
        (DisconnectAt::BeforeReply, 5, vec![closed(20_000)]),
        (DisconnectAt::WithinReply, 5, vec![at(20_000, b"\x02014"), closed(20_000)]),
        (DisconnectAt::AfterReply, 5, vec![at(20_000, IS_SET), closed(20_000)]),
    ] {
        let mut bench = Bench::of([Rule::new(Fault::Disconnect(point)), Rule::new(delay_ms(20, 20))]);
        bench.receive(0, SET);
        assert_eq!(bench.r0(), r0, "{point:?}");
        assert_eq!(bench.all(), sent, "{point:?}");
    }
}

#[test]
fn disconnect_closes_without_a_reply_too() {
    for (fault, request) in
        [(None, READ_ABSENT), (None, BROADCAST_7), (Some(Fault::Ignore), SET), (Some(Fault::DropReply), SET)]
    {
        for point in [
            DisconnectAt::BeforeExecution,
            DisconnectAt::BeforeReply,
            DisconnectAt::WithinReply,
            DisconnectAt::AfterReply,
        ] {
            let faults = fault.iter().cloned().chain([Fault::Disconnect(point)]);
            let mut bench = Bench::of(faults.map(Rule::new));
            bench.receive(0, request);
            assert_eq!(bench.all(), [closed(0)], "{point:?} of {}", request.escape_ascii());
        }
    }
}

#[test]
fn after_a_disconnect_requests_are_executed_unanswered() {
    let mut bench = Bench::of([Rule::new(delay_ms(50, 50)).times(1)]);
    bench.receive(0, &[READ, SET].concat());
    bench.session.disconnect();
    assert_eq!(bench.r0(), 0, "it waits for the first request");
    bench.wait(60);
    assert_eq!(bench.r0(), 5);
    assert_eq!(bench.all(), []);
}

#[test]
fn stations_with_ignore_do_not_obey_a_broadcast() {
    for (rules, obeying) in [
        (vec![], [true, true]),
        (vec![Rule::new(Fault::Ignore).station(2)], [true, false]),
        (vec![Rule::new(Fault::Ignore).station(0)], [false, false]),
        (vec![Rule::new(Fault::Ignore)], [false, false]),
        (vec![Rule::new(Fault::Ignore).command(Code::ReadRegisters)], [true, true]),
        // Faults of replies neither apply to a broadcast nor count it.
        (vec![Rule::new(Fault::duplicate()), Rule::new(Fault::Error(ErrorCode::Syntax))], [true, true]),
    ] {
        let mut bench = Bench::of(rules.clone());
        bench.receive(0, BROADCAST_7);
        let obeyed = [0, 1].map(|n| bench.plcs[n].read(element!("R0")) == Value::Word(7));
        assert_eq!(obeyed, obeying, "{rules:?}");
        let applied: u64 = bench.faults.rules().iter().map(Rule::times_applied).sum();
        assert_eq!(applied, u64::from(obeying != [true, true]));
        assert_eq!(bench.all(), []);
    }
}

#[test]
fn frames_for_absent_stations_are_not_counted() {
    let mut bench = Bench::of([Rule::new(Fault::BadChecksum).times(1)]);
    bench.receive(0, READ_ABSENT);
    bench.receive(0, READ);
    assert_eq!(bench.all(), [at(0, b"\x02014600001BD\x03")]);
}
