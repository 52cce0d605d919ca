//! A job of the model: the real [`Job`], driven as `station::job` drives it.

use std::hash::{Hash, Hasher};
use std::rc::Rc;

use super::model::Frame;
use super::requests::Name;
use crate::link::in_step::{InStep, Proof, Shape};
use crate::link::job::{Job, Progress};

#[derive(Clone, Debug)]
pub(super) struct Held {
    job: Job<u8>,
    /// What it asks for.
    pub(super) name: Name,
    /// The job as text, for it has no equality.
    key: Rc<str>,
    /// The mark of the next read.
    at: u8,
    /// Bits of the marks whose results are other requests'.
    wrong: u8,
    /// The proof that the job was told last. The rule counts from there, so that the states are finite.
    told: Proof,
    /// A refusal that is to be confirmed, and whether it is the request's own.
    refusal: Option<bool>,
}

impl Held {
    pub(super) fn new(name: Name) -> Self {
        let job = Job::new(1);
        let key = format!("{job:?}").into();
        Self { job, name, key, at: 0, wrong: 0, told: Proof::default(), refusal: None }
    }

    /// The number of its requests. Equal pages need one more: a shift of them begins behind two that differ.
    fn requests(&self) -> u8 {
        if self.name == Name::Page { 4 } else { 3 }
    }

    /// Whether a check is the next that the job asks for.
    pub(super) fn must_confirm(&self) -> bool {
        self.refusal.is_some() || self.at == self.requests()
    }

    /// The job ends here; says whether a wrong result is given out: one that is not held.
    pub(super) fn fails(&self) -> bool {
        self.has_wrong_before(self.job.first_held().unwrap_or(self.at))
    }

    /// A read was answered; says whether a wrong result is given out. `confirms`: whether the job ends with a check.
    pub(super) fn answered(&mut self, known: &mut InStep, shape: Shape, frame: Frame, confirms: bool) -> bool {
        let proof = self.tell(known);
        let progress = self.job.answered(self.at, shape, proof);
        if progress != Progress::Go {
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

    /// The check was answered, or silence replaced it.
    pub(super) fn confirmed(&mut self, known: &mut InStep) -> bool {
        let proof = self.tell(known);
        match self.job.confirmed(proof) {
            Progress::Go => self.ends(),
            progress => self.rewound(progress),
        }
    }

    fn rewound(&mut self, progress: Progress<u8>) -> bool {
        self.refusal = None;
        match progress {
            Progress::Go => {}
            Progress::Rewind(first) => {
                self.at = first;
                self.wrong &= (1 << first) - 1;
                self.remember();
            }
            Progress::Failed(first) => {
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

    /// The job compares proofs for equality alone, so two values of each counter are enough.
    fn tell(&mut self, known: &mut InStep) -> Proof {
        let new = std::mem::take(&mut known.proof);
        self.told.proofs ^= u32::from(new.proofs > 0);
        self.told.doubts ^= u32::from(new.doubts > 0);
        self.told
    }

    fn remember(&mut self) {
        self.key = format!("{:?}", self.job).into();
    }
}

impl PartialEq for Held {
    fn eq(&self, other: &Self) -> bool {
        (&self.key, self.name, self.at, self.wrong, self.told, self.refusal)
            == (&other.key, other.name, other.at, other.wrong, other.told, other.refusal)
    }
}

impl Eq for Held {}

impl Hash for Held {
    fn hash<H: Hasher>(&self, state: &mut H) {
        (&self.key, self.name, self.at, self.wrong, self.told, self.refusal).hash(state);
    }
}
