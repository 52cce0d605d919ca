//! What is printed: a line a second, and a table at the end.

use std::io::{IsTerminal, Write, stdout};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fatek::Pool;
use fatek::poll::PollerHandle;

use crate::idle::Idle;
use crate::options::Options;
use crate::process::{memory, processor_time};
use crate::tally::{Counts, Tally};

pub(crate) struct Summary {
    options: Options,
    pool: Pool,
    poller: PollerHandle,
    tally: Arc<Tally>,
    /// The resident memory before there was a link.
    memory_before: Option<u64>,
    simulator: u32,
    terminal: bool,
    /// As of the last line, and of the beginning of what is measured.
    last: Sample,
    first: Sample,
    measured: Option<Measured>,
    idle: Idle,
    back: Option<Option<Duration>>,
    /// Tasks, and open files, that are left after all has been closed.
    left: (usize, usize),
}

/// Counters at a time.
#[derive(Clone)]
struct Sample {
    at: Instant,
    counts: Counts,
    /// Cycles that were left out.
    overruns: u64,
    processor_time: Option<Duration>,
    simulator_time: Option<Duration>,
}

/// What the table says.
struct Measured {
    took: Duration,
    counts: Counts,
    overruns: u64,
    up: usize,
    memory: Option<u64>,
    memory_per_link: Option<u64>,
    processor: Option<f64>,
    simulator: Option<f64>,
}

impl Summary {
    pub(crate) fn new(
        options: &Options,
        pool: Pool,
        poller: PollerHandle,
        tally: Arc<Tally>,
        memory_before: Option<u64>,
        simulator: u32,
    ) -> Self {
        let sample = Sample::take(&tally, &poller, simulator);
        Self {
            options: options.clone(),
            pool,
            poller,
            tally,
            memory_before,
            simulator,
            terminal: stdout().is_terminal(),
            last: sample.clone(),
            first: sample,
            measured: None,
            idle: Idle::default(),
            back: None,
            left: (0, 0),
        }
    }

    /// What links cost that are not used.
    pub(crate) fn idle(&mut self, idle: Idle) {
        self.idle = idle;
    }

    /// What is measured begins now.
    pub(crate) fn begin(&mut self) {
        self.note("all are up");
        self.first = Sample::take(&self.tally, &self.poller, self.simulator);
        self.last = self.first.clone();
    }

    /// What is measured ends now.
    pub(crate) fn end(&mut self) {
        let now = Sample::take(&self.tally, &self.poller, self.simulator);
        let (memory, memory_per_link) = self.memory();
        self.measured = Some(Measured {
            took: now.at - self.first.at,
            counts: now.counts.since(&self.first.counts),
            overruns: now.overruns - self.first.overruns,
            up: self.pool.stats().up,
            memory,
            memory_per_link,
            processor: now.share(&self.first, |sample| sample.processor_time),
            simulator: now.share(&self.first, |sample| sample.simulator_time),
        });
        self.note("the end");
    }

    /// Shows how it goes.
    pub(crate) fn show(&mut self) {
        let now = Sample::take(&self.tally, &self.poller, self.simulator);
        let counts = now.counts.since(&self.last.counts);
        let took = (now.at - self.last.at).as_secs_f64();
        let stats = self.pool.stats();
        let (memory, per_link) = self.memory();
        let line = format!(
            "up {} connecting {} down {} | {:.0} replies/s, {} errors, {} late, {} overrun | p50 {:.1} ms, p99 {:.1} ms | \
             {}, {} a link | CPU {}",
            stats.up,
            stats.waiting + stats.connecting,
            stats.idle + stats.down + stats.closed,
            counts.replies as f64 / took,
            self.tally.errors(),
            now.counts.late,
            now.overruns - self.first.overruns,
            millis(counts.percentile(50)),
            millis(counts.percentile(99)),
            memory.map_or("n/a".into(), mebibytes),
            per_link.map_or("n/a".into(), kibibytes),
            percent(now.share(&self.last, |sample| sample.processor_time)),
        );
        self.last = now;
        let mut out = stdout().lock();
        let rewritten = if self.terminal { ("\r\x1b[2K", "") } else { ("", "\n") };
        let _ = write!(out, "{}{line}{}", rewritten.0, rewritten.1).and_then(|()| out.flush());
    }

