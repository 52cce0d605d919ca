//! The link: one connection, shared by many callers and many stations.
//!
//! [`Link`] is the handle, made by [`Link::new`] or a [`LinkBuilder`]. [`CallOptions`] say how
//! calls are treated; [`LinkState`], [`LinkStats`] and [`StationStats`] show what happens on the
//! line.

// The parts:
// - `shared`: the state that handles and the task share. The task advances the driver. So does a
//   caller, to put its request on the wire. `io_waker` wakes the task.
// - `driver`: owns the connection, moves bytes and time, and decides nothing.
// - `core`: decides which call is next, when to connect, and whether a reply is proven. It has no
//   I/O and no clock. Its parts: `connection`, `exchange` (the request on the wire), `scheduler`
//   (the order of waiting calls), `stations` (online or not), `in_step` (the rule about replies).
// - `call`: the state that a caller and the link share for one call.
// - `job`: several calls that are confirmed together.
// - `stats`: counters and states. `by_station`: a map. `buffer`: a buffer per thread.
// - `mute`: detects connections over which nothing is answered any more.
// - `connect_limiter`: limits the connection attempts of several links.
// - `connector`: opens the connections. `line`: transmission times.
// - `send_gate`: a permission that the driver asks for before each write.
mod buffer;
mod builder;
#[cfg(all(test, feature = "sim"))]
pub(crate) mod bus_time;
mod by_station;
mod call;
mod config;
mod connect_limiter;
mod connection;
mod connector;
mod core;
pub mod defaults;
mod driver;
mod exchange;
mod frame_gap;
mod in_step;
mod io_waker;
pub(crate) mod job;
mod line;
mod mute;
mod one_request;
mod shared;
mod shared_capabilities;
pub(crate) use line::Line;
mod options;
mod scheduler;
mod send_gate;
mod state;
mod stations;
mod stats;
#[cfg(test)]
mod test_line;
mod watchable;

use std::fmt;
use std::future::Future;
use std::io;
use std::panic::AssertUnwindSafe;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::runtime::{Handle, Id, TryCurrentError};
use tokio::sync::watch;
use tokio::task::{consume_budget, yield_now};
use tokio::time::Instant;
use tracing::Instrument;
use tracing::level_filters::LevelFilter;

use self::by_station::ByStation;
use self::call::{CallMeta, Sending};
use self::config::Config;
pub(crate) use self::config::SharedConfigs;
pub(crate) use self::connect_limiter::ConnectLimiter;
pub(crate) use self::connector::Connector;
pub(crate) use self::in_step::{Declared, LongestReads, Prices, Proof, Shape};
use self::shared::Shared;
use self::shared_capabilities::SharedCapabilities;
use self::state::SharedLinkState;
use self::stats::SharedStats;
use crate::capabilities::{Capabilities, Refused};
use crate::command::{Command, InvalidRequest, Spelling};
use crate::endpoint::{Endpoint, InStepSettings};
use crate::error::{Error, Rounded};
use crate::station::{Broadcast, Station};
use crate::wire::Framing;

pub use self::builder::LinkBuilder;
pub use self::options::{CallOptions, EchoMode};
pub use self::send_gate::SendGate;
pub use self::state::LinkState;
pub use self::stats::{CheckStats, LinkStats, RoundTripStats, SpellingStats, StationState, StationStats};

/// One connection to one or more PLCs. Cheap to clone; all clones share the connection.
///
/// Making a link does no I/O. The first call opens the connection, and after a loss the next call
/// opens it again. A task of the Tokio runtime owns the connection. It ends with
/// [`close`](Self::close), or when the last handle (this, or a [`Station`] or [`Broadcast`] of it)
/// is dropped.
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
    inner: Arc<LinkInner>,
}

struct LinkInner {
    name: Arc<str>,
    config: Arc<Config>,
    options: CallOptions,
    shared: Arc<Shared>,
    /// For each station whose bits of registers were changed: held from the read to the write.
    modifying: OnceLock<Box<Mutex<ByStation<ModifyLock>>>>,
    capabilities: SharedCapabilities,
    state: Arc<SharedLinkState>,
    stats: Arc<SharedStats>,
}

/// Held by a change of bits of a station's registers.
type ModifyLock = Arc<AssertUnwindSafe<tokio::sync::Mutex<()>>>;

impl Drop for LinkInner {
    fn drop(&mut self) {
        self.shared.orphan();
    }
}

