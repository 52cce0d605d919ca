//! Moves bytes and time between the [`Core`] and the outside, and decides nothing. It owns the
//! connection.
//!
//! ```text
//!        ┌─────────────────────────────────────────────────────────────────┐
//!        ▼                                                                 │
//! write the request ──done──▶ read until no data is left ──▶ next action of the core:
//!                                                            connect, disconnect, send: done, and on
//!                                                            wait: return to the caller of `advance`
//! ```
//!
//! Behind a request, if there are no data to read, it waits for the reply at once.
//!
//! [`Driver::advance`] does all that can be done without waiting. The link's task calls it after
//! each wake-up. A caller with a new request calls it, too, to send that without waking the task.
//! I/O always wakes the task, never a caller: a caller's future may be dropped at any moment.
//!
//! Invariants:
//! - A request is begun only after all data that had come were read.
//! - A request that is partly written is written to its end, or the connection is closed.
//! - No byte is written unless the [send gate](SendGate), if there is one, was open immediately before.
//! - The task learns of everything that `advance` waits for: readability and writability by its
//!   waker, instants by the return value.

#[cfg(test)]
mod tests;
mod writing;

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker, ready};

use bytes::BytesMut;
use futures::future::{BoxFuture, FutureExt};
use tokio::time::Instant;
use tokio_util::io::poll_read_buf;

use self::writing::{Unwritten, Writing};
use super::buffer;
use super::call::PendingCall;
use super::connect_limiter::{ConnectLimiter, ConnectPermit, ConnectSlot};
use super::connector::Connector;
use super::core::{Action, Core};
use super::in_step::Declared;
use super::io_waker::IoWaker;
use super::send_gate::SendGate;
use super::state::{LinkState, SharedLinkState};
use crate::error::Rounded;
use crate::transport::{BoxIo, Io};

/// The connection of a link, and everything needed to open and use it.
pub(crate) struct Driver {
    core: Core,
    connector: Connector,
    /// Shared by links that must not all connect at once.
    connect_limiter: Option<Arc<ConnectLimiter>>,
    /// Asked before each write.
    send_gate: Option<SendGate>,
    /// When the last written byte has left the machine.
    sent_until: Option<Instant>,
    state: Arc<SharedLinkState>,
    io_waker: Arc<IoWaker>,
    /// All data were read after the ready flag was cleared, and the stream wakes its reader for
    /// more. So reading may be skipped while the flag is clear.
    read_armed: bool,
    io: Option<BoxIo>,
    opening: Option<Opening>,
    /// The core wants a connection, and the task has not begun to open it.
    open_requested: bool,
    writing: Option<Writing>,
    /// The last handle was dropped.
    orphaned: bool,
    /// Nothing new is begun.
    ending: bool,
    /// Number of bytes that were received since other tasks could run.
    received: usize,
}

/// Why [`Driver::advance`] has returned.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum DriverStatus {
    /// It waits for I/O, or until this instant if there is one.
    Waiting(Option<Instant>),
    /// The next action needs the task.
    NeedsTask,
    /// Other tasks must run first: there is more to do.
    Yield,
    /// The runtime must look for I/O events first.
    AfterEvents,
    /// The link has ended.
    Ended,
}

/// The task on which the driver runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum AdvancedBy {
    LinkTask,
    Caller,
}

/// The clock, read as rarely as possible.
struct Clock(Option<Instant>);

impl Clock {
    /// The time of the last reading.
    fn now(&mut self) -> Instant {
        *self.0.get_or_insert_with(Instant::now)
    }

    /// Reads the clock.
    fn look(&mut self) -> Instant {
        *self.0.insert(Instant::now())
    }
}

const CLOSED_BY_PEER: &str = "the peer closed the connection";

/// Maximum number of reads before a request, and of actions before other tasks run.
const MAX_AT_ONCE: usize = 64;

/// Maximum number of received bytes that are handled before other tasks run: a peer that never
/// stops must not hold up the runtime.
const MAX_BYTES_AT_ONCE: usize = 8 * buffer::LEN;

impl Driver {
    pub(crate) fn new(
        core: Core,
        connector: Connector,
        connect_limiter: Option<Arc<ConnectLimiter>>,
        send_gate: Option<SendGate>,
        state: Arc<SharedLinkState>,
    ) -> Self {
        Self {
            core,
            connector,
            connect_limiter,
            send_gate,
            sent_until: None,
            state,
            io_waker: Arc::default(),
            read_armed: false,
            io: None,
            opening: None,
            open_requested: false,
            writing: None,
            orphaned: false,
            ending: false,
            received: 0,
        }
    }

