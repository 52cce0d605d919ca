//! The commands of a fleet. They talk to its store, and not to its members.

pub(super) mod args;
mod push;
mod status;

use std::collections::BTreeMap;
use std::io;
use std::process::ExitCode;

use fatek_bridge::config::{Config, FleetSection, Name, NatsSection};
use fatek_bridge::fleet::{self, Initialized, LinkSpec, Observation, PlantLinks, PlantStore, Reach};
use tokio::runtime::Runtime;

use self::args::{DrainArgs, FleetCommand, MoveArgs, PlantArgs, StatusArgs};
use super::{STATUS_FAILED, STATUS_USAGE, complain, print};

/// Why a command has not been done: the text, and the status.
type Refusal = (String, u8);

/// Runs a command of a fleet.
pub(super) fn run(command: &FleetCommand) -> io::Result<ExitCode> {
    let runtime = Runtime::new()?;
    let done = runtime.block_on(async {
        match command {
            FleetCommand::Init(args) => init(args).await,
            FleetCommand::Status(args) => status(args).await,
            FleetCommand::Drain(args) => drain(args).await,
            FleetCommand::Move(args) => move_link(args).await,
            FleetCommand::Push(args) => push::push(args).await,
        }
    });
    match done {
        Ok(text) => print(&text).map(|()| ExitCode::SUCCESS),
        Err((error, status)) => Ok(complain(&error, status)),
    }
}

/// A configuration with a fleet.
struct Plant {
    config: Config,
    fleet: FleetSection,
    nats: NatsSection,
    /// The members that have refused the version of the store, and why.
    refusals: BTreeMap<String, String>,
}

impl Plant {
    /// Reads a file, with the plant of the store if it is to have that.
    async fn load(args: &PlantArgs) -> Result<Self, Refusal> {
        let mut plant = Self::read(args)?;
        if plant.config.has_stored_plant() {
            let store = PlantStore::open(&plant.nats, plant.id(), &plant.fleet.bucket).await;
            let store = store.map_err(|error| plant.failure(error))?;
            let refusals = store.refusals().map(|(member, why)| (member.to_owned(), why.to_owned()));
            plant.refusals = refusals.collect();
            plant.config = match store.current() {
                Some(stored) => plant.config.with_plant(stored.clone()).map_err(|error| plant.failure(error))?,
                None => Config { plant: Default::default(), ..plant.config },
            };
        }
        Ok(plant)
    }

    /// Reads a file.
    fn read(args: &PlantArgs) -> Result<Self, Refusal> {
        let config = Config::read(&args.config, &args.environment());
        let config = config.map_err(|error| (error.to_string(), STATUS_USAGE))?;
        // A configuration with a fleet has a server.
        let Some((fleet, nats)) = config.fleet.clone().zip(config.nats.clone()) else {
            let text = format!("{}: it has no section fleet", args.config.display());
            return Err((text, STATUS_USAGE));
        };
        Ok(Self { config, fleet, nats, refusals: BTreeMap::new() })
    }

    fn id(&self) -> &Name {
        &self.config.bridge.id
    }

    fn links(&self) -> Vec<LinkSpec> {
        fleet::links(&self.config.plant)
    }

    async fn observe(&self) -> Result<Observation, Refusal> {
        let config = fleet::config_hash(&self.config);
        let seen = fleet::observe(&self.nats, self.id(), &self.fleet.bucket, &config, self.links()).await;
        seen.map_err(|error| self.failure(error))
    }

    /// The refusal for an error of the server.
    fn failure(&self, error: impl std::fmt::Display) -> Refusal {
        (format!("{}: {error}", self.nats.url), STATUS_FAILED)
    }
}

