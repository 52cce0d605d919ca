//! The requests of one plan, on their way through a cycle, and the replies to them.

use std::sync::Arc;

use super::work::{Piece, Work};
use super::{Stamp, TagId};
use crate::plan::{PlannedRequest, ReadRequest, Words};
use crate::tag::TagValue;

/// The requests of one plan.
#[derive(Debug)]
pub(super) struct Batch {
    pub(super) work: Arc<Work>,
    /// Which request comes first.
    start: usize,
    pub(super) done: usize,
    replies: Vec<Option<(Words, Stamp)>>,
    /// For each tag, how many replies it lacks.
    lacks: Vec<u32>,
}

impl Batch {
    pub(super) fn new(work: Arc<Work>, start: usize) -> Self {
        let replies = std::iter::repeat_with(|| None).take(work.requests().len()).collect();
        let lacks = work.requests_per_piece().to_vec();
        Self { work, start, done: 0, replies, lacks }
    }

    /// The number of the request whose turn it is.
    pub(super) fn at(&self) -> usize {
        let count = self.work.requests().len();
        self.start.saturating_add(self.done).checked_rem(count).unwrap_or(0)
    }

    /// Goes on to the next request that has a piece which is wanted; says whether there is one.
    pub(super) fn skip_to(&mut self, is_wanted: impl Fn(Piece) -> bool) -> bool {
        while self.planned().is_some() {
            let mut pieces = self.work.pieces_of(self.at()).iter().filter_map(|number| self.work.piece(*number));
            if pieces.any(&is_wanted) {
                return true;
            }
            self.done = self.done.saturating_add(1);
        }
        false
    }

    pub(super) fn planned(&self) -> Option<&PlannedRequest> {
        let requests = self.work.requests();
        (self.done < requests.len()).then(|| requests.get(self.at()))?
    }

    pub(super) fn request(&self) -> Option<&ReadRequest> {
        self.planned().map(PlannedRequest::request)
    }

    /// With which request the next cycle begins, so that the one which had no answer is the last one. One that was taken
    /// apart counts as done already.
    pub(super) fn next_start(&self, apart: bool) -> usize {
        let after = if apart { self.at() } else { self.at().saturating_add(1) };
        after.checked_rem(self.work.requests().len()).unwrap_or(0)
    }

    pub(super) fn replied(&mut self, words: Words, at: Stamp, mut read: impl FnMut(TagId, Vec<TagValue>, Stamp)) {
        let request = self.at();
        self.done = self.done.saturating_add(1);
        if let Some(reply) = self.replies.get_mut(request) {
            *reply = Some((words, at));
        }
        for number in self.work.pieces_of(request) {
            let Some(lacks) = self.lacks.get_mut(*number as usize) else { continue };
            *lacks = lacks.saturating_sub(1);
            if *lacks > 0 {
                continue;
            }
            let reply = |request: usize| self.replies.get(request)?.as_ref();
            let plan = self.work.plan();
            // Most tags are in one request.
            let first = match self.work.requests_per_piece().get(*number as usize) {
                Some(2..) => {
                    let stamps = plan.requests_of(*number as usize).filter_map(|n| reply(n).map(|(_, at)| *at));
                    stamps.min_by_key(|at| at.instant).unwrap_or(at)
                }
                _ => at,
            };
            let values = plan.values(*number as usize, |request| reply(request).map(|(words, _)| words));
            if let (Some(piece), Some(values)) = (self.work.piece(*number), values)
                && piece.is_whole()
            {
                read(piece.id, values, first);
            }
        }
    }
}
