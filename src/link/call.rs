//! A call: a request on its way through the link, and the slot its result comes back in.
//!
//! ```text
//! queued ──▶ sent ──▶ done
//!    └────────┴─────▶ abandoned   (the caller's future was dropped, or its deadline passed)
//! ```
//!
//! The caller and the link share one allocation, which [`Spares`] keeps for the next call. The link sees it without its
//! type, as [`AnyCall`]; what it needs for scheduling are the call's [`Terms`].

use std::any::Any;
use std::future::Future;
use std::ops::Deref;
use std::pin::Pin;
use std::sync::atomic::{AtomicU8, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::BytesMut;
use futures::task::AtomicWaker;
use tokio::time::Instant;

use super::in_step::{Kind, Proof, Shape, Spelled};
use super::options::{CallOptions, Lane};
use crate::command::{
    self, Candidates, Class, Code, Command, InvalidRequest, NO_CANDIDATES, ReplyError, Run, Spelling,
};
use crate::error::{Error, ErrorCode};
use crate::wire::{FieldError, Framing};

/// What the link can do with a call whose type it does not know.
pub(crate) trait AnyCall: Send + Sync {
    /// What it needs to know of it.
    fn terms(&self) -> &Terms;

    /// What the request is to the rule of `in_step`.
    fn kind(&self) -> Kind;

    /// The spelling that is the request itself.
    fn plain(&self) -> Spelling;

    /// The other spellings.
    fn candidates(&self, framing: Framing) -> Candidates;

    /// The shape of the positive reply to a spelling.
    fn shape(&self, spelling: Spelling, framing: Framing) -> Shape;

    /// The consecutive elements that are read.
    fn run(&self) -> Option<Run>;

    /// Chooses the spelling that is sent next.
    fn spell(&self, spelling: Spelling);

    /// The spelling that was chosen last.
    fn spelling(&self) -> Spelling;

    /// Appends the request, in the spelling chosen, as a frame.
    fn encode(&self, framing: Framing, station: u8, dst: &mut BytesMut) -> Result<(), InvalidRequest>;

    /// Offers the data of a frame with the right station and command. It is held if it is exactly a reply to this request; then
    /// the call waits for [`commit`](Self::commit) or [`retract`](Self::retract). `now` is when the frame came.
    fn offer(&self, framing: Framing, station: u8, data: &[u8], now: Instant) -> Result<Option<ErrorCode>, FieldError>;

    /// Ends the call with the reply that is held.
    fn commit(&self, proof: Proof);

    /// Drops the reply that is held: it may be another request's.
    fn retract(&self);

    /// The request is about to be sent, and from now on the PLC may execute it; `false`: nobody wants that any more.
    fn mark_sent(&self) -> bool;

    /// The request that was sent last has been refused for its spelling alone, so it counts as not sent.
    fn respelled(&self);

    /// The station must be silent before the request is sent.
    fn doubt(&self);

    /// Whether it waits for that.
    fn is_in_doubt(&self) -> bool;

    /// Ends a call that has no reply to wait for: a broadcast.
    fn complete_unanswered(&self, proof: Proof);

    /// Ends the call.
    fn fail(&self, error: Error);

    /// Ends the call if it has not ended: nobody sees to it any more.
    fn let_go(&self);

    /// Whether nobody waits for the result any more.
    fn is_abandoned(&self) -> bool;

    /// Whether the request, or a part of it, has been sent at least once.
    fn was_sent(&self) -> bool;
}

/// What is said of a call when it is made.
#[derive(Debug)]
pub(crate) struct Terms {
    pub(crate) station: u8,
    pub(crate) code: Code,
    pub(crate) lane: Lane,
    /// When the caller gives up, whatever happens.
    pub(crate) deadline: Instant,
    pub(crate) queued_at: Instant,
    pub(crate) response_timeout: Duration,
    pub(crate) options: CallOptions,
    /// A part of a longer read or write, which may leave elements to the next request.
    pub(crate) longer: bool,
    /// Not a request, but a check that confirms what was taken before.
    pub(crate) confirms: bool,
}

/// A call in the link's hands. Dropped without a result, it ends with [`Error::Closed`], so that no caller waits for a task
/// that is gone.
pub(crate) struct Ticket {
    pub(crate) call: Arc<dyn AnyCall>,
    /// How often it can still be sent after it has failed.
    pub(crate) retries_left: u32,
    /// A reply came without proof, and it was asked again: that is not counted as a retry, once.
    pub(crate) asked_again: bool,
    /// Another spelling was refused.
    pub(crate) plain: bool,
    /// A write was refused in another spelling when the station had this many doubts. With one more, the refusal may have been
    /// another request's, and the write executed.
    pub(crate) refused_at: Option<u32>,
}

/// A call to the rule of `in_step`.
pub(crate) struct InFraming<'a>(pub(crate) &'a Ticket, pub(crate) Framing);

