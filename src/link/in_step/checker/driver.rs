//! The client of the model: the real [`InStep`], driven as `core::outcome` drives it.

use std::time::Duration;

use tokio::time::Instant;

use super::jobs::Held;
use super::model::{Asked, Frame, Out, State};
use super::requests::{Name, Request};
use crate::command::Code;
use crate::link::in_step::{Check, Choice, InStep, Kind, Reply, Rule, Spelled, Why};

/// The ingredient of the rule that is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Without {
    Nothing,
    /// A new connection is trusted.
    Suspicion,
    /// A timeout leaves the station in step.
    Timeout,
    /// A broadcast owes nothing.
    Broadcast,
    /// Where no spelling is distinct, the plain one goes out without a check.
    Separation,
    /// All nonces are equal.
    FreshNonce,
    /// A refusal is owed to requests of its own size only.
    EverySize,
    /// The frame received is owed, and not the other answer to its request.
    OtherAnswer,
    /// A reply without proof is taken.
    Proof,
    /// A refusal of 4E clears a suspect station.
    Echo,
    /// Where 4E is refused, 40 replaces the silence.
    Silence,
    /// Strays have no consequence.
    Strays,
    /// Input is discarded unread while no request is on the wire.
    IdleInput,
    /// Input stays unread until a request is on the wire.
    ReadFirst,
    /// A job ends without a check.
    Confirmation,
}

/// What happened, the state after it, and whether a caller got another request's result.
pub(super) type Outcome = (&'static str, State, Option<Wrong>);

/// A result that was another request's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Wrong {
    Value,
    Acknowledgement,
    Refusal,
    /// Given out by a job.
    InJob,
}

pub(super) struct Driver {
    pub(super) rule: Rule,
    pub(super) without: Without,
    /// The time of all events; only silence takes any.
    pub(super) now: Instant,
    /// A result is wrong only if its content is not that of the true reply.
    pub(super) by_content: bool,
    /// A refused spelling may be a command that the device lacks.
    pub(super) lacks: bool,
    pub(super) requests: [Request; 6],
}

impl Driver {
    pub(super) fn request(&self, name: Name) -> &Request {
        &self.requests[name as usize]
    }

    /// As `Core::goal_of`, for a request.
    pub(super) fn choose(&self, known: &mut InStep, name: Name, plain: bool) -> Choice {
        let request = self.request(name);
        match (self.without, known.choose(request, plain, &self.rule, self.now)) {
            (Without::Separation, Choice::Check(_, Why::Owed)) => Choice::Send(request.plain()),
            (Without::Silence, Choice::Silence(_)) => Choice::Check(Check::Status, Why::Unproven),
            (_, choice) => {
                let allowed = !matches!(choice, Choice::Send(spelling) if !known.allows(request, spelling));
                assert!(allowed, "{choice:?} is not allowed in {known:?}");
                choice
            }
        }
    }

    /// As `Core::goal_of`, for the end of a job.
    pub(super) fn confirm(&self, known: &mut InStep) -> Option<Choice> {
        known.confirm(&self.rule, self.now)
    }

    /// The station is silent for the quiet time, and nothing can come any more.
    pub(super) fn is_silent(&self, known: &mut InStep) {
        known.silent_since = None;
        assert!(known.prove(&self.rule, self.now).is_some());
        assert_eq!(known.prove(&self.rule, self.now + self.rule.quiet), None);
    }

    /// The copy window passes, and no copy can come any more.
    pub(super) fn window_passes(&self, known: &mut InStep) {
        known.lapse(&self.rule, self.now + self.rule.settings.window());
    }

    pub(super) fn broadcast(&self, known: &mut InStep, code: Code) {
        if self.without != Without::Broadcast {
            known.broadcast(code, self.now);
        }
    }

    pub(super) fn stray(&self, known: &mut InStep, frame: &Frame) {
        if self.without != Without::Strays {
            known.stray(frame.code.into(), frame.fingerprint(), &self.rule, self.now);
        }
    }

    /// As `Core::give_up`.
    pub(super) fn timed_out(&self, s: &State, out: &Out) -> Vec<Outcome> {
        let mut after = s.clone();
        if self.without != Without::Timeout {
            after.known.timed_out(out.shape.code);
        }
        self.repeated_or_failed("times out", after, out)
    }

    /// A request is sent again, or it fails and a job with it.
    fn repeated_or_failed(&self, label: &'static str, after: State, out: &Out) -> Vec<Outcome> {
        let mut outcomes = vec![(label, after.clone(), None)];
        if let (Some(job), true) = (&after.job, out.in_job) {
            let mut failed = after.clone();
            let wrong = job.fails();
            failed.job = Some(Held::new(job.name));
            outcomes.push(("fails, and the job with it", failed, wrong.then_some(Wrong::InJob)));
        }
        outcomes
    }

