use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use super::call::Spares;
use super::config::Config;
use super::core::Core;
use super::driver::Driver;
use super::gate::Gate;
use super::hub::Hub;
use super::line::Line;
use super::options::{CallOptions, EchoMode};
use super::stations::Rules;
use super::stats::Board;
use super::transport::Connector;
use super::{Link, LinkState, Shared};
use crate::endpoint::{InStepSettings, SerialSettings};
use crate::random::Random;
use crate::wire::{Framing, LONGEST_FRAME};

/// Settings of a link. Each has a default that suits one PLC on an Ethernet module.
#[derive(Debug)]
#[must_use]
pub struct LinkBuilder {
    connector: Connector,
    options: CallOptions,
    /// The response timeout, unless the options have one.
    response_timeout: Duration,
    connect_timeout: Duration,
    line: Option<Line>,
    pub(super) config: Config,
    seed: Option<u64>,
    gate: Option<Arc<Gate>>,
}

impl LinkBuilder {
    /// How calls are treated, unless a [`Station`](crate::Station) has options of its own.
    pub fn options(mut self, options: CallOptions) -> Self {
        self.options = options;
        self
    }

    /// How long a PLC has for its answer; the same as [`CallOptions::response_timeout`]. Default: 1 s, on a serial line
    /// 300 ms and the time that the bytes take.
    pub fn response_timeout(mut self, timeout: Duration) -> Self {
        self.options = self.options.response_timeout(timeout);
        self
    }

    /// How long a whole call may take; the same as [`CallOptions::call_timeout`]. Default: 10 s.
    pub fn call_timeout(mut self, timeout: Duration) -> Self {
        self.options = self.options.call_timeout(timeout);
        self
    }

    /// How often a read is sent again; the same as [`CallOptions::retries`]. Default: 2.
    pub fn retries(mut self, retries: u32) -> Self {
        self.options = self.options.retries(retries);
        self
    }

    /// How long one attempt to connect may take. Default: 3 s.
    pub fn connect_timeout(mut self, timeout: Duration) -> Self {
        self.connect_timeout = timeout;
        self
    }

    /// Whether TCP connections ask for signs of life when nothing has come for 30 s, then every 10 s, and end if there are
    /// none. Default: `true`.
    ///
    /// Only for a link to an [`Endpoint`](crate::Endpoint).
    pub fn keep_alive(mut self, on: bool) -> Self {
        if let Connector::Endpoint { keep_alive, .. } = &mut self.connector {
            *keep_alive = on;
        }
        self
    }

