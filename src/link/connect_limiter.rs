//! Limits the connection attempts of links that share it: how many at once, and how many a second.
//!
//! ```text
//! queued ──near the head, a permit is free──▶ slot time assigned ──reached──▶ slot ──take_permit──▶ permit
//!                                                    └────────────dropped───────┴──▶ slot time and permit return
//! ```
//!
//! Invariants:
//! - No more connections are being opened than there are permits.
//! - On average, no more permits are taken a second than the rate allows.
//! - Waiting links are served in the order in which they came.
//! - A slot that is not used costs the others next to nothing: many calls may be given up while
//!   they wait. Therefore only links near the head of the queue have a slot time, and it is close.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, sleep_until};

use super::later;
use crate::random::Random;

#[derive(Debug)]
pub(crate) struct ConnectLimiter {
    /// Limits the head of the queue. There are several places, so that a task that is not polled
    /// does not stop the queue.
    first: Arc<Semaphore>,
    permits: Arc<Semaphore>,
    rate_limit: Mutex<RateLimit>,
}

/// The right to take a permit now. Dropping it gives its slot time back.
#[derive(Debug)]
pub(crate) struct ConnectSlot {
    limiter: Arc<ConnectLimiter>,
    /// `None` once it is taken.
    permit: Option<ConnectPermit>,
    /// Keeps a place at the head of the queue.
    _first: Option<OwnedSemaphorePermit>,
}

/// The right to open one connection, until it is dropped.
#[derive(Debug)]
pub(crate) struct ConnectPermit {
    /// Always `Some`: the semaphore is never closed.
    _permit: Option<OwnedSemaphorePermit>,
}

#[derive(Debug)]
struct RateLimit {
    /// Time between two slots.
    interval: Duration,
    /// The next free slot time.
    next_at: Option<Instant>,
    random: Random,
}

/// How far ahead slot times are assigned, and the minimum number of places at the head of the
/// queue.
const AHEAD: Duration = Duration::from_millis(20);
const FEWEST_AHEAD: usize = 4;

impl ConnectLimiter {
    pub(crate) fn new(at_once: usize, per_second: u32, seed: u64) -> Arc<Self> {
        let interval = Duration::from_secs(1).checked_div(per_second).unwrap_or(Duration::from_secs(1));
        let ahead = AHEAD
            .as_nanos()
            .checked_div(interval.as_nanos())
            .and_then(|places| usize::try_from(places).ok())
            .unwrap_or(usize::MAX);
        Arc::new(Self {
            first: Arc::new(Semaphore::new(ahead.clamp(FEWEST_AHEAD, Semaphore::MAX_PERMITS))),
            permits: Arc::new(Semaphore::new(at_once.clamp(1, Semaphore::MAX_PERMITS))),
            rate_limit: Mutex::new(RateLimit { interval, next_at: None, random: Random::new(seed) }),
        })
    }

    /// Waits for a slot.
    pub(crate) async fn wait(self: Arc<Self>) -> ConnectSlot {
        let first = self.first.clone().acquire_owned().await.ok();
        let permit = ConnectPermit { _permit: self.permits.clone().acquire_owned().await.ok() };
        // A link that need not wait does not use the timer, which counts in whole milliseconds.
        let now = Instant::now();
        let at = self.lock().reserve(now);
        let slot = ConnectSlot { limiter: self, permit: Some(permit), _first: first };
        if at > now {
            sleep_until(at).await;
        }
        slot
    }

    fn lock(&self) -> MutexGuard<'_, RateLimit> {
        // No code panics while it holds this lock.
        self.rate_limit.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ConnectSlot {
    pub(crate) fn take_permit(mut self) -> Option<ConnectPermit> {
        self.permit.take()
    }
}

impl Drop for ConnectSlot {
    fn drop(&mut self) {
        if self.permit.is_some() {
            self.limiter.lock().give_back();
        }
    }
}

impl RateLimit {
    /// Assigns the next slot time; `now`, if it is free.
    fn reserve(&mut self, now: Instant) -> Instant {
        match self.next_at.filter(|&at| at > now) {
            None => {
                self.next_at = Some(later(now, self.interval));
                now
            }
            Some(at) => {
                self.next_at = Some(later(at, self.interval));
                // Up to half an interval later, so that several programs do not connect in step.
                later(at, self.interval.saturating_sub(self.random.jitter(self.interval)))
            }
        }
    }

