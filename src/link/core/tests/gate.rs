//! Requests that the send gate has held back.

use super::test_link::{TIMEOUT, TestLink, read, result, write};
use crate::command::Code;
use crate::error::Error;
use crate::link::core::Action;
use crate::link::options::CallOptions;
use crate::link::stats::StationState;
use crate::wire::Framing;

/// Begins a request. Nothing of it is written yet.
fn begin(link: &mut TestLink) {
    let action = link.next_action();
    assert!(matches!(action, Action::Send(_)), "{action:?}");
}

#[test]
fn a_call_of_which_nothing_was_written_was_certainly_not_executed() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let mut link = TestLink::new(framing);
        let bytes = link.core.exchange.line_bytes();
        for _ in 0..3 {
            let mut call = link.call(1, write());
            begin(&mut link);
            link.core.gate_closed(false, link.now);
            let error = result(&mut call).expect("it ends").expect_err("it was not sent");
            assert!(matches!(error, Error::GateClosed { station: 1, code: Code::WriteRegisters, sent: false }));
            assert_eq!(link.core.exchange.line_bytes(), bytes, "the line was not used");
        }
        // The station is in step as before: no check is needed.
        let mut call = link.call(1, read(2));
        assert_eq!(link.expect_send(), Code::ReadRegisters);
        link.receive_reply(1, &read(2), &vec![7, 8]);
        assert_eq!(result(&mut call).expect("it ends").expect("it is answered"), [7, 8]);
    }
}

#[test]
fn a_call_that_was_sent_before_is_in_doubt() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, write(), CallOptions::new().with_retry_writes(true));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    // The check before the retry.
    begin(&mut link);
    link.core.gate_closed(false, link.now);
    assert!(matches!(result(&mut call), Some(Err(Error::GateClosed { sent: true, .. }))));
}

#[test]
fn a_call_is_in_doubt_if_a_part_of_it_was_written_and_not_if_of_its_check() {
    for (own, in_doubt) in [(true, true), (false, false)] {
        let mut link = TestLink::new(Framing::Ascii);
        if !own {
            link.core.connected(link.now);
        }
        let mut call = link.call(1, write());
        begin(&mut link);
        link.core.gate_closed(true, link.now);
        let error = result(&mut call).expect("it ends").expect_err("it was cut");
        assert_eq!((error.may_have_executed(), matches!(error, Error::GateClosed { .. })), (in_doubt, true));
    }
}

#[test]
fn all_waiting_calls_end_and_count_and_the_exchange_goes_on() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut first = link.call(1, read(2));
    link.expect_send();
    let mut waiting = [link.call(1, read(3)), link.call(2, read(4))];
    assert!(!link.core.wants_to_send(link.now), "a request is on the wire");
    link.receive_reply(1, &read(2), &vec![7, 8]);
    assert!(link.core.wants_to_send(link.now));
    link.core.withhold_all();
    assert_eq!(result(&mut first).expect("it ends").expect("it is answered"), [7, 8]);
    for call in &mut waiting {
        assert!(matches!(result(call), Some(Err(Error::GateClosed { sent: false, .. }))));
    }
    assert!(!link.core.wants_to_send(link.now));
    assert_eq!((link.next_action(), link.stats().withheld), (Action::Wait(None), 2));
}

#[test]
fn an_offline_station_is_unknown_and_has_no_timer() {
    for withdraws in [false, true] {
        let mut link = TestLink::with(Framing::Ascii, |config| config.offline_rules.offline_after = 1);
        let _silent = link.call_with(1, read(1), CallOptions::new().with_retries(0));
        link.expect_send();
        link.advance(TIMEOUT);
        link.next_action();
        let Action::Wait(Some(probe_at)) = link.next_action() else { panic!("no probe is due later") };
        link.now = probe_at;
        if withdraws {
            begin(&mut link);
            link.core.gate_closed(false, link.now);
        } else {
            assert!(link.core.wants_to_send(link.now), "the probe");
            link.core.withhold_all();
        }
        assert_eq!(link.next_action(), Action::Wait(None), "nothing waits for the gate");
        assert_eq!(link.station_state(1), StationState::Unknown);
    }
}