impl Link {
    /// A link to this endpoint, with the default settings.
    #[must_use]
    pub fn new(endpoint: Endpoint) -> Self {
        Self::builder(endpoint).build()
    }

    /// Settings of a link to this endpoint.
    pub fn builder(endpoint: Endpoint) -> LinkBuilder {
        LinkBuilder::of_endpoint(Arc::new(endpoint))
    }

    /// A link over an open connection, which cannot be opened again after a loss.
    ///
    /// For anything that reads and writes bytes: a `tokio::io::duplex` in a test, a tunnel, a port
    /// that was set up elsewhere.
    #[must_use]
    pub fn from_stream(stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static, framing: Framing) -> Self {
        Self::stream_builder(stream, framing).build()
    }

    /// Settings of a link over an open connection, as for [`from_stream`](Self::from_stream).
    pub fn stream_builder(
        stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
        framing: Framing,
    ) -> LinkBuilder {
        LinkBuilder::with_connector(Connector::Once(Some(Box::new(stream))), framing, "the given stream")
    }

    /// Settings of a link whose connections are made by `open`: the first one and, after each loss,
    /// the next.
    ///
    /// The link's task calls `open`. Requests are also written by callers, on the runtime that
    /// polls them.
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
        Station::new(self.clone(), station, self.inner.options)
    }

    /// All PLCs of the link at once, for broadcasts. None of them answers.
    #[must_use]
    pub fn broadcast(&self) -> Broadcast {
        Broadcast::new(self.clone(), self.inner.options)
    }

    /// The framing of the link.
    #[must_use]
    pub fn framing(&self) -> Framing {
        self.inner.config.framing
    }

    /// The present state of the connection.
    #[must_use]
    pub fn state(&self) -> LinkState {
        self.inner.state.get()
    }

    /// Watches the state of the connection.
    #[must_use]
    pub fn watch_state(&self) -> watch::Receiver<LinkState> {
        self.inner.state.watch()
    }

    /// Returns the counters of the link: a snapshot.
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
        self.inner.stats.link_stats()
    }

    /// The lock that a caller holds while it changes bits of a register of a station.
    pub(crate) fn turns_to_modify(&self, station: u8) -> Arc<AssertUnwindSafe<tokio::sync::Mutex<()>>> {
        let modifying = self.inner.modifying.get_or_init(Box::default);
        let mut modifying = modifying.lock().unwrap_or_else(PoisonError::into_inner);
        modifying.with(station, || Arc::new(AssertUnwindSafe(tokio::sync::Mutex::default())), |turns| turns.clone())
    }

    /// The known capabilities of a station: declared, or learned from refusals.
    pub(crate) fn known_capabilities(&self, station: u8) -> Capabilities {
        self.inner.capabilities.get(station)
    }

    /// The declared capabilities of a station, without those learned.
    pub(crate) fn declared_capabilities(&self, station: u8) -> Capabilities {
        self.inner.capabilities.declared(station)
    }

    /// Returns whether anything is known of the capabilities of any station.
    pub(crate) fn knows_capabilities(&self) -> bool {
        self.inner.capabilities.has_any()
    }

    /// Declares the capabilities of a station, for its calls and for the requests of the link itself.
    pub(crate) fn declare_capabilities(&self, station: u8, capabilities: Capabilities) {
        let declared = capabilities.declared();
        // Under the lock of the capabilities, so that both are of one declaration.
        self.inner.capabilities.with(station, |known| {
            self.inner.shared.declare(station, declared);
            known.declare(capabilities);
        });
        // Calls that were posted meanwhile found the driver's lock taken. Without the lock of the
        // capabilities: it may wake callers.
        self.inner.shared.drain_inbox();
    }

    /// Notes what a refusal has shown.
    pub(crate) fn learn_capability(&self, station: u8, learned: Refused) {
        tracing::debug!(station, ?learned, "learned from a refusal");
        self.inner.capabilities.with(station, |known| known.learn(learned, Instant::now()));
    }

    /// Returns whether the link has been closed, or its task has ended.
    pub(crate) fn is_closed(&self) -> bool {
        self.inner.shared.is_closed()
    }

    /// The number of handles, those of stations included.
    pub(crate) fn handles(&self) -> usize {
        Arc::strong_count(&self.inner)
    }

    /// The endpoint, or the name given to [`connector_builder`](Self::connector_builder).
    /// The same for all handles of a link, and another one for each link that lives.
    pub(crate) fn identity(&self) -> usize {
        Arc::as_ptr(&self.inner).addr()
    }

    pub(crate) fn name(&self) -> &str {
        &self.inner.name
    }

    pub(crate) fn line(&self) -> Option<Line> {
        self.inner.config.line
    }

    /// See [`Config::request_times`].
    pub(crate) fn request_times(&self) -> (Duration, InStepSettings) {
        self.inner.config.request_times()
    }

    pub(crate) fn shared_stats(&self) -> &SharedStats {
        &self.inner.stats
    }

    /// Closes the link for all its handles.
    ///
    /// Waiting calls fail with [`Error::Closed`], the request on the wire is finished, and the
    /// connection is closed. Returns when that is done; later calls fail at once.
    ///
    /// Dropping the future does not undo it.
    pub async fn close(&self) {
        // Another handle may have called it before, and closing may still be under way.
        self.inner.shared.close();
        let mut state = self.watch_state();
        let _ = state.wait_for(|state| matches!(state, LinkState::Closed)).await;
    }

    /// Makes a call, and waits for its result.
    pub(crate) fn submit<C: Command>(
        &self,
        station: u8,
        request: C,
        purpose: Purpose,
        options: &CallOptions,
    ) -> impl Future<Output = CallOutcome<C::Reply>> {
        self.submit_with(station, request, purpose, options, Option::take)
    }

    /// Makes a call, and waits for its result; `take` takes the reply, where it was decoded.
    // All arguments are moved on before the first await: this future is part of the caller's, of
    // which there may be thousands.
    pub(crate) async fn submit_with<C: Command, T>(
        &self,
        station: u8,
        request: C,
        purpose: Purpose,
        options: &CallOptions,
        take: impl FnOnce(&mut Option<C::Reply>) -> Option<T>,
    ) -> CallOutcome<T> {
        let queued_at = Instant::now();
        let deadline = later(queued_at, options.call_timeout);
        let checked = request.check(self.framing()).map_err(Error::from);
        let runtime = match checked.and_then(|()| self.prepare()) {
            Ok(runtime) => runtime,
            Err(error) => return CallOutcome::none(Err(error), request.plain()),
        };
        let meta = CallMeta {
            station,
            code: C::CODE,
            lane: options.lane(C::CODE.class()),
            deadline,
            queued_at,
            confirms: purpose == Purpose::Confirm,
        };
        let sending = Sending {
            response_timeout: options.response_timeout.unwrap_or(self.inner.config.response_timeout),
            adaptive: options.adaptive,
            part: purpose == Purpose::Part,
        };
        let in_job = matches!(purpose, Purpose::InJob | Purpose::Part);
        let (call, mut future) = call::new(request, meta, sending, options);
        // Lasts until the call has ended.
        let span = spans_are_on()
            .then(|| tracing::debug_span!("call", link = %self.inner.name, station, command = C::CODE.name()));
        // Work for the link may also serve calls of others, so it runs in the link's span.
        if spans_are_on() {
            self.span().in_scope(|| self.inner.shared.submit(call));
        } else {
            self.inner.shared.submit(call);
        }
        // The runtime of the task may have ended just before.
        if !self.inner.shared.is_started(false)
            && let Err(error) = self.start()
        {
            return CallOutcome::none(Err(error), future.spelling());
        }
        // A call may be ready at once: a broadcast is done when it is written. Other tasks must run
        // all the same.
        consume_budget().await;
        let mut ended = future.ended_by(deadline, runtime).await;
        // This process may have been stopped until now, with the reply in the socket: the runtime
        // looks for events, and then the link's task reads it.
        for _ in 0..LOOKS_AT_DEADLINE {
            if ended {
                break;
            }
            yield_now().await;
            ended = future.has_ended();
        }
        drop(span);
        let spelling = future.spelling();
        let result = if ended {
            future.take_result(take)
        } else {
            future.abandon();
            Err(future.unanswered(queued_at.elapsed()))
        };
        let mut outcome = CallOutcome {
            result,
            replied_at: future.replied_at(),
            spelling,
            shape: if in_job { future.shape(self.framing()) } else { Shape { code: spelling.code, size: 0 } },
            proof: future.proof(),
        };
        if outcome.result.is_err() {
            outcome.result = outcome.result.map_err(|error| self.explain(error, deadline));
        }
        future.recycle();
        outcome
    }

    /// Replaces a timeout by the connection's error if the call waited for the connection until its
    /// deadline.
    fn explain(&self, error: Error, deadline: Instant) -> Error {
        let Error::Timeout { after, sent, .. } = error else { return error };
        // Before its deadline a call times out because its station is silent, not because of the
        // connection.
        if Instant::now() < deadline {
            return error;
        }
        let still = |doing: &str| {
            Arc::new(io::Error::new(io::ErrorKind::TimedOut, format!("still {doing} after {}", Rounded(after))))
        };
        let source = match self.inner.state.get() {
            LinkState::Down { error } => error,
            LinkState::Connecting => still("connecting"),
            LinkState::Waiting => still("waiting for other connections to be opened"),
            LinkState::Idle | LinkState::Up | LinkState::Closed => return error,
        };
        Error::Connect { endpoint: self.inner.name.to_string(), source, sent }
    }

    /// Starts the task if it does not run. Returns the caller's runtime.
    ///
    /// # Errors
    /// [`Error::Connect`]: the caller is in no runtime. A started task does not need it, but the timer of a
    /// call does.
    fn prepare(&self) -> Result<Id, Error> {
        let runtime = Handle::try_current().map_err(|error| self.no_runtime(error))?.id();
        if !self.inner.shared.is_started(false) {
            self.start()?;
        }
        Ok(runtime)
    }

    /// Starts the task with the first call, and with the first one after its runtime has ended.
    fn start(&self) -> Result<(), Error> {
        // Fails before the task is taken, so that a caller without a runtime does not use it up.
        let runtime = Handle::try_current().map_err(|error| self.no_runtime(error))?;
        if !self.inner.shared.is_started(false) && !self.inner.shared.is_started(true) {
            let (task, span) = (self.inner.shared.clone().run(), self.span());
            if span.is_none() {
                runtime.spawn(task);
            } else {
                runtime.spawn(task.instrument(span));
            }
        }
        Ok(())
    }

    /// The span of events that concern the link; its task and its callers emit them.
    fn span(&self) -> tracing::Span {
        tracing::debug_span!(parent: None, "link", name = %self.inner.name)
    }

    fn no_runtime(&self, error: TryCurrentError) -> Error {
        self.connect_error(Arc::new(io::Error::other(error)))
    }

    fn connect_error(&self, source: Arc<io::Error>) -> Error {
        Error::Connect { endpoint: self.inner.name.to_string(), source, sent: false }
    }
}

