//! The allocation that caller and link share for one call, and the caller's future.
//!
//! Memory order: the result is written under its mutex before `DONE` is set with `AcqRel`, and the
//! future reads `DONE` with `Acquire`. `proof` is stored before `DONE`, too, so `Relaxed` suffices
//! for it. The spelling is stored after `SENT` and before `DONE`: a caller that has no result may read
//! the one before.

use std::future::{Future, poll_fn};
use std::pin::Pin;
use std::sync::atomic::{AtomicU8, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::BytesMut;
use tokio::runtime::Id;
use tokio::time::Instant;

use super::deadline::{CallTask, CallTimer};
use super::{AnyCall, Sending, lock, spares};
use crate::command::{self, Candidates, Class, Code, Command, NO_CANDIDATES, ReplyError, Run, Spelling};
use crate::error::{Error, ErrorCode, Seen};
use crate::link::in_step::{Proof, Shape};
use crate::wire::{FieldError, Framing};

/// The caller's half of a call: a future of its result. Dropping it abandons the call.
#[derive(Debug)]
pub(crate) struct CallFuture<C: Command> {
    slot: Arc<CallSlot<C>>,
    /// The timer of the deadline, or the one that the slot was kept with.
    timer: Option<Box<CallTimer>>,
}

impl<C: Command> CallFuture<C> {
    pub(super) fn new(slot: Arc<CallSlot<C>>, timer: Option<Box<CallTimer>>) -> Self {
        Self { slot, timer }
    }

    /// Gives the call up. Returns whether the request, or a part of it, has been sent; if not, it
    /// never will be.
    pub(crate) fn abandon(&self) -> bool {
        self.slot.state.fetch_or(ABANDONED, Ordering::AcqRel) & SENT != 0
    }

    /// Sets the timer of the deadline. The caller runs on this runtime: its timer must not be made by a
    /// later poll, which may be on another one.
    ///
    /// # Panics
    /// The runtime has no timers. So this comes before the request is sent.
    pub(crate) fn set_timer(&mut self, deadline: Instant, runtime: Id) {
        match &mut self.timer {
            Some(timer) if timer.runtime() == runtime => timer.begin(deadline),
            Some(_) | None => {
                self.timer = Some(Box::new(CallTimer::new(deadline, runtime, self.slot.task.clone())));
            }
        }
    }

    /// Waits until the call has ended or its deadline has passed, for which the timer is set. Returns
    /// whether it has ended. [`take_result`](Self::take_result) has its result then.
    pub(crate) async fn ended_by(&mut self, deadline: Instant) -> bool {
        debug_assert!(self.timer.is_some(), "a call waits without a timer");
        let (slot, timer) = (&self.slot, &mut self.timer);
        poll_fn(|cx| match (slot.poll_ended(cx), &mut *timer) {
            (Poll::Ready(()), _) => Poll::Ready(true),
            (Poll::Pending, Some(timer)) => timer.poll(deadline).map(|()| false),
            (Poll::Pending, None) => Poll::Pending,
        })
        .await
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.slot.has_ended()
    }

    /// Takes the result of a call that has ended, and when its reply came, if there was one; `take` takes
    /// the reply. A result that was taken already is an error rather than a panic.
    #[inline]
    pub(crate) fn take_result<T>(
        &self,
        take: impl FnOnce(&mut Option<C::Reply>) -> Option<T>,
    ) -> (Result<T, Error>, Option<Instant>) {
        let mut slot = lock(&self.slot.result);
        let CallResult { result, reply, at } = &mut *slot;
        let reply = match result.take() {
            Some(Err(error)) => return (Err(error), at.take()),
            Some(Ok(())) => take(reply),
            None => None,
        };
        let Some(reply) = reply else { return (Err(Error::Closed { sent: true }), at.take()) };
        (Ok(reply), at.take())
    }

    /// The error of the call if it ends without a reply after this time.
    pub(crate) fn unanswered(&self, after: Duration) -> Error {
        self.slot.unanswered(after, None)
    }

    /// The spelling of the request that was answered.
    pub(crate) fn spelling(&self) -> Spelling {
        self.slot.spelling()
    }

    /// Shape of the positive reply to the spelling that was sent.
    pub(crate) fn shape(&self, framing: Framing) -> Shape {
        self.slot.shape(self.slot.spelling(), framing)
    }

    /// The station's proof when the reply was taken.
    pub(crate) fn proof(&self) -> Proof {
        let bits = self.slot.proof.load(Ordering::Relaxed);
        let [p0, p1, p2, p3, d0, d1, d2, d3] = bits.to_be_bytes();
        Proof { proofs: u32::from_be_bytes([p0, p1, p2, p3]), doubts: u32::from_be_bytes([d0, d1, d2, d3]) }
    }

    /// Leaves slot and timer to a later call if this one has ended.
    pub(crate) fn recycle(mut self) {
        if self.has_ended() {
            let (slot, timer) = (self.slot.clone(), self.timer.take());
            // `keep` wants a slot that has no other holder.
            drop(self);
            // The wake-up at the end of the call takes the waker. Until then the link has the slot, too, and it
            // is given to no other call.
            spares::keep(slot, timer);
        }
    }
}

/// The result of the call.
impl<C: Command> Future for CallFuture<C> {
    type Output = Result<C::Reply, Error>;

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        self.slot.poll_ended(cx).map(|()| self.take_result(Option::take).0)
    }
}

