//! The task that owns the connection: it moves bytes and time between the [`Core`] and the world, and decides nothing.

use std::future::poll_fn;
use std::io;
use std::mem::MaybeUninit;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Poll, ready};
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead as _, AsyncWriteExt, ReadBuf};
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep_until, timeout_at};

use super::LinkState;
use super::call::Ticket;
use super::core::{Core, Step};
use super::gate::{Gate, Pass, Turn};
use super::later;
use super::line::Line;
use super::transport::{BoxIo, Connector};

/// What the handles tell the task: here is a call; or, with `None`, to end.
///
/// No more than a pointer, for the channel keeps room for dozens of them, and there may be thousands of links.
pub(crate) type Message = Option<Box<Ticket>>;

/// Everything the task needs to run.
#[derive(Debug)]
pub(crate) struct Driver {
    pub(crate) core: Core,
    pub(crate) connector: Connector,
    pub(crate) connect_timeout: Duration,
    /// What lets links connect one after the other, if they share one.
    pub(crate) gate: Option<Arc<Gate>>,
    /// The serial line, if it is one.
    pub(crate) line: Option<Line>,
    /// Until when the line is busy with what has been written.
    pub(crate) sent_until: Option<Instant>,
    pub(crate) messages: mpsc::Receiver<Message>,
    pub(crate) state: watch::Sender<LinkState>,
}

/// How often is read before a request, to be rid of what came before it.
const MAX_DRAINED_READS: usize = 64;

/// How much is read at once. The longest reply fits.
const READ_LEN: usize = 1024;

impl Driver {
    /// Runs until the link is closed, its last handle is dropped, or its one connection has ended.
    pub(crate) async fn run(mut self: Box<Self>) {
        // In its box, for it would be in the task twice: as what the future begins with, and as what it works on.
        let mut io: Option<BoxIo> = None;
        let mut opening: Option<Opening> = None;
        let mut orphaned = false;
        let mut retired: Option<BoxIo> = None;
        loop {
            // A peer that never stops sending must not keep the handles from being heard.
            while let Ok(message) = self.messages.try_recv() {
                self.hear(message);
            }
            if self.core.is_idle() {
                // What has come by now came before the next request, so it is no reply to that.
                if let Some(Err(error)) = drain(&mut io, &mut self.core)
                    && !self.lose(&mut io, error)
                {
                    break;
                }
            }
            match self.core.step(Instant::now()) {
                Step::Connect => {
                    // A fresh socket must differ from the old one, so that one is kept until the new one is open.
                    retired = io.take();
                    opening = match self.gate.clone() {
                        Some(gate) => {
                            self.waits();
                            Some(Opening::Turn(gate.turn().boxed()))
                        }
                        None => self.open(None),
                    };
                    if opening.is_none() {
                        break;
                    }
                }
                Step::Disconnect => {
                    tracing::debug!("idle");
                    io = None;
                    self.state.send_replace(LinkState::Idle);
                }
                Step::Send(by) => {
                    let written = match &mut io {
                        // Flushing a serial port blocks the thread until the last bit is on the line.
                        Some(io) => write(io, self.core.outgoing(), self.line.is_none(), by).await,
                        None => Err(io::ErrorKind::NotConnected.into()),
                    };
                    match written {
                        Ok(()) => {
                            let at = self.transmitted_at();
                            self.core.sent(at);
                        }
                        Err(error) => {
                            if !self.lose(&mut io, error) {
                                break;
                            }
                        }
                    }
                }
                // Not before what is on the wire has ended, so that the PLC is not cut off in the middle of its answer.
                Step::Wait(_) if (self.core.is_closing() || orphaned) && self.core.is_idle() => break,
                Step::Wait(until) => tokio::select! {
                    // In this order, so that a run can be repeated: what has come is dealt with before time passes.
                    biased;
                    read = read(&mut io, &mut self.core) => match read {
                        Ok(()) => self.core.received(Instant::now()),
                        Err(error) => {
                            if !self.lose(&mut io, error) {
                                break;
                            }
                        }
                    },
                    opened = opened(&mut opening) => {
                        opening = None;
                        match opened {
                            Progress::Opened(opened) => {
                                drop(retired.take());
                                self.opened(opened, &mut io);
                            }
                            Progress::Turn(turn) if self.core.may_connect(Instant::now()) => {
                                opening = self.open(turn.take());
                                if opening.is_none() {
                                    break;
                                }
                            }
                            Progress::Turn(_) => self.waits_no_more(),
                        }
                    }
                    message = self.messages.recv(), if !orphaned => match message {
                        Some(message) => self.hear(message),
                        None => orphaned = true,
                    },
                    () = pause(until) => {}
                },
            }
        }
        self.messages.close();
        self.core.close();
        if let (Some(_), Some(until)) = (&io, self.sent_until) {
            // A broadcast that has been said to be sent is not cut off.
            sleep_until(until).await;
        }
        drop(io);
        // Whoever closes it waits for this: now all is done.
        self.state.send_replace(LinkState::Closed);
    }

