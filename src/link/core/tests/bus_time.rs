//! The time in which the line was in use, exchange by exchange.

use std::sync::Arc;
use std::time::Duration;

use super::test_link::{MS, TIMEOUT, TestLink, read, write};
use crate::command::Code;
use crate::link::frame_gap::GapLengths;
use crate::link::options::CallOptions;
use crate::wire::Framing;

const GAP: Duration = Duration::from_millis(3);

fn link() -> TestLink {
    TestLink::with(Framing::Ascii, |config| {
        config.frame_gap = GapLengths::fixed(GAP);
        config.broadcast_gap = 20 * MS;
    })
}

fn bus_time(link: &TestLink) -> Duration {
    link.stats().bus_time
}

#[test]
fn it_is_from_request_to_reply_and_the_frame_gap() {
    let mut link = link();
    for n in 1..=3 {
        // The first register of each reply differs, so that no reply is a duplicate of the one before.
        let count = 1 + usize::try_from(n).expect("small");
        let _call = link.call(1, read(count));
        assert_eq!(link.expect_send(), Code::ReadRegisters);
        link.advance(10 * MS);
        assert_eq!(bus_time(&link), (10 * MS + GAP) * (n - 1), "it is added at the end");
        link.receive_reply(1, &read(count), &vec![7; count]);
        assert_eq!(bus_time(&link), (10 * MS + GAP) * n);
        // A time without requests does not count.
        link.advance(50 * MS);
        link.next_action();
    }
}

#[test]
fn a_timeout_a_check_and_a_lost_connection_count() {
    let mut link = link();
    let _call = link.call_with(1, read(1), CallOptions::new().with_retries(1));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    assert_eq!(bus_time(&link), TIMEOUT);
    assert_eq!(link.expect_send(), Code::LoopBack);
    link.advance(4 * MS);
    link.receive_echo();
    assert_eq!(bus_time(&link), TIMEOUT + 4 * MS + GAP);
    link.advance(GAP);
    assert_eq!(link.expect_send(), Code::ReadRegisters);
    link.advance(5 * MS);
    link.core.disconnected(&Arc::new(std::io::ErrorKind::ConnectionReset.into()), link.now);
    assert_eq!(bus_time(&link), TIMEOUT + 9 * MS + GAP);
}

#[test]
fn a_broadcast_counts_with_its_gap_and_a_withheld_request_does_not() {
    let mut link = link();
    let _call = link.call(0, write());
    link.expect_send();
    assert_eq!(bus_time(&link), 20 * MS);
    link.advance(20 * MS);
    for (partly, counts) in [(false, 0), (true, 6)] {
        let before = bus_time(&link);
        let _call = link.call(2, write());
        link.next_action();
        link.advance(6 * MS);
        link.core.gate_closed(partly, link.now);
        assert_eq!(bus_time(&link) - before, counts * MS, "cut: {partly}");
    }
}

/// Without it, neither counted: a link over a stream that cannot be opened again had a load of 0 when its peer closed
/// in the middle of a request.
#[test]
fn an_exchange_that_ends_with_its_link_or_runtime_counts() {
    for runtime in [false, true] {
        let mut link = link();
        let _call = link.call(1, read(1));
        link.expect_send();
        link.advance(7 * MS);
        let error = Arc::new(std::io::ErrorKind::ConnectionReset.into());
        match runtime {
            false => link.core.abort(&error, link.now),
            true => link.core.runtime_ended(&error, link.now),
        }
        assert_eq!(bus_time(&link), 7 * MS, "runtime: {runtime}");
        // Nothing is on the line any more.
        link.advance(7 * MS);
        link.core.abort(&error, link.now);
        assert_eq!(bus_time(&link), 7 * MS, "runtime: {runtime}");
    }
}