impl<C: Command> Drop for CallFuture<C> {
    fn drop(&mut self) {
        if !self.has_ended() {
            self.abandon();
        }
    }
}

#[derive(Debug)]
pub(super) struct CallSlot<C: Command> {
    /// `None` only in a spare slot.
    request: Option<C>,
    station: u8,
    sending: Sending,
    state: AtomicU8,
    /// How many times the request has been sent, at most 255.
    sends: AtomicU8,
    /// The spelling: whether it begins one element earlier, the code, the number of elements.
    spelling: AtomicU32,
    /// The upper half is the number of proofs, the lower half that of doubts.
    proof: AtomicU64,
    /// Traffic received instead of the reply.
    seen: Mutex<Seen>,
    result: Mutex<CallResult<C>>,
    task: Arc<CallTask>,
}

/// The result of a call. A reply may be large: it is decoded here, and the caller takes it from here.
#[derive(Debug)]
struct CallResult<C: Command> {
    /// `None` before the call has ended, and after the result was taken. `Ok`: `reply` is the result.
    result: Option<Result<(), Error>>,
    /// Otherwise anything: a reply that was retracted, or the one of an earlier call.
    reply: Option<C::Reply>,
    /// When the reply came, if there was one.
    at: Option<Instant>,
}

impl<C: Command> CallResult<C> {
    const NONE: Self = Self { result: None, reply: None, at: None };
}

/// Bits of the state. A call that is neither done nor abandoned is queued or on the wire.
const DONE: u8 = 1;
const ABANDONED: u8 = 2;
/// The request has been sent at least once. The bit stays when the request is queued again.
const SENT: u8 = 4;
/// The call waits for the quiet time of its station.
const AWAITS_SILENCE: u8 = 8;
/// A check was sent for the call, and not answered yet.
const CHECKED: u8 = 16;

impl<C: Command> CallSlot<C> {
    pub(super) fn new(request: C, station: u8, sending: Sending) -> Self {
        Self {
            request: Some(request),
            station,
            sending,
            state: AtomicU8::new(0),
            sends: AtomicU8::new(0),
            spelling: AtomicU32::new(0),
            proof: AtomicU64::new(0),
            seen: Mutex::default(),
            result: Mutex::new(CallResult::NONE),
            task: Arc::default(),
        }
    }

    /// Reuses the slot of a call that has ended.
    pub(super) fn begin(&mut self, request: C, station: u8, sending: Sending) {
        self.request = Some(request);
        (self.station, self.sending) = (station, sending);
        *self.state.get_mut() = 0;
        *self.sends.get_mut() = 0;
        *self.spelling.get_mut() = 0;
        *self.proof.get_mut() = 0;
        *self.seen.get_mut().unwrap_or_else(PoisonError::into_inner) = Seen::default();
        let result = self.result.get_mut().unwrap_or_else(PoisonError::into_inner);
        (result.result, result.at) = (None, None);
    }

