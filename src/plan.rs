//! Plans: the cheapest list of requests that reads a set of tags. No I/O, except in [`Plan::read`].
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::endpoint::SerialSettings;
//! use fatek::plan::{CostModel, Plan};
//! use fatek::wire::Framing;
//!
//! let cost = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
//! let plan = Plan::builder(cost)
//!     .tags(["R0-R9", "R12:f32", "R900", "D7", "M3"].map(|tag| tag.parse().unwrap()))
//!     .build()?;
//! println!("{}", plan.explain());
//! assert_eq!(plan.requests().len(), 2); // R0 to R13 as one run, through a gap; the other three as a mixed read
//!
//! let readings = plan.read(&station).await;
//! assert!(matches!(readings.tag(1), Some(Ok(values)) if values == [fatek::tag::TagValue::F32(0.0)]));
//! # Ok(()) });
//! ```
//!
//! # Guarantees
//!
//! - Each value comes from one request, and thus from one scan: the halves of an `R100:f32` and the
//!   registers of a text never come from two. Different values of one tag (`R0-R99`) may come from
//!   different scans, unless [`PlanBuilder::one_scan`] puts them in one request or fails.
//! - No request reads an element that the [`Limits`] exclude, not even in a gap between two tags.
//! - No request has a list of elements that is ambiguous in the binary framing.
//!
//! # Search space
//!
//! The input is a set of *parts*: the values of the tags, and the groups that must come from one
//! scan. A value has one or two cells, or up to 64 for a text. A cell is a discrete, a word of
//! discretes, or a 16-bit register; `DR0` is the cells `R0` and `R1`. Equal parts count once, and a
//! value within another value is read with it. A plan distributes the parts among requests, each of
//! which is
//!
//! - a *run*, 44 or 46: all cells from the first part to the last; or
//! - a *mixed* read, 48: only the cells of the parts, neighbours in pairs (`DR0` is shorter than
//!   `R0 R1`), in the order of symbols and addresses.
//!
//! A discrete X, Y, M or S is also read as a bit of a word, by a run 46 or a mixed read: `WM0` is M0
//! to M15. The word begins at a multiple of 8 and has only discretes that the [`Limits`] allow. A
//! discrete within the word of a tag is read with it. Words are not read as discretes, nor T and C
//! as words. `WM0` and `WM8`, which overlap, are not in one run.
//!
//! If a list is ambiguous in the binary framing, its last stretch of neighbours comes first.
//!
//! The cost of a plan is the sum of the costs of its requests by the [`CostModel`], and the time of
//! their [proofs](Plan::proof_time), which depends on their order.
//!
//! Up to eight parts, the plan is the cheapest of all partitions, of all choices of words in each
//! request, and of all orders. There are two exceptions: of lists with replies of one length, only
//! the cheapest choices of words are tried if these are ambiguous in the binary framing; and of
//! requests with more than 16 discretes, only the cheapest choice for each number of units. Above
//! eight parts:
//!
//! - Without mixed reads, groups and words of discretes, and without
//!   [proofs](CostModel::with_proofs), no requests are cheaper: a dynamic program over the sorted values
//!   finds the runs.
//! - With mixed reads, the same program chooses run or mixed read for each value, for several
//!   prices of a unit in a mixed read. If the values left for mixed reads at price 0 fit in one,
//!   the same is true. Otherwise the loss is about the unused part of the last mixed read.
//! - Proofs: each of these plans is also made with requests that are shorter by a value than the
//!   ones before, so that neighbours differ, and the cheaper one is taken. Then the requests are
//!   ordered. Up to eight of them are joined, or sent in another form, if that saves more.
//! - Words of discretes are chosen by another such program for each area, before the values are
//!   distributed. A plan without words is made as well, unless a lower bound shows that it costs
//!   more, and the cheaper one is taken.
//! - Groups are placed first, each as its own cheapest request, and values fill the remaining room.
//!   This is a heuristic. A text that is longer than the PLC's longest run is planned as a group.
//!
//! The run time is O(n log n), for sorting values and requests; the rest is linear. The comparison of
//! all plans of n parts, at most eight, takes at most 3^n steps for each form of a request, each shape
//! of a reply before it, and each shape of the last reply; nearly always its lower bounds end it far
//! before that.

mod access;
mod builder;
mod cost;
mod error;
mod explain;
mod fallback;
mod layout;
mod limits;
mod order;
mod proofs;
mod read;
mod readings;
mod reply;
mod request;
mod solve;
mod struct_plan;
mod words;

use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

pub use builder::PlanBuilder;
pub use cost::CostModel;
pub use error::PlanError;
pub use explain::Explanation;
pub use limits::Limits;
pub(crate) use limits::check_range;
pub use readings::PlanReadings;
pub use reply::Reply;
pub(crate) use reply::ReplyWords;
pub use request::{PlannedRequest, ReadRequest};
pub use struct_plan::StructPlan;
pub(crate) use words::WordAreas;

use crate::station::Station;
use crate::tag::Tag;

/// The maximum number of values in a plan.
pub const MAX_VALUES: usize = 1 << 20;