    /// Declares capabilities of a station.
    pub(crate) fn declare(&mut self, station: u8, declared: Declared) {
        self.core.declare(station, declared);
    }

    /// Takes a call.
    #[inline]
    pub(crate) fn push(&mut self, call: PendingCall, now: Instant) {
        self.core.push(call, now);
    }

    /// Begins nothing new from now on.
    pub(crate) fn close(&mut self) {
        if !self.core.is_closing() {
            self.core.close();
        }
    }

    /// Returns whether the link can go on with another runtime.
    pub(crate) fn outlives_runtime(&self) -> bool {
        !(self.connector.is_once() || self.ending || self.core.is_closing())
    }

    /// Closes the connection and fails all calls: the runtime that the connection belongs to has
    /// ended.
    pub(crate) fn runtime_ended(&mut self) {
        self.io = None;
        self.opening = None;
        self.open_requested = false;
        self.writing = None;
        self.sent_until = None;
        self.read_armed = false;
        let error = Arc::new(io::Error::other("the runtime of the link's task has ended"));
        self.core.runtime_ended(&error, Instant::now());
        self.state.set(LinkState::Down { error });
    }

    /// Notes that the last handle was dropped.
    pub(crate) fn orphan(&mut self) {
        self.orphaned = true;
    }

    /// The waker of the link's task.
    pub(crate) fn io_waker(&self) -> &Arc<IoWaker> {
        &self.io_waker
    }

    /// Returns whether a call made now would be sent at once, as far as can be told.
    pub(crate) fn can_send_now(&self) -> bool {
        self.io.is_some() && self.opening.is_none() && self.writing.is_none() && !self.ending && self.core.is_idle()
    }

    /// Returns whether a call made now waits only for the end of the exchange on the wire, which
    /// wakes the task.
    pub(crate) fn is_awaiting_reply(&self) -> bool {
        self.io.is_some() && self.writing.is_none() && !self.core.is_idle()
    }

    #[cfg(test)]
    pub(crate) fn debug_text(&self) -> String {
        format!("{:?}", self.core)
    }

    /// Does all that can be done without waiting. `now` is the time if it was read a moment ago;
    /// `waker` is one of [`io_waker`](Self::io_waker).
    pub(crate) fn advance(&mut self, by: AdvancedBy, now: Option<Instant>, waker: &Waker) -> DriverStatus {
        self.run(by, &mut Clock(now), &mut Context::from_waker(waker))
    }