    /// As `Exchange::classify` and `Core::conclude`: these frames come in one read.
    pub(super) fn hears(&self, s: &State, frames: &[Frame]) -> Vec<Outcome> {
        let mut after = s.clone();
        let Some(out) = s.out.clone() else {
            if self.without != Without::IdleInput {
                frames.iter().for_each(|frame| self.stray(&mut after.known, frame));
            }
            return vec![("a stray", after, None)];
        };
        let (mut held, mut followed, mut copied) = (None::<Frame>, false, false);
        for frame in frames {
            match held {
                None if frame.fits(out.shape) => held = Some(*frame),
                None => self.stray(&mut after.known, frame),
                Some(reply) if reply.fingerprint() == frame.fingerprint() => copied = true,
                Some(_) => {
                    followed = true;
                    self.stray(&mut after.known, frame);
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
    fn replied(&self, mut after: State, out: &Out, frame: Frame, followed: bool, copied: bool) -> Vec<Outcome> {
        let reply = Reply { shape: out.shape, refused: frame.refused, fingerprint: frame.fingerprint() };
        let name = match out.asked {
            Asked::Call(name) => name,
            Asked::Check { check, confirms } => return self.checked(after, out, check, confirms, (&reply, followed)),
        };
        let request = self.request(name);
        let kind = request.kind();
        if followed {
            after.known.followed();
        }
        let contradicted = kind != Kind::Once && followed;
        if !self.proves(&after.known, kind, &reply) || contradicted && self.without != Without::Proof {
            after.known.unproven(&reply, copied, &self.rule, self.now);
            return self.repeated_or_failed("no proof", after, out);
        }
        let known = &mut after.known;
        known.taken(kind, &reply, Duration::ZERO, &self.rule, self.now);
        if reply.refused && out.spelling != request.plain() {
            let mut lacking = after.clone();
            for (state, lacks) in [(&mut after, false), (&mut lacking, true)] {
                state.known.spelling_refused(request.plain(), out.spelling, request.run, lacks);
                if kind == Kind::Once {
                    state.known.write_refused();
                }
            }
            let mut outcomes = vec![("a spelling is refused", after, None), ("a command is lacking", lacking, None)];
            outcomes.truncate(1 + usize::from(self.lacks));
            return outcomes;
        }
        if !reply.refused {
            known.answered(request.run, out.spelling);
        }
        if copied {
            known.copied();
        }
        let wrong = match (frame.own, frame.refused, kind) {
            (true, ..) => None,
            (false, true, _) => Some(Wrong::Refusal),
            (false, false, Kind::Once) => Some(Wrong::Acknowledgement),
            (false, false, _) => Some(Wrong::Value),
        };
        if let (Some(job), true) = (&mut after.job, out.in_job) {
            let confirms = self.without != Without::Confirmation;
            let wrong = job.answered(&mut after.known, out.shape, frame, confirms);
            return vec![("the reply, in the job", after, wrong.then_some(Wrong::InJob))];
        }
        // With a job, only the results of the job count.
        let wrong = wrong.filter(|_| after.job.is_none());
        let label = if wrong.is_some() { "TAKEN FOR THE REPLY" } else { "the reply" };
        vec![(label, after, wrong)]
    }

    fn checked(
        &self,
        mut after: State,
        out: &Out,
        check: Check,
        confirms: bool,
        (reply, followed): (&Reply, bool),
    ) -> Vec<Outcome> {
        let known = &mut after.known;
        let mut passed = known.checked(check, (reply, followed), Duration::ZERO, &self.rule, self.now);
        let trusted = match self.without {
            Without::Echo => reply.refused,
            Without::Silence => check == Check::Status,
            _ => false,
        };
        if !passed && trusted {
            known.is_in_step();
            passed = true;
        }
        if !passed {
            return vec![("no proof", after, None)];
        }
        if let (Some(job), true, true) = (&mut after.job, out.in_job, confirms) {
            let wrong = job.confirmed(&mut after.known);
            return vec![("the check is answered, for the job", after, wrong.then_some(Wrong::InJob))];
        }
        vec![("the check is answered", after, None)]
    }

    fn proves(&self, known: &InStep, kind: Kind, reply: &Reply) -> bool {
        let other_size = |size| size != reply.shape.size;
        let mut known = known.clone();
        match self.without {
            Without::Proof => return true,
            Without::EverySize => {
                known.taken = known.taken.filter(|taken| taken.fingerprint.is_some() || !other_size(taken.shape.size));
            }
            Without::OtherAnswer => {
                known.taken = known.taken.filter(|taken| taken.fingerprint.is_none() == reply.refused);
            }
            _ => {}
        }
        known.proves(kind, reply)
    }
}
