//! The link's logic, without I/O and without a clock: calls, bytes and instants go in, steps come out.
//!
//! The states of the connection are [`Connection`], those of a station [`Stations`], those of the request on the wire
//! [`Exchange`], the order of the others is [`Scheduler`]; this is what ties them together. Here it is decided what is done
//! next, and in `outcome` what follows from what has come of it.
//!
//! The protocol has no transaction id: after a timeout, a late reply to the same kind of request looks right. So any
//! doubt makes the station *dirty*: a timeout, a corrupt reply, a frame that nobody asked for. A dirty station is asked
//! nothing until it has echoed a loop-back with a nonce that was never used before; a PLC answers in order, so whatever
//! it sends before that echo is stale. The loop-back is also the probe of a station that is offline.
//!
//! What must always hold:
//! - a call ends once: with its reply, or with an error;
//! - a write or control command is sent once, unless the caller has chosen otherwise;
//! - between a doubt about a station and its next request lies an echoed nonce (or, if the station refuses loop-backs,
//!   a quiet period);
//! - a station that does not answer costs the others no more than one response timeout at a time.

mod outcome;
#[cfg(test)]
mod tests;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

use super::call::Ticket;
use super::config::Config;
use super::connection::{Connection, State};
use super::exchange::{Check, Exchange, Goal};
use super::later;
use super::scheduler::Scheduler;
use super::stations::Stations;
use super::stats::{Board, StationState, add};
use crate::command::LoopBack;
use crate::error::Error;
use crate::random::Random;

/// What the driver has to do next.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Close the connection if there is one and open another, then say [`Core::connected`] or [`Core::connect_failed`].
    Connect,
    /// Close the connection: nobody has used it for long.
    Disconnect,
    /// Write [`Core::outgoing`], by this time, then say [`Core::sent`] or [`Core::disconnected`].
    Send(Instant),
    /// Nothing, until bytes or a call come, or until then.
    Wait(Option<Instant>),
}

#[derive(Debug)]
pub(crate) struct Core {
    config: Config,
    exchange: Exchange,
    scheduler: Scheduler,
    stations: Stations,
    board: Arc<Board>,
    /// A call whose barrier has just been passed: it is sent before all others.
    cleared: Option<Ticket>,
    connection: Connection,
    hold_until: Option<Instant>,
    /// When a call came or ended last; nothing while it is idle.
    used_at: Option<Instant>,
    /// Whether nothing new is sent any more.
    closing: bool,
    nonce: u64,
}

impl Core {
    pub(crate) fn new(config: Config, board: Arc<Board>, seed: u64) -> Self {
        let mut random = Random::new(seed);
        Self {
            exchange: Exchange::new(config.framing, config.echo),
            scheduler: Scheduler::new(config.queue_capacity, config.ageing),
            stations: Stations::new(config.rules),
            board,
            cleared: None,
            hold_until: None,
            used_at: None,
            closing: false,
            nonce: random.next(),
            connection: Connection::new(config.connect_backoff, random),
            config,
        }
    }

    /// Takes a call.
    pub(crate) fn push(&mut self, ticket: Ticket, now: Instant) {
        if self.closing {
            return; // Dropped, it ends with the right error.
        }
        self.used_at = Some(now);
        if let Some(probe_at) = self.stations.offline_until(ticket.station) {
            return ticket.call.fail(offline(&ticket, probe_at, now));
        }
        if let Some(ticket) = self.scheduler.push(ticket, now) {
            let limit = self.config.queue_capacity;
            ticket.call.fail(Error::QueueFull { station: ticket.station, limit });
        }
    }

