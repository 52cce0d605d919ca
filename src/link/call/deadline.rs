//! The timers of calls' deadlines, kept for later calls of the thread.
//!
//! A call has a timer of its own, so it ends by its deadline even if the runtime of the link's task
//! stands still. To create, register and remove a timer costs more than all other work for the deadline.
//! So a call takes a timer that an earlier one has left, and moves it only after it has fired, or for an
//! earlier deadline.
//!
//! Invariants:
//! - A timer in use is due at the deadline of its call or before.
//! - A timer is used on the runtime that drives it, and on no other. Tokio gives no two runtimes of a
//!   process one id, as long as it counts them.
//! - A timer is polled only for a call that waits: a timer of a runtime that has ended panics then.
//! - A timer that no call uses holds no waker of a task: a waker keeps the memory of its task.
//! - A thread keeps a bounded number of timers, all of the runtime that it was used with last. A timer
//!   keeps the memory and the descriptors of its runtime.

use std::cell::RefCell;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker, ready};

use futures::future::Future;
use futures::task::AtomicWaker;
use tokio::runtime::{Handle, Id, TryCurrentError};
use tokio::task::unconstrained;
use tokio::time::{Instant, Sleep, sleep_until};

use super::CallFuture;
use crate::command::Command;

/// Maximum number of timers that a thread keeps.
const MAX_KEPT: usize = 256;

thread_local! {
    static KEPT: RefCell<Vec<CallTimer>> = const { RefCell::new(Vec::new()) };
}

/// A timer, and the runtime that drives it.
struct CallTimer {
    sleep: Pin<Box<Sleep>>,
    /// The timer is registered with its own waker, or has fired since.
    registered: bool,
    /// The task of the call that uses it.
    task: Arc<Task>,
    /// Wakes `task`.
    waker: Waker,
    runtime: Id,
}

/// The task to be woken by a timer. `None`: no call uses the timer.
#[derive(Default)]
struct Task(AtomicWaker);

impl Wake for Task {
    fn wake(self: Arc<Self>) {
        self.0.wake();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.0.wake();
    }
}

impl CallTimer {
    /// Takes a timer of this runtime that is due at the deadline or before.
    fn take(deadline: Instant, runtime: Id) -> Self {
        let timer = with_kept(|kept| {
            keep_only(kept, runtime);
            kept.pop()
        });
        let Some(mut timer) = timer.flatten() else {
            let task = Arc::<Task>::default();
            let waker = task.clone().into();
            return Self { sleep: Box::pin(sleep_until(deadline)), registered: false, task, waker, runtime };
        };
        if timer.sleep.deadline() > deadline {
            timer.reset(deadline);
        }
        timer
    }

    /// Leaves the timer to a later call.
    fn keep(self) {
        drop(self.task.0.take());
        with_kept(|kept| {
            keep_only(kept, self.runtime);
            if kept.len() < MAX_KEPT {
                kept.push(self);
            }
        });
    }

    fn reset(&mut self, deadline: Instant) {
        self.sleep.as_mut().reset(deadline);
        self.registered = false;
    }

