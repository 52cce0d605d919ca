use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;

use super::*;
use crate::command::{LoopBack, ReadRegisters, ReadStatus, StackReply, WriteRegisters};
use crate::element::Register;

pub(super) fn call(options: CallOptions) -> (PendingCall, CallFuture<ReadStatus>) {
    call_of(ReadStatus, options)
}

fn call_of<C: Command>(request: C, options: CallOptions) -> (PendingCall, CallFuture<C>) {
    let queued_at = Instant::now();
    let meta = CallMeta {
        station: 7,
        code: C::CODE,
        lane: Lane::Read,
        deadline: queued_at + options.call_timeout,
        queued_at,
        confirms: false,
        plain: request.plain(),
    };
    let sending = Sending { response_timeout: Duration::from_secs(1), adaptive: options.adaptive, part: false };
    new(request, meta, sending, &options)
}

fn result<C: Command>(future: &mut CallFuture<C>) -> Option<Result<(), Error>> {
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
        for before in 0..sends {
            assert_eq!(call.slot.mark_sent(), Some(before > 0));
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
    assert!(first.slot.mark_sent().is_none() && !first.slot.was_sent());
    let (second, future) = call(CallOptions::new());
    assert!(second.slot.mark_sent().is_some());
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

#[test]
fn an_uncounted_transmission_is_no_repetition() {
    let (call, mut future) = call(CallOptions::new());
    call.slot.mark_sent();
    call.slot.uncount_send();
    call.slot.mark_sent();
    let Error::Timeout { sent: true, attempts: 1, .. } = call.unanswered(Duration::ZERO) else {
        panic!("expected one attempt")
    };
    call.slot.try_complete(Framing::Ascii, 7, b"4", Instant::now()).expect("a refusal");
    call.slot.commit(Proof::default());
    assert!(matches!(result(&mut future), Some(Err(Error::Plc { repeated: false, .. }))));
}

#[test]
fn errors_list_the_traffic_of_all_attempts() {
    let (mut call, _future) = call(CallOptions::new());
    call.slot.note(&Seen { garbage: 3, half_frame: true, ..Seen::default() });
    call.slot.note(&Seen { garbage: 4, other_station: Some(9), ..Seen::default() });
    let noted = Seen { garbage: 7, other_station: Some(9), half_frame: true, ..Seen::default() };
    let Error::Timeout { seen, .. } = call.unanswered(Duration::ZERO) else { panic!("expected a timeout") };
    assert_eq!(seen, noted);
    call.cause = Some(Box::new(Cause::Fault("an incomplete frame".to_owned())));
    let Error::BadReply { seen, .. } = call.unanswered(Duration::ZERO) else { panic!("expected a bad reply") };
    assert_eq!(seen, Seen { half_frame: false, ..noted }, "the reason has the incomplete frame already");
}

#[test]
fn a_timeout_says_whether_the_check_was_unanswered() {
    let (call, _future) = call(CallOptions::new());
    let checked = || match call.unanswered(Duration::ZERO) {
        Error::Timeout { checked, .. } => checked,
        error => panic!("{error:?}"),
    };
    assert!(!checked());
    call.slot.mark_checked();
    assert!(checked());
    call.slot.check_answered();
    assert!(!checked());
}

#[test]
fn a_withdrawn_transmission_leaves_what_was_sent_before() {
    let (call, _future) = call(CallOptions::new());
    for sends in 0..3 {
        // Nothing of it was written, any number of times.
        for _ in 0..2 {
            let before = call.slot.mark_sent().expect("the caller waits");
            call.slot.withdraw_send(before);
        }
        let Error::Timeout { sent, attempts, .. } = call.unanswered(Duration::ZERO) else { panic!("a timeout") };
        assert_eq!((sent, attempts, call.slot.was_sent()), (sends > 0, sends, sends > 0));
        call.slot.mark_sent();
    }
}

#[test]
fn a_call_that_waits_for_silence_ends_out_of_step() {
    let (call, _future) = call(CallOptions::new());
    let is_out_of_step = || matches!(call.unanswered(Duration::ZERO), Error::OutOfStep { station: 7, sent: false, .. });
    call.slot.await_silence();
    assert!(is_out_of_step());
    call.slot.mark_checked();
    assert!(!is_out_of_step(), "a check was sent instead");
    call.slot.await_silence();
    assert!(is_out_of_step());
    call.slot.mark_sent();
    assert!(!is_out_of_step());
}

const STATUS: &[u8] = b"0010000";

#[test]
fn a_retracted_reply_is_no_result_and_a_result_stays() {
    let (first, mut future) = call(CallOptions::new());
    assert_eq!(first.slot.try_complete(Framing::Ascii, 7, STATUS, Instant::now()), Ok(None));
    first.slot.retract();
    first.slot.commit(Proof::default());
    assert!(matches!(result(&mut future), Some(Err(Error::Closed { .. }))), "there is no reply");

    let (second, mut future) = call(CallOptions::new());
    assert_eq!(second.slot.try_complete(Framing::Ascii, 7, STATUS, Instant::now()), Ok(None));
    second.slot.commit(Proof::default());
    second.slot.retract();
    assert!(matches!(result(&mut future), Some(Ok(()))), "the call has ended");
}

/// The reply stays in the slot when its values are copied from there. Neither a later call nor a frame that
/// is no reply may bring it again.
#[test]
fn a_reply_in_a_slot_is_the_result_of_its_own_call_only() {
    while spares::take::<StackReply<ReadRegisters<Register>, 4>>().is_some() {}
    let read = || StackReply::<_, 4>(ReadRegisters::new(Register::r(0), 2).expect("a read"));
    let reply = |call: &PendingCall, data: &[u8]| call.slot.try_complete(Framing::Ascii, 7, data, Instant::now());
    let copied = |future: &mut CallFuture<StackReply<ReadRegisters<Register>, 4>>| {
        future.take_result(|reply| Some(reply.as_ref()?.as_slice().to_vec())).0
    };
    let (first, mut future) = call_of(read(), CallOptions::new());
    assert_eq!(reply(&first, b"000010002"), Ok(None));
    first.slot.commit(Proof::default());
    assert!(matches!(copied(&mut future), Ok(values) if values == [1, 2]));
    assert!(matches!(copied(&mut future), Err(Error::Closed { .. })), "it is taken once");
    drop(first);
    future.recycle();

    let (second, mut future) = call_of(read(), CallOptions::new());
    assert!(spares::take::<StackReply<ReadRegisters<Register>, 4>>().is_none(), "it has the slot of the first call");
    second.slot.commit(Proof::default());
    assert!(matches!(copied(&mut future), Err(Error::Closed { .. })), "it has had no reply");

    let (third, mut future) = call_of(read(), CallOptions::new());
    assert_eq!(reply(&third, b"000030004"), Ok(None));
    assert_eq!(reply(&third, b"00005000X"), Err(FieldError::NotHex(b'X')));
    third.slot.commit(Proof::default());
    assert!(matches!(copied(&mut future), Err(Error::Closed { .. })), "the held reply is replaced by none");
}

#[test]
fn a_reply_to_an_abandoned_call_does_not_end_it() {
    let (call, mut future) = call(CallOptions::new());
    future.abandon();
    assert_eq!(call.slot.try_complete(Framing::Ascii, 7, STATUS, Instant::now()), Ok(None));
    call.slot.commit(Proof::default());
    assert!(result(&mut future).is_none());
}

#[test]
fn the_caller_learns_proofs_and_doubts_of_its_reply() {
    let (call, future) = call(CallOptions::new());
    let proof = Proof { proofs: 0x0123_4567, doubts: 0x89AB_CDEF };
    call.slot.commit(proof);
    assert_eq!(future.proof(), proof);
}

#[test]
fn only_a_loop_back_of_one_byte_could_be_a_refusal() {
    for (data, kind) in [("", Kind::Read), ("4", Kind::Once), ("44", Kind::Read)] {
        let request = LoopBack::new(data).expect("a short one");
        let (call, _future) = call_of(request, CallOptions::new());
        assert_eq!(call.kind, kind, "{data:?}");
    }
}

#[test]
fn replies_to_reads_show_which_elements_exist() {
    let first = Register::r(5);
    let (read, _future) = call_of(ReadRegisters::new(first, 3).expect("a read"), CallOptions::new());
    assert_eq!(read.slot.run(), Some(Run { first: first.into(), count: 3 }));
    let (write, _future) = call_of(WriteRegisters::new(first, [1]).expect("a write"), CallOptions::new());
    assert_eq!(write.slot.run(), None, "some elements can be written only");
}

/// Takes the slots that other tests of the thread have left.
fn take_all() {
    while spares::take::<ReadStatus>().is_some() || spares::take::<LoopBack>().is_some() {}
}

/// Ends a call and leaves its slot to later calls.
fn end<C: Command>((call, mut future): (PendingCall, CallFuture<C>)) {
    call.expire();
    drop(call);
    assert!(result(&mut future).is_some());
    future.recycle();
}

#[test]
fn the_slot_of_an_ended_call_serves_a_later_call_of_its_type() {
    take_all();
    end(call_of(ReadStatus, CallOptions::new()));
    end(call_of(LoopBack::empty(), CallOptions::new()));
    assert!(spares::take::<ReadStatus>().is_some(), "the slot of another type is newer");
    assert!(spares::take::<LoopBack>().is_some());
    assert!(spares::take::<ReadStatus>().is_none(), "each serves one call");

    end(call_of(ReadStatus, CallOptions::new()));
    let (call, mut future) = call_of(ReadStatus, CallOptions::new());
    assert!(spares::take::<ReadStatus>().is_none(), "the new call has it");
    assert!(!call.slot.was_sent() && result(&mut future).is_none(), "nothing of the earlier call is left");
}

#[test]
fn the_slot_of_a_call_under_way_serves_no_other() {
    take_all();
    let (call, mut future) = call(CallOptions::new());
    call.expire();
    assert!(result(&mut future).is_some());
    future.recycle();
    assert!(spares::take::<ReadStatus>().is_none(), "the link still has it");
    drop(call);
    assert!(spares::take::<ReadStatus>().is_some());

    let (call, future) = self::call(CallOptions::new());
    future.recycle();
    drop(call);
    assert!(spares::take::<ReadStatus>().is_none(), "its caller did not see its end");
}

#[test]
fn the_data_of_an_ended_call_are_not_kept() {
    take_all();
    let data = Bytes::from(vec![b'A'; 200]);
    let request = LoopBack::new(data.clone()).expect("not too long");
    end(call_of(request, CallOptions::new()));
    assert!(data.is_unique());
    assert!(spares::take::<LoopBack>().is_some(), "only its slot is");
}
