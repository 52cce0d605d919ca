//! Estimates the response time of a PLC from measured round trips, for the cost of requests.

use std::time::Duration;

use crate::plan::CostModel;

/// Samples needed before the estimate is used.
const MIN_SAMPLES: u32 = 8;
/// A difference that is negligible for a plan.
const NEGLIGIBLE: Duration = Duration::from_micros(200);

/// The response time of a [`CostModel`], measured: an exponential moving average with weight 1/8.
#[derive(Debug)]
pub(super) struct LatencyEstimator {
    model: CostModel,
    /// The average of the samples; meaningless without samples.
    average: Duration,
    samples: u32,
}

impl LatencyEstimator {
    pub(super) fn new(model: CostModel) -> Self {
        Self { model, average: Duration::ZERO, samples: 0 }
    }

    /// Records the round trip of a request and the length of its reply.
    pub(super) fn record(&mut self, round_trip: Duration, reply_bytes: usize) {
        let bytes = self.model.byte_time().saturating_mul(u32::try_from(reply_bytes).unwrap_or(u32::MAX));
        let sample = round_trip.saturating_sub(bytes);
        // Limits the effect of a single spike. A lasting increase soon raises the average.
        let sample = sample.min(self.current().saturating_mul(2).saturating_add(NEGLIGIBLE));
        self.average = match self.samples {
            0 => sample,
            _ => self.average.saturating_mul(7).saturating_add(sample).checked_div(8).unwrap_or(sample),
        };
        self.samples = self.samples.saturating_add(1);
    }

    fn current(&self) -> Duration {
        if self.samples == 0 { self.model.response_time() } else { self.average }
    }

    /// Returns the model with the estimated response time.
    pub(super) fn cost(&self) -> CostModel {
        self.model.with_response_time(self.response_time())
    }

    /// Returns the estimate; the model's own response time before [`MIN_SAMPLES`].
    pub(super) fn response_time(&self) -> Duration {
        if self.samples < MIN_SAMPLES {
            return self.model.response_time();
        }
        // Rounded up to steps of 25 %, so that stations with similar response times share plans.
        let mut step = NEGLIGIBLE;
        while step < self.average {
            step = step.saturating_mul(5).checked_div(4).unwrap_or(step);
        }
        step
    }

    /// Returns whether the cost of a request differs by more than a factor of 1.5 from that with
    /// `response_time`.
    pub(super) fn has_changed_since(&self, response_time: Duration) -> bool {
        let request_time = |response_time| self.model.with_response_time(response_time).request_time();
        let (then, now) = (request_time(response_time), request_time(self.response_time()));
        let (more, less) = (then.max(now), then.min(now));
        more.saturating_sub(less) > NEGLIGIBLE && more.saturating_mul(2) > less.saturating_mul(3)
    }
}
