use std::num::NonZeroU32;
use std::time::Duration;

/// How fast a line is, and how fast the PLCs on it turn around from hearing to speaking.
///
/// The default takes no time at all.
///
/// ```
/// use std::time::Duration;
/// use fatek::sim::Line;
///
/// let line = Line::new(9600).turnaround(Duration::from_millis(1), Duration::from_millis(20));
/// assert_eq!(line.transmission(96), Duration::from_millis(100)); // 10 bits a character: 7E1
/// ```
///
/// Source: protocol reference, section 7.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Line {
    /// `None`: bytes take no time.
    baud: Option<NonZeroU32>,
    bits_per_character: u32,
    /// The shortest and the longest.
    turnaround: (Duration, Duration),
    byte_by_byte: bool,
}

impl Line {
    /// A line of this speed, in bits a second, with 10 bits a character and no turnaround. On one of 0 baud bytes take
    /// no time, as over Ethernet.
    #[must_use]
    pub fn new(baud: u32) -> Self {
        Self {
            baud: NonZeroU32::new(baud),
            bits_per_character: 10,
            turnaround: (Duration::ZERO, Duration::ZERO),
            byte_by_byte: false,
        }
    }

    /// Sets how many bits a character takes, start, parity and stop bits included: 10 for 7E1 and 8N1, 11 for 8E1.
    #[must_use]
    pub fn bits_per_character(mut self, bits: u32) -> Self {
        self.bits_per_character = bits;
        self
    }

    /// Sets how long a PLC takes from the end of a request to its execution: the scan that it has to finish, and its
    /// reply delay. For each request a time between the two, both included.
    #[must_use]
    pub fn turnaround(mut self, min: Duration, max: Duration) -> Self {
        self.turnaround = (min, max);
        self
    }

    /// Hands every byte of a reply over when it has come, instead of all of them when the last has: truer, and a timer a
    /// byte.
    #[must_use]
    pub fn byte_by_byte(mut self) -> Self {
        self.byte_by_byte = true;
        self
    }

    /// How long this many bytes take.
    #[must_use]
    pub fn transmission(&self, bytes: usize) -> Duration {
        let Some(baud) = self.baud else { return Duration::ZERO };
        let bits = u128::try_from(bytes).unwrap_or(u128::MAX).saturating_mul(self.bits_per_character.into());
        let nanos = bits.saturating_mul(1_000_000_000) / u128::from(baud.get());
        Duration::from_nanos(u64::try_from(nanos).unwrap_or(u64::MAX))
    }

    pub(super) fn turnarounds(&self) -> (Duration, Duration) {
        self.turnaround
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
