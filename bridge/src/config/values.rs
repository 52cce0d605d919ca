//! Values of the configuration: names, sizes and times.

use std::fmt;
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A name in topics: 1 to 64 of the characters `A-Z a-z 0-9 _ -`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Name(String);

impl Name {
    /// A name of this program.
    pub(crate) fn constant(name: &'static str) -> Self {
        debug_assert!(is_name(name), "{name} is a name");
        Self(name.to_owned())
    }

    /// The name that a text is.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        is_name(text).then(|| Self(text.to_owned()))
    }

    /// The name of this host, with other characters replaced; `bridge` if it is not known.
    pub(super) fn of_host() -> Self {
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let name: String = host.trim().chars().map(|c| if is_part(c) { c } else { '-' }).take(64).collect();
        Self(if is_name(&name) { name } else { "bridge".to_owned() })
    }

    /// A name with an ending of this program. It may be longer than others.
    pub(crate) fn with_ending(&self, ending: &'static str) -> Self {
        Self(format!("{}{ending}", self.0))
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
        Self::parse(&text).ok_or_else(|| D::Error::custom(NAME_RULE))
    }
}

pub(super) const NAME_RULE: &str = "a name has 1 to 64 of the characters A-Z a-z 0-9 _ -";

impl Serialize for Name {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.0)
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

impl fmt::Display for ByteSize {
    /// Displays it with the largest unit of which it is a multiple.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let units = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)];
        let whole = |unit: u64| self.0 > 0 && self.0.is_multiple_of(unit);
        let unit = units.into_iter().find(|(_, unit)| whole(*unit));
        let (name, unit) = unit.unwrap_or(("B", 1));
        write!(f, "{}{name}", self.0 / unit)
    }
}

impl Serialize for ByteSize {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
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

impl fmt::Display for Period {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        humantime::format_duration(self.0).fmt(f)
    }
}

impl Serialize for Period {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Texts with a pattern, for the schema.
macro_rules! text_schema {
    ($($type:ty: $name:literal $pattern:literal $example:literal)*) => { $(
        impl JsonSchema for $type {
            fn schema_name() -> std::borrow::Cow<'static, str> {
                $name.into()
            }

            fn inline_schema() -> bool {
                true
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({ "type": "string", "pattern": $pattern, "examples": [$example] })
            }
        }
    )* };
}

text_schema! {
    Name: "name" "^[A-Za-z0-9_-]{1,64}$" "hall-2"
    ByteSize: "size" "^[0-9]+ *([kKMG]B|[KMG]iB|B)?$" "64MiB"
    Period: "time" "^ *([0-9]+(\\.[0-9]+)? *[a-z]+ *)+$" "500ms"
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
    fn sizes_and_times_are_shown_as_they_are_parsed() {
        for (size, text) in [(64 << 20, "64MiB"), (1 << 30, "1GiB"), (1500, "1500B"), (0, "0B"), (3 << 10, "3KiB")] {
            assert_eq!(ByteSize(size).to_string(), text);
            assert_eq!(ByteSize::parse(text), Some(ByteSize(size)));
        }
        for period in [Duration::from_millis(1500), Duration::from_secs(7 * 24 * 3600), Duration::from_secs(90)] {
            let text = Period(period).to_string();
            assert_eq!(humantime::parse_duration(&text), Ok(period), "{text}");
        }
    }

    #[test]
    fn the_host_gives_a_name() {
        assert!(is_name(Name::of_host().as_str()));
        assert!(!is_name("") && !is_name("a/b") && !is_name(&"a".repeat(65)) && is_name("hall-2"));
    }
}
