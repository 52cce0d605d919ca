use std::sync::Arc;
use std::time::Duration;

use super::PollError;
use crate::tag::Tag;

/// How often tags are read: all tags of a class, on one station, are read together.
///
/// Two classes are the same if all their settings are.
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
pub struct ScanClass {
    pub(super) period: Duration,
    pub(super) phase: Option<Duration>,
    stale_after: Option<Duration>,
    bad_after: Option<Duration>,
    pub(super) probe_refused: Duration,
}

impl ScanClass {
    /// Once a period, 1 ms to a day.
    #[must_use]
    pub fn every(period: Duration) -> Self {
        Self { period, phase: None, stale_after: None, bad_after: None, probe_refused: Duration::from_secs(60) }
    }

    /// When in the period: counted from the making of the [`Poller`](super::Poller), so that classes with the same period
    /// and phase are read at the same time. Default: at random for each station, so that the load of many is even.
    #[must_use]
    pub fn phase(self, phase: Duration) -> Self {
        Self { phase: Some(phase), ..self }
    }

    /// How old a good value can be before it is [stale](super::Quality::Stale) though nothing has failed: because its turn
    /// does not come, or the answer takes long. Default: three periods. At least two.
    #[must_use]
    pub fn stale_after(self, age: Duration) -> Self {
        Self { stale_after: Some(age), ..self }
    }

    /// How old a stale value can be before it is [bad](super::Quality::Bad), and given no more. Default: ten periods, or as
    /// long as [`stale_after`](Self::stale_after) if that is more.
    #[must_use]
    pub fn bad_after(self, age: Duration) -> Self {
        Self { bad_after: Some(age), ..self }
    }

    /// How long a tag that the PLC has refused is left alone before it is tried again. Default: a minute.
    #[must_use]
    pub fn probe_refused(self, interval: Duration) -> Self {
        Self { probe_refused: interval, ..self }
    }

    /// The period.
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

    pub(super) fn check(&self) -> Result<(), PollError> {
        const SHORTEST: Duration = Duration::from_millis(1);
        const LONGEST: Duration = Duration::from_secs(86_400);
        if !(SHORTEST..=LONGEST).contains(&self.period) {
            return Err(PollError::Period { period: self.period, min: SHORTEST, max: LONGEST });
        }
        Ok(())
    }
}

/// A tag with a name, and when its samples are given: after each reading, or by change.
///
/// ```
/// use std::time::Duration;
/// use fatek::poll::PollTag;
///
/// let level = PollTag::new("level", "R100:f32".parse()?).deadband(0.5).heartbeat(Duration::from_secs(60));
/// let alarm = PollTag::new("alarm", "M10".parse()?).on_change();
/// assert_eq!(level.name(), "level");
/// # Ok::<(), fatek::tag::ParseTagError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct PollTag {
    pub(super) name: Arc<str>,
    pub(super) tag: Tag,
    pub(super) report: Report,
}

/// When samples are given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Report {
    pub(super) on_change: bool,
    pub(super) deadband: f64,
    pub(super) heartbeat: Option<Duration>,
}

impl PollTag {
    /// A tag whose samples are given after each reading.
    ///
    /// The name is yours: it stands in the samples, and means nothing to the poller.
    #[must_use]
    pub fn new(name: impl Into<Arc<str>>, tag: Tag) -> Self {
        Self { name: name.into(), tag, report: Report { on_change: false, deadband: 0.0, heartbeat: None } }
    }

    /// A sample only when a value or the quality is another than in the last sample.
    #[must_use]
    pub fn on_change(mut self) -> Self {
        self.report.on_change = true;
        self
    }

    /// As [`on_change`](Self::on_change), and a number counts as changed when it is further than this from that of the last
    /// sample: a slow drift is not lost.
    #[must_use]
    pub fn deadband(mut self, deadband: f64) -> Self {
        self.report = Report { on_change: true, deadband, ..self.report };
        self
    }

    /// As [`on_change`](Self::on_change), and a sample with the first reading after this time without one.
    #[must_use]
    pub fn heartbeat(mut self, heartbeat: Duration) -> Self {
        self.report = Report { on_change: true, heartbeat: Some(heartbeat), ..self.report };
        self
    }

    /// The name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The tag.
    #[must_use]
    pub fn tag(&self) -> Tag {
        self.tag
    }

    pub(super) fn check(&self) -> Result<(), PollError> {
        let deadband = self.report.deadband;
        let is_number = self.tag.tag_type().is_number();
        if !deadband.is_finite() || deadband < 0.0 || (deadband > 0.0 && !is_number) {
            return Err(PollError::Deadband { name: self.name.to_string(), tag: self.tag, deadband });
        }
        Ok(())
    }
}

impl From<Tag> for PollTag {
    /// The tag's own text is its name.
    fn from(tag: Tag) -> Self {
        Self::new(tag.to_string(), tag)
    }
}
