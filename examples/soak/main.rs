//! Soak test: links to simulated PLCs over real sockets and pseudo-terminals, with all faults, for
//! half an hour.
//!
//! ```text
//! cargo run --release --example soak --features sim
//! cargo run --release --example soak --features sim -- --for 10m --seed 7 --links 12
//! ```
//!
//! The exit status is 1 after
//! - a value that the PLC cannot have had at that time: every value contains its place and its
//!   version ([`layout`]), and [`expected`] has the possible versions of each place;
//! - a confirmed write that is missing, or a write executed more often than called: the memory and
//!   the journal of the PLCs are audited periodically ([`audit`]);
//! - a call more than about a minute past its deadline, or a line without a reply for so long.
//!   There are no other limits of time, so the test can run beside other work;
//! - growth of memory, open files or tasks ([`health`]), or a leak after the close.
//!
//! The simulator injects the faults ([`line`]), and the ports are interrupted ([`server`]). Their
//! choice depends on the seed alone. Time and order of events are real and differ between runs;
//! `tests/simulation.rs` is exactly reproducible.
//!
//! The load is made by callers ([`caller`], [`calls`]) and a poller ([`polling`]).

mod audit;
mod caller;
mod calls;
mod counters;
mod expected;
mod health;
mod layout;
mod line;
mod options;
mod polling;
#[path = "../poll_many/process.rs"]
#[allow(dead_code, reason = "this example needs few open files")]
mod process;
mod report;
mod rng;
mod server;

