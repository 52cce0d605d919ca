//! The cycle as a [`Job`]: results are held until they are confirmed.
//!
//! ```text
//!            answered           all requests of a phase done, a refusal, no answer
//! reading ─────────────▶ held ────────────────────────────────────────────────────▶ check
//!    ▲                                                                                │ │
//!    └── an unexpected stray: the values are dropped, the cycle begins again ─────────┤ └──▶ given out
//!        as often as reads are retried; then it is abandoned ◀────────────────────────┘
//! ```
//!
//! A cycle that begins again asks only for tags that it has given out neither values nor a refusal of.

use std::sync::Arc;

use super::{Bench, Cycle, Phase, Start};
use crate::error::{Error, ErrorCode};
use crate::link::job::{Job, JobProgress};
use crate::link::{Proof, Shape};
use crate::plan::Words;
use crate::poll::{Reason, Stamp, TagId};
use crate::tag::TagValue;

/// The results of a cycle that are not confirmed. The marks of the job count the values of the cycle.
#[derive(Debug)]
pub(super) struct Held {
    job: Job<usize>,
    values: Vec<(TagId, Vec<TagValue>, Stamp)>,
    /// The values before those held.
    given: usize,
    /// The check is due, and leads to this.
    then: Option<Then>,
}

/// The continuation of a cycle whose results are confirmed.
#[derive(Debug)]
enum Then {
    NextPhase,
    Refused(ErrorCode),
    Abandon(Reason, Start),
}

impl Held {
    pub(super) fn new(retries: u32) -> Self {
        Self { job: Job::new(retries), values: Vec::new(), given: 0, then: None }
    }

    pub(super) fn is_to_be_confirmed(&self) -> bool {
        self.then.is_some()
    }

    pub(super) fn hold(&mut self, id: TagId, values: Vec<TagValue>, at: Stamp) {
        self.values.push((id, values, at));
    }

    fn must_confirm(&self) -> bool {
        !self.values.is_empty() && self.job.must_confirm()
    }

    fn mark(&self) -> usize {
        self.given.saturating_add(self.values.len())
    }
}

impl Cycle {
    /// The answer to what was sent: its words, or the refusal.
    pub(in crate::poll) fn answered(
        &mut self,
        answer: Result<Words, ErrorCode>,
        (shape, proof): (Shape, Proof),
        at: Stamp,
        bench: &mut Bench<'_>,
    ) {
        let progress = self.held.job.answered(self.held.mark(), shape, proof);
        if progress != JobProgress::Go {
            return self.rewind(progress, at, bench);
        }
        let confirmed = self.held.job.first_held().unwrap_or(self.held.mark());
        self.give_out(confirmed, bench);
        match answer {
            Ok(words) => self.replied(words, at, bench),
            Err(code) => self.held.then = Some(Then::Refused(code)),
        }
    }

    /// No answer came to what was sent. What was read before is given out if it can be confirmed.
    pub(in crate::poll) fn failed(&mut self, reason: Reason, bench: &mut Bench<'_>) {
        let start = self.next_start();
        if self.held.must_confirm() {
            self.held.then = Some(Then::Abandon(reason, start));
        } else {
            self.give_out(usize::MAX, bench);
            self.abandon(reason, start);
        }
    }

    /// The result of the check.
    pub(in crate::poll) fn confirmed(&mut self, result: Result<Proof, Reason>, now: Stamp, bench: &mut Bench<'_>) {
        let then = self.held.then.take();
        let progress = match result {
            Ok(proof) => self.held.job.confirmed(proof),
            Err(reason) => {
                self.drop_held();
                let start = self.next_start();
                return match then {
                    Some(Then::Abandon(reason, start)) => self.abandon(reason, start),
                    Some(Then::NextPhase | Then::Refused(_)) | None => self.abandon(reason, start),
                };
            }
        };
        match (progress, then) {
            (JobProgress::Go, then) => {
                self.give_out(usize::MAX, bench);
                match then {
                    Some(Then::Refused(code)) => self.refused(code, now, bench),
                    Some(Then::Abandon(reason, start)) => self.abandon(reason, start),
                    Some(Then::NextPhase) | None => self.settle(now, bench),
                }
            }
            (JobProgress::Rewind(_) | JobProgress::Failed(_), Some(Then::Abandon(reason, start))) => {
                bench.repeated = true;
                self.drop_held();
                self.abandon(reason, start);
            }
            (progress, Some(Then::NextPhase | Then::Refused(_)) | None) => self.rewind(progress, now, bench),
        }
    }

    /// The requests of a phase are done; says whether a check must come before the next one.
    pub(super) fn confirm_phase(&mut self, bench: &mut Bench<'_>) -> bool {
        let must = self.held.must_confirm();
        if must {
            self.held.then = Some(Then::NextPhase);
        } else {
            self.give_out(usize::MAX, bench);
        }
        must
    }

    /// What is held may be the values of other requests.
    fn rewind(&mut self, progress: JobProgress<usize>, now: Stamp, bench: &mut Bench<'_>) {
        bench.repeated = true;
        self.drop_held();
        match progress {
            JobProgress::Go | JobProgress::Rewind(_) => {
                self.stack.clear();
                self.probe.clear();
                self.phase = Phase::Members;
                self.begin(now, bench);
            }
            JobProgress::Failed(_) => {
                let error = Error::Duplicates { station: bench.known.polled.station, sent: true };
                self.abandon(Reason::Failed(Arc::new(error)), Start::default());
            }
        }
    }

    fn drop_held(&mut self) {
        self.held.values = Vec::new();
    }

    fn abandon(&mut self, reason: Reason, start: Start) {
        self.stack.clear();
        self.phase = Phase::Over;
        self.abandoned = Some((reason, start));
    }

    /// Gives out the values before this mark.
    fn give_out(&mut self, mark: usize, bench: &mut Bench<'_>) {
        let count = mark.saturating_sub(self.held.given).min(self.held.values.len());
        self.held.given = self.held.given.saturating_add(count);
        for (id, values, at) in self.held.values.drain(..count) {
            let Some(point) = bench.known.points.get_mut(id) else { continue };
            // Read again with others, after it was given out.
            if point.cycle == self.number && !point.is_refused() {
                continue;
            }
            let was_refused = point.is_refused();
            point.cycle = self.number;
            point.read(values, at, bench.samples);
            bench.oldest = Some(bench.oldest.map_or(at.instant, |oldest| oldest.min(at.instant)));
            if was_refused {
                bench.known.changed();
            }
        }
    }
}