/// A list of requests that reads a set of tags. See [the module](self).
#[derive(Clone, Debug)]
pub struct Plan {
    tags: Vec<Tag>,
    /// For each tag, the index of its first value in `slots`.
    first_slot: Vec<usize>,
    slots: Vec<ValueSlot>,
    requests: Vec<PlannedRequest>,
    proof_time: Duration,
    /// Present if a request reads discretes as words.
    inputs: Option<Arc<fallback::PlanInputs>>,
}

/// The place of a value: its request, and its first word in the reply.
#[derive(Clone, Copy, Debug)]
struct ValueSlot {
    request: u32,
    word: u16,
    /// The bit of the word, for a discrete that is read as part of it.
    bit: Option<u8>,
}

impl Plan {
    /// Returns a builder of a plan with these costs.
    #[must_use]
    pub fn builder(cost: CostModel) -> PlanBuilder {
        PlanBuilder::new(cost)
    }

    /// Starts a plan for a station: with its costs, within its [capabilities](Station::capabilities).
    ///
    /// If no plan is within those that refusals have shown, it is one within those that were declared.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::{Plan, Tag};
    ///
    /// let plan = Plan::builder_for(&station).tag(Tag::parse("R0-R7")?).build()?;
    /// assert_eq!(plan.read(&station).await.errors().count(), 0);
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn builder_for(station: &Station) -> PlanBuilder {
        let known = station.capabilities();
        let builder = Self::builder(CostModel::of_link(station.link()).with_known(&known));
        let limits = |known| Limits::new().within(known);
        let (all, declared) = (limits(&known), limits(&station.declared_capabilities()));
        if all == declared { builder.limits(all) } else { builder.limits(all).wider_limits(declared) }
    }

    /// Returns the tags in the order in which they were added.
    #[must_use]
    pub fn tags(&self) -> &[Tag] {
        &self.tags
    }

    /// Returns the requests, in the order in which they are sent: that with the shortest
    /// [proofs](Self::proof_time).
    #[must_use]
    pub fn requests(&self) -> &[PlannedRequest] {
        &self.requests
    }

    /// Returns the indices of the [requests](Self::requests) that read the tag with this index.
    ///
    /// Empty if the plan has no such tag.
    pub fn requests_of(&self, tag: usize) -> impl Iterator<Item = usize> + use<> {
        let requests = self.slots(tag).unwrap_or_default().iter().map(|slot| slot.request as usize);
        requests.collect::<BTreeSet<_>>().into_iter()
    }

    /// Returns the length of all requests and replies in bytes, without proofs.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.requests.iter().map(PlannedRequest::bytes).sum()
    }

    /// Returns the duration of all requests and their [proofs](Self::proof_time) by the cost model.
    #[must_use]
    pub fn time(&self) -> Duration {
        self.requests.iter().fold(self.proof_time, |sum, request| sum.saturating_add(request.time))
    }

    /// Returns the duration of the proofs of all requests by the [cost model](CostModel).
    ///
    /// Zero if no two neighbours have replies of one command and one length, and the last reply
    /// differs from all others.
    #[must_use]
    pub fn proof_time(&self) -> Duration {
        self.proof_time
    }

    /// Returns a human-readable table of requests, bytes and milliseconds.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::plan::{CostModel, Plan};
    /// use fatek::wire::Framing;
    ///
    /// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    /// let plan = Plan::builder(network).tag(fatek::element!("R0")).build()?;
    /// assert!(plan.explain().to_string().starts_with("request"));
    /// # Ok::<(), fatek::plan::PlanError>(())
    /// ```
    #[must_use]
    pub fn explain(&self) -> Explanation<'_> {
        Explanation { plan: self }
    }

    /// Assigns replies to the tags, one for each request, if the caller sends the requests.
    ///
    /// A refused request is an error of its tags. [`Limits::words_of_discretes`] makes plans for a PLC
    /// that refuses words of discretes.
    ///
    /// # Errors
    /// [`PlanError::Reply`] if a reply does not match its request, or their numbers differ.
    pub fn scatter<E>(
        &self,
        replies: impl IntoIterator<Item = Result<Reply, E>>,
    ) -> Result<PlanReadings<'_, E>, PlanError> {
        let mut words = Vec::with_capacity(self.requests.len());
        for (n, reply) in replies.into_iter().enumerate() {
            let planned = self.requests.get(n).ok_or(PlanError::Reply { request: n })?;
            if let Ok(reply) = &reply
                && !reply.matches(&planned.request)
            {
                return Err(PlanError::Reply { request: n });
            }
            words.push(reply.map(ReplyWords::from));
        }
        if words.len() < self.requests.len() {
            return Err(PlanError::Reply { request: words.len() });
        }
        Ok(PlanReadings::new(self, words))
    }

    fn slots(&self, tag: usize) -> Option<&[ValueSlot]> {
        self.slots.get(self.slot_range(tag)?)
    }

    /// Returns the indices of the values of a tag.
    fn slot_range(&self, tag: usize) -> Option<Range<usize>> {
        let start = *self.first_slot.get(tag)?;
        Some(start..self.first_slot.get(tag + 1).copied().unwrap_or(self.slots.len()))
    }
}

#[cfg(test)]
mod tests;
