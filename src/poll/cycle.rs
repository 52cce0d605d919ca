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
//! - A request that is *refused* is taken apart: its tags are read again in two halves, each as its own plan says. A tag, or a
//!   group, that is refused by itself is at fault, and what is left of it is not asked for any more. If nothing in the halves
//!   was at fault, the request is sent once more: if it is refused again, it was the request, and that is a [`Lesson`] for the
//!   next plan; if not, whatever it was has passed.
//! - *Probe*: the tag that was refused longest ago, if it is time, is tried again.
//! - *Others*: the probe was answered, so something has changed: all other refused tags are tried, too.
//! - No answer *abandons* the cycle: a station that does not answer one request will not answer the others. The next
//!   cycle begins behind the request that failed, so that one which never gets an answer does not keep the others from
//!   theirs.
//! - A cycle is a [job](crate::link::job): its values are held until a check has confirmed them. `confirm` has this part.
//!
//! What must always hold:
//! - a tag's values are those of replies to requests of this cycle, one plan's, and its stamp is that of the first;
//! - a value is given out only once, and only if it is confirmed;
//! - a tag is at fault only if it was refused by itself, and the refusal is confirmed;
//! - the cycle ends: each half is smaller than what it is a half of, and each phase comes once.

mod confirm;

use std::sync::Arc;

use tokio::time::Instant;

use self::confirm::Held;
use super::batch::Batch;
use super::class::ScanClass;
use super::known::Known;
use super::lesson::{Lesson, Seam};
use super::point::Point;
use super::points::Points;
use super::work::{Piece, Work, items};
use super::{Reason, Sample, Stamp, TagId};
use crate::error::ErrorCode;
use crate::plan::{PlannedRequest, ReadRequest, Words};

#[derive(Debug)]
pub(super) struct Cycle {
    /// Of this class; from 1.
    pub(super) number: u64,
    pub(super) due: Instant,
    pub(super) started: Instant,
    start: Start,
    /// The plans of the class.
    works: Vec<Arc<Work>>,
    phase: Phase,
    stack: Vec<Frame>,
    /// What the probe phase tries.
    probe: Vec<TagId>,
    held: Held,
    /// Why it was given up, and where the next one begins.
    pub(super) abandoned: Option<(Reason, Start)>,
}

/// A step of a cycle.
#[derive(Debug)]
pub(super) enum Ask<'c> {
    /// This is to be sent.
    Read(&'c ReadRequest),
    /// The results so far are to be confirmed by a check.
    Confirm,
}

/// Where a cycle begins: with this plan of the class, the others after it, and the last one with this request. So what had
/// no answer in one cycle is the last in the next.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Start {
    work: usize,
    request: usize,
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
    Suspect(Suspect),
}

/// A request that was refused. Above it is the half that is being read.
#[derive(Debug)]
struct Suspect {
    request: ReadRequest,
    seam: Seam,
    /// What is still to be read of it.
    rest: Option<Vec<Piece>>,
    /// Whether what is at fault has been found in it.
    explained: bool,
    /// Whether it is to be sent once more.
    again: bool,
    /// How many tags had been removed from the device when it was sent; `None`: it asked for some of them.
    removals: Option<u64>,
}

/// What a cycle works with.
pub(super) struct Bench<'d> {
    pub(super) known: &'d mut Known,
    pub(super) scan: &'d ScanClass,
    /// The tags of the class; those of a group stand together.
    pub(super) members: &'d [TagId],
    pub(super) samples: &'d mut Vec<Sample>,
    /// The oldest stamp of the values that were given out.
    pub(super) oldest: Option<Instant>,
    /// Whether results were dropped because duplicates came out of order.
    pub(super) repeated: bool,
}

