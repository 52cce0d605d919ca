//! Scan classes, and the tags to be polled.

use serde::{Deserialize, Serialize};

use super::{DurationText, through_forms};
use crate::poll::{PollTag, ScanClass};
use crate::tag::Tag;

through_forms! {
    ScanClass => ScanClassForm;
    PollTag => PollTagForm;
}

/// The form of [`ScanClass`].
#[derive(Serialize, Deserialize)]
#[serde(rename = "ScanClass", deny_unknown_fields)]
struct ScanClassForm {
    period: DurationText,
    #[serde(default)]
    phase: Option<DurationText>,
    #[serde(default)]
    stale_after: Option<DurationText>,
    #[serde(default)]
    bad_after: Option<DurationText>,
    #[serde(default)]
    probe_refused: Option<DurationText>,
}

impl ScanClassForm {
    fn of(class: &ScanClass) -> Result<Self, String> {
        let ScanClass { period, phase, stale_after, bad_after, probe_refused } = *class;
        class.check().map_err(|error| error.to_string())?;
        Ok(Self {
            period: DurationText(period),
            phase: phase.map(DurationText),
            stale_after: stale_after.map(DurationText),
            bad_after: bad_after.map(DurationText),
            probe_refused: Some(DurationText(probe_refused)),
        })
    }

    fn make(self) -> Result<ScanClass, String> {
        let mut class = ScanClass::every(self.period.0);
        if let Some(DurationText(phase)) = self.phase {
            class = class.phase(phase);
        }
        if let Some(DurationText(age)) = self.stale_after {
            class = class.stale_after(age);
        }
        if let Some(DurationText(age)) = self.bad_after {
            class = class.bad_after(age);
        }
        if let Some(DurationText(interval)) = self.probe_refused {
            class = class.probe_refused(interval);
        }
        class.check().map_err(|error| error.to_string())?;
        Ok(class)
    }
}

/// The form of [`PollTag`].
#[derive(Serialize, Deserialize)]
#[serde(rename = "PollTag", deny_unknown_fields)]
struct PollTagForm {
    /// Default: the text of the tag.
    #[serde(default)]
    name: Option<String>,
    tag: Tag,
    /// Default: `true` with a deadband or a heartbeat.
    #[serde(default)]
    on_change: Option<bool>,
    #[serde(default)]
    deadband: Option<f64>,
    #[serde(default)]
    heartbeat: Option<DurationText>,
}

impl PollTagForm {
    fn of(tag: &PollTag) -> Result<Self, String> {
        // A deadband that is not a number has no form in JSON.
        tag.check().map_err(|error| error.to_string())?;
        let policy = tag.policy;
        Ok(Self {
            name: Some(tag.name().to_owned()),
            tag: tag.tag(),
            on_change: Some(policy.on_change),
            deadband: policy.on_change.then_some(policy.deadband),
            heartbeat: policy.heartbeat.map(DurationText),
        })
    }

    fn make(self) -> Result<PollTag, String> {
        let is_always = self.on_change == Some(false);
        if is_always && (self.deadband.is_some() || self.heartbeat.is_some()) {
            return Err(format!(
                "`on_change` of {} is false, and a deadband or a heartbeat needs reports on change",
                self.tag
            ));
        }
        let mut tag = match self.name {
            Some(name) => PollTag::new(name, self.tag),
            None => PollTag::from(self.tag),
        };
        tag = tag.on_change(self.on_change.unwrap_or(false));
        if let Some(deadband) = self.deadband {
            tag = tag.deadband(deadband);
        }
        if let Some(DurationText(heartbeat)) = self.heartbeat {
            tag = tag.heartbeat(heartbeat);
        }
        tag.check().map_err(|error| error.to_string())?;
        Ok(tag)
    }
}
