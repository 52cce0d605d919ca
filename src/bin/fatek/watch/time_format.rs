//! Times of the lines of `fatek watch`.

use std::time::{Duration, SystemTime};

use humantime::format_rfc3339_millis;
use jiff::Timestamp;
use jiff::tz::TimeZone;

/// Format of times, with milliseconds.
#[derive(Debug)]
pub(super) enum TimeFormat {
    /// `2026-11-29T07:09:13.250Z`.
    Utc,
    /// `2026-11-29T08:09:13.250+01:00`.
    Local(TimeZone),
}

/// The last second that both formats can express in all time zones: 9999-12-30T00:00:00Z.
const LAST_SECOND: u64 = 253_402_128_000;

impl TimeFormat {
    /// `local`: the time zone of the system, or of the variable `TZ`; UTC if neither is known.
    pub(super) fn new(local: bool) -> Self {
        if local { Self::Local(TimeZone::system()) } else { Self::Utc }
    }

    /// Number of characters of a time.
    pub(super) fn width(&self) -> usize {
        match self {
            Self::Utc => 24,
            Self::Local(_) => 29,
        }
    }

    /// The text of a time between the years 1970 and 9999; the nearest one of any other time.
    pub(super) fn format(&self, time: SystemTime) -> String {
        let start = SystemTime::UNIX_EPOCH;
        let time = time.clamp(start, start + Duration::from_secs(LAST_SECOND));
        match self {
            Self::Utc => format_rfc3339_millis(time).to_string(),
            Self::Local(zone) => {
                let zoned = Timestamp::try_from(time).unwrap_or_default().to_zoned_datetime(zone.clone());
                zoned.strftime("%Y-%m-%dT%H:%M:%S%.3f%:z").to_string()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_milliseconds_and_local_ones_the_utc_offset() {
        let time = SystemTime::UNIX_EPOCH + Duration::from_millis(1_795_331_353_250);
        let berlin = TimeFormat::Local(TimeZone::posix("CET-1CEST,M3.5.0,M10.5.0/3").unwrap());
        assert_eq!(TimeFormat::Utc.format(time), "2026-11-22T07:09:13.250Z");
        assert_eq!(berlin.format(time), "2026-11-22T08:09:13.250+01:00");
        assert_eq!(berlin.format(time - Duration::from_secs(180 * 86_400)), "2026-05-26T09:09:13.250+02:00");
        let utc = TimeFormat::Local(TimeZone::UTC);
        assert_eq!(utc.format(time), "2026-11-22T07:09:13.250+00:00");
    }

    // Before: a time after the year 9999 ended the command with a panic.
    #[test]
    fn all_times_have_a_text_of_the_same_width() {
        let start = SystemTime::UNIX_EPOCH;
        let far = [start - Duration::from_secs(1 << 40), start, start + Duration::from_secs(1 << 50)];
        for zone in ["<+14>-14", "<-12>12", "UTC0"] {
            for format in [TimeFormat::Utc, TimeFormat::Local(TimeZone::posix(zone).unwrap())] {
                for time in far {
                    assert_eq!(format.format(time).len(), format.width(), "{}", format.format(time));
                }
            }
        }
    }
}
