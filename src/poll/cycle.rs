//! One cycle of a scan class on one station: all its tags, read once.
//!
//! ```text
//!             all requests done                probe answered
//! members ───────────────────────▶ probe ───────────────────────▶ others ──▶ over
//!    │ ▲                             └──none due, or refused─────────────────▶ │
//!    │ └── both halves done                                                    │
//!    ▼                                                                         │
//! halves of a refused request, and halves of these …                           │
//!    any of them: no answer ────────────────────────────────────────▶ abandoned┘
//! ```
//!
//! - *Members*: the requests of the class's plan, one after the other. The tags that the PLC has refused are not in it.
//! - A request that is *refused* is taken apart: its tags are read again in two halves, the left one first, each as its
//!   own plan says. A tag, or a group, that is refused by itself is at fault. If nothing in the halves was at fault, it
//!   was the request: that is a [`Lesson`], and the next plan does without it.
//! - *Probe*: one tag that was refused, if it is time, is tried again.
//! - *Others*: the probe was answered, so something has changed: all other refused tags are tried, too.
//! - No answer *abandons* the cycle: a station that does not answer one request will not answer the others. The next
//!   cycle begins behind the request that failed, so that one which never gets an answer does not keep the others from
//!   theirs.
//!
//! What must always hold:
//! - a tag's values are those of replies to requests of this cycle, one plan's, and its stamp is that of the first;
//! - a tag is at fault only if it was refused by itself;
//! - the cycle ends: each half is smaller than what it is a half of, and each phase comes once.

use std::sync::Arc;

use tokio::time::Instant;

use super::class::ScanClass;
use super::lesson::Lessons;
use super::point::Point;
use super::points::Points;
use super::trip::Trip;
use super::work::{Halves, Piece, Work, items};
use super::{Reason, Sample, Stamp, TagId};
use crate::error::ErrorCode;
use crate::plan::{Limits, PlanError, PlannedRequest, ReadRequest, Words};
use crate::tag::TagValue;

#[derive(Debug)]
pub(super) struct Cycle {
    /// Of this class; from 1.
    pub(super) number: u64,
    pub(super) due: Instant,
    pub(super) started: Instant,
    phase: Phase,
    stack: Vec<Frame>,
    /// What the probe phase tries.
    probe: Vec<TagId>,
    /// Why it was given up, and with which request of the class's plan the next one begins.
    pub(super) abandoned: Option<(Reason, usize)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Members,
    Probe,
    Others,
    Over,
}

#[derive(Debug)]
enum Frame {
    Batch(Batch),
    /// A request that was refused. Above it is the half that is being read.
    Suspect {
        halves: Halves,
        /// Whether the right half has had its turn.
        right: bool,
        /// Whether what is at fault has been found in it.
        explained: bool,
    },
}

/// The requests of one plan.
#[derive(Debug)]
struct Batch {
    work: Arc<Work>,
    /// Which request comes first.
    start: usize,
    done: usize,
    replies: Vec<Option<(Words, Stamp)>>,
    /// For each tag, how many replies it lacks.
    lacks: Vec<u32>,
}

/// What is known of a device.
#[derive(Debug)]
pub(super) struct Known {
    pub(super) points: Points,
    pub(super) lessons: Lessons,
    /// What the device takes, without the lessons.
    pub(super) limits: Limits,
    pub(super) trip: Trip,
    /// Whether the plans were made with something else.
    pub(super) plans_stale: bool,
}

impl Known {
    /// A plan for these, with the lessons, and without a run through what the device has refused.
    fn plan(&self, pieces: &[Piece]) -> Result<Work, PlanError> {
        let refused = self.points.values().filter(|point| point.is_refused());
        let refused = refused.map(|point| (point.tag.first(), point.tag.element_count()));
        let limits = self.lessons.apply(&self.limits).avoid_all(refused);
        Work::new(pieces, &self.points, &limits, &self.trip.cost())
    }
}

/// What a cycle works with.
pub(super) struct Bench<'d> {
    pub(super) known: &'d mut Known,
    pub(super) scan: &'d ScanClass,
    /// The tags of the class; those of a group stand together.
    pub(super) members: &'d [TagId],
    pub(super) samples: &'d mut Vec<Sample>,
}

