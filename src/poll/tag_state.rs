//! One tag: its values, its quality, and when to report a sample of it.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::class::{PollTag, ReportPolicy};
use super::{Quality, Reason, Sample, Stamp, TagId};
use crate::tag::{Tag, TagValue};

/// The state of a tag.
///
/// ```text
///             read             failed, or overdue               too old
/// unread ────────────▶ good ───────────────────────▶ stale ───────────────▶ bad
///   │                ▲ └───────────refused───────────┼──────refused───────▶│
///   └──failed or refused: bad                        │                     │
///                    └──────────────read─────────────┴─────────────────────┘
/// ```
///
/// Invariant: there are values if and only if the quality is good or stale. They are the last
/// values read, and `at` is the time of their reply. There is a `stale_since` if and only if the quality is stale.
#[derive(Debug)]
pub(super) struct TagState {
    /// Its values are the last ones read.
    sample: Sample,
    pub(super) tag: Tag,
    /// Tags with the same group must be read by one request.
    pub(super) group: Option<u64>,
    policy: ReportPolicy,
    /// The last sample reported, if samples are reported on change.
    last_report: Option<Box<LastReport>>,
    /// The time of the next probe of a refused tag.
    pub(super) probe_at: Option<Instant>,
    /// The last cycle with values or a refusal of the tag.
    cycle: u64,
}

#[derive(Debug)]
struct LastReport {
    quality: Quality,
    values: Option<Arc<[TagValue]>>,
    instant: Instant,
}

impl TagState {
    pub(super) fn new(id: TagId, tag: PollTag, group: Option<u64>, now: Stamp) -> Self {
        let PollTag { name, tag, policy } = tag;
        let quality = Quality::Bad(Reason::NotYetRead);
        let sample = Sample { id, name, quality, at: now, stale_since: None, cycle: 0, values: None };
        Self { sample, tag, group, policy, last_report: None, probe_at: None, cycle: 0 }
    }

    pub(super) fn id(&self) -> TagId {
        self.sample.id
    }

    /// Returns whether the tag was added after this time and has not been read or refused.
    pub(super) fn is_new_since(&self, time: Instant) -> bool {
        matches!(self.sample.quality, Quality::Bad(Reason::NotYetRead)) && self.sample.at.instant > time
    }

    /// Returns whether this cycle has reported values or a refusal of the tag.
    pub(super) fn is_settled_in(&self, cycle: u64) -> bool {
        self.cycle == cycle
    }

    /// Marks the tag as read or refused in this cycle.
    pub(super) fn settle_in(&mut self, cycle: u64) {
        self.cycle = cycle;
        self.sample.cycle = cycle;
    }

    /// Marks the tag as not read in this cycle, which has ended.
    pub(super) fn miss_in(&mut self, cycle: u64) {
        self.sample.cycle = cycle;
    }

    /// Returns whether the PLC has refused the tag.
    pub(super) fn is_refused(&self) -> bool {
        self.probe_at.is_some()
    }

    /// Sets the values that were read.
    pub(super) fn set_values(&mut self, values: Vec<TagValue>, at: Stamp, samples: &mut Vec<Sample>) {
        // Equal values share their memory with earlier samples.
        if self.sample.values.as_deref().is_none_or(|before| !is_identical(before, &values)) {
            self.sample.values = Some(values.into());
        }
        self.sample.quality = Quality::Good;
        self.sample.at = at;
        self.sample.stale_since = None;
        self.probe_at = None;
        self.report_if_due(at.instant, samples);
    }

    /// Marks the tag as not read. It keeps values that are younger than `bad_age`.
    pub(super) fn set_failed(&mut self, reason: Reason, now: Stamp, bad_age: Duration, samples: &mut Vec<Sample>) {
        if self.sample.values.is_some() && self.sample.at.age(now.instant) < bad_age {
            self.set_stale(reason, now);
        } else {
            self.set_bad(reason, now);
        }
        self.report_if_due(now.instant, samples);
    }

    /// Marks the tag as refused: it is bad until a probe succeeds.
    pub(super) fn set_refused(&mut self, reason: Reason, now: Stamp, probe_at: Instant, samples: &mut Vec<Sample>) {
        self.set_bad(reason, now);
        self.probe_at = Some(probe_at);
        self.report_if_due(now.instant, samples);
    }

