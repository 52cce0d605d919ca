//! The tags of one station, and what is to be asked next. No I/O, and no clock.
//!
//! ```text
//! class   waiting ──its time has come──▶ running ──its cycle is over──▶ waiting
//! ```
//!
//! One request is on its way at a time. Among the classes that are running, the one whose next cycle is due first has it:
//! a fast class gets its turn between the requests of a slow one, and the slow one, however late, comes to be the first.
//!
//! What must always hold:
//! - a cycle begins at a time of its class's grid, or later if that cannot be; the times of the grid at which one is still
//!   running are counted as overruns and skipped: there is never more than one cycle of a class;
//! - values are given out only when their cycle has confirmed them;
//! - a removed tag has no samples after its removal;
//! - the quality of every tag is true now, after [`next`](Device::next) or [`age`](Device::age) has been called with now.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::class::{PollTag, ScanClass};
use super::cycle::{Ask, Bench, Cycle, Start};
use super::known::{Known, Polled};
use super::plans::Plans;
use super::point::Point;
use super::points::Points;
use super::stats::{ClassStats, Counters};
use super::trip::Trip;
use super::work::Work;
use super::{PollError, Reason, Sample, Stamp, TagId};
use crate::error::{Error, ErrorCode};
use crate::link::{Proof, Shape};
use crate::plan::{CostModel, Limits, PlanError, ReadRequest, Reply, Words};
use crate::random::Random;

#[derive(Debug)]
pub(super) struct Device {
    known: Known,
    classes: Vec<Class>,
    /// What classes have done whose tags are all removed.
    retired: Option<Box<Counters>>,
    /// Of which class the request is that is on its way.
    asking: Option<usize>,
    random: Random,
    epoch: Instant,
    next_group: u64,
    /// How many values all tags have.
    values: usize,
}

#[derive(Debug)]
struct Class {
    scan: ScanClass,
    /// In the order they came; those of a group stand together.
    members: Vec<TagId>,
    plan: Option<Plan>,
    /// Where the next cycle begins.
    start: Start,
    due: Instant,
    cycle: Option<Box<Cycle>>,
    /// When the age of a tag may change its quality; not later than that, but perhaps earlier.
    ages_at: Option<Instant>,
    /// When that was last looked at.
    aged_at: Option<Instant>,
    stats: Counters,
}

#[derive(Debug)]
struct Plan {
    works: Vec<Arc<Work>>,
    /// The latency that it was made with.
    latency: Duration,
    made_at: Instant,
}

/// For so long a plan is kept though the round trip has changed: it is not worth much, and a spike is nothing at all.
const KEPT: Duration = Duration::from_secs(60);

/// What is to be done next.
#[derive(Debug)]
pub(super) enum Step {
    /// This is to be sent. Apart, because the task waits for its next cycle nearly always.
    Read(Box<ReadRequest>),
    /// The results of a cycle are to be confirmed by a check: see [`Device::confirmed`].
    Confirm,
    /// Nothing, until then, or until tags come.
    Wait(Option<Instant>),
}

/// The answer to a request.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) result: Result<Reply, Error>,
    /// When it came, or when it was known that there is none.
    pub(super) at: Stamp,
    /// The time on the wire, as far as it is known.
    pub(super) trip: Option<Duration>,
    pub(super) shape: Shape,
    pub(super) proof: Proof,
}

impl Device {
    pub(super) fn new(
        polled: Polled,
        (limits, cost): (Arc<Limits>, CostModel),
        epoch: Instant,
        seed: u64,
        plans: Arc<Plans>,
    ) -> Self {
        Self {
            known: Known::new(limits, Trip::new(cost), plans, polled),
            classes: Vec::new(),
            retired: None,
            asking: None,
            random: Random::new(seed),
            epoch,
            next_group: 0,
            values: 0,
        }
    }

