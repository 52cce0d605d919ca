//! Tags, or parts of them, and the plan that reads them.

use std::ops::Range;
use std::sync::Arc;

use super::TagId;
use super::lesson::Seam;
use super::plans::{Layout, Order, Plans};
use super::points::Points;
use crate::plan::{CostModel, Limits, Plan, PlanError, PlannedRequest};
use crate::tag::Tag;

/// What is to be read: a tag, or some elements of it, to find out whether these are refused.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece {
    pub(super) id: TagId,
    /// `None`: the whole tag.
    part: Option<Tag>,
}

/// Pieces, and the requests that read them.
#[derive(Debug)]
pub(super) struct Work {
    /// Numbered as in the plan.
    pieces: Vec<Piece>,
    layout: Arc<Layout>,
}

impl Piece {
    pub(super) fn whole(id: &TagId) -> Self {
        Self { id: *id, part: None }
    }

    pub(super) fn is_whole(&self) -> bool {
        self.part.is_none()
    }

    fn tag(&self, points: &Points) -> Option<Tag> {
        let point = points.get(self.id)?;
        Some(self.part.unwrap_or(point.tag))
    }

    /// Some of its values.
    fn part(&self, values: Range<usize>, points: &Points) -> Option<Self> {
        let tag = self.tag(points)?;
        let first = tag.first().nth(values.start.checked_mul(tag.elements_per_value())?).ok()?;
        let part = Tag::new(first, tag.tag_type(), values.len()).ok()?;
        Some(Self { part: Some(part), ..*self })
    }

    /// Its halves, each with the number of its values; `None` for one value.
    fn halves(&self, points: &Points) -> Option<[(Self, usize); 2]> {
        let values = self.tag(points)?.value_count();
        let middle = values / 2;
        let right = values.checked_sub(middle)?;
        Some([(self.part(0..middle, points)?, middle), (self.part(middle..values, points)?, right)])
    }
}

impl Work {
    /// The tags of a group stand together. Those that were removed are left out.
    pub(super) fn new(
        pieces: &[Piece],
        points: &Points,
        limits: &Limits,
        cost: &CostModel,
        plans: &Plans,
    ) -> Result<Self, PlanError> {
        let mut pieces: Vec<Piece> = pieces.iter().copied().filter(|piece| points.contains(piece.id)).collect();
        // It stays for as long as the plan does.
        pieces.shrink_to_fit();
        let tags = pieces.iter().filter_map(|piece| piece.tag(points)).collect();
        let groups = items(&pieces, points).map(|item| if is_group(item, points) { item.len() } else { 0 }).collect();
        let layout = plans.get(Order { tags, groups, limits: limits.clone(), cost: *cost })?;
        Ok(Self { pieces, layout })
    }

    pub(super) fn plan(&self) -> &Plan {
        &self.layout.plan
    }

    pub(super) fn requests(&self) -> &[PlannedRequest] {
        self.layout.plan.requests()
    }

    /// Whether it is one request, a run, for the elements of one tag and no others.
    pub(super) fn is_tight(&self) -> bool {
        match (self.requests(), self.plan().tags()) {
            ([request], [tag]) => request.request().run().is_some_and(|(first, _)| first == tag.first()),
            _ => false,
        }
    }

    pub(super) fn piece(&self, number: u32) -> Option<Piece> {
        self.pieces.get(number as usize).copied()
    }

    /// The numbers of the pieces that a request has values of.
    pub(super) fn pieces_of(&self, request: usize) -> &[u32] {
        self.layout.by_request.get(request).map(Vec::as_slice).unwrap_or_default()
    }

    /// For each piece, how many requests it has values in.
    pub(super) fn requests_per_piece(&self) -> &[u32] {
        &self.layout.requests_per_tag
    }

    /// Shares the pieces of a refused request out in two halves, in the order of the reply; tags that must be read together
    /// stay together. `None` if there is nothing to share out.
    ///
    /// Of a tag with values in other requests, too, only those of this one are looked at again.
    pub(super) fn halves(&self, request: usize, points: &Points) -> Option<Halves> {
        let numbers = self.pieces_of(request).iter().copied();
        // Those that were removed meanwhile have no group any more that would keep the others together.
        let numbers: Vec<u32> =
            numbers.filter(|n| self.piece(*n).is_some_and(|piece| points.contains(piece.id))).collect();
        let pieces: Vec<Piece> = numbers.iter().filter_map(|number| self.piece(*number)).collect();
        let mut parts: Vec<(Range<usize>, Vec<Piece>)> = Vec::new();
        let mut at = 0_usize;
        for item in items(&pieces, points) {
            let end = at.saturating_add(item.len());
            let of_item = numbers.get(at..end).unwrap_or_default();
            at = end;
            let words = of_item.iter().filter_map(|number| self.layout.plan.words_in(*number as usize, request));
            let span = words.reduce(|span, words| span.start.min(words.start)..span.end.max(words.end));
            let mut item = item.to_vec();
            if let ([piece], [number]) = (item.as_mut_slice(), of_item)
                && self.layout.requests_per_tag.get(*number as usize).is_some_and(|requests| *requests > 1)
                && let Some(values) = self.layout.plan.values_in(*number as usize, request)
                && let Some(part) = piece.part(values, points)
            {
                *piece = part;
            }
            parts.push((span.unwrap_or_default(), item));
        }
        if let [(span, item)] = parts.as_slice()
            && let [piece] = item.as_slice()
            && !is_group(item, points)
            && let Some(halves) = piece.halves(points)
        {
            let middle = span.start.saturating_add(span.len() / 2);
            // Two halves of as many values, the left one shorter by one if they are odd.
            let [left, right] = halves;
            let words_left =
                left.1.saturating_mul(span.len()).checked_div(left.1.saturating_add(right.1)).unwrap_or(middle);
            let seam = span.start.saturating_add(words_left);
            parts = vec![(span.start..seam, vec![left.0]), (seam..span.end, vec![right.0])];
        }
        if parts.len() < 2 {
            return None;
        }
        parts.sort_by_key(|(span, _)| (span.start, span.end));
        let (left, right) = parts.split_at(parts.len() / 2);
        let end = |of: &[(Range<usize>, Vec<Piece>)]| of.iter().map(|(span, _)| span.end).max().unwrap_or(0);
        let right_start = right.first().map_or(0, |(span, _)| span.start);
        let seam = Seam { left_end: end(left), right_start, right: end(right).saturating_sub(right_start) };
        let all = |of: &[(Range<usize>, Vec<Piece>)]| of.iter().flat_map(|(_, item)| item.iter().copied()).collect();
        Some(Halves { left: all(left), right: all(right), seam })
    }
}

/// The pieces of a refused request.
#[derive(Debug)]
pub(super) struct Halves {
    pub(super) left: Vec<Piece>,
    pub(super) right: Vec<Piece>,
    pub(super) seam: Seam,
}

/// What cannot be taken apart as long as it is whole: single tags, and groups.
pub(super) fn items<'t>(pieces: &'t [Piece], points: &Points) -> impl Iterator<Item = &'t [Piece]> {
    let group = |piece: &Piece| points.get(piece.id).and_then(|point| point.group);
    pieces.chunk_by(move |a, b| group(a).is_some() && group(a) == group(b))
}

fn is_group(item: &[Piece], points: &Points) -> bool {
    item.first().and_then(|piece| points.get(piece.id)).is_some_and(|point| point.group.is_some())
}
