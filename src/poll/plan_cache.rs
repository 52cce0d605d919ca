//! Plans in use, shared by stations with equal tags, limits and costs.
//!
//! A service polls thousands of machines of one kind. Each plan is computed once and kept once, as
//! long as a station uses it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use crate::plan::{CostModel, Limits, Plan, PlanError};
use crate::tag::Tag;

/// A plan with the indices that a cycle needs.
#[derive(Debug)]
pub(super) struct IndexedPlan {
    pub(super) plan: Plan,
    /// For each request, the indices of the tags that have values in it.
    pub(super) tags_by_request: Vec<Vec<u32>>,
    /// For each tag, the number of requests that have values of it.
    pub(super) requests_per_tag: Vec<u32>,
}

/// The inputs of a plan.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct PlanKey {
    pub(super) tags: Vec<Tag>,
    /// The length of each one-scan group, in the order of the tags; 0 for a single tag.
    pub(super) groups: Vec<usize>,
    pub(super) limits: Limits,
    pub(super) cost: CostModel,
}

#[derive(Debug, Default)]
pub(super) struct PlanCache {
    entries: Mutex<CacheEntries>,
}

#[derive(Debug, Default)]
struct CacheEntries {
    plans: HashMap<PlanKey, Weak<IndexedPlan>>,
    /// At this number of entries, unused plans are removed.
    tidy_at: usize,
}

impl PlanCache {
    /// Returns the plan for `key`, from the cache or computed.
    pub(super) fn get(&self, key: PlanKey) -> Result<Arc<IndexedPlan>, PlanError> {
        if let Some(plan) = self.lock().plans.get(&key).and_then(Weak::upgrade) {
            return Ok(plan);
        }
        // Computed without the lock. If two stations compute the same plan, the later entry stays.
        let plan = Arc::new(IndexedPlan::new(&key)?);
        let mut entries = self.lock();
        if entries.plans.len() >= entries.tidy_at {
            entries.plans.retain(|_, plan| plan.strong_count() > 0);
            entries.tidy_at = entries.plans.len().saturating_mul(2).max(64);
        }
        entries.plans.insert(key, Arc::downgrade(&plan));
        Ok(plan)
    }

    fn lock(&self) -> MutexGuard<'_, CacheEntries> {
        // No code panics under this lock.
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl IndexedPlan {
    fn new(key: &PlanKey) -> Result<Self, PlanError> {
        let mut builder = Plan::builder(key.cost).limits(key.limits.clone()).without_fallbacks();
        let mut tags = key.tags.iter().copied();
        for group in &key.groups {
            let members: Vec<Tag> = tags.by_ref().take((*group).max(1)).collect();
            builder = if *group > 0 { builder.one_scan(members) } else { builder.tags(members) };
        }
        let plan = builder.build()?;
        let mut tags_by_request = vec![Vec::new(); plan.requests().len()];
        let mut requests_per_tag = Vec::with_capacity(key.tags.len());
        for (index, tag) in (0_u32..).zip(0..key.tags.len()) {
            let mut count: u32 = 0;
            for request in plan.requests_of(tag) {
                count = count.saturating_add(1);
                if let Some(tags) = tags_by_request.get_mut(request) {
                    tags.push(index);
                }
            }
            requests_per_tag.push(count);
        }
        Ok(Self { plan, tags_by_request, requests_per_tag })
    }
}
