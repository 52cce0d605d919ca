//! Durations on the command line: `500ms`, `1.5s`, `10m`, `2h`.

use std::time::Duration;

/// Parses a duration of 0 to 24 hours.
pub(crate) fn parse(text: &str) -> Result<Duration, String> {
    match humantime::parse_duration(text) {
        Ok(duration) if duration <= MAX => Ok(duration),
        Ok(_) => Err("the limit is 24h".to_owned()),
        Err(_) => Err("expected a number with a unit, such as 500ms, 1.5s, 10m or 2h".to_owned()),
    }
}

/// Parses a duration of more than 0, up to 24 hours.
pub(crate) fn parse_positive(text: &str) -> Result<Duration, String> {
    let duration = parse(text)?;
    if duration.is_zero() { Err("it must be more than 0".to_owned()) } else { Ok(duration) }
}

const MAX: Duration = Duration::from_secs(24 * 3600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_a_number_and_a_unit() {
        for (text, millis) in [
            ("500ms", 500),
            ("2s", 2000),
            ("1.5s", 1500),
            ("1m", 60_000),
            ("0s", 0),
            ("60min", 3_600_000),
            ("2h", 7_200_000),
            ("1h 30m", 5_400_000),
            ("24h", 86_400_000),
        ] {
            assert_eq!(parse(text), Ok(Duration::from_millis(millis)), "{text}");
        }
        for text in ["", "5", "s", "ms", "-1s", "1.2.3s", "25h", ".s", "1.s", "99999999999999999999999s", "1sms"] {
            assert!(parse(text).is_err(), "{text}");
        }
        assert!(parse_positive("0ms").is_err());
        assert_eq!(parse_positive("1ms"), Ok(Duration::from_millis(1)));
    }
}
