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
//! - Each value comes from one request, so from one scan: the two halves of an `R100:f32` never come from two.
//!   Different values of one tag (`R0-R99`) may come from different scans, unless [`PlanBuilder::one_scan`] asks for
//!   more; then they are in one request, or the plan is refused.
//! - No element is asked for that the [`Limits`] exclude, also not in a gap between two tags.
//! - No list is asked for that has two readings in the binary framing.
//!
//! # The plans that are looked at
//!
//! What is needed is a set of *parts*: the values of the tags, each one cell or two, and the groups that must come from
//! one scan. (A cell is a discrete, a word of discretes, or a 16-bit register; `DR0` is the cells `R0` and `R1`.) Equal
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
//! Up to ten parts, the plan is the cheapest of all ways to share them out. Above that:
//!
//! - Without mixed reads and without groups, it is still the cheapest: a dynamic program over the sorted values finds
//!   where runs begin and end.
//! - With mixed reads, the same program decides between run and mixed read for each value, for several prices of a
//!   place in a mixed request. If what is left over at the price 0 fits into one mixed request, the result is still the
//!   cheapest; else what is lost is about the unused part of the last mixed request.
//! - Groups are placed first, each at its own best, and values fill what room they leave. This is a heuristic.
//!
//! The time it takes is that of sorting the values, n log n; the rest is linear.

mod cost;
mod layout;
mod limits;
mod parts;
mod readings;
mod solve;

use std::fmt;
use std::time::Duration;

pub use cost::CostModel;
pub use limits::Limits;
pub(crate) use readings::Words;
pub use readings::{Readings, Reply};

use self::layout::{Cells, Draft};
use crate::command::{Command, InvalidRequest, ReadDiscretes, ReadMixed, ReadRegisters};
use crate::element::{Element, Register, Register32};
use crate::error::Error;
use crate::station::Station;
use crate::tag::Tag;
use crate::wire::Framing;

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

/// One request of a [`Plan`], and what it costs.
#[derive(Clone, Debug)]
pub struct PlannedRequest {
    request: ReadRequest,
    values: usize,
    request_bytes: usize,
    reply_bytes: usize,
    time: Duration,
}

/// A request that reads elements.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ReadRequest {
    /// 44: a run of discretes.
    Discretes(ReadDiscretes),
    /// 46: a run of 16-bit registers.
    Registers(ReadRegisters<Register>),
    /// 46: a run of 32-bit registers.
    Registers32(ReadRegisters<Register32>),
    /// 48: elements of any kind.
    Mixed(ReadMixed),
}

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A limit of the device that makes no sense.
    #[error("{name} is {given}, and it can be {min} to {max}")]
    #[non_exhaustive]
    Limit {
        /// Which limit.
        name: &'static str,
        /// What was given.
        given: usize,
        /// The least it can be.
        min: usize,
        /// The most it can be.
        max: usize,
    },
    /// A readable range that is none.
    #[error("{first} to {last} is no range: both ends must be of one symbol of 1 or 16 bits, the lower one first")]
    #[non_exhaustive]
    Range {
        /// The first element given.
        first: Element,
        /// The last element given.
        last: Element,
    },
    /// A tag outside the ranges that the device can read.
    #[error("{element} of the tag {tag} is not in a readable range of the device, or only in part")]
    #[non_exhaustive]
    NotReadable {
        /// The tag.
        tag: Tag,
        /// The first of its elements that cannot be read.
        element: Element,
    },
    /// Tags that must come from one scan, and are more than one request holds.
    #[error(
        "{tags} tags from {first} on must come from one scan, but no single request of the device holds them: they need \
         {units} units and one mixed read takes at most {max} of them, and as one run they are too long, of several \
         kinds, or reach across what cannot be read"
    )]
    #[non_exhaustive]
    OneScan {
        /// The first of the tags.
        first: Tag,
        /// How many they are.
        tags: usize,
        /// How many units they count, where 32 bits count two.
        units: usize,
        /// The most that one mixed read takes; 0 if there are none.
        max: usize,
    },
    /// More values than a plan holds.
    #[error("the tags have more than {max} values")]
    #[non_exhaustive]
    TooManyValues {
        /// The most a plan holds.
        max: usize,
    },
    /// A reply that does not belong to its request: another kind of value, or another number of them, or none at all.
    #[error("what was given for request {request} of the plan is no reply to it")]
    #[non_exhaustive]
    Reply {
        /// Which request, from 0.
        request: usize,
    },
    /// A request that breaks a rule of the protocol.
    #[error(transparent)]
    Request(#[from] InvalidRequest),
}

/// What a plan is made from: see [`Plan::builder`].
#[derive(Clone, Debug)]
pub struct PlanBuilder {
    cost: CostModel,
    limits: Limits,
    tags: Vec<Tag>,
    /// The tags of each group, by their place in `tags`.
    groups: Vec<std::ops::Range<usize>>,
}

