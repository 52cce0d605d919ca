//! The client of the model: the real [`InStep`], driven as `core::outcome` drives it.

use std::time::Duration;

use tokio::time::Instant;

use super::frame::Frame;
use super::jobs::ModelJob;
use super::requests::{Name, Request};
use super::state::{Asked, ModelState, Out};
use crate::command::Code;
use crate::link::in_step::{Check, Choice, InStep, Kind, Reply, Rule, Spelled, Why};

/// The part of the rule that is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ablation {
    Nothing,
    /// A new connection is trusted.
    Suspicion,
    /// A timeout leaves the station in step.
    Timeout,
    /// A broadcast owes nothing.
    Broadcast,
    /// Where no spelling is distinct, the plain one is sent without a check.
    Separation,
    /// All nonces are equal.
    FreshNonce,
    /// A refusal is owed to requests of its own size only.
    EverySize,
    /// The received frame is owed, and not the other possible answer to its request.
    OtherAnswer,
    /// A reply without proof is taken.
    Proof,
    /// A refusal of 4E clears a suspect station.
    Echo,
    /// Where 4E is refused, 40 replaces the silence.
    Silence,
    /// Strays are ignored.
    Strays,
    /// Input is discarded unread while no request is on the wire.
    IdleInput,
    /// Input stays unread until a request is on the wire.
    ReadFirst,
    /// A job ends without a check.
    Confirmation,
}

/// An event, the state after it, and a wrong result if a caller got one.
pub(super) type StepOutcome = (&'static str, ModelState, Option<Wrong>);

/// Kinds of results whose reply answered another request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Wrong {
    Value,
    Acknowledgement,
    Refusal,
    /// Given out by a job.
    InJob,
}

pub(super) struct Client {
    pub(super) rule: Rule,
    pub(super) ablation: Ablation,
    /// The time of all events; only silence takes time.
    pub(super) now: Instant,
    /// A result is wrong only if its content is not that of the true reply.
    pub(super) by_content: bool,
    /// A refused spelling may be a command that the device lacks.
    pub(super) lacks: bool,
    pub(super) requests: [Request; 6],
}

impl Client {
    pub(super) fn request(&self, name: Name) -> &Request {
        &self.requests[name as usize]
    }

    /// As `Core::outgoing_for`, for a request.
    pub(super) fn choose(&self, in_step: &mut InStep, name: Name, plain: bool) -> Choice {
        let request = self.request(name);
        match (self.ablation, in_step.choose(request, plain, &self.rule, self.now)) {
            (Ablation::Separation, Choice::Check(_, Why::Owed)) => Choice::Send(request.plain()),
            (Ablation::Silence, Choice::Silence(_)) => Choice::Check(Check::Status, Why::Unproven),
            (_, choice) => {
                let allowed = !matches!(choice, Choice::Send(spelling) if !in_step.allows(request, spelling));
                assert!(allowed, "{choice:?} is not allowed in {in_step:?}");
                choice
            }
        }
    }

    /// As `Core::outgoing_for`, for the end of a job.
    pub(super) fn confirm(&self, in_step: &mut InStep) -> Option<Choice> {
        in_step.confirm(&self.rule, self.now)
    }

    /// The station is silent for the quiet time, and nothing can come after it.
    pub(super) fn is_silent(&self, in_step: &mut InStep) {
        in_step.silent_since = None;
        assert!(in_step.prove(&self.rule, self.now).is_some());
        assert_eq!(in_step.prove(&self.rule, self.now + self.rule.quiet), None);
    }

    /// The copy window passes, and no duplicate can come after it.
    pub(super) fn window_passes(&self, in_step: &mut InStep) {
        in_step.lapse(&self.rule, self.now + self.rule.settings.window());
    }

    pub(super) fn broadcast(&self, in_step: &mut InStep, code: Code) {
        if self.ablation != Ablation::Broadcast {
            in_step.broadcast(code, self.now);
        }
    }

    pub(super) fn stray(&self, in_step: &mut InStep, frame: &Frame) {
        if self.ablation != Ablation::Strays {
            in_step.stray(frame.code.into(), frame.fingerprint(), &self.rule, self.now);
        }
    }

    /// As `Core::give_up`.
    pub(super) fn timed_out(&self, s: &ModelState, out: &Out) -> Vec<StepOutcome> {
        let mut after = s.clone();
        if self.ablation != Ablation::Timeout {
            after.in_step.timed_out(out.shape.code);
        }
        self.repeated_or_failed("times out", after, out)
    }

    /// The request is sent again; or it fails, and its job with it.
    fn repeated_or_failed(&self, label: &'static str, after: ModelState, out: &Out) -> Vec<StepOutcome> {
        let mut outcomes = vec![(label, after.clone(), None)];
        if let (Some(job), true) = (&after.job, out.in_job) {
            let mut failed = after.clone();
            let wrong = job.fails();
            failed.job = Some(ModelJob::new(job.name));
            outcomes.push(("fails, and the job with it", failed, wrong.then_some(Wrong::InJob)));
        }
        outcomes
    }

