//! Handles the result of a request: for its call, its station and the connection.

use std::time::Duration;

use tokio::time::Instant;

use super::{Core, offline};
use crate::command::Code;
use crate::error::{Error, ErrorCode, Seen};
use crate::link::call::{Cause, PendingCall};
use crate::link::exchange::{Active, Event, LinkRequest, Outgoing, may_contain_reply};
use crate::link::in_step::{InStep, Kind, Reply, Stray};
use crate::link::later;
use crate::link::stats::{StationState, add};

impl Core {
    pub(super) fn on_event(&mut self, event: Event, now: Instant) {
        match event {
            Event::Replied => {}
            Event::Echoed => {
                self.stats.count_link(|link| add(&mut link.rare().echoes, 1));
                self.note(&Seen { echo: true, ..Seen::default() });
            }
            Event::Duplicate { station } => self.stats.count_station(station, |stats| add(&mut stats.duplicates, 1)),
            Event::Stray { station, command, fingerprint } => self.stray(station, command, fingerprint, now),
            Event::Noise { reason, bytes } => {
                self.stats.count_discarded(reason, bytes);
                if !may_contain_reply(reason) {
                    self.note(&Seen { garbage: u64::try_from(bytes).unwrap_or(u64::MAX), ..Seen::default() });
                }
                // The reply may have been among these bytes. If not, it comes at once, or finds the
                // station suspect. A call without retries gains nothing by giving up early.
                if let (Some(active), true) = (self.exchange.active(), may_contain_reply(reason))
                    && active.outgoing.call().is_some_and(|call| call.retries_left > 0)
                {
                    let deadline = active.deadline.min(later(now, self.config.settle));
                    self.exchange.expect_until(deadline);
                }
            }
        }
    }

    /// Handles a good frame that no request on the wire takes.
    fn stray(&mut self, station: u8, command: u8, fingerprint: u64, now: Instant) {
        // A station that was never sent a request is suspect anyway. Station 0 has no state.
        let rule = self.rule(station);
        let stray = match self.stations.in_step(station) {
            Some(in_step) => in_step.stray(command, fingerprint, &rule, now),
            None if station == BROADCAST => Stray::Broadcast,
            None => Stray::Unexpected,
        };
        self.mute.reset();
        let late_by = self.timed_out.filter(|&(of, _)| of == station && stray == Stray::Late);
        let late_by = late_by.map(|(_, at)| now.saturating_duration_since(at));
        tracing::debug!(station, command = format_args!("{command:02X}h"), ?stray, ?late_by, "stray frame");
        let own = self.exchange.active().is_some_and(|active| active.outgoing.station() == station);
        self.note(&Seen { late_by, other_station: (!own).then_some(station), ..Seen::default() });
        self.stats.count_station(station, |stats| match stray {
            Stray::Duplicate => add(&mut stats.duplicates, 1),
            Stray::Late => add(&mut stats.late_replies, 1),
            Stray::Broadcast => add(&mut stats.broadcast_answers, 1),
            Stray::Unexpected => add(&mut stats.stray_frames, 1),
        });
    }

    /// Notes traffic received instead of the reply, for the error of the call that waits.
    fn note(&self, seen: &Seen) {
        if let Some(call) = self.exchange.active().and_then(|active| active.outgoing.call()) {
            call.slot.note(seen);
        }
    }

    /// Ends the exchange if its reply has come and all frames that came with it are handled.
    pub(super) fn conclude(&mut self, now: Instant) {
        if let Some(reply) = self.exchange.active().and_then(|active| active.reply)
            && let Some(active) = self.exchange.end()
        {
            self.replied(active, reply, now);
        }
    }

