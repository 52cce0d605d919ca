//! Enums whose form is the name of the variant.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::link::{EchoMode, LinkState, StationState};
use crate::poll::Quality;

impl Serialize for LinkState {
    /// The name of the state. The error of a lost connection is left out.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(match self {
            Self::Idle => "idle",
            Self::Waiting => "waiting",
            Self::Connecting => "connecting",
            Self::Up => "up",
            Self::Down { .. } => "down",
            Self::Closed => "closed",
        })
    }
}

impl Serialize for StationState {
    /// The name of the state. The time of the next probe is left out: it is a monotonic time.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(match self {
            Self::Unknown => "unknown",
            Self::Online => "online",
            Self::Offline { .. } => "offline",
        })
    }
}

impl Serialize for Quality {
    /// The name of the quality. Its [reason](Quality::reason) is a field of a sample.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(match self {
            Self::Good => "good",
            Self::Stale(_) => "stale",
            Self::Bad(_) => "bad",
        })
    }
}

/// The form of [`EchoMode`].
#[derive(Serialize, Deserialize)]
#[serde(rename = "EchoMode", rename_all = "snake_case")]
enum EchoModeForm {
    Auto,
    On,
    Off,
}

impl Serialize for EchoMode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let form = match self {
            Self::Auto => EchoModeForm::Auto,
            Self::On => EchoModeForm::On,
            Self::Off => EchoModeForm::Off,
        };
        form.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for EchoMode {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Ok(match EchoModeForm::deserialize(deserializer)? {
            EchoModeForm::Auto => Self::Auto,
            EchoModeForm::On => Self::On,
            EchoModeForm::Off => Self::Off,
        })
    }
}
