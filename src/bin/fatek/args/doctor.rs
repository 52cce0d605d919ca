//! Arguments of `fatek doctor`.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fatek::Element;

use super::Plc;
use crate::duration;

/// Examine a PLC for the assumptions of this program
///
/// Sends some 200 requests that only read, one at a time, at most 20 in a second, and prints for each
/// assumption whether it holds, is contradicted, or stayed open. Duration and number of requests are
/// stated before it starts. Ctrl-C prints the result so far.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek doctor --link tcp://192.168.2.3 --station 1
  fatek doctor --quick --evidence
  fatek doctor --report fbs-24mc.md
  fatek doctor --idle 2m --connections 8
  fatek doctor --write R3000 --yes

Load: 48 requests without a pause, and up to 3 requests together, 12 times (UDP:
15 times). Two status requests go to station 0, which all stations of a line
receive. --no-load leaves that out.
A running PLC executes all requests of this command as reads. --write writes the
named element, reads it back and restores it; a Y is a physical output. Codes
that no source documents are sent with --unknown-commands only: a PLC may have
commands that no source has.

A report has no address, no values and no program. docs/HARDWARE.md says where
to send it. Exit status 7 if an assumption is contradicted; 4 or 5 if the PLC
does not answer any more: the result so far is printed.")]
pub(crate) struct DoctorArgs {
    /// Fewer requests: no memory map, no load, no connections
    #[arg(long)]
    pub(crate) quick: bool,
    /// Requests in a second at most, 1 to 1000; 25 ms follow each reply
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u16).range(1..=1000), value_name = "N")]
    pub(crate) rate: u16,
    /// No requests without a pause, together, or to station 0
    #[arg(long)]
    pub(crate) no_load: bool,
    /// TCP connections at once, 2 to 16
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(2..=16), value_name = "N")]
    pub(crate) connections: u8,
    /// Leave the connection idle for this time, up to 24h
    #[arg(long, value_parser = duration::parse_positive, value_name = "TIME")]
    pub(crate) idle: Option<Duration>,
    /// Send two command codes that no source documents
    #[arg(long)]
    pub(crate) unknown_commands: bool,
    /// Write this discrete or 16-bit register, read it back and restore it
    #[arg(long, value_name = "ELEMENT")]
    pub(crate) write: Option<Element>,
    /// No confirmation prompt before --write
    #[arg(short, long, requires = "write")]
    pub(crate) yes: bool,
    /// Requests and replies as hexadecimal digits, values hidden
    #[arg(long)]
    pub(crate) evidence: bool,
    /// Show the values in --evidence
    #[arg(long, requires = "evidence")]
    pub(crate) values: bool,
    /// State link and station in the report
    #[arg(long)]
    pub(crate) with_address: bool,
    /// Save the report: Markdown, or JSON if the name ends in .json
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}
