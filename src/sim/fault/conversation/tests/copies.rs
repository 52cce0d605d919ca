//! Copies and second answers: their times, and their order.

use super::*;

#[test]
fn a_copy_at_once_is_glued_to_its_reply() {
    let mut talk = Talk::of([Rule::new(Fault::duplicate()).times(1)]);
    talk.hear(0, &[READ, READ].concat());
    assert_eq!(talk.all(), [at(0, &[READS_0, READS_0].concat()), at(0, READS_0)]);
}

#[test]
fn a_copy_comes_at_its_time_also_without_a_further_request() {
    assert_eq!(under(Fault::Duplicate(after(20, 20)), READ), [at(0, READS_0), at(20_000, READS_0)]);
}

#[test]
fn a_copy_comes_directly_before_an_earlier_next_reply() {
    for (copy_after, expected) in [
        (3, vec![at(5000, READS_0), at(8000, READS_0), at(11_000, IS_SET)]),
        (8, vec![at(5000, READS_0), at(11_000, &[READS_0, IS_SET].concat())]),
        (86_400_000, vec![at(5000, READS_0), at(11_000, &[READS_0, IS_SET].concat())]),
    ] {
        let mut talk = after_5_ms([Rule::new(Fault::Duplicate(after(copy_after, copy_after))).times(1)]);
        talk.hear(0, READ);
        talk.hear(6, SET);
        assert_eq!(talk.all(), expected, "{copy_after} ms");
    }
}

#[test]
fn only_the_next_reply_of_the_same_station_draws_a_copy() {
    let mut talk = after_5_ms([Rule::new(Fault::Duplicate(after(50, 50))).station(1).times(1)]);
    talk.hear(0, READ);
    talk.hear(10, READ_2);
    talk.hear(20, NOBODY);
    talk.hear(30, BROADCAST_7);
    assert_eq!(talk.all(), [at(5000, READS_0), at(15_000, READS_2), at(55_000, READS_0)]);
}

#[test]
fn the_share_of_the_next_request_is_exact() {
    for (share, expected) in [
        (0, vec![at(10_000, READS_0), at(15_000, IS_SET)]),
        (500, vec![at(12_500, READS_0), at(15_000, IS_SET)]),
        (999, vec![at(14_995, READS_0), at(15_000, IS_SET)]),
        (1000, vec![at(15_000, &[READS_0, IS_SET].concat())]),
        (u16::MAX, vec![at(15_000, &[READS_0, IS_SET].concat())]),
    ] {
        let mut talk = after_5_ms([Rule::new(Fault::Duplicate(with_next(share, share))).times(1)]);
        talk.hear(0, READ);
        talk.hear(7, READ_2);
        talk.hear(10, SET);
        let mut said = talk.all();
        said.retain(|(_, said)| *said != text(READS_2));
        assert_eq!(said.remove(0), at(5000, READS_0));
        assert_eq!(said, expected, "{share} per mille");
    }
}

#[test]
fn a_copy_does_not_wait_for_the_next_request_for_ever() {
    for share in [0, 1000] {
        let said = under(Fault::Duplicate(with_next(share, share)), READ);
        assert_eq!(said, [at(0, READS_0), at(1_000_000, READS_0)]);
    }
}

#[test]
fn a_request_that_is_lost_has_the_copy_at_its_arrival() {
    for lost in [Fault::Ignore, Fault::DropReply] {
        let copy = Rule::new(Fault::Duplicate(with_next(0, 0))).times(1);
        let mut talk = after_5_ms([copy, Rule::new(lost).skip(1).times(1)]);
        talk.hear(0, READ);
        talk.hear(10, READ);
        talk.hear(20, SET);
        assert_eq!(talk.all(), [at(5000, READS_0), at(10_000, READS_0), at(25_000, IS_SET)]);
    }
    // Without a reply there is no share of the time until it.
    let copy = Rule::new(Fault::Duplicate(with_next(1000, 1000))).times(1);
    let mut talk = after_5_ms([copy, Rule::new(Fault::Ignore).skip(1).times(1)]);
    talk.hear(0, READ);
    talk.hear(10, READ);
    assert_eq!(talk.all(), [at(5000, READS_0), at(10_000, READS_0)]);
}

#[test]
fn a_next_request_that_has_arrived_before_the_reply_counts() {
    let mut talk = after_5_ms([Rule::new(Fault::Duplicate(with_next(500, 500))).times(1)]);
    talk.hear(0, &[READ, SET].concat());
    assert_eq!(talk.all(), [at(5000, READS_0), at(7500, READS_0), at(10_000, IS_SET)]);
}

