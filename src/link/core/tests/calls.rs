//! Calls: the bytes of a reply, timeouts, retries, priority and the end of a call.

use bytes::BytesMut;

use super::test_link::{MS, TIMEOUT, TestLink, read, result, write};
use crate::command::{self, Code, ControlPlc, ReadStatus};
use crate::error::Error;
use crate::link::core::Action;
use crate::link::options::CallOptions;
use crate::wire::Framing;

#[test]
fn bytes_before_a_request_are_dropped_and_counted() {
    let mut link = TestLink::new(Framing::Ascii);
    link.receive(b"\x020146000");
    assert_eq!(link.stats().stale_bytes, 0, "they may still become a frame");
    let mut call = link.call(1, read(1));
    link.expect_send();
    assert_eq!(link.stats().stale_bytes, 8);
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    link.call(1, read(1));
    link.call(1, ReadStatus);
    assert_eq!(link.stats().stale_bytes, 8, "no bytes came before the second request");
}

#[test]
fn a_frame_begun_before_a_request_is_not_its_reply() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let mut reply = BytesMut::new();
        command::encode_reply(&read(1), Ok(&vec![7]), framing, 1, &mut reply);
        for len in 1..reply.len() {
            let mut link = TestLink::new(framing);
            let (begun, rest) = reply.split_at(len);
            link.receive(begun);
            let mut call = link.call(1, read(1));
            assert_eq!(link.expect_send(), Code::ReadRegisters);
            link.receive(rest);
            assert!(result(&mut call).is_none(), "{len} bytes came before the request");
            link.receive(&reply);
            assert_eq!(result(&mut call).unwrap().unwrap(), [7]);
        }
    }
}

#[test]
fn a_link_that_awaits_a_reply_keeps_no_request() {
    let mut link = TestLink::new(Framing::Ascii);
    let _call = link.call(1, read(1));
    link.expect_send();
    assert!(!link.sent.is_empty() && link.core.request_bytes().is_empty());
    // It is sent again all the same.
    let first = link.sent.clone();
    link.receive(b"\x020146000011FF\x03");
    link.advance(TIMEOUT);
    link.next_action();
    while link.expect_send() == Code::LoopBack {
        link.receive_echo();
    }
    assert_eq!(link.sent, first);
}

#[test]
fn bytes_of_frames_on_the_line_are_counted_in_both_directions() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, read(1));
    link.expect_send();
    let request = link.sent.len();
    assert_eq!(usize::try_from(link.core.exchange.line_bytes()), Ok(request));
    let mut reply = BytesMut::new();
    command::encode_reply(&read(1), Ok(&vec![7]), Framing::Ascii, 1, &mut reply);
    link.receive(&reply);
    assert!(result(&mut call).unwrap().is_ok());
    assert_eq!(usize::try_from(link.core.exchange.line_bytes()), Ok(request + reply.len()));
}

#[test]
fn a_frame_behind_a_false_header_is_found_in_silence() {
    let mut link = TestLink::new(Framing::Binary);
    let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.receive(b"\x52\x10\x03\x00");
    link.receive_frame(1, 0x46, b"\x00\x12\x34");
    assert!(result(&mut call).is_none(), "it seems to be part of a longer frame");
    link.advance(TIMEOUT * 10);
    link.next_action();
    assert_eq!(result(&mut call).unwrap().unwrap(), [0x1234]);
}

#[test]
fn a_truncated_reply_is_a_bad_reply_and_no_timeout() {
    let cut_off = [
        (Framing::Ascii, &b"\x020146000"[..], "an incomplete frame"),
        (Framing::Binary, b"\x52\x10\x00\x05\x01\x46", "a truncated frame"),
    ];
    for (framing, bytes, what) in cut_off {
        let mut link = TestLink::new(framing);
        let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
        link.expect_send();
        link.receive(bytes);
        link.advance(TIMEOUT * 10);
        link.next_action();
        let error = result(&mut call).unwrap().unwrap_err();
        assert!(matches!(&error, Error::BadReply { reason, .. } if reason == what), "{error:?}");
        assert_eq!((link.station_stats(1).bad_replies, link.station_stats(1).timeouts), (1, 0));
        // An incomplete frame in ASCII may go on. Otherwise its memory stayed until the next one.
        assert_eq!(link.core.receive_buffer().capacity() > 0, framing == Framing::Ascii);
    }
}

#[test]
fn garbage_between_frames_does_not_end_the_wait() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(1));
    link.expect_send();
    link.receive(b"\x00\xFF");
    let end = link.now + TIMEOUT;
    assert_eq!(link.next_action(), Action::Wait(Some(end)), "the reply is still to come");
    link.now = end;
    link.next_action();
    assert_eq!((link.station_stats(1).timeouts, link.station_stats(1).bad_replies), (1, 0));
    assert!(result(&mut call).is_none(), "it is retried");
}

