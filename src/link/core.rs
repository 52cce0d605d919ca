//! The link's logic, without I/O and without a clock: calls, bytes and instants go in, actions come
//! out.
//!
//! [`Core`] ties the parts together: [`Connection`] has the state of the connection, [`Stations`]
//! that of each station, [`Exchange`] the request on the wire, and [`Scheduler`] the order of
//! waiting calls. This file decides what is done next; `outgoing` chooses the next request, and
//! `outcome` handles its result.
//!
//! The rule of [`InStep`](super::in_step::InStep), one for each station, decides whether a reply
//! belongs to the request on the wire. It chooses the spelling of a request, asks for a check
//! before it, and judges the reply. A check with a nonce is also the probe of an offline station.
//!
//! Invariants:
//! - A call ends once: with its reply, or with an error.
//! - A write or control command is executed at most once, unless the caller has chosen otherwise.
//! - A request is sent only as its station's rule allows. Its reply is given to its call only if
//!   proven.
//! - A station that does not answer costs the others at most one response timeout at a time.

mod outcome;
mod outgoing;
#[cfg(test)]
mod tests;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use tokio::time::Instant;

use super::call::PendingCall;
use super::config::Config;
use super::connection::{Connection, ConnectionState};
use super::exchange::{Exchange, Outgoing};
use super::frame_gap::FrameGap;
use super::in_step::{Declared, InStep, Prices, Proof};
use super::later;
use super::mute::MuteDetector;
use super::one_request::{Change, OneRequest};
use super::scheduler::Scheduler;
use super::stations::Stations;
use super::stats::{SharedStats, StationState, add};
use crate::error::{Error, Seen};
use crate::random::Random;
use crate::transport::LateDatagrams;

/// The next thing for the driver to do.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Action {
    /// Close the connection if there is one, and open another. Then call [`Core::connected`] or
    /// [`Core::connect_failed`].
    Connect,
    /// Close the connection: the link has fallen idle.
    Disconnect,
    /// Write [`Core::request_bytes`] by this time. Then call [`Core::sent`] or
    /// [`Core::disconnected`].
    Send(Instant),
    /// Nothing, until bytes or a call come, or until this instant.
    Wait(Option<Instant>),
    /// The response timeout of the request on the wire has passed. Read all data that have come by
    /// now, also those that the operating system has and the runtime has not seen, and call
    /// [`Core::next_action`] again.
    ReadAgain,
    /// Nothing was answered over the connection for this time: call [`Core::disconnected`], so that
    /// another is opened.
    Replace(Duration),
}

#[derive(Debug)]
pub(crate) struct Core {
    config: Arc<Config>,
    /// The name of the endpoint in errors.
    name: Arc<str>,
    exchange: Exchange,
    scheduler: Scheduler,
    stations: Stations,
    stats: Arc<SharedStats>,
    /// A call whose check was just answered: it is sent before all others.
    resynced: Option<PendingCall>,
    connection: Connection,
    /// Nothing is sent before this time: after a broadcast, or after connecting.
    hold_until: Option<Instant>,
    /// `None`: a network, or a line with a gap of zero.
    frame_gap: Option<Box<FrameGap>>,
    /// When a call came or ended last; `None` while the link is idle.
    used_at: Option<Instant>,
    /// Nothing new is sent.
    closing: bool,
    nonce: u64,
    prices: Prices,
    one_request: OneRequest,
    mute: MuteDetector,
    /// The connection is being replaced because it is mute.
    replacing: bool,
    /// The station of the last request without a reply, and when it was given up.
    timed_out: Option<(u8, Instant)>,
    /// All data were read after the response timeout of the request on the wire.
    has_read_again: bool,
}

impl Core {
    pub(crate) fn new(config: Arc<Config>, name: Arc<str>, stats: Arc<SharedStats>, seed: u64) -> Self {
        let mut random = Random::new(seed);
        Self {
            exchange: Exchange::new(config.framing, config.echo),
            scheduler: Scheduler::new(config.queue_capacity, config.ageing),
            stations: Stations::new(config.offline_rules),
            stats,
            resynced: None,
            hold_until: None,
            frame_gap: FrameGap::new(config.frame_gap).map(Box::new),
            used_at: None,
            closing: false,
            nonce: random.next(),
            connection: Connection::new(config.connect_backoff, random),
            prices: outgoing::prices(&config),
            one_request: OneRequest::new(config.in_step.one_request()),
            mute: MuteDetector::new(config.mute_timeout),
            replacing: false,
            timed_out: None,
            has_read_again: false,
            config,
            name,
        }
    }

    /// Declares capabilities of a station, in place of those declared or found before.
    pub(crate) fn declare(&mut self, station: u8, declared: Declared) {
        self.stations.with_in_step(station, |in_step| in_step.declare(declared));
    }

