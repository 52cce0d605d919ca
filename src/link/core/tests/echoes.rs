//! Lines that echo requests.

use super::test_link::{TIMEOUT, TestLink, read, result};
use crate::command::{Code, LoopBack, ReadStatus};
use crate::error::Error;
use crate::link::options::{CallOptions, EchoMode};
use crate::wire::Framing;

#[test]
fn a_binary_reply_like_its_request_is_no_echo() {
    let mut link = TestLink::new(Framing::Binary);
    let _first = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    // The content of the request: a count, `R` and its address.
    link.receive_frame(1, 0x46, b"\x01R\x00\x00");
    assert_eq!((link.stats().echoes, link.station_stats(1).stray_frames), (0, 1));
    link.advance(TIMEOUT);
    link.next_action();
    // A true echo has the header of a query.
    let mut call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_echo();
    assert!(link.stats().echoes == 1 && result(&mut call).is_none());
}

#[test]
fn only_a_frame_equal_to_the_request_is_an_echo() {
    let mut link = TestLink::new(Framing::Ascii);
    let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    assert_eq!(link.sent, b"\x02014601R0000070\x03");
    link.receive_frame(1, 0x46, b"01R00001");
    assert_eq!(link.stats().echoes, 0, "another address");
    link.advance(TIMEOUT);
    link.next_action();
    assert!(matches!(result(&mut call), Some(Err(Error::BadReply { .. }))));
}

#[test]
fn a_line_with_echo_is_tested_again_after_a_reconnect() {
    let mut link = TestLink::new(Framing::Ascii);
    let _call = link.call(1, read(1));
    link.expect_send();
    link.receive_echo();
    assert_eq!(link.stats().echoes, 1);
    assert!(!link.core.exchange.must_learn_echo(), "it is known");
    link.core.connected(link.now);
    assert!(link.core.exchange.must_learn_echo());

    let link = TestLink::with(Framing::Binary, |config| config.echo = EchoMode::Auto);
    assert!(!link.core.exchange.must_learn_echo(), "the header marks an echo");
    let link = TestLink::with(Framing::Ascii, |config| config.echo = EchoMode::On);
    assert!(!link.core.exchange.must_learn_echo());
}

#[test]
fn noise_of_half_a_request_leaves_the_echo_unknown() {
    // The status request has 8 bytes: half of it or more may be the rest of its echo.
    for (garbage, known) in [(&b""[..], true), (b"\xFF\xFF\xFF", true), (b"\xFF\xFF\xFF\xFF", false)] {
        let mut link = TestLink::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
        let _call = link.call(1, read(1));
        assert_eq!(link.expect_send(), Code::ReadStatus);
        link.receive(garbage);
        link.receive_frame(1, 0x40, b"0010000");
        assert_eq!(!link.core.exchange.must_learn_echo(), known, "{} bytes", garbage.len());
        // The reply proves nothing: a check follows.
        assert_eq!(link.expect_send(), if known { Code::LoopBack } else { Code::ReadStatus });
    }
}

#[test]
fn a_stray_during_the_echo_test_leads_to_a_check() {
    let mut link = TestLink::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
    let _call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::ReadStatus);
    link.receive_frame(1, 0x46, b"00001");
    link.receive_frame(1, 0x40, b"0010000");
    assert_eq!(link.expect_send(), Code::LoopBack);
}

#[test]
fn an_echo_behind_a_late_status_reply_is_recognised() {
    let mut link = TestLink::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
    let _call = link.call(1, read(1));
    assert_eq!(link.expect_send(), Code::ReadStatus);
    let status = link.sent.clone();
    link.receive_frame(1, 0x40, b"0010000"); // of an earlier process
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive(&status);
    assert_eq!(link.stats().echoes, 1);
    link.receive_echo();
    assert!(!link.core.is_idle(), "that was the echo of the line, not the reply");
}

#[test]
fn replies_after_the_echo_test_are_no_echoes() {
    let mut link = TestLink::with(Framing::Ascii, |config| config.echo = EchoMode::Auto);
    let mut status = link.call(1, ReadStatus);
    assert_eq!(link.expect_send(), Code::ReadStatus);
    link.receive_frame(1, 0x40, b"0010000");
    assert!(!link.core.exchange.must_learn_echo(), "the line does not echo");
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_echo();
    assert_eq!(link.expect_send(), Code::ReadStatus);
    link.receive_frame(1, 0x40, b"0010000");
    assert!(result(&mut status).unwrap().is_ok());
    let mut empty = link.call(1, LoopBack::empty());
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.receive_frame(1, 0x4E, b"");
    assert!(result(&mut empty).unwrap().is_ok());
    assert_eq!(link.stats().echoes, 0);
}
