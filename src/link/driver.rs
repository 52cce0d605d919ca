//! What moves bytes and time between the [`Core`] and the world, and decides nothing. It owns the connection.
//!
//! ```text
//!        ┌───────────────────────────────────────────────────────────────┐
//!        ▼                                                               │
//! a request is being written ──done──▶ read until nothing comes ──▶ what does the core want?
//!                                                                  connect, disconnect, send: done, and on
//!                                                                  wait: back to whoever called
//! ```
//!
//! [`Driver::advance`] goes as far as it can without waiting. It is called by the link's task whenever something that it
//! waits for has come, and by a caller with a new request, so that this is sent without waking the task. It is always the task
//! that is woken by the connection: a caller only lends its time, and may go away at any moment.
//!
//! What must always hold:
//! - a request is begun only after all that had come was read;
//! - a request of which a part has been written is written to its end, or the connection is given up;
//! - the task hears of everything that `advance` waits for: bytes and room for bytes by its waker, times because
//!   `advance` tells them.

#[cfg(test)]
mod tests;

use std::io;
use std::mem::MaybeUninit;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker, ready};
use std::time::Duration;

use bytes::BytesMut;
use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead as _, AsyncWrite as _, ReadBuf};
use tokio::sync::watch;
use tokio::time::Instant;

use super::LinkState;
use super::bell::Bell;
use super::buffer;
use super::call::Ticket;
use super::core::{Core, Step};
use super::gate::{Gate, Pass, Turn};
use super::later;
use super::line::Line;
use super::transport::{BoxIo, Connector, Io};

/// Everything that is needed to run a link.
pub(crate) struct Driver {
    core: Core,
    connector: Connector,
    connect_timeout: Duration,
    /// What lets links connect one after the other, if they share one.
    gate: Option<Arc<Gate>>,
    /// The serial line, if it is one.
    line: Option<Line>,
    /// Until when the line is busy with what has been written.
    sent_until: Option<Instant>,
    state: watch::Sender<LinkState>,
    bell: Arc<Bell>,
    /// The bell's.
    waker: Waker,
    /// Whether all had been read that had come when the ring was taken last, so that the bell rings when more comes.
    listens: bool,
    io: Option<BoxIo>,
    opening: Option<Opening>,
    /// Whether the core wants a connection, and the task has not begun to open it yet.
    connects: bool,
    writing: Option<Writing>,
    /// Whether there is a handle that can make calls.
    orphaned: bool,
    /// Whether nothing new is done any more.
    ending: bool,
}

/// A request on its way out.
#[derive(Debug)]
struct Writing {
    /// How much of it is out.
    written: usize,
    /// When it must be.
    by: Instant,
}

/// What is left to wait for, when all has been done that can be.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Next {
    /// What the waker was given to, or this time, if there is one.
    Wait(Option<Instant>),
    /// Something that only the task can do.
    Task,
    /// Nothing; but others are to have their turn.
    Yield,
    /// Nothing, for good.
    End,
}

/// Who lends its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum By {
    Task,
    Caller,
}

/// The time, looked at no more often than is needed.
struct Clock(Option<Instant>);

impl Clock {
    /// What it was when it was looked at last.
    fn now(&mut self) -> Instant {
        *self.0.get_or_insert_with(Instant::now)
    }

    /// What it is.
    fn look(&mut self) -> Instant {
        *self.0.insert(Instant::now())
    }
}

/// How often is read before a request, to be rid of what came before it; and how many steps are made before others have
/// their turn.
const MAX_AT_ONCE: usize = 64;

impl Driver {
    pub(crate) fn new(
        core: Core,
        (connector, connect_timeout): (Connector, Duration),
        gate: Option<Arc<Gate>>,
        line: Option<Line>,
        state: watch::Sender<LinkState>,
    ) -> Self {
        let bell = Arc::new(Bell::default());
        Self {
            core,
            connector,
            connect_timeout,
            gate,
            line,
            sent_until: None,
            state,
            waker: Waker::from(bell.clone()),
            bell,
            listens: false,
            io: None,
            opening: None,
            connects: false,
            writing: None,
            orphaned: false,
            ending: false,
        }
    }

    /// Takes a call.
    pub(crate) fn push(&mut self, ticket: Ticket, now: Instant) {
        self.core.push(ticket, now);
    }

    /// Sends nothing new any more.
    pub(crate) fn close(&mut self) {
        if !self.core.is_closing() {
            self.core.close();
        }
    }

    /// The last handle is gone.
    pub(crate) fn orphan(&mut self) {
        self.orphaned = true;
    }

    /// What rings when there is something to be done.
    pub(crate) fn bell(&self) -> &Arc<Bell> {
        &self.bell
    }