impl Cycle {
    /// A cycle of these requests, the one with the number `start` first; without them, of a new plan for all tags that are
    /// not refused. With it, the requests.
    pub(super) fn new(
        (number, due): (u64, Instant),
        (work, start): (Option<Arc<Work>>, usize),
        now: Stamp,
        bench: &mut Bench<'_>,
    ) -> (Self, Option<Arc<Work>>) {
        let (stack, probe) = (Vec::new(), Vec::new());
        let phase = Phase::Members;
        let mut cycle = Self { number, due, started: now.instant, phase, stack, probe, abandoned: None };
        match work {
            Some(work) => cycle.stack.push(Frame::Batch(Batch::new(work, start))),
            None => {
                let refused = |id: &&TagId| bench.known.points.get(**id).is_some_and(|point| point.is_refused());
                let members: Vec<Piece> = bench.members.iter().filter(|id| !refused(id)).map(Piece::whole).collect();
                cycle.push(&members, now, bench);
            }
        }
        let work = cycle.stack.first().and_then(|frame| match frame {
            Frame::Batch(batch) => Some(batch.work.clone()),
            Frame::Suspect { .. } => None,
        });
        cycle.settle(now, bench);
        (cycle, work)
    }

    /// What is to be sent next; `None`: the cycle is over.
    pub(super) fn request(&self) -> Option<&ReadRequest> {
        match self.stack.last()? {
            Frame::Batch(batch) => batch.request(),
            Frame::Suspect { .. } => None,
        }
    }

    /// The bytes of the reply to it.
    pub(super) fn reply_bytes(&self) -> usize {
        match self.stack.last() {
            Some(Frame::Batch(batch)) => batch.planned().map_or(0, |planned| planned.reply_bytes()),
            _ => 0,
        }
    }

    /// The reply to what was sent.
    pub(super) fn replied(&mut self, words: Words, at: Stamp, bench: &mut Bench<'_>) {
        if let Some(Frame::Batch(batch)) = self.stack.last_mut() {
            batch.replied(words, at, |id, values, at| {
                if let Some(point) = bench.known.points.get_mut(id) {
                    bench.known.plans_stale |= point.is_refused();
                    point.cycle = self.number;
                    point.read(values, at, bench.samples);
                }
            });
        }
        self.settle(at, bench);
    }

    /// The PLC refused what was sent.
    pub(super) fn refused(&mut self, code: ErrorCode, now: Stamp, bench: &mut Bench<'_>) {
        let Some(Frame::Batch(batch)) = self.stack.last_mut() else { return };
        let halves = batch.work.halves(batch.at(), &bench.known.points);
        batch.done = batch.done.saturating_add(1);
        match halves {
            Ok(halves) => {
                let left = halves.left.clone();
                self.stack.push(Frame::Suspect { halves, right: false, explained: false });
                self.push(&left, now, bench);
            }
            Err(pieces) => self.blame(&pieces, &Reason::Refused(code), now, bench),
        }
        self.settle(now, bench);
    }

    /// No answer came to what was sent.
    pub(super) fn failed(&mut self, reason: Reason) {
        let next = match (self.phase, self.stack.first()) {
            (Phase::Members, Some(Frame::Batch(batch))) => batch.next_start(self.stack.len() > 1),
            _ => 0,
        };
        self.stack.clear();
        self.phase = Phase::Over;
        self.abandoned = Some((reason, next));
    }

    /// Goes on until there is something to send, or the cycle is over.
    fn settle(&mut self, now: Stamp, bench: &mut Bench<'_>) {
        loop {
            match self.stack.last_mut() {
                Some(Frame::Batch(batch)) if batch.request().is_some() => return,
                Some(Frame::Batch(_)) => {
                    self.stack.pop();
                }
                Some(Frame::Suspect { halves, right: right @ false, .. }) => {
                    *right = true;
                    let pieces = std::mem::take(&mut halves.right);
                    self.push(&pieces, now, bench);
                }
                Some(Frame::Suspect { halves, explained, .. }) => {
                    let lesson = if *explained { None } else { halves.lesson };
                    let found = *explained || lesson.is_some();
                    if let Some(lesson) = lesson {
                        tracing::debug!(?lesson, "a request was refused, and its halves were not");
                        bench.known.lessons.learn(lesson, now.instant);
                        bench.known.plans_stale = true;
                    }
                    self.stack.pop();
                    if found {
                        self.explain();
                    }
                }
                None => match self.next_phase(now, bench) {
                    Some(pieces) => self.push(&pieces, now, bench),
                    None => {
                        self.phase = Phase::Over;
                        return;
                    }
                },
            }
        }
    }

