use super::read::RequestResult;
use super::reply::ReplyWords;
use super::{Plan, ValueSlot};
use crate::command::Value;
use crate::error::Error;
use crate::tag::{Tag, TagValue};

/// The results of a [`Plan`]: for each tag its values or an error.
///
/// It keeps the replies and decodes a tag when it is read.
///
/// ```
/// use std::time::Duration;
/// use fatek::plan::{CostModel, Plan, Reply};
/// use fatek::tag::TagValue;
/// use fatek::wire::Framing;
///
/// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
/// let plan = Plan::builder(network).tags(["R0:i16", "R1:f32"].map(|tag| tag.parse().unwrap())).build()?;
/// let reply = Reply::Words(vec![0xFFFF, 0x1000, 0xC3FA]); // to the only request of the plan, R0 to R2
/// let readings = plan.scatter([Ok::<_, fatek::Error>(reply)])?;
/// assert!(matches!(readings.tag(0), Some(Ok(values)) if values == [TagValue::I16(-1)]));
/// assert!(matches!(readings.tag(1), Some(Ok(values)) if values == [TagValue::F32(-500.125)]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct PlanReadings<'p, E> {
    plan: &'p Plan,
    /// One for each request, and those of the requests in place of refused ones.
    replies: Vec<Result<ReplyWords, E>>,
    /// For each further reply, the request that was refused.
    refused: Vec<usize>,
    /// The places of all values, if some differ from those of the plan.
    slots: Option<Vec<ValueSlot>>,
}

impl PlanReadings<'_, Error> {
    /// The values of the tags with these indices, or the error of the first one that failed. If the plan has
    /// several tags, a refusal names those of its request.
    pub(crate) fn all_values(&self, tags: impl Iterator<Item = usize>) -> Result<Vec<Vec<TagValue>>, Error> {
        let read = |tag: usize| {
            let values = self.tag(tag);
            debug_assert!(values.is_some(), "the indices are those of tags of the plan");
            // Values of no tag fit no type.
            values.unwrap_or_else(|| Ok(Vec::new()))
        };
        let all: Result<_, &Error> = tags.map(read).collect();
        all.map_err(|error| {
            // Tags of the same request have the same error.
            let is_of_it = |values: &Result<_, &Error>| values.as_ref().is_err_and(|other| std::ptr::eq(*other, error));
            let refused: Vec<Tag> = self.iter().filter(|(_, values)| is_of_it(values)).map(|(tag, _)| tag).collect();
            if self.plan.tags.len() > 1 { error.clone().of_tags(&refused) } else { error.clone() }
        })
    }
}

impl<'p, E> PlanReadings<'p, E> {
    pub(super) fn new(plan: &'p Plan, replies: Vec<Result<ReplyWords, E>>) -> Self {
        Self { plan, replies, refused: Vec::new(), slots: None }
    }

    /// Results of which some are those of other requests, in place of a refused one.
    pub(super) fn with_fallbacks(plan: &'p Plan, results: Vec<RequestResult<E>>) -> Self {
        let mut readings = Self::new(plan, Vec::with_capacity(results.len()));
        let mut fallbacks = Vec::new();
        for (request, result) in results.into_iter().enumerate() {
            readings.replies.push(result.reply);
            fallbacks.extend(result.fallbacks.into_iter().map(|fallback| (request, fallback)));
        }
        for (request, (fallback, replies)) in fallbacks {
            let slots = readings.slots.get_or_insert_with(|| plan.slots.clone());
            let first = u32::try_from(readings.replies.len()).unwrap_or(u32::MAX);
            for (value, slot) in fallback.values.iter().zip(&fallback.plan.slots) {
                if let Some(moved) = slots.get_mut(*value) {
                    *moved = ValueSlot { request: first.saturating_add(slot.request), ..*slot };
                }
            }
            let is_left = slots.iter().any(|slot| slot.request as usize == request);
            if let Some(reply) = readings.replies.get_mut(request).filter(|_| !is_left) {
                *reply = Ok(ReplyWords::Words(Vec::new()));
            }
            readings.refused.extend(replies.iter().map(|_| request));
            readings.replies.extend(replies);
        }
        readings
    }

    /// Returns the values of the tag with this index, or the error of its first failed request.
    ///
    /// `None` if the plan has no such tag.
    pub fn tag(&self, index: usize) -> Option<Result<Vec<TagValue>, &E>> {
        self.plan.tags.get(index).map(|tag| self.values(index, tag))
    }

    /// Iterates over the tags in the order of the plan, each with its values or an error.
    pub fn iter(&self) -> impl Iterator<Item = (Tag, Result<Vec<TagValue>, &E>)> {
        self.plan.tags.iter().enumerate().map(|(n, tag)| (*tag, self.values(n, tag)))
    }

    /// Iterates over the requests that failed: their index in [`Plan::requests`] and the error.
    ///
    /// A refused request whose values were read by others is none of them. If these fail, each error
    /// is one of the refused request.
    pub fn errors(&self) -> impl Iterator<Item = (usize, &E)> {
        let requests = (0..self.plan.requests.len()).chain(self.refused.iter().copied());
        requests.zip(&self.replies).filter_map(|(n, reply)| Some((n, reply.as_ref().err()?)))
    }

    fn values(&self, index: usize, tag: &Tag) -> Result<Vec<TagValue>, &E> {
        let mut raw = Vec::with_capacity(tag.element_count());
        let slots = self.slots.as_ref().unwrap_or(&self.plan.slots);
        let range = self.plan.slot_range(index).unwrap_or_default();
        for slot in slots.get(range).unwrap_or_default() {
            self.value(tag, *slot, &mut raw)?;
        }
        // Number and width of the elements are those of the tag.
        let values = tag.decode(&raw);
        debug_assert!(values.is_ok(), "the elements of a plan are those of its tags");
        Ok(values.unwrap_or_default())
    }

    fn value(&self, tag: &Tag, slot: ValueSlot, raw: &mut Vec<Value>) -> Result<(), &E> {
        let words = self.replies[slot.request as usize].as_ref()?;
        // The link and `Plan::scatter` check the length of each reply.
        let taken = tag.append_value(words, slot, raw);
        debug_assert!(taken.is_some(), "a reply matches its request");
        Ok(())
    }
}
