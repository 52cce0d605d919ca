//! Values of the configuration: names, sizes and times.

use std::fmt;
use std::time::Duration;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

/// A name in topics: 1 to 64 of the characters `A-Z a-z 0-9 _ -`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Name(String);

impl Name {
    /// A name of this program.
    pub(crate) fn constant(name: &'static str) -> Self {
        debug_assert!(is_name(name), "{name} is a name");
        Self(name.to_owned())
    }

    /// The name of this host, with other characters replaced; `bridge` if it is not known.
    pub(super) fn of_host() -> Self {
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let name: String = host.trim().chars().map(|c| if is_part(c) { c } else { '-' }).take(64).collect();
        Self(if is_name(&name) { name } else { "bridge".to_owned() })
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

fn is_part(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_' || c == '-'
}

fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len()) && text.chars().all(is_part)
}

impl<'de> Deserialize<'de> for Name {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        if is_name(&text) {
            return Ok(Self(text));
        }
        Err(D::Error::custom("a name has 1 to 64 of the characters A-Z a-z 0-9 _ -"))
    }
}

/// A size in bytes: `64MiB`, `1GiB`, `500kB`, or a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ByteSize(pub u64);

impl ByteSize {
    fn parse(text: &str) -> Option<Self> {
        let digits = text.bytes().take_while(u8::is_ascii_digit).count();
        let (number, unit) = text.split_at(digits);
        let unit: u64 = match unit.trim_start() {
            "" | "B" => 1,
            "kB" | "KB" => 1000,
            "MB" => 1_000_000,
            "GB" => 1_000_000_000,
            "KiB" => 1 << 10,
            "MiB" => 1 << 20,
            "GiB" => 1 << 30,
            _ => return None,
        };
        number.parse::<u64>().ok()?.checked_mul(unit).map(Self)
    }
}

impl<'de> Deserialize<'de> for ByteSize {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::parse(&text)
            .ok_or_else(|| D::Error::custom("a size is a number with a unit, such as 64MiB, 1GiB or 500kB"))
    }
}

/// A time: `500ms`, `3s`, `7d`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Period(pub Duration);

impl<'de> Deserialize<'de> for Period {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let period = humantime::parse_duration(&text).ok().filter(|period| !period.is_zero());
        period.map(Self).ok_or_else(|| D::Error::custom("a time is a number with a unit, such as 500ms, 3s or 7d"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_a_unit() {
        let size = |text| ByteSize::parse(text).map(|size| size.0);
        assert_eq!((size("64MiB"), size("1 GiB"), size("500kB")), (Some(64 << 20), Some(1 << 30), Some(500_000)));
        assert_eq!(
            (size("7"), size(""), size("MiB"), size("-1MiB"), size("99999999999GiB")),
            (Some(7), None, None, None, None)
        );
    }

    #[test]
    fn the_host_gives_a_name() {
        assert!(is_name(Name::of_host().as_str()));
        assert!(!is_name("") && !is_name("a/b") && !is_name(&"a".repeat(65)) && is_name("hall-2"));
    }
}
