use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use super::fallback::PlanInputs;
use super::layout::{Cells, Draft};
use super::solve::{self, Part, Solution};
use super::words::{self, WordAreas};
use super::{CostModel, Limits, MAX_VALUES, Plan, PlanError, PlannedRequest, ValueSlot};
use crate::command::InvalidRequest;
use crate::element::{Symbol, Width};
use crate::tag::Tag;
use crate::wire::Framing;

/// Builder of a [`Plan`]: its tags, limits and costs. See [`Plan::builder`].
#[derive(Clone, Debug)]
pub struct PlanBuilder {
    cost: CostModel,
    limits: Limits,
    /// Limits for tags that no request reads within `limits`.
    wider_limits: Option<Limits>,
    tags: Vec<Tag>,
    /// The indices of the tags of each one-scan group.
    groups: Vec<Range<usize>>,
    /// The plan keeps what it needs to read the values of a refused request by others.
    fallbacks: bool,
}

impl PlanBuilder {
    pub(super) fn new(cost: CostModel) -> Self {
        let (tags, groups) = (Vec::new(), Vec::new());
        Self { cost, limits: Limits::new(), wider_limits: None, tags, groups, fallbacks: true }
    }

    /// Sets the limits of the PLC. Default: the limits of the protocol.
    #[must_use]
    pub fn limits(self, limits: Limits) -> Self {
        Self { limits, wider_limits: None, ..self }
    }

    /// Sets limits that apply in place of the others if no plan is within these: refusals, which pass, make
    /// no plan impossible.
    #[must_use]
    pub(super) fn wider_limits(self, limits: Limits) -> Self {
        Self { wider_limits: Some(limits), ..self }
    }

    /// Makes a plan without fallbacks, for a caller that has its own. It takes less memory.
    #[must_use]
    pub(crate) fn without_fallbacks(self) -> Self {
        Self { fallbacks: false, ..self }
    }

    /// Adds a tag. Tags have indices from 0 in the order in which they are added.
    #[must_use]
    pub fn tag(mut self, tag: impl Into<Tag>) -> Self {
        self.tags.push(tag.into());
        self
    }

    /// Adds several tags.
    #[must_use]
    pub fn tags(mut self, tags: impl IntoIterator<Item = Tag>) -> Self {
        self.tags.extend(tags);
        self
    }

    /// Adds tags that must come from one scan of the PLC: one request reads them.
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
    /// [`PlanError::NotReadable`] and [`PlanError::OneScan`] if the limits exclude a tag or a
    /// group; [`PlanError::TooManyValues`] above [`MAX_VALUES`]; [`PlanError::Request`] if the
    /// framing of the costs does not have the address of an element. [`PlanError::Unassigned`] would be a
    /// defect of the planner.
    pub fn build(mut self) -> Result<Plan, PlanError> {
        let mut solved = self.solve();
        if let (Err(_), Some(wider)) = (&solved, self.wider_limits.take()) {
            self.limits = wider;
            solved = self.solve();
        }
        let (values, parts, Solution { shares, proofs, .. }) = solved?;

        let mut request_of: Vec<Option<u32>> = vec![None; parts.groups.len() + parts.single.len()];
        for (request, (_, parts)) in (0..).zip(&shares) {
            for part in parts {
                request_of[*part] = Some(request);
            }
        }
        let words_before: Vec<Vec<u32>> = shares.iter().map(|(draft, _)| draft.words_before()).collect();
        let mut counts = vec![0; shares.len()];
        let mut word_areas = vec![WordAreas::default(); shares.len()];
        let mut slots = Vec::with_capacity(values.cells.len());
        for (n, (cells, part)) in values.cells.iter().zip(&parts.part_of).enumerate() {
            let found = request_of[*part].and_then(|request| {
                let at = request as usize;
                let (word, bit) = shares[at].0.find(*cells, &words_before[at])?;
                Some(ValueSlot { request, word: u16::try_from(word).ok()?, bit })
            });
            debug_assert!(found.is_some(), "the solver assigned {cells:?} to a request that reads it");
            let slot = found.ok_or_else(|| PlanError::Unassigned { tag: self.tags[values.tag_of(n)] })?;
            let at = slot.request as usize;
            counts[at] += 1;
            if slot.bit.is_some() {
                word_areas[at].insert(cells.area.symbol());
            }
            slots.push(slot);
        }
        let planned = |(((draft, _), values), word_areas): ((&solve::Share, usize), WordAreas)| {
            let (request_bytes, reply_bytes) = draft.bytes(&self.cost);
            let time = Duration::from_nanos(draft.cost(&self.cost));
            Ok(PlannedRequest { request: draft.request()?, values, request_bytes, reply_bytes, time, word_areas })
        };
        let mut requests =
            shares.iter().zip(counts).zip(word_areas).map(planned).collect::<Result<Vec<_>, InvalidRequest>>()?;
        let inputs = (self.fallbacks && requests.iter().any(PlannedRequest::may_have_fallback))
            .then(|| Arc::new(PlanInputs { cost: self.cost, limits: self.limits, groups: self.groups }));
        let (mut tags, mut first_slot) = (self.tags, values.first_slot);
        // A poller keeps thousands of plans.
        requests.shrink_to_fit();
        tags.shrink_to_fit();
        first_slot.shrink_to_fit();
        let proof_time = Duration::from_nanos(proofs);
        Ok(Plan { tags, first_slot, slots, requests, proof_time, inputs })
    }