    /// Undoes one [`reserve`](Self::reserve). Slot times that were assigned meanwhile stay; the
    /// next one comes earlier instead.
    fn give_back(&mut self) {
        self.next_at = self.next_at.and_then(|at| at.checked_sub(self.interval));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn permits_are_given_at_the_rate_and_no_faster() {
        let limiter = ConnectLimiter::new(1000, 100, 1);
        let began = Instant::now();
        let mut permits = Vec::new();
        for n in 0..50_u32 {
            permits.push(limiter.clone().wait().await.take_permit());
            let due = Duration::from_millis(10) * n;
            let took = began.elapsed();
            assert!(due <= took && took <= due + Duration::from_millis(6), "{n}: {took:?}");
        }
        sleep_until(Instant::now() + Duration::from_secs(1)).await;
        let idle = Instant::now();
        for wait in [0, 10] {
            permits.push(limiter.clone().wait().await.take_permit());
            let (least, most) = (Duration::from_millis(wait), Duration::from_millis(wait + 6));
            assert!(
                (least..=most).contains(&idle.elapsed()),
                "a single link does not wait, and unused slots are not saved up"
            );
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_permit_is_given_when_another_is_dropped() {
        let limiter = ConnectLimiter::new(2, 1_000_000, 1);
        let permit = async || limiter.clone().wait().await.take_permit();
        let (first, _second) = (permit().await, permit().await);
        let third = permit();
        tokio::pin!(third);
        assert!(tokio::time::timeout(Duration::from_secs(1), &mut third).await.is_err());
        drop(first);
        assert!(tokio::time::timeout(Duration::from_millis(2), third).await.is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn fast_rates_are_reached_with_a_timer_of_milliseconds() {
        let limiter = ConnectLimiter::new(100_000, 5000, 1);
        let began = Instant::now();
        let mut waiting = tokio::task::JoinSet::new();
        for _ in 0..5000 {
            let slot = limiter.clone().wait();
            waiting.spawn(async move { drop(slot.await.take_permit()) });
        }
        waiting.join_all().await;
        let took = began.elapsed();
        assert!((990..=1100).contains(&took.as_millis()), "{took:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn unused_slots_cost_little_and_are_not_saved_up() {
        let interval = Duration::from_millis(10);
        for seed in 0..20 {
            let limiter = ConnectLimiter::new(10, 100, seed);
            let mut random = Random::new(seed);
            let began = Instant::now();
            let (taken, mut waiting) = (Arc::new(Mutex::new(Vec::new())), tokio::task::JoinSet::new());
            for _ in 0..1000 {
                let (limiter, taken, wanted) = (limiter.clone(), taken.clone(), random.next().is_multiple_of(5));
                waiting.spawn(async move {
                    let slot = limiter.wait().await;
                    if wanted {
                        slot.take_permit();
                        taken.lock().unwrap().push(began.elapsed());
                    }
                });
            }
            waiting.join_all().await;
            let taken = taken.lock().unwrap();
            let count = u32::try_from(taken.len()).unwrap();
            for (n, took) in (0..).zip(taken.iter()) {
                assert!(interval * n <= *took, "seed {seed}: slot {n} at {took:?} is earlier than the rate allows");
            }
            let (last, at_the_rate) = (taken.last().copied().unwrap_or_default(), interval * count);
            assert!(last <= at_the_rate.mul_f64(1.4), "seed {seed}: {last:?} instead of {at_the_rate:?}");
        }
    }
}
