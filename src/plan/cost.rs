use std::time::Duration;

use crate::element::{Symbol, Width};
use crate::endpoint::SerialSettings;
use crate::link::{Line, Link};
use crate::wire::Framing;

/// What a request costs: time for its bytes, and time for its being one more request.
///
/// A request with its reply takes
///
/// ```text
/// turnaround + latency + overhead + (bytes of the request + bytes of the reply) × byte time
/// ```
///
/// and a plan takes the sum, for a link has one request on the wire at a time.
///
/// ```
/// use std::time::Duration;
/// use fatek::endpoint::SerialSettings;
/// use fatek::plan::CostModel;
/// use fatek::wire::Framing;
///
/// let serial = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
/// assert_eq!(serial.byte_time(), Duration::from_nanos(1_041_667)); // 10 bits at 9600 baud
///
/// let network = CostModel::network(Framing::Ascii, Duration::from_millis(12)).with_overhead(Duration::from_millis(1));
/// assert_eq!(network.request_time(), Duration::from_millis(13));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct CostModel {
    framing: Framing,
    byte_time: Duration,
    turnaround: Duration,
    latency: Duration,
    overhead: Duration,
}

impl CostModel {
    /// A serial line: bytes take as long as the settings say, and the line is left alone between a reply and the next
    /// request as the link does it. The latency is 5 ms, about half a scan of a PLC; measure yours.
    #[must_use]
    pub fn serial(settings: SerialSettings, framing: Framing) -> Self {
        Self::line(Line::from(settings), framing)
    }

    fn line(line: Line, framing: Framing) -> Self {
        Self {
            framing,
            byte_time: line.transmission(1),
            turnaround: line.frame_gap(),
            latency: DEFAULT_LATENCY,
            overhead: Duration::ZERO,
        }
    }

    /// That of the line that a link is on, as far as the link knows it. A network's latency is 5 ms: measure it.
    pub(crate) fn of_link(link: &Link) -> Self {
        match link.line() {
            Some(line) => Self::line(line, link.framing()),
            None => Self::network(link.framing(), DEFAULT_LATENCY),
        }
    }

    /// A network with this round trip, from the first byte of a short request to the last of its reply. Bytes take
    /// 0.8 µs, which is 10 Mbit/s both ways; where a module passes them on to a serial port inside, set
    /// [`with_byte_time`](Self::with_byte_time) to that port's.
    #[must_use]
    pub fn network(framing: Framing, round_trip: Duration) -> Self {
        Self {
            framing,
            byte_time: Duration::from_nanos(800),
            turnaround: Duration::ZERO,
            latency: round_trip,
            overhead: Duration::ZERO,
        }
    }

    /// The same with another time for each byte, at most a second.
    #[must_use]
    pub fn with_byte_time(self, byte_time: Duration) -> Self {
        Self { byte_time: bounded(byte_time), ..self }
    }

    /// The same with another silence between a reply and the next request, at most a second.
    #[must_use]
    pub fn with_turnaround(self, turnaround: Duration) -> Self {
        Self { turnaround: bounded(turnaround), ..self }
    }

    /// The same with another time from the end of a request to the begin of its reply, which is what a measured round
    /// trip has beyond its bytes; at most a minute.
    #[must_use]
    pub fn with_latency(self, latency: Duration) -> Self {
        Self { latency: latency.min(MAX_LATENCY), ..self }
    }

    /// The same with another time that every request costs besides, at most a second: a way to have fewer of them.
    #[must_use]
    pub fn with_overhead(self, overhead: Duration) -> Self {
        Self { overhead: bounded(overhead), ..self }
    }

    /// The framing whose bytes are counted.
    #[must_use]
    pub fn framing(&self) -> Framing {
        self.framing
    }

    /// How long a byte takes.
    #[must_use]
    pub fn byte_time(&self) -> Duration {
        self.byte_time
    }

    /// How long a request takes besides its bytes and those of its reply.
    #[must_use]
    pub fn request_time(&self) -> Duration {
        self.turnaround + self.latency.min(MAX_LATENCY) + self.overhead
    }

    pub(crate) fn latency(&self) -> Duration {
        self.latency
    }

    /// What a request with so many bytes, those of the reply among them, costs.
    pub(super) fn cost(&self, bytes: usize) -> u64 {
        nanoseconds(self.request_time()).saturating_add(self.bytes_cost(bytes))
    }

    pub(super) fn bytes_cost(&self, bytes: usize) -> u64 {
        nanoseconds(self.byte_time).saturating_mul(u64::try_from(bytes).unwrap_or(u64::MAX))
    }

    /// The bytes of a request without its elements: the frame and N.
    pub(super) fn request_bytes(&self) -> usize {
        self.framing.request_overhead()
    }

    /// The bytes of a reply without its values: the frame and the error code.
    pub(super) fn reply_bytes(&self) -> usize {
        self.framing.reply_overhead()
    }

    pub(super) fn element_bytes(&self, symbol: Symbol) -> usize {
        self.framing.element_len(symbol)
    }

    pub(super) fn value_bytes(&self, width: Width) -> usize {
        self.framing.value_len(width)
    }
}

// Bounds that keep every sum far from the end of a u64 of nanoseconds.
const MAX_LATENCY: Duration = Duration::from_secs(60);

/// Until something is measured.
const DEFAULT_LATENCY: Duration = Duration::from_millis(5);

fn bounded(time: Duration) -> Duration {
    time.min(Duration::from_secs(1))
}

fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
