//! What refusals teach: requests that a PLC does not take though it takes their halves.

use std::time::Duration;

use tokio::time::Instant;

use crate::element::Element;
use crate::plan::{Limits, ReadRequest};

/// How long a lesson is heeded. Then the request is tried again: it may have been refused for a reason that has passed.
const HEEDED: Duration = Duration::from_secs(600);

/// What not to ask for any more. Each forbids the very request that it was learned from, so that no request is refused
/// for ever.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lesson {
    /// These elements were in a run, and no tag is on them.
    Avoid { first: Element, count: usize },
    /// What is before this element is not read in one run with it.
    Split { before: Element },
    /// So many registers were taken, and more never were.
    Registers(usize),
    /// So many points were taken, and more never were.
    Points(usize),
    /// So many units were taken in a mixed read, and more never were. 0: none are.
    Mixed(usize),
}

/// Where the halves of a request meet, in words of its reply.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seam {
    pub(super) left_end: usize,
    pub(super) right_start: usize,
    /// How many words the right one has.
    pub(super) right: usize,
}

/// The lessons of one PLC.
#[derive(Debug, Default)]
pub(super) struct Lessons {
    heeded: Vec<(Lesson, Instant)>,
    longest: Longest,
}

/// The longest requests of each kind that have been answered: no limit is learned below them.
#[derive(Clone, Copy, Debug, Default)]
struct Longest {
    registers: usize,
    points: usize,
    mixed: usize,
}

impl Lessons {
    /// Whether there is none to heed.
    pub(super) fn is_empty(&self) -> bool {
        self.heeded.is_empty()
    }

    /// A request was answered.
    pub(super) fn answered(&mut self, request: &ReadRequest) {
        let (kind, units) = match request {
            ReadRequest::Discretes(request) => (&mut self.longest.points, request.count()),
            ReadRequest::Registers(request) => (&mut self.longest.registers, request.count()),
            ReadRequest::Registers32(request) => (&mut self.longest.registers, request.count().saturating_mul(2)),
            ReadRequest::Mixed(request) => (&mut self.longest.mixed, mixed_units(request.elements())),
        };
        *kind = units.max(*kind);
    }

    /// What there is to learn if `request` is refused and its halves are not; `None`: nothing, for one of the halves is the
    /// whole request.
    pub(super) fn of(&self, request: &ReadRequest, seam: Seam) -> Option<Lesson> {
        let Seam { left_end, right_start, right } = seam;
        let longer = left_end.max(right);
        let (units, longest, limit): (usize, usize, fn(usize) -> Lesson) = match request {
            ReadRequest::Discretes(request) => (request.count(), self.longest.points, Lesson::Points),
            ReadRequest::Registers(request) => (request.count(), self.longest.registers, Lesson::Registers),
            ReadRequest::Registers32(request) => {
                (request.count().saturating_mul(2), self.longest.registers, Lesson::Registers)
            }
            ReadRequest::Mixed(request) => {
                let units = mixed_units(request.elements());
                let most = longer.max(self.longest.mixed);
                // One element in a mixed read is no better than a run of one.
                return Some(Lesson::Mixed(if most < units && most > 1 { most } else { 0 }));
            }
        };
        let (first, words) = request.run()?;
        let element = |word: usize| first.nth(word.checked_div(words)?).ok();
        if let Some(gap) = right_start.checked_sub(left_end).filter(|gap| *gap > 0) {
            return Some(Lesson::Avoid { first: element(left_end)?, count: gap.div_ceil(words) });
        }
        let most = longer.max(longest);
        if longer >= units || right_start == 0 {
            None
        } else if most < units && most >= 2 {
            Some(limit(most))
        } else {
            // It is not the length.
            Some(Lesson::Split { before: element(right_start)? })
        }
    }

    pub(super) fn learn(&mut self, lesson: Lesson, now: Instant) {
        self.heeded.retain(|(known, _)| *known != lesson);
        self.heeded.push((lesson, now));
    }

    /// Forgets what was learned long ago; says whether there was any.
    pub(super) fn forget(&mut self, now: Instant) -> bool {
        let before = self.heeded.len();
        self.heeded.retain(|(_, learned)| now.saturating_duration_since(*learned) < HEEDED);
        self.heeded.len() < before
    }

    /// The limits, with what was learned.
    pub(super) fn apply(&self, limits: &Limits) -> Limits {
        let (mut registers, mut points, mut mixed) = (usize::MAX, usize::MAX, usize::MAX);
        let (mut avoided, mut splits) = (Vec::new(), Vec::new());
        for (lesson, _) in &self.heeded {
            match *lesson {
                Lesson::Avoid { first, count } => avoided.push((first, count)),
                Lesson::Split { before } => splits.push(before),
                Lesson::Registers(most) => registers = registers.min(most),
                Lesson::Points(most) => points = points.min(most),
                Lesson::Mixed(most) => mixed = mixed.min(most),
            }
        }
        limits.clone().at_most(registers, points, mixed).avoid_all(avoided).split_before(splits)
    }
}

/// What elements count in a mixed read: 32 bits count two.
fn mixed_units(elements: &[Element]) -> usize {
    elements.iter().map(|element| element.width().units()).fold(0, usize::saturating_add)
}
