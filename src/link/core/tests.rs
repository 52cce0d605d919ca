//! The logic step by step, with the clock in the test's hand: what is sent when, and what each thing that comes leads to.

mod desk;

use desk::{Desk, MS, TIMEOUT, read, result, write};

use bytes::BytesMut;

use super::*;
use crate::command::{Code, ControlPlc, ReadStatus};
use crate::link::options::{CallOptions, EchoMode};
use crate::wire::{FieldWriter as _, Framing, ascii};

#[test]
fn after_a_doubt_nothing_is_asked_before_a_nonce_has_come_back() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut first = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    assert_eq!(desk.sends(), Code::ReadRegisters);
    desk.passes(TIMEOUT);
    assert_eq!(desk.step(), Step::Wait(Some(desk.now)), "what has come by now is looked at first");
    assert!(matches!(result(&mut first), Some(Err(Error::Timeout { sent: true, after: TIMEOUT, .. }))));

    let mut second = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_frame(1, 0x46, b"00007");
    assert!(result(&mut second).is_none(), "the late reply is nobody's");
    desk.hears_echo();
    assert_eq!(desk.sends(), Code::ReadRegisters);
    desk.hears_frame(1, 0x46, b"00008");
    assert_eq!(result(&mut second).unwrap().unwrap(), [8]);
    let stats = desk.stats_of(1);
    assert_eq!((stats.requests, stats.replies, stats.timeouts, stats.checks, stats.late_replies), (2, 1, 1, 1, 1));
    assert_eq!((stats.checks_for.timed_out, stats.stray_frames), (1, 0));
}

#[test]
fn bytes_from_before_a_request_are_forgotten_and_counted() {
    let mut desk = Desk::new(Framing::Ascii);
    desk.hears(b"\x020146000");
    assert_eq!(desk.stats().stale_bytes, 0, "they may become a frame");
    let mut call = desk.ask(1, read(1));
    desk.sends();
    assert_eq!(desk.stats().stale_bytes, 8);
    desk.hears_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    desk.ask(1, read(1));
    desk.ask(1, ReadStatus);
    assert_eq!(desk.stats().stale_bytes, 8, "there was nothing the second time");
}

#[test]
fn a_frame_behind_a_false_beginning_is_found_when_the_line_is_silent() {
    let mut desk = Desk::new(Framing::Binary);
    let mut call = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    desk.hears(b"\x52\x10\x03\x00");
    desk.hears_frame(1, 0x46, b"\x00\x12\x34");
    assert!(result(&mut call).is_none(), "it is in what seems to be a longer frame");
    desk.passes(TIMEOUT * 10);
    desk.step();
    assert_eq!(result(&mut call).unwrap().unwrap(), [0x1234]);
}

#[test]
fn a_reply_that_stops_in_the_middle_is_a_bad_reply_and_silence_is_a_timeout() {
    let cut_off = [
        (Framing::Ascii, &b"\x020146000"[..], "an incomplete frame"),
        (Framing::Binary, b"\x52\x10\x00\x05\x01\x46", "a truncated frame"),
    ];
    for (framing, bytes, what) in cut_off {
        let mut desk = Desk::new(framing);
        let mut call = desk.ask_with(1, read(1), CallOptions::new().retries(0));
        desk.sends();
        desk.hears(bytes);
        desk.passes(TIMEOUT * 10);
        desk.step();
        let error = result(&mut call).unwrap().unwrap_err();
        assert!(matches!(&error, Error::BadReply { reason, .. } if reason == what), "{error:?}");
        assert_eq!((desk.stats_of(1).bad_replies, desk.stats_of(1).timeouts), (1, 0));
    }
}

#[test]
fn garbage_between_frames_is_no_bad_reply_and_shortens_no_wait() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask_with(1, read(1), CallOptions::new().retries(1));
    desk.sends();
    desk.hears(b"\x00\xFF");
    let end = desk.now + TIMEOUT;
    assert_eq!(desk.step(), Step::Wait(Some(end)), "the reply is still to come");
    desk.now = end;
    desk.step();
    assert_eq!((desk.stats_of(1).timeouts, desk.stats_of(1).bad_replies), (1, 0));
    assert!(result(&mut call).is_none(), "it is repeated");
}

