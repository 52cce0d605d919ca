//! One tag: what is known of it, and whether that is news.

use std::sync::Arc;

use tokio::time::Instant;

use super::class::{PollTag, Report};
use super::{Quality, Reason, Sample, Stamp, TagId};
use crate::tag::{Tag, TagValue};

/// ```text
///            read             failed, or overdue               too old
/// not yet ────────▶ good ────────────────────────▶ stale ───────────────▶ bad
///   │                ▲ └───────────refused───────────┼──────refused───────▶│
///   └──failed or refused: bad                        │                     │
///                    └──────────────read─────────────┴─────────────────────┘
/// ```
///
/// What must always hold: there are values just when the quality is good or stale, they are the last ones that were
/// read, and `at` is when they were read.
#[derive(Debug)]
pub(super) struct Point {
    pub(super) id: TagId,
    pub(super) tag: Tag,
    /// Those that have the same must be read in one request.
    pub(super) group: Option<u64>,
    name: Arc<str>,
    report: Report,
    quality: Quality,
    values: Option<Arc<[TagValue]>>,
    at: Stamp,
    /// The last sample given, if it matters for the next one.
    reported: Option<Box<Reported>>,
    /// When a tag that the PLC has refused is to be tried again.
    pub(super) probe_at: Option<Instant>,
    /// The cycle that last found something out about it.
    pub(super) cycle: u64,
}

#[derive(Debug)]
struct Reported {
    quality: Quality,
    values: Option<Arc<[TagValue]>>,
    instant: Instant,
}

impl Point {
    pub(super) fn new(id: TagId, tag: PollTag, group: Option<u64>, now: Stamp) -> Self {
        let PollTag { name, tag, report } = tag;
        let quality = Quality::Bad(Reason::NotYetRead);
        Self { id, tag, group, name, report, quality, values: None, at: now, reported: None, probe_at: None, cycle: 0 }
    }

    /// Whether it came after this time, and nothing is known of it yet.
    pub(super) fn is_new_since(&self, time: Instant) -> bool {
        matches!(self.quality, Quality::Bad(Reason::NotYetRead)) && self.at.instant > time
    }

    /// Whether the PLC has refused it.
    pub(super) fn is_refused(&self) -> bool {
        self.probe_at.is_some()
    }

    /// These values were read.
    pub(super) fn read(&mut self, values: Vec<TagValue>, at: Stamp, samples: &mut Vec<Sample>) {
        // Most values are the same as before: no need for memory of their own.
        if self.values.as_deref().is_none_or(|before| !same(before, &values)) {
            self.values = Some(values.into());
        }
        self.quality = Quality::Good;
        self.at = at;
        self.probe_at = None;
        self.tell(at.instant, samples);
    }

    /// It could not be read. The values stay while they are not too old.
    pub(super) fn failed(
        &mut self,
        reason: Reason,
        now: Stamp,
        bad_age: std::time::Duration,
        samples: &mut Vec<Sample>,
    ) {
        if self.values.is_some() && self.at.age(now.instant) < bad_age {
            self.quality = Quality::Stale(reason);
        } else {
            self.forget(reason, now);
        }
        self.tell(now.instant, samples);
    }

    /// It cannot be read. What was read before is worth nothing.
    pub(super) fn refused(&mut self, reason: Reason, now: Stamp, probe_at: Instant, samples: &mut Vec<Sample>) {
        self.forget(reason, now);
        self.probe_at = Some(probe_at);
        self.tell(now.instant, samples);
    }

    /// A cycle is over, and had nothing to say about it.
    pub(super) fn passed_over(&mut self, now: Instant, samples: &mut Vec<Sample>) {
        self.tell(now, samples);
    }

    /// When its age will change its quality.
    pub(super) fn ages_at(&self, stale_age: std::time::Duration, bad_age: std::time::Duration) -> Option<Instant> {
        let age = match self.quality {
            Quality::Good => stale_age,
            Quality::Stale(_) => bad_age,
            Quality::Bad(_) => return None,
        };
        self.at.instant.checked_add(age)
    }

    /// Lets its age change its quality.
    pub(super) fn age(
        &mut self,
        now: Stamp,
        stale_age: std::time::Duration,
        bad_age: std::time::Duration,
        samples: &mut Vec<Sample>,
    ) {
        let age = self.at.age(now.instant);
        let before = self.quality.clone();
        match before {
            Quality::Good if age >= bad_age => self.forget(Reason::Overdue, now),
            Quality::Good if age >= stale_age => self.quality = Quality::Stale(Reason::Overdue),
            Quality::Stale(reason) if age >= bad_age => self.forget(reason, now),
            Quality::Good | Quality::Stale(_) | Quality::Bad(_) => return,
        }
        self.tell(now.instant, samples);
    }

    /// What is known of it now.
    pub(super) fn sample(&self) -> Sample {
        Sample {
            id: self.id,
            name: self.name.clone(),
            quality: self.quality.clone(),
            at: self.at,
            values: self.values.clone(),
        }
    }

    fn forget(&mut self, reason: Reason, now: Stamp) {
        self.quality = Quality::Bad(reason);
        self.values = None;
        self.at = now;
    }

    /// Gives a sample, if it is time for one.
    fn tell(&mut self, now: Instant, samples: &mut Vec<Sample>) {
        if self.is_news(now) {
            if self.report.on_change {
                let (quality, values) = (self.quality.clone(), self.values.clone());
                self.reported = Some(Box::new(Reported { quality, values, instant: now }));
            }
            samples.push(self.sample());
        }
    }

    fn is_news(&self, now: Instant) -> bool {
        let (Some(last), true) = (&self.reported, self.report.on_change) else {
            return true;
        };
        let silent = now.saturating_duration_since(last.instant);
        self.quality.differs_from(&last.quality)
            || self.report.heartbeat.is_some_and(|heartbeat| silent >= heartbeat)
            || self.has_moved(last.values.as_deref())
    }

    /// Whether a value has left the deadband around the one that was told last.
    fn has_moved(&self, from: Option<&[TagValue]>) -> bool {
        match (self.values.as_deref(), from) {
            (Some(now), Some(then)) => {
                now.len() != then.len()
                    || now.iter().zip(then).any(|(now, then)| moved(now, then, self.report.deadband))
            }
            (now, then) => now.is_some() != then.is_some(),
        }
    }
}

/// Whether they are the same to the last bit: 0.0 is not -0.0 here.
fn same(a: &[TagValue], b: &[TagValue]) -> bool {
    let bits = |value: &TagValue| value.as_f64().map(f64::to_bits);
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| bits(a) == bits(b) && (bits(a).is_some() || a == b))
}

fn moved(now: &TagValue, then: &TagValue, deadband: f64) -> bool {
    match (now.as_f64(), then.as_f64()) {
        // Two NaNs are no change, a NaN and a number are one.
        (Some(now), Some(then)) if now.is_nan() || then.is_nan() => now.is_nan() != then.is_nan(),
        (Some(now), Some(then)) if now == then => false, // infinity less infinity is no number
        (Some(now), Some(then)) => (now - then).abs() > deadband,
        _ => now != then,
    }
}
