//! Arguments of `fatek ping` and `fatek scan`.

use std::str::FromStr;
use std::time::Duration;

use clap::Args;

use super::{LinkArgs, Plc};
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

/// Scan a line for stations
///
/// Reads the status of each station in turn, and the detailed status of each station that answers.
/// All unexpected traffic is reported: bad replies, garbage, late and duplicate frames. Exit status
/// 0 if stations answer and all replies are good, 4 if no station answers, 6 if a reply is bad, as
/// with two stations of one number.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  fatek scan --link tcp://192.168.2.3
  fatek scan 1-16 --timeout 1s --retries 2
  fatek scan --link 'serial:/dev/ttyUSB0?baud=19200'

The default of --timeout is 200ms: all 254 stations take up to 51 s.

Column answer:
  ok       good replies
  refused  error code, such as for a command unknown to the station
  bad      no good reply, or other frames or garbage besides
  late     reply after the timeout: increase --timeout

JSON: array of objects with station, answer, running, main_unit, os_version,
time_ms and note; unknown values are null.")]
pub(crate) struct ScanArgs {
    /// Station range, both ends included, or one station; 1 to 254
    #[arg(default_value = "1-254", value_name = "FROM-TO")]
    pub(crate) stations: Stations,
    /// Retries after no reply or a bad reply, 0 to 10
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=10), value_name = "N")]
    pub(crate) retries: u32,
    #[command(flatten)]
    pub(crate) link: LinkArgs,
}

/// Range of station numbers, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stations {
    pub(crate) first: u8,
    pub(crate) last: u8,
}

impl FromStr for Stations {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let number = |text: &str| {
            let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
            text.parse().ok().filter(|number| digits && (1..=254).contains(number))
        };
        let (first, last) = text.split_once('-').unwrap_or((text, text));
        match (number(first), number(last)) {
            (Some(first), Some(last)) if first <= last => Ok(Self { first, last }),
            _ => Err("expected a station or a range of stations from 1 to 254, such as 5 or 1-16".to_owned()),
        }
    }
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