#[test]
fn times_are_drawn_between_the_two() {
    let mut talk = after_5_ms([Rule::new(Fault::Duplicate(with_next(200, 600)))]);
    for nth in 0..=1000 {
        talk.hear(10 * nth, READ);
    }
    // Replies come 5 ms after their requests, and copies between the next request and its reply.
    let copies = talk.said.iter().map(|(us, _)| us % 10_000).filter(|us| *us != 5000);
    assert_eq!(copies.clone().count(), 999);
    let (min, max) = copies.fold((u128::MAX, 0), |(min, max), us| (min.min(us), max.max(us)));
    assert!((1000..1100).contains(&min) && (2900..=3000).contains(&max), "{min} to {max}");
    assert_eq!(under(Fault::Duplicate(after(25, 5)), READ), [at(0, READS_0), at(5000, READS_0)]);
}

#[test]
fn a_roaming_copy_comes_later_than_other_replies() {
    let mut talk = after_5_ms([Rule::new(Fault::RoamingDuplicate(after(20, 20))).times(1)]);
    talk.hear(0, READ);
    talk.hear(6, SET);
    talk.hear(12, READ);
    assert_eq!(talk.all(), [at(5000, READS_0), at(11_000, IS_SET), at(17_000, READS_5), at(25_000, READS_0)]);
}

#[test]
fn only_a_roaming_copy_comes_after_the_next_reply() {
    let ms = Duration::from_millis;
    let timing = Timing::AfterNextReply { min: ms(2), max: ms(2), at_latest: ms(100) };
    for (fault, expected) in [
        (Fault::RoamingDuplicate(timing), vec![at(25_000, IS_SET), at(27_000, READS_0), at(35_000, READS_5)]),
        (Fault::Duplicate(timing), vec![at(25_000, &[READS_0, IS_SET].concat()), at(35_000, READS_5)]),
    ] {
        let mut talk = after_5_ms([Rule::new(fault.clone()).times(1)]);
        talk.hear(0, READ);
        talk.hear(20, SET);
        talk.hear(30, READ);
        assert_eq!(talk.all()[1..], expected, "{fault:?}");
        assert_eq!(under(fault, READ), [at(0, READS_0), at(100_000, READS_0)]);
    }
}

#[test]
fn a_read_is_executed_again_for_its_second_answer() {
    let second = Fault::SecondAnswer { timing: after(20, 20), error: None };
    let mut talk = Talk::of([Rule::new(second).times(1)]);
    talk.hear(0, READ);
    talk.plcs[0].write(register!("R0"), 5_u16).unwrap();
    assert_eq!(talk.all(), [at(0, READS_0), at(20_000, READS_5)]);
}

#[test]
fn a_write_is_executed_once_and_answered_twice() {
    let second = Fault::SecondAnswer { timing: after(20, 20), error: None };
    let mut talk = Talk::of([Rule::new(second)]);
    talk.hear(0, SET);
    talk.plcs[0].write(register!("R0"), 9_u16).unwrap();
    talk.wait(30);
    assert_eq!((talk.r0(), talk.faults.log().writes()), (9, 1));
    assert_eq!(talk.all(), [at(0, IS_SET), at(20_000, IS_SET)]);
}

#[test]
fn a_second_answer_may_be_a_refusal_or_follow_one() {
    let refusal = |error| Fault::SecondAnswer { timing: after(20, 20), error };
    let mut talk = Talk::of([Rule::new(refusal(Some(ErrorCode::NotSupported)))]);
    talk.hear(0, READ);
    let mut reply = BytesMut::new();
    crate::command::encode_refusal(0x46, ErrorCode::NotSupported, Framing::Ascii, 1, &mut reply);
    assert_eq!(talk.all(), [at(0, READS_0), at(20_000, &reply)]);
    let mut talk = Talk::of([Rule::new(refusal(None)), Rule::new(Fault::Error(ErrorCode::NotSupported))]);
    talk.hear(0, READ);
    assert!(!talk.faults.log().entries()[0].executed);
    talk.wait(20);
    assert!(!talk.faults.log().entries()[0].executed, "what is refused is not executed later either");
    assert_eq!(talk.all(), [at(0, &reply), at(20_000, &reply)]);
}

#[test]
fn a_second_answer_keeps_the_order() {
    let second = Fault::SecondAnswer { timing: after(50, 50), error: None };
    let mut talk = after_5_ms([Rule::new(second).times(1)]);
    talk.hear(0, READ);
    talk.hear(10, SET);
    // It is read when it is sent, which is after the execution of the write.
    assert_eq!(talk.all(), [at(5000, READS_0), at(15_000, &[READS_5, IS_SET].concat())]);
}

#[test]
fn there_is_no_copy_of_what_is_not_a_whole_reply() {
    for fault in [Fault::DropReply, Fault::Disconnect(Moment::BeforeReply), Fault::Disconnect(Moment::WithinReply)] {
        for timing in [Timing::AT_ONCE, after(20, 20)] {
            let mut talk = Talk::of([Rule::new(Fault::Duplicate(timing)), Rule::new(fault.clone())]);
            talk.hear(0, READ);
            let said = talk.all();
            assert!(said.iter().all(|(us, said)| *us == 0 && *said != text(READS_0)), "{fault:?}: {said:?}");
        }
    }
    let mut talk = Talk::of([Rule::new(Fault::duplicate()), Rule::new(Fault::Disconnect(Moment::AfterReply))]);
    talk.hear(0, READ);
    assert_eq!(talk.all(), [at(0, &[READS_0, READS_0].concat()), closed(0)]);
}

