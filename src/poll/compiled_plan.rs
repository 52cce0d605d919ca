//! Tags, or parts of them, and the plan that reads them.

use std::ops::Range;
use std::sync::Arc;

use super::TagId;
use super::learned_limit::SplitPoint;
use super::plan_cache::{IndexedPlan, PlanCache, PlanKey};
use super::tag_map::TagMap;
use crate::plan::{CostModel, Limits, Plan, PlanError, PlannedRequest};
use crate::tag::Tag;

/// A tag to be read, or some of its values, to find out whether the PLC refuses these.
#[derive(Clone, Copy, Debug)]
pub(super) struct TagPart {
    pub(super) id: TagId,
    /// `None`: the whole tag.
    section: Option<Tag>,
}

/// Tag parts, and the requests that read them.
#[derive(Debug)]
pub(super) struct CompiledPlan {
    /// Numbered as the tags of the plan.
    parts: Vec<TagPart>,
    indexed: Arc<IndexedPlan>,
}

impl TagPart {
    pub(super) fn whole(id: &TagId) -> Self {
        Self { id: *id, section: None }
    }

    pub(super) fn is_whole(&self) -> bool {
        self.section.is_none()
    }

    fn tag(&self, tag_map: &TagMap) -> Option<Tag> {
        let state = tag_map.get(self.id)?;
        Some(self.section.unwrap_or(state.tag))
    }

    /// A range of its values.
    fn values(&self, values: Range<usize>, tag_map: &TagMap) -> Option<Self> {
        let tag = self.tag(tag_map)?;
        let first = tag.first().nth(values.start.checked_mul(tag.elements_per_value())?).ok()?;
        let section = Tag::new(first, tag.tag_type(), values.len()).ok()?;
        Some(Self { section: Some(section), ..*self })
    }

    /// Its halves, each with its number of values; `None` for a single value.
    fn halves(&self, tag_map: &TagMap) -> Option<[(Self, usize); 2]> {
        let count = self.tag(tag_map)?.slot_count();
        let middle = count / 2;
        let right = count.checked_sub(middle)?;
        Some([(self.values(0..middle, tag_map)?, middle), (self.values(middle..count, tag_map)?, right)])
    }
}

impl CompiledPlan {
    /// Plans the parts of tags that are in `tag_map`; parts of removed tags are left out.
    ///
    /// Tags of a one-scan group must be consecutive.
    pub(super) fn new(
        parts: &[TagPart],
        tag_map: &TagMap,
        limits: &Limits,
        cost: &CostModel,
        cache: &PlanCache,
    ) -> Result<Self, PlanError> {
        let mut parts: Vec<TagPart> = parts.iter().copied().filter(|part| tag_map.contains(part.id)).collect();
        // Kept as long as the plan.
        parts.shrink_to_fit();
        let tags = parts.iter().filter_map(|part| part.tag(tag_map)).collect();
        let group_len = |item: &[TagPart]| if is_group(item, tag_map) { item.len() } else { 0 };
        let groups = tags_and_groups(&parts, tag_map).map(group_len).collect();
        let indexed = cache.get(PlanKey { tags, groups, limits: limits.clone(), cost: *cost })?;
        Ok(Self { parts, indexed })
    }

    pub(super) fn as_plan(&self) -> &Plan {
        &self.indexed.plan
    }

    pub(super) fn requests(&self) -> &[PlannedRequest] {
        self.indexed.plan.requests()
    }

    /// Returns whether it is a single run that reads one tag and nothing else.
    pub(super) fn is_tight(&self) -> bool {
        match (self.requests(), self.as_plan().tags()) {
            ([request], [tag]) => request.request().run().is_some_and(|(first, _)| first == tag.first()),
            _ => false,
        }
    }

    pub(super) fn part(&self, index: u32) -> Option<TagPart> {
        self.parts.get(index as usize).copied()
    }

    /// The indices of the parts that have values in a request.
    pub(super) fn parts_of(&self, request: usize) -> &[u32] {
        let parts = self.indexed.tags_by_request.get(request);
        debug_assert!(parts.is_some(), "the plan has no request {request}");
        parts.map(Vec::as_slice).unwrap_or_default()
    }

    /// For each part, the number of requests that have values of it.
    pub(super) fn requests_per_part(&self) -> &[u32] {
        &self.indexed.requests_per_tag
    }

