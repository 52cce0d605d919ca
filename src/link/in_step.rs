//! In step: the rule that a reply is given to a request only if it is this request's own. One [`InStep`] a station, without I/O
//! and clock.
//!
//! The protocol has no transaction id. A line may deliver a reply late or lose it, and it may deliver a reply more than once. A
//! PLC answers in the order in which it was asked and the line keeps that order, so a duplicate comes before the true reply to
//! any request that was sent later. The rule is that of the alternating bit protocol (Bartlett, Scantlebury, Wilkinson 1969),
//! with the bit in the shape of the reply.
//!
//! ```text
//!                 connected, stray, timeout, reply without proof
//!   in step ───────────────────────────────────────────────────────▶ suspect
//!      ▲      nonce echoed, or (where 4E is refused) silence             │
//!      └─────────────────────────────────────────────────────────────────┘
//! ```
//!
//! A *stray* is a frame of the station that no request on the wire takes. A *check* is a loop-back (4E) with a nonce that was
//! never used before. *Owed* are the shapes of replies that may still come: what was taken last, and answers to broadcasts.
//!
//! Invariants:
//! - a suspect station is sent nothing but checks, and only the echo of a check or silence clears it;
//! - in step, a request is sent only if nothing owed could answer it, in one of its [spellings](crate::command::Spelling); a
//!   read also while a refusal is owed, and a program page also while a page is owed;
//! - after a reply was taken, its positive shape and the refusal of its command are owed, and nothing older is;
//! - a reply without proof is given to no caller.

mod answered;
#[cfg(test)]
mod checker;
mod codes;
#[cfg(test)]
mod tests;

use std::time::Duration;

use tokio::time::Instant;

use self::answered::Answered;
use self::codes::Codes;
use super::later;
use crate::command::{Candidate, Candidates, Code, Run, Spelling};
use crate::endpoint::InStepSettings;

/// The shape of a positive reply. A refusal fits every size of its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Shape {
    pub(crate) code: Code,
    /// See [`Command::reply_size`](crate::command::Command).
    pub(crate) size: u32,
}

/// What a request is to the rule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Kind {
    /// It can be asked again.
    Read,
    /// A read of a program page: a page that differs from the one before it is new.
    Page,
    /// It is sent only if no owed frame of any sort could answer it.
    Once,
}

/// A request, as far as the rule must know it.
pub(crate) trait Spelled {
    fn kind(&self) -> Kind;
    fn plain(&self) -> Spelling;
    /// The other spellings.
    fn candidates(&self) -> Candidates;
    /// The shape of the positive reply to a spelling.
    fn shape(&self, spelling: Spelling) -> Shape;
}

/// A reply that fits the request on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reply {
    /// The shape that was asked for.
    pub(crate) shape: Shape,
    pub(crate) refused: bool,
    /// Of the frame: see [`fingerprint`].
    pub(crate) fingerprint: u64,
}

/// What goes out for a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Choice {
    /// The request, so spelt.
    Send(Spelling),
    /// A request of the link itself, before it.
    Check(Check, Why),
    /// Nothing before this time, nor ever if a frame comes from the station before.
    Silence(Instant),
}

/// What the link itself sends to separate two requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Check {
    /// 4E with a nonce. Its echo always proves.
    Nonce,
    /// 4E without data: in step, any distinct exchange separates.
    Empty,
    /// 40, where 4E was refused without proof.
    Status,
    /// 53, where 4E was refused without proof and 40 is owed.
    Detail,
}

/// Why a check is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Why {
    /// The connection is new.
    Connected,
    /// A request was not answered in time.
    TimedOut,
    /// A frame came that no request takes.
    Stray,
    /// A reply came without proof.
    Unproven,
    /// No spelling of the request is distinct from what is owed.
    Owed,
    /// A job ends, or a station is probed.
    Confirm,
}

/// What a frame is that no request takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Stray {
    /// A copy of the reply that was taken last.
    Duplicate,
    /// An answer to a request that had timed out.
    Late,
    /// An answer to a broadcast.
    Broadcast,
    /// None of these.
    Unexpected,
}

/// A number for what was proven of a station so far: see [`Job`](super::job::Job).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Proof {
    /// The number of proofs: echoes of checks and silences.
    pub(crate) proofs: u32,
    /// The number of unexpected strays.
    pub(crate) doubts: u32,
}

/// The rule as it holds on a link.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rule {
    pub(crate) settings: InStepSettings,
    /// The silence that replaces a check.
    pub(crate) quiet: Duration,
    /// The connection is for one request alone, so silence replaces every check.
    pub(crate) one_request: bool,
    pub(crate) prices: Prices,
}

