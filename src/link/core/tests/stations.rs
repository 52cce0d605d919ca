//! Offline stations and probes.

use super::test_link::{TIMEOUT, TestLink, read, result};
use crate::command::Code;
use crate::error::Error;
use crate::link::core::Action;
use crate::link::options::CallOptions;
use crate::wire::Framing;

#[test]
fn response_timeouts_take_a_station_offline_also_of_calls_with_an_earlier_deadline() {
    for options in [CallOptions::new().with_call_timeout(TIMEOUT / 2), CallOptions::new()] {
        let mut link = TestLink::new(Framing::Ascii);
        for _ in 0..3 {
            let _call = link.call_with(1, read(1), options.with_retries(0));
            link.expect_send();
            link.advance(TIMEOUT);
            link.next_action();
        }
        let mut call = link.call(1, read(1));
        assert!(matches!(result(&mut call), Some(Err(Error::Offline { sent: false, .. }))));
    }
}

#[test]
fn bad_replies_do_not_take_a_station_offline() {
    let mut link = TestLink::new(Framing::Ascii);
    for _ in 0..9 {
        let _call = link.call_with(1, read(1), CallOptions::new().with_retries(0));
        if link.expect_send() == Code::LoopBack {
            link.receive_echo();
            link.expect_send();
        }
        link.receive_frame(1, 0x46, b"0");
        link.advance(TIMEOUT);
        link.next_action();
    }
    assert_eq!(link.station_stats(1).bad_replies, 9);
    assert_eq!(link.core.stations.offline_until(1), None);
}

#[test]
fn calls_waiting_for_a_station_that_goes_offline_fail() {
    let mut link = TestLink::with(Framing::Ascii, |config| config.offline_rules.offline_after = 1);
    let _lost = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    let mut waiting = link.call(1, read(1));
    let mut other = link.call(2, read(1));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    assert!(matches!(result(&mut waiting), Some(Err(Error::Offline { station: 1, sent: false, .. }))));
    link.expect_send();
    link.receive_frame(2, 0x46, b"00002");
    assert_eq!(result(&mut other).unwrap().unwrap(), [2]);
}

#[test]
fn a_new_connection_probes_offline_stations_at_once() {
    let mut link = TestLink::with(Framing::Ascii, |config| config.offline_rules.offline_after = 1);
    let _silent = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    assert!(link.core.stations.offline_until(1).is_some());
    let _call = link.call(2, read(1));
    link.core.connected(link.now);
    assert_eq!(link.expect_send(), Code::LoopBack);
    assert_eq!(&link.sent[1..3], b"01", "the station that is offline");
}

/// With several addresses of the host, a connection is replaced at its first call without an answer.
///
/// With probes counted as well, the probe of station 1 would end each connection before station 2
/// was asked anything.
#[test]
fn a_probe_does_not_end_the_trial_of_an_address() {
    let mut link = TestLink::with(Framing::Ascii, |config| {
        config.offline_rules.offline_after = 1;
        config.mute_timeout = Some(TIMEOUT * 50);
    });
    let _silent = link.call_with(1, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    let mut call = link.call(2, read(1));
    link.core.connected(link.now);
    link.core.note_other_addresses();
    assert_eq!((link.expect_send(), &link.sent[1..3]), (Code::LoopBack, &b"01"[..]), "the probe");
    link.advance(TIMEOUT);
    link.next_action();
    link.expect_send();
    assert_eq!(&link.sent[1..3], b"02");
    link.advance(TIMEOUT);
    link.next_action();
    assert!(matches!(link.next_action(), Action::Replace(_)), "a call had no answer");
    link.core.disconnected(&std::sync::Arc::new(std::io::ErrorKind::TimedOut.into()), link.now);
    let address = link.core.address();
    assert!(address > 0);
    // A reply ends all trials.
    link.core.connected(link.now);
    link.core.note_other_addresses();
    for _ in 0..4 {
        if result(&mut call).is_some() {
            break;
        }
        match link.expect_send() {
            Code::LoopBack if &link.sent[1..3] == b"02" => link.receive_echo(),
            Code::LoopBack => {
                link.advance(TIMEOUT);
                link.next_action();
            }
            _ => link.receive_frame(2, 0x46, b"00002"),
        }
    }
    let _lost = link.call_with(2, read(1), CallOptions::new().with_retries(0));
    link.expect_send();
    link.advance(TIMEOUT);
    link.next_action();
    assert!(!matches!(link.next_action(), Action::Replace(_)), "one lost datagram of an address that has answered");
    assert_eq!(link.core.address(), address);
}
