//! The link's logic, without I/O and without a clock: calls, bytes and instants go in, steps come out.
//!
//! The states of the connection are [`Connection`], those of a station [`Stations`], those of the request on the wire
//! [`Exchange`], the order of the others is [`Scheduler`]; this is what ties them together. Here it is decided what is done
//! next, and in `outcome` what follows from what has come of it.
//!
//! Whether a reply is that to the request on the wire is decided by the rule of [`InStep`](super::in_step::InStep), one for each
//! station: it chooses how a request is spelt, asks for a check before it, and says whether a reply is proven. The nonce of a
//! check is also the probe of a station that is offline.
//!
//! Invariants:
//! - a call ends once: with its reply, or with an error;
//! - a write or control command is executed once at most, unless the caller has chosen otherwise;
//! - a request is sent only as its station's rule allows, and its reply is given to its call only if it is proven;
//! - a station that does not answer costs the others no more than one response timeout at a time.

mod outcome;
#[cfg(test)]
mod tests;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

use super::call::{InFraming, Ticket};
use super::config::Config;
use super::connection::{Connection, State};
use super::exchange::{Check, Exchange, Goal};
use super::in_step::{self, Choice, InStep, Prices, Proof, Rule, Why};
use super::later;
use super::scheduler::Scheduler;
use super::stations::Stations;
use super::stats::{Board, StationState, add};
use super::transport::Late;
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
    prices: Prices,
    /// The device closes its connection after each reply: set, or learned.
    one_request: bool,
    /// The echo of a check was the last answer over the connection, strays apart.
    echo_was_last: bool,
    /// Connections in a row that were closed right behind the echo of a check.
    closed_behind_echo: u32,
}

/// Connections that are closed right behind the echo of a check before silence replaces the check.
const CLOSES_TO_LEARN: u32 = 2;

