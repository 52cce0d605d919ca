//! What wakes a link's task, and remembers whether it was the connection or the time that did.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};

use futures::task::AtomicWaker;

/// There are two ways to wake a task: what the driver waits for [`rings`](Wake::wake), everybody else [`calls`](Self::call).
/// So whoever has the driver knows, when it has not rung, that there is nothing to be read, and need not look.
///
/// What must always hold: since whoever [took](Self::take) the ring last looked, nothing has come without another ring.
#[derive(Debug, Default)]
pub(crate) struct Bell {
    task: AtomicWaker,
    rung: AtomicBool,
}

impl Bell {
    /// The task is woken by this from now on.
    pub(crate) fn wakes(&self, task: &Waker) {
        self.task.register(task);
    }

    /// Wakes nobody any more: a waker keeps the memory of its task.
    pub(crate) fn forget(&self) {
        drop(self.task.take());
    }

    /// Wakes the task.
    pub(crate) fn call(&self) {
        self.task.wake();
    }

    /// Whether it has rung, and nobody has looked since.
    pub(crate) fn has_rung(&self) -> bool {
        self.rung.load(Ordering::Acquire)
    }

    /// Whoever takes the ring must look, after this and not before.
    pub(crate) fn take(&self) {
        self.rung.swap(false, Ordering::AcqRel);
    }
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // Before the task can look whether it has.
        self.rung.store(true, Ordering::Release);
        self.call();
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
    fn a_ring_is_remembered_until_it_is_taken_and_a_call_is_none() {
        let (bell, woken) = (Arc::new(Bell::default()), Arc::new(Count::default()));
        let waker = Waker::from(bell.clone());
        let wakes = |times| {
            assert_eq!(woken.0.load(Ordering::Relaxed), times);
            bell.wakes(&Waker::from(woken.clone()));
        };
        wakes(0);
        bell.call();
        assert!(!bell.has_rung());
        wakes(1);
        waker.wake_by_ref();
        assert!(bell.has_rung() && bell.has_rung());
        wakes(2);
        bell.take();
        assert!(!bell.has_rung());
        waker.wake();
        assert!(bell.has_rung());
        wakes(3);
        bell.forget();
        assert_eq!(Arc::strong_count(&woken), 1, "it keeps nothing of the task");
        bell.call();
        wakes(3);
    }
}
