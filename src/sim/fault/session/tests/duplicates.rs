//! Times and order of duplicates and second answers.

use super::*;

#[test]
fn a_duplicate_at_once_is_written_with_its_reply() {
    let mut bench = Bench::of([Rule::new(Fault::duplicate()).times(1)]);
    bench.receive(0, &[READ, READ].concat());
    assert_eq!(bench.all(), [at(0, &[IS_0, IS_0].concat()), at(0, IS_0)]);
}

#[test]
fn a_duplicate_needs_no_further_request() {
    assert_eq!(under(Fault::Duplicate(after(20, 20)), READ), [at(0, IS_0), at(20_000, IS_0)]);
}

#[test]
fn a_duplicate_precedes_an_earlier_next_reply() {
    for (duplicate_after, expected) in [
        (3, vec![at(5000, IS_0), at(8000, IS_0), at(11_000, IS_SET)]),
        (8, vec![at(5000, IS_0), at(11_000, &[IS_0, IS_SET].concat())]),
        (86_400_000, vec![at(5000, IS_0), at(11_000, &[IS_0, IS_SET].concat())]),
    ] {
        let mut bench = after_5_ms([Rule::new(Fault::Duplicate(after(duplicate_after, duplicate_after))).times(1)]);
        bench.receive(0, READ);
        bench.receive(6, SET);
        assert_eq!(bench.all(), expected, "{duplicate_after} ms");
    }
}

#[test]
fn only_a_reply_of_the_same_station_brings_a_duplicate() {
    let mut bench = after_5_ms([Rule::new(Fault::Duplicate(after(50, 50))).station(1).times(1)]);
    bench.receive(0, READ);
    bench.receive(10, READ_2);
    bench.receive(20, READ_ABSENT);
    bench.receive(30, BROADCAST_7);
    assert_eq!(bench.all(), [at(5000, IS_0), at(15_000, IS_0_OF_2), at(55_000, IS_0)]);
}

#[test]
fn the_share_of_the_next_request_is_exact() {
    for (share, expected) in [
        (0, vec![at(10_000, IS_0), at(15_000, IS_SET)]),
        (500, vec![at(12_500, IS_0), at(15_000, IS_SET)]),
        (999, vec![at(14_995, IS_0), at(15_000, IS_SET)]),
        (1000, vec![at(15_000, &[IS_0, IS_SET].concat())]),
        (u16::MAX, vec![at(15_000, &[IS_0, IS_SET].concat())]),
    ] {
        let mut bench = after_5_ms([Rule::new(Fault::Duplicate(with_next(share, share))).times(1)]);
        bench.receive(0, READ);
        bench.receive(7, READ_2);
        bench.receive(10, SET);
        let mut sent = bench.all();
        sent.retain(|(_, sent)| *sent != text(IS_0_OF_2));
        assert_eq!(sent.remove(0), at(5000, IS_0));
        assert_eq!(sent, expected, "{share} per mille");
    }
}

#[test]
fn a_duplicate_comes_at_the_latest_time_without_a_request() {
    for share in [0, 1000] {
        let sent = under(Fault::Duplicate(with_next(share, share)), READ);
        assert_eq!(sent, [at(0, IS_0), at(1_000_000, IS_0)]);
    }
}

#[test]
fn a_lost_request_brings_the_duplicate_on_its_arrival() {
    for lost in [Fault::Ignore, Fault::DropReply] {
        let duplicate = Rule::new(Fault::Duplicate(with_next(0, 0))).times(1);
        let mut bench = after_5_ms([duplicate, Rule::new(lost).skip(1).times(1)]);
        bench.receive(0, READ);
        bench.receive(10, READ);
        bench.receive(20, SET);
        assert_eq!(bench.all(), [at(5000, IS_0), at(10_000, IS_0), at(25_000, IS_SET)]);
    }
    // For a lost request, each share is its arrival.
    let duplicate = Rule::new(Fault::Duplicate(with_next(1000, 1000))).times(1);
    let mut bench = after_5_ms([duplicate, Rule::new(Fault::Ignore).skip(1).times(1)]);
    bench.receive(0, READ);
    bench.receive(10, READ);
    assert_eq!(bench.all(), [at(5000, IS_0), at(10_000, IS_0)]);
}

#[test]
fn an_early_next_request_counts() {
    let mut bench = after_5_ms([Rule::new(Fault::Duplicate(with_next(500, 500))).times(1)]);
    bench.receive(0, &[READ, SET].concat());
    assert_eq!(bench.all(), [at(5000, IS_0), at(7500, IS_0), at(10_000, IS_SET)]);
}

