//! `fleet push`: a plant is checked and stored, and taken back if a member refuses it.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use fatek::plant::Plant as Plcs;
use fatek_bridge::check::{Finding, Report, Severity};
use fatek_bridge::config::{StoredPlant, plant_text};
use fatek_bridge::fleet::{Observer, OrderError, PlantStore, PlantStoreError, config_hash};
use tokio::time::sleep;

use super::args::PushArgs;
use super::{Plant, Refusal};
use crate::cli::{STATUS_FAILED, STATUS_USAGE, print};

/// The period in which members that have not answered are looked at again.
const LOOK: Duration = Duration::from_millis(200);
/// The time for members to take a version that was rolled back.
const ROLLBACK: Duration = Duration::from_secs(10);
/// The leases for which a member that is not seen any more is waited for.
const LEASES: u32 = 3;
/// The round trip of the check of a plant, which tells nothing about faults.
const ROUND_TRIP: Duration = Duration::from_millis(5);

/// The answers of the members to a version.
#[derive(Debug, Default, PartialEq, Eq)]
struct Answers {
    loaded: BTreeSet<String>,
    refused: BTreeMap<String, String>,
    /// They live, and have another configuration.
    missing: BTreeSet<String>,
}

pub(super) async fn push(args: &PushArgs) -> Result<String, Refusal> {
    let environment = args.plant.environment();
    let plant = Plant::read(&args.plant)?;
    let usage = |text: String| (text, STATUS_USAGE);
    if !plant.config.has_stored_plant() {
        let text = "fleet.config is not store: members have the plant of their own file";
        return Err(usage(format!("{}: {text}", args.plant.config.display())));
    }
    let faults = faults(&Report::of(&args.plant.config, &environment, ROUND_TRIP));
    if !faults.is_empty() {
        return Err(usage(faults.join("\n")));
    }
    let text = plant_text(&args.plant.config, &environment).map_err(|error| usage(error.to_string()))?;
    let parsed = StoredPlant { version: None, text: text.as_str().into() }.parse();
    let parsed = parsed.map_err(|error| usage(error.to_string()))?;
    let hash = config_hash(&plant.config);
    if config_hash(&fatek_bridge::config::Config { plant: parsed, ..plant.config.clone() }) != hash {
        return Err((
            "the text for the store is another plant: this is a fault of the bridge".to_owned(),
            STATUS_FAILED,
        ));
    }
    let failed = |error: PlantStoreError| plant.failure(error);
    let mut store = PlantStore::open(&plant.nats, plant.id(), &plant.fleet.bucket).await.map_err(failed)?;
    let before = store.current().cloned();
    if let Some(before) = before.as_ref().filter(|before| before.text.as_ref() == text) {
        return Ok(format!("The store has this plant already: {}.", before.name().display()));
    }
    let mut members = Members::open(&plant).await.map_err(|error| plant.failure(error))?;
    let version = store.put(&text).await.map_err(failed)?;
    let (plcs, tags) = size(&plant.config.plant);
    // A closed stdout does not end the push.
    let _ = print(&format!("Version {version} is in the store: {plcs} PLCs with {tags} tags."));
    let answers = answers(&mut members, &mut store, &hash, args.timeout).await;
    let why = match answers {
        Ok(answers) if answers.refused.is_empty() && answers.missing.is_empty() => return Ok(loaded(&answers)),
        Ok(answers) => explain(&answers, args.timeout),
        Err(error) => format!("the members cannot be seen: {error}"),
    };
    if args.no_rollback {
        return Err((format!("{why}\nversion {version} stays in the store"), STATUS_FAILED));
    }
    let back = roll_back(&mut members, &mut store, before.as_ref(), version, &hash).await;
    Err((format!("{why}\n{back}"), STATUS_FAILED))
}

/// The faults of a plant. Sections of a member are not stored, and its files need not be here.
fn faults(report: &Report) -> Vec<String> {
    const OWN: [&str; 3] = ["bridge", "mqtt", "stdout"];
    let is_own = |finding: &&Finding| OWN.contains(&finding.key.split('.').next().unwrap_or_default());
    let faults = report.findings.iter().filter(|finding| finding.severity == Severity::Fault && !is_own(finding));
    faults.map(|finding| format!("{}: {finding}", report.path.display())).collect()
}

fn size(plant: &Plcs) -> (usize, usize) {
    (plant.plcs().count(), plant.plcs().map(|plc| plc.tags().count()).sum())
}

