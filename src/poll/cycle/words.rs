//! Discretes as words in a cycle: requests that a PLC refuses for their words.

use super::{Cycle, CycleContext, RefusedRequest, StackFrame};
use crate::plan::{PlannedRequest, ReadRequest, WordAreas};
use crate::poll::Stamp;
use crate::poll::compiled_plan::{TagPart, tags_and_groups};

impl Cycle {
    /// The areas whose discretes the request to send next reads as words.
    pub(in crate::poll) fn word_areas(&self) -> WordAreas {
        let areas = self.stack.last().and_then(|frame| match frame {
            StackFrame::Plan(in_flight) => in_flight.planned().map(PlannedRequest::word_areas),
            StackFrame::Refused(refused) => Some(refused.own_areas),
        });
        areas.unwrap_or_default()
    }

    /// Returns whether the PLC may accept other requests for the values of the one to send next: it is
    /// a mixed read, or reads discretes as words.
    pub(in crate::poll) fn is_optional(&self) -> bool {
        !self.word_areas().is_empty() || matches!(self.request(), Some(ReadRequest::Mixed(_)))
    }

    /// Reads these parts of a refused request next, without words of these areas. Returns whether there
    /// are such areas, and the parts fit without their words.
    pub(super) fn read_without_words(
        &mut self,
        request: RefusedRequest,
        parts: &[TagPart],
        word_areas: WordAreas,
        now: Stamp,
        ctx: &mut CycleContext<'_>,
    ) -> bool {
        // A group may fit as words only.
        let fits = !word_areas.is_empty() && self.fit_without_words(parts, word_areas, ctx);
        if fits {
            self.stack.push(StackFrame::Refused(RefusedRequest { word_areas, ..request }));
            self.push(parts, now, ctx);
        }
        fits
    }

    /// Returns whether these parts can be planned without words of these areas.
    fn fit_without_words(&self, parts: &[TagPart], areas: WordAreas, ctx: &mut CycleContext<'_>) -> bool {
        let no_words = self.refused_words().and(areas);
        if ctx.station.plan(parts, no_words).is_ok() {
            return true;
        }
        // A group or a text exceeds the learned limits, or those of any request.
        let excluded = no_words.and(ctx.station.learned_limits.no_words());
        let fits = |item| ctx.station.plan_with_configured_limits(item, excluded).is_ok();
        tags_and_groups(parts, &ctx.station.tag_map).all(fits)
    }

    /// Replaces the current request if it has words that a request of this cycle has excluded.
    /// Returns whether it did.
    pub(super) fn replace_words(&mut self, now: Stamp, ctx: &mut CycleContext<'_>) -> bool {
        let Some(StackFrame::Plan(in_flight)) = self.stack.last() else { return false };
        let Some(planned) = in_flight.planned() else { return false };
        let excluded = planned.word_areas().common(ctx.station.learned_limits.no_words());
        // Requests in place of a refused one were planned for it.
        let is_retry = self.stack.iter().any(|frame| match frame {
            StackFrame::Refused(_) => true,
            StackFrame::Plan(_) => false,
        });
        if excluded.is_empty() || is_retry {
            return false;
        }
        let plan = &in_flight.plan;
        let parts: Vec<TagPart> =
            plan.parts_of(in_flight.current()).iter().filter_map(|part| plan.part(*part)).collect();
        // Not sent, so nothing is learned from it.
        let replaced = RefusedRequest::new(planned.request().clone(), planned.word_areas(), None);
        let last = self.stack.len().saturating_sub(1);
        let is_replaced = self.read_without_words(replaced, &parts, excluded, now, ctx);
        if let (true, Some(StackFrame::Plan(in_flight))) = (is_replaced, self.stack.get_mut(last)) {
            in_flight.done = in_flight.done.saturating_add(1);
        }
        is_replaced
    }

    /// The areas of discretes whose words were refused in the requests that are being read again.
    ///
    /// The discrete at fault may be in words of others.
    pub(super) fn refused_words(&self) -> WordAreas {
        self.stack.iter().fold(WordAreas::default(), |areas, frame| match frame {
            StackFrame::Refused(refused) => areas.and(refused.word_areas),
            StackFrame::Plan(_) => areas,
        })
    }
}
