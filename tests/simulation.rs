//! A simulated bus with seeded faults of every kind and many random callers, in paused time.
//!
//! Each register holds its own address, each write has its own value, and each kind of refusal has
//! its own error code. Some addresses and commands are always refused. So the test detects wrong
//! values, lost and repeated writes, and refusals that belong to another request. A short run is a
//! test; the long one is
//! ```text
//! FATEK_SEEDS=250 FATEK_REQUESTS=5000 cargo test --release --all-features --test simulation
//! ```
//!
//! `FATEK_SEED=n` runs one seed, such as one that a failure has printed.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use fatek::command::{ControlPlc, Request, WriteRegisters};
use fatek::sim::{self, Plc};
use fatek::wire::Framing;
use fatek::{
    CallOptions, Discrete, EchoMode, Element, Error, ErrorCode, Link, Register, Register32, Station, Symbol, Value,
};
use tokio::time::{Instant, sleep, timeout};

use self::faults::{
    INJECTED, LABELS, NO_MIXED, NO_RUN, REFUSED, RUN_REFUSED, UNKNOWN_COMMAND, UNREADABLE, UNWRITABLE, bus, faults,
    label,
};
use self::rng::Rng;

#[path = "simulation/faults.rs"]
mod faults;
mod naive;
#[path = "common/rng.rs"]
mod rng;

const STATIONS: u8 = 32;
/// Stations that are often late and get more requests than the others: a late reply is most likely
/// to do damage there.
const SLOW: std::ops::RangeInclusive<u8> = 1..=3;
/// A station with a longer response timeout.
const LONG_TIMEOUT_STATION: u8 = 9;
const LONG_TIMEOUT: Duration = Duration::from_millis(150);
/// Number of concurrent callers.
const CALLERS: u32 = 48;
/// Number of registers, and of discretes, that are only read.
const READ_ONLY: u16 = 240;
/// Allowance for calls that end after their deadline.
const GRACE: Duration = Duration::from_millis(10);

/// Results of a run.
#[derive(Debug, Default, PartialEq, Eq)]
struct Outcome {
    requests: u64,
    /// Calls with the right value or a right refusal.
    confirmed: u64,
    cancelled: u64,
    /// Number of calls by error.
    errors: BTreeMap<&'static str, u64>,
    /// Wrong values, refused requests reported as done, and refusals of other requests.
    wrong: Vec<String>,
    /// Writes executed more than once, and RUN or STOP executed more often than called or less
    /// often than confirmed.
    repeated: u64,
    /// RUN and STOP commands by station: number of calls, and number of confirmed calls.
    controls: BTreeMap<(u8, bool), (u64, u64)>,
    /// Broadcast writes that were sent: caller and value.
    broadcasts: Vec<(u32, u32)>,
    /// Number of stations that executed them.
    obeyed: u64,
    /// Calls that ended after their deadline.
    late: u64,
    /// Hash of all results, in order.
    digest: u64,
}

impl Outcome {
    fn hash(&mut self, value: u64) {
        self.digest = (self.digest.rotate_left(5) ^ value).wrapping_mul(0x0100_0000_01B3);
    }

    fn add(&mut self, other: Self) {
        self.requests += other.requests;
        self.confirmed += other.confirmed;
        self.cancelled += other.cancelled;
        other.errors.into_iter().for_each(|(error, count)| *self.errors.entry(error).or_default() += count);
        self.wrong.extend(other.wrong);
        self.repeated += other.repeated;
        self.late += other.late;
        self.broadcasts.extend(other.broadcasts);
        self.obeyed += other.obeyed;
        for (which, (called, confirmed)) in other.controls {
            let control = self.controls.entry(which).or_default();
            *control = (control.0 + called, control.1 + confirmed);
        }
        self.hash(other.digest);
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { requests, confirmed, cancelled, errors, wrong, repeated, obeyed, late, .. } = self;
        write!(f, "{requests} calls, {confirmed} with a result, {cancelled} cancelled, errors {errors:?}, ")?;
        write!(f, "{} broadcast writes obeyed by {obeyed} stations; ", self.broadcasts.len())?;
        write!(f, "{} wrong, {repeated} repeated, {late} late", wrong.len())
    }
}

/// Content of a read-only register: its station and address.
fn word(station: u8, address: u16) -> u16 {
    u16::from(station) << 8 | address
}

/// Content of a read-only discrete.
fn bit(station: u8, address: u16) -> bool {
    Rng(u64::from(station) << 16 | u64::from(address)).per_mille(500)
}

