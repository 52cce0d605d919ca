//! The requests of one plan in a cycle, and the replies so far.

use std::sync::Arc;

use super::compiled_plan::{CompiledPlan, TagPart};
use super::{Stamp, TagId};
use crate::plan::{PlannedRequest, ReadRequest, ReplyWords};
use crate::tag::TagValue;

/// A plan in progress: the requests are sent in the order of the plan, from `first` on and around.
#[derive(Debug)]
pub(super) struct InFlight {
    pub(super) plan: Arc<CompiledPlan>,
    /// The index of the request that is sent first.
    first: usize,
    /// The number of requests that are sent or skipped.
    pub(super) done: usize,
    replies: Vec<Option<(ReplyWords, Stamp)>>,
    /// For each tag part, the number of outstanding replies.
    outstanding: Vec<u32>,
}

impl InFlight {
    pub(super) fn new(plan: Arc<CompiledPlan>, first: usize) -> Self {
        let replies = std::iter::repeat_with(|| None).take(plan.requests().len()).collect();
        let outstanding = plan.requests_per_part().to_vec();
        Self { plan, first, done: 0, replies, outstanding }
    }

    /// The index of the current request.
    pub(super) fn current(&self) -> usize {
        self.wrapped(self.first.saturating_add(self.done))
    }

    /// Skips requests without a wanted part. Returns whether there is a request left to send.
    pub(super) fn skip_to(&mut self, is_wanted: impl Fn(TagPart) -> bool) -> bool {
        while self.planned().is_some() {
            let mut parts = self.plan.parts_of(self.current()).iter().filter_map(|index| self.plan.part(*index));
            if parts.any(&is_wanted) {
                return true;
            }
            self.done = self.done.saturating_add(1);
        }
        false
    }

    pub(super) fn planned(&self) -> Option<&PlannedRequest> {
        let requests = self.plan.requests();
        (self.done < requests.len()).then(|| requests.get(self.current()))?
    }

    pub(super) fn request(&self) -> Option<&ReadRequest> {
        self.planned().map(PlannedRequest::request)
    }

    /// The first request of the next cycle, such that the request without a reply comes last.
    ///
    /// With `halving`, that request is being read in halves and is counted in `done` already.
    pub(super) fn next_first(&self, halving: bool) -> usize {
        if halving { self.current() } else { self.wrapped(self.current().saturating_add(1)) }
    }

    fn wrapped(&self, index: usize) -> usize {
        // A plan without requests has no other index than 0.
        index.checked_rem(self.plan.requests().len()).unwrap_or(0)
    }

    /// Takes the reply to the current request. Calls `read` for each tag whose replies are
    /// complete, with its values and the time of the first of its replies.
    pub(super) fn take_reply(
        &mut self,
        words: ReplyWords,
        at: Stamp,
        mut read: impl FnMut(TagId, Vec<TagValue>, Stamp),
    ) {
        let request = self.current();
        self.done = self.done.saturating_add(1);
        if let Some(reply) = self.replies.get_mut(request) {
            *reply = Some((words, at));
        }
        for index in self.plan.parts_of(request) {
            let number = *index as usize;
            let Some(outstanding) = self.outstanding.get_mut(number) else { continue };
            debug_assert!(*outstanding > 0, "each request of a plan has one reply");
            *outstanding = outstanding.saturating_sub(1);
            if *outstanding > 0 {
                continue;
            }
            let reply = |request: usize| self.replies.get(request)?.as_ref();
            let plan = self.plan.as_plan();
            // Most tags are in one request.
            let first = match self.plan.requests_per_part().get(number) {
                Some(2..) => {
                    let stamps = plan.requests_of(number).filter_map(|n| reply(n).map(|(_, at)| *at));
                    stamps.min_by_key(|at| at.instant).unwrap_or(at)
                }
                _ => at,
            };
            let values = plan.values(number, |request| reply(request).map(|(words, _)| words));
            if let (Some(part), Some(values)) = (self.plan.part(*index), values)
                && part.is_whole()
            {
                read(part.id, values, first);
            }
        }
    }
}
