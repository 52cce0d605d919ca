//! Many PLCs that go away and come back under load: all are back in time, connecting keeps to the pool's limits meanwhile,
//! and nothing is left once the pool is closed.
//!
//! What "in time" is: a link tries again at the latest one back-off cap after an attempt that failed, but only at its turn,
//! and so many turns as there are links take their time. While the turns before were taken at the same pace, the two do not
//! add up; so all are back within the longer one of them.
#![cfg(feature = "sim")]
#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

mod common;
mod plant;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use fatek::wire::Framing;
use fatek::{CallOptions, Pool, Station, register};
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, sleep_until};

use self::common::Rng;
use self::plant::{Mode, Plant};

/// The defaults of links and pools.
const BACKOFF_CAP: Duration = Duration::from_secs(30);
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
const AT_ONCE: usize = 128;
const PER_SECOND: u32 = 200;

/// How long a PLC takes to accept or to refuse a connection.
const TAKES: Duration = Duration::from_millis(20);

/// How often each PLC is polled.
const INTERVAL: Duration = Duration::from_secs(2);

/// Callers that poll PLCs without end, and when each of these has answered.
struct Load {
    tasks: JoinSet<()>,
    answered: Arc<Mutex<Vec<Vec<Instant>>>>,
}

impl Load {
    fn new(plant: &Plant, pool: &Pool, plcs: usize, options: CallOptions) -> Self {
        let answered = Arc::new(Mutex::new(vec![Vec::new(); plcs]));
        let mut tasks = JoinSet::new();
        for n in 0..plcs {
            let station = pool.station(plant.endpoint(n), 1).unwrap().with_options(options);
            tasks.spawn(poll(station, n, INTERVAL.mul_f64(n as f64 / plcs as f64), answered.clone()));
        }
        Self { tasks, answered }
    }

    /// How many PLCs have not answered since then.
    fn missing(&self, since: Instant) -> usize {
        self.answered.lock().unwrap().iter().filter(|answers| answers.last().is_none_or(|&at| at <= since)).count()
    }

    /// How long after that moment a PLC has answered first; `None`: it has not.
    fn back(&self, n: usize, since: Instant) -> Option<Duration> {
        let first = self.answered.lock().unwrap()[n].iter().find(|&&at| at > since).copied();
        first.map(|at| at.duration_since(since))
    }

    /// Waits until all PLCs have answered since then, and says when that was; not longer than this.
    async fn all_answer(&self, since: Instant, within: Duration) -> Duration {
        while self.missing(since) > 0 {
            assert!(since.elapsed() < within, "after {within:?}, {} PLCs have not answered", self.missing(since));
            sleep(Duration::from_millis(5)).await;
        }
        since.elapsed()
    }

    async fn stop(mut self) {
        self.tasks.shutdown().await;
    }
}

/// Never ends. A call that takes longer than the interval is followed by the next one at its next time.
async fn poll(station: Station, n: usize, phase: Duration, answered: Arc<Mutex<Vec<Vec<Instant>>>>) {
    let mut due = Instant::now() + phase;
    loop {
        sleep_until(due).await;
        if let Ok(values) = station.read_registers(register!("R0"), 1).await {
            assert_eq!(values, [n as u16], "a reply of another PLC");
            answered.lock().unwrap()[n].push(Instant::now());
        }
        while due <= Instant::now() {
            due += INTERVAL;
        }
    }
}

/// No more connections were begun between two moments than the pool's limits allow.
fn assert_pace(attempts: &[Instant], (from, to): (Instant, Instant), per_second: u32) -> usize {
    let within = attempts.iter().filter(|&&at| from <= at && at < to).count();
    // Up to half of an interval later at random, so that one of the time before can be among them.
    let most = to.duration_since(from).as_secs_f64() * f64::from(per_second) + 2.0;
    assert!(within as f64 <= most, "{within} connections were begun, {most} are allowed");
    within
}

/// Nothing is left of a pool that was closed: no connection and no task.
async fn assert_nothing_is_left(plant: &Plant, pool: Pool) {
    pool.close().await;
    drop(pool);
    // The tasks have said that they have ended, and then they do.
    sleep(Duration::from_millis(1)).await;
    assert_eq!((plant.open(), Handle::current().metrics().num_alive_tasks()), (0, 0));
}

#[tokio::test(start_paused = true)]
async fn a_thousand_plcs_killed_and_restarted_under_load_are_back_within_one_backoff_cap() {
    const PLCS: usize = 1000;
    for (dead, for_seconds) in [
        (Mode::Refuses, 1),
        (Mode::Refuses, 10),
        (Mode::Refuses, 120),
        (Mode::IsOff, 10),
        (Mode::IsOff, 120),
        (Mode::IsMute, 10),
        (Mode::IsMute, 120),
    ] {
        let plant = Plant::new(PLCS, Framing::Ascii, TAKES);
        let pool = plant.pool().build();
        let load = Load::new(&plant, &pool, PLCS, CallOptions::new());
        let up = load.all_answer(Instant::now(), Duration::from_secs(6)).await;
        assert!(up >= Duration::from_secs_f64((PLCS - 1) as f64 / f64::from(PER_SECOND)), "{up:?} is too fast");
        assert_eq!(plant.open(), PLCS);

        let killed_at = Instant::now();
        (0..PLCS).for_each(|n| plant.kill(n, dead));
        sleep(Duration::from_secs(for_seconds)).await;
        if dead != Mode::IsMute {
            assert_eq!(plant.open(), 0, "lost connections are dropped");
        }
        let attempts = assert_pace(&plant.attempts(), (killed_at, Instant::now()), PER_SECOND);

        let restarted_at = Instant::now();
        (0..PLCS).for_each(|n| plant.kill(n, Mode::Answers));
        // An attempt of before may still have to fail.
        let in_flight = if dead == Mode::IsOff { CONNECT_TIMEOUT } else { Duration::ZERO };
        let back = load.all_answer(restarted_at, BACKOFF_CAP + in_flight + INTERVAL).await;
        println!("{dead:?} for {for_seconds} s: {attempts} attempts meanwhile, all back after {back:.1?}");
        assert_pace(&plant.attempts(), (restarted_at, Instant::now()), PER_SECOND);
        assert!(plant.most_opening() <= AT_ONCE, "{}", plant.most_opening());
        assert_eq!((plant.open(), pool.stats().up), (PLCS, PLCS));

        load.stop().await;
        assert_nothing_is_left(&plant, pool).await;
    }
}