impl PlanBuilder {
    /// What the device takes. Without this, it is what the protocol has.
    #[must_use]
    pub fn limits(self, limits: Limits) -> Self {
        Self { limits, ..self }
    }

    /// Adds a tag. Tags are numbered as they are added, from 0.
    #[must_use]
    pub fn tag(mut self, tag: impl Into<Tag>) -> Self {
        self.tags.push(tag.into());
        self
    }

    /// Adds tags, one after the other.
    #[must_use]
    pub fn tags(mut self, tags: impl IntoIterator<Item = Tag>) -> Self {
        self.tags.extend(tags);
        self
    }

    /// Adds tags that must come from one scan of the PLC, so from one request.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::plan::{CostModel, Plan};
    /// use fatek::wire::Framing;
    ///
    /// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    /// let tags = |tags: [&str; 2]| tags.map(|tag| tag.parse().unwrap());
    /// assert_eq!(Plan::builder(network).one_scan(tags(["R0", "M5"])).build()?.requests().len(), 1);
    /// assert!(Plan::builder(network).one_scan(tags(["R0-R63", "M5"])).build().is_err()); // 65 units
    /// # Ok::<(), fatek::plan::PlanError>(())
    /// ```
    #[must_use]
    pub fn one_scan(mut self, tags: impl IntoIterator<Item = Tag>) -> Self {
        let start = self.tags.len();
        self.tags.extend(tags);
        if self.tags.len() > start {
            self.groups.push(start..self.tags.len());
        }
        self
    }

    /// Makes the plan.
    ///
    /// # Errors
    /// [`PlanError::NotReadable`] and [`PlanError::OneScan`] where the device's limits do not allow it;
    /// [`PlanError::TooManyValues`] above [`MAX_VALUES`].
    pub fn build(self) -> Result<Plan, PlanError> {
        let Self { cost, limits, tags, groups } = self;
        let total = tags.iter().map(Tag::value_count).fold(0, usize::saturating_add);
        if total > MAX_VALUES {
            return Err(PlanError::TooManyValues { max: MAX_VALUES });
        }
        let mut values: Vec<Cells> = Vec::with_capacity(total);
        let mut first_slot = Vec::with_capacity(tags.len());
        for tag in &tags {
            first_slot.push(values.len());
            for first in tag.elements().step_by(tag.elements_per_value()) {
                let cells = Cells::of(first, tag.elements_per_value(), &limits);
                values.push(cells.ok_or(PlanError::NotReadable { tag: *tag, element: first })?);
            }
        }
        let slots_of = |tags: &std::ops::Range<usize>| {
            first_slot[tags.start]..first_slot.get(tags.end).copied().unwrap_or(values.len())
        };

        // The parts, and for each value the part that it is read with.
        let mut part_of: Vec<usize> = vec![0; values.len()];
        let mut parts: Vec<solve::Part> = Vec::with_capacity(groups.len());
        let mut plain: Vec<bool> = vec![true; values.len()];
        for (n, group) in groups.iter().enumerate() {
            let slots = slots_of(group);
            let mut part = values[slots.clone()].to_vec();
            part.sort_unstable_by_key(|cells| cells.key());
            part.dedup_by(|next, kept| kept.hold(*next));
            part_of[slots.clone()].fill(n);
            plain[slots].fill(false);
            if Draft::cheapest(&part, &limits, &cost).is_none() {
                return Err(PlanError::OneScan {
                    first: tags[group.start],
                    tags: group.len(),
                    units: part.iter().map(|cells| (cells.len * cells.area.units()) as usize).sum(),
                    max: limits.mixed_units() as usize,
                });
            }
            parts.push(part);
        }
        // Values that are not in a group, those of groups among them to find what lies in one.
        let mut sorted: Vec<(Cells, bool, usize)> = (0..values.len()).map(|n| (values[n], plain[n], n)).collect();
        sorted.sort_unstable_by_key(|(cells, plain, n)| (cells.key(), *plain, *n));
        let mut single: Vec<Cells> = Vec::with_capacity(sorted.len());
        // Values have one or two cells: the last of two cells, and the last at all, are the only ones to hold the next.
        let mut last: [Option<(Cells, usize)>; 2] = [None, None];
        for (cells, plain, n) in sorted {
            if plain {
                match last.iter().flatten().find(|(other, _)| other.hold(cells)) {
                    Some((_, part)) => {
                        part_of[n] = *part;
                        continue;
                    }
                    None => {
                        part_of[n] = parts.len() + single.len();
                        single.push(cells);
                    }
                }
            }
            last[usize::from(cells.len == 1)] = Some((cells, part_of[n]));
        }

        let shares = solve::solve(&parts, &single, &limits, &cost);
        let mut request_of = vec![0_u32; parts.len() + single.len()];
        for (request, (_, parts)) in (0..).zip(&shares) {
            for part in parts {
                request_of[*part] = request;
            }
        }
        let words_before: Vec<Vec<u32>> = shares.iter().map(|(draft, _)| draft.words_before()).collect();
        let mut counts = vec![0; shares.len()];
        let mut slots = Vec::with_capacity(values.len());
        for (cells, part) in values.iter().zip(&part_of) {
            let request = request_of[*part];
            let at = request as usize;
            counts[at] += 1;
            let word = shares[at].0.find(*cells, &words_before[at]);
            debug_assert!(word.is_some(), "the solver says that this request reads this value");
            slots.push(Slot { request, word: word.unwrap_or(u32::MAX) });
        }
        let planned = |((draft, _), values): (&solve::Share, usize)| {
            let (request_bytes, reply_bytes) = draft.bytes(&cost);
            let time = Duration::from_nanos(draft.cost(&cost));
            Ok(PlannedRequest { request: draft.request()?, values, request_bytes, reply_bytes, time })
        };
        let requests = shares.iter().zip(counts).map(planned).collect::<Result<Vec<_>, InvalidRequest>>()?;
        Ok(Plan { tags, first_slot, slots, requests })
    }
}

