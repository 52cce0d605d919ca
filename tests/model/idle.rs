//! Waits until the runtime is idle: no task can proceed before time passes.
//!
//! The runtime is idle when it parks its thread. The waiter is woken then, before time advances.

use std::cell::RefCell;
use std::future::poll_fn;
use std::io;
use std::task::{Poll, Waker};

use tokio::runtime::{Builder, Runtime};
use tokio::time::Instant;

thread_local! {
    /// Waker of the waiter, and the time that must have passed.
    static WAITING: RefCell<Option<(Waker, Option<Instant>)>> = const { RefCell::new(None) };
}

/// Creates a runtime with paused time that reports when it is idle.
pub(crate) fn runtime() -> io::Result<Runtime> {
    Builder::new_current_thread().enable_time().start_paused(true).on_thread_park(on_park).build()
}

fn on_park() {
    let has_passed = |time: &Option<Instant>| time.is_none_or(|time| time < Instant::now());
    let woken = WAITING.with_borrow_mut(|waiting| waiting.take_if(|(_, time)| has_passed(time)));
    if let Some((waker, _)) = woken {
        waker.wake();
    }
}

/// Waits until no task can proceed at the current time.
pub(crate) async fn idle() {
    idle_after(None).await;
}

/// Waits until no task can proceed at the next time at which a timer fires. Needs a pending timer.
pub(crate) async fn next_idle() {
    idle_after(Some(Instant::now())).await;
}

/// Number of times that the thread must park: a task that yields to the runtime's events makes it
/// park once for each time that it yields.
const PARKS: usize = 6;

async fn idle_after(time: Option<Instant>) {
    park_after(time).await;
    for _ in 1..PARKS {
        park_after(None).await;
    }
}

async fn park_after(time: Option<Instant>) {
    let mut waits = false;
    poll_fn(|cx| {
        if !std::mem::replace(&mut waits, true) {
            WAITING.set(Some((cx.waker().clone(), time)));
        }
        if WAITING.with_borrow(Option::is_some) { Poll::Pending } else { Poll::Ready(()) }
    })
    .await;
}
