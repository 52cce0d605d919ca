//! One cycle of a scan class on one station: reads all its tags once.
//!
//! ```text
//!             all requests done                probe answered
//! members ───────────────────────▶ probe ───────────────────────▶ others ──▶ over
//!    │ ▲                             └──none due, or refused─────────────────▶ │
//!    │ └── both halves done                                                    │
//!    ▼                                                                         │
//! halves of a refused request, and halves of these …                           │
//!    any of them: no reply ─────────────────────────────────────────▶ abandoned┘
//! ```
//!
//! - *Members*: the requests of the class's plan in turn. The plan leaves out refused tags.
//! - A *refused* request is halved: its tags are read again in two halves, each by a plan of its
//!   own. A tag or group that is refused alone is at fault and is not read further. If neither half
//!   contains one, the request is sent once more. A second refusal is due to the request itself and
//!   gives a [`LearnedLimit`] for the next plans; otherwise the cause has passed.
//! - If a refused request has *words of discretes*, its tags are read by requests without these words
//!   instead of in halves. If none of them is at fault, the request is sent once more, and a second
//!   refusal excludes words for the lifetime of a learned limit: those of the areas of which no word
//!   was ever accepted. If there is none, a request of several words is halved, and a single word is
//!   avoided. Requests of this cycle with excluded words are replaced before they are sent.
//! - *Probe*: the tag that was refused longest ago is read again when its probe is due.
//! - *Others*: after an accepted probe, all other refused tags are read again too.
//! - A missing reply *abandons* the cycle: the station would not reply to the other requests
//!   either. The next cycle begins behind the failed request, so that it does not starve the
//!   others.
//! - A cycle is a [job](crate::link::job): `confirm` holds its values until a check has confirmed
//!   them.
//!
//! Invariants:
//! - the values of a tag come from requests of one plan in this cycle; its time is that of the
//!   first reply;
//! - each value is reported once, and only if confirmed;
//! - a tag is at fault only if it was refused alone, and the refusal is confirmed;
//! - the cycle ends: each half is smaller than the whole, or excludes more areas of words, and each
//!   phase occurs once.

mod confirm;
mod words;

use std::sync::Arc;

use tokio::time::Instant;

use self::confirm::HeldResults;
use super::class::ScanClass;
use super::compiled_plan::{CompiledPlan, TagPart, tags_and_groups};
use super::context::StationContext;
use super::in_flight::InFlight;
use super::learned_limit::{LearnedLimit, SplitPoint};
use super::tag_map::TagMap;
use super::{Reason, Sample, Stamp, TagId};
use crate::error::ErrorCode;
use crate::plan::{PlannedRequest, ReadRequest, ReplyWords, WordAreas};

#[derive(Debug)]
pub(super) struct Cycle {
    /// Counts the cycles of the class, from 1.
    pub(super) number: u64,
    pub(super) due: Instant,
    pub(super) started: Instant,
    start: CycleStart,
    /// The plans of the class.
    plans: Vec<Arc<CompiledPlan>>,
    phase: CyclePhase,
    stack: Vec<StackFrame>,
    /// The tags of the probe phase.
    probe: Vec<TagId>,
    held: HeldResults,
    /// The reason why the cycle was abandoned, and the start of the next one.
    pub(super) abandoned: Option<(Reason, CycleStart)>,
}

/// The next step of a cycle.
#[derive(Debug)]
pub(super) enum CycleStep<'c> {
    /// Send this request.
    Read(&'c ReadRequest),
    /// Confirm the results so far by a check.
    Confirm,
}

/// The position in the plans of a class at which a cycle begins.
///
/// The cycle runs the plans from `plan` on and around, and the last of them from `request` on and
/// around. So the request that had no reply in one cycle is the last one of the next.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CycleStart {
    plan: usize,
    request: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CyclePhase {
    Members,
    Probe,
    Others,
    Over,
}

#[derive(Debug)]
enum StackFrame {
    Plan(InFlight),
    Refused(RefusedRequest),
}

