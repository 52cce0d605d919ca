//! A job of the model: the real [`Job`], driven as `station::job` drives it.

use std::hash::{Hash, Hasher};
use std::rc::Rc;

use super::frame::Frame;
use super::requests::Name;
use crate::link::in_step::{InStep, Proof, Shape};
use crate::link::job::{Job, JobProgress};

#[derive(Clone, Debug)]
pub(super) struct ModelJob {
    job: Job<u8>,
    /// The requests of the job.
    pub(super) name: Name,
    /// The job as text: it has no equality of its own.
    key: Rc<str>,
    /// The mark of the next read.
    at: u8,
    /// One bit per mark: its result belongs to another request.
    wrong: u8,
    /// The proof that the job was given last. The rule counts from there, so that the states are
    /// finite.
    given_proof: Proof,
    /// A refusal that waits for its confirmation, and whether it is the request's own.
    refusal: Option<bool>,
}

impl ModelJob {
    pub(super) fn new(name: Name) -> Self {
        let job = Job::new(1);
        let key = format!("{job:?}").into();
        Self { job, name, key, at: 0, wrong: 0, given_proof: Proof::default(), refusal: None }
    }

    /// Number of requests. Equal pages need one more: a shift of them begins after two that differ.
    fn requests(&self) -> u8 {
        if self.name == Name::Page { 4 } else { 3 }
    }

    /// Returns whether the job needs a check next.
    pub(super) fn must_confirm(&self) -> bool {
        self.refusal.is_some() || self.at == self.requests()
    }

    /// Ends the job. Returns whether a wrong result is given out, that is one that is not held.
    pub(super) fn fails(&self) -> bool {
        self.has_wrong_before(self.job.first_held().unwrap_or(self.at))
    }

    /// Handles the reply to a read. Returns whether a wrong result is given out. `confirms`:
    /// whether the job ends with a check.
    pub(super) fn answered(&mut self, in_step: &mut InStep, shape: Shape, frame: Frame, confirms: bool) -> bool {
        let proof = self.next_proof(in_step);
        let progress = self.job.answered(self.at, shape, proof);
        if progress != JobProgress::Go {
            return self.rewound(progress);
        }
        if frame.refused {
            self.refusal = Some(frame.own);
        } else {
            self.wrong |= u8::from(!frame.own) << self.at;
            self.at += 1;
        }
        let wrong = self.fails();
        if self.must_confirm() && (!confirms || self.refusal.is_none() && !self.job.must_confirm()) {
            return self.ends();
        }
        self.remember();
        wrong
    }

    /// Handles the answer to a check, or silence in its place.
    pub(super) fn confirmed(&mut self, in_step: &mut InStep) -> bool {
        let proof = self.next_proof(in_step);
        match self.job.confirmed(proof) {
            JobProgress::Go => self.ends(),
            progress => self.rewound(progress),
        }
    }

    fn rewound(&mut self, progress: JobProgress<u8>) -> bool {
        self.refusal = None;
        match progress {
            JobProgress::Go => {}
            JobProgress::Rewind(first) => {
                self.at = first;
                self.wrong &= (1 << first) - 1;
                self.remember();
            }
            JobProgress::Failed(first) => {
                let wrong = self.has_wrong_before(first);
                *self = Self::new(self.name);
                return wrong;
            }
        }
        self.has_wrong_before(self.at)
    }

    fn ends(&mut self) -> bool {
        let wrong = self.wrong != 0 || self.refusal == Some(false);
        *self = Self::new(self.name);
        wrong
    }

    fn has_wrong_before(&self, mark: u8) -> bool {
        self.wrong & ((1 << mark) - 1) != 0
    }

    /// Returns the proof for the job. Jobs compare proofs for equality only, so two values of each
    /// counter are enough.
    fn next_proof(&mut self, in_step: &mut InStep) -> Proof {
        let new = std::mem::take(&mut in_step.proof);
        self.given_proof.proofs ^= u32::from(new.proofs > 0);
        self.given_proof.doubts ^= u32::from(new.doubts > 0);
        self.given_proof
    }

    fn remember(&mut self) {
        self.key = format!("{:?}", self.job).into();
    }
}

impl PartialEq for ModelJob {
    fn eq(&self, other: &Self) -> bool {
        (&self.key, self.name, self.at, self.wrong, self.given_proof, self.refusal)
            == (&other.key, other.name, other.at, other.wrong, other.given_proof, other.refusal)
    }
}

impl Eq for ModelJob {}

impl Hash for ModelJob {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (&self.key, self.name, self.at, self.wrong, self.given_proof, self.refusal).hash(state);
    }
}
