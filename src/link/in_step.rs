//! In step: the rule that a reply is given only to the request it answers. One [`InStep`] a
//! station, without I/O and clock.
//!
//! The protocol has no transaction id. A line may deliver a reply late, lose it, or deliver it more
//! than once. A PLC answers in the order in which it was asked, and the line keeps that order. So a
//! duplicate comes before the true reply to any request sent later. The rule is that of the
//! alternating bit protocol (Bartlett, Scantlebury, Wilkinson 1969), with the bit in the shape of
//! the reply.
//!
//! ```text
//!                 connected, stray, timeout, reply without proof
//!   in step ───────────────────────────────────────────────────────▶ suspect
//!      ▲      nonce echoed, or (behind a refused 4E) silence             │
//!      └─────────────────────────────────────────────────────────────────┘
//! ```
//!
//! A *stray* is a frame of the station that no request on the wire takes. A *check* is a loop-back
//! (4E) with a nonce that was never used before. *Owed* are the shapes of replies that may still
//! come: that of the reply taken last, and those of answers to broadcasts.
//!
//! Invariants:
//! - A suspect station is sent nothing but checks, and only the echo of a check or silence clears
//!   it.
//! - In step, a request is sent only if nothing owed could answer it, in one of its
//!   [spellings](crate::command::Spelling). A read may also be sent while a refusal is owed, and a
//!   program page while a page is owed.
//! - After a reply was taken, its positive shape and the refusal of its command are owed, and
//!   nothing older.
//! - A reply without proof is given to no caller.

mod answered;
#[cfg(test)]
mod checker;
mod terms;
#[cfg(test)]
mod tests;

use std::time::Duration;

use tokio::time::Instant;

use self::answered::AnsweredElements;
use self::terms::ANY_SIZE;
pub(crate) use self::terms::{
    Check, Choice, Declared, Kind, LongestReads, Prices, Proof, Reply, Rule, Shape, Spelled, Stray, Why,
};
use super::{later, nanoseconds};
use crate::command::{Candidate, Code, CommandSet, NO_CANDIDATES, Run, Spelling};

/// The state of the rule for one station.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct InStep {
    /// Why any reply may come; `None`: the station is in step.
    suspect: Option<Why>,
    /// 4E was refused, or the command in its place was answered, without proof since the last proof.
    refused: bool,
    /// The beginning of the silence that replaces a check.
    silent_since: Option<Instant>,
    /// The reply taken last, while a duplicate of it may come.
    taken: Option<Taken>,
    /// Replies taken before that; empty unless duplicates may come later than the next reply.
    older: Vec<Taken>,
    /// Broadcasts that may be answered.
    broadcasts: CommandSet,
    /// Requests that timed out since the last proof.
    timed_out: CommandSet,
    /// The fingerprint of the reply taken last.
    last: Option<u64>,
    /// The fingerprint of the page taken last.
    last_page: Option<u64>,
    /// That page was equal to the one before it.
    equal_pages: bool,
    /// A stray equal to the reply taken last need not be its duplicate: a reply without proof came
    /// since, or it is a page that came while another page was owed. If a roaming duplicate was
    /// taken before, that stray is the true reply.
    ambiguous: bool,
    /// Such a stray came over this connection: a check goes before each page.
    careful: bool,
    /// Commands that the station does not know: spellings that were refused, and those declared.
    lacks: CommandSet,
    /// Commands that are declared as unanswered: no check uses them.
    unanswered: CommandSet,
    /// Longer spellings would be refused.
    longest: LongestReads,
    answered: AnsweredElements,
    /// The silence before the reply, in the slowest of recent exchanges, in nanoseconds.
    slowest: u64,
    proof: Proof,
    /// Number of frames that no request took, duplicates of replies not counted. Late datagrams are
    /// none of these: their port shows that they are of another request.
    strays: u32,
}

/// A reply that was taken, and of which a duplicate may come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Taken {
    shape: Shape,
    /// `None` for a refusal: its duplicate may be any positive reply.
    fingerprint: Option<u64>,
    /// The silence of the station after which no duplicate comes.
    window: Duration,
    heard_at: Instant,
    /// The line's busy time at `heard_at`.
    busy_at: Duration,
}