    /// Distributes the values among requests: with words of discretes if that is cheaper.
    fn solve(&self) -> Result<(Values, Parts, Solution), PlanError> {
        let values = Values::of(&self.tags, &self.limits, self.cost.framing())?;
        let (parts, solution) = self.solve_values(&values)?;
        Ok((values, parts, solution))
    }

    fn solve_values(&self, values: &Values) -> Result<(Parts, Solution), PlanError> {
        let solved = |builder: &Self| {
            let parts = builder.parts(values)?;
            let solution = solve::solve(&parts.groups, &parts.single, &builder.limits, &self.cost);
            Ok::<_, PlanError>((parts, solution))
        };
        let with_words = solved(self)?;
        let (parts, solution) = &with_words;
        // For few parts, the solver compares all plans; in the binary framing some are ambiguous.
        let is_exact = parts.groups.len() + parts.single.len() <= solve::MAX_EXACT_PARTS;
        let is_best = solution.shares.len() == 1 || is_exact && self.cost.framing() == Framing::Ascii;
        if is_best || !values.cells.iter().any(|cells| words::has_words(cells, &self.limits)) {
            return Ok(with_words);
        }
        let limits = self.limits.clone().words_of_discretes(false);
        let builder = Self { limits, ..self.clone() };
        // Mostly the bound shows that no plan without words is cheaper, at a fraction of the time.
        let costs_more = |parts: &Parts| {
            parts.groups.is_empty() && solve::least_cost(&parts.single, &builder.limits, &self.cost) >= solution.price()
        };
        if builder.parts(values).is_ok_and(|parts| costs_more(&parts)) {
            return Ok(with_words);
        }
        // A group may fit in a request by words only.
        let Ok(without_words) = solved(&builder) else { return Ok(with_words) };
        Ok(if without_words.1.price() < solution.price() { without_words } else { with_words })
    }

    /// Divides the values into parts, each of which must come from one request.
    fn parts(&self, values: &Values) -> Result<Parts, PlanError> {
        let mut part_of: Vec<usize> = vec![0; values.cells.len()];
        let mut plain: Vec<bool> = vec![true; values.cells.len()];
        let mut groups: Vec<Part> = Vec::with_capacity(self.groups.len());
        let mut seen: HashMap<Part, usize> = HashMap::new();
        for tags in self.groups.iter().cloned().chain(self.long_texts(values)) {
            let slots = values.slots(&tags);
            let mut part = values.cells[slots.clone()].to_vec();
            part.sort_unstable_by_key(|cells| cells.key());
            part.dedup_by(|next, kept| kept.contains(*next));
            if Draft::cheapest(&part, &self.limits, &self.cost).is_none() {
                return Err(PlanError::OneScan {
                    first: self.tags[tags.start],
                    tags: tags.len(),
                    units: words::fewest_units(&part, &self.limits, &self.cost) as usize,
                    max: self.limits.mixed_units() as usize,
                });
            }
            let n = *seen.entry(part.clone()).or_insert(groups.len());
            if n == groups.len() {
                groups.push(part);
            }
            part_of[slots.clone()].fill(n);
            plain[slots].fill(false);
        }

        // All values, also those of groups, to find the single values that lie within a group.
        let mut sorted: Vec<(Cells, bool, usize)> =
            values.cells.iter().zip(&plain).enumerate().map(|(n, (cells, plain))| (*cells, *plain, n)).collect();
        sorted.sort_unstable_by_key(|(cells, plain, n)| (cells.key(), *plain, *n));
        let in_words = self.words(values);
        let mut single: Vec<Cells> = Vec::with_capacity(sorted.len());
        // Sorted by first cell: if an earlier part contains the next value, the one with the
        // last end does.
        let mut farthest: Option<(Cells, usize)> = None;
        // Words come behind discretes, so the number of a word that is a part of its own is not yet
        // known.
        let mut bits_of_words: Vec<(usize, usize)> = Vec::new();
        for (cells, plain, n) in sorted {
            let container = farthest.filter(|(other, _)| other.contains(cells));
            if plain {
                if container.is_none()
                    && let Some(word) = in_words.find(cells)
                {
                    bits_of_words.push((n, word));
                    continue;
                }
                part_of[n] = container.map_or(groups.len() + single.len(), |(_, part)| part);
                if container.is_none() {
                    single.push(cells);
                }
            }
            if container.is_none() {
                farthest = Some((cells, part_of[n]));
            }
        }
        for (n, word) in bits_of_words {
            part_of[n] = part_of[word];
        }
        Ok(Parts { groups, single, part_of })
    }

