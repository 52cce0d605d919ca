//! Callers, the task and its runtime, over a line whose PLC answers at once.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::pin;
use std::sync::Mutex;
use std::time::Duration;

use futures::future::FutureExt;
use tokio::task::coop::has_budget_remaining;
use tokio::task::{consume_budget, yield_now};
use tokio::time::Instant;

use super::{Arc, lock};
use crate::link::LinkState;
use crate::link::test_line::Line;
use crate::{CallOptions, Error, register};

#[tokio::test(start_paused = true)]
async fn the_task_sends_a_call_that_found_the_driver_busy() {
    let line = Line::default();
    let link = line.builder(true).build();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    let mut call = pin!(station.read_registers(register!("R0"), 1));
    {
        let _busy = lock(&link.inner.shared.slot);
        assert!(call.as_mut().now_or_never().is_none());
    }
    assert_eq!(lock(&link.inner.shared.inbox).len(), 1, "it was not sent");
    link.inner.shared.io_waker.wake_task();
    assert_eq!(call.await.expect("the task takes it"), [0]);
}

#[tokio::test(start_paused = true)]
async fn a_caller_sends_calls_that_came_while_it_had_the_driver() {
    let line = Line::default();
    let link = line.builder(true).broadcast_gap(Duration::ZERO).idle_timeout(None).build();
    let station = link.station(1).expect("a station");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    let all = link.broadcast();
    // The PLC repeats its last reply at the first broadcast only.
    all.write_registers(register!("R0"), &[2]).await.expect("it is sent");
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [2]);

    // Until the task has nothing left to do.
    for _ in 0..5 {
        yield_now().await;
    }
    let other = Arc::new(Mutex::new(None));
    let (made, station) = (other.clone(), station.clone());
    line.plc().during_write = Some(Box::new(move || {
        let mut call = async move { station.read_registers(register!("R0"), 1).await }.boxed();
        assert!((&mut call).now_or_never().is_none());
        *lock(&made) = Some(call);
    }));
    // A broadcast has no reply, so nothing wakes the task.
    all.write_registers(register!("R0"), &[2]).await.expect("it is sent");
    let call = lock(&other).take().expect("it was made during the write");
    let began = Instant::now();
    assert_eq!(call.await.expect("it is sent"), [2]);
    assert_eq!(began.elapsed(), Duration::ZERO, "it waits for no timer");
}

#[tokio::test(start_paused = true)]
async fn a_response_timeout_is_kept_while_the_timer_is_due_later() {
    let line = Line::default();
    let link = line.builder(true).idle_timeout(Duration::from_secs(60)).build();
    let timeout = Duration::from_millis(100);
    let options = CallOptions::new().with_retries(0).with_response_timeout(timeout);
    let station = link.station(1).expect("a station").with_options(options);
    assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
    yield_now().await;
    assert!(lock(&link.inner.shared.slot).as_ref().is_some_and(|slot| slot.timer.is_some()), "of the idle timeout");
    line.plc().silent = true;
    let began = Instant::now();
    let error = station.read_registers(register!("R0"), 1).await.expect_err("it is silent");
    assert!(matches!(error, Error::Timeout { after, .. } if after == timeout), "{error:?}");
    assert!((timeout..2 * timeout).contains(&began.elapsed()), "{:?}", began.elapsed());
}

#[test]
fn a_link_without_handles_ends_with_its_runtime() {
    let line = Line::default();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
    let state = runtime.block_on(async {
        let link = line.builder(true).build();
        let station = link.station(1).expect("a station");
        assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
        line.plc().silent = true;
        // The task waits for the end of an exchange.
        assert!(pin!(station.read_registers(register!("R0"), 1)).now_or_never().is_none());
        link.watch_state()
    });
    assert!(matches!(*state.borrow(), LinkState::Up));
    drop(runtime);
    assert!(matches!(*state.borrow(), LinkState::Closed), "{:?}", *state.borrow());
}

/// With the timer made behind the request, the write was sent, and its caller panicked.
#[test]
fn a_call_without_a_timer_sends_nothing() {
    let line = Line::default();
    let with_time = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
    let station = with_time.block_on(async {
        let station = line.builder(true).build().station(1).expect("a station");
        assert_eq!(station.read_registers(register!("R0"), 1).await.expect("it answers"), [0]);
        station
    });
    line.plc().answered.clear();
    let without_time = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
    let write = || without_time.block_on(station.write_registers(register!("R0"), &[1]));
    assert!(catch_unwind(AssertUnwindSafe(write)).is_err(), "a deadline needs a timer");
    assert!(line.plc().answered.is_empty(), "it was sent");
    with_time.block_on(async { station.read_registers(register!("R0"), 1).await.expect("it answers") });
    assert!(!line.plc().answered.is_empty());
}

/// A call whose first poll has used up the budget of its task goes on where it is polled next. With the timer
/// made there, a later call on the first runtime took that of the second one, which has ended, and panicked.
#[test]
fn the_timer_of_a_call_is_of_the_runtime_that_polls_it_first() {
    let line = Line::default();
    let builder = || tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_time().build();
    let (first, second) = (builder().expect("a runtime"), builder().expect("a runtime"));
    let link = line.builder(true).build();
    let station = link.station(1).expect("a station");
    let read = || async { station.read_registers(register!("R0"), 1).await.expect("it answers") };
    // On another thread, so that this one has no timer for the call.
    std::thread::scope(|scope| scope.spawn(|| first.block_on(read())).join()).expect("it does not panic");
    let mut call = Box::pin(read());
    first.block_on(async {
        while has_budget_remaining() {
            consume_budget().await;
        }
        assert!((&mut call).now_or_never().is_none(), "other tasks run first");
    });
    assert_eq!(second.block_on(call), [0]);
    drop(second);
    // A call that waits polls its timer.
    line.plc().silent = true;
    first.block_on(async { assert!(pin!(read()).now_or_never().is_none()) });
}
