//! The timer of a call's deadline.
//!
//! A call has a timer of its own, so it ends by its deadline even if the runtime of the link's task
//! stands still. To create, register and remove a timer costs more than all other work for the deadline.
//! So a timer is kept with the slot of its call for a later one ([`spares`](super::spares)), and is moved
//! only after it has fired, or for an earlier deadline.
//!
//! The link and the timer wake a call by the same [`CallTask`], so its caller registers its waker once.
//!
//! Invariants:
//! - A timer in use is due at the deadline of its call or before.
//! - A timer is used on the runtime that drives it, and on no other. Tokio gives no two runtimes of a
//!   process one id, as long as it counts them.
//! - A timer is polled only for a call that waits: a timer of a runtime that has ended panics then.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker, ready};

use futures::future::Future;
use futures::task::AtomicWaker;
use tokio::runtime::Id;
use tokio::task::unconstrained;
use tokio::time::{Instant, Sleep, sleep_until};

/// The task that waits for a call: woken when the call ends, and by the timer of its deadline.
#[derive(Debug, Default)]
pub(super) struct CallTask(AtomicWaker);

impl CallTask {
    pub(super) fn register(&self, task: &Waker) {
        self.0.register(task);
    }

    /// Removes the task: a waker keeps the memory of its task.
    pub(super) fn clear(&self) {
        drop(self.0.take());
    }

    pub(super) fn wake(&self) {
        self.0.wake();
    }
}

impl Wake for CallTask {
    fn wake(self: Arc<Self>) {
        self.0.wake();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.0.wake();
    }
}

/// A timer, and the runtime that drives it.
#[derive(Debug)]
pub(super) struct CallTimer {
    sleep: Pin<Box<Sleep>>,
    /// The timer is registered with its waker, or has fired since.
    registered: bool,
    /// Wakes the task of the call.
    waker: Waker,
    runtime: Id,
}

impl CallTimer {
    /// A timer of this runtime, on which the caller runs.
    pub(super) fn new(deadline: Instant, runtime: Id, task: Arc<CallTask>) -> Self {
        Self { sleep: Box::pin(sleep_until(deadline)), registered: false, waker: task.into(), runtime }
    }

    pub(super) fn runtime(&self) -> Id {
        self.runtime
    }

    /// Prepares the timer for a call with this deadline.
    pub(super) fn begin(&mut self, deadline: Instant) {
        if self.sleep.deadline() > deadline {
            self.reset(deadline);
        }
    }

    fn reset(&mut self, deadline: Instant) {
        self.sleep.as_mut().reset(deadline);
        self.registered = false;
    }