    /// Adds tags: all or none of them.
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
        let of = tags.iter().map(|(_, tag)| tag.tag);
        let builder = crate::plan::Plan::builder(self.known.trip.cost()).limits(Limits::clone(&self.known.limits));
        if one_scan { builder.one_scan(of) } else { builder.tags(of) }.build()?;
        let values = tags.iter().map(|(_, tag)| tag.tag.value_count()).fold(self.values, usize::saturating_add);
        if values > crate::plan::MAX_VALUES {
            return Err(PlanError::TooManyValues { max: crate::plan::MAX_VALUES }.into());
        }
        self.values = values;
        let group = one_scan.then(|| {
            self.next_group = self.next_group.saturating_add(1);
            self.next_group
        });
        let at = match self.classes.iter().position(|class| class.scan == scan) {
            Some(at) => at,
            None => {
                let due = self.first_due(&scan, now.instant);
                // Mostly there is one, and thousands of stations have one each.
                self.classes.reserve_exact(1);
                self.classes.push(Class::new(scan, due));
                self.classes.len().saturating_sub(1)
            }
        };
        if let Some(class) = self.classes.get_mut(at) {
            if class.members.is_empty() {
                class.members.reserve_exact(tags.len());
            }
            class.members.extend(tags.iter().map(|(id, _)| *id));
            class.plan = None;
        }
        self.known.points.extend(tags.into_iter().map(|(id, tag)| Point::new(id, tag, group, now)));
        Ok(())
    }

    /// Removes a tag; says whether it was there. Of tags that must come from one scan, the others stay.
    pub(super) fn remove(&mut self, id: TagId, now: Instant) -> bool {
        let Some(point) = self.known.points.get(id) else { return false };
        let (group, refused) = (point.group, point.is_refused());
        self.values = self.values.saturating_sub(point.tag.value_count());
        self.known.points.remove(id);
        self.known.removals = self.known.removals.saturating_add(1);
        for class in self.classes.iter_mut().filter(|class| class.members.contains(&id)) {
            class.members.retain(|member| *member != id);
            class.plan = None;
            // It may have been what the PLC refused of its group.
            for member in class.members.iter().filter(|_| refused && group.is_some()) {
                if let Some(point) = self.known.points.get_mut(*member).filter(|point| point.group == group) {
                    point.probe_at = point.probe_at.map(|at| at.min(now));
                }
            }
        }
        if refused {
            self.known.changed();
        }
        true
    }

    /// What is known of a tag now.
    pub(super) fn sample(&mut self, id: TagId, now: Stamp, samples: &mut Vec<Sample>) -> Option<Sample> {
        self.age_all(now, samples);
        self.known.points.get(id).map(Point::sample)
    }

    /// What is known of all tags now.
    pub(super) fn snapshot(&mut self, now: Stamp, samples: &mut Vec<Sample>) -> Vec<Sample> {
        self.age_all(now, samples);
        self.known.points.values().map(Point::sample).collect()
    }

    /// What the classes do that have tags.
    pub(super) fn classes(&self) -> impl Iterator<Item = ClassStats> {
        let refused = |id: &&TagId| self.known.points.get(**id).is_some_and(|point| point.is_refused());
        self.classes.iter().filter(|class| !class.members.is_empty()).map(move |class| ClassStats {
            class: class.scan,
            tags: class.members.len(),
            refused_tags: class.members.iter().filter(refused).count(),
            requests_per_cycle: class.plan.iter().flat_map(|plan| &plan.works).map(|work| work.requests().len()).sum(),
            counters: class.stats,
        })
    }

    /// What has been done, by all classes that there are and were.
    pub(super) fn counters(&self) -> Counters {
        let mut counters = self.retired.as_deref().copied().unwrap_or_default();
        self.classes.iter().for_each(|class| counters.add(&class.stats));
        counters
    }

    /// What is to be done next. To be called when nothing is on its way.
    pub(super) fn next(&mut self, now: Stamp, samples: &mut Vec<Sample>) -> Step {
        self.asking = None;
        self.age(now, samples);
        self.classes.retain(|class| {
            if class.members.is_empty() {
                self.retired.get_or_insert_default().add(&class.stats);
            }
            !class.members.is_empty()
        });
        if self.known.lessons.forget(now.instant) {
            self.known.changed();
        }
        self.drop_stale_plans();
        for at in 0..self.classes.len() {
            self.begin(at, now, samples);
        }
        let running = self.classes.iter().enumerate().filter_map(|(at, class)| {
            let cycle = class.cycle.as_ref()?;
            Some((cycle.due.checked_add(class.scan.period)?, at, cycle.ask()?))
        });
        if let Some((_, at, ask)) = running.min_by_key(|(deadline, at, _)| (*deadline, *at)) {
            self.asking = Some(at);
            return match ask {
                Ask::Read(request) => Step::Read(Box::new(request.clone())),
                Ask::Confirm => Step::Confirm,
            };
        }
        Step::Wait(self.classes.iter().map(|class| class.due).chain(self.ages_at()).min())
    }

    /// Takes the answer to the request that [`next`](Self::next) gave. Says whether results were dropped because duplicates came
    /// out of order.
    pub(super) fn done(&mut self, answer: Answer, samples: &mut Vec<Sample>) -> bool {
        let Answer { result, at: now, trip, shape, proof } = answer;
        self.act(now, samples, |cycle, stats, bench| {
            stats.requests = stats.requests.saturating_add(1);
            match result {
                // The link gives no reply that is none to its request.
                Ok(reply) => match cycle.request().and_then(|request| Words::of(reply, request)) {
                    Some(words) => {
                        if let (Some(trip), Some(bytes)) = (trip, cycle.reply_bytes()) {
                            bench.known.trip.measured(trip, bytes);
                        }
                        cycle.answered(Ok(words), (shape, proof), now, bench);
                    }
                    None => cycle.failed(Reason::Overdue, bench),
                },
                Err(error) => match error.error_code().filter(|code| is_about_the_request(*code)) {
                    Some(code) => {
                        stats.refusals = stats.refusals.saturating_add(1);
                        cycle.answered(Err(code), (shape, proof), now, bench);
                    }
                    None => {
                        stats.failures = stats.failures.saturating_add(1);
                        cycle.failed(Reason::Failed(Arc::new(error)), bench);
                    }
                },
            }
        })
    }

    /// Takes the result of the check that [`next`](Self::next) asked for. Says whether results were dropped because duplicates
    /// came out of order.
    pub(super) fn confirmed(&mut self, result: Result<Proof, Error>, now: Stamp, samples: &mut Vec<Sample>) -> bool {
        self.act(now, samples, |cycle, stats, bench| {
            stats.failures = stats.failures.saturating_add(u64::from(result.is_err()));
            cycle.confirmed(result.map_err(|error| Reason::Failed(Arc::new(error))), now, bench);
        })
    }

    /// Lets the cycle act that was asking.
    fn act(
        &mut self,
        now: Stamp,
        samples: &mut Vec<Sample>,
        act: impl FnOnce(&mut Cycle, &mut Counters, &mut Bench<'_>),
    ) -> bool {
        let Some(at) = self.asking.take() else { return false };
        let Some(class) = self.classes.get_mut(at) else { return false };
        let Some(cycle) = &mut class.cycle else { return false };
        let (scan, members) = (&class.scan, &class.members);
        let mut bench = Bench { known: &mut self.known, scan, members, samples, oldest: None, repeated: false };
        act(cycle, &mut class.stats, &mut bench);
        let Bench { oldest, repeated, .. } = bench;
        let ages_at = oldest.and_then(|at| at.checked_add(class.scan.stale_age()));
        class.ages_at = class.ages_at.into_iter().chain(ages_at).min();
        self.end(at, now, samples);
        repeated
    }

    /// Lets age change qualities: also to be called while a request is on its way, at [`ages_at`](Self::ages_at).
    pub(super) fn age(&mut self, now: Stamp, samples: &mut Vec<Sample>) {
        for class in self.classes.iter_mut().filter(|class| class.looks_at().is_some_and(|at| at <= now.instant)) {
            class.age(now, &mut self.known.points, samples);
        }
    }

    /// When [`age`](Self::age) is to be called.
    pub(super) fn ages_at(&self) -> Option<Instant> {
        self.classes.iter().filter_map(Class::looks_at).min()
    }

    /// As [`age`](Self::age), to the moment: for somebody who asks.
    fn age_all(&mut self, now: Stamp, samples: &mut Vec<Sample>) {
        for class in self.classes.iter_mut().filter(|class| class.ages_at.is_some_and(|at| at <= now.instant)) {
            class.age(now, &mut self.known.points, samples);
        }
    }

    fn first_due(&mut self, scan: &ScanClass, now: Instant) -> Instant {
        let period = scan.period.as_nanos().max(1);
        let nanoseconds = |n: u128| Duration::from_nanos(u64::try_from(n).unwrap_or(u64::MAX));
        match scan.phase {
            None => {
                let phase = u128::from(self.random.next()).checked_rem(period).unwrap_or(0);
                now.checked_add(nanoseconds(phase)).unwrap_or(now)
            }
            Some(phase) => {
                // The first time of the grid that is not past.
                let phase = phase.as_nanos().checked_rem(period).unwrap_or(0);
                let since = now.saturating_duration_since(self.epoch).as_nanos();
                let cycles = since.saturating_sub(phase).div_ceil(period);
                let due = self.epoch.checked_add(nanoseconds(cycles.saturating_mul(period).saturating_add(phase)));
                due.unwrap_or(now)
            }
        }
    }

    /// Begins a cycle, if it is time.
    fn begin(&mut self, at: usize, now: Stamp, samples: &mut Vec<Sample>) {
        let Some(class) = self.classes.get_mut(at) else { return };
        if class.cycle.is_some() || class.due > now.instant {
            return;
        }
        // Not begun in time, and not for want of its end: this task was not woken.
        let due = class.skip_to(now.instant);
        // One request for nothing but the tags is the best there is, whatever it costs.
        let improves = |plan: &Plan| !matches!(plan.works.as_slice(), [work] if work.is_tight());
        let old = |plan: &Plan| improves(plan) && now.instant.saturating_duration_since(plan.made_at) >= KEPT;
        if class.plan.as_ref().is_some_and(|plan| old(plan) && self.known.trip.has_changed_since(plan.latency)) {
            tracing::debug!(latency = ?self.known.trip.latency(), "the round trip has changed, and the plan with it");
            class.plan = None;
        }
        class.stats.cycles = class.stats.cycles.saturating_add(1);
        let latency = self.known.trip.latency();
        let (scan, members) = (&class.scan, &class.members);
        let mut bench = Bench { known: &mut self.known, scan, members, samples, oldest: None, repeated: false };
        let planned = class.plan.as_ref().map(|plan| plan.works.clone());
        let (cycle, works) = Cycle::new((class.stats.cycles, due), (planned, class.start), now, &mut bench);
        if class.plan.is_none() {
            class.plan = Some(Plan { works, latency, made_at: now.instant });
        }
        class.cycle = Some(Box::new(cycle));
        self.end(at, now, samples);
    }

    /// Ends the cycle, if it is over.
    fn end(&mut self, at: usize, now: Stamp, samples: &mut Vec<Sample>) {
        self.drop_stale_plans();
        let Some(class) = self.classes.get_mut(at) else { return };
        let Some(cycle) = class.cycle.take_if(|cycle| cycle.ask().is_none()) else { return };
        let bad_age = class.scan.bad_age();
        for id in &class.members {
            let Some(point) = self.known.points.get_mut(*id).filter(|point| point.cycle != cycle.number) else {
                continue;
            };
            match &cycle.abandoned {
                _ if point.is_refused() => point.passed_over(now.instant, samples),
                Some((reason, _)) if !point.is_new_since(cycle.started) => {
                    point.failed(reason.clone(), now, bad_age, samples);
                }
                // It came meanwhile; or it was taken apart with others, and there will be something in the next cycle.
                _ => {}
            }
        }
        class.start = Start::default();
        if let Some((_, start)) = cycle.abandoned {
            class.start = start;
            class.stats.abandoned = class.stats.abandoned.saturating_add(1);
        }
        class.stats.last_cycle = now.instant.saturating_duration_since(cycle.started);
        class.overrun(now.instant);
        class.watch_ages(&self.known.points);
    }

    fn drop_stale_plans(&mut self) {
        if std::mem::take(&mut self.known.plans_stale) {
            self.classes.iter_mut().for_each(|class| class.plan = None);
        }
    }
}