fn plc(station: u8) -> Plc {
    let plc = Plc::with_model(fatek::sim::Model::largest());
    for address in 0..READ_ONLY {
        plc.write(Register::r(address), word(station, address)).unwrap();
        plc.write(Discrete::new(Symbol::M, address).unwrap(), bit(station, address)).unwrap();
    }
    plc.refuse_run((station == NO_RUN).then_some(RUN_REFUSED));
    plc
}

/// Random options, and their deadline.
fn options(rng: &mut Rng) -> (CallOptions, Duration) {
    let deadline = Duration::from_millis(200 + rng.below(3000));
    let options = CallOptions::new().with_response_timeout(Duration::from_millis(60)).with_call_timeout(deadline);
    let options = options.with_retries(rng.below(4) as u32).with_background(rng.per_mille(300));
    let adaptive = rng.per_mille(200);
    (if adaptive { options.with_adaptive_timeout(Duration::from_millis(20)) } else { options }, deadline)
}

/// Makes calls one after the other, with pauses.
async fn caller(link: Link, number: u32, mut rng: Rng, calls: u32) -> Outcome {
    let mut outcome = Outcome::default();
    // Possible content of this caller's own register by station: the last write, and unconfirmed
    // ones since.
    let mut own: BTreeMap<u8, Vec<u32>> = BTreeMap::new();
    for nth in 0..calls {
        sleep(Duration::from_millis(rng.below(40))).await;
        let stations = if rng.per_mille(500) { *SLOW.end() } else { STATIONS };
        let station_number = 1 + rng.below(u64::from(stations)) as u8;
        let (options, deadline) = options(&mut rng);
        let options =
            if station_number == LONG_TIMEOUT_STATION { options.with_response_timeout(LONG_TIMEOUT) } else { options };
        let station = link.station(station_number).unwrap().with_options(options);
        let cancel_after = match rng.per_mille(100) {
            true => Duration::from_millis(rng.below(100)),
            false => Duration::from_secs(3600),
        };
        outcome.requests += 1;
        let began = Instant::now();
        let held = own.entry(station_number).or_insert_with(|| vec![0]);
        let serial = number << 20 | (nth + 1);
        let mut right = Vec::new();
        let call = call(&station, number, serial, held, &mut right, &mut outcome, &mut rng);
        let ended = timeout(cancel_after, call).await;
        if began.elapsed() > deadline + GRACE {
            outcome.late += 1;
        }
        match ended {
            Err(_) => outcome.cancelled += 1,
            Ok(Err(Error::Plc { station, code, error, .. })) if !right.contains(&error) => {
                outcome.wrong.push(format!("station {station}, {code} refused with {error}, right is {right:?}"));
            }
            Ok(Err(error)) => {
                outcome.confirmed += u64::from(matches!(error, Error::Plc { .. }));
                outcome.hash(u64::from(error.may_have_executed()));
                *outcome.errors.entry(error_kind(&error)).or_default() += 1;
            }
            Ok(Ok(Ok(digest))) => {
                outcome.hash(digest);
                outcome.confirmed += 1;
            }
            Ok(Ok(Err(wrong))) => outcome.wrong.push(wrong),
        }
    }
    outcome
}

