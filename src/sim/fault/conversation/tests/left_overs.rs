//! Replies that outlive their connection.

use super::*;
use crate::command::{ReadRegisters, WriteRegisters};

#[test]
fn a_connection_that_is_still_there_gets_a_late_reply() {
    let mut talk = left_over_after(500, 1);
    talk.hear(0, READ);
    talk.hear(10, SET);
    let mut other = talk.join();
    other.open(20);
    assert_eq!(talk.all(), [at(500_000, READS_0), at(500_000, IS_SET)]);
    assert_eq!(other.all(), []);
}

#[test]
fn a_reply_comes_at_its_time_on_the_next_connection() {
    let mut talk = left_over_after(500, 1);
    talk.hear(0, READ);
    talk.wait(100);
    talk.conversation.hang_up();
    let mut next = talk.join();
    next.open(200);
    next.hear(300, SET);
    assert_eq!(talk.all(), []);
    assert_eq!(next.all(), [at(500_000, READS_0), at(500_000, IS_SET)]);
}

#[test]
fn a_reply_comes_when_the_next_connection_opens() {
    let mut talk = left_over_after(500, 1);
    talk.hear(0, READ);
    talk.conversation.hang_up();
    talk.wait(600);
    let mut next = talk.join();
    next.open(700);
    let mut third = talk.join();
    third.open(800);
    assert_eq!(next.all(), [at(700_000, READS_0)]);
    assert_eq!((talk.all(), third.all()), (vec![], vec![]));
}

#[test]
fn a_request_that_waits_for_its_turn_outlives_its_client() {
    let mut talk = left_over_after(100, 3);
    talk.hear(0, &[READ, SET, READ].concat());
    talk.conversation.hang_up();
    let mut next = talk.join();
    next.open(50);
    talk.wait(150);
    next.open(150);
    talk.wait(1000);
    next.open(1000);
    assert_eq!(talk.all(), []);
    // The first has been executed before the connection ended; the others are known to the next one when it looks.
    let order: Vec<_> = next.all().into_iter().map(|(_, said)| said).collect();
    assert_eq!(order, [READS_0, IS_SET, READS_5].map(text));
}

#[test]
fn a_client_that_ends_its_half_has_gone() {
    let mut talk = left_over_after(500, 1);
    talk.hear(0, READ);
    talk.hear(1, READ_2);
    talk.conversation.end_input();
    let mut next = talk.join();
    next.open(10);
    assert_eq!(next.all(), [at(500_000, READS_0)]);
    assert_eq!(talk.all(), [at(1000, READS_2)]);
}

#[test]
fn the_latest_connection_counts_and_hands_on_what_it_has_not_sent() {
    let talk = left_over_after(500, 1);
    let mut older = talk.join();
    older.open(0);
    let mut asking = talk.join();
    asking.open(0);
    let mut newer = talk.join();
    newer.open(0);
    asking.hear(0, READ);
    asking.conversation.hang_up();
    for connection in [&mut older, &mut newer] {
        connection.open(10);
    }
    newer.conversation.hang_up();
    let mut last = talk.join();
    last.open(20);
    assert_eq!((older.all(), newer.all()), (vec![], vec![]));
    assert_eq!(last.all(), [at(500_000, READS_0)]);
}

#[test]
fn only_a_connection_that_opened_later_gets_it() {
    let talk = left_over_after(500, 1);
    let mut older = talk.join();
    older.open(0);
    let mut asking = talk.join();
    asking.hear(0, READ);
    asking.conversation.hang_up();
    older.open(600);
    assert_eq!(older.all(), []);
    let mut next = talk.join();
    next.open(700);
    assert_eq!(next.all(), [at(700_000, READS_0)]);
}

#[test]
fn other_replies_end_with_their_connection() {
    let mut talk = Talk::of([Rule::new(delay_ms(500, 500))]);
    talk.hear(0, READ);
    talk.conversation.hang_up();
    let mut next = talk.join();
    next.open(100);
    assert_eq!((talk.all(), next.all()), (vec![], vec![]));
}

