use std::time::Duration;

use crate::capabilities::Capabilities;
use crate::element::{Symbol, Width};
use crate::endpoint::{InStepSettings, SerialSettings};
use crate::link::{Line, Link};
use crate::station::Station;
use crate::wire::Framing;

/// The cost of requests in time: a fixed time per request, and a time per byte.
///
/// A request with its reply takes
///
/// ```text
/// frame gap + response time + overhead + (bytes of the request + bytes of the reply) × byte time
/// ```
///
/// A plan takes the sum over its requests, because a link has one request in flight at a time, and
/// their *proofs*: a request whose reply has the command and the length of the reply before it is
/// sent as a mixed read (48) where that is cheaper than a loop-back without data, which is sent
/// before it otherwise; and a check ends a plan of several requests, unless the last reply differs
/// from all others.
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
    frame_gap: Duration,
    response_time: Duration,
    overhead: Duration,
    /// The link separates requests whose replies have one shape.
    proofs: bool,
}

impl CostModel {
    /// Costs of a serial line: byte time and frame gap by its settings, a response time of 5 ms.
    ///
    /// The response time is about half a scan of a PLC; measure yours and set it with
    /// [`with_response_time`](Self::with_response_time).
    #[must_use]
    pub fn serial(settings: SerialSettings, framing: Framing) -> Self {
        Self::line(Line::from(settings), framing)
    }

    fn line(line: Line, framing: Framing) -> Self {
        Self {
            framing,
            byte_time: line.transmission(1),
            frame_gap: line.frame_gap().short,
            response_time: DEFAULT_RESPONSE_TIME,
            overhead: Duration::ZERO,
            proofs: true,
        }
    }

    /// Costs of a link: of its serial line if known, else of a network with a 5 ms round trip.
    ///
    /// The frame gap and the [proofs](Self::with_in_step) are those of the link.
    #[must_use]
    pub fn of_link(link: &Link) -> Self {
        let model = match link.line() {
            Some(line) => Self::line(line, link.framing()),
            None => Self::network(link.framing(), DEFAULT_RESPONSE_TIME),
        };
        let (frame_gap, in_step) = link.request_times();
        model.with_frame_gap(frame_gap).with_in_step(in_step)
    }

    /// Costs of a station: those of its link, with its [response
    /// time](crate::Capabilities::response_time) if it is known.
    #[must_use]
    pub fn of_station(station: &Station) -> Self {
        Self::of_link(station.link()).with_known(&station.capabilities())
    }

    /// Sets the response time of the capabilities, if it is known.
    pub(crate) fn with_known(self, known: &Capabilities) -> Self {
        known.response_time().map_or(self, |time| self.with_response_time(time))
    }

    /// Costs of a network with this round trip of a short request.
    ///
    /// The round trip counts as the response time. The byte time is 0.8 µs, for 10 Mbit/s. Set that
    /// of the serial port with [`with_byte_time`](Self::with_byte_time) if a module forwards
    /// requests to one.
    #[must_use]
    pub fn network(framing: Framing, round_trip: Duration) -> Self {
        Self {
            framing,
            byte_time: NETWORK_BYTE_TIME,
            frame_gap: Duration::ZERO,
            response_time: round_trip,
            overhead: Duration::ZERO,
            proofs: true,
        }
    }

    /// Sets the time per byte, clamped to a second.
    #[must_use]
    pub fn with_byte_time(self, byte_time: Duration) -> Self {
        Self { byte_time: bounded(byte_time), ..self }
    }

    /// Sets the silence between a reply and the next request, clamped to a second.
    #[must_use]
    pub fn with_frame_gap(self, frame_gap: Duration) -> Self {
        Self { frame_gap: bounded(frame_gap), ..self }
    }

    /// Sets the time from the end of a request to the beginning of its reply, clamped to a minute.
    ///
    /// It is a measured round trip without the time of the bytes.
    #[must_use]
    pub fn with_response_time(self, response_time: Duration) -> Self {
        Self { response_time: response_time.min(MAX_RESPONSE_TIME), ..self }
    }

    /// Sets an additional time per request, clamped to a second. More makes fewer requests.
    #[must_use]
    pub fn with_overhead(self, overhead: Duration) -> Self {
        Self { overhead: bounded(overhead), ..self }
    }

