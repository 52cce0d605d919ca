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
// - `submit`: makes a call. `call`: the state that a caller and the link share for one call.
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
mod submit;
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
use tokio::sync::watch;
use tokio::time::Instant;

use self::by_station::ByStation;
use self::config::Config;
pub(crate) use self::config::SharedConfigs;
pub(crate) use self::connect_limiter::ConnectLimiter;
pub(crate) use self::connector::Connector;
pub(crate) use self::in_step::{Declared, LongestReads, Prices, Proof, Shape};
use self::shared::Shared;
use self::shared_capabilities::SharedCapabilities;
use self::state::SharedLinkState;
use self::stats::SharedStats;
pub(crate) use self::submit::{CallOutcome, Purpose};
use crate::capabilities::{Capabilities, Refused};
use crate::command::InvalidRequest;
use crate::endpoint::{Endpoint, InStepSettings};
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
    /// Waiting calls fail with [`Error::Closed`](crate::Error::Closed), the request on the wire is finished, and the
    /// connection is closed. Returns when that is done; later calls fail at once.
    ///
    /// Dropping the future does not undo it.
    pub async fn close(&self) {
        // Another handle may have called it before, and closing may still be under way.
        self.inner.shared.close();
        let mut state = self.watch_state();
        let _ = state.wait_for(|state| matches!(state, LinkState::Closed)).await;
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