    fn run(&mut self, by: AdvancedBy, clock: &mut Clock, cx: &mut Context<'_>) -> DriverStatus {
        // A user's stream may have data without waking its reader.
        self.read_armed = self.read_armed && self.connector.wakes_reader();
        let mut sends = false;
        if by == AdvancedBy::LinkTask {
            self.received = 0;
        }
        for _ in 0..MAX_AT_ONCE {
            if self.received >= MAX_BYTES_AT_ONCE {
                return match by {
                    AdvancedBy::Caller => DriverStatus::NeedsTask,
                    AdvancedBy::LinkTask => DriverStatus::AfterEvents,
                };
            }
            if self.ending {
                return self.end(clock.now());
            }
            if let Some(Writing { by, .. }) = self.writing {
                match self.poll_write(cx) {
                    Poll::Pending if clock.now() < by => return DriverStatus::Waiting(Some(by)),
                    Poll::Pending => {
                        let late = "the request was not written in time";
                        self.connection_lost(io::Error::new(io::ErrorKind::TimedOut, late), clock.now());
                    }
                    Poll::Ready(Ok(())) => {
                        let at = self.transmitted_at(clock);
                        self.core.sent(at);
                        let late = self.io.as_deref_mut().map(<dyn Io>::take_late).unwrap_or_default();
                        self.core.late_datagrams(late);
                        self.read_armed = self.read_armed && self.connector.wakes_reader();
                        // With a request on the wire, the rest only reads, and waits as the core would.
                        if self.read_armed
                            && !self.io_waker.is_ready()
                            && let Some(until) = self.core.await_reply(clock.now())
                        {
                            return DriverStatus::Waiting(Some(until));
                        }
                    }
                    Poll::Ready(Err(Unwritten::GateClosed { partly })) => self.gate_closed(partly, clock.now()),
                    Poll::Ready(Err(Unwritten::Lost(error))) => self.connection_lost(error, clock.now()),
                }
                continue;
            }
            if !self.read_armed || self.io_waker.is_ready() {
                match self.read_all(cx, clock) {
                    Ok(all) => self.read_armed = all,
                    Err(error) => {
                        self.connection_lost(error, clock.now());
                        continue;
                    }
                }
            }
            let now = clock.now();
            // Asked before a connection is opened and before a request is begun, so that calls do not
            // wait for a connection over which they would not be sent.
            if self.send_gate.is_some() && self.core.wants_to_send(now) && !self.may_send() {
                self.core.withhold_all();
                // One that is wanted and not begun.
                if std::mem::take(&mut self.open_requested) {
                    self.core.may_connect(now);
                }
            }
            // A write must not go into a connection that is closed already: whether it was executed
            // would not be known.
            if self.core.may_send_write() && self.io.as_deref().is_some_and(<dyn Io>::is_closed_by_peer) {
                self.connection_lost(io::Error::new(io::ErrorKind::UnexpectedEof, CLOSED_BY_PEER), now);
                continue;
            }
            match self.core.next_action(now) {
                Action::Connect => {
                    self.io = None;
                    self.open_requested = true;
                }
                Action::Disconnect => {
                    tracing::debug!("idle");
                    self.io = None;
                    self.state.set(LinkState::Idle);
                }
                Action::Send(by) => {
                    if std::mem::replace(&mut sends, true) {
                        // Sending the request before took time.
                        clock.look();
                    }
                    self.writing = Some(Writing { written: 0, by });
                }
                // The exchange on the wire ends first: the PLC must not be cut off in its reply.
                Action::Wait(_) if (self.core.is_closing() || self.orphaned) && self.core.is_idle() => {
                    self.ending = true
                }
                Action::ReadAgain => {
                    self.read_armed = false;
                    if by == AdvancedBy::Caller {
                        // The runtime may not have looked for events yet.
                        self.core.postpone_read_again();
                        return DriverStatus::NeedsTask;
                    }
                    return DriverStatus::AfterEvents;
                }
                Action::Replace(silent) => {
                    let silent = Rounded(silent);
                    tracing::debug!(%silent, "nothing is answered over the connection");
                    let reason = format!("no station answered over the connection for {silent}");
                    self.connection_lost(io::Error::new(io::ErrorKind::TimedOut, reason), now);
                }
                Action::Wait(until) => {
                    if self.opening.is_some() || self.open_requested {
                        if by == AdvancedBy::Caller {
                            return DriverStatus::NeedsTask;
                        }
                        if self.open(cx, now).is_ready() {
                            clock.look();
                            self.read_armed = false;
                            continue;
                        }
                    }
                    match until {
                        Some(until) if until <= now => self.read_armed = false,
                        until if self.read_armed => return DriverStatus::Waiting(until),
                        _ => {}
                    }
                }
            }
        }
        DriverStatus::Yield
    }

    /// Ends the link: waiting calls fail, and the connection closes once all bytes have left the
    /// machine.
    fn end(&mut self, now: Instant) -> DriverStatus {
        self.core.close();
        match self.sent_until {
            // A broadcast that was reported as sent is not cut off.
            Some(until) if self.io.is_some() && now < until => DriverStatus::Waiting(Some(until)),
            _ => DriverStatus::Ended,
        }
    }

    /// Closes the connection and reports that the link is closed; [`close`](super::Link::close)
    /// waits for that.
    pub(crate) fn finish(mut self) {
        self.io = None;
        self.state.end();
    }

    /// Reads all data and passes them to the core. Returns whether all were read: from a peer that
    /// never stops, only a number of reads are taken.
    fn read_all(&mut self, cx: &mut Context<'_>, clock: &mut Clock) -> io::Result<bool> {
        let mut bytes = buffer::borrow();
        let result = self.read_with(&mut bytes, cx, clock);
        buffer::give_back(bytes);
        result
    }

    /// Reads all data through an empty buffer, which is empty again in the end.
    fn read_with(&mut self, bytes: &mut BytesMut, cx: &mut Context<'_>, clock: &mut Clock) -> io::Result<bool> {
        while self.received < MAX_BYTES_AT_ONCE {
            let Some(io) = &mut self.io else { return Ok(true) };
            self.io_waker.clear_ready();
            // A frame that was taken from its beginning has left less room.
            bytes.reserve(buffer::LEN);
            let read = match poll_read_buf(Pin::new(io), cx, bytes) {
                Poll::Pending => return Ok(true),
                Poll::Ready(read) => read?,
            };
            if read == 0 {
                return Err(io::Error::new(io::ErrorKind::UnexpectedEof, CLOSED_BY_PEER));
            }
            self.received = self.received.saturating_add(read);
            // Read after the data: the frame gap of a serial line begins now.
            self.process_bytes(bytes, clock.look());
            if !self.core.is_idle() {
                // The deadline of the exchange may have passed.
                return Ok(false);
            }
        }
        Ok(false)
    }

