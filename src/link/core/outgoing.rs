//! Chooses what is sent next, and begins its exchange.

use std::time::Duration;

use tokio::time::Instant;

use super::{Action, Core};
use crate::error::Error;
use crate::link::call::{CallInFraming, PendingCall, Sending};
use crate::link::config::Config;
use crate::link::exchange::{LinkRequest, Outgoing};
use crate::link::in_step::{self, Choice, InStep, Prices, Rule, Why};
use crate::link::later;
use crate::link::stats::add;

/// A call that has waited for less than this is sent, however little time is left.
const SHORT_WAIT: Duration = Duration::from_millis(1);

/// The decision about a call whose turn it is.
enum Turn {
    /// Its request is sent.
    Send,
    /// A check is sent before it.
    Check(in_step::Check, Why),
    /// Its station must be silent until then.
    Silence(Instant),
    /// Nothing: the call has ended.
    Ended,
}

impl Core {
    /// The rule, with the present settings and figures, for a station.
    pub(super) fn rule(&self, station: u8) -> Rule {
        let settings = self.config.in_step;
        let quiet = settings.quiet().max(self.stations.longest_timeout(station));
        let busy = self.prices.line_time(self.exchange.line_bytes());
        Rule { settings, quiet, one_request: self.one_request.is_in_force(), prices: self.prices, busy }
    }

    pub(super) fn next_outgoing(&mut self, now: Instant) -> Option<Outgoing> {
        if self.closing {
            return None;
        }
        match self.resynced.take() {
            Some(call) if call.is_wanted(now) => {
                if let Some(outgoing) = self.outgoing_for(call, now) {
                    return Some(outgoing);
                }
            }
            Some(call) => call.expire(),
            None => {}
        }
        if let Some(station) = self.stations.due_probe(now) {
            let check = self.stations.with_in_step(station, |in_step| in_step.first_check());
            return Some(self.check(station, check, Why::Confirm, None));
        }
        loop {
            let call = self.scheduler.pop(now)?;
            if !self.can_be_answered(&call, now) {
                call.slot.fail(call.unanswered(now.saturating_duration_since(call.queued_at)));
                continue;
            }
            if let Some(outgoing) = self.outgoing_for(call, now) {
                return Some(outgoing);
            }
        }
    }

    /// Returns whether the reply to a call can still come before its deadline, as far as the round
    /// trips of its station show. Otherwise the PLC would work for a caller that has gone, and the
    /// calls behind would come too late as well.
    ///
    /// A call that has not waited is sent in any case, and so is one to a station that was sent
    /// nothing for the time of a round trip: they show when the round trips become shorter. Writes
    /// are sent, too: the round trip may be that of much longer reads.
    fn can_be_answered(&self, call: &PendingCall, now: Instant) -> bool {
        // Mostly it is sent at once, and the two are equal.
        let has_waited = || now.saturating_duration_since(call.queued_at) >= SHORT_WAIT;
        if call.is_write() || now <= call.queued_at || !has_waited() {
            return true;
        }
        let left = call.deadline.saturating_duration_since(now);
        let is_too_long =
            |expected: Duration| expected > left && self.stations.was_sent_within(call.station, expected, now);
        !self.stations.round_trip(call.station).is_some_and(is_too_long)
    }

    /// Chooses the request for a call: its own, or a check before it. `None`: the station must be silent
    /// first, or the call has ended.
    #[inline]
    fn outgoing_for(&mut self, mut call: PendingCall, now: Instant) -> Option<Outgoing> {
        // Decided by reference: each move of a call takes time.
        match self.turn_of(&mut call, now) {
            Turn::Send => Some(Outgoing::Call(call)),
            Turn::Check(check, why) => Some(self.check(call.station, check, why, Some(call))),
            Turn::Silence(until) => {
                self.put_off(call, until);
                None
            }
            Turn::Ended => None,
        }
    }

    /// Decides what is done for a call whose turn it is.
    fn turn_of(&mut self, call: &mut PendingCall, now: Instant) -> Turn {
        let station = call.station;
        if call.is_broadcast() {
            return Turn::Send;
        }
        if self.exchange.must_learn_echo() {
            return Turn::Check(in_step::Check::Nonce, Why::Connected);
        }
        let (rule, framing) = (self.rule(station), self.config.framing);
        let choice = self.stations.with_in_step(station, |in_step| match call.confirms {
            true => in_step.confirm(&rule, now).ok_or(in_step.proof()),
            false => Ok(in_step.choose(&CallInFraming(call, framing), call.only_plain, &rule, now)),
        });
        match choice {
            Ok(Choice::Send(_)) if self.may_be_executed(call) => {
                let (code, after) = (call.code, now.saturating_duration_since(call.queued_at));
                call.slot.fail(Error::OutOfStep { station, code, after, sent: true });
                Turn::Ended
            }
            Ok(Choice::Send(spelling)) => {
                call.refused_at = None;
                call.spelling = spelling;
                Turn::Send
            }
            Ok(Choice::Check(check, why)) => Turn::Check(check, why),
            Ok(Choice::Silence(until)) => Turn::Silence(until),
            Err(proof) => {
                call.slot.complete_without_reply(proof);
                Turn::Ended
            }
        }
    }

