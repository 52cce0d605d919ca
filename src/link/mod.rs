//! The link: one connection, shared by many callers and many stations.
//!
//! - [`Link`] is the handle: cheap to clone, what all of them share and no more.
//! - `driver` owns the connection. It moves bytes and time, and decides nothing. `hub` is what handles and task share: the
//!   driver is advanced by the link's task and, to put a request on the wire, by a caller. `bell` is what wakes the task.
//! - `core` decides: which call is next, when to connect, whom to believe. It does no I/O and reads no clock.
//!   `connection` is whether there is one and when there may be another.
//! - `exchange` is the one request on the wire and the matching of its reply; `scheduler` is the order of the others;
//!   `stations` is whom to believe, and who is there.
//! - `call` is what a caller and the link share for one call; `stats` is what everybody can see; `by_station` is a map for what is
//!   known of each station.
//! - `buffer` is what they put bytes in that they have in hand.
//! - `gate` lets links that share it connect one after the other.
//! - `transport` is what the bytes go over, and `line` how long they take.

mod bell;
mod buffer;
mod builder;
#[cfg(all(test, feature = "sim"))]
pub(crate) mod bus_time;
mod by_station;
mod call;
mod config;
mod connection;
mod core;
mod driver;
mod exchange;
mod gate;
mod hub;
mod in_step;
pub(crate) mod job;
mod line;
pub(crate) use line::Line;
mod options;
mod scheduler;
mod stations;
mod stats;
mod transport;

use std::fmt;
use std::future::Future;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::consume_budget;
use tokio::time::{Instant, timeout_at};
use tracing::Instrument;

use self::call::{Spares, Terms};
pub(crate) use self::gate::Gate;
use self::hub::Hub;
pub(crate) use self::in_step::{Proof, Shape};
use self::stats::Board;
pub(crate) use self::transport::{BoxIo, Connector};
use crate::command::{Command, InvalidRequest, Spelling};
use crate::endpoint::{Endpoint, Transport};
use crate::error::Error;
use crate::station::{Broadcast, Station};
use crate::wire::Framing;

pub use self::builder::LinkBuilder;
pub use self::options::{CallOptions, EchoMode};
pub use self::stats::{CheckStats, LinkStats, RoundTripStats, SpellingStats, StationState, StationStats};

/// One connection to one or more PLCs. Cheap to clone; all clones share the connection.
///
/// Making a link does no I/O: the connection is opened by the first call, and again by the next call after it was
/// lost. A task of the Tokio runtime owns it; it ends when the last handle (this, or a [`Station`] or [`Broadcast`] of
/// it) is dropped, or with [`close`](Self::close).
///
/// ```no_run
/// use fatek::{Link, register};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let link = Link::new("tcp://192.168.2.3:500".parse()?);
/// let station = link.station(1)?;
/// let values = station.read_registers(register!("R12"), 3).await?;
/// println!("R12 to R14: {values:?}");
/// # Ok(())
/// # }
/// ```
#[derive(Clone)]
pub struct Link {
    shared: Arc<Shared>,
}

struct Shared {
    name: Arc<str>,
    framing: Framing,
    options: CallOptions,
    /// For calls whose options have none.
    response_timeout: Duration,
    hub: Arc<Hub>,
    spares: Spares,
    state: watch::Receiver<LinkState>,
    board: Arc<Board>,
    /// The serial line, if it is one.
    line: Option<Line>,
}

impl Drop for Shared {
    fn drop(&mut self) {
        self.hub.orphan();
    }
}

/// What a link's connection is doing.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum LinkState {
    /// Not open: no call has been made yet, or none for the [idle timeout](LinkBuilder::idle_timeout).
    Idle,
    /// Waiting for its turn to be opened: a [`Pool`](crate::Pool) opens only so many at a time. A link that was down stays
    /// so while it waits.
    Waiting,
    /// Being opened.
    Connecting,
    /// Open.
    Up,
    /// Lost, or not to be opened; the next call, or one that waits, tries again.
    #[non_exhaustive]
    Down {
        /// What happened.
        error: Arc<io::Error>,
    },
    /// Closed for good.
    Closed,
}

impl Link {
    /// A link to this endpoint, with the default settings.
    #[must_use]
    pub fn new(endpoint: Endpoint) -> Self {
        Self::builder(endpoint).build()
    }

    /// A link to this endpoint, with settings.
    pub fn builder(endpoint: Endpoint) -> LinkBuilder {
        let framing = endpoint.framing();
        let name = endpoint.to_string();
        let (transport, in_step) = (endpoint.transport().clone(), endpoint.in_step());
        let connector = Connector::Endpoint { endpoint, keep_alive: true };
        let builder = LinkBuilder::with_connector(connector, framing, &name).in_step(in_step);
        match transport {
            Transport::Tcp { .. } | Transport::Udp { .. } => builder,
            Transport::Serial { settings, .. } => builder.serial_line(settings),
        }
    }

