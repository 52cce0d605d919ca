//! Values of a request that a PLC refuses: read again, without words of discretes or mixed reads.

use std::ops::Range;

use super::{CostModel, Limits, Plan, PlanBuilder, PlannedRequest};
use crate::command::Code;
use crate::element::Width;
use crate::error::{Error, ErrorCode};
use crate::tag::Tag;

/// The inputs of a plan, kept for requests that take the place of refused ones.
#[derive(Debug)]
pub(super) struct PlanInputs {
    pub(super) cost: CostModel,
    pub(super) limits: Limits,
    /// The indices of the tags of each one-scan group.
    pub(super) groups: Vec<Range<usize>>,
}

/// Requests in place of a refused one.
#[derive(Debug)]
pub(super) struct Fallback {
    /// Its tags are those of the refused request, or values of them.
    pub(super) plan: Plan,
    /// For each value of `plan`, the index of its place in the plan with the refused request.
    pub(super) values: Vec<usize>,
}

/// The tags of a [`Fallback`].
struct FallbackBuilder {
    builder: PlanBuilder,
    values: Vec<usize>,
}

/// Returns whether a PLC that refuses a request with this error may accept others for its values.
pub(super) fn is_refusal(error: &Error) -> bool {
    error.error_code().is_some_and(ErrorCode::is_about_the_request)
}

impl Plan {
    /// Plans the values of a refused request: without words of discretes, and without mixed reads if
    /// the error may mean that the PLC does not know these. None if that excludes nothing.
    ///
    /// Tags of words are in a plan of their own, since the PLC may refuse these. Values of a one-scan
    /// group that needs what is excluded are left out.
    pub(super) fn fallbacks(&self, request: usize, refusal: &Error) -> Vec<Fallback> {
        self.build_fallbacks(request, refusal).unwrap_or_default()
    }

    fn build_fallbacks(&self, request: usize, refusal: &Error) -> Option<Vec<Fallback>> {
        let inputs = self.inputs.as_deref()?;
        let planned = self.requests.get(request)?;
        let lacks_mixed = planned.lacks_mixed_reads(refusal);
        if !planned.has_words_of_discretes() && !lacks_mixed {
            return None;
        }
        let mut limits = inputs.limits.clone().words_of_discretes(false);
        if lacks_mixed {
            limits = limits.mixed_reads(false);
        }
        let builder = || Plan::builder(inputs.cost).limits(limits.clone());
        let mut words = FallbackBuilder { builder: builder(), values: Vec::new() };
        let mut others = FallbackBuilder { builder: builder(), values: Vec::new() };
        let mut groups = inputs.groups.iter().peekable();
        let mut tag = 0;
        while tag < self.tags.len() {
            while groups.next_if(|group| group.end <= tag).is_some() {}
            let group = groups.peek().filter(|group| group.start <= tag);
            let tags = group.map_or(tag..tag + 1, |group| (*group).clone());
            tag = tags.end;
            let slots = self.slot_range(tags.start)?.start..self.slot_range(tags.end.checked_sub(1)?)?.end;
            let is_here = |slot: &usize| self.slots.get(*slot).is_some_and(|slot| slot.request as usize == request);
            let here: Vec<usize> = slots.clone().filter(is_here).collect();
            if here.is_empty() {
                continue;
            }
            let first = self.tags.get(tags.start)?;
            let plan = if group.is_none() && is_of_words(first) { &mut words } else { &mut others };
            let before = std::mem::replace(&mut plan.builder, builder());
            plan.builder = if group.is_some() {
                let whole = self.tags.get(tags)?;
                if builder().one_scan(whole.iter().copied()).build().is_err() {
                    plan.builder = before;
                    continue;
                }
                before.one_scan(whole.iter().copied())
            } else if here.len() == slots.len() {
                before.tag(*first)
            } else {
                let singles: Vec<Tag> = first.singles().collect();
                before.tags(here.iter().filter_map(|slot| singles.get(slot - slots.start)).copied())
            };
            plan.values.extend(here);
        }
        let built = [others, words].into_iter().filter_map(|FallbackBuilder { builder, values }| {
            let plan = builder.build().ok()?;
            debug_assert_eq!(plan.slots.len(), values.len(), "each value once");
            Some(Fallback { plan, values })
        });
        Some(built.collect())
    }
}

impl PlannedRequest {
    /// Returns whether this refusal may mean that the PLC does not know mixed reads.
    pub(super) fn lacks_mixed_reads(&self, refusal: &Error) -> bool {
        self.request().code() == Code::ReadMixed && refusal.error_code().is_some_and(ErrorCode::is_about_the_command)
    }
}

/// Returns whether a tag reads words of discretes.
fn is_of_words(tag: &Tag) -> bool {
    let symbol = tag.first().symbol();
    let smallest = symbol.area().smallest();
    smallest.width() == Width::Bit && symbol != smallest
}
