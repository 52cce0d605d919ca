//! The campaign: every kind of user over lines with late, duplicate and lost replies, in paused
//! time.
//!
//! Each register holds its station and address, each write has its own value, and each kind of
//! refusal has its own error code. Some addresses and commands are always refused. So the campaign
//! detects a wrong value, a refused write reported as done, a refusal that belongs to another
//! request, and a write executed more or less often than reported.
//!
//! A short run is a test. The full one takes a few minutes. It sends at least this number of
//! requests, checks not counted:
//!
//! ```text
//! FATEK_CAMPAIGN=1000000 cargo test --release --all-features --test campaign -- --nocapture
//! ```
//!
//! `FATEK_SEED=n FATEK_CALLS=n` runs one seed, such as one that a failure has printed.
//! `FATEK_TRACE=1` prints its frames.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

mod faults;
mod jobs;
mod layout;
mod line;
#[path = "../common/rng.rs"]
mod rng;
mod sockets;
mod tally;
mod transfers;
mod users;
mod world;

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

use fatek::endpoint::InStepSettings;
use fatek::wire::Framing;

use self::faults::{FAULT_SETS, FaultKind};
use self::line::LineKind;
use self::rng::Rng;
use self::tally::Tally;
use self::users::Calls;
use self::world::World;

/// A user of links.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum User {
    Single,
    Many,
    Fresh,
    Idle,
    Pooled,
    ReadsAndWrites,
    OneShape,
    LongReads,
    LongWrites,
    Plans,
    Poller,
    Backup,
    Restore,
    ReadProgram,
    WriteProgram,
}

use User::*;

/// Run `n` has user `n` modulo 15, and fault set `n` modulo 17. The two have no common factor.
const USERS: [User; 15] = [
    Single,
    Many,
    LongReads,
    Fresh,
    LongWrites,
    Plans,
    ReadsAndWrites,
    Poller,
    Idle,
    Backup,
    Pooled,
    Restore,
    ReadProgram,
    WriteProgram,
    OneShape,
];

/// Users of jobs: results are held until they are proven, so they are right even with a roaming
/// duplicate.
const JOBS: &[User] = &[LongReads, LongWrites, Plans, Poller, Backup, Restore, ReadProgram, WriteProgram];

async fn calls(user: User, world: &World, rng: &mut Rng, calls: u64, tally: &mut Tally) {
    match user {
        Single => users::single(world, rng, calls, Calls::All, tally).await,
        ReadsAndWrites => users::single(world, rng, calls, Calls::ReadsAndWrites, tally).await,
        OneShape => users::single(world, rng, calls, Calls::OneShape, tally).await,
        Many => users::many(world, rng, calls, tally).await,
        Fresh => users::fresh(world, rng, calls, tally).await,
        Idle => users::idle(world, rng, calls, tally).await,
        Pooled => users::pooled(world, rng, calls, tally).await,
        LongReads => {
            let link = world.link();
            jobs::long_reads(world, &link, rng, calls, tally).await;
            tally.links(&link.stats());
            link.close().await;
        }
        LongWrites => {
            let link = world.link();
            jobs::long_writes(world, &link, rng, calls, tally).await;
            tally.links(&link.stats());
            link.close().await;
        }
        Plans => jobs::plans(world, rng, calls, tally).await,
        Poller => transfers::poll(world, rng, calls, tally).await,
        Backup => transfers::back_up(world, rng, calls, tally).await,
        Restore => transfers::restore(world, rng, calls, tally).await,
        ReadProgram => transfers::read_program(world, rng, calls, tally).await,
        WriteProgram => transfers::write_program(world, rng, calls, tally).await,
    }
}

/// Parameters of a run that do not follow from the seed.
#[derive(Clone, Copy)]
struct Scenario {
    user: User,
    faults: Option<&'static [FaultKind]>,
    line: Option<LineKind>,
    in_step: InStepSettings,
}

