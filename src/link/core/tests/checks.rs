//! Checks: when one goes before a request, and which replies need no proof.

use std::io;
use std::sync::Arc;

use bytes::BytesMut;

use super::test_link::{MS, TIMEOUT, TestLink, read, result, write};
use crate::command::{Code, ControlPlc, ReadMixed, ReadStatus};
use crate::element::{Register, Value};
use crate::error::Error;
use crate::link::core::Action;
use crate::link::options::CallOptions;
use crate::wire::{FieldWriter as _, Framing, ascii};

#[test]
fn a_timed_out_station_is_sent_a_nonce_before_requests() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut first = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    assert_eq!(link.expect_send(), Code::ReadRegisters);
    link.advance(TIMEOUT);
    assert_eq!(link.next_action(), Action::Wait(Some(link.now)), "received data are read first");
    assert!(matches!(result(&mut first), Some(Err(Error::Timeout { sent: true, after: TIMEOUT, .. }))));

    let mut second = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_frame(1, 0x46, b"00007");
    assert!(result(&mut second).is_none(), "the late reply is given to no call");
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::ReadRegisters);
    link.receive_frame(1, 0x46, b"00008");
    assert_eq!(result(&mut second).unwrap().unwrap(), [8]);
    let stats = link.station_stats(1);
    assert_eq!((stats.requests, stats.replies, stats.timeouts, stats.checks, stats.late_replies), (2, 1, 1, 1, 1));
    assert_eq!((stats.checks_for.timed_out, stats.stray_frames), (1, 0));
}

#[test]
fn a_read_answered_after_a_stray_is_sent_again_after_a_check() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, read(1));
    link.expect_send();
    link.receive_frame(1, 0x40, b"010000");
    assert_eq!(link.station_stats(1).stray_frames, 1);
    link.receive_frame(1, 0x46, b"00009");
    assert!(result(&mut call).is_none(), "the reply is not proven");
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::ReadRegisters);
    link.receive_frame(1, 0x46, b"00009");
    assert_eq!(result(&mut call).unwrap().unwrap(), [9]);
    assert_eq!((link.station_stats(1).unproven_replies, link.station_stats(1).retries), (1, 0));
}

#[test]
fn a_write_answered_after_a_stray_is_done() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, write());
    link.expect_send();
    link.receive_frame(1, 0x40, b"010000");
    link.receive_frame(1, 0x47, b"0");
    assert!(matches!(result(&mut call), Some(Ok(()))));
    let _next = link.call(1, write());
    assert_eq!(link.expect_send(), Code::LoopBack);
}

#[test]
fn two_fitting_frames_in_one_read_are_no_value() {
    let glued = |frames: [&[u8]; 2]| {
        let mut bytes = BytesMut::new();
        for data in frames {
            ascii::emit(&mut bytes, 1, 0x46, |fields| fields.raw(data));
        }
        bytes
    };
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.receive(&glued([b"00007", b"00008"]));
    assert!(result(&mut call).is_none());
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_echo();
    link.expect_send();
    link.receive(&glued([b"00008", b"00008"]));
    assert_eq!(result(&mut call).unwrap().unwrap(), [8], "a duplicate is no other reply");
    assert_eq!((link.station_stats(1).duplicates, link.station_stats(1).stray_frames), (1, 1));
}

#[test]
fn of_two_answers_to_a_write_in_one_read_the_first_counts() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, write());
    link.expect_send();
    let mut bytes = BytesMut::new();
    ascii::emit(&mut bytes, 1, 0x47, |fields| fields.raw(b"0"));
    ascii::emit(&mut bytes, 1, 0x47, |fields| fields.raw(b"4"));
    link.receive(&bytes);
    assert!(matches!(result(&mut call), Some(Ok(()))));
    let _next = link.call(1, write());
    assert_eq!(link.expect_send(), Code::LoopBack, "the other answer makes the station suspect");
}

