//! Errors of calls.

use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

use crate::error::Error;

impl Serialize for Error {
    /// Kind, text and the two properties that decide about a repetition.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut form = serializer.serialize_struct("Error", 4)?;
        form.serialize_field("kind", kind(self))?;
        form.serialize_field("message", &self.to_string())?;
        form.serialize_field("is_transient", &self.is_transient())?;
        form.serialize_field("may_have_executed", &self.may_have_executed())?;
        form.end()
    }
}

fn kind(error: &Error) -> &'static str {
    match error {
        Error::Invalid(_) => "invalid",
        Error::Tag(_) => "tag",
        Error::Plc { .. } => "plc",
        Error::Timeout { .. } => "timeout",
        Error::BadReply { .. } => "bad_reply",
        Error::OutOfStep { .. } => "out_of_step",
        Error::Duplicates { .. } => "duplicates",
        Error::Offline { .. } => "offline",
        Error::QueueFull { .. } => "queue_full",
        Error::GateClosed { .. } => "gate_closed",
        Error::Connect { .. } => "connect",
        Error::Disconnected { .. } => "disconnected",
        Error::PartlyWritten { .. } => "partly_written",
        Error::RefusedTags { .. } => "refused_tags",
        Error::ReadBeforeWrite { .. } => "read_before_write",
        Error::Clock { .. } => "clock",
        Error::Closed { .. } => "closed",
    }
}