/// A refused request that is being read in halves. The half in progress is above it on the stack.
#[derive(Clone, Debug)]
struct RefusedRequest {
    request: ReadRequest,
    split_point: SplitPoint,
    /// The half that has not been read.
    second_half: Option<Vec<TagPart>>,
    /// `true` if a tag at fault was found in it.
    explained: bool,
    /// `true` if the whole request is sent once more.
    resend: bool,
    /// The number of removed tags when it was sent; `None` if it read some of these tags.
    removals: Option<u64>,
    /// Its tags are read by runs alone.
    by_runs: bool,
    /// The areas whose discretes it reads as words.
    own_areas: WordAreas,
    /// The areas whose words its tags are read without, instead of in halves.
    word_areas: WordAreas,
}

/// The environment of a cycle: its station and class, and the samples it makes.
pub(super) struct CycleContext<'d> {
    pub(super) station: &'d mut StationContext,
    pub(super) scan: &'d ScanClass,
    /// The tags of the class; those of a group are consecutive.
    pub(super) members: &'d [TagId],
    pub(super) samples: &'d mut Vec<Sample>,
    /// The oldest time of the values that were reported.
    pub(super) oldest: Option<Instant>,
    /// `true` if results were dropped because of duplicates out of order.
    pub(super) repeated: bool,
}

impl Cycle {
    /// Starts a cycle with the given plans; without them, plans all tags that are not refused.
    ///
    /// Returns the plans too.
    pub(super) fn new(
        (number, due): (u64, Instant),
        (plans, start): (Option<Vec<Arc<CompiledPlan>>>, CycleStart),
        now: Stamp,
        ctx: &mut CycleContext<'_>,
    ) -> (Self, Vec<Arc<CompiledPlan>>) {
        let mut cycle = Self {
            number,
            due,
            started: now.instant,
            start,
            plans: Vec::new(),
            phase: CyclePhase::Members,
            stack: Vec::new(),
            probe: Vec::new(),
            held: HeldResults::new(ctx.station.params.retries),
            abandoned: None,
        };
        let plans = plans.unwrap_or_else(|| {
            let members = ctx.members.iter().filter(|id| !ctx.station.tag_map.is_refused(**id));
            let members: Vec<TagPart> = members.map(TagPart::whole).collect();
            cycle.plan(&members, now, ctx)
        });
        cycle.plans.clone_from(&plans);
        cycle.begin(now, ctx);
        (cycle, plans)
    }

    /// Pushes the plans of the class.
    fn begin(&mut self, now: Stamp, ctx: &mut CycleContext<'_>) {
        let (plans, start) = (&self.plans, self.start);
        // The last plan is the lowest on the stack.
        for place in (0..plans.len()).rev() {
            let last = place.saturating_add(1) == plans.len();
            let request = if last { start.request } else { 0 };
            let plan = start.plan.saturating_add(place).checked_rem(plans.len()).and_then(|at| plans.get(at));
            self.stack.extend(plan.map(|plan| StackFrame::Plan(InFlight::new(plan.clone(), request))));
        }
        self.settle(now, ctx);
    }

