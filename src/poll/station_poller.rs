//! The tags of one station, and the next request to send. No I/O, and no clock.
//!
//! ```text
//! class   waiting ──due──▶ running ──its cycle is over──▶ waiting
//! ```
//!
//! One request is in flight at a time. It belongs to the running class whose next cycle is due
//! first: a fast class gets its turn between the requests of a slow one, and the slow one is not
//! starved because its deadline comes first in the end.
//!
//! Invariants:
//! - a cycle begins at a time that the [schedule](super::schedule) of its class gives, or later if
//!   that is not possible; a class has at most one cycle;
//! - values are reported only after their cycle has confirmed them;
//! - a tag has no samples after its removal;
//! - after [`next_step`](StationPoller::next_step) or [`age`](StationPoller::age), the quality of
//!   every tag is up to date.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::class::{PollTag, ScanClass};
use super::class_state::{ClassPlan, ClassState};
use super::context::{StationContext, StationParams};
use super::cycle::{Cycle, CycleContext, CycleStart, CycleStep};
use super::latency::LatencyEstimator;
use super::plan_cache::PlanCache;
use super::schedule::{Due, LineSchedule};
use super::stats::{ClassStats, Counters};
use super::tag_state::TagState;
use super::{PollError, Reason, Sample, Stamp, TagId};
use crate::capabilities::Refused;
use crate::error::{Error, ErrorCode};
use crate::link::{Proof, Shape};
use crate::plan::{CostModel, Limits, MAX_VALUES, Plan, PlanError, ReadRequest, Reply, ReplyWords};
use crate::random::Random;

#[derive(Debug)]
pub(super) struct StationPoller {
    context: StationContext,
    classes: Vec<ClassState>,
    /// Counters of classes without tags, which were removed.
    retired: Option<Box<Counters>>,
    /// The index of the class whose request or check is in flight.
    active: Option<usize>,
    random: Random,
    line: Arc<LineSchedule>,
    next_group: u64,
    /// The number of values of all tags.
    values: usize,
}

/// The minimum age of a plan before it is replaced because of another response time.
///
/// The gain is small, and a spike gives none.
const MIN_PLAN_AGE: Duration = Duration::from_secs(60);

/// The next step of a station.
#[derive(Debug)]
pub(super) enum PollStep {
    /// Send this request. Boxed, because nearly all steps are [`Wait`](Self::Wait).
    Read(Box<ReadRequest>),
    /// Confirm the results of a cycle by a check: see [`StationPoller::handle_check`].
    Confirm,
    /// Wait until then, or until tags are added or removed.
    Wait(Option<Instant>),
}

/// The outcome of a request.
#[derive(Debug)]
pub(super) struct ReadOutcome {
    pub(super) result: Result<Reply, Error>,
    /// The time of the reply, or of the failure.
    pub(super) at: Stamp,
    /// The round trip, if known.
    pub(super) round_trip: Option<Duration>,
    pub(super) shape: Shape,
    pub(super) proof: Proof,
}

impl StationPoller {
    pub(super) fn new(
        params: StationParams,
        (limits, cost): (Arc<Limits>, CostModel),
        line: Arc<LineSchedule>,
        seed: u64,
        plan_cache: Arc<PlanCache>,
    ) -> Self {
        Self {
            context: StationContext::new(limits, LatencyEstimator::new(cost), plan_cache, params),
            classes: Vec::new(),
            retired: None,
            active: None,
            random: Random::new(seed),
            line,
            next_group: 0,
            values: 0,
        }
    }

    /// Adds all of these tags, or none of them on error.
    pub(super) fn add(
        &mut self,
        scan: ScanClass,
        tags: Vec<(TagId, PollTag)>,
        one_scan: bool,
        now: Stamp,
    ) -> Result<(), PollError> {
        scan.check()?;
        tags.iter().try_for_each(|(_, tag)| tag.check())?;
        if tags.is_empty() {
            return if one_scan { Err(PollError::NoTags) } else { Ok(()) };
        }
        let planned = tags.iter().map(|(_, tag)| tag.tag);
        let builder = Plan::builder(self.context.latency.cost()).limits(Limits::clone(&self.context.limits));
        let plan = if one_scan { builder.one_scan(planned) } else { builder.tags(planned) }.build()?;
        let values = tags.iter().map(|(_, tag)| tag.tag.value_count()).fold(self.values, usize::saturating_add);
        if values > MAX_VALUES {
            return Err(PlanError::TooManyValues { max: MAX_VALUES }.into());
        }
        self.values = values;
        let group = one_scan.then(|| {
            self.next_group = self.next_group.saturating_add(1);
            self.next_group
        });
        let index = match self.classes.iter().position(|class| class.scan == scan) {
            Some(index) => index,
            None => {
                let due = self.line.first_due(&scan, now.instant, self.random.next());
                // Exact, because most of thousands of stations have one class.
                self.classes.reserve_exact(1);
                self.classes.push(ClassState::new(scan, due));
                self.classes.len().saturating_sub(1)
            }
        };
        if let Some(class) = self.classes.get_mut(index) {
            if class.members.is_empty() {
                class.members.reserve_exact(tags.len());
            }
            class.members.extend(tags.iter().map(|(id, _)| *id));
            class.plan = None;
            class.schedule.tags_added(&scan, class.cycle.is_some(), &self.line, now.instant, plan.time());
        }
        self.context.tag_map.extend(tags.into_iter().map(|(id, tag)| TagState::new(id, tag, group, now)));
        Ok(())
    }

