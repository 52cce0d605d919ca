//! What can stand behind `fatek program`.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};

use super::{Consent, Plc};
use crate::duration;

#[derive(Debug, Subcommand)]
pub(crate) enum ProgramCommand {
    Read(ProgramReadArgs),
    Write(ProgramWriteArgs),
    Verify(ProgramVerifyArgs),
    /// Print what a saved program is, without a PLC
    Info(ProgramFile),
}

#[derive(Debug, Args)]
pub(crate) struct ProgramFile {
    /// The file with the program
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// The file holds the bytes of all pages and nothing else: no status, no checksum
    #[arg(long)]
    pub(crate) raw: bool,
}

/// Read the program of the PLC into a file
///
/// A file that is there keeps its content until all of the new is on the disk. After a failure that is not the PLC's answer
/// it goes on where it was, as long as each attempt brings at least a page.
#[derive(Debug, Args)]
#[command(after_help = "Example:
  fatek program read pump.program --link tcp://192.168.2.3 --station 1")]
pub(crate) struct ProgramReadArgs {
    #[command(flatten)]
    pub(crate) file: ProgramFile,
    /// Read all pages a second time, and fail if one has changed
    #[arg(long)]
    pub(crate) twice: bool,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Write the program in a file to the PLC: the pages that differ
///
/// Asks before anything is changed; where there is no terminal, --yes must be given. Each page is read back and compared.
/// If it ends in the middle, by Ctrl-C too, the PLC is left stopped; the same command again writes the rest. With --dry-run it
/// ends as it would without, also where it would be refused, but changes nothing.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek program write pump.program --dry-run --link tcp://192.168.2.3 --station 1
  fatek program write pump.program --stop --run")]
pub(crate) struct ProgramWriteArgs {
    #[command(flatten)]
    pub(crate) file: ProgramFile,
    /// Stop the PLC first if it runs; else one that runs is refused
    #[arg(long)]
    pub(crate) stop: bool,
    /// Run the PLC again afterwards, if it ran before
    #[arg(long, requires = "stop")]
    pub(crate) run: bool,
    /// Write all pages, not only those that differ
    #[arg(long)]
    pub(crate) all: bool,
    /// Compare all pages once more in the end
    #[arg(long)]
    pub(crate) verify: bool,
    /// How long the PLC may take to write a page, such as 5s [default: --timeout]
    #[arg(long, value_parser = duration::parse_timeout, value_name = "TIME")]
    pub(crate) page_timeout: Option<Duration>,
    #[command(flatten)]
    pub(crate) consent: Consent,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Compare the program of the PLC with the one in a file
///
/// Prints the pages that differ. Exit status 0 if there are none, 7 if there are.
#[derive(Debug, Args)]
pub(crate) struct ProgramVerifyArgs {
    #[command(flatten)]
    pub(crate) file: ProgramFile,
    #[command(flatten)]
    pub(crate) plc: Plc,
}
