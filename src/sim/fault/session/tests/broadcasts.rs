//! Answered broadcasts.

use super::*;

/// Replies to a write from station 2, and with station number 0.
const IS_SET_2: &[u8] = b"\x0202470FF\x03";
const IS_SET_0: &[u8] = b"\x0200470FD\x03";

#[test]
fn each_station_answers_a_broadcast_under_its_number() {
    for (rule, expected) in [
        (Rule::new(answer(None)), vec![at(20_000, IS_SET), at(20_000, IS_SET_2)]),
        (Rule::new(answer(None)).station(0), vec![at(20_000, IS_SET), at(20_000, IS_SET_2)]),
        (Rule::new(answer(None)).station(2), vec![at(20_000, IS_SET_2)]),
        (Rule::new(answer(None)).station(3), vec![]),
        (Rule::new(answer(None)).command(Code::ReadRegisters), vec![]),
        (Rule::new(answer(None)).times(1), vec![at(20_000, IS_SET)]),
        (Rule::new(answer(Some(0))), vec![at(20_000, IS_SET_0), at(20_000, IS_SET_0)]),
    ] {
        let mut bench = Bench::of([rule.clone()]);
        bench.receive(0, BROADCAST_7);
        bench.receive(0, READ_ABSENT);
        assert_eq!(obeyed(&bench), [true, true]);
        assert_eq!(bench.faults.rules()[0].times_applied(), expected.len() as u64, "{rule:?}");
        assert_eq!(bench.all(), expected, "{rule:?}");
    }
}

#[test]
fn answer_broadcast_does_not_apply_to_requests() {
    let mut bench = Bench::of([Rule::new(answer(Some(0)))]);
    bench.receive(0, READ);
    assert_eq!(bench.faults.rules()[0].times_applied(), 0);
    assert_eq!(bench.all(), [at(0, IS_0)]);
}

#[test]
fn a_station_that_refuses_a_broadcast_does_not_obey_it() {
    let refusal = Fault::AnswerBroadcast {
        station: None,
        min: Duration::ZERO,
        max: Duration::ZERO,
        error: Some(ErrorCode::IllegalAddress),
    };
    let mut bench = Bench::of([Rule::new(refusal).station(1)]);
    bench.receive(0, BROADCAST_7);
    assert_eq!(obeyed(&bench), [false, true]);
    assert_eq!(bench.faults.log().writes(), 1);
    assert_eq!(bench.all(), [at(0, b"\x020147A0F\x03")]);
}

#[test]
fn a_station_that_ignores_a_broadcast_does_not_answer_it() {
    let mut bench = Bench::of([Rule::new(answer(None)), Rule::new(Fault::Ignore).station(1)]);
    bench.receive(0, BROADCAST_7);
    assert_eq!(obeyed(&bench), [false, true]);
    assert_eq!(bench.all(), [at(20_000, IS_SET_2)]);
}

#[test]
fn a_broadcast_answer_precedes_the_next_reply() {
    let mut bench = Bench::of([Rule::new(answer(None)).station(1)]);
    bench.receive(0, BROADCAST_7);
    bench.receive(5, READ);
    bench.receive(6, READ_2);
    let reads_7 = b"\x02014600007C4\x03";
    let reads_7_2 = b"\x02024600007C5\x03";
    assert_eq!(bench.all(), [at(6000, reads_7_2), at(20_000, IS_SET), at(20_000, reads_7)]);
}

#[test]
fn the_log_has_broadcast_faults_and_answers() {
    let mut bench = Bench::of([Rule::new(answer(None)), Rule::new(Fault::Echo)]);
    bench.receive(0, BROADCAST_7);
    bench.wait(20);
    let entry = bench.faults.log().entries().remove(0);
    assert_eq!(entry.faults, [Fault::Echo, answer(None)]);
    assert_eq!(entry.answer.unwrap(), [IS_SET, IS_SET_2].concat());
}

#[test]
fn the_chance_of_an_answer_is_drawn_per_station() {
    let mut bench = Bench::of([Rule::new(answer(None)).one_in(2)]);
    for nth in 0..400 {
        bench.receive(100 * nth, BROADCAST_7);
    }
    let applied = bench.faults.rules()[0].times_applied();
    assert!((350..450).contains(&applied), "{applied}");
    let sent = bench.all();
    let both = sent.windows(2).filter(|pair| pair[0].0 == pair[1].0).count();
    assert!((70..130).contains(&both), "{both}");
}

fn answer(station: Option<u8>) -> Fault {
    let late = Duration::from_millis(20);
    Fault::AnswerBroadcast { station, min: late, max: late, error: None }
}

fn obeyed(bench: &Bench) -> [bool; 2] {
    [0, 1].map(|n| bench.plcs[n].read(element!("R0")) == Value::Word(7))
}
