//! Plans: from any set of tags to the cheapest list of requests that reads them. No I/O, but for [`Plan::read`].
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
//! assert_eq!(plan.requests().len(), 2); // R0 to R13 in one run, through a gap; the other three in a mixed read
//!
//! let readings = plan.read(&station).await;
//! assert!(matches!(readings.tag(1), Some(Ok(values)) if values == [fatek::tag::TagValue::F32(0.0)]));
//! # Ok(()) });
//! ```
//!
//! # What is promised
//!
//! - Each value comes from one request, so from one scan: the two halves of an `R100:f32` never come from two, nor do
//!   the registers of a text.
//!   Different values of one tag (`R0-R99`) may come from different scans, unless [`PlanBuilder::one_scan`] asks for
//!   more; then they are in one request, or the plan is refused.
//! - No element is asked for that the [`Limits`] exclude, also not in a gap between two tags.
//! - No list is asked for that has two readings in the binary framing.
//!
//! # The plans that are looked at
//!
//! What is needed is a set of *parts*: the values of the tags, each one cell or two, or up to 64 for a text, and the groups
//! that must come from one scan. (A cell is a discrete, a word of discretes, or a 16-bit register; `DR0` is the cells `R0` and `R1`.) Equal
//! parts are one part, and a value within another value is read with it. A plan shares the parts out among requests,
//! each of which is
//!
//! - a *run*, 44 or 46: from the first cell that is needed to the last, with all that lies between; or
//! - a *mixed* read, 48: the cells that are needed and no others, neighbours in pairs (`DR0` is shorter than `R0 R1`),
//!   in the order of symbols and addresses.
//!
//! Its price is the sum over the requests of [`CostModel`]'s. Discretes are not read as words, nor words as discretes,
//! nor `WM0` with `WM8`, whose words lie across each other.
//!
//! Up to eight parts, the plan is the cheapest of all ways to share them out. Above that:
//!
//! - Without mixed reads and without groups, it is still the cheapest: a dynamic program over the sorted values finds
//!   where runs begin and end.
//! - With mixed reads, the same program decides between run and mixed read for each value, for several prices of a
//!   place in a mixed request. If what is left over at the price 0 fits into one mixed request, the result is still the
//!   cheapest; else what is lost is about the unused part of the last mixed request.
//! - Groups are placed first, each at its own best, and values fill what room they leave. This is a heuristic. A text for
//!   which the device's runs are too short is such a group.
//!
//! The time it takes is that of sorting the values, n log n; the rest is linear.

mod builder;
mod cost;
mod error;
mod explain;
mod layout;
mod limits;
mod parts;
mod readings;
mod request;
mod solve;

use std::collections::BTreeSet;
use std::time::Duration;

pub use builder::PlanBuilder;
pub use cost::CostModel;
pub use error::PlanError;
pub use explain::Explanation;
pub use limits::Limits;
pub(crate) use readings::Words;
pub use readings::{Readings, Reply};
pub use request::{PlannedRequest, ReadRequest};

use crate::error::Error;
use crate::station::{JobReply, Outcome, Station, StationJob};
use crate::tag::Tag;

/// The most values in a plan.
pub const MAX_VALUES: usize = 1 << 20;

/// A list of requests that reads a set of tags: see [the module](self).
#[derive(Clone, Debug)]
pub struct Plan {
    tags: Vec<Tag>,
    /// For each tag, where its values begin in `slots`.
    first_slot: Vec<usize>,
    slots: Vec<Slot>,
    requests: Vec<PlannedRequest>,
}

/// Where a value is found: a request, and the first word of it in the reply.
#[derive(Clone, Copy, Debug)]
struct Slot {
    request: u32,
    word: u32,
}

impl Plan {
    /// Begins a plan whose requests cost what the model says.
    #[must_use]
    pub fn builder(cost: CostModel) -> PlanBuilder {
        PlanBuilder::new(cost)
    }