async fn init(args: &PlantArgs) -> Result<String, Refusal> {
    let plant = Plant::read(args)?;
    let bucket = &plant.fleet.bucket;
    // First that of the plant: a member needs both.
    let made = fleet::init_plants(&plant.nats, plant.id(), bucket).await;
    made.map_err(|error| plant.failure(error))?;
    let made = fleet::init(&plant.nats, plant.id(), bucket).await;
    Ok(match made.map_err(|error| plant.failure(error))? {
        Initialized::Made(1) => format!(
            "The store {bucket} was made, with 1 replica.\n\
             One replica: if its server loses its last writes in a power failure, all members stop for good."
        ),
        Initialized::Made(replicas) => format!("The store {bucket} was made, with {replicas} replicas."),
        Initialized::Exists => format!("The store {bucket} is there already: nothing has changed."),
    })
}

async fn status(args: &StatusArgs) -> Result<String, Refusal> {
    let plant = Plant::load(&args.plant).await?;
    let seen = plant.observe().await?;
    let report = status::Report { plant: &plant, seen: &seen };
    Ok(if args.json { format!("{:#}", report.to_json()) } else { report.to_string() })
}

async fn drain(args: &DrainArgs) -> Result<String, Refusal> {
    let plant = Plant::load(&args.plant).await?;
    let member = &args.member;
    let seen = plant.observe().await?;
    let done = fleet::drain(&plant.nats, plant.id(), &plant.fleet.bucket, member, !args.undo).await;
    done.map_err(|error| plant.failure(error))?;
    let lives = lives(&seen, member);
    let others = seen.members.iter().any(|other| *other.id != *member.as_str() && !other.is_draining);
    Ok(match (args.undo, lives, others) {
        (true, true, _) => format!("{member} gets links again."),
        (true, false, _) => format!("{member} gets links again when it is started: it does not run now."),
        (false, false, _) => format!("{member} gets no links when it is started: it does not run now."),
        (false, true, true) => format!("{member} gives its links to the others. fleet status shows when it has none."),
        (false, true, false) => format!("{member} keeps its links: there is no other member to take them."),
    })
}

async fn move_link(args: &MoveArgs) -> Result<String, Refusal> {
    let plant = Plant::load(&args.plant).await?;
    let link = &args.link;
    let links = PlantLinks::of(&plant.config.plant);
    let Some(spec) = links.find(link.as_str()) else {
        let mut names: Vec<&str> = links.specs().iter().map(|link| links.name_of(&link.id)).collect();
        names.sort_unstable();
        return Err((no_link(link, &names), STATUS_USAGE));
    };
    let is_allowed = |member: &Name| match &spec.reach {
        Reach::All => Ok(()),
        Reach::Pinned(host) => Err(format!("{link} is a serial port of {host}: it cannot be moved")),
        Reach::Only(hosts) if hosts.iter().any(|host| **host == *member.as_str()) => Ok(()),
        Reach::Only(hosts) => Err(format!("{member} does not reach {link}: `only` has {}", hosts.join(", "))),
    };
    if let Some(member) = &args.member {
        is_allowed(member).map_err(|error| (error, STATUS_USAGE))?;
    }
    let seen = plant.observe().await?;
    let done = fleet::move_link(&plant.nats, plant.id(), &plant.fleet.bucket, &spec.id, args.member.as_ref()).await;
    done.map_err(|error| plant.failure(error))?;
    Ok(match &args.member {
        None => format!("{link} goes where the others would have it."),
        Some(member) if lives(&seen, member) => format!("{link} goes to {member}."),
        Some(member) => format!("{link} goes to {member} when that is started: it does not run now."),
    })
}

fn no_link(link: &Name, names: &[&str]) -> String {
    let known = if names.len() > 20 { String::new() } else { format!(" (known: {})", names.join(" ")) };
    format!("there is no link {link}{known}: a link has the name of its bus, or of its PLC; check shows them")
}

/// Returns whether a member has a living session.
fn lives(seen: &Observation, member: &Name) -> bool {
    seen.members.iter().any(|other| *other.id == *member.as_str() && !other.is_silent())
}
