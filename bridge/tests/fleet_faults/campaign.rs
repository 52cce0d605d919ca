//! The campaign: rounds of faults, each of which ends with a fleet that is well.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use futures::future::join_all;

use super::fleet::{Fleet, LINKS, id_of};
use super::inject::inject;
use super::oracle::Judged;
use super::plan::{KINDS, LEASE, Planned, draw};

/// The settings of a campaign.
#[derive(Clone, Debug)]
pub(crate) struct Settings {
    /// The seed of the first round; each round has the next one.
    pub(crate) seed: u64,
    /// The number of faults.
    pub(crate) faults: usize,
    /// A naive variant of the protocol: the campaign ends with its first request of a former owner.
    pub(crate) naive: Option<&'static str>,
}

/// The result of a campaign.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    pub(crate) judged: Judged,
    /// All that was not as it must be, beside requests.
    pub(crate) problems: Vec<String>,
    counts: [usize; KINDS.len()],
    /// The longest gap in the requests to a PLC in rounds with a kind of fault.
    gaps: [Duration; KINDS.len()],
    rounds: u64,
    recoveries: Vec<Duration>,
    shares: Vec<Duration>,
    elapsed: Duration,
}

/// Runs a campaign. `None`: there is no server on this machine.
pub(crate) async fn run(settings: &Settings) -> Option<Outcome> {
    let fleet = Fleet::new(settings.naive).await?;
    let mut outcome = Outcome::default();
    let begin = Instant::now();
    let mut members = 0;
    let mut seed = settings.seed;
    while outcome.faults() < settings.faults {
        if members == 0 {
            members = fastrand::Rng::with_seed(seed).usize(3..=5);
            start_all(&fleet, members, &mut outcome).await;
        }
        let plan = draw(seed, members, LINKS.len());
        let round = Round { seed, members };
        println!("{:>6.1?} seed {seed}, {members} members: {}", begin.elapsed(), describe(&plan));
        let is_over = round.run(&fleet, &plan, &mut outcome).await;
        outcome.rounds += 1;
        if is_over {
            members = 0;
        }
        let wrong = outcome.judged.wrong();
        outcome.judged = fleet.judge().await;
        let gap = fleet.take_gap().await;
        for planned in &plan {
            let longest = &mut outcome.gaps[planned.fault.kind()];
            *longest = gap.max(*longest);
        }
        if outcome.judged.wrong() > wrong {
            println!("FATEK_FLEET_SEED={seed}: {:#?}", outcome.judged.faults);
            if settings.naive.is_some() {
                break;
            }
        }
        if outcome.problems.len() > 5 && settings.naive.is_none() {
            break;
        }
        seed += 1;
    }
    outcome.elapsed = begin.elapsed();
    Some(outcome)
}

fn describe(plan: &[Planned]) -> String {
    plan.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
}

async fn start_all(fleet: &Fleet, members: usize, outcome: &mut Outcome) {
    let begin = Instant::now();
    for member in 0..members {
        fleet.start(member).await;
    }
    let polled = fleet.polled_after(begin).await;
    if let Err(problem) = polled {
        outcome.problem(fleet, &format!("start of {members} members: {problem}")).await;
    }
}

/// A round.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Round {
    pub(crate) seed: u64,
    pub(crate) members: usize,
}

impl Round {
    /// Runs the faults, heals all, and waits until the fleet is well. Returns whether all members have ended.
    async fn run(self, fleet: &Fleet, plan: &[Planned], outcome: &mut Outcome) -> bool {
        let results = join_all(plan.iter().map(|planned| inject(fleet, self, planned))).await;
        for (planned, result) in plan.iter().zip(results) {
            match result {
                Ok(is_injected) => outcome.counts[planned.fault.kind()] += usize::from(is_injected),
                Err(problem) => outcome.problem(fleet, &format!("seed {}: {planned}: {problem}", self.seed)).await,
            }
        }
        if plan.iter().any(|planned| planned.fault.ends_fleet()) {
            return true;
        }
        fleet.heal().await;
        let healed = Instant::now();
        for member in 0..self.members {
            let mut place = fleet.members[member].lock().await;
            let status = place.as_mut().and_then(|member| member.ended());
            if let Some(status) = status {
                drop(place);
                let problem = format!("seed {}: {} ended by itself, {status}", self.seed, id_of(member));
                outcome.problem(fleet, &problem).await;
                fleet.retire(member).await;
                fleet.start(member).await;
            }
        }
        match fleet.polled_after(healed).await {
            Ok(time) => outcome.recoveries.push(time),
            Err(problem) => outcome.problem(fleet, &format!("seed {}: {problem}", self.seed)).await,
        }
        match fleet.all_have_a_share(self.members).await {
            Ok(_) => outcome.shares.push(healed.elapsed()),
            Err(problem) => outcome.problem(fleet, &format!("seed {}: {problem}", self.seed)).await,
        }
        fleet.forget_former(self.members).await;
        false
    }
}

impl Outcome {
    fn faults(&self) -> usize {
        self.counts.iter().sum()
    }

    /// Notes a problem, and keeps the logs of all members.
    async fn problem(&mut self, fleet: &Fleet, text: &str) {
        let number = self.problems.len();
        let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fleet_faults-{number}"));
        println!("PROBLEM: {text}; logs are in {}", folder.display());
        std::fs::create_dir_all(&folder).unwrap();
        for (index, member) in fleet.members.iter().enumerate() {
            if let Some(member) = &*member.lock().await {
                std::fs::write(folder.join(id_of(index)), member.log()).unwrap();
            }
        }
        self.problems.push(text.to_owned());
    }

    /// The figures as a table.
    pub(crate) fn table(&self) -> String {
        let mut text = String::from("| fault | number | longest gap in a round with it, s |\n|---|---|---|\n");
        for (kind, name) in KINDS.iter().enumerate() {
            writeln!(text, "| {name} | {} | {:.2} |", self.counts[kind], self.gaps[kind].as_secs_f64()).unwrap();
        }
        let judged = &self.judged;
        writeln!(text, "\n{} faults in {} rounds, {:.0?}", self.faults(), self.rounds, self.elapsed).unwrap();
        writeln!(
            text,
            "requests {}, connections {}, ownerships {} of which {} sent; stale {}, late {}, without ownership {}; \
             connections of unknown processes {}, of processes known by their end {}",
            judged.requests,
            judged.connections,
            judged.ownerships,
            judged.used,
            judged.stale,
            judged.late,
            judged.unowned,
            judged.unknown,
            judged.by_end,
        )
        .unwrap();
        writeln!(text, "all links polled after the end of the faults: {}", spread(&self.recoveries)).unwrap();
        writeln!(text, "each member has its share after the end of the faults: {}", spread(&self.shares)).unwrap();
        text
    }
}

/// The median, the 99th percentile and the longest of times, in leases.
fn spread(times: &[Duration]) -> String {
    let mut times: Vec<f64> = times.iter().map(|time| time.as_secs_f64() / LEASE.as_secs_f64()).collect();
    times.sort_by(f64::total_cmp);
    let at = |part: usize| times.get((times.len() * part / 100).min(times.len().saturating_sub(1)));
    let [median, most, longest] = [50, 99, 100].map(|part| at(part).copied().unwrap_or_default());
    format!("median {median:.1} leases, 99 % {most:.1}, longest {longest:.1} of {}", times.len())
}