#[test]
fn a_corrupt_frame_shortens_the_wait_of_a_call_that_can_be_repeated_and_of_no_other() {
    for (retries, wait) in [(1, 30 * MS), (0, TIMEOUT)] {
        let mut desk = Desk::new(Framing::Ascii);
        let _call = desk.ask_with(1, read(1), CallOptions::new().retries(retries));
        desk.sends();
        desk.hears(b"\x020146000011FF\x03");
        assert_eq!(desk.step(), Step::Wait(Some(desk.now + wait)), "{retries} retries");
        desk.passes(wait);
        desk.step();
        assert_eq!((desk.stats_of(1).bad_replies, desk.stats().checksum_errors), (1, 1));
    }
}

#[test]
fn a_read_whose_reply_follows_a_stray_is_asked_again_behind_a_check() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, read(1));
    desk.sends();
    desk.hears_frame(1, 0x40, b"010000");
    assert_eq!(desk.stats_of(1).stray_frames, 1);
    desk.hears_frame(1, 0x46, b"00009");
    assert!(result(&mut call).is_none(), "the reply is not proven");
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_echo();
    assert_eq!(desk.sends(), Code::ReadRegisters);
    desk.hears_frame(1, 0x46, b"00009");
    assert_eq!(result(&mut call).unwrap().unwrap(), [9]);
    assert_eq!((desk.stats_of(1).unproven_replies, desk.stats_of(1).retries), (1, 0));
}

#[test]
fn a_write_whose_reply_follows_a_stray_of_another_command_is_done() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, write());
    desk.sends();
    desk.hears_frame(1, 0x40, b"010000");
    desk.hears_frame(1, 0x47, b"0");
    assert!(matches!(result(&mut call), Some(Ok(()))));
    let _next = desk.ask(1, write());
    assert_eq!(desk.sends(), Code::LoopBack);
}

#[test]
fn two_frames_in_one_read_that_fit_are_no_value() {
    let glued = |frames: [&[u8]; 2]| {
        let mut bytes = BytesMut::new();
        for data in frames {
            ascii::emit(&mut bytes, 1, 0x46, |fields| fields.raw(data));
        }
        bytes
    };
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    desk.hears(&glued([b"00007", b"00008"]));
    assert!(result(&mut call).is_none());
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_echo();
    desk.sends();
    desk.hears(&glued([b"00008", b"00008"]));
    assert_eq!(result(&mut call).unwrap().unwrap(), [8], "a copy is no other reply");
    assert_eq!((desk.stats_of(1).duplicates, desk.stats_of(1).stray_frames), (1, 1));
}

#[test]
fn of_two_answers_to_a_write_in_one_read_the_first_counts() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, write());
    desk.sends();
    let mut bytes = BytesMut::new();
    ascii::emit(&mut bytes, 1, 0x47, |fields| fields.raw(b"0"));
    ascii::emit(&mut bytes, 1, 0x47, |fields| fields.raw(b"4"));
    desk.hears(&bytes);
    assert!(matches!(result(&mut call), Some(Ok(()))));
    let _next = desk.ask(1, write());
    assert_eq!(desk.sends(), Code::LoopBack, "the other answer makes the station suspect");
}

#[test]
fn a_stray_of_a_station_makes_it_suspect_and_no_other() {
    let mut desk = Desk::new(Framing::Ascii);
    for station in [1, 2] {
        let mut call = desk.ask(station, read(1));
        desk.sends();
        desk.hears_frame(station, 0x46, b"00001");
        assert!(result(&mut call).unwrap().is_ok());
    }
    desk.hears_frame(1, 0x46, b"00005");
    desk.hears_frame(8, 0x46, b"00001");
    let _of_2 = desk.ask(2, ReadStatus);
    assert_eq!(desk.sends(), Code::ReadStatus);
    desk.hears_frame(2, 0x40, b"0010000");
    let _of_1 = desk.ask(1, ReadStatus);
    assert_eq!(desk.sends(), Code::LoopBack);
    assert_eq!(desk.stats_of(1).checks_for.stray, 1);
}

