use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};

use super::*;
use crate::command::ReadStatus;

fn call(options: CallOptions) -> (PendingCall, CallFuture<ReadStatus>) {
    let queued_at = Instant::now();
    let meta = CallMeta {
        station: 7,
        code: ReadStatus::CODE,
        lane: Lane::Read,
        deadline: queued_at + options.call_timeout,
        queued_at,
        response_timeout: Duration::from_secs(1),
        options,
        part: false,
        confirms: false,
    };
    new(ReadStatus, None, meta, &SpareSlots::default())
}

fn result(future: &mut CallFuture<ReadStatus>) -> Option<Result<(), Error>> {
    let mut context = Context::from_waker(std::task::Waker::noop());
    match Pin::new(future).poll(&mut context) {
        Poll::Ready(result) => Some(result.map(drop)),
        Poll::Pending => None,
    }
}

#[test]
fn a_call_is_wanted_until_its_deadline_or_until_abandoned() {
    let (call, future) = call(CallOptions::new());
    let just_before = call.deadline - Duration::from_nanos(1);
    assert!(call.is_wanted(just_before));
    assert!(!call.is_wanted(call.deadline));
    assert!(!call.slot.is_abandoned());
    drop(future);
    assert!(call.slot.is_abandoned() && !call.is_wanted(just_before));
}

#[test]
fn an_expired_call_says_its_timeout_and_whether_it_was_sent() {
    for sends in 0..=2 {
        let (call, mut future) = call(CallOptions::new().with_call_timeout(Duration::from_secs(3)));
        for _ in 0..sends {
            assert!(call.slot.mark_sent());
        }
        call.expire();
        drop(call);
        let Some(Err(Error::Timeout { station: 7, code: Code::ReadStatus, after, sent, attempts, .. })) =
            result(&mut future)
        else {
            panic!("expected the timeout, which was first")
        };
        assert_eq!((after, sent, attempts), (Duration::from_secs(3), sends > 0, sends));
    }
}

#[test]
fn the_first_result_stays_and_an_abandoned_call_gets_none() {
    let (call, mut future) = call(CallOptions::new());
    call.expire();
    call.slot.fail(Error::Closed { sent: false });
    assert!(matches!(result(&mut future), Some(Err(Error::Timeout { .. }))));
    let (call, mut future) = self::call(CallOptions::new());
    future.abandon();
    call.expire();
    assert!(result(&mut future).is_none());
}

#[test]
fn a_call_ends_when_its_pending_half_is_dropped() {
    let (call, mut future) = call(CallOptions::new());
    assert!(result(&mut future).is_none());
    drop(call);
    assert!(matches!(result(&mut future), Some(Err(Error::Closed { sent: false }))));
    assert!(matches!(result(&mut future), Some(Err(Error::Closed { sent: true }))), "polled after it was ready");
}

#[test]
fn an_abandoned_call_is_sent_never_or_was_sent_before() {
    let (first, future) = call(CallOptions::new());
    assert!(!future.abandon());
    assert!(!first.slot.mark_sent() && !first.slot.was_sent());
    let (second, future) = call(CallOptions::new());
    assert!(second.slot.mark_sent());
    assert!(future.abandon() && second.slot.was_sent());
}

#[test]
fn a_refusal_says_whether_the_request_was_repeated() {
    for sends in 1..=3 {
        let (call, mut future) = call(CallOptions::new());
        for _ in 0..sends {
            call.slot.mark_sent();
        }
        let refusal = call.slot.try_complete(Framing::Ascii, 7, b"4", Instant::now());
        assert_eq!(refusal.expect("a refusal"), ErrorCode::from_u8(4));
        assert!(result(&mut future).is_none(), "the result is held");
        call.slot.commit(Proof::default());
        let Some(Err(Error::Plc { repeated, .. })) = result(&mut future) else { panic!("expected a refusal") };
        assert_eq!(repeated, sends > 1);
    }
}

#[test]
fn debug_output_names_station_command_and_lane() {
    let (call, _completion) = call(CallOptions::new());
    assert_eq!(format!("{call:?}"), "PendingCall(station 7, read brief status (40h), Read)");
}