impl Spelled for InFraming<'_> {
    fn kind(&self) -> Kind {
        self.0.call.kind()
    }

    fn plain(&self) -> Spelling {
        self.0.call.plain()
    }

    fn candidates(&self) -> Candidates {
        self.0.call.candidates(self.1)
    }

    fn shape(&self, spelling: Spelling) -> Shape {
        self.0.call.shape(spelling, self.1)
    }
}

impl Deref for Ticket {
    type Target = Terms;

    fn deref(&self) -> &Terms {
        self.call.terms()
    }
}

impl Ticket {
    /// Whether the caller still waits at this time.
    pub(crate) fn is_wanted(&self, now: Instant) -> bool {
        now < self.deadline && !self.call.is_abandoned()
    }

    /// Ends a call that is not wanted any more.
    pub(crate) fn expire(&self) {
        let Terms { station, code, options, .. } = **self;
        let (after, sent) = (options.call_timeout, self.call.was_sent());
        self.call.fail(match self.call.is_in_doubt() {
            true => Error::OutOfStep { station, code, after, sent },
            false => Error::Timeout { station, code, after, sent },
        });
    }

    pub(crate) fn is_broadcast(&self) -> bool {
        self.station == 0
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.call.let_go();
    }
}

impl std::fmt::Debug for Ticket {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Ticket(station {}, {}, {:?})", self.station, self.code, self.lane)
    }
}

/// The caller's half of a call: a future of its result. Dropping it abandons the call.
#[derive(Debug)]
pub(crate) struct Completion<C: Command> {
    slot: Arc<Slot<C>>,
    answered_at: Option<Instant>,
}

/// Makes the two halves of a call. `unanswered` is what it ends with once it has been sent, if no reply ends it.
pub(crate) fn new<C: Command>(
    request: C,
    unanswered: Option<C::Reply>,
    terms: Terms,
    spares: &Spares,
) -> (Ticket, Completion<C>) {
    let retries_left = terms.options.retries_for(C::CODE.class());
    let slot = match spares.take::<Slot<C>>() {
        None => Arc::new(Slot::new(request, unanswered, terms)),
        Some(mut spare) => match Arc::get_mut(&mut spare) {
            None => Arc::new(Slot::new(request, unanswered, terms)),
            Some(slot) => {
                slot.begin(request, unanswered, terms);
                spare
            }
        },
    };
    let ticket = Ticket { call: slot.clone(), retries_left, asked_again: false, plain: false, refused_at: None };
    (ticket, Completion { slot, answered_at: None })
}

/// Slots of calls that have ended, for those that follow.
#[derive(Default)]
pub(crate) struct Spares {
    slots: Mutex<Vec<Arc<dyn Any + Send + Sync>>>,
}

/// How many are kept at the most: as many calls can be under way at once without one of them needing new memory.
const MOST_SPARES: usize = 16;

impl Spares {
    fn take<S: Any + Send + Sync>(&self) -> Option<Arc<S>> {
        let mut slots = lock(&self.slots);
        let at = slots.iter().rposition(|slot| slot.is::<S>() && Arc::strong_count(slot) == 1)?;
        slots.swap_remove(at).downcast().ok()
    }

    fn keep<C: Command>(&self, mut slot: Arc<Slot<C>>) {
        if std::mem::needs_drop::<C>() {
            // The values of a write are not kept with it.
            match Arc::get_mut(&mut slot) {
                Some(slot) => slot.request = None,
                None => return,
            }
        }
        let mut slots = lock(&self.slots);
        if slots.len() >= MOST_SPARES {
            slots.remove(0);
        }
        // Most links have one caller at a time.
        slots.reserve_exact(1);
        slots.push(slot);
    }
}

impl<C: Command> Completion<C> {
    /// Gives the call up; says whether the request, or a part of it, has been sent. If not, it never will be.
    pub(crate) fn abandon(&self) -> bool {
        self.slot.state.fetch_or(ABANDONED, Ordering::AcqRel) & SENT != 0
    }

    /// Whether the station had to be silent before the request could be sent.
    pub(crate) fn is_in_doubt(&self) -> bool {
        self.slot.is_in_doubt()
    }

    /// When the reply came, once the result is there and if there was one.
    pub(crate) fn answered_at(&self) -> Option<Instant> {
        self.answered_at
    }

