//! Each fault, on the bytes that are said.

use super::*;

#[test]
fn without_faults_everything_is_answered_at_once_and_in_order() {
    let mut talk = Talk::of([]);
    talk.hear(0, &[SET, READ_2, READ].concat());
    assert_eq!(talk.all(), [at(0, IS_SET), at(0, READS_2), at(0, READS_5)]);
}

#[test]
fn what_is_ignored_is_not_executed_and_what_is_dropped_is() {
    for (fault, r0) in [(Fault::Ignore, 0), (Fault::DropReply, 5)] {
        let mut talk = Talk::of([Rule::new(fault).times(1)]);
        talk.hear(0, SET);
        assert_eq!(talk.r0(), r0);
        talk.hear(1, READ_2);
        assert_eq!(talk.all(), [at(1000, READS_2)]);
    }
}

#[test]
fn an_error_is_answered_and_nothing_is_executed() {
    let mut talk = Talk::of([Rule::new(Fault::Error(ErrorCode::IllegalAddress)).times(1)]);
    talk.hear(0, SET);
    assert_eq!(talk.r0(), 0);
    assert_eq!(talk.all(), [at(0, b"\x020147A0F\x03")]);
    assert_eq!(under(Fault::Error(ErrorCode::Unknown(1)), READ), [at(0, b"\x0201461FE\x03")]);
}

#[test]
fn the_reply_is_changed_as_the_fault_says() {
    for (fault, reply) in [
        (Fault::WrongStation, &b"\x02024600000BE\x03"[..]),
        (Fault::WrongCommand, b"\x02014700000BE\x03"),
        (Fault::Truncated { by: 1 }, b"\x02014600008D\x03"),
        (Fault::Extended { by: 1 }, b"\x020146000000ED\x03"),
        (Fault::BadChecksum, b"\x02014600001BD\x03"),
        (Fault::duplicate(), b"\x02014600000BD\x03\x02014600000BD\x03"),
        (Fault::Delay { min: Duration::ZERO, max: Duration::ZERO }, READS_0),
        (Fault::Refuse, READS_0),
    ] {
        assert_eq!(under(fault.clone(), READ), [at(0, reply)], "{fault:?}");
    }
}

#[test]
fn garbage_comes_with_the_reply() {
    let [(0, before)] = &under(Fault::GarbageBefore { max_len: 3 }, READ)[..] else { panic!("one write") };
    assert!(before.ends_with(&text(READS_0)) && before.len() > text(READS_0).len(), "{before}");
    let [(0, inside)] = &under(Fault::GarbageInside { max_len: 3 }, READ)[..] else { panic!("one write") };
    assert_ne!(*inside, text(READS_0));
}

#[test]
fn a_split_reply_comes_in_pieces_with_pauses() {
    let split = |pieces, pause_ms| under(Fault::Split { pieces, pause: Duration::from_millis(pause_ms) }, READ);
    assert_eq!(split(3, 40), [at(0, b"\x02014"), at(40_000, b"6000"), at(80_000, b"00BD\x03")]);
    assert_eq!(split(0, 40), [at(0, READS_0)]);
    assert_eq!(split(usize::MAX, 0).len(), READS_0.len());
    // The line is taken until the last piece is out.
    let fault = Fault::Split { pieces: 2, pause: Duration::from_millis(10) };
    let mut talk = Talk::of([Rule::new(fault).station(1)]);
    talk.hear(0, &[READ, READ_2].concat());
    assert_eq!(talk.all(), [at(0, b"\x0201460"), at(10_000, b"0000BD\x03"), at(10_000, READS_2)]);
}

#[test]
fn an_echo_is_the_very_bytes_of_the_request_and_comes_first() {
    let lower_case = b"\x02014701r00000000a82\x03";
    assert_eq!(under(Fault::Echo, lower_case), [at(0, lower_case), at(0, IS_SET)]);
    // Whoever it is for: all, a station that is not there, or one that is dead.
    for unanswered in [BROADCAST_7, NOBODY] {
        assert_eq!(under(Fault::Echo, unanswered), [at(0, unanswered)]);
    }
    let mut talk = Talk::of([Rule::new(Fault::Ignore), Rule::new(Fault::Echo)]);
    talk.hear(0, SET);
    assert_eq!(talk.r0(), 0);
    assert_eq!(talk.all(), [at(0, SET)]);
}

#[test]
fn an_echo_does_not_wait_for_a_busy_station() {
    let mut talk = Talk::of([Rule::new(delay_ms(50, 50)).times(1), Rule::new(Fault::Echo)]);
    talk.hear(0, READ);
    talk.hear(10, SET);
    assert_eq!(talk.all(), [at(0, READ), at(10_000, SET), at(50_000, READS_0), at(50_000, IS_SET)]);
}