    /// Removes a tag and returns whether it was there. The other tags of its one-scan group stay.
    pub(super) fn remove(&mut self, id: TagId, now: Instant) -> bool {
        let Some(state) = self.context.tag_map.get(id) else { return false };
        let (group, refused) = (state.group, state.is_refused());
        debug_assert!(self.values >= state.tag.value_count(), "the sum contains the values of each tag");
        self.values = self.values.saturating_sub(state.tag.value_count());
        self.context.tag_map.remove(id);
        self.context.removals = self.context.removals.saturating_add(1);
        for class in self.classes.iter_mut().filter(|class| class.members.contains(&id)) {
            class.members.retain(|member| *member != id);
            class.plan = None;
            // The group may have been refused because of this tag: probe the others now.
            for member in class.members.iter().filter(|_| refused && group.is_some()) {
                if let Some(state) = self.context.tag_map.get_mut(*member).filter(|state| state.group == group) {
                    state.probe_at = state.probe_at.map(|at| at.min(now));
                }
            }
        }
        if refused {
            self.context.invalidate_plans();
        }
        true
    }

    /// Returns the current sample of a tag.
    pub(super) fn sample(&mut self, id: TagId, now: Stamp, samples: &mut Vec<Sample>) -> Option<Sample> {
        self.age_now(now, samples);
        self.context.tag_map.get(id).map(TagState::sample)
    }

    /// Returns the current sample of each tag.
    pub(super) fn snapshot(&mut self, now: Stamp, samples: &mut Vec<Sample>) -> Vec<Sample> {
        self.age_now(now, samples);
        self.context.tag_map.values().map(TagState::sample).collect()
    }

    /// Reports the current sample of each tag that was read or has failed: in the order of their times, a stale one
    /// by the time since when it is stale.
    pub(super) fn report_all(&mut self, now: Stamp, samples: &mut Vec<Sample>) {
        self.age_now(now, samples);
        let mut current = Vec::new();
        self.context.tag_map.values_mut().for_each(|state| state.report_again(now.instant, &mut current));
        current.sort_by_key(|sample| sample.stale_since.unwrap_or(sample.at).instant);
        samples.append(&mut current);
    }

    /// Returns the statistics of each class that has tags.
    pub(super) fn classes(&self) -> impl Iterator<Item = ClassStats> {
        let refused = |id: &&TagId| self.context.tag_map.is_refused(**id);
        self.classes.iter().filter(|class| !class.members.is_empty()).map(move |class| ClassStats {
            class: class.scan,
            tags: class.members.len(),
            refused_tags: class.members.iter().filter(refused).count(),
            requests_per_cycle: class.plan.iter().flat_map(|plan| &plan.plans).map(|plan| plan.requests().len()).sum(),
            counters: class.stats,
        })
    }

    /// Returns the sum over all classes, including removed ones.
    pub(super) fn counters(&self) -> Counters {
        let mut counters = self.retired.as_deref().copied().unwrap_or_default();
        self.classes.iter().for_each(|class| counters.add(&class.stats));
        counters
    }

    /// Returns what refusals have shown since the last time, for other users of the station.
    pub(super) fn take_learned(&mut self) -> Vec<Refused> {
        self.context.learned_limits.take_new()
    }