#[test]
fn a_copy_of_the_reply_taken_last_is_dropped_and_makes_no_suspect() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, read(1));
    desk.sends();
    desk.hears_frame(1, 0x46, b"00001");
    assert!(result(&mut call).unwrap().is_ok());
    desk.hears_frame(1, 0x46, b"00001");
    let mut next = desk.ask(1, ReadStatus);
    assert_eq!(desk.sends(), Code::ReadStatus);
    desk.hears_frame(1, 0x46, b"00001");
    desk.hears_frame(1, 0x40, b"0010000");
    assert!(result(&mut next).unwrap().is_ok());
    assert_eq!((desk.stats_of(1).duplicates, desk.stats_of(1).stray_frames), (2, 0));
}

#[test]
fn a_frame_of_another_station_leaves_the_one_on_the_wire_undoubted() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, read(1));
    desk.sends();
    desk.hears_frame(2, 0x46, b"00002");
    desk.hears_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    let _next = desk.ask(1, ReadStatus);
    assert_eq!(desk.sends(), Code::ReadStatus);
}

#[test]
fn in_the_binary_framing_a_reply_like_its_request_is_no_echo() {
    let mut desk = Desk::new(Framing::Binary);
    let _first = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    // What the request holds: a count, `R` and its address.
    desk.hears_frame(1, 0x46, b"\x01R\x00\x00");
    assert_eq!((desk.stats().echoes, desk.stats_of(1).stray_frames), (0, 1));
    desk.passes(TIMEOUT);
    desk.step();
    // A true echo has the header of a query.
    let mut call = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_echo();
    assert!(desk.stats().echoes == 1 && result(&mut call).is_none());
}

#[test]
fn a_frame_as_long_as_its_request_is_an_echo_only_if_it_is_the_same() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    assert_eq!(desk.sent, b"\x02014601R0000070\x03");
    desk.hears_frame(1, 0x46, b"01R00001");
    assert_eq!(desk.stats().echoes, 0, "another address");
    desk.passes(TIMEOUT);
    desk.step();
    assert!(matches!(result(&mut call), Some(Err(Error::BadReply { .. }))));
}

#[test]
fn a_line_that_is_found_to_echo_is_asked_again_after_each_reconnect_and_a_binary_one_never() {
    let mut desk = Desk::new(Framing::Ascii);
    let _call = desk.ask(1, read(1));
    desk.sends();
    desk.hears_echo();
    assert_eq!(desk.stats().echoes, 1);
    assert!(!desk.core.exchange.must_learn_echo(), "it is known now");
    desk.core.connected(desk.now);
    assert!(desk.core.exchange.must_learn_echo());

    let desk = Desk::with(Framing::Binary, |config| config.echo = EchoMode::Auto);
    assert!(!desk.core.exchange.must_learn_echo(), "its header tells an echo");
    let desk = Desk::with(Framing::Ascii, |config| config.echo = EchoMode::On);
    assert!(!desk.core.exchange.must_learn_echo());
}

#[test]
fn what_may_have_been_a_garbled_echo_leaves_open_whether_the_line_echoes() {
    // The status request has 8 bytes: half of it or more may be what is left of its echo.
    for (garbage, known) in [(&b""[..], true), (b"\xFF\xFF\xFF", true), (b"\xFF\xFF\xFF\xFF", false)] {
        let mut desk = Desk::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
        let _call = desk.ask(1, read(1));
        assert_eq!(desk.sends(), Code::ReadStatus);
        desk.hears(garbage);
        desk.hears_frame(1, 0x40, b"0010000");
        assert_eq!(!desk.core.exchange.must_learn_echo(), known, "{} bytes", garbage.len());
        // The reply proves nothing: a check follows.
        assert_eq!(desk.sends(), if known { Code::LoopBack } else { Code::ReadStatus });
    }
}

#[test]
fn a_doubt_that_arises_while_the_echo_is_learned_is_settled_before_the_call() {
    let mut desk = Desk::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
    let _call = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::ReadStatus);
    desk.hears_frame(1, 0x46, b"00001");
    desk.hears_frame(1, 0x40, b"0010000");
    assert_eq!(desk.sends(), Code::LoopBack);
}

#[test]
fn a_refused_loop_back_clears_nothing_until_the_line_has_been_quiet() {
    let mut desk = Desk::new(Framing::Ascii);
    let _lost = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    desk.passes(TIMEOUT);
    desk.step();
    let _call = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_frame(1, 0x4E, b"4");
    assert_eq!(desk.step(), Step::Wait(Some(desk.now + TIMEOUT)));
    desk.passes(TIMEOUT);
    assert_eq!(desk.sends(), Code::ReadRegisters);
}

