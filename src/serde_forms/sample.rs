//! Samples of the poller.

use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

use crate::file::utc_millis;
use crate::poll::{Reason, Sample, Stamp, TagId};
use crate::tag::TagValue;

impl Serialize for TagId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(self.0)
    }
}

impl Serialize for Reason {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl Serialize for Stamp {
    /// The system time; the monotonic time means nothing to another process.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&utc_millis(self.time))
    }
}

impl Serialize for Sample {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let reason = self.quality.reason();
        let fields = 6_usize.saturating_add(reason.is_some().into()).saturating_add(self.stale_since.is_some().into());
        let mut form = serializer.serialize_struct("Sample", fields)?;
        form.serialize_field("id", &self.id)?;
        form.serialize_field("name", &*self.name)?;
        form.serialize_field("value", &ValuesForm(self.values()))?;
        form.serialize_field("quality", &self.quality)?;
        match reason {
            Some(reason) => form.serialize_field("reason", reason)?,
            None => form.skip_field("reason")?,
        }
        form.serialize_field("at", &self.at)?;
        match &self.stale_since {
            Some(since) => form.serialize_field("stale_since", since)?,
            None => form.skip_field("stale_since")?,
        }
        form.serialize_field("cycle", &self.cycle)?;
        form.end()
    }
}

/// Nothing, the only value, or a list.
struct ValuesForm<'v>(&'v [TagValue]);

impl Serialize for ValuesForm<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            [] => serializer.serialize_none(),
            [value] => value.serialize(serializer),
            values => values.serialize(serializer),
        }
    }
}
