use std::sync::Arc;

use super::compiled_plan::{CompiledPlan, TagPart};
use super::latency::LatencyEstimator;
use super::learned_limit::LearnedLimits;
use super::plan_cache::PlanCache;
use super::tag_map::TagMap;
use super::tag_state::TagState;
use crate::plan::{Limits, PlanError, WordAreas};
use crate::tag::Tag;

/// The tags, limits and costs of one station: everything a plan depends on.
#[derive(Debug)]
pub(super) struct StationContext {
    pub(super) tag_map: TagMap,
    pub(super) learned_limits: LearnedLimits,
    /// The configured limits of the PLC, without the learned ones.
    pub(super) limits: Arc<Limits>,
    pub(super) latency: LatencyEstimator,
    pub(super) params: StationParams,
    /// Set when the plans were made with other limits than the current ones.
    pub(super) plans_stale: bool,
    /// The number of tags removed so far.
    pub(super) removals: u64,
    /// The current limits: configured, learned, and refused tags avoided. `None`: to be computed.
    effective_limits: Option<Box<Limits>>,
    plan_cache: Arc<PlanCache>,
}

/// The polled station.
#[derive(Clone, Copy, Debug)]
pub(super) struct StationParams {
    pub(super) station: u8,
    /// How often a cycle is repeated after duplicates out of order.
    pub(super) retries: u32,
}

impl StationContext {
    pub(super) fn new(
        limits: Arc<Limits>,
        latency: LatencyEstimator,
        plan_cache: Arc<PlanCache>,
        params: StationParams,
    ) -> Self {
        Self {
            tag_map: TagMap::default(),
            learned_limits: LearnedLimits::default(),
            limits,
            latency,
            params,
            plans_stale: false,
            removals: 0,
            effective_limits: None,
            plan_cache,
        }
    }

    /// Invalidates the plans after a change of the learned limits or of the refused tags.
    pub(super) fn invalidate_plans(&mut self) {
        self.plans_stale = true;
        self.effective_limits = None;
    }

    /// Invalidates the plans after the refusal of one more tag.
    pub(super) fn avoid_refused(&mut self, tag: Tag) {
        self.plans_stale = true;
        if let Some(limits) = self.effective_limits.take() {
            self.effective_limits = Some(Box::new(limits.avoid_all([(tag.first(), tag.element_count())])));
        }
    }

    /// Plans these parts with the learned limits, without runs through refused tags, and without words
    /// of the discretes of these areas.
    pub(super) fn plan(&mut self, parts: &[TagPart], no_words: WordAreas) -> Result<CompiledPlan, PlanError> {
        if !no_words.is_empty() {
            return self.compile(parts, &self.restricted_limits().without_words(no_words));
        }
        let cost = self.latency.cost();
        if self.learned_limits.is_empty() && !self.tag_map.values().any(TagState::is_refused) {
            return CompiledPlan::new(parts, &self.tag_map, &self.limits, &cost, &self.plan_cache);
        }
        let limits = self.effective_limits.take().unwrap_or_else(|| Box::new(self.restricted_limits()));
        let limits = self.effective_limits.insert(limits);
        CompiledPlan::new(parts, &self.tag_map, limits, &cost, &self.plan_cache)
    }

    /// Plans these parts without the learned limits, which may stem from other kinds of requests, and
    /// without words of the discretes of these areas.
    pub(super) fn plan_with_configured_limits(
        &self,
        parts: &[TagPart],
        no_words: WordAreas,
    ) -> Result<CompiledPlan, PlanError> {
        self.compile(parts, &Limits::clone(&self.limits).without_words(no_words))
    }

    /// Plans these parts by runs alone, without words of the discretes of these areas.
    pub(super) fn plan_runs(&self, parts: &[TagPart], no_words: WordAreas) -> Result<CompiledPlan, PlanError> {
        self.compile(parts, &Limits::clone(&self.limits).mixed_reads(false).without_words(no_words))
    }

    /// Returns the configured limits with the learned ones, and with refused tags avoided.
    fn restricted_limits(&self) -> Limits {
        let refused = self.tag_map.values().filter(|state| state.is_refused());
        let refused = refused.map(|state| (state.tag.first(), state.tag.element_count()));
        self.learned_limits.apply(&self.limits).avoid_all(refused)
    }

    fn compile(&self, parts: &[TagPart], limits: &Limits) -> Result<CompiledPlan, PlanError> {
        CompiledPlan::new(parts, &self.tag_map, limits, &self.latency.cost(), &self.plan_cache)
    }
}