    pub(crate) fn config(&self) -> &Config {
        &self.config
    }

    /// Takes a call.
    pub(crate) fn push(&mut self, call: PendingCall, now: Instant) {
        if self.closing {
            return; // Dropped, it ends with the right error.
        }
        self.used_at = Some(now);
        if let Some(probe_at) = self.stations.offline_until(call.station) {
            return call.slot.fail(offline(&call, probe_at, now));
        }
        if let Some(call) = self.scheduler.push(call, now) {
            let limit = self.config.queue_capacity;
            call.slot.fail(Error::QueueFull { station: call.station, limit });
        }
    }

    /// Decides what is to be done now.
    pub(crate) fn next_action(&mut self, now: Instant) -> Action {
        loop {
            if let Some(until) = self.await_reply(now) {
                return Action::Wait(Some(until));
            }
            if !self.is_idle() {
                // This process may have been stopped, with the reply in the socket.
                if !std::mem::replace(&mut self.has_read_again, true) {
                    return Action::ReadAgain;
                }
                self.has_read_again = false;
                self.give_up(now);
                // Data that have come by now are read before anything else is sent.
                return Action::Wait(Some(now));
            }
            match self.connection.state() {
                ConnectionState::Connecting => return Action::Wait(None),
                ConnectionState::Down { retry_at } => {
                    if !self.has_work(now) {
                        if self.falls_idle(now) {
                            continue;
                        }
                        return Action::Wait(self.next_timer());
                    }
                    if let Some(at) = retry_at.filter(|&at| now < at) {
                        return Action::Wait(Some(at));
                    }
                    self.connection.begin();
                    return Action::Connect;
                }
                ConnectionState::Up { .. } if self.connection.is_spent() => {
                    if !self.has_work(now) {
                        if self.falls_idle(now) {
                            return self.disconnect();
                        }
                        return Action::Wait(self.next_timer());
                    }
                    self.connection.begin();
                    return Action::Connect;
                }
                ConnectionState::Up { .. } => {}
            }
            if let Some(silent) = self.mute.mute_for(now) {
                self.mute.reset();
                self.replacing = true;
                // A new connection is a new chance: stations that were silent over the old one are
                // probed as if they had just fallen silent.
                self.stations.restart_probe_intervals();
                self.stats.count_link(|link| add(&mut link.rare().mute_connections, 1));
                return Action::Replace(silent);
            }
            let gap_until = self.frame_gap.as_ref().and_then(|gap| gap.until(|| self.may_send_write()));
            if let Some(until) = self.hold_until.max(gap_until).filter(|&until| now < until) {
                return Action::Wait(Some(until));
            }
            // Checked before the probes: they alone are no reason to stay connected.
            if self.falls_idle(now) {
                return self.disconnect();
            }
            if !self.has_waiting() {
                // Mostly the only call has just been answered, and the rest of this would find nothing to do.
                return Action::Wait(self.idle_at());
            }
            let Some(outgoing) = self.next_outgoing(now) else {
                return Action::Wait(self.next_timer());
            };
            if let Some(action) = self.begin(outgoing, now) {
                return action;
            }
        }
    }

    /// Until when to wait for the reply to the request on the wire, if that is later than now. When it has
    /// passed, all data are read again, also if they were for the request before.
    #[inline]
    pub(crate) fn await_reply(&mut self, now: Instant) -> Option<Instant> {
        let until = self.exchange.active().map(|active| active.deadline).filter(|&until| now < until)?;
        self.has_read_again = false;
        Some(until)
    }

    /// The bytes to be written.
    pub(crate) fn request_bytes(&self) -> &[u8] {
        self.exchange.request()
    }

    /// Notes that all [`request_bytes`](Self::request_bytes) were written, and that the last one
    /// leaves the machine at `at`.
    pub(crate) fn sent(&mut self, at: Instant) {
        let Some(active) = self.exchange.active() else { return };
        if let Outgoing::Call(call) = &active.outgoing
            && call.is_broadcast()
        {
            let code = call.code;
            call.slot.complete_without_reply(Proof::default());
            let took = at.saturating_duration_since(active.began);
            self.stats.add_bus_time(took.saturating_add(self.config.broadcast_gap));
            self.exchange.end();
            self.stations.for_all(|station| station.broadcast(code, at));
            self.hold_until = Some(later(at, self.config.broadcast_gap));
            return;
        }
        let deadline = later(at, active.response_timeout);
        self.exchange.sent(at, deadline);
    }