/// The members of a fleet.
struct Members {
    observer: Observer,
    /// The members that have lived in the last leases, each with its configuration and the time of that look. One
    /// whose renewal is late, or that makes a new session, lives.
    seen: BTreeMap<String, (String, Instant)>,
    patience: Duration,
}

impl Members {
    async fn open(plant: &Plant) -> Result<Self, OrderError> {
        let (bucket, patience) = (&plant.fleet.bucket, plant.fleet.lease.0 * LEASES);
        let observer = Observer::open(&plant.nats, plant.id(), bucket, "", plant.links()).await?;
        let mut members = Self { observer, seen: BTreeMap::new(), patience };
        members.look();
        Ok(members)
    }

    fn look(&mut self) {
        let now = Instant::now();
        for member in self.observer.observation().members.iter().filter(|member| !member.is_silent()) {
            self.seen.insert(member.id.to_string(), (member.config.clone(), now));
        }
        self.seen.retain(|_, (_, at)| now.duration_since(*at) < self.patience);
    }
}

/// Waits until all living members have loaded the version or one has refused it, for a limited time.
async fn answers(
    members: &mut Members,
    store: &mut PlantStore,
    hash: &str,
    limit: Duration,
) -> Result<Answers, String> {
    let until = Instant::now() + limit;
    loop {
        members.look();
        let mut answers = Answers::default();
        for (member, (config, _)) in &members.seen {
            let list = if config == hash { &mut answers.loaded } else { &mut answers.missing };
            list.insert(member.clone());
        }
        for (member, why) in store.refusals().filter(|(member, _)| answers.missing.contains(*member)) {
            answers.refused.insert(member.to_owned(), why.to_owned());
        }
        answers.missing.retain(|member| !answers.refused.contains_key(member));
        if answers.missing.is_empty() || !answers.refused.is_empty() || Instant::now() >= until {
            return Ok(answers);
        }
        wait(members, store).await?;
    }
}

fn loaded(answers: &Answers) -> String {
    let names: Vec<&str> = answers.loaded.iter().map(String::as_str).collect();
    match names.as_slice() {
        [] => "No member runs: they load it when they are started.".to_owned(),
        names => format!("All members have loaded it: {}.", names.join(", ")),
    }
}

fn explain(answers: &Answers, limit: Duration) -> String {
    let refused = answers.refused.iter().map(|(member, why)| format!("{member} refuses it: {why}"));
    let limit = humantime::format_duration(limit);
    // Of members that would have answered a moment later, nothing is said.
    let missing = answers.missing.iter().filter(|_| answers.refused.is_empty());
    let missing = missing.map(|member| {
        format!("{member} has not loaded it within {limit}: it needs fleet.config = \"store\" and the store")
    });
    refused.chain(missing).collect::<Vec<_>>().join("\n")
}

/// Stores the former plant as a new version. Returns the result as a text. `hash`: that of the version.
async fn roll_back(
    members: &mut Members,
    store: &mut PlantStore,
    before: Option<&StoredPlant>,
    version: u64,
    hash: &str,
) -> String {
    let text = before.map_or("", |before| &before.text);
    let back = match store.put(text).await {
        Ok(back) => back,
        Err(error) => return format!("version {version} was not rolled back: {error}"),
    };
    let Some(before) = before else {
        return format!("version {version} was rolled back: the store has no plant, as before");
    };
    let told = format!("version {version} was rolled back: version {back} is again {}", before.name().display());
    let until = Instant::now() + ROLLBACK;
    loop {
        members.look();
        let has_version =
            |(member, (config, _)): (&String, &(String, Instant))| (config == hash).then(|| member.clone());
        let late: Vec<String> = members.seen.iter().filter_map(has_version).collect();
        if late.is_empty() {
            return told;
        }
        if Instant::now() >= until {
            return format!("{told}\n{} still has version {version}", late.join(", "));
        }
        if let Err(error) = wait(members, store).await {
            return format!("{told}\nthe members cannot be seen: {error}");
        }
    }
}

/// Waits for a change of the store of the plant, for a short time, and follows the members.
async fn wait(members: &mut Members, store: &mut PlantStore) -> Result<(), String> {
    tokio::select! {
        () = sleep(LOOK) => Ok(()),
        changed = store.changed() => changed.map_err(|error| error.to_string()),
        lost = members.observer.follow() => match lost {
            Err(error) => Err(error.to_string()),
            Ok(never) => match never {},
        },
    }
}
