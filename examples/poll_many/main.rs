//! Polls thousands of simulated PLCs, which run in a second process, and says what that costs.
//!
//! ```text
//! cargo run --release --example poll_many --features sim -- --plcs 10000 --interval 1s --for 60s
//! cargo run --release --example poll_many --features sim -- --plcs 1000 --for 60s --restart-at 10s
//! ```
//!
//! Each PLC holds its own number, so that a reply from the wrong one is an error. All errors count, but for calls that
//! fail while the simulator is away; the exit status is not 0 if there was one.
//!
//! - [`poller`] is the polling itself, the part that a program of yours would have;
//! - [`simulator`] is the second process, and [`plc`] what its PLCs hold and where they are;
//! - [`idle`] weighs the links before they are polled;
//! - [`tally`] counts, [`process`] asks the system what the process uses, [`summary`] prints both.

mod idle;
mod options;
mod plc;
mod poller;
mod process;
mod simulator;
mod summary;
mod tally;

use std::error::Error;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use fatek::Pool;
use tokio::runtime::Handle;
use tokio::time::{Instant, interval, sleep, sleep_until};

use self::options::Options;
use self::simulator::Simulator;
use self::summary::Summary;
use self::tally::Tally;

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
        Err(wrong) => {
            eprintln!("{wrong}\n\n{}", options::HELP);
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

/// Says whether all went well.
async fn run(options: Options) -> Result<bool> {
    // A connection each, and what the program has open besides.
    process::allow_open_files(options.plcs as u64 + 100)?;
    let mut simulator = Simulator::start(&options).await?;
    let endpoints = simulator.endpoints();
    println!("{options}");
    println!("process {} polls, process {} is the PLCs", std::process::id(), simulator.process());

    let (memory_before, files_before) = (process::memory(), process::open_files());
    let backoff = options.backoff;
    let pool = Pool::builder()
        .max_endpoints(options.plcs as usize)
        .connects_per_second(options.connects_per_second)
        .idle_timeout(None)
        .links(move |link| link.connect_backoff(backoff.0, backoff.1))
        .build();
    let idle = idle::measure(&pool, simulator.endpoints(), &options, memory_before).await?;
    let tally = Arc::new(Tally::new(options.plcs));
    let pollers = poller::start(&pool, endpoints, &options, &tally)?;
    let mut summary =
        Summary::new(&options, pool.clone(), pollers.handle(), tally.clone(), memory_before, simulator.process());

    summary.idle(idle);

    // All must be connected before anything is measured.
    let most = options.longest_start();
    let up = show_until(&mut summary, Instant::now() + most, || tally.all_answered()).await;
    if !up {
        return Err(format!("not all PLCs have answered within {most:?}").into());
    }
    summary.begin();
    let (began, ends_at) = (Instant::now(), Instant::now() + options.run_for);
    if let Some(at) = options.restart_at {
        show_until(&mut summary, began + at, || false).await;
        let back = restart(&mut simulator, &mut summary, &tally, &options).await?;
        summary.restarted(back);
    }
    show_until(&mut summary, ends_at, || false).await;
    summary.end();

    pollers.stop().await?;
    let all_back = tally.all_answered();
    pool.close().await;
    drop(pool);
    let (tasks, files) = left(files_before).await;
    summary.left(tasks, files);
    summary.print();
    Ok(tally.errors() == 0 && all_back && (tasks, files) == (0, 0))
}

/// Shows a line a second until then, or until it is done; says whether it is.
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

/// Kills all PLCs and starts them again; says how long it then takes until each has answered.
async fn restart(
    simulator: &mut Simulator,
    summary: &mut Summary,
    tally: &Tally,
    options: &Options,
) -> Result<Option<Duration>> {
    summary.note("the simulator is killed");
    tally.away(true);
    simulator.kill()?;
    show_until(summary, Instant::now() + options.down_for, || false).await;
    simulator.start_again(options).await?;
    summary.simulator_is(simulator.process());
    summary.note("the simulator is there again");
    tally.forget_answers();
    let began = Instant::now();
    let most = options.longest_start();
    while !tally.all_answered() && began.elapsed() < most {
        let soon = Instant::now() + Duration::from_secs(1);
        let mut ticks = interval(Duration::from_millis(10));
        while !tally.all_answered() && Instant::now() < soon {
            ticks.tick().await;
        }
        summary.show();
    }
    let back = tally.all_answered().then(|| began.elapsed());
    tally.away(false);
    Ok(back)
}

/// How many tasks and open files there are that were not there before.
async fn left(files_before: Option<usize>) -> (usize, usize) {
    let now = || {
        let files = process::open_files().zip(files_before).map_or(0, |(now, before)| now.saturating_sub(before));
        (Handle::current().metrics().num_alive_tasks(), files)
    };
    // Tasks are told to end, which takes them a moment.
    for _ in 0..100 {
        if now() == (0, 0) {
            break;
        }
        sleep(Duration::from_millis(20)).await;
    }
    now()
}