/// The part of an exchange that is not its bytes, as it is priced: half a scan of a PLC.
const LATENCY: Duration = Duration::from_millis(5);

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
            prices: prices(&config),
            one_request: config.in_step.one_request(),
            echo_was_last: false,
            closed_behind_echo: 0,
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
                State::Up { .. } if self.connection.is_spent() => {
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
            let code = ticket.code;
            ticket.call.complete_unanswered(Proof::default());
            self.exchange.end();
            self.stations.for_all(|station| station.broadcast(code, at));
            self.hold_until = Some(later(at, self.config.broadcast_gap));
            return;
        }
        let (deadline, patient) = self.response_deadline(&active.goal, at);
        self.exchange.sent(at, deadline, patient);
    }

    /// Datagrams came to the ports of earlier requests, and were dropped.
    pub(crate) fn late_datagrams(&mut self, late: Late) {
        if late.copies > 0 || late.others > 0 {
            let count = late.copies.saturating_add(late.others);
            self.board.count(|link| add(&mut link.late_datagrams, count));
        }
        if late.others > 0 {
            // One of them may be the true reply to a request that a copy has answered, on a port that is used again.
            self.stations.for_all(InStep::lost_beginning);
        }
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
        // Not before: a frame that came with the reply may contradict it.
        self.conclude(now);
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
        self.stations.for_all(InStep::connected);
        self.echo_was_last = false;
        if !self.connection.is_spent() {
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
        self.learn_one_request(error);
        if let Some(ticket) = self.cleared.take() {
            self.scheduler.push_front(ticket);
        }
        if let Some(active) = self.exchange.end() {
            let station = active.goal.station();
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

    /// A device that closes its connection after each reply closes it behind the echo of the check, too.
    fn learn_one_request(&mut self, error: &io::Error) {
        use io::ErrorKind::{BrokenPipe, ConnectionAborted, ConnectionReset, UnexpectedEof};
        let closed = matches!(error.kind(), UnexpectedEof | ConnectionReset | ConnectionAborted | BrokenPipe);
        if !closed || !self.echo_was_last || self.one_request {
            return;
        }
        self.closed_behind_echo = self.closed_behind_echo.saturating_add(1);
        if self.closed_behind_echo >= CLOSES_TO_LEARN {
            self.one_request = true;
            self.board.count(|link| link.one_request = true);
            let quiet = self.config.in_step.quiet();
            tracing::warn!(
                ?quiet,
                "the device closes its connection after each reply: silence replaces the check from now on"
            );
        }
    }

    /// The rule as it holds for a station.
    fn rule(&self, station: u8) -> Rule {
        let settings = self.config.in_step;
        let quiet = settings.quiet().max(self.stations.allowed(station));
        let busy = self.prices.line_time(self.exchange.line_bytes());
        Rule { settings, quiet, one_request: self.one_request, prices: self.prices, busy }
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
            Some(ticket) if ticket.is_wanted(now) => {
                if let Some(goal) = self.goal_of(ticket, now) {
                    return Some(goal);
                }
            }
            Some(ticket) => ticket.expire(),
            None => {}
        }
        if let Some(station) = self.stations.due_probe(now) {
            return Some(self.check(station, in_step::Check::Nonce, Why::Confirm, None));
        }
        loop {
            let ticket = self.scheduler.pop(now)?;
            if let Some(goal) = self.goal_of(ticket, now) {
                return Some(goal);
            }
        }
    }

    /// What is sent for a call: its request, or a check before it. `None`: the station must be silent first, or the call has ended.
    fn goal_of(&mut self, mut ticket: Ticket, now: Instant) -> Option<Goal> {
        let station = ticket.station;
        if ticket.is_broadcast() {
            return Some(Goal::Call(ticket));
        }
        if self.exchange.must_learn_echo() {
            return Some(self.check(station, in_step::Check::Nonce, Why::Connected, Some(ticket)));
        }
        let (rule, framing) = (self.rule(station), self.config.framing);
        let choice = self.stations.with_in_step(station, |known| match ticket.confirms {
            true => known.confirm(&rule, now).ok_or(known.proof()),
            false => Ok(known.choose(&InFraming(&ticket, framing), ticket.plain, &rule, now)),
        });
        match choice {
            Ok(Choice::Send(_)) if self.may_be_executed(&ticket) => {
                let (code, after) = (ticket.code, now.saturating_duration_since(ticket.queued_at));
                ticket.call.fail(Error::OutOfStep { station, code, after, sent: true });
                None
            }
            Ok(Choice::Send(spelling)) => {
                ticket.refused_at = None;
                ticket.call.spell(spelling);
                Some(Goal::Call(ticket))
            }
            Ok(Choice::Check(check, why)) => Some(self.check(station, check, why, Some(ticket))),
            Ok(Choice::Silence(until)) => {
                ticket.call.doubt();
                self.board.count_for(station, |stats| add(&mut stats.silences, 1));
                self.scheduler.push_front(ticket);
                self.scheduler.block(station, until);
                None
            }
            Err(proof) => {
                ticket.call.complete_unanswered(proof);
                None
            }
        }
    }

    /// Whether a write that was refused in another spelling may have been executed: an unexpected frame came since.
    fn may_be_executed(&mut self, ticket: &Ticket) -> bool {
        ticket
            .refused_at
            .is_some_and(|doubts| self.stations.with_in_step(ticket.station, |known| known.proof().doubts != doubts))
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
            self.stations.for_all(InStep::lost_beginning);
        }
        if let Goal::Call(ticket) = &active.goal {
            if ticket.is_broadcast() {
                self.board.count(|link| add(&mut link.broadcasts, 1));
            } else {
                let (plain, spelling) = (ticket.call.plain(), ticket.call.spelling());
                self.stations.allow(station, ticket.response_timeout);
                self.board.count_for(station, |stats| stats.sent(plain, spelling));
                debug_assert!(
                    self.stations.with_in_step(station, |known| {
                        known.allows(&InFraming(ticket, self.config.framing), spelling)
                    }),
                    "rule 2: nothing owed could answer {spelling:?}"
                );
            }
        }
        tracing::trace!(station, bytes = %self.exchange.request().escape_ascii(), "sending");
        Some(Step::Send(deadline))
    }

    /// A check of a station, for a call or as a probe.
    fn check(&mut self, station: u8, check: in_step::Check, why: Why, call: Option<Ticket>) -> Goal {
        if self.exchange.must_learn_echo() {
            self.board.count_for(station, |stats| add(&mut stats.checks, 1));
            return Goal::Check { station, check: Check::Echo, call };
        }
        self.board.count_for(station, |stats| stats.checked(why));
        tracing::debug!(station, ?check, ?why, "check");
        let data = if check == in_step::Check::Nonce {
            self.nonce = self.nonce.wrapping_add(1);
            LoopBack::nonce(self.nonce)
        } else {
            LoopBack::empty()
        };
        Goal::Check { station, check: Check::Separate(check, data), call }
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

fn prices(config: &Config) -> Prices {
    let byte = config.byte_time;
    let frames =
        byte.saturating_mul(2).saturating_mul(u32::try_from(config.framing.frame_overhead()).unwrap_or(u32::MAX));
    Prices { byte, exchange: frames.saturating_add(LATENCY).saturating_add(config.gap) }
}

fn offline(ticket: &Ticket, probe_at: Instant, now: Instant) -> Error {
    let probe_in = probe_at.saturating_duration_since(now);
    Error::Offline { station: ticket.station, probe_in, sent: ticket.call.was_sent() }
}