    fn replied(&mut self, active: Active, reply: Reply, now: Instant) {
        let station = active.outgoing.station();
        self.connection.replied();
        self.mute.reset();
        if self.frame_gap.as_mut().is_some_and(|gap| gap.replied(station, active.began, now)) {
            tracing::debug!(station, "no answer after a short frame gap, but after a long one: it is long for a while");
            self.stats.count_link(|link| add(&mut link.rare().long_gaps, 1));
        }
        let took = now.saturating_duration_since(active.began);
        self.scheduler.charge(station, took);
        // The next request waits for the frame gap.
        let gap = self.frame_gap.as_ref().map_or(Duration::ZERO, |gap| gap.length(|| false));
        self.stats.add_bus_time(took.saturating_add(gap));
        // On a network a request is sent when it is begun.
        let sent = active.sent.unwrap_or(active.began);
        let round_trip = if sent == active.began { took } else { now.saturating_duration_since(sent) };
        // While the process was stopped, no round trip was measured.
        let measured = round_trip.min(active.response_timeout);
        // How long the line was silent within that time.
        debug_assert!(self.exchange.line_bytes() >= active.bytes_before, "the bytes of a line only grow");
        let reply_bytes = self.exchange.line_bytes().saturating_sub(active.bytes_before);
        let silent = round_trip.saturating_sub(self.prices.line_time(reply_bytes));
        match active.outgoing {
            Outgoing::Call(call) => {
                self.used_at = Some(now);
                self.one_request.call_answered();
                if self.one_request.is_in_force() {
                    self.connection.spend();
                }
                let slot = &*call.slot;
                let kind = call.kind;
                if active.followed {
                    self.stations.with_in_step(station, InStep::followed);
                }
                let proven = self.stations.with_in_step(station, |in_step| in_step.proves(kind, &reply));
                // Of two answers to a write the first is its own: nothing owed could have answered
                // it.
                let contradicted = kind != Kind::Once && active.followed;
                if !proven || contradicted {
                    return self.unproven(call, &reply, active.copied, now);
                }
                self.answered(station, measured, now);
                let rule = self.rule(station);
                let (plain, spelling, run) = (call.plain, call.spelling, slot.run());
                if reply.refused && spelling != plain {
                    // Only the spelling may be refused.
                    let lacks = active.refusal.is_some_and(ErrorCode::is_about_the_command);
                    let strays = self.stations.with_in_step(station, |in_step| {
                        in_step.taken(kind, &reply, silent, &rule, now);
                        in_step.spelling_refused(plain, spelling, run, lacks);
                        if kind == Kind::Once {
                            in_step.write_refused();
                        }
                        in_step.strays()
                    });
                    self.stats.mark_online(station, |stats| add(&mut stats.refused_spellings, 1));
                    return self.respell(call, (kind == Kind::Once).then_some(strays));
                }
                let proof = self.stations.with_in_step(station, |in_step| {
                    in_step.taken(kind, &reply, silent, &rule, now);
                    if !reply.refused {
                        in_step.answered(run, spelling);
                    }
                    if active.copied {
                        in_step.copied();
                    }
                    in_step.proof()
                });
                self.stats.mark_online(station, |stats| stats.replied(round_trip, reply.refused));
                slot.commit(proof);
            }
            Outgoing::Link { request, call, .. } => {
                self.answered(station, measured, now);
                self.stats.mark_online(station, |_| ());
                let rule = self.rule(station);
                let passed = match request {
                    LinkRequest::Check(check) => {
                        self.one_request.check_answered(!reply.refused);
                        let refused = reply.refused && reply.shape.code == Code::LoopBack;
                        self.stats.count_station(station, |stats| add(&mut stats.refused_checks, u64::from(refused)));
                        self.stations.with_in_step(station, |in_step| {
                            in_step.checked(check, (&reply, active.followed), silent, &rule, now)
                        })
                    }
                    // The reply may be a late one: it proves nothing about the station.
                    LinkRequest::EchoTest => {
                        self.stations.with_in_step(station, |in_step| in_step.unproven(&reply, false, &rule, now));
                        false
                    }
                };
                if let Some(call) = &call {
                    call.slot.check_answered();
                }
                match call {
                    None => self.stations.probe_ended(took, now),
                    Some(call) if passed && call.confirms => {
                        call.slot
                            .complete_without_reply(self.stations.with_in_step(station, |in_step| in_step.proof()));
                    }
                    Some(call) if passed => self.resynced = Some(call),
                    Some(call) => self.scheduler.push_front(call),
                }
            }
        }
    }

    /// Notes that a station has answered within this round trip. The caller sets the
    /// state of the station in the statistics.
    fn answered(&mut self, station: u8, round_trip: Duration, now: Instant) {
        if self.stations.answered(station, round_trip, now) {
            tracing::info!(station, "station is back");
            self.scheduler.forgive(station);
        }
    }

    /// Drops a reply without proof, and sends its request again. The reply may belong to another
    /// request.
    fn unproven(&mut self, mut call: PendingCall, reply: &Reply, copied: bool, now: Instant) {
        let station = call.station;
        let rule = self.rule(station);
        call.slot.retract();
        self.stations.with_in_step(station, |in_step| in_step.unproven(reply, copied, &rule, now));
        self.stats.count_station(station, |stats| add(&mut stats.unproven_replies, 1));
        tracing::debug!(station, "reply without proof dropped");
        let again = !call.unproven_once && call.is_wanted(now) && !self.closing;
        if again {
            call.unproven_once = true;
            self.scheduler.push_front(call);
            return;
        }
        self.retry_or_fail(call, now, |call, after| Error::OutOfStep {
            station,
            code: call.code,
            after,
            sent: call.slot.was_sent(),
        });
    }

    /// Sends a request as the caller made it after another spelling was refused.
    /// `refused_at`: the station's number of strays, if the request is a write.
    fn respell(&mut self, mut call: PendingCall, refused_at: Option<u32>) {
        call.refused_at = refused_at;
        call.slot.retract();
        call.slot.uncount_send();
        call.only_plain = true;
        self.scheduler.push_front(call);
    }

