//! What is logged of it.

use super::*;
use crate::command::{ReadRegisters, RequestError, WriteRegisters};
use crate::sim::LogEntry;
use crate::wire::Discard;

#[test]
fn every_arrival_is_logged_with_what_came_of_it() {
    let mut talk = Talk::of([Rule::new(Fault::BadChecksum).station(2)]);
    talk.hear(3, SET);
    talk.hear(4, b"\x06");
    talk.hear(5, READ_2);
    talk.hear(6, b"\x020199D5\x03"); // no such command
    talk.hear(7, NOBODY);
    let entries = talk.faults.log().entries();
    let told: Vec<_> = entries.iter().map(|entry| tell(entry, talk.began)).collect();
    assert_eq!(
        told,
        [
            (3, Some(1), true, Some(text(IS_SET))),
            (4, None, false, None),
            (5, Some(2), true, Some(text(b"\x02024600001BE\x03"))),
            (6, Some(1), false, Some(text(b"\x020199409\x03"))),
            (7, Some(3), false, None),
        ]
    );
    assert_eq!(entries[0].request(), Some(&set()));
    assert_eq!(entries[1].heard, Heard::Noise { reason: Discard::Garbage, bytes: Bytes::from_static(b"\x06") });
    assert_eq!(entries[2].faults, [Fault::BadChecksum]);
    let Heard::Unreadable { frame, reason } = &entries[3].heard else { panic!("{:?}", entries[3]) };
    assert_eq!((frame.command, reason), (0x99, &RequestError::UnknownCommand(0x99)));
    let read = Request::ReadRegisters(ReadRegisters::new(register!("R0"), 1).unwrap());
    assert_eq!(entries[4].request(), Some(&read));
    assert_eq!(talk.faults.log().arrivals(), 5);
}

#[test]
fn what_is_lost_is_not_executed_and_what_is_dropped_is() {
    for (fault, executed) in [
        (Fault::Ignore, false),
        (Fault::DropReply, true),
        (Fault::Disconnect(Moment::BeforeExecution), false),
        (Fault::Disconnect(Moment::BeforeReply), true),
    ] {
        let mut talk = Talk::of([Rule::new(fault.clone())]);
        talk.hear(0, SET);
        let log = talk.faults.log();
        let entry = log.entries().remove(0);
        assert_eq!((entry.executed, entry.answer, entry.faults), (executed, None, vec![fault]));
        assert_eq!(log.applied(1, &set()), u64::from(executed));
    }
}

#[test]
fn an_error_is_an_answer_to_what_was_not_executed() {
    let mut talk = Talk::of([Rule::new(Fault::Error(ErrorCode::WriteProhibited))]);
    talk.hear(0, SET);
    let log = talk.faults.log();
    let entry = log.entries().remove(0);
    assert_eq!((entry.executed, entry.answer), (false, Some(Bytes::from_static(b"\x020147301\x03"))));
    assert_eq!(log.writes(), 0);
}

#[test]
fn what_waits_for_its_turn_is_not_executed_yet() {
    let mut talk = Talk::of([Rule::new(delay_ms(100, 100)).times(1)]);
    talk.hear(0, &[READ, SET].concat());
    let executed = |talk: &Talk| talk.faults.log().entries().iter().map(|entry| entry.executed).collect::<Vec<_>>();
    assert_eq!(executed(&talk), [true, false]);
    talk.wait(100);
    assert_eq!(executed(&talk), [true, true]);
}

#[test]
fn the_time_is_when_the_last_byte_came() {
    let mut talk = Talk::over(Line::new(1000));
    talk.hear(0, &[READ, SET].concat());
    let at: Vec<_> = talk.faults.log().entries().iter().map(|entry| (entry.at - talk.began).as_millis()).collect();
    assert_eq!(at, [160, 360]);
}

#[test]
fn the_journal_tells_how_often_a_write_was_applied() {
    let mut talk = Talk::of([Rule::new(Fault::DropReply).times(1)]);
    talk.hear(0, SET);
    let log = talk.faults.log();
    assert_eq!(log.repeated(), []);
    talk.hear(1, SET);
    talk.hear(2, READ);
    talk.hear(3, b"\x02004701R00000000535\x03"); // the same to all
    assert_eq!((log.applied(1, &set()), log.applied(2, &set())), (3, 1));
    let [repeated] = &log.repeated()[..] else { panic!("only station 1") };
    assert_eq!((repeated.station, repeated.times), (1, 3));
    assert_eq!((log.writes(), log.unjournaled()), (4, 0));
    // A write that the PLC refuses has not been applied.
    talk.hear(4, b"\x02014701R655361234\x33\x42\x03");
    assert_eq!(log.writes(), 4);
}

fn set() -> Request {
    Request::WriteRegisters(WriteRegisters::new(register!("R0"), [5]).unwrap())
}

fn tell(entry: &LogEntry, began: Instant) -> (u128, Option<u8>, bool, Option<String>) {
    let answer = entry.answer.as_ref().map(|answer| text(answer));
    ((entry.at - began).as_millis(), entry.station(), entry.executed, answer)
}