    /// Puts a call back until its station has been silent long enough.
    #[cold]
    fn put_off(&mut self, call: PendingCall, until: Instant) {
        let station = call.station;
        call.slot.await_silence();
        self.stats.count_station(station, |stats| add(&mut stats.silences, 1));
        self.scheduler.push_front(call);
        self.scheduler.block(station, until);
    }

    /// Returns whether a write that was refused in another spelling may have been executed: an
    /// unexpected frame has come since.
    fn may_be_executed(&mut self, call: &PendingCall) -> bool {
        call.refused_at
            .is_some_and(|strays| self.stations.with_in_step(call.station, |in_step| in_step.strays() != strays))
    }

    pub(super) fn begin(&mut self, outgoing: Outgoing, now: Instant) -> Option<Action> {
        // Not limited by the caller's deadline: a request that is not written in time costs the
        // connection.
        let (own_timeout, response_timeout) = self.response_timeouts(&outgoing);
        let written_by = later(now, response_timeout.saturating_add(self.config.frame_time));
        let repeats = match &outgoing {
            Outgoing::Call(call) => call.slot.mark_sent()?,
            Outgoing::Link { .. } => false,
        };
        let stale = self.exchange.begin((outgoing, repeats), response_timeout, now, written_by);
        let active = self.exchange.active()?;
        let station = active.outgoing.station();
        self.stations.note_sent(station, own_timeout, now);
        if stale > 0 {
            self.stats.count_link(|link| add(&mut link.stale_bytes, u64::try_from(stale).unwrap_or(u64::MAX)));
            self.stations.for_all(InStep::input_dropped);
        }
        if let Outgoing::Call(call) = &active.outgoing {
            if call.is_broadcast() {
                self.stats.count_link(|link| add(&mut link.broadcasts, 1));
            } else {
                let (plain, spelling) = (call.plain, call.spelling);
                self.stats.count_station(station, |stats| stats.sent(plain, spelling));
                debug_assert!(
                    self.stations.with_in_step(station, |in_step| {
                        in_step.allows(&CallInFraming(call, self.config.framing), spelling)
                    }),
                    "something owed could answer {spelling:?}"
                );
            }
        }
        tracing::trace!(station, bytes = %self.exchange.request().escape_ascii(), "sending");
        Some(Action::Send(written_by))
    }

    /// Makes a check of a station, for a call or as a probe.
    fn check(&mut self, station: u8, check: in_step::Check, why: Why, call: Option<PendingCall>) -> Outgoing {
        if let Some(call) = &call {
            call.slot.mark_checked();
        }
        if self.exchange.must_learn_echo() {
            self.stats.count_station(station, |stats| add(&mut stats.checks, 1));
            return Outgoing::Link { station, request: LinkRequest::EchoTest, nonce: 0, call };
        }
        self.stats.count_station(station, |stats| stats.checked(why));
        tracing::debug!(station, ?check, ?why, "check");
        if check == in_step::Check::Nonce {
            self.nonce = self.nonce.wrapping_add(1);
        }
        Outgoing::Link { station, request: LinkRequest::Check(check), nonce: self.nonce, call }
    }

    /// The response timeout that a caller has chosen, if the request is that of its call, and the one of
    /// the request. It does not end with the deadline of the call: a reply that its caller no longer
    /// awaits is still the reply to this request, and no stray.
    fn response_timeouts(&self, outgoing: &Outgoing) -> (Option<Duration>, Duration) {
        let Some(call) = outgoing.call() else {
            let longest = self.stations.longest_timeout(outgoing.station());
            return (None, self.config.response_timeout.max(longest));
        };
        let Sending { adaptive, response_timeout: chosen, .. } = call.slot.sending();
        let adapted = |shortest| self.stations.adaptive_timeout(call.station, shortest, chosen);
        let is_own = matches!(outgoing, Outgoing::Call(_));
        (is_own.then_some(chosen), adaptive.map_or(chosen, adapted))
    }
}

/// The prices of separating two requests on the line of these settings.
pub(super) fn prices(config: &Config) -> Prices {
    Prices::new(config.framing, config.byte_time, config.frame_gap.short)
}