/// The owed frames that could answer a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Threat {
    None,
    Refusal,
    Reply,
}

impl InStep {
    /// The state of a station at the beginning of a connection.
    pub(crate) fn new() -> Self {
        Self {
            suspect: Some(Why::Connected),
            refused: false,
            silent_since: None,
            taken: None,
            older: Vec::new(),
            broadcasts: CommandSet::NONE,
            timed_out: CommandSet::NONE,
            last: None,
            last_page: None,
            equal_pages: false,
            ambiguous: false,
            careful: false,
            lacks: CommandSet::NONE,
            unanswered: CommandSet::NONE,
            longest: LongestReads::ANY,
            answered: AnsweredElements::new(),
            slowest: 0,
            proof: Proof::default(),
            strays: 0,
        }
    }

    /// The state of a station that is in step and owes nothing.
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

    pub(crate) fn strays(&self) -> u32 {
        self.strays
    }

    /// Chooses what to send for a request. `only_plain`: another spelling of it was refused.
    pub(crate) fn choose(&mut self, request: &impl Spelled, only_plain: bool, rule: &Rule, now: Instant) -> Choice {
        if let Some(choice) = self.prove(rule, now) {
            return choice;
        }
        let spelling = request.plain();
        // A page after two equal ones is probably equal, too, and would be read twice.
        let likely_equal = (self.equal_pages || self.careful) && request.kind() == Kind::Page;
        if self.allows(request, spelling) && !(likely_equal && self.threat(request.shape(spelling)) == Threat::Reply) {
            return Choice::Send(spelling);
        }
        let candidates = if only_plain { NO_CANDIDATES } else { request.candidates() };
        let price = |candidate: &Candidate| rule.prices.of(candidate, spelling);
        let possible = |candidate: &Candidate| {
            let known = candidate.extra.is_none_or(|extra| self.answered.contains(extra));
            let lacking = self.lacks.contains(candidate.spelling.code) && candidate.spelling.code != spelling.code;
            let is_cheaper = rule.prices.is_below_an_exchange(candidate, spelling);
            let fits = self.longest.allows(candidate);
            known && fits && !lacking && self.allows(request, candidate.spelling) && is_cheaper
        };
        let best = candidates.iter().flatten().filter(|candidate| possible(candidate)).min_by_key(|&c| price(c));
        match best {
            Some(candidate) => Choice::Send(candidate.spelling),
            // A refusal owed by an earlier 4E could answer another 4E, which would separate
            // nothing.
            None if spelling.code == Code::LoopBack && request.kind() == Kind::Once => {
                self.separate(Why::Owed, Check::Status, rule, now)
            }
            None => self.separate(Why::Owed, Check::Empty, rule, now),
        }
    }

    /// Chooses what to send to confirm all results so far. `None`: they are confirmed.
    pub(crate) fn confirm(&mut self, rule: &Rule, now: Instant) -> Option<Choice> {
        let suspect = self.suspect.is_some();
        let choice = self.prove(rule, now);
        // A suspect station that needs no check has been silent. The end of the copy window is no
        // proof: a duplicate may have been taken, and the true reply may be slower than the window.
        if choice.is_some() || suspect || rule.settings.copies() == 0 {
            return choice;
        }
        if rule.one_request {
            self.suspect = Some(Why::Confirm);
            return self.prove(rule, now);
        }
        Some(self.separate(Why::Confirm, Check::Nonce, rule, now))
    }

    /// Chooses what a suspect station needs. `None`: it is in step.
    fn prove(&mut self, rule: &Rule, now: Instant) -> Option<Choice> {
        self.lapse(rule, now);
        let why = self.suspect?;
        if !rule.one_request && !self.refused {
            return Some(Choice::Check(self.first_check(), why));
        }
        let until = later(*self.silent_since.get_or_insert(now), rule.quiet);
        if now < until {
            return Some(Choice::Silence(until));
        }
        self.is_in_step();
        None
    }

