//! Arguments of `fatek program`.

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
    /// Print the properties of a program file; no PLC needed
    Info(ProgramFile),
}

#[derive(Debug, Args)]
pub(crate) struct ProgramFile {
    /// Program file
    #[arg(value_name = "FILE")]
    pub(crate) file: PathBuf,
    /// Raw file: bytes of all pages, without status and checksum
    #[arg(long)]
    pub(crate) raw: bool,
}

/// Upload the program of the PLC to a file
///
/// An existing file is replaced only after the new one is complete on the disk. After a line
/// failure the upload resumes, as long as each attempt reads at least one more page.
#[derive(Debug, Args)]
#[command(after_help = "Example:
  fatek program read pump.program --link tcp://192.168.2.3 --station 1")]
pub(crate) struct ProgramReadArgs {
    #[command(flatten)]
    pub(crate) file: ProgramFile,
    /// Read all pages twice; a difference is an error
    #[arg(long)]
    pub(crate) twice: bool,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Download a program file to the PLC, only the pages that differ
///
/// Asks for confirmation before the first write; without a terminal --yes is required. Each page is
/// read back and compared. After a failure or Ctrl-C the PLC stays stopped: repeat the command to
/// write the rest. --dry-run makes the same checks and changes nothing.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek program write pump.program --stop --dry-run
  fatek program write pump.program --stop --run")]
pub(crate) struct ProgramWriteArgs {
    #[command(flatten)]
    pub(crate) file: ProgramFile,
    /// Stop a running PLC first [default: refuse a running PLC]
    #[arg(long)]
    pub(crate) stop: bool,
    /// Start the PLC again after the download, if it ran before
    #[arg(long, requires = "stop")]
    pub(crate) run: bool,
    /// Write all pages, including equal ones
    #[arg(long)]
    pub(crate) all: bool,
    /// Compare all pages again after the download
    #[arg(long)]
    pub(crate) verify: bool,
    /// Write to another PLC than that of the file: other model or OS version
    ///
    /// Without it the command compares the PLC with the one that the file was read from, lists the
    /// differences, and writes nothing.
    #[arg(long)]
    pub(crate) force: bool,
    /// Response timeout for the write of one page, up to 24h [default: --timeout]
    #[arg(long, value_parser = duration::parse_positive, value_name = "TIME")]
    pub(crate) page_timeout: Option<Duration>,
    #[command(flatten)]
    pub(crate) consent: Consent,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Compare the program of the PLC with a file
///
/// Prints the pages that differ. Exit status 0 if all are equal, 7 if not.
#[derive(Debug, Args)]
pub(crate) struct ProgramVerifyArgs {
    #[command(flatten)]
    pub(crate) file: ProgramFile,
    #[command(flatten)]
    pub(crate) plc: Plc,
}