impl Cycle {
    /// A cycle of these plans, which begins where `start` says; without them, of new ones for all tags that are not refused.
    /// With it, the plans.
    pub(super) fn new(
        (number, due): (u64, Instant),
        (works, start): (Option<Vec<Arc<Work>>>, Start),
        now: Stamp,
        bench: &mut Bench<'_>,
    ) -> (Self, Vec<Arc<Work>>) {
        let (stack, probe, held) = (Vec::new(), Vec::new(), Held::new(bench.known.polled.retries));
        let (phase, plans) = (Phase::Members, Vec::new());
        let mut cycle =
            Self { number, due, started: now.instant, start, works: plans, phase, stack, probe, held, abandoned: None };
        let works = works.unwrap_or_else(|| {
            let refused = |id: &&TagId| bench.known.points.get(**id).is_some_and(|point| point.is_refused());
            let members: Vec<Piece> = bench.members.iter().filter(|id| !refused(id)).map(Piece::whole).collect();
            cycle.plan(&members, now, bench)
        });
        cycle.works.clone_from(&works);
        cycle.begin(now, bench);
        (cycle, works)
    }

    /// Begins with the plans of the class.
    fn begin(&mut self, now: Stamp, bench: &mut Bench<'_>) {
        let (works, start) = (&self.works, self.start);
        // The last one lies lowest.
        for place in (0..works.len()).rev() {
            let last = place.saturating_add(1) == works.len();
            let request = if last { start.request } else { 0 };
            let work = start.work.saturating_add(place).checked_rem(works.len()).and_then(|at| works.get(at));
            self.stack.extend(work.map(|work| Frame::Batch(Batch::new(work.clone(), request))));
        }
        self.settle(now, bench);
    }