    /// Ends it before it has begun.
    pub(crate) fn never_run(self) {
        self.state.send_replace(LinkState::Closed);
    }

    fn hear(&mut self, message: Message) {
        match message {
            Some(ticket) => self.core.push(ticket, Instant::now()),
            None => {
                self.messages.close();
                self.core.close();
            }
        }
    }

    /// When what has just been written leaves the machine. On a serial line, it waits for what was written before.
    fn transmitted_at(&mut self) -> Instant {
        let now = Instant::now();
        let Some(line) = self.line else { return now };
        let begins = self.sent_until.map_or(now, |until| until.max(now));
        let ends = later(begins, line.transmission(self.core.outgoing().len()));
        self.sent_until = Some(ends);
        ends
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

    /// Begins to open a connection. `None`: there will never be another.
    fn open(&mut self, pass: Option<Pass>) -> Option<Opening> {
        let opening = self.connector.open(self.connect_timeout)?;
        self.state.send_replace(LinkState::Connecting);
        Some(Opening::Connection { opening, _pass: pass })
    }

    fn opened(&mut self, opened: io::Result<BoxIo>, io: &mut Option<BoxIo>) {
        match opened {
            Ok(opened) => {
                tracing::debug!("connected");
                *io = Some(opened);
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

    /// The connection is lost; says whether there can be another.
    fn lose(&mut self, io: &mut Option<BoxIo>, error: io::Error) -> bool {
        tracing::debug!(%error, "connection lost");
        *io = None;
        let error = Arc::new(error);
        let reopens = self.connector.reopens();
        if reopens {
            self.core.disconnected(&error, Instant::now());
        } else {
            self.core.abort(&error);
        }
        self.state.send_replace(LinkState::Down { error });
        reopens
    }
}

async fn write(io: &mut BoxIo, bytes: &[u8], flush: bool, by: Instant) -> io::Result<()> {
    let written = timeout_at(by, async {
        io.write_all(bytes).await?;
        if flush { io.flush().await } else { Ok(()) }
    });
    written
        .await
        .unwrap_or_else(|_| Err(io::Error::new(io::ErrorKind::TimedOut, "the request could not be written in time")))
}

/// Waits for bytes and puts them where the core looks for them; for ever if there is no connection.
async fn read(io: &mut Option<BoxIo>, core: &mut Core) -> io::Result<()> {
    let Some(io) = io else { return std::future::pending().await };
    poll_fn(|cx| {
        // Not kept while nothing comes: most links wait most of the time, and there may be thousands of them.
        let mut buffer = [const { MaybeUninit::uninit() }; READ_LEN];
        let mut buffer = ReadBuf::uninit(&mut buffer);
        ready!(Pin::new(&mut *io).poll_read(cx, &mut buffer))?;
        core.incoming().extend_from_slice(buffer.filled());
        Poll::Ready(match buffer.filled() {
            [] => Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the other end closed it")),
            _ => Ok(()),
        })
    })
    .await
}

/// Takes what can be read without waiting; of a peer that never stops, no more than a few reads' worth.
fn drain(io: &mut Option<BoxIo>, core: &mut Core) -> Option<io::Result<()>> {
    for _ in 0..MAX_DRAINED_READS {
        io.as_ref()?;
        match read(io, core).now_or_never()? {
            Ok(()) => core.received(Instant::now()),
            error => return Some(error),
        }
    }
    None
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

enum Progress {
    Turn(Turn),
    Opened(io::Result<BoxIo>),
}

async fn opened(opening: &mut Option<Opening>) -> Progress {
    match opening {
        Some(Opening::Turn(turn)) => Progress::Turn(turn.await),
        Some(Opening::Connection { opening, .. }) => Progress::Opened(opening.await),
        None => std::future::pending().await,
    }
}

async fn pause(until: Option<Instant>) {
    match until {
        Some(until) => sleep_until(until).await,
        None => std::future::pending().await,
    }
}