#[test]
fn a_write_is_sent_once_unless_its_caller_has_chosen_otherwise() {
    for (options, sends) in [
        (CallOptions::new(), 1),
        (CallOptions::new().retry_writes(true), 3),
        (CallOptions::new().retry_writes(true).retries(0), 1),
    ] {
        let mut desk = Desk::new(Framing::Ascii);
        let mut call = desk.ask_with(1, write(), options);
        let mut count = 0;
        while result(&mut call).is_none() {
            if desk.sends() == Code::LoopBack {
                desk.hears_echo();
            } else {
                count += 1;
                desk.passes(TIMEOUT);
                desk.step();
            }
        }
        assert_eq!(count, sends, "{options:?}");
        assert_eq!(desk.stats_of(1).retries, sends - 1);
    }
}

#[test]
fn nothing_is_repeated_after_the_callers_own_time() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask_with(1, read(1), CallOptions::new().call_timeout(40 * MS));
    desk.sends();
    assert_eq!(desk.step(), Step::Wait(Some(desk.now + 40 * MS)), "the caller gives up first");
    desk.passes(40 * MS);
    desk.step();
    assert!(matches!(result(&mut call), Some(Err(Error::Timeout { .. }))));
    assert_eq!((desk.stats_of(1).retries, desk.step()), (0, Step::Wait(None)));
}

#[test]
fn callers_in_a_hurry_take_no_station_offline_and_patient_ones_do() {
    for (options, offline) in [(CallOptions::new().call_timeout(TIMEOUT / 2), false), (CallOptions::new(), true)] {
        let mut desk = Desk::new(Framing::Ascii);
        for _ in 0..3 {
            let _call = desk.ask_with(1, read(1), options.retries(0));
            desk.sends();
            desk.passes(TIMEOUT);
            desk.step();
        }
        let mut call = desk.ask(1, read(1));
        assert_eq!(matches!(result(&mut call), Some(Err(Error::Offline { sent: false, .. }))), offline);
    }
}

#[test]
fn bad_replies_take_no_station_offline_for_it_is_there() {
    let mut desk = Desk::new(Framing::Ascii);
    for _ in 0..9 {
        let _call = desk.ask_with(1, read(1), CallOptions::new().retries(0));
        if desk.sends() == Code::LoopBack {
            desk.hears_echo();
            desk.sends();
        }
        desk.hears_frame(1, 0x46, b"0");
        desk.passes(TIMEOUT);
        desk.step();
    }
    assert_eq!(desk.stats_of(1).bad_replies, 9);
    assert_eq!(desk.core.stations.offline_until(1), None);
}

#[test]
fn what_waits_for_a_station_that_goes_offline_fails_with_it() {
    let mut desk = Desk::with(Framing::Ascii, |config| config.rules.offline_after = 1);
    let _lost = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    let mut waiting = desk.ask(1, read(1));
    let mut other = desk.ask(2, read(1));
    desk.sends();
    desk.passes(TIMEOUT);
    desk.step();
    assert!(matches!(result(&mut waiting), Some(Err(Error::Offline { station: 1, sent: false, .. }))));
    desk.sends();
    desk.hears_frame(2, 0x46, b"00002");
    assert_eq!(result(&mut other).unwrap().unwrap(), [2]);
}

#[test]
fn a_call_that_nobody_wants_any_more_is_never_sent() {
    let mut desk = Desk::new(Framing::Ascii);
    drop(desk.ask(1, read(1)));
    let given_up = desk.ask(1, read(1));
    assert!(!given_up.abandon(), "nothing of it was sent");
    assert_eq!(desk.step(), Step::Wait(None));
    assert_eq!(desk.stats_of(1).requests, 0);
    let sent = desk.ask(1, read(1));
    desk.sends();
    assert!(sent.abandon());
}

#[test]
fn the_time_of_a_reply_is_when_its_frame_came() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, read(1));
    desk.sends();
    desk.passes(7 * MS);
    desk.hears_reply(1, &read(1), &vec![3]);
    let came = desk.now;
    desk.passes(7 * MS);
    assert_eq!(result(&mut call).unwrap().unwrap(), [3]);
    assert_eq!(call.answered_at(), Some(came));
    let round_trip = desk.stats_of(1).round_trip.unwrap();
    assert_eq!((round_trip.last, round_trip.smoothed), (7 * MS, 7 * MS));
}

