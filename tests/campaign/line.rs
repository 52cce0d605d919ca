//! Lines of the runs: their timing, and the links over them.

use std::time::Duration;

use fatek::LinkBuilder;
use fatek::endpoint::{InStepSettings, SerialSettings};
use fatek::sim::{self, Bus, Line};
use fatek::wire::Framing;
use fatek::{CallOptions, EchoMode, Link};

use crate::rng::Rng;

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineKind {
    /// Transmission takes no time.
    Network,
    /// Sockets in real time, on a machine that may be busy.
    Sockets,
    Serial {
        baud: u32,
        echoes: bool,
    },
}

/// Times that depend on the speed of the line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Times {
    pub(crate) response_timeout: Duration,
    pub(crate) call_timeout: Duration,
    /// Delays of late replies: longer than the response timeout.
    pub(crate) late: (Duration, Duration),
    /// Longest delay of a copy: within the copy window, transmission included.
    pub(crate) copies: Duration,
    /// Time for which a PLC is busy with an earlier client or a broadcast.
    pub(crate) busy: Duration,
    pub(crate) quiet: Duration,
}

impl LineKind {
    pub(crate) fn draw(rng: &mut Rng) -> Self {
        match rng.below(6) {
            0..=2 => Self::Network,
            3 => Self::Serial { baud: 9600, echoes: rng.percent(50) },
            _ => Self::Serial { baud: 115_200, echoes: rng.percent(50) },
        }
    }

    pub(crate) fn times(self) -> Times {
        let (response_timeout, late, copies, quiet) = match self {
            Self::Network => (60, (65, 200), 95, 1000),
            Self::Sockets => (250, (255, 400), 40, 1000),
            Self::Serial { baud: 9600, .. } => (800, (805, 1200), 40, 4000),
            Self::Serial { .. } => (120, (125, 300), 50, 1000),
        };
        Times {
            response_timeout: ms(response_timeout),
            call_timeout: ms(3 * quiet + 10 * response_timeout),
            late: (ms(late.0), ms(late.1)),
            copies: ms(copies),
            busy: ms(response_timeout / 3),
            quiet: ms(quiet),
        }
    }

    pub(crate) fn sim_line(self, rng: &mut Rng) -> Line {
        let (min, max) = rng.pick(&[(0, 0), (1, 5), (5, 5), (0, 20)]);
        let baud = match self {
            Self::Network | Self::Sockets => 0,
            Self::Serial { baud, .. } => baud,
        };
        let line = Line::new(baud).response_time(ms(min), ms(max));
        if baud > 9600 && rng.percent(5) { line.byte_by_byte(true) } else { line }
    }

    pub(crate) fn echoes(self) -> bool {
        matches!(self, Self::Serial { echoes: true, .. })
    }

    pub(crate) fn builder(self, bus: Bus, framing: Framing, in_step: InStepSettings) -> LinkBuilder {
        self.settings(Link::connector_builder("simulated bus", framing, sim::connector(bus, framing)), framing, in_step)
    }

    /// Applies the settings for a link over this line.
    pub(crate) fn settings(self, builder: LinkBuilder, framing: Framing, in_step: InStepSettings) -> LinkBuilder {
        let times = self.times();
        let builder = match self {
            Self::Network | Self::Sockets => builder,
            Self::Serial { baud, .. } => {
                builder.serial_line(SerialSettings::new(framing).with_baud(baud).unwrap()).echo(EchoMode::Auto)
            }
        };
        let options =
            CallOptions::new().with_response_timeout(times.response_timeout).with_call_timeout(times.call_timeout);
        builder
            .options(options)
            .connect_backoff(ms(1), ms(10))
            .offline_after(0)
            .in_step(in_step.with_quiet(times.quiet))
    }
}