impl Plan {
    /// Begins a plan whose requests cost what the model says.
    #[must_use]
    pub fn builder(cost: CostModel) -> PlanBuilder {
        PlanBuilder { cost, limits: Limits::new(), tags: Vec::new(), groups: Vec::new() }
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
    /// A request that fails does not end it: its tags have the error, the others their values.
    pub async fn read(&self, station: &Station) -> Readings<'_, Error> {
        let mut replies = Vec::with_capacity(self.requests.len());
        for planned in &self.requests {
            replies.push(planned.request.call(station).await.map(readings::Words::from));
        }
        Readings::new(self, replies)
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

impl PlannedRequest {
    /// What is sent.
    #[must_use]
    pub fn request(&self) -> &ReadRequest {
        &self.request
    }

    /// How many values of tags come from it.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.values
    }

    /// The bytes of the request and of its reply.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.request_bytes + self.reply_bytes
    }

    /// How long it takes, by the cost model.
    #[must_use]
    pub fn time(&self) -> Duration {
        self.time
    }
}

impl ReadRequest {
    /// Sends it.
    ///
    /// # Errors
    /// As for every method of [`Station`].
    pub async fn call(&self, station: &Station) -> Result<Reply, Error> {
        Ok(match self {
            Self::Discretes(request) => Reply::Bits(station.call(*request).await?),
            Self::Registers(request) => Reply::Words(station.call(*request).await?),
            Self::Registers32(request) => Reply::Doubles(station.call(*request).await?),
            Self::Mixed(request) => Reply::Mixed(station.call(request.clone()).await?),
        })
    }

    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        match self {
            Self::Discretes(request) => request.check(framing),
            Self::Registers(request) => request.check(framing),
            Self::Registers32(request) => request.check(framing),
            Self::Mixed(request) => request.check(framing),
        }
    }
}

impl fmt::Display for ReadRequest {
    /// The code and the elements: `46 R0-R9`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let run = |f: &mut fmt::Formatter<'_>, code, first: Element, count: usize| {
            write!(f, "{code} {first}")?;
            match first.nth(count.saturating_sub(1)) {
                Ok(last) if last != first => write!(f, "-{last}"),
                _ => Ok(()),
            }
        };
        match self {
            Self::Discretes(request) => run(f, 44, request.first().into(), request.count()),
            Self::Registers(request) => run(f, 46, request.first().into(), request.count()),
            Self::Registers32(request) => run(f, 46, request.first().into(), request.count()),
            Self::Mixed(request) => {
                f.write_str("48")?;
                request.elements().iter().try_for_each(|element| write!(f, " {element}"))
            }
        }
    }
}

/// A plan as a table: see [`Plan::explain`].
#[derive(Clone, Copy, Debug)]
pub struct Explanation<'p> {
    plan: &'p Plan,
}

impl fmt::Display for Explanation<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let milliseconds = |time: Duration| format!("{:.3}", time.as_secs_f64() * 1e3);
        let plan = self.plan;
        writeln!(f, "{:>7}  {:>6}  {:>6}  {:>10}  reads", "request", "values", "bytes", "ms")?;
        for (n, planned) in plan.requests.iter().enumerate() {
            let (values, bytes, time) = (planned.values, planned.bytes(), milliseconds(planned.time));
            writeln!(f, "{:>7}  {values:>6}  {bytes:>6}  {time:>10}  {}", n + 1, planned.request)?;
        }
        let (values, bytes, time) = (plan.slots.len(), plan.bytes(), milliseconds(plan.time()));
        write!(f, "{:>7}  {values:>6}  {bytes:>6}  {time:>10}  {} requests", "total", plan.requests.len())
    }
}

#[cfg(test)]
mod tests;