    /// Returns the next step. Call it when nothing is in flight.
    pub(super) fn next_step(&mut self, now: Stamp, samples: &mut Vec<Sample>) -> PollStep {
        self.active = None;
        self.age(now, samples);
        self.classes.retain(|class| {
            if class.members.is_empty() {
                self.retired.get_or_insert_default().add(&class.stats);
            }
            !class.members.is_empty()
        });
        if self.context.learned_limits.expire(now.instant) {
            self.context.invalidate_plans();
        }
        self.drop_stale_plans();
        for index in 0..self.classes.len() {
            self.begin(index, now, samples);
        }
        let running = self.classes.iter().enumerate().filter_map(|(index, class)| {
            let cycle = class.cycle.as_ref()?;
            Some((cycle.due.checked_add(class.scan.period)?, index, cycle.next_step()?))
        });
        if let Some((_, index, step)) = running.min_by_key(|(deadline, index, _)| (*deadline, *index)) {
            self.active = Some(index);
            return match step {
                CycleStep::Read(request) => PollStep::Read(Box::new(request.clone())),
                CycleStep::Confirm => PollStep::Confirm,
            };
        }
        PollStep::Wait(self.classes.iter().map(|class| class.schedule.next_due()).chain(self.next_aging()).min())
    }

    /// Handles the outcome of the request that [`next_step`](Self::next_step) returned.
    ///
    /// Returns whether results were dropped because of duplicates out of order.
    pub(super) fn handle_read(&mut self, outcome: ReadOutcome, samples: &mut Vec<Sample>) -> bool {
        let ReadOutcome { result, at: now, round_trip, shape, proof } = outcome;
        self.with_active_cycle(now, samples, |cycle, stats, ctx| {
            stats.requests = stats.requests.saturating_add(1);
            match result {
                Ok(reply) => match cycle.request().and_then(|request| ReplyWords::of(reply, request)) {
                    Some(words) => {
                        if let (Some(round_trip), Some(bytes)) = (round_trip, cycle.reply_bytes()) {
                            ctx.station.latency.record(round_trip, bytes);
                        }
                        cycle.answered(Ok(words), (shape, proof), now, ctx);
                    }
                    // Does not occur: the link returns only replies that match the request.
                    None => cycle.failed(Reason::Overdue, ctx),
                },
                Err(error) => {
                    match error.error_code().filter(|code| concerns_the_request(*code, cycle.is_optional())) {
                        Some(code) => {
                            stats.refusals = stats.refusals.saturating_add(1);
                            cycle.answered(Err(code), (shape, proof), now, ctx);
                        }
                        None => {
                            stats.failures = stats.failures.saturating_add(1);
                            cycle.failed(Reason::Failed(Arc::new(error)), ctx);
                        }
                    }
                }
            }
        })
    }

    /// Handles the result of the check that [`next_step`](Self::next_step) requested.
    ///
    /// Returns whether results were dropped because of duplicates out of order.
    pub(super) fn handle_check(&mut self, result: Result<Proof, Error>, now: Stamp, samples: &mut Vec<Sample>) -> bool {
        self.with_active_cycle(now, samples, |cycle, stats, ctx| {
            stats.failures = stats.failures.saturating_add(u64::from(result.is_err()));
            cycle.confirmed(result.map_err(|error| Reason::Failed(Arc::new(error))), now, ctx);
        })
    }

