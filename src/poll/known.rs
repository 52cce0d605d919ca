use std::sync::Arc;

use super::lesson::Lessons;
use super::plans::Plans;
use super::point::Point;
use super::points::Points;
use super::trip::Trip;
use super::work::{Piece, Work};
use crate::plan::{Limits, PlanError};
use crate::tag::Tag;

/// What is known of a device.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) points: Points,
    pub(super) lessons: Lessons,
    /// What the device takes, without the lessons.
    pub(super) limits: Arc<Limits>,
    pub(super) trip: Trip,
    pub(super) polled: Polled,
    /// Whether the plans were made with something else.
    pub(super) plans_stale: bool,
    /// How many tags have been removed.
    pub(super) removals: u64,
    /// What the device takes, as far as is known now; `None`: to be put together.
    limits_now: Option<Box<Limits>>,
    plans: Arc<Plans>,
}

/// The station that is polled.
#[derive(Clone, Copy, Debug)]
pub(super) struct Polled {
    pub(super) station: u8,
    /// How often a cycle begins again after duplicates out of order.
    pub(super) retries: u32,
}

impl Known {
    pub(super) fn new(limits: Arc<Limits>, trip: Trip, plans: Arc<Plans>, polled: Polled) -> Self {
        let (points, lessons) = (Points::default(), Lessons::default());
        Self { points, lessons, limits, trip, polled, plans_stale: false, removals: 0, limits_now: None, plans }
    }

    /// Something was found out: plans are to be made anew.
    pub(super) fn changed(&mut self) {
        self.plans_stale = true;
        self.limits_now = None;
    }

    /// The device refuses this tag.
    pub(super) fn refuses(&mut self, tag: Tag) {
        self.plans_stale = true;
        if let Some(limits) = self.limits_now.take() {
            self.limits_now = Some(Box::new(limits.avoid_all([(tag.first(), tag.element_count())])));
        }
    }

    /// A plan for these, with the lessons, and without a run through what the device has refused.
    pub(super) fn plan(&mut self, pieces: &[Piece]) -> Result<Work, PlanError> {
        let cost = self.trip.cost();
        let simple = self.lessons.is_empty() && !self.points.values().any(Point::is_refused);
        if simple {
            return Work::new(pieces, &self.points, &self.limits, &cost, &self.plans);
        }
        let limits = self.limits_now.get_or_insert_with(|| {
            let refused = self.points.values().filter(|point| point.is_refused());
            let refused = refused.map(|point| (point.tag.first(), point.tag.element_count()));
            Box::new(self.lessons.apply(&self.limits).avoid_all(refused))
        });
        Work::new(pieces, &self.points, limits, &cost, &self.plans)
    }

    /// A plan for these without the lessons: they may be about other requests than these need.
    pub(super) fn plan_untaught(&self, pieces: &[Piece]) -> Result<Work, PlanError> {
        Work::new(pieces, &self.points, &self.limits, &self.trip.cost(), &self.plans)
    }

    /// A plan for these by runs alone.
    pub(super) fn plan_runs(&self, pieces: &[Piece]) -> Result<Work, PlanError> {
        Work::new(pieces, &self.points, &Limits::clone(&self.limits).no_mixed_reads(), &self.trip.cost(), &self.plans)
    }
}