/// Runs one seed: a bus with faults, and a user.
fn run(seed: u64, scenario: Scenario, size: u64) -> Tally {
    let mut rng = Rng(seed);
    let Scenario { user, faults, line, in_step } = scenario;
    let framing = if rng.percent(50) { Framing::Ascii } else { Framing::Binary };
    // Only the ASCII framing has the program commands.
    let framing = if matches!(user, ReadProgram | WriteProgram) { Framing::Ascii } else { framing };
    let drawn = LineKind::draw(&mut rng);
    let faults = faults.map_or_else(|| faults::draw(seed, &mut rng), <[_]>::to_vec);
    // Serial ports do not close. A line that may echo needs two exchanges on each connection.
    let drawn = if faults.contains(&FaultKind::Closes) { LineKind::Network } else { drawn };
    let line = line.unwrap_or(drawn);
    let world = World::new(seed, framing, line, faults, in_step, &mut rng);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build().unwrap();
    let mut tally = Tally { runs: 1, ..Tally::default() };
    runtime.block_on(async {
        calls(user, &world, &mut rng, size, &mut tally).await;
        // All requests must have ended before the writes are counted.
        tokio::time::sleep(std::time::Duration::from_secs(10)).await;
    });
    world.audit(&mut tally);
    let setup = format!("seed {seed}, {user:?}, {framing}, {line:?}, {:?}", world.fault_kinds);
    tally.wrong.iter_mut().for_each(|wrong| *wrong = format!("{setup}: {wrong}"));
    if tally.late > 0 {
        println!("{setup}: {} calls ended too late", tally.late);
    }
    tally
}

fn setting(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name} is a number")))
}

/// The single seed to run. Its frames are printed if `FATEK_TRACE` is set.
fn one_seed() -> Option<u64> {
    let seed = setting("FATEK_SEED")?;
    if std::env::var_os("FATEK_TRACE").is_some() {
        let _ = tracing_subscriber::fmt().with_max_level(tracing_subscriber::filter::LevelFilter::TRACE).try_init();
    }
    Some(seed)
}

/// Runs the seeds from 0 on, in one thread per processor, while `goes_on`.
fn in_threads(
    goes_on: impl Fn(u64) -> bool + Sync,
    run: impl Fn(u64) -> Tally + Sync,
    each: impl Fn(u64, &Tally) + Sync,
) -> Tally {
    let (next, total) = (AtomicU64::new(0), Mutex::new(Tally::default()));
    thread::scope(|scope| {
        for _ in 0..thread::available_parallelism().map_or(2, usize::from) {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if !goes_on(seed) {
                        return;
                    }
                    let tally = run(seed);
                    each(seed, &tally);
                    total.lock().unwrap().add(tally);
                }
            });
        }
    });
    total.into_inner().unwrap()
}

#[test]
fn no_result_belongs_to_another_request() {
    let scenario = |seed: u64| Scenario {
        user: USERS[(seed % USERS.len() as u64) as usize],
        faults: None,
        line: None,
        in_step: InStepSettings::new(),
    };
    let wanted = setting("FATEK_CAMPAIGN");
    let size = setting("FATEK_CALLS").unwrap_or(if wanted.is_some() { 400 } else { 20 });
    if let Some(seed) = one_seed() {
        let tally = run(seed, scenario(seed), size);
        println!("{tally}\n{:#?}", tally.fault_counts);
        assert!(tally.is_sound(), "{:#?}", tally.wrong);
        return;
    }
    // Every user with every set of faults.
    let all = (USERS.len() * FAULT_SETS.len()) as u64;
    let requests = AtomicU64::new(0);
    let (by_user, by_faults) = (Mutex::new(BTreeMap::new()), Mutex::new(BTreeMap::new()));
    let goes_on = |seed| seed < all || requests.load(Ordering::Relaxed) < wanted.unwrap_or(0);
    let total = in_threads(
        goes_on,
        |seed| run(seed, scenario(seed), size),
        |seed, tally| {
            if !tally.is_sound() {
                println!("FATEK_SEED={seed} FATEK_CALLS={size}: {tally}, first {:?}", tally.wrong.first());
            }
            requests.fetch_add(tally.requests, Ordering::Relaxed);
            by_user.lock().unwrap().entry(scenario(seed).user).or_insert_with(Tally::default).add(tally.clone());
            let set = seed as usize % FAULT_SETS.len();
            by_faults.lock().unwrap().entry(set).or_insert_with(Tally::default).add(tally.clone());
        },
    );
    for (user, tally) in by_user.into_inner().unwrap() {
        println!("{user:?}: {tally}");
    }
    for (n, tally) in by_faults.into_inner().unwrap() {
        println!("{:?}: {tally}", FAULT_SETS[n]);
    }
    println!("{total}\n{:#?}", total.fault_counts);
    assert!(
        total.is_sound(),
        "{} wrong, {} late; the first: {:#?}",
        total.wrong.len(),
        total.late,
        total.wrong.first()
    );
    let never: Vec<_> = total.fault_counts.iter().filter(|&(_, &count)| count == 0).collect();
    assert!(never.is_empty(), "faults that were never injected: {never:?}");
    total.assert_right(85);
}

