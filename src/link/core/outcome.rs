//! What follows from what has come of a request: for its call, for the station, and for the connection.

use std::time::Duration;

use tokio::time::Instant;

use super::{Core, offline};
use crate::command::Code;
use crate::error::{Error, ErrorCode};
use crate::link::call::Ticket;
use crate::link::exchange::{Active, Check, Event, Goal, spoils};
use crate::link::in_step::{InStep, Kind, Reply, Stray};
use crate::link::later;
use crate::link::stats::{StationState, add};

impl Core {
    pub(super) fn on_event(&mut self, event: Event, now: Instant) {
        match event {
            Event::Replied => {}
            Event::Echoed => self.board.count(|link| add(&mut link.echoes, 1)),
            Event::Copy { station } => self.board.count_for(station, |stats| add(&mut stats.duplicates, 1)),
            Event::Stray { station, command, fingerprint } => self.stray(station, command, fingerprint, now),
            Event::Noise { reason, bytes } => {
                self.board.discarded(reason, bytes);
                // The reply may have been in it. If it was not, it comes at once, or finds the station suspect. A call
                // that is not repeated has nothing to gain from giving up early.
                if let (Some(active), true) = (self.exchange.active(), spoils(reason))
                    && active.goal.call().is_some_and(|ticket| ticket.retries_left > 0)
                {
                    let deadline = active.deadline.min(later(now, self.config.settle));
                    self.exchange.expect_until(deadline);
                }
            }
        }
    }

    /// A good frame that no request on the wire takes.
    fn stray(&mut self, station: u8, command: u8, fingerprint: u64, now: Instant) {
        // A station that has not been asked anything is suspect anyway; station 0 is no station.
        let rule = self.rule(station);
        let stray = match self.stations.in_step(station) {
            Some(known) => known.stray(command, fingerprint, &rule, now),
            None if station == BROADCAST => Stray::Broadcast,
            None => Stray::Unexpected,
        };
        tracing::debug!(station, command, ?stray, "stray frame");
        self.board.count_for(station, |stats| match stray {
            Stray::Duplicate => add(&mut stats.duplicates, 1),
            Stray::Late => add(&mut stats.late_replies, 1),
            Stray::Broadcast => add(&mut stats.broadcast_answers, 1),
            Stray::Unexpected => add(&mut stats.stray_frames, 1),
        });
    }

    /// All that came with the reply is understood: the exchange is over.
    pub(super) fn conclude(&mut self, now: Instant) {
        if let Some(reply) = self.exchange.active().and_then(|active| active.reply)
            && let Some(active) = self.exchange.end()
        {
            self.replied(active, reply, now);
        }
    }

    fn replied(&mut self, active: Active, reply: Reply, now: Instant) {
        let station = active.goal.station();
        self.connection.replied();
        self.hold_until = Some(later(now, self.config.gap));
        let took = now.saturating_duration_since(active.began);
        self.scheduler.charge(station, took);
        let round_trip = now.saturating_duration_since(active.sent.unwrap_or(active.began));
        // Of that the line was silent for this long.
        let reply_bytes = self.exchange.line_bytes().saturating_sub(active.bytes_before);
        let silent = round_trip.saturating_sub(self.prices.line_time(reply_bytes));
        match active.goal {
            Goal::Call(ticket) => {
                self.used_at = Some(now);
                self.echo_was_last = false;
                self.closed_behind_echo = 0;
                if self.one_request {
                    self.connection.spend();
                }
                let kind = ticket.call.kind();
                if active.followed {
                    self.stations.with_in_step(station, InStep::followed);
                }
                let proven = self.stations.with_in_step(station, |known| known.proves(kind, &reply));
                // Of two answers to a write the first is its own, for nothing owed could have answered it.
                let contradicted = kind != Kind::Once && active.followed;
                if !proven || contradicted {
                    return self.unproven(ticket, &reply, active.copied, now);
                }
                self.is_there(station, round_trip, now);
                let rule = self.rule(station);
                let (plain, spelling, run) = (ticket.call.plain(), ticket.call.spelling(), ticket.call.run());
                if reply.refused && spelling != plain {
                    // It may be the spelling that is refused.
                    let lacks = active.refusal.is_some_and(is_about_the_command);
                    let doubts = self.stations.with_in_step(station, |known| {
                        known.taken(kind, &reply, silent, &rule, now);
                        known.spelling_refused(plain, spelling, run, lacks);
                        if kind == Kind::Once {
                            known.write_refused();
                        }
                        known.proof().doubts
                    });
                    self.board.count_for(station, |stats| add(&mut stats.refused_spellings, 1));
                    return self.respell(ticket, (kind == Kind::Once).then_some(doubts));
                }
                let proof = self.stations.with_in_step(station, |known| {
                    known.taken(kind, &reply, silent, &rule, now);
                    if !reply.refused {
                        known.answered(run, spelling);
                    }
                    if active.copied {
                        known.copied();
                    }
                    known.proof()
                });
                self.board.answered(station, |stats| stats.replied(round_trip, reply.refused));
                ticket.call.commit(proof);
            }
            Goal::Check { check, call, .. } => {
                self.is_there(station, round_trip, now);
                let rule = self.rule(station);
                let passed = match check {
                    Check::Separate(check, _) => {
                        self.echo_was_last = !reply.refused;
                        let refused = reply.refused && reply.shape.code == Code::LoopBack;
                        self.board.count_for(station, |stats| add(&mut stats.refused_checks, u64::from(refused)));
                        self.stations.with_in_step(station, |known| {
                            known.checked(check, (&reply, active.followed), silent, &rule, now)
                        })
                    }
                    // The reply may be a late one: it shows nothing of the station.
                    Check::Echo => {
                        self.stations.with_in_step(station, |known| known.unproven(&reply, false, &rule, now));
                        false
                    }
                };
                match call {
                    None => self.stations.probe_ended(took, now),
                    Some(ticket) if passed && ticket.confirms => {
                        ticket.call.complete_unanswered(self.stations.with_in_step(station, |known| known.proof()));
                    }
                    Some(ticket) if passed => self.cleared = Some(ticket),
                    Some(ticket) => self.scheduler.push_front(ticket),
                }
            }
        }
    }

