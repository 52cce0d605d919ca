//! Keys and values in the bucket of a fleet.
//!
//! | key | value |
//! |---|---|
//! | `w.<session>` | a [`SessionValue`], or `dead` for a session that was fenced or has ended |
//! | `l.<link>` | the session of the owner; empty: free |
//! | `o.<link>` | the id of the member that is to own the link, set by hand; empty or missing: by placement |
//! | `d.<member>` | `drain`: the member gives its links away; else nothing |
//!
//! Other keys belong to other parts. A value that this version does not understand is a fault of its key alone.

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// The value of a session that has ended. It is never renewed again.
pub(super) const DEAD: &str = "dead";
/// The value of the key of a member that is to give its links away.
pub(super) const DRAIN: &str = "drain";
/// The longest value of a session that is read.
const MAX_VALUE: usize = 4096;
/// The longest lease that a configuration can have.
const MAX_LEASE: Duration = Duration::from_secs(60);

/// A key of the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Key<'a> {
    Session(&'a str),
    Link(&'a str),
    Override(&'a str),
    Drain(&'a str),
}

impl<'a> Key<'a> {
    /// The key of a text; `None` if it belongs to another part.
    pub(super) fn parse(text: &'a str) -> Option<Self> {
        let (kind, name) = text.split_once('.')?;
        match kind {
            "w" => Some(Self::Session(name)),
            "l" => Some(Self::Link(name)),
            "o" => Some(Self::Override(name)),
            "d" => Some(Self::Drain(name)),
            _ => None,
        }
    }

    pub(super) fn text(self) -> String {
        match self {
            Self::Session(name) => format!("w.{name}"),
            Self::Link(name) => format!("l.{name}"),
            Self::Override(name) => format!("o.{name}"),
            Self::Drain(name) => format!("d.{name}"),
        }
    }
}

/// The value of a living session.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub(super) struct SessionValue {
    /// The id of the member.
    pub(super) member: String,
    /// Its version of the program.
    pub(super) version: String,
    /// The hash of its configuration.
    pub(super) config: String,
    /// Its share in comparison with the others.
    pub(super) weight: u32,
    /// `true`: it gives its links away.
    pub(super) draining: bool,
    /// Its lease.
    pub(super) lease_ms: u64,
    /// Counts the attempts to write this session, so that a member knows which of them was stored.
    pub(super) beat: u64,
}

impl SessionValue {
    /// The session of a value; `None` if it has ended, or this version does not understand it.
    pub(super) fn parse(text: &str) -> Option<Self> {
        if text.len() > MAX_VALUE {
            return None;
        }
        serde_json::from_str(text).ok()
    }

    pub(super) fn to_json(&self) -> String {
        // A struct of texts and numbers.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// Its lease in nanoseconds, within the bounds of the configuration.
    pub(super) fn lease(&self) -> u64 {
        self.lease_ms.saturating_mul(1_000_000).min(nanoseconds(MAX_LEASE))
    }

    /// Returns whether two differ by more than the attempt: in what placement and status depend on.
    pub(super) fn differs_from(&self, other: &Self) -> bool {
        *self != Self { beat: self.beat, ..other.clone() }
    }
}

/// A duration as the core counts it.
pub(super) fn nanoseconds(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_of_the_protocol() {
        for (text, key) in [
            ("w.1f-2", Key::Session("1f-2")),
            ("l.mixer", Key::Link("mixer")),
            ("o.mixer", Key::Override("mixer")),
            ("d.hall-2", Key::Drain("hall-2")),
        ] {
            assert_eq!(Key::parse(text), Some(key));
            assert_eq!(key.text(), text);
        }
        for other in ["", "w", "config", "x.mixer", "lmixer"] {
            assert_eq!(Key::parse(other), None, "{other}");
        }
    }

    #[test]
    fn a_value_is_read_as_it_was_written() {
        let value = SessionValue {
            member: "hall-2".into(),
            version: "0.1.0".into(),
            config: "9f".into(),
            weight: 2,
            draining: false,
            lease_ms: 3000,
            beat: 17,
        };
        assert_eq!(SessionValue::parse(&value.to_json()), Some(value.clone()));
        assert!(!value.differs_from(&SessionValue { beat: 18, ..value.clone() }));
        assert!(value.differs_from(&SessionValue { draining: true, ..value.clone() }));
        assert_eq!(value.lease(), 3_000_000_000);
        let longest = SessionValue { lease_ms: u64::MAX, ..value.clone() };
        assert_eq!(longest.lease(), 60_000_000_000);
        // A newer version may add fields.
        let newer = value.to_json().replace('{', r#"{"hall":"north","#);
        assert_eq!(SessionValue::parse(&newer), Some(value));
        for other in [DEAD, "", "{}", "[]", &"x".repeat(10_000)] {
            assert_eq!(SessionValue::parse(other), None);
        }
    }
}