#[test]
fn control_comes_before_writes_and_writes_before_reads() {
    let mut desk = Desk::new(Framing::Ascii);
    let _read = desk.ask_with(1, read(1), CallOptions::new().background(true));
    let _status = desk.ask(1, ReadStatus);
    let _write = desk.ask(1, write());
    let _stop = desk.ask(1, ControlPlc::Stop);
    let mut order = Vec::new();
    for (command, reply) in [(0x41, &b"0"[..]), (0x47, b"0"), (0x40, b"0010000"), (0x46, b"00001")] {
        order.push(desk.sends());
        desk.hears_frame(1, command, reply);
    }
    assert_eq!(order, [Code::ControlPlc, Code::WriteRegisters, Code::ReadStatus, Code::ReadRegisters]);
}

#[test]
fn a_link_that_closes_sends_nothing_more_and_ends_what_waits() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut on_the_wire = desk.ask(1, read(1));
    let mut waiting = desk.ask(1, read(1));
    desk.sends();
    assert!(!desk.core.is_closing());
    desk.core.close();
    assert!(desk.core.is_closing());
    assert!(matches!(result(&mut waiting), Some(Err(Error::Closed { sent: false }))));
    assert!(matches!(result(&mut desk.ask(1, read(1))), Some(Err(Error::Closed { sent: false }))));
    assert!(!desk.core.is_idle());
    desk.passes(TIMEOUT);
    desk.step();
    assert!(matches!(result(&mut on_the_wire), Some(Err(Error::Timeout { sent: true, .. }))), "it is not repeated");
    assert!(desk.core.is_idle());
}

#[test]
fn the_call_behind_an_echoed_nonce_is_sent_before_all_others() {
    let mut desk = Desk::new(Framing::Ascii);
    let _lost = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    desk.passes(TIMEOUT);
    desk.step();
    let _read = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack);
    let _urgent = desk.ask(2, ControlPlc::Stop);
    desk.hears_echo();
    assert_eq!(desk.sends(), Code::ReadRegisters, "what has proved itself may be in doubt again a moment later");
    desk.hears_frame(1, 0x46, b"00001");
    assert_eq!(desk.sends(), Code::ControlPlc);
}

#[test]
fn a_call_whose_time_is_up_when_the_nonce_comes_back_is_not_sent() {
    let mut desk = Desk::new(Framing::Ascii);
    let _lost = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    desk.passes(TIMEOUT);
    desk.step();
    let mut call = desk.ask_with(1, read(1), CallOptions::new().call_timeout(40 * MS));
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.passes(40 * MS);
    desk.hears_echo();
    assert_eq!(desk.step(), Step::Wait(None));
    assert!(matches!(result(&mut call), Some(Err(Error::Timeout { sent: false, .. }))));
}

#[test]
fn a_station_that_speaks_while_another_one_is_asked_must_prove_itself() {
    let mut desk = Desk::new(Framing::Ascii);
    let _known = desk.ask(1, read(1));
    desk.sends();
    desk.hears_frame(1, 0x46, b"00001");
    let mut other = desk.ask(2, read(1));
    desk.sends();
    desk.hears_frame(1, 0x46, b"00003");
    desk.hears_frame(2, 0x46, b"00002");
    assert_eq!(result(&mut other).unwrap().unwrap(), [2]);
    let _next = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack);
}

#[test]
fn a_new_connection_hurries_the_probes() {
    let mut desk = Desk::with(Framing::Ascii, |config| config.rules.offline_after = 1);
    let _silent = desk.ask_with(1, read(1), CallOptions::new().retries(0));
    desk.sends();
    desk.passes(TIMEOUT);
    desk.step();
    assert!(desk.core.stations.offline_until(1).is_some());
    let _call = desk.ask(2, read(1));
    desk.core.connected(desk.now);
    assert_eq!(desk.sends(), Code::LoopBack);
    assert_eq!(&desk.sent[1..3], b"01", "the station that is offline");
}