    /// Waits for the deadline. The timer may have been set for an earlier one. The caller has registered
    /// its task: a timer that fires later wakes it.
    pub(super) fn poll(&mut self, deadline: Instant) -> Poll<()> {
        while !self.registered || self.sleep.is_elapsed() {
            // Outside of Tokio's budget: an exhausted one would leave the timer unregistered.
            let mut sleep = unconstrained(self.sleep.as_mut());
            self.registered = true;
            ready!(Pin::new(&mut sleep).poll(&mut Context::from_waker(&self.waker)));
            if self.sleep.deadline() >= deadline {
                return Poll::Ready(());
            }
            self.reset(deadline);
        }
        Poll::Pending
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures::future::FutureExt;
    use tokio::runtime::{Builder, Handle, Runtime};

    use super::*;
    use crate::command::ReadStatus;
    use crate::link::CallOptions;
    use crate::link::call::spares::{self, MAX_KEPT};
    use crate::link::call::tests::call;
    use crate::link::call::{CallFuture, PendingCall};

    const SECOND: Duration = Duration::from_secs(1);

    /// The number of kept timers.
    fn kept() -> usize {
        spares::timers()
    }

    fn runtime() -> Runtime {
        Builder::new_current_thread().enable_all().start_paused(true).build().expect("a runtime")
    }

    /// Waits with a timer of the runtime that polls first.
    async fn ended_by(call: &mut CallFuture<ReadStatus>, deadline: Instant) -> bool {
        call.set_timer(deadline, Handle::current().id());
        call.ended_by(deadline).await
    }

    /// A call that waits for its deadline, this long from now. It ends then, so its timer is kept.
    async fn time_out_after(time: Duration) -> Duration {
        let (pending, mut future): (PendingCall, CallFuture<ReadStatus>) = call(CallOptions::new());
        let began = Instant::now();
        assert!(!ended_by(&mut future, began + time).await);
        drop(pending);
        future.recycle();
        began.elapsed()
    }

    #[tokio::test(start_paused = true)]
    async fn calls_with_a_kept_timer_end_at_their_own_deadlines() {
        for (n, seconds) in [10, 3, 3, 25, 1, 10].into_iter().enumerate() {
            assert_eq!(time_out_after(seconds * SECOND).await, seconds * SECOND);
            assert_eq!(kept(), 1, "call {n} has used the timer of the one before");
        }
        // Calls that end early leave a timer that is due before the next deadlines.
        for _ in 0..100 {
            let (pending, mut future) = call(CallOptions::new());
            let deadline = Instant::now() + 10 * SECOND;
            let (ended, ()) = tokio::join!(ended_by(&mut future, deadline), async {
                tokio::time::sleep(SECOND / 2).await;
                drop(pending);
            });
            future.recycle();
            assert!(ended && kept() == 1);
        }
        assert_eq!(time_out_after(SECOND).await, SECOND, "the timer of the last one is due later");
        assert_eq!(time_out_after(10 * SECOND).await, 10 * SECOND);
    }

    #[tokio::test(start_paused = true)]
    async fn calls_under_way_at_once_have_timers_of_their_own() {
        for _ in 0..2 {
            let calls = (1..=2 * MAX_KEPT).rev().map(|n| async move {
                let time = Duration::from_millis(u64::try_from(n).expect("a number"));
                assert_eq!(time_out_after(time).await, time);
            });
            futures::future::join_all(calls).await;
            assert_eq!(kept(), MAX_KEPT);
        }
    }

    /// With a timer of the ended runtime the call would wait forever, or panic.
    #[test]
    fn a_timer_is_not_used_on_another_runtime() {
        let (first, second) = (runtime(), runtime());
        for runtime in [&first, &second, &first] {
            assert_eq!(runtime.block_on(time_out_after(10 * SECOND)), 10 * SECOND);
            assert_eq!(kept(), 1, "that of the other runtime was dropped");
        }
        drop(first);
        assert_eq!(second.block_on(time_out_after(SECOND)), SECOND);
    }

    struct Idle;

    impl Wake for Idle {
        fn wake(self: Arc<Self>) {}
    }

    /// Polls a call with a waker of this task.
    fn poll(future: &mut CallFuture<ReadStatus>, task: &Arc<Idle>) {
        let mut waits = Box::pin(ended_by(future, Instant::now() + SECOND));
        let waker = Waker::from(task.clone());
        assert!(waits.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
        drop(waits);
        assert!(Arc::strong_count(task) >= 2);
    }

    #[tokio::test(start_paused = true)]
    async fn a_kept_timer_holds_no_waker() {
        let task = Arc::new(Idle);
        let (pending, mut future) = call(CallOptions::new());
        poll(&mut future, &task);
        drop(pending);
        future.recycle();
        assert_eq!((kept(), Arc::strong_count(&task)), (1, 1), "an ended call leaves its timer and no waker");
        let (pending, mut future) = call(CallOptions::new());
        poll(&mut future, &task);
        drop((future, pending));
        assert_eq!((kept(), Arc::strong_count(&task)), (0, 1), "an abandoned call leaves nothing");
    }

    /// Before, with a timer that is polled when it is kept: a panic in `drop`.
    #[test]
    fn a_call_may_be_dropped_after_its_runtime() {
        let (runtime, other) = (runtime(), runtime());
        for ends in [true, false] {
            let (pending, mut future) = call(CallOptions::new());
            let mut waits = Box::pin(ended_by(&mut future, Instant::now() + SECOND));
            runtime.block_on(async {
                assert!((&mut waits).now_or_never().is_none());
            });
            drop(waits);
            if ends {
                drop(pending);
            }
            future.recycle();
            assert_eq!(kept(), usize::from(ends));
            assert_eq!(other.block_on(time_out_after(SECOND)), SECOND, "that timer is not used");
        }
        let (_pending, mut future) = call(CallOptions::new());
        let mut waits = Box::pin(ended_by(&mut future, Instant::now() + SECOND));
        runtime.block_on(async {
            assert!((&mut waits).now_or_never().is_none());
        });
        drop(runtime);
        drop(waits);
        drop(future);
        assert_eq!(other.block_on(time_out_after(SECOND)), SECOND);
    }

    /// Before: that of the other runtime stayed below.
    #[test]
    fn all_kept_timers_are_of_one_runtime() {
        let (first, second) = (runtime(), runtime());
        let (pending, mut future) = call(CallOptions::new());
        let mut waits = Box::pin(ended_by(&mut future, Instant::now() + SECOND));
        first.block_on(async {
            assert!((&mut waits).now_or_never().is_none());
        });
        drop(waits);
        second.block_on(async {
            let waits_here = time_out_after(SECOND);
            tokio::pin!(waits_here);
            assert!(waits_here.as_mut().now_or_never().is_none());
            drop(pending);
            future.recycle();
            assert_eq!(kept(), 1, "that of the first runtime");
            assert_eq!(waits_here.await, SECOND);
        });
        assert_eq!(kept(), 1, "that of the second one");
    }
}
