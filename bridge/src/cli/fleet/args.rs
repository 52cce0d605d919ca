//! Arguments and help texts of `fleet`.

use std::time::Duration;

use clap::{Args, Subcommand, ValueHint};
use fatek_bridge::config::{Environment, Name};

use crate::cli::args::{name, time};

/// Make, show and change a fleet: bridges that share the PLCs
///
/// The members know each other through a store in NATS JetStream: [nats] and [fleet] of the configuration name it.
/// These commands talk to the store alone, and the members follow within a second.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge fleet init plant.toml
  fatek-bridge run plant.toml --id hall-1
  fatek-bridge fleet status plant.toml
  fatek-bridge fleet drain plant.toml hall-1
  fatek-bridge fleet push plant.toml")]
pub(in crate::cli) struct FleetArgs {
    #[command(subcommand)]
    pub(in crate::cli) command: FleetCommand,
}

#[derive(Debug, Subcommand)]
pub(in crate::cli) enum FleetCommand {
    /// Make the store of a fleet, once
    ///
    /// Two buckets: the leases, and the plant for fleet push. Three replicas in a cluster, else one. A store that is
    /// there is left as it is. No member ever makes it: one that was deleted must not come back unnoticed.
    #[command(after_help = "Examples:
  fatek-bridge fleet init plant.toml")]
    Init(PlantArgs),
    Status(StatusArgs),
    Drain(DrainArgs),
    Move(MoveArgs),
    Push(PushArgs),
}

/// The configuration of a fleet.
#[derive(Debug, Args)]
pub(in crate::cli) struct PlantArgs {
    /// Configuration with [nats] and [fleet]
    #[arg(value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub(in crate::cli) config: std::path::PathBuf,
    /// Name of this client in the log of the server, in place of bridge.id
    #[arg(long, value_name = "NAME", value_parser = name)]
    pub(in crate::cli) id: Option<Name>,
}

impl PlantArgs {
    /// The variables of this process, with the options.
    pub(in crate::cli) fn environment(&self) -> Environment {
        Environment::with_id(self.id.as_ref())
    }
}

/// Show the members, and who owns which link since when
///
/// A member is silent if its last sign of life is older than its lease; it comes three times in a lease. Times are
/// those of the server. TO is the member that is to own a link, if another one owns it: by placement, or moved by hand.
/// Serial ports have no token: they always belong to their host.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge fleet status plant.toml
  fatek-bridge fleet status plant.toml --json
  watch -n 2 fatek-bridge fleet status plant.toml

JSON: object with fleet, bucket, replicas; config, the hash of FILE or of the
plant in the store, and version, that of the plant in the store; members, each
with member, state (active, draining, silent), version, config, weight, links,
lease_ms and silent_for_ms; links, each with link, owner, rev (the token),
owned_for_ms, target and moved; drained; counts; and warnings.

Exit status: 0, also with warnings; 1 if the store does not answer.")]
pub(in crate::cli) struct StatusArgs {
    #[command(flatten)]
    pub(in crate::cli) plant: PlantArgs,
    /// One JSON document in place of tables
    #[arg(long)]
    pub(in crate::cli) json: bool,
}

/// Let a member give its links to the others, before it is stopped
///
/// The order stands until --undo, also when the member is started again. It keeps links that no other member can
/// reach. A member that gets SIGTERM gives its links away by itself.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge fleet drain plant.toml hall-2
  fatek-bridge fleet drain plant.toml hall-2 --undo")]
pub(in crate::cli) struct DrainArgs {
    #[command(flatten)]
    pub(in crate::cli) plant: PlantArgs,
    /// Id of the member
    #[arg(value_name = "MEMBER", value_parser = name)]
    pub(in crate::cli) member: Name,
    /// Let it have links again
    #[arg(long)]
    pub(in crate::cli) undo: bool,
}

/// Move a link to a member by hand
///
/// The order stands until --undo or another one. While the member does not live, or gives its links away, the link is
/// where it would be without the order. A link has the name of its bus, or of its PLC: check shows it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge fleet move plant.toml mixer hall-2
  fatek-bridge fleet move plant.toml mixer --undo")]
pub(in crate::cli) struct MoveArgs {
    #[command(flatten)]
    pub(in crate::cli) plant: PlantArgs,
    /// Name of the link
    #[arg(value_name = "LINK", value_parser = name)]
    pub(in crate::cli) link: Name,
    /// Id of the member
    #[arg(value_name = "MEMBER", value_parser = name, required_unless_present = "undo", conflicts_with = "undo")]
    pub(in crate::cli) member: Option<Name>,
    /// Let it be where the others would have it
    #[arg(long)]
    pub(in crate::cli) undo: bool,
}

/// Give the PLCs and classes of a file to all members, by the store
///
/// For members with fleet.config = "store". The file is checked as check does, and stored as a new version: its
/// sections class, template, plc and bus, with the tables of tags. Each member loads it as SIGHUP would. If one
/// refuses it or does not load it in time, the former plant is stored again.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek-bridge fleet push plant.toml
  fatek-bridge fleet push plant.toml --timeout 1m --no-rollback

Exit status: 0, all living members have loaded it; 1, it was rolled back, or the
store does not answer; 2, faults of the file.")]
pub(in crate::cli) struct PushArgs {
    #[command(flatten)]
    pub(in crate::cli) plant: PlantArgs,
    /// Time for the members to load it
    #[arg(long, value_name = "TIME", default_value = "30s", value_parser = time)]
    pub(in crate::cli) timeout: Duration,
    /// Leave it in the store, also if a member refuses it
    #[arg(long)]
    pub(in crate::cli) no_rollback: bool,
}
