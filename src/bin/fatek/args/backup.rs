//! What can stand behind `fatek backup` and `fatek restore`.

use std::path::PathBuf;

use clap::Args;
use fatek::tag::Tag;

use super::{Consent, Plc};

/// Save what ranges of registers and discretes hold in a file
///
/// A file that is there keeps its content until all of the new is on the disk. What the PLC refuses to give is missing in the
/// file, never zero, and the exit status is then 3; if it gives nothing at all, nothing is saved.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek backup plant.backup R0-R3839 D0-D2047 M0-M1911 --link tcp://192.168.2.3 --station 1
  fatek backup plant.backup R0-R99:f32 DR200-DR298 WM0-WM96
  fatek backup plant.backup --compare

Of a type only one thing matters: values of two registers, such as f32, are never read by halves. Values
from different requests come from different scans of the PLC: if they must fit together, stop it before.
With --compare, exit status 0 if the PLC holds what the file says, 7 if not.")]
pub(crate) struct BackupArgs {
    /// The file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// Ranges that share no memory, such as R0-R99
    #[arg(value_name = "RANGE", required_unless_present = "compare")]
    pub(crate) ranges: Vec<Tag>,
    /// Save nothing: compare the PLC with the file, or with these ranges of it, and print what differs
    #[arg(long)]
    pub(crate) compare: bool,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Write what differs from a file of `backup` to the PLC
///
/// Asks before anything is changed; where there is no terminal, --yes must be given. All is compared first, what differs is
/// written, and then all is read once more and compared. If it ends in the middle, the same command again writes the rest.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek restore plant.backup --dry-run --link tcp://192.168.2.3 --station 1
  fatek restore plant.backup D0-D99 M0-M15 --stop --run

A program that runs may overwrite what is restored: that is told, with exit status 7. Inputs X and the contacts
T and C are not written, and discretes that are disabled stay as they are forced, unless --forced is given.
Outputs Y switch what is wired to them, also in a PLC that is stopped.")]
pub(crate) struct RestoreArgs {
    /// The file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// Only these ranges of the file
    #[arg(value_name = "RANGE")]
    pub(crate) ranges: Vec<Tag>,
    /// Stop the PLC first if it runs
    #[arg(long)]
    pub(crate) stop: bool,
    /// Run the PLC again afterwards, if it ran before and all is restored
    #[arg(long, requires = "stop")]
    pub(crate) run: bool,
    /// Refuse a PLC that runs
    #[arg(long, conflicts_with = "stop")]
    pub(crate) require_stopped: bool,
    /// Write discretes that are disabled, too
    #[arg(long)]
    pub(crate) forced: bool,
    /// Write up to so many equal elements between two that differ, where that saves a request
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub(crate) bridge: usize,
    #[command(flatten)]
    pub(crate) consent: Consent,
    #[command(flatten)]
    pub(crate) plc: Plc,
}