    /// The request of a call under way.
    fn request(&self) -> Option<&C> {
        debug_assert!(self.request.is_some(), "only a spare slot has no request");
        self.request.as_ref()
    }

    /// Drops the request, and with it the values of a write.
    pub(super) fn drop_request(&mut self) {
        self.request = None;
    }

    /// Stores a result that may still be taken back, unless the call has ended: the first result stays.
    /// Returns `false` if it has.
    fn hold(&self, store: impl FnOnce(&mut CallResult<C>)) -> bool {
        let mut slot = lock(&self.result);
        let wanted = self.is_wanted();
        if wanted {
            store(&mut slot);
        }
        wanted
    }

    /// Returns whether the call has not ended, and its caller waits.
    fn is_wanted(&self) -> bool {
        self.state.load(Ordering::Acquire) & (DONE | ABANDONED) == 0
    }

    /// Returns the spelling that was encoded last; before the first one, that of the caller.
    fn spelling(&self) -> Spelling {
        let [before, code, high, low] = self.spelling.load(Ordering::Acquire).to_be_bytes();
        match Code::from_u8(code) {
            Some(code) => Spelling { code, count: u16::from_be_bytes([high, low]), before: before != 0 },
            None => self.request().map_or(Spelling::new(C::CODE, 0), C::plain),
        }
    }

    /// Returns the error code of a reply that is not wanted, if it is a refusal.
    #[cold]
    fn judge(&self, request: &C, framing: Framing, data: &[u8]) -> Result<Option<ErrorCode>, FieldError> {
        command::refusal_in(command::decode_spelled_into(request, self.spelling(), framing, data, &mut None))
    }

    fn done(&self) {
        self.state.fetch_or(DONE, Ordering::AcqRel);
        self.task.wake();
    }

    fn has_ended(&self) -> bool {
        self.state.load(Ordering::Acquire) & DONE != 0
    }

    /// Waits for the end of the call.
    fn poll_ended(&self, cx: &Context<'_>) -> Poll<()> {
        if self.has_ended() {
            return Poll::Ready(());
        }
        self.task.register(cx.waker());
        // Checked again: the call may have ended before the waker was registered, and have woken no
        // task.
        if self.has_ended() {
            self.task.clear();
            return Poll::Ready(());
        }
        Poll::Pending
    }
}

impl<C: Command> AnyCall for CallSlot<C> {
    fn sending(&self) -> Sending {
        self.sending
    }

    fn candidates(&self, framing: Framing) -> Candidates {
        self.request().map_or(NO_CANDIDATES, |request| request.candidates(self.sending.part, framing))
    }

    fn shape(&self, spelling: Spelling, framing: Framing) -> Shape {
        let size = self.request().map_or(0, |request| request.reply_size(spelling, framing));
        Shape { code: spelling.code, size }
    }

    fn run(&self) -> Option<Run> {
        self.request().filter(|_| C::CODE.class() == Class::Read)?.run()
    }

    fn encode(&self, spelling: Spelling, framing: Framing, station: u8, dst: &mut BytesMut) -> Shape {
        let [high, low] = spelling.count.to_be_bytes();
        let bits = u32::from_be_bytes([spelling.before.into(), spelling.code.into(), high, low]);
        self.spelling.store(bits, Ordering::Release);
        if let Some(request) = self.request() {
            debug_assert!(request.check(framing).is_ok(), "a request is checked before it is queued");
            command::encode_spelled(request, spelling, framing, station, dst);
        }
        self.shape(spelling, framing)
    }

    fn try_complete(
        &self,
        framing: Framing,
        station: u8,
        data: &[u8],
        now: Instant,
    ) -> Result<Option<ErrorCode>, FieldError> {
        let Some(request) = self.request() else { return Err(FieldError::Unreadable) };
        let mut slot = lock(&self.result);
        if !self.is_wanted() {
            // The result of a call that has ended stays.
            return self.judge(request, framing, data);
        }
        // One that was held before is replaced.
        let CallResult { result, reply, at } = &mut *slot;
        (*result, *at) = (None, None);
        let refusal = match command::decode_spelled_into(request, self.spelling(), framing, data, reply) {
            Ok(()) => {
                *result = Some(Ok(()));
                None
            }
            Err(ReplyError::Plc(error)) => {
                let repeated = self.sends.load(Ordering::Acquire) > 1;
                *result = Some(Err(Error::Plc { station, code: C::CODE, error, repeated }));
                Some(error)
            }
            Err(ReplyError::Mismatch(mismatch)) => return Err(mismatch),
        };
        *at = Some(now);
        Ok(refusal)
    }

