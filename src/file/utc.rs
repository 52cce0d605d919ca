use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The last second of 9999, which ends the years of four digits.
const LAST_SECOND: u64 = 253_402_300_799;

/// Formats a time as in files: `2026-11-22T07:09:13Z`. A time before 1970 or after 9999 becomes the
/// first or last second of these years.
#[must_use]
pub fn utc(time: SystemTime) -> String {
    humantime::format_rfc3339_seconds(whole_seconds(time)).to_string()
}

/// Formats a time with milliseconds: `2026-11-22T07:09:13.250Z`. Limited to the years from 1970 to 9999,
/// as in [`utc`].
#[cfg(feature = "serde")]
pub(crate) fn utc_millis(time: SystemTime) -> String {
    let last = UNIX_EPOCH.checked_add(Duration::from_secs(LAST_SECOND)).unwrap_or(UNIX_EPOCH);
    humantime::format_rfc3339_millis(time.clamp(UNIX_EPOCH, last)).to_string()
}

/// Parses the format of [`utc`] and no other.
pub(crate) fn parse_utc(text: &str) -> Option<SystemTime> {
    let time = humantime::parse_rfc3339(text).ok()?;
    (utc(time) == text).then_some(time)
}

/// The time as files have it: in whole seconds, from 1970 to 9999.
pub(crate) fn whole_seconds(time: SystemTime) -> SystemTime {
    // An error means that the time is before 1970.
    let since_1970 = time.duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    let seconds = Duration::from_secs(since_1970.as_secs().min(LAST_SECOND));
    // All systems have the time until 9999.
    UNIX_EPOCH.checked_add(seconds).unwrap_or(UNIX_EPOCH)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> SystemTime {
        UNIX_EPOCH + Duration::from_secs(seconds)
    }

    #[test]
    fn known_instants_have_their_usual_form() {
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_000_000_000, "2001-09-09T01:46:40Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (253_402_300_799, "9999-12-31T23:59:59Z"),
        ] {
            assert_eq!(utc(at(seconds)), text);
            assert_eq!(parse_utc(text), Some(at(seconds)), "{text}");
        }
        assert_eq!(utc(UNIX_EPOCH - Duration::from_secs(5)), "1970-01-01T00:00:00Z");
        assert_eq!(utc(at(300_000_000_000)), "9999-12-31T23:59:59Z");
        assert_eq!(utc(at(5) + Duration::from_millis(999)), "1970-01-01T00:00:05Z");
    }

    #[test]
    fn other_forms_and_impossible_times_are_refused() {
        for bad in [
            "",
            "2026-11-22",
            "2026-11-22T07:09:13",
            "2026-11-22T07:09:13.5Z",
            "2026-11-22T07:09:13+00:00",
            "2026-11-22 07:09:13Z",
            "2026-02-29T00:00:00Z",
            "2026-13-01T00:00:00Z",
            "2026-01-01T24:00:00Z",
            "2026-01-01T00:00:60Z",
            "1969-12-31T23:59:59Z",
            "26-01-01T00:00:00Z",
            "2026-1-01T00:00:00Z",
            "2026-01-01T00:00:00:00Z",
            "+026-01-01T00:00:00Z",
        ] {
            assert_eq!(parse_utc(bad), None, "{bad}");
        }
    }

    proptest::proptest! {
        #[test]
        fn every_second_can_be_parsed_again(seconds in 0..253_402_300_800_u64) {
            proptest::prop_assert_eq!(parse_utc(&utc(at(seconds))), Some(at(seconds)));
        }

        #[test]
        fn any_text_is_parsed_or_refused(text in "\\PC{0,25}", digits in "[0-9TZ:.+-]{15,25}") {
            for text in [text, digits] {
                proptest::prop_assert!(parse_utc(&text).is_none_or(|time| utc(time) == text));
            }
        }
    }
}
