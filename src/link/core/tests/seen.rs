//! The traffic that came instead of a reply, as the error of the call tells it.

use bytes::BytesMut;

use super::test_link::{TIMEOUT, TestLink, read, result};
use crate::command::Code;
use crate::error::{Error, Seen};
use crate::link::options::{CallOptions, EchoMode};
use crate::transport::LateDatagrams;
use crate::wire::{FieldWriter as _, Framing, ascii};

/// Sends a read to station 1, lets traffic come, and returns what the error of its timeout has seen.
fn seen(link: &mut TestLink, traffic: impl FnOnce(&mut TestLink)) -> Seen {
    let mut call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    if link.expect_send() == Code::LoopBack {
        traffic(link);
        link.receive_echo();
        link.expect_send();
    } else {
        traffic(link);
    }
    // A frame that has begun extends the wait.
    for _ in 0..100 {
        link.advance(TIMEOUT);
        link.next_action();
        match result(&mut call) {
            None => {}
            Some(Err(Error::Timeout { seen, .. } | Error::BadReply { seen, .. })) => return seen,
            Some(other) => panic!("{other:?}"),
        }
    }
    panic!("the call does not end");
}

#[test]
fn each_kind_of_traffic_is_told_apart() {
    let nothing = Seen::default();
    let mut link = TestLink::new(Framing::Ascii);
    assert_eq!(seen(&mut link, |_| ()), nothing);

    let mut link = TestLink::new(Framing::Ascii);
    let garbage = seen(&mut link, |link| link.receive(b"\xF0\xF1\xF2"));
    assert_eq!(garbage, Seen { garbage: 3, ..nothing });

    // A corrupt frame is no garbage: it is the fault of the reply.
    let mut link = TestLink::new(Framing::Ascii);
    let corrupt = seen(&mut link, |link| link.receive(b"\x0201460000000\x03"));
    assert_eq!(corrupt, nothing);

    let mut link = TestLink::new(Framing::Ascii);
    let other = seen(&mut link, |link| link.receive_frame(9, 0x46, b"00001"));
    assert_eq!(other, Seen { other_station: Some(9), ..nothing });

    // The reason of a bad reply names an incomplete frame, so it is not told twice.
    let mut link = TestLink::new(Framing::Ascii);
    let half = seen(&mut link, |link| {
        link.advance(TIMEOUT * 9 / 10);
        link.receive(b"\x020146");
    });
    assert_eq!(half, nothing);

    // Of another station, and whole in the end.
    let mut link = TestLink::new(Framing::Ascii);
    let slow = seen(&mut link, |link| {
        link.advance(TIMEOUT * 9 / 10);
        let mut frame = BytesMut::new();
        ascii::emit(&mut frame, 9, 0x46, |fields| fields.raw(b"00001"));
        let rest = frame.split_off(6);
        link.receive(&frame);
        link.advance(TIMEOUT / 5);
        link.receive(&rest);
    });
    assert_eq!(slow, Seen { other_station: Some(9), half_frame: true, ..nothing });

    let mut link = TestLink::with(Framing::Ascii, |config| config.echo = EchoMode::On);
    let echo = seen(&mut link, TestLink::receive_echo);
    assert_eq!(echo, Seen { echo: true, ..nothing });
}

#[test]
fn a_late_reply_tells_by_how_much() {
    let mut link = TestLink::new(Framing::Ascii);
    assert_eq!(seen(&mut link, |_| ()), Seen::default());
    // Its reply comes during the check before the next request.
    let late = seen(&mut link, |link| {
        link.advance(TIMEOUT / 4);
        link.receive_frame(1, 0x46, b"00001");
    });
    assert_eq!(late, Seen { late_by: Some(TIMEOUT / 4), ..Seen::default() });
    assert_eq!(link.station_stats(1).late_replies, 1);
}

#[test]
fn only_the_late_reply_of_the_station_itself_is_late_by_a_time() {
    // A frame that no request explains.
    let mut link = TestLink::new(Framing::Ascii);
    seen(&mut link, |_| ());
    let unexpected = seen(&mut link, |link| link.receive_frame(1, 0x40, b"0000000"));
    assert_eq!(unexpected.late_by, None);
    assert_eq!(link.station_stats(1).stray_frames, 1);

    // The late reply of another station than that of the last timeout.
    let mut link = TestLink::new(Framing::Ascii);
    let _other = link.call_with(2, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    seen(&mut link, |_| ());
    let late = seen(&mut link, |link| link.receive_frame(2, 0x46, b"00001"));
    assert_eq!((late.late_by, late.other_station), (None, Some(2)));
    assert_eq!(link.station_stats(2).late_replies, 1);
}

#[test]
fn frames_of_stations_that_were_never_asked_are_no_answers_to_broadcasts() {
    let mut link = TestLink::new(Framing::Ascii);
    link.receive_frame(0, 0x41, b"0");
    link.receive_frame(77, 0x41, b"0");
    assert_eq!((link.station_stats(0).broadcast_answers, link.station_stats(0).stray_frames), (1, 0));
    assert_eq!((link.station_stats(77).broadcast_answers, link.station_stats(77).stray_frames), (0, 1));
}

#[test]
fn late_datagrams_are_counted_and_others_than_duplicates_are_a_doubt() {
    for (duplicates, others, doubts) in [(0, 0, 0), (2, 0, 0), (0, 3, 1), (1, 2, 1)] {
        let mut link = TestLink::new(Framing::Ascii);
        let proof = |link: &mut TestLink| link.core.stations.with_in_step(1, |in_step| in_step.proof());
        let before = proof(&mut link);
        link.core.late_datagrams(LateDatagrams { duplicates, others });
        assert_eq!(link.stats().late_datagrams, duplicates + others);
        assert_eq!(proof(&mut link).doubts - before.doubts, doubts, "{duplicates} duplicates, {others} others");
    }
}
