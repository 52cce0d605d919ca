use std::sync::{Arc, OnceLock};
use std::time::Duration;

use super::config::{Config, SharedConfigs};
use super::connect_limiter::ConnectLimiter;
use super::connector::Connector;
use super::core::Core;
use super::defaults;
use super::driver::Driver;
use super::frame_gap::GapLengths;
use super::line::Line;
use super::options::{CallOptions, EchoMode};
use super::send_gate::SendGate;
use super::shared::Shared;
use super::shared_capabilities::SharedCapabilities;
use super::state::SharedLinkState;
use super::stations::OfflineRules;
use super::stats::SharedStats;
use super::{Link, LinkInner};
use crate::endpoint::{Endpoint, InStepSettings, SerialSettings};
use crate::random::Random;
use crate::wire::{Framing, LONGEST_FRAME};

/// Settings of a link. The defaults suit one PLC on an Ethernet module.
#[derive(Debug)]
#[must_use]
pub struct LinkBuilder {
    connector: Connector,
    options: CallOptions,
    pub(super) config: Config,
    name: Arc<str>,
    /// The settings of other links, to be shared with them.
    configs: Option<Arc<SharedConfigs>>,
    seed: Option<u64>,
    connect_limiter: Option<Arc<ConnectLimiter>>,
    send_gate: Option<SendGate>,
}

impl LinkBuilder {
    /// Sets how calls are treated, unless a [`Station`](crate::Station) has options of its own.
    pub fn options(mut self, options: CallOptions) -> Self {
        self.options = options;
        self
    }

    /// Sets the response timeout, as [`CallOptions::with_response_timeout`]. Default:
    /// [`RESPONSE_TIMEOUT`](defaults::RESPONSE_TIMEOUT), or
    /// [`SERIAL_RESPONSE_TIMEOUT`](defaults::SERIAL_RESPONSE_TIMEOUT) on
    /// a serial line, where the transmission times come on top.
    pub fn response_timeout(mut self, timeout: Duration) -> Self {
        self.options = self.options.with_response_timeout(timeout);
        self
    }

    /// Sets the timeout of a whole call, as [`CallOptions::with_call_timeout`]. Default:
    /// [`CALL_TIMEOUT`](defaults::CALL_TIMEOUT).
    pub fn call_timeout(mut self, timeout: Duration) -> Self {
        self.options = self.options.with_call_timeout(timeout);
        self
    }

    /// Sets the number of retries of a read, as [`CallOptions::with_retries`]. Default:
    /// [`RETRIES`](defaults::RETRIES).
    pub fn retries(mut self, retries: u32) -> Self {
        self.options = self.options.with_retries(retries);
        self
    }

    /// Sets the timeout of one attempt to connect. Default:
    /// [`CONNECT_TIMEOUT`](defaults::CONNECT_TIMEOUT).
    pub fn connect_timeout(mut self, timeout: Duration) -> Self {
        self.config.connect_timeout = timeout;
        self
    }

    /// Sets TCP keep-alive: the first probe after 30 s of silence, then one every 10 s; without an
    /// answer the connection ends. Default: `true`.
    ///
    /// Only for a link to an [`Endpoint`](crate::Endpoint).
    pub fn keep_alive(mut self, on: bool) -> Self {
        if let Connector::Endpoint { keep_alive, .. } = &mut self.connector {
            *keep_alive = on;
        }
        self
    }

    /// Declares that the stream is a serial line with these settings, opened elsewhere. A link to a
    /// serial [`Endpoint`](crate::Endpoint) needs no such call.
    ///
    /// The link then takes transmission times into account and never flushes the stream: flushing a
    /// serial port blocks the thread until the last bit is on the line. This sets the defaults of a
    /// serial link, so call it before the other setters.
    ///
    /// ```
    /// use fatek::Link;
    /// use fatek::endpoint::SerialSettings;
    /// use fatek::wire::Framing;
    ///
    /// let (port, _plc) = tokio::io::duplex(1024); // or a port that was opened in a special way
    /// let settings = SerialSettings::new(Framing::Ascii);
    /// let link = Link::stream_builder(port, Framing::Ascii).serial_line(settings).build();
    /// ```
    pub fn serial_line(mut self, settings: SerialSettings) -> Self {
        let line = Line::from(settings);
        self.config.line = Some(line);
        self.config.response_timeout = defaults::SERIAL_RESPONSE_TIMEOUT;
        self.config.frame_time = line.transmission(LONGEST_FRAME);
        self.config.byte_time = line.transmission(1);
        self.config.frame_gap = line.frame_gap();
        self.config.broadcast_gap = defaults::SERIAL_BROADCAST_GAP;
        self.config.settle = self.config.settle.max(line.frame_gap().long);
        self.config.echo = EchoMode::Auto;
        self
    }