    /// How the request was spelt that was answered.
    pub(crate) fn spelling(&self) -> Spelling {
        self.slot.spelling()
    }

    /// The shape of the positive reply.
    pub(crate) fn shape(&self, framing: Framing) -> Shape {
        self.slot.shape(self.slot.spelling(), framing)
    }

    /// What was proven of the station when the reply was taken.
    pub(crate) fn proof(&self) -> Proof {
        let bits = self.slot.proof.load(Ordering::Relaxed);
        let half = |bits: u64| u32::try_from(bits & u64::from(u32::MAX)).unwrap_or_default();
        Proof { proofs: half(bits >> 32), doubts: half(bits) }
    }

    /// Leaves the slot of a call that has ended to another one.
    pub(crate) fn recycle(self, spares: &Spares) {
        let slot = self.slot.clone();
        drop(self);
        if slot.state.load(Ordering::Acquire) & DONE != 0 {
            // It would keep the caller's task in memory.
            drop(slot.waker.take());
            spares.keep(slot);
        }
    }
}

impl<C: Command> Future for Completion<C> {
    type Output = Result<C::Reply, Error>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        if self.slot.state.load(Ordering::Acquire) & DONE == 0 {
            self.slot.waker.register(cx.waker());
            // Once more, for it may have ended in between, and have woken nobody.
            if self.slot.state.load(Ordering::Acquire) & DONE == 0 {
                return Poll::Pending;
            }
        }
        // A future is not polled again after it is ready, so the result is there; a caller that does so all the same
        // gets an error rather than a panic.
        let answer = lock(&self.slot.result).take();
        let (result, at) = answer.unwrap_or((Err(Error::Closed { sent: true }), None));
        self.answered_at = at;
        Poll::Ready(result)
    }
}

impl<C: Command> Drop for Completion<C> {
    fn drop(&mut self) {
        self.abandon();
    }
}

#[derive(Debug)]
struct Slot<C: Command> {
    /// Always there while the call is under way.
    request: Option<C>,
    /// What the caller gets when there is no reply to wait for.
    unanswered: Option<C::Reply>,
    terms: Terms,
    state: AtomicU8,
    /// How often the request has been sent, as far as 255.
    sends: AtomicU8,
    /// The spelling: whether it begins before, the code, the number of elements.
    spelling: AtomicU32,
    /// The proofs, then the doubts.
    proof: AtomicU64,
    result: Mutex<Option<Answer<C>>>,
    waker: AtomicWaker,
}

/// The result, and when the reply came that it was in, if it was in one.
type Answer<C> = (Result<<C as Command>::Reply, Error>, Option<Instant>);

/// Bits of the state. A call that is neither done nor abandoned is queued or on the wire.
const DONE: u8 = 1;
const ABANDONED: u8 = 2;
/// The request has been sent at least once; it stays so when it is queued again.
const SENT: u8 = 4;
/// The station must be silent before the request is sent.
const DOUBT: u8 = 8;

impl<C: Command> Slot<C> {
    fn new(request: C, unanswered: Option<C::Reply>, terms: Terms) -> Self {
        Self {
            request: Some(request),
            unanswered,
            terms,
            state: AtomicU8::new(0),
            sends: AtomicU8::new(0),
            spelling: AtomicU32::new(0),
            proof: AtomicU64::new(0),
            result: Mutex::new(None),
            waker: AtomicWaker::new(),
        }
    }

    /// What [`new`](Self::new) makes, in the place of a call that has ended. Of that, the waker is gone already.
    fn begin(&mut self, request: C, unanswered: Option<C::Reply>, terms: Terms) {
        self.request = Some(request);
        self.unanswered = unanswered;
        self.terms = terms;
        *self.state.get_mut() = 0;
        *self.sends.get_mut() = 0;
        *self.spelling.get_mut() = 0;
        *self.proof.get_mut() = 0;
        *self.result.get_mut().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// The first result stays: nothing that comes later can replace it.
    fn finish(&self, result: Result<C::Reply, Error>, at: Option<Instant>) {
        if self.hold(result, at) {
            self.done();
        }
    }

    /// Puts a result there that may still be taken back; `false`: the call has ended.
    fn hold(&self, result: Result<C::Reply, Error>, at: Option<Instant>) -> bool {
        let mut slot = lock(&self.result);
        let wanted = self.state.load(Ordering::Acquire) & (DONE | ABANDONED) == 0;
        if wanted {
            *slot = Some((result, at));
        }
        wanted
    }

    fn done(&self) {
        self.state.fetch_or(DONE, Ordering::AcqRel);
        self.waker.wake();
    }
}

impl<C: Command> AnyCall for Slot<C> {
    fn terms(&self) -> &Terms {
        &self.terms
    }

