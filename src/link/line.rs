//! Transmission times of a serial line: arithmetic, without a clock.

use std::time::Duration;

use super::frame_gap::GapLengths;
use crate::endpoint::{DataBits, Parity, SerialSettings, StopBits};

/// The speed of a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Line {
    pub(crate) baud: u32,
    /// Start bit, data bits, parity bit and stop bits.
    pub(crate) bits_per_character: u8,
}

impl Line {
    /// Transmission time of a number of bytes, rounded up to the nanosecond.
    pub(crate) fn transmission(&self, bytes: usize) -> Duration {
        let bits = u128::from(self.bits_per_character).saturating_mul(bytes.try_into().unwrap_or(u128::MAX));
        self.half_bits(bits.saturating_mul(2))
    }

    /// The default frame gap: three and a half characters, as usual on serial buses, and at least 2
    /// ms if slow RS-485 drivers must turn around.
    pub(crate) fn frame_gap(&self) -> GapLengths {
        let short = self.half_bits(u128::from(self.bits_per_character).saturating_mul(7));
        GapLengths { short, long: short.max(Duration::from_millis(2)) }
    }

    fn half_bits(&self, half_bits: u128) -> Duration {
        let nanoseconds = half_bits.saturating_mul(500_000_000).div_ceil(u128::from(self.baud.max(1)));
        Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
    }
}

impl From<SerialSettings> for Line {
    fn from(settings: SerialSettings) -> Self {
        let data_bits: u8 = match settings.data_bits() {
            DataBits::Seven => 7,
            DataBits::Eight => 8,
        };
        let parity_bits = match settings.parity() {
            Parity::None => 0,
            Parity::Even | Parity::Odd => 1,
        };
        let stop_bits = match settings.stop_bits() {
            StopBits::One => 1,
            StopBits::Two => 2,
        };
        let bits = [1, data_bits, parity_bits, stop_bits].into_iter().fold(0, u8::saturating_add);
        Self { baud: settings.baud(), bits_per_character: bits }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Framing;

    #[test]
    fn a_character_is_its_start_data_parity_and_stop_bits() {
        use {DataBits::*, Parity::*, StopBits::*};
        for (data_bits, parity, stop_bits, bits) in [
            (Seven, None, One, 9),
            (Seven, Even, One, 10),
            (Seven, Odd, Two, 11),
            (Seven, None, Two, 10),
            (Eight, None, One, 10),
            (Eight, Even, One, 11),
            (Eight, Odd, Two, 12),
        ] {
            let settings = SerialSettings::new(Framing::Ascii)
                .with_data_bits(data_bits)
                .with_parity(parity)
                .with_stop_bits(stop_bits);
            assert_eq!(Line::from(settings), Line { baud: 9600, bits_per_character: bits }, "{settings}");
        }
    }

    #[test]
    fn transmission_times_are_exact_and_rounded_up() {
        let line = |baud, bits_per_character| Line { baud, bits_per_character };
        for (line, bytes, nanoseconds) in [
            (line(9600, 10), 0, 0),
            (line(9600, 10), 1, 1_041_667),        // 1041666.66…
            (line(9600, 10), 3, 3_125_000),        // not three times the rounded time of one
            (line(9600, 10), 508, 529_166_667),    // the longest ASCII frame
            (line(19_200, 11), 17, 9_739_584),     // 9739583.33…
            (line(115_200, 10), 1, 86_806),        // 86805.55…
            (line(921_600, 10), 1024, 11_111_112), // 11111111.11…
            (line(300, 12), 1024, 40_960_000_000),
        ] {
            assert_eq!(line.transmission(bytes), Duration::from_nanos(nanoseconds), "{bytes} bytes on {line:?}");
        }
    }

    #[test]
    fn no_time_overflows() {
        for baud in [0, 1, u32::MAX] {
            for bits_per_character in [0, u8::MAX] {
                let line = Line { baud, bits_per_character };
                assert!(line.transmission(usize::MAX) <= Duration::from_nanos(u64::MAX));
                let GapLengths { short, long } = line.frame_gap();
                assert!(long >= Duration::from_millis(2) && long >= short);
            }
        }
    }

    #[test]
    fn the_frame_gap_is_3_5_characters_and_at_least_2_ms_for_slow_drivers() {
        for (baud, bits_per_character, short, long) in
            [(9600, 10, 3_645_834, 3_645_834), (19_200, 11, 2_005_209, 2_005_209), (115_200, 10, 303_820, 2_000_000)]
        {
            let gap = Line { baud, bits_per_character }.frame_gap();
            assert_eq!(gap, GapLengths { short: Duration::from_nanos(short), long: Duration::from_nanos(long) });
        }
    }
}