    /// Says that the stream is a serial line with these settings, which is opened elsewhere. A link to a serial
    /// [`Endpoint`](crate::Endpoint) knows that already.
    ///
    /// The time that bytes take on the line is then heeded, the stream is never flushed (of a serial port that would
    /// wait, and all other tasks with it, until the last bit is on the line), and what the settings of a serial link
    /// default to is set. So call it before the others.
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
        self.line = Some(line);
        self.response_timeout = Duration::from_millis(300);
        self.config.frame_time = line.transmission(LONGEST_FRAME);
        self.config.byte_time = line.transmission(1);
        self.config.gap = line.gap();
        self.config.broadcast_gap = Duration::from_millis(100);
        self.config.settle = self.config.settle.max(line.gap());
        self.config.echo = EchoMode::Auto;
        self
    }

    /// The pause between the end of an answer and the next request, in which RS-485 drivers turn around. Default: none,
    /// on a serial line the time of three and a half characters, and at least 2 ms.
    pub fn gap(mut self, gap: Duration) -> Self {
        self.config.gap = gap;
        self
    }

    /// The pause after a broadcast, in which the PLCs do what they were told. Default: none, on a serial line 100 ms.
    pub fn broadcast_gap(mut self, gap: Duration) -> Self {
        self.config.broadcast_gap = gap;
        self
    }

    /// Whether waiting calls fail as soon as an attempt to connect does. Default: `false`, they wait for the next
    /// attempt until their own time is up.
    pub fn fail_fast(mut self, fail_fast: bool) -> Self {
        self.config.fail_fast = fail_fast;
        self
    }

    /// The pause after a failed attempt to connect: it doubles from `shortest` to `longest`, less up to a half at
    /// random. Default: 0.1 s to 30 s.
    pub fn connect_backoff(mut self, shortest: Duration, longest: Duration) -> Self {
        self.config.connect_backoff = (shortest, longest.max(shortest));
        self
    }

    /// After how many timeouts in a row a station is offline; 0 for never. Default: 3.
    pub fn offline_after(mut self, timeouts: u32) -> Self {
        self.config.rules.offline_after = if timeouts == 0 { u32::MAX } else { timeouts };
        self
    }

    /// How many calls can wait for one station. Default: 1024.
    pub fn queue_capacity(mut self, calls: usize) -> Self {
        self.config.queue_capacity = calls.max(1);
        self
    }

    /// The shortest and the longest time between two probes of a station that is offline: it doubles from the one to the
    /// other. Default: 1 s to 60 s. While other stations of the link answer, all probes together use at most a twentieth of
    /// the line's time, so that they may come later than that. When a station is back, or the connection is lost, the others
    /// are probed as soon as possible.
    pub fn probe_interval(mut self, shortest: Duration, longest: Duration) -> Self {
        self.config.rules.probe_interval = (shortest, longest.max(shortest));
        self
    }

    /// Whether the line echoes what is sent on it. Default: [`EchoMode::Off`], for serial lines [`EchoMode::Auto`].
    pub fn echo(mut self, echo: EchoMode) -> Self {
        self.config.echo = echo;
        self
    }

    /// After how long without a call the connection is closed, to be opened again by the next call; at most a day, and
    /// `None` for never. Default: never.
    ///
    /// The link is [`LinkState::Idle`] then. Stations that were offline are not probed meanwhile, and are asked again by
    /// the next call. A connection that cannot be opened again ([`Link::from_stream`]) stays open.
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

    /// Sets how the line treats replies: how far back a duplicate may come, and what replaces the check where a device does not
    /// know it. Default: that of the [`Endpoint`](crate::Endpoint).
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

    /// What opens the connections instead.
    pub(crate) fn connector(mut self, connector: Connector) -> Self {
        self.connector = connector;
        self
    }

    /// What lets it connect, together with others.
    pub(crate) fn gate(mut self, gate: Arc<Gate>) -> Self {
        self.gate = Some(gate);
        self
    }

    /// The seed of the nonces and of the jitter, so that a test can be repeated. Default: a new one for each link.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = Some(seed);
        self
    }

    /// Makes the link. The connection is opened by the first call.
    #[must_use]
    pub fn build(self) -> Link {
        let (state, watcher) = watch::channel(LinkState::Idle);
        let timeout = self.options.response_timeout.unwrap_or(self.response_timeout);
        // A connection that cannot be opened again is not closed for being idle.
        let idle_timeout = self.config.idle_timeout.filter(|_| !matches!(self.connector, Connector::Once(_)));
        let config = Config { probe_timeout: timeout, idle_timeout, ..self.config };
        let board = Arc::new(Board::default());
        let (name, framing) = (config.name.clone(), config.framing);
        let core = Core::new(config, board.clone(), self.seed.unwrap_or_else(Random::seed));
        let driver = Driver::new(core, (self.connector, self.connect_timeout), self.gate, self.line, state);
        let shared = Shared {
            name,
            framing,
            options: self.options.response_timeout(timeout),
            response_timeout: timeout,
            hub: Arc::new(Hub::new(driver)),
            spares: Spares::default(),
            state: watcher,
            board,
            line: self.line,
        };
        Link { shared: Arc::new(shared) }
    }

    pub(super) fn with_connector(connector: Connector, framing: Framing, name: &str) -> Self {
        let response_timeout = Duration::from_secs(1);
        let config = Config {
            framing,
            name: name.into(),
            queue_capacity: 1024,
            ageing: Duration::from_secs(1),
            probe_timeout: response_timeout,
            rules: Rules {
                offline_after: 3,
                probe_interval: (Duration::from_secs(1), Duration::from_secs(60)),
                probe_pause: 19,
            },
            connect_backoff: (Duration::from_millis(100), Duration::from_secs(30)),
            fail_fast: false,
            in_step: InStepSettings::default(),
            byte_time: NETWORK_BYTE,
            settle: Duration::from_millis(30),
            frame_time: Duration::ZERO,
            gap: Duration::ZERO,
            broadcast_gap: Duration::ZERO,
            echo: EchoMode::Off,
            idle_timeout: None,
        };
        Self {
            connector,
            options: CallOptions::new(),
            response_timeout,
            connect_timeout: Duration::from_secs(3),
            line: None,
            config,
            seed: None,
            gate: None,
        }
    }
}

/// The time of a byte on a network of 10 Mbit/s.
pub(crate) const NETWORK_BYTE: Duration = Duration::from_nanos(800);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::endpoint::Endpoint;

    #[test]
    fn a_serial_link_knows_its_line_and_a_network_has_none() {
        let settings = SerialSettings::new(Framing::Ascii);
        let serial = Link::builder(Endpoint::serial("/dev/ttyS0")).build();
        assert_eq!(serial.line(), Some(Line::from(settings)));
        assert_eq!(Link::builder(Endpoint::tcp("127.0.0.1", 500)).build().line(), None);
    }

    #[test]
    fn only_a_connection_that_can_be_opened_again_is_closed_when_it_is_idle() {
        let minute = Duration::from_secs(60);
        let built = |connector| {
            let link = LinkBuilder::with_connector(connector, Framing::Ascii, "here").idle_timeout(minute).build();
            link.shared.hub.shown()
        };
        let idle = format!("idle_timeout: {:?}", Some(minute));
        assert!(built(Connector::custom(|| async { Ok(tokio::io::empty()) })).contains(&idle));
        assert!(built(Connector::Once(None)).contains("idle_timeout: None"));
    }
}