#[test]
fn a_corrupt_frame_ends_the_wait_only_if_retries_are_left() {
    for (retries, wait) in [(1, 30 * MS), (0, TIMEOUT)] {
        let mut link = TestLink::new(Framing::Ascii);
        let _call = link.call_with(1, read(1), CallOptions::new().with_retries(retries));
        link.expect_send();
        link.receive(b"\x020146000011FF\x03");
        assert_eq!(link.next_action(), Action::Wait(Some(link.now + wait)), "{retries} retries");
        link.advance(wait);
        link.next_action();
        assert_eq!((link.station_stats(1).bad_replies, link.stats().checksum_errors), (1, 1));
    }
}

#[test]
fn a_write_is_sent_once_unless_retries_are_allowed() {
    for (options, sends) in [
        (CallOptions::new(), 1),
        (CallOptions::new().with_retry_writes(true), 3),
        (CallOptions::new().with_retry_writes(true).with_retries(0), 1),
    ] {
        let mut link = TestLink::new(Framing::Ascii);
        let mut call = link.call_with(1, write(), options);
        let mut count = 0;
        while result(&mut call).is_none() {
            if link.expect_send() == Code::LoopBack {
                link.receive_echo();
            } else {
                count += 1;
                link.advance(TIMEOUT);
                link.next_action();
            }
        }
        assert_eq!(count, sends, "{options:?}");
        assert_eq!(link.station_stats(1).retries, sends - 1);
    }
}

#[test]
fn nothing_is_retried_after_the_callers_deadline() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, read(1), CallOptions::new().with_call_timeout(40 * MS));
    link.expect_send();
    link.advance(40 * MS);
    // The caller's own timer has gone off.
    call.abandon();
    assert_eq!(link.next_action(), Action::Wait(Some(link.now + 60 * MS)), "the reply may still come");
    link.advance(60 * MS);
    link.next_action();
    assert!(result(&mut call).is_none());
    assert_eq!((link.station_stats(1).retries, link.next_action()), (0, Action::Wait(None)));
}

/// Before, the exchange ended with the caller's deadline, and the reply was a stray: the next
/// request needed a check, and with many impatient callers nothing but checks was answered.
#[test]
fn a_reply_after_the_callers_deadline_is_no_stray() {
    let mut link = TestLink::new(Framing::Ascii);
    let call = link.call_with(1, read(1), CallOptions::new().with_call_timeout(40 * MS));
    link.expect_send();
    link.advance(50 * MS);
    call.abandon();
    link.receive_reply(1, &read(1), &vec![0]);
    let stats = link.station_stats(1);
    assert_eq!((stats.replies, stats.late_replies, stats.stray_frames, stats.timeouts), (1, 0, 0, 0));
    let _next = link.call(1, read(2));
    assert_eq!(link.expect_send(), Code::ReadRegisters, "the station is in step");
}

#[test]
fn a_call_that_cannot_be_answered_in_time_is_not_sent() {
    let mut link = TestLink::new(Framing::Ascii);
    let impatient = CallOptions::new().with_call_timeout(50 * MS);
    let first = link.call_with(1, read(1), impatient);
    link.expect_send();
    link.advance(30 * MS);
    link.receive_reply(1, &read(1), &vec![0]);
    drop(first);
    // A round trip takes 30 ms, so a call with 20 ms left would be answered in vain.
    let busy = link.call_with(1, read(2), CallOptions::new());
    let mut waits = link.call_with(1, read(3), impatient);
    link.expect_send();
    link.advance(30 * MS);
    link.receive_reply(1, &read(2), &vec![0, 0]);
    drop(busy);
    assert_eq!(link.next_action(), Action::Wait(None));
    let error = result(&mut waits).expect("it has ended").expect_err("it was not sent");
    assert_eq!(error.to_string(), "read registers (46h) to station 1 was queued for 30 ms and never sent");
    assert!(!error.may_have_executed());
    // A call that has not waited shows whether the round trip is still as long.
    let _short = link.call_with(1, read(3), CallOptions::new().with_call_timeout(10 * MS));
    link.expect_send();
}

/// Before, the error said that the check was not answered.
#[test]
fn a_call_that_waits_behind_its_answered_check_does_not_blame_the_station() {
    let mut link = TestLink::new(Framing::Ascii);
    link.core.stations.with_in_step(1, |in_step| in_step.connected());
    let mut call = link.call_with(1, read(1), CallOptions::new().with_call_timeout(40 * MS));
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_echo();
    link.advance(40 * MS);
    link.next_action();
    let error = result(&mut call).expect("its deadline has passed").expect_err("it was not sent");
    assert_eq!(error.to_string(), "read registers (46h) to station 1 was queued for 40 ms and never sent");
}

/// A long round trip must not keep a station from being sent anything: only a request shows that it
/// has become shorter.
#[test]
fn a_call_to_an_idle_station_is_sent_whatever_its_round_trip_was() {
    let mut link = TestLink::new(Framing::Ascii);
    let _slow = link.call(1, read(1));
    link.expect_send();
    link.advance(90 * MS);
    link.receive_reply(1, &read(1), &vec![0]);
    link.advance(200 * MS);
    let _waits = link.call_with(1, read(2), CallOptions::new().with_call_timeout(80 * MS));
    link.advance(10 * MS);
    link.expect_send();
}

