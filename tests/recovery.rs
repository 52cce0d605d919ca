//! Many PLCs fail and come back under load. All must be back in time, connecting must keep to the
//! pool's limits, and a closed pool must leave nothing behind.
//!
//! "In time" is the longer of two times, plus one poll interval: the back-off cap, and the number
//! of links divided by the connection rate. The two do not add up, because earlier attempts keep
//! the same rate.
#![cfg(feature = "sim")]
#![allow(clippy::print_stdout, reason = "prints its figures")]

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

/// Defaults of links and pools.
const BACKOFF_CAP: Duration = Duration::from_secs(30);
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
const CONNECTS_AT_ONCE: usize = 128;
const CONNECTS_PER_SECOND: u32 = 200;

/// Time for a PLC to accept or refuse a connection.
const CONNECT_TIME: Duration = Duration::from_millis(20);

/// Poll interval of each PLC.
const INTERVAL: Duration = Duration::from_secs(2);

/// Callers that poll all PLCs, and the times of the answers.
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

    /// Number of PLCs without an answer since then.
    fn missing(&self, since: Instant) -> usize {
        self.answered.lock().unwrap().iter().filter(|answers| answers.last().is_none_or(|&at| at <= since)).count()
    }

    /// Time from `since` to the first answer of a PLC; `None`: no answer yet.
    fn recovery_time(&self, n: usize, since: Instant) -> Option<Duration> {
        let first = self.answered.lock().unwrap()[n].iter().find(|&&at| at > since).copied();
        first.map(|at| at.duration_since(since))
    }

    /// Waits until all PLCs have answered since then, for at most `within`. Returns the time that
    /// it took.
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

/// Polls a PLC forever. A call that exceeds the interval skips polls.
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

/// Asserts that connection attempts between two moments kept to the pool's rate; returns their
/// number.
fn assert_connect_rate(attempts: &[Instant], (from, to): (Instant, Instant), per_second: u32) -> usize {
    let within = attempts.iter().filter(|&&at| from <= at && at < to).count();
    // Attempts have a jitter of up to half an interval, so one of the time before may be among
    // them.
    let most = to.duration_since(from).as_secs_f64() * f64::from(per_second) + 2.0;
    assert!(within as f64 <= most, "{within} connections were begun, {most} are allowed");
    within
}

/// Closes the pool, and asserts that no connection and no task is left.
async fn assert_nothing_is_left(plant: &Plant, pool: Pool) {
    pool.close().await;
    drop(pool);
    // The tasks report their end just before they end.
    sleep(Duration::from_millis(1)).await;
    assert_eq!((plant.open(), Handle::current().metrics().num_alive_tasks()), (0, 0));
}

#[tokio::test(start_paused = true)]
async fn a_thousand_restarted_plcs_are_back_within_the_backoff_cap() {
    const PLCS: usize = 1000;
    for (dead, for_seconds) in [
        (Mode::Refuses, 1),
        (Mode::Refuses, 10),
        (Mode::Refuses, 120),
        (Mode::PoweredOff, 10),
        (Mode::PoweredOff, 120),
        (Mode::Silent, 10),
        (Mode::Silent, 120),
    ] {
        let plant = Plant::new(PLCS, Framing::Ascii, CONNECT_TIME);
        let pool = plant.pool().build();
        let load = Load::new(&plant, &pool, PLCS, CallOptions::new());
        let up = load.all_answer(Instant::now(), Duration::from_secs(6)).await;
        assert!(
            up >= Duration::from_secs_f64((PLCS - 1) as f64 / f64::from(CONNECTS_PER_SECOND)),
            "{up:?} is too fast"
        );
        assert_eq!(plant.open(), PLCS);

        let killed_at = Instant::now();
        (0..PLCS).for_each(|n| plant.kill(n, dead));
        sleep(Duration::from_secs(for_seconds)).await;
        if dead != Mode::Silent {
            assert_eq!(plant.open(), 0, "lost connections are dropped");
        }
        let attempts = assert_connect_rate(&plant.attempts(), (killed_at, Instant::now()), CONNECTS_PER_SECOND);

        let restarted_at = Instant::now();
        (0..PLCS).for_each(|n| plant.kill(n, Mode::Answers));
        // An earlier attempt may still have to time out.
        let in_flight = if dead == Mode::PoweredOff { CONNECT_TIMEOUT } else { Duration::ZERO };
        let back = load.all_answer(restarted_at, BACKOFF_CAP + in_flight + INTERVAL).await;
        println!("{dead:?} for {for_seconds} s: {attempts} attempts meanwhile, all back after {back:.1?}");
        assert_connect_rate(&plant.attempts(), (restarted_at, Instant::now()), CONNECTS_PER_SECOND);
        assert!(plant.most_opening() <= CONNECTS_AT_ONCE, "{}", plant.most_opening());
        assert_eq!((plant.open(), pool.stats().up), (PLCS, PLCS));

        load.stop().await;
        assert_nothing_is_left(&plant, pool).await;
    }
}

