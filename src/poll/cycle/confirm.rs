//! The cycle as a [`Job`]: results are held until they are confirmed.
//!
//! ```text
//!            answered           all requests of a phase done, a refusal, no reply
//! reading ─────────────▶ held ────────────────────────────────────────────────────▶ check
//!    ▲                                                                                │ │
//!    └── unexpected stray: the values are dropped, the cycle begins again ────────────┤ └──▶ reported
//!        up to the number of retries of a read; then it is abandoned ◀────────────────┘
//! ```
//!
//! A repeated cycle leaves out tags of which it has reported values or a refusal.

use std::sync::Arc;

use super::{Cycle, CycleContext, CyclePhase, CycleStart};
use crate::error::{Error, ErrorCode};
use crate::link::job::{Job, JobProgress};
use crate::link::{Proof, Shape};
use crate::plan::ReplyWords;
use crate::poll::{Reason, Stamp, TagId};
use crate::tag::TagValue;

/// The unconfirmed results of a cycle. The marks of the job count the values of the cycle.
#[derive(Debug)]
pub(super) struct HeldResults {
    job: Job<usize>,
    values: Vec<(TagId, Vec<TagValue>, Stamp)>,
    /// The number of values that were reported before those held.
    reported: usize,
    /// The continuation after the check that is due.
    after_check: Option<AfterCheck>,
}

/// The continuation of a cycle after its results are confirmed.
#[derive(Debug)]
enum AfterCheck {
    NextPhase,
    Refused(ErrorCode),
    Abandon(Reason, CycleStart),
}

impl HeldResults {
    pub(super) fn new(retries: u32) -> Self {
        Self { job: Job::new(retries), values: Vec::new(), reported: 0, after_check: None }
    }

    pub(super) fn awaits_check(&self) -> bool {
        self.after_check.is_some()
    }

    pub(super) fn hold(&mut self, id: TagId, values: Vec<TagValue>, at: Stamp) {
        self.values.push((id, values, at));
    }

    fn must_confirm(&self) -> bool {
        !self.values.is_empty() && self.job.must_confirm()
    }

    fn mark(&self) -> usize {
        self.reported.saturating_add(self.values.len())
    }
}

impl Cycle {
    /// Handles the reply to the current request: its words, or a refusal.
    pub(in crate::poll) fn answered(
        &mut self,
        answer: Result<ReplyWords, ErrorCode>,
        (shape, proof): (Shape, Proof),
        at: Stamp,
        ctx: &mut CycleContext<'_>,
    ) {
        let progress = self.held.job.answered(self.held.mark(), shape, proof);
        if progress != JobProgress::Go {
            return self.rewind(progress, at, ctx);
        }
        let confirmed = self.held.job.first_held().unwrap_or(self.held.mark());
        self.report(confirmed, ctx);
        match answer {
            Ok(words) => self.handle_reply(words, at, ctx),
            Err(code) => self.held.after_check = Some(AfterCheck::Refused(code)),
        }
    }

    /// Handles a missing reply. The values read before are reported if they can be confirmed.
    pub(in crate::poll) fn failed(&mut self, reason: Reason, ctx: &mut CycleContext<'_>) {
        let start = self.next_start();
        if self.held.must_confirm() {
            self.held.after_check = Some(AfterCheck::Abandon(reason, start));
        } else {
            self.report(usize::MAX, ctx);
            self.abandon(reason, start);
        }
    }

    /// Handles the result of the check.
    pub(in crate::poll) fn confirmed(&mut self, result: Result<Proof, Reason>, now: Stamp, ctx: &mut CycleContext<'_>) {
        let after_check = self.held.after_check.take();
        let progress = match result {
            Ok(proof) => self.held.job.confirmed(proof),
            Err(failed) => {
                self.drop_held();
                let (reason, start) = match after_check {
                    Some(AfterCheck::Abandon(reason, start)) => (reason, start),
                    Some(AfterCheck::NextPhase | AfterCheck::Refused(_)) | None => (failed, self.next_start()),
                };
                return self.abandon(reason, start);
            }
        };
        match (progress, after_check) {
            (JobProgress::Go, after_check) => {
                self.report(usize::MAX, ctx);
                match after_check {
                    Some(AfterCheck::Refused(code)) => self.handle_refusal(code, now, ctx),
                    Some(AfterCheck::Abandon(reason, start)) => self.abandon(reason, start),
                    Some(AfterCheck::NextPhase) | None => self.settle(now, ctx),
                }
            }
            (JobProgress::Rewind(_) | JobProgress::Failed(_), Some(AfterCheck::Abandon(reason, start))) => {
                ctx.repeated = true;
                self.drop_held();
                self.abandon(reason, start);
            }
            (progress, Some(AfterCheck::NextPhase | AfterCheck::Refused(_)) | None) => self.rewind(progress, now, ctx),
        }
    }

    /// Ends the requests of a phase. Returns whether a check must precede the next phase.
    pub(super) fn confirm_phase(&mut self, ctx: &mut CycleContext<'_>) -> bool {
        let must = self.held.must_confirm();
        if must {
            self.held.after_check = Some(AfterCheck::NextPhase);
        } else {
            self.report(usize::MAX, ctx);
        }
        must
    }

    /// Drops the held values, which may be of other requests; repeats or abandons the cycle.
    fn rewind(&mut self, progress: JobProgress<usize>, now: Stamp, ctx: &mut CycleContext<'_>) {
        ctx.repeated = true;
        self.drop_held();
        match progress {
            JobProgress::Go | JobProgress::Rewind(_) => {
                self.stack.clear();
                self.probe.clear();
                self.phase = CyclePhase::Members;
                self.begin(now, ctx);
            }
            JobProgress::Failed(_) => {
                let error = Error::Duplicates { station: ctx.station.params.station, sent: true };
                self.abandon(Reason::Failed(Arc::new(error)), CycleStart::default());
            }
        }
    }

    fn drop_held(&mut self) {
        self.held.values = Vec::new();
    }

    fn abandon(&mut self, reason: Reason, start: CycleStart) {
        self.stack.clear();
        self.phase = CyclePhase::Over;
        self.abandoned = Some((reason, start));
    }

    /// Reports the values before this mark.
    fn report(&mut self, mark: usize, ctx: &mut CycleContext<'_>) {
        // Values before the mark may be reported already: at the end of a phase without a check.
        let count = mark.saturating_sub(self.held.reported).min(self.held.values.len());
        self.held.reported = self.held.reported.saturating_add(count);
        for (id, values, at) in self.held.values.drain(..count) {
            let Some(state) = ctx.station.tag_map.get_mut(id) else { continue };
            // Reported before, and read again together with other tags.
            if state.is_settled_in(self.number) && !state.is_refused() {
                continue;
            }
            let was_refused = state.is_refused();
            state.settle_in(self.number);
            state.set_values(values, at, ctx.samples);
            ctx.oldest = Some(ctx.oldest.map_or(at.instant, |oldest| oldest.min(at.instant)));
            if was_refused {
                ctx.station.invalidate_plans();
            }
        }
    }
}
