//! Arguments of `fatek watch`.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use clap_complete::ArgValueCompleter;

use super::{ModelArgs, Plc};
use crate::names::TableArgs;
use crate::{byte_size, complete, duration};

/// Poll tags and print each value with its time
///
/// Prints one line per value until Ctrl-C, or with --wide one line per reading. Values that cannot be
/// read are printed with the reason, and polled again.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek watch R0-R9 R100:f32 --interval 500ms --on-change
  fatek watch R5:i16*0.1-40 --deadband 0.5 --format csv --count 1000
  fatek watch R0-R9 M0 --wide --for 10m --log day.csv --log-size 10M
  fatek --config plant.toml @all watch --plot level

A reading reads all tags of a PLC once. The time is that of the reply.
A value whose quality is not good is printed with the reason: (stale: ...)
after the last good value, or (bad: ...) without a value.
JSON: one object per line with time, tag, value and quality; no value is null.
JSON of --wide: one object per line with time, plc if there are several,
values (an object), and quality. A value that is not good is null there.
The file of --log is CSV in any format of the output. A file that exists is
continued; when it is full it becomes FILE.1, FILE.1 becomes FILE.2, and so on.")]
pub(crate) struct WatchArgs {
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
    /// Print a value only when its value or quality changes
    #[arg(long)]
    pub(crate) on_change: bool,
    /// Deadband: as --on-change, for numbers only changes by more than this
    #[arg(long, value_name = "NUMBER")]
    pub(crate) deadband: Option<f64>,
    /// Number of readings of each PLC before exit, 1 or more [default: unlimited]
    ///
    /// Failed readings count, and with --on-change also those without a change.
    #[arg(short, long, value_parser = clap::value_parser!(u64).range(1..), value_name = "N")]
    pub(crate) count: Option<u64>,
    /// Time before exit, more than 0s, up to 24h [default: unlimited]
    #[arg(long = "for", value_parser = duration::parse_positive, value_name = "TIME")]
    pub(crate) duration: Option<Duration>,
    /// One line per reading with a column for each tag, in place of a line per value
    #[arg(long, conflicts_with = "deadband")]
    pub(crate) wide: bool,
    /// Local time with its UTC offset, in place of UTC
    #[arg(long)]
    pub(crate) local_time: bool,
    /// Draw this tag on the whole terminal, in place of lines
    ///
    /// An element or a name, as for TAG. A range and several PLCs have a curve for each value, 6 at most.
    #[arg(long, value_name = "TAG", add = ArgValueCompleter::new(complete::tags),
        conflicts_with_all = ["tags", "on_change", "deadband", "count", "wide", "local_time", "log"])]
    pub(crate) plot: Option<String>,
    #[command(flatten)]
    pub(crate) log: LogArgs,
    #[command(flatten)]
    pub(crate) model: ModelArgs,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Log file of `fatek watch`.
#[derive(Debug, Args)]
pub(crate) struct LogArgs {
    /// Append the lines to this CSV file, too
    #[arg(long = "log", id = "log", value_name = "FILE")]
    pub(crate) file: Option<PathBuf>,
    /// Size of a full log file in bytes, or with K, M or G; at least 1K
    #[arg(long = "log-size", id = "log-size", requires = "log", default_value = "100M",
        value_parser = byte_size::parse, value_name = "SIZE")]
    pub(crate) size: u64,
    /// Number of full log files that are kept, 0 to 999
    #[arg(long = "log-keep", id = "log-keep", requires = "log", default_value_t = 9,
        value_parser = clap::value_parser!(u16).range(0..=999), value_name = "N")]
    pub(crate) keep: u16,
}