/// Prices of what separates two requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Prices {
    /// Time on the line of a byte.
    pub(crate) byte: Duration,
    /// Time of an exchange without data.
    pub(crate) exchange: Duration,
}

/// What is known of one station.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct InStep {
    /// Why anything may come, if so.
    suspect: Option<Why>,
    /// 4E was refused without proof since the last proof.
    refused: bool,
    /// The beginning of the silence that replaces a check.
    silent_since: Option<Instant>,
    /// The reply that was taken last, while a copy of it may come.
    taken: Option<Taken>,
    /// Those before it; more than none only if copies may come later than the next reply.
    older: Vec<Taken>,
    /// Broadcasts that may be answered.
    broadcasts: Codes,
    /// Requests that timed out since the last proof.
    timed_out: Codes,
    /// The fingerprint of the reply that was taken last.
    last: Option<u64>,
    /// The fingerprint of the page that was taken last.
    last_page: Option<u64>,
    /// That page was equal to the one before it.
    equal_pages: bool,
    /// Commands that are used as spellings and that the station does not know.
    lacks: Codes,
    answered: Answered,
    proof: Proof,
}

/// A reply that was taken, of which a copy may come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Taken {
    shape: Shape,
    /// `None` for a refusal: the copy may be any positive reply then.
    fingerprint: Option<u64>,
    /// The silence of the station after which no copy comes any more.
    window: Duration,
    heard_at: Instant,
}

/// What of the owed frames could answer a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Threat {
    None,
    Refusal,
    Reply,
}

impl InStep {
    /// A station on a connection over which it has not been asked anything.
    pub(crate) fn new() -> Self {
        Self {
            suspect: Some(Why::Connected),
            refused: false,
            silent_since: None,
            taken: None,
            older: Vec::new(),
            broadcasts: Codes::NONE,
            timed_out: Codes::NONE,
            last: None,
            last_page: None,
            equal_pages: false,
            lacks: Codes::NONE,
            answered: Answered::new(),
            proof: Proof::default(),
        }
    }

    /// A station that is in step, and that nothing is owed of.
    #[cfg(test)]
    pub(crate) fn trusted() -> Self {
        Self { suspect: None, ..Self::new() }
    }