    /// Ends the exchange: its reply has not come, or not whole.
    pub(super) fn give_up(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event_in_silence(now) {
            self.on_event(event, now);
        }
        self.conclude(now);
        let Some(active) = self.exchange.give_up() else { return };
        let station = active.outgoing.station();
        let after = now.saturating_duration_since(active.began);
        let own = matches!(active.outgoing, Outgoing::Call(_));
        self.scheduler.charge_timeout(station, after);
        self.stats.add_bus_time(after);
        self.one_request.timed_out();
        self.timed_out = Some((station, now));
        if let Some(gap) = &mut self.frame_gap {
            let answers = self.stations.is_answering(station) && self.stations.round_trip(station).is_some();
            gap.gave_up(station, answers, active.began);
        }
        self.stations.with_in_step(station, |in_step| in_step.timed_out(active.shape.code));
        self.stats.count_station(station, |stats| match &active.fault {
            Some(_) => add(&mut stats.bad_replies, 1),
            None => add(&mut stats.timeouts, 1),
        });
        let silent = active.fault.is_none();
        let began = active.began;
        let for_call = active.outgoing.call().is_some();
        match active.outgoing.into_call() {
            None => {
                self.stations.probe_ended(after, now);
                self.probe_failed(station, now);
            }
            Some(mut call) => {
                self.used_at = Some(now);
                let cause = active.fault.map_or(Cause::Silence, Cause::Fault);
                tracing::debug!(station, command = %call.code, check = !own, ?cause, after = ?after, "no reply");
                // The cause of the request's own failure is not replaced by that of a check.
                if own {
                    call.cause.get_or_insert_with(|| Box::new(cause));
                    self.retry_or_fail(call, now, PendingCall::unanswered);
                } else if self.may_repeat_check(&call, now) {
                    self.repeat_check(call);
                } else {
                    self.retry_or_fail(call, now, move |call, after| match (call.cause.as_deref(), cause) {
                        (None, Cause::Fault(reason)) => call.slot.unanswered(after, Some(reason)),
                        (Some(_), _) | (None, Cause::Silence) => call.unanswered(after),
                    });
                }
            }
        }
        if silent {
            self.mute.unanswered(began, for_call);
        }
        if silent && let Some(probe_at) = self.stations.timed_out(station, now) {
            tracing::warn!(station, "station is offline");
            self.stats.set_state(station, StationState::Offline { probe_at });
            for call in self.scheduler.drain(station) {
                call.slot.fail(offline(&call, probe_at, now));
            }
        }
    }

    /// Ends the request on the wire, which the send gate has held back. `partly`: a part of it was
    /// written. The caller closes the connection then.
    pub(crate) fn gate_closed(&mut self, partly: bool, now: Instant) {
        let active = if partly { self.exchange.end() } else { self.exchange.withdraw() };
        if let Some(active) = active {
            if partly {
                self.stats.add_bus_time(now.saturating_duration_since(active.began));
            } else if let Outgoing::Call(call) = &active.outgoing {
                call.slot.withdraw_send(active.repeats);
            }
            if let Some(call) = active.outgoing.into_call() {
                self.withhold(&call);
            }
        }
        // With a gate that closes for moments only, a probe could be begun again without end.
        self.forget_offline();
    }

    /// Ends all waiting calls: the send gate is closed. Offline stations become unknown: another master
    /// may have them, and a timer for their probes would find the gate closed each time.
    pub(crate) fn withhold_all(&mut self) {
        for call in self.resynced.take().into_iter().chain(self.scheduler.drain_all()) {
            self.withhold(&call);
        }
        self.forget_offline();
    }

    /// Ends a call that the send gate has held back.
    fn withhold(&self, call: &PendingCall) {
        self.stats.count_link(|link| add(&mut link.rare().withheld, 1));
        let (station, code, sent) = (call.station, call.code, call.slot.was_sent());
        tracing::debug!(station, command = %code, sent, "the send gate is closed");
        call.slot.fail(Error::GateClosed { station, code, sent });
    }

    /// Sends a call again if it has retries left, else ends it with this error, made of the call
    /// and the time since it was made.
    pub(super) fn retry_or_fail(
        &mut self,
        mut call: PendingCall,
        now: Instant,
        error: impl FnOnce(&PendingCall, Duration) -> Error,
    ) {
        match call.retries_left.checked_sub(1) {
            Some(left) if call.is_wanted(now) && !self.closing => {
                call.retries_left = left;
                self.retry(call);
            }
            _ => call.slot.fail(error(&call, now.saturating_duration_since(call.queued_at))),
        }
    }

    /// Returns whether the check before a request that must not be repeated itself may be: nothing
    /// was sent for the request yet.
    pub(super) fn may_repeat_check(&self, call: &PendingCall, now: Instant) -> bool {
        call.check_retries_left > 0 && call.is_wanted(now) && !self.closing
    }

    pub(super) fn repeat_check(&mut self, mut call: PendingCall) {
        call.check_retries_left = call.check_retries_left.saturating_sub(1);
        self.retry(call);
    }

    fn retry(&mut self, call: PendingCall) {
        tracing::debug!(station = call.station, command = %call.code, left = call.retries_left, "retry");
        self.stats.count_station(call.station, |stats| add(&mut stats.retries, 1));
        self.scheduler.push_front(call);
    }

    pub(super) fn probe_failed(&mut self, station: u8, now: Instant) {
        if let Some(probe_at) = self.stations.probe_failed(station, now) {
            self.stats.set_state(station, StationState::Offline { probe_at });
        }
    }
}

/// The station number of a broadcast.
const BROADCAST: u8 = 0;