/// Makes a random call and checks it. Returns a digest of the result, or what is wrong with it.
/// `right` gets the legal refusals.
async fn call(
    station: &Station,
    caller: u32,
    serial: u32,
    held: &mut Vec<u32>,
    right: &mut Vec<ErrorCode>,
    outcome: &mut Outcome,
    rng: &mut Rng,
) -> Result<Result<u64, String>, Error> {
    let number = station.number();
    // Mostly of one shape: replies of equal shape can be mistaken for each other.
    let count = if rng.per_mille(800) { 1 } else { 1 + rng.below(16) as u16 };
    let first = rng.below(u64::from(READ_ONLY - 2 * count)) as u16;
    let own = Register32::new(Symbol::DD, 2 * caller as u16).unwrap();
    let check = |what: &str, good: bool, got: &dyn std::fmt::Debug| match good {
        true => Ok(u64::from(number) << 32 | u64::from(first) << 8 | u64::from(count)),
        false => Err(format!("station {number}, {what} from {first}, {count} of them: {got:?}")),
    };
    let what = rng.below(14);
    match what {
        0..=4 | 7 | 13 => right.push(INJECTED),
        8 if number == NO_RUN => right.push(RUN_REFUSED),
        9 => right.push(UNKNOWN_COMMAND),
        11 | 12 => right.push(REFUSED),
        _ => {}
    }
    if number == NO_MIXED && matches!(what, 6 | 7) {
        right.push(UNKNOWN_COMMAND);
    }
    Ok(match what {
        0..=3 => {
            let values = station.read_registers(Register::r(first), count.into()).await?;
            check("R", values.iter().copied().eq((first..first + count).map(|a| word(number, a))), &values)
        }
        4 => {
            let values = station.read_registers32(Register32::new(Symbol::DR, first).unwrap(), count.into()).await?;
            let expected = (0..count)
                .map(|n| first + 2 * n)
                .map(|a| u32::from(word(number, a + 1)) << 16 | u32::from(word(number, a)));
            check("DR", values.iter().copied().eq(expected), &values)
        }
        5 => {
            let states = station.read_discretes(Discrete::new(Symbol::M, first).unwrap(), count.into()).await?;
            check("M", states.iter().copied().eq((first..first + count).map(|a| bit(number, a))), &states)
        }
        6 => {
            let elements = [Element::from(Register::r(first)), Discrete::new(Symbol::M, first).unwrap().into()];
            let values = station.read_mixed(&elements).await?;
            check("R and M", values == [Value::Word(word(number, first)), Value::Bit(bit(number, first))], &values)
        }
        7 => {
            // From now on the register may hold the value, even if the future is dropped.
            held.push(serial);
            let written = match rng.per_mille(500) {
                true => station.write_registers32(own, &[serial]).await,
                false => station.write_mixed(&[(own.into(), Value::DWord(serial))]).await,
            };
            match written {
                Ok(()) => {
                    held.clear();
                    held.push(serial);
                    Ok(u64::from(serial))
                }
                Err(error) => {
                    if !error.may_have_executed() {
                        held.retain(|&value| value != serial);
                    }
                    return Err(error);
                }
            }
        }
        8 => {
            let run = rng.per_mille(500);
            outcome.controls.entry((number, run)).or_default().0 += 1;
            if run { station.run().await } else { station.stop().await }?;
            outcome.controls.entry((number, run)).or_default().1 += 1;
            check("RUN", !(run && number == NO_RUN), &"done")
        }
        9 => {
            station.loop_back(format!("{serial:08X}")).await?;
            Ok(u64::from(serial))
        }
        10 => {
            // Broadcasts write registers of their own. There is no reply, so only repetitions can
            // be detected.
            let shared = Register32::new(Symbol::DF, 2 * caller as u16).unwrap();
            let all = station.link().broadcast().with_options(station.options());
            all.write_registers32(shared, &[serial]).await?;
            outcome.broadcasts.push((caller, serial));
            Ok(u64::from(serial))
        }
        11 => {
            let values = station.read_registers(Register::r(UNREADABLE.0 + first % 80), count.into()).await?;
            check("unreadable", false, &values)
        }
        12 => {
            let unwritable = Register::new(Symbol::D, UNWRITABLE.0 + caller as u16).unwrap();
            station.write_registers(unwritable, &vec![serial as u16; count.into()]).await?;
            check("unwritable", false, &"done")
        }
        _ => {
            let values = station.read_registers32(own, 1).await?;
            match values[..] {
                [value] if held.contains(&value) => Ok(u64::from(value)),
                _ => Err(format!("station {number}, {own}: {values:?}, but it can only be one of {held:?}")),
            }
        }
    })
}

fn error_kind(error: &Error) -> &'static str {
    match error {
        Error::Invalid(_) => "invalid",
        Error::Plc { .. } | Error::RefusedTags { .. } => "refused",
        Error::Timeout { .. } => "timeout",
        Error::BadReply { .. } => "bad reply",
        Error::Connect { .. } => "connect",
        Error::Disconnected { .. } => "disconnected",
        Error::Offline { .. } => "offline",
        Error::QueueFull { .. } => "queue full",
        Error::GateClosed { .. } => "gate closed",
        Error::OutOfStep { .. } => "out of step",
        Error::Duplicates { .. } => "duplicates",
        Error::Closed { .. } => "closed",
        _ => "other",
    }
}

