//! Replies that are owed, proofs and doubts: one condition at a time.

use super::*;
use crate::element::Element;

#[test]
fn another_spelling_must_cost_less_than_an_exchange() {
    let mut station = TestStation::with(SERIAL_9600, 1);
    let pair = read(0, 2, false);
    station.exchange(&pair);
    // 48 names one element more: six characters.
    station.rule.prices.exchange = SERIAL_9600 * 6;
    assert_eq!(station.choose(&pair), empty_check());
    station.rule.prices.exchange += Duration::from_nanos(1);
    assert_eq!(station.expect_send(&pair), (Code::ReadMixed, 2));
}

#[test]
fn a_copy_is_a_doubt_only_of_a_page_while_another_page_is_owed() {
    let mut station = TestStation::new();
    let doubts = |station: &mut TestStation| {
        let before = station.in_step.proof().doubts;
        station.in_step.copied();
        station.in_step.proof().doubts - before
    };
    station.exchange(&read(0, 1, false));
    assert_eq!(doubts(&mut station), 0, "a read");
    station.exchange(&page());
    assert_eq!(doubts(&mut station), 0, "a page behind a read");
    station.exchange(&page());
    assert_eq!(doubts(&mut station), 1, "it may be that of the page before");
    station.exchange(&run());
    assert_eq!(doubts(&mut station), 0, "a command behind a page");
}

#[test]
fn a_check_without_a_nonce_proves_unless_its_answer_may_be_owed() {
    for refused in [false, true] {
        let mut station = TestStation::new();
        station.exchange(&run());
        assert!(station.check(Check::Empty, refused), "nothing owed looks like it, refused: {refused}");
        assert!(!station.check(Check::Empty, true), "it may be a duplicate of the one before");
    }
    let mut station = TestStation::new();
    station.in_step.connected();
    assert!(!station.check(Check::Empty, false), "the station is suspect");
    assert!(station.in_step.is_suspect());
    assert!(station.check(Check::Nonce, false));
    assert!(!station.in_step.is_suspect());
}

#[test]
fn all_that_is_owed_lapses_after_a_long_silence() {
    let mut station = TestStation::with(NETWORK, 3);
    let one = read(0, 1, false);
    station.exchange(&one);
    station.exchange(&write(1));
    station.now += 3 * WINDOW;
    assert_eq!(station.expect_send(&one), (Code::ReadRegisters, 1));
}

#[test]
fn a_page_is_proven_if_it_differs_from_a_page_without_proof() {
    for (equal, refused) in [(false, false), (true, false), (false, true)] {
        let mut station = TestStation::with(NETWORK, 2);
        let shape = page().shape(page().plain());
        let first = station.reply(shape, refused);
        station.in_step.unproven(&first, false, &station.rule, station.now);
        assert!(station.check(Check::Nonce, false));
        let mut second = station.reply(shape, false);
        if equal {
            second.fingerprint = first.fingerprint;
        }
        // A refusal has no fingerprint: it may be owed for another page.
        assert_eq!(station.in_step.proves(Kind::Page, &second), !equal && !refused, "equal: {equal}, {refused}");
    }
}

#[test]
fn elements_are_answered_when_they_overlap_others_in_part() {
    let mut answered = AnsweredElements::new();
    let register = |address| -> Element { Register::r(address).into() };
    answered.add(register(0), 10);
    for (first, count) in [(5, 10), (20, 5), (12, 10)] {
        answered.add(register(first), count);
        assert!((first..first + 10).take(count).all(|address| answered.contains(register(address))), "from {first}");
    }
    assert!(!answered.contains(register(25)));
}

#[test]
fn the_line_time_is_that_of_the_bytes() {
    let prices = Prices { byte: SERIAL_9600, exchange: Duration::ZERO };
    assert_eq!((prices.line_time(0), prices.line_time(1000)), (Duration::ZERO, SERIAL_9600 * 1000));
    assert_eq!(prices.line_time(u64::MAX), Duration::from_nanos(u64::MAX));
}