    /// Returns the values that are words of discretes, which may be read with them.
    fn words(&self, values: &Values) -> TagWords {
        let mut words = TagWords::default();
        for (n, cells) in values.cells.iter().enumerate() {
            if cells.area.discrete().is_some_and(|discrete| self.limits.has_words_of(discrete)) {
                words.by_address.extend(cells.addresses().map(|address| ((cells.area.symbol(), address), n)));
            }
        }
        words
    }

    /// Texts outside of groups that are longer than a run, and so need a mixed read.
    fn long_texts<'a>(&'a self, values: &'a Values) -> impl Iterator<Item = Range<usize>> + 'a {
        let mut groups = self.groups.iter().peekable();
        (0..self.tags.len()).map(|n| n..n + 1).filter(move |tag| {
            while groups.next_if(|group| group.end <= tag.start).is_some() {}
            let is_in_group = groups.peek().is_some_and(|group| group.start <= tag.start);
            let too_long = |cells: &Cells| cells.len > cells.area.max_run(&self.limits);
            !is_in_group && values.cells[values.slots(tag)].first().is_some_and(too_long)
        })
    }
}

/// The values of the tags as cells, in the order of the tags.
struct Values {
    cells: Vec<Cells>,
    /// For each tag, the index of its first value.
    first_slot: Vec<usize>,
}

/// The values that have words of discretes.
#[derive(Default)]
struct TagWords {
    /// By symbol and address of the word, the number of a value with it.
    by_address: HashMap<(Symbol, u16), usize>,
}

impl TagWords {
    /// Returns the number of a value whose words contain this discrete.
    fn find(&self, cells: Cells) -> Option<usize> {
        if self.by_address.is_empty() || cells.area.width() != Width::Bit {
            return None;
        }
        let address = cells.addresses().next()?;
        let symbol = cells.area.symbol().area().word();
        let word = |residue| self.by_address.get(&(symbol, words::word_address(address, residue)?)).copied();
        word(0).or_else(|| word(8))
    }
}

/// Groups and single values, each of which must come from one request.
struct Parts {
    groups: Vec<Part>,
    /// Sorted and distinct. None lies within another part or is longer than a run.
    single: Vec<Cells>,
    /// For each value, the index of its part; those of groups come first.
    part_of: Vec<usize>,
}

impl Values {
    fn of(tags: &[Tag], limits: &Limits, framing: Framing) -> Result<Self, PlanError> {
        let total = tags.iter().map(Tag::value_count).fold(0, usize::saturating_add);
        if total > MAX_VALUES {
            return Err(PlanError::TooManyValues { max: MAX_VALUES });
        }
        let mut values = Self { cells: Vec::with_capacity(total), first_slot: Vec::with_capacity(tags.len()) };
        for tag in tags {
            tag.check_in(framing).map_err(InvalidRequest::from)?;
            values.first_slot.push(values.cells.len());
            let count = tag.elements_per_value();
            for first in tag.elements().step_by(count) {
                let missing = || {
                    let mut elements = (0..count).filter_map(|n| first.nth(n).ok());
                    let element = elements.find(|element| Cells::of(*element, 1, limits).is_none()).unwrap_or(first);
                    PlanError::NotReadable { tag: *tag, element }
                };
                values.cells.push(Cells::of(first, count, limits).ok_or_else(missing)?);
            }
        }
        Ok(values)
    }

    /// Returns the index of the tag of a value.
    fn tag_of(&self, value: usize) -> usize {
        self.first_slot.partition_point(|first| *first <= value).saturating_sub(1)
    }

    fn slots(&self, tags: &Range<usize>) -> Range<usize> {
        self.first_slot[tags.start]..self.first_slot.get(tags.end).copied().unwrap_or(self.cells.len())
    }
}
