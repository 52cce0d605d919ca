//! Limits learned from refusals: requests that a PLC refuses although it accepts both halves.

use tokio::time::Instant;

use crate::capabilities::{LEARNED_LIFETIME, Refused};
use crate::element::{Element, Width};
use crate::plan::{Limits, ReadRequest, WordAreas};

/// A restriction of future requests.
///
/// Invariant: it excludes the very request it was learned from, so no refusal repeats for ever.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LearnedLimit {
    /// No run reads through these elements, which have no tag on them.
    Avoid { first: Element, count: usize },
    /// No run reads this element together with the one before it.
    Split { before: Element },
    /// The most registers of a run.
    Registers(usize),
    /// The most discretes of a run.
    Points(usize),
    /// The most units of a mixed read; 0: no mixed reads.
    Mixed(usize),
    /// The discretes of these areas are not read as words.
    NoWords(WordAreas),
}

/// The position between the halves of a request, in words of its reply.
#[derive(Clone, Copy, Debug)]
pub(super) struct SplitPoint {
    /// The end of the left half.
    pub(super) left_end: usize,
    pub(super) right_start: usize,
    /// The number of words of the right half.
    pub(super) right_len: usize,
}

/// The learned limits of one PLC.
#[derive(Debug, Default)]
pub(super) struct LearnedLimits {
    /// Each limit once, with the time when it was learned last.
    limits: Vec<(LearnedLimit, Instant)>,
    accepted: LongestAccepted,
    /// Learned since the last [`take_new`](Self::take_new), without limits that apply to a place, or to the
    /// tags of this poller: what other users of the station may take from it.
    new: Vec<Refused>,
}

/// The longest accepted request of each kind. No limit below it is learned.
#[derive(Clone, Copy, Debug, Default)]
struct LongestAccepted {
    registers: usize,
    points: usize,
    mixed: usize,
    /// The areas of discretes of which a word was accepted.
    words: WordAreas,
}

impl LearnedLimit {
    /// The capability that the station lacks; `None` for a place.
    fn as_refused(self, accepted: LongestAccepted) -> Option<Refused> {
        match self {
            Self::Registers(max) => Some(Refused::Registers(max)),
            Self::Points(max) => Some(Refused::Points(max)),
            // The command is known if one of these was accepted: the refusal is one of the elements.
            Self::Mixed(0) => (accepted.mixed == 0).then_some(Refused::MixedReads),
            Self::Mixed(max) => Some(Refused::Mixed(max)),
            Self::NoWords(areas) => Some(Refused::Words(areas)),
            Self::Avoid { .. } | Self::Split { .. } => None,
        }
    }
}

impl LearnedLimits {
    pub(super) fn is_empty(&self) -> bool {
        self.limits.is_empty()
    }

    /// Records that the PLC accepted a request, with words of the discretes of these areas.
    pub(super) fn record_accepted(&mut self, request: &ReadRequest, word_areas: WordAreas) {
        self.accepted.words = self.accepted.words.and(word_areas);
        let (kind, units) = match request {
            ReadRequest::Discretes(request) => (&mut self.accepted.points, request.count()),
            ReadRequest::Registers(request) => (&mut self.accepted.registers, request.count()),
            ReadRequest::Registers32(request) => (&mut self.accepted.registers, request.count().saturating_mul(2)),
            ReadRequest::Mixed(request) => (&mut self.accepted.mixed, mixed_units(request.elements())),
        };
        *kind = units.max(*kind);
    }

    /// Returns the limit that explains why `request` is refused although its halves are accepted.
    ///
    /// `None` if one of the halves is the whole request.
    pub(super) fn explanation(&self, request: &ReadRequest, split_point: SplitPoint) -> Option<LearnedLimit> {
        let SplitPoint { left_end, right_start, right_len } = split_point;
        let longer_half = left_end.max(right_len);
        let (units, accepted, limit): (usize, usize, fn(usize) -> LearnedLimit) = match request {
            ReadRequest::Discretes(request) => (request.count(), self.accepted.points, LearnedLimit::Points),
            ReadRequest::Registers(request) => (request.count(), self.accepted.registers, LearnedLimit::Registers),
            ReadRequest::Registers32(request) => {
                (request.count().saturating_mul(2), self.accepted.registers, LearnedLimit::Registers)
            }
            ReadRequest::Mixed(request) => {
                let units = mixed_units(request.elements());
                let max = longer_half.max(self.accepted.mixed);
                // A mixed read of one element has no advantage over a run of one.
                return Some(LearnedLimit::Mixed(if max < units && max > 1 { max } else { 0 }));
            }
        };
        let (first, words_per_element) = request.run()?;
        let element = |word: usize| first.nth(word.checked_div(words_per_element)?).ok();
        if let Some(gap) = right_start.checked_sub(left_end).filter(|gap| *gap > 0) {
            return Some(LearnedLimit::Avoid { first: element(left_end)?, count: gap.div_ceil(words_per_element) });
        }
        let max = longer_half.max(accepted);
        if longer_half >= units || right_start == 0 {
            None
        } else if max < units && max >= 2 {
            Some(limit(max))
        } else {
            // A request of this length was accepted before: the cause is the place, not the length.
            Some(LearnedLimit::Split { before: element(right_start)? })
        }
    }