    /// Shows what has happened.
    pub(crate) fn note(&self, what: &str) {
        if self.terminal {
            println!();
        }
        println!("-- {what}");
    }

    /// The simulator is another process from now on.
    pub(crate) fn simulator_is(&mut self, process: u32) {
        self.simulator = process;
        self.first.simulator_time = None;
        self.last.simulator_time = None;
    }

    /// How long it took after the restart until all had answered; `None`: they have not.
    pub(crate) fn restarted(&mut self, back: Option<Duration>) {
        self.back = Some(back);
    }

    /// So much is left after all has been closed.
    pub(crate) fn left(&mut self, tasks: usize, files: usize) {
        self.left = (tasks, files);
    }

    /// Prints the table.
    pub(crate) fn print(&self) {
        let Some(measured) = &self.measured else { return };
        let Measured { took, counts, up, .. } = measured;
        let row = |name: &str, value: String| println!("{name:<44} {value}");
        println!();
        row("links, up at the end", format!("{}, {up}", self.options.plcs));
        row("replies", format!("{} in {:.1} s", counts.replies, took.as_secs_f64()));
        row("replies a second", format!("{:.0}", counts.replies as f64 / took.as_secs_f64()));
        row("errors", self.tally.errors().to_string());
        row("readings that were late, that were left out", format!("{}, {}", counts.late, measured.overruns));
        let (half, most) = (counts.percentile(50), counts.percentile(99));
        row("round trip, p50 and p99", format!("{:.2} ms, {:.2} ms", millis(half), millis(most)));
        row("resident memory", measured.memory.map_or("n/a".into(), mebibytes));
        row("resident memory a link that was never used", self.idle.unused.map_or("n/a".into(), kibibytes));
        row("resident memory a link, connected and idle", self.idle.connected.map_or("n/a".into(), kibibytes));
        row("resident memory a link, polled", measured.memory_per_link.map_or("n/a".into(), kibibytes));
        row("CPU of one core", percent(measured.processor));
        row("CPU of one core, the simulator's", percent(measured.simulator));
        if let Some(back) = self.back {
            let back = back.map_or("not all".into(), |back| format!("{:.1} s", back.as_secs_f64()));
            row("after the restart, all have answered within", back);
            let (cap, gate) = (self.options.backoff.1, self.options.start());
            row("  the back-off cap", format!("{:.1} s", cap.as_secs_f64()));
            row("  all links at the pace of connecting", format!("{:.1} s", gate.as_secs_f64()));
            row("  calls that failed meanwhile", counts.failed_while_away.to_string());
        }
        row("tasks, sockets left after closing", format!("{}, {}", self.left.0, self.left.1));
        for error in self.tally.first_errors() {
            println!("  {error}");
        }
    }

    /// Of the process, and for each link what has come with the links.
    fn memory(&self) -> (Option<u64>, Option<u64>) {
        let now = memory();
        let grown = now.zip(self.memory_before).map(|(now, before)| now.saturating_sub(before));
        (now, grown.map(|grown| grown / u64::from(self.options.plcs)))
    }
}

impl Sample {
    fn take(tally: &Tally, poller: &PollerHandle, simulator: u32) -> Self {
        Self {
            at: Instant::now(),
            counts: tally.counts(),
            overruns: poller.stats().overruns,
            processor_time: processor_time(std::process::id()),
            simulator_time: processor_time(simulator),
        }
    }

    /// What share of a processor was used since then, in percent.
    fn share(&self, before: &Self, time: impl Fn(&Self) -> Option<Duration>) -> Option<f64> {
        let used = time(self)?.checked_sub(time(before)?)?;
        Some(100.0 * used.as_secs_f64() / (self.at - before.at).as_secs_f64())
    }
}

fn millis(time: Duration) -> f64 {
    1000.0 * time.as_secs_f64()
}

fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}

fn kibibytes(bytes: u64) -> String {
    format!("{:.2} KiB", bytes as f64 / 1024.0)
}

fn percent(share: Option<f64>) -> String {
    share.map_or("n/a".to_owned(), |share| format!("{share:.1} %"))
}