/// Returns whether a subscriber may want the spans of calls. Mostly none does, and to make and enter
/// two spans in vain costs a call more than this.
fn spans_are_on() -> bool {
    LevelFilter::current() >= LevelFilter::DEBUG
}

/// How often the runtime looks for events after the deadline of a call: once for the caller, and
/// once more for the link's task.
const LOOKS_AT_DEADLINE: u32 = 3;

/// Purpose of a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// A single request, or a broadcast.
    Whole,
    /// A request of a [`job`].
    InJob,
    /// A request of a longer read or write, which is a job. A spelling may leave elements to the
    /// next one.
    Part,
    /// The confirmation of earlier results. The request itself is never sent.
    Confirm,
}

/// The result of a call, and what its reply has shown.
pub(crate) struct CallOutcome<T> {
    pub(crate) result: Result<T, Error>,
    /// When the reply came, if there was one.
    pub(crate) replied_at: Option<Instant>,
    /// The spelling that was sent.
    pub(crate) spelling: Spelling,
    /// Shape of the positive reply, within a job.
    pub(crate) shape: Shape,
    /// The station's proof when the reply was taken.
    pub(crate) proof: Proof,
}

impl<T> CallOutcome<T> {
    fn none(result: Result<T, Error>, spelling: Spelling) -> Self {
        Self {
            result,
            replied_at: None,
            spelling,
            shape: Shape { code: spelling.code, size: 0 },
            proof: Proof::default(),
        }
    }
}

impl fmt::Debug for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Link({}, {})", self.inner.name, self.framing())
    }
}

/// A time in nanoseconds, for the smoothing of times.
#[inline]
pub(crate) fn nanoseconds(time: Duration) -> u64 {
    // More than 500 years.
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

/// The instant `by` after `now`, at most a day: more than any call takes, and within the range of a
/// clock.
#[inline]
pub(crate) fn later(now: Instant, by: Duration) -> Instant {
    now.checked_add(by.min(Duration::from_secs(86_400))).unwrap_or(now)
}