    #[cfg(test)]
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect.is_some()
    }

    pub(crate) fn proof(&self) -> Proof {
        self.proof
    }

    /// Decides what goes out for a request. `plain`: another spelling of it has been refused.
    pub(crate) fn choose(&mut self, request: &impl Spelled, plain: bool, rule: &Rule, now: Instant) -> Choice {
        if let Some(choice) = self.prove(rule, now) {
            return choice;
        }
        let spelling = request.plain();
        // A page after two equal ones is probably equal, too, and would be asked for twice.
        let doubtful = self.equal_pages && request.kind() == Kind::Page;
        if self.allows(request, spelling) && !(doubtful && self.threat(request.shape(spelling)) == Threat::Reply) {
            return Choice::Send(spelling);
        }
        let candidates = if plain { [None; 3] } else { request.candidates() };
        let price = |candidate: &Candidate| rule.prices.of(candidate, spelling);
        let possible = |candidate: &Candidate| {
            let known = candidate.extra.is_none_or(|extra| self.answered.contains(extra));
            let lacking = self.lacks.contains(candidate.spelling.code) && candidate.spelling.code != spelling.code;
            known && !lacking && self.allows(request, candidate.spelling) && price(candidate) < rule.prices.exchange
        };
        let best = candidates.iter().flatten().filter(|candidate| possible(candidate)).min_by_key(|&c| price(c));
        match best {
            Some(candidate) => Choice::Send(candidate.spelling),
            None => self.separate(Why::Owed, Check::Empty, rule, now),
        }
    }

    /// Decides what goes out to confirm all that was taken so far; `None`: it is confirmed.
    pub(crate) fn confirm(&mut self, rule: &Rule, now: Instant) -> Option<Choice> {
        let choice = self.prove(rule, now);
        if choice.is_some() || !self.owes_anything() {
            return choice;
        }
        if rule.one_request {
            self.suspect = Some(Why::Confirm);
            return self.prove(rule, now);
        }
        Some(self.separate(Why::Confirm, Check::Nonce, rule, now))
    }

    /// What a suspect station needs; `None`: it is in step.
    fn prove(&mut self, rule: &Rule, now: Instant) -> Option<Choice> {
        self.lapse(now);
        let why = self.suspect?;
        if !rule.one_request && !self.refused {
            return Some(Choice::Check(Check::Nonce, why));
        }
        let until = later(*self.silent_since.get_or_insert(now), rule.quiet);
        if now < until {
            return Some(Choice::Silence(until));
        }
        self.is_in_step();
        None
    }

    /// What goes between two requests: this check, if 4E can.
    fn separate(&mut self, why: Why, check: Check, rule: &Rule, now: Instant) -> Choice {
        let free = |shape: Shape| self.threat(shape) == Threat::None;
        if !self.refused {
            // A nonce may always go out: its echo cannot be another's.
            let empty = check == Check::Empty && free(Check::EMPTY);
            return Choice::Check(if empty { Check::Empty } else { Check::Nonce }, why);
        }
        if free(Check::STATUS) {
            return Choice::Check(Check::Status, why);
        }
        if free(Check::DETAIL) {
            return Choice::Check(Check::Detail, why);
        }
        self.suspect = Some(why);
        Choice::Silence(later(*self.silent_since.get_or_insert(now), rule.quiet))
    }

    /// Whether a request may be sent with this spelling.
    pub(crate) fn allows(&self, request: &impl Spelled, spelling: Spelling) -> bool {
        let threat = self.threat(request.shape(spelling));
        self.suspect.is_none()
            && match request.kind() {
                Kind::Once => threat == Threat::None,
                Kind::Read => threat <= Threat::Refusal,
                Kind::Page => true,
            }
    }

    fn threat(&self, shape: Shape) -> Threat {
        let of_taken = self
            .owed()
            .filter(|taken| taken.shape.code == shape.code)
            .map(|taken| if taken.shape.size == shape.size { Threat::Reply } else { Threat::Refusal });
        // Commands that can be broadcast have positive replies of one size.
        let of_broadcasts = self.broadcasts.contains(shape.code).then_some(Threat::Reply);
        of_taken.chain(of_broadcasts).max().unwrap_or(Threat::None)
    }

    fn owed(&self) -> impl Iterator<Item = &Taken> {
        self.taken.iter().chain(&self.older)
    }

    fn owes_anything(&self) -> bool {
        self.owed().next().is_some() || !self.broadcasts.is_empty()
    }

    /// Whether a reply is proven to be that to the request on the wire.
    pub(crate) fn proves(&self, kind: Kind, reply: &Reply) -> bool {
        let threat = self.threat(reply.shape);
        let in_step = self.suspect.is_none();
        match kind {
            Kind::Once => true,
            Kind::Read => in_step && !(reply.refused && threat > Threat::None),
            Kind::Page if reply.refused => in_step && threat == Threat::None,
            Kind::Page => {
                let mut of_page = self.owed().filter(|taken| taken.shape == reply.shape);
                in_step && of_page.all(|taken| taken.fingerprint.is_some_and(|page| page != reply.fingerprint))
            }
        }
    }

    /// A reply was taken, after this time on the wire: it may come again, and nothing older may.
    pub(crate) fn taken(&mut self, kind: Kind, reply: &Reply, took: Duration, rule: &Rule, now: Instant) {
        if kind == Kind::Page {
            self.equal_pages = !reply.refused && self.last_page == Some(reply.fingerprint);
            self.last_page = Some(reply.fingerprint);
        }
        self.last = Some(reply.fingerprint);
        self.broadcasts = Codes::NONE;
        let copies = usize::from(rule.settings.copies());
        let taken = Taken {
            shape: reply.shape,
            fingerprint: (!reply.refused).then_some(reply.fingerprint),
            window: rule.settings.window().max(took.saturating_mul(2)),
            heard_at: now,
        };
        let before = self.taken.take();
        if copies > 0 {
            self.taken = Some(taken);
        }
        if copies > 1 {
            self.older.extend(before);
            let most = copies.saturating_sub(1);
            let too_many = self.older.len().saturating_sub(most);
            self.older.drain(..too_many);
        }
    }

    /// A read of these elements was answered.
    pub(crate) fn answered(&mut self, run: Option<Run>, spelling: Spelling) {
        if let Some(run) = run {
            self.answered.add(run.first, run.count.max(spelling.count.into()));
        }
    }

    /// A spelling that is not the plain one was refused. `lacks`: the device does not know its command.
    pub(crate) fn spelling_refused(&mut self, plain: Spelling, spelling: Spelling, run: Option<Run>, lacks: bool) {
        if spelling.code == plain.code {
            run.into_iter().for_each(|run| self.answered.forget(run.first));
        } else if lacks {
            self.lacks.insert(spelling.code);
        }
    }

    /// A check has been answered, after this time. Says whether it has proven anything.
    pub(crate) fn checked(&mut self, check: Check, reply: &Reply, took: Duration, rule: &Rule, now: Instant) -> bool {
        let echo = check == Check::Nonce && !reply.refused;
        let proves = echo || self.suspect.is_none() && !(reply.refused && self.threat(reply.shape) > Threat::None);
        if !proves {
            if reply.shape.code == Code::LoopBack && reply.refused {
                self.refused = true;
                self.silent_since = None;
            }
            return false;
        }
        if echo {
            self.is_in_step();
        }
        self.refused = false;
        self.taken(Kind::Once, reply, took, rule, now);
        true
    }

    /// All that was owed has come, or will never come.
    fn is_in_step(&mut self) {
        self.suspect = None;
        self.refused = false;
        self.silent_since = None;
        self.taken = None;
        self.older.clear();
        self.broadcasts = Codes::NONE;
        self.timed_out = Codes::NONE;
        self.proof.proofs = self.proof.proofs.wrapping_add(1);
    }

    /// What a taken reply owes lapses in a silence.
    fn lapse(&mut self, now: Instant) {
        let ends = |taken: &Taken| now.saturating_duration_since(taken.heard_at) >= taken.window;
        if self.taken.is_some_and(|taken| ends(&taken)) {
            self.taken = None;
            self.older.retain(|taken| !ends(taken));
            if self.older.is_empty() && self.suspect.is_none() {
                self.proof.proofs = self.proof.proofs.wrapping_add(1);
            }
        }
    }

    /// The connection is new, and may be to what was asked over another one.
    pub(crate) fn connected(&mut self) {
        self.suspect = Some(Why::Connected);
        self.refused = false;
        self.silent_since = None;
    }

    /// A request was not answered in time, or the connection was lost: the answer may come at any time.
    pub(crate) fn timed_out(&mut self, code: Code) {
        self.suspect = Some(Why::TimedOut);
        self.timed_out.insert(code);
        self.silent_since = None;
    }

    /// A reply came without proof, and its request is to be sent again.
    pub(crate) fn unproven(&mut self, code: Code) {
        self.suspect.get_or_insert(Why::Unproven);
        self.timed_out.insert(code);
    }

    /// A broadcast was sent: the station may answer it.
    pub(crate) fn broadcast(&mut self, code: Code) {
        self.broadcasts.insert(code);
    }

    /// The beginning of a frame was dropped, which may have been a stray of this station: results that are held are in doubt.
    pub(crate) fn lost_beginning(&mut self) {
        self.proof.doubts = self.proof.doubts.wrapping_add(1);
    }

    /// A frame came from the station that no request takes.
    pub(crate) fn stray(&mut self, command: u8, fingerprint: u64, now: Instant) -> Stray {
        self.silent_since = None;
        self.taken.iter_mut().chain(&mut self.older).for_each(|taken| taken.heard_at = now);
        if self.last == Some(fingerprint) {
            return Stray::Duplicate;
        }
        let is_in = |codes: Codes| Code::from_u8(command).is_some_and(|code| codes.contains(code));
        let stray = match (is_in(self.timed_out), is_in(self.broadcasts)) {
            (true, _) => Stray::Late,
            (false, true) => Stray::Broadcast,
            (false, false) => Stray::Unexpected,
        };
        self.suspect.get_or_insert(Why::Stray);
        if stray == Stray::Unexpected {
            self.proof.doubts = self.proof.doubts.wrapping_add(1);
        }
        stray
    }
}