    fn kind(&self) -> Kind {
        match (C::CODE.class(), &self.request) {
            (Class::Write | Class::Control, _) | (Class::Read, None) => Kind::Once,
            (Class::Read, Some(request)) if request.is_like_a_refusal() => Kind::Once,
            (Class::Read, Some(_)) if C::CODE == Code::ReadProgramPage => Kind::Page,
            (Class::Read, Some(_)) => Kind::Read,
        }
    }

    fn plain(&self) -> Spelling {
        self.request.as_ref().map_or(Spelling::new(C::CODE, 0), C::plain)
    }

    fn candidates(&self, framing: Framing) -> Candidates {
        self.request.as_ref().map_or(NO_CANDIDATES, |request| request.candidates(self.terms.longer, framing))
    }

    fn shape(&self, spelling: Spelling, framing: Framing) -> Shape {
        let size = self.request.as_ref().map_or(0, |request| request.reply_size(spelling, framing));
        Shape { code: spelling.code, size }
    }

    fn run(&self) -> Option<Run> {
        self.request.as_ref().filter(|_| C::CODE.class() == Class::Read)?.run()
    }

    fn spell(&self, spelling: Spelling) {
        let [high, low] = spelling.count.to_be_bytes();
        let bits = u32::from_be_bytes([spelling.before.into(), spelling.code.into(), high, low]);
        self.spelling.store(bits, Ordering::Release);
    }

    fn spelling(&self) -> Spelling {
        let [before, code, high, low] = self.spelling.load(Ordering::Acquire).to_be_bytes();
        match Code::from_u8(code) {
            Some(code) => Spelling { code, count: u16::from_be_bytes([high, low]), before: before != 0 },
            None => self.plain(),
        }
    }

    fn encode(&self, framing: Framing, station: u8, dst: &mut BytesMut) -> Result<(), InvalidRequest> {
        if let Some(request) = &self.request {
            request.check(framing)?;
            command::encode_spelled(request, self.spelling(), framing, station, dst);
        }
        Ok(())
    }

    fn offer(&self, framing: Framing, station: u8, data: &[u8], now: Instant) -> Result<Option<ErrorCode>, FieldError> {
        let Some(request) = &self.request else { return Err(FieldError::Unreadable) };
        match command::decode_spelled(request, self.spelling(), framing, data) {
            Ok(reply) => {
                self.hold(Ok(reply), Some(now));
                Ok(None)
            }
            Err(ReplyError::Plc(error)) => {
                let repeated = self.sends.load(Ordering::Acquire) > 1;
                self.hold(Err(Error::Plc { station, code: C::CODE, error, repeated }), Some(now));
                Ok(Some(error))
            }
            Err(ReplyError::Mismatch(mismatch)) => Err(mismatch),
        }
    }

    fn commit(&self, proof: Proof) {
        self.proof.store(u64::from(proof.proofs) << 32 | u64::from(proof.doubts), Ordering::Relaxed);
        if self.state.load(Ordering::Acquire) & (DONE | ABANDONED) == 0 {
            self.done();
        }
    }

    fn retract(&self) {
        let mut slot = lock(&self.result);
        if self.state.load(Ordering::Acquire) & DONE == 0 {
            *slot = None;
        }
    }

    fn respelled(&self) {
        let count = self.sends.load(Ordering::Acquire);
        self.sends.store(count.saturating_sub(1), Ordering::Release);
    }

    fn mark_sent(&self) -> bool {
        // One of the two is first: the caller, who gives up and is told that nothing was sent, or the link, which sends.
        let wanted = |state| (state & ABANDONED == 0).then_some((state | SENT) & !DOUBT);
        let sends = self.state.fetch_update(Ordering::AcqRel, Ordering::Acquire, wanted).is_ok();
        if sends {
            let count = self.sends.load(Ordering::Acquire);
            self.sends.store(count.saturating_add(1), Ordering::Release);
        }
        sends
    }

    fn doubt(&self) {
        self.state.fetch_or(DOUBT, Ordering::AcqRel);
    }

    fn is_in_doubt(&self) -> bool {
        self.state.load(Ordering::Acquire) & DOUBT != 0
    }

    fn complete_unanswered(&self, proof: Proof) {
        if self.hold(self.unanswered.clone().ok_or(Error::Closed { sent: true }), None) {
            self.commit(proof);
        }
    }