    /// Returns the next step; `None` if the cycle is over.
    pub(super) fn next_step(&self) -> Option<CycleStep<'_>> {
        if self.held.awaits_check() { Some(CycleStep::Confirm) } else { self.request().map(CycleStep::Read) }
    }

    /// Returns the request to send next.
    pub(super) fn request(&self) -> Option<&ReadRequest> {
        match self.stack.last()? {
            StackFrame::Plan(in_flight) => in_flight.request(),
            StackFrame::Refused(refused) => refused.resend.then_some(&refused.request),
        }
    }

    /// Returns the length of the reply to [`request`](Self::request) in bytes; `None` if not known.
    pub(super) fn reply_bytes(&self) -> Option<usize> {
        match self.stack.last()? {
            StackFrame::Plan(in_flight) => in_flight.planned().map(PlannedRequest::reply_bytes),
            StackFrame::Refused(_) => None,
        }
    }

    /// Handles the reply to the current request.
    fn handle_reply(&mut self, words: ReplyWords, at: Stamp, ctx: &mut CycleContext<'_>) {
        if let Some(request) = self.request() {
            ctx.station.learned_limits.record_accepted(request, self.word_areas());
        }
        match self.stack.last_mut() {
            Some(StackFrame::Plan(in_flight)) => {
                in_flight.take_reply(words, at, |id, values, at| self.held.hold(id, values, at));
            }
            // The cause of the refusal has passed.
            Some(StackFrame::Refused(_)) => {
                self.stack.pop();
                self.mark_explained();
            }
            None => {}
        }
        self.settle(at, ctx);
    }

    /// Handles the refusal of the current request.
    fn handle_refusal(&mut self, code: ErrorCode, now: Stamp, ctx: &mut CycleContext<'_>) {
        match self.stack.last_mut() {
            Some(StackFrame::Plan(in_flight)) => {
                let request = in_flight.current();
                in_flight.done = in_flight.done.saturating_add(1);
                let plan = in_flight.plan.clone();
                self.halve(&plan, request, code, now, ctx);
            }
            Some(StackFrame::Refused(refused)) => {
                let limit = refused.explanation(ctx.station);
                self.stack.pop();
                if let Some(limit) = limit {
                    tracing::debug!(?limit, "a request is refused although its halves are accepted");
                    ctx.station.learned_limits.learn(limit, now.instant);
                    ctx.station.invalidate_plans();
                }
                self.mark_explained();
            }
            None => {}
        }
        self.settle(now, ctx);
    }

    /// Returns the start of the next cycle if this one is abandoned now.
    fn next_start(&self) -> CycleStart {
        let plans = self.stack.iter().map_while(|frame| match frame {
            StackFrame::Plan(in_flight) => Some(in_flight),
            StackFrame::Refused(_) => None,
        });
        match (self.phase, plans.enumerate().last()) {
            // The `below` plans under it come first in the next cycle, and this plan last.
            (CyclePhase::Members, Some((below, in_flight))) => CycleStart {
                plan: self.start.plan.saturating_add(self.plans.len().saturating_sub(below)),
                request: in_flight.next_first(self.stack.len() > below.saturating_add(1)),
            },
            (CyclePhase::Members | CyclePhase::Probe | CyclePhase::Others | CyclePhase::Over, _) => {
                CycleStart::default()
            }
        }
    }

    /// Reads the parts of a refused request in halves, or marks them as refused.
    fn halve(&mut self, plan: &CompiledPlan, index: usize, code: ErrorCode, now: Stamp, ctx: &mut CycleContext<'_>) {
        let Some(planned) = plan.requests().get(index) else { return };
        let (request, word_areas) = (planned.request(), planned.word_areas());
        let parts: Vec<TagPart> = plan.parts_of(index).iter().filter_map(|part| plan.part(*part)).collect();
        let removed = parts.iter().any(|part| !ctx.station.tag_map.contains(part.id));
        let removals = (!removed).then_some(ctx.station.removals);
        let mut refused = RefusedRequest::new(request.clone(), word_areas, removals);
        let halves = plan.halves(index, &ctx.station.tag_map);
        // The PLC may accept the discretes. A group has no halves.
        if halves.is_none() || ctx.station.learned_limits.may_lack_words(request, word_areas) {
            let polled: Vec<TagPart> =
                parts.iter().copied().filter(|part| ctx.station.tag_map.contains(part.id)).collect();
            if self.read_without_words(refused.clone(), &polled, word_areas, now, ctx) {
                return;
            }
        }
        match halves {
            Some(halves) => {
                refused.split_point = halves.split_point;
                // Alternates between cycles: a half without a reply must not starve the other.
                let (first, second) = match self.number.is_multiple_of(2) {
                    true => (halves.right, halves.left),
                    false => (halves.left, halves.right),
                };
                refused.second_half = Some(second);
                self.stack.push(StackFrame::Refused(refused));
                self.push(&first, now, ctx);
            }
            // A removed tag may have been at fault.
            None if removed => {
                let parts: Vec<TagPart> =
                    parts.into_iter().filter(|part| ctx.station.tag_map.contains(part.id)).collect();
                self.push(&parts, now, ctx);
            }
            None => {
                // The PLC may refuse a mixed read of elements that it accepts as a run. A group may be
                // a run by words only, and then these are tried once.
                let no_words = self.refused_words().and(word_areas).and(ctx.station.learned_limits.no_words());
                let with_words = !self.has_runs_on_stack();
                let runs = matches!(request, ReadRequest::Mixed(_)).then(|| {
                    let runs = ctx.station.plan_runs(&parts, no_words);
                    runs.or_else(|error| {
                        if with_words { ctx.station.plan_runs(&parts, WordAreas::default()) } else { Err(error) }
                    })
                });
                if let Some(Ok(plan)) = runs {
                    refused.by_runs = true;
                    self.stack.push(StackFrame::Refused(refused));
                    self.stack.push(StackFrame::Plan(InFlight::new(Arc::new(plan), 0)));
                } else {
                    self.mark_refused(&parts, &Reason::Refused(code), now, ctx);
                }
            }
        }
    }

    /// Advances until there is a step to take, or the cycle is over.
    fn settle(&mut self, now: Stamp, ctx: &mut CycleContext<'_>) {
        loop {
            match self.stack.last_mut() {
                Some(StackFrame::Plan(in_flight)) => {
                    let number = self.number;
                    let is_wanted = |part: TagPart| is_wanted(part, number, &ctx.station.tag_map);
                    if !in_flight.skip_to(is_wanted) {
                        self.stack.pop();
                    } else if !self.replace_words(now, ctx) {
                        return;
                    }
                }
                Some(StackFrame::Refused(refused)) => {
                    if let Some(half) = refused.second_half.take() {
                        self.push(&half, now, ctx);
                    } else if refused.explained {
                        self.stack.pop();
                        self.mark_explained();
                    } else if refused.explanation(ctx.station).is_none() {
                        self.stack.pop();
                    } else {
                        refused.resend = true;
                        return;
                    }
                }
                None => {
                    // The next phase depends on the results of this one.
                    if self.phase != CyclePhase::Over && self.confirm_phase(ctx) {
                        return;
                    }
                    match self.next_phase(now, ctx) {
                        Some(parts) => self.push(&parts, now, ctx),
                        None => {
                            self.phase = CyclePhase::Over;
                            return;
                        }
                    }
                }
            }
        }
    }

    /// Enters the next phase and returns the tags to read in it; `None` if the cycle is over.
    fn next_phase(&mut self, now: Stamp, ctx: &mut CycleContext<'_>) -> Option<Vec<TagPart>> {
        let tag_map = &ctx.station.tag_map;
        let untried = |part: &TagPart| tag_map.is_refused(part.id) && is_wanted(*part, self.number, tag_map);
        let refused = || ctx.members.iter().map(TagPart::whole).filter(untried).collect::<Vec<_>>();
        match self.phase {
            CyclePhase::Members => {
                let refused = refused();
                let due = |item: &&[TagPart]| {
                    let times = item.iter().filter_map(|part| tag_map.get(part.id)?.probe_at);
                    times.min().filter(|at| *at <= now.instant)
                };
                let items = tags_and_groups(&refused, tag_map).filter(|item| due(item).is_some());
                let probe = items.min_by_key(due)?.to_vec();
                self.probe = probe.iter().map(|part| part.id).collect();
                self.phase = CyclePhase::Probe;
                // Also if there is no reply: the next probe is that of another tag.
                let probe_at = self.probe_at(now, ctx);
                for id in &self.probe {
                    if let Some(state) = ctx.station.tag_map.get_mut(*id) {
                        state.probe_at = Some(probe_at);
                    }
                }
                Some(probe)
            }
            CyclePhase::Probe if !self.probe.iter().any(|id| tag_map.is_refused(*id)) => {
                self.phase = CyclePhase::Others;
                Some(refused())
            }
            CyclePhase::Probe | CyclePhase::Others | CyclePhase::Over => None,
        }
    }

    /// Returns whether the tags of a refused request are being read by runs alone.
    fn has_runs_on_stack(&self) -> bool {
        self.stack.iter().any(|frame| match frame {
            StackFrame::Refused(refused) => refused.by_runs,
            StackFrame::Plan(_) => false,
        })
    }

    fn probe_at(&self, now: Stamp, ctx: &CycleContext<'_>) -> Instant {
        now.instant.checked_add(ctx.scan.probe_refused).unwrap_or(now.instant)
    }

    /// Reads these parts next.
    fn push(&mut self, parts: &[TagPart], now: Stamp, ctx: &mut CycleContext<'_>) {
        let plans = self.plan(parts, now, ctx);
        self.stack.extend(plans.into_iter().map(|plan| StackFrame::Plan(InFlight::new(plan, 0))));
    }

    /// Plans the wanted ones of these parts, nearly always in one plan.
    fn plan(&mut self, parts: &[TagPart], now: Stamp, ctx: &mut CycleContext<'_>) -> Vec<Arc<CompiledPlan>> {
        let is_wanted = |part: &TagPart| is_wanted(*part, self.number, &ctx.station.tag_map);
        let parts: Vec<TagPart> = parts.iter().copied().filter(is_wanted).collect();
        let no_words = self.refused_words();
        if let Ok(plan) = ctx.station.plan(&parts, no_words) {
            return vec![Arc::new(plan)];
        }
        // A group or a text exceeds the learned limits, or those of any request.
        let items: Vec<Vec<TagPart>> = tags_and_groups(&parts, &ctx.station.tag_map).map(<[TagPart]>::to_vec).collect();
        let (mut plans, mut plannable) = (Vec::new(), Vec::new());
        for item in items {
            if ctx.station.plan(&item, no_words).is_ok() {
                plannable.extend(item);
                continue;
            }
            let excluded = no_words.and(ctx.station.learned_limits.no_words());
            let configured = |no_words| ctx.station.plan_with_configured_limits(&item, no_words);
            // A group may fit as words only.
            match configured(excluded).or_else(|_| configured(WordAreas::default())) {
                Ok(plan) => plans.push(Arc::new(plan)),
                Err(error) => self.mark_refused(&item, &Reason::NoPlan(Arc::new(error)), now, ctx),
            }
        }
        match ctx.station.plan(&plannable, no_words) {
            Ok(plan) => plans.push(Arc::new(plan)),
            // Too many values, which `StationPoller::add` excludes.
            Err(error) => self.mark_refused(&plannable, &Reason::NoPlan(Arc::new(error)), now, ctx),
        }
        plans
    }

    /// Marks parts as refused: the PLC refused them alone, or no request can read them.
    fn mark_refused(&mut self, parts: &[TagPart], reason: &Reason, now: Stamp, ctx: &mut CycleContext<'_>) {
        let probe_at = self.probe_at(now, ctx);
        for part in parts {
            if let Some(state) = ctx.station.tag_map.get_mut(part.id) {
                let (tag, was_refused) = (state.tag, state.is_refused());
                tracing::debug!(%tag, %reason, "a tag was refused");
                state.settle_in(self.number);
                state.set_refused(reason.clone(), now, probe_at, ctx.samples);
                if !was_refused {
                    ctx.station.avoid_refused(tag);
                }
            }
        }
        self.mark_explained();
    }

    /// Marks the innermost refused request as explained.
    fn mark_explained(&mut self) {
        let innermost = self.stack.iter_mut().rev().find_map(|frame| match frame {
            StackFrame::Refused(refused) => Some(refused),
            StackFrame::Plan(_) => None,
        });
        if let Some(refused) = innermost {
            refused.explained = true;
        }
    }
}

/// Returns whether a tag is polled and this cycle has reported neither values nor a refusal of it.
fn is_wanted(part: TagPart, number: u64, tag_map: &TagMap) -> bool {
    tag_map.get(part.id).is_some_and(|state| !state.is_settled_in(number))
}

impl RefusedRequest {
    /// A request with words of the discretes of these areas. `removals`: see the field.
    fn new(request: ReadRequest, own_areas: WordAreas, removals: Option<u64>) -> Self {
        Self {
            request,
            split_point: SplitPoint { left_end: 0, right_start: 0, right_len: 0 },
            second_half: None,
            explained: false,
            resend: false,
            removals,
            by_runs: false,
            own_areas,
            word_areas: WordAreas::default(),
        }
    }

    /// Returns the limit to learn if the request is refused again.
    fn explanation(&self, station: &StationContext) -> Option<LearnedLimit> {
        // After the removal of a tag, a plan would not contain the same request.
        let unchanged = self.removals == Some(station.removals);
        if !self.word_areas.is_empty() {
            return unchanged.then(|| station.learned_limits.words_explanation(&self.request, self.word_areas));
        }
        unchanged.then(|| station.learned_limits.explanation(&self.request, self.split_point))?
    }
}
