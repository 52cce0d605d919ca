//! The timers of calls' deadlines, kept for later calls of the link.
//!
//! A call has a timer of its own, so it ends by its deadline even if the runtime of the link's task
//! stands still. Creating, registering and removing a timer costs more than all other work for the
//! deadline. So a call takes a timer that an earlier one has left, and moves it only after it has fired.
//!
//! Invariants:
//! - A timer in use is due at the deadline of its call or before.
//! - A timer is used on the runtime that drives it, and on no other.
//! - A timer that no call uses holds no waker: a waker keeps the memory of its task.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll, Waker, ready};

use futures::future::Future;
use tokio::runtime::{Handle, Id};
use tokio::task::unconstrained;
use tokio::time::{Instant, Sleep, sleep_until};

use super::{CallFuture, SpareSlots};
use crate::command::Command;

/// A timer, and the runtime that drives it.
pub(super) struct CallTimer {
    sleep: Pin<Box<Sleep>>,
    runtime: Id,
}

impl CallTimer {
    pub(super) fn runtime(&self) -> Id {
        self.runtime
    }

    fn new(runtime: Id, deadline: Instant) -> Self {
        Self { sleep: Box::pin(sleep_until(deadline)), runtime }
    }

    /// Polls until the deadline. The timer may have been set for an earlier one.
    fn poll(&mut self, deadline: Instant, cx: &mut Context<'_>) -> Poll<()> {
        loop {
            ready!(self.sleep.as_mut().poll(cx));
            if self.sleep.deadline() >= deadline {
                return Poll::Ready(());
            }
            self.sleep.as_mut().reset(deadline);
        }
    }
}

/// A timer while a call uses it. Returned to the link when it is dropped.
struct TimerInUse<'a> {
    spares: &'a SpareSlots,
    timer: Option<CallTimer>,
}

impl TimerInUse<'_> {
    fn poll(&mut self, deadline: Instant, cx: &mut Context<'_>) -> Poll<()> {
        let Self { spares, timer } = self;
        timer.get_or_insert_with(|| take(spares, deadline)).poll(deadline, cx)
    }
}

impl Drop for TimerInUse<'_> {
    fn drop(&mut self) {
        if let Some(mut timer) = self.timer.take() {
            // Replaces the waker. Outside of Tokio's budget: an exhausted budget would leave the waker.
            let mut sleep = unconstrained(timer.sleep.as_mut());
            let _ = Pin::new(&mut sleep).poll(&mut Context::from_waker(Waker::noop()));
            self.spares.keep_timer(timer);
        }
    }
}

/// Takes a timer of this runtime that is due at the deadline or before.
fn take(spares: &SpareSlots, deadline: Instant) -> CallTimer {
    let runtime = Handle::current().id();
    match spares.take_timer(runtime) {
        None => CallTimer::new(runtime, deadline),
        Some(mut timer) => {
            if timer.sleep.deadline() > deadline {
                timer.sleep.as_mut().reset(deadline);
            }
            timer
        }
    }
}

/// Waits until a call has ended or its deadline has passed. Returns whether it has ended.
pub(crate) async fn ended_by<C: Command>(call: &mut CallFuture<C>, deadline: Instant, spares: &SpareSlots) -> bool {
    let mut timer = TimerInUse { spares, timer: None };
    poll_fn(|cx| {
        if call.poll_ended(cx).is_ready() {
            return Poll::Ready(true);
        }
        timer.poll(deadline, cx).map(|()| false)
    })
    .await
}