    /// Sets the frame gap: the silence between the end of a reply and the next request, in which
    /// RS-485 drivers turn around. Default: none.
    ///
    /// Default on a serial line: three and a half characters; before a write or control command
    /// at least 2 ms. Slower lines show it: a station does not answer a request after the shorter gap,
    /// and answers the next one. Then the gap is at least 2 ms for the next 256 exchanges, and for
    /// four times as many, up to 65,536, each time that this is seen again
    /// ([`LinkStats::long_gaps`](crate::LinkStats::long_gaps)). A gap that is set here never changes.
    pub fn frame_gap(mut self, gap: Duration) -> Self {
        self.config.frame_gap = GapLengths::fixed(gap);
        self
    }

    /// Sets the silence after a broadcast, in which the PLCs execute it. Default: none; on a serial
    /// line 100 ms.
    pub fn broadcast_gap(mut self, gap: Duration) -> Self {
        self.config.broadcast_gap = gap;
        self
    }

    /// Sets whether waiting calls fail with the first failed attempt to connect. Default: `false`:
    /// they wait for the next attempt until their own deadline.
    pub fn fail_fast(mut self, fail_fast: bool) -> Self {
        self.config.fail_fast = fail_fast;
        self
    }

    /// Sets the back-off after a failed attempt to connect. It doubles from `shortest` to
    /// `longest`, less up to a half as jitter. Default: [`CONNECT_BACKOFF`](defaults::CONNECT_BACKOFF).
    pub fn connect_backoff(mut self, shortest: Duration, longest: Duration) -> Self {
        self.config.connect_backoff = (shortest, longest.max(shortest));
        self
    }

    /// Sets after how many timeouts in a row a station is offline; 0: never. Default:
    /// [`OFFLINE_AFTER`](defaults::OFFLINE_AFTER).
    pub fn offline_after(mut self, timeouts: u32) -> Self {
        self.config.offline_rules.offline_after = if timeouts == 0 { u32::MAX } else { timeouts };
        self
    }

    /// Sets how many calls can wait for one station. Default:
    /// [`QUEUE_CAPACITY`](defaults::QUEUE_CAPACITY).
    pub fn queue_capacity(mut self, calls: usize) -> Self {
        self.config.queue_capacity = calls.max(1);
        self
    }

    /// Sets the time between two probes of an offline station: it doubles from `shortest` to
    /// `longest`. Default: [`PROBE_INTERVAL`](defaults::PROBE_INTERVAL).
    ///
    /// While other stations of the link answer, all probes together use at most a twentieth of the
    /// line's time, so they may be further apart. When a station is back, or the connection is
    /// lost, the others are probed as soon as possible.
    pub fn probe_interval(mut self, shortest: Duration, longest: Duration) -> Self {
        self.config.offline_rules.probe_interval = (shortest, longest.max(shortest));
        self
    }

    /// Sets whether the line echoes requests. Default: [`EchoMode::Off`]; on a serial line
    /// [`EchoMode::Auto`].
    pub fn echo(mut self, echo: EchoMode) -> Self {
        self.config.echo = echo;
        self
    }

