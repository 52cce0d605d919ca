//! What the handles of a link and its task share: the [`Driver`], the calls on their way to it, and the task itself.
//!
//! ```text
//! caller ──submit──▶ driver is free: sent at once ─────────────────────────────┐
//!             │                                                                 ├──▶ task: replies, times, connections
//!             └─────▶ somebody has it: inbox ──▶ taken out by whoever has it ───┘
//! ```
//!
//! A caller never waits for the driver: it is had for a moment by one caller or by the task, and whoever lets go of it looks
//! at the inbox once more, so no call is left there. The task alone opens connections, watches the time and is woken by what
//! comes; callers only put their request on the wire.
//!
//! What must always hold:
//! - a call that is in the inbox when the driver is let go of is taken out by whoever lets go of it, or by whoever has it next;
//! - the task's timer is due no later than the first time that the driver waits for;
//! - when the task has ended, however it did, no call waits;
//! - a transport that panics ends the task, whoever lent it the time, and no caller.
//!
//! The timer is put off only when it has gone off: nearly every call waits for its reply longer than its predecessor did, so
//! a timer that is due too early costs one look a second, and one that were set anew for each call would cost that each time.

use std::any::Any;
use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::panic::{AssertUnwindSafe, RefUnwindSafe, catch_unwind, resume_unwind};
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};
use std::task::{Context, Poll};

use futures::future::FutureExt;
use tokio::task::unconstrained;
use tokio::time::{Instant, Sleep, sleep_until};

use super::bell::Bell;
use super::call::Ticket;
use super::driver::{By, Driver, Next};

pub(crate) struct Hub {
    inbox: Mutex<VecDeque<Ticket>>,
    /// Whether anything has been put into the inbox since it was emptied: mostly nothing, and then it need not be locked.
    posted: AtomicBool,
    /// Until the task has ended.
    desk: Mutex<Option<Box<Desk>>>,
    /// Wakes the task.
    bell: Arc<Bell>,
    started: AtomicBool,
    /// No new calls.
    closed: AtomicBool,
    /// No handles.
    orphaned: AtomicBool,
}

/// Wakers are swapped whole, and after a panic the locks are still good.
impl RefUnwindSafe for Hub {}

/// What only one has at a time.
struct Desk {
    driver: Driver,
    /// When the task's timer is due.
    timer: Option<Instant>,
    /// What a transport did to a caller that lent its time: it is the task that ends with it.
    panic: Option<Box<dyn Any + Send>>,
}

impl Hub {
    pub(crate) fn new(driver: Driver) -> Self {
        let bell = driver.bell().clone();
        Self {
            inbox: Mutex::default(),
            posted: AtomicBool::new(false),
            desk: Mutex::new(Some(Box::new(Desk { driver, timer: None, panic: None }))),
            bell,
            started: AtomicBool::new(false),
            closed: AtomicBool::new(false),
            orphaned: AtomicBool::new(false),
        }
    }

    /// Whether the task has been started; if not, whoever asks with `start` must do it now.
    pub(crate) fn is_started(&self, start: bool) -> bool {
        self.started.load(Ordering::Acquire) || (start && self.started.swap(true, Ordering::AcqRel))
    }

