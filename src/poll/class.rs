use std::sync::Arc;
use std::time::Duration;

use super::PollError;
use crate::tag::Tag;

/// Default of [`ScanClass::probe_refused`].
const DEFAULT_PROBE_INTERVAL: Duration = Duration::from_secs(60);

/// A scan class: period and phase of reading its tags, and age limits of their values.
///
/// All tags of a class on one station are read together. Classes with equal settings are equal.
///
/// ```
/// use std::time::Duration;
/// use fatek::poll::ScanClass;
///
/// let slow = ScanClass::every(Duration::from_secs(10)).stale_after(Duration::from_secs(60));
/// assert_eq!(slow, ScanClass::every(Duration::from_secs(10)).stale_after(Duration::from_secs(60)));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[must_use]
pub struct ScanClass {
    pub(crate) period: Duration,
    pub(crate) phase: Option<Duration>,
    pub(crate) stale_after: Option<Duration>,
    pub(crate) bad_after: Option<Duration>,
    pub(crate) probe_refused: Duration,
}

impl ScanClass {
    /// Makes a class that is read once a period, 1 ms to a day.
    pub fn every(period: Duration) -> Self {
        Self { period, phase: None, stale_after: None, bad_after: None, probe_refused: DEFAULT_PROBE_INTERVAL }
    }

    /// Sets the phase within the period, counted from when the [`Poller`](super::Poller) was made.
    ///
    /// Classes with equal period and phase are read at the same time. Default: random for each
    /// station, which spreads the load of many stations evenly. Tags of a class with a
    /// phase have their first reading at its phase; others are read soon after they were added.
    pub fn phase(self, phase: Duration) -> Self {
        Self { phase: Some(phase), ..self }
    }

    /// Sets the age at which a good value becomes [stale](super::Quality::Stale) without a failure.
    ///
    /// That happens when its turn does not come or a reply takes long. Default: three periods.
    /// Raised to two periods if less.
    pub fn stale_after(self, age: Duration) -> Self {
        Self { stale_after: Some(age), ..self }
    }

    /// Sets the age at which a stale value becomes [bad](super::Quality::Bad) and is dropped.
    ///
    /// Default: ten periods. Raised to [`stale_after`](Self::stale_after) if less.
    pub fn bad_after(self, age: Duration) -> Self {
        Self { bad_after: Some(age), ..self }
    }

    /// Sets the interval of the probes of a tag that the PLC has refused. Default: a minute.
    pub fn probe_refused(self, interval: Duration) -> Self {
        Self { probe_refused: interval, ..self }
    }

    /// Returns the period.
    #[must_use]
    pub fn period(&self) -> Duration {
        self.period
    }

    pub(super) fn stale_age(&self) -> Duration {
        self.stale_after.unwrap_or(self.period.saturating_mul(3)).max(self.period.saturating_mul(2))
    }

    pub(super) fn bad_age(&self) -> Duration {
        self.bad_after.unwrap_or(self.period.saturating_mul(10)).max(self.stale_age())
    }

    pub(crate) fn check(&self) -> Result<(), PollError> {
        const SHORTEST: Duration = Duration::from_millis(1);
        const LONGEST: Duration = Duration::from_secs(86_400);
        if !(SHORTEST..=LONGEST).contains(&self.period) {
            return Err(PollError::Period { period: self.period, min: SHORTEST, max: LONGEST });
        }
        Ok(())
    }
}

/// A tag with a name and the rule for its samples: after each reading, or on change.
///
/// ```
/// use std::time::Duration;
/// use fatek::poll::PollTag;
///
/// let level = PollTag::new("level", "R100:f32".parse()?).deadband(0.5).heartbeat(Duration::from_secs(60));
/// let alarm = PollTag::new("alarm", "M10".parse()?).on_change(true);
/// assert_eq!(level.name(), "level");
/// # Ok::<(), fatek::tag::ParseTagError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
#[must_use]
pub struct PollTag {
    pub(super) name: Arc<str>,
    pub(super) tag: Tag,
    pub(crate) policy: ReportPolicy,
}

/// When samples are reported.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ReportPolicy {
    pub(crate) on_change: bool,
    pub(crate) deadband: f64,
    pub(crate) heartbeat: Option<Duration>,
}

impl ReportPolicy {
    /// After each reading.
    const ALWAYS: Self = Self { on_change: false, deadband: 0.0, heartbeat: None };
}

impl PollTag {
    /// Makes a tag whose samples are reported after each reading.
    ///
    /// The name is copied to the samples; it need not be unique.
    pub fn new(name: impl Into<Arc<str>>, tag: Tag) -> Self {
        Self { name: name.into(), tag, policy: ReportPolicy::ALWAYS }
    }

    /// Sets whether a sample is reported only when a value or the quality has changed since the
    /// last sample. Default: `false`, which also removes deadband and heartbeat.
    pub fn on_change(mut self, on_change: bool) -> Self {
        self.policy = if on_change { ReportPolicy { on_change, ..self.policy } } else { ReportPolicy::ALWAYS };
        self
    }

    /// Reports on change of a number by more than this since the last sample.
    ///
    /// Measured from the last sample, so a slow drift is reported too. See
    /// [`on_change`](Self::on_change).
    pub fn deadband(self, deadband: f64) -> Self {
        Self { policy: ReportPolicy { on_change: true, deadband, ..self.policy }, ..self }
    }

    /// Reports on change, and with the first reading after this time without a sample.
    ///
    /// See [`on_change`](Self::on_change).
    pub fn heartbeat(self, heartbeat: Duration) -> Self {
        Self { policy: ReportPolicy { on_change: true, heartbeat: Some(heartbeat), ..self.policy }, ..self }
    }

    /// Returns the name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    pub(crate) fn check(&self) -> Result<(), PollError> {
        let deadband = self.policy.deadband;
        let is_number = self.tag.tag_type().is_number();
        if !deadband.is_finite() || deadband < 0.0 || (deadband > 0.0 && !is_number) {
            return Err(PollError::Deadband { name: self.name.to_string(), tag: self.tag, deadband });
        }
        Ok(())
    }
}

impl From<Tag> for PollTag {
    /// Uses the text of the tag as its name.
    fn from(tag: Tag) -> Self {
        Self::new(tag.to_string(), tag)
    }
}
