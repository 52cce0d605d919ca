//! The link: one connection, shared by many callers and many stations.
//!
//! - [`Link`] is the handle: cheap to clone, nothing but a sender to the task.
//! - `driver` is the task that owns the connection. It moves bytes and time, and decides nothing.
//! - `core` decides: which call is next, when to connect, whom to believe. It does no I/O and reads no clock.
//!   `connection` is whether there is one and when there may be another.
//! - `exchange` is the one request on the wire and the matching of its reply; `scheduler` is the order of the others;
//!   `stations` is whom to believe, and who is there.
//! - `call` is what a caller and the task share; `stats` is what everybody can see; `by_station` is a map for what is
//!   known of each station.
//! - `gate` lets links that share it connect one after the other.
//! - `transport` is what the bytes go over, and `line` how long they take.
#![cfg_attr(
    not(test),
    deny(
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::indexing_slicing,
        clippy::arithmetic_side_effects
    )
)]

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
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, timeout_at};
use tracing::Instrument;

use self::call::{AnyCall, Completion, Ticket};
use self::driver::{Driver, Message};
pub(crate) use self::gate::Gate;
use self::stats::Board;
pub(crate) use self::transport::{BoxIo, Connector};
use crate::command::{Command, InvalidRequest};
use crate::endpoint::{Endpoint, Transport};
use crate::error::Error;
use crate::station::{Broadcast, Station};
use crate::wire::Framing;

pub use self::builder::LinkBuilder;
pub use self::options::{CallOptions, EchoMode};
pub use self::stats::{LinkStats, RoundTripStats, StationState, StationStats};

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
    messages: mpsc::Sender<Message>,
    state: watch::Receiver<LinkState>,
    board: Arc<Board>,
    /// The serial line, if it is one.
    line: Option<Line>,
    /// The task, until the first call starts it.
    driver: Mutex<Option<Box<Driver>>>,
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
        let transport = endpoint.transport().clone();
        let connector = Connector::Endpoint { endpoint, keep_alive: true };
        let mut builder = LinkBuilder::with_connector(connector, framing, &name);
        match transport {
            Transport::Tcp { .. } => builder,
            Transport::Udp { .. } => {
                // What comes late for one socket never reaches the next.
                builder.config.fresh_on_doubt = true;
                builder
            }
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
        self.shared.messages.is_closed()
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
    /// Dropping the future does not undo it, once the task has been told; that may take a moment when very many calls are
    /// on their way to it.
    pub async fn close(&self) {
        // A task that has not been started has nothing to finish.
        if let Some(driver) = self.take_driver() {
            return driver.never_run();
        }
        // If that is not heard any more, somebody else has closed it, and may not be done yet.
        let _ = self.shared.messages.send(None).await;
        let mut state = self.shared.state.clone();
        let _ = state.wait_for(|state| matches!(state, LinkState::Closed)).await;
    }

    pub(crate) async fn call<C: Command>(
        &self,
        station: u8,
        request: C,
        options: CallOptions,
    ) -> Result<C::Reply, Error> {
        request.check(self.framing())?;
        let (call, mut completion) = call::new(request);
        self.submit(self.ticket::<C>(station, call, options), &mut completion).await
    }

    /// As [`call`](Self::call), and tells when the reply came; if none did, when that was known.
    pub(crate) async fn timed_call<C: Command>(
        &self,
        station: u8,
        request: C,
        options: CallOptions,
    ) -> (Result<C::Reply, Error>, Instant) {
        if let Err(error) = request.check(self.framing()) {
            return (Err(error.into()), Instant::now());
        }
        let (call, mut completion) = call::new(request);
        let result = self.submit(self.ticket::<C>(station, call, options), &mut completion).await;
        (result, completion.answered_at().unwrap_or_else(Instant::now))
    }

    /// Sends a request that no station answers.
    pub(crate) async fn cast<C: Command<Reply = ()>>(&self, request: C, options: CallOptions) -> Result<(), Error> {
        request.check(self.framing())?;
        let (call, mut completion) = call::unanswered(request, ());
        self.submit(self.ticket::<C>(0, call, options), &mut completion).await
    }

    fn ticket<C: Command>(&self, station: u8, call: Arc<dyn AnyCall>, options: CallOptions) -> Box<Ticket> {
        let class = C::CODE.class();
        let queued_at = Instant::now();
        Box::new(Ticket {
            call,
            station,
            code: C::CODE,
            lane: options.lane(class),
            deadline: later(queued_at, options.call_timeout),
            queued_at,
            response_timeout: options.response_timeout.unwrap_or(self.shared.response_timeout),
            options,
            retries_left: options.retries_for(class),
        })
    }

    async fn submit<C: Command>(&self, ticket: Box<Ticket>, completion: &mut Completion<C>) -> Result<C::Reply, Error> {
        self.start()?;
        let Ticket { station, code, queued_at, deadline, .. } = *ticket;
        let answered = timeout_at(deadline, async {
            self.shared.messages.send(Some(ticket)).await.map_err(|_| Error::Closed { sent: false })?;
            (&mut *completion).await
        })
        .instrument(tracing::debug_span!("call", link = %self.shared.name, station, command = code.name()));
        let result = answered.await.unwrap_or_else(|_| {
            let after = queued_at.elapsed();
            Err(Error::Timeout { station, code, after, sent: completion.abandon() })
        });
        // Before its time is up, a call times out because a station is silent, and what the connection does is another matter.
        let expired = Instant::now() >= deadline;
        match (result, &*self.shared.state.borrow()) {
            // The time was spent on trying to connect: that is what the caller wants to know.
            (Err(Error::Timeout { sent: false, .. }), LinkState::Down { error }) if expired => {
                Err(self.connect_error(error.clone()))
            }
            (Err(Error::Timeout { sent: false, .. }), LinkState::Waiting) if expired => {
                let reason = "too many other connections were to be opened before it";
                Err(self.connect_error(Arc::new(io::Error::new(io::ErrorKind::TimedOut, reason))))
            }
            (result, _) => result,
        }
    }

    /// Starts the task, the first time.
    fn start(&self) -> Result<(), Error> {
        let mut driver = self.lock_driver();
        if driver.is_none() {
            return Ok(());
        }
        // Only with a runtime at hand: a caller without one must not use the task up.
        let runtime = Handle::try_current().map_err(|error| self.connect_error(Arc::new(io::Error::other(error))))?;
        if let Some(driver) = driver.take() {
            runtime.spawn(driver.run().instrument(tracing::debug_span!("link", name = %self.shared.name)));
        }
        Ok(())
    }

    fn connect_error(&self, source: Arc<io::Error>) -> Error {
        Error::Connect { endpoint: self.shared.name.to_string(), source, sent: false }
    }

    fn take_driver(&self) -> Option<Box<Driver>> {
        self.lock_driver().take()
    }

    fn lock_driver(&self) -> MutexGuard<'_, Option<Box<Driver>>> {
        // Nothing panics while it holds this lock.
        self.shared.driver.lock().unwrap_or_else(PoisonError::into_inner)
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
