//! A soak: links to simulated PLCs over real sockets and pseudo-terminals, for half an hour and with faults of every kind.
//!
//! ```text
//! cargo run --release --example soak --features sim
//! cargo run --release --example soak --features sim -- --for 10m --seed 7 --links 12
//! ```
//!
//! It ends with status 1 after
//! - a value that this PLC could not hold at that time: every value names its place and its version ([`layout`]), and
//!   [`shadow`] knows which version may be where;
//! - a write that was confirmed and is not there, or one that was executed more often than called for: from time to time the
//!   memory and the journal of the PLCs are looked at themselves ([`audit`]);
//! - a call past its deadline, or a line without a reply, by more than a minute or so. There are no other limits on time, so that
//!   it can run beside other work;
//! - memory, open files or tasks that grow ([`health`]), or are left when all is closed.
//!
//! The faults are those of the simulator ([`line`]); besides the ports go away and come back ([`ends`]). All of them depend on
//! the seed, but what happens meanwhile does not: time is real, and so is the order in which things happen. For runs that
//! can be repeated exactly there is `tests/simulation.rs`.
//!
//! The callers are in [`caller`], what they ask in [`calls`], the poller beside them in [`polling`].

mod audit;
mod caller;
mod calls;
mod dice;
mod ends;
mod health;
mod layout;
mod line;
mod options;
mod polling;
#[path = "../poll_many/process.rs"]
#[allow(dead_code, reason = "this example needs few open files")]
mod process;
mod report;
mod shadow;
mod tally;

use std::error::Error;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use futures::future::join_all;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{Instant, interval, sleep, timeout};
use tokio_util::sync::CancellationToken;

use self::audit::HANG;
use self::caller::{Caller, Way};
use self::dice::Dice;
use self::health::Use;
use self::line::{Line, Over};
use self::options::Options;
use self::report::Report;
use self::tally::{MAX_FINDINGS, load};

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

#[tokio::main(worker_threads = 2)]
async fn main() -> ExitCode {
    let options = match Options::parse(std::env::args().skip(1)) {
        Ok(Some(options)) => options,
        Ok(None) => {
            print!("{}", options::HELP);
            return ExitCode::SUCCESS;
        }
        Err(wrong) => {
            eprintln!("{wrong}\n\n{}", options::HELP);
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

/// Says whether all is well.
async fn run(options: &Options) -> Result<bool> {
    let before = Use::now();
    println!("{options}");
    let mut soak = Soak::begin(options).await?;
    let uses = soak.watch(options).await;
    let well = soak.end(options, &uses).await?;
    drop(soak);
    if !well {
        return Ok(false);
    }
    let left = left(before).await;
    println!("left when all is closed: {} tasks, {} open files", left.tasks, left.files);
    Ok((left.tasks, left.files) == (0, 0))
}

/// All that is under way.
struct Soak {
    lines: Vec<Arc<Line>>,
    report: Report,
    /// Callers, audits and the poller.
    work: JoinSet<Result<()>>,
    ends: Vec<JoinHandle<Result<u64>>>,
    stop_work: CancellationToken,
    stop_ends: CancellationToken,
}

/// How long it is from one audit of a line to the next.
const BETWEEN_AUDITS: Duration = Duration::from_secs(15);

impl Soak {
    async fn begin(options: &Options) -> Result<Self> {
        let mut dice = Dice::new(options.seed);
        let (stop_work, stop_ends) = (CancellationToken::new(), CancellationToken::new());
        let (mut lines, mut ends) = (Vec::new(), Vec::new());
        for number in 0..options.links {
            let (line, end) = Line::new(number, options).await?;
            lines.push(Arc::new(line));
            ends.push(tokio::spawn(end.serve(dice.fork(number as u64), stop_ends.clone())));
        }
        let mut work = JoinSet::new();
        for line in &lines {
            for number in 0..options.callers {
                let (lines, dice) = (vec![line.clone()], dice.fork(number as u64));
                let caller = Caller { lines, way: Way::Link, number, pause: options.pause, dice };
                work.spawn(caller.run(stop_work.clone()));
            }
            let (line, stop) = (line.clone(), stop_work.clone());
            // Not all at the same time, and in short runs, too.
            let every = BETWEEN_AUDITS.min(options.run_for / 3) + dice.millis(0, 1_000);
            work.spawn(async move { audit::run(&line, every, stop).await });
        }
        let tcp: Vec<_> = lines.iter().filter(|line| line.over == Over::Tcp).cloned().collect();
        for guest in 0..options.guests {
            let (number, mut dice) = (options.callers + guest, dice.fork(guest as u64));
            let way = Way::pool(dice.roll());
            let caller = Caller { lines: tcp.clone(), way, number, pause: options.pause, dice };
            work.spawn(caller.run(stop_work.clone()));
        }
        work.spawn(polling::run(lines.clone(), dice.fork(0), stop_work.clone()));
        Ok(Self { report: Report::new(&lines), lines, work, ends, stop_work, stop_ends })
    }

    /// Looks on until the time is over, or there is nothing more to be learned; gives what was used, second by second.
    async fn watch(&mut self, options: &Options) -> Vec<Use> {
        let mut uses = Vec::new();
        let mut seconds = interval(Duration::from_secs(1));
        seconds.tick().await;
        let began = Instant::now();
        let mut reported = began;
        let mut progress = vec![(0, began); self.lines.len()];
        while began.elapsed() < options.run_for {
            tokio::select! {
                _ = seconds.tick() => {}
                // Before the end it is a failure of some kind, which `end` meets again.
                Some(ended) = self.work.join_next() => {
                    self.work.spawn(async move { ended? });
                    break;
                }
            }
            let used = Use::now();
            uses.push(used);
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
        uses
    }

    /// Ends it all and says whether all was well.
    async fn end(&mut self, options: &Options, uses: &[Use]) -> Result<bool> {
        self.report.show(Use::now());
        if self.report.findings() >= MAX_FINDINGS {
            // Whatever it is, it need not end by itself.
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
                line.wrong(0, "its link cannot be closed");
            }
        }
        self.stop_ends.cancel();
        let mut interruptions = 0;
        for end in self.ends.drain(..) {
            interruptions += end.await??;
        }
        let mut growth = health::growth(uses);
        if options.run_for < health::SHORTEST {
            println!("too short to say whether anything grows");
            growth.clear();
        }
        let findings = self.report.findings();
        self.report.summary(interruptions, &growth);
        // All callers are answered now and then, and no call breaks a rule.
        let idle = self.lines.iter().any(|line| load(&line.tally.confirmed) == 0 || load(&line.tally.samples) == 0);
        if idle {
            println!("some line has had no good call or no good sample at all");
        }
        Ok(findings == 0 && !idle && !growth.iter().any(|growth| growth.is_too_much()))
    }
}

/// How many tasks and open files there are that were not there before.
async fn left(before: Use) -> Use {
    let mut left = Use::default();
    // Connections that were closed take a moment to end.
    for _ in 0..500 {
        let now = Use::now();
        left = Use {
            files: now.files.saturating_sub(before.files),
            tasks: now.tasks.saturating_sub(before.tasks),
            ..Use::default()
        };
        if (left.tasks, left.files) == (0, 0) {
            break;
        }
        sleep(Duration::from_millis(20)).await;
    }
    left
}
