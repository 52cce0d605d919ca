//! State that the handles of a link and its task share: the [`Driver`], the inbox, and the task
//! itself.
//!
//! ```text
//! caller ──submit──▶ lock is free: sent at once ──────────────────────────┐
//!             │                                                            ├──▶ task: replies, timers, connections
//!             └─────▶ lock is taken: inbox ──▶ drained by the lock holder ─┘
//! ```
//!
//! A call never waits for the driver's lock; only a declaration of a station's commands does. One
//! caller or the task holds it for a short time, and checks the inbox once more after releasing it, so
//! no call is left there. Only the task opens connections, keeps the timer and is woken by I/O; callers
//! only put their request on the wire.
//!
//! Invariants:
//! - A call that is in the inbox when the lock is released is taken by the thread that has released
//!   it, or by the next holder.
//! - The task's timer is due no later than the first instant that the driver waits for.
//! - When the task has ended, for any reason, no call waits. If it has ended with its runtime, the
//!   next call starts another.
//! - A transport that panics ends the task, even if a caller was advancing the driver, and no
//!   caller.
//!
//! The task's timer is rearmed only after it has fired, or for an earlier instant. Nearly every
//! call has a later deadline than the one before it, so an early timer costs one wake-up per
//! response timeout; rearming per call would cost that each time.

#[cfg(test)]
mod tests;

use std::any::Any;
use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicBool, Ordering, fence};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::task::{Context, Poll, Waker};

use tokio::task::{unconstrained, yield_now};
use tokio::time::{Instant, Sleep, sleep_until};

use super::call::PendingCall;
use super::driver::{AdvancedBy, Driver, DriverStatus};
use super::in_step::Declared;
use super::io_waker::IoWaker;

/// The state of a link that its handles and its task share.
pub(crate) struct Shared {
    inbox: Mutex<VecDeque<PendingCall>>,
    /// `true` if a call was put into the inbox since it was emptied. Mostly none was, and then the
    /// inbox need not be locked.
    posted: AtomicBool,
    /// `None` once the task has ended.
    slot: Mutex<Option<Box<DriverSlot>>>,
    /// Wakes the task.
    io_waker: Arc<IoWaker>,
    started: AtomicBool,
    /// No new calls are accepted.
    closed: AtomicBool,
    /// No handle is left.
    orphaned: AtomicBool,
}

/// The driver, and the state of the task that goes with it. One thread has it at a time.
struct DriverSlot {
    driver: Driver,
    /// A waker of the link's `io_waker`, for all that the driver waits for, and for the timer.
    waker: Waker,
    /// The task that `io_waker` wakes.
    task: Option<Waker>,
    /// When the task's timer is due.
    timer: Option<Instant>,
    /// The panic of a transport while a caller was advancing the driver: the task resumes it.
    panic: Option<Box<dyn Any + Send>>,
}

impl Shared {
    pub(crate) fn new(driver: Driver) -> Self {
        let io_waker = driver.io_waker().clone();
        let waker = Waker::from(io_waker.clone());
        Self {
            inbox: Mutex::default(),
            posted: AtomicBool::new(false),
            slot: Mutex::new(Some(Box::new(DriverSlot { driver, waker, task: None, timer: None, panic: None }))),
            io_waker,
            started: AtomicBool::new(false),
            closed: AtomicBool::new(false),
            orphaned: AtomicBool::new(false),
        }
    }

    /// Returns whether the task has been started. With `start`, the first caller gets `false` and
    /// must start it.
    pub(crate) fn is_started(&self, start: bool) -> bool {
        self.started.load(Ordering::SeqCst) || (start && self.started.swap(true, Ordering::SeqCst))
    }

    /// Returns whether the link accepts no more calls.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Ends the link after the request on the wire has ended.
    pub(crate) fn close(&self) {
        self.closed.store(true, Ordering::SeqCst);
        if self.is_started(true) {
            self.io_waker.wake_task();
        } else {
            // A task that was never started has nothing to finish.
            self.end();
        }
    }

    /// Ends the link: the last handle was dropped.
    pub(crate) fn orphan(&self) {
        self.orphaned.store(true, Ordering::Release);
        self.io_waker.wake_task();
    }

    /// Declares capabilities of a station.
    pub(crate) fn declare(&self, station: u8, declared: Declared) {
        if let Some(slot) = lock(&self.slot).as_mut() {
            slot.driver.declare(station, declared);
        }
    }