impl Check {
    pub(crate) const EMPTY: Shape = Shape { code: Code::LoopBack, size: 0 };
    pub(crate) const STATUS: Shape = Shape { code: Code::ReadStatus, size: 0 };
    pub(crate) const DETAIL: Shape = Shape { code: Code::ReadDetailedStatus, size: 0 };
}

impl Prices {
    fn of(&self, candidate: &Candidate, plain: Spelling) -> Duration {
        let bytes = self.byte.saturating_mul(u32::try_from(candidate.more_bytes).unwrap_or(u32::MAX));
        // What is left takes its part of another exchange.
        let rest = self.exchange.saturating_mul(candidate.left.into()).checked_div(u32::from(plain.count.max(1)));
        bytes.saturating_add(rest.unwrap_or_default())
    }
}

/// A number for the content of a frame: equal for equal frames, and for others hardly ever.
pub(crate) fn fingerprint(command: u8, data: &[u8]) -> u64 {
    const FACTOR: u64 = 0x9E37_79B9_7F4A_7C15;
    let (words, rest) = data.as_chunks::<8>();
    let mut last = [0; 8];
    last.iter_mut().zip(rest).for_each(|(place, &byte)| *place = byte);
    let seed = u64::from(command) << 32 | u64::try_from(data.len()).unwrap_or(u64::MAX);
    words.iter().chain([&last]).fold(seed.wrapping_mul(FACTOR), |hash, word| {
        (hash.rotate_left(23) ^ u64::from_le_bytes(*word)).wrapping_mul(FACTOR)
    })
}
