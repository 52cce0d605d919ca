//! Replies that outlive their connection.

use super::*;
use crate::command::{ReadRegisters, WriteRegisters};
use crate::sim::fault::left_over::MAX_LEFT_OVER;

#[test]
fn an_open_connection_gets_its_late_reply() {
    let mut bench = left_over_after(500, 1);
    bench.receive(0, READ);
    bench.receive(10, SET);
    let mut other = bench.connect();
    other.open(20);
    assert_eq!(bench.all(), [at(500_000, IS_0), at(500_000, IS_SET)]);
    assert_eq!(other.all(), []);
}

#[test]
fn a_reply_comes_at_its_time_on_the_next_connection() {
    let mut bench = left_over_after(500, 1);
    bench.receive(0, READ);
    bench.wait(100);
    bench.session.disconnect();
    let mut next = bench.connect();
    next.open(200);
    next.receive(300, SET);
    assert_eq!(bench.all(), []);
    assert_eq!(next.all(), [at(500_000, IS_0), at(500_000, IS_SET)]);
}

#[test]
fn a_reply_comes_when_the_next_connection_opens() {
    let mut bench = left_over_after(500, 1);
    bench.receive(0, READ);
    bench.session.disconnect();
    bench.wait(600);
    let mut next = bench.connect();
    next.open(700);
    let mut third = bench.connect();
    third.open(800);
    assert_eq!(next.all(), [at(700_000, IS_0)]);
    assert_eq!((bench.all(), third.all()), (vec![], vec![]));
}

#[test]
fn a_waiting_request_outlives_its_client() {
    let mut bench = left_over_after(100, 3);
    bench.receive(0, &[READ, SET, READ].concat());
    bench.session.disconnect();
    let mut next = bench.connect();
    next.open(50);
    bench.wait(150);
    next.open(150);
    bench.wait(1000);
    next.open(1000);
    assert_eq!(bench.all(), []);
    // The first request was executed before the connection ended, the others after that.
    let order: Vec<_> = next.all().into_iter().map(|(_, sent)| sent).collect();
    assert_eq!(order, [IS_0, IS_SET, IS_5].map(text));
}

#[test]
fn a_half_closed_connection_counts_as_ended() {
    let mut bench = left_over_after(500, 1);
    bench.receive(0, READ);
    bench.receive(1, READ_2);
    bench.session.end_input();
    let mut next = bench.connect();
    next.open(10);
    assert_eq!(next.all(), [at(500_000, IS_0)]);
    assert_eq!(bench.all(), [at(1000, IS_0_OF_2)]);
}

#[test]
fn unsent_left_over_replies_go_to_the_latest_connection() {
    let bench = left_over_after(500, 1);
    let mut older = bench.connect();
    older.open(0);
    let mut asking = bench.connect();
    asking.open(0);
    let mut newer = bench.connect();
    newer.open(0);
    asking.receive(0, READ);
    asking.session.disconnect();
    for connection in [&mut older, &mut newer] {
        connection.open(10);
    }
    newer.session.disconnect();
    let mut last = bench.connect();
    last.open(20);
    assert_eq!((older.all(), newer.all()), (vec![], vec![]));
    assert_eq!(last.all(), [at(500_000, IS_0)]);
}

#[test]
fn only_a_later_connection_gets_a_left_over_reply() {
    let bench = left_over_after(500, 1);
    let mut older = bench.connect();
    older.open(0);
    let mut asking = bench.connect();
    asking.receive(0, READ);
    asking.session.disconnect();
    older.open(600);
    assert_eq!(older.all(), []);
    let mut next = bench.connect();
    next.open(700);
    assert_eq!(next.all(), [at(700_000, IS_0)]);
}

#[test]
fn other_replies_end_with_their_connection() {
    let mut bench = Bench::of([Rule::new(delay_ms(500, 500))]);
    bench.receive(0, READ);
    bench.session.disconnect();
    let mut next = bench.connect();
    next.open(100);
    assert_eq!((bench.all(), next.all()), (vec![], vec![]));
}