/// Runs these users over a network, with `size` calls or requests each.
fn run_over_network(
    users: &'static [User],
    faults: &'static [FaultKind],
    in_step: InStepSettings,
    runs: u64,
    size: u64,
    each: impl Fn(&Tally) + Sync,
) -> Tally {
    let scenario = |seed: u64| {
        let user = users[(seed % users.len() as u64) as usize];
        Scenario { user, faults: Some(faults), line: Some(LineKind::Network), in_step }
    };
    let total = match one_seed() {
        Some(seed) => run(seed, scenario(seed), size),
        None => in_threads(|seed| seed < runs, |seed| run(seed, scenario(seed), size), |_, tally| each(tally)),
    };
    println!("{users:?} with {faults:?} and {} copies: {total}", in_step.copies());
    total
}

fn roaming_runs() -> u64 {
    setting("FATEK_CAMPAIGN").map_or(24, |requests| (requests / 200).clamp(24, 3000))
}

/// Seeds of [`jobs_detect_a_roaming_duplicate`] that failed earlier.
///
/// The failures: a shift among equal pages was not detected; page 0 came from the transfer before;
/// and a write was executed twice, because the refusal of its first spelling belonged to another
/// request. Each of them fails again if its cure is taken out: the doubt of equal pages, the check at
/// the end of each transfer, the check before a refused write is sent again.
const FAILED_SEEDS: [u64; 4] = [582, 617, 686, 2334];

#[test]
fn jobs_detect_a_roaming_duplicate() {
    for seed in FAILED_SEEDS {
        let user = JOBS[(seed % JOBS.len() as u64) as usize];
        let (faults, line) = (Some(&[FaultKind::RoamingOnce][..]), Some(LineKind::Network));
        let tally = run(seed, Scenario { user, faults, line, in_step: InStepSettings::new() }, 80);
        assert!(tally.is_sound(), "{:#?}", tally.wrong);
    }
    let total = run_over_network(JOBS, &[FaultKind::RoamingOnce], InStepSettings::new(), roaming_runs(), 80, |_| ());
    assert!(total.is_sound(), "{:#?}", total.wrong);
    assert!(
        total.fault_counts.values().all(|&count| count > 0) && total.repeated_jobs > 0,
        "{total}: {:?}",
        total.fault_counts
    );
    total.assert_right(97);
}

#[test]
fn a_roaming_duplicate_gives_at_most_one_wrong_result() {
    const SINGLE: &[User] = &[Single, Many, ReadsAndWrites, OneShape];
    let at_most_one = |tally: &Tally| assert!(tally.wrong.len() <= 1 && tally.late == 0, "{:#?}", tally.wrong);
    let total =
        run_over_network(SINGLE, &[FaultKind::RoamingOnce], InStepSettings::new(), roaming_runs(), 80, at_most_one);
    assert!(total.fault_counts.values().all(|&count| count > 0), "{total}: {:?}", total.fault_counts);
    total.assert_right(97);
}

/// Proves that the campaign can fail, with a link that does not expect duplicates.
///
/// The code at 3728afb, before the link kept in step, was as wrong: 301653 wrong values of 1049115,
/// and 15095 of 364800 reads reported as refused, for calls of four tasks over TCP
/// (`tests/in_step`).
#[test]
fn without_protection_from_duplicates_the_same_runs_fail() {
    const SINGLE: &[User] = &[Many, ReadsAndWrites, OneShape];
    let no_copies = InStepSettings::new().with_copies(0).unwrap();
    let copies: &[FaultKind] = &[FaultKind::CopyWithNext];
    let total = run_over_network(SINGLE, copies, no_copies, 12, 200, |_| ());
    assert!(total.wrong.len() > 20, "{total}");
    let same = run_over_network(SINGLE, copies, InStepSettings::new(), 12, 200, |_| ());
    assert!(same.is_sound(), "{:#?}", same.wrong);
}
