//! Lets links that share it connect one after the other: only so many at once, and only so many a second.
//!
//! What must always hold: no more connections are being opened than there are passes; on average, no more passes are
//! given a second than the rate says. Those who wait are served in the order in which they came.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, sleep_until};

use super::later;
use crate::random::Random;

#[derive(Debug)]
pub(crate) struct Gate {
    passes: Arc<Semaphore>,
    pace: Mutex<Pace>,
}

/// The right to open a connection, until it is dropped.
#[derive(Debug)]
pub(crate) struct Pass {
    /// `None` cannot be: the semaphore is never closed.
    _permit: Option<OwnedSemaphorePermit>,
}

#[derive(Debug)]
struct Pace {
    /// The time from one to the next.
    interval: Duration,
    /// When the next one may go.
    next_at: Option<Instant>,
    random: Random,
}

impl Gate {
    pub(crate) fn new(at_once: usize, per_second: u32, seed: u64) -> Arc<Self> {
        let interval = Duration::from_secs(1).checked_div(per_second).unwrap_or(Duration::from_secs(1));
        Arc::new(Self {
            passes: Arc::new(Semaphore::new(at_once.clamp(1, Semaphore::MAX_PERMITS))),
            pace: Mutex::new(Pace { interval, next_at: None, random: Random::new(seed) }),
        })
    }

    /// Waits until it is the caller's turn.
    pub(crate) async fn pass(self: Arc<Self>) -> Pass {
        let permit = self.passes.clone().acquire_owned().await.ok();
        // Whoever need not wait does not touch the timer, which counts in whole milliseconds.
        let now = Instant::now();
        let at = self.reserve(now);
        if at > now {
            sleep_until(at).await;
        }
        Pass { _permit: permit }
    }

    /// Takes the next place in time, at once if that is free.
    fn reserve(&self, now: Instant) -> Instant {
        // Nothing panics while it holds this lock.
        let mut pace = self.pace.lock().unwrap_or_else(PoisonError::into_inner);
        let interval = pace.interval;
        match pace.next_at.filter(|&at| at > now) {
            None => {
                pace.next_at = Some(later(now, interval));
                now
            }
            Some(at) => {
                pace.next_at = Some(later(at, interval));
                // Up to half the interval later, so that several programs do not go on in step.
                later(at, interval.saturating_sub(pace.random.jitter(interval)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn passes_are_given_at_the_rate_and_no_faster() {
        let gate = Gate::new(1000, 100, 1);
        let began = Instant::now();
        let mut passes = Vec::new();
        for n in 0..50_u32 {
            passes.push(gate.clone().pass().await);
            let slot = Duration::from_millis(10) * n;
            let took = began.elapsed();
            assert!(slot <= took && took <= slot + Duration::from_millis(6), "{n}: {took:?}");
        }
        sleep_until(Instant::now() + Duration::from_secs(1)).await;
        let idle = Instant::now();
        gate.pass().await;
        assert_eq!(idle.elapsed(), Duration::ZERO, "who comes alone does not wait, and nothing is saved up");
    }

    #[tokio::test(start_paused = true)]
    async fn a_pass_is_given_when_another_is_given_back() {
        let gate = Gate::new(2, 1_000_000, 1);
        let (first, _second) = (gate.clone().pass().await, gate.clone().pass().await);
        let third = gate.clone().pass();
        tokio::pin!(third);
        assert!(tokio::time::timeout(Duration::from_secs(1), &mut third).await.is_err());
        drop(first);
        assert!(tokio::time::timeout(Duration::from_millis(2), third).await.is_ok());
    }
}