    /// Takes a call, and sends it at once if the driver is free.
    pub(crate) fn submit(&self, call: PendingCall) {
        if self.is_closed() {
            return; // Dropped, it ends with the right error.
        }
        let mut slot = match self.slot.try_lock() {
            Ok(slot) => slot,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                self.post(call);
                return self.drain_inbox();
            }
        };
        let needs_task = slot.as_mut().is_some_and(|slot| {
            let now = call.queued_at;
            slot.serve(Some(call), self.take_inbox(), now)
        });
        drop(slot);
        if needs_task {
            self.io_waker.wake_task();
        }
        self.drain_inbox();
    }

    /// Empties the inbox, unless another thread has the driver: that one empties it.
    pub(crate) fn drain_inbox(&self) {
        while self.has_posted() {
            let mut slot = match self.slot.try_lock() {
                Ok(slot) => slot,
                Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => return,
            };
            let calls = self.take_inbox();
            let needs_task = slot.as_mut().is_some_and(|slot| slot.serve(None, calls, Instant::now()));
            drop(slot);
            if needs_task {
                self.io_waker.wake_task();
            }
        }
    }

    fn post(&self, call: PendingCall) {
        let mut inbox = lock(&self.inbox);
        inbox.push_back(call);
        self.posted.store(true, Ordering::Release);
    }

    /// Returns whether the inbox has a call. Asked after the driver's lock was released, or was found
    /// taken: of a caller that posts and one that has the driver at least one sees the call.
    fn has_posted(&self) -> bool {
        // One caller posts and then tries to lock again, in `drain_inbox`. The other releases the lock and
        // then looks at the flag. Without a fence in both, either could miss what the other has done.
        fence(Ordering::SeqCst);
        self.posted.load(Ordering::Acquire)
    }

    /// Takes all calls from the inbox.
    ///
    /// A call that is posted at the same moment may be missed: [`has_posted`](Self::has_posted) finds
    /// it after the driver's lock was released.
    fn take_inbox(&self) -> Option<VecDeque<PendingCall>> {
        if !self.posted.load(Ordering::Acquire) {
            return None;
        }
        let mut inbox = lock(&self.inbox);
        self.posted.store(false, Ordering::Release);
        Some(std::mem::take(&mut *inbox))
    }

    /// The link's task: runs until the link is closed, its last handle is dropped, or its only
    /// connection has ended.
    pub(crate) fn run(self: Arc<Self>) -> impl Future<Output = ()> + Send {
        // Ends the link also if the task is dropped with its runtime, even before it was first
        // polled.
        let shared = EndOnDrop { link: self, ends: false };
        async move {
            let mut shared = shared;
            let mut timer = pin!(sleep_until(Instant::now()));
            // Tokio's budget is not needed: `advance` yields by itself after a number of actions.
            while unconstrained(poll_fn(|cx| shared.poll(cx, timer.as_mut()))).await == TaskStatus::AfterEvents {
                // Tokio looks for I/O events before the task goes on.
                yield_now().await;
            }
            shared.ends = true;
        }
    }

    fn poll(&self, cx: &mut Context<'_>, mut timer: Pin<&mut Sleep>) -> Poll<TaskStatus> {
        loop {
            let mut guard = lock(&self.slot);
            let Some(slot) = guard.as_mut() else { return Poll::Ready(TaskStatus::Ended) };
            if !slot.task.as_ref().is_some_and(|task| task.will_wake(cx.waker())) {
                self.io_waker.register(cx.waker());
                slot.task = Some(cx.waker().clone());
            }
            if let Some(panic) = slot.panic.take() {
                drop(guard);
                resume_unwind(panic);
            }
            if self.is_closed() {
                slot.driver.close();
            }
            if self.orphaned.load(Ordering::Acquire) {
                slot.driver.orphan();
            }
            let inbox = self.take_inbox();
            let now = inbox.is_some().then(Instant::now);
            if let (Some(inbox), Some(now)) = (inbox, now) {
                inbox.into_iter().for_each(|call| slot.driver.push(call, now));
            }
            match slot.driver.advance(AdvancedBy::LinkTask, now, &slot.waker) {
                DriverStatus::Ended => return Poll::Ready(TaskStatus::Ended),
                DriverStatus::AfterEvents => return Poll::Ready(TaskStatus::AfterEvents),
                DriverStatus::NeedsTask | DriverStatus::Yield => {
                    cx.waker().wake_by_ref();
                    return Poll::Pending;
                }
                DriverStatus::Waiting(until) => {
                    let sooner = until.filter(|&until| slot.timer.is_none_or(|due| until < due));
                    if let Some(until) = sooner {
                        timer.as_mut().reset(until);
                        slot.timer = Some(until);
                    }
                    // A timer keeps the waker of its last poll, which is always the driver's, so it
                    // need not be polled again.
                    let polls = slot.timer.is_some() && (sooner.is_some() || timer.is_elapsed());
                    if polls && timer.as_mut().poll(&mut Context::from_waker(&slot.waker)).is_ready() {
                        slot.timer = None;
                        continue;
                    }
                }
            }
            drop(guard);
            if !self.has_posted() {
                return Poll::Pending;
            }
        }
    }

    /// The debug output of the driver's core; empty after the task has ended.
    #[cfg(test)]
    pub(crate) fn debug_text(&self) -> String {
        lock(&self.slot).as_ref().map(|slot| slot.driver.debug_text()).unwrap_or_default()
    }

    /// Detaches the link from a runtime that has ended: its calls fail, its connection is closed,
    /// and the next call starts a task again. Returns `false` if the link ends instead.
    fn detach(&self) -> bool {
        if self.is_closed() || self.orphaned.load(Ordering::Acquire) {
            return false;
        }
        let mut guard = lock(&self.slot);
        let Some(slot) = guard.as_mut() else { return false };
        if slot.panic.is_some() || !slot.driver.outlives_runtime() {
            return false;
        }
        // A waker keeps the memory of its task, and with it that of the runtime. Removed before
        // another task can start and register its own.
        self.io_waker.unregister();
        (slot.task, slot.timer) = (None, None);
        // Before the inbox is emptied: a call that comes later finds that the task must be started.
        self.started.store(false, Ordering::SeqCst);
        let inbox = std::mem::take(&mut *lock(&self.inbox));
        inbox.into_iter().for_each(|call| slot.driver.push(call, Instant::now()));
        slot.driver.runtime_ended();
        drop(guard);
        // Closed in the meantime, by a caller that took the task for running: that has to end it
        // now.
        let closed = self.closed.load(Ordering::SeqCst);
        !closed || self.started.swap(true, Ordering::SeqCst)
    }

    fn end(&self) {
        self.closed.store(true, Ordering::Release);
        let slot = lock(&self.slot).take();
        if let Some(slot) = slot {
            slot.driver.finish();
        }
        // A waker keeps the memory of its task, and with it that of the runtime.
        self.io_waker.unregister();
        // Dropping the calls ends them with the right error. The driver's lock was released before,
        // so a call that is posted later finds it free.
        drop(std::mem::take(&mut *lock(&self.inbox)));
    }
}