    /// As `Exchange::classify` and `Core::conclude`, for frames that come in one read.
    pub(super) fn receive(&self, s: &ModelState, frames: &[Frame]) -> Vec<StepOutcome> {
        let mut after = s.clone();
        let Some(out) = s.out.clone() else {
            if self.ablation != Ablation::IdleInput {
                frames.iter().for_each(|frame| self.stray(&mut after.in_step, frame));
            }
            return vec![("a stray", after, None)];
        };
        let (mut held, mut followed, mut copied) = (None::<Frame>, false, false);
        for frame in frames {
            match held {
                None if frame.fits(out.shape) => held = Some(*frame),
                None => self.stray(&mut after.in_step, frame),
                Some(reply) if reply.fingerprint() == frame.fingerprint() => copied = true,
                Some(_) => {
                    followed = true;
                    self.stray(&mut after.in_step, frame);
                }
            }
        }
        match held {
            None => vec![("a stray", after, None)],
            Some(mut frame) => {
                let true_reply = |other: &&Frame| other.own && other.fingerprint() == frame.fingerprint();
                frame.own |= self.by_content && s.on_its_way().chain(frames).any(|other| true_reply(&other));
                after.ends();
                self.replied(after, &out, frame, followed, copied)
            }
        }
    }

    /// As `Core::replied`.
    fn replied(
        &self,
        mut after: ModelState,
        out: &Out,
        frame: Frame,
        followed: bool,
        copied: bool,
    ) -> Vec<StepOutcome> {
        let reply = Reply { shape: out.shape, refused: frame.refused, fingerprint: frame.fingerprint() };
        let name = match out.asked {
            Asked::Call(name) => name,
            Asked::Check { check, confirms } => return self.checked(after, out, check, confirms, (&reply, followed)),
        };
        let request = self.request(name);
        let kind = request.kind();
        if followed {
            after.in_step.followed();
        }
        let contradicted = kind != Kind::Once && followed;
        if !self.proves(&after.in_step, kind, &reply) || contradicted && self.ablation != Ablation::Proof {
            after.in_step.unproven(&reply, copied, &self.rule, self.now);
            return self.repeated_or_failed("no proof", after, out);
        }
        let in_step = &mut after.in_step;
        in_step.taken(kind, &reply, Duration::ZERO, &self.rule, self.now);
        if reply.refused && out.spelling != request.plain() {
            let mut lacking = after.clone();
            for (state, lacks) in [(&mut after, false), (&mut lacking, true)] {
                state.in_step.spelling_refused(request.plain(), out.spelling, request.run, lacks);
                if kind == Kind::Once {
                    state.in_step.write_refused();
                }
            }
            let mut outcomes = vec![("a spelling is refused", after, None), ("a command is lacking", lacking, None)];
            outcomes.truncate(1 + usize::from(self.lacks));
            return outcomes;
        }
        if !reply.refused {
            in_step.answered(request.run, out.spelling);
        }
        if copied {
            in_step.copied();
        }
        let wrong = match (frame.own, frame.refused, kind) {
            (true, ..) => None,
            (false, true, _) => Some(Wrong::Refusal),
            (false, false, Kind::Once) => Some(Wrong::Acknowledgement),
            (false, false, _) => Some(Wrong::Value),
        };
        if let (Some(job), true) = (&mut after.job, out.in_job) {
            let confirms = self.ablation != Ablation::Confirmation;
            let wrong = job.answered(&mut after.in_step, out.shape, frame, confirms);
            return vec![("the reply, in the job", after, wrong.then_some(Wrong::InJob))];
        }
        // In a model with a job, only the results of the job count.
        let wrong = wrong.filter(|_| after.job.is_none());
        let label = if wrong.is_some() { "TAKEN FOR THE REPLY" } else { "the reply" };
        vec![(label, after, wrong)]
    }

    fn checked(
        &self,
        mut after: ModelState,
        out: &Out,
        check: Check,
        confirms: bool,
        (reply, followed): (&Reply, bool),
    ) -> Vec<StepOutcome> {
        let in_step = &mut after.in_step;
        let mut passed = in_step.checked(check, (reply, followed), Duration::ZERO, &self.rule, self.now);
        let trusted = match self.ablation {
            Ablation::Echo => reply.refused,
            Ablation::Silence => check == Check::Status,
            _ => false,
        };
        if !passed && trusted {
            in_step.is_in_step();
            passed = true;
        }
        if !passed {
            return vec![("no proof", after, None)];
        }
        if let (Some(job), true, true) = (&mut after.job, out.in_job, confirms) {
            let wrong = job.confirmed(&mut after.in_step);
            return vec![("the check is answered, for the job", after, wrong.then_some(Wrong::InJob))];
        }
        vec![("the check is answered", after, None)]
    }

    fn proves(&self, in_step: &InStep, kind: Kind, reply: &Reply) -> bool {
        let other_size = |size| size != reply.shape.size;
        let mut in_step = in_step.clone();
        match self.ablation {
            Ablation::Proof => return true,
            Ablation::EverySize => {
                in_step.taken =
                    in_step.taken.filter(|taken| taken.fingerprint.is_some() || !other_size(taken.shape.size));
            }
            Ablation::OtherAnswer => {
                in_step.taken = in_step.taken.filter(|taken| taken.fingerprint.is_none() == reply.refused);
            }
            _ => {}
        }
        in_step.proves(kind, reply)
    }
}