    /// A station has answered.
    fn is_there(&mut self, station: u8, round_trip: Duration, now: Instant) {
        if self.stations.answered(station, round_trip, now) {
            tracing::info!(station, "station is back");
        }
        self.board.answered(station, |_| ());
    }

    /// A reply that may be another request's is given to no caller.
    fn unproven(&mut self, mut ticket: Ticket, reply: &Reply, copied: bool, now: Instant) {
        let station = ticket.station;
        let rule = self.rule(station);
        ticket.call.retract();
        self.stations.with_in_step(station, |known| known.unproven(reply, copied, &rule, now));
        self.board.count_for(station, |stats| add(&mut stats.unproven_replies, 1));
        tracing::debug!(station, "the reply may be one to an earlier request");
        let again = !ticket.asked_again && ticket.is_wanted(now) && !self.closing;
        if again {
            ticket.asked_again = true;
            self.scheduler.push_front(ticket);
            return;
        }
        let (code, after) = (ticket.code, now.saturating_duration_since(ticket.queued_at));
        self.retry_or_fail(ticket, now, |sent| Error::OutOfStep { station, code, after, sent });
    }

    /// Sends a request as itself that was refused in another spelling.
    fn respell(&mut self, mut ticket: Ticket, refused_at: Option<u32>) {
        ticket.refused_at = refused_at;
        ticket.call.retract();
        ticket.call.respelled();
        ticket.plain = true;
        self.scheduler.push_front(ticket);
    }

    /// The reply to what is on the wire has not come, or not whole.
    pub(super) fn give_up(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event_in_silence(now) {
            self.on_event(event, now);
        }
        self.conclude(now);
        let Some(active) = self.exchange.give_up() else { return };
        let station = active.goal.station();
        let after = now.saturating_duration_since(active.began);
        self.scheduler.charge(station, after);
        self.echo_was_last = false;
        self.stations.with_in_step(station, |known| known.timed_out(active.shape.code));
        self.board.count_for(station, |stats| match &active.fault {
            Some(_) => add(&mut stats.bad_replies, 1),
            None => add(&mut stats.timeouts, 1),
        });
        // A caller whose own time was up before the response timeout says nothing about the station.
        let silent = active.fault.is_none() && active.patient;
        match active.goal.into_call() {
            None => {
                self.stations.probe_ended(after, now);
                self.probe_failed(station, now);
            }
            Some(ticket) => {
                self.used_at = Some(now);
                let code = ticket.code;
                let fault = active.fault;
                self.retry_or_fail(ticket, now, |sent| match fault {
                    Some(reason) => Error::BadReply { station, code, after, reason, sent },
                    None => Error::Timeout { station, code, after, sent },
                });
            }
        }
        if silent && let Some(probe_at) = self.stations.timed_out(station, now) {
            tracing::warn!(station, "station is offline");
            self.board.state(station, StationState::Offline { probe_at });
            for ticket in self.scheduler.drain(station) {
                ticket.call.fail(offline(&ticket, probe_at, now));
            }
        }
    }

    pub(super) fn retry_or_fail(&mut self, mut ticket: Ticket, now: Instant, error: impl FnOnce(bool) -> Error) {
        match ticket.retries_left.checked_sub(1) {
            Some(left) if ticket.is_wanted(now) && !self.closing => {
                ticket.retries_left = left;
                self.board.count_for(ticket.station, |stats| add(&mut stats.retries, 1));
                self.scheduler.push_front(ticket);
            }
            _ => ticket.call.fail(error(ticket.call.was_sent())),
        }
    }

    pub(super) fn probe_failed(&mut self, station: u8, now: Instant) {
        if let Some(probe_at) = self.stations.probe_failed(station, now) {
            self.board.state(station, StationState::Offline { probe_at });
        }
    }
}

/// The station number of a broadcast.
const BROADCAST: u8 = 0;

/// Whether an error code may say that the device does not know the command.
fn is_about_the_command(code: ErrorCode) -> bool {
    match code {
        ErrorCode::IllegalFormat | ErrorCode::NotSupported | ErrorCode::Unknown(_) => true,
        ErrorCode::IllegalValue
        | ErrorCode::WriteProhibited
        | ErrorCode::LadderChecksum
        | ErrorCode::IdMismatch
        | ErrorCode::Syntax
        | ErrorCode::IllegalAddress => false,
    }
}