#[test]
fn every_station_of_a_new_connection_is_asked_nothing_before_a_check() {
    let mut desk = Desk::new(Framing::Ascii);
    desk.core.connected(desk.now);
    for station in [1, 2, 7] {
        let mut call = desk.ask(station, read(1));
        assert_eq!(desk.sends(), Code::LoopBack, "station {station}");
        desk.hears_frame(station, 0x46, b"00009");
        desk.hears_echo();
        assert_eq!(desk.sends(), Code::ReadRegisters);
        desk.hears_frame(station, 0x46, b"00001");
        assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
        assert_eq!(desk.stats_of(station).checks_for.connected, 1);
    }
}

#[test]
fn two_closes_behind_the_echo_of_a_check_make_silence_replace_it() {
    let mut desk = Desk::new(Framing::Ascii);
    let mut call = desk.ask(1, read(1));
    let closed = Arc::new(io::Error::from(io::ErrorKind::UnexpectedEof));
    for _ in 0..2 {
        desk.core.connected(desk.now);
        assert_eq!(desk.sends(), Code::LoopBack);
        desk.hears_echo();
        desk.core.disconnected(&closed, desk.now);
        desk.step();
    }
    assert!(desk.stats().one_request);
    desk.core.connected(desk.now);
    assert_eq!(desk.step(), Step::Wait(Some(desk.now + TIMEOUT)));
    desk.passes(TIMEOUT);
    assert_eq!(desk.sends(), Code::ReadRegisters);
    desk.hears_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    let _next = desk.ask(1, read(1));
    assert_eq!(desk.step(), Step::Connect, "the connection has had its one request");
}

#[test]
fn a_spelling_that_is_refused_is_sent_as_itself_and_not_used_again() {
    let mut desk = Desk::new(Framing::Ascii);
    for (asked, number) in [("the first", 1), ("spelt otherwise", 2)] {
        let mut call = desk.ask(1, read(1));
        let code = desk.sends();
        if number == 2 {
            assert_eq!(code, Code::ReadMixed, "{asked}");
            desk.hears_frame(1, 0x48, b"4");
            assert!(result(&mut call).is_none());
            assert_eq!(desk.sends(), Code::ReadRegisters);
        }
        desk.hears_frame(1, 0x46, b"00001");
        assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    }
    let _call = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack, "48 is not known there");
    assert_eq!(desk.stats_of(1).refused_spellings, 1);
}

#[test]
fn an_answer_to_a_broadcast_is_not_the_reply_to_what_follows() {
    let mut desk = Desk::new(Framing::Ascii);
    let _all = desk.ask_with(0, ControlPlc::Stop, CallOptions::new());
    assert_eq!(desk.sends(), Code::ControlPlc);
    let mut run = desk.ask(1, ControlPlc::Run);
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_frame(1, 0x41, b"0");
    desk.hears_frame(0, 0x41, b"0");
    desk.hears_echo();
    assert_eq!(desk.sends(), Code::LoopBack, "the answer was a stray: a nonce goes before RUN");
    desk.hears_echo();
    assert_eq!(desk.sends(), Code::ControlPlc);
    desk.hears_frame(1, 0x41, b"5");
    assert!(matches!(result(&mut run), Some(Err(Error::Plc { .. }))));
    assert_eq!((desk.stats_of(1).broadcast_answers, desk.stats_of(0).broadcast_answers), (1, 1));
}

#[test]
fn the_echo_of_a_status_request_behind_a_late_reply_is_seen() {
    let mut desk = Desk::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
    let _call = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::ReadStatus);
    let status = desk.sent.clone();
    desk.hears_frame(1, 0x40, b"0010000"); // of an earlier process
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears(&status);
    assert_eq!(desk.stats().echoes, 1);
    desk.hears_echo();
    assert!(!desk.core.is_idle(), "that was the line, and not the PLC");
}

#[test]
fn a_stray_behind_the_echo_in_the_same_read_asks_for_another_echo() {
    let mut desk = Desk::new(Framing::Ascii);
    desk.core.connected(desk.now);
    let mut call = desk.ask(1, read(1));
    assert_eq!(desk.sends(), Code::LoopBack);
    let mut bytes = BytesMut::from(&desk.sent[..]);
    ascii::emit(&mut bytes, 1, 0x46, |fields| fields.raw(b"00009"));
    desk.hears(&bytes);
    assert_eq!(desk.sends(), Code::LoopBack);
    desk.hears_echo();
    assert_eq!(desk.sends(), Code::ReadRegisters);
    desk.hears_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
}