    /// What is to be done now.
    pub(crate) fn step(&mut self, now: Instant) -> Step {
        loop {
            if let Some(active) = self.exchange.active() {
                if now < active.deadline {
                    return Step::Wait(Some(active.deadline));
                }
                self.give_up(now);
                // What has come by now is looked at before anything else is sent.
                return Step::Wait(Some(now));
            }
            match self.connection.state() {
                State::Connecting => return Step::Wait(None),
                State::Down { retry_at } => {
                    if !self.has_work(now) {
                        if self.falls_idle(now) {
                            continue;
                        }
                        return Step::Wait(self.next_timer());
                    }
                    if let Some(at) = retry_at.filter(|&at| now < at) {
                        return Step::Wait(Some(at));
                    }
                    self.connection.begin();
                    return Step::Connect;
                }
                State::Up { .. } if self.wants_fresh() => {
                    if !self.has_work(now) {
                        if self.falls_idle(now) {
                            return self.disconnect();
                        }
                        return Step::Wait(self.next_timer());
                    }
                    self.connection.begin();
                    return Step::Connect;
                }
                State::Up { .. } => {}
            }
            if let Some(until) = self.hold_until.filter(|&until| now < until) {
                return Step::Wait(Some(until));
            }
            // Before the probes: they alone are no reason to stay connected.
            if self.falls_idle(now) {
                return self.disconnect();
            }
            let Some(goal) = self.next_goal(now) else {
                return Step::Wait(self.next_timer());
            };
            if let Some(step) = self.begin(goal, now) {
                return step;
            }
        }
    }

    /// The bytes to be written.
    pub(crate) fn outgoing(&self) -> &[u8] {
        self.exchange.request()
    }

    /// All of [`outgoing`](Self::outgoing) has been written, and has left or will have left the machine at this time.
    pub(crate) fn sent(&mut self, at: Instant) {
        let Some(active) = self.exchange.active() else { return };
        if let Goal::Call(ticket) = &active.goal
            && ticket.is_broadcast()
        {
            ticket.call.complete_unanswered();
            self.exchange.end();
            self.hold_until = Some(later(at, self.config.broadcast_gap));
            return;
        }
        let (deadline, patient) = self.response_deadline(&active.goal, at);
        self.exchange.sent(at, deadline, patient);
    }

    /// Where the driver puts the bytes it receives; then it says [`received`](Self::received). What is left in it then is
    /// the beginning of a frame.
    pub(crate) fn incoming(&mut self) -> &mut BytesMut {
        &mut self.exchange.received
    }

    /// Bytes have come.
    pub(crate) fn received(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event(now) {
            self.on_event(event, now);
        }
        // A frame is coming in: it is given the time it takes, but not for ever.
        if let (Some(active), false) = (self.exchange.active(), self.exchange.received.is_empty())
            && let Some(sent) = active.sent
        {
            let (usual, _) = self.response_deadline(&active.goal, sent);
            let latest = active.goal.call().map_or(usual, |ticket| ticket.deadline);
            let extended = later(now, self.config.settle).min(later(usual, self.config.frame_time)).min(latest);
            self.exchange.expect_until(extended.max(active.deadline));
        }
    }

    /// The turn to open a connection has come; says whether anybody still wants one.
    pub(crate) fn may_connect(&mut self, now: Instant) -> bool {
        let wanted = self.has_work(now);
        if !wanted {
            self.connection.closed();
        }
        wanted
    }

    /// The connection is open.
    pub(crate) fn connected(&mut self, now: Instant) {
        self.exchange.reconnected();
        if !self.wants_fresh() {
            self.stations.hurry(now);
        }
        self.connection.opened();
        self.board.count(|link| add(&mut link.connects, 1));
    }

    /// The connection could not be opened.
    pub(crate) fn connect_failed(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.board.count(|link| add(&mut link.connect_failures, 1));
        self.connection.failed(now);
        if self.config.fail_fast {
            for ticket in self.cleared.take().into_iter().chain(self.scheduler.drain_all()) {
                let (endpoint, sent) = (self.config.name.to_string(), ticket.call.was_sent());
                ticket.call.fail(Error::Connect { endpoint, source: error.clone(), sent });
            }
        }
    }