    /// Reports the state again at the end of a cycle that has not read the tag.
    pub(super) fn set_unchanged(&mut self, now: Instant, samples: &mut Vec<Sample>) {
        self.report_if_due(now, samples);
    }

    /// The time at which the age of the values changes the quality.
    pub(super) fn next_aging(&self, stale_age: Duration, bad_age: Duration) -> Option<Instant> {
        let age = match self.sample.quality {
            Quality::Good => stale_age,
            Quality::Stale(_) => bad_age,
            Quality::Bad(_) => return None,
        };
        self.sample.at.instant.checked_add(age)
    }

    /// Updates the quality by the age of the values.
    pub(super) fn age(&mut self, now: Stamp, stale_age: Duration, bad_age: Duration, samples: &mut Vec<Sample>) {
        let age = self.sample.at.age(now.instant);
        let before = self.sample.quality.clone();
        match before {
            Quality::Good if age >= bad_age => self.set_bad(Reason::Overdue, now),
            Quality::Good if age >= stale_age => self.set_stale(Reason::Overdue, now),
            Quality::Stale(reason) if age >= bad_age => self.set_bad(reason, now),
            Quality::Good | Quality::Stale(_) | Quality::Bad(_) => return,
        }
        self.report_if_due(now.instant, samples);
    }

    /// The current sample.
    pub(super) fn sample(&self) -> Sample {
        self.sample.clone()
    }

    fn set_stale(&mut self, reason: Reason, now: Stamp) {
        self.sample.quality = Quality::Stale(reason);
        self.sample.stale_since.get_or_insert(now);
    }

    fn set_bad(&mut self, reason: Reason, now: Stamp) {
        self.sample.quality = Quality::Bad(reason);
        self.sample.stale_since = None;
        self.sample.values = None;
        self.sample.at = now;
    }

    /// Reports the state as if it had changed, unless no cycle has read the tag or failed to.
    pub(super) fn report_again(&mut self, now: Instant, samples: &mut Vec<Sample>) {
        if !matches!(self.sample.quality, Quality::Bad(Reason::NotYetRead)) {
            self.report(now, samples);
        }
    }

    fn report_if_due(&mut self, now: Instant, samples: &mut Vec<Sample>) {
        if self.is_report_due(now) {
            self.report(now, samples);
        }
    }

    fn report(&mut self, now: Instant, samples: &mut Vec<Sample>) {
        if self.policy.on_change {
            let (quality, values) = (self.sample.quality.clone(), self.sample.values.clone());
            self.last_report = Some(Box::new(LastReport { quality, values, instant: now }));
        }
        samples.push(self.sample());
    }

    fn is_report_due(&self, now: Instant) -> bool {
        let (Some(last), true) = (&self.last_report, self.policy.on_change) else {
            return true;
        };
        let silence = now.saturating_duration_since(last.instant);
        self.sample.quality.differs_from(&last.quality)
            || self.policy.heartbeat.is_some_and(|heartbeat| silence >= heartbeat)
            || self.has_left_deadband(last.values.as_deref())
    }

    /// Returns whether a value has left the deadband around the last reported one.
    fn has_left_deadband(&self, reported: Option<&[TagValue]>) -> bool {
        match (self.sample.values.as_deref(), reported) {
            (Some(now), Some(then)) => {
                now.len() != then.len()
                    || now.iter().zip(then).any(|(now, then)| has_changed(now, then, self.policy.deadband))
            }
            (now, then) => now.is_some() != then.is_some(),
        }
    }
}

/// Returns whether values are equal bit by bit: 0.0 and -0.0 differ.
fn is_identical(a: &[TagValue], b: &[TagValue]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.is_identical(b))
}

fn has_changed(now: &TagValue, then: &TagValue, deadband: f64) -> bool {
    if let Some(distance) = now.integer_distance(then) {
        return distance > deadband;
    }
    match (now.as_f64(), then.as_f64()) {
        // NaN to NaN is no change; NaN to a number, and back, is.
        (Some(now), Some(then)) if now.is_nan() || then.is_nan() => now.is_nan() != then.is_nan(),
        (Some(now), Some(then)) if now == then => false, // infinity minus infinity is NaN
        (Some(now), Some(then)) => (now - then).abs() > deadband,
        (None, _) | (_, None) => now != then,
    }
}
