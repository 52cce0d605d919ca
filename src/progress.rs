//! How far a transfer of many requests has come.
//!
//! Given as a [`Progress`] after each step. What counts is told the time, and reads no clock.

use std::fmt;
use std::time::Duration;

use tokio::time::Instant;

/// What a transfer is about at the moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Phase {
    /// What the PLC holds is read.
    Reading,
    /// What the PLC holds is read and compared, to find out what has to be written.
    Comparing,
    /// What differs is written and read back.
    Writing,
    /// All is read once more and compared.
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

/// How far a transfer has come: a snapshot, given after each step.
///
/// Every phase begins anew: its steps, bytes and time are its own. Its `Display` is a line for people.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Progress {
    /// What it is about.
    pub phase: Phase,
    /// Steps that are done: of a program, pages; of a backup, elements.
    pub done: usize,
    /// Steps that there are in this phase.
    pub total: usize,
    /// Bytes of the content that have gone over the line in this phase, without the frames around them.
    pub bytes: u64,
    /// How long this phase has taken so far.
    pub elapsed: Duration,
    /// Steps that were done already when this run began, and have taken none of its time.
    pub kept: usize,
}

impl Progress {
    /// Bytes of the content a second; `None` before any time has passed.
    #[must_use]
    pub fn bytes_per_second(&self) -> Option<f64> {
        let seconds = self.elapsed.as_secs_f64();
        (seconds > 0.0).then(|| self.bytes as f64 / seconds)
    }

    /// How long the rest of this phase will take if it goes on like this; `None` before anything is known of that.
    #[must_use]
    pub fn time_left(&self) -> Option<Duration> {
        let fresh = u32::try_from(self.done.checked_sub(self.kept)?).ok().filter(|&fresh| fresh > 0)?;
        let left = u32::try_from(self.total.saturating_sub(self.done)).ok()?;
        Some(self.elapsed.checked_div(fresh)?.saturating_mul(left))
    }

    /// Whether the phase is over.
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

/// Counts the steps of a phase.
#[derive(Clone, Debug)]
pub(crate) struct Meter {
    phase: Phase,
    since: Instant,
    done: usize,
    total: usize,
    kept: usize,
    bytes: u64,
}

impl Meter {
    /// A phase of so many steps begins, of which some are done already.
    pub(crate) fn new(phase: Phase, total: usize, kept: usize, now: Instant) -> Self {
        Self { phase, since: now, done: kept, total, kept, bytes: 0 }
    }

    pub(crate) fn phase(&self) -> Phase {
        self.phase
    }

    pub(crate) fn done(&self) -> usize {
        self.done
    }

    /// So many steps of so many are done by now, and so many bytes more have gone over the line.
    pub(crate) fn advance(&mut self, done: usize, total: usize, bytes: usize) {
        self.done = done;
        self.total = total;
        self.bytes = self.bytes.saturating_add(u64::try_from(bytes).unwrap_or(u64::MAX));
    }

    pub(crate) fn progress(&self, now: Instant) -> Progress {
        Progress {
            phase: self.phase,
            done: self.done,
            total: self.total,
            bytes: self.bytes,
            elapsed: now.saturating_duration_since(self.since),
            kept: self.kept,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_and_time_left_count_only_what_was_done_in_this_run() {
        let start = Instant::now();
        let mut meter = Meter::new(Phase::Reading, 10, 4, start);
        assert_eq!(meter.progress(start).time_left(), None);
        assert_eq!(meter.progress(start).bytes_per_second(), None);
        meter.advance(6, 10, 256);
        let progress = meter.progress(start + Duration::from_secs(2));
        assert_eq!(progress.time_left(), Some(Duration::from_secs(4)));
        assert_eq!(progress.bytes_per_second(), Some(128.0));
        assert_eq!(progress.to_string(), "reading: 6 of 10, 256 bytes, 128 bytes/s, 4 s left");
        meter.advance(10, 10, 512);
        let progress = meter.progress(start + Duration::from_secs(6));
        assert!(progress.is_complete());
        assert_eq!(progress.to_string(), "reading: 10 of 10, 768 bytes, 128 bytes/s");
        assert_eq!(meter.phase(), Phase::Reading);
    }
}
