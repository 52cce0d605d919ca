//! Fifty clients of both framings and eight stations on a faulty line, in paused time.
//!
//! A client takes the next frame for its reply, so a late or misdirected frame shows as a wrong
//! value. `FATEK_SEEDS=n` sets the number of seeds. `FATEK_SEED=n` runs one, such as one that a
//! failure has printed.

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use fatek::command::{
    LoopBack, ReadDiscretes, ReadMixed, ReadRegisters, ReplyError, Value, WriteMixed, WriteRegisters,
};
use fatek::sim::{Fault, Faults, Line, Rule};
use fatek::{ErrorCode, Register};
use tokio::runtime::Builder;
use tokio::task::JoinSet;
use tokio::time::sleep;

use crate::bench::{Bench, Client, READ_ONLY, STATIONS, UNRESTRICTED, Unanswered, bit, m, word};
use crate::common::{FRAMINGS, Rng};

const CLIENTS: u16 = 50;
const REQUESTS: usize = 40;

/// Results of a run.
#[derive(Debug, Default, PartialEq, Eq)]
struct Outcome {
    answered: u64,
    refused: u64,
    unanswered: u64,
    confirmed_writes: u64,
    wrong: Vec<String>,
    /// Number of injections of each fault.
    fault_counts: BTreeMap<String, u64>,
}

impl Outcome {
    fn add(&mut self, other: Self) {
        self.answered += other.answered;
        self.refused += other.refused;
        self.unanswered += other.unanswered;
        self.confirmed_writes += other.confirmed_writes;
        self.wrong.extend(other.wrong);
        other.fault_counts.into_iter().for_each(|(kind, times)| *self.fault_counts.entry(kind).or_default() += times);
    }
}

#[test]
fn fifty_clients_of_both_framings_read_right_values() {
    let number = |name| std::env::var(name).ok().map(|value| value.parse::<u64>().unwrap());
    let seeds = match number("FATEK_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_SEEDS").unwrap_or(6),
    };
    let mut all = Outcome::default();
    for seed in seeds {
        let outcome = run(seed);
        assert_eq!(outcome.wrong, Vec::<String>::new(), "FATEK_SEED={seed}");
        all.add(outcome);
    }
    println!("{all:?}");
    assert!(all.fault_counts.len() == 11 && all.fault_counts.values().all(|&times| times > 0));
    assert!(all.answered > all.unanswered && all.unanswered > 0 && all.refused > 0 && all.confirmed_writes > 0);
}

#[test]
fn equal_seeds_give_equal_runs() {
    assert_eq!(run(3), run(3));
}

fn run(seed: u64) -> Outcome {
    let runtime = Builder::new_current_thread().enable_all().start_paused(true).build().unwrap();
    runtime.block_on(async {
        let mut rng = Rng(seed);
        // From less than one round of all clients to more than any call takes.
        let call_timeout = rng.pick(&[300, 2000, 20_000]);
        let bench =
            Bench::with_faults(rng.pick(&FRAMINGS), UNRESTRICTED, faults(seed), Duration::from_millis(call_timeout));
        let mut clients = JoinSet::new();
        for number in 0..CLIENTS {
            let client = bench.client(FRAMINGS[usize::from(number % 2)]);
            clients.spawn(run_client(client, number, Rng(rng.next())));
        }
        let mut outcome = Outcome::default();
        clients.join_all().await.into_iter().for_each(|one| outcome.add(one));

        let log = bench.faults.log();
        assert_eq!((log.repeated(), log.unjournaled()), (vec![], 0), "FATEK_SEED={seed}");
        assert!(log.writes() >= outcome.confirmed_writes, "FATEK_SEED={seed}");
        for rule in bench.faults.rules() {
            let kind = format!("{:?}", rule.fault()).split([' ', '(']).next().unwrap().to_owned();
            *outcome.fault_counts.entry(kind).or_default() += rule.times_applied();
        }
        let counts = bench.proxy.counts();
        assert_eq!(
            (counts.done, counts.refused, counts.silent, counts.faulty + counts.held_back + counts.ignored),
            (outcome.answered, outcome.refused, outcome.unanswered, 0),
            "FATEK_SEED={seed}"
        );
        outcome
    })
}