use std::error::Error;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{Instant, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;

use self::audit::HANG;
use self::caller::{Access, Caller};
use self::counters::{MAX_FINDINGS, load};
use self::health::Usage;
use self::line::{Line, Transport};
use self::options::Options;
use self::report::Report;
use self::rng::Rng;

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

#[tokio::main(worker_threads = 2)]
async fn main() -> ExitCode {
    let options = match Options::parse(std::env::args().skip(1)) {
        Ok(Some(options)) => options,
        Ok(None) => {
            print!("{}", options::HELP);
            return ExitCode::SUCCESS;
        }
        Err(error) => {
            eprintln!("{error}\n\n{}", options::HELP);
            return ExitCode::from(2);
        }
    };
    match run(&options).await {
        Ok(true) => return ExitCode::SUCCESS,
        Ok(false) => println!("FAILED with --seed {}", options.seed),
        Err(error) => println!("FAILED with --seed {}: {error}", options.seed),
    }
    ExitCode::FAILURE
}

/// Runs the test. Returns whether it has passed.
async fn run(options: &Options) -> Result<bool> {
    let before = Usage::now();
    println!("{options}");
    let mut soak = Soak::start(options).await?;
    let samples = soak.watch(options).await;
    let passed = soak.finish(options, &samples).await?;
    drop(soak);
    if !passed {
        return Ok(false);
    }
    let leaked = leaked(before).await;
    println!("leaked: {} tasks, {} open files", leaked.tasks, leaked.files);
    Ok((leaked.tasks, leaked.files) == (0, 0))
}

/// Running test.
struct Soak {
    lines: Vec<Arc<Line>>,
    report: Report,
    /// Callers, audits and the poller.
    work: JoinSet<Result<()>>,
    servers: Vec<JoinHandle<Result<u64>>>,
    stop_work: CancellationToken,
    stop_servers: CancellationToken,
}

/// Interval of the audits of a line.
const AUDIT_INTERVAL: Duration = Duration::from_secs(15);

impl Soak {
    async fn start(options: &Options) -> Result<Self> {
        let mut rng = Rng::new(options.seed);
        let (stop_work, stop_servers) = (CancellationToken::new(), CancellationToken::new());
        let (mut lines, mut servers) = (Vec::new(), Vec::new());
        for number in 0..options.links {
            let (line, server) = Line::new(number, options).await?;
            lines.push(Arc::new(line));
            servers.push(tokio::spawn(server.serve(rng.fork(number as u64), stop_servers.clone())));
        }
        let mut work = JoinSet::new();
        for line in &lines {
            for number in 0..options.callers {
                let (lines, rng) = (vec![line.clone()], rng.fork(number as u64));
                let caller = Caller { lines, access: Access::Link, number, pause: options.pause, rng };
                work.spawn(caller.run(stop_work.clone()));
            }
            let (line, stop) = (line.clone(), stop_work.clone());
            // Spread over the lines, and several in a short run.
            let interval = AUDIT_INTERVAL.min(options.run_for / 3) + rng.millis(0, 1_000);
            work.spawn(async move { audit::run(&line, interval, stop).await });
        }
        let tcp: Vec<_> = lines.iter().filter(|line| line.transport == Transport::Tcp).cloned().collect();
        for guest in 0..options.guests {
            let (number, mut rng) = (options.callers + guest, rng.fork(guest as u64));
            let access = Access::pool(rng.next_u64());
            let caller = Caller { lines: tcp.clone(), access, number, pause: options.pause, rng };
            work.spawn(caller.run(stop_work.clone()));
        }
        work.spawn(polling::run(lines.clone(), rng.fork(0), stop_work.clone()));
        Ok(Self { report: Report::new(&lines), lines, work, servers, stop_work, stop_servers })
    }

    /// Watches the test until its end, or until there are enough findings. Returns the resource
    /// usage per second.
    async fn watch(&mut self, options: &Options) -> Vec<Usage> {
        let mut samples = Vec::new();
        let mut seconds = interval(Duration::from_secs(1));
        seconds.tick().await;
        let began = Instant::now();
        let mut reported = began;
        let mut progress = vec![(0, began); self.lines.len()];
        while began.elapsed() < options.run_for {
            tokio::select! {
                _ = seconds.tick() => {}
                // A task that ends early has failed; `finish` returns its error.
                Some(ended) = self.work.join_next() => {
                    self.work.spawn(async move { ended? });
                    break;
                }
            }
            let used = Usage::now();
            samples.push(used);
            for (line, (replies, since)) in self.lines.iter().zip(&mut progress) {
                let now = line.link.stats().stations.replies;
                if now != *replies {
                    (*replies, *since) = (now, Instant::now());
                } else if since.elapsed() > HANG {
                    line.wrong(0, &format!("no reply for {HANG:?}: {:?}", line.link.stats()));
                    *since = Instant::now();
                }
            }
            if self.report.findings() >= MAX_FINDINGS {
                break;
            }
            if reported.elapsed() >= options.report {
                self.report.show(used);
                reported = Instant::now();
            }
        }
        samples
    }

    /// Ends the test. Returns whether it has passed.
    async fn finish(&mut self, options: &Options, samples: &[Usage]) -> Result<bool> {
        self.report.show(Usage::now());
        if self.report.findings() >= MAX_FINDINGS {
            // After these errors the tasks may hang.
            self.work.shutdown().await;
            self.report.summary(0, &[]);
            return Ok(false);
        }
        self.stop_work.cancel();
        while let Some(ended) = self.work.join_next().await {
            ended??;
        }
        for audited in join_all(self.lines.iter().map(|line| audit::audit(line))).await {
            audited?;
        }
        for line in &self.lines {
            if timeout(HANG, line.link.close()).await.is_err() {
                line.wrong(0, "the link cannot be closed");
            }
        }
        self.stop_servers.cancel();
        let mut interruptions = 0;
        for server in self.servers.drain(..) {
            interruptions += server.await??;
        }
        let mut growth = health::growth(samples);
        if options.run_for < health::MIN_RUN {
            println!("run too short for a check of growth");
            growth.clear();
        }
        let findings = self.report.findings();
        self.report.summary(interruptions, &growth);
        // Every line must have had at least one good call and one good sample.
        let idle =
            self.lines.iter().any(|line| load(&line.counters.confirmed) == 0 || load(&line.counters.samples) == 0);
        if idle {
            println!("a line had no good call or no good sample");
        }
        Ok(findings == 0 && !idle && !growth.iter().any(|growth| growth.is_too_much()))
    }
}

/// Number of tasks and of open files that were not there at the start.
async fn leaked(before: Usage) -> Usage {
    let mut leaked = Usage::default();
    // Closed connections need a moment to end.
    for _ in 0..500 {
        let now = Usage::now();
        leaked = Usage {
            files: now.files.saturating_sub(before.files),
            tasks: now.tasks.saturating_sub(before.tasks),
            ..Usage::default()
        };
        if (leaked.tasks, leaked.files) == (0, 0) {
            break;
        }
        sleep(Duration::from_millis(20)).await;
    }
    leaked
}