    /// The connection is lost.
    pub(crate) fn disconnected(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.board.count(|link| add(&mut link.disconnects, 1));
        self.connection.lost(now);
        self.exchange.forget();
        if let Some(ticket) = self.cleared.take() {
            // The nonce came back over a connection that is gone; behind a bridge the line to the PLC is the same, so
            // the station stays clean.
            self.scheduler.push_front(ticket);
        }
        if let Some(active) = self.exchange.end() {
            let station = active.goal.station();
            if station != BROADCAST {
                self.stations.doubt(station);
            }
            match active.goal.into_call() {
                None => self.probe_failed(station, now),
                Some(ticket) => {
                    let endpoint = self.config.name.to_string();
                    let source = error.clone();
                    self.retry_or_fail(ticket, now, |sent| Error::Disconnected { endpoint, source, sent });
                }
            }
        }
        // Perhaps a station was silent and has been started anew. The next connection is opened to see, after the
        // back-off and not only when the probe would have been due.
        self.stations.hurry(now);
    }

    pub(crate) fn is_closing(&self) -> bool {
        self.closing
    }

    /// Fails all that waits, and sends nothing any more; what is on the wire goes on until it has ended.
    pub(crate) fn close(&mut self) {
        self.closing = true;
        self.cleared = None;
        self.scheduler.drain_all();
    }

    /// Fails all there is: the link cannot go on.
    pub(crate) fn abort(&mut self, error: &Arc<io::Error>) {
        self.board.count(|link| add(&mut link.disconnects, 1));
        let active = self.exchange.end().and_then(|active| active.goal.into_call());
        for ticket in active.into_iter().chain(self.cleared.take()).chain(self.scheduler.drain_all()) {
            let sent = ticket.call.was_sent();
            let endpoint = self.config.name.to_string();
            ticket.call.fail(Error::Disconnected { endpoint, source: error.clone(), sent });
        }
    }

    /// Whether nothing is on the wire.
    pub(crate) fn is_idle(&self) -> bool {
        self.exchange.active().is_none()
    }

    /// Whether nobody has used the link for so long that it is idle from now on: what was known of stations that did
    /// not answer is too old then, and they are not probed for nobody.
    fn falls_idle(&mut self, now: Instant) -> bool {
        if self.idle_at().is_none_or(|at| now < at) || self.cleared.is_some() || self.scheduler.is_waiting(now) {
            return false;
        }
        self.used_at = None;
        for station in self.stations.forget_offline() {
            self.board.state(station, StationState::Unknown);
        }
        true
    }

    fn idle_at(&self) -> Option<Instant> {
        Some(later(self.used_at?, self.config.idle_timeout?))
    }

    fn disconnect(&mut self) -> Step {
        self.connection.closed();
        self.exchange.forget();
        self.board.count(|link| add(&mut link.idle_closes, 1));
        Step::Disconnect
    }

    /// Whether a doubt is a reason to open another connection, and there is one.
    fn wants_fresh(&self) -> bool {
        self.connection.is_doubted() && self.config.fresh_on_doubt
    }

    fn has_work(&mut self, now: Instant) -> bool {
        // A station that is offline is asked nothing but probes, so a probe is reason enough to connect.
        !self.closing
            && (self.cleared.is_some() || self.scheduler.has_work(now) || self.stations.due_probe(now).is_some())
    }

