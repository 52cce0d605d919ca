//! Jobs: requests whose results are good only together, such as the requests of a long read. No I/O and no clock.
//!
//! The rule of [`in_step`](super::in_step) proves each reply as long as duplicates keep the order of the line. A duplicate that
//! does not (it *roams*) may still be taken for the reply to a request of its shape. Then the true reply is left over: it comes
//! as an unexpected stray before the answer to anything that is sent later. So a job holds its results until a check has come
//! back with no such stray before it.
//!
//! ```text
//!            answered                     answered, a proof since: confirmed so far
//!   empty ────────────▶ results held ◀──────────────────────────────┐
//!     ▲                  │   │   └───────────────────────────────────┘
//!     └──────────────────┘   └── a stray since: rewind to the first result held
//!       confirmed: no stray
//! ```
//!
//! Invariants:
//! - a result is confirmed only if no unexpected stray came between it and a later proof (the echo of a check, or silence);
//! - a job ends with a check, unless its last exchange has a shape that no other exchange of the job had;
//! - a job rewinds as often as a read is retried, and then it fails; once a proof confirms something, it may as often again.

use super::in_step::{Proof, Shape};

/// What follows from an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub(crate) enum Progress<M> {
    /// Go on.
    Go,
    /// The results from this mark on may be other requests': ask again from there on.
    Rewind(M),
    /// The same, and that has been done as often as may be.
    Failed(M),
}

/// The state of a job. `M` marks where its requests stand in it.
#[derive(Clone, Debug)]
pub(crate) struct Job<M> {
    /// The first result that is not confirmed.
    first_held: Option<M>,
    /// What was proven of the station when the last result was taken.
    last: Option<Proof>,
    /// The shapes of all exchanges.
    shapes: Vec<Shape>,
    /// The last exchange has a shape that no other has.
    last_is_distinct: bool,
    exchanges: usize,
    /// How often it rewinds before a proof confirms something.
    rewinds: u32,
    rewinds_left: u32,
}

impl<M: Copy> Job<M> {
    /// A job that rewinds this often.
    pub(crate) fn new(rewinds: u32) -> Self {
        Self {
            first_held: None,
            last: None,
            shapes: Vec::new(),
            last_is_distinct: false,
            exchanges: 0,
            rewinds,
            rewinds_left: rewinds,
        }
    }

    /// The first result that is not confirmed.
    pub(crate) fn first_held(&self) -> Option<M> {
        self.first_held
    }

    /// A request that stands at this mark has been answered by a reply of this shape.
    pub(crate) fn answered(&mut self, mark: M, shape: Shape, proof: Proof) -> Progress<M> {
        if let Some(first) = self.doubted(proof) {
            return self.rewind(first);
        }
        if self.last.is_some_and(|last| last.proofs != proof.proofs) {
            self.first_held = None;
            self.rewinds_left = self.rewinds;
        }
        self.last = Some(proof);
        self.first_held.get_or_insert(mark);
        self.exchanges = self.exchanges.saturating_add(1);
        self.last_is_distinct = !self.shapes.contains(&shape);
        if self.last_is_distinct {
            self.shapes.push(shape);
        }
        Progress::Go
    }

    /// Whether a check must confirm what is held before the job ends.
    pub(crate) fn must_confirm(&self) -> bool {
        self.exchanges > 1 && !self.last_is_distinct && self.first_held.is_some()
    }

    /// A check has been answered, or silence has replaced it.
    pub(crate) fn confirmed(&mut self, proof: Proof) -> Progress<M> {
        if let Some(first) = self.doubted(proof) {
            return self.rewind(first);
        }
        self.first_held = None;
        self.last = Some(proof);
        Progress::Go
    }

    /// The first result held, if an unexpected stray came since the last answer.
    fn doubted(&self, proof: Proof) -> Option<M> {
        self.first_held.filter(|_| self.last.is_some_and(|last| last.doubts != proof.doubts))
    }

    fn rewind(&mut self, first: M) -> Progress<M> {
        self.first_held = None;
        self.last = None;
        match self.rewinds_left.checked_sub(1) {
            Some(left) => {
                self.rewinds_left = left;
                Progress::Rewind(first)
            }
            None => Progress::Failed(first),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::Code;

    fn shape(size: u32) -> Shape {
        Shape { code: Code::ReadRegisters, size }
    }

    fn proof(proofs: u32, doubts: u32) -> Proof {
        Proof { proofs, doubts }
    }

    #[test]
    fn a_job_of_one_exchange_needs_no_check() {
        let mut job = Job::new(2);
        assert!(!job.must_confirm());
        assert_eq!(job.answered(0, shape(64), proof(1, 0)), Progress::Go);
        assert!(!job.must_confirm());
    }

    #[test]
    fn the_last_exchange_confirms_if_its_shape_is_distinct() {
        let mut job = Job::new(2);
        for (mark, size, must) in [(0, 64, false), (1, 63, false), (2, 64, true), (3, 30, false), (4, 63, true)] {
            assert_eq!(job.answered(mark, shape(size), proof(1, 0)), Progress::Go);
            assert_eq!(job.must_confirm(), must, "{mark}");
        }
        assert_eq!(job.confirmed(proof(2, 0)), Progress::Go);
        assert!(!job.must_confirm());
    }

    #[test]
    fn a_stray_rewinds_to_the_first_result_since_the_last_proof() {
        let mut job = Job::new(2);
        assert_eq!(job.answered(0, shape(64), proof(1, 0)), Progress::Go);
        assert_eq!(job.answered(1, shape(63), proof(1, 0)), Progress::Go);
        // A proof in between confirms 0 and 1.
        assert_eq!(job.answered(2, shape(64), proof(2, 0)), Progress::Go);
        assert_eq!(job.answered(3, shape(63), proof(2, 0)), Progress::Go);
        assert_eq!(job.answered(4, shape(64), proof(3, 1)), Progress::Rewind(2));
        assert_eq!(job.answered(2, shape(63), proof(3, 1)), Progress::Go);
        assert_eq!(job.answered(3, shape(63), proof(3, 1)), Progress::Go);
        assert_eq!(job.confirmed(proof(4, 2)), Progress::Rewind(2));
        assert_eq!(job.answered(2, shape(63), proof(4, 2)), Progress::Go);
        assert_eq!(job.confirmed(proof(5, 3)), Progress::Failed(2));
    }
}