#[test]
fn times_are_drawn_between_min_and_max() {
    let mut bench = after_5_ms([Rule::new(Fault::Duplicate(with_next(200, 600)))]);
    for nth in 0..=1000 {
        bench.receive(10 * nth, READ);
    }
    // Replies come 5 ms after their requests, and duplicates before the next reply.
    let duplicates = bench.sent.iter().map(|(us, _)| us % 10_000).filter(|us| *us != 5000);
    assert_eq!(duplicates.clone().count(), 999);
    let (min, max) = duplicates.fold((u128::MAX, 0), |(min, max), us| (min.min(us), max.max(us)));
    assert!((1000..1100).contains(&min) && (2900..=3000).contains(&max), "{min} to {max}");
    assert_eq!(under(Fault::Duplicate(after(25, 5)), READ), [at(0, IS_0), at(5000, IS_0)]);
}

#[test]
fn a_roaming_duplicate_comes_after_later_replies() {
    let mut bench = after_5_ms([Rule::new(Fault::RoamingDuplicate(after(20, 20))).times(1)]);
    bench.receive(0, READ);
    bench.receive(6, SET);
    bench.receive(12, READ);
    assert_eq!(bench.all(), [at(5000, IS_0), at(11_000, IS_SET), at(17_000, IS_5), at(25_000, IS_0)]);
}

#[test]
fn only_a_roaming_duplicate_comes_after_the_next_reply() {
    let ms = Duration::from_millis;
    let timing = Timing::AfterNextReply { min: ms(2), max: ms(2), at_latest: ms(100) };
    for (fault, expected) in [
        (Fault::RoamingDuplicate(timing), vec![at(25_000, IS_SET), at(27_000, IS_0), at(35_000, IS_5)]),
        (Fault::Duplicate(timing), vec![at(25_000, &[IS_0, IS_SET].concat()), at(35_000, IS_5)]),
    ] {
        let mut bench = after_5_ms([Rule::new(fault.clone()).times(1)]);
        bench.receive(0, READ);
        bench.receive(20, SET);
        bench.receive(30, READ);
        assert_eq!(bench.all()[1..], expected, "{fault:?}");
        assert_eq!(under(fault, READ), [at(0, IS_0), at(100_000, IS_0)]);
    }
}

#[test]
fn a_read_is_executed_again_for_its_second_answer() {
    let second = Fault::SecondAnswer { timing: after(20, 20), error: None };
    let mut bench = Bench::of([Rule::new(second).times(1)]);
    bench.receive(0, READ);
    bench.plcs[0].write(register!("R0"), 5_u16).unwrap();
    assert_eq!(bench.all(), [at(0, IS_0), at(20_000, IS_5)]);
}

#[test]
fn a_write_is_executed_once_and_answered_twice() {
    let second = Fault::SecondAnswer { timing: after(20, 20), error: None };
    let mut bench = Bench::of([Rule::new(second)]);
    bench.receive(0, SET);
    bench.plcs[0].write(register!("R0"), 9_u16).unwrap();
    bench.wait(30);
    assert_eq!((bench.r0(), bench.faults.log().writes()), (9, 1));
    assert_eq!(bench.all(), [at(0, IS_SET), at(20_000, IS_SET)]);
}

#[test]
fn a_second_answer_can_be_or_follow_a_refusal() {
    let refusal = |error| Fault::SecondAnswer { timing: after(20, 20), error };
    let mut bench = Bench::of([Rule::new(refusal(Some(ErrorCode::NotSupported)))]);
    bench.receive(0, READ);
    let mut reply = BytesMut::new();
    crate::command::encode_refusal(0x46, ErrorCode::NotSupported, Framing::Ascii, 1, &mut reply);
    assert_eq!(bench.all(), [at(0, IS_0), at(20_000, &reply)]);
    let mut bench = Bench::of([Rule::new(refusal(None)), Rule::new(Fault::Error(ErrorCode::NotSupported))]);
    bench.receive(0, READ);
    assert!(!bench.faults.log().entries()[0].executed);
    bench.wait(20);
    assert!(!bench.faults.log().entries()[0].executed, "a refused request is not executed later");
    assert_eq!(bench.all(), [at(0, &reply), at(20_000, &reply)]);
}

#[test]
fn a_second_answer_stays_in_order() {
    let second = Fault::SecondAnswer { timing: after(50, 50), error: None };
    let mut bench = after_5_ms([Rule::new(second).times(1)]);
    bench.receive(0, READ);
    bench.receive(10, SET);
    // The read is executed again when sent, after the execution of the write.
    assert_eq!(bench.all(), [at(5000, IS_0), at(15_000, &[IS_5, IS_SET].concat())]);
}

#[test]
fn a_dropped_or_cut_reply_has_no_duplicate() {
    for fault in
        [Fault::DropReply, Fault::Disconnect(DisconnectAt::BeforeReply), Fault::Disconnect(DisconnectAt::WithinReply)]
    {
        for timing in [Timing::AT_ONCE, after(20, 20)] {
            let mut bench = Bench::of([Rule::new(Fault::Duplicate(timing)), Rule::new(fault.clone())]);
            bench.receive(0, READ);
            let sent = bench.all();
            assert!(sent.iter().all(|(us, sent)| *us == 0 && *sent != text(IS_0)), "{fault:?}: {sent:?}");
        }
    }
    let mut bench = Bench::of([Rule::new(Fault::duplicate()), Rule::new(Fault::Disconnect(DisconnectAt::AfterReply))]);
    bench.receive(0, READ);
    assert_eq!(bench.all(), [at(0, &[IS_0, IS_0].concat()), closed(0)]);
}

