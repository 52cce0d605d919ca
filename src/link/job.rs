//! Jobs: requests whose results are good only together, such as those of a long read. No I/O and no
//! clock.
//!
//! The rule of [`in_step`](super::in_step) proves each reply as long as duplicates keep the order
//! of the line. A roaming duplicate does not, and may be taken for the reply to a request of its
//! shape. Then the true reply is left over: it comes as an unexpected stray before the reply to
//! anything sent later. So a job holds its results until a check has come back without such a stray
//! before it.
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
//! - A result is confirmed only if no unexpected stray came between it and a later proof (the echo
//!   of a check, or silence).
//! - A job ends with a check, unless its last exchange has a shape that no other exchange of the
//!   job had. A transfer ends with one in any case: its last reply may be a roaming duplicate of an
//!   earlier transfer.
//! - A job rewinds as often as a read is retried; the next time it fails. After a proof has
//!   confirmed results, it may rewind as often again.

use super::in_step::{Proof, Shape};

/// The next step of a job after a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub(crate) enum JobProgress<M> {
    /// Continue.
    Go,
    /// The results from this mark on may belong to other requests: repeat the requests from there.
    Rewind(M),
    /// As `Rewind`, but the job has rewound as often as it may.
    Failed(M),
}

/// The state of a job. `M` marks the position of a request in it.
#[derive(Clone, Debug)]
pub(crate) struct Job<M> {
    /// Mark of the first result that is not confirmed.
    first_held: Option<M>,
    /// The station's proof when the last result was taken.
    last: Option<Proof>,
    /// The shapes of all exchanges.
    shapes: Vec<Shape>,
    /// The last exchange has a shape that no other has.
    last_is_distinct: bool,
    exchanges: usize,
    /// How often the job may rewind before a proof confirms results.
    rewinds: u32,
    rewinds_left: u32,
}

impl<M: Copy> Job<M> {
    /// A job that may rewind this often.
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

    /// Mark of the first result that is not confirmed.
    pub(crate) fn first_held(&self) -> Option<M> {
        self.first_held
    }

    /// Notes that the request at `mark` was answered by a reply of this shape.
    pub(crate) fn answered(&mut self, mark: M, shape: Shape, proof: Proof) -> JobProgress<M> {
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
        JobProgress::Go
    }

    /// Returns whether a check must confirm the held results before the job ends.
    pub(crate) fn must_confirm(&self) -> bool {
        self.exchanges > 1 && !self.last_is_distinct && self.first_held.is_some()
    }

    /// Notes that a check was answered, or that silence has replaced it.
    pub(crate) fn confirmed(&mut self, proof: Proof) -> JobProgress<M> {
        if let Some(first) = self.doubted(proof) {
            return self.rewind(first);
        }
        self.first_held = None;
        self.last = Some(proof);
        JobProgress::Go
    }

    /// Mark of the first result held, if an unexpected stray came since the last reply.
    fn doubted(&self, proof: Proof) -> Option<M> {
        self.first_held.filter(|_| self.last.is_some_and(|last| last.doubts != proof.doubts))
    }

    fn rewind(&mut self, first: M) -> JobProgress<M> {
        self.first_held = None;
        self.last = None;
        match self.rewinds_left.checked_sub(1) {
            Some(left) => {
                self.rewinds_left = left;
                JobProgress::Rewind(first)
            }
            None => JobProgress::Failed(first),
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
        assert_eq!(job.answered(0, shape(64), proof(1, 0)), JobProgress::Go);
        assert!(!job.must_confirm());
    }

    #[test]
    fn the_last_exchange_confirms_if_its_shape_is_distinct() {
        let mut job = Job::new(2);
        for (mark, size, must) in [(0, 64, false), (1, 63, false), (2, 64, true), (3, 30, false), (4, 63, true)] {
            assert_eq!(job.answered(mark, shape(size), proof(1, 0)), JobProgress::Go);
            assert_eq!(job.must_confirm(), must, "{mark}");
        }
        assert_eq!(job.confirmed(proof(2, 0)), JobProgress::Go);
        assert!(!job.must_confirm());
    }

    #[test]
    fn a_stray_rewinds_to_the_first_result_since_the_last_proof() {
        let mut job = Job::new(2);
        assert_eq!(job.answered(0, shape(64), proof(1, 0)), JobProgress::Go);
        assert_eq!(job.answered(1, shape(63), proof(1, 0)), JobProgress::Go);
        // A proof in between confirms 0 and 1.
        assert_eq!(job.answered(2, shape(64), proof(2, 0)), JobProgress::Go);
        assert_eq!(job.answered(3, shape(63), proof(2, 0)), JobProgress::Go);
        assert_eq!(job.answered(4, shape(64), proof(3, 1)), JobProgress::Rewind(2));
        assert_eq!(job.answered(2, shape(63), proof(3, 1)), JobProgress::Go);
        assert_eq!(job.answered(3, shape(63), proof(3, 1)), JobProgress::Go);
        assert_eq!(job.confirmed(proof(4, 2)), JobProgress::Rewind(2));
        assert_eq!(job.answered(2, shape(63), proof(4, 2)), JobProgress::Go);
        assert_eq!(job.confirmed(proof(5, 3)), JobProgress::Failed(2));
    }
}