    /// Notes that datagrams came to the ports of earlier requests, and were dropped.
    pub(crate) fn late_datagrams(&mut self, late: LateDatagrams) {
        if late.duplicates > 0 || late.others > 0 {
            let count = late.duplicates.saturating_add(late.others);
            self.stats.count_link(|link| add(&mut link.rare().late_datagrams, count));
        }
        if late.others > 0 {
            // One of them may be the true reply to a request that a duplicate has answered, on a
            // port that is in use again.
            self.stations.for_all(InStep::input_dropped);
        }
    }

    /// The buffer for received bytes; after filling it, call [`received`](Self::received). Then it
    /// holds at most the beginning of a frame.
    pub(crate) fn receive_buffer(&mut self) -> &mut BytesMut {
        &mut self.exchange.received
    }

    /// Handles received bytes.
    pub(crate) fn received(&mut self, now: Instant) {
        while let Some(event) = self.exchange.next_event(now) {
            self.on_event(event, now);
        }
        // After all frames: one that came with the reply may contradict it.
        self.conclude(now);
        // While a frame is coming in, the deadline is extended, but not without limit.
        if let (Some(active), false) = (self.exchange.active(), self.exchange.received.is_empty())
            && let Some(sent) = active.sent
        {
            let usual = later(sent, active.response_timeout);
            let extended = later(now, self.config.byte_timeout).min(later(usual, self.config.slow_frame_time));
            if extended > active.deadline {
                if let Some(call) = active.outgoing.call() {
                    call.slot.note(&Seen { half_frame: true, ..Seen::default() });
                }
                self.exchange.expect_until(extended);
            }
        }
    }

    /// Returns whether the link still needs a connection, now that its slot to open one has come.
    pub(crate) fn may_connect(&mut self, now: Instant) -> bool {
        let wanted = self.has_work(now);
        if !wanted {
            self.connection.closed();
        }
        wanted
    }

    /// Notes that the connection is open.
    pub(crate) fn connected(&mut self, now: Instant) {
        self.exchange.reconnected();
        self.stations.for_all(InStep::connected);
        let change = self.one_request.connected();
        self.note_one_request(change);
        if !self.connection.is_spent() {
            self.stations.probe_soon(now);
        }
        self.connection.opened();
        self.mute.reset();
        self.hold_until = self.hold_until.max(Some(later(now, self.config.in_step.settle())));
        self.stats.count_link(|link| add(&mut link.connects, 1));
    }

    /// Notes that the open connection is to one of several addresses of the host. If no reply has come
    /// from it yet, it may be the wrong one: the connection is replaced at the first call without an
    /// answer.
    pub(crate) fn note_other_addresses(&mut self) {
        if !self.connection.is_address_proven() {
            self.mute.begin_trial();
        }
    }

    /// The number of the host's address for the next connection, for transports that choose.
    pub(crate) fn address(&self) -> usize {
        self.connection.address()
    }

    /// Notes that the connection could not be opened.
    pub(crate) fn connect_failed(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.stats.count_link(|link| add(&mut link.connect_failures, 1));
        self.connection.failed(now);
        if self.config.fail_fast {
            for call in self.resynced.take().into_iter().chain(self.scheduler.drain_all()) {
                let (endpoint, sent) = (self.name.to_string(), call.slot.was_sent());
                call.slot.fail(Error::Connect { endpoint, source: error.clone(), sent });
            }
        }
    }

    /// Notes that the connection is lost.
    pub(crate) fn disconnected(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.stats.count_link(|link| add(&mut link.disconnects, 1));
        self.connection.lost(now);
        if let (true, Some(limit)) = (std::mem::take(&mut self.replacing), self.config.mute_timeout) {
            // Stations that answer must not wait longer for the sake of one that does not.
            self.connection.retry_within(limit, now);
        }
        self.exchange.forget();
        let change = self.one_request.lost(error);
        self.note_one_request(change);
        if let Some(call) = self.resynced.take() {
            self.scheduler.push_front(call);
        }
        if let Some(active) = self.exchange.end() {
            self.stats.add_bus_time(now.saturating_duration_since(active.began));
            let station = active.outgoing.station();
            let own = matches!(active.outgoing, Outgoing::Call(_));
            match active.outgoing.into_call() {
                None => self.probe_failed(station, now),
                Some(call) if !own && self.may_repeat_check(&call, now) => self.repeat_check(call),
                Some(call) => {
                    let endpoint = self.name.to_string();
                    let source = error.clone();
                    self.retry_or_fail(call, now, |call, _| Error::Disconnected {
                        endpoint,
                        source,
                        sent: call.slot.was_sent(),
                    });
                }
            }
        }
        // A silent station may have been restarted. The next connection is opened to probe it after
        // the back-off, not only when the probe would have been due.
        self.stations.probe_soon(now);
    }

    pub(crate) fn is_closing(&self) -> bool {
        self.closing
    }

    /// Fails all waiting calls, and sends nothing from now on. The exchange on the wire goes on.
    pub(crate) fn close(&mut self) {
        self.closing = true;
        self.resynced = None;
        self.scheduler.drain_all();
    }