    /// Sets the idle timeout: the connection is closed after this time without a call, and opened
    /// again by the next one. At most a day; `None`: never. Default: never.
    ///
    /// The link is [`LinkState::Idle`](super::LinkState::Idle) then. Stations that were offline are not
    /// probed meanwhile, and the next call is sent to them again. A connection that cannot be opened again
    /// ([`Link::from_stream`]) stays open.
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::Link;
    ///
    /// let link = Link::builder("tcp://192.168.2.3:500".parse()?).idle_timeout(Duration::from_secs(60)).build();
    /// # Ok::<(), fatek::ParseEndpointError>(())
    /// ```
    pub fn idle_timeout(mut self, timeout: impl Into<Option<Duration>>) -> Self {
        self.config.idle_timeout = timeout.into();
        self
    }

    /// Sets the mute timeout: a connection over which no request was answered for this time, by any
    /// station, is closed, and another is opened. At least three requests must have failed. `None`:
    /// never. Default: [`MUTE_TIMEOUT`](defaults::MUTE_TIMEOUT).
    ///
    /// Some devices and networks drop a connection without closing it. The connections after it are
    /// opened with a [back-off](Self::connect_backoff) until one is answered. One silent station
    /// among others that answer does not make a connection mute. A connection that cannot be opened
    /// again ([`Link::from_stream`]) stays open.
    pub fn mute_timeout(mut self, timeout: impl Into<Option<Duration>>) -> Self {
        self.config.mute_timeout = timeout.into();
        self
    }

    /// Sets what is assumed of the line's replies: how late a duplicate may come, and what replaces
    /// the check where a device does not know it. Default: that of the
    /// [`Endpoint`](crate::Endpoint).
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::{Endpoint, Link, endpoint::InStepSettings};
    ///
    /// let settings = InStepSettings::new().with_window(Duration::from_millis(300));
    /// let link = Link::builder(Endpoint::tcp("192.168.2.3", 500)).in_step(settings).build();
    /// ```
    pub fn in_step(mut self, settings: InStepSettings) -> Self {
        self.config.in_step = settings;
        self
    }

    /// Sets the settle time, as [`InStepSettings::with_settle`]: a pause between opening a connection
    /// and the first request on it. Default: that of the [`Endpoint`](crate::Endpoint), or none.
    pub fn settle(mut self, time: Duration) -> Self {
        self.config.in_step = self.config.in_step.with_settle(time);
        self
    }

    /// Sets the [send gate](SendGate): a permission that is asked for before each write. Default: none;
    /// the link sends at any time.
    ///
    /// Of several gates, set by several calls, all must be open.
    ///
    /// ```
    /// use std::sync::Arc;
    /// use std::sync::atomic::{AtomicBool, Ordering};
    /// use fatek::Link;
    ///
    /// let maintenance = Arc::new(AtomicBool::new(false));
    /// let lock = maintenance.clone();
    /// let link = Link::builder("tcp://192.168.2.3:500".parse()?)
    ///     .send_gate(move || !lock.load(Ordering::Acquire))
    ///     .build();
    /// # Ok::<(), fatek::ParseEndpointError>(())
    /// ```
    pub fn send_gate(mut self, gate: impl Into<SendGate>) -> Self {
        let gate = gate.into();
        self.send_gate = Some(match self.send_gate.take() {
            Some(first) => first.and(gate),
            None => gate,
        });
        self
    }

    /// Replaces the connector.
    pub(crate) fn connector(mut self, connector: Connector) -> Self {
        self.connector = connector;
        self
    }

    /// A link to an endpoint. Its connection is opened again after a loss.
    pub(crate) fn of_endpoint(endpoint: Arc<Endpoint>) -> Self {
        let (framing, in_step, name) = (endpoint.framing(), endpoint.in_step(), endpoint.to_string());
        let serial = endpoint.transport().serial_settings();
        let connector = Connector::Endpoint { endpoint, keep_alive: true };
        let builder = Self::with_connector(connector, framing, &name).in_step(in_step);
        match serial {
            Some(settings) => builder.serial_line(settings),
            None => builder,
        }
    }

    /// Shares the settings with other links that have the same ones.
    pub(crate) fn share_config(mut self, configs: &Arc<SharedConfigs>) -> Self {
        self.configs = Some(configs.clone());
        self
    }

    /// Sets the limiter of connection attempts that the link shares with others.
    pub(crate) fn connect_limiter(mut self, connect_limiter: Arc<ConnectLimiter>) -> Self {
        self.connect_limiter = Some(connect_limiter);
        self
    }

