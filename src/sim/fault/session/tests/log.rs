//! Log of a session.

use super::*;
use crate::command::{ReadRegisters, RequestError, WriteRegisters};
use crate::sim::LogEntry;
use crate::wire::Discard;

#[test]
fn every_arrival_is_logged_with_its_result() {
    let mut bench = Bench::of([Rule::new(Fault::BadChecksum).station(2)]);
    bench.receive(3, SET);
    bench.receive(4, b"\x06");
    bench.receive(5, READ_2);
    bench.receive(6, b"\x020199D5\x03"); // no such command
    bench.receive(7, READ_ABSENT);
    let entries = bench.faults.log().entries();
    let results: Vec<_> = entries.iter().map(|entry| result_of(entry, bench.began)).collect();
    assert_eq!(
        results,
        [
            (3, Some(1), true, Some(text(IS_SET))),
            (4, None, false, None),
            (5, Some(2), true, Some(text(b"\x02024600001BE\x03"))),
            (6, Some(1), false, Some(text(b"\x020199409\x03"))),
            (7, Some(3), false, None),
        ]
    );
    assert_eq!(entries[0].request(), Some(&set()));
    assert_eq!(entries[1].arrival, Arrival::Noise { reason: Discard::Garbage, bytes: Bytes::from_static(b"\x06") });
    assert_eq!(entries[2].faults, [Fault::BadChecksum]);
    let Arrival::Unreadable { frame, reason } = &entries[3].arrival else { panic!("{:?}", entries[3]) };
    assert_eq!((frame.command, reason), (0x99, &RequestError::UnknownCommand(0x99)));
    let read = Request::ReadRegisters(ReadRegisters::new(register!("R0"), 1).unwrap());
    assert_eq!(entries[4].request(), Some(&read));
    assert_eq!(bench.faults.log().arrivals(), 5);
}

#[test]
fn a_lost_request_is_not_executed_in_the_log() {
    for (fault, executed) in [
        (Fault::Ignore, false),
        (Fault::DropReply, true),
        (Fault::Disconnect(DisconnectAt::BeforeExecution), false),
        (Fault::Disconnect(DisconnectAt::BeforeReply), true),
    ] {
        let mut bench = Bench::of([Rule::new(fault.clone())]);
        bench.receive(0, SET);
        let log = bench.faults.log();
        let entry = log.entries().remove(0);
        assert_eq!((entry.executed, entry.answer, entry.faults), (executed, None, vec![fault]));
        assert_eq!(log.applied(1, &set()), u64::from(executed));
    }
}

#[test]
fn a_refused_request_is_answered_and_not_executed() {
    let mut bench = Bench::of([Rule::new(Fault::Error(ErrorCode::WriteProhibited))]);
    bench.receive(0, SET);
    let log = bench.faults.log();
    let entry = log.entries().remove(0);
    assert_eq!((entry.executed, entry.answer), (false, Some(Bytes::from_static(b"\x020147301\x03"))));
    assert_eq!(log.writes(), 0);
}

#[test]
fn a_waiting_request_is_not_executed_in_the_log() {
    let mut bench = Bench::of([Rule::new(delay_ms(100, 100)).times(1)]);
    bench.receive(0, &[READ, SET].concat());
    let executed = |bench: &Bench| bench.faults.log().entries().iter().map(|entry| entry.executed).collect::<Vec<_>>();
    assert_eq!(executed(&bench), [true, false]);
    bench.wait(100);
    assert_eq!(executed(&bench), [true, true]);
}

#[test]
fn the_time_of_an_arrival_is_that_of_its_last_byte() {
    let mut bench = Bench::over(Line::new(1000));
    bench.receive(0, &[READ, SET].concat());
    let at: Vec<_> = bench.faults.log().entries().iter().map(|entry| (entry.at - bench.began).as_millis()).collect();
    assert_eq!(at, [160, 360]);
}

#[test]
fn the_journal_counts_executions_of_a_write() {
    let mut bench = Bench::of([Rule::new(Fault::DropReply).times(1)]);
    bench.receive(0, SET);
    let log = bench.faults.log();
    assert_eq!(log.repeated(), []);
    bench.receive(1, SET);
    bench.receive(2, READ);
    bench.receive(3, b"\x02004701R00000000535\x03"); // the same as a broadcast
    assert_eq!((log.applied(1, &set()), log.applied(2, &set())), (3, 1));
    let [repeated] = &log.repeated()[..] else { panic!("only station 1") };
    assert_eq!((repeated.station, repeated.times), (1, 3));
    assert_eq!((log.writes(), log.unjournaled()), (4, 0));
    // A refused write is not executed.
    bench.receive(4, b"\x02014701R655361234\x33\x42\x03");
    assert_eq!(log.writes(), 4);
}

fn set() -> Request {
    Request::WriteRegisters(WriteRegisters::new(register!("R0"), [5]).unwrap())
}

fn result_of(entry: &LogEntry, began: Instant) -> (u128, Option<u8>, bool, Option<String>) {
    let answer = entry.answer.as_ref().map(|answer| text(answer));
    ((entry.at - began).as_millis(), entry.station(), entry.executed, answer)
}
