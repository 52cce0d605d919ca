//! Arguments of `fatek ping`, `fatek clock` and `fatek probe`.

use std::time::Duration;

use clap::Args;

use super::Plc;
use crate::duration;

/// Measure the round trip with loop-back requests
///
/// The first time includes opening the connection. Requests are not retried. Exit status 4 if a
/// reply is missing.
#[derive(Debug, Args)]
pub(crate) struct PingArgs {
    /// Number of requests, 1 or more
    #[arg(short, long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..), value_name = "N")]
    pub(crate) count: u32,
    /// Pause between a reply and the next request, up to 24h
    #[arg(short, long, default_value = "1s", value_parser = duration::parse, value_name = "TIME")]
    pub(crate) interval: Duration,
    /// Data length in bytes, 0 to 256
    #[arg(short, long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(0..=256), value_name = "N")]
    pub(crate) size: u16,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Print or set the clock of the PLC
///
/// The clock has no time zone. Setting it writes M1952 and R4128 to R4134, and reads the clock back.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek clock --link tcp://192.168.2.3 --station 1
  fatek clock --set 2026-11-29T06:30:00
  fatek clock --set now

The PLC does not say which weekday is 0: without --weekday the number follows
from the date and the weekday that the clock has now.")]
pub(crate) struct ClockArgs {
    /// Time to set: now (UTC), or date and time such as 2026-11-29T06:30:00
    #[arg(long, value_name = "TIME")]
    pub(crate) set: Option<String>,
    /// Weekday to set, 0 to 6 [default: counted on from the clock]
    #[arg(long, requires = "set", value_parser = clap::value_parser!(u8).range(0..=6), value_name = "N")]
    pub(crate) weekday: Option<u8>,
    #[command(flatten)]
    pub(crate) plc: Plc,
}

/// Find what the PLC supports, by reading only
///
/// Some 30 requests: commands, longest requests, words of discretes, response time. JSON is the form
/// of the type Capabilities.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek probe --link tcp://192.168.2.3 --station 1
  fatek probe --format json

Commands that write or control, and program pages, are not tried: their support
is unknown. R0 must be readable.")]
pub(crate) struct ProbeArgs {
    #[command(flatten)]
    pub(crate) plc: Plc,
}