    /// The check of a suspect station, and the probe of an offline one: 4E, or in its place the first
    /// command that is not declared as unanswered.
    pub(crate) fn first_check(&self) -> Check {
        if !self.unanswered.contains(Code::LoopBack) {
            return Check::Nonce;
        }
        let answered = Check::IN_PLACE.into_iter().find(|(_, shape)| !self.unanswered.contains(shape.code));
        // A station that answers none of them cannot be used.
        answered.map_or(Check::Nonce, |(check, _)| check)
    }

    /// Declares the commands that the station refuses or does not answer and its longest reads, in place of
    /// those declared or found before.
    pub(crate) fn declare(&mut self, declared: Declared) {
        let Declared { refused, unanswered, longest } = declared;
        (self.lacks, self.unanswered, self.longest) = (refused.and(unanswered), unanswered, longest);
    }

    /// Chooses what goes between two requests: `check`, if nothing owed could answer it.
    fn separate(&mut self, why: Why, check: Check, rule: &Rule, now: Instant) -> Choice {
        let free = |shape: Shape| self.threat(shape) == Threat::None;
        let answered = |code: Code| !self.unanswered.contains(code);
        if !self.refused && answered(Code::LoopBack) && matches!(check, Check::Empty | Check::Nonce) {
            // A nonce may always be sent: only its own reply echoes it.
            let empty = check == Check::Empty && free(Check::EMPTY);
            return Choice::Check(if empty { Check::Empty } else { Check::Nonce }, why);
        }
        if let Some((check, _)) = Check::IN_PLACE.into_iter().find(|(_, shape)| free(*shape) && answered(shape.code)) {
            return Choice::Check(check, why);
        }
        self.suspect = Some(why);
        if !self.refused && !answered(Code::LoopBack) {
            return Choice::Check(self.first_check(), why);
        }
        Choice::Silence(later(*self.silent_since.get_or_insert(now), rule.quiet))
    }

    /// Returns whether a request may be sent in this spelling.
    #[inline]
    pub(crate) fn allows(&self, request: &impl Spelled, spelling: Spelling) -> bool {
        // Nothing is owed to the first request after a pause, and on lines without duplicates.
        let threat = if self.owes_nothing() { Threat::None } else { self.threat(request.shape(spelling)) };
        self.suspect.is_none()
            && match request.kind() {
                Kind::Once => threat == Threat::None,
                Kind::Read => threat <= Threat::Refusal,
                Kind::Page => true,
            }
    }

    #[inline]
    fn threat(&self, shape: Shape) -> Threat {
        if self.owes_nothing() {
            return Threat::None;
        }
        let of_taken = self.owed().filter(|taken| taken.shape.code == shape.code).map(|taken| {
            if [shape.size, ANY_SIZE].contains(&taken.shape.size) { Threat::Reply } else { Threat::Refusal }
        });
        // Commands that can be broadcast have positive replies of one size.
        let of_broadcasts = self.broadcasts.contains(shape.code).then_some(Threat::Reply);
        of_taken.chain(of_broadcasts).max().unwrap_or(Threat::None)
    }

    fn owes_nothing(&self) -> bool {
        self.taken.is_none() && self.older.is_empty() && self.broadcasts == CommandSet::NONE
    }

    fn owed(&self) -> impl Iterator<Item = &Taken> {
        self.taken.iter().chain(&self.older)
    }

    /// Returns whether a reply is proven to answer the request on the wire.
    #[inline]
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

    /// Notes that a reply was taken, for which the line was silent this long. Its duplicate may
    /// come; nothing older may.
    pub(crate) fn taken(&mut self, kind: Kind, reply: &Reply, took: Duration, rule: &Rule, now: Instant) {
        // Decays slowly: a reply that comes at once may be a duplicate.
        self.slowest = nanoseconds(took).max(self.slowest.saturating_sub(self.slowest / 8));
        if kind == Kind::Page {
            self.equal_pages = !reply.refused && self.last_page == Some(reply.fingerprint);
            self.last_page = Some(reply.fingerprint);
        }
        self.ambiguous = kind == Kind::Page && self.owed().any(|taken| taken.shape == reply.shape);
        self.last = Some(reply.fingerprint);
        self.broadcasts = CommandSet::NONE;
        let fingerprint = (!reply.refused).then_some(reply.fingerprint);
        let before = self.taken.take();
        if rule.settings.copies() > 0 {
            self.taken = Some(self.owed_frame(reply.shape, fingerprint, rule, now));
        }
        self.remember(before, rule);
    }

