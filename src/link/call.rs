//! A call: one request on its way through the link, and the slot that takes its result.
//!
//! ```text
//! queued ──▶ sent ──▶ done
//!    └────────┴─────▶ abandoned   (the caller's future was dropped, or its deadline passed)
//! ```
//!
//! Caller and link share one allocation, the slot. The caller holds it as a [`CallFuture`], the
//! link as a [`PendingCall`]. The link sees the slot as [`AnyCall`], without the type of the
//! request; the scheduler needs its [`CallMeta`] only. [`spares`] keeps the slots of ended
//! calls for later ones, with the timers of their deadlines.
//!
//! Invariants:
//! - A call ends once: the first result stays.
//! - A call that its caller has abandoned before it was sent is never sent.
//! - A [`PendingCall`] that is dropped ends its call, so no caller waits for a task that has ended.

mod deadline;
mod slot;
mod spares;
#[cfg(test)]
mod tests;

use std::ops::Deref;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

pub(crate) use self::slot::CallFuture;
use self::slot::CallSlot;
use super::in_step::{Kind, Proof, Shape, Spelled};
use super::options::{CallOptions, Lane};
use crate::command::{Candidates, Class, Code, Command, Run, Spelling};
use crate::error::{Error, ErrorCode, Seen};
use crate::wire::{FieldError, Framing};

/// A call as the link sees it, without the type of its request.
pub(crate) trait AnyCall: Send + Sync {
    /// How the request is sent.
    fn sending(&self) -> Sending;

    /// Other spellings of the request that the rule may choose.
    fn candidates(&self, framing: Framing) -> Candidates;

    /// Shape of the positive reply to a spelling.
    fn shape(&self, spelling: Spelling, framing: Framing) -> Shape;

    /// The consecutive elements that a read covers.
    fn run(&self) -> Option<Run>;

    /// Appends the request to `dst` as a frame in this spelling. Its reply is decoded by it, and the caller
    /// learns of it. Returns the shape of the positive reply. The request was checked for this framing.
    fn encode(&self, spelling: Spelling, framing: Framing, station: u8, dst: &mut BytesMut) -> Shape;

    /// Decodes the data of a frame that has the right station and command, received at `now`.
    ///
    /// If it is exactly a reply to this request, the result is held until [`commit`](Self::commit)
    /// or [`retract`](Self::retract). Returns the error code if the reply is a refusal.
    fn try_complete(
        &self,
        framing: Framing,
        station: u8,
        data: &[u8],
        now: Instant,
    ) -> Result<Option<ErrorCode>, FieldError>;

    /// Ends the call with the held result.
    fn commit(&self, proof: Proof);

    /// Drops the held result: its reply may belong to another request.
    fn retract(&self);

    /// Marks the request as sent: from now on the PLC may execute it. Returns whether it was sent
    /// before; `None` if the call is abandoned, and then it must not be sent.
    fn mark_sent(&self) -> Option<bool>;

    /// Takes back one [`mark_sent`](Self::mark_sent): only the spelling was refused, so the
    /// transmission does not count as a repetition.
    fn uncount_send(&self);

    /// Takes back one [`mark_sent`](Self::mark_sent), which has returned `sent_before`: nothing was
    /// written.
    fn withdraw_send(&self, sent_before: bool);

    /// Notes that a check was sent for the call.
    fn mark_checked(&self);

    /// Notes that the check was answered.
    fn check_answered(&self);

    /// Notes traffic received instead of the reply.
    fn note(&self, seen: &Seen);

    /// Marks the call as waiting for the quiet time of a suspect station.
    fn await_silence(&self);

    /// Ends a call that has no reply of its own: a broadcast or a confirmation.
    fn complete_without_reply(&self, proof: Proof);

    /// Ends the call with an error.
    fn fail(&self, error: Error);

    /// The error of a call that has no reply after this time: a timeout, or a bad reply if `fault`
    /// has its reason.
    fn unanswered(&self, after: Duration, fault: Option<String>) -> Error;

    /// Ends the call with [`Error::Closed`] unless it has ended.
    fn fail_if_pending(&self);

    /// Returns whether the caller has given up.
    fn is_abandoned(&self) -> bool;

    /// Returns whether the request, or a part of it, has been sent at least once.
    fn was_sent(&self) -> bool;
}

/// Data of a call that are known when it is made, and that the link schedules it by.
#[derive(Debug)]
pub(crate) struct CallMeta {
    pub(crate) station: u8,
    pub(crate) code: Code,
    pub(crate) lane: Lane,
    /// When the caller gives up.
    pub(crate) deadline: Instant,
    pub(crate) queued_at: Instant,
    /// The call is a check that confirms earlier results; its request is never sent.
    pub(crate) confirms: bool,
    /// The spelling that the caller has asked for. Here it fits beside the bytes above: a link has the place of
    /// two calls.
    pub(crate) plain: Spelling,
}

/// How the request of a call is sent.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sending {
    pub(crate) response_timeout: Duration,
    /// The shortest response timeout, if it adapts.
    pub(crate) adaptive: Option<Duration>,
    /// The request is part of a longer read or write: a spelling may leave elements to the next
    /// request.
    pub(crate) part: bool,
}

