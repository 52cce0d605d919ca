//! Progress of a transfer of many requests.

use std::fmt;
use std::time::Duration;

/// The current phase of a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Phase {
    /// Reading from the PLC.
    Reading,
    /// Reading from the PLC, to find what differs.
    Comparing,
    /// Writing what differs, and reading it back.
    Writing,
    /// Reading again, to compare.
    Verifying,
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Reading => "reading",
            Self::Comparing => "comparing",
            Self::Writing => "writing",
            Self::Verifying => "verifying",
        })
    }
}

/// Progress of a transfer after one of its steps. Its `Display` is one line for people.
///
/// Every phase counts its own steps, bytes and time.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Progress {
    /// The phase.
    pub phase: Phase,
    /// Steps that are done: pages of a program, elements of a backup.
    pub done: usize,
    /// Steps of this phase.
    pub total: usize,
    /// Bytes of program or memory that were transferred in this phase, without frames.
    pub bytes: u64,
    /// Duration of this phase so far.
    pub elapsed: Duration,
    /// Steps that were done before this run, and took none of its time.
    pub kept: usize,
}

impl Progress {
    /// Bytes of program or memory per second; `None` before time has passed.
    #[must_use]
    pub fn bytes_per_second(&self) -> Option<f64> {
        let seconds = self.elapsed.as_secs_f64();
        (seconds > 0.0).then(|| self.bytes as f64 / seconds)
    }

    /// Estimated duration of the rest of this phase; `None` before the first step of this run.
    #[must_use]
    pub fn time_left(&self) -> Option<Duration> {
        let fresh = u32::try_from(self.done.checked_sub(self.kept)?).ok().filter(|&fresh| fresh > 0)?;
        let left = u32::try_from(self.total.saturating_sub(self.done)).ok()?;
        Some(self.elapsed.checked_div(fresh)?.saturating_mul(left))
    }

    /// Returns whether the phase is complete.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        self.done >= self.total
    }
}

impl fmt::Display for Progress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { phase, done, total, bytes, .. } = self;
        write!(f, "{phase}: {done} of {total}, {bytes} bytes")?;
        if let Some(rate) = self.bytes_per_second() {
            write!(f, ", {rate:.0} bytes/s")?;
        }
        match self.time_left() {
            Some(left) if !self.is_complete() => write!(f, ", {} s left", left.as_secs_f64().ceil()),
            _ => Ok(()),
        }
    }
}