    /// What is to be read in the next phase; `None`: the cycle is over.
    fn next_phase(&mut self, now: Stamp, bench: &Bench<'_>) -> Option<Vec<Piece>> {
        let points = &bench.known.points;
        let refused = |id: &TagId| points.get(*id).is_some_and(Point::is_refused);
        let untried =
            |id: &TagId| points.get(*id).is_some_and(|point| point.is_refused() && point.cycle != self.number);
        let pieces: Vec<Piece> = bench.members.iter().filter(|id| untried(id)).map(Piece::whole).collect();
        match self.phase {
            Phase::Members => {
                let is_due = |piece: &Piece| {
                    let probe_at = points.get(piece.id).and_then(|point| point.probe_at);
                    probe_at.is_some_and(|at| at <= now.instant)
                };
                let probe = items(&pieces, points).find(|item| item.iter().any(is_due))?.to_vec();
                self.probe = probe.iter().map(|piece| piece.id).collect();
                self.phase = Phase::Probe;
                Some(probe)
            }
            Phase::Probe if !self.probe.iter().any(refused) => {
                self.phase = Phase::Others;
                Some(pieces)
            }
            Phase::Probe | Phase::Others | Phase::Over => None,
        }
    }

    /// Reads these next.
    fn push(&mut self, pieces: &[Piece], now: Stamp, bench: &mut Bench<'_>) {
        match bench.known.plan(pieces) {
            Ok(work) => self.stack.push(Frame::Batch(Batch::new(Arc::new(work), 0))),
            // Not all of them can be planned. Some may be.
            Err(error) => {
                let plannable = |item: &&[Piece]| bench.known.plan(item).is_ok();
                let (good, bad): (Vec<&[Piece]>, Vec<&[Piece]>) =
                    items(pieces, &bench.known.points).partition(plannable);
                let (good, bad) = (good.concat(), bad.concat());
                // What can be planned item by item can be planned together: nothing but its length was ever against it,
                // and that was looked at when the tags came.
                let bad = if bad.is_empty() { pieces.to_vec() } else { bad };
                self.blame(&bad, &Reason::NoPlan(Arc::new(error)), now, bench);
                if bad.len() < pieces.len() {
                    self.push(&good, now, bench);
                }
            }
        }
    }

    /// These were refused by themselves.
    fn blame(&mut self, pieces: &[Piece], reason: &Reason, now: Stamp, bench: &mut Bench<'_>) {
        let probe_at = now.instant.checked_add(bench.scan.probe_refused).unwrap_or(now.instant);
        for piece in pieces {
            if let Some(point) = bench.known.points.get_mut(piece.id) {
                tracing::debug!(tag = %point.tag, %reason, "a tag was refused");
                bench.known.plans_stale |= !point.is_refused();
                point.cycle = self.number;
                point.refused(reason.clone(), now, probe_at, bench.samples);
            }
        }
        self.explain();
    }

    /// What was at fault is found, as far as the innermost suspect goes.
    fn explain(&mut self) {
        let suspects = self.stack.iter_mut().rev();
        let innermost = suspects.filter_map(|frame| match frame {
            Frame::Suspect { explained, .. } => Some(explained),
            Frame::Batch(_) => None,
        });
        if let Some(explained) = innermost.into_iter().next() {
            *explained = true;
        }
    }
}

impl Batch {
    fn new(work: Arc<Work>, start: usize) -> Self {
        let replies = std::iter::repeat_with(|| None).take(work.requests().len()).collect();
        let lacks = work.requests_per_piece().to_vec();
        Self { work, start, done: 0, replies, lacks }
    }

    /// The number of the request whose turn it is.
    fn at(&self) -> usize {
        let count = self.work.requests().len();
        self.start.saturating_add(self.done).checked_rem(count).unwrap_or(0)
    }

    fn planned(&self) -> Option<&PlannedRequest> {
        let requests = self.work.requests();
        (self.done < requests.len()).then(|| requests.get(self.at()))?
    }

    fn request(&self) -> Option<&ReadRequest> {
        self.planned().map(PlannedRequest::request)
    }

    /// With which request the next cycle begins, so that the one which had no answer is the last one. One that was taken
    /// apart counts as done already.
    fn next_start(&self, apart: bool) -> usize {
        let after = if apart { self.at() } else { self.at().saturating_add(1) };
        after.checked_rem(self.work.requests().len()).unwrap_or(0)
    }

    fn replied(&mut self, words: Words, at: Stamp, mut read: impl FnMut(TagId, Vec<TagValue>, Stamp)) {
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