/// Runs one seed: a bus with faults, and its callers. Counts the injections of each fault.
fn run(seed: u64, requests: u32, fault_counts: &mut BTreeMap<String, u64>) -> Outcome {
    let mut rng = Rng(seed);
    let framing = if seed.is_multiple_of(2) { Framing::Ascii } else { Framing::Binary };
    let echo = rng.per_mille(300);
    let faults = faults(seed, framing, echo);
    let bus = bus(&faults);
    in_paused_time(async move {
        let link = Link::connector_builder("simulated bus", framing, sim::connector(bus, framing))
            .connect_backoff(Duration::from_millis(5), Duration::from_millis(50))
            .probe_interval(Duration::from_millis(50), Duration::from_millis(500))
            .echo(if echo { EchoMode::Auto } else { EchoMode::Off })
            .seed(seed)
            .build();
        let callers: Vec<_> = (0..CALLERS)
            .map(|number| tokio::spawn(caller(link.clone(), number, Rng(rng.next()), requests / CALLERS)))
            .collect();
        let mut outcome = Outcome::default();
        for caller in callers {
            outcome.add(caller.await.unwrap());
        }
        // All requests must have ended before the writes are counted.
        sleep(Duration::from_secs(5)).await;
        let log = faults.log();
        assert_eq!(log.unjournaled(), 0);
        let is_control = |request: &Request| matches!(request, Request::ControlPlc(_));
        outcome.repeated = log.repeated().iter().filter(|applied| !is_control(&applied.request)).count() as u64;
        for (&(station, run), &(called, confirmed)) in &outcome.controls {
            let request = Request::ControlPlc(if run { ControlPlc::Run } else { ControlPlc::Stop });
            let applied = log.applied(station, &request);
            outcome.repeated += u64::from(!(confirmed..=called).contains(&applied));
        }
        for &(caller, serial) in &outcome.broadcasts {
            let write = Request::WriteRegisters32(
                WriteRegisters::new(Register32::new(Symbol::DF, 2 * caller as u16).unwrap(), [serial]).unwrap(),
            );
            outcome.obeyed += (1..=STATIONS).map(|station| log.applied(station, &write)).sum::<u64>();
        }
        for rule in faults.rules() {
            *fault_counts.entry(label(rule.fault())).or_default() += rule.times_applied();
        }
        outcome
    })
}

fn in_paused_time<T>(future: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build().unwrap();
    runtime.block_on(future)
}

fn setting(name: &str, default: u32) -> u32 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

#[test]
fn faults_cause_no_wrong_value_repeated_write_or_late_call() {
    let requests = setting("FATEK_REQUESTS", 960);
    let seeds: Vec<u64> = match std::env::var("FATEK_SEED") {
        Ok(seed) => vec![seed.parse().expect("FATEK_SEED is a number")],
        Err(_) => REGRESSIONS.iter().copied().chain(0..u64::from(setting("FATEK_SEEDS", 10))).collect(),
    };
    let mut total = Outcome::default();
    let mut fault_counts = BTreeMap::new();
    for &seed in &seeds {
        let outcome = run(seed, requests, &mut fault_counts);
        let sound = outcome.wrong.is_empty() && outcome.repeated == 0 && outcome.late == 0;
        assert!(sound, "FATEK_SEED={seed} FATEK_REQUESTS={requests}: {outcome:#?}");
        total.add(outcome);
    }
    println!("{} seeds: {total}\nfaults: {fault_counts:#?}", seeds.len());
    assert!(total.confirmed * 2 > total.requests, "most calls succeed: {total}");
    let broadcasts = total.broadcasts.len() as u64;
    // Some broadcasts are lost with their connection, and some stations refuse them.
    assert!(
        total.obeyed * 10 > broadcasts * u64::from(STATIONS) * 9,
        "{broadcasts} broadcasts, {} obeyed",
        total.obeyed
    );
    if seeds.len() >= 10 {
        assert!(
            fault_counts.len() == LABELS && fault_counts.values().all(|&count| count > 0),
            "faults that were never injected: {fault_counts:?}"
        );
    }
}

/// Seeds of earlier failures.
const REGRESSIONS: &[u64] = &[];

#[test]
fn equal_seeds_give_equal_results() {
    let go = |seed| run(seed, 480, &mut BTreeMap::new());
    for seed in [3, 4] {
        assert_eq!(go(seed), go(seed));
    }
    assert_ne!(go(3).digest, go(5).digest);
}

#[test]
fn a_naive_client_fails_the_same_run() {
    let mut wrong = 0;
    for seed in 0_u64..4 {
        let framing = if seed.is_multiple_of(2) { Framing::Ascii } else { Framing::Binary };
        let bus = bus(&faults(seed, framing, false));
        wrong += in_paused_time(naive::run(bus, framing, 400));
    }
    assert!(
        wrong > 10,
        "a client without matching and checks must deliver wrong values, or this run proves nothing: {wrong}"
    );
}
