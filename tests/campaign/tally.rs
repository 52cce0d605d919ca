//! Counts of the results of runs.

use std::collections::BTreeMap;
use std::fmt;

use fatek::{Error, ErrorCode, LinkStats};

/// Results of one or more runs.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tally {
    pub(crate) runs: u64,
    pub(crate) calls: u64,
    /// Calls with the right result, expected refusals included.
    pub(crate) right: u64,
    pub(crate) errors: BTreeMap<&'static str, u64>,
    /// Wrong values, refused requests reported as done, refusals of other requests, and writes
    /// executed more or less often than reported.
    pub(crate) wrong: Vec<String>,
    /// Calls that ended after their deadline.
    pub(crate) late: u64,
    /// Requests sent, checks not counted.
    pub(crate) requests: u64,
    pub(crate) checks: u64,
    pub(crate) duplicates: u64,
    pub(crate) repeated_jobs: u64,
    /// Broadcasts sent, and broadcasts executed by at least one station.
    pub(crate) broadcasts: (u64, u64),
    /// Number of injections of each fault.
    pub(crate) fault_counts: BTreeMap<String, u64>,
}

impl Tally {
    /// Counts a call. Only the refusals in `refusals` are right; with `refused`, no other result
    /// is.
    pub(crate) fn call<T: fmt::Debug>(
        &mut self,
        what: impl fmt::Display,
        (refused, refusals): (bool, &[ErrorCode]),
        result: Result<T, Error>,
        is_right: impl FnOnce(&T) -> bool,
    ) -> Result<T, Error> {
        self.calls += 1;
        match &result {
            Ok(values) if refused || !is_right(values) => {
                let mut got = format!("{values:?}");
                got.truncate(300);
                self.wrong.push(format!("{what}: {got}"));
            }
            Ok(_) => self.right += 1,
            Err(error) => match refusal(error) {
                Some(code) if !refusals.contains(&code) => self.wrong.push(format!("{what}: {error}")),
                Some(_) => self.right += 1,
                None => *self.errors.entry(kind(error)).or_default() += 1,
            },
        }
        result
    }

    pub(crate) fn links(&mut self, stats: &LinkStats) {
        self.requests += stats.stations.requests + stats.broadcasts;
        self.checks += stats.stations.checks;
        self.duplicates += stats.stations.duplicates;
        self.repeated_jobs += stats.stations.repeated_jobs;
    }

    pub(crate) fn add(&mut self, other: Self) {
        self.runs += other.runs;
        self.calls += other.calls;
        self.right += other.right;
        self.wrong.extend(other.wrong);
        self.late += other.late;
        self.requests += other.requests;
        self.checks += other.checks;
        self.duplicates += other.duplicates;
        self.repeated_jobs += other.repeated_jobs;
        self.broadcasts = (self.broadcasts.0 + other.broadcasts.0, self.broadcasts.1 + other.broadcasts.1);
        other.errors.into_iter().for_each(|(kind, count)| *self.errors.entry(kind).or_default() += count);
        other.fault_counts.into_iter().for_each(|(fault, count)| *self.fault_counts.entry(fault).or_default() += count);
    }

    pub(crate) fn is_sound(&self) -> bool {
        self.wrong.is_empty() && self.late == 0
    }

    /// Asserts that at least `percent` % of the calls had the right result.
    #[track_caller]
    pub(crate) fn assert_right(&self, percent: u64) {
        assert!(
            self.right * 100 >= self.calls * percent,
            "fewer than {percent} % of the calls have the right result: {self}"
        );
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { runs, calls, right, errors, wrong, late, requests, checks, duplicates, repeated_jobs, .. } = self;
        write!(f, "{runs} runs, {requests} requests, {checks} checks, {duplicates} duplicates dropped, ")?;
        write!(f, "{repeated_jobs} jobs repeated; {calls} calls, {right} right, errors {errors:?}; ")?;
        write!(f, "broadcasts {:?}; {} wrong, {late} late", self.broadcasts, wrong.len())
    }
}

/// Short name of an error.
fn kind(error: &Error) -> &'static str {
    match error {
        Error::Invalid(_) => "invalid",
        Error::Plc { .. } => "refused",
        Error::Timeout { .. } => "timeout",
        Error::BadReply { .. } => "bad reply",
        Error::OutOfStep { .. } => "out of step",
        Error::Duplicates { .. } => "duplicates",
        Error::Offline { .. } => "offline",
        Error::QueueFull { .. } => "queue full",
        Error::GateClosed { .. } => "gate closed",
        Error::Connect { .. } => "connect",
        Error::Disconnected { .. } => "disconnected",
        Error::PartlyWritten { source, .. } | Error::RefusedTags { source, .. } => kind(source),
        Error::Closed { .. } => "closed",
        _ => "other",
    }
}

/// Error code of the refusal that caused the error.
fn refusal(error: &Error) -> Option<ErrorCode> {
    match error {
        Error::Plc { error, .. } => Some(*error),
        Error::PartlyWritten { source, .. } | Error::RefusedTags { source, .. } => refusal(source),
        _ => None,
    }
}