    /// Fails all calls: there will be no other connection.
    pub(crate) fn abort(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.stats.count_link(|link| add(&mut link.disconnects, 1));
        let active = self.exchange.end();
        if let Some(active) = &active {
            self.stats.add_bus_time(now.saturating_duration_since(active.began));
        }
        let active = active.and_then(|active| active.outgoing.into_call());
        for call in active.into_iter().chain(self.resynced.take()).chain(self.scheduler.drain_all()) {
            let sent = call.slot.was_sent();
            let endpoint = self.name.to_string();
            call.slot.fail(Error::Disconnected { endpoint, source: error.clone(), sent });
        }
    }

    /// Fails all calls, and begins anew as without a connection.
    pub(crate) fn runtime_ended(&mut self, error: &Arc<io::Error>, now: Instant) {
        self.abort(error, now);
        self.connection.closed();
        self.exchange.forget();
        self.mute.reset();
        self.hold_until = None;
        if let Some(gap) = &mut self.frame_gap {
            gap.runtime_ended();
        }
        self.has_read_again = false;
    }

    /// Notes that data were not read again, as [`Action::ReadAgain`] demands.
    pub(crate) fn postpone_read_again(&mut self) {
        self.has_read_again = false;
    }

    /// Returns whether the next request may be one that must not be repeated: a write or control
    /// command.
    pub(crate) fn may_send_write(&self) -> bool {
        let resynced = || self.resynced.as_ref().is_some_and(PendingCall::is_write);
        self.is_idle() && (resynced() || self.scheduler.has_write())
    }

    /// Returns whether no request is on the wire.
    pub(crate) fn is_idle(&self) -> bool {
        self.exchange.active().is_none()
    }

    /// Makes the link idle if it was not used for the idle timeout; returns whether it did.
    ///
    /// Offline stations become unknown: they are not probed while no caller uses them, and by the
    /// next call the state would be outdated.
    fn falls_idle(&mut self, now: Instant) -> bool {
        if self.idle_at().is_none_or(|at| now < at) || self.resynced.is_some() || self.scheduler.is_waiting(now) {
            return false;
        }
        self.used_at = None;
        self.forget_offline();
        true
    }

    /// Makes offline stations unknown, so that they are not probed.
    fn forget_offline(&mut self) {
        for station in self.stations.forget_offline() {
            self.stats.set_state(station, StationState::Unknown);
        }
    }

    fn idle_at(&self) -> Option<Instant> {
        Some(later(self.used_at?, self.config.idle_timeout?))
    }

    fn disconnect(&mut self) -> Action {
        self.connection.closed();
        self.exchange.forget();
        self.stats.count_link(|link| add(&mut link.idle_closes, 1));
        Action::Disconnect
    }

    /// Notes what was learned, or forgotten, about the connections of the device.
    fn note_one_request(&mut self, change: Option<Change>) {
        let Some(change) = change else { return };
        self.stats.count_link(|link| link.one_request = change != Change::Forgotten);
        let quiet = self.config.in_step.quiet();
        match change {
            Change::LearnedFirst => {
                tracing::warn!(
                    ?quiet,
                    "device closes its connection after each reply: silence replaces checks from now on"
                );
            }
            Change::LearnedAgain => tracing::debug!("device still closes its connection after each reply"),
            Change::Forgotten => tracing::debug!("checks are tried again: the device may have been misjudged"),
        }
    }

    /// Returns whether the next action may be to send a request, or to open a connection for one.
    pub(crate) fn wants_to_send(&mut self, now: Instant) -> bool {
        self.is_idle() && self.has_work(now)
    }

    /// Returns whether anything may be to send, now or later: a call waits, or a station is offline.
    fn has_waiting(&self) -> bool {
        self.resynced.is_some() || self.scheduler.has_calls() || self.stations.has_offline()
    }

    fn has_work(&mut self, now: Instant) -> bool {
        // An offline station gets nothing but probes, so a due probe is a reason to connect.
        !self.closing
            && (self.resynced.is_some() || self.scheduler.has_work(now) || self.stations.due_probe(now).is_some())
    }

    fn next_timer(&self) -> Option<Instant> {
        let unblocked = self.scheduler.next_unblocked();
        // The link does not fall idle while a call waits.
        let idle_at = if unblocked.is_none() { self.idle_at() } else { None };
        [unblocked, self.stations.next_probe(), idle_at].into_iter().flatten().min()
    }
}

fn offline(call: &PendingCall, probe_at: Instant, now: Instant) -> Error {
    let probe_in = probe_at.saturating_duration_since(now);
    Error::Offline { station: call.station, probe_in, sent: call.slot.was_sent() }
}