    fn fail(&self, error: Error) {
        self.finish(Err(error), None);
    }

    fn let_go(&self) {
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

/// A lock whose holder panicked is still good here: it only ever holds a whole result.
fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::ReadStatus;

    fn ticket(options: CallOptions) -> (Ticket, Completion<ReadStatus>) {
        let queued_at = Instant::now();
        let terms = Terms {
            station: 7,
            code: ReadStatus::CODE,
            lane: Lane::Read,
            deadline: queued_at + options.call_timeout,
            queued_at,
            response_timeout: Duration::from_secs(1),
            options,
            longer: false,
            confirms: false,
        };
        new(ReadStatus, None, terms, &Spares::default())
    }

    fn result(completion: &mut Completion<ReadStatus>) -> Option<Result<(), Error>> {
        let mut context = Context::from_waker(std::task::Waker::noop());
        match Pin::new(completion).poll(&mut context) {
            Poll::Ready(result) => Some(result.map(drop)),
            Poll::Pending => None,
        }
    }

    #[test]
    fn a_call_is_wanted_until_its_deadline_or_until_its_caller_has_gone() {
        let (ticket, completion) = ticket(CallOptions::new());
        let just_before = ticket.deadline - Duration::from_nanos(1);
        assert!(ticket.is_wanted(just_before));
        assert!(!ticket.is_wanted(ticket.deadline));
        assert!(!ticket.call.is_abandoned());
        drop(completion);
        assert!(ticket.call.is_abandoned() && !ticket.is_wanted(just_before));
    }

    #[test]
    fn a_call_that_has_expired_says_after_which_time_and_whether_it_was_sent() {
        for sends in 0..=2 {
            let (ticket, mut completion) = ticket(CallOptions::new().call_timeout(Duration::from_secs(3)));
            for _ in 0..sends {
                assert!(ticket.call.mark_sent());
            }
            ticket.expire();
            drop(ticket);
            let Some(Err(Error::Timeout { station: 7, code: Code::ReadStatus, after, sent })) = result(&mut completion)
            else {
                panic!("the first result stays, and it is the timeout")
            };
            assert_eq!((after, sent), (Duration::from_secs(3), sends > 0));
        }
    }

    #[test]
    fn the_first_result_stays_and_one_that_comes_when_the_caller_has_gone_is_nobodys() {
        let (ticket, mut completion) = ticket(CallOptions::new());
        ticket.expire();
        ticket.call.fail(Error::Closed { sent: false });
        assert!(matches!(result(&mut completion), Some(Err(Error::Timeout { .. }))));
        let (ticket, mut completion) = self::ticket(CallOptions::new());
        completion.abandon();
        ticket.expire();
        assert!(result(&mut completion).is_none());
    }

    #[test]
    fn a_call_whose_ticket_is_lost_ends_all_the_same() {
        let (ticket, mut completion) = ticket(CallOptions::new());
        assert!(result(&mut completion).is_none());
        drop(ticket);
        assert!(matches!(result(&mut completion), Some(Err(Error::Closed { sent: false }))));
        assert!(matches!(result(&mut completion), Some(Err(Error::Closed { sent: true }))), "polled once too often");
    }

    #[test]
    fn what_was_given_up_is_never_sent_and_what_was_sent_is_told_so_when_it_is_given_up() {
        let (first, completion) = ticket(CallOptions::new());
        assert!(!completion.abandon());
        assert!(!first.call.mark_sent() && !first.call.was_sent());
        let (second, completion) = ticket(CallOptions::new());
        assert!(second.call.mark_sent());
        assert!(completion.abandon() && second.call.was_sent());
    }

    #[test]
    fn a_refusal_says_whether_the_request_was_repeated() {
        for sends in 1..=3 {
            let (ticket, mut completion) = ticket(CallOptions::new());
            for _ in 0..sends {
                ticket.call.mark_sent();
            }
            let refusal = ticket.call.offer(Framing::Ascii, 7, b"4", Instant::now());
            assert_eq!(refusal.expect("it is one"), ErrorCode::from_u8(4));
            assert!(result(&mut completion).is_none(), "it is held");
            ticket.call.commit(Proof::default());
            let Some(Err(Error::Plc { repeated, .. })) = result(&mut completion) else { panic!("it is a refusal") };
            assert_eq!(repeated, sends > 1);
        }
    }

    #[test]
    fn a_ticket_is_shown_by_its_station_command_and_lane() {
        let (ticket, _completion) = ticket(CallOptions::new());
        assert_eq!(format!("{ticket:?}"), "Ticket(station 7, read brief status (40), Read)");
    }
}