/// The process was stopped for an hour, with the reply in the socket.
#[test]
fn a_stopped_process_measures_no_round_trip() {
    let mut link = TestLink::new(Framing::Ascii);
    let _call = link.call(1, read(1));
    link.expect_send();
    link.advance(36_000 * TIMEOUT);
    link.receive_reply(1, &read(1), &vec![0]);
    assert!(link.core.stations.round_trip(1).is_some_and(|expected| expected <= 2 * TIMEOUT));
}

#[test]
fn an_abandoned_call_is_never_sent() {
    let mut link = TestLink::new(Framing::Ascii);
    drop(link.call(1, read(1)));
    let given_up = link.call(1, read(1));
    assert!(!given_up.abandon(), "nothing of it was sent");
    assert_eq!(link.next_action(), Action::Wait(None));
    assert_eq!(link.station_stats(1).requests, 0);
    let sent = link.call(1, read(1));
    link.expect_send();
    assert!(sent.abandon());
}

#[test]
fn the_time_of_a_reply_is_when_its_frame_came() {
    let mut link = TestLink::new(Framing::Ascii);
    let call = link.call(1, read(1));
    link.expect_send();
    link.advance(7 * MS);
    link.receive_reply(1, &read(1), &vec![3]);
    let came = link.now;
    link.advance(7 * MS);
    assert!(call.has_ended());
    let (result, replied_at) = call.take_result(Option::take);
    assert_eq!((result.unwrap(), replied_at), (vec![3], Some(came)));
    let round_trip = link.station_stats(1).round_trip.unwrap();
    assert_eq!((round_trip.last, round_trip.smoothed), (7 * MS, 7 * MS));
}

#[test]
fn control_comes_before_writes_and_writes_before_reads() {
    let mut link = TestLink::new(Framing::Ascii);
    let _read = link.call_with(1, read(1), CallOptions::new().with_background(true));
    let _status = link.call(1, ReadStatus);
    let _write = link.call(1, write());
    let _stop = link.call(1, ControlPlc::Stop);
    let mut order = Vec::new();
    for (command, reply) in [(0x41, &b"0"[..]), (0x47, b"0"), (0x40, b"0010000"), (0x46, b"00001")] {
        order.push(link.expect_send());
        link.receive_frame(1, command, reply);
    }
    assert_eq!(order, [Code::ControlPlc, Code::WriteRegisters, Code::ReadStatus, Code::ReadRegisters]);
}

#[test]
fn a_closing_link_fails_waiting_calls_and_sends_nothing() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut on_the_wire = link.call(1, read(1));
    let mut waiting = link.call(1, read(1));
    link.expect_send();
    assert!(!link.core.is_closing());
    link.core.close();
    assert!(link.core.is_closing());
    assert!(matches!(result(&mut waiting), Some(Err(Error::Closed { sent: false }))));
    assert!(matches!(result(&mut link.call(1, read(1))), Some(Err(Error::Closed { sent: false }))));
    assert!(!link.core.is_idle());
    link.advance(TIMEOUT);
    link.next_action();
    assert!(matches!(result(&mut on_the_wire), Some(Err(Error::Timeout { sent: true, .. }))), "it is not retried");
    assert!(link.core.is_idle());
}

#[test]
fn all_data_are_read_again_before_a_request_is_given_up() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    assert_eq!(link.core.next_action(link.now), Action::ReadAgain);
    // The caller that runs the link cannot: the task does.
    link.core.postpone_read_again();
    assert_eq!(link.core.next_action(link.now), Action::ReadAgain);
    assert!(result(&mut call).is_none());
    assert_eq!(link.core.next_action(link.now), Action::Wait(Some(link.now)));
    assert!(matches!(result(&mut call), Some(Err(Error::Timeout { .. }))));
}

/// The reading of the request before counted for the next one, which was given up with its reply unread, when
/// the driver waited for a reply without asking for the next action.
#[test]
fn all_data_are_read_again_for_each_request() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut first = link.call(1, read(1));
    link.expect_send();
    link.advance(TIMEOUT);
    assert_eq!(link.core.next_action(link.now), Action::ReadAgain);
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut first).unwrap().unwrap(), [1]);

    let mut second = link.call(1, read(2));
    link.expect_send();
    assert_eq!(link.core.await_reply(link.now), Some(link.now + TIMEOUT));
    link.advance(TIMEOUT);
    assert_eq!(link.core.await_reply(link.now), None);
    assert_eq!(link.core.next_action(link.now), Action::ReadAgain);
    link.receive_frame(1, 0x46, b"000010002");
    assert_eq!(result(&mut second).unwrap().unwrap(), [1, 2]);
}

#[test]
fn a_write_is_about_to_be_sent_only_if_one_waits_and_nothing_is_on_the_wire() {
    let mut link = TestLink::new(Framing::Ascii);
    assert!(!link.core.may_send_write());
    let _read = link.call(1, read(1));
    assert!(!link.core.may_send_write());
    link.expect_send();
    let _write = link.call(1, write());
    assert!(!link.core.may_send_write(), "a read is on the wire");
    link.receive_frame(1, 0x46, b"00001");
    assert!(link.core.may_send_write());
}
