use super::*;
use crate::command::{ReadStatus, WriteRegisters};
use crate::register;

#[tokio::test(start_paused = true)]
async fn the_log_drops_and_counts_the_oldest_entries() {
    let log = Log::new();
    log.set_capacity(2);
    let numbers = [1, 2, 3].map(|station| arrive(&log, station));
    assert_eq!(stations(&log), [2, 3]);
    assert_eq!((log.arrivals(), log.forgotten()), (3, 1));
    for number in numbers {
        log.executed(number, 1, None);
        log.answered(number, &Bytes::from_static(b"x"));
    }
    assert!(log.entries().iter().all(|entry| entry.executed && entry.answer.is_some()));
    log.set_capacity(1);
    assert_eq!((stations(&log), log.forgotten()), (vec![3], 2));
}

#[tokio::test(start_paused = true)]
async fn a_log_of_capacity_0_only_counts() {
    let log = Log::new();
    log.set_capacity(0);
    let number = log.arrived(Instant::now(), &[], || panic!("not evaluated at capacity 0"));
    log.executed(number, 1, None);
    assert_eq!((log.entries(), log.arrivals(), log.forgotten()), (vec![], 1, 1));
}

#[tokio::test(start_paused = true)]
async fn results_are_added_to_the_entry_of_their_arrival() {
    let log = Log::new();
    let [first, second] = [1, 2].map(|station| arrive(&log, station));
    log.executed(second, 2, None);
    log.answered(first, &Bytes::from_static(b"a"));
    let entries = log.entries();
    assert_eq!((entries[0].executed, entries[0].answer.as_deref()), (false, Some(&b"a"[..])));
    assert_eq!((entries[1].executed, entries[1].answer.as_deref()), (true, None));
    // Numbers stay valid after the log is cleared.
    log.clear();
    log.executed(first, 1, None);
    let third = arrive(&log, 3);
    log.executed(second, 1, None);
    assert!(!log.entries()[0].executed);
    log.executed(third, 1, None);
    assert!(log.entries()[0].executed);
    assert_eq!((log.arrivals(), log.forgotten()), (1, 0));
}

#[test]
fn the_journal_counts_equal_writes_of_a_station() {
    let log = Log::new();
    for (station, value) in [(1, 5), (2, 5), (1, 6), (2, 5), (1, 5), (1, 5)] {
        log.executed(0, station, Some(&write(value)));
    }
    assert_eq!(
        [(1, 5), (2, 5), (1, 6), (2, 6), (3, 5)].map(|(station, v)| log.applied(station, &write(v))),
        [3, 2, 1, 0, 0]
    );
    assert_eq!(log.repeated(), [(1, 3), (2, 2)].map(|(station, times)| Applied { station, request: write(5), times }));
    assert_eq!(log.writes(), 6);
    log.clear();
    assert_eq!((log.writes(), log.repeated(), log.applied(1, &write(5))), (0, vec![], 0));
}

#[test]
fn the_journal_is_bounded() {
    let log = Log::new();
    log.set_journal_capacity(2);
    for value in [1, 2, 3, 1, 3] {
        log.executed(0, 1, Some(&write(value)));
    }
    assert_eq!([1, 2, 3].map(|value| log.applied(1, &write(value))), [2, 1, 0]);
    assert_eq!((log.writes(), log.unjournaled()), (5, 2));
}

fn arrive(log: &Log, station: u8) -> u64 {
    log.arrived(Instant::now(), &[], || Arrival::Request { station, request: Request::ReadStatus(ReadStatus) })
}

fn stations(log: &Log) -> Vec<u8> {
    log.entries().iter().filter_map(LogEntry::station).collect()
}

fn write(value: u16) -> Request {
    Request::WriteRegisters(WriteRegisters::new(register!("R0"), [value]).unwrap())
}

#[test]
fn an_arrival_is_shown_on_one_line() {
    let frame = Frame { station: 1, command: 0x99, data: Bytes::from_static(b"\x1b") };
    let noise = |bytes| Arrival::Noise { reason: Discard::Garbage, bytes };
    for (arrival, text) in [
        (Arrival::Request { station: 1, request: write(5) }, "station 1: write registers (47h) R0 = 5"),
        (Arrival::Request { station: 0, request: write(5) }, "broadcast: write registers (47h) R0 = 5"),
        (
            Arrival::Unreadable { frame, reason: RequestError::UnknownCommand(0x99) },
            "station 1: command 99h 1B: there is no command 99",
        ),
        (noise(Bytes::from_static(b"\x06")), "noise: garbage between frames: 06"),
        (noise(Bytes::from_static(b"ab")), r#"noise: garbage between frames: "ab""#),
    ] {
        assert_eq!(arrival.to_string(), text);
    }
    let repeated = Applied { station: 3, request: write(5), times: 2 };
    assert_eq!(repeated.to_string(), "station 3: write registers (47h) R0 = 5; executed 2 times");
}
