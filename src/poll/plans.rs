//! Plans that are in use. Machines of one kind have the same tags, and a service has thousands of them: each plan is made
//! once, and kept once, for as long as somebody uses it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use crate::plan::{CostModel, Limits, Plan, PlanError};
use crate::tag::Tag;

/// A plan, and what a cycle wants to know of it.
#[derive(Debug)]
pub(super) struct Layout {
    pub(super) plan: Plan,
    /// For each request, the numbers of the tags that it has values of.
    pub(super) by_request: Vec<Vec<u32>>,
    /// For each tag, how many requests it has values in.
    pub(super) requests_per_tag: Vec<u32>,
}

/// What a plan is made from.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Order {
    pub(super) tags: Vec<Tag>,
    /// How many tags belong together, one group after the other; a tag that is none is a group of itself, with 0.
    pub(super) groups: Vec<usize>,
    pub(super) limits: Limits,
    pub(super) cost: CostModel,
}

#[derive(Debug, Default)]
pub(super) struct Plans {
    known: Mutex<Known>,
}

#[derive(Debug, Default)]
struct Known {
    layouts: HashMap<Order, Weak<Layout>>,
    /// With so many, those that nobody uses any more are thrown away.
    tidy_at: usize,
}

impl Plans {
    pub(super) fn get(&self, order: Order) -> Result<Arc<Layout>, PlanError> {
        if let Some(layout) = self.lock().layouts.get(&order).and_then(Weak::upgrade) {
            return Ok(layout);
        }
        // Two may make the same at the same time; then one of them stays.
        let layout = Arc::new(Layout::new(&order)?);
        let mut known = self.lock();
        if known.layouts.len() >= known.tidy_at {
            known.layouts.retain(|_, layout| layout.strong_count() > 0);
            known.tidy_at = known.layouts.len().saturating_mul(2).max(64);
        }
        known.layouts.insert(order, Arc::downgrade(&layout));
        Ok(layout)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Known> {
        // Nothing panics while it holds this lock.
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Layout {
    fn new(order: &Order) -> Result<Self, PlanError> {
        let mut builder = Plan::builder(order.cost).limits(order.limits.clone());
        let mut tags = order.tags.iter().copied();
        for group in &order.groups {
            let of: Vec<Tag> = tags.by_ref().take((*group).max(1)).collect();
            builder = if *group > 0 { builder.one_scan(of) } else { builder.tags(of) };
        }
        let plan = builder.build()?;
        let mut by_request = vec![Vec::new(); plan.requests().len()];
        let mut requests_per_tag = Vec::with_capacity(order.tags.len());
        for (number, tag) in (0_u32..).zip(0..order.tags.len()) {
            let requests: Vec<usize> = plan.requests_of(tag).collect();
            requests_per_tag.push(u32::try_from(requests.len()).unwrap_or(u32::MAX));
            for request in requests {
                if let Some(of) = by_request.get_mut(request) {
                    of.push(number);
                }
            }
        }
        Ok(Self { plan, by_request, requests_per_tag })
    }
}
