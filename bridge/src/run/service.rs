//! The service manager: systemd learns when the bridge is ready, reloads and ends, and that it is alive.
//! Without one, nothing is sent.

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::time::{Instant, sleep_until};

use crate::liveness::{HANGS_AFTER, Liveness};

/// The messages to the service manager.
#[derive(Debug)]
pub(super) struct Service {
    /// The time between two signs of life.
    period: Option<Duration>,
    next: std::cell::Cell<Instant>,
}

impl Service {
    pub(super) fn new() -> Self {
        // Twice within the time of the manager: one late sign does no harm.
        let period = sd_notify::watchdog_enabled().map(|limit| limit / 2).filter(|period| !period.is_zero());
        Self { period, next: std::cell::Cell::new(Instant::now()) }
    }

    /// Tells that the configuration is in force.
    pub(super) fn ready(&self) {
        notify(&[NotifyState::Ready]);
    }

    /// Tells that the configuration is being reloaded; [`ready`](Self::ready) ends it.
    pub(super) fn reloading(&self) {
        match NotifyState::monotonic_usec_now() {
            Ok(now) => notify(&[NotifyState::Reloading, now]),
            Err(error) => tracing::warn!(%error, "the service manager is not told of the reload"),
        }
    }

    /// Tells that the bridge ends.
    pub(super) fn stopping(&self) {
        notify(&[NotifyState::Stopping]);
    }

    /// Sends a sign of life each time that one is due, unless the collector hangs. Never returns. Cancel-safe.
    pub(super) async fn stay_alive(&self, liveness: &Liveness) {
        let Some(period) = self.period else { return std::future::pending().await };
        loop {
            sleep_until(self.next.get()).await;
            if liveness.age() < HANGS_AFTER {
                notify(&[NotifyState::Watchdog]);
            } else {
                tracing::error!("the collector hangs: the service manager gets no sign of life");
            }
            self.next.set(Instant::now() + period);
        }
    }
}

fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!(%error, "the service manager cannot be told");
    }
}