    /// A link over a connection that is open already, and cannot be opened again once it is lost.
    ///
    /// For anything that reads and writes bytes: a `tokio::io::duplex` in a test, a tunnel, a port that was set up
    /// elsewhere.
    #[must_use]
    pub fn from_stream(stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static, framing: Framing) -> Self {
        Self::stream_builder(stream, framing).build()
    }

    /// As [`from_stream`](Self::from_stream), with settings.
    pub fn stream_builder(
        stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
        framing: Framing,
    ) -> LinkBuilder {
        LinkBuilder::with_connector(Connector::Once(Some(Box::new(stream))), framing, "the given stream")
    }

    /// A link over connections that `open` opens: the first one and, after each loss, the next one.
    ///
    /// They are opened by the link's task; requests are also written by callers, on the runtime that polls them.
    ///
    /// ```
    /// use fatek::{Link, wire::Framing};
    ///
    /// let link = Link::connector_builder("bench PLC", Framing::Ascii, || async {
    ///     tokio::net::TcpStream::connect("192.168.2.3:500").await
    /// })
    /// .build();
    /// ```
    pub fn connector_builder<F, Fut, T>(name: &str, framing: Framing, open: F) -> LinkBuilder
    where
        F: FnMut() -> Fut + Send + 'static,
        Fut: Future<Output = io::Result<T>> + Send + 'static,
        T: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        LinkBuilder::with_connector(Connector::custom(open), framing, name)
    }

    /// The PLC with this station number, 1 to 254.
    ///
    /// # Errors
    /// [`InvalidRequest::Station`] for 0 and 255.
    pub fn station(&self, station: u8) -> Result<Station, InvalidRequest> {
        Station::new(self.clone(), station, self.shared.options)
    }

    /// All PLCs of the link at once. None of them answers.
    #[must_use]
    pub fn broadcast(&self) -> Broadcast {
        Broadcast::new(self.clone(), self.shared.options)
    }

    /// How frames look on this link.
    #[must_use]
    pub fn framing(&self) -> Framing {
        self.shared.framing
    }

    /// What the connection is doing now.
    #[must_use]
    pub fn state(&self) -> LinkState {
        self.shared.state.borrow().clone()
    }

    /// What the connection is doing, to be watched.
    #[must_use]
    pub fn watch_state(&self) -> watch::Receiver<LinkState> {
        self.shared.state.clone()
    }

    /// What has gone over the link so far: a snapshot.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.read_status().await?;
    /// let stats = station.link().stats();
    /// assert_eq!((stats.stations.requests, stats.stations.replies, stats.checksum_errors), (1, 1, 0));
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn stats(&self) -> LinkStats {
        self.shared.board.link()
    }

    /// Whether it will never do anything again: it has been closed, or its task has ended.
    pub(crate) fn is_closed(&self) -> bool {
        self.shared.hub.is_closed()
    }

    /// How many handles there are, those of stations included.
    pub(crate) fn handles(&self) -> usize {
        Arc::strong_count(&self.shared)
    }

    /// The endpoint, or what a link over something else was called.
    pub(crate) fn name(&self) -> &str {
        &self.shared.name
    }

    pub(crate) fn line(&self) -> Option<Line> {
        self.shared.line
    }

    pub(crate) fn board(&self) -> &Board {
        &self.shared.board
    }

    /// Closes the link for all its handles: what waits fails with [`Error::Closed`], the request on the wire is
    /// finished, the connection is closed. Returns when that is done; calls made later fail at once.
    ///
    /// Dropping the future does not undo it.
    pub async fn close(&self) {
        // If somebody else has closed it, that may not be done yet.
        self.shared.hub.close();
        let mut state = self.shared.state.clone();
        let _ = state.wait_for(|state| matches!(state, LinkState::Closed)).await;
    }

    /// Has a request sent.
    // Whatever a call needs is moved on before anything is awaited: its future is part of its caller's, of which there may be
    // thousands.
    pub(crate) async fn submit<C: Command>(
        &self,
        station: u8,
        request: C,
        purpose: Purpose<C>,
        options: CallOptions,
    ) -> Answered<C::Reply> {
        if let Err(error) = request.check(self.framing()).map_err(Error::from).and_then(|()| self.start()) {
            return Answered::none(Err(error), request.plain());
        }
        let queued_at = Instant::now();
        let deadline = later(queued_at, options.call_timeout);
        let terms = Terms {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline,
            queued_at,
            response_timeout: options.response_timeout.unwrap_or(self.shared.response_timeout),
            options,
            longer: matches!(purpose, Purpose::Part),
            confirms: matches!(purpose, Purpose::Confirm(_)),
        };
        let in_job = matches!(purpose, Purpose::InJob | Purpose::Part);
        let unanswered = match purpose {
            Purpose::Whole | Purpose::InJob | Purpose::Part => None,
            Purpose::Broadcast(reply) | Purpose::Confirm(reply) => Some(reply),
        };
        let (ticket, mut completion) = call::new(request, unanswered, terms, &self.shared.spares);
        // Until the call has ended.
        let span = tracing::debug_span!("call", link = %self.shared.name, station, command = C::CODE.name());
        // What is done for the link now may be for others' calls, too.
        self.span().in_scope(|| self.shared.hub.submit(ticket));
        // It may never have to wait: a broadcast is done when it is written. All the same, others have their turn.
        consume_budget().await;
        let answered = timeout_at(deadline, &mut completion).await;
        drop(span);
        let result = answered.unwrap_or_else(|_| {
            let after = queued_at.elapsed();
            let (code, sent) = (C::CODE, completion.abandon());
            Err(match completion.is_in_doubt() {
                true => Error::OutOfStep { station, code, after, sent },
                false => Error::Timeout { station, code, after, sent },
            })
        });
        let mut answered = Answered::none(result.map_err(|error| self.explain(error, deadline)), completion.spelling());
        answered.at = completion.answered_at();
        answered.proof = completion.proof();
        if in_job {
            answered.shape = completion.shape(self.framing());
        }
        completion.recycle(&self.shared.spares);
        answered
    }

    /// When the time was spent on trying to connect, that is what the caller wants to know.
    fn explain(&self, error: Error, deadline: Instant) -> Error {
        // Before its time is up, a call times out because a station is silent, and what the connection does is another matter.
        if !matches!(error, Error::Timeout { sent: false, .. }) || Instant::now() < deadline {
            return error;
        }
        match &*self.shared.state.borrow() {
            LinkState::Down { error } => self.connect_error(error.clone()),
            LinkState::Waiting => {
                let reason = "too many other connections were to be opened before it";
                self.connect_error(Arc::new(io::Error::new(io::ErrorKind::TimedOut, reason)))
            }
            LinkState::Idle | LinkState::Connecting | LinkState::Up | LinkState::Closed => error,
        }
    }

    /// Starts the task, the first time.
    fn start(&self) -> Result<(), Error> {
        if self.shared.hub.is_started(false) {
            return Ok(());
        }
        // Only with a runtime at hand: a caller without one must not use the task up.
        let runtime = Handle::try_current().map_err(|error| self.connect_error(Arc::new(io::Error::other(error))))?;
        if !self.shared.hub.is_started(true) {
            let task = self.shared.hub.clone().run();
            runtime.spawn(task.instrument(self.span()));
        }
        Ok(())
    }

    /// What is told of the link is told in this span, whoever lends it the time.
    fn span(&self) -> tracing::Span {
        tracing::debug_span!(parent: None, "link", name = %self.shared.name)
    }

    fn connect_error(&self, source: Arc<io::Error>) -> Error {
        Error::Connect { endpoint: self.shared.name.to_string(), source, sent: false }
    }
}