    /// The tags, as they were added.
    #[must_use]
    pub fn tags(&self) -> &[Tag] {
        &self.tags
    }

    /// The requests.
    #[must_use]
    pub fn requests(&self) -> &[PlannedRequest] {
        &self.requests
    }

    /// Which requests, by their place in [`requests`](Self::requests), the values of the tag with this number come from.
    /// None: the plan has no tag with this number.
    pub fn requests_of(&self, tag: usize) -> impl Iterator<Item = usize> + use<> {
        let requests = self.slots(tag).unwrap_or_default().iter().map(|slot| slot.request as usize);
        requests.collect::<BTreeSet<_>>().into_iter()
    }

    /// All bytes, of requests and replies.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.requests.iter().map(PlannedRequest::bytes).sum()
    }

    /// How long it takes, by the cost model.
    #[must_use]
    pub fn time(&self) -> Duration {
        self.requests.iter().fold(Duration::ZERO, |sum, request| sum.saturating_add(request.time))
    }

    /// A table for people: requests, bytes and milliseconds.
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

    /// Sends the requests one after the other, and gives what came back.
    ///
    /// A request that fails does not end it: its tags have the error, the others their values. Several requests are confirmed
    /// by a check at their end, and read again if a duplicate of a reply came between them out of order.
    pub async fn read(&self, station: &Station) -> Readings<'_, Error> {
        let mut job = StationJob::new(station);
        let mut replies: Vec<Result<Words, Error>> = Vec::with_capacity(self.requests.len());
        loop {
            while let Some(planned) = self.requests.get(replies.len()) {
                match planned.request.call_in_job(&mut job, replies.len()).await {
                    Ok(Outcome::Reply(JobReply { reply, .. })) => replies.push(Ok(reply.into())),
                    Ok(Outcome::Rewind(confirmed)) => replies.truncate(confirmed),
                    Err(error @ Error::Duplicates { .. }) => {
                        fail_from(&mut replies, job.first_held(), &error);
                        replies.push(Err(error));
                    }
                    Err(error) => replies.push(Err(error)),
                }
            }
            match job.end().await {
                Ok(None) => return Readings::new(self, replies),
                Ok(Some(confirmed)) => replies.truncate(confirmed),
                Err(error) => {
                    fail_from(&mut replies, job.first_held(), &error);
                    return Readings::new(self, replies);
                }
            }
        }
    }

    /// Gives the replies of the requests, in their order, to the tags: for those who send the requests themselves.
    ///
    /// # Errors
    /// [`PlanError::Reply`] when one is no reply to its request, or there is not one for each.
    pub fn scatter<E>(
        &self,
        replies: impl IntoIterator<Item = Result<Reply, E>>,
    ) -> Result<Readings<'_, E>, PlanError> {
        let mut words = Vec::with_capacity(self.requests.len());
        for (n, reply) in replies.into_iter().enumerate() {
            let planned = self.requests.get(n).ok_or(PlanError::Reply { request: n })?;
            if let Ok(reply) = &reply
                && !reply.answers(&planned.request)
            {
                return Err(PlanError::Reply { request: n });
            }
            words.push(reply.map(readings::Words::from));
        }
        if words.len() < self.requests.len() {
            return Err(PlanError::Reply { request: words.len() });
        }
        Ok(Readings::new(self, words))
    }

    fn slots(&self, tag: usize) -> Option<&[Slot]> {
        let start = *self.first_slot.get(tag)?;
        let end = self.first_slot.get(tag + 1).copied().unwrap_or(self.slots.len());
        self.slots.get(start..end)
    }
}

/// Drops the replies that are not confirmed.
fn fail_from(replies: &mut [Result<Words, Error>], first: Option<usize>, error: &Error) {
    for reply in replies.iter_mut().skip(first.unwrap_or(usize::MAX)) {
        *reply = Err(error.clone());
    }
}

#[cfg(test)]
mod tests;
