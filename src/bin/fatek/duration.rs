//! Durations as people write them: `500ms`, `2s`, `1.5s`, `1m`.

use std::time::Duration;

/// A duration of up to an hour.
pub(crate) fn parse(text: &str) -> Result<Duration, String> {
    let unit_at = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let seconds_per_unit = match unit {
        "ms" => 0.001,
        "s" => 1.0,
        "m" | "min" => 60.0,
        _ => return Err(RULE.to_owned()),
    };
    let number: f64 = number.parse().map_err(|_| RULE.to_owned())?;
    match Duration::try_from_secs_f64(number * seconds_per_unit) {
        Ok(duration) if duration <= LONGEST => Ok(duration),
        _ => Err("it must be at most an hour".to_owned()),
    }
}

/// The same, but not 0.
pub(crate) fn parse_timeout(text: &str) -> Result<Duration, String> {
    let duration = parse(text)?;
    if duration.is_zero() { Err("it must be more than 0".to_owned()) } else { Ok(duration) }
}

const RULE: &str = "it must be a number and a unit, ms, s or m: 500ms, 2s, 1.5s";
const LONGEST: Duration = Duration::from_secs(3600);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_a_number_and_a_unit() {
        for (text, millis) in
            [("500ms", 500), ("2s", 2000), ("1.5s", 1500), ("1m", 60_000), ("0s", 0), ("60min", 3_600_000)]
        {
            assert_eq!(parse(text), Ok(Duration::from_millis(millis)), "{text}");
        }
        for text in ["", "5", "s", "ms", "1 s", "-1s", "1.2.3s", "1h", ".s", "61m", "99999999999999999999999s", "1sms"]
        {
            assert!(parse(text).is_err(), "{text}");
        }
        assert!(parse_timeout("0ms").is_err());
        assert_eq!(parse_timeout("1ms"), Ok(Duration::from_millis(1)));
    }
}
