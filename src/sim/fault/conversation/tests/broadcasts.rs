//! Broadcasts that are answered.

use super::*;

/// The reply to a write of station 2, and one under the number 0.
const IS_SET_2: &[u8] = b"\x0202470FF\x03";
const IS_SET_0: &[u8] = b"\x0200470FD\x03";

#[test]
fn each_station_answers_under_its_number() {
    for (rule, expected) in [
        (Rule::new(answer(None)), vec![at(20_000, IS_SET), at(20_000, IS_SET_2)]),
        (Rule::new(answer(None)).station(0), vec![at(20_000, IS_SET), at(20_000, IS_SET_2)]),
        (Rule::new(answer(None)).station(2), vec![at(20_000, IS_SET_2)]),
        (Rule::new(answer(None)).station(3), vec![]),
        (Rule::new(answer(None)).command(Code::ReadRegisters), vec![]),
        (Rule::new(answer(None)).times(1), vec![at(20_000, IS_SET)]),
        (Rule::new(answer(Some(0))), vec![at(20_000, IS_SET_0), at(20_000, IS_SET_0)]),
    ] {
        let mut talk = Talk::of([rule.clone()]);
        talk.hear(0, BROADCAST_7);
        talk.hear(0, NOBODY);
        assert_eq!(obeyed(&talk), [true, true]);
        assert_eq!(talk.faults.rules()[0].struck(), expected.len() as u64, "{rule:?}");
        assert_eq!(talk.all(), expected, "{rule:?}");
    }
}

#[test]
fn requests_to_one_station_are_no_broadcasts() {
    let mut talk = Talk::of([Rule::new(answer(Some(0)))]);
    talk.hear(0, READ);
    assert_eq!(talk.faults.rules()[0].struck(), 0);
    assert_eq!(talk.all(), [at(0, READS_0)]);
}

#[test]
fn a_station_that_refuses_a_broadcast_does_not_obey_it() {
    let refusal = Fault::AnswerBroadcast {
        station: None,
        min: Duration::ZERO,
        max: Duration::ZERO,
        error: Some(ErrorCode::IllegalAddress),
    };
    let mut talk = Talk::of([Rule::new(refusal).station(1)]);
    talk.hear(0, BROADCAST_7);
    assert_eq!(obeyed(&talk), [false, true]);
    assert_eq!(talk.faults.log().writes(), 1);
    assert_eq!(talk.all(), [at(0, b"\x020147A0F\x03")]);
}

#[test]
fn a_station_that_ignores_a_broadcast_does_not_answer_it() {
    let mut talk = Talk::of([Rule::new(answer(None)), Rule::new(Fault::Ignore).station(1)]);
    talk.hear(0, BROADCAST_7);
    assert_eq!(obeyed(&talk), [false, true]);
    assert_eq!(talk.all(), [at(20_000, IS_SET_2)]);
}

#[test]
fn the_answer_to_a_broadcast_is_before_the_next_reply() {
    let mut talk = Talk::of([Rule::new(answer(None)).station(1)]);
    talk.hear(0, BROADCAST_7);
    talk.hear(5, READ);
    talk.hear(6, READ_2);
    let reads_7 = b"\x02014600007C4\x03";
    let reads_7_2 = b"\x02024600007C5\x03";
    assert_eq!(talk.all(), [at(6000, reads_7_2), at(20_000, IS_SET), at(20_000, reads_7)]);
}

#[test]
fn the_log_has_the_fault_and_the_answers_to_a_broadcast() {
    let mut talk = Talk::of([Rule::new(answer(None)), Rule::new(Fault::Echo)]);
    talk.hear(0, BROADCAST_7);
    talk.wait(20);
    let entry = talk.faults.log().entries().remove(0);
    assert_eq!(entry.faults, [Fault::Echo, answer(None)]);
    assert_eq!(entry.answer.unwrap(), [IS_SET, IS_SET_2].concat());
}

#[test]
fn the_chance_of_an_answer_is_drawn_for_each_station() {
    let mut talk = Talk::of([Rule::new(answer(None)).one_in(2)]);
    for nth in 0..400 {
        talk.hear(100 * nth, BROADCAST_7);
    }
    let struck = talk.faults.rules()[0].struck();
    assert!((350..450).contains(&struck), "{struck}");
    let said = talk.all();
    let both = said.windows(2).filter(|pair| pair[0].0 == pair[1].0).count();
    assert!((70..130).contains(&both), "{both}");
}

fn answer(station: Option<u8>) -> Fault {
    let late = Duration::from_millis(20);
    Fault::AnswerBroadcast { station, min: late, max: late, error: None }
}

fn obeyed(talk: &Talk) -> [bool; 2] {
    [0, 1].map(|n| talk.plcs[n].read(element!("R0")) == Value::Word(7))
}
