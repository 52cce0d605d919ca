//! The link's logic, without I/O and without a clock: calls, bytes and instants go in, steps come out.
//!
//! ```text
//! connection   down ──Connect──▶ connecting ──▶ up ──lost──▶ down (again after a back-off)
//! station      clean ──doubt──▶ dirty ──loop-back echoed──▶ clean
//!              online ──timeouts in a row──▶ offline ──probe echoed──▶ online
//! ```
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

use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

use super::call::Ticket;
use super::exchange::{Active, Event, Exchange, Goal};
use super::random::Random;
use super::scheduler::Scheduler;
use crate::command::LoopBack;
use crate::error::Error;
use crate::wire::{Discard, Framing};

/// What the driver has to do next.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Open the connection, then say [`Core::connected`] or [`Core::connect_failed`].
    Connect,
    /// Write [`Core::outgoing`], by this time, then say [`Core::sent`] or [`Core::disconnected`].
    Send(Instant),
    /// Nothing, until bytes or a call come, or until then.
    Wait(Option<Instant>),
}

/// How the link behaves towards all its stations.
#[derive(Clone, Debug)]
pub(crate) struct Config {
    pub(crate) framing: Framing,
    /// What the errors call the other end.
    pub(crate) name: Arc<str>,
    pub(crate) queue_capacity: usize,
    pub(crate) ageing: Duration,
    /// The response timeout of a probe.
    pub(crate) probe_timeout: Duration,
    pub(crate) offline_after: u32,
    pub(crate) probe_interval: (Duration, Duration),
    /// After a probe that took a time, none for so many times as long.
    pub(crate) probe_pause: u32,
    pub(crate) connect_backoff: (Duration, Duration),
    /// Whether calls fail as soon as an attempt to connect does, instead of waiting for the next one.
    pub(crate) fail_fast: bool,
    /// How long the line must be silent about a station that refuses loop-backs.
    pub(crate) quiet: Duration,
    /// How long to go on listening after a corrupt frame, in which the reply may have been.
    pub(crate) settle: Duration,
    /// How long the line is left alone after a broadcast.
    pub(crate) broadcast_gap: Duration,
}

#[derive(Debug)]
pub(crate) struct Core {
    config: Config,
    exchange: Exchange,
    scheduler: Scheduler,
    stations: BTreeMap<u8, Health>,
    /// A call whose barrier has just been passed: it is sent before all others.
    cleared: Option<Ticket>,
    connection: Connection,
    /// Attempts to connect, and connections that ended without a single reply, since the last reply.
    failures: u32,
    hold_until: Option<Instant>,
    probe_allowed_at: Option<Instant>,
    nonce: u64,
    random: Random,
    outgoing: BytesMut,
    stale_bytes: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Connection {
    Down { retry_at: Option<Instant> },
    Connecting,
    Up { replied: bool },
}

/// What is known of a station.
#[derive(Debug, Default)]
struct Health {
    dirty: bool,
    /// Timeouts in a row.
    timeouts: u32,
    offline: Option<Offline>,
    refuses_loop_back: bool,
}

#[derive(Debug)]
struct Offline {
    probe_at: Instant,
    interval: Duration,
}

impl Core {
    pub(crate) fn new(config: Config, seed: u64) -> Self {
        let mut random = Random::new(seed);
        Self {
            exchange: Exchange::new(config.framing),
            scheduler: Scheduler::new(config.queue_capacity, config.ageing),
            stations: BTreeMap::new(),
            cleared: None,
            connection: Connection::Down { retry_at: None },
            failures: 0,
            hold_until: None,
            probe_allowed_at: None,
            nonce: random.next(),
            random,
            outgoing: BytesMut::new(),
            stale_bytes: 0,
            config,
        }
    }

