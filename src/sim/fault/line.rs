use std::num::NonZeroU32;
use std::time::Duration;

/// Speed of a line, and response time of the PLCs on it.
///
/// Default: no transmission time and no response time.
///
/// ```
/// use std::time::Duration;
/// use fatek::sim::Line;
///
/// let line = Line::new(9600).response_time(Duration::from_millis(1), Duration::from_millis(20));
/// assert_eq!(line.transmission(96), Duration::from_millis(100)); // 10 bits per character: 7E1
/// ```
///
/// Source: protocol reference, section 7.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Line {
    /// `None`: no transmission time.
    baud: Option<NonZeroU32>,
    bits_per_character: u32,
    /// Shortest and longest.
    response_time: (Duration, Duration),
    byte_by_byte: bool,
    turnaround: Duration,
    half_duplex: bool,
}

impl Line {
    /// A line of this speed in bits per second, with 10 bits per character and no response time.
    ///
    /// 0 is for Ethernet: no transmission time.
    #[must_use]
    pub fn new(baud: u32) -> Self {
        Self {
            baud: NonZeroU32::new(baud),
            bits_per_character: 10,
            response_time: (Duration::ZERO, Duration::ZERO),
            byte_by_byte: false,
            turnaround: Duration::ZERO,
            half_duplex: false,
        }
    }

    /// Sets the number of bits per character, with start, parity and stop bits.
    ///
    /// 10 for 7E1 and 8N1, 11 for 8E1. Default: 10.
    #[must_use]
    pub fn bits_per_character(mut self, bits: u32) -> Self {
        self.bits_per_character = bits;
        self
    }

    /// Sets the response time of the PLCs: from the end of a request to the beginning of its reply.
    ///
    /// It stands for the rest of the scan cycle and the PLC's reply delay, and the request is
    /// executed at its end. Drawn per request from `min` to `max`, both included. Default: 0.
    #[must_use]
    pub fn response_time(mut self, min: Duration, max: Duration) -> Self {
        self.response_time = (min, max);
        self
    }

    /// Sets whether each byte of a reply is delivered at its own time, instead of all with the last
    /// one. Default: `false`.
    ///
    /// More realistic, but needs a timer per byte.
    #[must_use]
    pub fn byte_by_byte(mut self, byte_by_byte: bool) -> Self {
        self.byte_by_byte = byte_by_byte;
        self
    }

    /// Sets the time after a reply in which its RS-485 driver still holds the line: requests that
    /// begin in it are lost. Default: 0.
    #[must_use]
    pub fn turnaround(mut self, turnaround: Duration) -> Self {
        self.turnaround = turnaround;
        self
    }

    /// Sets whether requests and replies share one pair of wires, as on RS-485: the transmission of one
    /// begins after those of all others. Default: `false`, the two directions are independent.
    ///
    /// It makes a difference with several clients, or with requests that are sent before the reply to an
    /// earlier one.
    #[must_use]
    pub fn half_duplex(mut self, half_duplex: bool) -> Self {
        self.half_duplex = half_duplex;
        self
    }

    /// Transmission time of this many bytes.
    #[must_use]
    pub fn transmission(&self, bytes: usize) -> Duration {
        let Some(baud) = self.baud else { return Duration::ZERO };
        let bits = u128::try_from(bytes).unwrap_or(u128::MAX).saturating_mul(self.bits_per_character.into());
        let nanos = bits.saturating_mul(1_000_000_000) / u128::from(baud.get());
        Duration::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX))
    }

    pub(super) fn response_times(&self) -> (Duration, Duration) {
        self.response_time
    }

    pub(super) fn turnaround_time(&self) -> Duration {
        self.turnaround
    }

    pub(super) fn is_half_duplex(&self) -> bool {
        self.half_duplex
    }

    pub(super) fn is_byte_by_byte(&self) -> bool {
        self.byte_by_byte
    }
}

impl Default for Line {
    fn default() -> Self {
        Self::new(0)
    }
}
