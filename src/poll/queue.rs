//! The bounded queue of samples: drops the oldest samples when it is full.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

use futures::task::AtomicWaker;

use super::Sample;

/// The oldest samples were dropped because the consumer was too slow.
///
/// [`PollerHandle::snapshot`](super::PollerHandle::snapshot) returns the newest sample of each tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[error("{count} samples were dropped because they were not taken in time")]
#[non_exhaustive]
pub struct Missed {
    /// The number of samples dropped since the previous [`Missed`].
    pub count: u64,
}

/// The capacity that an empty queue keeps.
const KEPT_CAPACITY: usize = 1024;

#[derive(Debug)]
pub(super) struct SampleQueue {
    state: Mutex<QueueState>,
    waker: AtomicWaker,
    capacity: usize,
}

#[derive(Debug, Default)]
struct QueueState {
    samples: VecDeque<Sample>,
    /// Samples dropped since the last [`Missed`].
    missed: u64,
    /// All samples pushed.
    total: u64,
    /// All samples dropped.
    total_missed: u64,
    closed: bool,
}

impl SampleQueue {
    pub(super) fn new(capacity: usize) -> Self {
        Self { state: Mutex::default(), waker: AtomicWaker::new(), capacity: capacity.max(1) }
    }

    /// Pushes samples and drops the oldest ones if the queue is full.
    pub(super) fn push(&self, samples: Vec<Sample>) {
        if samples.is_empty() {
            return;
        }
        let mut state = self.lock();
        if state.closed {
            return;
        }
        for sample in samples {
            state.total = state.total.saturating_add(1);
            if state.samples.len() >= self.capacity && state.samples.pop_front().is_some() {
                state.missed = state.missed.saturating_add(1);
                state.total_missed = state.total_missed.saturating_add(1);
            }
            state.samples.push_back(sample);
        }
        drop(state);
        self.waker.wake();
    }

    /// Pops the oldest sample, or [`Missed`] before it; `None` once the queue is closed and empty.
    pub(super) fn poll_next(&self, cx: &mut Context<'_>) -> Poll<Option<Result<Sample, Missed>>> {
        self.waker.register(cx.waker());
        let mut state = self.lock();
        if state.missed > 0 {
            return Poll::Ready(Some(Err(Missed { count: std::mem::take(&mut state.missed) })));
        }
        match state.samples.pop_front() {
            Some(sample) => {
                // Frees the memory of a burst.
                if state.samples.is_empty() && state.samples.capacity() > KEPT_CAPACITY {
                    state.samples.shrink_to(KEPT_CAPACITY);
                }
                Poll::Ready(Some(Ok(sample)))
            }
            None if state.closed => Poll::Ready(None),
            None => Poll::Pending,
        }
    }

    /// Refuses further samples. Queued ones can still be popped.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.waker.wake();
    }

    /// Drops all queued samples.
    pub(super) fn clear(&self) {
        self.lock().samples = VecDeque::new();
    }

    /// Returns the number of samples pushed, and of those dropped.
    pub(super) fn totals(&self) -> (u64, u64) {
        let state = self.lock();
        (state.total, state.total_missed)
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        // No code panics under this lock.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