    /// Counts the proofs of a link with these settings: none if [the line has no
    /// duplicates](InStepSettings::with_copies). If a connection carries [one
    /// request](InStepSettings::with_one_request) only, the quiet time that proves it counts as the
    /// [overhead](Self::with_overhead), in place of any other.
    ///
    /// Of two copies or more, only the first is counted: see [`with_proofs`](Self::with_proofs).
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::endpoint::InStepSettings;
    /// use fatek::plan::CostModel;
    /// use fatek::wire::Framing;
    ///
    /// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    /// assert!(!network.with_in_step(InStepSettings::new().with_copies(0)?).proofs());
    /// let one_request = network.with_in_step(InStepSettings::new().with_one_request(true));
    /// assert_eq!(one_request.request_time(), Duration::from_millis(1005));
    /// # Ok::<(), fatek::endpoint::InvalidSettings>(())
    /// ```
    #[must_use]
    pub fn with_in_step(self, settings: InStepSettings) -> Self {
        let one_request = settings.one_request();
        let quiet = if one_request { settings.quiet() } else { Duration::ZERO };
        self.with_overhead(quiet).with_proofs(settings.copies() > 0 && !one_request)
    }

    /// Sets whether proofs are counted: `false` is for links without them, such as those that were
    /// told that [the line has no duplicates](InStepSettings::with_copies). Default: `true`.
    ///
    /// A proof is counted where a reply has the shape of the one before it. A link that expects [two
    /// copies](InStepSettings::with_copies) of a reply or more also compares the replies before that,
    /// so a plan may take longer over it than its [time](super::Plan::time).
    ///
    /// ```
    /// use std::time::Duration;
    /// use fatek::plan::{CostModel, Limits, Plan};
    /// use fatek::wire::Framing;
    ///
    /// let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    /// let plan = |cost| {
    ///     let tags = ["R0", "R500", "R1000"].map(|tag| tag.parse().unwrap());
    ///     Plan::builder(cost).limits(Limits::new().mixed_reads(false)).tags(tags).build()
    /// };
    /// // A loop-back after the first request and after the second one, and one at the end.
    /// assert!(plan(network)?.proof_time() > Duration::from_millis(15));
    /// assert_eq!(plan(network.with_proofs(false))?.proof_time(), Duration::ZERO);
    /// # Ok::<(), fatek::plan::PlanError>(())
    /// ```
    #[must_use]
    pub fn with_proofs(self, proofs: bool) -> Self {
        Self { proofs, ..self }
    }

    /// Returns whether [proofs](Self::with_proofs) are counted.
    #[must_use]
    pub fn proofs(&self) -> bool {
        self.proofs
    }

    /// Returns the framing whose bytes are counted.
    #[must_use]
    pub fn framing(&self) -> Framing {
        self.framing
    }

    /// Returns the time per byte.
    #[must_use]
    pub fn byte_time(&self) -> Duration {
        self.byte_time
    }

    /// Returns the silence between a reply and the next request.
    #[must_use]
    pub fn frame_gap(&self) -> Duration {
        self.frame_gap
    }

    /// Returns the additional time per request.
    #[must_use]
    pub fn overhead(&self) -> Duration {
        self.overhead
    }

    /// Returns the fixed time per request: frame gap, response time and overhead.
    #[must_use]
    pub fn request_time(&self) -> Duration {
        self.frame_gap + self.response_time.min(MAX_RESPONSE_TIME) + self.overhead
    }

    /// Returns the time from the end of a request to the beginning of its reply.
    #[must_use]
    pub fn response_time(&self) -> Duration {
        self.response_time
    }

    /// Returns the cost of a request in nanoseconds; `bytes` are those of request and reply.
    pub(super) fn cost(&self, bytes: usize) -> u64 {
        nanoseconds(self.request_time()).saturating_add(self.bytes_cost(bytes))
    }

    /// Returns the cost of bytes in nanoseconds.
    pub(super) fn bytes_cost(&self, bytes: usize) -> u64 {
        nanoseconds(self.byte_time).saturating_mul(u64::try_from(bytes).unwrap_or(u64::MAX))
    }

    /// The length of a request without its elements: the frame and N.
    pub(super) fn request_bytes(&self) -> usize {
        self.framing.request_overhead()
    }

    /// The length of a reply without its values: the frame and the error code.
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

// The bounds keep the cost of any plan far below the maximum of a u64 of nanoseconds.
const MAX_RESPONSE_TIME: Duration = Duration::from_secs(60);
const MAX_OTHER_TIME: Duration = Duration::from_secs(1);

/// The response time before any is measured.
const DEFAULT_RESPONSE_TIME: Duration = Duration::from_millis(5);

/// One byte at 10 Mbit/s.
const NETWORK_BYTE_TIME: Duration = Duration::from_nanos(800);

fn bounded(time: Duration) -> Duration {
    time.min(MAX_OTHER_TIME)
}

fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