    /// Divides the parts of a refused request into halves, in the order of the reply; `None` if it
    /// cannot be divided.
    ///
    /// Tags of a one-scan group stay together. Of a tag that has values in other requests too, only
    /// the values in this request are read again.
    pub(super) fn halves(&self, request: usize, tag_map: &TagMap) -> Option<Halves> {
        let mut items = self.items_of(request, tag_map);
        if let [item] = items.as_slice()
            && let [part] = item.parts.as_slice()
            && !is_group(&item.parts, tag_map)
            && let Some(halves) = part.halves(tag_map)
        {
            items = item.divide(halves);
        }
        if items.len() < 2 {
            return None;
        }
        items.sort_by_key(|item| (item.words.start, item.words.end));
        let (left, right) = items.split_at(items.len() / 2);
        let end = |items: &[RefusedItem]| items.iter().map(|item| item.words.end).max().unwrap_or(0);
        let right_start = right.first().map_or(0, |item| item.words.start);
        debug_assert!(right_start <= end(right), "an item ends behind its start");
        let right_len = end(right).saturating_sub(right_start);
        let split_point = SplitPoint { left_end: end(left), right_start, right_len };
        let parts = |items: &[RefusedItem]| items.iter().flat_map(|item| item.parts.iter().copied()).collect();
        Some(Halves { left: parts(left), right: parts(right), split_point })
    }

    /// The tags and groups of a request that are still polled, each with its words of the reply.
    fn items_of(&self, request: usize, tag_map: &TagMap) -> Vec<RefusedItem> {
        // A removed tag has no group that would keep the others together.
        let indexed: Vec<(u32, TagPart)> = self
            .parts_of(request)
            .iter()
            .filter_map(|index| Some((*index, self.part(*index)?)))
            .filter(|(_, part)| tag_map.contains(part.id))
            .collect();
        let mut items = Vec::new();
        for item in indexed.chunk_by(|(_, a), (_, b)| is_one_group(a, b, tag_map)) {
            let words = item.iter().filter_map(|(index, _)| self.as_plan().words_in(*index as usize, request));
            let words = words.reduce(|span, words| span.start.min(words.start)..span.end.max(words.end));
            let mut parts: Vec<TagPart> = item.iter().map(|(_, part)| *part).collect();
            if let ([part], [(index, _)]) = (parts.as_mut_slice(), item)
                && self.requests_per_part().get(*index as usize).is_some_and(|requests| *requests > 1)
                && let Some(values) = self.as_plan().values_in(*index as usize, request)
                && let Some(section) = part.values(values, tag_map)
            {
                *part = section;
            }
            debug_assert!(words.is_some(), "the parts of a request have words in its reply");
            items.push(RefusedItem { words: words.unwrap_or_default(), parts });
        }
        items
    }
}

/// The halves of a refused request.
#[derive(Debug)]
pub(super) struct Halves {
    pub(super) left: Vec<TagPart>,
    pub(super) right: Vec<TagPart>,
    pub(super) split_point: SplitPoint,
}

/// A tag or a group of a refused request.
struct RefusedItem {
    /// The words of the reply from its first to its last.
    words: Range<usize>,
    parts: Vec<TagPart>,
}

impl RefusedItem {
    /// Divides it in proportion to the number of values of the halves of its only part.
    fn divide(&self, [left, right]: [(TagPart, usize); 2]) -> Vec<Self> {
        let values = left.1.saturating_add(right.1);
        let words_left = left.1.saturating_mul(self.words.len()).checked_div(values).unwrap_or(0);
        let middle = self.words.start.saturating_add(words_left);
        vec![
            Self { words: self.words.start..middle, parts: vec![left.0] },
            Self { words: middle..self.words.end, parts: vec![right.0] },
        ]
    }
}

/// Divides parts into single tags and one-scan groups, which are not divided further.
pub(super) fn tags_and_groups<'t>(parts: &'t [TagPart], tag_map: &TagMap) -> impl Iterator<Item = &'t [TagPart]> {
    parts.chunk_by(move |a, b| is_one_group(a, b, tag_map))
}

fn is_one_group(a: &TagPart, b: &TagPart, tag_map: &TagMap) -> bool {
    let group = |part: &TagPart| tag_map.get(part.id).and_then(|state| state.group);
    group(a).is_some() && group(a) == group(b)
}

fn is_group(item: &[TagPart], tag_map: &TagMap) -> bool {
    item.first().and_then(|part| tag_map.get(part.id)).is_some_and(|state| state.group.is_some())
}
