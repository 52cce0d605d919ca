//! What runs come to.

use std::collections::BTreeMap;
use std::fmt;

use fatek::{Error, ErrorCode, LinkStats};

use crate::plant::{kind, refusal};

/// The results of one or many runs.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tally {
    pub(crate) runs: u64,
    pub(crate) calls: u64,
    /// Calls with the right result, refusals of what is refused included.
    pub(crate) right: u64,
    pub(crate) errors: BTreeMap<&'static str, u64>,
    /// Wrong values, refused requests said to be done, refusals of other requests, and writes that were executed more or
    /// less often than was said.
    pub(crate) wrong: Vec<String>,
    /// Calls that ended after their deadline.
    pub(crate) late: u64,
    /// Requests on the wire, checks not counted.
    pub(crate) requests: u64,
    pub(crate) checks: u64,
    pub(crate) duplicates: u64,
    pub(crate) repeated_jobs: u64,
    /// Broadcasts sent, and those of them that were obeyed by somebody.
    pub(crate) broadcasts: (u64, u64),
    /// How often each fault struck.
    pub(crate) struck: BTreeMap<String, u64>,
}

impl Tally {
    /// Counts a call. `refusals`: those that are right; `refused`: nothing else is.
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
        other.struck.into_iter().for_each(|(fault, count)| *self.struck.entry(fault).or_default() += count);
    }

    pub(crate) fn is_sound(&self) -> bool {
        self.wrong.is_empty() && self.late == 0
    }

    /// Asserts that at least so many calls in a hundred had the right result.
    #[track_caller]
    pub(crate) fn assert_right(&self, in_hundred: u64) {
        assert!(
            self.right * 100 >= self.calls * in_hundred,
            "{in_hundred} % of the calls have the right result: {self}"
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