impl Class {
    fn new(scan: ScanClass, due: Instant) -> Self {
        Self {
            scan,
            members: Vec::new(),
            plan: None,
            start: Start::default(),
            due,
            cycle: None,
            ages_at: None,
            aged_at: None,
            stats: Counters::default(),
        }
    }

    /// Goes to the last time of the grid that is not in the future, and gives it; the next one is due then.
    fn skip_to(&mut self, now: Instant) -> Instant {
        let late = now.saturating_duration_since(self.due);
        let missed = late.as_nanos().checked_div(self.scan.period.as_nanos()).unwrap_or(0);
        self.stats.overruns = self.stats.overruns.saturating_add(u64::try_from(missed).unwrap_or(u64::MAX));
        let due = self.after(missed);
        self.due = due.checked_add(self.scan.period).unwrap_or(due);
        due
    }

    /// Skips the times of the grid that have passed while a cycle was running.
    fn overrun(&mut self, now: Instant) {
        if self.due <= now {
            self.skip_to(now);
            self.stats.overruns = self.stats.overruns.saturating_add(1);
        }
    }

    fn after(&self, periods: u128) -> Instant {
        let nanoseconds = self.scan.period.as_nanos().saturating_mul(periods);
        let by = Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX));
        self.due.checked_add(by).unwrap_or(self.due)
    }

    fn age(&mut self, now: Stamp, points: &mut Points, samples: &mut Vec<Sample>) {
        let (stale, bad) = (self.scan.stale_age(), self.scan.bad_age());
        for id in &self.members {
            if let Some(point) = points.get_mut(*id) {
                point.age(now, stale, bad, samples);
            }
        }
        self.aged_at = Some(now.instant);
        self.watch_ages(points);
    }

    /// When to look at the ages: not with every tag of a thousand that get old one after the other.
    fn looks_at(&self) -> Option<Instant> {
        let pause = self.scan.stale_age().checked_div(16).unwrap_or_default().max(Duration::from_millis(10));
        let pause_ends = self.aged_at.and_then(|at| at.checked_add(pause));
        Some(self.ages_at?.max(pause_ends.unwrap_or(self.ages_at?)))
    }

    fn watch_ages(&mut self, points: &Points) {
        let (stale, bad) = (self.scan.stale_age(), self.scan.bad_age());
        let ages = self.members.iter().filter_map(|id| points.get(*id)?.ages_at(stale, bad));
        self.ages_at = ages.min();
    }
}

/// Whether an error code says something about what was asked. The others are about the state of the PLC.
fn is_about_the_request(code: ErrorCode) -> bool {
    match code {
        ErrorCode::IllegalValue | ErrorCode::IllegalFormat | ErrorCode::IllegalAddress | ErrorCode::Unknown(_) => true,
        ErrorCode::WriteProhibited
        | ErrorCode::LadderChecksum
        | ErrorCode::IdMismatch
        | ErrorCode::Syntax
        | ErrorCode::NotSupported => false,
    }
}