    /// Passes received bytes to the core, and empties the buffer.
    fn process_bytes(&mut self, bytes: &mut BytesMut, now: Instant) {
        let received = self.core.receive_buffer();
        if !received.is_empty() {
            received.extend_from_slice(bytes);
            bytes.clear();
            self.core.received(now);
            let left = self.core.receive_buffer();
            if left.is_empty() {
                *left = BytesMut::new();
            }
            return;
        }
        debug_assert_eq!(received.capacity(), 0, "an empty buffer has no memory");
        // Mostly a frame comes whole, and is decoded where it was read.
        std::mem::swap(received, bytes);
        self.core.received(now);
        let left = self.core.receive_buffer();
        if left.is_empty() {
            std::mem::swap(left, bytes);
        } else {
            // Exactly as much memory as the incomplete frame needs.
            let kept = BytesMut::from(&left[..]);
            *bytes = std::mem::replace(left, kept);
        }
        bytes.clear();
    }

    /// Begins or continues to open a connection. Ready when the attempt has ended.
    fn open(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<()> {
        if std::mem::take(&mut self.open_requested) {
            match self.connect_limiter.clone() {
                Some(connect_limiter) => {
                    self.enter_waiting();
                    self.opening = Some(Opening::Queued(connect_limiter.wait().boxed()));
                }
                None => self.start_opening(None),
            }
        }
        match &mut self.opening {
            None => {}
            Some(Opening::Queued(slot)) => {
                let slot = ready!(slot.poll_unpin(cx));
                self.opening = None;
                if self.core.may_connect(now) {
                    self.start_opening(slot.take_permit());
                } else {
                    self.leave_waiting();
                }
            }
            Some(Opening::Connection { opening, .. }) => {
                let opened = ready!(opening.poll_unpin(cx));
                self.opening = None;
                self.opened(opened);
            }
        }
        Poll::Ready(())
    }

    /// Reports that the link waits for its slot. A link that is down keeps its state, and with it
    /// the error.
    fn enter_waiting(&self) {
        self.state.set_if(|state| !matches!(state, LinkState::Down { .. }), LinkState::Waiting);
    }

    /// Reports that the link no longer waits for its slot: no call needs the connection any more.
    fn leave_waiting(&self) {
        self.state.set_if(|state| matches!(state, LinkState::Waiting), LinkState::Idle);
    }

    /// Begins to open a connection. If the connector has none left, the link ends.
    fn start_opening(&mut self, permit: Option<ConnectPermit>) {
        match self.connector.open(self.core.config().connect_timeout, self.core.address()) {
            Some(opening) => {
                self.state.set(LinkState::Connecting);
                self.opening = Some(Opening::Connection { opening, _permit: permit });
            }
            None => self.ending = true,
        }
    }

    fn opened(&mut self, opened: io::Result<BoxIo>) {
        match opened {
            Ok(opened) => {
                tracing::debug!("connected");
                let has_other_addresses = opened.has_other_addresses();
                self.io = Some(opened);
                self.sent_until = None;
                self.core.connected(Instant::now());
                if has_other_addresses {
                    self.core.note_other_addresses();
                }
                self.state.set(LinkState::Up);
            }
            Err(error) => {
                tracing::debug!(%error, "cannot connect");
                let error = Arc::new(error);
                self.state.set(LinkState::Down { error: error.clone() });
                self.core.connect_failed(&error, Instant::now());
            }
        }
    }

    /// Handles a lost connection. If there can be no other, the link ends.
    fn connection_lost(&mut self, error: io::Error, now: Instant) {
        tracing::debug!(%error, "connection lost");
        self.io = None;
        self.writing = None;
        let error = Arc::new(error);
        if self.connector.reopens() {
            self.core.disconnected(&error, now);
        } else {
            self.core.abort(&error, now);
            self.ending = true;
        }
        self.state.set(LinkState::Down { error });
    }
}

/// An attempt to connect.
enum Opening {
    /// It waits for its slot.
    Queued(BoxFuture<'static, ConnectSlot>),
    Connection {
        opening: BoxFuture<'static, io::Result<BoxIo>>,
        /// Held until the attempt has ended: it limits the number of simultaneous attempts.
        _permit: Option<ConnectPermit>,
    },
}
