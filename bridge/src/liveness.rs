//! Signs of life of the collector, for `/healthz` and the watchdog of the service manager.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// The time of the last sign of life. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Liveness {
    started: Instant,
    /// Milliseconds between the start and the last sign.
    last: Arc<AtomicU64>,
}

/// The time without a sign after which the collector counts as hung.
pub const HANGS_AFTER: Duration = Duration::from_secs(10);

impl Liveness {
    /// With a first sign now.
    #[must_use]
    pub fn new() -> Self {
        Self { started: Instant::now(), last: Arc::new(AtomicU64::new(0)) }
    }

    /// Gives a sign of life.
    pub fn beat(&self) {
        let now = u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.last.store(now, Ordering::Relaxed);
    }

    /// The time since the last sign.
    #[must_use]
    pub fn age(&self) -> Duration {
        self.started.elapsed().saturating_sub(Duration::from_millis(self.last.load(Ordering::Relaxed)))
    }
}

impl Default for Liveness {
    fn default() -> Self {
        Self::new()
    }
}
