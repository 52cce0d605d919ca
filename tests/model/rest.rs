//! Waiting until everything is at rest: no task can go on before time passes.
//!
//! That is when the runtime parks its thread. Whoever waits for it is woken then, and time does not pass yet.

use std::cell::RefCell;
use std::future::poll_fn;
use std::io;
use std::task::{Poll, Waker};

use tokio::runtime::{Builder, Runtime};
use tokio::time::Instant;

thread_local! {
    /// Who waits, and the time that must have passed.
    static WAITING: RefCell<Option<(Waker, Option<Instant>)>> = const { RefCell::new(None) };
}

/// A runtime with paused time, which tells of its rest.
pub(crate) fn runtime() -> io::Result<Runtime> {
    Builder::new_current_thread().enable_time().start_paused(true).on_thread_park(at_rest).build()
}

fn at_rest() {
    let has_passed = |time: &Option<Instant>| time.is_none_or(|time| time < Instant::now());
    let woken = WAITING.with_borrow_mut(|waiting| waiting.take_if(|(_, time)| has_passed(time)));
    if let Some((waker, _)) = woken {
        waker.wake();
    }
}

/// All have done what there is to be done at this time.
pub(crate) async fn rest() {
    rest_after(None).await;
}

/// The same at the next time at which there is something to be done, when this one is over. Some timer must be set.
pub(crate) async fn next_rest() {
    rest_after(Some(Instant::now())).await;
}

async fn rest_after(time: Option<Instant>) {
    let mut waits = false;
    poll_fn(|cx| {
        if !std::mem::replace(&mut waits, true) {
            WAITING.set(Some((cx.waker().clone(), time)));
        }
        if WAITING.with_borrow(Option::is_some) { Poll::Pending } else { Poll::Ready(()) }
    })
    .await;
}
