//! Arguments of `fatek top`.

use std::time::Duration;

use clap::Args;
use clap_complete::ArgValueCompleter;

use super::{ModelArgs, Plc};
use crate::complete;
use crate::duration;
use crate::names::TableArgs;

/// Show a dashboard of PLCs and tags on the terminal
///
/// Polls until q or Ctrl-C. Without tags, the PLCs alone are shown. A value is written only after a
/// prompt with PLC, tag, present and new value. Needs a terminal; NO_COLOR is respected.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek top R0-R9 M0-M7 --link tcp://192.168.2.3 --station 1
  fatek top --station 1-4,9 --interval 500ms
  fatek --config plant.toml @all top
  fatek --config plant.toml @mixer top level setpoint --read-only

Keys:
  up down     select a row; tab: the other table
  s, r        sort by name, value, quality, age or PLC; reverse
  /           filter by PLC, name and element
  space       pause the display; polling goes on
  w           write a value to the selected tag
  ?           help
  q, Ctrl-C   quit

Columns of a PLC: round trips in ms (last one, moving average, longest),
requests, bad replies and refusals, timeouts, retries.
Tags of a plant are written if they have `write`, special elements with
--special.")]
pub(crate) struct TopArgs {
    /// Element or range, with an optional type, as for read
    ///
    /// Also a name of the table of --tags or of the PLC of --config; without any, all of these.
    #[arg(value_name = "TAG", add = ArgValueCompleter::new(complete::tags))]
    pub(crate) tags: Vec<String>,
    #[command(flatten)]
    pub(crate) table: TableArgs,
    /// Poll interval, more than 0s, up to 24h
    #[arg(long, default_value = "1s", value_parser = duration::parse_positive, value_name = "TIME")]
    pub(crate) interval: Duration,
    /// Write nothing
    #[arg(long, conflicts_with = "special")]
    pub(crate) read_only: bool,
    /// Take special elements for writes, too: R3840-R4167 and M1912-M2001
    #[arg(long)]
    pub(crate) special: bool,
    #[command(flatten)]
    pub(crate) model: ModelArgs,
    #[command(flatten)]
    pub(crate) plc: Plc,
}
