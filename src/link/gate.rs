//! Lets links that share it connect one after the other: only so many at once, and only so many a second.
//!
//! ```text
//! in line ──among the first, a pass is free──▶ has a place in time ──it has come──▶ turn ──take──▶ pass
//!                                                    └────────────dropped───────────┴──▶ all free for another
//! ```
//!
//! What must always hold: no more connections are being opened than there are passes; on average, no more passes are
//! taken a second than the rate says. Those who wait are served in the order in which they came. A turn that is not taken
//! costs the others next to nothing: calls that are given up while they wait can be many. Therefore only the first in line
//! have a place in time, which is not far off.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, sleep_until};

use super::later;
use crate::random::Random;

#[derive(Debug)]
pub(crate) struct Gate {
    /// For the first in line. There are several of them, so that one whose task is not run does not stop all others.
    first: Arc<Semaphore>,
    passes: Arc<Semaphore>,
    pace: Mutex<Pace>,
}

/// The right to take a pass. Dropped, it gives its place in time back.
#[derive(Debug)]
pub(crate) struct Turn {
    gate: Arc<Gate>,
    /// Until it is taken.
    pass: Option<Pass>,
    /// To be one of the first in line.
    _first: Option<OwnedSemaphorePermit>,
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

/// How far ahead places in time are given, and the fewest of them.
const AHEAD: Duration = Duration::from_millis(20);
const FEWEST_AHEAD: usize = 4;

impl Gate {
    pub(crate) fn new(at_once: usize, per_second: u32, seed: u64) -> Arc<Self> {
        let interval = Duration::from_secs(1).checked_div(per_second).unwrap_or(Duration::from_secs(1));
        let ahead = AHEAD
            .as_nanos()
            .checked_div(interval.as_nanos())
            .and_then(|places| usize::try_from(places).ok())
            .unwrap_or(usize::MAX);
        Arc::new(Self {
            first: Arc::new(Semaphore::new(ahead.clamp(FEWEST_AHEAD, Semaphore::MAX_PERMITS))),
            passes: Arc::new(Semaphore::new(at_once.clamp(1, Semaphore::MAX_PERMITS))),
            pace: Mutex::new(Pace { interval, next_at: None, random: Random::new(seed) }),
        })
    }

    /// Waits until it is the caller's turn.
    pub(crate) async fn turn(self: Arc<Self>) -> Turn {
        let first = self.first.clone().acquire_owned().await.ok();
        let pass = Pass { _permit: self.passes.clone().acquire_owned().await.ok() };
        // Whoever need not wait does not touch the timer, which counts in whole milliseconds.
        let now = Instant::now();
        let at = self.lock().reserve(now);
        let turn = Turn { gate: self, pass: Some(pass), _first: first };
        if at > now {
            sleep_until(at).await;
        }
        turn
    }

    fn lock(&self) -> MutexGuard<'_, Pace> {
        // Nothing panics while it holds this lock.
        self.pace.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Turn {
    pub(crate) fn take(mut self) -> Option<Pass> {
        self.pass.take()
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        if self.pass.is_some() {
            self.gate.lock().give_back();
        }
    }
}

impl Pace {
    /// Takes the next place in time, at once if that is free.
    fn reserve(&mut self, now: Instant) -> Instant {
        match self.next_at.filter(|&at| at > now) {
            None => {
                self.next_at = Some(later(now, self.interval));
                now
            }
            Some(at) => {
                self.next_at = Some(later(at, self.interval));
                // Up to half the interval later, so that several programs do not go on in step.
                later(at, self.interval.saturating_sub(self.random.jitter(self.interval)))
            }
        }
    }

    /// Undoes a [`reserve`](Self::reserve). Places that others have taken meanwhile stay where they are: the next one to
    /// come is so much earlier.
    fn give_back(&mut self) {
        self.next_at = self.next_at.and_then(|at| at.checked_sub(self.interval));
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
            passes.push(gate.clone().turn().await.take());
            let slot = Duration::from_millis(10) * n;
            let took = began.elapsed();
            assert!(slot <= took && took <= slot + Duration::from_millis(6), "{n}: {took:?}");
        }
        sleep_until(Instant::now() + Duration::from_secs(1)).await;
        let idle = Instant::now();
        for wait in [0, 10] {
            passes.push(gate.clone().turn().await.take());
            let (least, most) = (Duration::from_millis(wait), Duration::from_millis(wait + 6));
            assert!((least..=most).contains(&idle.elapsed()), "who comes alone does not wait, and nothing is saved up");
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_pass_is_given_when_another_is_given_back() {
        let gate = Gate::new(2, 1_000_000, 1);
        let pass = async || gate.clone().turn().await.take();
        let (first, _second) = (pass().await, pass().await);
        let third = pass();
        tokio::pin!(third);
        assert!(tokio::time::timeout(Duration::from_secs(1), &mut third).await.is_err());
        drop(first);
        assert!(tokio::time::timeout(Duration::from_millis(2), third).await.is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn fast_rates_are_reached_though_the_timer_is_slow() {
        let gate = Gate::new(100_000, 5000, 1);
        let began = Instant::now();
        let mut waiting = tokio::task::JoinSet::new();
        for _ in 0..5000 {
            let turn = gate.clone().turn();
            waiting.spawn(async move { drop(turn.await.take()) });
        }
        waiting.join_all().await;
        let took = began.elapsed();
        assert!((990..=1100).contains(&took.as_millis()), "{took:?}");
    }

    #[tokio::test(start_paused = true)]
    async fn turns_that_are_not_taken_cost_next_to_nothing_and_bring_nothing() {
        let interval = Duration::from_millis(10);
        for seed in 0..20 {
            let gate = Gate::new(10, 100, seed);
            let mut random = Random::new(seed);
            let began = Instant::now();
            let (taken, mut waiting) = (Arc::new(Mutex::new(Vec::new())), tokio::task::JoinSet::new());
            for _ in 0..1000 {
                let (gate, taken, wanted) = (gate.clone(), taken.clone(), random.next().is_multiple_of(5));
                waiting.spawn(async move {
                    let turn = gate.turn().await;
                    if wanted {
                        turn.take();
                        taken.lock().unwrap().push(began.elapsed());
                    }
                });
            }
            waiting.join_all().await;
            let taken = taken.lock().unwrap();
            let count = u32::try_from(taken.len()).unwrap();
            for (n, took) in (0..).zip(taken.iter()) {
                assert!(interval * n <= *took, "seed {seed}: {n} at {took:?} is earlier than the rate allows");
            }
            let (last, at_the_rate) = (taken.last().copied().unwrap_or_default(), interval * count);
            assert!(last <= at_the_rate.mul_f64(1.4), "seed {seed}: {last:?} for what takes {at_the_rate:?}");
        }
    }
}