/// Faults of the bus. Late replies and wrong station numbers come from different stations: the
/// combination cannot be detected.
fn faults(seed: u64) -> Faults {
    let ms = Duration::from_millis;
    let some = |fault: Fault, per_mille: u16| Rule::new(fault).per_mille(per_mille);
    let mut faults = Faults::new(seed)
        .journal_capacity(100_000)
        .line(Line::new(57_600).response_time(ms(1), ms(5)))
        .rule(some(Fault::Ignore, 15))
        .rule(some(Fault::DropReply, 15))
        .rule(some(Fault::Split { pieces: 3, pause: ms(4) }, 30))
        .rule(some(Fault::GarbageBefore { max_len: 40 }, 15))
        .rule(some(Fault::GarbageInside { max_len: 10 }, 15))
        .rule(some(Fault::WrongCommand, 15))
        .rule(some(Fault::Truncated { by: 1 }, 15))
        .rule(some(Fault::BadChecksum, 15))
        .rule(some(Fault::Error(ErrorCode::IllegalAddress), 15));
    for station in 1..=STATIONS {
        let fault = match station % 2 {
            0 => Fault::WrongStation,
            _ => Fault::Delay { min: ms(110), max: ms(400) },
        };
        faults = faults.rule(some(fault, 40).station(station));
    }
    faults
}

/// Runs one client: requests one after the other, with pauses.
async fn run_client(mut client: Client, number: u16, mut rng: Rng) -> Outcome {
    let mut outcome = Outcome::default();
    // Possible content of this client's own registers by station: the last write, and unconfirmed
    // ones since.
    let mut own: HashMap<u8, Vec<u32>> = HashMap::new();
    for nth in 0..REQUESTS {
        sleep(Duration::from_millis(rng.next() % 200)).await;
        let station = 1 + rng.index(STATIONS.into()) as u8;
        let held = own.entry(station).or_insert_with(|| vec![0]);
        let serial = u32::from(number) << 16 | u32::try_from(nth + 1).unwrap();
        match request(&mut client, station, number, serial, held, &mut rng, &mut outcome).await {
            Ok(is_write) => {
                outcome.answered += 1;
                outcome.confirmed_writes += u64::from(is_write);
            }
            Err(Unanswered::Silence) => outcome.unanswered += 1,
            Err(Unanswered::Reply(ReplyError::Plc(_))) => outcome.refused += 1,
            Err(Unanswered::Reply(mismatch)) => outcome.wrong.push(format!("client {number}: {mismatch}")),
        }
    }
    outcome
}

/// Makes a random request and checks the result. Returns whether it was a write.
async fn request(
    client: &mut Client,
    station: u8,
    number: u16,
    serial: u32,
    held: &mut Vec<u32>,
    rng: &mut Rng,
    outcome: &mut Outcome,
) -> Result<bool, Unanswered> {
    // Mostly of one shape: replies of equal shape can be mistaken for each other.
    let count = if rng.index(10) < 8 { 1 } else { 1 + rng.index(64) as u16 };
    let first = rng.index(usize::from(READ_ONLY - count)) as u16;
    let own = Register::r(2 * number).widened().unwrap();
    let mut check = |good: bool, got: &dyn std::fmt::Debug| {
        if !good {
            outcome.wrong.push(format!("client {number}, station {station}, {count} from {first} on: {got:?}"));
        }
        Ok(false)
    };
    match rng.index(10) {
        0..=3 => {
            let values = client.call(station, &ReadRegisters::new(Register::d(first), count.into()).unwrap()).await?;
            check(values.iter().copied().eq((first..first + count).map(|a| word(station, a))), &values)
        }
        4 => {
            let states = client.call(station, &ReadDiscretes::new(m(first), count.into()).unwrap()).await?;
            check(states.iter().copied().eq((first..first + count).map(|a| bit(station, a))), &states)
        }
        5 => {
            let elements = [Register::d(first).into(), m(first).into()];
            let values = client.call(station, &ReadMixed::new(elements).unwrap()).await?;
            check(values == [Value::Word(word(station, first)), Value::Bit(bit(station, first))], &values)
        }
        6 => {
            let values = client.call(station, &ReadRegisters::new(own, 1).unwrap()).await?;
            check(values.len() == 1 && held.contains(&values[0]), &(&values, &held))?;
            *held = values;
            Ok(false)
        }
        7 => {
            client.call(station, &LoopBack::new(format!("{serial:08X}")).unwrap()).await?;
            Ok(false)
        }
        _ => {
            // From now on the register may hold the value, until a reply clears it up.
            held.push(serial);
            let written = match rng.index(2) {
                0 => client.call(station, &WriteRegisters::new(own, [serial]).unwrap()).await,
                _ => client.call(station, &WriteMixed::new([(own.into(), serial.into())]).unwrap()).await,
            };
            match written {
                Ok(()) => *held = vec![serial],
                Err(Unanswered::Reply(_)) => held.retain(|&value| value != serial),
                Err(Unanswered::Silence) => {}
            }
            written.map(|()| true)
        }
    }
}