    fn owed_frame(&self, shape: Shape, fingerprint: Option<u64>, rule: &Rule, now: Instant) -> Taken {
        let window = rule.settings.window().max(Duration::from_nanos(self.slowest.saturating_mul(2)));
        Taken { shape, fingerprint, window, heard_at: now, busy_at: rule.busy }
    }

    /// Keeps a frame whose duplicate may come later than the next reply, if duplicates roam.
    fn remember(&mut self, frame: Option<Taken>, rule: &Rule) {
        let most = usize::from(rule.settings.copies()).saturating_sub(1);
        if most > 0 {
            self.older.extend(frame);
            let too_many = self.older.len().saturating_sub(most);
            self.older.drain(..too_many);
        }
    }

    /// Notes that a read of these elements was answered.
    pub(crate) fn answered(&mut self, run: Option<Run>, spelling: Spelling) {
        if let Some(run) = run {
            // In a spelling of a mixed read the first element stands twice.
            self.answered.add(run.first, if run.count == 1 { 1 } else { spelling.count_behind() });
        }
    }

    /// Notes that a spelling other than the plain one was refused. `lacks`: the device does not
    /// know its command.
    pub(crate) fn spelling_refused(&mut self, plain: Spelling, spelling: Spelling, run: Option<Run>, lacks: bool) {
        if spelling.code == plain.code {
            run.into_iter().for_each(|run| self.answered.forget(run.first));
        } else if lacks {
            self.lacks.insert(spelling.code);
        }
    }

    /// Notes that a write was refused in another spelling, and is to be sent as the caller made it:
    /// not before a check has shown that the refusal was its own.
    pub(crate) fn write_refused(&mut self) {
        self.suspect.get_or_insert(Why::Confirm);
    }

    /// Handles the reply to a check. Returns whether it has proven anything.
    ///
    /// `followed`: a stray came after the reply in the same read. `took`: the silence before the
    /// reply.
    pub(crate) fn checked(
        &mut self,
        check: Check,
        (reply, followed): (&Reply, bool),
        took: Duration,
        rule: &Rule,
        now: Instant,
    ) -> bool {
        let echo = check == Check::Nonce && !reply.refused;
        let proves = echo || self.suspect.is_none() && !(reply.refused && self.threat(reply.shape) > Threat::None);
        if !proves {
            let is_refusal = reply.shape.code == Code::LoopBack && reply.refused;
            let in_its_place = check != Check::Nonce && check == self.first_check();
            self.refused |= is_refusal || in_its_place;
            // The silence begins behind every reply: its duplicate may come.
            self.silent_since = None;
            return false;
        }
        if echo {
            let (taken, older) = (self.taken, std::mem::take(&mut self.older));
            self.is_in_step();
            if rule.settings.copies() > 1 {
                // A duplicate that may come later than the next reply may come later than the echo.
                (self.taken, self.older) = (taken, older);
            }
        }
        self.refused = false;
        self.taken(Kind::Once, reply, took, rule, now);
        if followed {
            self.followed();
            // The frame after the echo is none of those that came before it.
            self.suspect = Some(Why::Stray);
        }
        !followed
    }

    /// Puts the station in step: all that was owed has come, or will never come.
    fn is_in_step(&mut self) {
        self.suspect = None;
        self.refused = false;
        self.silent_since = None;
        self.taken = None;
        self.older.clear();
        self.broadcasts = CommandSet::NONE;
        self.timed_out = CommandSet::NONE;
        self.proof.proofs = self.proof.proofs.wrapping_add(1);
    }