    /// Waits for the deadline. The timer may have been set for an earlier one.
    fn poll(&mut self, deadline: Instant, cx: &mut Context<'_>) -> Poll<()> {
        self.task.0.register(cx.waker());
        // Looked at after the task was registered: a timer that fires later wakes it.
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

/// Drops the kept timers of other runtimes. All are of one runtime.
fn keep_only(kept: &mut Vec<CallTimer>, runtime: Id) {
    if kept.last().is_some_and(|timer| timer.runtime != runtime) {
        kept.clear();
    }
}

/// `None`: the thread is ending, or it drops a timer, which may end tasks whose calls have timers. It
/// keeps none then.
fn with_kept<R>(work: impl FnOnce(&mut Vec<CallTimer>) -> R) -> Option<R> {
    KEPT.try_with(|kept| kept.try_borrow_mut().ok().map(|mut kept| work(&mut kept))).ok().flatten()
}

/// The timer of a call, until it has ended. `None` while it is dropped.
pub(crate) struct TimerInUse(Option<CallTimer>);

impl TimerInUse {
    /// Takes a timer for this deadline.
    ///
    /// # Errors
    /// The caller is in no runtime.
    pub(crate) fn take(deadline: Instant) -> Result<Self, TryCurrentError> {
        let runtime = Handle::try_current()?.id();
        Ok(Self(Some(CallTimer::take(deadline, runtime))))
    }
}

impl Drop for TimerInUse {
    fn drop(&mut self) {
        if let Some(timer) = self.0.take() {
            timer.keep();
        }
    }
}

/// Waits until a call has ended or its deadline has passed. Returns whether it has ended.
pub(crate) async fn ended_by<C: Command>(call: &mut CallFuture<C>, timer: &mut TimerInUse, deadline: Instant) -> bool {
    poll_fn(|cx| match (call.poll_ended(cx), &mut timer.0) {
        (Poll::Ready(()), _) => Poll::Ready(true),
        (Poll::Pending, Some(timer)) => timer.poll(deadline, cx).map(|()| false),
        (Poll::Pending, None) => Poll::Pending,
    })
    .await
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures::future::FutureExt;
    use tokio::runtime::{Builder, Runtime};

    use super::*;
    use crate::command::ReadStatus;
    use crate::link::CallOptions;
    use crate::link::call::PendingCall;
    use crate::link::call::tests::call;

    const SECOND: Duration = Duration::from_secs(1);

    fn kept() -> usize {
        with_kept(|kept| kept.len()).expect("the thread is alive")
    }

    fn runtime() -> Runtime {
        Builder::new_current_thread().enable_all().start_paused(true).build().expect("a runtime")
    }

    /// Waits with a timer of the runtime that polls first.
    async fn ended_by(call: &mut CallFuture<ReadStatus>, deadline: Instant) -> bool {
        let mut timer = TimerInUse::take(deadline).expect("a runtime");
        super::ended_by(call, &mut timer, deadline).await
    }

    /// A call that waits for its deadline, this long from now.
    async fn time_out_after(time: Duration) -> Duration {
        let (_pending, mut future): (PendingCall, CallFuture<ReadStatus>) = call(CallOptions::new());
        let began = Instant::now();
        assert!(!ended_by(&mut future, began + time).await);
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

    #[tokio::test(start_paused = true)]
    async fn a_kept_timer_holds_no_waker() {
        let task = Arc::<Task>::default();
        let (pending, mut future) = call(CallOptions::new());
        {
            let mut waits = Box::pin(ended_by(&mut future, Instant::now() + SECOND));
            let waker = Waker::from(task.clone());
            assert!(waits.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
            assert!(Arc::strong_count(&task) > 1);
        }
        drop((pending, future));
        assert_eq!((kept(), Arc::strong_count(&task)), (1, 1), "a dropped call leaves its timer and no waker");
    }

    /// Before, with a timer that is polled when it is kept: a panic in `drop`.
    #[test]
    fn a_call_may_be_dropped_after_its_runtime() {
        let (runtime, other) = (runtime(), runtime());
        let (_pending, mut future) = call(CallOptions::new());
        let mut waits = Box::pin(ended_by(&mut future, Instant::now() + SECOND));
        runtime.block_on(async {
            assert!((&mut waits).now_or_never().is_none());
        });
        drop(runtime);
        drop(waits);
        assert_eq!(kept(), 1);
        assert_eq!(other.block_on(time_out_after(SECOND)), SECOND, "that timer is not used");
    }

    /// Before: that of the other runtime stayed below.
    #[test]
    fn all_kept_timers_are_of_one_runtime() {
        let (first, second) = (runtime(), runtime());
        let (_pending, mut future) = call(CallOptions::new());
        let mut waits = Box::pin(ended_by(&mut future, Instant::now() + SECOND));
        first.block_on(async {
            assert!((&mut waits).now_or_never().is_none());
        });
        second.block_on(async {
            let waits_here = time_out_after(SECOND);
            tokio::pin!(waits_here);
            assert!(waits_here.as_mut().now_or_never().is_none());
            drop(waits);
            assert_eq!(waits_here.await, SECOND);
        });
        assert_eq!(kept(), 1);
    }
}
