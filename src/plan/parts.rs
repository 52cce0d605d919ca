//! A plan request by request, for those who do not wait for all replies: the poller.

use std::ops::Range;

use super::readings::{Reply, Words};
use super::{Plan, PlannedRequest, ReadRequest, Slot};
use crate::element::Element;
use crate::tag::TagValue;

impl Plan {
    /// Which values of a tag a request has, from the first to the last.
    pub(crate) fn values_in(&self, tag: usize, request: usize) -> Option<Range<usize>> {
        let here = |slot: &Slot| slot.request as usize == request;
        let slots = self.slots(tag)?;
        Some(slots.iter().position(here)?..slots.iter().rposition(here)? + 1)
    }

    /// The words of a request's reply that a tag has values in, from the first to the last.
    pub(crate) fn words_in(&self, tag: usize, request: usize) -> Option<Range<usize>> {
        let words = self.tags.get(tag)?.slot_words();
        let here = |slot: &&Slot| slot.request as usize == request;
        let starts = self.slots(tag)?.iter().filter(here).map(|slot| slot.word as usize);
        let (first, last) =
            starts.fold((usize::MAX, None), |(first, last), word| (first.min(word), last.max(Some(word))));
        Some(first..last? + words)
    }

    /// The values of a tag, if all replies are there that it has values in.
    pub(crate) fn values<'w>(&self, tag: usize, reply: impl Fn(usize) -> Option<&'w Words>) -> Option<Vec<TagValue>> {
        let a_tag = self.tags.get(tag)?;
        let mut raw = Vec::with_capacity(a_tag.element_count());
        for slot in self.slots(tag)? {
            a_tag.take(reply(slot.request as usize)?, slot.word as usize, &mut raw)?;
        }
        a_tag.decode(&raw).ok()
    }
}

impl PlannedRequest {
    /// The bytes of its reply.
    pub(crate) fn reply_bytes(&self) -> usize {
        self.reply_bytes
    }
}

impl ReadRequest {
    /// The element that a word of the reply belongs to, and how many words each has; `None` for mixed reads, whose
    /// elements do not follow each other.
    pub(crate) fn run(&self) -> Option<(Element, usize)> {
        match self {
            Self::Discretes(request) => Some((request.first().into(), 1)),
            Self::Registers(request) => Some((request.first().into(), 1)),
            Self::Registers32(request) => Some((request.first().into(), 2)),
            Self::Mixed(_) => None,
        }
    }
}

impl Words {
    /// A reply to this request; `None` if it is none.
    pub(crate) fn of(reply: Reply, request: &ReadRequest) -> Option<Self> {
        reply.answers(request).then(|| reply.into())
    }
}
