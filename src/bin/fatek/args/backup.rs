//! Arguments of `fatek backup` and `fatek restore`.

use std::path::PathBuf;

use clap::Args;
use fatek::tag::Tag;

use super::{Consent, ModelArgs, Plc};

/// Save ranges of registers and discretes to a file
///
/// An existing file is replaced only after the new one is complete on the disk. Ranges refused by
/// the PLC are missing in the file, never zero; the exit status is then 3. If all are refused, no
/// file is saved.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek backup plant.backup R0-R3839 D0-D2047 M0-M1911
  fatek backup plant.backup R0-R99:f32 DR200-DR298 WM0-WM96
  fatek backup plant.backup --compare

A 32-bit value, such as f32, is always read in one request; other types have no
effect. Values of different requests come from different scan cycles: for a
consistent backup, stop the PLC first.
With --compare the exit status is 0 if all values are equal, 7 if not.")]
pub(crate) struct BackupArgs {
    /// Backup file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// Range without overlap with the others, such as R0-R99
    #[arg(value_name = "RANGE", required_unless_present = "compare")]
    pub(crate) ranges: Vec<Tag>,
    /// Compare the PLC with the file, or with the given ranges of it; save nothing
    #[arg(long)]
    pub(crate) compare: bool,
    #[command(flatten)]
    pub(crate) model: ModelArgs,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Restore a backup file to the PLC, only the values that differ
///
/// Compares all values, writes those that differ, and verifies all. Asks for confirmation before
/// the first write; without a terminal --yes is required. After a failure, repeat the command to
/// write the rest.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek restore plant.backup --dry-run
  fatek restore plant.backup D0-D99 M0-M15 --stop --run

Elements overwritten by the running program are reported as errors, with exit
status 7. Inputs X and contacts T and C are never written. Disabled discretes
keep their forced state unless --forced is given. A backup of another station,
model or OS version is refused with exit status 7 unless --force is given.
CAUTION: outputs Y switch the connected loads, also in a stopped PLC.")]
pub(crate) struct RestoreArgs {
    /// Backup file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// Range of the file to restore [default: all]
    #[arg(value_name = "RANGE")]
    pub(crate) ranges: Vec<Tag>,
    /// Stop a running PLC before the first write
    #[arg(long)]
    pub(crate) stop: bool,
    /// Start the PLC again after a complete restore, if it ran before
    #[arg(long, requires = "stop")]
    pub(crate) run: bool,
    /// Refuse a running PLC
    #[arg(long, conflicts_with = "stop")]
    pub(crate) require_stopped: bool,
    /// Write disabled discretes, too
    #[arg(long)]
    pub(crate) forced: bool,
    /// Write to another PLC than that of the file: other station, model or OS version
    ///
    /// Without it the command compares the PLC with the one that the file was read from, lists the
    /// differences, and writes nothing.
    #[arg(long)]
    pub(crate) force: bool,
    /// Special elements of the file, R3840-R4167 and M1912-M2001: write or skip [default: refuse the
    /// file]
    ///
    /// Writing them can cause system or I/O errors, or cut the line.
    #[arg(long, value_enum, value_name = "CHOICE")]
    pub(crate) special: Option<SpecialArg>,
    /// Number of equal elements written between two that differ, if that saves a request
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub(crate) bridge: usize,
    #[command(flatten)]
    pub(crate) consent: Consent,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Treatment of special elements.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
pub(crate) enum SpecialArg {
    /// They are restored as all others
    Write,
    /// All others are restored
    Skip,
}