/// The link's half of a call. Dropped without a result, it ends the call with [`Error::Closed`].
pub(crate) struct PendingCall {
    pub(crate) slot: Arc<dyn AnyCall>,
    /// Not in the slot, whose type is not known here: each access would be a virtual call. It is small,
    /// because a call is moved several times on its way.
    meta: CallMeta,
    /// How many retries are left.
    pub(crate) retries_left: u32,
    /// A reply without proof has come, and the request was sent again. That is allowed once, and
    /// does not count as a retry.
    pub(crate) unproven_once: bool,
    /// Another spelling was refused, so the request is sent as the caller made it.
    pub(crate) only_plain: bool,
    /// The kind of the request, for the rule of `in_step`.
    pub(crate) kind: Kind,
    /// The spelling of the next transmission, or of the last one. The slot has that of the last one, too.
    pub(crate) spelling: Spelling,
    /// A write was refused in another spelling when the station had this number of strays. With one
    /// more, the refusal may have been another request's, and the write may have been executed.
    pub(crate) refused_at: Option<u32>,
    /// How often the check before a write may still be repeated: nothing was sent then.
    pub(crate) check_retries_left: u32,
    /// Why the first attempt of the request itself has failed.
    pub(crate) cause: Option<Box<Cause>>,
}

/// Why an attempt has failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Cause {
    Silence,
    /// A frame came that was not the reply, for this reason.
    Fault(String),
}

/// A call in the framing of its link, as the rule of `in_step` sees it.
pub(crate) struct CallInFraming<'a>(pub(crate) &'a PendingCall, pub(crate) Framing);

impl Spelled for CallInFraming<'_> {
    fn kind(&self) -> Kind {
        self.0.kind
    }

    fn plain(&self) -> Spelling {
        self.0.plain
    }

    fn candidates(&self) -> Candidates {
        self.0.slot.candidates(self.1)
    }

    fn shape(&self, spelling: Spelling) -> Shape {
        self.0.slot.shape(spelling, self.1)
    }
}

impl Deref for PendingCall {
    type Target = CallMeta;

    fn deref(&self) -> &CallMeta {
        &self.meta
    }
}

impl PendingCall {
    /// Returns whether the caller still waits at `now`.
    pub(crate) fn is_wanted(&self, now: Instant) -> bool {
        now < self.deadline && !self.slot.is_abandoned()
    }

    /// Ends a call whose deadline has passed or whose caller has given up.
    pub(crate) fn expire(&self) {
        self.slot.fail(self.unanswered(self.deadline.saturating_duration_since(self.queued_at)));
    }

    /// The error of the call if it ends without a reply after this time.
    pub(crate) fn unanswered(&self, after: Duration) -> Error {
        let fault = match self.cause.as_deref() {
            Some(Cause::Fault(reason)) => Some(reason.clone()),
            Some(Cause::Silence) | None => None,
        };
        self.slot.unanswered(after, fault)
    }

    /// Returns whether the request is a write or a control command.
    pub(crate) fn is_write(&self) -> bool {
        self.code.class() != Class::Read
    }

    pub(crate) fn is_broadcast(&self) -> bool {
        self.station == 0
    }
}

impl Drop for PendingCall {
    fn drop(&mut self) {
        self.slot.fail_if_pending();
    }
}

impl std::fmt::Debug for PendingCall {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PendingCall(station {}, {}, {:?})", self.station, self.code, self.lane)
    }
}

/// Makes the two halves of a call. `options` have its retries.
pub(crate) fn new<C: Command>(
    request: C,
    meta: CallMeta,
    sending: Sending,
    options: &CallOptions,
) -> (PendingCall, CallFuture<C>) {
    let retries_left = options.retries_for(C::CODE.class());
    let check_retries_left = options.retries.saturating_sub(retries_left);
    let (kind, spelling) = (kind_of(&request), meta.plain);
    let (slot, timer) = match spares::take::<C>() {
        None => (Arc::new(CallSlot::new(request, meta.station, sending)), None),
        Some((mut spare, timer)) => match Arc::get_mut(&mut spare) {
            None => (Arc::new(CallSlot::new(request, meta.station, sending)), None),
            Some(slot) => {
                slot.begin(request, meta.station, sending);
                (spare, timer)
            }
        },
    };
    let call = PendingCall {
        slot: slot.clone(),
        meta,
        retries_left,
        unproven_once: false,
        only_plain: false,
        kind,
        spelling,
        refused_at: None,
        check_retries_left,
        cause: None,
    };
    (call, CallFuture::new(slot, timer))
}

/// The kind of a request, for the rule of `in_step`.
fn kind_of<C: Command>(request: &C) -> Kind {
    match C::CODE.class() {
        Class::Write | Class::Control => Kind::Once,
        Class::Read if request.is_like_a_refusal() => Kind::Once,
        Class::Read if C::CODE == Code::ReadProgramPage => Kind::Page,
        Class::Read => Kind::Read,
    }
}

/// Locks a mutex. Poisoning is ignored: each of these mutexes holds a complete value at all times.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
