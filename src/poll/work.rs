//! Tags, or parts of them, and the plan that reads them.

use std::ops::Range;

use super::TagId;
use super::lesson::Lesson;
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
    plan: Plan,
    /// For each request, the numbers of the pieces that it has values of.
    by_request: Vec<Vec<u32>>,
    /// For each piece, how many requests it has values in.
    requests_per_piece: Vec<u32>,
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

    /// Halves of `values`, which are some of its values; `None` for one value.
    fn halves(&self, values: Range<usize>, points: &Points) -> Option<[(Self, Range<usize>); 2]> {
        let tag = self.tag(points)?;
        let middle = values.start.checked_add(values.len().checked_div(2)?)?;
        let half = |values: Range<usize>| {
            let first = tag.first().nth(values.start.checked_mul(tag.elements_per_value())?).ok()?;
            let part = Tag::new(first, tag.tag_type(), values.len()).ok()?;
            Some((Self { part: Some(part), ..*self }, values))
        };
        Some([half(values.start..middle)?, half(middle..values.end)?])
    }
}

impl Work {
    /// The tags of a group stand together. Those that were removed are left out.
    pub(super) fn new(pieces: &[Piece], points: &Points, limits: &Limits, cost: &CostModel) -> Result<Self, PlanError> {
        let mut builder = Plan::builder(*cost).limits(limits.clone());
        let mut pieces: Vec<Piece> = pieces.iter().copied().filter(|piece| points.contains(piece.id)).collect();
        // It stays for as long as the plan does.
        pieces.shrink_to_fit();
        for item in items(&pieces, points) {
            let of = item.iter().filter_map(|piece| piece.tag(points));
            builder = if is_group(item, points) { builder.one_scan(of) } else { builder.tags(of) };
        }
        let plan = builder.build()?;
        let mut by_request = vec![Vec::new(); plan.requests().len()];
        let mut requests_per_piece = Vec::with_capacity(pieces.len());
        for (number, tag) in (0_u32..).zip(0..pieces.len()) {
            let requests: Vec<usize> = plan.requests_of(tag).collect();
            requests_per_piece.push(u32::try_from(requests.len()).unwrap_or(u32::MAX));
            for request in requests {
                if let Some(of) = by_request.get_mut(request) {
                    of.push(number);
                }
            }
        }
        Ok(Self { pieces, plan, by_request, requests_per_piece })
    }

    pub(super) fn plan(&self) -> &Plan {
        &self.plan
    }

    pub(super) fn requests(&self) -> &[PlannedRequest] {
        self.plan.requests()
    }

    pub(super) fn piece(&self, number: u32) -> Option<Piece> {
        self.pieces.get(number as usize).copied()
    }

    /// The numbers of the pieces that a request has values of.
    pub(super) fn pieces_of(&self, request: usize) -> &[u32] {
        self.by_request.get(request).map(Vec::as_slice).unwrap_or_default()
    }

    /// For each piece, how many requests it has values in.
    pub(super) fn requests_per_piece(&self) -> &[u32] {
        &self.requests_per_piece
    }

    /// Shares the pieces of a refused request out in two halves, in the order of the reply; tags that must be read together
    /// stay together. `Err` with all of them if there is nothing to share out.
    pub(super) fn halves(&self, request: usize, points: &Points) -> Result<Halves, Vec<Piece>> {
        let numbers = self.pieces_of(request);
        let pieces: Vec<Piece> = numbers.iter().filter_map(|number| self.piece(*number)).collect();
        let mut parts: Vec<(Range<usize>, Vec<Piece>)> = Vec::new();
        let mut at = 0_usize;
        for item in items(&pieces, points) {
            let end = at.saturating_add(item.len());
            let words = numbers.get(at..end).unwrap_or_default().iter();
            let words = words.filter_map(|number| self.plan.words_in(*number as usize, request));
            let span = words.reduce(|span, words| span.start.min(words.start)..span.end.max(words.end));
            parts.push((span.unwrap_or_default(), item.to_vec()));
            at = end;
        }
        if let ([piece], [number], [(span, _)]) = (pieces.as_slice(), numbers, parts.as_slice())
            && !is_group(&pieces, points)
            && let Some(values) = self.plan.values_in(*number as usize, request)
            && let Some(halves) = piece.halves(values.clone(), points)
            && let Some(words_per_value) = span.len().checked_div(values.len())
        {
            let words = |half: Range<usize>| {
                let word = |value: usize| value.saturating_sub(values.start).saturating_mul(words_per_value);
                span.start.saturating_add(word(half.start))..span.start.saturating_add(word(half.end))
            };
            parts = halves.into_iter().map(|(piece, values)| (words(values), vec![piece])).collect();
        }
        if parts.len() < 2 {
            return Err(pieces);
        }
        parts.sort_by_key(|(span, _)| (span.start, span.end));
        let (left, right) = parts.split_at(parts.len() / 2);
        let end = |of: &[(Range<usize>, Vec<Piece>)]| of.iter().map(|(span, _)| span.end).max().unwrap_or(0);
        let start = right.first().map_or(0, |(span, _)| span.start);
        let longest_right = end(right).saturating_sub(start);
        let planned = self.requests().get(request);
        let lesson = planned.and_then(|p| Lesson::of(p.request(), end(left), start, longest_right));
        let all = |of: &[(Range<usize>, Vec<Piece>)]| of.iter().flat_map(|(_, item)| item.iter().copied()).collect();
        Ok(Halves { left: all(left), right: all(right), lesson })
    }
}

/// The pieces of a refused request, and what there is to learn if neither half is refused.
#[derive(Debug)]
pub(super) struct Halves {
    pub(super) left: Vec<Piece>,
    pub(super) right: Vec<Piece>,
    pub(super) lesson: Option<Lesson>,
}

/// What cannot be taken apart as long as it is whole: single tags, and groups.
pub(super) fn items<'t>(pieces: &'t [Piece], points: &Points) -> impl Iterator<Item = &'t [Piece]> {
    let group = |piece: &Piece| points.get(piece.id).and_then(|point| point.group);
    pieces.chunk_by(move |a, b| group(a).is_some() && group(a) == group(b))
}

fn is_group(item: &[Piece], points: &Points) -> bool {
    item.first().and_then(|piece| points.get(piece.id)).is_some_and(|point| point.group.is_some())
}