#[test]
fn a_copy_takes_its_time_on_the_line() {
    let mut talk = Talk::of([Rule::new(Fault::Duplicate(after(10, 10))).times(1)]);
    talk.faults.set_line(Line::new(1000));
    talk.hear(0, READ);
    assert_eq!(talk.said, []);
    assert_eq!(talk.all(), [at(290_000, READS_0), at(430_000, READS_0)]);
    // The next reply is ready at 320 ms, while the copy goes out.
    let mut talk = Talk::of([Rule::new(Fault::Duplicate(after(10, 10))).times(1)]);
    talk.faults.set_line(Line::new(1000));
    talk.hear(0, &[READ, READ].concat());
    assert_eq!(talk.all(), [at(290_000, READS_0), at(430_000, READS_0), at(560_000, READS_0)]);
}

#[test]
fn a_copy_at_once_is_one_with_its_reply() {
    let copy = |timing| {
        let mut talk = Talk::of([Rule::new(Fault::Duplicate(timing))]);
        talk.faults.set_line(Line::new(1000));
        talk.hear(0, READ);
        talk.all()
    };
    assert_eq!(copy(Timing::AT_ONCE), [at(420_000, &[READS_0, READS_0].concat())]);
    let nanosecond = Duration::from_nanos(1);
    let separate = copy(Timing::After { min: nanosecond, max: nanosecond });
    assert_eq!(separate, [at(290_000, READS_0), at(420_000, READS_0)]);
    let split = Fault::Split { pieces: 2, pause: Duration::from_millis(10) };
    let mut talk = Talk::of([split, Fault::duplicate()].map(Rule::new));
    talk.hear(0, READ);
    assert_eq!(talk.all(), [at(0, READS_0), at(10_000, READS_0)]);
}

#[test]
fn a_copy_is_not_split_and_has_no_garbage_before_it() {
    let split = Fault::Split { pieces: 2, pause: Duration::from_millis(10) };
    let rules = [split, Fault::Duplicate(after(20, 20)), Fault::BadChecksum].map(Rule::new);
    let mut talk = Talk::of(rules);
    talk.hear(0, READ);
    let bad = b"\x02014600001BD\x03";
    assert_eq!(talk.all(), [at(0, b"\x0201460"), at(10_000, b"0001BD\x03"), at(30_000, bad)]);
    let mut talk = Talk::of([Fault::GarbageBefore { max_len: 4 }, Fault::Duplicate(after(20, 20))].map(Rule::new));
    talk.hear(0, READ);
    assert_eq!(talk.all()[1..], [at(20_000, READS_0)]);
}

#[test]
fn copies_are_bounded_and_hold_up_no_requests() {
    let mut talk = Talk::of([Rule::new(Fault::RoamingDuplicate(after(100_000, 100_000)))]);
    for nth in 0..100 {
        talk.hear(nth, READ);
        assert!(talk.conversation.has_room());
    }
    assert_eq!(talk.all().len(), 100 + MAX_FOLLOW_UPS);
}

#[test]
fn the_log_has_the_fault_and_every_answer() {
    let fault = Fault::Duplicate(after(20, 20));
    let mut talk = Talk::of([Rule::new(fault.clone())]);
    talk.hear(0, READ);
    let entry = |talk: &Talk| talk.faults.log().entries().remove(0);
    assert_eq!((entry(&talk).faults, entry(&talk).answer.as_deref()), (vec![fault], Some(READS_0)));
    talk.wait(20);
    assert_eq!(entry(&talk).answer.unwrap(), [READS_0, READS_0].concat());
}

#[test]
fn equal_seeds_give_equal_copies() {
    let said = |seed| {
        let mut talk = Talk::new(Faults::new(seed).line(Line::new(9600)));
        talk.faults.set_rules([
            Rule::new(Fault::Duplicate(after(0, 20))).one_in(3),
            Rule::new(Fault::SecondAnswer { timing: with_next(0, 1000), error: None }).one_in(4),
            Rule::new(Fault::RoamingDuplicate(after(0, 50))).one_in(5),
        ]);
        for nth in 0..300 {
            talk.hear(60 * nth, READ);
        }
        talk.all()
    };
    assert_eq!(said(3), said(3));
    assert_ne!(said(3), said(4));
}

fn after(min_ms: u64, max_ms: u64) -> Timing {
    Timing::After { min: Duration::from_millis(min_ms), max: Duration::from_millis(max_ms) }
}

fn with_next(min_per_mille: u16, max_per_mille: u16) -> Timing {
    Timing::WithNextRequest { min_per_mille, max_per_mille, at_latest: Duration::from_secs(1) }
}