#[test]
fn a_duplicate_follows_its_reply_to_the_next_connection() {
    let duplicate = Fault::Duplicate(Timing::WithNextRequest {
        min_per_mille: 0,
        max_per_mille: 0,
        at_latest: Duration::from_secs(9),
    });
    // The client disconnects before and after the reply.
    for gone_at in [1, 200] {
        let mut bench = left_over_after(100, 1);
        bench.faults.add_rule(Rule::new(duplicate.clone()).times(1));
        bench.receive(0, READ);
        bench.wait(gone_at);
        bench.session.disconnect();
        let mut next = bench.connect();
        next.open(300);
        next.receive(400, READ_2);
        next.receive(500, SET);
        let sent = next.all();
        let reply = (gone_at == 1).then(|| at(300_000, IS_0));
        let rest = [at(400_000, IS_0_OF_2), at(500_000, IS_0), at(500_000, IS_SET)];
        assert_eq!(sent, reply.into_iter().chain(rest).collect::<Vec<_>>(), "gone at {gone_at}");
    }
}

#[test]
fn a_reply_in_transmission_outlives_its_client() {
    let mut bench = left_over_after(0, 1);
    bench.faults.set_line(Line::new(1000));
    bench.receive(0, READ);
    bench.wait(200); // transmission is from 160 to 290 ms
    bench.session.disconnect();
    let mut next = bench.connect();
    next.open(250);
    assert_eq!(next.all(), [at(290_000, IS_0)]);
}

#[test]
fn a_run_can_begin_with_left_over_replies() {
    let read = Request::ReadRegisters(ReadRegisters::new(register!("R0"), 1).unwrap());
    let write = Request::WriteRegisters(WriteRegisters::new(register!("R0"), [5]).unwrap());
    let ms = Duration::from_millis;
    let faults = Faults::new(1)
        .left_over(LeftOver::reply(1, read.clone()))
        .left_over(LeftOver::reply(3, read.clone())) // absent
        .left_over(LeftOver::reply(1, write.clone()).error(ErrorCode::IllegalAddress).delay(ms(20)))
        .left_over(LeftOver::bytes(&b"anything"[..]).delay(ms(10)));
    let mut bench = Bench::new(faults);
    bench.plcs[0].write(register!("R0"), 5_u16).unwrap();
    let mut other = bench.connect();
    bench.open(3);
    other.open(4);
    let log = bench.faults.log();
    let entries = log.entries();
    assert_eq!(entries.iter().map(|entry| entry.request()).collect::<Vec<_>>(), [Some(&read), Some(&write)]);
    assert_eq!(entries[1].faults, [Fault::LeftOver { min: ms(20), max: ms(20) }]);
    assert_eq!((entries[0].executed, entries[1].executed, log.writes()), (true, false, 0));
    let refused = b"\x020147A0F\x03";
    assert_eq!(bench.all(), [at(3000, IS_5), at(23_000, refused), at(23_000, b"anything")], "in their order");
    assert_eq!(other.all(), []);
    assert_eq!(log.entries()[1].answer.as_deref(), Some(&refused[..]));
}

#[test]
fn a_reply_added_in_a_run_goes_to_the_next_connection() {
    let mut bench = Bench::of([]);
    bench.open(0);
    bench.faults.add_left_over(LeftOver::bytes(&b"late"[..]));
    bench.open(1);
    let mut next = bench.connect();
    next.open(2);
    assert_eq!((bench.all(), next.all()), (vec![], vec![at(2000, b"late")]));
}

#[test]
fn left_over_replies_are_bounded() {
    let mut bench = left_over_after(1, u64::MAX);
    bench.receive(0, &READ.repeat(100));
    bench.session.disconnect();
    bench.wait(1000);
    for _ in 0..100 {
        bench.faults.add_left_over(LeftOver::bytes(&b"x"[..]));
    }
    let mut next = bench.connect();
    next.open(2000);
    let sent = next.all();
    let added = sent.iter().filter(|(_, sent)| sent == "x").count();
    assert_eq!((added, sent.len() - added), (MAX_LEFT_OVER, MAX_LEFT_OVER));
}

/// The first `times` replies have this delay and outlive their connection.
fn left_over_after(ms: u64, times: u64) -> Bench {
    let late = Duration::from_millis(ms);
    Bench::of([Rule::new(Fault::LeftOver { min: late, max: late }).station(1).times(times)])
}