impl DriverSlot {
    /// Takes calls, and sends one if none is on the wire. Returns whether the task must be woken.
    fn serve(&mut self, call: Option<PendingCall>, inbox: Option<VecDeque<PendingCall>>, now: Instant) -> bool {
        let (can_send, awaiting_reply) = (self.driver.can_send_now(), self.driver.is_awaiting_reply());
        if let Some(inbox) = inbox {
            inbox.into_iter().for_each(|call| self.driver.push(call, now));
        }
        if let Some(call) = call {
            self.driver.push(call, now);
        }
        if self.panic.is_some() {
            return true;
        }
        if !can_send {
            return !awaiting_reply;
        }
        // Outside of Tokio's budget: a socket of a caller that has used up its budget would seem to
        // have no data.
        let (driver, waker) = (&mut self.driver, &self.waker);
        let mut advance = unconstrained(poll_fn(|_| Poll::Ready(driver.advance(AdvancedBy::Caller, Some(now), waker))));
        let advanced = catch_unwind(AssertUnwindSafe(|| Pin::new(&mut advance).poll(&mut Context::from_waker(waker))));
        match advanced {
            Ok(Poll::Ready(DriverStatus::Waiting(Some(until)))) => self.timer.is_none_or(|due| until < due),
            Ok(Poll::Ready(DriverStatus::Waiting(None))) => false,
            Ok(_) => true,
            Err(panic) => {
                self.panic = Some(panic);
                true
            }
        }
    }
}

/// Why the task has stopped to poll the driver.
#[derive(Debug, PartialEq, Eq)]
enum TaskStatus {
    Ended,
    /// The runtime must look for I/O events first.
    AfterEvents,
}

/// Ends the link when it is dropped, or leaves it to a task of another runtime.
struct EndOnDrop {
    link: Arc<Shared>,
    /// The task has ended by itself, or a transport has panicked; it was not dropped with its
    /// runtime.
    ends: bool,
}

impl EndOnDrop {
    fn poll(&mut self, cx: &mut Context<'_>, timer: Pin<&mut Sleep>) -> Poll<TaskStatus> {
        // Stays if the poll panics. A runtime may also be dropped by a panic of its user.
        self.ends = true;
        let status = self.link.poll(cx, timer);
        self.ends = false;
        status
    }
}

impl Drop for EndOnDrop {
    fn drop(&mut self) {
        if self.ends || !self.link.detach() {
            self.link.end();
        }
    }
}

/// Locks a mutex. Poisoning is ignored: the link's own code does not panic, and after a panic of a
/// transport the task ends.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