    fn commit(&self, proof: Proof) {
        self.proof.store(u64::from(proof.proofs) << 32 | u64::from(proof.doubts), Ordering::Relaxed);
        if self.is_wanted() {
            self.done();
        }
    }

    fn retract(&self) {
        let mut slot = lock(&self.result);
        if self.state.load(Ordering::Acquire) & DONE == 0 {
            (slot.result, slot.at) = (None, None);
        }
    }

    fn uncount_send(&self) {
        let count = self.sends.load(Ordering::Acquire);
        debug_assert!(count > 0, "a request is uncounted that was not sent");
        self.sends.store(count.saturating_sub(1), Ordering::Release);
    }

    fn mark_sent(&self) -> Option<bool> {
        // Either the caller abandons first and learns that nothing was sent, or the link marks
        // first and sends.
        let wanted = |state| (state & ABANDONED == 0).then_some((state | SENT) & !AWAITS_SILENCE);
        let before = self.state.fetch_update(Ordering::AcqRel, Ordering::Acquire, wanted).ok()?;
        let count = self.sends.load(Ordering::Acquire);
        self.sends.store(count.saturating_add(1), Ordering::Release);
        Some(before & SENT != 0)
    }

    fn withdraw_send(&self, sent_before: bool) {
        self.uncount_send();
        if !sent_before {
            // A caller that abandons before this takes the request for sent, which is the safe side.
            self.state.fetch_and(!SENT, Ordering::AcqRel);
        }
    }

    fn check_answered(&self) {
        self.state.fetch_and(!CHECKED, Ordering::AcqRel);
    }

    fn mark_checked(&self) {
        self.state.fetch_or(CHECKED, Ordering::AcqRel);
        self.state.fetch_and(!AWAITS_SILENCE, Ordering::AcqRel);
    }

    fn note(&self, seen: &Seen) {
        lock(&self.seen).add(seen);
    }

    fn await_silence(&self) {
        self.state.fetch_or(AWAITS_SILENCE, Ordering::AcqRel);
    }

    fn complete_without_reply(&self, proof: Proof) {
        let implied = |slot: &mut CallResult<C>| {
            slot.reply = C::IMPLIED_REPLY;
            slot.result = Some(slot.reply.as_ref().map(|_| ()).ok_or(Error::Closed { sent: true }));
        };
        if self.hold(implied) {
            self.commit(proof);
        }
    }

    fn fail(&self, error: Error) {
        if self.hold(|slot| slot.result = Some(Err(error))) {
            self.done();
        }
    }

    fn unanswered(&self, after: Duration, fault: Option<String>) -> Error {
        let (station, code) = (self.station, C::CODE);
        let state = self.state.load(Ordering::Acquire);
        let sent = state & SENT != 0;
        if state & AWAITS_SILENCE != 0 {
            return Error::OutOfStep { station, code, after, sent };
        }
        let attempts = self.sends.load(Ordering::Acquire).into();
        let seen = *lock(&self.seen);
        match fault {
            // The reason names an incomplete frame.
            Some(reason) => {
                let seen = Seen { half_frame: false, ..seen };
                Error::BadReply { station, code, after, reason, sent, attempts, seen }
            }
            None => Error::Timeout { station, code, after, sent, attempts, checked: state & CHECKED != 0, seen },
        }
    }

    fn fail_if_pending(&self) {
        if self.state.load(Ordering::Acquire) & DONE == 0 {
            self.fail(Error::Closed { sent: self.was_sent() });
        }
    }

    fn is_abandoned(&self) -> bool {
        self.state.load(Ordering::Acquire) & ABANDONED != 0
    }

    fn was_sent(&self) -> bool {
        self.state.load(Ordering::Acquire) & SENT != 0
    }
}