#[test]
fn a_duplicate_takes_transmission_time() {
    let mut bench = Bench::of([Rule::new(Fault::Duplicate(after(10, 10))).times(1)]);
    bench.faults.set_line(Line::new(1000));
    bench.receive(0, READ);
    assert_eq!(bench.sent, []);
    assert_eq!(bench.all(), [at(290_000, IS_0), at(430_000, IS_0)]);
    // The next reply is ready at 320 ms, during transmission of the duplicate.
    let mut bench = Bench::of([Rule::new(Fault::Duplicate(after(10, 10))).times(1)]);
    bench.faults.set_line(Line::new(1000));
    bench.receive(0, &[READ, READ].concat());
    assert_eq!(bench.all(), [at(290_000, IS_0), at(430_000, IS_0), at(560_000, IS_0)]);
}

#[test]
fn a_duplicate_at_once_is_delivered_and_split_with_its_reply() {
    let duplicate = |timing| {
        let mut bench = Bench::of([Rule::new(Fault::Duplicate(timing))]);
        bench.faults.set_line(Line::new(1000));
        bench.receive(0, READ);
        bench.all()
    };
    assert_eq!(duplicate(Timing::AT_ONCE), [at(420_000, &[IS_0, IS_0].concat())]);
    let nanosecond = Duration::from_nanos(1);
    let separate = duplicate(Timing::After { min: nanosecond, max: nanosecond });
    assert_eq!(separate, [at(290_000, IS_0), at(420_000, IS_0)]);
    let split = Fault::Split { pieces: 2, pause: Duration::from_millis(10) };
    let mut bench = Bench::of([split, Fault::duplicate()].map(Rule::new));
    bench.receive(0, READ);
    assert_eq!(bench.all(), [at(0, IS_0), at(10_000, IS_0)]);
}

#[test]
fn a_duplicate_is_not_split_and_has_no_garbage_before() {
    let split = Fault::Split { pieces: 2, pause: Duration::from_millis(10) };
    let rules = [split, Fault::Duplicate(after(20, 20)), Fault::BadChecksum].map(Rule::new);
    let mut bench = Bench::of(rules);
    bench.receive(0, READ);
    let bad = b"\x02014600001BD\x03";
    assert_eq!(bench.all(), [at(0, b"\x0201460"), at(10_000, b"0001BD\x03"), at(30_000, bad)]);
    let mut bench = Bench::of([Fault::GarbageBefore { max_len: 4 }, Fault::Duplicate(after(20, 20))].map(Rule::new));
    bench.receive(0, READ);
    assert_eq!(bench.all()[1..], [at(20_000, IS_0)]);
}

#[test]
fn duplicates_are_bounded_and_cause_no_backpressure() {
    let mut bench = Bench::of([Rule::new(Fault::RoamingDuplicate(after(100_000, 100_000)))]);
    for nth in 0..100 {
        bench.receive(nth, READ);
        assert!(bench.session.has_room());
    }
    assert_eq!(bench.all().len(), 100 + MAX_FOLLOW_UPS);
}

#[test]
fn the_log_has_the_fault_and_both_replies() {
    let fault = Fault::Duplicate(after(20, 20));
    let mut bench = Bench::of([Rule::new(fault.clone())]);
    bench.receive(0, READ);
    let entry = |bench: &Bench| bench.faults.log().entries().remove(0);
    assert_eq!((entry(&bench).faults, entry(&bench).answer.as_deref()), (vec![fault], Some(IS_0)));
    bench.wait(20);
    assert_eq!(entry(&bench).answer.unwrap(), [IS_0, IS_0].concat());
}

#[test]
fn equal_seeds_give_equal_duplicates() {
    let sent = |seed| {
        let mut bench = Bench::new(Faults::new(seed).line(Line::new(9600)));
        bench.faults.set_rules([
            Rule::new(Fault::Duplicate(after(0, 20))).one_in(3),
            Rule::new(Fault::SecondAnswer { timing: with_next(0, 1000), error: None }).one_in(4),
            Rule::new(Fault::RoamingDuplicate(after(0, 50))).one_in(5),
        ]);
        for nth in 0..300 {
            bench.receive(60 * nth, READ);
        }
        bench.all()
    };
    assert_eq!(sent(3), sent(3));
    assert_ne!(sent(3), sent(4));
}

fn after(min_ms: u64, max_ms: u64) -> Timing {
    Timing::After { min: Duration::from_millis(min_ms), max: Duration::from_millis(max_ms) }
}

fn with_next(min_per_mille: u16, max_per_mille: u16) -> Timing {
    Timing::WithNextRequest { min_per_mille, max_per_mille, at_latest: Duration::from_secs(1) }
}