    /// Drops replies whose copy window has passed in silence. The time of frames of other stations
    /// does not count, for a duplicate waits while they use the line.
    fn lapse(&mut self, rule: &Rule, now: Instant) {
        let ends = |taken: &Taken| {
            debug_assert!(rule.busy >= taken.busy_at, "the time of a line's frames only grows");
            let busy = rule.busy.saturating_sub(taken.busy_at);
            now.saturating_duration_since(taken.heard_at).saturating_sub(busy) >= taken.window
        };
        if self.taken.is_some_and(|taken| ends(&taken)) {
            self.taken = None;
            self.older.retain(|taken| !ends(taken));
        }
    }

    /// Notes that a duplicate of the reply taken last came, or a frame equal to it.
    pub(crate) fn copied(&mut self) {
        if self.ambiguous {
            self.careful = true;
            self.doubt();
        }
    }

    /// Notes that a frame of the station came after a reply in the same read, and is no duplicate
    /// of it. A duplicate of anything older would have come before the reply.
    pub(crate) fn followed(&mut self) {
        self.strays = self.strays.wrapping_add(1);
        self.doubt();
    }

    fn doubt(&mut self) {
        self.proof.doubts = self.proof.doubts.wrapping_add(1);
    }

    /// Notes a new connection: it may deliver replies to requests of another one.
    pub(crate) fn connected(&mut self) {
        self.careful = false;
        self.suspect = Some(Why::Connected);
        self.refused = false;
        self.silent_since = None;
    }

    /// Notes a timeout or a lost connection: the reply may come at any time.
    pub(crate) fn timed_out(&mut self, code: Code) {
        self.suspect = Some(Why::TimedOut);
        self.timed_out.insert(code);
        self.silent_since = None;
    }

    /// Notes a reply without proof, whose request is sent again. `copied`: a duplicate of it came
    /// in the same read.
    ///
    /// The reply to that request may still come, and so may the true reply to a read that a roaming
    /// duplicate has answered. So a later frame is unexpected, and a duplicate that came with the
    /// reply may be one of these: both put a job's results in doubt.
    pub(crate) fn unproven(&mut self, reply: &Reply, copied: bool, rule: &Rule, now: Instant) {
        self.suspect.get_or_insert(Why::Unproven);
        self.ambiguous = true;
        // A silence that ended with this reply proves nothing.
        self.restart_silence(now);
        if copied {
            self.doubt();
        }
        let fingerprint = (!reply.refused).then_some(reply.fingerprint);
        self.remember(Some(self.owed_frame(reply.shape, fingerprint, rule, now)), rule);
    }

    /// Notes that a broadcast was sent: the station may answer it.
    pub(crate) fn broadcast(&mut self, code: Code, now: Instant) {
        self.broadcasts.insert(code);
        self.restart_silence(now);
    }

    fn restart_silence(&mut self, now: Instant) {
        if let Some(since) = &mut self.silent_since {
            *since = now;
        }
    }

    /// Notes that a part of a frame, or a late datagram, was dropped. It may have been a stray of
    /// this station, so held results are in doubt.
    pub(crate) fn input_dropped(&mut self) {
        self.doubt();
    }

    /// Handles a frame of the station that no request takes.
    pub(crate) fn stray(&mut self, command: u8, fingerprint: u64, rule: &Rule, now: Instant) -> Stray {
        self.restart_silence(now);
        self.taken.iter_mut().chain(&mut self.older).for_each(|taken| {
            (taken.heard_at, taken.busy_at) = (now, rule.busy);
        });
        if self.last == Some(fingerprint) {
            self.copied();
            return Stray::Duplicate;
        }
        if let Some(code) = Code::from_u8(command) {
            self.remember(Some(self.owed_frame(Shape { code, size: ANY_SIZE }, None, rule, now)), rule);
        }
        let is_in = |codes: CommandSet| Code::from_u8(command).is_some_and(|code| codes.contains(code));
        let stray = match (is_in(self.timed_out), is_in(self.broadcasts)) {
            (true, _) => Stray::Late,
            (false, true) => Stray::Broadcast,
            (false, false) => Stray::Unexpected,
        };
        self.suspect.get_or_insert(Why::Stray);
        if stray == Stray::Unexpected {
            self.strays = self.strays.wrapping_add(1);
            self.doubt();
        }
        stray
    }
}