    /// Runs `act` on the cycle whose request or check was in flight; ends the cycle if it is over.
    fn with_active_cycle(
        &mut self,
        now: Stamp,
        samples: &mut Vec<Sample>,
        act: impl FnOnce(&mut Cycle, &mut Counters, &mut CycleContext<'_>),
    ) -> bool {
        let Some(index) = self.active.take() else { return false };
        let Some(class) = self.classes.get_mut(index) else { return false };
        let Some(cycle) = &mut class.cycle else { return false };
        let (scan, members) = (&class.scan, &class.members);
        let mut ctx =
            CycleContext { station: &mut self.context, scan, members, samples, oldest: None, repeated: false };
        act(cycle, &mut class.stats, &mut ctx);
        let CycleContext { oldest, repeated, .. } = ctx;
        let next_aging = oldest.and_then(|at| at.checked_add(class.scan.stale_age()));
        class.next_aging = class.next_aging.into_iter().chain(next_aging).min();
        self.end(index, now, samples);
        repeated
    }

    /// Updates the quality of the tags by their age. Call it at [`next_aging`](Self::next_aging),
    /// also while a request is in flight.
    pub(super) fn age(&mut self, now: Stamp, samples: &mut Vec<Sample>) {
        self.age_due(ClassState::next_age_check, now, samples);
    }

    /// Returns when to call [`age`](Self::age).
    pub(super) fn next_aging(&self) -> Option<Instant> {
        self.classes.iter().filter_map(ClassState::next_age_check).min()
    }

    /// Updates the quality of the tags without the pause of [`age`](Self::age).
    fn age_now(&mut self, now: Stamp, samples: &mut Vec<Sample>) {
        self.age_due(|class| class.next_aging, now, samples);
    }

    fn age_due(&mut self, due: impl Fn(&ClassState) -> Option<Instant>, now: Stamp, samples: &mut Vec<Sample>) {
        let classes = self.classes.iter_mut().filter(|class| due(class).is_some_and(|at| at <= now.instant));
        classes.for_each(|class| class.age(now, &mut self.context.tag_map, samples));
    }

    /// Begins a cycle of a class if it is due.
    fn begin(&mut self, index: usize, now: Stamp, samples: &mut Vec<Sample>) {
        let Some(class) = self.classes.get_mut(index) else { return };
        if class.cycle.is_some() {
            return;
        }
        let Some(Due { at: due, overruns }) = class.schedule.begin(&class.scan, now.instant) else { return };
        class.stats.overruns = class.stats.overruns.saturating_add(overruns);
        // A single request for nothing but the tags is optimal at any cost.
        let can_improve = |plan: &ClassPlan| !matches!(plan.plans.as_slice(), [plan] if plan.is_tight());
        let is_old =
            |plan: &ClassPlan| now.instant.saturating_duration_since(plan.made_at) >= MIN_PLAN_AGE && can_improve(plan);
        let latency = &self.context.latency;
        if class.plan.as_ref().is_some_and(|plan| is_old(plan) && latency.has_changed_since(plan.response_time)) {
            tracing::debug!(response_time = ?latency.response_time(), "new plan for another response time");
            class.plan = None;
        }
        class.stats.cycles = class.stats.cycles.saturating_add(1);
        let response_time = self.context.latency.response_time();
        let (scan, members) = (&class.scan, &class.members);
        let mut ctx =
            CycleContext { station: &mut self.context, scan, members, samples, oldest: None, repeated: false };
        let planned = class.plan.as_ref().map(|plan| plan.plans.clone());
        let (cycle, plans) = Cycle::new((class.stats.cycles, due), (planned, class.start), now, &mut ctx);
        if class.plan.is_none() {
            class.plan = Some(ClassPlan { plans, response_time, made_at: now.instant });
        }
        class.cycle = Some(Box::new(cycle));
        self.end(index, now, samples);
    }

    /// Ends the cycle of a class if it is over.
    fn end(&mut self, index: usize, now: Stamp, samples: &mut Vec<Sample>) {
        self.drop_stale_plans();
        let Some(class) = self.classes.get_mut(index) else { return };
        let Some(cycle) = class.cycle.take_if(|cycle| cycle.next_step().is_none()) else { return };
        let bad_age = class.scan.bad_age();
        for id in &class.members {
            let Some(state) = self.context.tag_map.get_mut(*id).filter(|state| !state.is_settled_in(cycle.number))
            else {
                continue;
            };
            match &cycle.abandoned {
                _ if state.is_refused() => {
                    state.miss_in(cycle.number);
                    state.set_unchanged(now.instant, samples);
                }
                Some((reason, _)) if !state.is_new_since(cycle.started) => {
                    state.miss_in(cycle.number);
                    state.set_failed(reason.clone(), now, bad_age, samples);
                }
                // Added during the cycle, or read only in part: the next cycle reads it.
                Some(_) | None => {}
            }
        }
        class.start = CycleStart::default();
        class.stats.completed = class.stats.completed.saturating_add(1);
        if let Some((_, start)) = cycle.abandoned {
            class.start = start;
            class.stats.abandoned = class.stats.abandoned.saturating_add(1);
        }
        class.stats.last_cycle = now.instant.saturating_duration_since(cycle.started);
        let is_complete = cycle.abandoned.is_none();
        let overruns = class.schedule.end(&class.scan, now.instant, is_complete);
        class.stats.overruns = class.stats.overruns.saturating_add(overruns);
        class.schedule_aging(&self.context.tag_map);
    }

    fn drop_stale_plans(&mut self) {
        if std::mem::take(&mut self.context.plans_stale) {
            self.classes.iter_mut().for_each(|class| class.plan = None);
        }
    }
}

/// Returns whether an error code is about the request. Error 9 is, only if the PLC may accept other requests
/// for the same values (`is_optional`).
fn concerns_the_request(code: ErrorCode, is_optional: bool) -> bool {
    code.is_about_the_request() && (is_optional || code != ErrorCode::NotSupported)
}