    /// Returns whether a request may be refused because of its words of the discretes of these areas,
    /// rather than for its length or one of its elements.
    pub(super) fn may_lack_words(&self, request: &ReadRequest, areas: WordAreas) -> bool {
        !areas.is_empty() && (!self.accepted.words.contains_all(areas) || reads_one_element(request))
    }

    /// Returns the limit that explains why `request` is refused although its tags are accepted without
    /// words of the discretes of these areas.
    pub(super) fn words_explanation(&self, request: &ReadRequest, areas: WordAreas) -> LearnedLimit {
        let unknown = areas.without(self.accepted.words);
        if !unknown.is_empty() {
            return LearnedLimit::NoWords(unknown);
        }
        // A second word of an area shows that the PLC does not accept its words any more.
        let is_second = |known: &(LearnedLimit, Instant)| match known.0 {
            LearnedLimit::Avoid { first, .. } => {
                first.width() != Width::Bit && areas.contains(first.symbol().area().smallest())
            }
            LearnedLimit::Split { .. }
            | LearnedLimit::Registers(_)
            | LearnedLimit::Points(_)
            | LearnedLimit::Mixed(_)
            | LearnedLimit::NoWords(_) => false,
        };
        match request.run() {
            Some((first, _)) if reads_one_element(request) && !self.limits.iter().any(is_second) => {
                LearnedLimit::Avoid { first, count: 1 }
            }
            Some(_) | None => LearnedLimit::NoWords(areas),
        }
    }

    /// The areas whose discretes are not read as words.
    pub(super) fn no_words(&self) -> WordAreas {
        self.limits.iter().fold(WordAreas::default(), |areas, (limit, _)| match limit {
            LearnedLimit::NoWords(more) => areas.and(*more),
            LearnedLimit::Avoid { .. }
            | LearnedLimit::Split { .. }
            | LearnedLimit::Registers(_)
            | LearnedLimit::Points(_)
            | LearnedLimit::Mixed(_) => areas,
        })
    }

    pub(super) fn learn(&mut self, limit: LearnedLimit, now: Instant) {
        if let LearnedLimit::NoWords(areas) = limit {
            self.accepted.words = self.accepted.words.without(areas);
        }
        self.new.extend(limit.as_refused(self.accepted));
        self.limits.retain(|(known, _)| *known != limit);
        self.limits.push((limit, now));
    }

    /// Returns what was learned since the last time.
    pub(super) fn take_new(&mut self) -> Vec<Refused> {
        std::mem::take(&mut self.new)
    }

    /// Drops limits that have reached [`LEARNED_LIFETIME`]. Returns whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.limits.len();
        self.limits.retain(|(_, learned)| now.saturating_duration_since(*learned) < LEARNED_LIFETIME);
        self.limits.len() < before
    }

    /// Returns `limits` restricted by the learned ones.
    pub(super) fn apply(&self, limits: &Limits) -> Limits {
        let (mut registers, mut points, mut mixed) = (usize::MAX, usize::MAX, usize::MAX);
        let (mut avoided, mut splits) = (Vec::new(), Vec::new());
        for (limit, _) in &self.limits {
            match *limit {
                LearnedLimit::Avoid { first, count } => avoided.push((first, count)),
                LearnedLimit::Split { before } => splits.push(before),
                LearnedLimit::Registers(max) => registers = registers.min(max),
                LearnedLimit::Points(max) => points = points.min(max),
                LearnedLimit::Mixed(max) => mixed = mixed.min(max),
                LearnedLimit::NoWords(_) => {}
            }
        }
        let limits = limits.clone().without_words(self.no_words());
        limits.at_most(registers, points, mixed).avoid_all(avoided).split_before(splits)
    }
}

/// Returns whether a request reads one element.
fn reads_one_element(request: &ReadRequest) -> bool {
    match request {
        ReadRequest::Discretes(request) => request.count() == 1,
        ReadRequest::Registers(request) => request.count() == 1,
        ReadRequest::Registers32(request) => request.count() == 1,
        ReadRequest::Mixed(request) => request.elements().len() == 1,
    }
}

/// The units of elements in a mixed read, where 32 bits count two.
fn mixed_units(elements: &[Element]) -> usize {
    elements.iter().map(|element| element.width().units()).fold(0, usize::saturating_add)
}
