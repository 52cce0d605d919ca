//! Discretes whose words a PLC refuses: read again, by requests without words.

use std::ops::Range;

use super::{CostModel, Limits, Plan};
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

/// The requests in place of a refused one.
#[derive(Debug)]
pub(super) struct Fallback {
    /// Its tags are those of the refused request, or values of them.
    pub(super) plan: Plan,
    /// For each value of `plan`, the index of its place in the plan with the refused request.
    pub(super) values: Vec<usize>,
}

/// Returns whether a PLC that refuses a request with this error may accept its discretes as such.
pub(super) fn is_refusal(error: &Error) -> bool {
    match error.error_code() {
        Some(
            ErrorCode::IllegalValue
            | ErrorCode::IllegalFormat
            | ErrorCode::IllegalAddress
            | ErrorCode::NotSupported
            | ErrorCode::Unknown(_),
        ) => true,
        Some(
            ErrorCode::WriteProhibited | ErrorCode::LadderChecksum | ErrorCode::IdMismatch | ErrorCode::Syntax,
        )
        | None => false,
    }
}

impl Plan {
    /// Plans the values of a request without words of discretes. `None` if there are none in it.
    ///
    /// Values of a one-scan group that only fits as words are left out.
    pub(super) fn fallback(&self, request: usize) -> Option<Fallback> {
        let inputs = self.inputs.as_deref()?;
        if !self.requests.get(request)?.has_words_of_discretes() {
            return None;
        }
        let limits = inputs.limits.clone().words_of_discretes(false);
        let builder = || Plan::builder(inputs.cost).limits(limits.clone());
        let (mut all, mut values) = (builder(), Vec::new());
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
            if group.is_some() || here.len() == slots.len() {
                let whole: Vec<Tag> = self.tags.get(tags).unwrap_or_default().to_vec();
                if group.is_none() {
                    all = all.tags(whole);
                } else if builder().one_scan(whole.iter().copied()).build().is_ok() {
                    all = all.one_scan(whole);
                } else {
                    continue;
                }
            } else {
                let singles: Vec<Tag> = self.tags.get(tags.start)?.singles().collect();
                all = all.tags(here.iter().filter_map(|slot| singles.get(slot - slots.start)).copied());
            }
            values.extend(here);
        }
        let plan = all.build().ok()?;
        debug_assert_eq!(plan.slots.len(), values.len(), "each value once");
        Some(Fallback { plan, values })
    }
}
