//! The waker of a link's task, which records whether I/O woke it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Wake, Waker};

/// Wakes a link's task.
///
/// Sockets and timers of the driver wake it as a [`Waker`], which sets the ready flag; callers use
/// [`wake_task`](Self::wake_task), which does not. If the flag is clear, the socket has no unread
/// data, and the driver skips the read.
///
/// A task is registered once, by its first poll, and stays registered when it is woken. So it need
/// not be registered by each poll.
///
/// Invariant: no I/O event has come since the last [`clear_ready`](Self::clear_ready) and the read
/// after it, unless the flag is set again.
#[derive(Debug, Default)]
pub(crate) struct IoWaker {
    task: Mutex<Option<Waker>>,
    ready: AtomicBool,
}

impl IoWaker {
    /// Registers the task to be woken.
    pub(crate) fn register(&self, task: &Waker) {
        let before = self.task().replace(task.clone());
        drop(before);
    }

    /// Removes the task: a waker keeps its task's memory alive.
    pub(crate) fn unregister(&self) {
        let task = self.task().take();
        drop(task);
    }

    /// Wakes the task without setting the flag.
    pub(crate) fn wake_task(&self) {
        // Under the lock: it is the waker of a task of Tokio, which schedules it and does no more.
        if let Some(task) = &*self.task() {
            task.wake_by_ref();
        }
    }

    fn task(&self) -> MutexGuard<'_, Option<Waker>> {
        self.task.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether an I/O event has come since the flag was cleared.
    pub(crate) fn is_ready(&self) -> bool {
        self.ready.load(Ordering::Acquire)
    }

    /// Sets the flag, then wakes the task: it may check the flag at once.
    fn set_ready(&self) {
        self.ready.store(true, Ordering::Release);
        self.wake_task();
    }

    /// Clears the flag. The caller must read after this, not before.
    pub(crate) fn clear_ready(&self) {
        // Mostly it is clear, and then nothing must be ordered before the read.
        if self.is_ready() {
            self.ready.swap(false, Ordering::AcqRel);
        }
    }
}

impl Wake for IoWaker {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.set_ready();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicUsize;

    #[derive(Default)]
    struct Count(AtomicUsize);

    impl Wake for Count {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn io_sets_the_ready_flag_and_a_callers_wake_up_does_not() {
        let (io_waker, woken) = (Arc::new(IoWaker::default()), Arc::new(Count::default()));
        let waker = Waker::from(io_waker.clone());
        let wakes = |times| assert_eq!(woken.0.load(Ordering::Relaxed), times);
        io_waker.wake_task();
        wakes(0);
        io_waker.register(&Waker::from(woken.clone()));
        io_waker.wake_task();
        assert!(!io_waker.is_ready());
        wakes(1);
        waker.wake_by_ref();
        assert!(io_waker.is_ready() && io_waker.is_ready());
        wakes(2);
        io_waker.clear_ready();
        assert!(!io_waker.is_ready());
        waker.wake();
        assert!(io_waker.is_ready());
        wakes(3);
        io_waker.unregister();
        assert_eq!(Arc::strong_count(&woken), 1, "no waker of the task is kept");
        io_waker.wake_task();
        wakes(3);
    }
}