    /// Takes a call.
    pub(crate) fn push(&mut self, ticket: Ticket, now: Instant) {
        if let Some(offline) = self.stations.get(&ticket.station).and_then(|health| health.offline.as_ref()) {
            return ticket.call.fail(offline_error(&ticket, offline, now));
        }
        if let Err(ticket) = self.scheduler.push(ticket, now) {
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
                continue;
            }
            match self.connection {
                Connection::Up { .. } => {}
                Connection::Connecting => return Step::Wait(None),
                Connection::Down { retry_at } => {
                    if !self.has_work(now) {
                        return Step::Wait(self.scheduler.next_unblocked());
                    }
                    if let Some(at) = retry_at.filter(|&at| now < at) {
                        return Step::Wait(Some(at));
                    }
                    self.connection = Connection::Connecting;
                    return Step::Connect;
                }
            }
            if let Some(until) = self.hold_until.filter(|&until| now < until) {
                return Step::Wait(Some(until));
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
        &self.outgoing
    }

    /// All of [`outgoing`](Self::outgoing) has been written, and left the machine at this time.
    pub(crate) fn sent(&mut self, now: Instant) {
        self.outgoing.clear();
        let Some(active) = self.exchange.active() else { return };
        match &active.goal {
            Goal::Call(ticket) if ticket.is_broadcast() => {
                ticket.call.complete_unanswered();
                self.exchange.end();
                self.hold_until = now.checked_add(self.config.broadcast_gap);
            }
            goal => {
                let (deadline, patient) = self.response_deadline(goal, now);
                self.exchange.expect_until(deadline, patient);
            }
        }
    }

    /// Where the driver puts the bytes it receives; then it says [`received`](Self::received).
    pub(crate) fn incoming(&mut self) -> &mut BytesMut {
        &mut self.exchange.received
    }

    /// Bytes have come.
    pub(crate) fn received(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event() {
            self.on_event(event, now);
        }
    }

    /// The connection is open.
    pub(crate) fn connected(&mut self, now: Instant) {
        self.connection = Connection::Up { replied: false };
        self.exchange.forget();
        // Whatever was the matter with the stations, it may have been the connection: ask again soon.
        for offline in self.stations.values_mut().filter_map(|health| health.offline.as_mut()) {
            offline.probe_at = now;
        }
    }

    /// The connection could not be opened.
    pub(crate) fn connect_failed(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.failed_to_connect(now);
        if self.config.fail_fast {
            for ticket in self.scheduler.drain_all() {
                ticket.call.fail(self.connect_error(error));
            }
        }
    }

    /// The connection is lost.
    pub(crate) fn disconnected(&mut self, error: &Arc<io::Error>, now: Instant) {
        if self.connection == (Connection::Up { replied: true }) {
            self.connection = Connection::Down { retry_at: None };
        } else {
            self.failed_to_connect(now);
        }
        self.outgoing.clear();
        self.exchange.forget();
        if let Some(ticket) = self.cleared.take() {
            // The nonce came back over a connection that is gone; behind a bridge the line to the PLC is the same, so
            // the station stays clean.
            self.scheduler.push_front(ticket);
        }
        if let Some(active) = self.exchange.end() {
            let station = active.goal.station();
            if station != 0 {
                self.health(station).dirty = true;
            }
            let endpoint = self.config.name.to_string();
            let source = error.clone();
            match active.goal {
                Goal::Call(ticket) => {
                    self.retry_or_fail(ticket, now, |sent| Error::Disconnected { endpoint, source, sent })
                }
                Goal::Barrier { call: Some(ticket), .. } => {
                    self.retry_or_fail(ticket, now, |sent| Error::Disconnected { endpoint, source, sent });
                }
                Goal::Barrier { call: None, .. } => self.probe_failed(station, now),
            }
        }
    }

    /// Fails all that waits; what is on the wire goes on.
    pub(crate) fn close(&mut self) {
        for ticket in self.cleared.take().into_iter().chain(self.scheduler.drain_all()) {
            ticket.call.fail(Error::Closed);
        }
    }

    /// Fails all there is: the link cannot go on.
    pub(crate) fn abort(&mut self, error: &Arc<io::Error>) {
        let active = self.exchange.end().map(|active| match active.goal {
            Goal::Call(ticket) => Some(ticket),
            Goal::Barrier { call, .. } => call,
        });
        for ticket in active.flatten().into_iter().chain(self.cleared.take()).chain(self.scheduler.drain_all()) {
            let sent = ticket.call.was_sent();
            let endpoint = self.config.name.to_string();
            ticket.call.fail(Error::Disconnected { endpoint, source: error.clone(), sent });
        }
    }

    /// Whether nothing is on the wire.
    pub(crate) fn is_idle(&self) -> bool {
        self.exchange.active().is_none()
    }

    pub(crate) fn connect_error(&self, error: &Arc<io::Error>) -> Error {
        Error::Connect { endpoint: self.config.name.to_string(), source: error.clone() }
    }

    fn has_work(&mut self, now: Instant) -> bool {
        self.cleared.is_some() || self.scheduler.has_work(now)
    }

    fn next_goal(&mut self, now: Instant) -> Option<Goal> {
        match self.cleared.take() {
            Some(ticket) if ticket.is_wanted(now) => return Some(Goal::Call(ticket)),
            Some(ticket) => ticket.expire(),
            None => {}
        }
        if let Some(station) = self.due_probe(now) {
            return Some(self.barrier(station, None));
        }
        loop {
            let ticket = self.scheduler.pop(now)?;
            if ticket.is_broadcast() {
                return Some(Goal::Call(ticket));
            }
            let station = ticket.station;
            let quiet = self.config.quiet;
            let health = self.health(station);
            if let Some(offline) = &health.offline {
                ticket.call.fail(offline_error(&ticket, offline, now));
            } else if !health.dirty {
                return Some(Goal::Call(ticket));
            } else if !health.refuses_loop_back {
                return Some(self.barrier(station, Some(ticket)));
            } else {
                // The next best thing to an echo: silence. Whatever still comes makes the station dirty again.
                health.dirty = false;
                self.scheduler.push_front(ticket);
                self.scheduler.block(station, later(now, quiet));
            }
        }
    }

    fn begin(&mut self, goal: Goal, now: Instant) -> Option<Step> {
        let (deadline, _) = self.response_deadline(&goal, now);
        let call = match &goal {
            Goal::Call(ticket) => Some(ticket.call.clone()),
            Goal::Barrier { .. } => None,
        };
        self.outgoing.clear();
        let stale = self.exchange.begin(goal, now, deadline, &mut self.outgoing)?;
        self.stale_bytes = self.stale_bytes.saturating_add(u64::try_from(stale).unwrap_or(u64::MAX));
        if let Some(call) = call {
            call.mark_sent();
        }
        Some(Step::Send(deadline))
    }

    fn on_event(&mut self, event: Event, now: Instant) {
        match event {
            Event::Replied(active) => self.replied(active, now),
            Event::Refused(active) => {
                let station = active.goal.station();
                self.answered(&active, now);
                self.health(station).refuses_loop_back = true;
                if let Goal::Barrier { call: Some(ticket), .. } = active.goal {
                    self.scheduler.push_front(ticket);
                }
            }
            Event::Stray { station } => {
                let awaited = self.exchange.active().is_some_and(|active| active.goal.station() == station);
                // A station that nobody has asked anything is nobody's concern.
                if let (false, Some(health)) = (awaited, self.stations.get_mut(&station)) {
                    health.dirty = true;
                }
            }
            Event::Noise(Discard::BadChecksum | Discard::Malformed) => {
                if let Some(deadline) = self.exchange.active().map(|active| active.deadline) {
                    self.exchange.expect_until(deadline.min(later(now, self.config.settle)), false);
                }
            }
            Event::Noise(_) => {}
        }
    }

    fn replied(&mut self, active: Active, now: Instant) {
        self.answered(&active, now);
        let station = active.goal.station();
        match active.goal {
            Goal::Call(_) => self.health(station).dirty |= active.doubtful,
            Goal::Barrier { call, .. } => {
                self.health(station).dirty = false;
                self.cleared = call;
            }
        }
    }

    /// What any answer of a station shows: it is there, and so is the connection.
    fn answered(&mut self, active: &Active, now: Instant) {
        self.connection = Connection::Up { replied: true };
        self.failures = 0;
        let station = active.goal.station();
        self.scheduler.charge(station, now.saturating_duration_since(active.began));
        let health = self.health(station);
        health.timeouts = 0;
        if health.offline.take().is_some() {
            tracing::info!(station, "station is back");
            self.probe_ended(active, now);
        }
    }

    /// The reply to what is on the wire has not come, or not whole.
    fn give_up(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event_in_silence() {
            self.on_event(event, now);
        }
        let Some(active) = self.exchange.end() else { return };
        let station = active.goal.station();
        let after = now.saturating_duration_since(active.began);
        self.scheduler.charge(station, after);
        let offline_after = self.config.offline_after;
        let health = self.health(station);
        health.dirty = true;
        // A caller whose own time was up before the response timeout says nothing about the station.
        if active.fault.is_none() && active.patient {
            health.timeouts = health.timeouts.saturating_add(1);
        }
        let lost = health.timeouts >= offline_after && health.offline.is_none();
        match active.goal {
            Goal::Barrier { call: None, .. } => {
                self.probe_ended(&active, now);
                self.probe_failed(station, now);
            }
            Goal::Call(ticket) | Goal::Barrier { call: Some(ticket), .. } => {
                let code = ticket.code;
                let fault = active.fault;
                self.retry_or_fail(ticket, now, |sent| match fault {
                    Some(reason) => Error::BadReply { station, code, after, reason, sent },
                    None => Error::Timeout { station, code, after, sent },
                });
            }
        }
        if lost {
            self.take_offline(station, now);
        }
    }

    fn retry_or_fail(&mut self, mut ticket: Ticket, now: Instant, error: impl FnOnce(bool) -> Error) {
        match ticket.retries_left.checked_sub(1) {
            Some(left) if ticket.is_wanted(now) => {
                ticket.retries_left = left;
                self.scheduler.push_front(ticket);
            }
            _ => ticket.call.fail(error(ticket.call.was_sent())),
        }
    }

    fn take_offline(&mut self, station: u8, now: Instant) {
        let (interval, _) = self.config.probe_interval;
        let offline = Offline { probe_at: later(now, interval), interval };
        tracing::warn!(station, probe_in = ?interval, "station is offline");
        for ticket in self.scheduler.drain(station) {
            ticket.call.fail(offline_error(&ticket, &offline, now));
        }
        self.health(station).offline = Some(offline);
    }

    fn due_probe(&self, now: Instant) -> Option<u8> {
        if self.probe_allowed_at.is_some_and(|at| now < at) {
            return None;
        }
        let offline =
            self.stations.iter().filter_map(|(&station, health)| Some((health.offline.as_ref()?.probe_at, station)));
        offline.min().filter(|&(at, _)| at <= now).map(|(_, station)| station)
    }

    fn probe_ended(&mut self, active: &Active, now: Instant) {
        let took = now.saturating_duration_since(active.began);
        self.probe_allowed_at = now.checked_add(took.saturating_mul(self.config.probe_pause));
    }

    fn probe_failed(&mut self, station: u8, now: Instant) {
        let (_, longest) = self.config.probe_interval;
        if let Some(offline) = &mut self.health(station).offline {
            offline.interval = offline.interval.saturating_mul(2).min(longest);
            offline.probe_at = later(now, offline.interval);
        }
    }

    fn failed_to_connect(&mut self, now: Instant) {
        let (shortest, longest) = self.config.connect_backoff;
        let doubled = shortest.saturating_mul(1_u32.checked_shl(self.failures).unwrap_or(u32::MAX));
        self.failures = self.failures.saturating_add(1).min(31);
        let delay = self.random.jitter(doubled.min(longest));
        self.connection = Connection::Down { retry_at: now.checked_add(delay) };
    }

    fn barrier(&mut self, station: u8, call: Option<Ticket>) -> Goal {
        self.nonce = self.nonce.wrapping_add(1);
        // 16 characters are far below the limit of a loop-back, so this always succeeds.
        let nonce = LoopBack::nonce(self.nonce);
        Goal::Barrier { station, nonce, call }
    }

    /// Until when the reply is waited for, and whether that is the whole response timeout.
    fn response_deadline(&self, goal: &Goal, now: Instant) -> (Instant, bool) {
        match goal {
            Goal::Call(ticket) | Goal::Barrier { call: Some(ticket), .. } => {
                let deadline = later(now, ticket.options.response_timeout);
                (deadline.min(ticket.deadline), deadline <= ticket.deadline)
            }
            Goal::Barrier { call: None, .. } => (later(now, self.config.probe_timeout), true),
        }
    }

    fn next_timer(&self) -> Option<Instant> {
        let probe = self.stations.values().filter_map(|health| Some(health.offline.as_ref()?.probe_at)).min();
        let probe = probe.map(|at| self.probe_allowed_at.map_or(at, |allowed| at.max(allowed)));
        [self.scheduler.next_unblocked(), probe].into_iter().flatten().min()
    }

    fn health(&mut self, station: u8) -> &mut Health {
        self.stations.entry(station).or_default()
    }
}

fn offline_error(ticket: &Ticket, offline: &Offline, now: Instant) -> Error {
    let probe_in = offline.probe_at.saturating_duration_since(now);
    Error::Offline { station: ticket.station, probe_in, sent: ticket.call.was_sent() }
}

/// An instant so far away that the clock cannot hold it is taken as a day from now.
fn later(now: Instant, by: Duration) -> Instant {
    now.checked_add(by.min(Duration::from_secs(86_400))).unwrap_or(now)
}
