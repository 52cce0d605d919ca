//! Traffic received while a call waited, and times in error texts.

use std::fmt;
use std::time::Duration;

/// Traffic received while a call waited for its reply, in all its attempts.
///
/// A cause of timeouts can be read from it: bytes that form no frame come from a wrong baud rate or
/// parity, or from noise; frames of another station from a wrong station number.
///
/// ```
/// use std::time::Duration;
/// use fatek::sim::{Bus, Faults};
/// use fatek::{Error, Link, register, wire::Framing};
///
/// # #[tokio::main(flavor = "current_thread", start_paused = true)]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// // Nothing answers at all.
/// let (client, _device) = tokio::io::duplex(64);
/// let link = Link::stream_builder(client, Framing::Ascii).retries(0).build();
/// let error = link.station(1)?.read_registers(register!("R0"), 1).await.unwrap_err();
/// let Error::Timeout { seen, attempts, .. } = error else { panic!("{error}") };
/// assert!(seen.is_nothing());
/// assert_eq!(attempts, 0, "the check before it was not answered");
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Seen {
    /// Number of bytes that were part of no frame.
    pub garbage: u64,
    /// The last other station that a frame came from.
    pub other_station: Option<u8>,
    /// `true` if a frame began and did not end.
    pub half_frame: bool,
    /// `true` if the echo of the request came.
    pub echo: bool,
    /// The time by which the reply to an earlier attempt was too late.
    pub late_by: Option<Duration>,
}

impl Seen {
    /// Returns whether nothing came at all.
    #[must_use]
    pub fn is_nothing(&self) -> bool {
        *self == Self::default()
    }

    /// Adds what came in another attempt.
    pub(crate) fn add(&mut self, other: &Self) {
        self.garbage = self.garbage.saturating_add(other.garbage);
        self.other_station = other.other_station.or(self.other_station);
        self.half_frame |= other.half_frame;
        self.echo |= other.echo;
        self.late_by = other.late_by.or(self.late_by);
    }
}

impl fmt::Display for Seen {
    /// `12 bytes that are no frame (…), a frame of station 3`; empty if nothing came.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { garbage, other_station, half_frame, echo, late_by } = *self;
        let mut parts = Vec::new();
        match garbage {
            0 => {}
            1 => parts.push("1 byte that is no frame (baud rate or parity may be wrong)".to_owned()),
            bytes => parts.push(format!("{bytes} bytes that are no frame (baud rate or parity may be wrong)")),
        }
        if let Some(station) = other_station {
            parts.push(format!("a frame of station {station}"));
        }
        if half_frame {
            parts.push("an incomplete frame".to_owned());
        }
        if echo {
            parts.push("the echo of the request".to_owned());
        }
        if let Some(by) = late_by {
            parts.push(format!("a reply that was {} late", Rounded(by)));
        }
        f.write_str(&parts.join(", "))
    }
}

/// A time for people: whole milliseconds below a second, else seconds with at most two decimals.
pub(crate) struct Rounded(pub(crate) Duration);

impl fmt::Display for Rounded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = self.0.as_millis();
        if ms < 1000 {
            return write!(f, "{ms} ms");
        }
        let seconds = format!("{:.2}", self.0.as_secs_f64());
        write!(f, "{} s", seconds.trim_end_matches('0').trim_end_matches('.'))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_rounded_for_people() {
        for (ns, text) in [
            (0, "0 ms"),
            (1_999_999, "1 ms"),
            (280_123_456, "280 ms"),
            (1_000_000_000, "1 s"),
            (1_250_700_000, "1.25 s"),
            (10_004_000_000, "10 s"),
            (75_500_000_000, "75.5 s"),
        ] {
            assert_eq!(Rounded(Duration::from_nanos(ns)).to_string(), text);
        }
    }

    #[test]
    fn the_text_lists_what_came() {
        assert_eq!(Seen::default().to_string(), "");
        let seen = Seen {
            garbage: 12,
            other_station: Some(3),
            half_frame: true,
            echo: true,
            late_by: Some(Duration::from_millis(120)),
        };
        assert_eq!(
            seen.to_string(),
            "12 bytes that are no frame (baud rate or parity may be wrong), a frame of station 3, an incomplete frame, \
             the echo of the request, a reply that was 120 ms late"
        );
        let mut sum = Seen { garbage: 1, other_station: Some(2), ..Seen::default() };
        sum.add(&seen);
        assert_eq!(sum, Seen { garbage: 13, ..seen });
        sum.add(&Seen::default());
        assert_eq!(sum, Seen { garbage: 13, ..seen });
    }
}