/// Runs `FATEK_SEEDS` seeds. A seed decides which PLCs fail, when, and how.
#[tokio::test(start_paused = true)]
async fn plcs_killed_at_random_are_back_within_the_backoff_cap() {
    const PLCS: usize = 60;
    // The same ratio of links and rate as a thousand links with the default rate.
    const CONNECT_RATE: u32 = 12;
    const CONNECTS_AT_ONCE: usize = 8;
    let seeds = std::env::var("FATEK_SEEDS").ok().and_then(|seeds| seeds.parse().ok()).unwrap_or(20);
    let mut slowest = Duration::ZERO;
    for seed in 1..=seeds {
        let mut rng = Rng(seed);
        let plant = Plant::new(PLCS, Framing::Ascii, CONNECT_TIME);
        let pool = plant.pool().connects_per_second(CONNECT_RATE).connects_at_once(CONNECTS_AT_ONCE).seed(seed).build();
        let load = Load::new(&plant, &pool, PLCS, CallOptions::new());
        load.all_answer(Instant::now(), Duration::from_secs(6)).await;
        let began = Instant::now();

        // About half of the PLCs fail, each for one period, in several ways one after the other.
        let mut events = Vec::new();
        let mut restarted_at = vec![began; PLCS];
        for n in (0..PLCS).filter(|_| rng.index(2) == 0).collect::<Vec<_>>() {
            let mut at = Duration::from_millis(rng.index(60_000) as u64);
            for _ in 0..=rng.index(3) {
                events.push((at, n, rng.pick(&[Mode::Refuses, Mode::Refuses, Mode::Silent, Mode::PoweredOff])));
                at += Duration::from_millis(rng.index(60_000) as u64);
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
            let back = load.recovery_time(n, restarted_at).unwrap_or(Duration::MAX);
            assert!(back <= within, "seed {seed}: PLC {n} is back after {back:.1?}");
            slowest = slowest.max(back);
        }
        assert_connect_rate(&plant.attempts(), (began, Instant::now()), CONNECT_RATE);
        assert!(plant.most_opening() <= CONNECTS_AT_ONCE, "seed {seed}: {}", plant.most_opening());
        assert_eq!((plant.open(), pool.stats().up), (PLCS, PLCS), "seed {seed}");
        load.stop().await;
        assert_nothing_is_left(&plant, pool).await;
    }
    println!("{seeds} seeds: the slowest of all was back after {slowest:.1?}");
}

#[tokio::test(start_paused = true)]
async fn unused_connect_slots_do_not_delay_other_links() {
    const PLCS: usize = 1000;
    let plant = Plant::new(PLCS, Framing::Ascii, CONNECT_TIME);
    let pool = plant.pool().build();
    // Nine calls of ten have ended when their connection slot comes.
    let short_deadline = CallOptions::new().with_call_timeout(INTERVAL / 10);
    let load = Load::new(&plant, &pool, PLCS, short_deadline);
    let up = load.all_answer(Instant::now(), Duration::from_secs(60)).await;
    println!("one call in ten waits long enough: all up after {up:.1?}");
    assert!(up < Duration::from_secs(8), "five seconds' worth of turns took {up:?}");
    assert_eq!(plant.attempts().len(), PLCS);
    load.stop().await;
    assert_nothing_is_left(&plant, pool).await;
}

#[tokio::test(start_paused = true)]
async fn a_restarted_plc_is_polled_before_its_probe_is_due() {
    let plant = Plant::new(1, Framing::Ascii, CONNECT_TIME);
    let pool = plant.pool().build();
    let load = Load::new(&plant, &pool, 1, CallOptions::new());
    load.all_answer(Instant::now(), Duration::from_secs(1)).await;
    plant.set(0, Mode::Silent);
    sleep(Duration::from_secs(300)).await;
    // By now probes are a minute apart.
    plant.kill(0, Mode::Answers);
    // The silent connections before were replaced again and again, with pauses of at most this.
    let pause = fatek::link::defaults::MUTE_TIMEOUT;
    let back = load.all_answer(Instant::now(), INTERVAL + CONNECT_TIME + pause).await;
    println!("back after {back:.1?}");
    load.stop().await;
    assert_nothing_is_left(&plant, pool).await;
}