/// As often as `FATEK_SEEDS` says: what dies when, and how it is dead, is decided by the seed.
#[tokio::test(start_paused = true)]
async fn plcs_that_die_at_random_are_back_within_one_backoff_cap() {
    const PLCS: usize = 60;
    // As many links to a connection a second as there are when a thousand have the default.
    const PACE: u32 = 12;
    const AT_ONCE: usize = 8;
    let seeds = std::env::var("FATEK_SEEDS").ok().and_then(|seeds| seeds.parse().ok()).unwrap_or(20);
    let mut slowest = Duration::ZERO;
    for seed in 1..=seeds {
        let mut rng = Rng::new(seed);
        let plant = Plant::new(PLCS, Framing::Ascii, TAKES);
        let pool = plant.pool().connects_per_second(PACE).connects_at_once(AT_ONCE).seed(seed).build();
        let load = Load::new(&plant, &pool, PLCS, CallOptions::new());
        load.all_answer(Instant::now(), Duration::from_secs(6)).await;
        let began = Instant::now();

        // Some half of them, each dead from one moment to another, in one way after the other.
        let mut events = Vec::new();
        let mut restarted_at = vec![began; PLCS];
        for n in (0..PLCS).filter(|_| rng.below(2) == 0).collect::<Vec<_>>() {
            let mut at = Duration::from_millis(rng.below(60_000) as u64);
            for _ in 0..=rng.below(3) {
                events.push((at, n, rng.pick(&[Mode::Refuses, Mode::Refuses, Mode::IsMute, Mode::IsOff])));
                at += Duration::from_millis(rng.below(60_000) as u64);
            }
            events.push((at, n, Mode::Answers));
            restarted_at[n] = began + at;
        }
        events.sort_by_key(|&(at, n, _)| (at, n));
        for (at, n, mode) in events {
            sleep_until(began + at).await;
            plant.kill(n, mode);
        }

        let within = BACKOFF_CAP + CONNECT_TIMEOUT + INTERVAL;
        sleep(within).await;
        for (n, &restarted_at) in restarted_at.iter().enumerate() {
            let back = load.back(n, restarted_at).unwrap_or(Duration::MAX);
            assert!(back <= within, "seed {seed}: PLC {n} is back after {back:.1?}");
            slowest = slowest.max(back);
        }
        assert_pace(&plant.attempts(), (began, Instant::now()), PACE);
        assert!(plant.most_opening() <= AT_ONCE, "seed {seed}: {}", plant.most_opening());
        assert_eq!((plant.open(), pool.stats().up), (PLCS, PLCS), "seed {seed}");
        load.stop().await;
        assert_nothing_is_left(&plant, pool).await;
    }
    println!("{seeds} seeds: the slowest of all was back after {slowest:.1?}");
}

#[tokio::test(start_paused = true)]
async fn turns_that_come_when_nobody_waits_cost_the_others_nothing() {
    const PLCS: usize = 1000;
    let plant = Plant::new(PLCS, Framing::Ascii, TAKES);
    let pool = plant.pool().build();
    // Nine calls of ten have ended when the turn comes that they had asked for.
    let hasty = CallOptions::new().call_timeout(INTERVAL / 10);
    let load = Load::new(&plant, &pool, PLCS, hasty);
    let up = load.all_answer(Instant::now(), Duration::from_secs(60)).await;
    println!("one call in ten waits long enough: all up after {up:.1?}");
    assert!(up < Duration::from_secs(8), "five seconds' worth of turns took {up:?}");
    assert_eq!(plant.attempts().len(), PLCS);
    load.stop().await;
    assert_nothing_is_left(&plant, pool).await;
}

#[tokio::test(start_paused = true)]
async fn a_silent_plc_that_is_started_anew_is_asked_at_once_and_not_when_its_probe_is_due() {
    let plant = Plant::new(1, Framing::Ascii, TAKES);
    let pool = plant.pool().build();
    let load = Load::new(&plant, &pool, 1, CallOptions::new());
    load.all_answer(Instant::now(), Duration::from_secs(1)).await;
    plant.set(0, Mode::IsMute);
    sleep(Duration::from_secs(300)).await;
    // By now a minute passes between two probes.
    plant.kill(0, Mode::Answers);
    let back = load.all_answer(Instant::now(), INTERVAL + TAKES).await;
    println!("back after {back:.1?}");
    load.stop().await;
    assert_nothing_is_left(&plant, pool).await;
}
