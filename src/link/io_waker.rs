//! The waker of a link's task, which records whether I/O woke it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};

/// Wakes a link's task.
///
/// Sockets and timers of the driver wake it as a [`Waker`], which sets the ready flag; callers use
/// [`wake_task`](Self::wake_task), which does not. If the flag is clear, the socket has no unread
/// data, and the driver skips the read.
///
/// Each task of a link has its own, made by its first poll. So no lock and no exchange of wakers is
/// needed to wake it.
///
/// Invariant: no I/O event has come since the last [`clear_ready`](Self::clear_ready) and the read
/// after it, unless the flag is set again.
#[derive(Debug)]
pub(crate) struct IoWaker {
    task: Waker,
    ready: AtomicBool,
}

impl IoWaker {
    pub(crate) fn new(task: &Waker) -> Self {
        Self { task: task.clone(), ready: AtomicBool::new(false) }
    }

    /// The waker of no task: none runs.
    pub(crate) fn noop() -> Self {
        Self::new(Waker::noop())
    }

    /// Returns whether it wakes this task.
    pub(crate) fn wakes(&self, task: &Waker) -> bool {
        self.task.will_wake(task)
    }

    /// Wakes the task without setting the flag.
    pub(crate) fn wake_task(&self) {
        self.task.wake_by_ref();
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
        let woken = Arc::new(Count::default());
        let task = Waker::from(woken.clone());
        let io_waker = Arc::new(IoWaker::new(&task));
        assert!(io_waker.wakes(&task) && !IoWaker::noop().wakes(&task));
        let waker = Waker::from(io_waker.clone());
        let wakes = |times| assert_eq!(woken.0.load(Ordering::Relaxed), times);
        wakes(0);
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
        drop((task, io_waker));
        assert_eq!(Arc::strong_count(&woken), 1, "no waker of the task is kept");
    }
}
