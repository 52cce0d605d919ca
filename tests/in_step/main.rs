//! Duplicate replies, and late replies to earlier clients, over real sockets and in real time.
//!
//! No value may belong to another request, and no refused write may be reported as done. A short
//! run is a test. The full campaign takes about nine minutes:
//!
//! ```text
//! FATEK_REPEATS=100 cargo test --release --all-features --test in_step -- --nocapture
//! ```
//!
//! "Before" at a test is its result with 100 repeats on the code at 3728afb, before the link kept
//! in step.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

mod broadcasts;
mod fresh_links;
mod long_read;
#[cfg(feature = "cli")]
#[path = "../process/mod.rs"]
mod process;
#[path = "../common/rng.rs"]
mod rng;
mod server;
mod single_calls;
mod writes;

use std::collections::BTreeMap;
use std::fmt;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use fatek::wire::Framing;
use fatek::{Element, Error, Register, Symbol};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;

/// Delays of copies.
const DELAYS: [Duration; 8] = [
    Duration::ZERO,
    Duration::from_micros(300),
    Duration::from_millis(1),
    Duration::from_millis(2),
    Duration::from_millis(5),
    Duration::from_millis(10),
    Duration::from_millis(20),
    Duration::from_millis(40),
];

const PLC_TIMES: [Duration; 4] =
    [Duration::ZERO, Duration::from_millis(2), Duration::from_millis(5), Duration::from_millis(20)];

#[cfg(all(unix, feature = "serial"))]
const SERIAL: server::Transport = server::Transport::Serial(115_200);

/// Concurrent runs. On a busy processor, requests are late and copies overtake them.
const MAX_CONCURRENT_RUNS: usize = 16;

/// Number of runs of each combination.
fn repeats() -> usize {
    std::env::var("FATEK_REPEATS").map_or(1, |text| text.parse().expect("FATEK_REPEATS is a number"))
}

/// Framing of a run: ASCII for even numbers, binary for odd ones.
fn framing(run: usize) -> Framing {
    if run.is_multiple_of(2) { Framing::Ascii } else { Framing::Binary }
}

fn r(n: u16) -> Register {
    register(Symbol::R, n)
}

fn register(symbol: Symbol, n: u16) -> Register {
    Element::new(symbol, n).unwrap().try_into().unwrap()
}

/// Results of one or more runs.
#[derive(Clone, Debug, Default)]
struct Tally {
    runs: usize,
    /// Runs with any wrong result.
    wrong_runs: usize,
    calls: usize,
    /// Calls with the correct result: the values, or the expected refusal.
    correct: usize,
    /// Values delivered as `Ok`.
    values: usize,
    wrong_values: usize,
    /// Refused or unexecuted requests that were reported as done.
    reported_done: usize,
    /// Executed requests that were reported as refused.
    reported_refused: usize,
    /// Other errors, by kind.
    errors: BTreeMap<String, usize>,
    copies: usize,
    /// Runs whose last call had the correct result.
    ended_well: usize,
}

impl Tally {
    fn wrong(&self) -> usize {
        self.wrong_values + self.reported_done + self.reported_refused
    }

    /// Counts a read of registers that hold their own address.
    fn read(&mut self, first: u16, result: Result<Vec<u16>, Error>) {
        self.calls += 1;
        match result {
            Ok(values) => {
                let wrong = (first..).zip(&values).filter(|(expected, value)| expected != *value).count();
                self.values += values.len();
                self.wrong_values += wrong;
                self.correct += usize::from(wrong == 0);
            }
            Err(error @ Error::Plc { .. }) => {
                self.reported_refused += 1;
                self.error(&error);
            }
            Err(error) => self.error(&error),
        }
    }

    /// Counts a write or a control command; `refused`: the PLC refuses it.
    fn command(&mut self, refused: bool, result: Result<(), Error>) {
        self.calls += 1;
        match (refused, result) {
            (false, Ok(())) | (true, Err(Error::Plc { .. })) => self.correct += 1,
            (true, Ok(())) => self.reported_done += 1,
            (false, Err(Error::Plc { .. })) => self.reported_refused += 1,
            (_, Err(error)) => self.error(&error),
        }
    }

    fn error(&mut self, error: &Error) {
        let text = format!("{error:?}");
        let kind = text.split([' ', '(']).next().unwrap_or_default().to_owned();
        *self.errors.entry(kind).or_default() += 1;
    }

    fn end_run(&mut self, copies: usize) {
        self.runs = 1;
        self.wrong_runs = usize::from(self.wrong() > 0);
        self.copies = copies;
    }

    fn add(&mut self, other: Self) {
        self.runs += other.runs;
        self.wrong_runs += other.wrong_runs;
        self.calls += other.calls;
        self.correct += other.correct;
        self.values += other.values;
        self.wrong_values += other.wrong_values;
        self.reported_done += other.reported_done;
        self.reported_refused += other.reported_refused;
        self.copies += other.copies;
        self.ended_well += other.ended_well;
        other.errors.into_iter().for_each(|(kind, count)| *self.errors.entry(kind).or_default() += count);
    }

    /// Asserts that no result was wrong.
    #[track_caller]
    fn assert_nothing_wrong(&self) {
        assert_eq!(self.wrong(), 0, "{self}");
    }

    /// Asserts that 99 % of the calls had the correct result.
    #[track_caller]
    fn assert_nearly_all_correct(&self) {
        assert!(self.correct * 100 >= self.calls * 99, "{self}");
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "wrong values {} of {}, reported done {}, reported refused {}, in {} of {} runs; correct calls {} of {}, errors {:?}; \
             {} copies",
            self.wrong_values,
            self.values,
            self.reported_done,
            self.reported_refused,
            self.wrong_runs,
            self.runs,
            self.correct,
            self.calls,
            self.errors,
            self.copies
        )
    }
}

/// Runs all combinations concurrently, the repeats of each in sequence, and prints the result of
/// each.
async fn campaign<F, T>(name: &str, repeats: usize, combinations: Vec<(String, F)>) -> Tally
where
    F: Fn(usize) -> T + Send + Sync + 'static,
    T: Future<Output = Tally> + Send + 'static,
{
    let mut set = JoinSet::new();
    let permits = Arc::new(Semaphore::new(MAX_CONCURRENT_RUNS));
    // The short run takes every third combination of the large campaigns.
    let step = if repeats == 1 && combinations.len() > 40 && crate::repeats() == 1 { 3 } else { 1 };
    for (index, (label, run)) in combinations.into_iter().enumerate().step_by(step) {
        let permits = permits.clone();
        set.spawn(async move {
            let mut tally = Tally::default();
            for n in 0..repeats {
                let _permit = permits.acquire().await.unwrap();
                tally.add(run(index + n).await);
            }
            (index, label, tally)
        });
    }
    let mut results = set.join_all().await;
    results.sort_by_key(|&(index, ..)| index);
    let mut total = Tally::default();
    for (_, label, tally) in results {
        println!("{name}, {label}: {tally}");
        total.add(tally);
    }
    println!("{name}: {total}");
    total
}