    /// Sets the seed of nonces and jitter, so that a test can be repeated. Default: random.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = Some(seed);
        self
    }

    /// Makes the link. The connection is opened by the first call.
    #[must_use]
    pub fn build(self) -> Link {
        let state = Arc::new(SharedLinkState::new());
        let timeout = self.options.response_timeout.unwrap_or(self.config.response_timeout);
        // A connection that cannot be opened again is not closed.
        let reopens = !matches!(self.connector, Connector::Once(_));
        let idle_timeout = self.config.idle_timeout.filter(|_| reopens);
        let mute_timeout = self.config.mute_timeout.filter(|_| reopens);
        let config = Config { response_timeout: timeout, idle_timeout, mute_timeout, ..self.config };
        let stats = Arc::new(SharedStats::default());
        let name = self.name;
        let config = match self.configs {
            Some(configs) => configs.share(config),
            None => Arc::new(config),
        };
        let core = Core::new(config.clone(), name.clone(), stats.clone(), self.seed.unwrap_or_else(Random::seed));
        let driver = Driver::new(core, self.connector, self.connect_limiter, self.send_gate, state.clone());
        let inner = LinkInner {
            name,
            config,
            options: self.options.with_response_timeout(timeout),
            shared: Arc::new(Shared::new(driver)),
            modifying: OnceLock::new(),
            capabilities: SharedCapabilities::default(),
            state,
            stats,
        };
        Link { inner: Arc::new(inner) }
    }

    pub(super) fn with_connector(connector: Connector, framing: Framing, name: &str) -> Self {
        let config = Config {
            framing,
            queue_capacity: defaults::QUEUE_CAPACITY,
            ageing: Duration::from_secs(1),
            line: None,
            response_timeout: defaults::RESPONSE_TIMEOUT,
            connect_timeout: defaults::CONNECT_TIMEOUT,
            offline_rules: OfflineRules {
                offline_after: defaults::OFFLINE_AFTER,
                probe_interval: defaults::PROBE_INTERVAL,
                probe_pause: 19,
            },
            connect_backoff: defaults::CONNECT_BACKOFF,
            fail_fast: false,
            in_step: InStepSettings::default(),
            byte_time: NETWORK_BYTE,
            settle: Duration::from_millis(30),
            frame_time: Duration::ZERO,
            byte_timeout: defaults::BYTE_TIMEOUT,
            slow_frame_time: defaults::SLOW_FRAME_TIME,
            mute_timeout: Some(defaults::MUTE_TIMEOUT),
            frame_gap: GapLengths::fixed(Duration::ZERO),
            broadcast_gap: Duration::ZERO,
            echo: EchoMode::Off,
            idle_timeout: None,
        };
        Self {
            connector,
            options: CallOptions::new(),
            config,
            name: name.into(),
            configs: None,
            seed: None,
            connect_limiter: None,
            send_gate: None,
        }
    }
}

/// Transmission time of a byte on a network of 10 Mbit/s.
pub(crate) const NETWORK_BYTE: Duration = Duration::from_nanos(800);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_serial_link_has_a_line() {
        let settings = SerialSettings::new(Framing::Ascii);
        let serial = Link::builder(Endpoint::serial("/dev/ttyS0")).build();
        assert_eq!(serial.line(), Some(Line::from(settings)));
        assert_eq!(Link::builder(Endpoint::tcp("127.0.0.1", 500)).build().line(), None);
    }

    #[test]
    fn only_a_connection_that_can_be_reopened_is_closed_when_idle() {
        let minute = Duration::from_secs(60);
        let built = |connector| {
            let link = LinkBuilder::with_connector(connector, Framing::Ascii, "here").idle_timeout(minute).build();
            link.inner.shared.debug_text()
        };
        let idle = format!("idle_timeout: {:?}", Some(minute));
        assert!(built(Connector::custom(|| async { Ok(tokio::io::empty()) })).contains(&idle));
        assert!(built(Connector::Once(None)).contains("idle_timeout: None"));
    }
}