#[test]
fn a_copy_goes_with_its_reply() {
    let copy = Fault::Duplicate(Timing::WithNextRequest {
        min_per_mille: 0,
        max_per_mille: 0,
        at_latest: Duration::from_secs(9),
    });
    // The client goes before the reply, and after it.
    for gone_at in [1, 200] {
        let mut talk = left_over_after(100, 1);
        talk.faults.add_rule(Rule::new(copy.clone()).times(1));
        talk.hear(0, READ);
        talk.wait(gone_at);
        talk.conversation.hang_up();
        let mut next = talk.join();
        next.open(300);
        next.hear(400, READ_2);
        next.hear(500, SET);
        let said = next.all();
        let reply = (gone_at == 1).then(|| at(300_000, READS_0));
        let rest = [at(400_000, READS_2), at(500_000, READS_0), at(500_000, IS_SET)];
        assert_eq!(said, reply.into_iter().chain(rest).collect::<Vec<_>>(), "gone at {gone_at}");
    }
}

#[test]
fn a_reply_that_is_on_the_line_outlives_its_client() {
    let mut talk = left_over_after(0, 1);
    talk.faults.set_line(Line::new(1000));
    talk.hear(0, READ);
    talk.wait(200); // It goes out from 160 to 290 ms.
    talk.conversation.hang_up();
    let mut next = talk.join();
    next.open(250);
    assert_eq!(next.all(), [at(290_000, READS_0)]);
}

#[test]
fn a_run_can_begin_with_left_over_replies() {
    let read = Request::ReadRegisters(ReadRegisters::new(register!("R0"), 1).unwrap());
    let write = Request::WriteRegisters(WriteRegisters::new(register!("R0"), [5]).unwrap());
    let ms = Duration::from_millis;
    let faults = Faults::new(1)
        .left_over(LeftOver::reply(1, read.clone()))
        .left_over(LeftOver::reply(3, read.clone())) // not there
        .left_over(LeftOver::reply(1, write.clone()).error(ErrorCode::IllegalAddress).delay(ms(20)))
        .left_over(LeftOver::bytes(&b"anything"[..]).delay(ms(10)));
    let mut talk = Talk::new(faults);
    talk.plcs[0].write(register!("R0"), 5_u16).unwrap();
    let mut other = talk.join();
    talk.open(3);
    other.open(4);
    let log = talk.faults.log();
    let entries = log.entries();
    assert_eq!(entries.iter().map(|entry| entry.request()).collect::<Vec<_>>(), [Some(&read), Some(&write)]);
    assert_eq!(entries[1].faults, [Fault::LeftOver { min: ms(20), max: ms(20) }]);
    assert_eq!((entries[0].executed, entries[1].executed, log.writes()), (true, false, 0));
    let refused = b"\x020147A0F\x03";
    assert_eq!(talk.all(), [at(3000, READS_5), at(23_000, refused), at(23_000, b"anything")], "in their order");
    assert_eq!(other.all(), []);
    assert_eq!(log.entries()[1].answer.as_deref(), Some(&refused[..]));
}

#[test]
fn what_is_left_over_in_a_run_is_for_the_next_connection() {
    let mut talk = Talk::of([]);
    talk.open(0);
    talk.faults.add_left_over(LeftOver::bytes(&b"late"[..]));
    talk.open(1);
    let mut next = talk.join();
    next.open(2);
    assert_eq!((talk.all(), next.all()), (vec![], vec![at(2000, b"late")]));
}

#[test]
fn left_over_replies_are_bounded() {
    let mut talk = left_over_after(1, u64::MAX);
    talk.hear(0, &READ.repeat(100));
    talk.conversation.hang_up();
    talk.wait(1000);
    for _ in 0..100 {
        talk.faults.add_left_over(LeftOver::bytes(&b"x"[..]));
    }
    let mut next = talk.join();
    next.open(2000);
    let said = next.all();
    let added = said.iter().filter(|(_, said)| said == "x").count();
    assert_eq!((added, said.len() - added), (MAX_LEFT_OVER, MAX_LEFT_OVER));
}

/// The first `times` replies are this late, and outlive their connection.
fn left_over_after(ms: u64, times: u64) -> Talk {
    let late = Duration::from_millis(ms);
    Talk::of([Rule::new(Fault::LeftOver { min: late, max: late }).station(1).times(times)])
}