#[test]
fn a_stray_makes_only_its_own_station_suspect() {
    let mut link = TestLink::new(Framing::Ascii);
    for station in [1, 2] {
        let mut call = link.call(station, read(1));
        link.expect_send();
        link.receive_frame(station, 0x46, b"00001");
        assert!(result(&mut call).unwrap().is_ok());
    }
    link.receive_frame(1, 0x46, b"00005");
    link.receive_frame(8, 0x46, b"00001");
    let _of_2 = link.call(2, ReadStatus);
    assert_eq!(link.expect_send(), Code::ReadStatus);
    link.receive_frame(2, 0x40, b"0010000");
    let _of_1 = link.call(1, ReadStatus);
    assert_eq!(link.expect_send(), Code::LoopBack);
    assert_eq!(link.station_stats(1).checks_for.stray, 1);
}

#[test]
fn a_duplicate_of_the_last_reply_is_dropped_and_counted() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, read(1));
    link.expect_send();
    link.receive_frame(1, 0x46, b"00001");
    assert!(result(&mut call).unwrap().is_ok());
    link.receive_frame(1, 0x46, b"00001");
    let mut next = link.call(1, ReadStatus);
    assert_eq!(link.expect_send(), Code::ReadStatus);
    link.receive_frame(1, 0x46, b"00001");
    link.receive_frame(1, 0x40, b"0010000");
    assert!(result(&mut next).unwrap().is_ok());
    assert_eq!((link.station_stats(1).duplicates, link.station_stats(1).stray_frames), (2, 0));
}

#[test]
fn a_frame_of_another_station_does_not_touch_the_exchange() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, read(1));
    link.expect_send();
    link.receive_frame(2, 0x46, b"00002");
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    let _next = link.call(1, ReadStatus);
    assert_eq!(link.expect_send(), Code::ReadStatus);
}

#[test]
fn after_a_refused_check_only_silence_resynchronises() {
    let mut link = TestLink::new(Framing::Ascii);
    let _lost = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    let _call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_frame(1, 0x4E, b"4");
    assert_eq!(link.next_action(), Action::Wait(Some(link.now + TIMEOUT)));
    link.advance(TIMEOUT);
    assert_eq!(link.expect_send(), Code::ReadRegisters);
}

#[test]
fn the_call_behind_a_check_is_sent_before_all_others() {
    let mut link = TestLink::new(Framing::Ascii);
    let _lost = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    let _read = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
    let _urgent = link.call(2, ControlPlc::Stop);
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::ReadRegisters, "the station may become suspect again meanwhile");
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(link.expect_send(), Code::ControlPlc);
}

#[test]
fn a_call_that_expires_during_its_check_is_not_sent() {
    let mut link = TestLink::new(Framing::Ascii);
    let _lost = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    let mut call = link.call_with(1, read(1), CallOptions::new().with_call_timeout(40 * MS));
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.advance(40 * MS);
    link.receive_echo();
    assert_eq!(link.next_action(), Action::Wait(None));
    assert!(matches!(result(&mut call), Some(Err(Error::Timeout { sent: false, .. }))));
}

#[test]
fn a_stray_during_another_stations_exchange_leads_to_a_check() {
    let mut link = TestLink::new(Framing::Ascii);
    let _known = link.call(1, read(1));
    link.expect_send();
    link.receive_frame(1, 0x46, b"00001");
    let mut other = link.call(2, read(1));
    link.expect_send();
    link.receive_frame(1, 0x46, b"00003");
    link.receive_frame(2, 0x46, b"00002");
    assert_eq!(result(&mut other).unwrap().unwrap(), [2]);
    let _next = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
}

#[test]
fn on_a_new_connection_each_station_is_checked_first() {
    let mut link = TestLink::new(Framing::Ascii);
    link.core.connected(link.now);
    for station in [1, 2, 7] {
        let mut call = link.call(station, read(1));
        assert_eq!(link.expect_send(), Code::LoopBack, "station {station}");
        link.receive_frame(station, 0x46, b"00009");
        link.receive_echo();
        assert_eq!(link.expect_send(), Code::ReadRegisters);
        link.receive_frame(station, 0x46, b"00001");
        assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
        assert_eq!(link.station_stats(station).checks_for.connected, 1);
    }
}

