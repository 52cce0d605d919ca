//! Access to a plan request by request, for the poller, which does not wait for all replies.

use std::ops::Range;

use super::reply::{Reply, ReplyWords};
use super::words::WordAreas;
use super::{Plan, PlannedRequest, ReadRequest, ValueSlot};
use crate::element::Element;
use crate::tag::TagValue;

impl Plan {
    /// Returns the range from the first to the last value of a tag that a request reads.
    pub(crate) fn values_in(&self, tag: usize, request: usize) -> Option<Range<usize>> {
        let here = |slot: &ValueSlot| slot.request as usize == request;
        let slots = self.slots(tag)?;
        Some(slots.iter().position(here)?..slots.iter().rposition(here)? + 1)
    }

    /// Returns the range from the first to the last word of a tag in the reply to a request.
    pub(crate) fn words_in(&self, tag: usize, request: usize) -> Option<Range<usize>> {
        let words = self.tags.get(tag)?.words_per_value();
        let here = |slot: &&ValueSlot| slot.request as usize == request;
        let starts = self.slots(tag)?.iter().filter(here).map(|slot| usize::from(slot.word));
        let (first, last) =
            starts.fold((usize::MAX, None), |(first, last), word| (first.min(word), last.max(Some(word))));
        Some(first..last? + words)
    }

    /// Returns the values of a tag if `reply` has the replies to all of its requests.
    pub(crate) fn values<'w>(
        &self,
        index: usize,
        reply: impl Fn(usize) -> Option<&'w ReplyWords>,
    ) -> Option<Vec<TagValue>> {
        let tag = self.tags.get(index)?;
        let mut raw = Vec::with_capacity(tag.element_count());
        for slot in self.slots(index)? {
            tag.append_value(reply(slot.request as usize)?, *slot, &mut raw)?;
        }
        tag.decode(&raw).ok()
    }
}

impl PlannedRequest {
    /// Returns the areas of the discretes that it reads as bits of words.
    pub(crate) fn word_areas(&self) -> WordAreas {
        self.word_areas
    }

    /// Returns the length of the reply in bytes.
    pub(crate) fn reply_bytes(&self) -> usize {
        self.reply_bytes
    }
}

impl ReadRequest {
    /// Returns the first element of a run and the words per element; `None` for mixed reads.
    pub(crate) fn run(&self) -> Option<(Element, usize)> {
        match self {
            Self::Discretes(request) => Some((request.first().into(), 1)),
            Self::Registers(request) => Some((request.first().into(), 1)),
            Self::Registers32(request) => Some((request.first().into(), 2)),
            Self::Mixed(_) => None,
        }
    }
}

impl ReplyWords {
    /// Converts the reply to a request; `None` if it does not match the request.
    pub(crate) fn of(reply: Reply, request: &ReadRequest) -> Option<Self> {
        reply.matches(request).then(|| reply.into())
    }
}
