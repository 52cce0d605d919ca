use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex};

use tokio::time::Instant;
use tokio_util::task::TaskTracker;

use super::queue::SampleQueue;
use super::schedule::PollerSchedule;
use super::shared::PollerShared;
use super::{Poller, PollerHandle};
use crate::plan::{CostModel, Limits};
use crate::random::Random;

/// Settings of a [`Poller`]: see [`Poller::builder`].
#[derive(Clone, Copy, Debug)]
#[must_use]
pub struct PollerBuilder {
    capacity: usize,
    seed: Option<u64>,
}

impl PollerBuilder {
    /// Default of [`capacity`](Self::capacity).
    const DEFAULT_CAPACITY: usize = 65_536;

    pub(super) fn new() -> Self {
        Self { capacity: Self::DEFAULT_CAPACITY, seed: None }
    }

    /// Sets the most samples that are queued for the consumer. Default: 65,536.
    pub fn capacity(self, samples: usize) -> Self {
        Self { capacity: samples, ..self }
    }

    /// Sets the seed of the random phases, for repeatable tests. Default: a new one each time.
    pub fn seed(self, seed: u64) -> Self {
        Self { seed: Some(seed), ..self }
    }

    /// Makes the poller.
    #[must_use]
    pub fn build(self) -> Poller {
        let shared = PollerShared {
            queue: SampleQueue::new(self.capacity),
            tasks: TaskTracker::new(),
            next_id: AtomicU64::new(1),
            random: Mutex::new(Random::new(self.seed.unwrap_or_else(Random::seed))),
            schedule: Arc::new(PollerSchedule::new(Instant::now())),
            plan_cache: Arc::default(),
            limits: Arc::default(),
            stations: Mutex::default(),
        };
        Poller { handle: PollerHandle { shared: Arc::new(shared) } }
    }
}

/// Settings of a polled station: the limits of its PLC and the cost of requests.
#[derive(Clone, Debug, Default)]
#[must_use]
#[non_exhaustive]
pub struct StationPolling {
    /// `None`: the limits of the protocol.
    pub(super) limits: Option<Arc<Limits>>,
    /// `None`: derived from the link.
    pub(super) cost: Option<CostModel>,
}

impl StationPolling {
    /// Returns the defaults: limits of the protocol, costs derived from the link's line.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets the limits of the PLC.
    pub fn limits(self, limits: Limits) -> Self {
        Self { limits: Some(Arc::new(limits)), ..self }
    }

    /// Sets the cost of requests. Its response time is an initial value, until enough are measured.
    pub fn cost(self, cost: CostModel) -> Self {
        Self { cost: Some(cost), ..self }
    }
}