#[test]
fn an_echo_in_the_binary_framing_is_the_query() {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap();
    let bus = bus.with_faults(Faults::new(1).rule(Rule::new(Fault::Echo)));
    let mut conversation = Conversation::new(bus.clone(), bus.conditions().unwrap().clone(), Framing::Binary);
    let stop = &b"\x51\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA"[..];
    let item = Codec::new(Framing::Binary, Side::Plc).decode(&mut stop.into()).unwrap().unwrap();
    let now = Instant::now();
    conversation.hear(item, Bytes::from_static(stop), now);
    assert_eq!(conversation.next(now), Some(Output::Bytes(Bytes::from_static(stop))));
    let reply = b"\x52\x10\x00\x03\x01\x41\x00\x45\xD4\x55\xAA";
    assert_eq!(conversation.next(now), Some(Output::Bytes(Bytes::from_static(reply))));
}

#[test]
fn a_connection_is_closed_at_its_moment() {
    for (moment, r0, said) in [
        (Moment::BeforeExecution, 0, vec![closed(0)]),
        (Moment::BeforeReply, 5, vec![closed(20_000)]),
        (Moment::WithinReply, 5, vec![at(20_000, b"\x02014"), closed(20_000)]),
        (Moment::AfterReply, 5, vec![at(20_000, IS_SET), closed(20_000)]),
    ] {
        let mut talk = Talk::of([Rule::new(Fault::Disconnect(moment)), Rule::new(delay_ms(20, 20))]);
        talk.hear(0, SET);
        assert_eq!(talk.r0(), r0, "{moment:?}");
        assert_eq!(talk.all(), said, "{moment:?}");
    }
}

#[test]
fn a_connection_is_closed_also_where_there_is_no_reply() {
    for (fault, request) in
        [(None, NOBODY), (None, BROADCAST_7), (Some(Fault::Ignore), SET), (Some(Fault::DropReply), SET)]
    {
        for moment in [Moment::BeforeExecution, Moment::BeforeReply, Moment::WithinReply, Moment::AfterReply] {
            let faults = fault.iter().cloned().chain([Fault::Disconnect(moment)]);
            let mut talk = Talk::of(faults.map(Rule::new));
            talk.hear(0, request);
            assert_eq!(talk.all(), [closed(0)], "{moment:?} of {}", request.escape_ascii());
        }
    }
}

#[test]
fn after_the_connection_has_been_closed_what_has_arrived_is_executed_and_not_answered() {
    let mut talk = Talk::of([Rule::new(delay_ms(50, 50)).times(1)]);
    talk.hear(0, &[READ, SET].concat());
    talk.conversation.hang_up();
    assert_eq!(talk.r0(), 0, "its turn has not come");
    talk.wait(60);
    assert_eq!(talk.r0(), 5);
    assert_eq!(talk.all(), []);
}

#[test]
fn a_broadcast_is_obeyed_by_all_but_those_who_ignore_it() {
    for (rules, obeying) in [
        (vec![], [true, true]),
        (vec![Rule::new(Fault::Ignore).station(2)], [true, false]),
        (vec![Rule::new(Fault::Ignore).station(0)], [false, false]),
        (vec![Rule::new(Fault::Ignore)], [false, false]),
        (vec![Rule::new(Fault::Ignore).command(Code::ReadRegisters)], [true, true]),
        // What only a reply can suffer does not befall it, and is not used up by it.
        (vec![Rule::new(Fault::duplicate()), Rule::new(Fault::Error(ErrorCode::Syntax))], [true, true]),
    ] {
        let mut talk = Talk::of(rules.clone());
        talk.hear(0, BROADCAST_7);
        let obeyed = [0, 1].map(|n| talk.plcs[n].read(element!("R0")) == Value::Word(7));
        assert_eq!(obeyed, obeying, "{rules:?}");
        let struck: u64 = talk.faults.rules().iter().map(Rule::struck).sum();
        assert_eq!(struck, u64::from(obeying != [true, true]));
        assert_eq!(talk.all(), []);
    }
}

#[test]
fn frames_for_nobody_use_up_no_faults() {
    let mut talk = Talk::of([Rule::new(Fault::BadChecksum).times(1)]);
    talk.hear(0, NOBODY);
    talk.hear(0, READ);
    assert_eq!(talk.all(), [at(0, b"\x02014600001BD\x03")]);
}
