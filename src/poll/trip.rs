//! How long the PLC takes beyond the bytes: measured, and put into the cost of requests.

use std::time::Duration;

use crate::plan::CostModel;

/// So many replies, and what was measured is believed.
const ENOUGH: u32 = 8;
/// What makes no difference to a plan.
const NOTHING: Duration = Duration::from_micros(200);

/// The latency of a [`CostModel`], measured: smoothed, a reply counts an eighth.
#[derive(Debug)]
pub(super) struct Trip {
    model: CostModel,
    latency: Duration,
    replies: u32,
}

impl Trip {
    pub(super) fn new(model: CostModel) -> Self {
        Self { model, latency: Duration::ZERO, replies: 0 }
    }

    /// A reply of so many bytes came so long after its request.
    pub(super) fn measured(&mut self, trip: Duration, reply_bytes: usize) {
        let bytes = self.model.byte_time().saturating_mul(u32::try_from(reply_bytes).unwrap_or(u32::MAX));
        let latency = trip.saturating_sub(bytes);
        // A spike is no news; a longer round trip that lasts is, before long.
        let latency = latency.min(self.smoothed().saturating_mul(2).saturating_add(NOTHING));
        self.latency = match self.replies {
            0 => latency,
            _ => self.latency.saturating_mul(7).saturating_add(latency).checked_div(8).unwrap_or(latency),
        };
        self.replies = self.replies.saturating_add(1);
    }

    fn smoothed(&self) -> Duration {
        if self.replies == 0 { self.model.latency() } else { self.latency }
    }

    /// The model, with the latency that was measured.
    pub(super) fn cost(&self) -> CostModel {
        self.model.with_latency(self.latency())
    }

    /// What was measured; until that is enough to be believed, what the model says.
    pub(super) fn latency(&self) -> Duration {
        if self.replies < ENOUGH {
            return self.model.latency();
        }
        // In steps, so that stations with about the same round trip have the same plans.
        let mut step = NOTHING;
        while step < self.latency {
            step = step.saturating_mul(5).checked_div(4).unwrap_or(step);
        }
        step
    }

    /// Whether a plan made with this latency is out of date: by a half more or a third less.
    pub(super) fn has_changed_since(&self, latency: Duration) -> bool {
        let with = |latency| self.model.with_latency(latency).request_time();
        let (then, now) = (with(latency), with(self.latency()));
        let (more, less) = (then.max(now), then.min(now));
        more.saturating_sub(less) > NOTHING && more.saturating_mul(2) > less.saturating_mul(3)
    }
}