    /// Whether there will be no more calls.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Ends the link when what is on the wire has ended.
    pub(crate) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        if self.is_started(true) {
            self.bell.call();
        } else {
            // A task that has not been started has nothing to finish.
            self.end();
        }
    }

    /// The last handle is gone.
    pub(crate) fn orphan(&self) {
        self.orphaned.store(true, Ordering::Release);
        self.bell.call();
    }

    /// Takes a call, and sends it at once if that can be.
    pub(crate) fn submit(&self, ticket: Ticket) {
        if self.is_closed() {
            return; // Dropped, it ends with the right error.
        }
        let mut desk = match self.desk.try_lock() {
            Ok(desk) => desk,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => {
                self.post(ticket);
                return self.deliver();
            }
        };
        let wakes = desk.as_mut().is_some_and(|desk| {
            let now = ticket.queued_at;
            desk.serve(Some(ticket), self.take_inbox(), now)
        });
        drop(desk);
        if wakes {
            self.bell.call();
        }
        self.deliver();
    }

    /// Sees to it that nothing is left in the inbox, unless somebody has the driver, who then does so.
    fn deliver(&self) {
        while !lock(&self.inbox).is_empty() {
            let mut desk = match self.desk.try_lock() {
                Ok(desk) => desk,
                Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => return,
            };
            let calls = self.take_inbox();
            let wakes = desk.as_mut().is_some_and(|desk| desk.serve(None, calls, Instant::now()));
            drop(desk);
            if wakes {
                self.bell.call();
            }
        }
    }

    fn post(&self, ticket: Ticket) {
        let mut inbox = lock(&self.inbox);
        inbox.push_back(ticket);
        self.posted.store(true, Ordering::Release);
    }

    /// Takes what is in the inbox. What is put there at this very moment may be left: [`deliver`](Self::deliver) and the
    /// task look again, behind the lock.
    fn take_inbox(&self) -> VecDeque<Ticket> {
        if !self.posted.load(Ordering::Acquire) {
            return VecDeque::new();
        }
        let mut inbox = lock(&self.inbox);
        self.posted.store(false, Ordering::Release);
        std::mem::take(&mut *inbox)
    }

    /// The task: runs until the link is closed, its last handle is dropped, or its one connection has ended.
    pub(crate) fn run(self: Arc<Self>) -> impl Future<Output = ()> + Send {
        // Also when the task is dropped, with its runtime, and be it before its first turn.
        let hub = End(self);
        async move {
            let hub = hub;
            let mut timer = pin!(sleep_until(Instant::now()));
            // It takes turns with others by itself, after so many steps.
            unconstrained(poll_fn(|cx| hub.0.poll(cx, timer.as_mut()))).await;
        }
    }

    fn poll(&self, cx: &mut Context<'_>, mut timer: Pin<&mut Sleep>) -> Poll<()> {
        self.bell.wakes(cx.waker());
        loop {
            let mut guard = lock(&self.desk);
            let Some(desk) = guard.as_mut() else { return Poll::Ready(()) };
            if let Some(panic) = desk.panic.take() {
                drop(guard);
                resume_unwind(panic);
            }
            if self.is_closed() {
                desk.driver.close();
            }
            if self.orphaned.load(Ordering::Acquire) {
                desk.driver.orphan();
            }
            let inbox = self.take_inbox();
            let now = (!inbox.is_empty()).then(Instant::now);
            for (ticket, now) in inbox.into_iter().zip(now.into_iter().cycle()) {
                desk.driver.push(ticket, now);
            }
            match desk.driver.advance(By::Task, now) {
                Next::End => return Poll::Ready(()),
                Next::Task | Next::Yield => {
                    cx.waker().wake_by_ref();
                    return Poll::Pending;
                }
                Next::Wait(until) => {
                    let sooner = until.filter(|&until| desk.timer.is_none_or(|due| until < due));
                    if let Some(until) = sooner {
                        timer.as_mut().reset(until);
                        desk.timer = Some(until);
                    }
                    // Once it has been polled, it rings: the bell is always the same.
                    let polls = desk.timer.is_some() && (sooner.is_some() || timer.is_elapsed());
                    if polls && timer.as_mut().poll(&mut desk.driver.context()).is_ready() {
                        desk.timer = None;
                        continue;
                    }
                }
            }
            drop(guard);
            if lock(&self.inbox).is_empty() {
                return Poll::Pending;
            }
        }
    }

    /// What the driver's core is, in words; nothing when the task has ended.
    #[cfg(test)]
    pub(crate) fn shown(&self) -> String {
        lock(&self.desk).as_ref().map(|desk| desk.driver.shown()).unwrap_or_default()
    }

    fn end(&self) {
        self.closed.store(true, Ordering::Release);
        let desk = lock(&self.desk).take();
        if let Some(desk) = desk {
            desk.driver.finish();
        }
        // It would keep the memory of the task, and with it the runtime's.
        self.bell.forget();
        // Dropped, they end with the right error. Behind the lock, so that whoever puts a call there later finds the desk free.
        drop(std::mem::take(&mut *lock(&self.inbox)));
    }
}

impl Desk {
    /// Takes calls, and sends one if none is on the wire; says whether the task must look after the rest.
    fn serve(&mut self, ticket: Option<Ticket>, inbox: VecDeque<Ticket>, now: Instant) -> bool {
        let (free, at_work) = (self.driver.is_free(), self.driver.is_at_work());
        for ticket in inbox {
            self.driver.push(ticket, now);
        }
        if let Some(ticket) = ticket {
            self.driver.push(ticket, now);
        }
        if self.panic.is_some() {
            return true;
        }
        if !free {
            return !at_work;
        }
        // What comes must be seen, however much the caller has done in this turn of its.
        let advance = unconstrained(async { self.driver.advance(By::Caller, Some(now)) });
        match catch_unwind(AssertUnwindSafe(|| advance.now_or_never())) {
            Ok(Some(Next::Wait(Some(until)))) => self.timer.is_none_or(|due| until < due),
            Ok(Some(Next::Wait(None))) => false,
            Ok(_) => true,
            Err(panic) => {
                self.panic = Some(panic);
                true
            }
        }
    }
}

/// Ends the link when it is dropped.
struct End(Arc<Hub>);

impl Drop for End {
    fn drop(&mut self) {
        self.0.end();
    }
}

/// A lock whose holder panicked is still good: the link's own code does not panic, and after a transport has, the task ends.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
