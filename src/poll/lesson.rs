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
    /// So many registers were taken, and more were not.
    Registers(usize),
    /// So many points were taken, and more were not.
    Points(usize),
    /// So many units were taken in a mixed read, and more were not. 0: none are.
    Mixed(usize),
}

impl Lesson {
    /// What there is to learn if `request` is refused and its halves are not: the left one ends before the word `left_end`
    /// of the reply, the right one, of `right` words, begins with `right_start`.
    ///
    /// `None`: nothing, for one of the halves is the whole request.
    pub(super) fn of(request: &ReadRequest, left_end: usize, right_start: usize, right: usize) -> Option<Self> {
        let longer = left_end.max(right);
        let shorter = |whole: usize| longer < whole;
        if let Some((first, words)) = request.run()
            && let Some(gap) = right_start.checked_sub(left_end).filter(|gap| *gap > 0)
        {
            let first = first.nth(left_end.checked_div(words)?).ok()?;
            return Some(Self::Avoid { first, count: gap.div_ceil(words) });
        }
        match request {
            ReadRequest::Discretes(request) => shorter(request.count()).then_some(Self::Points(longer)),
            ReadRequest::Registers(request) => shorter(request.count()).then_some(Self::Registers(longer)),
            ReadRequest::Registers32(request) => {
                shorter(request.count().saturating_mul(2)).then_some(Self::Registers(longer))
            }
            // One element in a mixed read is no better than a run of one.
            ReadRequest::Mixed(_) => Some(Self::Mixed(if longer > 1 { longer } else { 0 })),
        }
    }
}

/// The lessons of one PLC.
#[derive(Debug, Default)]
pub(super) struct Lessons(Vec<(Lesson, Instant)>);

impl Lessons {
    pub(super) fn learn(&mut self, lesson: Lesson, now: Instant) {
        self.0.push((lesson, now));
    }

    /// Forgets what was learned long ago; says whether there was any.
    pub(super) fn forget(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        self.0.retain(|(_, learned)| now.saturating_duration_since(*learned) < HEEDED);
        self.0.len() < before
    }

    /// The limits, with what was learned.
    pub(super) fn apply(&self, limits: &Limits) -> Limits {
        let (mut registers, mut points, mut mixed) = (usize::MAX, usize::MAX, usize::MAX);
        let mut avoided = Vec::new();
        for (lesson, _) in &self.0 {
            match *lesson {
                Lesson::Avoid { first, count } => avoided.push((first, count)),
                Lesson::Registers(most) => registers = registers.min(most),
                Lesson::Points(most) => points = points.min(most),
                Lesson::Mixed(most) => mixed = mixed.min(most),
            }
        }
        limits.clone().at_most(registers, points, mixed).avoid_all(avoided)
    }
}