    fn next_goal(&mut self, now: Instant) -> Option<Goal> {
        if self.closing {
            return None;
        }
        match self.cleared.take() {
            // A doubt may have arisen behind the echo.
            Some(ticket) if self.stations.is_dirty(ticket.station) => self.scheduler.push_front(ticket),
            Some(ticket) if ticket.is_wanted(now) => return Some(Goal::Call(ticket)),
            Some(ticket) => ticket.expire(),
            None => {}
        }
        if let Some(station) = self.stations.due_probe(now) {
            return Some(self.check(station, None));
        }
        loop {
            let ticket = self.scheduler.pop(now)?;
            let station = ticket.station;
            if ticket.is_broadcast() {
                return Some(Goal::Call(ticket));
            }
            if self.exchange.must_learn_echo() {
                return Some(self.check(station, Some(ticket)));
            }
            if !self.stations.is_dirty(station) {
                return Some(Goal::Call(ticket));
            }
            if !self.stations.has_refused(station) {
                return Some(self.check(station, Some(ticket)));
            }
            // The next best thing to an echo: silence. Whatever still comes makes the station dirty again.
            let quiet = self.config.quiet.max(self.stations.allowed(station));
            self.stations.clear(station);
            self.scheduler.push_front(ticket);
            self.scheduler.block(station, later(now, quiet));
        }
    }

    fn begin(&mut self, goal: Goal, now: Instant) -> Option<Step> {
        // Not by the caller's own deadline, for a request that is not written in time costs the connection.
        let deadline = later(now, self.response_timeout(&goal).saturating_add(self.config.frame_time));
        if let Goal::Call(ticket) = &goal
            && !ticket.call.mark_sent()
        {
            return None;
        }
        let stale = self.exchange.begin(goal, now, deadline)?;
        let active = self.exchange.active()?;
        let station = active.goal.station();
        if stale > 0 {
            self.board.count(|link| add(&mut link.stale_bytes, u64::try_from(stale).unwrap_or(u64::MAX)));
        }
        match &active.goal {
            Goal::Call(ticket) => {
                if ticket.is_broadcast() {
                    self.board.count(|link| add(&mut link.broadcasts, 1));
                } else {
                    self.stations.allow(station, ticket.response_timeout);
                    self.board.count_for(station, |stats| add(&mut stats.requests, 1));
                }
            }
            Goal::Check { .. } => self.board.count_for(station, |stats| add(&mut stats.checks, 1)),
        }
        tracing::trace!(station, bytes = %self.exchange.request().escape_ascii(), "sending");
        Some(Step::Send(deadline))
    }

    /// What must be settled about a station before a call: first whether the line echoes, then whether it can be
    /// believed.
    fn check(&mut self, station: u8, call: Option<Ticket>) -> Goal {
        if self.exchange.must_learn_echo() {
            return Goal::Check { station, check: Check::Echo, call };
        }
        self.nonce = self.nonce.wrapping_add(1);
        Goal::Check { station, check: Check::Barrier(LoopBack::nonce(self.nonce)), call }
    }

    /// Until when the reply is waited for, and whether that is the whole response timeout.
    fn response_deadline(&self, goal: &Goal, now: Instant) -> (Instant, bool) {
        let deadline = later(now, self.response_timeout(goal));
        match goal.call() {
            Some(ticket) => (deadline.min(ticket.deadline), deadline <= ticket.deadline),
            None => (deadline, true),
        }
    }

    /// How long the station is given for its answer.
    fn response_timeout(&self, goal: &Goal) -> Duration {
        let Some(ticket) = goal.call() else {
            return self.config.probe_timeout.max(self.stations.allowed(goal.station()));
        };
        match ticket.options.adaptive {
            Some(shortest) => self.stations.patience(ticket.station, shortest, ticket.response_timeout),
            None => ticket.response_timeout,
        }
    }

    fn next_timer(&self) -> Option<Instant> {
        let unblocked = self.scheduler.next_unblocked();
        // While a call waits it does not fall idle.
        let idle_at = if unblocked.is_none() { self.idle_at() } else { None };
        [unblocked, self.stations.next_probe(), idle_at].into_iter().flatten().min()
    }
}

/// The station number of a broadcast.
const BROADCAST: u8 = 0;

fn offline(ticket: &Ticket, probe_at: Instant, now: Instant) -> Error {
    let probe_in = probe_at.saturating_duration_since(now);
    Error::Offline { station: ticket.station, probe_in, sent: ticket.call.was_sent() }
}
