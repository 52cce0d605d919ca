//! Output: a line per second, and a table at the end.

use std::io::{IsTerminal, Write, stdout};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fatek::Pool;
use fatek::poll::PollerHandle;

use crate::counters::{Counters, Snapshot};
use crate::idle::Idle;
use crate::options::Options;
use crate::process::{memory, processor_time};

pub(crate) struct Summary {
    options: Options,
    pool: Pool,
    poller: PollerHandle,
    counters: Arc<Counters>,
    /// Resident memory before the first link.
    memory_before: Option<u64>,
    simulator: u32,
    terminal: bool,
    /// Figures of the last line, and of the start of the measurement.
    last: Figures,
    first: Figures,
    measured: Option<Measured>,
    idle: Idle,
    /// Time from the restart until all have answered: `None` without a restart, `Some(None)` after
    /// a timeout.
    recovery: Option<Option<Duration>>,
    /// Tasks and open files left after the close of all links.
    leaked: (usize, usize),
}

/// Counters at one time.
#[derive(Clone)]
struct Figures {
    at: Instant,
    counts: Snapshot,
    /// Skipped poll cycles.
    overruns: u64,
    processor_time: Option<Duration>,
    simulator_time: Option<Duration>,
}

/// Results of the measurement.
struct Measured {
    elapsed: Duration,
    counts: Snapshot,
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
        counters: Arc<Counters>,
        memory_before: Option<u64>,
        simulator: u32,
    ) -> Self {
        let figures = Figures::take(&counters, &poller, simulator);
        Self {
            options: options.clone(),
            pool,
            poller,
            counters,
            memory_before,
            simulator,
            terminal: stdout().is_terminal(),
            last: figures.clone(),
            first: figures,
            measured: None,
            idle: Idle::default(),
            recovery: None,
            leaked: (0, 0),
        }
    }

    /// Sets the memory of idle links.
    pub(crate) fn set_idle(&mut self, idle: Idle) {
        self.idle = idle;
    }

    /// Starts the measurement.
    pub(crate) fn begin(&mut self) {
        self.note("all are up");
        self.first = Figures::take(&self.counters, &self.poller, self.simulator);
        self.last = self.first.clone();
    }

    /// Ends the measurement.
    pub(crate) fn end(&mut self) {
        let now = Figures::take(&self.counters, &self.poller, self.simulator);
        let (memory, memory_per_link) = self.memory();
        self.measured = Some(Measured {
            elapsed: now.at - self.first.at,
            counts: now.counts.since(&self.first.counts),
            overruns: now.overruns - self.first.overruns,
            up: self.pool.stats().up,
            memory,
            memory_per_link,
            processor: now.share(&self.first, |figures| figures.processor_time),
            simulator: now.share(&self.first, |figures| figures.simulator_time),
        });
        self.note("end of the measurement");
    }

    /// Prints the line of the last second.
    pub(crate) fn show(&mut self) {
        let now = Figures::take(&self.counters, &self.poller, self.simulator);
        let counts = now.counts.since(&self.last.counts);
        let elapsed = (now.at - self.last.at).as_secs_f64();
        let stats = self.pool.stats();
        let (memory, per_link) = self.memory();
        let line = format!(
            "up {} connecting {} down {} | {:.0} replies/s, {} errors, {} late, {} overrun | p50 {:.1} ms, p99 {:.1} ms | \
             {}, {} per link | CPU {}",
            stats.up,
            stats.waiting + stats.connecting,
            stats.idle + stats.down + stats.closed,
            counts.replies as f64 / elapsed,
            self.counters.errors(),
            now.counts.late,
            now.overruns - self.first.overruns,
            millis(counts.percentile(50)),
            millis(counts.percentile(99)),
            memory.map_or("n/a".into(), mebibytes),
            per_link.map_or("n/a".into(), kibibytes),
            percent(now.share(&self.last, |figures| figures.processor_time)),
        );
        self.last = now;
        let mut out = stdout().lock();
        let rewritten = if self.terminal { ("\r\x1b[2K", "") } else { ("", "\n") };
        let _ = write!(out, "{}{line}{}", rewritten.0, rewritten.1).and_then(|()| out.flush());
    }

    /// Prints an event.
    pub(crate) fn note(&self, event: &str) {
        if self.terminal {
            println!();
        }
        println!("-- {event}");
    }

    /// Sets the process of the restarted simulator.
    pub(crate) fn set_simulator(&mut self, process: u32) {
        self.simulator = process;
        self.first.simulator_time = None;
        self.last.simulator_time = None;
    }

    /// Sets the time from the restart until all PLCs have answered, or `None` after a timeout.
    pub(crate) fn set_recovery(&mut self, recovery: Option<Duration>) {
        self.recovery = Some(recovery);
    }

    /// Sets the number of tasks and open files left after the close of all links.
    pub(crate) fn set_leaked(&mut self, tasks: usize, files: usize) {
        self.leaked = (tasks, files);
    }

    /// Prints the table.
    pub(crate) fn print(&self) {
        let Some(measured) = &self.measured else { return };
        let Measured { elapsed, counts, up, .. } = measured;
        let row = |name: &str, value: String| println!("{name:<44} {value}");
        println!();
        row("links, up at the end", format!("{}, {up}", self.options.plcs));
        row("replies", format!("{} in {:.1} s", counts.replies, elapsed.as_secs_f64()));
        row("replies per second", format!("{:.0}", counts.replies as f64 / elapsed.as_secs_f64()));
        row("errors", self.counters.errors().to_string());
        row("poll cycles late, skipped", format!("{}, {}", counts.late, measured.overruns));
        let (p50, p99) = (counts.percentile(50), counts.percentile(99));
        row("round trip, p50 and p99", format!("{:.2} ms, {:.2} ms", millis(p50), millis(p99)));
        row("resident memory", measured.memory.map_or("n/a".into(), mebibytes));
        row("resident memory per link, never used", self.idle.unused.map_or("n/a".into(), kibibytes));
        row("resident memory per link, connected and idle", self.idle.connected.map_or("n/a".into(), kibibytes));
        row("resident memory per link, polled", measured.memory_per_link.map_or("n/a".into(), kibibytes));
        row("CPU of one core", percent(measured.processor));
        row("CPU of one core, simulator", percent(measured.simulator));
        if let Some(recovery) = self.recovery {
            let recovery = recovery.map_or("not all".into(), |time| format!("{:.1} s", time.as_secs_f64()));
            row("all PLCs answer after the restart within", recovery);
            let (cap, connect_time) = (self.options.backoff.1, self.options.connect_time());
            row("  longest back-off", format!("{:.1} s", cap.as_secs_f64()));
            row("  all connects at the rate limit", format!("{:.1} s", connect_time.as_secs_f64()));
            row("  failed calls meanwhile", counts.failed_while_down.to_string());
        }
        row("tasks, open files left after the close", format!("{}, {}", self.leaked.0, self.leaked.1));
        for error in self.counters.first_errors() {
            println!("  {error}");
        }
    }

    /// Resident memory of the process, and its growth per link.
    fn memory(&self) -> (Option<u64>, Option<u64>) {
        let now = memory();
        let grown = now.zip(self.memory_before).map(|(now, before)| now.saturating_sub(before));
        (now, grown.map(|grown| grown / u64::from(self.options.plcs)))
    }
}

impl Figures {
    fn take(counters: &Counters, poller: &PollerHandle, simulator: u32) -> Self {
        Self {
            at: Instant::now(),
            counts: counters.snapshot(),
            overruns: poller.stats().overruns,
            processor_time: processor_time(std::process::id()),
            simulator_time: processor_time(simulator),
        }
    }

    /// Processor load since `before`, in percent of one core.
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
