//! Polls thousands of simulated PLCs in a second process, and prints the time and memory used.
//!
//! ```text
//! cargo run --release --example poll_many --features sim -- --plcs 10000 --interval 1s --for 60s
//! cargo run --release --example poll_many --features sim -- --plcs 1000 --for 60s --restart-at 10s
//! ```
//!
//! Each PLC holds its own number, so a reply from the wrong PLC is detected. The exit status is 1
//! after any error, except for failed calls while the simulator is down.
//!
//! - [`poller`]: the poller and its consumer, the part that an application would have;
//! - [`simulator`]: the second process, and [`plc`]: contents and addresses of its PLCs;
//! - [`idle`]: memory of links before the poll begins;
//! - [`counters`]: events, [`process`]: resources of a process, [`summary`]: the output.

mod counters;
mod idle;
mod options;
mod plc;
mod poller;
mod process;
mod simulator;
mod summary;

use std::error::Error;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use fatek::Pool;
use tokio::runtime::Handle;
use tokio::time::{Instant, interval, sleep, sleep_until};

use self::counters::Counters;
use self::options::Options;
use self::simulator::Simulator;
use self::summary::Summary;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

#[tokio::main]
async fn main() -> ExitCode {
    if std::env::args().nth(1).as_deref() == Some(simulator::FLAG) {
        return exit_code(simulator::run().await.map(|()| true));
    }
    match Options::parse(std::env::args().skip(1)) {
        Ok(Some(options)) => exit_code(run(options).await),
        Ok(None) => {
            print!("{}", options::HELP);
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("{error}\n\n{}", options::HELP);
            ExitCode::from(2)
        }
    }
}

fn exit_code(result: Result<bool>) -> ExitCode {
    match result {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("poll_many: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Polls and prints the results. Returns whether there were no errors.
async fn run(options: Options) -> Result<bool> {
    // One connection per PLC, and the other files of the program.
    process::allow_open_files(options.plcs as u64 + 100)?;
    let mut simulator = Simulator::start(&options).await?;
    let endpoints = simulator.endpoints();
    println!("{options}");
    println!("poller: process {}, PLCs: process {}", std::process::id(), simulator.process());

    let (memory_before, files_before) = (process::memory(), process::open_files());
    let backoff = options.backoff;
    let pool = Pool::builder()
        .max_endpoints(options.plcs as usize)
        .connects_per_second(options.connects_per_second)
        .idle_timeout(None)
        .links(move |link| link.connect_backoff(backoff.0, backoff.1))
        .build();
    let idle = idle::measure(&pool, simulator.endpoints(), &options, memory_before).await?;
    let counters = Arc::new(Counters::new(options.plcs));
    let polling = poller::start(&pool, endpoints, &options, &counters)?;
    let mut summary =
        Summary::new(&options, pool.clone(), polling.handle(), counters.clone(), memory_before, simulator.process());

    summary.set_idle(idle);

    // The measurement begins when all links are connected.
    let limit = options.start_timeout();
    let up = show_until(&mut summary, Instant::now() + limit, || counters.all_answered()).await;
    if !up {
        return Err(format!("not all PLCs answered within {limit:?}").into());
    }
    summary.begin();
    let (began, ends_at) = (Instant::now(), Instant::now() + options.run_for);
    if let Some(at) = options.restart_at {
        show_until(&mut summary, began + at, || false).await;
        let recovery = restart(&mut simulator, &mut summary, &counters, &options).await?;
        summary.set_recovery(recovery);
    }
    show_until(&mut summary, ends_at, || false).await;
    summary.end();

    polling.stop().await?;
    let all_up = counters.all_answered();
    pool.close().await;
    drop(pool);
    let (tasks, files) = leaked(files_before).await;
    summary.set_leaked(tasks, files);
    summary.print();
    Ok(counters.errors() == 0 && all_up && (tasks, files) == (0, 0))
}

/// Prints a line per second until `until` or until `done`. Returns whether it is done.
async fn show_until(summary: &mut Summary, until: Instant, done: impl Fn() -> bool) -> bool {
    let mut ticks = interval(Duration::from_secs(1));
    ticks.tick().await;
    loop {
        if done() {
            return true;
        }
        tokio::select! {
            _ = ticks.tick() => summary.show(),
            () = sleep_until(until) => return done(),
        }
    }
}

/// Kills all PLCs and starts them again. Returns the time until all have answered, or `None` after
/// a timeout.
async fn restart(
    simulator: &mut Simulator,
    summary: &mut Summary,
    counters: &Counters,
    options: &Options,
) -> Result<Option<Duration>> {
    summary.note("simulator killed");
    counters.set_down(true);
    simulator.kill()?;
    show_until(summary, Instant::now() + options.down_for, || false).await;
    simulator.restart(options).await?;
    summary.set_simulator(simulator.process());
    summary.note("simulator restarted");
    counters.forget_answers();
    let began = Instant::now();
    let limit = options.start_timeout();
    while !counters.all_answered() && began.elapsed() < limit {
        let next_line = Instant::now() + Duration::from_secs(1);
        let mut ticks = interval(Duration::from_millis(10));
        while !counters.all_answered() && Instant::now() < next_line {
            ticks.tick().await;
        }
        summary.show();
    }
    let recovery = counters.all_answered().then(|| began.elapsed());
    counters.set_down(false);
    Ok(recovery)
}

/// Number of tasks and of open files that were not there at the start.
async fn leaked(files_before: Option<usize>) -> (usize, usize) {
    let now = || {
        let files = process::open_files().zip(files_before).map_or(0, |(now, before)| now.saturating_sub(before));
        (Handle::current().metrics().num_alive_tasks(), files)
    };
    // Aborted tasks need a moment to end.
    for _ in 0..100 {
        if now() == (0, 0) {
            break;
        }
        sleep(Duration::from_millis(20)).await;
    }
    now()
}
