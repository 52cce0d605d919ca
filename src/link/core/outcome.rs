//! What follows from what has come of a request: for its call, for the station, and for the connection.

use tokio::time::Instant;

use super::{Core, offline};
use crate::error::Error;
use crate::link::call::Ticket;
use crate::link::exchange::{Active, Check, Event, Goal, spoils};
use crate::link::later;
use crate::link::stats::{StationState, add};

impl Core {
    pub(super) fn on_event(&mut self, event: Event, now: Instant) {
        match event {
            Event::Replied { refused } => {
                if let Some(active) = self.exchange.end() {
                    self.replied(active, refused, now);
                }
            }
            Event::Echoed => self.board.count(|link| add(&mut link.echoes, 1)),
            Event::Stray { station } => {
                self.board.count_for(station, |stats| add(&mut stats.stray_frames, 1));
                let awaited = self.exchange.active().is_some_and(|active| active.goal.station() == station);
                // A station that nobody has asked anything is nobody's concern.
                if !awaited && self.stations.knows(station) {
                    self.doubt(station);
                }
            }
            Event::Noise { reason, bytes } => {
                self.board.discarded(reason, bytes);
                // The reply may have been in it. If it was not, it comes at once, or finds the station dirty. A call
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

    fn replied(&mut self, active: Active, refused: bool, now: Instant) {
        let station = active.goal.station();
        self.connection.replied();
        self.hold_until = Some(later(now, self.config.gap));
        let took = now.saturating_duration_since(active.began);
        self.scheduler.charge(station, took);
        let round_trip = now.saturating_duration_since(active.sent.unwrap_or(active.began));
        if self.stations.answered(station, round_trip, now) {
            tracing::info!(station, "station is back");
        }
        let is_call = matches!(active.goal, Goal::Call(_));
        self.board.answered(station, |stats| {
            if is_call {
                stats.replied(round_trip, refused);
            }
        });
        match active.goal {
            Goal::Call(_) => {
                self.used_at = Some(now);
                if active.doubtful {
                    self.doubt(station);
                }
            }
            Goal::Check { check, call, .. } => {
                let passed = matches!(check, Check::Barrier(_)) && !refused;
                match check {
                    Check::Barrier(_) if refused => self.stations.loop_back_refused(station),
                    Check::Barrier(_) => self.stations.clear(station),
                    Check::Echo if active.doubtful => self.doubt(station),
                    Check::Echo => {}
                }
                match call {
                    None => self.stations.probe_ended(took, now),
                    Some(ticket) if passed => self.cleared = Some(ticket),
                    Some(ticket) => self.scheduler.push_front(ticket),
                }
            }
        }
    }

    /// The reply to what is on the wire has not come, or not whole.
    pub(super) fn give_up(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event_in_silence(now) {
            self.on_event(event, now);
        }
        let Some(active) = self.exchange.give_up() else { return };
        let station = active.goal.station();
        let after = now.saturating_duration_since(active.began);
        self.scheduler.charge(station, after);
        self.doubt(station);
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

    fn doubt(&mut self, station: u8) {
        self.stations.doubt(station);
        self.connection.doubt();
    }

    pub(super) fn probe_failed(&mut self, station: u8, now: Instant) {
        if let Some(probe_at) = self.stations.probe_failed(station, now) {
            self.board.state(station, StationState::Offline { probe_at });
        }
    }
}