#[test]
fn after_two_closes_behind_an_echo_silence_replaces_checks() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call(1, read(1));
    let closed = Arc::new(io::Error::from(io::ErrorKind::UnexpectedEof));
    for _ in 0..2 {
        link.core.connected(link.now);
        assert_eq!(link.expect_send(), Code::LoopBack);
        link.receive_echo();
        link.core.disconnected(&closed, link.now);
        link.next_action();
    }
    assert!(link.stats().one_request);
    link.core.connected(link.now);
    assert_eq!(link.next_action(), Action::Wait(Some(link.now + TIMEOUT)));
    link.advance(TIMEOUT);
    assert_eq!(link.expect_send(), Code::ReadRegisters);
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    let _next = link.call(1, read(1));
    assert_eq!(link.next_action(), Action::Connect, "the connection has carried its one request");

    // The two closes may have been by chance. It stayed so for ever.
    for _ in 0..60 {
        assert!(link.stats().one_request);
        link.core.connected(link.now);
    }
    assert!(!link.stats().one_request);
    assert_eq!(link.expect_send(), Code::LoopBack);
}

#[test]
fn a_refused_spelling_is_sent_plain_and_not_used_again() {
    let mut link = TestLink::new(Framing::Ascii);
    for (asked, number) in [("the first", 1), ("in another spelling", 2)] {
        let mut call = link.call(1, read(1));
        let code = link.expect_send();
        if number == 2 {
            assert_eq!(code, Code::ReadMixed, "{asked}");
            link.receive_frame(1, 0x48, b"4");
            assert!(result(&mut call).is_none());
            assert_eq!(link.expect_send(), Code::ReadRegisters);
        }
        link.receive_frame(1, 0x46, b"00001");
        assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
    }
    let _call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack, "the station does not know 48");
    assert_eq!(link.station_stats(1).refused_spellings, 1);
}

#[test]
fn an_answer_to_a_broadcast_is_no_reply_to_the_next_request() {
    let mut link = TestLink::new(Framing::Ascii);
    let _all = link.call_with(0, ControlPlc::Stop, CallOptions::new());
    assert_eq!(link.expect_send(), Code::ControlPlc);
    let mut run = link.call(1, ControlPlc::Run);
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_frame(1, 0x41, b"0");
    link.receive_frame(0, 0x41, b"0");
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::LoopBack, "the answer was a stray: a nonce goes before RUN");
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::ControlPlc);
    link.receive_frame(1, 0x41, b"5");
    assert!(matches!(result(&mut run), Some(Err(Error::Plc { .. }))));
    assert_eq!((link.station_stats(1).broadcast_answers, link.station_stats(0).broadcast_answers), (1, 1));
}

#[test]
fn a_stray_behind_an_echo_leads_to_another_check() {
    let mut link = TestLink::new(Framing::Ascii);
    link.core.connected(link.now);
    let mut call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
    let mut bytes = BytesMut::from(&link.sent[..]);
    ascii::emit(&mut bytes, 1, 0x46, |fields| fields.raw(b"00009"));
    link.receive(&bytes);
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::ReadRegisters);
    link.receive_frame(1, 0x46, b"00001");
    assert_eq!(result(&mut call).unwrap().unwrap(), [1]);
}

#[test]
fn a_repeated_mixed_read_names_its_first_element_twice() {
    let mut link = TestLink::new(Framing::Ascii);
    let mixed = ReadMixed::new([Register::r(3).into(), Register::r(7).into()]).unwrap();
    for (request, reply, spelling) in [
        (&b"4802R00003R00007"[..], &b"000010002"[..], "as the caller has made it"),
        (b"4803R00003R00007R00003", b"0000100020001", "with a reply of another length"),
    ] {
        let mut call = link.call(1, mixed.clone());
        assert_eq!(link.expect_send(), Code::ReadMixed, "no check is needed");
        assert_eq!(&link.sent[3..link.sent.len() - 3], request, "{spelling}");
        link.receive_frame(1, 0x48, reply);
        assert_eq!(result(&mut call).unwrap().unwrap(), [Value::Word(1), Value::Word(2)]);
    }
}