/// What a call is for.
pub(crate) enum Purpose<C: Command> {
    /// The request is all that is asked for.
    Whole,
    /// A request of a [`job`].
    InJob,
    /// A part of a longer read or write, which is a job: it may leave elements to the next request.
    Part,
    /// A broadcast, which has this result once it is sent.
    Broadcast(C::Reply),
    /// The confirmation of what was taken before, which has this result. The request itself is never sent.
    Confirm(C::Reply),
}

/// The result of a call.
pub(crate) struct Answered<T> {
    pub(crate) result: Result<T, Error>,
    /// When the reply came, if one did.
    pub(crate) at: Option<Instant>,
    /// How the request was spelt.
    pub(crate) spelling: Spelling,
    /// The shape of the positive reply, within a job.
    pub(crate) shape: Shape,
    /// What was proven of the station when the reply was taken.
    pub(crate) proof: Proof,
}

impl<T> Answered<T> {
    fn none(result: Result<T, Error>, spelling: Spelling) -> Self {
        Self { result, at: None, spelling, shape: Shape { code: spelling.code, size: 0 }, proof: Proof::default() }
    }
}

impl fmt::Debug for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Link({}, {})", self.shared.name, self.shared.framing)
    }
}

/// An instant this much later. A day at the most: far more than any call should take, and still within what a clock can
/// hold.
fn later(now: Instant, by: Duration) -> Instant {
    now.checked_add(by.min(Duration::from_secs(86_400))).unwrap_or(now)
}