    /// For what the task waits for.
    pub(crate) fn context(&self) -> Context<'_> {
        Context::from_waker(&self.waker)
    }

    /// Whether a call that comes now would be sent at once, as far as can be told.
    pub(crate) fn is_free(&self) -> bool {
        self.io.is_some() && self.opening.is_none() && self.writing.is_none() && !self.ending && self.core.is_idle()
    }

    /// Whether a call that comes now waits for nothing but the end of the request on the wire, which the task awaits.
    pub(crate) fn is_at_work(&self) -> bool {
        self.io.is_some() && self.writing.is_none() && !self.core.is_idle()
    }

    #[cfg(test)]
    pub(crate) fn shown(&self) -> String {
        format!("{:?}", self.core)
    }

    /// Does what can be done now; `now` is the time, if it was looked at a moment ago.
    pub(crate) fn advance(&mut self, by: By, now: Option<Instant>) -> Next {
        let waker = std::mem::replace(&mut self.waker, Waker::noop().clone());
        let next = self.steps(by, &mut Clock(now), &mut Context::from_waker(&waker));
        self.waker = waker;
        next
    }

    fn steps(&mut self, by: By, clock: &mut Clock, cx: &mut Context<'_>) -> Next {
        // Some users' streams have more, and tell nobody.
        self.listens = self.listens && self.connector.tells();
        let mut sends = false;
        for _ in 0..MAX_AT_ONCE {
            if self.ending {
                return self.end(clock.now());
            }
            if let Some(Writing { by, .. }) = self.writing {
                match self.poll_write(cx) {
                    Poll::Pending if clock.now() < by => return Next::Wait(Some(by)),
                    Poll::Pending => {
                        let late = "the request could not be written in time";
                        self.lose(io::Error::new(io::ErrorKind::TimedOut, late), clock.now());
                    }
                    Poll::Ready(Ok(())) => {
                        let at = self.transmitted_at(clock);
                        self.core.sent(at);
                        let late = self.io.as_deref_mut().map(<dyn Io>::take_late).unwrap_or_default();
                        self.core.late_datagrams(late);
                        self.listens = self.listens && self.connector.tells();
                    }
                    Poll::Ready(Err(error)) => self.lose(error, clock.now()),
                }
                continue;
            }
            if !self.listens || self.bell.has_rung() {
                match self.read_all(cx, clock) {
                    Ok(all) => self.listens = all,
                    Err(error) => {
                        self.lose(error, clock.now());
                        continue;
                    }
                }
            }
            let now = clock.now();
            match self.core.step(now) {
                Step::Connect => {
                    self.io = None;
                    self.connects = true;
                }
                Step::Disconnect => {
                    tracing::debug!("idle");
                    self.io = None;
                    self.state.send_replace(LinkState::Idle);
                }
                Step::Send(by) => {
                    if std::mem::replace(&mut sends, true) {
                        // What was sent before it has taken its time.
                        clock.look();
                    }
                    self.writing = Some(Writing { written: 0, by });
                }
                // Not before what is on the wire has ended, so that the PLC is not cut off in the middle of its answer.
                Step::Wait(_) if (self.core.is_closing() || self.orphaned) && self.core.is_idle() => self.ending = true,
                Step::Wait(until) => {
                    if self.opening.is_some() || self.connects {
                        if by == By::Caller {
                            return Next::Task;
                        }
                        if self.open(cx, now).is_ready() {
                            clock.look();
                            self.listens = false;
                            continue;
                        }
                    }
                    match until {
                        Some(until) if until <= now => self.listens = false,
                        until if self.listens => return Next::Wait(until),
                        _ => {}
                    }
                }
            }
        }
        Next::Yield
    }

    /// The end of all: calls that wait fail, and the connection is closed as soon as what was sent has left the machine.
    fn end(&mut self, now: Instant) -> Next {
        self.core.close();
        match self.sent_until {
            // A broadcast that has been said to be sent is not cut off.
            Some(until) if self.io.is_some() && now < until => Next::Wait(Some(until)),
            _ => Next::End,
        }
    }

    /// Closes the connection. Whoever closes the link waits for this: now all is done.
    pub(crate) fn finish(mut self) {
        self.io = None;
        self.state.send_replace(LinkState::Closed);
    }

    /// When what has just been written leaves the machine. On a serial line, it waits for what was written before; a socket
    /// takes it at once, so that the clock need not be looked at for it; and what a user's stream does within a write or a flush
    /// may take long.
    fn transmitted_at(&mut self, clock: &mut Clock) -> Instant {
        let Some(line) = self.line else {
            return if self.connector.tells() { clock.now() } else { clock.look() };
        };
        let now = clock.look();
        let begins = self.sent_until.map_or(now, |until| until.max(now));
        let ends = later(begins, line.transmission(self.core.outgoing().len()));
        self.sent_until = Some(ends);
        ends
    }

    /// Goes on writing the request; ready when that is over.
    fn poll_write(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Some(writing) = &mut self.writing else { return Poll::Ready(Ok(())) };
        let Some(io) = &mut self.io else {
            self.writing = None;
            return Poll::Ready(Err(io::ErrorKind::NotConnected.into()));
        };
        let result = loop {
            match self.core.outgoing().get(writing.written..) {
                Some(rest) if !rest.is_empty() => match ready!(Pin::new(&mut *io).poll_write(cx, rest)) {
                    Ok(0) => break Err(io::ErrorKind::WriteZero.into()),
                    Ok(written) => writing.written = writing.written.saturating_add(written),
                    Err(error) => break Err(error),
                },
                // Flushing a serial port blocks the thread until the last bit is on the line.
                _ if self.line.is_some() => break Ok(()),
                _ => break ready!(Pin::new(&mut *io).poll_flush(cx)),
            }
        };
        self.writing = None;
        Poll::Ready(result)
    }

    /// Reads what has come, and lets the core understand it. Says whether that is all; of a peer that never stops, no more
    /// than a few reads' worth is taken.
    fn read_all(&mut self, cx: &mut Context<'_>, clock: &mut Clock) -> io::Result<bool> {
        for _ in 0..MAX_AT_ONCE {
            let Some(io) = &mut self.io else { return Ok(true) };
            self.bell.take();
            let mut bytes = [const { MaybeUninit::uninit() }; buffer::LEN];
            let mut bytes = ReadBuf::uninit(&mut bytes);
            match Pin::new(io).poll_read(cx, &mut bytes) {
                Poll::Pending => return Ok(true),
                Poll::Ready(result) => result?,
            }
            if bytes.filled().is_empty() {
                return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the other end closed it"));
            }
            // Not before it has been read: the gap on a serial line begins then.
            self.understand(bytes.filled(), clock.look());
            if !self.core.is_idle() {
                // Its time may be up.
                return Ok(false);
            }
        }
        Ok(false)
    }

    fn understand(&mut self, bytes: &[u8], now: Instant) {
        let borrows = self.core.incoming().is_empty();
        if borrows {
            *self.core.incoming() = buffer::borrow();
        }
        self.core.incoming().extend_from_slice(bytes);
        self.core.received(now);
        let left = self.core.incoming();
        // As much as is needed, and no more.
        let kept = if left.is_empty() { BytesMut::new() } else { BytesMut::from(&left[..]) };
        if borrows {
            buffer::give_back(std::mem::replace(left, kept));
        } else if left.is_empty() {
            *left = kept;
        }
    }

    /// Goes on opening a connection, or begins to; ready when something has come of it.
    fn open(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<()> {
        if std::mem::take(&mut self.connects) {
            match self.gate.clone() {
                Some(gate) => {
                    self.waits();
                    self.opening = Some(Opening::Turn(gate.turn().boxed()));
                }
                None => self.begin_to_open(None),
            }
        }
        match &mut self.opening {
            None => {}
            Some(Opening::Turn(turn)) => {
                let turn = ready!(turn.poll_unpin(cx));
                self.opening = None;
                if self.core.may_connect(now) {
                    self.begin_to_open(turn.take());
                } else {
                    self.waits_no_more();
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

    /// It is not its turn to connect yet. A link that is down goes on saying why.
    fn waits(&self) {
        self.state.send_if_modified(|state| {
            let down = matches!(state, LinkState::Down { .. });
            if !down {
                *state = LinkState::Waiting;
            }
            !down
        });
    }

    /// It is its turn, and nobody wants that any more.
    fn waits_no_more(&self) {
        self.state.send_if_modified(|state| {
            let waiting = matches!(state, LinkState::Waiting);
            if waiting {
                *state = LinkState::Idle;
            }
            waiting
        });
    }

    /// Begins to open a connection. If there will never be another, that is the end.
    fn begin_to_open(&mut self, pass: Option<Pass>) {
        match self.connector.open(self.connect_timeout) {
            Some(opening) => {
                self.state.send_replace(LinkState::Connecting);
                self.opening = Some(Opening::Connection { opening, _pass: pass });
            }
            None => self.ending = true,
        }
    }

    fn opened(&mut self, opened: io::Result<BoxIo>) {
        match opened {
            Ok(opened) => {
                tracing::debug!("connected");
                self.io = Some(opened);
                self.sent_until = None;
                self.core.connected(Instant::now());
                self.state.send_replace(LinkState::Up);
            }
            Err(error) => {
                tracing::debug!(%error, "cannot connect");
                let error = Arc::new(error);
                self.state.send_replace(LinkState::Down { error: error.clone() });
                self.core.connect_failed(&error, Instant::now());
            }
        }
    }

    /// The connection is lost. If there can be no other, that is the end.
    fn lose(&mut self, error: io::Error, now: Instant) {
        tracing::debug!(%error, "connection lost");
        self.io = None;
        self.writing = None;
        let error = Arc::new(error);
        if self.connector.reopens() {
            self.core.disconnected(&error, now);
        } else {
            self.core.abort(&error);
            self.ending = true;
        }
        self.state.send_replace(LinkState::Down { error });
    }
}

/// A connection on its way.
enum Opening {
    /// It waits for its turn.
    Turn(BoxFuture<'static, Turn>),
    Connection {
        opening: BoxFuture<'static, io::Result<BoxIo>>,
        /// Held until it is open, so that not too many are opened at once.
        _pass: Option<Pass>,
    },
}