    /// The next step; `None`: the cycle is over.
    pub(super) fn ask(&self) -> Option<Ask<'_>> {
        if self.held.is_to_be_confirmed() { Some(Ask::Confirm) } else { self.request().map(Ask::Read) }
    }

    /// The request that is to be sent next.
    pub(super) fn request(&self) -> Option<&ReadRequest> {
        match self.stack.last()? {
            Frame::Batch(batch) => batch.request(),
            Frame::Suspect(suspect) => suspect.again.then_some(&suspect.request),
        }
    }

    /// The bytes of the reply to it, if they are known.
    pub(super) fn reply_bytes(&self) -> Option<usize> {
        match self.stack.last()? {
            Frame::Batch(batch) => batch.planned().map(PlannedRequest::reply_bytes),
            Frame::Suspect(_) => None,
        }
    }

    /// The reply to what was sent.
    fn replied(&mut self, words: Words, at: Stamp, bench: &mut Bench<'_>) {
        if let Some(request) = self.request() {
            bench.known.lessons.answered(request);
        }
        match self.stack.last_mut() {
            Some(Frame::Batch(batch)) => batch.replied(words, at, |id, values, at| self.held.hold(id, values, at)),
            // The reason of the refusal has passed.
            Some(Frame::Suspect(_)) => {
                self.stack.pop();
                self.explain();
            }
            None => {}
        }
        self.settle(at, bench);
    }

    /// The PLC refused what was sent.
    fn refused(&mut self, code: ErrorCode, now: Stamp, bench: &mut Bench<'_>) {
        match self.stack.last_mut() {
            Some(Frame::Batch(batch)) => {
                let at = batch.at();
                batch.done = batch.done.saturating_add(1);
                let work = batch.work.clone();
                self.take_apart(&work, at, code, now, bench);
            }
            Some(Frame::Suspect(suspect)) => {
                let lesson = suspect.lesson(bench.known);
                self.stack.pop();
                if let Some(lesson) = lesson {
                    tracing::debug!(?lesson, "a request is refused, and its halves are not");
                    bench.known.lessons.learn(lesson, now.instant);
                    bench.known.changed();
                }
                self.explain();
            }
            None => {}
        }
        self.settle(now, bench);
    }

    /// Where the next cycle begins if this one is given up now.
    fn next_start(&self) -> Start {
        let works = self.stack.iter().map_while(|frame| match frame {
            Frame::Batch(batch) => Some(batch),
            Frame::Suspect(_) => None,
        });
        match (self.phase, works.enumerate().last()) {
            // So many are left that lie below it, and it comes to lie lowest.
            (Phase::Members, Some((left, batch))) => Start {
                work: self.start.work.saturating_add(self.works.len()).saturating_sub(left),
                request: batch.next_start(self.stack.len() > left.saturating_add(1)),
            },
            (Phase::Members | Phase::Probe | Phase::Others | Phase::Over, _) => Start::default(),
        }
    }

    fn take_apart(&mut self, work: &Work, at: usize, code: ErrorCode, now: Stamp, bench: &mut Bench<'_>) {
        let Some(request) = work.requests().get(at).map(PlannedRequest::request) else { return };
        let pieces: Vec<Piece> = work.pieces_of(at).iter().filter_map(|number| work.piece(*number)).collect();
        let removed = pieces.iter().any(|piece| !bench.known.points.contains(piece.id));
        let mut suspect = Suspect {
            request: request.clone(),
            seam: Seam { left_end: 0, right_start: 0, right: 0 },
            rest: None,
            explained: false,
            again: false,
            removals: (!removed).then_some(bench.known.removals),
        };
        match work.halves(at, &bench.known.points) {
            Some(halves) => {
                suspect.seam = halves.seam;
                // The left half comes first in every other cycle, so that one which never gets an answer does not keep the
                // other from its turn.
                let (first, second) = match self.number.is_multiple_of(2) {
                    true => (halves.right, halves.left),
                    false => (halves.left, halves.right),
                };
                suspect.rest = Some(second);
                self.stack.push(Frame::Suspect(suspect));
                self.push(&first, now, bench);
            }
            // What was at fault may have been removed.
            None if removed => {
                let pieces: Vec<Piece> =
                    pieces.into_iter().filter(|piece| bench.known.points.contains(piece.id)).collect();
                self.push(&pieces, now, bench);
            }
            None => {
                // What can only be read together may be in a run what it is not in a mixed read.
                let runs = matches!(request, ReadRequest::Mixed(_)).then(|| bench.known.plan_runs(&pieces));
                if let Some(Ok(work)) = runs {
                    self.stack.push(Frame::Suspect(suspect));
                    self.stack.push(Frame::Batch(Batch::new(Arc::new(work), 0)));
                } else {
                    self.blame(&pieces, &Reason::Refused(code), now, bench);
                }
            }
        }
    }

    /// Goes on until there is something to send, or the cycle is over.
    fn settle(&mut self, now: Stamp, bench: &mut Bench<'_>) {
        loop {
            match self.stack.last_mut() {
                Some(Frame::Batch(batch)) => {
                    let number = self.number;
                    let is_wanted = |piece: Piece| is_wanted(piece, number, &bench.known.points);
                    if batch.skip_to(is_wanted) {
                        return;
                    }
                    self.stack.pop();
                }
                Some(Frame::Suspect(suspect)) => {
                    if let Some(rest) = suspect.rest.take() {
                        self.push(&rest, now, bench);
                    } else if suspect.explained {
                        self.stack.pop();
                        self.explain();
                    } else if suspect.lesson(bench.known).is_none() {
                        self.stack.pop();
                    } else {
                        suspect.again = true;
                        return;
                    }
                }
                None => {
                    // The next phase depends on the results of this one.
                    if self.phase != Phase::Over && self.confirm_phase(bench) {
                        return;
                    }
                    match self.next_phase(now, bench) {
                        Some(pieces) => self.push(&pieces, now, bench),
                        None => {
                            self.phase = Phase::Over;
                            return;
                        }
                    }
                }
            }
        }
    }

    /// What is to be read in the next phase; `None`: the cycle is over.
    fn next_phase(&mut self, now: Stamp, bench: &mut Bench<'_>) -> Option<Vec<Piece>> {
        let points = &bench.known.points;
        let refused = |id: &TagId| points.get(*id).is_some_and(Point::is_refused);
        let untried =
            |id: &TagId| points.get(*id).is_some_and(|point| point.is_refused() && point.cycle != self.number);
        let pieces = || bench.members.iter().filter(|id| untried(id)).map(Piece::whole).collect::<Vec<_>>();
        match self.phase {
            Phase::Members => {
                let pieces = pieces();
                let due = |item: &&[Piece]| {
                    item.iter().filter_map(|piece| points.get(piece.id)?.probe_at).min().filter(|at| *at <= now.instant)
                };
                let probe = items(&pieces, points).filter(|item| due(item).is_some()).min_by_key(due)?.to_vec();
                self.probe = probe.iter().map(|piece| piece.id).collect();
                self.phase = Phase::Probe;
                // Whatever comes of it: it has had its turn.
                let probe_at = self.probe_at(now, bench);
                for id in &self.probe {
                    if let Some(point) = bench.known.points.get_mut(*id) {
                        point.probe_at = Some(probe_at);
                    }
                }
                Some(probe)
            }
            Phase::Probe if !self.probe.iter().any(refused) => {
                self.phase = Phase::Others;
                Some(pieces())
            }
            Phase::Probe | Phase::Others | Phase::Over => None,
        }
    }

    fn probe_at(&self, now: Stamp, bench: &Bench<'_>) -> Instant {
        now.instant.checked_add(bench.scan.probe_refused).unwrap_or(now.instant)
    }

    /// Reads these next.
    fn push(&mut self, pieces: &[Piece], now: Stamp, bench: &mut Bench<'_>) {
        let works = self.plan(pieces, now, bench);
        self.stack.extend(works.into_iter().map(|work| Frame::Batch(Batch::new(work, 0))));
    }

    /// Plans for these, as far as they are wanted. Most often one is enough.
    fn plan(&mut self, pieces: &[Piece], now: Stamp, bench: &mut Bench<'_>) -> Vec<Arc<Work>> {
        let pieces: Vec<Piece> =
            pieces.iter().copied().filter(|piece| is_wanted(*piece, self.number, &bench.known.points)).collect();
        if let Ok(work) = bench.known.plan(&pieces) {
            return vec![Arc::new(work)];
        }
        // Not all of them can be planned: a group or a text is too much for what was learned, or for any request.
        let items: Vec<Vec<Piece>> = items(&pieces, &bench.known.points).map(<[Piece]>::to_vec).collect();
        let (mut works, mut good) = (Vec::new(), Vec::new());
        for item in items {
            if bench.known.plan(&item).is_ok() {
                good.extend(item);
                continue;
            }
            match bench.known.plan_untaught(&item) {
                Ok(work) => works.push(Arc::new(work)),
                Err(error) => self.blame(&item, &Reason::NoPlan(Arc::new(error)), now, bench),
            }
        }
        match bench.known.plan(&good) {
            Ok(work) => works.push(Arc::new(work)),
            // Too many values, and that was looked at when they came.
            Err(error) => self.blame(&good, &Reason::NoPlan(Arc::new(error)), now, bench),
        }
        works
    }

    /// These were refused by themselves.
    fn blame(&mut self, pieces: &[Piece], reason: &Reason, now: Stamp, bench: &mut Bench<'_>) {
        let probe_at = self.probe_at(now, bench);
        for piece in pieces {
            if let Some(point) = bench.known.points.get_mut(piece.id) {
                let (tag, was_refused) = (point.tag, point.is_refused());
                tracing::debug!(%tag, %reason, "a tag was refused");
                point.cycle = self.number;
                point.refused(reason.clone(), now, probe_at, bench.samples);
                if !was_refused {
                    bench.known.refuses(tag);
                }
            }
        }
        self.explain();
    }

    /// What was at fault is found, as far as the innermost suspect goes.
    fn explain(&mut self) {
        let suspects = self.stack.iter_mut().rev();
        let innermost = suspects.filter_map(|frame| match frame {
            Frame::Suspect(suspect) => Some(&mut suspect.explained),
            Frame::Batch(_) => None,
        });
        if let Some(explained) = innermost.into_iter().next() {
            *explained = true;
        }
    }
}

/// Whether there is still something to be found out about a piece: it has not been removed, and this cycle has given out
/// neither values nor a refusal of it.
fn is_wanted(piece: Piece, number: u64, points: &Points) -> bool {
    points.get(piece.id).is_some_and(|point| point.cycle != number)
}

impl Suspect {
    /// What there is to learn if it is refused again.
    fn lesson(&self, known: &Known) -> Option<Lesson> {
        // Without a tag that was removed it would not be the same request.
        (self.removals == Some(known.removals)).then(|| known.lessons.of(&self.request, self.seam))?
    }
}
