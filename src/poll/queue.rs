//! Samples on their way to the consumer: a bounded queue that gives up the oldest ones rather than wait.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

use futures::task::AtomicWaker;

use super::Sample;

/// Samples were dropped, the oldest ones, because they were not taken in time.
///
/// [`PollerHandle::snapshot`](super::PollerHandle::snapshot) gives the newest one of each tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, thiserror::Error)]
#[error("{count} samples were not taken in time and have been dropped")]
#[non_exhaustive]
pub struct Missed {
    /// How many, since this was last told.
    pub count: u64,
}

/// For so many samples there is always room.
const KEPT: usize = 1024;

#[derive(Debug)]
pub(super) struct Queue {
    inner: Mutex<Inner>,
    waker: AtomicWaker,
    capacity: usize,
}

#[derive(Debug, Default)]
struct Inner {
    samples: VecDeque<Sample>,
    /// Dropped and not told yet.
    missed: u64,
    /// All that came, and all that were dropped.
    total: u64,
    total_missed: u64,
    closed: bool,
}

impl Queue {
    pub(super) fn new(capacity: usize) -> Self {
        Self { inner: Mutex::default(), waker: AtomicWaker::new(), capacity: capacity.max(1) }
    }

    /// Takes all of these, whatever it costs those that are there.
    pub(super) fn push(&self, samples: Vec<Sample>) {
        if samples.is_empty() {
            return;
        }
        let mut inner = self.lock();
        if inner.closed {
            return;
        }
        for sample in samples {
            inner.total = inner.total.saturating_add(1);
            if inner.samples.len() >= self.capacity && inner.samples.pop_front().is_some() {
                inner.missed = inner.missed.saturating_add(1);
                inner.total_missed = inner.total_missed.saturating_add(1);
            }
            inner.samples.push_back(sample);
        }
        drop(inner);
        self.waker.wake();
    }

    /// The oldest sample; before it, that there were older ones. `None` once it is closed and empty.
    pub(super) fn poll_next(&self, cx: &mut Context<'_>) -> Poll<Option<Result<Sample, Missed>>> {
        self.waker.register(cx.waker());
        let mut inner = self.lock();
        if inner.missed > 0 {
            return Poll::Ready(Some(Err(Missed { count: std::mem::take(&mut inner.missed) })));
        }
        match inner.samples.pop_front() {
            Some(sample) => {
                // What a burst needed is not kept for the next one.
                if inner.samples.is_empty() && inner.samples.capacity() > KEPT {
                    inner.samples.shrink_to(KEPT);
                }
                Poll::Ready(Some(Ok(sample)))
            }
            None if inner.closed => Poll::Ready(None),
            None => Poll::Pending,
        }
    }

    /// Takes nothing more. What is there can still be had.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.waker.wake();
    }

    /// Gives up what is there: nobody will take it.
    pub(super) fn clear(&self) {
        self.lock().samples = VecDeque::new();
    }

    /// How many samples came, and how many of them were dropped.
    pub(super) fn totals(&self) -> (u64, u64) {
        let inner = self.lock();
        (inner.total, inner.total_missed)
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Nothing panics while it holds this lock.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
